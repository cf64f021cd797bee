"""Long run of the fuzz tests: `python -m tests.fuzz`; of crafted inputs, or attacks by others' sessions."""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.attacking import Met, attack
from tests.fuzz.crafted import KINDS, crafted
from tests.fuzz.foreign import foreign
from tests.fuzz.fuzzing import fuzz
from tests.fuzz.seeds import SEEDS


def main() -> int:
    """Fuzz all readers; return 1 if any input was neither read nor refused."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=sorted(SEEDS), help="seeds")
    parser.add_argument("--keep", type=Path, help="an empty folder, where inputs that make trouble stay")
    parser.add_argument(
        "--crafted", nargs="*", choices=KINDS, help="crafted inputs instead, of all classes or some"
    )
    parser.add_argument(
        "--foreign", type=int, nargs="?", const=200, help="attacks by others' sessions instead"
    )
    parser.add_argument("--number", type=int, help="this one of the attacks alone")
    stated = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if stated.foreign is not None:
            numbers = range(stated.foreign) if stated.number is None else [stated.number]
            return _show(foreign(Path(folder), numbers, seed=stated.seed), all_of_them=False)
        if stated.crafted is not None:
            return _show(attack(crafted(stated.crafted or list(KINDS)), Path(folder)), all_of_them=True)
        place = stated.keep or Path(folder)
        damaged = fuzz(place, stated.inputs, seed=stated.seed, names=stated.only)
        return _show(damaged, all_of_them=False)


def _show(attacks: Iterator[Met], *, all_of_them: bool) -> int:
    """Print a table of inputs, all or those with trouble, and one of classes; return 1 for any trouble."""
    met = []
    print("| class | input | kB | s | MB | outcome |\n| --- | --- | --- | --- | --- | --- |")  # noqa: T201
    for each in attacks:
        met.append(each)
        outcome = each.trouble.strip().rpartition("\n")[2] or ("refused" if each.refused else "read")
        row = [
            each.kind,
            each.what,
            f"{each.bytes / 1e3:.0f}",
            f"{each.cpu_s:.1f}",
            f"{each.mb:.0f}",
            outcome,
        ]
        if all_of_them or each.trouble:
            print("|", " | ".join(row), "|", flush=True)  # noqa: T201
    print("\n| class | inputs | refused | most s | most MB | trouble |\n" + "| --- " * 6 + "|")  # noqa: T201
    for kind in dict.fromkeys(each.kind for each in met):
        of_it = [each for each in met if each.kind == kind]
        counts = f"{len(of_it)} | {sum(bool(each.refused) for each in of_it)}"
        most = f"{max(each.cpu_s for each in of_it):.1f} | {max(each.mb for each in of_it):.0f}"
        print(f"| {kind} | {counts} | {most} | {sum(bool(each.trouble) for each in of_it)} |")  # noqa: T201
    return int(any(each.trouble for each in met))


if __name__ == "__main__":
    sys.exit(main())
