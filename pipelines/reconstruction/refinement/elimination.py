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

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.reconstruction.refinement import kernels
from pipelines.reconstruction.refinement.problem import Knowledge, Layout, Problem, State

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Their arguments are assembled from tuples, whose lengths types do not know.
_assemble: Callable[..., None] = kernels.assemble
_whiten: Callable[..., None] = kernels.whiten
_misfit: Callable[..., float] = kernels.misfit

_SEGMENT = 256  # times of the skeleton
_KEPT_BYTES = 600e6  # of factors, before segments are factorised twice
_ANYWHERE_M = 100.0  # a joint that nobody saw lies within this of where the search began


@dataclass
class Factor:
    """One elimination: its unknowns x follow the rest of the front z as x = L^-T (y - W' z)."""

    time: int  # of the joints that were eliminated, or the knot
    knot: bool
    lower: Float  # [n, n]
    across: Float  # [m, n], W'
    solved: Float  # [n], y


@dataclass
class _Front:
    """Normal equations of what is alive: joints at three times, knots around them, what all share."""

    matrix: Float  # [N, N] Fortran order, lower triangle
    gradient: Float  # [N]
    interval: int

    def copy(self) -> _Front:
        return _Front(self.matrix.copy(order="F"), self.gradient.copy(), self.interval)


@dataclass(frozen=True)
class Visit:
    """What the way back sees of one time: the covariance of its whole front, and where things stand."""

    time: int
    covariance: Float  # [N, N]: three times, knot before, knot after, shared
    interval: int


@dataclass(frozen=True)
class System:
    """A problem with its prior, linearised at will."""

    problem: Problem
    knowledge: Knowledge
    layout: Layout
    bound2: float  # of the robust loss
    sharpness: Float = field(init=False)
    white_precision: Float = field(init=False)  # [C, 6], inf without
    inverse_acceleration: Float = field(init=False)  # [J, J]
    of_time: Int64 = field(init=False)  # [T - 2]
    fraction: Float = field(init=False)  # [G]
    starts: Int64 = field(init=False)  # [T - 1] where the pictures of each time begin
    usual_step_s: float = field(init=False)

    def __post_init__(self) -> None:
        """Derive what every linearisation needs."""
        problem, known = self.problem, self.knowledge
        of_time, fraction = problem.intervals()
        knot_s = float(problem.knot_t_s[1] - problem.knot_t_s[0])
        white = np.array([np.repeat(errors.white_with_stray(knot_s), 3) for errors in known.poses])
        derived = {
            "sharpness": problem.pictures.sharpness / known.pixel_scale,
            "white_precision": np.where(white > 0, 1 / np.where(white > 0, white, 1.0) ** 2, np.inf),
            "inverse_acceleration": np.linalg.inv(known.acceleration),
            "of_time": of_time,
            "fraction": fraction,
            "starts": np.searchsorted(problem.pictures.first, np.arange(len(problem.t_s) - 1)),
            "usual_step_s": float(np.median(np.diff(problem.t_s))),
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

    def curvature(self, time: int) -> tuple[Float, float]:
        """Weights [3] that make an acceleration of three positions, and its variance against the usual."""
        before, after = np.diff(self.problem.t_s[time : time + 3])
        weights = 2 / (before + after) * np.array([1 / before, -1 / before - 1 / after, 1 / after])
        return weights, self.usual_step_s / (0.5 * (before + after))


def step(system: System, state: State) -> tuple[State, float]:
    """The Gauss-Newton step from a state, and half the logarithm of the determinant of its equations."""
    factors, rest, log_determinant = _eliminate_all(system, state)
    return _solve_back(system, state, factors, rest), log_determinant


def posterior(
    system: System,
    state: State,
    see_time: Callable[[Visit], None],
    see_knots: Callable[[int, Float], None] | None = None,
) -> None:
    """Visit the posterior covariances of every front, from the last time to the first.

    Args:
        system: the problem and its prior.
        state: where it is linearised.
        see_time: called with every time but the last two, which the one before them holds.
        see_knots: called with every interval between two knots, and their joint covariance.
    """
    kept, rest, _ = _eliminate_all(system, state)
    _visit_back(system, state, kept, rest, see_time, see_knots or (lambda _interval, _covariance: None))


def misfit(system: System, state: State) -> tuple[float, Float, Float]:
    """Loss of the pictures, whitened squared residuals [G, J], the ten numbers of each picture [G, 10]."""
    pictures = system.problem.pictures
    squared = np.empty(pictures.xy.shape[:2])
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
        squared,
        numbers,
    )
    return total, squared, numbers


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
    finite = np.isfinite(system.white_precision[:, 0])
    of_picture = finite[problem.pictures.camera]
    precision = system.white_precision[problem.pictures.camera[of_picture]]
    cost += np.sum(precision * state.white[of_picture] ** 2)
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        value = state.knots[:, column : column + 3] if at_knots else state.shared[None, column : column + 3]
        cost += np.sum(value[0] ** 2) / process.sigma0**2
        for k in range(len(value) - 1):
            kept, variance = process.step(layout.knot_t_s[k + 1] - layout.knot_t_s[k])
            cost += np.sum((value[k + 1] - kept * value[k]) ** 2) / variance
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
class _Kept:
    """Factors of segments: all of them, or the fronts from which they are made again."""

    fronts: list[_Front]
    factors: dict[int, list[Factor]]


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
        factors = list(_eliminate(system, state, front, first, last))
        log_determinant += sum(float(np.log(np.diagonal(factor.lower)).sum()) for factor in factors)
        if bytes_per_time * last < _KEPT_BYTES or last == len(system.problem.t_s) - 2:
            kept.factors[index] = factors
    return kept, front, log_determinant


def _begin(system: System, state: State) -> _Front:
    """The priors of what is there from the start."""
    layout, n3 = system.layout, 9 * system.problem.joints
    front = _Front(np.zeros((system.size, system.size), order="F"), np.zeros(system.size), 0)
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
        front.matrix[place, place] += 1e-6  # a length that nothing speaks of stays where it is
    _tie_knots(system, state, front)
    return front


def _tie_knots(system: System, state: State, front: _Front) -> None:
    """The random walk from the knot before to the knot after."""
    layout, before = system.layout, 9 * system.problem.joints
    if layout.knot_count == 0:
        return
    after, k = before + layout.knot_count, front.interval
    elapsed_s = layout.knot_t_s[k + 1] - layout.knot_t_s[k]
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        if not at_knots:
            continue
        kept, variance = process.step(elapsed_s)
        for i in range(column, column + 3):
            change = state.knots[k + 1, i] - kept * state.knots[k, i]
            front.matrix[before + i, before + i] += kept**2 / variance
            front.matrix[after + i, after + i] += 1 / variance
            front.matrix[after + i, before + i] -= kept / variance
            front.gradient[before + i] -= kept * change / variance
            front.gradient[after + i] += change / variance


def _eliminate(system: System, state: State, front: _Front, first: int, last: int) -> Iterator[Factor]:
    """Eliminate the knots and joints of some times; the front is changed in place."""
    for time in range(first, last):
        while system.layout.knot_count and front.interval < system.of_time[time]:
            yield _eliminate_knot(system, state, front)
        _add_time(system, state, front, time)
        yield _eliminate_joints(system, front, time)


def _add_time(system: System, state: State, front: _Front, time: int) -> None:
    problem, layout, pictures = system.problem, system.layout, system.problem.pictures
    _assemble(
        system.starts[time],
        system.starts[time + 1],
        time,
        problem.t_s,
        state.position,
        state.knots,
        state.shared,
        state.white,
        pictures.camera,
        pictures.when_s,
        system.fraction,
        front.interval,
        *system.picture_arguments(),
        system.bound2,
        system.white_precision,
        *system.entries(),
        layout.knot_count,
        front.matrix,
        front.gradient,
    )
    weights, spread = system.curvature(time)
    lengths = state.shared[layout.bone_column :]
    grown = system.grown(state)
    length_offset = 9 * problem.joints + 2 * layout.knot_count + layout.bone_column
    # All bones of a time at once with the first of its three; the last two times have their own.
    times = range(1) if time < len(problem.t_s) - 3 else range(3)
    kernels.add_motion(
        state.position[time : time + 3],
        weights,
        system.inverse_acceleration / (spread * grown**2),
        1 / _ANYWHERE_M**2,
        lengths,
        length_offset,
        front.matrix,
        front.gradient,
    )
    for offset in times:
        kernels.add_bones(
            state.position[time + offset],
            problem.bones,
            lengths,
            system.knowledge.bone_sigma_m * grown,
            3 * problem.joints * offset,
            length_offset,
            front.matrix,
            front.gradient,
        )


def _eliminate_joints(system: System, front: _Front, time: int) -> Factor:
    n = 3 * system.problem.joints
    factor, rest, gradient = _partial(front.matrix, front.gradient, n, time, knot=False)
    # The joints at the next two times move up, and those of a third come in, of which nothing is known yet.
    size = system.size
    matrix = front.matrix
    matrix[: 2 * n, : 2 * n] = rest[: 2 * n, : 2 * n]
    matrix[2 * n : 3 * n] = 0.0
    matrix[2 * n :, 2 * n : 3 * n] = 0.0
    matrix[3 * n :, : 2 * n] = rest[2 * n :, : 2 * n]
    matrix[3 * n :, 3 * n :] = rest[2 * n :, 2 * n :]
    front.gradient = np.concatenate([gradient[: 2 * n], np.zeros(n), gradient[2 * n : size - n]])
    return factor


def _eliminate_knot(system: System, state: State, front: _Front) -> Factor:
    n3, count = 9 * system.problem.joints, system.layout.knot_count
    order = np.concatenate([np.arange(n3, n3 + count), np.arange(n3), np.arange(n3 + count, system.size)])
    whole = front.matrix + np.tril(front.matrix, -1).T
    # The joints of the third time are not in yet: a one on their diagonal keeps them apart.
    factor, rest, gradient = _partial(
        np.asfortranarray(np.tril(whole[np.ix_(order, order)])), front.gradient[order], count,
        front.interval, knot=True,
    )  # fmt: skip
    kept = np.concatenate([np.arange(n3), np.arange(n3, n3 + count), np.arange(n3 + 2 * count, system.size)])
    matrix = np.zeros_like(front.matrix)
    matrix[np.ix_(kept, kept)] = np.tril(rest)
    front.matrix = np.asfortranarray(matrix)
    front.gradient = np.zeros_like(front.gradient)
    front.gradient[kept] = gradient
    front.interval += 1
    _tie_knots(system, state, front)
    return factor


def _partial(matrix: Float, gradient: Float, n: int, time: int, *, knot: bool) -> tuple[Factor, Float, Float]:
    """Eliminate the first n unknowns; the Schur complement (lower) and gradient of the others."""
    from scipy.linalg.blas import dsyrk, dtrsm
    from scipy.linalg.lapack import dpotrf, dtrtrs

    lower, failed = dpotrf(matrix[:n, :n], lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError(f"the equations at {'knot' if knot else 'time'} {time} are singular")
    across = dtrsm(1.0, lower, matrix[n:, :n], side=1, lower=1, trans_a=1)
    rest = dsyrk(-1.0, across, beta=1.0, c=matrix[n:, n:], lower=1)
    solved = dtrtrs(lower, -gradient[:n], lower=1)[0]
    return Factor(time, knot, lower, across, solved), rest, gradient[n:] + across @ solved


# --- backwards -----------------------------------------------------------------------------------------


def _last_front(system: System, rest: _Front) -> tuple[Float, Float]:
    """Factor and solution of what is left at the end: two times, two knots, what all share."""
    from scipy.linalg.lapack import dpotrf, dpotrs

    n = 3 * system.problem.joints
    alive = np.concatenate([np.arange(2 * n), np.arange(3 * n, system.size)])
    lower, failed = dpotrf(rest.matrix[np.ix_(alive, alive)], lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("the equations of what all times share are singular")
    return lower, dpotrs(lower, -rest.gradient[alive], lower=1)[0]


def _factors_backwards(system: System, state: State, kept: _Kept) -> Iterator[Factor]:
    segments = _segments(system)
    for index in range(len(segments) - 1, -1, -1):
        factors = kept.factors.pop(index, None)
        if factors is None:
            factors = list(_eliminate(system, state, kept.fronts[index].copy(), *segments[index]))
        yield from reversed(factors)


def _solve_back(system: System, state: State, kept: _Kept, rest: _Front) -> State:
    from scipy.linalg.lapack import dtrtrs

    problem, layout = system.problem, system.layout
    n, count = 3 * problem.joints, layout.knot_count
    _, solution = _last_front(system, rest)
    times = len(problem.t_s)
    position, knots = np.zeros((times, n)), np.zeros_like(state.knots)
    position[-2:] = solution[: 2 * n].reshape(2, n)
    shared = solution[2 * n + 2 * count :]
    k = rest.interval
    if count:
        knots[k : k + 2] = solution[2 * n : 2 * n + 2 * count].reshape(2, count)
    time = times - 2
    for factor in _factors_backwards(system, state, kept):
        if factor.knot:
            k = factor.time
            others = np.concatenate([position[time : time + 2].ravel(), np.zeros(n), knots[k + 1], shared])
        else:
            time = factor.time
            beside = knots[k : k + 2].ravel() if count else np.zeros(0)
            others = np.concatenate([position[time + 1 : time + 3].ravel(), beside, shared])
        found = dtrtrs(factor.lower, factor.solved - factor.across.T @ others, lower=1, trans=1)[0]
        if factor.knot:
            knots[k] = found
        else:
            position[time] = found
    moved = State(position.reshape(state.position.shape), knots, shared, np.zeros_like(state.white))
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
        system.white_precision,
        *system.entries(),
        moved.white,
    )
    return moved


def _visit_back(
    system: System,
    state: State,
    kept: _Kept,
    rest: _Front,
    see_time: Callable[[Visit], None],
    see_knots: Callable[[int, Float], None],
) -> None:
    from scipy.linalg.lapack import dpotri, dtrtri

    n, count = 3 * system.problem.joints, system.layout.knot_count
    lower, _ = _last_front(system, rest)
    inverse, _ = dpotri(lower, lower=1)
    others = np.tril(inverse) + np.tril(inverse, -1).T
    interval = rest.interval
    both = slice(2 * n, 2 * n + 2 * count)
    if count:
        see_knots(interval, others[both, both])
    for factor in _factors_backwards(system, state, kept):
        inverse_lower, _ = dtrtri(factor.lower, lower=1)
        if factor.knot:
            # Alive beside it: two times, a third that is not in yet, the knot after, what all share.
            interval = factor.time
            there = np.concatenate([np.arange(2 * n), np.arange(3 * n, system.size - count)])
            across = factor.across[there]
            alive = np.concatenate([np.arange(2 * n + count), np.arange(2 * n + 2 * count, len(others))])
            beside = others[np.ix_(alive, alive)]
            own, cross = _join(inverse_lower, across, beside)
            joined = np.empty_like(others)
            knot = np.arange(2 * n, 2 * n + count)
            place = np.concatenate([np.arange(2 * n), np.arange(2 * n + count, len(others))])
            joined[np.ix_(place, place)] = beside
            joined[np.ix_(knot, knot)] = own
            joined[np.ix_(knot, place)] = cross
            joined[np.ix_(place, knot)] = cross.T
            others = joined
            see_knots(interval, others[both, both])
            continue
        own, cross = _join(inverse_lower, factor.across, others)
        whole = np.empty((system.size, system.size))
        whole[:n, :n] = own
        whole[:n, n:] = cross
        whole[n:, :n] = cross.T
        whole[n:, n:] = others
        see_time(Visit(factor.time, whole, interval))
        alive = np.concatenate([np.arange(2 * n), np.arange(3 * n, system.size)])
        others = np.ascontiguousarray(whole[np.ix_(alive, alive)])


def _join(inverse_lower: Float, across: Float, others: Float) -> tuple[Float, Float]:
    """Covariance of what was eliminated, and with the others, given that of the others."""
    gain = -(across @ inverse_lower).T  # [n, m]
    cross = gain @ others
    own = inverse_lower.T @ inverse_lower + cross @ gain.T
    # Rounding must not grow from step to step: what is not symmetric would.
    return (own + own.T) / 2, cross
