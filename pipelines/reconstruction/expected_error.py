"""Verdict on a reconstruction without truth: the error that its covariances predict, and what limits it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import parquet

# Mean error over the root mean square that the covariances predict: quantiles 0.1, 0.5 and 0.9 over 156
# flights with truth (near, far, opposite, high, two and three cameras), by where the errors of poses are
# known from; the geometry is in the covariances. A mean of lengths is 0.92 of their root mean square. Errors
# of a log's own covariances may last or not; where nobody states errors, they may also be far from usual.
ERROR_OVER_PREDICTED = {
    "none": (0.40, 0.70, 2.4),
    "stated": (0.60, 0.85, 1.6),
    "logged": (0.50, 1.05, 2.1),
    "estimated": (0.50, 1.00, 3.3),
}
# Three cameras and more agree better than their covariances say: each errs by itself, by what it can err.
OF_MORE_THAN_TWO = 0.8
# Expected errors below are good: as of optical systems without markers that stand still.
GOOD_MM = 60.0
# Beyond, steps and joint angles are no longer usable.
USABLE_MM = 150.0
# Less of the joints measured makes a flight poor, whatever their error.
LEAST_SHARE = 0.5
# Less of the joints measured is said.
USUAL_SHARE = 0.9


def verdict(folder: Path, figures: Mapping[str, Any]) -> dict[str, Any]:
    """Judge a reconstruction without truth.

    Args:
        folder: of the stage, with skeleton.parquet.
        figures: those of metrics.json.

    Returns:
        `grade`: `good`, `usable`, `poor`, or `wrong` where the flight is doubted; `expected_error_mm`: the
        80 % interval of MPJPE with its median between, None where nothing was measured; `why`: what holds the
        result back, most important first; `next`: the next command.
    """
    table = parquet.read_table(folder / "skeleton.parquet", columns=["cxx", "cyy", "czz", "status"])
    variance = sum(table[name].to_numpy() for name in ("cxx", "cyy", "czz"))
    variance = variance[(table["status"].to_numpy() == "ok") & np.isfinite(variance)]
    predicted_mm = 1e3 * float(np.sqrt(variance.mean())) if variance.size else float("nan")
    used = figures.get("method_used") or {}
    kind = str(used.get("pose_noise") or "none")
    factors = ERROR_OVER_PREDICTED.get(kind, ERROR_OVER_PREDICTED["estimated"])
    cameras = len(figures["reprojection_px_per_camera"])
    predicted_mm *= OF_MORE_THAN_TWO if cameras > 2 else 1.0
    expected = [round(predicted_mm * factor, 1) for factor in factors] if np.isfinite(predicted_mm) else None
    doubts, share = figures.get("doubts") or [], figures["reconstructed_share"]
    why = [str(doubt["what"]) for doubt in doubts]
    if share < USUAL_SHARE:
        why.append(f"{share:.0%} of the joints were measured")
    if not (used.get("background") or {}).get("cameras"):
        why.append("no background was used: the videos of the cameras show how each of them moved")
    if cameras == 2:
        why.append("there are two cameras: nothing shows which of them is wrong where they disagree")
    if kind == "estimated":
        why.append("errors of the poses are not stated, and were estimated: set pose_noise if you know them")
    if doubts:
        grade = "wrong"
    elif expected is None or share < LEAST_SHARE or expected[1] > USABLE_MM:
        grade = "poor"
    else:
        grade = "good" if expected[1] <= GOOD_MM else "usable"
    mends = bool(doubts) and bool(doubts[0]["remedy"])
    return {
        "grade": grade,
        "expected_error_mm": expected,
        "why": why,
        "next": "mocap check flight.yaml --fix" if mends else "mocap report SESSION",
    }
