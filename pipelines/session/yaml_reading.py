"""Reading of safe YAML into plain mappings, lists and numbers; problems are one-line errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pipelines.session.errors import DataError

_MOST_BITS = 1024  # a float holds integers of fewer


def plain_yaml(path: Path, text: str) -> object:
    """Parse YAML into plain types only.

    Args:
        path: the file of the text, for messages.
        text: of the whole file.

    Raises:
        DataError: no valid YAML; the message names the line if it is known. Or a value that no program
            can use: a text that cannot be written, an integer beyond any float.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    remedy = "mend it, or copy the file again if it was cut off"
    try:
        value: object = YAML(typ="safe", pure=True).load(text)
    except MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = " ".join(str(error.problem or error.context).split())
        raise DataError(path, f"is no valid YAML{line} ({problem})", remedy) from None
    except (YAMLError, ValueError, RecursionError) as error:
        problem = " ".join(str(error).split())[:200]
        raise DataError(path, f"is no valid YAML ({problem})", remedy) from None
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
        elif isinstance(item, int) and item.bit_length() >= _MOST_BITS:
            digits = item.bit_length() * 3 // 10
            raise _impossible(path, place, f"holds an integer of about {digits} digits")


def _impossible(path: Path, place: tuple[object, ...], problem: str) -> DataError:
    where = ".".join(map(str, place))[:200]
    return DataError(path, f"{where}: {problem}" if where else problem, "mend it")


def _is_unicode(text: str) -> bool:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
