"""Clocks by the backgrounds of pictures: how cameras turned between pictures, against what their logs say.

Rays of people agree with each other where all cameras are late alike: drones that follow somebody carry the
error along. The background does not move, so it tells when each camera turned by itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.cameras import undistort
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction.background_tracks import Followed
from pipelines.reconstruction.observations import Camera
from pipelines.session.description import Interpolation

# Over this time cameras turn by more than the errors of followed points, and points are still seen.
_SPAN_NS = 200_000_000
_MOST_PARTS, _MOST_TURNS = 20, 200  # of a camera that are looked at, spread over the flight
_FEWEST_POINTS, _POINTS = 12, 40  # that two pictures share, and of these that are looked at
# Fewer turns do not show a clock.
_FEWEST_TURNS = 10
# The rotation between two pictures converges in fewer steps.
_STEPS = 3
# A camera that moved by less than this only turned.
_BASELINE_M = 1e-3
# Points beyond this many standard deviations count linearly.
_HUBER = 1.5
# Clocks are tried every 0.1 s, and then more finely around the best.
_GRID_S = np.linspace(-1.0, 1.0, 21)
_FINE_STEP_S, _FINE_STEPS = 0.02, 4  # around the best of them
# Errors of attitudes that wander pass for smaller offsets of clocks.
_LEAST_LATE_S = 0.2
# The turns beyond this share are outliers.
_USUAL_SHARE = 0.9
# Logs that leave a larger share of the turning unexplained tell no time.
_UNEXPLAINED = 0.5

RATES = (25 / 30, 24 / 30, 30 / 25, 30 / 24, 2.0, 0.5)
"""Factors between frame rates that are mistaken for each other: 25 for 30, 24 for 30, half and double."""

LEAST_GAIN = 16.0
"""Least gain of chi^2 with which other times of pictures are accepted."""


class Turns(NamedTuple):
    """Pairs of one camera's pictures, each with the background points that both show."""

    first_ns: Int64  # [N] of the first picture of each, by its clock
    second_ns: Int64  # [N]
    before: Float  # [N, K, 3] unit rays to points of the background in the first
    after: Float  # [N, K, 3] to the same points in the second


@dataclass(frozen=True)
class Lateness:
    """Times of pictures by which logs turn as their backgrounds do."""

    cameras: tuple[int, ...]
    late_s: float
    slower: float  # factor of the times between pictures
    gain: float  # chi^2 that the stated times cost more
    sigma_s: float  # of `late_s`; NaN of a factor


def turns_of(camera: Camera, followed: Followed) -> Turns:
    """Choose pairs of pictures, 0.2 s apart, whose backgrounds tell how a camera turned between them."""
    t_ns = camera.frame_t_ns[followed.rows]
    step_ns = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else np.inf
    span = max(1, round(_SPAN_NS / step_ns))
    count = len(followed.parts)
    chosen = np.unique(np.linspace(0, max(count - 1, 0), _MOST_PARTS).astype(np.intp))[:count]
    first: list[int] = []
    pairs: list[tuple[Float, Float]] = []
    for place, index in enumerate(chosen):
        tracks = followed.parts[index]()
        if not tracks.picture.size:
            continue
        rays = undistort(tracks.xy, camera.intrinsics)
        rays = np.column_stack([rays, np.ones(len(rays))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        begins = np.searchsorted(tracks.picture, np.arange(len(t_ns) + 1))
        for k in range(int(tracks.picture[0]), int(tracks.picture[-1]) - span + 1, span):
            one, other = (np.arange(begins[each], begins[each + 1]) for each in (k, k + span))
            shared = np.intersect1d(tracks.point[one], tracks.point[other], return_indices=True)
            one, other = one[shared[1]], other[shared[2]]
            if len(one) >= _FEWEST_POINTS and len(first) < _MOST_TURNS * (place + 1) / len(chosen):
                some = np.linspace(0, len(one) - 1, _POINTS).astype(np.intp)
                pairs.append((rays[one[some]], rays[other[some]]))
                first.append(k)
    second = np.array(first, dtype=np.intp) + span
    before, after = np.array(pairs).reshape(-1, 2, _POINTS, 3).swapaxes(0, 1)
    return Turns(t_ns[second - span], t_ns[second], before, after)


def _turned(before: Float, after: Float, logged: Float, moved: Float) -> Float:
    """Return rotations [N, 3, 3] that bring rays [N, K, 3] onto others, beside what is logged."""
    # Where the camera moved, a point tells the turn across that motion alone: its distance is unknown.
    far = np.linalg.norm(moved, axis=1, keepdims=True) > _BASELINE_M
    normal = np.cross(np.where(far, moved, [1.0, 0.0, 0.0])[:, None], after)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-9)
    turn, weight = np.broadcast_to(np.eye(3), logged.shape), np.ones(after.shape[:2])
    for _ in range(_STEPS):
        toward = before @ np.swapaxes(turn @ logged, 1, 2)
        design, miss = np.cross(toward, normal), (normal * (after - toward)).sum(axis=2)
        weighted = np.swapaxes(design * weight[..., None], 1, 2)
        step = np.linalg.solve(weighted @ design + 1e-9 * np.eye(3), weighted @ miss[..., None])
        turn = matrix_from_quaternion(quaternion_from_rotation_vector(step[..., 0])) @ turn
        left = np.abs(miss - (design @ step)[..., 0])
        usual = _HUBER * (1.48 * np.median(left, axis=1, keepdims=True) + 1e-6)
        weight = 1 / np.maximum(left / usual, 1.0)
    return turn


def _angles(rotation: Float) -> Float:
    vectors = rotation_vector_from_quaternion(quaternion_from_matrix(rotation))
    return np.asarray(np.linalg.norm(vectors, axis=1))


def lateness(
    cameras: Sequence[Camera], turns: Mapping[int, Turns], between: Interpolation, first_ns: Sequence[int]
) -> list[Lateness]:
    """Find the clocks and frame rates, of all cameras and of each, by which the turns fit best; best first.

    Turns are by camera; other rates count from the cameras' first pictures at `first_ns`. None is returned if
    too little turns, or the logs turn otherwise at all times.
    """
    times = [*((float(s), 1.0) for s in _GRID_S), *((0.0, factor) for factor in RATES)]
    curves = {i: _gains(cameras[i], found, between, times, first_ns[i]) for i, found in turns.items()}
    groups = [*((i,) for i in turns), *([tuple(turns)] if len(turns) == len(cameras) > 1 else [])]
    tried: list[Lateness] = []
    for group in groups:
        clocks, rates = np.split(np.sum([curves[i] for i in group], axis=0), [len(_GRID_S)])
        clock = _best_clock(group, _GRID_S, clocks)
        tried += [] if clock is None else [clock]
        tried += [
            Lateness(group, 0.0, factor, float(gain), float("nan"))
            for factor, gain in zip(RATES, _explained(rates), strict=True)
            if np.isfinite(gain)
        ]
    return sorted(tried, key=lambda each: -each.gain)


def common_offset(
    cameras: Sequence[Camera], followed: Mapping[str, object], between: Interpolation
) -> Lateness | None:
    """Estimate the clock offset that all cameras share by their backgrounds; None if it is not sure."""
    turns, late = all_turns(cameras, followed), None
    for grid in (_GRID_S, _FINE_STEP_S * np.arange(-_FINE_STEPS, _FINE_STEPS + 1, dtype=np.float64)):
        at: Float = grid if late is None else grid + late.late_s
        curves = [_gains(cameras[i], each, between, [(s, 1.0) for s in at]) for i, each in turns.items()]
        found = _best_clock(tuple(range(len(cameras))), at, np.sum(curves, axis=0)) if curves else None
        if late is not None and found is not None:
            return replace(late, late_s=found.late_s)
        late = late or found
        if late is None or not is_sure_clock(late):
            return None
    return late


def all_turns(cameras: Sequence[Camera], followed: Mapping[str, object]) -> dict[int, Turns]:
    """Choose the turns of the cameras whose followed backgrounds show enough of them, by index."""
    tracks = {index: followed.get(camera.name) for index, camera in enumerate(cameras)}
    turns = {i: turns_of(cameras[i], each) for i, each in tracks.items() if isinstance(each, Followed)}
    return {index: found for index, found in turns.items() if len(found.before) >= _FEWEST_TURNS}


def is_sure_clock(late: Lateness) -> bool:
    """Test if a clock offset is significant, and larger than the apparent offsets of attitude errors."""
    return late.gain >= LEAST_GAIN and bool(np.isfinite(late.sigma_s)) and abs(late.late_s) >= _LEAST_LATE_S


def _gains(
    camera: Camera,
    turns: Turns,
    between: Interpolation,
    times: Sequence[tuple[float, float]],
    start_ns: int = 0,
) -> Float:
    """Return by how much other times lower the chi^2, the squares left, and those of turns [S, 3].

    Times are seconds that are added, and a factor.
    """
    # The level of the logs' errors is estimated: N log of the ratio of mean squares.
    stated, _ = _left(camera, turns, between, turns.first_ns, turns.second_ns)
    found = []
    for late_s, slower in times:
        first_ns, second_ns = (
            start_ns + ((t_ns - start_ns) * slower).astype(np.int64) + round(late_s * 1e9)
            for t_ns in (turns.first_ns, turns.second_ns)
        )
        left, logged = _left(camera, turns, between, first_ns, second_ns)
        both = np.isfinite(stated) & np.isfinite(left)
        if both.sum() < _FEWEST_TURNS:
            found.append((0.0, np.inf, 0.0))
            continue
        angles = np.stack([each[both] for each in (stated, left, logged)])
        usual = np.minimum(angles, np.quantile(angles, _USUAL_SHARE, axis=1, keepdims=True))
        squares = np.mean(usual**2, axis=1) + 1e-12
        found.append((both.sum() * np.log(squares[0] / squares[1]), squares[1], squares[2]))
    return np.array(found)


def _left(
    camera: Camera, turns: Turns, between: Interpolation, first_ns: Int64, second_ns: Int64
) -> tuple[Float, Float]:
    """Return the angles [N] by which the log turns otherwise at given times, and turns; NaN without poses."""
    start, before = camera.poses_at(first_ns, between)
    end, after = camera.poses_at(second_ns, between)
    back = np.swapaxes(after, 1, 2)
    logged = back @ before
    moved = np.einsum("nij,nj->ni", back, start - end)
    known = np.isfinite(logged).all(axis=(1, 2)) & np.isfinite(moved).all(axis=1)
    left, turned = np.full((2, len(logged)), np.nan)
    left[known] = _angles(_turned(turns.before[known], turns.after[known], logged[known], moved[known]))
    turned[known] = _angles(logged[known])
    return left, turned


def _explained(summed: Float) -> Float:
    """Return the gains [S] of times; -inf where the logs do not turn mostly as the pictures do."""
    return np.where(summed[:, 1] <= _UNEXPLAINED * summed[:, 2], summed[:, 0], -np.inf)


def _best_clock(group: tuple[int, ...], grid: Float, summed: Float) -> Lateness | None:
    """Find the best clock of a group on a grid [S] of seconds, between its values by a parabola."""
    gains = _explained(summed)
    best = int(np.argmax(gains))
    if not np.isfinite(gains[best]):
        return None
    late_s, sigma_s = float(grid[best]), float("nan")
    if 0 < best < len(grid) - 1 and np.isfinite(gains[[best - 1, best + 1]]).all():
        below, at, above = gains[best - 1 : best + 2]
        bend = float(2 * at - below - above)
        if bend > 0:
            step_s = float(grid[1] - grid[0])
            late_s += step_s * float(above - below) / (2 * bend)
            sigma_s = step_s * float(np.sqrt(2 / bend))
    return Lateness(group, late_s, 1.0, float(gains[best]), sigma_s)
