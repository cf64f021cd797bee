"""Gauss-Newton steps and posterior covariances, in time and memory linear in the length of the flight.

The normal equations are banded in time with a border: a second difference ties three times together, a
picture three times and two knots, and the shared unknowns touch everything. So joints and knots are
eliminated in the order of time by one small dense front (Duff & Reid 1983, multifrontal; the same as a
forward filter in information form), and found again backwards, with the covariances of every front on the
way (Takahashi's recursion; in time, the smoother of Rauch, Tung & Striebel 1965). Nothing is approximated by
windows. Factors of a long flight do not fit into memory: the fronts at every `_SEGMENT` times are kept, and
a segment is factorised again when the way back reaches it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.reconstruction.refinement import kernels, sweeps
from pipelines.reconstruction.refinement.problem import EXACT, Knowledge, Layout, PoseErrors, Problem, State

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Their arguments are assembled from tuples, whose lengths types do not know.
_forwards: Callable[..., tuple[int, float]] = sweeps.forwards
_visit: Callable[..., tuple[Float, int]] = sweeps.visit
_whiten: Callable[..., None] = kernels.whiten
_misfit: Callable[..., float] = kernels.misfit

_SEGMENT = 256  # times of the skeleton
_KEPT_BYTES = 600e6  # of factors, before segments are factorised twice
_HELD = 1e10  # 1 / m^2, of a bone length
_ANYWHERE_M = 100.0  # a joint that nobody saw lies within this of where the search began


@dataclass(frozen=True)
class System:
    """A problem with its prior, linearised at will."""

    problem: Problem
    knowledge: Knowledge
    layout: Layout
    bound2: float  # of the robust loss
    held: bool = False  # bone lengths stay as they are
    sharpness: Float = field(init=False)
    white_row: Int64 = field(init=False)  # [G] where the next has the picture's
    white_precision: Float = field(init=False)  # [., 6, 6] of each camera, then of logged poses; inf without
    inverse_acceleration: Float = field(init=False)  # [J, J]
    of_time: Int64 = field(init=False)  # [T - 2]
    fraction: Float = field(init=False)  # [G]
    starts: Int64 = field(init=False)  # [T - 1] where the pictures of each time begin
    usual_step_s: float = field(init=False)
    curvature: Float = field(init=False)  # [T - 2, 3] weights that make an acceleration of three positions
    spread: Float = field(init=False)  # [T - 2] its variance against the usual
    tie_kept: Float = field(init=False)  # [K - 1, c] share of a slow error that is left at the next knot
    tie_variance: Float = field(init=False)  # [K - 1, c] what comes in addition

    def __post_init__(self) -> None:
        """Derive what every linearisation needs."""
        problem, known = self.problem, self.knowledge
        of_time, fraction = problem.intervals()
        white_row, white_precision = _white_errors(problem, known.poses)
        before, after = np.diff(problem.t_s)[:-1], np.diff(problem.t_s)[1:]
        usual = float(np.median(np.diff(problem.t_s)))
        kept, variance = _ties(self.layout)
        derived = {
            "sharpness": problem.pictures.sharpness / (known.pixel_scale * np.sqrt(known.memory)),
            "white_row": white_row,
            "white_precision": white_precision,
            "inverse_acceleration": np.linalg.inv(known.acceleration),
            "of_time": of_time,
            "fraction": fraction,
            "starts": np.searchsorted(problem.pictures.first, np.arange(len(problem.t_s) - 1)),
            "usual_step_s": usual,
            "curvature": np.stack(
                [2 / (before * (before + after)), -2 / (before * after), 2 / (after * (before + after))],
                axis=1,
            ),
            "spread": usual / (0.5 * (before + after)),
            "tie_kept": kept,
            "tie_variance": variance,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Of a front."""
        return 9 * self.problem.joints + 2 * self.layout.knot_count + self.layout.shared_count

    def picture_arguments(self) -> tuple[Any, ...]:
        """What the kernels take between a picture's place in time and the robust bound."""
        pictures = self.problem.pictures
        return (
            pictures.xy,
            self.sharpness,
            pictures.position,
            pictures.rotation,
            pictures.speed,
            pictures.turn,
            pictures.trust,
        )

    def entries(self) -> tuple[Any, ...]:
        """What the kernels need to know of the layout."""
        layout = self.layout
        return (
            layout.entry_start,
            layout.entry_number,
            layout.entry_knot,
            layout.entry_column,
            layout.clock_column,
        )

    def grown(self, state: State) -> float:
        """How much larger the body is than the one for which the prior of motion and bones holds."""
        lengths = state.shared[self.layout.bone_column :]
        return float(lengths.mean() / self.knowledge.size_m) if len(lengths) else 1.0

    def arguments(self, state: State) -> tuple[Any, ...]:
        """What the sweeps need to know of the problem and of where it is linearised."""
        pictures = self.problem.pictures
        return (
            self.problem.t_s,
            state.position,
            state.knots,
            state.shared,
            state.white,
            self.starts,
            pictures.camera,
            pictures.when_s,
            self.fraction,
            self.of_time,
            *self.picture_arguments(),
            self.bound2,
            self.white_row,
            self.white_precision,
            *self.entries(),
            self.layout.knot_count,
            self.curvature,
            self.spread,
        )


def _white_errors(problem: Problem, poses: Sequence[PoseErrors]) -> tuple[Int64, Float]:
    """Where the inverse covariance of each picture's white error stands [G], and all of them [., 6, 6]."""
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


def _ties(layout: Layout) -> tuple[Float, Float]:
    """How every unknown of a knot [K - 1, c] goes on to the next."""
    elapsed_s = np.diff(layout.knot_t_s)
    kept, variance = (
        np.ones((len(elapsed_s), layout.knot_count)),
        np.ones((len(elapsed_s), layout.knot_count)),
    )
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        if at_knots:
            steps = np.array([process.step(float(span)) for span in elapsed_s])
            kept[:, column : column + 3] = steps[:, :1]
            variance[:, column : column + 3] = steps[:, 1:]
    return kept, variance


@dataclass(frozen=True)
class Moments:
    """Posterior mean squares of what the levels are the deviations of, and posterior variances."""

    acceleration: Float  # [2, J, J] sums of mean squares and of variances over the times
    bones: Float  # [B] sums of mean squares
    image: Float  # [J, 2] weighted squares of residuals, and how many of them the fit leaves
    white: Float  # [2, 4] of position, rotation: sum of mean squares, count, sum of told shares and squares
    walked: Float  # [c, 4] of the changes between knots per s: mean squares, count, variances and squares
    starting: Float  # [c + shared, 2] mean squares and variances at the first time
    times: int


@dataclass
class Eliminated:
    """A state's equations after the elimination of all that does not live to the end."""

    state: State
    kept: _Kept
    rest: _Front
    lower: Float  # Cholesky factor of what is left at the end
    log_determinant: float  # half of it, of all equations, white errors too


def eliminate(system: System, state: State) -> Eliminated:
    """Linearise at a state and eliminate.

    Raises:
        LinAlgError: the equations are singular.
    """
    kept, rest, half = _eliminate_all(system, state)
    lower = _last_factor(system, rest)
    return Eliminated(state, kept, rest, lower, half + float(np.log(np.diagonal(lower)).sum()))


def step(system: System, at: Eliminated) -> State:
    """The Gauss-Newton step."""
    from scipy.linalg.lapack import dpotrs

    last = dpotrs(at.lower, -at.rest.gradient[_alive(system)], lower=1)[0]
    return _solve_back(system, at, last)


def covariances(system: System, at: Eliminated) -> Float:
    """Posterior covariance [T, J, 3, 3] of every joint at every time."""
    joints = system.problem.joints
    covariance = np.zeros((len(system.problem.t_s), joints, 3, 3))
    _visit_back(system, at.state, at, covariance, 0)
    return covariance


def moments(system: System, state: State, at: Eliminated, *, every: int) -> Moments:
    """What the levels are estimated from, pictures from one in so many times.

    Covariances are those of the state that was eliminated, squares those of `state`, a step further.
    """
    return _visit_back(system, state, at, np.zeros((0, 1, 3, 3)), every)


def shared_covariance(system: System, at: Eliminated) -> Float:
    """Posterior covariance of what all times share."""
    whole = _last_covariance(at)
    begins = len(whole) - system.layout.shared_count
    return whole[begins:, begins:]


def samples(system: System, at: Eliminated, count: int, rng: np.random.Generator) -> Iterator[Float]:
    """Draws [T, J, 3] from the posterior of the joints about 0: the errors that it expects."""
    from scipy.linalg.lapack import dtrtrs

    for _ in range(count):
        last = dtrtrs(at.lower, rng.standard_normal(len(at.lower)), lower=1, trans=1)[0]
        yield _solve_back(system, at, last, rng).position


def misfit(system: System, state: State) -> tuple[float, Float, Float]:
    """Loss of the pictures, whitened residuals [G, J, 2], NaN unseen, the ten numbers of each picture."""
    pictures = system.problem.pictures
    residual = np.empty(pictures.xy.shape)
    numbers = np.empty((len(pictures.first), kernels.NUMBERS))
    total: float = _misfit(
        system.problem.t_s,
        state.position,
        state.knots,
        state.shared,
        state.white,
        pictures.first,
        pictures.camera,
        pictures.when_s,
        system.fraction,
        system.of_time[pictures.first],
        *system.picture_arguments(),
        system.bound2,
        *system.entries(),
        residual,
        numbers,
    )
    return total, residual, numbers


def prior_cost(system: System, state: State) -> float:
    """Minus twice the logarithm of the prior, up to a constant."""
    problem, known, layout = system.problem, system.knowledge, system.layout
    before, after = np.diff(problem.t_s)[:-1], np.diff(problem.t_s)[1:]
    slopes = np.diff(state.position, axis=0) / np.diff(problem.t_s)[:, None, None]
    acceleration = 2 * np.diff(slopes, axis=0) / (before + after)[:, None, None]
    weight = 0.5 * (before + after) / system.usual_step_s
    cost = np.einsum(
        "t,tji,jk,tki->", weight, acceleration, system.inverse_acceleration, acceleration, optimize=True
    )
    lengths = state.shared[layout.bone_column :]
    cost += np.sum(((_bone_lengths(problem, state.position) - lengths) / known.bone_sigma_m) ** 2)
    cost /= system.grown(state) ** 2
    precision = system.white_precision[system.white_row]
    there = np.isfinite(precision[:, 0, 0])
    white = state.white[there]
    cost += np.sum((precision[there] @ white[..., None])[..., 0] * white)
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        begins = state.knots[0] if at_knots else state.shared
        cost += np.sum(begins[column : column + 3] ** 2) / process.sigma0**2
    changes = state.knots[1:] - system.tie_kept * state.knots[:-1]
    cost += np.sum(changes**2 / system.tie_variance)
    clocks = layout.clock_column >= 0
    cost += np.sum((state.shared[layout.clock_column[clocks]] / layout.clock_sigma_s[clocks]) ** 2)
    return float(cost)


def _bone_lengths(problem: Problem, position: Float) -> Float:
    """[T, B] m."""
    ends = position[:, problem.bones]
    lengths: Float = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    return lengths


# --- forwards ------------------------------------------------------------------------------------------


@dataclass
class _Front:
    """Normal equations of what is alive: joints at three times, knots around them, what all share."""

    matrix: Float  # [N, N] lower triangle
    gradient: Float  # [N]
    interval: int

    def copy(self) -> _Front:
        return _Front(self.matrix.copy(), self.gradient.copy(), self.interval)


@dataclass
class _Factors:
    """What a segment's elimination leaves; see `sweeps.forwards`."""

    first_interval: int
    inverse: Float
    across: Float
    solved: Float
    knot_inverse: Float
    knot_across: Float
    knot_solved: Float


@dataclass
class _Kept:
    """Factors of segments, or the fronts from which they are made again."""

    fronts: list[_Front]
    factors: dict[int, _Factors]


def _segments(system: System) -> list[tuple[int, int]]:
    last = len(system.problem.t_s) - 2
    return [(first, min(first + _SEGMENT, last)) for first in range(0, last, _SEGMENT)]


def _eliminate_all(system: System, state: State) -> tuple[_Kept, _Front, float]:
    front = _begin(system, state)
    kept = _Kept([], {})
    log_determinant = 0.0
    bytes_per_time = 8 * 3 * system.problem.joints * system.size
    for index, (first, last) in enumerate(_segments(system)):
        kept.fronts.append(front.copy())
        factors, part = _eliminate(system, state, front, first, last)
        log_determinant += part
        if bytes_per_time * last < _KEPT_BYTES or last == len(system.problem.t_s) - 2:
            kept.factors[index] = factors
    return kept, front, log_determinant


def _begin(system: System, state: State) -> _Front:
    """The priors of what is there from the start."""
    layout, n3 = system.layout, 9 * system.problem.joints
    front = _Front(np.zeros((system.size, system.size)), np.zeros(system.size), 0)
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        value = state.knots[0] if at_knots else state.shared
        offset = n3 if at_knots else n3 + 2 * layout.knot_count
        for i in range(column, column + 3):
            front.matrix[offset + i, offset + i] += 1 / process.sigma0**2
            front.gradient[offset + i] += value[i] / process.sigma0**2
    for column, sigma in zip(layout.clock_column, layout.clock_sigma_s, strict=True):
        if column >= 0:
            place = n3 + 2 * layout.knot_count + column
            front.matrix[place, place] += 1 / sigma**2
            front.gradient[place] += state.shared[column] / sigma**2
    for place in range(n3 + 2 * layout.knot_count + layout.bone_column, system.size):
        # A length that nothing speaks of stays where it is.
        front.matrix[place, place] += _HELD if system.held else 1e-6
    if layout.knot_count:
        sweeps.begin(
            front.matrix,
            front.gradient,
            3 * system.problem.joints,
            layout.knot_count,
            state.knots,
            system.tie_kept,
            system.tie_variance,
        )
    return front


def _eliminate(system: System, state: State, front: _Front, first: int, last: int) -> tuple[_Factors, float]:
    """Eliminate the knots and joints of some times; the front is changed in place."""
    n, c = 3 * system.problem.joints, system.layout.knot_count
    times, size = last - first, system.size
    knots = int(system.of_time[last - 1]) - front.interval if c else 0
    factors = _Factors(
        front.interval,
        np.zeros((times, n, n)),
        np.zeros((times, size - n, n)),
        np.zeros((times, n)),
        np.zeros((knots, c, c)),
        np.zeros((knots, size - n - c, c)),
        np.zeros((knots, c)),
    )
    grown = system.grown(state)
    try:
        front.interval, log_determinant = _forwards(
            first,
            last,
            *system.arguments(state),
            system.inverse_acceleration,
            1 / _ANYWHERE_M**2,
            system.problem.bones,
            system.knowledge.bone_sigma_m,
            grown,
            system.tie_kept,
            system.tie_variance,
            front.matrix,
            front.gradient,
            front.interval,
            factors.inverse,
            factors.across,
            factors.solved,
            factors.knot_inverse,
            factors.knot_across,
            factors.knot_solved,
        )
    except np.linalg.LinAlgError as error:
        raise np.linalg.LinAlgError("the equations of the refinement are singular") from error
    return factors, log_determinant


# --- backwards -----------------------------------------------------------------------------------------


def _alive(system: System) -> Int64:
    """What of a front is left at the end: two times, two knots, what all share."""
    n = 3 * system.problem.joints
    return np.concatenate([np.arange(2 * n), np.arange(3 * n, system.size)])


def _last_factor(system: System, rest: _Front) -> Float:
    from scipy.linalg.lapack import dpotrf

    alive = _alive(system)
    lower: Float
    lower, failed = dpotrf(rest.matrix[np.ix_(alive, alive)], lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("the equations of what all times share are singular")
    return lower


def _last_covariance(at: Eliminated) -> Float:
    from scipy.linalg.lapack import dpotri

    inverse, _ = dpotri(at.lower, lower=1)
    return np.ascontiguousarray(np.tril(inverse) + np.tril(inverse, -1).T)


def _factors_backwards(system: System, at: Eliminated) -> Iterator[tuple[int, int, _Factors]]:
    segments = _segments(system)
    for index in range(len(segments) - 1, -1, -1):
        factors = at.kept.factors.get(index)
        if factors is None:
            factors, _ = _eliminate(system, at.state, at.kept.fronts[index].copy(), *segments[index])
        yield *segments[index], factors


def _solve_back(
    system: System, at: Eliminated, last_solution: Float, rng: np.random.Generator | None = None
) -> State:
    """The unknowns of all times from those of the last; a draw about 0 where `rng` says so."""
    problem, layout, state = system.problem, system.layout, at.state
    n, count = 3 * problem.joints, layout.knot_count
    times = len(problem.t_s)
    position, knots = np.zeros((times, n)), np.zeros_like(state.knots)
    position[-2:] = last_solution[: 2 * n].reshape(2, n)
    shared = np.ascontiguousarray(last_solution[2 * n + 2 * count :])
    interval = at.rest.interval
    if count:
        knots[interval : interval + 2] = last_solution[2 * n : 2 * n + 2 * count].reshape(2, count)
    for first, last, factors in _factors_backwards(system, at):
        solved, knot_solved = factors.solved, factors.knot_solved
        if rng is not None:
            solved, knot_solved = rng.standard_normal(solved.shape), rng.standard_normal(knot_solved.shape)
        interval = sweeps.backwards(
            first,
            last,
            system.of_time,
            interval,
            factors.first_interval,
            factors.inverse,
            factors.across,
            solved,
            factors.knot_inverse,
            factors.knot_across,
            knot_solved,
            position,
            knots,
            shared,
        )
    moved = State(position.reshape(state.position.shape), knots, shared, np.zeros_like(state.white))
    if rng is not None:
        return moved
    pictures = problem.pictures
    _whiten(
        problem.t_s,
        state.position,
        state.knots,
        state.shared,
        state.white,
        moved.position,
        moved.knots,
        moved.shared,
        pictures.first,
        pictures.camera,
        pictures.when_s,
        system.fraction,
        system.of_time[pictures.first],
        *system.picture_arguments(),
        system.bound2,
        system.white_row,
        system.white_precision,
        *system.entries(),
        moved.white,
    )
    return moved


def _visit_back(system: System, state: State, at: Eliminated, covariance: Float, every: int) -> Moments:
    problem, layout = system.problem, system.layout
    joints = problem.joints
    others = _last_covariance(at)
    found = Moments(
        np.zeros((2, joints, joints)),
        np.zeros(len(problem.bones)),
        np.zeros((joints, 2)),
        np.zeros((2, 4)),
        np.zeros((layout.knot_count, 4)),
        np.zeros((layout.knot_count + layout.shared_count, 2)),
        len(problem.t_s) - 2,
    )
    interval = at.rest.interval
    if layout.knot_count and every:
        sweeps.last_walk(
            others, 3 * joints, layout.knot_count, state.knots, layout.knot_t_s, interval, found.walked
        )
    for first, last, factors in _factors_backwards(system, at):
        others, interval = _visit(
            first,
            last,
            *system.arguments(state),
            problem.bones,
            layout.knot_t_s,
            others,
            interval,
            factors.first_interval,
            factors.inverse,
            factors.across,
            factors.knot_inverse,
            factors.knot_across,
            every,
            covariance,
            found.acceleration,
            found.bones,
            found.image,
            found.white,
            found.walked,
            found.starting,
        )
    return found
