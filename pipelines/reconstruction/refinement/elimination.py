"""Gauss-Newton steps and posterior covariances, in time and memory linear in the length of the flight.

The normal equations are banded in time with a border. A second difference couples three times, a picture
couples three times and two knots, and the shared unknowns are coupled with everything. So joints and knots
are eliminated in the order of time by one small dense front (Duff & Reid 1983, multifrontal; equal to a
forward filter in information form). A backward pass solves for them and computes the covariances of fronts
(Takahashi's recursion; in time, the smoother of Rauch, Tung & Striebel 1965). The solution is exact, without
windows. Factors of a long flight do not fit into memory: the fronts at every `_SEGMENT` times are kept, and a
segment is factorised again when the backward pass reaches it.

A front [N, N] holds the normal equations of the live unknowns, lower triangle: joints at three times (3 n),
knots before and after (2 c), unknowns shared by all times. Eliminated unknowns x depend on the rest z of the
front as x = R' (y - W' z), with R the inverse of the Cholesky factor of their own block and W = B R'.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.reconstruction.refinement import kernels
from pipelines.reconstruction.refinement.kernels import (
    NUMBERS,
    WHITE,
    Equations,
    Linearised,
    Posterior,
    State,
    add_bones,
    add_motion,
    assemble,
    linearised,
    posterior_of_picture,
)
from pipelines.reconstruction.refinement.system import System

# Factors of so many times of the skeleton are computed again together.
_SEGMENT = 256
# Where the factors take more bytes, segments are factorised twice.
_KEPT_BYTES = 80e6
# Bone lengths with this precision (1 / m^2) do not move.
_HELD = 1e10
# An unseen joint is within this distance of its start, and so is every other joint at each time: 100 m held a
# whole flight of 6 s within 1.5 m.
_ANYWHERE_M = 1e4


@dataclass
class Eliminated:
    """Equations of a state after the elimination of all unknowns but those alive at the end."""

    state: State
    fronts: list[_Front]  # at the start of every segment, to recompute its factors
    factors: dict[int, Factors]  # of the segments whose factors are kept
    lower: Float  # Cholesky factor of the remaining equations
    gradient: Float  # of the same


def eliminate(system: System, state: State) -> Eliminated:
    """Linearise at a state and eliminate; LinAlgError: the equations are singular."""
    from scipy.linalg.lapack import dpotrf

    n, front = 3 * system.problem.joints, _begin(system, state)
    fronts, kept = [], {}
    segments = _segments(system)
    kept_times = _KEPT_BYTES / (8 * n * system.size)
    for index, (first, last) in enumerate(segments):
        fronts.append(front.packed())
        factors = _eliminate(system, state, front, first, last)
        if last < kept_times or index == len(segments) - 1:
            kept[index] = factors
    alive = np.concatenate([np.arange(2 * n), np.arange(3 * n, system.size)])
    lower, failed = dpotrf(front.matrix[np.ix_(alive, alive)], lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("the equations of what all times share are singular")
    return Eliminated(state, fronts, kept, lower, front.gradient[alive])


def step(system: System, at: Eliminated) -> State:
    """Compute the Gauss-Newton step."""
    from scipy.linalg.lapack import dpotrs

    state, n, count = at.state, 3 * system.problem.joints, system.layout.entries.knot_count
    alive = dpotrs(at.lower, -at.gradient, lower=1)[0]
    position, knots = np.zeros((len(system.problem.t_s), n)), np.zeros_like(state.knots)
    position[-2:] = alive[: 2 * n].reshape(2, n)
    shared = np.ascontiguousarray(alive[2 * n + 2 * count :])
    interval = int(system.of_time[-1])
    if count:
        knots[interval : interval + 2] = alive[2 * n : 2 * n + 2 * count].reshape(2, count)
    for first, last, factors in _factors_backwards(system, at):
        for begin, stop, knot in _backwards(system, first, last, interval, factors.first_interval):
            if begin == stop:
                interval, row = knot, knot - factors.first_interval
                z = np.concatenate([position[begin : begin + 2].ravel(), knots[knot + 1], shared])
                rest = factors.knot_solved[row] - z @ factors.knot_across[row]
                knots[knot] = rest @ factors.knot_inverse[row]
            else:
                z = np.concatenate([np.zeros(2 * n), knots[knot : knot + 2].ravel(), shared])
                for time in range(stop - 1, begin - 1, -1):
                    row = time - first
                    z[: 2 * n] = position[time + 1 : time + 3].ravel()
                    position[time] = (factors.solved[row] - z @ factors.across[row]) @ factors.inverse[row]
    moved = State(position.reshape(state.position.shape), knots, shared, np.zeros_like(state.white))
    kernels.whiten(system.equations(state), moved)
    return moved


def covariances(system: System, at: Eliminated) -> Float:
    """Compute the posterior covariance [T, J, 3, 3] of every joint at every time."""
    covariance = np.zeros((*at.state.position.shape, 3))
    _visit(system, at.state, at, covariance, 0)
    return covariance


def moments(system: System, state: State, at: Eliminated, *, every: int) -> Moments:
    """Compute the moments of levels, using every k-th time: squares of `state`, one step further."""
    return _visit(system, state, at, np.zeros((0, 1, 3, 3)), every)


def shared_covariance(system: System, at: Eliminated) -> Float:
    """Compute the posterior covariance of the unknowns shared by all times."""
    whole = _last_covariance(at)
    begins = len(whole) - system.layout.shared_count
    return whole[begins:, begins:]


@dataclass
class _Front:
    """Normal equations of the live unknowns: joints at three times, knots around them, shared unknowns."""

    matrix: Float  # [N, N] lower triangle; [N (N + 1) / 2] if packed, in half the memory
    gradient: Float  # [N]
    interval: int

    def packed(self) -> _Front:
        rows = np.tril_indices(len(self.matrix))
        return _Front(self.matrix[rows], self.gradient.copy(), self.interval)

    def unpacked(self) -> _Front:
        size = len(self.gradient)
        matrix = np.zeros((size, size))
        matrix[np.tril_indices(size)] = self.matrix
        return _Front(matrix, self.gradient.copy(), self.interval)


def _segments(system: System) -> list[tuple[int, int]]:
    """List the segments [first, last) of the eliminated times."""
    count = len(system.problem.t_s) - 2
    return [(first, min(first + _SEGMENT, count)) for first in range(0, count, _SEGMENT)]


def _begin(system: System, state: State) -> _Front:
    """Create the first front: the priors of slow errors at the first knot and of shared unknowns."""
    layout, n3 = system.layout, 9 * system.problem.joints
    front = _Front(np.zeros((system.size, system.size)), np.zeros(system.size), 0)
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
    if system.problem.size is not None:
        bones = slice(n3 + 2 * layout.entries.knot_count + layout.bone_column, system.size)
        slope, missed = system.problem.size.equations(state.shared[layout.bone_column :])
        front.matrix[bones, bones] += slope.T @ slope
        front.gradient[bones] += slope.T @ missed
    return front


def _sweep(system: System, state: State) -> Sweep:
    """Collect the arguments of the compiled functions."""
    t_s = system.problem.t_s
    before, after = np.diff(t_s)[:-1], np.diff(t_s)[1:]
    return Sweep(
        equations=system.equations(state),
        starts=np.searchsorted(system.pictures.first, np.arange(len(t_s) - 1)),
        curvature=np.stack(
            [2 / (before * (before + after)), -2 / (before * after), 2 / (after * (before + after))], axis=1
        ),
        spread=system.usual_step_s / (0.5 * (before + after)),
        precision=system.inverse_acceleration,
        hold=1 / _ANYWHERE_M**2,
        bones=system.problem.bones,
        bone_sigma=system.knowledge.bone_sigma_m,
        grown=system.grown(state),
    )


def _eliminate(system: System, state: State, front: _Front, first: int, last: int) -> Factors:
    """Eliminate the knots and joints of times from `first` to before `last`; change the front in place."""
    n, c = 3 * system.problem.joints, system.layout.entries.knot_count
    times, size = last - first, system.size
    knots = int(system.of_time[last]) - front.interval if c else 0
    factors = Factors(
        front.interval,
        np.zeros((times, n, n)),
        np.zeros((times, size - n, n)),
        np.zeros((times, n)),
        np.zeros((knots, c, c)),
        np.zeros((knots, size - n - c, c)),
        np.zeros((knots, c)),
    )
    sweep = _sweep(system, state)
    if c and first == 0:
        _tie_knots(front, system, state.knots, n)
    try:
        begin = first
        while True:
            while c and front.interval < system.of_time[begin]:
                row = front.interval - factors.first_interval
                knot = factors.knot_inverse[row], factors.knot_across[row], factors.knot_solved[row]
                _eliminate_knot(front, n, c, *knot)
                front.interval += 1
                _tie_knots(front, system, state.knots, n)
            if begin == last:
                return factors
            stop = min(last, int(np.searchsorted(system.of_time, front.interval, "right"))) if c else last
            rows = slice(begin - first, stop - first)
            own = factors.inverse[rows], factors.across[rows], factors.solved[rows]
            forwards(begin, sweep, front.matrix, front.gradient, *own)
            begin = stop
    except np.linalg.LinAlgError as error:
        raise np.linalg.LinAlgError("the equations of the refinement are singular") from error


def _eliminate_knot(front: _Front, n: int, c: int, inverse: Float, across: Float, solved: Float) -> None:
    """Eliminate the knot before; the knot after takes its place, and the next enters without information."""
    from scipy.linalg.lapack import dtrtri

    matrix, gradient = front.matrix, front.gradient
    before, after, end = slice(3 * n, 3 * n + c), slice(3 * n + c, 3 * n + 2 * c), 3 * n + 2 * c
    # Joints at the third time have no information yet.
    joints, others = slice(2 * n), slice(3 * n + c, None)
    beside = np.concatenate([matrix[before, joints].T, matrix[others, before]])
    inverse[:] = dtrtri(np.linalg.cholesky(matrix[before, before]), lower=1)[0]
    across[:] = beside @ inverse.T
    solved[:] = -inverse @ gradient[before]
    for rows, of_rows in ((joints, joints), (others, slice(2 * n, None))):
        matrix[rows, joints] -= across[of_rows] @ across[joints].T
        gradient[rows] += across[of_rows] @ solved
    matrix[others, others] -= across[2 * n :] @ across[2 * n :].T
    matrix[before, : 3 * n], matrix[before, before] = matrix[after, : 3 * n], matrix[after, after]
    matrix[end:, before], gradient[before] = matrix[end:, after], gradient[after]
    matrix[after, :end], matrix[end:, after], gradient[after] = 0.0, 0.0, 0.0


def _tie_knots(front: _Front, system: System, knots: Float, n: int) -> None:
    """Add the prior of the change between the knot before and the knot after."""
    interval = front.interval
    kept, q = system.tie_kept[interval], system.tie_variance[interval]
    change = knots[interval + 1] - kept * knots[interval]
    before = 3 * n + np.arange(len(q))
    after = before + len(q)
    front.matrix[before, before] += kept**2 / q
    front.matrix[after, after] += 1 / q
    front.matrix[after, before] -= kept / q
    front.gradient[before] -= kept * change / q
    front.gradient[after] += change / q


def _backwards(
    system: System, first: int, last: int, interval: int, least: int
) -> Iterator[tuple[int, int, int]]:
    """Yield a segment from its end: stretches [first, last) between two knots, and the knot before each.

    An empty stretch is the elimination of its knot before the time `first`. Knots before the segment are
    eliminated from `least` on.
    """
    knots, stop = system.layout.entries.knot_count > 0, last
    while True:
        while knots and interval > (system.of_time[stop - 1] if stop > first else least):
            interval -= 1
            yield stop, stop, interval
        if stop == first:
            return
        begin = max(first, int(np.searchsorted(system.of_time, interval))) if knots else first
        yield begin, stop, interval
        stop = begin


def _last_covariance(at: Eliminated) -> Float:
    """Compute the covariance of the unknowns alive at the end."""
    from scipy.linalg.lapack import dpotri

    inverse, _ = dpotri(at.lower, lower=1)
    return np.ascontiguousarray(np.tril(inverse) + np.tril(inverse, -1).T)


def _factors_backwards(system: System, at: Eliminated) -> Iterator[tuple[int, int, Factors]]:
    for index, segment in reversed(list(enumerate(_segments(system)))):
        factors = at.factors.get(index)
        if factors is None:
            factors = _eliminate(system, at.state, at.fronts[index].unpacked(), *segment)
        yield *segment, factors


def _visit(system: System, state: State, at: Eliminated, covariance: Float, every: int) -> Moments:
    """Compute the moments, linearised at `state`; fill `covariance` unless it is empty."""
    problem, layout = system.problem, system.layout
    joints, knot_count = problem.joints, layout.entries.knot_count
    found = Moments(
        np.zeros((2, joints, joints)),
        np.zeros(len(problem.bones)),
        np.zeros((joints, 2)),
        np.zeros((2, 3)),
        np.zeros((knot_count, 3)),
        np.zeros((knot_count + layout.shared_count, 2)),
        len(problem.t_s) - 2,
    )
    others, interval, sweep = _last_covariance(at), int(system.of_time[-1]), _sweep(system, state)
    n, size, walks = 3 * joints, system.size, bool(knot_count and every)
    whole = np.empty((size, size))
    if walks:
        _add_walk(others, n, system, state.knots, interval, found.walked)
    for first, last, factors in _factors_backwards(system, at):
        for begin, stop, knot in _backwards(system, first, last, interval, factors.first_interval):
            if begin == stop:
                interval, row = knot, knot - factors.first_interval
                others = _before_knot(others, n, factors.knot_inverse[row], factors.knot_across[row])
                if walks:
                    _add_walk(others, n, system, state.knots, interval, found.walked)
            else:
                for time in range(stop - 1, begin - 1, -1):
                    others = _before_time(
                        others, n, factors.inverse[time - first], factors.across[time - first], whole
                    )
                    for k in range(3 if time == len(problem.t_s) - 3 else 1) if len(covariance) else ():
                        own = whole[k * n : k * n + n, k * n : k * n + n].reshape(joints, 3, joints, 3)
                        covariance[time + k] = np.einsum("jajb->jab", own)
                    if every:
                        add_moments(time, every, sweep, whole, found)
    if every:
        first_value = np.concatenate([state.knots[0], state.shared])
        variance = np.delete(np.diagonal(whole)[3 * n :], np.s_[knot_count : 2 * knot_count])
        found.starting[:] = np.stack([first_value**2 + variance, variance], axis=1)
    return found


def _join(inverse: Float, across: Float, others: Float) -> tuple[Float, Float]:
    """Compute the covariance of eliminated unknowns, and (negated) with the others, from the others'."""
    gain = across @ inverse  # [m, n]; x depends on the others by its negative, transposed
    cross = others @ gain  # [m, n], negative
    more = gain.T @ cross
    # Symmetrise, because asymmetric rounding errors would grow from step to step.
    return inverse.T @ inverse + (more + more.T) / 2, cross


def _before_time(alive: Float, n: int, inverse: Float, across: Float, whole: Float) -> Float:
    """Compute the covariance of the unknowns alive before a time; fill that with its joints, `whole`."""
    whole[:n, :n], cross = _join(inverse, across, alive)
    np.negative(cross, out=whole[n:, :n])
    whole[:n, n:], whole[n:, n:] = whole[n:, :n].T, alive
    before = np.empty_like(alive)
    # The third of the joints' times was not alive before.
    halves = (slice(2 * n), slice(2 * n)), (slice(2 * n, None), slice(3 * n, None))
    for to, rows in halves:
        for across_to, columns in halves:
            before[to, across_to] = whole[rows, columns]
    return before


def _before_knot(alive: Float, n: int, inverse: Float, across: Float) -> Float:
    """Compute the covariance of the unknowns alive before the elimination of a knot."""
    c = len(inverse)
    then = np.r_[: 2 * n + c, 2 * n + 2 * c : len(alive)]  # all but the knot after the next
    place, knot = then + c * (then >= 2 * n) * (then < 2 * n + c), slice(2 * n, 2 * n + c)
    beside = alive[np.ix_(then, then)]
    own, cross = _join(inverse, across, beside)
    joined = np.empty_like(alive)
    joined[np.ix_(place, place)], joined[knot, knot] = beside, own
    joined[place, knot], joined[knot, place] = -cross, -cross.T
    return joined


def _add_walk(alive: Float, n: int, system: System, knots: Float, interval: int, walked: Float) -> None:
    """Add the change of the slow errors between two knots, per second."""
    knot_t_s, c = system.problem.knot_t_s, len(walked)
    elapsed = knot_t_s[interval + 1] - knot_t_s[interval]
    before = 2 * n + np.arange(c)
    after = before + c
    variance = (alive[before, before] + alive[after, after] - 2 * alive[before, after]) / elapsed
    walked[:, 0] += (knots[interval + 1] - knots[interval]) ** 2 / elapsed + variance
    walked[:, 1] += 1
    walked[:, 2] += variance


# --- compiled --------------------------------------------------------------------------------------------

# Products of fewer rows are too small to be fast.
_STRIP = 48


class Sweep(NamedTuple):
    """Flight of T times with the priors of its motion."""

    equations: Equations
    starts: Int64  # [T - 1] index of the first picture of each time
    curvature: Float  # [T - 2, 3] weights of three positions for their acceleration
    spread: Float  # [T - 2] its variance relative to the usual
    precision: Float  # [J, J] of an acceleration
    hold: float  # added to the diagonal of joints, so that unseen ones stay near their start
    bones: Int64  # [B, 2]
    bone_sigma: Float  # [B] m
    grown: float  # size of the body over that for which the priors hold


class Factors(NamedTuple):
    """Factors of a stretch's elimination: rows of its times, and of its knots from the first interval."""

    first_interval: int
    inverse: Float  # [., n, n] R
    across: Float  # [., m, n] W
    solved: Float  # [., n] y
    knot_inverse: Float  # [., c, c]
    knot_across: Float  # [., m', c]
    knot_solved: Float  # [., c]


class Moments(NamedTuple):
    """Posterior mean squares and variances of the quantities whose standard deviations are the levels."""

    acceleration: Float  # [2, J, J] sums of mean squares and of variances over the times
    bones: Float  # [B] sums of mean squares
    image: Float  # [J, 2] weighted squares of residuals, and their degrees of freedom after the fit
    white: Float  # [2, 3] of position, rotation: sums of mean squares, count, sum of determined shares
    walked: Float  # [c, 3] of the changes between knots per s: sums of mean squares, count, variances
    starting: Float  # [c + shared, 2] mean squares and variances at the first time
    times: int


@helper
def copy_block(source: Float, row: int, column: int, out: Float) -> None:
    """Copy part of a matrix; an assignment to a slice would take seconds longer to compile."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = source[row + i, column + j]


@helper
def lower_square(rows: Float) -> Float:
    """Compute the lower triangle of W W', in strips; values above it are undefined."""
    size = len(rows)
    square = np.empty((size, size))
    for begin in range(0, size, _STRIP):
        end = min(begin + _STRIP, size)
        strip = np.dot(rows[begin:end], rows[:end].T)
        for i in range(end - begin):
            for j in range(end):
                square[begin + i, j] = strip[i, j]
    return square


@helper
def eliminate_block(
    own: Float, beside: Float, gradient: Float, inverse: Float, across: Float, y: Float
) -> Float:
    """Compute R = L^-1, W = B R', y = -R g in place; return W W' (lower)."""
    n = len(own)
    lower = np.linalg.cholesky(own)
    for i in range(n):
        for j in range(i + 1):
            inverse[i, j] = 0.0
        for j in range(i + 1, n):
            inverse[i, j] = 0.0
        for k in range(i):
            scale = lower[i, k]
            for j in range(k + 1):
                inverse[i, j] -= scale * inverse[k, j]
        for j in range(i):
            inverse[i, j] /= lower[i, i]
        inverse[i, i] = 1.0 / lower[i, i]
    for i in range(n):
        total = 0.0
        for j in range(i + 1):
            total -= inverse[i, j] * gradient[j]
        y[i] = total
    np.dot(beside, inverse.T, across)
    return lower_square(across)


@cached
def forwards(
    first: int, sweep: Sweep, front: Float, gradient: Float, inverse: Float, across: Float, solved: Float
) -> None:
    """Eliminate the times from `first` that are between the same two knots; fill their factors."""
    position, shared = sweep.equations.state.position, sweep.equations.state.shared
    bones, starts, grown = sweep.bones, sweep.starts, sweep.grown
    n, size = inverse.shape[1], len(gradient)
    lengths = shared[len(shared) - len(bones) :]
    length_offset = size - len(bones)
    own, beside = np.empty((n, n)), np.empty((size - n, n))
    for row in range(len(inverse)):
        time = first + row
        assemble(starts[time], starts[time + 1], sweep.equations, front, gradient)
        add_motion(
            position[time : time + 3], sweep.curvature[time], sweep.precision,
            1.0 / (sweep.spread[time] * grown**2), sweep.hold, lengths, length_offset, front, gradient,
        )  # fmt: skip
        # All bones of a time at once with the first of its three, and those of the last times.
        for offset in range(1 if time < len(position) - 3 else 3):
            add_bones(
                position[time + offset], bones, lengths, sweep.bone_sigma, grown, n * offset, length_offset,
                front, gradient,
            )  # fmt: skip
        copy_block(front, 0, 0, own)
        copy_block(front, n, 0, beside)
        w = across[row]
        less = eliminate_block(own, beside, gradient[:n], inverse[row], w, solved[row])
        # The joints at the next two times move up; those of a third enter without any information.
        for i in range(2 * n):
            down = 0.0
            for a in range(n):
                down += w[i, a] * solved[row, a]
            gradient[i] = gradient[n + i] + down
            for j in range(i + 1):
                front[i, j] = front[n + i, n + j] - less[i, j]
        for i in range(2 * n, 3 * n):
            gradient[i] = 0.0
            for j in range(i + 1):
                front[i, j] = 0.0
        for i in range(3 * n, size):
            down = 0.0
            for a in range(n):
                down += w[i - n, a] * solved[row, a]
            gradient[i] += down
            for j in range(2 * n):
                front[i, j] = front[i, n + j] - less[i - n, j]
            for j in range(2 * n, 3 * n):
                front[i, j] = 0.0
            for j in range(3 * n, i + 1):
                front[i, j] -= less[i - n, j - n]


# --- covariances ---------------------------------------------------------------------------------------


@cached
def add_moments(time: int, every: int, sweep: Sweep, whole: Float, sums: Moments) -> None:
    """Add the squares at a time with the covariance `whole`, by pictures at every `every`-th time."""
    equations, starts = sweep.equations, sweep.starts
    position, white = equations.state.position, equations.state.white
    J = position.shape[1]
    acceleration_of(whole, position, sweep.curvature, sweep.spread, time, sums.acceleration)
    bones_of(whole, position, equations.state.shared, sweep.bones, time, sums.bones)
    if time % every != 0:
        return
    picture = linearised(J)
    posterior = Posterior(
        np.empty((J, 3, 3)), np.empty((J, 3, NUMBERS)), np.empty((NUMBERS, NUMBERS)), np.empty(WHITE)
    )
    for g in range(starts[time], starts[time + 1]):
        posterior_of_picture(g, equations, whole, picture, posterior)
        noise_of(picture, posterior, sums.image)
        row = equations.pictures.white_row[g]
        if row == equations.pictures.camera[g]:  # others have their own precision, not the level
            white_of(white[g], equations.white_precision[row], posterior.of_white, sums.white)


@helper
def acceleration_of(
    whole: Float, position: Float, curvature: Float, spread: Float, time: int, sums: Float
) -> None:
    """Add posterior mean squares, and variances, of the accelerations between three times [2, J, J]."""
    J = position.shape[1]
    n = 3 * J
    at = np.empty((J, 3))
    for joint in range(J):
        for a in range(3):
            at[joint, a] = 0.0
            for k in range(3):
                at[joint, a] += curvature[time, k] * position[time + k, joint, a]
    scale = 1.0 / (3 * spread[time])
    for i in range(J):
        for j in range(J):
            total, variance = 0.0, 0.0
            for a in range(3):
                total += at[i, a] * at[j, a]
            for k in range(3):
                for m in range(3):
                    both = curvature[time, k] * curvature[time, m]
                    for a in range(3):
                        variance += both * whole[k * n + 3 * i + a, m * n + 3 * j + a]
            sums[0, i, j] += scale * (total + variance)
            sums[1, i, j] += scale * variance


@helper
def bones_of(whole: Float, position: Float, shared: Float, bones: Int64, time: int, sums: Float) -> None:
    """Add posterior mean squares [B] of the deviations of bones from their lengths at a time."""
    B, size = len(bones), len(whole)
    column, by = np.empty(7, np.int64), np.empty(7)
    for b in range(B):
        i, j = bones[b]
        length = 0.0
        for a in range(3):
            by[3 + a] = position[time, j, a] - position[time, i, a]
            length += by[3 + a] ** 2
        length = np.sqrt(length)
        for a in range(3):
            by[3 + a] /= max(length, 1e-6)
            by[a] = -by[3 + a]
            column[a], column[3 + a] = 3 * i + a, 3 * j + a
        by[6], column[6] = -1.0, size - B + b
        total = (length - shared[len(shared) - B + b]) ** 2
        for p in range(7):
            for q in range(7):
                total += by[p] * by[q] * whole[column[p], column[q]]
        sums[b] += total


@helper
def noise_of(picture: Linearised, posterior: Posterior, sums: Float) -> None:
    """Add a picture's contribution to image noise [J, 2]."""
    residual, by_joint, by_number = picture.residual, picture.by_joint, picture.by_number
    view_weight = picture.view_weight
    of_joints, across, of_numbers = posterior.of_joints, posterior.across, posterior.of_numbers
    for joint in range(len(view_weight)):
        if view_weight[joint] == 0.0:
            continue
        for axis in range(2):
            variance = 0.0
            for i in range(3):
                follows = 0.0
                for j in range(3):
                    follows += of_joints[joint, i, j] * by_joint[joint, axis, j]
                for a in range(NUMBERS):
                    follows += 2 * across[joint, i, a] * by_number[joint, axis, a]
                variance += by_joint[joint, axis, i] * follows
            for a in range(NUMBERS):
                follows = 0.0
                for b in range(NUMBERS):
                    follows += of_numbers[a, b] * by_number[joint, axis, b]
                variance += by_number[joint, axis, a] * follows
            sums[joint, 0] += view_weight[joint] * residual[joint, axis] ** 2
            sums[joint, 1] += view_weight[joint] * (1 - variance)


@helper
def white_of(white: Float, precision: Float, variance: Float, sums: Float) -> None:
    """Add a picture's white error [6], with posterior `variance` [6], to the sums [2, 3] of its level."""
    for i in range(WHITE):
        if not np.isfinite(precision[i, i]):
            continue
        determined = 1 - variance[i] * precision[i, i]
        part = i // 3
        sums[part, 0] += white[i] ** 2 + variance[i]
        sums[part, 1] += 1
        sums[part, 2] += determined
