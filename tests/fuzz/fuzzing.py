"""Driver of the fuzz tests: damages seeds and watches the process that reads them."""

import random
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.fuzz.attacking import Met, Reader
from tests.fuzz.mutations import damage_one
from tests.fuzz.seeds import HEADS, SEEDS, sown


def fuzz(folder: Path, inputs: int, *, seed: int = 0, names: Sequence[str] | None = None) -> Iterator[Met]:
    """Read damaged copies of the seeds (all by default), the same number of each, in an empty folder.

    Inputs that made trouble stay below `trouble/`; input k does not depend on the number of inputs.
    """
    chosen = list(names or SEEDS)
    sources = sown(folder / "seeds", chosen)
    with Reader([(str(sources[name]), format_of(name)) for name in chosen]) as reader:
        for number in range(inputs):
            name = chosen[number % len(chosen)]
            place = folder / "input"
            copy, file = _damaged_copy(sources[name], place, random.Random(f"{seed} {number}"))  # noqa: S311
            met = reader.met(name, f"{number}: {file}", copy, format_of(name))
            if met.trouble:
                shutil.copytree(place, folder / "trouble" / f"{number}", dirs_exist_ok=True)
            shutil.rmtree(place)
            yield met


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
