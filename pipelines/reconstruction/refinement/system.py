"""Problem with its prior: values that every linearisation needs, the cost of a state, and its halves.

`elimination` eliminates the equations of both halves in parallel, from both ends of the flight until they
meet in the middle. The equations are symmetric in time. With times, pictures and knots in the opposite order,
the second half is a flight like the first and uses the same kernels. The same unknowns are alive at the end
of both halves: the joints at two times, the knots around them, and the unknowns shared by all times.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.noise import EXACT, PoseErrors
from pipelines.reconstruction.refinement import kernels
from pipelines.reconstruction.refinement.kernels import Equations, PictureArrays, State
from pipelines.reconstruction.refinement.problem import Knowledge, Problem, UnknownLayout
from pipelines.reconstruction.refinement.sweeps import Sweep, Ties

AT_ONCE = 4096
"""Pictures whose residuals are in memory together where only a sum over them is asked for."""

# An unseen joint is within this distance of its start.
_ANYWHERE_M = 100.0


@dataclass(frozen=True)
class System:
    """Problem with its prior, ready to be linearised at any state."""

    problem: Problem
    knowledge: Knowledge
    layout: UnknownLayout
    bound2: float  # of the robust loss
    held: bool = False  # bone lengths stay as they are
    pictures: PictureArrays = field(init=False)
    white_precision: Float = field(init=False)  # [., 6, 6] of each camera, then of logged poses; inf without
    inverse_acceleration: Float = field(init=False)  # [J, J]
    of_time: Int64 = field(init=False)  # [T - 2] the knot before each time
    usual_step_s: float = field(init=False)
    tie_kept: Float = field(init=False)  # [K - 1, c] share of a slow error that is left at the next knot
    tie_variance: Float = field(init=False)  # [K - 1, c] variance added from knot to knot

    def __post_init__(self) -> None:
        """Derive the values that every linearisation needs."""
        problem, known, seen = self.problem, self.knowledge, self.problem.pictures
        of_time, fraction = problem.intervals()
        white_row, white_precision = _loosened(problem, *_white_errors(problem, known.poses))
        kept, variance = _ties(self.layout)
        derived = {
            "pictures": PictureArrays(
                first=seen.first,
                camera=seen.camera,
                when_s=seen.when_s,
                rays=seen.rays,
                sharpness=seen.sharpness / (known.pixel_scale * np.sqrt(known.memory)),
                position=seen.position,
                rotation=seen.rotation,
                speed=seen.speed,
                turn=seen.turn,
                interval=of_time[seen.first],
                fraction=fraction,
                white_row=white_row,
            ),
            "white_precision": white_precision,
            "inverse_acceleration": np.linalg.inv(known.acceleration),
            "of_time": of_time,
            "usual_step_s": float(np.median(np.diff(problem.t_s))),
            "tie_kept": kept,
            "tie_variance": variance,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of unknowns of a front."""
        return 9 * self.problem.joints + 2 * self.layout.entries.knot_count + self.layout.shared_count

    def equations(self, state: State, t_s: Float, pictures: PictureArrays) -> Equations:
        """Collect the arguments of the kernels."""
        return Equations(t_s, state, pictures, self.layout.entries, self.bound2, self.white_precision)

    def grown(self, state: State) -> float:
        """Compute the ratio of the body's size to the one for which the prior of motion and bones holds."""
        lengths = state.shared[self.layout.bone_column :]
        return float(lengths.mean() / self.knowledge.size_m) if len(lengths) else 1.0


def _white_errors(problem: Problem, poses: Sequence[PoseErrors]) -> tuple[Int64, Float]:
    """Compute the inverse covariances [., 6, 6] of white errors, and the row [G] of each picture in them."""
    knot_s = float(problem.knot_t_s[1] - problem.knot_t_s[0])
    pictures, logged = problem.pictures, problem.pose_covariance
    level = np.array([np.repeat(errors.white_with_stray(knot_s), 3) for errors in poses])
    usual = np.full((len(poses), 6, 6), np.inf)
    has = level[:, 0] > 0
    usual[has] = level[has, :, None] ** -2.0 * np.eye(6)
    own = np.array([errors.logged for errors in poses])[pictures.camera] & (pictures.logged >= 0)
    if not own.any():
        return pictures.camera, usual
    stray2 = level**2 - np.repeat(np.square([errors.white for errors in poses]), 3, axis=1)
    of_camera = np.zeros(len(logged), dtype=np.int64)
    of_camera[pictures.logged[own]] = pictures.camera[own]
    added = np.maximum(stray2, EXACT**2)[of_camera]
    precision = np.linalg.inv(logged + added[:, :, None] * np.eye(6))
    return np.where(own, len(poses) + pictures.logged, pictures.camera), np.concatenate([usual, precision])


def _loosened(problem: Problem, row: Int64, precision: Float) -> tuple[Int64, Float]:
    """Add inverse covariances of the pictures in bad stretches of their logs."""
    (loose,) = np.nonzero((problem.pictures.loosened > 0).any(axis=1))
    if not len(loose):
        return row, precision
    known = precision[row[loose]]
    exact = ~np.isfinite(known[:, 0, 0])
    covariance = np.zeros(known.shape)
    covariance[~exact] = np.linalg.inv(known[~exact])
    added = np.maximum(problem.pictures.loosened[loose], EXACT) ** 2
    covariance += np.repeat(added, 3, axis=1)[..., None] * np.eye(6)
    row = row.copy()
    row[loose] = len(precision) + np.arange(len(loose))
    return row, np.concatenate([precision, np.linalg.inv(covariance)])


def _ties(layout: UnknownLayout) -> tuple[Float, Float]:
    """Compute the share kept and the variance added [K - 1, c] from each knot to the next."""
    elapsed_s = np.diff(layout.knot_t_s)
    kept, variance = (
        np.ones((len(elapsed_s), layout.entries.knot_count)),
        np.ones((len(elapsed_s), layout.entries.knot_count)),
    )
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        if at_knots:
            steps = np.array([process.step(float(span)) for span in elapsed_s])
            kept[:, column : column + 3] = steps[:, :1]
            variance[:, column : column + 3] = steps[:, 1:]
    return kept, variance


def misfit(system: System, state: State) -> tuple[float, Float, Float]:
    """Compute the loss of the pictures, whitened residuals [G, J, 2], and each picture's numbers [G, 10].

    Residuals are NaN, and cost nothing, for joints that were not seen or lie behind the camera.
    """
    residual = np.empty(system.pictures.rays.shape)
    numbers = np.empty((len(residual), kernels.NUMBERS))
    equations = system.equations(state, system.problem.t_s, system.pictures)
    return kernels.misfit(equations, 0, 0.0, residual, numbers), residual, numbers


def loss(system: System, state: State) -> float:
    """Compute the loss of the pictures."""
    equations = system.equations(state, system.problem.t_s, system.pictures)
    pictures, joints, _ = system.pictures.rays.shape
    residual, numbers = np.empty((AT_ONCE, joints, 2)), np.empty((AT_ONCE, kernels.NUMBERS))
    total = 0.0
    for first in range(0, pictures, AT_ONCE):
        rows = min(AT_ONCE, pictures - first)
        total = kernels.misfit(equations, first, total, residual[:rows], numbers[:rows])
    return total


def prior_cost(system: System, state: State) -> float:
    """Compute minus twice the logarithm of the prior, up to a constant."""
    layout, rows = system.layout, system.pictures.white_row
    cost = _body_cost(system, state)
    for first in range(0, len(rows), AT_ONCE):
        precision = system.white_precision[rows[first : first + AT_ONCE]]
        there = np.isfinite(precision[:, 0, 0])
        white = state.white[first : first + AT_ONCE][there]
        cost += float(np.sum((precision[there] @ white[..., None])[..., 0] * white))
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        begins = state.knots[0] if at_knots else state.shared
        cost += np.sum(begins[column : column + 3] ** 2) / process.sigma0**2
    changes = state.knots[1:] - system.tie_kept * state.knots[:-1]
    cost += np.sum(changes**2 / system.tie_variance)
    clocks = layout.entries.clock_column >= 0
    cost += np.sum((state.shared[layout.entries.clock_column[clocks]] / layout.clock_sigma_s[clocks]) ** 2)
    return float(cost)


def _body_cost(system: System, state: State) -> float:
    """Compute the part of `prior_cost` that is by motion and bones, some times at once."""
    problem, cost = system.problem, 0.0
    lengths = state.shared[system.layout.bone_column :]
    for first in range(0, len(problem.t_s), AT_ONCE):
        some = slice(first, first + AT_ONCE + 2)  # an acceleration takes three times
        t_s, position = problem.t_s[some], state.position[some]
        before, after = np.diff(t_s)[:-1], np.diff(t_s)[1:]
        slopes = np.diff(position, axis=0) / np.diff(t_s)[:, None, None]
        acceleration = 2 * np.diff(slopes, axis=0) / (before + after)[:, None, None]
        weight = 0.5 * (before + after) / system.usual_step_s
        inverse = system.inverse_acceleration
        cost += np.einsum("t,tji,jk,tki->", weight, acceleration, inverse, acceleration, optimize=True)
        ends = position[:AT_ONCE, problem.bones]
        missed = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1) - lengths
        cost += np.sum((missed / system.knowledge.bone_sigma_m) ** 2)
    return float(cost) / system.grown(state) ** 2


# --- halves --------------------------------------------------------------------------------------------

Value = TypeVar("Value", bound=np.generic)


@dataclass(frozen=True)
class Half:
    """One half, in the order of its elimination; T times, the last two shared with the other half."""

    system: System
    turned: bool
    meeting: int  # the first of the flight's two times at which the halves meet
    pictures: int  # of the flight, that belong to the first half
    t_s: Float  # [T] decreasing in the turned half
    knot_t_s: Float  # [K] the same
    of_time: Int64  # [T - 1] the knot before each eliminated time, and before the meeting
    starts: Int64  # [T - 1] index of the first picture of each time
    seen: PictureArrays
    ties: Ties

    @property
    def count(self) -> int:
        """Number of eliminated times."""
        return len(self.t_s) - 2

    def of_times(self, values: NDArray[Value]) -> NDArray[Value]:
        """Return this half's part of values [T', ...] at the flight's times."""
        return _turned(values[self.meeting :]) if self.turned else values[: self.meeting + 2]

    def state(self, state: State) -> State:
        """Return this half's part of a state, with all knots."""
        return State(
            self.of_times(state.position),
            _turned(state.knots) if self.turned else state.knots,
            state.shared,
            _turned(state.white[self.pictures :]) if self.turned else state.white[: self.pictures],
        )

    def met(self) -> Int64:
        """Return the place of each unknown alive at the meeting, in the order of the first half."""
        n, c = 3 * self.system.problem.joints, self.system.layout.entries.knot_count
        place = np.arange(2 * n + 2 * c + self.system.layout.shared_count)
        if self.turned:
            joints, knots = place[: 2 * n].reshape(2, n), place[2 * n : 2 * n + 2 * c].reshape(2, c)
            joints[:], knots[:] = joints[::-1].copy(), knots[::-1].copy()
        return place

    def sweep(self, state: State) -> Sweep:
        """Collect the arguments of the sweeps for this half's part of a state."""
        system = self.system
        before, after = np.diff(self.t_s)[:-1], np.diff(self.t_s)[1:]
        return Sweep(
            equations=system.equations(state, self.t_s, self.seen),
            starts=self.starts,
            of_time=self.of_time,
            curvature=np.stack(
                [2 / (before * (before + after)), -2 / (before * after), 2 / (after * (before + after))],
                axis=1,
            ),
            spread=system.usual_step_s / np.abs(0.5 * (before + after)),
            precision=system.inverse_acceleration,
            hold=1 / _ANYWHERE_M**2,
            bones=system.problem.bones,
            bone_sigma=system.knowledge.bone_sigma_m,
            grown=system.grown(state),
            own_times=1 if self.turned else 3,  # those of the meeting are the first's
            knot_t_s=self.knot_t_s,
            ties=self.ties,
        )


def halved(system: System) -> tuple[Half, Half]:
    """Split a flight of at least three times in the middle."""
    return parted(system, (len(system.problem.t_s) - 1) // 2)


def parted(system: System, meeting: int) -> tuple[Half, Half]:
    """Split a flight of T times at any meeting time from 1 to T - 2."""
    pictures = int(np.searchsorted(system.problem.pictures.first, meeting))
    return _half(system, meeting, pictures, turned=False), _half(system, meeting, pictures, turned=True)


def _half(system: System, meeting: int, pictures: int, *, turned: bool) -> Half:
    problem, seen = system.problem, system.pictures
    last_interval = max(len(problem.knot_t_s) - 2, 0)
    met_at = int(system.of_time[min(meeting, len(system.of_time) - 1)])
    before, after, variance = system.tie_kept, np.ones_like(system.tie_kept), system.tie_variance
    if turned:
        order: Callable[[NDArray[Any]], NDArray[Any]] = _turned
        mine, t_s = slice(pictures, None), _turned(problem.t_s[meeting:])
        first = _turned(len(problem.t_s) - 3 - seen.first[mine])
        of_time = last_interval - np.append(system.of_time[meeting:][::-1], met_at)
        before, after, variance = after, before, variance.copy()
        variance[met_at] = np.inf
    else:
        order = np.ascontiguousarray
        mine, t_s = slice(0, pictures), problem.t_s[: meeting + 2]
        first = seen.first[mine]
        of_time = np.append(system.of_time[:meeting], met_at)
    own = PictureArrays(*(order(values[mine]) for values in seen))
    return Half(
        system=system,
        turned=turned,
        meeting=meeting,
        pictures=pictures,
        t_s=t_s,
        knot_t_s=order(problem.knot_t_s),
        of_time=of_time,
        starts=np.searchsorted(first, np.arange(len(t_s) - 1)),
        seen=own._replace(
            first=first,
            interval=of_time[first],
            fraction=1 - own.fraction if turned else own.fraction,
        ),
        ties=Ties(order(before), order(after), order(variance)),
    )


def _turned(values: NDArray[Value]) -> NDArray[Value]:
    """Reverse values into a contiguous array, the layout that everything is compiled for."""
    return np.ascontiguousarray(values[::-1])
