"""Writers of YAML text with comments in the right places: scalars, flow mappings, comments of one line.

Names come from file systems and logs, and may hold any character. A scalar is always read back as the same
text, and a comment always ends at the end of its line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from decimal import Decimal

# Texts that every reader of YAML, old or new, reads as text without quotes.
_PLAIN = re.compile(r"(?:\.\.?/)*[A-Za-z_/][A-Za-z0-9_./-]*(?: [A-Za-z0-9_./-]+)*")
_WORDS_OF_YAML = frozenset(["null", "true", "false", "yes", "no", "on", "off", "y", "n"])
_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def scalar(value: object) -> str:
    """Write a text, number or boolean as one YAML scalar on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float | Decimal):
        return format(value, "f") if isinstance(value, Decimal) else str(value)
    text = str(value)
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS_OF_YAML:
        return text
    return '"' + "".join(_escaped(character) for character in text) + '"'


def _escaped(character: str) -> str:
    if character in _ESCAPES:
        return _ESCAPES[character]
    if character.isprintable():
        return character
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def flow(value: object) -> str:
    """Write mappings and lists in one line, anything else as `scalar`."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{scalar(key)}: {flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(flow(item) for item in value) + "]"
    return scalar(value)


def entry(key: str, value: object, comment: str = "") -> str:
    """Write a line `key: value  # comment`, without indentation."""
    return commented(f"{scalar(key)}: {flow(value)}", comment)


def commented(line: str, comment: str) -> str:
    """Append a comment to a line, if there is one."""
    return f"{line}  # {one_line(comment)}" if comment else line


def one_line(text: str) -> str:
    """Replace all characters that end a line or control a terminal."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
