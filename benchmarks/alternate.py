"""Speed of this checkout beside another one's: `python -m benchmarks.alternate FOLDER [--runs 15]`.

FOLDER is a checkout of an earlier commit (`git worktree add FOLDER COMMIT`). Both do the same work in turns.
Each run is a process of its own on one thread, after a smaller call that compiles. Processor seconds count,
and of these the fastest run: other work on the machine makes runs slower, but seldom the fastest of many.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parents[1]
MOST_SLOWER = 1.05
BEGIN = "import time; import numpy as np; from dataclasses import replace\n"
END = "\nwork(True); started = time.process_time(); work(False); print(time.process_time() - started)"
REFINED = """
import inspect
from benchmarks.refine import formation, refined_of
known = list(inspect.signature(refined_of).parameters)[2]  # its name changed
flights = {small: formation(60 if small else 2250, 5, (), 0) for small in (True, False)}
def work(small): refined_of(flights[small], (), **{known: True})
"""
TRIANGULATED = """
from pipelines.geometry.triangulation import estimate_noise, triangulate
from tests.geometry.rings import ring, with_pixel_noise
rng = np.random.default_rng(1)
flights = {small: with_pixel_noise(ring(100 if small else 22500, 5)[1], rng) for small in (True, False)}
def work(small):
    seen = replace(flights[small], pixel_sigma=estimate_noise(flights[small], threads=1))
    for _ in range(1 if small else 5): triangulate(seen, method="robust", threads=1)
"""
WORK = {
    "refined, 75 s x 5 cameras": REFINED,
    "noise, then five times robust, 22,500 frames x 5 cameras": TRIANGULATED,
}


def seconds(checkout: Path, work: str) -> float:
    """Run the work in a checkout; return its processor seconds."""
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", BEGIN + work + END],
        cwd=checkout,
        env=os.environ | threads | {"PYTHONPATH": str(checkout)},
        check=True,
        capture_output=True,
        text=True,
    )
    return float(done.stdout)


def main() -> None:
    """Print a row for each kind of work, and PASS if none is more than 5 % slower here."""
    parser = argparse.ArgumentParser(description="Compare the speed of two checkouts.")
    parser.add_argument("before", type=Path, help="checkout of an earlier commit")
    parser.add_argument("--runs", type=int, default=15)
    options = parser.parse_args()
    print("| work | before, CPU s | here, CPU s | ratio |\n| --- | --- | --- | --- |")
    ratios = []
    for name, work in WORK.items():
        before, here = [
            min(column)
            for column in zip(
                *(
                    (seconds(options.before.resolve(), work), seconds(HERE, work))
                    for _ in range(options.runs)
                ),
                strict=True,
            )
        ]
        ratios.append(here / before)
        print(f"| {name} | {before:.2f} | {here:.2f} | {ratios[-1]:.3f} |", flush=True)
    print("\nPASS" if max(ratios) <= MOST_SLOWER else "\nFAIL")


if __name__ == "__main__":
    main()
