"""Stored results of a reconstruction: rows of the session's tables, and the figures of metrics.json.

Figures are errors against the truth if known, and internal consistency. They are JSON-able, with null for
figures that could not be measured. The verdict needs no truth: the error that the covariances predict, and
what limits it.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pyarrow import parquet

from pipelines.geometry.arrays import Float, Int8, Int64
from pipelines.geometry.gait import HEEL_STRIKE, SIDES, TOE_OFF, GaitEvents, gait_events, summary
from pipelines.geometry.joint_angles import ANGLE_STATUS, ANGLES, joint_angles
from pipelines.geometry.metrics import (
    ERRORS,
    LEVEL,
    RESAMPLES,
    WORLD_ERRORS,
    Series,
    error_series,
    intervals,
    measure,
    measure_shape,
    own_truth,
    stretch_samples,
    tracking_errors,
    world_errors,
)
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.geometry.rig import CENTRES
from pipelines.geometry.triangulation import STATUS, Triangulation, Views, reprojection_px
from pipelines.reconstruction.body_fit import BodyFit
from pipelines.reconstruction.observations import Camera, Observations
from pipelines.session.description import Description, Interpolation
from pipelines.session.people import bones_of
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.storage import write_json
from pipelines.session.tables import BONES, JOINT_ERRORS, write_table

_OK, _FILLED = STATUS.index("ok"), STATUS.index("filled")
_PER_JOINT = (
    "mpjpe_mm",
    "root_mpjpe_mm",
    "pa_mpjpe_mm",
    "pck150",
    "reconstructed_share",
    "reprojection_px_mean",
)
_UNMEASURED = dict.fromkeys([*ERRORS, "root_frames_left_out", "pa_frames_left_out", *WORLD_ERRORS])
"""Placeholder for errors without truth."""


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
    """Compute every figure of metrics.json and of the tables of joints and bones.

    `truth` [T, P', J, 3] has people in any order; `solve` is the same triangulation, for the runs that leave
    one camera out. Figures are those of measured joints; filled joints have `filled_mpjpe_mm`.
    """
    shape = observations.confidence.shape[:3]
    status = result.status.reshape(shape)
    everything = result.points.reshape(*shape, 3)
    position = np.where((status == _OK)[..., None], everything, np.nan)
    residual = result.residual_px.reshape(*shape, -1)
    per_joint = {
        name: _figures(status[:, :, j], residual[:, :, j]) for j, name in enumerate(observations.joints)
    }
    errors: dict[str, Any] = {**_UNMEASURED, "per_joint": {}}
    own = None
    if truth is not None:
        own = own_truth(position, truth)
        errors |= measure(position, own, observations.joints, observations.t_ns)
        errors |= world_errors(position, own, observations.joints, observations.t_ns)
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
        "filled_mpjpe_mm": None
        if own is None
        else _mean_mm(everything[status == _FILLED] - own[status == _FILLED]),
        "clock_offsets_s": {},
        "intervals": _intervals(position, own, status, residual, observations.joints, observations.t_ns),
        "per_joint": per_joint,
    }


def of_people(
    names: Sequence[str], observations: Observations, result: Triangulation, truth: Float | None
) -> dict[str, Any]:
    """Compute the figures `by_person`, and with truth who was missed and confused; `tracking` else None."""
    shape = observations.confidence.shape[:3]
    ok = result.status.reshape(shape) == _OK
    position = np.where(ok[..., None], result.points.reshape(*shape, 3), np.nan)
    own = None if truth is None else own_truth(position, truth)
    tracking = None if truth is None else tracking_errors(position, truth)
    confused = [{}] * len(names) if tracking is None else tracking.pop("by_person")
    return {
        "by_person": {
            name: {
                "coverage": float(ok[:, k].any(axis=1).mean()),
                "reconstructed_share": float(ok[:, k].mean()),
                "mpjpe_mm": None if own is None else _mean_mm(position[:, k] - own[:, k]),
                **confused[k],
            }
            for k, name in enumerate(names)
        },
        "tracking": tracking,
    }


def _intervals(
    position: Float, own: Float | None, status: Int8, residual: Float, joints: tuple[str, ...], t_ns: Int64
) -> dict[str, Any]:
    """Compute confidence intervals of the means over the flight by block bootstrap (`geometry.metrics`)."""
    whole: dict[str, Series] = {}
    per_joint: Iterator[dict[str, Series]] = ({} for _ in joints)
    if own is not None:
        whole, per_joint = error_series(position, own, joints, t_ns)
        whole["reconstructed_share_of_truth"] = whole.pop("reconstructed_share")
    whole["reconstructed_share"] = _share(status)
    whole["reprojection_px_mean"] = _summed(residual)
    of_joints = {}
    for j, (name, series) in enumerate(zip(joints, per_joint, strict=True)):
        series["reconstructed_share"] = _share(status[:, :, [j]])
        series["reprojection_px_mean"] = _summed(residual[:, :, [j]])
        of_joints[name] = intervals({key: series[key] for key in _PER_JOINT if key in series}, t_ns)
    step_s = float(np.median(np.diff(t_ns))) / 1e9 if len(t_ns) > 1 else 0.0
    return {
        "level": LEVEL,
        "method": "circular block bootstrap over time",
        "stretch_s": stretch_samples(t_ns) * step_s if len(t_ns) > 1 else None,
        "resamples": RESAMPLES,
        "seed": 0,
        **intervals(whole, t_ns),
        "per_joint": of_joints,
    }


def _share(status: Int8) -> Series:
    """Count measured joint-frames and all joint-frames at each time."""
    measured = (status == _OK).sum(axis=(1, 2), dtype=np.float64)
    return measured, np.full(len(status), float(status[0].size))


def _summed(residual: Float) -> Series:
    there = np.isfinite(residual)
    axes = tuple(range(1, residual.ndim))
    return np.where(there, residual, 0.0).sum(axis=axes), there.sum(axis=axes, dtype=np.float64)


# Other places and axes of a truth are named above this error, where they make it smaller than this share.
_LEAST_OF_AXES_MM, _SHARE_OF_AXES = 300.0, 0.2
# So many moments of a flight tell the axes of its truth.
_MOMENTS_OF_AXES = 100
# What names the axes of a file of joints that are the world's x, y and z.
_KEYS_OF_AXES = {
    "z, x, y": "up: y",
    "y, z, x": "up: z",  # of a file that is read as if y pointed up
    "x, -y, -z": "up: -z",
    "y, x, -z": "axes: ned",
}


def other_place_of_truth(
    observations: Observations, result: Triangulation, truth: Float | None
) -> str | None:
    """Return a warning if a shift or right-angled turn of the truth [T, P', J, 3] takes its error away."""
    if truth is None:
        return None
    shape = observations.confidence.shape[:3]
    ok = result.status.reshape(shape) == _OK
    some = slice(None, None, len(ok) // _MOMENTS_OF_AXES + 1)
    position = np.where(ok[..., None], result.points.reshape(*shape, 3), np.nan)[some]

    def apart_m(turn: Float) -> Float:
        return position - own_truth(position, truth[some] @ turn.T)

    def error_mm(turn: Float) -> float:
        return _mean_mm(apart_m(turn)) or 0.0

    stated_mm = error_mm(np.eye(3))
    if stated_mm < _LEAST_OF_AXES_MM:
        return None
    shift = np.nanmean(apart_m(np.eye(3)), axis=(0, 1, 2))
    placed_mm = _mean_mm(apart_m(np.eye(3)) - shift) or 0.0
    signed = (
        np.diag(signs)[list(order)].astype(float)
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    )
    turn = min((each for each in signed if np.linalg.det(each) > 0), key=error_mm)
    least_mm = error_mm(turn)
    if placed_mm < least_mm and placed_mm < _SHARE_OF_AXES * stated_mm:
        far = ", ".join(f"{metres:+.2f}" for metres in shift)
        return (
            f"only the place is not the truth's: the error is {stated_mm:.0f} mm, and {placed_mm:.0f} mm"
            f" after one shift of the whole flight by {far} m"
        )
    if least_mm > _SHARE_OF_AXES * stated_mm:
        return None
    axes = ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in turn)
    remedy = f"state `truth: {{{_KEYS_OF_AXES[axes]}}}`" if axes in _KEYS_OF_AXES else "turn its file"
    return (
        f"the truth has other axes: its error is {stated_mm:.0f} mm, and {least_mm:.0f} mm if its {axes} are"
        f" the world's x, y, z; {remedy}"
    )


def _mean_mm(error_m: Float) -> float | None:
    distance = np.linalg.norm(error_m, axis=-1)
    there = distance[np.isfinite(distance)]
    return 1e3 * float(there.mean()) if there.size else None


def _figures(status: Int8, residual: Float) -> dict[str, Any]:
    counts = Counter({STATUS[code]: int((status == code).sum()) for code in np.unique(status)})
    return {
        "reconstructed_share": counts["ok"] / max(status.size, 1),
        "status_counts": {"all": status.size, "ok": counts["ok"]}
        | {name: counts[name] for name in STATUS if name != "ok" and counts[name]},
        "reprojection_px": _spread(residual),
    }


def _of_truth(errors: dict[str, Any]) -> dict[str, Any]:
    """Rename the reconstructed share among errors: it counts joint-frames with truth only."""
    share = {"reconstructed_share_of_truth": errors["reconstructed_share"]}
    return share | {name: value for name, value in errors.items() if name != "reconstructed_share"}


def _spread(residual: Float) -> dict[str, float | None]:
    """Compute median and mean over all views that saw a reconstructed joint, rejected views included."""
    distances = residual[np.isfinite(residual)]
    if not len(distances):
        return {"median": None, "mean": None}
    return {"median": float(np.median(distances)), "mean": float(distances.mean())}


def _leave_one_out(
    views: Views, cameras: Sequence[str], solve: Callable[[Views], Triangulation]
) -> dict[str, dict[str, float | None]] | None:
    """Measure each camera's keypoints against the skeleton of the others (px); None below three cameras."""
    if len(cameras) < 3:
        return None
    figures = {}
    for c, name in enumerate(cameras):
        weight = views.weight.copy()
        weight[:, c] = 0
        points = solve(replace(views, weight=weight)).points
        figures[name] = _spread(reprojection_px(views, points)[:, c])
    return figures


# --- people --------------------------------------------------------------------------------------------

_NO_BODY = {
    "ground": "not on the ground",
    "size": "not of a person's size",
    "misfit": "seen at different places by different cameras",
    "residual": "its views disagree more than those of the first person",
    "same": "a second image of a person",
    "bystander": "beyond the cameras and never in all of their pictures, a bystander",
}


def people_warnings(people: Mapping[str, Any]) -> list[str]:
    """Warn of bodies that are nobody, unused detections, and more people than requested, by the counts."""
    warnings = []
    causes = ", ".join(f"{count} {_NO_BODY[cause]}" for cause, count in people["phantoms"].items())
    if causes:
        warnings.append(f"bodies that --persons auto left out: {causes}")
    warnings += [
        f"{name} may be nobody, or mixed up with others ({_NO_BODY[cause]}): cameras and clocks are corrected"
        f" without {name}"
        for name, cause in people["doubted"].items()
    ]
    unused = [f"{name} {count}" for name, count in people["detections_not_used"].items() if count]
    if unused:
        line = f"detections that belong to nobody reconstructed: {', '.join(unused)}"
        if people["times_with_more"]:
            line += (
                f"; two cameras or more detect up to {people['seen_at_once']} at once, and more than"
                f" {people['asked']} at {people['times_with_more']} of {people['times']} times: if these are"
                f" people (detectors also take trees for them), --persons {people['seen_at_once']}"
                " reconstructs them"
            )
        warnings.append(line)
    return warnings


# --- parts of the method -------------------------------------------------------------------------------


def method_used(
    metrics: Mapping[str, Any], cameras: Sequence[Camera], known: str | None, method: str
) -> dict[str, Any]:
    """Say which parts of a method took part in a reconstruction, which not, and why.

    `background` and `ground`: the cameras whose poses they corrected, and the `reason` of each other;
    `clocks`: cameras whose clocks were estimated; `body`: motion and bones; `pose_noise`: stated, logged
    (`known`), estimated, assumed (of a single camera), or none; `summary`: all that in a line.
    """
    used: dict[str, Any] = {}
    entries = metrics.get("background") or {}
    used["background"] = {
        "cameras": [name for name, entry in entries.items() if entry["used"]],
        "reasons": {name: entry["reason"] for name, entry in entries.items() if not entry["used"]},
    }
    ground = metrics.get("ground") or {"moved_m": {}, "reasons": {}}
    used["ground"] = {"cameras": list(ground["moved_m"]), "reasons": ground["reasons"]}
    offsets_s = metrics.get("clock_offsets_s") or {}
    sigmas_s = metrics.get("clock_offset_sigmas_s") or {}
    # What nothing shows stays at exactly 0.
    clocks_s = {name: (offset_s, sigmas_s[name]) for name, offset_s in offsets_s.items() if offset_s != 0}
    refinement = metrics.get("refinement")
    absent = "robust fits calibrated still cameras better" if method == "auto" else "the method has none"
    reason = absent if refinement is None else refinement["fallback"]
    reason = None if len(cameras) == 1 else reason
    learned = refinement is not None and reason is None and refinement["pose_noise"] == "estimated"
    guessed = learned or bool(used["background"]["cameras"])
    exact = all(camera.static for camera in cameras)
    noise = "none" if exact else "estimated" if guessed else "assumed" if len(cameras) == 1 else "none"
    used |= {
        "clocks": list(clocks_s),
        "body": {"used": reason is None, "reason": reason},
        "pose_noise": known or noise,
    }
    people = "the size of people, their feet on the ground, and motion" if len(cameras) == 1 else None
    return used | {"summary": _summary(used, clocks_s, people or "motion and bones")}


def _summary(used: Mapping[str, Any], clocks_s: Mapping[str, tuple[float, float]], people: str) -> str:
    """Write the parts in one line, with estimated clock offsets and their standard deviations."""
    parts = ["keypoints"]
    if used["body"]["used"]:
        parts.append(people)
    for name, text in (("background", "backgrounds of"), ("ground", "ground seen by")):
        if used[name]["cameras"]:
            parts.append(f"{text} {', '.join(used[name]['cameras'])}")
    if clocks_s:
        clocks = [f"{name} ({at:+.3f} s, sigma {sigma_s:.3f} s)" for name, (at, sigma_s) in clocks_s.items()]
        parts.append(f"estimated clocks of {', '.join(clocks)}")
    noise = {"none": "the poses as exact", "estimated": "pose noise estimated from the pictures"}
    noise["assumed"] = "usual pose noise, which nobody stated"
    parts.append(noise.get(used["pose_noise"], f"{used['pose_noise']} pose noise"))
    left_out = [] if used["body"]["used"] else [f"motion and bones ({used['body']['reason']})"]
    for name in ("background", "ground"):
        for reason in dict.fromkeys(used[name]["reasons"].values()):
            cameras = [camera for camera, own in used[name]["reasons"].items() if own == reason]
            left_out.append(f"{name} of {', '.join(cameras)} ({reason})")
    return "used " + "; ".join(parts) + (f". Not used: {'; '.join(left_out)}" if left_out else "")


# --- trials ---------------------------------------------------------------------------------------------

_OF_TRIALS = (
    "mpjpe_mm",
    "root_mpjpe_mm",
    "pa_mpjpe_mm",
    "e_recon_m2",
    "e_recon_terms",
    "e_recon_per_joint_frame_m2",
    "pck150",
    "pck150_auc",
    "acceleration_error_mm_s2",
    "reconstructed_share",
)


def summary_of_trials(metrics: Sequence[Mapping[str, Any]], text: str, seed: int) -> dict[str, Any]:
    """Summarise all trials for metrics.json: `each`, `mean`, `std` (n - 1), `intervals`; null for none."""
    each = [_figures_of_trial(trial) for trial in metrics]
    mean: dict[str, float | None] = {}
    std: dict[str, float | None] = {}
    ends: dict[str, list[float] | None] = {}
    for name in each[0]:
        values = np.array([trial[name] for trial in each if trial[name] is not None], dtype=np.float64)
        mean[name] = float(values.mean()) if values.size else None
        std[name] = ends[name] = None
        if values.size > 1:
            std[name] = float(values.std(ddof=1))
            found = intervals({name: (values, np.ones(values.size))}, None, seed=seed)[name]
            ends[name] = None if found is None else list(found)
    return {
        "disturb_poses": text,
        "seed": seed,
        "count": len(each),
        "stored": 0,
        "mean": mean,
        "std": std,
        "intervals": ends,
        "each": each,
    }


def _figures_of_trial(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    figures: dict[str, float | None] = {name: metrics[name] for name in _OF_TRIALS}
    figures["reprojection_px_median"] = metrics["reprojection_px"]["median"]
    if "refinement" in metrics:
        figures["fell_back"] = float(metrics["refinement"]["fallback"] is not None)
    return figures


# --- tables --------------------------------------------------------------------------------------------


def write_figures(folder: Path, figures: Mapping[str, Any], description: Description) -> dict[str, Any]:
    """Write metrics.json, which is returned, and what it says of each joint and bone as tables beside it."""
    shape, intervals_of = figures["shape"], figures["intervals"]
    write_table(
        folder / "joint_errors.parquet",
        joint_errors_table(figures["per_joint"], intervals_of["per_joint"]),
        JOINT_ERRORS,
    )
    bones = [{"bone": name, **of} for name, of in shape["bones"].items()]
    write_table(folder / "bones.parquet", pd.DataFrame(bones, columns=BONES.names), BONES)
    stored = {name: value for name, value in figures.items() if name != "per_joint"}
    stored["intervals"] = {name: value for name, value in intervals_of.items() if name != "per_joint"}
    stored["shape"] = {name: value for name, value in shape.items() if name != "bones"}
    stored["verdict"] = verdict(folder, stored, description.guessed_lenses, description.guessed_rates)
    write_json(folder / "metrics.json", stored)
    return stored


def joint_errors_table(
    per_joint: Mapping[str, Mapping[str, Any]], intervals_of: Mapping[str, Mapping[str, Any]]
) -> pd.DataFrame:
    """Build the rows of `tables.JOINT_ERRORS`: one for each joint and figure."""
    rows = []
    for joint, figures in per_joint.items():
        plain = {name: value for name, value in figures.items() if not isinstance(value, Mapping)}
        plain |= {f"reprojection_px_{kind}": value for kind, value in figures["reprojection_px"].items()}
        plain |= {f"status_{status}": count for status, count in figures["status_counts"].items()}
        for name, value in plain.items():
            low, high = intervals_of.get(joint, {}).get(name) or (None, None)
            rows.append((joint, name, value, low, high))
    return pd.DataFrame(rows, columns=JOINT_ERRORS.names)


# Tables are larger than their arrays, and are made of so many times at once.
_TIMES_AT_ONCE = 8192


def skeleton_parts(observations: Observations, result: Triangulation) -> Iterator[pd.DataFrame]:
    """Yield the rows of `tables.SKELETON` in parts: every joint of every person at every time."""
    times, people, joints, _ = observations.confidence.shape
    names = np.array(observations.joints, dtype=object)
    for start in range(0, times, _TIMES_AT_ONCE):
        t_ns = observations.t_ns[start : start + _TIMES_AT_ONCE]
        rows = slice(start * people * joints, (start + len(t_ns)) * people * joints)
        table = pd.DataFrame(
            {
                "t_ns": np.repeat(t_ns, people * joints),
                "person": np.tile(np.repeat(np.arange(people), joints), len(t_ns)),
                "joint": np.tile(names, len(t_ns) * people),
            }
        )
        table[["x", "y", "z"]] = result.points[rows]
        table[list(POINT_COVARIANCE_COLUMNS)] = result.covariance[rows][:, *np.triu_indices(3)]
        table["views"] = result.views[rows]
        used = np.where(result.inlier[rows], result.residual_px[rows], np.nan)
        seen = np.sum(~np.isnan(used), axis=1)
        mean = np.nansum(used, axis=1) / np.maximum(seen, 1)
        table["reprojection_px"] = np.where(seen > 0, mean, np.nan)
        table["status"] = np.array(STATUS, dtype=object)[result.status[rows]]
        yield table


_CORRELATED = {
    "trunk_flexion": 0.6,
    "trunk_bending": 0.5,
    "trunk_rotation": 0.45,
    "elbow_flexion": 0.6,
    "ankle_dorsiflexion": 0.85,
}
_CORRELATED_ELSE = 0.65
"""Ratio of the standard deviation of an angle to that of joints whose errors are independent.

It is below 1 because a detector misplaces a limb or the trunk as a whole, and least where four joints of the
trunk take part. For the ankle it contains the offset of heel and toe from the sole. Chosen on the flights for
tuning: about 97 % of the errors are inside two standard deviations (`python -m benchmarks.accuracy corpus`).
"""


_BY_CENTRES = ("trunk_rotation", "hip_adduction", "hip_rotation")
"""Angles that the body's centres of joints showed 10 to 45 % better than landmarks did on the tuning flights.
The others were equal or worse. Landmarks show them where the centres do not determine them."""


def angles_parts(
    observations: Observations, views: Views, result: Triangulation, bodies: Sequence[BodyFit | None]
) -> Iterator[pd.DataFrame]:
    """Yield the rows of `tables.ANGLES` in parts, sorted by time.

    `_BY_CENTRES` rest on the centres of joints of `bodies`, the others on landmarks. Standard deviations rest
    on `own_covariance`, without the errors of camera poses, which move and turn the person as a whole and
    hardly change an angle. `_CORRELATED` accounts for the correlation of the rest.
    """
    times, people, joints, _ = observations.confidence.shape
    # Root of the variance of unit weight: two residuals for each view, three unknowns for each joint-frame.
    (ok,) = np.nonzero(result.status == _OK)
    used = result.inlier[ok]
    whitened = np.where(used, views.weight[ok] * result.residual_px[ok] / views.pixel_sigma, 0.0)
    freedom = np.maximum(2 * used.sum(axis=1) - 3, 0)
    total = int(freedom.sum())
    scale = float(np.sqrt((whitened[freedom > 0] ** 2).sum() / total)) if total else 1.0
    names = np.array(list(ANGLES), dtype=object)
    kinds = [name.removeprefix("left_").removeprefix("right_") for name in ANGLES]
    correlated = np.array([_CORRELATED.get(kind, _CORRELATED_ELSE) for kind in kinds])
    words = np.array(ANGLE_STATUS, dtype=object)
    points = result.points.reshape(times, people, joints, 3)
    centred, by_centres = points.copy(), np.isin(kinds, _BY_CENTRES)
    for person, body in enumerate(bodies):
        if body is not None:
            for joint in set(observations.joints).intersection(CENTRES):
                own = centred[:, person, observations.joints.index(joint)]
                own[body.row] = np.where(np.isnan(own[body.row]), np.nan, body.centre[:, CENTRES[joint]])
    for start in range(0, times, _TIMES_AT_ONCE):
        t_ns = observations.t_ns[start : start + _TIMES_AT_ONCE]
        rows = slice(start * people * joints, (start + len(t_ns)) * people * joints)
        shape = (len(t_ns), people, joints)
        covariance = own_covariance(views, result, rows, scale)[:, *np.triu_indices(3)].reshape(*shape, 6)
        status = result.status[rows].reshape(shape)
        by_landmarks, by_body = (
            joint_angles(observations.joints, each[start : start + len(t_ns)], covariance, status)
            for each in (points, centred)
        )
        chosen = by_centres & np.isfinite(by_body.value_deg)
        value, sigma, word = (
            np.where(chosen, getattr(by_body, each), getattr(by_landmarks, each))
            for each in ("value_deg", "sigma_deg", "status")
        )
        yield pd.DataFrame(
            {
                "t_ns": np.repeat(t_ns, people * len(names)),
                "person": np.tile(np.repeat(np.arange(people), len(names)), len(t_ns)),
                "angle": np.tile(names, len(t_ns) * people),
                "value_deg": value.ravel(),
                "sigma_deg": (correlated * sigma).ravel(),
                "status": words[word.ravel()],
            }
        )


def own_covariance(views: Views, result: Triangulation, rows: slice, scale: float) -> Float:
    """Compute the covariance [N, 3, 3] m^2 of joints relative to the other joints of the person.

    It is that of the pixels of their inlier views, scaled by the residuals. The stored covariance counts
    errors of camera poses, too, which move all joints of a picture together. It is returned where it is
    smaller, or fewer than two views are inliers (filled).
    """
    whole = result.covariance[rows]
    index, points = views.pose_index[rows], result.points[rows]
    normal = np.zeros((len(points), 3, 3))
    for c in range(views.weight.shape[1]):
        rotation = views.rotation[index, c]
        away = np.einsum("nji,nj->ni", rotation, points - views.position[index, c])
        with np.errstate(invalid="ignore", divide="ignore"):
            by_point = rotation[..., :2] - rotation[..., 2:] * (away[:, None, :2] / away[:, None, 2:])
            whitening = views.weight[rows, c] * views.focal[c] / (views.pixel_sigma[c] * away[:, 2])
        by_point *= whitening[:, None, None]
        by_point[~(result.inlier[rows, c] & np.isfinite(by_point).all(axis=(1, 2)))] = 0.0
        normal += by_point @ np.swapaxes(by_point, -1, -2)
    sure = np.linalg.det(normal) > 0
    own = np.full_like(normal, np.inf)
    own[sure] = scale**2 * np.linalg.inv(normal[sure])
    smaller = np.trace(own, axis1=-2, axis2=-1) < np.trace(whole, axis1=-2, axis2=-1)
    return np.where(smaller[:, None, None], own, whole)


def gait_of(observations: Observations, result: Triangulation) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Find the gait of every person: the rows of `tables.GAIT`, and by person a summary or None."""
    times, people, joints, _ = observations.confidence.shape
    position = result.points.reshape(times, people, joints, 3)
    parts: list[pd.DataFrame] = [_gait_rows(observations.t_ns[:0], 0, None)]
    figures: dict[str, Any] = {}
    for person in range(people):
        events = gait_events(observations.joints, observations.t_ns, position[:, person])
        parts.append(_gait_rows(observations.t_ns, person, events))
        figures[str(person)] = events and summary(events, observations.t_ns, observations.joints)
    return pd.concat(parts, ignore_index=True).sort_values(["t_ns", "person"], kind="stable"), figures


def _gait_rows(t_ns: Int64, person: int, events: GaitEvents | None) -> pd.DataFrame:
    row = np.zeros(0, np.int64) if events is None else events.row
    table = pd.DataFrame({"t_ns": t_ns[row], "person": np.full(len(row), person)})
    kept = events or GaitEvents(row, row, row > 0, np.zeros((0, 3)), *np.zeros((3, 0)))
    table["side"] = np.array(SIDES, dtype=object)[kept.side]
    table["event"] = np.where(kept.is_strike, HEEL_STRIKE, TOE_OFF).astype(object)
    table[["x", "y", "z"]] = kept.foot
    table["step_s"], table["step_m"], table["speed_mps"] = kept.step_s, kept.step_m, kept.speed_mps
    return table


def camera_poses_table(cameras: Sequence[Camera], between: Interpolation) -> pd.DataFrame:
    """Build the rows of `tables.CAMERA_POSES`: known poses of cameras at their pictures."""
    return poses_table(cameras, [camera.poses_at(camera.frame_t_ns, between) for camera in cameras])


def poses_table(cameras: Sequence[Camera], poses: Sequence[tuple[Float, Float]]) -> pd.DataFrame:
    """Build the same rows from each camera's poses at its pictures: position [F, 3], rotation [F, 3, 3]."""
    parts = []
    for camera, (position, rotation) in zip(cameras, poses, strict=True):
        (posed,) = np.nonzero(np.isfinite(position[:, 0]))
        table = pd.DataFrame({"t_ns": camera.frame_t_ns[posed], "camera": camera.name})
        table[["x", "y", "z"]] = position[posed]
        table[["qx", "qy", "qz", "qw"]] = quaternion_from_matrix(rotation[posed])
        parts.append(table)
    return pd.concat(parts, ignore_index=True)


# Mean error over the root mean square that the covariances predict: quantiles 0.07, 0.5 and 0.93 of 179
# flights with truth (near, far, opposite, high, two and three cameras), by where the errors of poses are
# known from; those of 19 to 60 flights hold 80 % of others. The geometry is in the covariances. A mean of
# lengths is 0.92 of their root mean square. Errors of a log's own covariances may last or not; where nobody
# states errors, they may also be far from usual. One camera sees no depth: its interval is wider, and was
# not calibrated. Errors and intervals: `python -m benchmarks.mistakes --expected 180 --seed 1002`.
ERROR_OVER_PREDICTED = {
    "none": (0.24, 0.55, 0.95),
    "stated": (0.45, 0.66, 1.36),
    "logged": (0.34, 0.87, 1.53),
    "estimated": (0.28, 0.55, 3.9),
    "one camera": (0.50, 0.85, 2.2),
}
# Three cameras and more agree better than their covariances say: each errs by itself, by what it can err.
OF_MORE_THAN_TWO = 0.8
# A guessed focal length is off by 15 %, and joints are 0.45 m from the middle of a body.
GUESSED_LENS_MM = 0.15 * 450.0
# Expected errors below are good: as of optical systems without markers that stand still.
GOOD_MM = 60.0
# Beyond, steps and joint angles are no longer usable.
USABLE_MM = 150.0
# Less of the joints measured makes a flight poor, whatever their error.
LEAST_SHARE = 0.5
# Less of the joints measured is said.
USUAL_SHARE = 0.9


def verdict(
    folder: Path,
    figures: Mapping[str, Any],
    guessed_lenses: Sequence[str] = (),
    guessed_rates: Sequence[str] = (),
) -> dict[str, Any]:
    """Judge a reconstruction without truth.

    `grade`: `good`, `usable`, `poor`, or `wrong` where the flight is doubted; `expected_error_mm`: the 80 %
    interval of MPJPE with its median between, None where nothing was measured; `why`: what holds the result
    back, most important first; `next`: the next command.
    """
    table = parquet.read_table(folder / "skeleton.parquet", columns=["cxx", "cyy", "czz", "status"])
    variance = sum(table[name].to_numpy() for name in ("cxx", "cyy", "czz"))
    variance = variance[(table["status"].to_numpy() == "ok") & np.isfinite(variance)]
    predicted_mm = 1e3 * float(np.sqrt(variance.mean())) if variance.size else float("nan")
    used = figures.get("method_used") or {}
    kind, cameras = str(used.get("pose_noise") or "none"), len(figures["reprojection_px_per_camera"])
    factors = ERROR_OVER_PREDICTED.get(kind, ERROR_OVER_PREDICTED["estimated"])
    factors = ERROR_OVER_PREDICTED["one camera"] if cameras == 1 else factors
    predicted_mm *= OF_MORE_THAN_TWO if cameras > 2 else 1.0
    predicted_mm = float(np.hypot(predicted_mm, GUESSED_LENS_MM if guessed_lenses else 0.0))
    expected = [round(predicted_mm * factor, 1) for factor in factors] if np.isfinite(predicted_mm) else None
    doubts, share = figures.get("doubts") or [], figures["reconstructed_share"]
    why = [str(doubt["what"]) for doubt in doubts]
    if named := ", ".join(guessed_rates):
        why.append(
            f"the frame rate of {named} is a guess, and times are as wrong as it: write frame_times.fps"
        )
    if named := ", ".join(guessed_lenses):
        why.append(
            f"the focal length of {named} is a guess, and sizes are as wrong as it is: add a calibration"
        )
    if share < USUAL_SHARE:
        why.append(f"{share:.0%} of the joints were measured")
    if not (used.get("background") or {}).get("cameras"):
        why.append("no background was used: the videos of the cameras show how each of them moved")
    if cameras == 1:
        gain = figures.get("with_second_drone_mm")
        less = "" if gain is None else f": a second drone across would leave about {gain:.0f} mm"
        why.insert(len(doubts), f"one camera does not measure how far away a person is{less}")
    if cameras > 1 and kind in ("stated", "logged") and expected is not None and expected[1] > USABLE_MM:
        why.insert(len(doubts), "the poses are known no better than that: record better ones")
    if cameras == 2:
        why.append("there are two cameras: nothing shows which of them is wrong where they disagree")
    if kind in ("estimated", "assumed"):
        why.append(f"errors of the poses are not stated, and were {kind}: set pose_noise if you know them")
    if doubts:
        grade = "wrong"
    elif expected is None or share < LEAST_SHARE or expected[1] > USABLE_MM:
        grade = "poor"
    else:
        grade = "good" if expected[1] <= GOOD_MM and not guessed_rates else "usable"
    mends = bool(doubts) and bool(doubts[0]["remedy"])
    return {
        "grade": grade,
        "expected_error_mm": expected,
        "why": why,
        "next": f"mocap check flight.yaml{' --fix' if mends else ''}" if doubts else "mocap report SESSION",
    }
