"""Driver of the fuzz tests: damages seeds and watches the process that reads them."""

from __future__ import annotations

import json
import random
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.fuzz.mutations import damage_one
from tests.fuzz.seeds import HEADS, SEEDS, sown

_WAIT_S = 120.0  # for an answer, however busy the machine is; the worker counts its own CPU time


@dataclass(frozen=True)
class Trouble:
    """Input that was neither read nor refused."""

    seed: str
    number: int
    file: str
    what: str


@dataclass(frozen=True)
class Fuzzed:
    """Results of all inputs."""

    inputs: int
    read: int  # ways in which inputs were read
    refused: int
    troubles: list[Trouble]


def fuzz(folder: Path, inputs: int, *, seed: int = 0, names: Sequence[str] | None = None) -> Fuzzed:
    """Read damaged copies of the seeds, the same number of each.

    Args:
        folder: an empty one to work in; inputs that made trouble stay below `trouble/`.
        inputs: number of inputs.
        seed: seed of all damage; input k does not depend on the number of inputs.
        names: the seeds, all by default.
    """
    chosen = list(names or SEEDS)
    sources = sown(folder / "seeds", chosen)
    reader = _Reader([[str(sources[name]), format_of(name)] for name in chosen])
    read = refused = 0
    troubles = []
    try:
        for number in range(inputs):
            name = chosen[number % len(chosen)]
            place = folder / "input"
            copy, file = _damaged_copy(sources[name], place, random.Random(f"{seed} {number}"))  # noqa: S311
            answer = reader.ask(copy, format_of(name))
            read += answer.get("read", 0)
            refused += answer.get("refused", 0)
            if "trouble" in answer:
                troubles.append(Trouble(name, number, file, answer["trouble"]))
                shutil.copytree(place, folder / "trouble" / f"{number}", dirs_exist_ok=True)
            shutil.rmtree(place)
    finally:
        reader.close()
    return Fuzzed(inputs, read, refused, troubles)


def format_of(name: str) -> str:
    """Return the format of a seed."""
    return name.replace(",", " ").split()[0]


def _damaged_copy(source: Path, place: Path, choice: random.Random) -> tuple[Path, str]:
    """Copy a seed and damage one file; return the copy and the name of that file."""
    together = source.parent if source.name in HEADS else source
    if together.is_dir():
        target = place / together.name
        shutil.copytree(together, target)
        return (target if together == source else target / source.name), damage_one(target, choice)
    place.mkdir()
    target = place / source.name
    shutil.copyfile(source, target)
    return target, damage_one(target, choice)


class _Reader:
    """Process that reads; replaced by another one after it died."""

    def __init__(self, warm: list[list[str]]) -> None:
        self._warm = json.dumps(warm)
        self._process: subprocess.Popen[str] | None = None

    def ask(self, path: Path, stated: str) -> dict[str, Any]:
        process = self._process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps([str(path), stated]) + "\n")
        process.stdin.flush()
        if not select.select([process.stdout], [], [], _WAIT_S)[0]:
            self.close()
            return {"trouble": f"no answer within {_WAIT_S:g} s"}
        line = process.stdout.readline()
        if line:
            answer: dict[str, Any] = json.loads(line)
            return answer
        status = process.wait()
        self.close()
        if status == -signal.SIGPROF:
            return {"trouble": "took more than 10 s of CPU"}
        return {"trouble": f"the process died with status {status}"}

    def _start(self) -> subprocess.Popen[str]:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stdin is not None
        self._process.stdin.write(self._warm + "\n")
        return self._process

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
