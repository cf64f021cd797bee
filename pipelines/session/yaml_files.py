"""Reading of users' YAML files: into plain types, and into models with all problems in one message."""

import re
from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from pydantic import ValidationError

from pipelines.session.errors import DataError
from pipelines.session.storage import read_text, url_of
from pipelines.session.yaml_models import YamlModel, describe_problem

# A real file has a few thousand bytes, and a parser of YAML needs seconds for a million.
MAX_FILE_BYTES = 1_000_000

M = TypeVar("M", bound=YamlModel)


def read_yaml_model(path: Path, model: type[M], noun: str, *, newest: int, shape: str, made: str = "") -> M:
    """Read and validate a file; one DataError holds every problem that was found."""
    how = f" ({made})" if made else ""
    raw = plain_yaml(path, read_text(path, most_bytes=MAX_FILE_BYTES))
    for text in [value for value, _ in _values(path, raw) if isinstance(value, str)]:
        url_of(text)  # before any message repeats a secret in it
    if not isinstance(raw, Mapping):
        raise DataError(path, f"is no {noun}", f"it must be {shape}{how}", code="wrong-kind")
    if isinstance(raw.get("schema"), int) and raw["schema"] > newest:
        problem = f"has schema {raw['schema']}, newer than {newest}"
        raise DataError(path, problem, "use a newer version of mocap", code="newer-schema")
    return checked(model, raw, path)


OPTION_CODES = {"literal_error": "no-such-name", "extra_forbidden": "no-such-name", "twice": "stated-twice"}
"""Codes of problems, by pydantic's types, in options of the command line."""


def checked(
    model: type[M],
    values: Mapping[str, object],
    source: Path | str,
    codes: Mapping[str, str] = MappingProxyType({}),
) -> M:
    """Validate values; one DataError holds every problem, with the code of the first one's kind."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = [describe_problem(problem, model) for problem in error.errors()]
        code = codes.get(error.errors()[0]["type"], "bad-value")
        raise DataError(source, "; ".join(dict.fromkeys(problems)), code=code) from None


# No file name holds these, and UTF-8 no lone surrogate.
_IMPOSSIBLE = re.compile("[\0\ud800-\udfff]")
# A float holds no integer of more bits.
MAX_INTEGER_BITS = 1024

# The parser reads 10,000 to 20,000 values in a second.
MAX_MARKS = 30_000

# Merges of merges, and aliases, repeat entries without end; no file of a user has so many.
MAX_MERGED_ENTRIES = 100_000


def plain_yaml(path: Path, text: str) -> object:
    """Parse YAML into plain types only; DataError: it is none, beyond reason, or holds impossible values."""
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
        problem = f"holds about {marks} values"
        raise DataError(path, problem, f"at most {MAX_MARKS} are read", code="too-large")
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
    """Refuse integers beyond any float, and texts with characters that no file name can hold."""
    for item, place in _values(path, value):
        if isinstance(item, str) and _IMPOSSIBLE.search(item):
            raise _impossible(path, place, f"holds a text with impossible characters ({item[:60]!r})")
        if isinstance(item, int) and item.bit_length() >= MAX_INTEGER_BITS:
            digits = item.bit_length() * 3 // 10
            raise _impossible(path, place, f"holds an integer of about {digits} digits")


def _values(path: Path, value: object) -> Iterator[tuple[object, tuple[object, ...]]]:
    """Yield all keys and values with their places; an aliased value each time that it is used."""
    waiting: list[tuple[object, tuple[object, ...]]] = [(value, ())]
    for visited in count():
        if not waiting:
            return
        if visited > MAX_MERGED_ENTRIES:  # an alias of what it is within repeats it without end
            problem = f"repeats values (&, *) to more than {MAX_MERGED_ENTRIES:,}"
            raise DataError(path, problem, "write them once", code="too-large")
        item, place = waiting.pop()
        yield item, place
        if isinstance(item, Mapping):
            waiting += [(part, (*place, key)) for key, part in item.items()]
            waiting += [(key, place) for key in item]  # last, so keys are checked before they name places
        elif isinstance(item, list | tuple):  # a tuple is a key
            waiting += [(part, (*place, index)) for index, part in enumerate(item)]


def _impossible(path: Path, place: tuple[object, ...], problem: str) -> DataError:
    where = ".".join(map(str, place))[:200]
    return DataError(path, f"{where}: {problem}" if where else problem, "mend it", code="bad-value")
