"""Pose errors that all people of a picture share, taken out before people are told apart.

A camera that is turned or shifted moves everybody in its picture by about the same. The person who is seen
most is surely one body, so what their views have in common shows these errors. Without them, two people who
stand near each other are further apart than the views of one person.

Only the part on which views can disagree is found. Cameras that all err alike show the person elsewhere, and
still agree.
"""

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_rotation_vector
from pipelines.keypoints.grouping import TracksOfDetections
from pipelines.keypoints.no_people import SightLines

Int64 = NDArray[np.int64]

# The errors of keypoints average out over this time, and those of poses hardly change.
_WINDOW_S = 0.5
# The last round changes the disagreement by less than a tenth.
_ROUNDS = 3
# About this many joints are used, which is enough to average their errors.
_JOINTS = 8
# The rays of this many times take 30 MB of memory.
_BLOCK = 2_000
# A larger correction means that the person may be none.
_MAX_CORRECTION_SIGMAS = 3.0
# If more of the first squares remains, the errors change from picture to picture.
_MAX_REMAINING_SHARE = 0.4
# Position errors move the far less than the near, so this share of the noise of rays remains.
_REMAINING_NOISE_SHARE = 0.7


def without_common_errors(time_s: Float, views: SightLines, seen: TracksOfDetections) -> SightLines:
    """Turn the cameras so that the views of the person seen most agree.

    Args:
        time_s: [T] s, increasing.
        views: all detections.
        seen: their tracks.

    Returns:
        The views with other rotations and less noise; as they were where the errors do not last, and without
        anybody whom two cameras see.
    """
    person = _most_seen(seen)
    if person is None:
        return views
    detection = np.where(person.any(axis=-1), person.argmax(axis=-1), -1)
    fewer = slice(None, None, max(1, views.xy.shape[3] // _JOINTS))
    few = views._replace(xy=views.xy[..., fewer, :], confidence=views.confidence[..., fewer])
    rotation = views.rotation.copy()
    total = np.zeros((*views.sigma.shape, 2))
    left = []
    for _ in range(_ROUNDS):
        missed = np.concatenate(
            [
                _missed(few, rotation, detection, slice(start, start + _BLOCK))
                for start in range(0, len(time_s), _BLOCK)
            ]
        )
        left.append(
            float(np.mean(missed**2, where=np.isfinite(missed))) if np.isfinite(missed).any() else 0.0
        )
        # A mean of means has no negative weight at any frequency, so the rounds do not amplify one.
        turn = np.stack([_mean(time_s, _mean(time_s, missed[:, c])) for c in range(missed.shape[1])], axis=1)
        total += turn
        rotation = rotation @ _turned(turn)
    small = np.hypot(*np.moveaxis(total, -1, 0)) <= _MAX_CORRECTION_SIGMAS * views.sigma
    if not left[-1] < _MAX_REMAINING_SHARE * left[0]:
        return views
    return views._replace(
        rotation=np.where(small[..., None, None], rotation, views.rotation),
        sigma=np.where(small, _REMAINING_NOISE_SHARE, 1.0) * views.sigma,
    )


def _most_seen(seen: TracksOfDetections) -> Bool | None:
    """Find the detections [T, C, D] of the track whom two cameras or more see most; None without one."""
    tracks, views = np.unique(seen.track[np.isfinite(seen.spread)], return_counts=True)
    if not len(tracks):
        return None
    return np.asarray(np.isfinite(seen.spread) & (seen.track == tracks[views.argmax()]))


def _missed(views: SightLines, rotation: Float, detection: Int64, rows: slice) -> Float:
    """Compute how far a person's joints are from where they are seen, median over joints [N, C, 2]; or NaN.

    Joints are the points nearest to their rays by least squares.
    """
    taken = np.maximum(detection[rows], 0)[..., None, None]
    xy = np.take_along_axis(views.xy[rows], taken[..., None], axis=2)[:, :, 0]
    confidence = np.take_along_axis(views.confidence[rows], taken, axis=2)[:, :, 0]
    position, rotation = views.position[rows], rotation[rows]
    posed = np.isfinite(position).all(axis=-1) & np.isfinite(rotation).all(axis=(-2, -1))
    there = ((detection[rows] >= 0) & posed)[..., None] & (confidence > 0) & np.isfinite(xy).all(axis=-1)
    there &= (there.sum(axis=1) > 1)[:, None]
    ray = np.concatenate([np.where(there[..., None], xy, 0.0), np.ones((*there.shape, 1))], axis=-1)
    ray = np.einsum("ncij,nckj->ncki", np.nan_to_num(rotation), ray)
    length = np.where(there[..., None], np.linalg.norm(ray, axis=-1, keepdims=True), np.inf)
    ray = ray / length  # 0 where nothing is seen
    origin = np.nan_to_num(position)[:, :, None]
    several = there.any(axis=1)
    normal = there.sum(axis=1)[..., None, None] * np.eye(3) - np.einsum("ncki,nckj->nkij", ray, ray)
    normal += np.where(several, 1e-9, 1.0)[..., None, None] * np.eye(3)
    along = (ray * origin).sum(axis=-1, keepdims=True)
    target = np.where(there[..., None], origin - along * ray, 0.0).sum(axis=1)
    points = np.linalg.solve(normal, target[..., None])[..., 0]
    u, v, depth = np.einsum("ncji,nckj->inck", rotation, points[:, None] - origin)
    ahead = np.where(there & (depth > 0), depth, np.nan)
    missed = np.stack([u / ahead, v / ahead], axis=-1) - xy
    unseen: Bool = np.asarray(np.isnan(missed).all(axis=2, keepdims=True))
    median = np.nanmedian(np.where(unseen, 0.0, missed), axis=2)
    return np.asarray(np.where(unseen[:, :, 0], np.nan, median), dtype=np.float64)


def _mean(time_s: Float, values: Float) -> Float:
    """Average values [T, 2] within the window about each time; where none is, the nearest average; or 0."""
    known = np.isfinite(values[:, 0])
    if not known.any():
        return np.zeros_like(values)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.c_[np.nan_to_num(values), known], axis=0)])
    first = np.searchsorted(time_s, time_s - _WINDOW_S / 2, side="left")
    last = np.searchsorted(time_s, time_s + _WINDOW_S / 2, side="right")
    within = total[last] - total[first]
    rows = np.flatnonzero(within[:, 2] > 0)
    mean = within[rows, :2] / within[rows, 2:]
    return np.stack([np.interp(time_s, time_s[rows], column) for column in mean.T], axis=1)


def _turned(offset: Float) -> Float:
    """Return the rotations [..., 3, 3] that move a whole picture by a small offset [..., 2] in it."""
    across, along = np.moveaxis(offset, -1, 0)
    vector = np.stack([-along, across, np.zeros_like(across)], axis=-1)
    return matrix_from_quaternion(quaternion_from_rotation_vector(vector))
