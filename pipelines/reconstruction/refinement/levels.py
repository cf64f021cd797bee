"""The parameters of the prior from the data: expectation maximisation over what the posterior says.

Every standard deviation becomes the root of the posterior mean square of what it is the deviation of
(Dempster, Laird & Rubin 1977): accelerations of the joints, image noise, spread of bone lengths, and the
levels of pose errors where nobody stated them. All of them are estimated together: fitting a constant
error alone to a log that drifts was measured to be ten times worse than trusting the log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.reconstruction.refinement import kernels
from pipelines.reconstruction.refinement.elimination import System, Visit, posterior
from pipelines.reconstruction.refinement.problem import Knowledge, PoseErrors, State

Float = NDArray[np.float64]

_rows_of_picture: Callable[..., None] = kernels.rows_of_picture  # its arguments come in tuples

_EVERY = 3  # pictures of every third time are enough to judge image noise and white errors
_LEAST_ACCELERATION = 0.3  # m/s^2: keeps a joint that nobody sees moving from being frozen
_LEAST_BONE_M = 0.001
_STRIDE = (
    1.8  # how far beyond its goal a step goes, on a logarithmic scale: a plain step covers little of the way
)
_LEAST_WHITE = (1e-4, 1e-5)  # m, rad
_LEAST_CONSTANT = (1e-3, 1e-4)
_LEAST_RATE = (1e-4, 1e-5)


@dataclass
class _Sums:
    """What the way back adds up; last axis of each: sum and count."""

    acceleration: Float
    bones: Float
    image: Float = field(default_factory=lambda: np.zeros(2))
    white: Float = field(default_factory=lambda: np.zeros((2, 2)))
    times: int = 0


def reestimated(system: System, state: State, *, poses: bool) -> Knowledge:
    """The prior's parameters that the posterior at `state` asks for.

    Args:
        system: the problem with the parameters so far.
        state: the estimate with them.
        poses: whether the levels of pose errors are free too, pooled over the cameras.
    """
    problem, known, layout = system.problem, system.knowledge, system.layout
    joints, n = problem.joints, 3 * problem.joints
    sums = _Sums(np.zeros((joints, joints)), np.zeros(len(problem.bones)))
    pictures = problem.pictures
    believed, residual = np.empty(joints), np.empty((joints, 2))
    rows, own = np.empty((2 * joints + 6, system.size)), np.empty(2 * joints + 6)
    walked = np.zeros(len(layout.processes))
    walked_s = 0.0
    starts = np.zeros((len(layout.processes), 2))

    def see_time(visit: Visit) -> None:
        time, covariance = visit.time, visit.covariance
        weights, spread = system.curvature(time)
        acceleration = np.einsum("k,kja->ja", weights, state.position[time : time + 3])
        spread_of = np.einsum(
            "k,l,kjalba->jb",
            weights,
            weights,
            covariance[: 3 * n, : 3 * n].reshape(3, joints, 3, 3, joints, 3),
            optimize=True,
        )
        sums.acceleration += (np.einsum("ja,ba->jb", acceleration, acceleration) + spread_of) / (3 * spread)
        sums.times += 1
        sums.bones += _bone_squares(system, state, time, covariance)
        if time % _EVERY:
            return
        for g in range(system.starts[time], system.starts[time + 1]):
            _rows_of_picture(
                g,
                time,
                problem.t_s,
                state.position,
                state.knots,
                state.shared,
                state.white,
                pictures.camera,
                pictures.when_s,
                system.fraction,
                visit.interval,
                *system.picture_arguments(),
                system.bound2,
                system.white_precision,
                *system.entries(),
                layout.knot_count,
                believed,
                residual,
                rows,
                own,
            )
            variance = np.einsum("ij,ij->i", rows @ covariance, rows) + own
            used = believed > 0
            squares = residual[used] ** 2 + variance[: 2 * joints].reshape(joints, 2)[used]
            sums.image += np.einsum("j,ja->", believed[used], squares), 2 * believed[used].sum()
            white = state.white[g] ** 2 + variance[2 * joints :]
            sums.white[0] += white[:3].sum(), 3
            sums.white[1] += white[3:].sum(), 3
        if time == 0:
            for index, (at_knots, column) in enumerate(layout.place):
                offset = 3 * n + (0 if at_knots else 2 * layout.knot_count) + column
                value = state.knots[0] if at_knots else state.shared
                starts[index] = (
                    (value[column : column + 3] ** 2).sum()
                    + np.diagonal(covariance)[offset : offset + 3].sum(),
                    3,
                )

    def see_knots(interval: int, covariance: Float) -> None:
        nonlocal walked_s
        count = layout.knot_count
        elapsed_s = layout.knot_t_s[interval + 1] - layout.knot_t_s[interval]
        walked_s += 3
        change = state.knots[interval + 1] - state.knots[interval]
        diagonal = np.diagonal(covariance)
        spread = diagonal[:count] + diagonal[count:] - 2 * np.diagonal(covariance, count)
        squares = (change**2 + spread) / elapsed_s
        for index, (at_knots, column) in enumerate(layout.place):
            if at_knots:
                walked[index] += squares[column : column + 3].sum()

    posterior(system, state, see_time, see_knots)
    grown = system.grown(state)
    acceleration = sums.acceleration / sums.times
    acceleration[np.diag_indices(joints)] += _LEAST_ACCELERATION**2
    acceleration = _beyond(known.acceleration * grown**2, acceleration)
    before = known.bone_sigma_m * grown
    bones = before * (np.sqrt(sums.bones / sums.times) / before) ** _STRIDE
    scale = known.pixel_scale * float(np.sqrt(sums.image[0] / max(sums.image[1], 1)))
    return Knowledge(
        poses=_poses(system, sums, starts, walked / max(walked_s, 1)) if poses else known.poses,
        clock_sigma_s=known.clock_sigma_s,
        acceleration=acceleration,
        bone_sigma_m=np.maximum(bones, _LEAST_BONE_M),
        size_m=known.size_m * grown,
        pixel_scale=scale,
    )


def _bounded(change: Any) -> Any:
    """A change of a level, small enough that one bad estimate does not run away with it."""
    return np.clip(change, 0.3, 2.0)


def _beyond(before: Float, goal: Float) -> Float:
    """A covariance as far beyond its goal as `_STRIDE` says, on the geodesic from the one before."""
    values, vectors = np.linalg.eigh(goal)
    root, inverse = (vectors * values**power @ vectors.T for power in (0.5, -0.5))
    values, vectors = np.linalg.eigh(inverse @ before @ inverse)
    further: Float = root @ (vectors * np.clip(values, 0.05, 20) ** (1 - _STRIDE) @ vectors.T) @ root
    return (further + further.T) / 2


def _bone_squares(system: System, state: State, time: int, covariance: Float) -> Float:
    """Posterior mean squares [B] of how far the bones of a time are from their lengths."""
    problem, layout = system.problem, system.layout
    if not len(problem.bones):
        return np.zeros(0)
    first, second = problem.bones.T
    along = state.position[time, second] - state.position[time, first]
    length = np.linalg.norm(along, axis=-1)
    along = along / np.maximum(length, 1e-6)[:, None]
    place = 9 * problem.joints + 2 * layout.knot_count + layout.bone_column + np.arange(len(first))
    axes = np.arange(3)
    columns = np.concatenate([3 * first[:, None] + axes, 3 * second[:, None] + axes, place[:, None]], axis=1)
    by = np.concatenate([-along, along, -np.ones((len(first), 1))], axis=1)
    block = covariance[columns[:, :, None], columns[:, None, :]]
    squares: Float = (length - state.shared[layout.bone_column :]) ** 2 + np.einsum(
        "bi,bij,bj->b", by, block, by
    )
    return squares


def _poses(system: System, sums: _Sums, starts: Float, walked: Float) -> tuple[PoseErrors, ...]:
    """The levels of pose errors, the same for all cameras."""
    known, layout = system.knowledge, system.layout
    white = np.sqrt(sums.white[:, 0] / np.maximum(sums.white[:, 1], 1))
    errors, knots = known.poses[0], layout.knot_t_s
    before = errors.white_with_stray(float(knots[1] - knots[0]))
    stray2 = before**2 - np.square(errors.white)
    white = before * _bounded(white / before) ** _STRIDE
    white = np.maximum(np.sqrt(np.maximum(white**2 - stray2, 0.0)), _LEAST_WHITE)
    kinds: dict[int, list[int]] = {}
    for index, (camera, process) in enumerate(layout.processes):
        place = known.poses[camera].processes.index(process)
        kinds.setdefault(place, []).append(index)
    poses = []
    for errors in known.poses:
        processes = []
        for place, process in enumerate(errors.processes):
            indices = kinds[place]
            part = 1 if process.number == 3 else 0
            sigma0 = np.sqrt(starts[indices, 0].sum() / starts[indices, 1].sum())
            rate = np.sqrt(walked[indices].mean())
            if process.rate > 0:
                rate = process.rate * _bounded(rate / process.rate) ** _STRIDE
            sigma0 = process.sigma0 * _bounded(sigma0 / process.sigma0)
            processes.append(
                replace(
                    process,
                    sigma0=max(float(sigma0), _LEAST_CONSTANT[part]),
                    rate=0.0 if process.constant else max(float(rate), _LEAST_RATE[part]),
                )
            )
        poses.append(PoseErrors((float(white[0]), float(white[1])), tuple(processes)))
    return tuple(poses)
