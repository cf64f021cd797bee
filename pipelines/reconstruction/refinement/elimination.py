"""Gauss-Newton steps and posterior covariances, in time and memory linear in the length of the flight.

The normal equations are banded in time with a border. A second difference couples three times, a picture
couples three times and two knots, and the shared unknowns are coupled with everything. So joints and knots
are eliminated in the order of time by one small dense front (Duff & Reid 1983, multifrontal; equal to a
forward filter in information form). A backward pass solves for them and computes the covariances of fronts
(Takahashi's recursion; in time, the smoother of Rauch, Tung & Striebel 1965). Two fronts start from both
ends of the flight and meet in the middle. The solution is exact, without windows. Factors of a long flight do
not fit into memory: the fronts at every `_SEGMENT` times are kept, and a segment is factorised again when the
backward pass reaches it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.refinement import kernels, sweeps
from pipelines.reconstruction.refinement.kernels import State
from pipelines.reconstruction.refinement.sweeps import Factors, Moments
from pipelines.reconstruction.refinement.system import Half, System, halved
from pipelines.session.progress import Halt, side_by_side

Part = TypeVar("Part")
Result = TypeVar("Result")

# Factors of so many times of the skeleton are computed again together.
_SEGMENT = 256
# Where a half's factors take more bytes, segments are factorised twice.
_KEPT_BYTES = 40e6
# Keeping a smaller share of the factors saves no time.
_WORTH = 0.1
# Bone lengths with this precision (1 / m^2) do not move.
_HELD = 1e10


@dataclass
class Eliminated:
    """Equations of a state after the elimination of all unknowns that are not alive where the halves meet."""

    state: State
    swept: tuple[_Swept, _Swept]
    lower: Float  # Cholesky factor of the remaining equations where the halves meet
    gradient: Float  # of the same, in the order of the first half
    log_determinant: float  # half the log determinant of all equations, white errors included


def eliminate(system: System, state: State) -> Eliminated:
    """Linearise at a state and eliminate.

    Raises:
        LinAlgError: the equations are singular.
    """
    swept = _on_both(
        halved(system), lambda half, halt: _sweep(half, half.state(state), halt), system.problem.threads
    )
    lower, gradient = _meet(swept)
    half_log = float(np.log(np.diagonal(lower)).sum()) + swept[0].log_determinant + swept[1].log_determinant
    return Eliminated(state, swept, lower, gradient, half_log)


def step(system: System, at: Eliminated) -> State:
    """Compute the Gauss-Newton step."""
    from scipy.linalg.lapack import dpotrs

    last = dpotrs(at.lower, -at.gradient, lower=1)[0]
    return _solve_back(system, at, last)


def covariances(system: System, at: Eliminated) -> Float:
    """Compute the posterior covariance [T, J, 3, 3] of every joint at every time."""
    shape = (system.problem.joints, 3, 3)
    whole = _last_covariance(at)
    every = np.empty((len(system.problem.t_s), *shape))

    def of_half(swept: _Swept, halt: Halt) -> None:
        covariance = np.zeros((len(swept.half.t_s), *shape))
        _visit_back(swept, swept.state, whole, covariance, 0, halt)
        # The times of the meeting are the first half's.
        if swept.half.turned:
            every[len(every) - len(covariance) + 2 :] = covariance[-3::-1]
        else:
            every[: len(covariance)] = covariance

    _on_both(at.swept, of_half, system.problem.threads)
    return every


def moments(system: System, state: State, at: Eliminated, *, every: int) -> Moments:
    """Compute the moments for the estimate of levels, using the pictures of every k-th time.

    Covariances are those of the eliminated state, squares those of `state`, one step further.
    """
    whole = _last_covariance(at)

    def of_half(swept: _Swept, halt: Halt) -> Moments:
        return _visit_back(swept, swept.half.state(state), whole, np.zeros((0, 1, 3, 3)), every, halt)

    return _added(*_on_both(at.swept, of_half, system.problem.threads))


def shared_covariance(system: System, at: Eliminated) -> Float:
    """Compute the posterior covariance of the unknowns shared by all times."""
    whole = _last_covariance(at)
    begins = len(whole) - system.layout.shared_count
    return whole[begins:, begins:]


def samples(system: System, at: Eliminated, count: int, rng: np.random.Generator) -> Iterator[Float]:
    """Draw samples [T, J, 3] of the joints' errors from the posterior, with mean 0."""
    from scipy.linalg.lapack import dtrtrs

    for _ in range(count):
        last = dtrtrs(at.lower, rng.standard_normal(len(at.lower)), lower=1, trans=1)[0]
        yield _solve_back(system, at, last, rng).position


# --- forwards ------------------------------------------------------------------------------------------


@dataclass
class _Front:
    """Normal equations of the live unknowns: joints at three times, knots around them, shared unknowns."""

    matrix: Float  # [N, N] lower triangle
    gradient: Float  # [N]
    interval: int

    def packed(self) -> _Packed:
        return _Packed(self.matrix[np.tril_indices(len(self.matrix))], self.gradient.copy(), self.interval)


@dataclass
class _Packed:
    """Front in half the memory."""

    lower: Float  # [N (N + 1) / 2]
    gradient: Float  # [N]
    interval: int

    def unpacked(self) -> _Front:
        size = len(self.gradient)
        matrix = np.zeros((size, size))
        matrix[np.tril_indices(size)] = self.lower
        return _Front(matrix, self.gradient.copy(), self.interval)


@dataclass
class _Swept:
    """Half of the flight after its elimination."""

    half: Half
    state: State  # its part
    fronts: list[_Packed]  # at the start of every segment, to recompute its factors
    factors: dict[int, Factors]  # of the segments whose factors are kept
    rest: _Front
    log_determinant: float


def _segments(half: Half) -> list[tuple[int, int]]:
    """List the segments [first, last) of a half; one empty segment without times, for its knots."""
    return [(first, min(first + _SEGMENT, half.count)) for first in range(0, max(half.count, 1), _SEGMENT)]


def _on_both(
    both: tuple[Part, Part], work: Callable[[Part, Halt], Result], threads: int
) -> tuple[Result, Result]:
    """Run the same work on both halves, in parallel if two threads are allowed."""
    halt = Halt()
    first, second = side_by_side(lambda part: work(part, halt), both, workers=min(threads, 2), halt=halt)
    return first, second


def _sweep(half: Half, state: State, halt: Halt) -> _Swept:
    system = half.system
    front = _begin(half, state)
    fronts, kept = [], {}
    log_determinant = 0.0
    bytes_per_time = 8 * 3 * system.problem.joints * system.size
    kept_times = _KEPT_BYTES / bytes_per_time
    if kept_times < _WORTH * half.count:
        kept_times = 0.0
    for index, (first, last) in enumerate(_segments(half)):
        halt.check()
        fronts.append(front.packed())
        factors, part = _eliminate(half, state, front, first, last)
        log_determinant += part
        if last < kept_times or last == half.count:
            kept[index] = factors
    return _Swept(half, state, fronts, kept, front, log_determinant)


def _begin(half: Half, state: State) -> _Front:
    """Create the first front: the first knots, tied; in the first half also the priors at the start."""
    system = half.system
    front = _Front(np.zeros((system.size, system.size)), np.zeros(system.size), 0)
    if not half.turned:
        _add_priors(system, state, front)
    if system.layout.entries.knot_count:
        sweeps.begin(
            front.matrix,
            front.gradient,
            3 * system.problem.joints,
            system.layout.entries.knot_count,
            state.knots,
            half.ties,
        )
    return front


def _add_priors(system: System, state: State, front: _Front) -> None:
    """Add the priors of slow errors at the first knot and of shared unknowns."""
    layout, n3 = system.layout, 9 * system.problem.joints
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        value = state.knots[0] if at_knots else state.shared
        offset = n3 if at_knots else n3 + 2 * layout.entries.knot_count
        for i in range(column, column + 3):
            front.matrix[offset + i, offset + i] += 1 / process.sigma0**2
            front.gradient[offset + i] += value[i] / process.sigma0**2
    for column, sigma in zip(layout.entries.clock_column, layout.clock_sigma_s, strict=True):
        if column >= 0:
            place = n3 + 2 * layout.entries.knot_count + column
            front.matrix[place, place] += 1 / sigma**2
            front.gradient[place] += state.shared[column] / sigma**2
    for place in range(n3 + 2 * layout.entries.knot_count + layout.bone_column, system.size):
        # A length without data keeps its value.
        front.matrix[place, place] += _HELD if system.held else 1e-6


def _eliminate(half: Half, state: State, front: _Front, first: int, last: int) -> tuple[Factors, float]:
    """Eliminate the knots and joints of times from `first` to before `last`; change the front in place."""
    system = half.system
    n, c = 3 * system.problem.joints, system.layout.entries.knot_count
    times, size = last - first, system.size
    knots = int(half.of_time[last]) - front.interval if c else 0
    factors = Factors(
        front.interval,
        np.zeros((times, n, n)),
        np.zeros((times, size - n, n)),
        np.zeros((times, n)),
        np.zeros((knots, c, c)),
        np.zeros((knots, size - n - c, c)),
        np.zeros((knots, c)),
    )
    try:
        front.interval, log_determinant = sweeps.forwards(
            first, last, half.sweep(state), front.matrix, front.gradient, front.interval, factors
        )
    except np.linalg.LinAlgError as error:
        raise np.linalg.LinAlgError("the equations of the refinement are singular") from error
    return factors, log_determinant


# --- where the halves meet -------------------------------------------------------------------------------


def _meet(swept: tuple[_Swept, _Swept]) -> tuple[Float, Float]:
    """Compute the Cholesky factor and gradient of the unknowns alive in both halves, in the first's order."""
    from scipy.linalg.lapack import dpotrf

    system = swept[0].half.system
    n = 3 * system.problem.joints
    alive = np.concatenate([np.arange(2 * n), np.arange(3 * n, system.size)])
    matrix, gradient = np.zeros((len(alive), len(alive))), np.zeros(len(alive))
    for each in swept:
        place = each.half.met()
        lower = np.tril(each.rest.matrix[np.ix_(alive, alive)])
        matrix[np.ix_(place, place)] += lower + np.tril(lower, -1).T
        gradient[place] += each.rest.gradient[alive]
    factor: Float
    factor, failed = dpotrf(matrix, lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("the equations of what all times share are singular")
    return factor, gradient


def _last_covariance(at: Eliminated) -> Float:
    """Compute the covariance of the unknowns alive where the halves meet, in the order of the first half."""
    from scipy.linalg.lapack import dpotri

    inverse, _ = dpotri(at.lower, lower=1)
    return np.ascontiguousarray(np.tril(inverse) + np.tril(inverse, -1).T)


# --- backwards -----------------------------------------------------------------------------------------


def _factors_backwards(swept: _Swept, halt: Halt) -> Iterator[tuple[int, int, Factors]]:
    segments = _segments(swept.half)
    for index in range(len(segments) - 1, -1, -1):
        halt.check()
        factors = swept.factors.get(index)
        if factors is None:
            factors, _ = _eliminate(swept.half, swept.state, swept.fronts[index].unpacked(), *segments[index])
        yield *segments[index], factors


def _solve_back(
    system: System, at: Eliminated, last_solution: Float, rng: np.random.Generator | None = None
) -> State:
    """Solve for the unknowns of all times from those of the meeting; with `rng`, draw a sample about 0."""
    layout, state = system.layout, at.state
    # Draws come from one source, so in order.
    threads = 1 if rng is not None else system.problem.threads
    (position, knots), (turned_position, turned_knots) = _on_both(
        at.swept, lambda swept, halt: _follow_back(swept, last_solution, rng, halt), threads
    )
    position = np.concatenate([position, turned_position[-3::-1]])
    first_of_second = at.swept[0].rest.interval + 2
    knots[first_of_second:] = turned_knots[::-1][first_of_second:]
    shared = np.ascontiguousarray(last_solution[len(last_solution) - layout.shared_count :])
    moved = State(position.reshape(state.position.shape), knots, shared, np.zeros_like(state.white))
    if rng is None:
        kernels.whiten(system.equations(state, system.problem.t_s, system.pictures), moved)
    return moved


def _follow_back(
    swept: _Swept, last_solution: Float, rng: np.random.Generator | None, halt: Halt
) -> tuple[Float, Float]:
    """Solve for the joints [T, n] of a half and for the knots [K, c]; knots of the other half stay 0."""
    half, state = swept.half, swept.state
    n, count = 3 * half.system.problem.joints, half.system.layout.entries.knot_count
    alive = last_solution[half.met()]
    position, knots = np.zeros((len(half.t_s), n)), np.zeros_like(state.knots)
    position[-2:] = alive[: 2 * n].reshape(2, n)
    shared = np.ascontiguousarray(alive[2 * n + 2 * count :])
    interval = swept.rest.interval
    if count:
        knots[interval : interval + 2] = alive[2 * n : 2 * n + 2 * count].reshape(2, count)
    for first, last, factors in _factors_backwards(swept, halt):
        used = factors
        if rng is not None:
            used = factors._replace(
                solved=rng.standard_normal(factors.solved.shape),
                knot_solved=rng.standard_normal(factors.knot_solved.shape),
            )
        interval = sweeps.backwards(first, last, half.of_time, interval, used, position, knots, shared)
    return position, knots


def _visit_back(
    swept: _Swept, state: State, last_covariance: Float, covariance: Float, every: int, halt: Halt
) -> Moments:
    """Compute the moments of a half, linearised at `state`; fill `covariance` unless it is empty."""
    half = swept.half
    problem, layout, sweep = half.system.problem, half.system.layout, half.sweep(state)
    joints, knot_count, place = problem.joints, layout.entries.knot_count, half.met()
    others = np.ascontiguousarray(last_covariance[np.ix_(place, place)])
    found = Moments(
        np.zeros((2, joints, joints)),
        np.zeros(len(problem.bones)),
        np.zeros((joints, 2)),
        np.zeros((2, 3)),
        np.zeros((knot_count, 3)),
        np.zeros((0 if half.turned else knot_count + layout.shared_count, 2)),
        half.count,
    )
    interval = swept.rest.interval
    if knot_count and every and not half.turned:
        sweeps.last_walk(others, 3 * joints, knot_count, state.knots, half.knot_t_s, interval, found.walked)
    for first, last, factors in _factors_backwards(swept, halt):
        others, interval = sweeps.visit(
            first, last, sweep, others, interval, factors, every, covariance, found
        )
    return found


def _added(first: Moments, second: Moments) -> Moments:
    """Add the moments of both halves; `starting` is the first half's."""
    sums = {
        name: getattr(first, name) + getattr(second, name) for name in Moments._fields if name != "starting"
    }
    return first._replace(**sums)
