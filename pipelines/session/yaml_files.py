"""Reading of users' YAML files: into plain types, and into models with all problems in one message."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_origin

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo

from pipelines.session.errors import DataError
from pipelines.session.storage import read_text

# A real file has a few thousand bytes, and a parser of YAML needs seconds for a million.
MAX_FILE_BYTES = 1_000_000

# Differences of two such times still fit into 64 bits.
LATEST_NS = 2**62


def nanoseconds(value: object) -> int:
    """Convert seconds, a number or text, to exact nanoseconds; ValueError for no time before 2116."""
    try:
        exact = Decimal(str(value)) * 1_000_000_000
        is_near = abs(exact) <= LATEST_NS  # before it becomes an integer of as many digits
    except ArithmeticError:
        raise ValueError("is no time in seconds") from None
    if not is_near:
        raise ValueError("is no time in seconds: it lies beyond the year 2116 (are these ms or ns?)")
    return int(exact.to_integral_value())


SecondsAsNs = Annotated[int, BeforeValidator(nanoseconds)]
"""Seconds in the file (number or text), exact nanoseconds in the program."""


class YamlModel(BaseModel):
    """A mapping of the manifest: unknown keys are refused, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)

    shorthand: ClassVar[str | None] = None
    """The key that a bare text (or list) stands for: `map: site.bt` means `map: {file: site.bt}`."""
    one_of: ClassVar[tuple[str, ...]] = ()
    """The keys that exclude each other; exactly one of them must be there."""

    @model_validator(mode="before")
    @classmethod
    def _expand_shorthand(cls, value: object) -> object:
        return {cls.shorthand: value} if cls.shorthand and isinstance(value, str | list) else value

    @field_validator("*", mode="before")
    @classmethod
    def _true_is_no_number(cls, value: object, info: ValidationInfo) -> object:
        annotation = cls.model_fields[info.field_name or ""].annotation
        if _holds_truth_value(value) and not _allows_truth_value(annotation):
            raise ValueError("is true or false where a number or text belongs")
        return value

    @model_validator(mode="after")
    def _exactly_one(self) -> YamlModel:
        stated = [name for name in self.one_of if getattr(self, name) not in (None, "")]
        if self.one_of and len(stated) != 1:
            raise ValueError(f"needs exactly one of {', '.join(self.one_of)}" + f" (has {len(stated)})")
        return self


def _holds_truth_value(value: object) -> bool:
    if isinstance(value, Mapping):
        value = list(value.values())
    return any(map(_holds_truth_value, value)) if isinstance(value, list) else isinstance(value, bool)


def _allows_truth_value(annotation: object) -> bool:
    """Return True for a type that is or contains `bool`, anything, or a model with fields of its own."""
    is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    if annotation in (bool, Any, object) or isinstance(annotation, bool) or is_model:
        return True
    return any(map(_allows_truth_value, get_args(annotation)))


M = TypeVar("M", bound=YamlModel)


def keys_of(model: type[YamlModel]) -> set[str]:
    """Return the keys that a mapping of this kind may have, as users write them."""
    return {field.alias or name for name, field in model.model_fields.items()}


def read_yaml_model(
    path: Path,
    model: type[M],
    noun: str,
    *,
    newest: int,
    shape: str,
    made: str = "",
    refuse: Callable[[Path, Mapping[object, object]], None] | None = None,
) -> M:
    """Read and validate a file.

    Args:
        model: the model of its content; the schema's version is the value of the key `schema`.
        noun: the name of such a file ("flight manifest").
        newest: the newest version of the schema.
        shape: a description of the file's form, for the message if the file is no mapping.
        made: how one is made, for the message if the file is another one.
        refuse: raises a DataError for a content that is worth a message of its own.

    Raises:
        DataError: the file is missing, no YAML, or does not keep to the schema; the message holds
            every problem that was found.
    """
    how = f" ({made})" if made else ""
    raw = plain_yaml(path, read_text(path, most_bytes=MAX_FILE_BYTES))
    if not isinstance(raw, Mapping):
        raise DataError(path, f"is no {noun}", f"it must be {shape}{how}", code="wrong-kind")
    if isinstance(raw.get("schema"), int) and raw["schema"] > newest:
        problem = f"has schema {raw['schema']}, newer than {newest}"
        raise DataError(path, problem, "use a newer version of mocap", code="newer-schema")
    if refuse is not None:
        refuse(path, raw)
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        problems = [describe_problem(problem, model) for problem in error.errors()]
        raise DataError(path, "; ".join(dict.fromkeys(problems)), code="bad-value") from None


def describe_problem(
    problem: Any, model: type[YamlModel]
) -> str:  # ErrorDetails, whose ctx has no fixed shape
    """Describe a problem that pydantic found, with its place."""
    place = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        known = list(_fields_at(model, problem["loc"][:-1]))
        return f"{place}: {unknown_key(str(problem['loc'][-1]), known)}"
    if problem["type"] == "missing":
        examples = _fields_at(model, problem["loc"][:-1])[problem["loc"][-1]].examples
        return f"{place}: is missing" + (f", for example {examples[0]}" if examples else "")
    if problem["type"] in {"model_type", "model_attributes_type", "dict_type"}:
        return f"{place}: must be a mapping (key: value), not {str(problem['input'])[:60]!r}"
    if problem["type"] == "too_short" and problem["ctx"]["min_length"] == 1:
        return f"{place}: needs at least one"
    message = problem["msg"].removeprefix("Value error, ")
    return f"{place}: {message}" if place else message


def unknown_key(key: str, known: Sequence[str]) -> str:
    """Describe a key that nothing knows, with the nearest known one."""
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
    return f"unknown key, {hint}"


def _fields_at(model: type[YamlModel], place: tuple[str | int, ...]) -> dict[str, FieldInfo]:
    """Return the fields by key that the schema allows at a place, by walking the types of the fields."""
    kind: Any = model
    for part in place:
        if isinstance(kind, type) and issubclass(kind, YamlModel):
            fields = {field.alias or name: field for name, field in kind.model_fields.items()}
            kind = _plain(fields[str(part)].annotation)
        else:  # a list or a dict
            kind = _plain(get_args(kind)[-1])
    return {field.alias or name: field for name, field in kind.model_fields.items()}


def _plain(annotation: Any) -> Any:
    """Return a type without `None` and without its `Annotated` metadata."""
    if get_origin(annotation) is Annotated:
        return _plain(get_args(annotation)[0])
    if type(None) in get_args(annotation):
        return _plain(next(a for a in get_args(annotation) if a is not type(None)))
    return annotation


# A float holds no integer of more bits.
MAX_INTEGER_BITS = 1024

# The parser reads 10,000 to 20,000 values in a second.
MAX_MARKS = 30_000

# Merges of merges copy entries without end; no file of a user has so many.
MAX_MERGED_ENTRIES = 100_000


def plain_yaml(path: Path, text: str) -> object:
    """Parse YAML into plain types only.

    DataError if it is no YAML, beyond reason as merges of merges, or holds what no program can use.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.constructor import ConstructorError, SafeConstructor
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    class Constructor(SafeConstructor):
        merged = 0

        def flatten_mapping(self, node: Any) -> Any:
            super().flatten_mapping(node)
            self.merged += len(getattr(node, "merge", None) or ())
            if self.merged > MAX_MERGED_ENTRIES:
                raise ConstructorError(
                    None, None, f"merges more than {MAX_MERGED_ENTRIES} entries", node.start_mark
                )

    marks = sum(map(text.count, "\n,:[{-?&*"))
    if marks > MAX_MARKS:
        raise DataError(
            path, f"holds about {marks} values", f"at most {MAX_MARKS} are read", code="too-large"
        )
    remedy = "mend it, or copy the file again if it was cut off"
    parser = YAML(typ="safe", pure=True)
    parser.Constructor = Constructor
    try:
        value: object = parser.load(text)
    except MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = " ".join(str(error.problem or error.context).split())
        raise DataError(path, f"is no valid YAML{line} ({problem})", remedy, code="damaged") from None
    except (YAMLError, ValueError, RecursionError) as error:
        problem = " ".join(str(error).split())[:200]
        raise DataError(path, f"is no valid YAML ({problem})", remedy, code="damaged") from None
    _refuse_impossible_values(path, value)
    return value


def _refuse_impossible_values(path: Path, value: object) -> None:
    """Refuse integers beyond any float, and texts with characters that no file name can hold.

    Such characters are zero bytes and lone surrogates. Python cannot print integers of thousands of digits.
    """
    seen: set[int] = set()  # an aliased value is one object, however often it is used
    waiting: list[tuple[object, tuple[object, ...]]] = [(value, ())]
    while waiting:
        item, place = waiting.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, Mapping):
            waiting += [(part, (*place, key)) for key, part in item.items()]
            waiting += [(key, place) for key in item]  # last, so keys are checked before they name places
        elif isinstance(item, list | tuple):  # a tuple is a key
            waiting += [(part, (*place, index)) for index, part in enumerate(item)]
        elif isinstance(item, str) and ("\0" in item or not _is_unicode(item)):
            raise _impossible(path, place, f"holds a text with impossible characters ({item[:60]!r})")
        elif isinstance(item, int) and item.bit_length() >= MAX_INTEGER_BITS:
            digits = item.bit_length() * 3 // 10
            raise _impossible(path, place, f"holds an integer of about {digits} digits")


def _impossible(path: Path, place: tuple[object, ...], problem: str) -> DataError:
    where = ".".join(map(str, place))[:200]
    return DataError(path, f"{where}: {problem}" if where else problem, "mend it", code="bad-value")


def _is_unicode(text: str) -> bool:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
