"""Driver of the fuzz tests: damages seeds and watches the process that reads them."""

import random
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.attacking import Reader
from tests.fuzz.mutations import damage_one
from tests.fuzz.seeds import HEADS, SEEDS, sown


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
    """Read damaged copies of the seeds (all by default), the same number of each, in an empty folder.

    Inputs that made trouble stay below `trouble/`; input k does not depend on the number of inputs.
    """
    chosen = list(names or SEEDS)
    sources = sown(folder / "seeds", chosen)
    read = refused = 0
    troubles = []
    with Reader([(str(sources[name]), format_of(name)) for name in chosen]) as reader:
        for number in range(inputs):
            name = chosen[number % len(chosen)]
            place = folder / "input"
            copy, file = _damaged_copy(sources[name], place, random.Random(f"{seed} {number}"))  # noqa: S311
            answer = reader.ask(copy, format_of(name))
            read += answer["read"]
            refused += answer["refused"]
            if answer["trouble"]:
                troubles.append(Trouble(name, number, file, answer["trouble"]))
                shutil.copytree(place, folder / "trouble" / f"{number}", dirs_exist_ok=True)
            shutil.rmtree(place)
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
