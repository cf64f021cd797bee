"""Agreement of a video with a camera's logged poses, by the motion of points in its pictures.

Between two pictures a point moves along a line that the camera's motion determines (Hartley and Zisserman
2004, section 9.1). So poses are judged without knowing the scene: by the distance of points from the segment
of that line between infinite depth and the nearest possible depth.
"""

from dataclasses import dataclass, replace

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.poses import conjugate, interpolate_poses, matrix_from_quaternion, multiply, rotate

# A difference of log-likelihoods is significant from this many standard deviations on.
SIGNIFICANT_SIGMAS = 4.0
# This grid of poses is finer than the pictures of a video at 30 Hz.
STEP_S = 0.02
# Poses of a log are noisy from row to row, so they are smoothed by a window of this standard deviation.
SMOOTHING_SIGMA_S = 0.1
# Next to gaps and ends the mean of a window is biased, so this share of the window must be known.
MIN_WINDOW_WEIGHT = 0.9
# Drones stay at least this far from anything that they film.
MIN_DISTANCE_M = 2.0
# No picture shows points beside the camera, so directions have at least this share of their length as depth.
MIN_DEPTH_SHARE = 0.1
# Tracking, and the poses between pictures, err by 0.4 px of pictures that are 320 px wide.
SCATTER_RAD = 2e-3
# All starts are tried in these steps, and those next to the best one in the finer steps.
SEARCH_STEP_S, FINE_STEP_S = 0.08, 0.01
# During the search the scatter is this share of the motion of points, so that the peak is wide enough.
SEARCH_SCATTER_SHARE = 0.25
# All starts are tried with at most this many points, to bound the time.
MAX_SEARCH_POINTS = 500
# A start at which the log covers less of the video cannot be compared with the others.
MIN_COVERED_SHARE = 0.5


@dataclass(frozen=True)
class TrackedPoints:
    """Points tracked through stretches of a video, in normalised coordinates (x/z, y/z)."""

    begin_ns: Int64  # [S] of the video's own stamps, rising
    end_ns: Int64  # [S]
    stretch: Int64  # [P] index of a point's stretch, rising
    begin: Float  # [P, 2]
    end: Float  # [P, 2]


@dataclass(frozen=True)
class _Path:
    """A camera's poses on a grid, smoothed."""

    position: Float  # [G, 3]
    quaternion: Float  # [G, 4]
    known: Bool  # [G]


def explain_motion(
    t_ns: Int64, position: Float, quaternion_xyzw: Float, followed: TrackedPoints, *, max_gap_ns: int
) -> tuple[Float, int] | None:
    """Compute how well a camera's poses explain the motion of points, at the start that fits best.

    Return the log-likelihood gain of each stretch [S] over a camera that stands still, and the start on the
    log's clock, ns. Distances have Cauchy's likelihood, so that the filmed person and lost points have little
    weight. The stamps [N] strictly increase. None if the poses cover less than half of the points.
    """
    if not len(followed.stretch) or len(t_ns) < 2:
        return None
    path = _path(t_ns, position, quaternion_xyzw, max_gap_ns)
    moved = float(np.median(np.linalg.norm(followed.end - followed.begin, axis=1)))
    scatter = max(SCATTER_RAD, SEARCH_SCATTER_SHARE * moved)
    last_s, length_s = float(followed.end_ns[-1]) / 1e9, STEP_S * (len(path.known) - 1)
    every = slice(None, None, max(1, len(followed.stretch) // MAX_SEARCH_POINTS))
    some = replace(
        followed, stretch=followed.stretch[every], begin=followed.begin[every], end=followed.end[every]
    )
    start_s = _best(path, some, np.arange(-last_s, length_s, SEARCH_STEP_S), scatter)
    if start_s is None:
        return None
    near_s = start_s + np.arange(-SEARCH_STEP_S, SEARCH_STEP_S, FINE_STEP_S)
    start_s = _best(path, followed, near_s, SCATTER_RAD) or start_s
    gain = np.nan_to_num(_gain(path, followed, start_s, SCATTER_RAD))
    return gain, int(t_ns[0]) + round(start_s * 1e9)


def explains_better(gain: Float, other: Float) -> bool:
    """Test if gains of `explain_motion` [S] are clearly above others of the same video, or above 0."""
    return sigmas_above(gain, other) > SIGNIFICANT_SIGMAS


def sigmas_above(gain: Float, other: Float) -> float:
    """Divide the sum of differences of gains by its standard deviation (Vuong 1989, independent stretches).

    That is taken as two or more: small differences without any spread are not significant.
    """
    known = (gain - other)[np.isfinite(gain - other)]
    sigma = float(np.std(known, ddof=1)) * np.sqrt(len(known)) if len(known) > 1 else np.inf
    return float(known.sum()) / max(sigma, SIGNIFICANT_SIGMAS / 2)


def _path(t_ns: Int64, position: Float, quaternion_xyzw: Float, max_gap_ns: int) -> _Path:
    from scipy.ndimage import gaussian_filter1d

    at_ns = t_ns[0] + np.arange(0, int(t_ns[-1] - t_ns[0]) + 1, round(STEP_S * 1e9))
    moved, turned = interpolate_poses(t_ns, position, quaternion_xyzw, at_ns, max_gap_ns=max_gap_ns)
    there: Bool = np.asarray(np.isfinite(moved).all(axis=1))
    width = SMOOTHING_SIGMA_S / STEP_S
    weight = gaussian_filter1d(there.astype(np.float64), width, mode="constant")

    def smoothed(values: Float) -> Float:
        held = np.where(there[:, None], values, 0.0)
        return gaussian_filter1d(held, width, axis=0, mode="constant") / np.maximum(weight, 1e-9)[:, None]

    centre = np.where(there[:, None], moved, 0.0).sum(axis=0) / max(int(there.sum()), 1)
    known = there & np.asarray(weight > MIN_WINDOW_WEIGHT)
    return _Path(smoothed(moved - centre), _unit(smoothed(turned)), known)


def _unit(quaternion: Float) -> Float:
    unit: Float = quaternion / np.maximum(np.linalg.norm(quaternion, axis=1, keepdims=True), 1e-9)
    return unit


def _best(path: _Path, followed: TrackedPoints, starts_s: Float, scatter: float) -> float | None:
    """Return the likeliest start, in s after the first pose; None where the log covers too little."""
    best: tuple[float, float] | None = None
    for start_s in starts_s.tolist():
        gain = _gain(path, followed, start_s, scatter)
        known = np.isfinite(gain)
        if known.mean() >= MIN_COVERED_SHARE and (best is None or gain[known].sum() > best[0]):
            best = float(gain[known].sum()), start_s
    return None if best is None else best[1]


def _gain(path: _Path, followed: TrackedPoints, start_s: float, scatter: float) -> Float:
    """Compute the log-likelihood [S] of a start over a still camera; NaN where the log has no poses."""
    off = [np.linalg.norm(followed.end - followed.begin, axis=1), _distances(path, followed, start_s)]
    still, moving = (
        np.bincount(followed.stretch, np.log1p((each / scatter) ** 2), len(followed.begin_ns)) for each in off
    )
    return np.asarray(still - moving)


def _distances(path: _Path, followed: TrackedPoints, start_s: float) -> Float:
    """Compute the distances [P] of points from where a start allows them; NaN where the log has no poses."""
    from_position, from_quaternion = _at(path, start_s + followed.begin_ns / 1e9)
    to_position, to_quaternion = _at(path, start_s + followed.end_ns / 1e9)
    turn = matrix_from_quaternion(multiply(conjugate(to_quaternion), from_quaternion))
    shift = rotate(conjugate(to_quaternion), from_position - to_position) / MIN_DISTANCE_M
    ray = np.einsum(
        "pij,pj->pi", turn[followed.stretch], np.column_stack([followed.begin, np.ones(len(followed.begin))])
    )
    infinite, nearest = (
        each[:, :2] / np.maximum(each[:, 2:], MIN_DEPTH_SHARE)
        for each in (ray, ray + shift[followed.stretch])
    )
    line, beside = nearest - infinite, followed.end - infinite
    length2 = np.maximum((line**2).sum(axis=1), 1e-18)
    along = np.clip((beside * line).sum(axis=1) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(beside - along[:, None] * line, axis=1))


def _at(path: _Path, at_s: Float) -> tuple[Float, Float]:
    """Interpolate positions [S, 3] and quaternions [S, 4] at times after the first pose; NaN if not known."""
    place = at_s / STEP_S
    before = np.clip(np.floor(place).astype(np.int64), 0, max(len(path.known) - 2, 0))
    after = np.minimum(before + 1, len(path.known) - 1)
    share = (place - before)[:, None]
    inside = (place >= 0) & (place <= len(path.known) - 1) & path.known[before] & path.known[after]
    position = (1 - share) * path.position[before] + share * path.position[after]
    quaternion = _unit((1 - share) * path.quaternion[before] + share * path.quaternion[after])
    return np.where(inside[:, None], position, np.nan), np.where(inside[:, None], quaternion, np.nan)
