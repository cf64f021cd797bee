"""Summaries of trajectories, calibrations and joints for `mocap info`, in one wording for every format."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.records import CalibratedCamera, Int64, JointMotion, Trajectory

GAP_STEPS = 5
"""A gap is a step of more than this many median steps."""


def median_step_ns(t_ns: Int64) -> float | None:
    """Return the median time between rows; None for fewer than two rows."""
    return float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else None


def describe_times(t_ns: Int64) -> dict[str, object]:
    """Return first and last stamp, span, rate, and the number and the longest of the gaps.

    Args:
        t_ns: [N] strictly increasing.
    """
    if not len(t_ns):
        return {}
    step = median_step_ns(t_ns)
    summary: dict[str, object] = {
        "first_ns": int(t_ns[0]),
        "last_ns": int(t_ns[-1]),
        "span_s": round((int(t_ns[-1]) - int(t_ns[0])) / 1e9, 6),
    }
    if step is not None:
        steps = np.diff(t_ns)
        gaps = steps[steps > GAP_STEPS * step]
        summary["rate_hz"] = round(1e9 / step, 3)
        summary["gaps"] = len(gaps)
        if len(gaps):
            summary["longest_gap_s"] = round(float(gaps.max()) / 1e9, 3)
    return summary


def describe_trajectory(trajectory: Trajectory) -> dict[str, object]:
    """Return rows, times, bounding box of the positions, and the rows dropped, by cause."""
    return {
        "rows": len(trajectory.t_ns),
        **describe_times(trajectory.t_ns),
        **_box(trajectory.position),
        "covariance": "yes" if trajectory.covariance is not None else "no",
        **{f"dropped: {cause}": count for cause, count in trajectory.dropped.items()},
    }


def describe_cameras(cameras: dict[str, CalibratedCamera]) -> dict[str, object]:
    """Describe every camera by name, on one line each."""
    return {"cameras": len(cameras), **{name: _camera_line(camera) for name, camera in cameras.items()}}


def _camera_line(camera: CalibratedCamera) -> str:
    parts = []
    if (lens := camera.intrinsics) is not None:
        parts.append(f"{lens.width} x {lens.height} px, f {lens.fx:.1f} {lens.fy:.1f}, {lens.model}")
    if camera.position is not None:
        parts.append("at " + " ".join(f"{value:.3f}" for value in camera.position))
    return ", ".join(parts)


def describe_motion(motion: JointMotion) -> dict[str, object]:
    """Return joints, people, times, share of missing joints, bounding box of the positions."""
    return {
        "rows": len(motion.t_ns),
        "people": motion.position.shape[1],
        "joints": list(motion.joints),
        **describe_times(motion.t_ns),
        "missing_share": round(float(np.isnan(motion.position).any(axis=-1).mean()), 4),
        **_box(motion.position.reshape(-1, 3)),
    }


def _box(position: Float) -> dict[str, object]:
    """Return the smallest and largest coordinates of the finite points [N, 3]."""
    finite = position[np.isfinite(position).all(axis=1)]
    if not len(finite):
        return {}
    return {
        "box_min_m": [round(v, 4) for v in finite.min(axis=0).tolist()],
        "box_max_m": [round(v, 4) for v in finite.max(axis=0).tolist()],
    }
