"""How good a reconstruction is: against the truth where there is one, and in itself.

Everything here is JSON-able, with null for what could not be measured.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.metrics import JointErrors, measure, measure_shape
from pipelines.geometry.triangulation import STATUS, Triangulation, Views
from pipelines.reconstruction.observations import Observations
from pipelines.reconstruction.reweighting import reprojection_px
from pipelines.session.records import Float
from pipelines.session.skeletons import bones_of

_UNMEASURED = dict.fromkeys(
    [*(field.name for field in fields(JointErrors)), "root_frames_left_out", "pa_frames_left_out"]
)
"""What stands in the place of errors where there is no truth."""


def assess(
    observations: Observations,
    views: Views,
    result: Triangulation,
    *,
    cameras: Sequence[str],
    method: str,
    truth: Float | None,
    solve: Callable[[Views], Triangulation],
) -> dict[str, Any]:
    """Every figure of metrics.json.

    Args:
        observations: what was triangulated.
        views: the same, one row for each joint-frame.
        result: what came out.
        cameras: their names.
        method: how it was triangulated.
        truth: [T, P', J, 3] the true joints at the same times, in any order of people.
        solve: the same way again, for the triangulations that leave one camera out.
    """
    shape = observations.confidence.shape[:3]
    position = result.points.reshape(*shape, 3)
    status = result.status.reshape(shape)
    residual = result.residual_px.reshape(*shape, -1)
    per_joint = {
        name: _figures(status[:, :, j], residual[:, :, j]) for j, name in enumerate(observations.joints)
    }
    errors: dict[str, Any] = {**_UNMEASURED, "per_joint": {}}
    if truth is not None:
        errors |= measure(position, _own_truth(position, truth), observations.joints, observations.t_ns)
    for name, figures in errors.pop("per_joint").items():
        per_joint[name] |= _of_truth(figures)
    overall = _figures(status, residual)
    return {
        "method": method,
        **overall,
        **_of_truth(errors),
        "reprojection_px_per_camera": {name: _spread(residual[..., c]) for c, name in enumerate(cameras)},
        "leave_one_camera_out_px": _leave_one_out(views, cameras, solve),
        "shape": measure_shape(
            position, observations.joints, bones_of(observations.joints), observations.t_ns
        ),
        "clock_offsets_s": {},
        "intervals": {},
        "per_joint": per_joint,
    }


def _figures(status: NDArray[np.int8], residual: Float) -> dict[str, Any]:
    counts = Counter({STATUS[code]: int((status == code).sum()) for code in np.unique(status)})
    return {
        "reconstructed_share": counts["ok"] / max(status.size, 1),
        "status_counts": {"all": status.size, "ok": counts["ok"]}
        | {name: counts[name] for name in STATUS if name != "ok" and counts[name]},
        "reprojection_px": _spread(residual),
    }


def _of_truth(errors: dict[str, Any]) -> dict[str, Any]:
    """The errors, their share named as what it is: of the joint-frames that have truth."""
    share = {"reconstructed_share_of_truth": errors["reconstructed_share"]}
    return share | {name: value for name, value in errors.items() if name != "reconstructed_share"}


def _spread(residual: Float) -> dict[str, float | None]:
    """Median and mean over all views that saw a reconstructed joint, rejected views included."""
    distances = residual[np.isfinite(residual)]
    if not len(distances):
        return {"median": None, "mean": None}
    return {"median": float(np.median(distances)), "mean": float(distances.mean())}


def _own_truth(position: Float, truth: Float) -> Float:
    """For each reconstructed person [T, P, J, 3] the true person that is nearest, each taken once."""
    from scipy.optimize import linear_sum_assignment

    distance = np.linalg.norm(position[:, :, None] - truth[:, None, :], axis=-1)
    seen = np.isfinite(distance)
    cost = np.where(seen, np.minimum(distance, 1e3), 0).sum(axis=(0, 3)) / np.maximum(
        seen.sum(axis=(0, 3)), 1
    )
    cost[seen.sum(axis=(0, 3)) == 0] = 1e6
    person, match = linear_sum_assignment(cost)
    own = np.full_like(position, np.nan)
    own[:, person] = truth[:, match]
    return own


def _leave_one_out(
    views: Views, cameras: Sequence[str], solve: Callable[[Views], Triangulation]
) -> dict[str, dict[str, float | None]] | None:
    """How far each camera's keypoints lie from the skeleton of the others; needs three cameras."""
    if len(cameras) < 3:
        return None
    figures = {}
    for c, name in enumerate(cameras):
        weight = views.weight.copy()
        weight[:, c] = 0
        points = solve(replace(views, weight=weight)).points
        figures[name] = _spread(reprojection_px(views, points)[:, c])
    return figures
