"""Everything that docs/results.md shows, from a clean clone: `python -m benchmarks.results`.

Runs the commands that the page names, one after the other, keeps their numbers in docs/results.json and their
figures in docs/figures/, and writes the page from them. Needs the detector (`mocap models fetch blazepose`).
`--resume` goes on with what an interrupted run left, `--page` writes the page alone.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.results_page import ARM_FIGURES, PLACE, POSES, SCENARIOS, STUDIES, Numbers, render
from pipelines.reporting.ablation import METRICS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
_CELL = ("tilt_deg", "drones", "noise", "noise_model", "method", "ratio")
_ARM = ("simulated", "tilt_deg", "occluded_share", "reconstruction_error")
_TIMES = f"{PLACE}/times.json"
_DIGITS = 6  # of a number that is kept


def main() -> None:
    """Run the commands and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", action="store_true", help="only write the page, from docs/results.json")
    parser.add_argument("--resume", action="store_true", help="go on where an interrupted run stopped")
    arguments = parser.parse_args()
    if not arguments.page:
        numbers = _rounded(measured(resume=arguments.resume))
        (DOCS / "results.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    numbers = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))
    (DOCS / "results.md").write_text(render(numbers), encoding="utf-8")
    print(f"written: {DOCS / 'results.md'}")


def measured(*, resume: bool = False) -> Numbers:
    """The numbers of all sections; their figures are copied beside the page."""
    if not resume:
        shutil.rmtree(ROOT / PLACE, ignore_errors=True)
    (ROOT / PLACE).mkdir(parents=True, exist_ok=True)
    shutil.rmtree(DOCS / "figures", ignore_errors=True)
    (DOCS / "figures").mkdir()
    numbers: Numbers = {
        "poses": {name: _poses(name, commands) for name, commands in POSES.commands.items()},
        "studies": {},
        "arms": {},
    }
    _run(POSES.compare)
    for key in POSES.figures:
        _keep(f"{PLACE}/compared/{key}.svg", f"poses-{key.removeprefix('compare-')}")
    for name, command in STUDIES.items():
        _run(command)
        numbers["studies"][name] = _study(_read(f"{PLACE}/{name}/summary.json"))
        _keep(f"{PLACE}/{name}/figure.svg", f"study-{name}")
    for name, commands in SCENARIOS.items():
        for command in commands:
            _run(command)
        numbers["arms"][name] = _arms(_read(f"{PLACE}/{name}.session/replan/metrics.json"))
    for name, (command, keys) in ARM_FIGURES.items():
        _run(command)
        for key in keys:
            _keep(f"{PLACE}/{name}-figures/{key}.svg", f"{name}-{key}")
    numbers["cpu_minutes"] = math.ceil(sum(_spent().values()) / 60)
    return numbers


def _run(command: str) -> None:
    """Run `mocap ...` of this environment from the top of the repository, and note its processor time."""
    print(command, flush=True)
    before = _children_s()
    words = shlex.split(command)
    program = Path(sys.executable).with_name(words[0])
    done = subprocess.run([program, *words[1:]], cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise SystemExit(f"{command}\n{done.stderr}")
    spent = _spent()
    # A stage that an interrupted run finished is skipped: what it took then counts.
    spent[command] = max(spent.get(command, 0.0), _children_s() - before)
    (ROOT / _TIMES).write_text(json.dumps(spent), encoding="utf-8")


def _children_s() -> float:
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def _spent() -> dict[str, float]:
    """Processor time of the commands so far, in s."""
    path = ROOT / _TIMES
    told: dict[str, float] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return told


def _read(path: str) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((ROOT / path).read_text(encoding="utf-8"))
    return told


def _keep(figure: str, name: str) -> None:
    shutil.copyfile(ROOT / figure, DOCS / "figures" / f"{name}.svg")


def _poses(name: str, commands: tuple[str, ...]) -> dict[str, Any]:
    for command in commands:
        _run(command)
    told = _read(f"{PLACE}/{name}.session/reconstruct/metrics.json")
    return {key: told[key] for key in POSES.measures}


def _study(summary: Mapping[str, Any]) -> dict[str, Any]:
    """What the study's tables are made of."""
    cells = [
        {**{key: cell[key] for key in _CELL}, "metrics": {key: cell["metrics"][key] for key in METRICS}}
        for cell in summary["cells"]
    ]
    return {"study": summary["study"], "settings": summary["settings"], "cells": cells}


def _arms(metrics: Mapping[str, Any]) -> dict[str, Any]:
    arms = {arm: {key: told[key] for key in _ARM} for arm, told in metrics["arms"].items()}
    return {"trials": metrics["trials"], "arms": arms, "verdict": metrics["verdict"]}


def _rounded(value: Any) -> Any:
    """The same with numbers to six digits: more is noise, and differs between machines."""
    match value:
        case float():
            return float(f"{value:.{_DIGITS}g}")
        case dict():
            return {key: _rounded(each) for key, each in value.items()}
        case list() | tuple():
            return [_rounded(each) for each in value]
    return value


def figures_of(page: str) -> Iterator[str]:
    """The files that a page shows."""
    for piece in page.split("](figures/")[1:]:
        yield piece.partition(")")[0]


if __name__ == "__main__":
    main()
