"""Long run of the fuzz tests: `python -m tests.fuzz`, and with `--crafted` that of the crafted inputs."""

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.fuzz.attacking import MOST_MB, MOST_S, attack
from tests.fuzz.crafted import KINDS, crafted
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
    stated = parser.parse_args()
    if stated.crafted is not None:
        return _attack(stated.crafted or list(KINDS))
    with tempfile.TemporaryDirectory() as folder:
        found = fuzz(stated.keep or Path(folder), stated.inputs, seed=stated.seed, names=stated.only)
    for trouble in found.troubles:
        print(f"--- input {trouble.number}, {trouble.seed}, {trouble.file}\n{trouble.what}")  # noqa: T201
    by_seed = Counter(trouble.seed for trouble in found.troubles)
    print(  # noqa: T201
        f"{found.inputs} inputs: read in {found.read} ways, refused in {found.refused},"
        f" {len(found.troubles)} made trouble" + (f": {dict(by_seed)}" if by_seed else "")
    )
    return 1 if found.troubles else 0


def _attack(kinds: list[str]) -> int:
    """Read the crafted inputs and print a table of them; return 1 if any made trouble."""
    met = []
    print("| class | input | kB | s | MB | outcome |\n| --- | --- | --- | --- | --- | --- |")  # noqa: T201
    with tempfile.TemporaryDirectory() as folder:
        for each in attack(crafted(kinds), Path(folder)):
            met.append(each)
            outcome = each.trouble.strip().rpartition("\n")[2] or ("refused" if each.refused else "read")
            row = (
                each.kind,
                each.what,
                f"{each.bytes / 1e3:.0f}",
                f"{each.cpu_s:.1f}",
                f"{each.mb:.0f}",
                outcome,
            )
            print("|", " | ".join(row), "|", flush=True)  # noqa: T201
    troubles = sum(bool(each.trouble) for each in met)
    print(  # noqa: T201
        f"{len(met)} crafted inputs in {len(kinds)} classes: at most {max(each.cpu_s for each in met):.1f} s"
        f" (of {MOST_S:g}) and {max(each.mb for each in met):.0f} MB (of {MOST_MB}); {troubles} made trouble"
    )
    return 1 if troubles else 0


if __name__ == "__main__":
    sys.exit(main())
