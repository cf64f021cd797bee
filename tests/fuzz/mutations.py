"""Damage to files as by disks, networks and attackers, the same for the same seed."""

import random
import re
import struct
from collections.abc import Callable
from pathlib import Path

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_BLOW_UPS = [
    *b"0 -1 1e308 -1e308 nan inf -inf 1e-320 1000000000000 4294967295 2147483648 0x7f 1_0 true null".split(),
    *(b"9223372036854775808", b"-9223372036854775809", b"1" + b"0" * 400, b"", b'"7"'),
]
_BINARY = [struct.pack("<Q", n) for n in (0, 10**12, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)]
_BINARY += [struct.pack("<d", x) for x in (float("nan"), float("inf"), 1e308, -1e300)]
_PIECES = (
    b"\\0",
    b"\\u0000",
    b"\\ud800",
    b"\xff",
    b"\0" * 8,
    b"\n",
    b"{",
    b"[" * 3000,
    b"]",
    b'"',
    b"&a *a",
    b"!!python/object:os.system",
)


def damaged(content: bytes, choice: random.Random) -> bytes:
    """Return a copy with one to four pieces of damage."""
    changed = bytearray(content)
    is_text = b"\0" not in content[:4096]
    for _ in range(choice.randint(1, 4)):
        kinds = [*_ANY, *([_blow_up] * 4 + [_break_lines] if is_text else [_overwrite] * 3)]
        choice.choice(kinds)(changed, choice)
    return bytes(changed)


def damage_one(path: Path, choice: random.Random) -> str:
    """Damage one file of a folder, or the file itself; return its name."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    file = choice.choice(files)
    file.write_bytes(damaged(file.read_bytes(), choice))
    return file.name


def _place(content: bytearray, choice: random.Random) -> int:
    """Choose a place; half of the hits go to the header, a small part of a file and the better target."""
    end = min(len(content), 400) if choice.random() < 0.5 else len(content)
    return choice.randrange(end + 1)


def _flip(content: bytearray, choice: random.Random) -> None:
    at = _place(content, choice)
    if at < len(content):
        content[at] ^= 1 << choice.randrange(8)


def _cut(content: bytearray, choice: random.Random) -> None:
    at = _place(content, choice)
    del content[at : at + choice.choice([1, 2, 8, 100])]


def _end(content: bytearray, choice: random.Random) -> None:
    del content[_place(content, choice) :]


def _insert(content: bytearray, choice: random.Random) -> None:
    at = _place(content, choice)
    content[at:at] = choice.choice(_PIECES)


def _repeat(content: bytearray, choice: random.Random) -> None:
    at = _place(content, choice)
    content[at:at] = content[at : at + choice.choice([1, 8, 200])]


def _overwrite(content: bytearray, choice: random.Random) -> None:
    at = _place(content, choice)
    size = choice.choice([1, 2, 4, 8])
    content[at : at + size] = choice.choice(_BINARY)[:size]


def _blow_up(content: bytearray, choice: random.Random) -> None:
    start = _place(content, choice)
    found = _NUMBER.search(content, start) or _NUMBER.search(content)
    if found:
        content[found.start() : found.end()] = choice.choice(_BLOW_UPS)


def _break_lines(content: bytearray, choice: random.Random) -> None:
    lines = bytes(content).splitlines(keepends=True)
    if lines:
        taken = lines.pop(choice.randrange(len(lines)))
        if choice.random() < 0.7:
            lines.insert(choice.randrange(len(lines) + 1), taken * choice.choice([1, 2]))
        content[:] = b"".join(lines)


_ANY: tuple[Callable[[bytearray, random.Random], None], ...] = (_flip, _flip, _cut, _end, _insert, _repeat)
