"""Results of a study: means with their intervals, tables, and the figure.

Rows are plain: `tilt_deg`, `drones`, `noise`, `noise_model`, `method`, `trial`, and the measured figures.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reporting.ablation_figure import Curve, Panel, StudyDrawing, save_study
from pipelines.session.records import Int64

Row = dict[str, Any]

METRICS = {
    "mpjpe_mm": "MPJPE, mm",
    "root_mpjpe_mm": "Root-relative MPJPE, mm",
    "pa_mpjpe_mm": "PA-MPJPE, mm",
    "own_mpjpe_mm": "MPJPE of everything that the method itself reconstructed, mm",
    "pck150": "PCK@150 mm, missing joints counted as wrong, %",
    "reconstructed_share": "Reconstructed, %",
    "fell_back": "Trials in which refined fell back to robust, %",
}
"""Titles of the metrics in the tables; the first three are on the joint-frames that every method has."""

_SHARES = {"pck150", "reconstructed_share", "fell_back"}  # in percent there
_DRAWN = ("mpjpe_mm", "root_mpjpe_mm")
_CONDITION = ("tilt_deg", "drones", "noise", "noise_model", "method")
_VARIED = {"tilt": "tilt_deg", "robots": "drones"}
_RESAMPLES = 2000
_TAIL_PERCENT = 2.5
_NOTHING_MM = 1e-3  # errors below are none: no ratio is taken to them


def estimates(rows: Sequence[Row], study: str, *, seed: int) -> list[dict[str, Any]]:
    """Compute the means over trials of every condition and method.

    Intervals hold 95 % of the means of resampled trials (Efron & Tibshirani 1993, 13.3).

    Args:
        rows: of every trial.
        study: tilt, robots or noise: the condition that the ratio compares.
        seed: of the resampling.

    Returns:
        In the order of the rows, each with the condition and method, and with
        - `metrics`: by name `mean`, `interval` (None where all trials are alike) and the number of `trials`
          that had the figure; None where none had it;
        - `ratio`: of `mpjpe_mm` to the first tilt or number of drones, or for `noise` to the first method,
          trials paired; None where that mean is zero;
        - `per_joint`: means.
    """
    by_condition: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        by_condition.setdefault(tuple(row[name] for name in _CONDITION), []).append(row)
    varied = _CONDITION.index(_VARIED.get(study, "method"))
    first = next(iter(by_condition))[varied]
    told = []
    for condition, own in by_condition.items():
        others = by_condition[(*condition[:varied], first, *condition[varied + 1 :])]
        told.append(
            {
                **dict(zip(_CONDITION, condition, strict=True)),
                "metrics": {name: _mean(own, name, seed) for name in own[0] if _is_measured(name)},
                "ratio": _ratio(own, others, seed),
                "per_joint": _per_joint(own),
            }
        )
    return told


def _is_measured(name: str) -> bool:
    return name not in {*_CONDITION, "trial", "per_joint"}


def _resampled(trials: int, seed: int) -> Int64:
    """Draw rows of trials [B, K] with replacement."""
    return np.random.default_rng([seed, trials]).integers(trials, size=(_RESAMPLES, trials))


def _mean(rows: Sequence[Row], name: str, seed: int) -> dict[str, Any] | None:
    values = np.array([row[name] for row in rows if row[name] is not None], dtype=np.float64)
    if not values.size:
        return None
    return _estimate(float(values.mean()), values[_resampled(len(values), seed)].mean(axis=1), len(values))


def _ratio(rows: Sequence[Row], others: Sequence[Row], seed: int) -> dict[str, Any] | None:
    """Compute the mean error as a multiple of another condition's; trials share random numbers in both."""
    pairs = np.array(
        [
            (row["mpjpe_mm"], other["mpjpe_mm"])
            for row, other in zip(rows, others, strict=True)
            if None not in (row["mpjpe_mm"], other["mpjpe_mm"])
        ],
        dtype=np.float64,
    ).reshape(-1, 2)
    if not len(pairs) or pairs[:, 1].min() < _NOTHING_MM:
        return None
    own, other = pairs.mean(axis=0)
    drawn = pairs[_resampled(len(pairs), seed)].mean(axis=1)
    return _estimate(float(own / other), drawn[:, 0] / drawn[:, 1], len(pairs))


def _estimate(mean: float, drawn: Float, trials: int) -> dict[str, Any]:
    interval = None
    if drawn.min() < drawn.max():  # trials without chance (exact poses, pictures filmed once) have none
        low, high = np.percentile(drawn, [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
        interval = [float(low), float(high)]
    return {"mean": mean, "interval": interval, "trials": trials}


def _per_joint(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    told: dict[str, dict[str, float | None]] = {}
    for joint, errors in rows[0]["per_joint"].items():
        told[joint] = {}
        for name in errors:
            values = [row["per_joint"][joint][name] for row in rows]
            there = [value for value in values if value is not None]
            told[joint][name] = float(np.mean(there)) if there else None
    return told


def results_csv(rows: Sequence[Row]) -> str:
    """Write one line for every condition, trial and method; empty where nothing could be measured."""
    text = io.StringIO()
    columns = [name for name in rows[0] if name != "per_joint"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# --- tables --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """One figure of a study; the varied condition is in columns."""

    title: str
    header: list[str]
    rows: list[list[str]]


def tables(summary: Mapping[str, Any]) -> list[Table]:
    """Make the tables for readers, as text; `-` where nothing could be measured."""
    head, columns = _heads(summary)
    first = summary["settings"]["methods"][0] if summary["study"] == "noise" else columns[0]
    told = []
    for name, title in [*METRICS.items(), ("ratio", f"MPJPE relative to {first}, on common joint-frames")]:
        lines = _lines(summary)
        if name == "fell_back":  # only refined can fall back
            lines = [(label, cells) for label, cells in lines if label[-1] == "refined"]
            if not lines:
                continue
        rows = [[*label, *(_text(cell, name) for cell in cells)] for label, cells in lines]
        told.append(Table(title, [*head, *columns], rows))
    return told


def _heads(summary: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Return the headers of the line names, and of their figures."""
    settings = summary["settings"]
    match summary["study"]:
        case "tilt":
            return ["noise", "method"], [f"{tilt:g} deg" for tilt in settings["tilts_deg"]]
        case "robots":
            return ["noise", "method"], [f"{drones} drones" for drones in settings["drones"]]
    return ["method"], list(settings["noise"])


def _lines(summary: Mapping[str, Any]) -> list[tuple[tuple[str, ...], list[Mapping[str, Any]]]]:
    """Group the cells by line, in the order of the varied condition."""
    names = ("method",) if summary["study"] == "noise" else ("noise", "method")
    lines: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for cell in summary["cells"]:
        lines.setdefault(tuple(cell[name] for name in names), []).append(cell)
    return list(lines.items())


def _text(cell: Mapping[str, Any], name: str) -> str:
    estimate = cell["ratio"] if name == "ratio" else cell["metrics"][name]
    if estimate is None:
        return "-"
    if name in _SHARES:
        return f"{100 * estimate['mean']:.1f}"
    digits = 2 if name == "ratio" else 1
    text = f"{estimate['mean']:.{digits}f}"
    if estimate["interval"] is None:
        return text
    low, high = estimate["interval"]
    return f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


# --- the figure ----------------------------------------------------------------------------------------


def draw(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write the study's figure as SVG, PNG and PDF."""
    save_study(folder, drawing(summary), f"Simulated: {setting(summary)}")


def setting(summary: Mapping[str, Any]) -> str:
    """Describe the filmed scene and the number of trials."""
    settings = summary["settings"]
    drones, tilt = f"{settings['drones'][0]} drones", f"tilt {settings['tilts_deg'][0]:g} deg"
    fixed = {"tilt": drones, "robots": tilt}.get(summary["study"], f"{drones}, {tilt}")
    return (
        f"{fixed}, {settings['seconds']:g} s of walking, keypoints: {summary['keypoints']};"
        f" mean and 95 % interval, trials: {settings['trials']}"
    )


def drawing(summary: Mapping[str, Any]) -> StudyDrawing:
    """Make the study's figure: a row for each of the first two metrics."""
    study, settings = summary["study"], summary["settings"]
    lines = _lines(summary)
    rows = []
    for name in _DRAWN:
        if study == "noise":
            panels = [Panel("", [_curve(label[0], cells, name) for label, cells in lines])]
        else:
            panels = [
                Panel(method, [_curve(noise, cells, name) for (noise, of), cells in lines if of == method])
                for method in settings["methods"]
            ]
        rows.append((METRICS[name], panels))
    match study:
        case "tilt":
            return StudyDrawing(rows, settings["tilts_deg"], "tilt of the formation, deg", "pose noise", True)
        case "robots":
            return StudyDrawing(rows, settings["drones"], "drones", "pose noise", True)
    return StudyDrawing(rows, list(settings["noise"]), "pose noise", "method", False)


def _curve(label: str, cells: Sequence[Mapping[str, Any]], name: str) -> Curve:
    found = [cell["metrics"][name] for cell in cells]
    return Curve(
        label,
        [None if each is None else each["mean"] for each in found],
        [None if each is None or each["interval"] is None else tuple(each["interval"]) for each in found],
    )
