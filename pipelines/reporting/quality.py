"""Data quality of every camera: poses, clock, detections, and how much the map hid the actor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.poses import conjugate, interpolate_poses, multiply, rotation_vector_from_quaternion
from pipelines.reporting.content import SessionContent, number, section
from pipelines.reporting.summary import CameraRow, Summary
from pipelines.reporting.wording import ABSENT, THIN, fixed, quantity
from pipelines.session.camera_poses import logged_covariance
from pipelines.session.tables import trajectory_from

if TYPE_CHECKING:
    import pandas as pd

_CONFIDENT = 0.3  # default least confidence of keypoints in reconstruct
_UNITS = {
    "position_m": ("", "m"),
    "rotation_deg": ("", "deg"),
    "position_m_per_sqrt_s": ("", "m/√s"),
    "rotation_deg_per_sqrt_s": ("", "deg/√s"),
    "correlation_s": ("over", "s"),
    "offset_s": ("", "s"),
}


@dataclass(frozen=True)
class QualityRow:
    """Quality of one camera, in words and shares; None where nothing is known."""

    name: str
    stated: str  # of the poses' errors, per axis
    measured: str  # logged less true poses, root mean square per axis
    offset: str
    sigma: str
    detected: float | None  # share of the frames looked at that show a person
    confident: float | None  # share of the keypoints of those that are used
    hidden: float | None  # share of moments in which the map hides the actor


def quality(content: SessionContent, summary: Summary) -> tuple[QualityRow, ...]:
    """Return the rows of the table of data quality."""
    return tuple(_row(content, summary, camera) for camera in summary.cameras)


def _row(content: SessionContent, summary: Summary, camera: CameraRow) -> QualityRow:
    clock = camera.entry.clock
    found = number(section(summary.metrics, "clock_offsets_s"), camera.name)
    offset = quantity(clock.offset_s, "s", 3)
    if found is not None:
        sign = "+" if found >= 0 else ""
        offset += f" {sign}{quantity(found, 's', 3)}"
    detected, confident = _detection(content, camera)
    poses, truth = content.poses.get(camera.name), content.true_poses.get(camera.name)
    still = camera.entry.poses.static
    return QualityRow(
        name=camera.name,
        stated=_stated(camera, poses),
        measured=ABSENT if poses is None or truth is None or still else _measured(poses, truth, summary),
        offset=offset,
        sigma="known" if clock.sigma_s == 0 else f"±{THIN}{quantity(clock.sigma_s, 's', 3)}",
        detected=detected,
        confident=confident,
        hidden=content.hidden.get(camera.name),
    )


# --- poses ---------------------------------------------------------------------------------------------


def _stated(camera: CameraRow, poses: pd.DataFrame | None) -> str:
    """Describe the errors of the poses, by flight.yaml or by the log."""
    if camera.entry.pose_noise:
        return "; ".join(_model(name, told) for name, told in camera.entry.pose_noise.items())
    covariance = logged_covariance(trajectory_from(poses)) if poses is not None else None
    if covariance is not None:
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        position_m, rotation_rad = (
            float(np.sqrt(np.median(variances[:, k : k + 3].mean(axis=1)))) for k in (0, 3)
        )
        return f"by the log: {_pair(position_m, float(np.degrees(rotation_rad)))}"
    return "stands still" if camera.entry.poses.static else "nothing"


def _model(name: str, told: dict[str, float | str]) -> str:
    words = []
    for key, value in told.items():
        before, unit = _UNITS.get(key, (key.replace("_", " "), ""))
        said = f"{value:g}{THIN}{unit}".strip() if isinstance(value, float | int) else str(value)
        words.append(f"{before} {said}".strip())
    return f"{name.replace('_', ' ')} {', '.join(words)}"


def _measured(logged: pd.DataFrame, true: pd.DataFrame, summary: Summary) -> str:
    """Compute the root mean square per axis of the logged poses' errors at their own stamps."""
    log, truth = trajectory_from(logged), trajectory_from(true)
    between = summary.description.pose_interpolation
    position, quaternion = interpolate_poses(
        truth.t_ns,
        truth.position,
        truth.quaternion_xyzw,
        log.t_ns,
        max_gap_ns=between.max_gap_ns,
        max_extrapolation_ns=0,
    )
    there = np.isfinite(position).all(axis=1)
    if not there.any():
        return ABSENT
    off_m = log.position[there] - position[there]
    turn = multiply(conjugate(quaternion[there]), log.quaternion_xyzw[there])
    off_rad = rotation_vector_from_quaternion(turn)
    return _pair(*(float(np.sqrt((v**2).mean())) for v in (off_m, np.degrees(off_rad))))


def _pair(position_m: float, rotation_deg: float) -> str:
    return f"{fixed(position_m, 3)}{THIN}m, {fixed(rotation_deg, 2)}{THIN}deg"


# --- detections ----------------------------------------------------------------------------------------


def _detection(content: SessionContent, camera: CameraRow) -> tuple[float | None, float | None]:
    table = content.keypoints.get(camera.name)
    if table is None:
        return None, None
    least = number(section(content.stages.get("reconstruct", {}), "settings"), "min_confidence")
    used = table["confidence"].to_numpy() >= (_CONFIDENT if least is None else least)
    confident = float(used.mean()) if len(used) else None
    if camera.entry.keypoints is not None:
        count = camera.entry.frames.count
        return 1 - camera.entry.keypoints.frames_without_person / max(count, 1), confident
    counts = section(section(content.stages.get("detect", {}), "counts"), "cameras")
    looked = number(section(counts, camera.name), "frames") or camera.entry.frames.count
    return float(min(table["frame"].nunique() / max(looked, 1), 1.0)), confident
