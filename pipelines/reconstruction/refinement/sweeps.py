"""Elimination of a stretch of time, forwards and backwards, compiled.

A front [N, N] holds the normal equations of the live unknowns, lower triangle: joints at three times (3 n),
knots before and after (2 c), unknowns shared by all times. Eliminated unknowns x depend on the rest z of the
front as x = R' (y - W' z), with R the inverse of the Cholesky factor of their own block and W = B R'.
"""

from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.reconstruction.refinement.kernels import (
    NUMBERS,
    WHITE,
    Equations,
    Linearised,
    Posterior,
    add_bones,
    add_motion,
    assemble,
    linearised,
    posterior_of_picture,
)

# Products of fewer rows are too small to be fast.
_STRIP = 48


class Ties(NamedTuple):
    """Priors of knots' changes: before * knot - after * next knot has mean 0 and this variance."""

    before: Float  # [K - 1, c]
    after: Float  # [K - 1, c]
    variance: Float  # [K - 1, c]; inf if the tie belongs to the other half


class Sweep(NamedTuple):
    """Half of a flight with the priors of its motion; T times, the last two shared with the other half."""

    equations: Equations
    starts: Int64  # [T - 1] index of the first picture of each time
    of_time: Int64  # [T - 1] the knot before each eliminated time, and before the meeting
    curvature: Float  # [T - 2, 3] weights of three positions for their acceleration
    spread: Float  # [T - 2] its variance relative to the usual
    precision: Float  # [J, J] of an acceleration
    hold: float  # added to the diagonal of joints, so that unseen ones stay near their start
    bones: Int64  # [B, 2]
    bone_sigma: Float  # [B] m
    grown: float  # size of the body over that for which the priors hold
    own_times: int  # of the last three times, those whose bones count in this half
    knot_t_s: Float  # [K]
    ties: Ties


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
    starting: Float  # [c + shared, 2] mean squares and variances at the first time; empty in the second half
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
def eliminate(
    own: Float, beside: Float, gradient: Float, inverse: Float, across: Float, y: Float
) -> tuple[Float, float]:
    """Compute R = L^-1, W = B R', y = -R g in place; return W W' (lower) and half log det of `own`."""
    n = len(own)
    lower = np.linalg.cholesky(own)
    half = 0.0
    for i in range(n):
        half += np.log(lower[i, i])
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
    return lower_square(across), half


@cached
def forwards(
    first: int, last: int, sweep: Sweep, front: Float, gradient: Float, interval: int, factors: Factors
) -> tuple[int, float]:
    """Eliminate joints and knots of the times from `first` to before `last`; change the front in place.

    Writes the factors. Returns the interval of the time `last`, in which the front ends, and half the log
    determinant of all eliminated unknowns, white errors included.
    """
    position, shared = sweep.equations.state.position, sweep.equations.state.shared
    knots, bones, own_times = sweep.equations.state.knots, sweep.bones, sweep.own_times
    starts, of_time, grown = sweep.starts, sweep.of_time, sweep.grown
    inverse, across, solved = factors.inverse, factors.across, factors.solved
    J = position.shape[1]
    n, c = 3 * J, sweep.equations.entries.knot_count
    size = len(gradient)
    s = size - 3 * n - 2 * c
    lengths = shared[len(shared) - len(bones) :]
    length_offset = size - len(bones)
    half = 0.0
    own, beside = np.empty((n, n)), np.empty((size - n, n))
    knot_own, knot_beside = np.empty((c, c)), np.empty((2 * n + c + s, c))
    for time in range(first, last + 1):
        while c and interval < of_time[time]:
            k = interval - factors.first_interval
            half += eliminate_knot(
                front, gradient, n, c, knot_own, knot_beside, factors.knot_inverse[k],
                factors.knot_across[k], factors.knot_solved[k],
            )  # fmt: skip
            interval += 1
            tie_knots(front, gradient, n, c, knots, interval, sweep.ties)
        if time == last:
            break
        half += assemble(starts[time], starts[time + 1], sweep.equations, front, gradient)
        add_motion(
            position[time : time + 3], sweep.curvature[time], sweep.precision,
            1.0 / (sweep.spread[time] * grown**2), sweep.hold, lengths, length_offset, front, gradient,
        )  # fmt: skip
        # All bones of a time at once with the first of its three; the last two times may have their own.
        for offset in range(1 if time < len(position) - 3 else own_times):
            add_bones(
                position[time + offset], bones, lengths, sweep.bone_sigma, grown, n * offset, length_offset,
                front, gradient,
            )  # fmt: skip
        copy_block(front, 0, 0, own)
        copy_block(front, n, 0, beside)
        row = time - first
        w = across[row]
        less, part = eliminate(own, beside, gradient[:n], inverse[row], w, solved[row])
        half += part
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
    return interval, half


@helper
def eliminate_knot(
    front: Float,
    gradient: Float,
    n: int,
    c: int,
    own: Float,
    beside: Float,
    inverse: Float,
    across: Float,
    solved: Float,
) -> float:
    """Eliminate the knot before; the knot after takes its place, and the next enters without information."""
    size = len(gradient)
    before, after = 3 * n, 3 * n + c
    copy_block(front, before, before, own)
    for i in range(c):
        for j in range(2 * n):
            beside[j, i] = front[before + i, j]
        for j in range(after, size):
            beside[2 * n + j - after, i] = front[j, before + i]
    less, half = eliminate(own, beside, gradient[before:after], inverse, across, solved)
    for i in range(2 * n):
        for a in range(c):
            gradient[i] += across[i, a] * solved[a]
        for j in range(i + 1):
            front[i, j] -= less[i, j]
    for i in range(after, size):
        row = 2 * n + i - after
        down = 0.0
        for a in range(c):
            down += across[row, a] * solved[a]
        gradient[i] += down
        for j in range(2 * n):
            front[i, j] -= less[row, j]
        for j in range(after, i + 1):
            front[i, j] -= less[row, 2 * n + j - after]
    for i in range(c):
        gradient[before + i] = gradient[after + i]
        gradient[after + i] = 0.0
        for j in range(3 * n):
            front[before + i, j] = front[after + i, j]
            front[after + i, j] = 0.0
        for j in range(i + 1):
            front[before + i, before + j] = front[after + i, after + j]
        for j in range(c):
            front[after + i, before + j] = 0.0
        for j in range(i + 1):
            front[after + i, after + j] = 0.0
    for i in range(after + c, size):
        for j in range(c):
            front[i, before + j] = front[i, after + j]
            front[i, after + j] = 0.0
    return half


@helper
def tie_knots(
    front: Float,
    gradient: Float,
    n: int,
    c: int,
    knots: Float,
    interval: int,
    ties: Ties,
) -> None:
    """Add the random walk between the knot before and the knot after."""
    before, after = 3 * n, 3 * n + c
    for i in range(c):
        b, a, q = ties.before[interval, i], ties.after[interval, i], ties.variance[interval, i]
        change = a * knots[interval + 1, i] - b * knots[interval, i]
        front[before + i, before + i] += b * b / q
        front[after + i, after + i] += a * a / q
        front[after + i, before + i] -= a * b / q
        gradient[before + i] -= b * change / q
        gradient[after + i] += a * change / q


@cached
def begin(front: Float, gradient: Float, n: int, c: int, knots: Float, ties: Ties) -> None:
    """Tie the first two knots."""
    tie_knots(front, gradient, n, c, knots, 0, ties)


@cached
def backwards(
    first: int,
    last: int,
    of_time: Int64,
    interval: int,
    factors: Factors,
    position: Float,
    knots: Float,
    shared: Float,
) -> int:
    """Solve for joints [T, n] and knots [K, c] of a stretch from its end, in place; return the interval."""
    inverse, across, solved = factors.inverse, factors.across, factors.solved
    n, c = position.shape[1], knots.shape[1]
    s = len(shared)
    z, zk = np.empty(2 * n + 2 * c + s), np.empty(2 * n + c + s)
    for i in range(s):
        z[2 * n + 2 * c + i] = shared[i]
        zk[2 * n + c + i] = shared[i]
    rest_n, rest_c = np.empty(n), np.empty(c)
    for time in range(last - 1, first - 2, -1):
        # Solve knots eliminated after this time first; at the end, those before the stretch.
        while c and interval > (of_time[time] if time >= first else factors.first_interval):
            interval -= 1
            follow_knot(time, interval, zk, rest_c, factors, position, knots)
        if time < first:
            break
        row = time - first
        for i in range(n):
            z[i] = position[time + 1, i]
            z[n + i] = position[time + 2, i]
            rest_n[i] = solved[row, i]
        for i in range(c):
            z[2 * n + i] = knots[interval, i]
            z[2 * n + c + i] = knots[interval + 1, i]
        for j in range(len(z)):
            for i in range(n):
                rest_n[i] -= across[row, j, i] * z[j]
        for i in range(n):
            position[time, i] = 0.0
        for j in range(n):
            for i in range(j + 1):
                position[time, i] += inverse[row, j, i] * rest_n[j]
    return interval


@helper
def follow_knot(
    time: int, interval: int, z: Float, rest: Float, factors: Factors, position: Float, knots: Float
) -> None:
    """Solve for a knot from the next knot and the joints at `time` + 1 and `time` + 2."""
    n, c = position.shape[1], knots.shape[1]
    row = interval - factors.first_interval
    inverse, across, solved = factors.knot_inverse, factors.knot_across, factors.knot_solved
    for i in range(n):
        z[i] = position[time + 1, i]
        z[n + i] = position[time + 2, i]
    for i in range(c):
        z[2 * n + i] = knots[interval + 1, i]
        rest[i] = solved[row, i]
    for j in range(len(z)):
        for i in range(c):
            rest[i] -= across[row, j, i] * z[j]
    for i in range(c):
        knots[interval, i] = 0.0
    for j in range(c):
        for i in range(j + 1):
            knots[interval, i] += inverse[row, j, i] * rest[j]


# --- covariances ---------------------------------------------------------------------------------------


@helper
def join(inverse: Float, across: Float, others: Float) -> tuple[Float, Float]:
    """Compute the covariance of eliminated unknowns, and (negated) with the others, from the others'."""
    gain = np.dot(across, inverse)  # [m, n]; x depends on the others by its negative, transposed
    cross = np.dot(others, gain)  # [m, n], negative
    own, more = np.dot(inverse.T, inverse), np.dot(gain.T, cross)
    # Symmetrise, because asymmetric rounding errors would grow from step to step.
    for i in range(len(own)):
        for j in range(i + 1):
            own[i, j] = own[i, j] + 0.5 * (more[i, j] + more[j, i])
            own[j, i] = own[i, j]
    return own, cross


@cached
def visit(
    first: int,
    last: int,
    sweep: Sweep,
    others: Float,
    interval: int,
    factors: Factors,
    every: int,
    covariance: Float,
    sums: Moments,
) -> tuple[Float, int]:
    """Compute covariances of a stretch from its end, and sums for the levels.

    `others` [m, m] is the covariance of the unknowns alive at the end. `covariance` [T, J, 3, 3] is filled
    unless empty; of the last three times only the half's own. Sums are made unless `every` is 0, over the
    pictures of every `every`-th time. Returns the covariance of the unknowns alive at the beginning, and the
    interval there.
    """
    equations, starts, of_time = sweep.equations, sweep.starts, sweep.of_time
    knots, shared, white = equations.state.knots, equations.state.shared, equations.state.white
    inverse, across, starting = factors.inverse, factors.across, sums.starting
    J = equations.state.position.shape[1]
    n, c = 3 * J, equations.entries.knot_count
    m = len(others)
    size = m + n
    whole = np.empty((size, size))
    alive = others.copy()
    picture = linearised(J)
    posterior = Posterior(
        np.empty((J, 3, 3)), np.empty((J, 3, NUMBERS)), np.empty((NUMBERS, NUMBERS)), np.empty(WHITE)
    )
    last_time = len(equations.t_s) - 3
    for time in range(last - 1, first - 2, -1):
        # As in the forward pass; at the end, the knots before the stretch.
        while c and interval > (of_time[time] if time >= first else factors.first_interval):
            interval -= 1
            row = interval - factors.first_interval
            alive = before_knot(alive, n, c, factors.knot_inverse[row], factors.knot_across[row])
            if every:
                walk_of(alive, n, c, knots, sweep.knot_t_s, interval, sums.walked)
        if time < first:
            break
        row = time - first
        own, cross = join(inverse[row], across[row], alive)
        for i in range(n):
            for j in range(n):
                whole[i, j] = own[i, j]
        for i in range(m):
            for j in range(n):
                whole[n + i, j] = -cross[i, j]
                whole[j, n + i] = -cross[i, j]
            for j in range(m):
                whole[n + i, n + j] = alive[i, j]
        if len(covariance):
            for k in range(sweep.own_times if time == last_time else 1):
                for joint in range(J):
                    p = k * n + 3 * joint
                    for a in range(3):
                        for b in range(3):
                            covariance[time + k, joint, a, b] = whole[
                                k * n + 3 * joint + a, k * n + 3 * joint + b
                            ]
        if every:
            acceleration_of(
                whole, equations.state.position, sweep.curvature, sweep.spread, time, sums.acceleration
            )
            bones_of(whole, equations.state.position, shared, sweep.bones, time, sums.bones)
            if time % every == 0:
                for g in range(starts[time], starts[time + 1]):
                    posterior_of_picture(g, equations, whole, picture, posterior)
                    noise_of(picture, posterior, sums.image)
                    row = equations.pictures.white_row[g]
                    if row == equations.pictures.camera[g]:  # others have their own precision, not the level
                        precision = equations.white_precision[row]
                        white_of(white[g], precision, posterior.of_white, sums.white)
            if time == 0 and len(starting):
                for i in range(c):
                    starting[i, 0] = knots[0, i] ** 2 + whole[3 * n + i, 3 * n + i]
                    starting[i, 1] = whole[3 * n + i, 3 * n + i]
                for i in range(len(shared)):
                    p = 3 * n + 2 * c + i
                    starting[c + i, 0] = shared[i] ** 2 + whole[p, p]
                    starting[c + i, 1] = whole[p, p]
        # The third of the joints' times was not alive before.
        for i in range(m):
            below = i if i < 2 * n else i + n
            for j in range(2 * n):
                alive[i, j] = whole[below, j]
            for j in range(2 * n, m):
                alive[i, j] = whole[below, n + j]
    return alive, interval


@helper
def before_knot(alive: Float, n: int, c: int, inverse: Float, across: Float) -> Float:
    """Compute the covariance of the unknowns alive before the elimination of a knot."""
    m = len(alive)
    place = np.empty(m - c, np.int64)  # those alive then: all but the knot after the next
    for i in range(2 * n + c):
        place[i] = i
    for i in range(2 * n + 2 * c, m):
        place[i - c] = i
    beside = np.empty((m - c, m - c))
    for i in range(m - c):
        for j in range(m - c):
            beside[i, j] = alive[place[i], place[j]]
    own, cross = join(inverse, across, beside)
    for i in range(2 * n, 2 * n + c):  # the knot before becomes the knot after
        place[i] += c
    joined = np.empty((m, m))
    for i in range(m - c):
        for j in range(m - c):
            joined[place[i], place[j]] = beside[i, j]
        for j in range(c):
            joined[place[i], 2 * n + j] = -cross[i, j]
            joined[2 * n + j, place[i]] = -cross[i, j]
    for i in range(c):
        for j in range(c):
            joined[2 * n + i, 2 * n + j] = own[i, j]
    return joined


@helper
def walk_of(
    alive: Float, n: int, c: int, knots: Float, knot_t_s: Float, interval: int, walked: Float
) -> None:
    """Add the change of the slow errors between two knots, per second."""
    elapsed = abs(knot_t_s[interval + 1] - knot_t_s[interval])
    for i in range(c):
        p, q = 2 * n + i, 2 * n + c + i
        variance = (alive[p, p] + alive[q, q] - 2 * alive[p, q]) / elapsed
        change = knots[interval + 1, i] - knots[interval, i]
        walked[i, 0] += change**2 / elapsed + variance
        walked[i, 1] += 1
        walked[i, 2] += variance


@cached
def last_walk(
    alive: Float, n: int, c: int, knots: Float, knot_t_s: Float, interval: int, walked: Float
) -> None:
    """Add the last interval's change of the slow errors."""
    walk_of(alive, n, c, knots, knot_t_s, interval, walked)


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
