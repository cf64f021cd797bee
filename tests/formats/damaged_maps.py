"""Damage as from disks, networks and attackers: a reader may refuse such a file or read it, nothing else."""

from __future__ import annotations

import random
from pathlib import Path

from pipelines.session.errors import DataError
from pipelines.session.registries import MapFormat


def damaged(content: bytes, seed: int) -> bytes:
    """Return a copy with a few bytes changed, cut out, doubled, or cut off at the end."""
    choice = random.Random(seed)  # noqa: S311 - damage needs no secrecy, but must be reproducible
    changed = bytearray(content)
    for _ in range(choice.randint(1, 4)):
        at = choice.randrange(len(changed)) if changed else 0
        # Headers are a small part of a file but the better target, so every other change is there.
        at = min(at, choice.randrange(200)) if choice.random() < 0.5 else at
        match choice.randrange(4):
            case 0:
                changed[at : at + 1] = bytes([choice.randrange(256)])
            case 1:
                changed[at : at + choice.randint(1, 8)] = b""
            case 2:
                changed[at:at] = changed[at : at + choice.randint(1, 8)]
            case _:
                changed[at : at + 1] = choice.choice([b"9", b"-", b"e", b"\n", b" ", b"0", b"\xff"])
    if choice.random() < 0.3:
        del changed[choice.randrange(len(changed) + 1) :]
    return bytes(changed)


def refuse_or_read(reader: MapFormat, path: Path, content: bytes, *, tries: int) -> int:
    """Read damaged copies of a file; return how many were refused. Only a DataError is accepted."""
    refused = 0
    for seed in range(tries):
        path.write_bytes(damaged(content, seed))
        reader.recognises(path)
        try:
            reader.describe(path)
            reader.read_map(path)
        except DataError as error:
            assert "\n" not in str(error)  # noqa: PT017 - one line each
            refused += 1
    return refused
