"""Models of users' YAML files: an unknown key is refused with the nearest known one."""

import difflib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from typing import Annotated, Any, ClassVar, Self, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationInfo, field_validator, model_validator
from pydantic.fields import FieldInfo

# Differences of two such times still fit into 64 bits.
LATEST_NS = 2**62


def nanoseconds(value: object) -> int:
    """Convert seconds, a number or text, to exact nanoseconds; ValueError for no time before 2116."""
    try:
        exact = Decimal(str(value)) * 1_000_000_000
        is_near = abs(exact) <= LATEST_NS  # before it becomes an integer of as many digits
    except ArithmeticError:
        raise ValueError(f"is no time in seconds{_seconds_of(str(value))}") from None
    if not is_near:
        raise ValueError("is no time in seconds: it lies beyond the year 2116 (are these ms or ns?)")
    return int(exact.to_integral_value())


def _seconds_of(date: str) -> str:
    """Say a date in seconds; without a zone it counts as UTC. Empty for another text."""
    try:
        moment = datetime.fromisoformat(date)
    except ValueError:
        return ", such as 1700000000.25 since 1970 or 12.5 since a log's start"
    return f": {date} is {(moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp():.6f}"


SecondsAsNs = Annotated[int, BeforeValidator(nanoseconds)]
"""Seconds in the file (number or text), exact nanoseconds in the program."""


_RENAMED = {
    **dict.fromkeys(("path", "log", "csv", "srt", "tum", "static", "dji", "ulog", "ardupilot"), "file"),
    **dict.fromkeys(("tlog", "gopro", "joints"), "file"),
    "fixed": "yaw_deg",
    "body_from_camera": "rotation_xyzw",
    "world_from_log": "world_from_source",
    "start_from": "start",
}
"""Keys of earlier versions of flight.yaml, with their names today."""


class YamlModel(BaseModel):
    """A mapping of the manifest: unknown keys are refused, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)

    shorthand: ClassVar[str | None] = None
    """The key that a bare text (or list) stands for: `map: site.bt` means `map: {file: site.bt}`."""
    one_of: ClassVar[tuple[str, ...]] = ()
    """The keys that exclude each other; exactly one of them must be there."""

    @model_validator(mode="before")
    @classmethod
    def _by_its_keys(cls, value: object) -> object:
        """Expand a shorthand, and read keys by the names that they had before 0.1.0."""
        if cls.shorthand and isinstance(value, str | list):
            return {cls.shorthand: value}
        return _by_todays_names(value, keys_of(cls)) if isinstance(value, dict) else value

    @field_validator("*", mode="before")
    @classmethod
    def _true_is_no_number(cls, value: object, info: ValidationInfo) -> object:
        annotation = cls.model_fields[info.field_name or ""].annotation
        if _holds_truth_value(value) and not _allows_truth_value(annotation):
            raise ValueError("is true or false where a number or text belongs")
        return value

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        stated = [name for name in self.one_of if getattr(self, name) not in (None, "")]
        if self.one_of and len(stated) != 1:
            held = f"has {' and '.join(stated)}: leave out all but one" if stated else "has none: add one"
            raise ValueError(f"needs exactly one of {', '.join(self.one_of)}, and {held}")
        return self


def _by_todays_names(value: dict[object, object], known: set[str]) -> dict[object, object]:
    """Rename keys of earlier versions; one whose new name is there already stays, and is refused."""
    found: dict[object, object] = {}
    for key, each in value.items():
        name = key if key in known else _RENAMED.get(str(key), key)
        was_nested = key != name and name in known and (name == "file" or _is_part(each, known))
        if was_nested and isinstance(each, dict) and not each.keys() & {*value, *found}:
            found |= each  # options stood below the file's kind, and angles below `fixed`
        else:
            found[name if name in known and name not in {*value, *found} else key] = each
    return found if found == value else _by_todays_names(found, known)


def _is_part(value: object, known: set[str]) -> bool:
    return isinstance(value, dict) and value.keys() <= known


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


def keys_of(model: type[YamlModel]) -> set[str]:
    """Return the keys that a mapping of this kind may have, as users write them."""
    return {field.alias or name for name, field in model.model_fields.items()}


def describe_problem(
    problem: Any, model: type[YamlModel]
) -> str:  # ErrorDetails, whose ctx has no fixed shape
    """Describe a problem that pydantic found, with its place."""
    place = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        known = list(_fields_at(model, problem["loc"][:-1]))
        return f"{place}: {unknown_key(str(problem['loc'][-1]), known)}"
    if problem["type"] == "missing":
        *above, key = problem["loc"]
        examples = _fields_at(model, tuple(above))[key].examples if isinstance(key, str) else None
        return f"{place}: is missing" + (f", for example {examples[0]}" if examples else "")
    if problem["type"] in {"model_type", "model_attributes_type", "dict_type"}:
        return f"{place}: must be a mapping (key: value), not {str(problem['input'])[:60]!r}"
    if problem["type"] == "too_short" and problem["ctx"]["min_length"] == 1:
        return f"{place}: needs at least one"
    message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
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
