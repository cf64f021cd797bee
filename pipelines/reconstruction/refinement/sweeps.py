"""Elimination of a stretch of time, forwards and backwards, compiled.

A front [N, N] holds the normal equations of the live unknowns, lower triangle: joints at three times (3 n),
knots before and after (2 c), unknowns shared by all times. Eliminated unknowns x depend on the rest z of the
front as x = R' (y - W' z), with R the inverse of the Cholesky factor of their own block and W = B R'.
"""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.reconstruction.refinement.kernels import (
    NUMBERS,
    WHITE,
    add_bones,
    add_motion,
    assemble,
    posterior_of_picture,
)

_STRIP = 48  # rows; with fewer, products are too small to be fast


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
    first: int,
    last: int,
    t_s: Float,
    position: Float,
    knots: Float,
    shared: Float,
    white: Float,
    starts: Int64,
    camera: Int64,
    when: Float,
    fraction: Float,
    of_time: Int64,
    xy: Float,
    sharpness: Float,
    pose_position: Float,
    pose_rotation: Float,
    speed: Float,
    turn: Float,
    trust: Float,
    bound2: float,
    white_row: Int64,
    white_precision: Float,
    entry_start: Int64,
    entry_number: Int64,
    entry_knot: Int64,
    entry_column: Int64,
    clock_column: Int64,
    knot_count: int,
    curvature: Float,
    spread: Float,
    precision: Float,
    hold: float,
    bones: Int64,
    bone_sigma: Float,
    grown: float,
    own_times: int,
    tie_before: Float,
    tie_after: Float,
    tie_variance: Float,
    front: Float,
    gradient: Float,
    interval: int,
    inverse: Float,
    across: Float,
    solved: Float,
    knot_inverse: Float,
    knot_across: Float,
    knot_solved: Float,
) -> tuple[int, float]:
    """Eliminate joints and knots of the times from `first` to before `last`; change the front in place.

    Of the last three times, only bones of the first `own_times` count here. Factors go to row `time - first`
    of `inverse` [., n, n], `across` [., m, n] and `solved` [., n]. Factors of knots go to row `k - interval`
    of the knot arrays. Returns the interval of the time `last`, in which the front ends, and half the log
    determinant of all eliminated unknowns, white errors included.
    """
    J = position.shape[1]
    n, c = 3 * J, knot_count
    size = len(gradient)
    s = size - 3 * n - 2 * c
    lengths = shared[len(shared) - len(bones) :]
    length_offset = size - len(bones)
    half = 0.0
    first_interval = interval
    own, beside = np.empty((n, n)), np.empty((size - n, n))
    knot_own, knot_beside = np.empty((c, c)), np.empty((2 * n + c + s, c))
    for time in range(first, last + 1):
        while c and interval < of_time[time]:
            k = interval - first_interval
            half += eliminate_knot(
                front, gradient, n, c, knot_own, knot_beside, knot_inverse[k], knot_across[k], knot_solved[k]
            )
            interval += 1
            tie_knots(front, gradient, n, c, knots, interval, tie_before, tie_after, tie_variance)
        if time == last:
            break
        half += assemble(
            starts[time], starts[time + 1], time, t_s, position, knots, shared, white, camera, when, fraction,
            interval, xy, sharpness, pose_position, pose_rotation, speed, turn, trust, bound2,
            white_row, white_precision, entry_start, entry_number, entry_knot, entry_column, clock_column,
            knot_count, front, gradient,
        )  # fmt: skip
        add_motion(
            position[time : time + 3], curvature[time], precision, 1.0 / (spread[time] * grown**2), hold,
            lengths, length_offset, front, gradient,
        )  # fmt: skip
        # All bones of a time at once with the first of its three; the last two times may have their own.
        for offset in range(1 if time < len(t_s) - 3 else own_times):
            add_bones(
                position[time + offset], bones, lengths, bone_sigma, grown, n * offset, length_offset, front,
                gradient,
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
    by_before: Float,
    by_after: Float,
    variance: Float,
) -> None:
    """Add the random walk between the knot before and the knot after."""
    before, after = 3 * n, 3 * n + c
    for i in range(c):
        b, a, q = by_before[interval, i], by_after[interval, i], variance[interval, i]
        change = a * knots[interval + 1, i] - b * knots[interval, i]
        front[before + i, before + i] += b * b / q
        front[after + i, after + i] += a * a / q
        front[after + i, before + i] -= a * b / q
        gradient[before + i] -= b * change / q
        gradient[after + i] += a * change / q


@cached
def begin(
    front: Float,
    gradient: Float,
    n: int,
    c: int,
    knots: Float,
    by_before: Float,
    by_after: Float,
    variance: Float,
) -> None:
    """Tie the first two knots."""
    tie_knots(front, gradient, n, c, knots, 0, by_before, by_after, variance)


@cached
def backwards(
    first: int,
    last: int,
    of_time: Int64,
    interval: int,
    first_interval: int,
    inverse: Float,
    across: Float,
    solved: Float,
    knot_inverse: Float,
    knot_across: Float,
    knot_solved: Float,
    position: Float,
    knots: Float,
    shared: Float,
) -> int:
    """Solve for joints [T, n] and knots [K, c] of a stretch from its end, in place; return the interval."""
    n, c = position.shape[1], knots.shape[1]
    s = len(shared)
    z, zk = np.empty(2 * n + 2 * c + s), np.empty(2 * n + c + s)
    for i in range(s):
        z[2 * n + 2 * c + i] = shared[i]
        zk[2 * n + c + i] = shared[i]
    rest_n, rest_c = np.empty(n), np.empty(c)
    for time in range(last - 1, first - 2, -1):
        # Solve knots eliminated after this time first; at the end, those before the stretch.
        while c and interval > (of_time[time] if time >= first else first_interval):
            interval -= 1
            follow_knot(
                interval - first_interval, time, interval, n, c, zk, rest_c, knot_inverse, knot_across,
                knot_solved, position, knots,
            )  # fmt: skip
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
    row: int,
    time: int,
    interval: int,
    n: int,
    c: int,
    z: Float,
    rest: Float,
    inverse: Float,
    across: Float,
    solved: Float,
    position: Float,
    knots: Float,
) -> None:
    """Solve for a knot from the next knot and the joints at `time` + 1 and `time` + 2."""
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
    t_s: Float,
    position: Float,
    knots: Float,
    shared: Float,
    white: Float,
    starts: Int64,
    camera: Int64,
    when: Float,
    fraction: Float,
    of_time: Int64,
    xy: Float,
    sharpness: Float,
    pose_position: Float,
    pose_rotation: Float,
    speed: Float,
    turn: Float,
    trust: Float,
    bound2: float,
    white_row: Int64,
    white_precision: Float,
    entry_start: Int64,
    entry_number: Int64,
    entry_knot: Int64,
    entry_column: Int64,
    clock_column: Int64,
    knot_count: int,
    curvature: Float,
    spread: Float,
    bones: Int64,
    own_times: int,
    knot_t_s: Float,
    others: Float,
    interval: int,
    first_interval: int,
    inverse: Float,
    across: Float,
    knot_inverse: Float,
    knot_across: Float,
    every: int,
    covariance: Float,
    acceleration: Float,
    bone_sums: Float,
    image: Float,
    white_sums: Float,
    walked: Float,
    starting: Float,
) -> tuple[Float, int]:
    """Compute covariances of a stretch from its end, and sums for the levels.

    `others` [m, m] is the covariance of the unknowns alive at the end. `covariance` [T, J, 3, 3] is filled
    unless empty; of the last three times only the first `own_times`. Sums are made unless `every` is 0, over
    the pictures of every `every`-th time: `acceleration` [2, J, J] posterior mean squares and variances;
    `bone_sums` [B]; `image` [J, 2] weighted squares, and their degrees of freedom after the fit; `white_sums`
    [2, 3] of position and rotation: mean squares, count, share determined by the pictures (1 - posterior /
    prior variance); `walked` [c, 3] of every knot's change per s: mean squares, count, posterior variances;
    `starting` [c + shared, 2] at time 0, unless empty: mean square, variance. Returns the covariance of the
    unknowns alive at the beginning, and the interval there.
    """
    J = position.shape[1]
    n, c = 3 * J, knot_count
    m = len(others)
    size = m + n
    whole = np.empty((size, size))
    alive = others.copy()
    believed, residual = np.empty(J), np.empty((J, 2))
    by_joint, by_number = np.zeros((J, 2, 3)), np.zeros((J, 2, NUMBERS))
    of_joints, beside = np.empty((J, 3, 3)), np.empty((J, 3, NUMBERS))
    of_numbers, of_white = np.empty((NUMBERS, NUMBERS)), np.empty(WHITE)
    last_time = len(t_s) - 3
    for time in range(last - 1, first - 2, -1):
        # As in the forward pass; at the end, the knots before the stretch.
        while c and interval > (of_time[time] if time >= first else first_interval):
            interval -= 1
            row = interval - first_interval
            alive = before_knot(alive, n, c, knot_inverse[row], knot_across[row])
            if every:
                walk_of(alive, n, c, knots, knot_t_s, interval, walked)
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
            for k in range(own_times if time == last_time else 1):
                for joint in range(J):
                    p = k * n + 3 * joint
                    for a in range(3):
                        for b in range(3):
                            covariance[time + k, joint, a, b] = whole[
                                k * n + 3 * joint + a, k * n + 3 * joint + b
                            ]
        if every:
            acceleration_of(whole, position, curvature, spread, time, acceleration)
            bones_of(whole, position, shared, bones, time, bone_sums)
            if time % every == 0:
                for g in range(starts[time], starts[time + 1]):
                    posterior_of_picture(
                        g, time, t_s, position, knots, shared, white, camera, when, fraction, interval, xy,
                        sharpness, pose_position, pose_rotation, speed, turn, trust, bound2, white_row,
                        white_precision, entry_start, entry_number, entry_knot, entry_column, clock_column,
                        knot_count, residual, believed, by_joint, by_number, whole, of_joints, beside,
                        of_numbers, of_white,
                    )  # fmt: skip
                    noise_of(residual, believed, by_joint, by_number, of_joints, beside, of_numbers, image)
                    white_of(white[g], white_precision[white_row[g]], of_white, white_sums)
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
def noise_of(
    residual: Float,
    believed: Float,
    by_joint: Float,
    by_number: Float,
    of_joints: Float,
    across: Float,
    of_numbers: Float,
    sums: Float,
) -> None:
    """Add a picture's contribution to image noise [J, 2]; arguments as in `posterior_of_picture`."""
    for joint in range(len(believed)):
        if believed[joint] == 0.0:
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
            sums[joint, 0] += believed[joint] * residual[joint, axis] ** 2
            sums[joint, 1] += believed[joint] * (1 - variance)


@helper
def white_of(white: Float, precision: Float, variance: Float, sums: Float) -> None:
    """Add a picture's white error [6], with posterior `variance` [6], to the sums [2, 3] of its level."""
    for i in range(WHITE):
        if not np.isfinite(precision[i, i]):
            continue
        told = 1 - variance[i] * precision[i, i]
        part = i // 3
        sums[part, 0] += white[i] ** 2 + variance[i]
        sums[part, 1] += 1
        sums[part, 2] += told
