"""Results of docs/results.md, measured from a clean clone: `python -m benchmarks.results`.

Runs the commands that the page names, one after the other, keeps their numbers in docs/results.json and their
figures in docs/figures/, and writes the page from them. Needs the detector (`mocap models fetch blazepose`).
`--resume` continues an interrupted run, `--only SECTION` measures one section again and keeps the others,
`--page` writes the page alone.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.results_page import (
    ARM_FIGURES,
    FILMED,
    PLACE,
    POSES,
    SCENARIOS,
    STILL,
    STUDIES,
    Numbers,
    render,
)
from pipelines.reporting.studies import METRICS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
_CELL = ("tilt_deg", "drones", "noise", "noise_model", "method", "ratio")
_ARM = ("simulated", "tilt_deg", "occluded_share", "reconstruction_error")
_TIMES = f"{PLACE}/times.json"
_DIGITS = 6  # of a number that is kept
_STILL_PX = (640, 360)  # of each picture in the still


def main() -> None:
    """Run the commands and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", action="store_true", help="only write the page, from docs/results.json")
    parser.add_argument("--resume", action="store_true", help="go on where an interrupted run stopped")
    parser.add_argument("--only", choices=SECTIONS, help="measure one section again, keep the others")
    arguments = parser.parse_args()
    if not arguments.page:
        if not arguments.only and not arguments.resume:
            shutil.rmtree(ROOT / PLACE, ignore_errors=True)
        found = _rounded(measured([arguments.only] if arguments.only else list(SECTIONS)))
        if arguments.only:
            del found["cpu_minutes"]  # of this section alone
        _store(_stored() | found)
    page = render(_stored())
    (DOCS / "results.md").write_text(page, encoding="utf-8")
    for old in {path.name for path in (DOCS / "figures").iterdir()} - set(figures_of(page)):
        (DOCS / "figures" / old).unlink()
    print(f"written: {DOCS / 'results.md'}")


def keep_numbers(section: str, parts: Numbers) -> None:
    """Replace these parts of a section that a command of its own measures, and write the page."""
    numbers = _stored()
    numbers[section] = numbers.get(section, {}) | _rounded(parts)
    _store(numbers)
    (DOCS / "results.md").write_text(render(numbers), encoding="utf-8")


def _stored() -> Numbers:
    """Read the numbers; those of sections that other commands measure stay what they are."""
    numbers: Numbers = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))
    return numbers


def _store(numbers: Numbers) -> None:
    (DOCS / "results.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")


def measured(sections: Sequence[str]) -> Numbers:
    """Measure the numbers of these sections; copy their figures beside the page."""
    (ROOT / PLACE).mkdir(parents=True, exist_ok=True)
    (DOCS / "figures").mkdir(exist_ok=True)
    numbers: Numbers = {section: SECTIONS[section]() for section in sections}
    numbers["cpu_minutes"] = math.ceil(sum(_spent().values()) / 60)
    return numbers


def _poses() -> Numbers:
    numbers = {}
    for name, commands in POSES.commands.items():
        for command in commands:
            _run(command)
        metrics = _read(f"{PLACE}/{name}.session/reconstruct/metrics.json")
        numbers[name] = {key: metrics[key] for key in POSES.measures}
    _run(POSES.compare)
    for key in POSES.figures:
        _keep(f"{PLACE}/compared/{key}.svg", f"poses-{key.removeprefix('compare-')}")
    return numbers


def _studies() -> Numbers:
    numbers = {}
    for name, command in STUDIES.items():
        _run(command)
        numbers[name] = _study(_read(f"{PLACE}/{name}/summary.json"))
        _keep(f"{PLACE}/{name}/figure.svg", f"study-{name}")
    return numbers


def _planners() -> Numbers:
    numbers = {}
    for name, commands in SCENARIOS.items():
        for command in commands:
            _run(command)
        numbers[name] = _arms(_read(f"{PLACE}/{name}.session/replan/metrics.json"))
    for name, (command, keys) in ARM_FIGURES.items():
        _run(command)
        for key in keys:
            _keep(f"{PLACE}/{name}-figures/{key}.svg", f"{name}-{key}")
    return numbers


def _filmed() -> Numbers:
    numbers = {}
    for name, commands in FILMED.items():
        for command in commands:
            _run(command)
        numbers[name] = _read(f"{PLACE}/{name}.session/film/metrics.json")["arms"]
    _keep_still(ROOT / PLACE / "e2.session" / "film")
    return numbers


SECTIONS: dict[str, Callable[[], Numbers]] = {
    "poses": _poses,
    "studies": _studies,
    "arms": _planners,
    "filmed": _filmed,
}


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
    # A stage that an interrupted run finished is skipped: its time of that run counts.
    spent[command] = max(spent.get(command, 0.0), _children_s() - before)
    (ROOT / _TIMES).write_text(json.dumps(spent), encoding="utf-8")


def _children_s() -> float:
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def _spent() -> dict[str, float]:
    """Read the processor time (s) of the commands so far."""
    path = ROOT / _TIMES
    stored: dict[str, float] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return stored


def _read(path: str) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads((ROOT / path).read_text(encoding="utf-8"))
    return stored


def _keep(figure: str, name: str) -> None:
    shutil.copyfile(ROOT / figure, DOCS / "figures" / f"{name}.svg")


def _keep_still(film: Path) -> None:
    """Save pictures of both cameras of both arms when the fixed formation measured the fewest joints."""
    measured = {
        arm: pd.read_parquet(film / arm / "skeleton.parquet").groupby("t_ns")["x"].count()
        for arm in ("adaptive", "fixed")
    }
    pictures = measured["adaptive"].index.union(measured["fixed"].index)  # at least one arm has a joint
    picture = int(measured["fixed"].reindex(pictures, fill_value=0).to_numpy().argmin())
    rows = [np.hstack([_picture(film / arm / f"drone{k}.mp4", picture) for k in (1, 2)]) for arm in measured]
    cv2.imwrite(str(DOCS / "figures" / STILL), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


def _picture(video: Path, number: int) -> NDArray[np.uint8]:
    with av.open(str(video)) as opened:
        frame = next(islice(opened.decode(video=0), number, None))
    return np.asarray(cv2.resize(frame.to_ndarray(format="bgr24"), _STILL_PX, interpolation=cv2.INTER_AREA))


def _study(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Select the values for the study's tables."""
    cells = [
        {**{key: cell[key] for key in _CELL}, "metrics": {key: cell["metrics"][key] for key in METRICS}}
        for cell in summary["cells"]
    ]
    return {"study": summary["study"], "settings": summary["settings"], "cells": cells}


def _arms(metrics: Mapping[str, Any]) -> dict[str, Any]:
    arms = {arm: {key: scores[key] for key in _ARM} for arm, scores in metrics["arms"].items()}
    return {"trials": metrics["trials"], "arms": arms, "verdict": metrics["verdict"]}


def _rounded(value: Any) -> Any:
    """Round all numbers to six digits: further digits are noise, and differ between machines."""
    match value:
        case float():
            return float(f"{value:.{_DIGITS}g}")
        case dict():
            return {key: _rounded(each) for key, each in value.items()}
        case list() | tuple():
            return [_rounded(each) for each in value]
    return value


def figures_of(page: str) -> Iterator[str]:
    """Yield the names of the figures in a page."""
    for piece in page.split("](figures/")[1:]:
        yield piece.partition(")")[0]


if __name__ == "__main__":
    main()
