"""Long run of the fuzz tests: `python -m tests.fuzz`."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.fuzz.fuzzing import fuzz
from tests.fuzz.seeds import SEEDS


def main() -> int:
    """Fuzz all readers; return 1 if any input was neither read nor refused."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=sorted(SEEDS), help="seeds")
    parser.add_argument("--keep", type=Path, help="an empty folder, where inputs that make trouble stay")
    stated = parser.parse_args()
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


if __name__ == "__main__":
    sys.exit(main())
