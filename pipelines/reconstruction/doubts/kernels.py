"""Compiled loops of the doubts: joints from rays, and the normal equations of a fault.

A diagnosis takes both a thousand times, of some thousand rays each.
"""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.compilation import cached, helper

# Joints are taken to be this far away before any distance is known.
_FIRST_M = 10.0
_NEAREST_M, _FARTHEST_M = 1e-3, 1e5
# A smaller determinant is that of rays along one line.
_SINGULAR = 1e-30
# A ray's angle to a joint that is nearer than this is not larger.
_NEAR_M = 0.5
# Rays that cross by less than this sine tell no distance.
_PARALLEL = 0.15
# This share of a joint's weight keeps its equations regular.
_FIRM = 1e-9


@helper
def _solve(matrix: Float, right: Float, solution: Float) -> None:
    """Solve a symmetric system [3, 3] by the adjugate."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    middle, last, cross = a * f - c * c, a * d - b * b, b * c - a * e
    determinant = a * first + b * second + c * third
    if not abs(determinant) > _SINGULAR:
        determinant = _SINGULAR
    x, y, z = right[0], right[1], right[2]
    solution[0] = (first * x + second * y + third * z) / determinant
    solution[1] = (second * x + middle * y + cross * z) / determinant
    solution[2] = (third * x + cross * y + last * z) / determinant


@helper
def _cross(one: Float, other: Float, product: Float) -> None:
    """Write the cross product of two vectors [3]."""
    product[0] = one[1] * other[2] - one[2] * other[1]
    product[1] = one[2] * other[0] - one[0] * other[2]
    product[2] = one[0] * other[1] - one[1] * other[0]


@cached
def joints_of(
    rays: Float, rotation: Float, position: Float, angle2: Float, place2: Float
) -> tuple[Float, Float, Int64, Bool, Float, Bool, Float]:
    """Triangulate by least squares of distances to rays.

    Args:
        rays: [C, T, J, 2] normalised image coordinates; NaN where nothing was seen.
        rotation: [C, T, 3, 3] world_from_camera.
        position: [C, T, 3] m.
        angle2: [C] variance of the rays' angles, rad^2.
        place2: [C] variance of the cameras' positions, m^2.

    Returns:
        Joints [T, J, 3] (NaN with fewer than two views), chi^2 [T, J], views [T, J], in front [T, J], unit
        rays in the world [C, T, J, 3], seen [C, T, J], depths [C, T, J] m.
    """
    cameras, times, count = rays.shape[:3]
    direction = np.zeros((cameras, times, count, 3))
    seen = np.zeros((cameras, times, count), dtype=np.bool_)
    depth = np.zeros((cameras, times, count))
    joints = np.full((times, count, 3), np.nan)
    chi2 = np.zeros((times, count))
    views = np.zeros((times, count), dtype=np.int64)
    in_front = np.ones((times, count), dtype=np.bool_)
    for camera in range(cameras):
        for t in range(times):
            if not np.isfinite(position[camera, t]).all():
                continue
            turn = rotation[camera, t]
            for joint in range(count):
                x, y = rays[camera, t, joint, 0], rays[camera, t, joint, 1]
                length = np.sqrt(x * x + y * y + 1.0)
                finite = True
                for row in range(3):
                    value = (turn[row, 0] * x + turn[row, 1] * y + turn[row, 2]) / length
                    finite = finite and bool(np.isfinite(value))
                    direction[camera, t, joint, row] = value
                if finite:
                    seen[camera, t, joint] = True
                    views[t, joint] += 1
                else:
                    direction[camera, t, joint] = 0.0
    matrix, right, point = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for t in range(times):
        for joint in range(count):
            if not views[t, joint]:
                continue
            depth[:, t, joint] = _FIRST_M
            for last in (False, True):
                matrix[:], right[:] = 0.0, 0.0
                for camera in range(cameras):
                    if not seen[camera, t, joint]:
                        continue
                    far = min(max(abs(depth[camera, t, joint]), _NEAREST_M), _FARTHEST_M)
                    weight = 1.0 / (far * far * angle2[camera] + place2[camera])
                    ray, centre = direction[camera, t, joint], position[camera, t]
                    along = ray[0] * centre[0] + ray[1] * centre[1] + ray[2] * centre[2]
                    for row in range(3):
                        right[row] += weight * (centre[row] - ray[row] * along)
                        for column in range(3):
                            matrix[row, column] -= weight * ray[row] * ray[column]
                        matrix[row, row] += weight
                _solve(matrix, right, point)
                chi = 0.0
                for camera in range(cameras):
                    if not seen[camera, t, joint]:
                        depth[camera, t, joint] = 0.0
                        continue
                    ray, centre = direction[camera, t, joint], position[camera, t]
                    along, apart2 = 0.0, 0.0
                    for row in range(3):
                        along += (point[row] - centre[row]) * ray[row]
                    for row in range(3):
                        apart2 += (point[row] - centre[row] - along * ray[row]) ** 2
                    far = min(max(abs(depth[camera, t, joint]), _NEAREST_M), _FARTHEST_M)
                    chi += apart2 / (far * far * angle2[camera] + place2[camera])
                    depth[camera, t, joint] = along
                    if last and not along > 0:
                        in_front[t, joint] = False
                chi2[t, joint] = chi
            if views[t, joint] >= 2:
                joints[t, joint] = point
    return joints, chi2, views, in_front, direction, seen, depth


@cached
def misses_of(
    joints: Float, position: Float, direction: Float, used: Bool, depth: Float
) -> tuple[Float, Float]:
    """Return by how much rays miss joints across [C, T, J, 3], over the depths [C, T, J], and these depths.

    Args:
        joints: [T, J, 3] m.
        position: [C, T, 3] m.
        direction: [C, T, J, 3] unit rays in the world.
        used: [C, T, J]; the others miss nothing.
        depth: [C, T, J] m.
    """
    cameras, times, count = used.shape
    missed = np.zeros((cameras, times, count, 3))
    far = np.ones((cameras, times, count))
    toward = np.zeros(3)
    for camera in range(cameras):
        for t in range(times):
            for joint in range(count):
                if not used[camera, t, joint]:
                    continue
                ray = direction[camera, t, joint]
                length = max(abs(depth[camera, t, joint]), _NEAR_M)
                along = 0.0
                for row in range(3):
                    toward[row] = joints[t, joint, row] - position[camera, t, row]
                    along += toward[row] * ray[row]
                for row in range(3):
                    missed[camera, t, joint, row] = (toward[row] - along * ray[row]) / length
                far[camera, t, joint] = length
    return missed, far


@cached
def normal_equations(
    direction: Float,
    missed: Float,
    depth: Float,
    weight: Float,
    placed: Float,
    pull: Float,
    camera_of_fault: int,
    basis: Float,
    axis: Float,
) -> tuple[Float, Float]:
    """Return the normal equations of constant errors and a fault; the joints are eliminated.

    The derivatives are those of (X - p) / depth - direction by the joint, the camera's shift and its turn.
    The terms with the miss keep the scale: without them a smaller flight seems to fit better.

    Args:
        direction: [C, T, J, 3] unit rays in the world.
        missed: [C, T, J, 3] rad.
        depth: [C, T, J] m.
        weight: [C, T, J], 0 where nothing is used.
        placed: [T, J] weight of a joint's own place.
        pull: [T, J, 3] that weight times the way there.
        camera_of_fault: the camera.
        basis: [T, 6, n] how its shift and turn change with each number of its fault.
        axis: [T, 3] its optical axis, where the one number is the logarithm of its focal length; else [0, 3].

    Returns:
        Matrix and right side of 6 C + n unknowns.
    """
    cameras, times, count = weight.shape
    numbers = 1 if len(axis) else basis.shape[2]
    size = 6 * cameras + numbers
    matrix, right = np.zeros((size, size)), np.zeros(size)
    rows = np.zeros((3, 6 + numbers))
    point, leaning = np.zeros((3, 3)), np.zeros((3, 3))
    of_point, at_point = np.zeros((3, 3)), np.zeros(3)
    both, solved = np.zeros((3, size)), np.zeros((3, size))
    moved, firm = np.zeros(3), np.zeros(3)
    for t in range(times):
        for joint in range(count):
            of_point[:], both[:] = 0.0, 0.0
            for row in range(3):
                of_point[row, row] = placed[t, joint] + _FIRM
                at_point[row] = -pull[t, joint, row]
            some = False
            for camera in range(cameras):
                w = weight[camera, t, joint]
                if w == 0.0:
                    continue
                some = True
                ray, miss = direction[camera, t, joint], missed[camera, t, joint]
                far = depth[camera, t, joint]
                for row in range(3):
                    for column in range(3):
                        same = 1.0 if row == column else 0.0
                        point[row, column] = (same - (ray[row] + miss[row]) * ray[column]) / far
                        leaning[row, column] = same + (ray[row] + miss[row]) * miss[column]
                for row in range(3):
                    rows[row, :3] = -point[row]
                    # times the matrix of the cross product with the ray
                    rows[row, 3] = leaning[row, 1] * ray[2] - leaning[row, 2] * ray[1]
                    rows[row, 4] = leaning[row, 2] * ray[0] - leaning[row, 0] * ray[2]
                    rows[row, 5] = leaning[row, 0] * ray[1] - leaning[row, 1] * ray[0]
                width = 6
                if camera == camera_of_fault and numbers:
                    width = 6 + numbers
                    if len(axis):
                        cosine = ray[0] * axis[t, 0] + ray[1] * axis[t, 1] + ray[2] * axis[t, 2]
                        for row in range(3):
                            rows[row, 6] = 0.0
                            for column in range(3):
                                inwards = cosine * (axis[t, column] - cosine * ray[column])
                                rows[row, 6] -= leaning[row, column] * inwards
                    else:
                        for row in range(3):
                            for number in range(numbers):
                                rows[row, 6 + number] = 0.0
                                for column in range(6):
                                    rows[row, 6 + number] += rows[row, column] * basis[t, column, number]
                for one in range(3):
                    for other in range(3):
                        for row in range(3):
                            of_point[one, other] += w * point[row, one] * point[row, other]
                    for row in range(3):
                        at_point[one] += w * point[row, one] * miss[row]
                for one in range(width):
                    first = 6 * camera + one if one < 6 else 6 * cameras + one - 6
                    for row in range(3):
                        value = w * rows[row, one]
                        right[first] += value * miss[row]
                        for axis_of in range(3):
                            both[axis_of, first] += point[row, axis_of] * value
                        for other in range(width):
                            second = 6 * camera + other if other < 6 else 6 * cameras + other - 6
                            matrix[first, second] += value * rows[row, other]
            if not some:
                continue
            for column in range(size):
                _solve(of_point, both[:, column], firm)
                for row in range(3):
                    solved[row, column] = firm[row]
            _solve(of_point, at_point, moved)
            for one in range(size):
                for row in range(3):
                    value = both[row, one]
                    if value == 0.0:
                        continue
                    right[one] -= value * moved[row]
                    for other in range(size):
                        matrix[one, other] -= value * solved[row, other]
    return matrix, right


@cached
def distances_of(
    direction: Float, seen: Bool, position: Float, rotation: Float, depth: Float, sigma: Float
) -> tuple[Bool, Float, Float]:
    """Return the signed distances of two cameras' rays, and how constant errors of both poses change them.

    The distance along the common normal changes by the normal with a shift of a camera, and by the lever
    (distance times ray) across the normal with a turn.

    Args:
        direction: [2, T, J, 3] unit rays in the world.
        seen: [2, T, J].
        position: [2, T, 3] m.
        rotation: [2, T, 3, 3] world_from_camera.
        depth: [2, T, J] m.
        sigma: [2, 2] standard deviations of the constant errors, m and rad.

    Returns:
        Used [T, J], distances [T, J] m and their derivatives [T, J, 12] by errors of one standard deviation.
    """
    _, times, count = seen.shape
    used = np.zeros((times, count), dtype=np.bool_)
    apart = np.zeros((times, count))
    design = np.zeros((times, count, 12))
    normal, lever = np.zeros(3), np.zeros(3)
    for t in range(times):
        for joint in range(count):
            if not (seen[0, t, joint] and seen[1, t, joint]):
                continue
            _cross(direction[0, t, joint], direction[1, t, joint], normal)
            length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            if not length > _PARALLEL:
                continue
            used[t, joint] = True
            for row in range(3):
                normal[row] /= length
                apart[t, joint] += normal[row] * (position[1, t, row] - position[0, t, row])
            for camera in range(2):
                sign, turn = (-1.0 if camera == 0 else 1.0), rotation[camera, t]
                _cross(direction[camera, t, joint], normal, lever)
                for column in range(3):
                    turned = 0.0
                    for row in range(3):
                        turned += turn[row, column] * lever[row]
                    turned *= sign * depth[camera, t, joint] * sigma[camera, 1]
                    design[t, joint, 6 * camera + column] = sign * normal[column] * sigma[camera, 0]
                    design[t, joint, 6 * camera + 3 + column] = turned
    return used, apart, design
