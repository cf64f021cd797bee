"""Equations of one camera's picture for joints and cameras: residuals, derivatives, normal equations.

A joint X appears in a camera at y = exp(r) R' (X - p + s) + b, where (p, R) is the logged
world_from_camera, s a shift in the world (m), r a rotation vector in the camera (rad) and b a shift in
the camera (m): the inverse of how `geometry.noise` disturbs a pose. The ten numbers of a picture are s, r, b
and its camera's clock offset; a white error adds to s and r and is eliminated picture by picture.
Interpolation is quadratic over three times of the skeleton.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.compilation import cached, helper

# Each picture has so many: shift in the world, rotation, shift in the camera, clock.
NUMBERS = 10
# The first so many numbers of a picture have a white part.
WHITE = 6
# A joint nearer to the camera's plane is not used.
_NEAREST_M = 0.1


class State(NamedTuple):
    """Values of the unknowns."""

    position: Float  # [T, J, 3] m
    knots: Float  # [K, knot_count]
    shared: Float  # [shared_count]
    white: Float  # [G, 6]

    def moved(self, step: State, share: float) -> State:
        """Return the state moved by a share of a step."""
        return State(*(value + share * change for value, change in zip(self, step, strict=True)))


class Entries(NamedTuple):
    """Links from unknowns to the numbers that they add to, camera by camera; see `problem.Layout`."""

    start: Int64  # [C + 1] first entry of each camera
    number: Int64  # [E] of the picture's ten
    knot: Bool  # [E] False for an unknown shared by all times
    column: Int64  # [E] among the unknowns of a knot, or the shared ones
    clock_column: Int64  # [C] -1 for a known clock
    knot_count: int  # unknowns of a knot


class PictureArrays(NamedTuple):
    """Pictures in the order of `first`, as `problem.Pictures`, with their places in a system's priors."""

    first: Int64  # [G]
    camera: Int64  # [G]
    when_s: Float  # [G]
    rays: Float  # [G, J, 2]
    sharpness: Float  # [G, J]
    position: Float  # [G, 3]
    rotation: Float  # [G, 3, 3]
    speed: Float  # [G, 3]
    turn: Float  # [G, 3]
    interval: Int64  # [G] the knot before
    fraction: Float  # [G] of the time to the next knot
    white_row: Int64  # [G] row of `Equations.white_precision`


class Equations(NamedTuple):
    """Pictures and the state at which they are linearised."""

    t_s: Float  # [T]
    state: State
    pictures: PictureArrays
    entries: Entries
    bound2: float  # of the robust loss
    white_precision: Float  # [., 6, 6] inverse covariances of white errors; inf without white errors


class Linearised(NamedTuple):
    """Equations of one picture, overwritten by the next."""

    joints: Float  # [J, 3] m at the picture's time
    velocity: Float  # [J, 3] m/s
    weight: Float  # [3] of the skeleton's three times
    slope: Float  # [3] of the same, for the velocity
    number: Float  # [10]
    residual: Float  # [J, 2] whitened; NaN for joints that are not seen or behind the camera
    by_joint: Float  # [J, 2, 3]
    by_number: Float  # [J, 2, 10]
    view_weight: Float  # [J] 0 for joints without a residual


@helper
def exponential(rotation_vector: Float, rotation: Float, jacobian: Float) -> None:
    """Compute exp(r) [3, 3] and its left Jacobian (Barfoot 2017, 7.77 and 7.85)."""
    angle2 = rotation_vector[0] ** 2 + rotation_vector[1] ** 2 + rotation_vector[2] ** 2
    if angle2 < 1e-8:
        a, b, c = 1.0 - angle2 / 6, 0.5 - angle2 / 24, 1.0 / 6 - angle2 / 120
    else:
        angle = np.sqrt(angle2)
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle2
        c = (1.0 - a) / angle2
    for i in range(3):
        for j in range(3):
            product = rotation_vector[i] * rotation_vector[j]
            one = 1.0 if i == j else 0.0
            rotation[i, j] = (1.0 - b * angle2) * one + b * product
            jacobian[i, j] = (1.0 - c * angle2) * one + c * product
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        rotation[i, j] -= a * rotation_vector[k]
        rotation[j, i] += a * rotation_vector[k]
        jacobian[i, j] -= b * rotation_vector[k]
        jacobian[j, i] += b * rotation_vector[k]


@cached
def turned(rotation_vectors: Float) -> Float:
    """Compute exp(r) [N, 3, 3] of rotation vectors [N, 3] (rad)."""
    rotations, unused = np.empty((len(rotation_vectors), 3, 3)), np.empty((3, 3))
    for n in range(len(rotation_vectors)):
        exponential(rotation_vectors[n], rotations[n], unused)
    return rotations


@helper
def weights_between(t0: float, t1: float, t2: float, t: float, weight: Float, slope: Float) -> None:
    """Compute Lagrange's quadratic through three times: weights of values, and of the derivative, at t."""
    weight[0] = (t - t1) * (t - t2) / ((t0 - t1) * (t0 - t2))
    weight[1] = (t - t0) * (t - t2) / ((t1 - t0) * (t1 - t2))
    weight[2] = (t - t0) * (t - t1) / ((t2 - t0) * (t2 - t1))
    slope[0] = (2 * t - t1 - t2) / ((t0 - t1) * (t0 - t2))
    slope[1] = (2 * t - t0 - t2) / ((t1 - t0) * (t1 - t2))
    slope[2] = (2 * t - t0 - t1) / ((t2 - t0) * (t2 - t1))


@helper
def linearise(
    joints: Float,
    velocity: Float,
    number: Float,
    rays: Float,
    sharpness: Float,
    position: Float,
    rotation: Float,
    speed: Float,
    turn: Float,
    residual: Float,
    by_joint: Float,
    by_number: Float,
) -> None:
    """Compute the whitened residuals of a picture, NaN for joints not seen, and their derivatives.

    `joints` (m) and `velocity` (m/s) are of the picture's time, `number` its ten corrections.
    `sharpness` is 1 / standard deviation of an image point. `position` and `rotation` are the logged
    pose at the uncorrected time, `speed` (m/s, world) and `turn` (rad/s, camera) how it changes.
    """
    turned, left, shutter, unused = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    exponential(number[3:6], turned, left)
    exponential(-number[9] * turn, shutter, unused)
    seen, before, by_rotation, by_clock = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    camera_from_world, corrected_from_world = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += shutter[i, k] * rotation[j, k]
            camera_from_world[i, j] = total
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += turned[i, k] * camera_from_world[k, j]
            corrected_from_world[i, j] = total
    for joint in range(len(joints)):
        residual[joint, 0] = residual[joint, 1] = np.nan
        if np.isnan(rays[joint, 0]):
            continue
        for i in range(3):
            before[i] = 0.0
            for k in range(3):
                away = joints[joint, k] - position[k] - speed[k] * number[9] + number[k]
                before[i] += camera_from_world[i, k] * away
        for i in range(3):
            seen[i] = 0.0
            for k in range(3):
                seen[i] += turned[i, k] * before[k]
        # d exp(r) v = -hat(exp(r) v) J dr
        for j in range(3):
            by_rotation[0, j] = left[1, j] * seen[2] - left[2, j] * seen[1]
            by_rotation[1, j] = left[2, j] * seen[0] - left[0, j] * seen[2]
            by_rotation[2, j] = left[0, j] * seen[1] - left[1, j] * seen[0]
        swung0 = before[1] * turn[2] - before[2] * turn[1]
        swung1 = before[2] * turn[0] - before[0] * turn[2]
        swung2 = before[0] * turn[1] - before[1] * turn[0]
        for i in range(3):
            by_clock[i] = turned[i, 0] * swung0 + turned[i, 1] * swung1 + turned[i, 2] * swung2
            for k in range(3):
                by_clock[i] += corrected_from_world[i, k] * (velocity[joint, k] - speed[k])
        for i in range(3):
            seen[i] += number[6 + i]
        if seen[2] < _NEAREST_M:
            continue
        scale = sharpness[joint] / seen[2]
        for axis in range(2):
            slant = seen[axis] / seen[2]
            residual[joint, axis] = sharpness[joint] * (slant - rays[joint, axis])
            for j in range(3):
                gradient = corrected_from_world[axis, j] - slant * corrected_from_world[2, j]
                by_joint[joint, axis, j] = scale * gradient
                by_number[joint, axis, j] = scale * gradient
                by_number[joint, axis, 3 + j] = scale * (by_rotation[axis, j] - slant * by_rotation[2, j])
                by_number[joint, axis, 6 + j] = 0.0
            by_number[joint, axis, 6 + axis] = scale
            by_number[joint, axis, 8] = -scale * slant
            by_number[joint, axis, 9] = scale * (by_clock[axis] - slant * by_clock[2])


@helper
def confidence_of(squared: float, bound2: float) -> float:
    """Weigh a view by its whitened squared residual: 1 within the bound, then less: bounded in its loss."""
    if not squared > bound2:
        return 1.0
    return (bound2 / squared) ** 2


@helper
def loss_of(squared: float, bound2: float) -> float:
    """Compute the loss with the weights of `confidence_of`: r^2 within the bound, 2 b - b^2 / r^2 beyond."""
    if not squared > bound2:
        return squared
    return 2 * bound2 - bound2 * bound2 / squared


@helper
def factorise(matrix: Float) -> None:
    """Replace a small matrix by its lower Cholesky factor."""
    n = len(matrix)
    for j in range(n):
        for i in range(j, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[j, j] = np.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]


@helper
def forward(factor: Float, vector: Float) -> None:
    """Replace v by L^-1 v."""
    for i in range(len(vector)):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]


@helper
def backward(factor: Float, vector: Float) -> None:
    """Replace v by L^-T v."""
    for i in range(len(vector) - 1, -1, -1):
        for k in range(i + 1, len(vector)):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@helper
def at_picture(
    first: int, t_s: Float, when: float, position: Float, weight: Float, slope: Float, out: Float, rate: Float
) -> None:
    """Interpolate joints (m) and velocities (m/s) [J, 3] to a picture's time from three times at `first`."""
    weights_between(t_s[first], t_s[first + 1], t_s[first + 2], when, weight, slope)
    for joint in range(len(out)):
        for i in range(3):
            out[joint, i] = 0.0
            rate[joint, i] = 0.0
            for k in range(3):
                out[joint, i] += weight[k] * position[first + k, joint, i]
                rate[joint, i] += slope[k] * position[first + k, joint, i]


@helper
def numbers_of(
    camera: int,
    fraction: float,
    interval: int,
    entries: Entries,
    knots: Float,
    shared: Float,
    white: Float,
    out: Float,
) -> None:
    """Compute the ten numbers of a picture from the unknowns."""
    out[:] = 0.0
    for e in range(entries.start[camera], entries.start[camera + 1]):
        column = entries.column[e]
        if entries.knot[e]:
            value = (1 - fraction) * knots[interval, column] + fraction * knots[interval + 1, column]
        else:
            value = shared[column]
        out[entries.number[e]] += value
    for i in range(WHITE):
        out[i] += white[i]


@helper
def unknowns_of(
    camera: int, fraction: float, n: int, entries: Entries, column: Int64, of_number: Int64, share: Float
) -> int:
    """List the front's unknowns in a picture's numbers with their shares, and return their count."""
    count = 0
    for e in range(entries.start[camera], entries.start[camera + 1]):
        if entries.knot[e]:
            column[count] = 3 * n + entries.column[e]
            of_number[count] = entries.number[e]
            share[count] = 1 - fraction
            count += 1
            column[count] = 3 * n + entries.knot_count + entries.column[e]
            of_number[count] = entries.number[e]
            share[count] = fraction
        else:
            column[count] = 3 * n + 2 * entries.knot_count + entries.column[e]
            of_number[count] = entries.number[e]
            share[count] = 1.0
        count += 1
    return count


@helper
def linearised(J: int) -> Linearised:
    """Allocate the equations of a picture of J joints."""
    return Linearised(
        np.empty((J, 3)), np.empty((J, 3)), np.empty(3), np.empty(3), np.empty(NUMBERS), np.empty((J, 2)),
        np.zeros((J, 2, 3)), np.zeros((J, 2, NUMBERS)), np.empty(J),
    )  # fmt: skip


@helper
def linearise_picture(
    g: int, t_s: Float, state: State, pictures: PictureArrays, entries: Entries, out: Linearised
) -> None:
    """Linearise a picture at the state; `view_weight` is left to `weigh`."""
    c = pictures.camera[g]
    clock = entries.clock_column[c]
    when = pictures.when_s[g] + (state.shared[clock] if clock >= 0 else 0.0)
    at_picture(pictures.first[g], t_s, when, state.position, out.weight, out.slope, out.joints, out.velocity)
    numbers_of(
        c, pictures.fraction[g], pictures.interval[g], entries, state.knots, state.shared, state.white[g],
        out.number,
    )  # fmt: skip
    linearise(
        out.joints, out.velocity, out.number, pictures.rays[g], pictures.sharpness[g], pictures.position[g],
        pictures.rotation[g], pictures.speed[g], pictures.turn[g], out.residual, out.by_joint, out.by_number,
    )  # fmt: skip


@helper
def weigh(residual: Float, bound2: float, view_weight: Float) -> None:
    """Compute the weights [J] of a picture's views from their residuals [J, 2]; 0 without a residual."""
    for joint in range(len(residual)):
        squared = residual[joint, 0] ** 2 + residual[joint, 1] ** 2
        view_weight[joint] = 0.0 if np.isnan(squared) else confidence_of(squared, bound2)


@helper
def normal_equations(
    picture: Linearised,
    of_joints: Float,
    across: Float,
    of_numbers: Float,
    joint_gradient: Float,
    number_gradient: Float,
) -> None:
    """Sum the normal equations of a picture: [J, 3, 3], [J, 3, 10], [10, 10], gradients [J, 3], [10]."""
    residual, by_joint, by_number = picture.residual, picture.by_joint, picture.by_number
    of_joints[:] = 0.0
    across[:] = 0.0
    of_numbers[:] = 0.0
    joint_gradient[:] = 0.0
    number_gradient[:] = 0.0
    for joint in range(len(residual)):
        weight = picture.view_weight[joint]
        if weight == 0.0:
            continue
        for axis in range(2):
            r = weight * residual[joint, axis]
            for a in range(NUMBERS):
                weighted = weight * by_number[joint, axis, a]
                number_gradient[a] += by_number[joint, axis, a] * r
                for b in range(a + 1):
                    of_numbers[a, b] += weighted * by_number[joint, axis, b]
                for i in range(3):
                    across[joint, i, a] += by_joint[joint, axis, i] * weighted
            for i in range(3):
                joint_gradient[joint, i] += by_joint[joint, axis, i] * r
                for j in range(3):
                    of_joints[joint, i, j] += weight * by_joint[joint, axis, i] * by_joint[joint, axis, j]
    for a in range(NUMBERS):
        for b in range(a):
            of_numbers[b, a] = of_numbers[a, b]


@helper
def assemble(
    first_picture: int, last_picture: int, equations: Equations, front: Float, gradient: Float
) -> None:
    """Add pictures with the same three times to the front; their white errors are eliminated.

    The front's unknowns are the joints at three times, the knots on both sides of the interval, and the
    shared unknowns; only its lower triangle is kept.
    """
    t_s, state, pictures, entries, bound2, white_precision = equations
    white = state.white
    J = state.position.shape[1]
    n = 3 * J
    picture = linearised(J)
    weight = picture.weight
    of_joints, across = np.empty((J, 3, 3)), np.empty((J, 3, NUMBERS))
    of_numbers = np.empty((NUMBERS, NUMBERS))
    joint_gradient, number_gradient = np.empty((J, 3)), np.empty(NUMBERS)
    factor, by_white = np.empty((WHITE, WHITE)), np.empty((n + NUMBERS + 1, WHITE))
    z = by_white[n + NUMBERS]  # the gradient is stored below the derivatives
    by_both = np.empty((n, n))  # what the white errors take from each pair of coordinates
    most = 2 * (entries.column.size + 1)
    column, of_number, share = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    for g in range(first_picture, last_picture):
        linearise_picture(g, t_s, state, pictures, entries, picture)
        weigh(picture.residual, bound2, picture.view_weight)
        normal_equations(picture, of_joints, across, of_numbers, joint_gradient, number_gradient)
        row = pictures.white_row[g]
        eliminated = np.isfinite(white_precision[row, 0, 0])
        if eliminated:
            for a in range(WHITE):
                z[a] = number_gradient[a]
                for b in range(WHITE):
                    factor[a, b] = of_numbers[a, b] + white_precision[row, a, b]
                    z[a] += white_precision[row, a, b] * white[g, b]
                for p in range(n):
                    by_white[p, a] = across[p // 3, p % 3, a]
                for b in range(NUMBERS):
                    by_white[n + b, a] = of_numbers[b, a]
            factorise(factor)
            for line in range(len(by_white)):
                forward(factor, by_white[line])
            for p in range(n):
                for q in range(p + 1):
                    total = 0.0
                    for a in range(WHITE):
                        total += by_white[p, a] * by_white[q, a]
                    by_both[p, q] = by_both[q, p] = total
        else:
            by_white[:] = 0.0

        unknowns = unknowns_of(pictures.camera[g], pictures.fraction[g], n, entries, column, of_number, share)

        for k in range(3):
            if weight[k] == 0.0:
                continue
            for m in range(k + 1):
                both = weight[k] * weight[m]
                if both == 0.0:
                    continue
                for joint in range(J):
                    for i in range(3):
                        for j in range(3):
                            front[k * n + 3 * joint + i, m * n + 3 * joint + j] += (
                                both * of_joints[joint, i, j]
                            )
                if eliminated:
                    for p in range(n):
                        for q in range(p + 1 if k == m else n):
                            front[k * n + p, m * n + q] -= both * by_both[p, q]
            for p in range(n):
                down = joint_gradient[p // 3, p % 3]
                for a in range(WHITE):
                    down -= by_white[p, a] * z[a]
                gradient[k * n + p] += weight[k] * down
            for e in range(unknowns):
                a = of_number[e]
                for p in range(n):
                    total = across[p // 3, p % 3, a]
                    for i in range(WHITE):
                        total -= by_white[p, i] * by_white[n + a, i]
                    front[column[e], k * n + p] += weight[k] * share[e] * total
        for e in range(unknowns):
            a = of_number[e]
            down = number_gradient[a]
            for i in range(WHITE):
                down -= by_white[n + a, i] * z[i]
            gradient[column[e]] += share[e] * down
            for f in range(unknowns):
                if column[f] <= column[e]:
                    b = of_number[f]
                    total = of_numbers[a, b]
                    for i in range(WHITE):
                        total -= by_white[n + a, i] * by_white[n + b, i]
                    front[column[e], column[f]] += share[e] * share[f] * total


@cached
def whiten(equations: Equations, step: State) -> None:
    """Compute the step of every picture's white error for a given step of all other unknowns, in place."""
    t_s, state, pictures, entries, bound2, white_precision = equations
    white = state.white
    J = state.position.shape[1]
    picture = linearised(J)
    residual, by_joint, by_number = picture.residual, picture.by_joint, picture.by_number
    numbers_by, factor, nothing = np.empty(NUMBERS), np.empty((WHITE, WHITE)), np.zeros(WHITE)
    for g in range(len(pictures.camera)):
        z = step.white[g]
        z[:] = 0.0
        row = pictures.white_row[g]
        if not np.isfinite(white_precision[row, 0, 0]):
            continue
        linearise_picture(g, t_s, state, pictures, entries, picture)
        weigh(residual, bound2, picture.view_weight)
        numbers_of(
            pictures.camera[g], pictures.fraction[g], pictures.interval[g], entries, step.knots,
            step.shared, nothing, numbers_by,
        )  # fmt: skip
        for a in range(WHITE):
            for b in range(WHITE):
                factor[a, b] = white_precision[row, a, b]
                z[a] -= factor[a, b] * white[g, b]
        for joint in range(J):
            if np.isnan(residual[joint, 0]):
                continue
            view_weight = picture.view_weight[joint]
            for axis in range(2):
                after = residual[joint, axis]
                for i in range(3):
                    for k in range(3):
                        by_time = by_joint[joint, axis, i] * picture.weight[k]
                        after += by_time * step.position[pictures.first[g] + k, joint, i]
                for a in range(NUMBERS):
                    after += by_number[joint, axis, a] * numbers_by[a]
                for a in range(WHITE):
                    z[a] -= view_weight * by_number[joint, axis, a] * after
                    for b in range(WHITE):
                        factor[a, b] += view_weight * by_number[joint, axis, a] * by_number[joint, axis, b]
        factorise(factor)
        forward(factor, z)
        backward(factor, z)


@cached
def misfit(equations: Equations, first: int, total: float, residuals: Float, numbers: Float) -> float:
    """Add the loss of G pictures to a total; fill whitened residuals [G, J, 2] and numbers [G, 10]."""
    t_s, state, pictures, entries, bound2, _ = equations
    picture = linearised(state.position.shape[1])
    residual = picture.residual
    for g in range(first, first + len(residuals)):
        linearise_picture(g, t_s, state, pictures, entries, picture)
        for a in range(NUMBERS):
            numbers[g - first, a] = picture.number[a]
        for joint in range(len(residual)):
            for axis in range(2):
                residuals[g - first, joint, axis] = residual[joint, axis]
            value = residual[joint, 0] ** 2 + residual[joint, 1] ** 2
            if not np.isnan(value):
                total += loss_of(value, bound2)
    return total


class Posterior(NamedTuple):
    """Covariances of the unknowns in a picture's residuals, overwritten by the next picture."""

    of_joints: Float  # [J, 3, 3] m^2 at the picture's time
    across: Float  # [J, 3, 10] of joints with the picture's numbers
    of_numbers: Float  # [10, 10] white part included
    of_white: Float  # [6] variances of the white part alone


@helper
def posterior_of_picture(
    g: int, equations: Equations, whole: Float, picture: Linearised, out: Posterior
) -> None:
    """Linearise a picture, and compute the posterior of its unknowns from the front's covariance [N, N]."""
    t_s, state, pictures, entries, bound2, white_precision = equations
    weight = picture.weight
    of_joints, across, of_numbers, of_white = out
    J = len(of_joints)
    n = 3 * J
    joint_gradient, number_gradient = np.empty((J, 3)), np.empty(NUMBERS)
    factor, own = np.zeros((WHITE, WHITE)), np.zeros((WHITE, WHITE))
    linearise_picture(g, t_s, state, pictures, entries, picture)
    weigh(picture.residual, bound2, picture.view_weight)
    most = 2 * (entries.column.size + 1)
    column, of_number, share = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    unknowns = unknowns_of(pictures.camera[g], pictures.fraction[g], n, entries, column, of_number, share)
    # The white error depends on the front by `follows` [6, N], and has its own posterior in addition.
    follows = np.zeros((WHITE, len(whole)))
    row = pictures.white_row[g]
    has_white = np.isfinite(white_precision[row, 0, 0])
    if has_white:
        normal_equations(picture, of_joints, across, of_numbers, joint_gradient, number_gradient)
        for a in range(WHITE):
            for b in range(WHITE):
                factor[a, b] = of_numbers[a, b] + white_precision[row, a, b]
        factorise(factor)
        for a in range(WHITE):
            own[a, a] = 1.0
            forward(factor, own[a])
            backward(factor, own[a])
            for p in range(n):
                total = 0.0
                for b in range(WHITE):
                    total += own[a, b] * across[p // 3, p % 3, b]
                for k in range(3):
                    follows[a, k * n + p] -= weight[k] * total
            for e in range(unknowns):
                for b in range(WHITE):
                    follows[a, column[e]] -= share[e] * own[a, b] * of_numbers[of_number[e], b]
    of_joints[:] = 0.0
    across[:] = 0.0
    of_numbers[:] = 0.0
    of_white[:] = 0.0
    for joint in range(J):
        for k in range(3):
            for i in range(3):
                p = k * n + 3 * joint + i
                for m in range(3):
                    for j in range(3):
                        q = m * n + 3 * joint + j
                        of_joints[joint, i, j] += weight[k] * weight[m] * whole[p, q]
                for e in range(unknowns):
                    across[joint, i, of_number[e]] += weight[k] * share[e] * whole[p, column[e]]
    for e in range(unknowns):
        for f in range(unknowns):
            both = share[e] * share[f] * whole[column[e], column[f]]
            of_numbers[of_number[e], of_number[f]] += both
    if not has_white:
        return
    with_front = np.dot(follows, whole)  # [6, N]
    whole_white = np.dot(with_front, follows.T)
    for a in range(WHITE):
        for joint in range(J):
            for k in range(3):
                for i in range(3):
                    across[joint, i, a] += weight[k] * with_front[a, k * n + 3 * joint + i]
        for e in range(unknowns):
            both = share[e] * with_front[a, column[e]]
            of_numbers[a, of_number[e]] += both
            of_numbers[of_number[e], a] += both
        for b in range(WHITE):
            of_numbers[a, b] += own[a, b] + whole_white[a, b]
        of_white[a] = own[a, a] + whole_white[a, a]


@helper
def add_motion(
    position: Float,
    weights: Float,
    precision: Float,
    scale: float,
    hold: float,
    lengths: Float,
    length_offset: int,
    front: Float,
    gradient: Float,
) -> None:
    """Add the prior of the acceleration between three times, in units of the body's size.

    The size is the mean of the bone lengths. Without it the estimate would shrink: smaller bodies
    accelerate less, and pictures do not determine the scale. `precision` [J, J] times `scale` is that of
    each axis at the present size. `hold` is added to the diagonal of the first time; it has no gradient.
    """
    J, B = position.shape[1], len(lengths)
    n = 3 * J
    shrinking = 1.0 / lengths.sum() if B else 0.0  # d log(size) / d length
    cost = 0.0
    acceleration, pull = np.empty(J), np.empty(J)
    for axis in range(3):
        for b in range(J):
            acceleration[b] = 0.0
            for k in range(3):
                acceleration[b] += weights[k] * position[k, b, axis]
        for a in range(J):
            pull[a] = 0.0
            for b in range(J):
                pull[a] += scale * precision[a, b] * acceleration[b]
            cost += pull[a] * acceleration[a]
        for k in range(3):
            for a in range(J):
                gradient[k * n + 3 * a + axis] += weights[k] * pull[a]
                for b in range(B):
                    front[length_offset + b, k * n + 3 * a + axis] -= weights[k] * pull[a] * shrinking
    for b in range(B):
        gradient[length_offset + b] -= cost * shrinking
        for d in range(b + 1):
            front[length_offset + b, length_offset + d] += cost * shrinking * shrinking
    for k in range(3):
        for m in range(k + 1):
            both = scale * weights[k] * weights[m]
            for a in range(J):
                for b in range(a + 1 if k == m else J):
                    for axis in range(3):
                        front[k * n + 3 * a + axis, m * n + 3 * b + axis] += both * precision[a, b]
    for i in range(n):
        front[i, i] += hold


@helper
def add_bones(
    position: Float,
    bones: Int64,
    lengths: Float,
    sigma: Float,
    grown: float,
    offset: int,
    length_offset: int,
    front: Float,
    gradient: Float,
) -> None:
    """Add the prior of the bones at one time around their lengths, in units of the body's size.

    A length changes the residual of its bone, and by the body's size those of all bones alike.
    """
    n, B = 3 * len(position), len(lengths)
    shrinking = 1.0 / lengths.sum() if B else 0.0
    direction, together, own = np.empty(3), np.zeros(n), np.zeros(B)
    cost = 0.0
    for b in range(len(bones)):
        i, j = bones[b]
        length = 0.0
        for axis in range(3):
            direction[axis] = position[j, axis] - position[i, axis]
            length += direction[axis] ** 2
        length = np.sqrt(length)
        if length < 1e-6:
            continue
        weight = 1 / (sigma[b] * grown) ** 2
        residual = length - lengths[b]
        own[b] = weight * residual
        cost += weight * residual**2
        front[length_offset + b, length_offset + b] += weight
        low, high = 3 * min(i, j), 3 * max(i, j)
        sign = 1.0 if j > i else -1.0  # of the joint with the larger number
        for p in range(3):
            along = sign * direction[p] / length
            front[length_offset + b, offset + high + p] -= weight * along
            front[length_offset + b, offset + low + p] += weight * along
            together[high + p] += own[b] * along
            together[low + p] -= own[b] * along
            for q in range(3):
                product = weight * direction[p] * direction[q] / length**2
                front[offset + high + p, offset + low + q] -= product
                if q <= p:
                    front[offset + high + p, offset + high + q] += product
                    front[offset + low + p, offset + low + q] += product
    for p in range(n):
        gradient[offset + p] += together[p]
    for d in range(B):
        gradient[length_offset + d] -= own[d] + cost * shrinking
        for p in range(n):
            front[length_offset + d, offset + p] -= shrinking * together[p]
        for e in range(d + 1):
            front[length_offset + d, length_offset + e] += shrinking * (own[d] + own[e] + cost * shrinking)
