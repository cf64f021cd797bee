"""Measures of an arm that was filmed: its pictures, the keypoints found, the errors of its joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import common, measure
from pipelines.geometry.triangulation import Views, reprojection_px
from pipelines.simulation.study.filming import Formation, Sightings, Walk, exact_keypoints

NEAR_SHARE = 0.1
"""Largest error of a right keypoint, as a share of the height in pixels of a person at that place."""

_NEAR_TILT_DEG = 5.0
_ERRORS = ("reconstructed_share", "mpjpe_mm", "root_mpjpe_mm", "pa_mpjpe_mm", "pck150")


def measure_arm(
    of: Walk,
    seen_by: Formation,
    sightings: Sightings,
    views: Views,
    points: Float,
    *,
    tilt_deg: Float,
    range_m: Float,
    desired_tilt_deg: float,
) -> dict[str, Any]:
    """Measure an arm: figures by their names in film/metrics.json.

    Shares are of pictures, of joints in them, or of moments.

    Args:
        of: the filmed person.
        seen_by: N cameras at T moments.
        sightings: the keypoints found in their pictures.
        views: the input of triangulation, one row for each joint-frame.
        points: [T, J, 3] m, the triangulated joints, NaN where there is none.
        tilt_deg: [N, T] of the cameras above the person.
        range_m: [N, T] distances of the cameras from the person.
        desired_tilt_deg: the planners' desired tilt.
    """
    exact = exact_keypoints(of, seen_by).xy
    inside = np.isfinite(exact[..., 0])
    off_px = np.linalg.norm(sightings.xy - exact, axis=-1)
    near = off_px <= NEAR_SHARE * (seen_by.lens.fx * of.height_m / range_m)[..., None]
    measured = off_px[np.isfinite(off_px)]
    errors = measure(points[:, None], of.joints[:, None], of.person.joints, of.t_ns)
    return {
        "pictures": int(np.prod(inside.shape[:2])),
        "in_view_share": float(inside.all(axis=-1).mean()),
        "tilt_deg": {
            "mean": float(tilt_deg.mean()),
            "max": float(tilt_deg.max()),
            "within_5_share": float((np.abs(tilt_deg - desired_tilt_deg) <= _NEAR_TILT_DEG).mean()),
        },
        "detected_share": float((sightings.confidence > 0).any(axis=-1).mean()),
        "keypoint_pck": float(near[inside].mean()) if inside.any() else None,
        "keypoint_median_px": float(np.median(measured)) if measured.size else None,
        "reprojection_px": _reprojection_px(views, points),
        **{name: errors[name] for name in _ERRORS},
    }


def errors_in_common(
    points: Mapping[str, Float], true_joints: Mapping[str, Float]
) -> dict[str, float | None]:
    """Compute each arm's MPJPE (mm) on the joint-frames that all arms reconstructed; None if there are none.

    Args:
        points: [T, J, 3] m of every arm, NaN for joints that were not reconstructed.
        true_joints: [T, J, 3] m of every arm.
    """
    shared = common(*(own[:, None] for own in points.values()))[:, 0]
    found: dict[str, float | None] = {}
    for name, own in points.items():
        error_m = np.linalg.norm(own - true_joints[name], axis=-1)[shared]
        found[name] = 1e3 * float(error_m.mean()) if error_m.size else None
    return found


def _reprojection_px(views: Views, points: Float) -> dict[str, float] | None:
    """Compute the error between used keypoints and the skeleton, by the poses that the log would have."""
    off_px = reprojection_px(views, points.reshape(-1, 3))
    used = off_px[np.isfinite(off_px)]
    return {"mean": float(used.mean()), "median": float(np.median(used))} if used.size else None
