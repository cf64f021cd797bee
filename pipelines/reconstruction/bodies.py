"""Bodies of the reconstructed people: fitted to their joints, as tables, and compared with true surfaces."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Bool, Float, Index, Int64
from pipelines.geometry.body_model import MEAN_SHAPE, SHAPE, body_model
from pipelines.geometry.noise import UNKNOWN_SIGMA
from pipelines.geometry.poses import interpolate_poses
from pipelines.geometry.rig import BONES, CENTRES
from pipelines.geometry.triangulation import STATUS, Triangulation, Views, reprojection_px
from pipelines.reconstruction.body_fit import (
    BodyFit,
    Landmarks,
    Rays,
    fit_body,
    landmarks_of,
)
from pipelines.reconstruction.observations import Observations
from pipelines.reconstruction.one_camera import (
    STATED_STATURE_SIGMA_M,
    STATURE_M,
    UNKNOWN_LEVEL_SIGMA_M,
    GroundHeight,
    fit_seen_body,
)
from pipelines.session.errors import DataError
from pipelines.session.records import POINT_COVARIANCE_COLUMNS, MovingBody
from pipelines.session.tables import BODY_ROTATION_COLUMNS, load_bodies

# The spread of landmarks was measured with two rays at right angles: (1 + 1 + 1/2) / 3.
TWO_RAYS_VARIANCE = 2.5 / 3
# Two rays that are parallel to 5 degrees show no depth: 2 * 2 * sin(5 deg)^2 is more.
_MIN_DETERMINANT = 0.02
# Errors in pictures grow with this power of the inverse confidence, on the tuning flights: a joint of
# confidence 0.5 errs 3.5 times as much as a sure one.
_CONFIDENCE_POWER = 1.8
# What a detector hardly sees has this confidence at least.
_MIN_CONFIDENCE = 0.05
# A joint whose covariance is infinite has this variance per axis.
_UNKNOWN_M2 = 1e4
# Surfaces are compared at this many times at most: a surface takes 3 ms.
_COMPARED_TIMES = 100
# Between true poses further apart nothing is interpolated.
_LONGEST_STEP_NS = 200_000_000
# A table of this many times has 16 MB for each person.
_TIMES_AT_ONCE = 4096


def fit_bodies(
    observations: Observations,
    views: Views,
    result: Triangulation,
    between: Callable[[range], Iterable[int]],
) -> list[BodyFit | None]:
    """Fit a body to each person; an empty list if the landmarks of the skeleton are not known.

    `between` gives memory back between parts of a long flight.
    """
    found = landmarks_of(observations.joints)
    if found is None:
        return []
    landmarks, columns = found
    times, people, joints, _ = observations.confidence.shape
    known = np.isin(result.status, [STATUS.index("ok"), STATUS.index("filled")])
    place = np.where(known[:, None], result.points, np.nan).reshape(times, people, joints, 3)
    bodies = []
    for person in range(people):
        first_row = (np.arange(times) * people + person) * joints
        errors = partial(_errors, landmarks, views, result, first_row, columns)
        bodies.append(fit_body(landmarks, observations.t_ns, place[:, person, columns], errors, between))
    return bodies


def _errors(
    landmarks: Landmarks, views: Views, result: Triangulation, first_row: Index, columns: Index, times: Index
) -> tuple[Float, Float, Float]:
    """Divide the covariances of landmarks into their own and common ones, see `body_fit.fit_body`.

    A joint's covariance holds errors of the camera poses, which move all joints of a person together. Its own
    error is the detector's, which errs by so much of a body in every picture: with unit vectors d along the
    inliers' rays, the inverse of the sum of I - d d^T over variances. The mean of what the whole has more is
    common. A person who is nearer than thought looks larger: such an error along a ray, relative to the
    distance, is the scale's.
    """
    start = first_row[times]
    rows = start[:, None] + columns
    away = np.nanmean(result.points[rows], axis=1)[:, None] - views.position[views.pose_index[start]]
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    ray = away / distance
    across = np.nan_to_num(np.eye(3) - ray[..., None] * ray[..., None, :])  # [N, C, 3, 3]
    inlier = result.inlier[rows].astype(np.float64)
    weight = inlier * np.maximum(views.weight[rows], _MIN_CONFIDENCE) ** 2
    normal, weighted = (np.einsum("nkc,ncij->nkij", each, across) for each in (inlier, weight))
    sure = (np.linalg.det(normal) > _MIN_DETERMINANT)[..., None, None]
    variance = (MEAN_SHAPE[0] * landmarks.picture_sigma) ** 2 / TWO_RAYS_VARIANCE
    whole = result.covariance[rows]
    own = np.where(sure, np.linalg.inv(np.where(sure, weighted, np.eye(3))) * variance[:, None, None], whole)
    unknown = ~np.isfinite(own).all(axis=(-1, -2), keepdims=True)
    less = np.trace(own, axis1=-2, axis2=-1) > np.trace(whole, axis1=-2, axis2=-1)
    covariance = np.where(less[..., None, None], 0.0, whole - own)
    finite = np.asarray(np.isfinite(covariance).all(axis=(-1, -2)))
    total = np.where(finite[..., None, None], covariance, 0.0).sum(axis=1)
    mean = total / np.maximum(finite.sum(axis=1), 1)[:, None, None]
    size, axes = np.linalg.eigh((mean + np.swapaxes(mean, -1, -2)) / 2)
    found: Float = (axes * np.maximum(size, 0.0)[:, None]) @ np.swapaxes(axes, -1, -2)
    nearer = np.nan_to_num(ray / distance)
    posed = np.isfinite(ray).all(axis=-1).sum(axis=1)
    scale = np.einsum("nci,nij,ncj->n", nearer, found, nearer) / np.maximum(posed, 1)
    return np.where(unknown, _UNKNOWN_M2 * np.eye(3), own), found, scale


# --- one camera ----------------------------------------------------------------------------------------


class OneCamera(NamedTuple):
    """Bodies from one camera, and their landmarks in the place of triangulated joints."""

    bodies: list[BodyFit | None]
    result: Triangulation
    with_second_drone_mm: float | None  # error that a second drone would leave


def bodies_of_one_camera(
    observations: Observations,
    views: Views,
    *,
    ground: Callable[[Float], tuple[Float, Float]] | None,
    of_map: bool,
    stature_m: float | None,
    static: bool,
) -> OneCamera:
    """Fit a body to each person whom the only camera sees; DataError: landmarks that are not known.

    `ground` gives the height under places [N, 3], NaN where it is unknown, and its error: of a map (`of_map`)
    the top of a voxel and its side. A `static` camera without stated noise is exact.
    """
    times, people, joints, _ = observations.confidence.shape
    known = landmarks_of(observations.joints)
    if known is None:
        raise DataError(
            "the skeleton of the keypoints",
            "has no known places on the body, without which one camera shows no distance",
            "use a detector of COCO, BODY_25 or BlazePose, or add a camera",
            code="no-views",
        )
    landmarks, columns = known
    noise = observations.pose_sigma
    usual = (0.0, 0.0) if static else UNKNOWN_SIGMA
    pose_sigma = np.tile(usual, (times, 1)) if noise is None else noise[:, 0]
    height = _height_of(ground, observations.position[:, 0], 0.5 if of_map else 0.0)
    stature = STATURE_M if stature_m is None else (stature_m, STATED_STATURE_SIGMA_M)
    place, status = np.full((times, people, joints, 3), np.nan), np.zeros((times, people, joints), np.int8)
    covariance = np.full((times, people, joints, 3, 3), np.nan)
    seen = np.isfinite(observations.rays[..., 0, :]).all(axis=-1) & (observations.confidence[..., 0] > 0)
    status[:] = np.where(seen, STATUS.index("few_views"), STATUS.index("not_detected"))
    posed = np.isfinite(observations.position[:, None, None, 0]).all(axis=-1)
    status[seen & ~posed] = STATUS.index("no_pose")
    seen &= posed
    bodies: list[BodyFit | None] = []
    for person in range(people):
        found = fit_seen_body(
            landmarks,
            observations.t_ns,
            _rays_of(observations, person, columns, seen[:, person, columns]),
            height,
            stature,
            pose_sigma,
        )
        bodies.append(None if found is None else found.body)
        if found is not None:
            at = np.ix_(found.body.row, np.array([person]), columns)
            shown = seen[at][:, 0]
            place[at] = np.where(shown[..., None], found.place, np.nan)[:, None]
            covariance[at] = np.where(shown[..., None, None], found.covariance, np.nan)[:, None]
            status[at] = np.where(shown, STATUS.index("ok"), status[at][:, 0])[:, None]
    points, ok = place.reshape(-1, 3), (status == STATUS.index("ok")).reshape(-1, 1)
    result = Triangulation(
        points,
        ok,
        status.ravel(),
        covariance.reshape(-1, 3, 3),
        ok[:, 0].astype(np.int64),
        reprojection_px(views, points),
    )
    return OneCamera(bodies, result, _with_second_drone_mm(views, result, pose_sigma))


def _rays_of(observations: Observations, person: int, columns: Index, seen: Bool) -> Rays:
    """Return the rays of one person's landmarks in the only camera, in the world."""
    xy = np.where(seen[..., None], observations.rays[:, person, columns, 0], 0.0)
    ray = np.concatenate([xy, np.ones((*seen.shape, 1))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    ray = np.einsum("tij,tkj->tki", np.nan_to_num(observations.rotation[:, 0]), ray)
    confidence = observations.confidence[:, person, columns, 0]
    sigma = np.where(seen, confidence, 1.0) ** -_CONFIDENCE_POWER
    camera, moment = observations.position[:, 0].copy(), np.arange(len(seen))
    posed = np.isfinite(camera).all(axis=1)
    for axis in range(3) if posed.any() else ():  # bodies go on through short gaps of the log
        camera[~posed, axis] = np.interp(moment[~posed], moment[posed], camera[posed, axis])
    return Rays(np.nan_to_num(camera), np.where(seen[..., None], ray, 0.0), sigma)


def _height_of(
    ground: Callable[[Float], tuple[Float, Float]] | None, camera: Float, lower: float
) -> GroundHeight:
    """Return heights that are known everywhere; they are `lower` times their error below the given ones."""
    flat, sigma_m = 0.0, UNKNOWN_LEVEL_SIGMA_M
    if ground is not None:
        heights, errors = ground(camera[np.isfinite(camera).all(axis=1)])
        if np.isfinite(heights).any():
            flat, sigma_m = float(np.nanmedian(heights)), float(np.nanmin(errors)) * max(lower, 1 - lower)

    def under(places: Float) -> Float:
        if ground is None:
            return np.zeros(len(places))
        heights, errors = ground(places)
        return np.where(np.isfinite(heights), heights, flat) - lower * errors

    return GroundHeight(under, sigma_m)


def _with_second_drone_mm(views: Views, result: Triangulation, pose_sigma: Float) -> float | None:
    """Predict the error with a second drone at right angles: a ray's error s gives the trace 2.5 s^2."""
    known = np.isfinite(result.points).all(axis=1)
    if not known.any():
        return None
    moment = views.pose_index[known]
    distance = np.linalg.norm(result.points[known] - views.position[moment, 0], axis=1)
    position, rotation = pose_sigma[moment].T
    square = position**2 + distance**2 * (rotation**2 + (views.pixel_sigma[0] / views.focal[0]) ** 2)
    return 1e3 * float(np.sqrt(2.5 * square.mean()))


# --- tables --------------------------------------------------------------------------------------------


def body_parts(t_ns: Int64, bodies: Sequence[BodyFit | None]) -> Iterator[pd.DataFrame]:
    """Yield the rows of `tables.BODY` in parts of times, sorted by time, then person."""
    for start in range(0, len(t_ns), _TIMES_AT_ONCE):
        parts = [
            _rows(
                t_ns, person, body, np.nonzero((body.row >= start) & (body.row < start + _TIMES_AT_ONCE))[0]
            )
            for person, body in enumerate(bodies)
            if body is not None
        ]
        if parts:
            yield pd.concat(parts, ignore_index=True).sort_values(["t_ns", "person"], kind="stable")


def _rows(t_ns: Int64, person: int, body: BodyFit, chosen: Int64) -> pd.DataFrame:
    table = pd.DataFrame(
        {
            "t_ns": np.repeat(t_ns[body.row[chosen]], len(BONES)),
            "person": person,
            "bone": np.tile(np.array(BONES, dtype=object), len(chosen)),
        }
    )
    upper = np.triu_indices(3)
    table[["x", "y", "z"]] = body.centre[chosen].reshape(-1, 3)
    table[list(POINT_COVARIANCE_COLUMNS)] = body.centre_covariance[chosen].reshape(-1, 3, 3)[:, *upper]
    table[["qx", "qy", "qz", "qw"]] = body.rotation[chosen].reshape(-1, 4)
    table[list(BODY_ROTATION_COLUMNS)] = body.rotation_covariance[chosen].reshape(-1, 3, 3)[:, *upper]
    return table


def shape_rows(bodies: Sequence[BodyFit | None]) -> pd.DataFrame:
    """Make the rows of `tables.BODY_SHAPE`."""
    rows = [
        (person, name, value, sigma)
        for person, body in enumerate(bodies)
        if body is not None
        for name, value, sigma in zip(
            SHAPE, body.shape.tolist(), np.sqrt(np.diag(body.shape_covariance)).tolist(), strict=True
        )
    ]
    return pd.DataFrame(rows, columns=["person", "number", "value", "sigma"])


# --- figures -------------------------------------------------------------------------------------------


def body_figures(
    t_ns: Int64, names: Sequence[str], bodies: Sequence[BodyFit | None], folder: Path
) -> dict[str, Any]:
    """Compute each person's stature, and with a session's true surfaces errors of vertices and joint centres.

    MPVPE is the mean distance of vertices, in mm; root-relative after the pelvis's joints were subtracted. So
    are the centres of shoulders, elbows, hips, knees and ankles; no landmark takes part in them.
    """
    figures: dict[str, Any] = {}
    truth: list[MovingBody] = []
    rows = [body.row[_compared(body)] for body in bodies if body is not None]
    if rows and (path := folder / "truth_body.parquet").is_file():
        truth = load_bodies(path, folder / "truth_body_shape.parquet", t_ns[np.concatenate(rows)])
    for name, body in zip(names, bodies, strict=False):
        if body is None:
            figures[name] = None
            continue
        figures[name] = {
            "stature_m": float(body.shape[0]),
            "stature_sigma_m": float(np.sqrt(body.shape_covariance[0, 0])),
        }
        if truth:
            errors = [_surface_errors(t_ns, body, each) for each in truth]
            figures[name] |= min(errors, key=lambda error: error["mpvpe_mm"] or np.inf)
    return figures


def _compared(body: BodyFit) -> Int64:
    """Choose the poses of a body that are compared with the truth."""
    return np.unique(np.linspace(0, len(body.row) - 1, _COMPARED_TIMES).astype(np.int64))


def _surface_errors(t_ns: Int64, body: BodyFit, truth: MovingBody) -> dict[str, float | None]:
    model, chosen = body_model(), _compared(body)
    true = [
        interpolate_poses(
            truth.t_ns,
            truth.centre[:, bone],
            truth.rotation[:, bone],
            t_ns[body.row[chosen]],
            max_gap_ns=_LONGEST_STEP_NS,
        )
        for bone in range(len(BONES))
    ]
    centre, rotation = (np.stack([each[part] for each in true], axis=1) for part in range(2))
    whole, relative = [], []
    away = (body.centre[chosen] - centre)[:, list(CENTRES.values())]
    centres = np.linalg.norm(away - (body.centre[chosen, :1] - centre[:, :1]), axis=-1)
    for k, row in enumerate(chosen.tolist()):
        if np.isfinite(centre[k]).all():
            own = model.surface(body.shape, body.centre[row, 0], body.rotation[row])
            error = own - model.surface(truth.shape, centre[k, 0], rotation[k])
            whole.append(np.linalg.norm(error, axis=1).mean())
            error -= body.centre[row, 0] - centre[k, 0]
            relative.append(np.linalg.norm(error, axis=1).mean())
    if not whole:
        return dict.fromkeys(("mpvpe_mm", "root_mpvpe_mm", "root_centres_mm"))
    return {
        "mpvpe_mm": 1e3 * float(np.mean(whole)),
        "root_mpvpe_mm": 1e3 * float(np.mean(relative)),
        "root_centres_mm": 1e3 * float(np.nanmean(centres)),
    }
