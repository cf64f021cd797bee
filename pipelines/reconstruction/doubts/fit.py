"""Joints of a scene, and the fit of numbers of its description with the constant errors of all poses.

Every camera may be off by a constant shift and a constant turn, with what is stated of them as prior. The
joints are eliminated. The cost of a fit is a chi^2: the residuals of all pictures, each as one observation,
and the constant errors over their standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_rotation_vector
from pipelines.reconstruction.doubts.body import size_sigmas
from pipelines.reconstruction.doubts.scene import JOINTS, Sampled, SceneOfMoments

# Good keypoints err by this much at least.
_KEYPOINT_PX = 3.0
# Keypoints err by this share of the size of the person in the picture.
_KEYPOINT_SHARE = 0.015
# Joints are taken to be this far away before any distance is known.
_FIRST_M = 10.0
_NEAREST_M, _FARTHEST_M = 1e-3, 1e5
# A ray's angle to a joint that is nearer than this is not larger.
_NEAR_M = 0.5
# This share of a joint's weight keeps its equations regular.
_FIRM = 1e-9
# Fits converge in fewer steps than this.
_STEPS = 20
# A step that changes the chi^2 by less is the last.
_CONVERGED = 0.05
_LEAST_SIGMA = (0.02, np.radians(0.1))  # of constant errors, m and rad
# Derivatives are taken over this step of m, rad and logarithms.
_PROBE = 1e-4
# The logged hips of an actor err by this much.
_PLACED_M = 0.3
# Residuals beyond this many standard deviations count linearly.
_HUBER = 1.5
# Errors of a logged actor wander, and count as so many independent ones.
_FEW = 3
# A person is filmed from about this distance where none is known.
_USUAL_M = 10.0
# With fewer rays nothing can be fitted.
_FEWEST_RAYS = 60

Make = Callable[[Float], SceneOfMoments]
"""A scene from the numbers [n] of an alternative."""


class SolvedJoints(NamedTuple):
    """Joints of a scene."""

    joints: Float  # [T, J, 3] m; NaN where fewer than two cameras see one
    chi2: Float  # [T, J]
    views: Int64  # [T, J] how many cameras see it
    in_front: Bool  # [T, J]
    direction: Float  # [C, T, J, 3] unit rays in the world; 0 where nothing was seen
    seen: Bool  # [C, T, J]
    depth: Float  # [C, T, J] m; 0 where nothing was seen


def pixel_variance(scene: SceneOfMoments) -> Float:
    """Return the variance [C] px^2 of keypoints: it grows with the person in the picture."""
    variance: Float = _KEYPOINT_PX**2 + (_KEYPOINT_SHARE * scene.person_px) ** 2
    return variance


def _directions(scene: SceneOfMoments) -> Float:
    """Return the unit rays [C, T, J, 3] in the world."""
    x, y = scene.rays[..., 0], scene.rays[..., 1]
    local = np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(x * x + y * y + 1)[..., None]
    direction: Float = local @ np.swapaxes(scene.rotation, -1, -2)
    return direction


@np.errstate(invalid="ignore")
def solve(scene: SceneOfMoments) -> SolvedJoints:
    """Triangulate by least squares of distances to rays, weighted by what keypoints and poses err by."""
    direction = _directions(scene)
    centre = scene.position[:, :, None]
    seen: Bool = np.asarray(np.isfinite(direction).all(axis=-1) & np.isfinite(centre).all(axis=-1))
    direction, centre = np.where(seen[..., None], direction, 0.0), np.nan_to_num(centre)
    views = seen.sum(axis=0)
    angle2 = (pixel_variance(scene) / scene.focal_px**2 + scene.sigma[:, 1] ** 2)[:, None, None]
    place2 = (scene.sigma[:, 0] ** 2)[:, None, None]
    across = centre - direction * (direction * centre).sum(axis=-1, keepdims=True)
    depth = np.full(seen.shape, _FIRST_M)
    by_joint = direction.transpose(1, 2, 3, 0)  # [T, J, 3, C]
    for _ in range(2):
        weight = seen / (np.clip(np.abs(depth), _NEAREST_M, _FARTHEST_M) ** 2 * angle2 + place2)
        total = (weight.sum(axis=0) * (1 + _FIRM) + 1e-30)[..., None, None] * np.eye(3)
        matrix = total - (by_joint * weight.transpose(1, 2, 0)[:, :, None]) @ np.swapaxes(by_joint, 2, 3)
        point = np.linalg.solve(matrix, (weight[..., None] * across).sum(axis=0)[..., None])[..., 0]
        toward = point - centre
        depth = (toward * direction).sum(axis=-1)
    apart2 = ((toward - depth[..., None] * direction) ** 2).sum(axis=-1)
    in_front: Bool = np.asarray(((depth > 0) | ~seen).all(axis=0))
    joints = np.where((views >= 2)[..., None], point, np.nan)
    return SolvedJoints(joints, (apart2 * weight).sum(axis=0), views, in_front, direction, seen, depth * seen)


@dataclass(frozen=True)
class Fit:
    """Fitted numbers, and the constant errors of all poses beside them."""

    numbers: Float  # [n]
    cost: float  # chi^2
    strain: float  # the part of it that is of constant errors, the logged actor and the person's stature
    errors: Float  # [C, 6] of all poses, m and rad
    scene: SceneOfMoments  # of the numbers; the constant errors stay in it
    covariance: Float  # [n, n] of the numbers: what the constant errors leave of it; without, of all errors


def fit(
    flight: Sampled,
    make: Make,
    start: Float | None = None,
    loose: Sequence[float] = (),
) -> Fit:
    """Fit the numbers of an alternative, and the constant errors of all poses, by Gauss-Newton.

    Args:
        flight: the flight.
        make: the scene of given numbers.
        start: the numbers [n] at which the search begins; by default there are none.
        loose: their standard deviations [n]; infinite where nothing is known.
    """
    numbers = np.zeros(0) if start is None else start
    scene = make(numbers)
    errors = np.zeros((len(scene.focal_px), 6))
    best, last = Fit(numbers, np.inf, np.inf, errors, scene, np.zeros((0, 0))), np.inf
    for _ in range(_STEPS):
        cost, strain, change, covariance = _step(flight, make, numbers, errors, loose)
        settled = abs(cost - last) < _CONVERGED
        last = cost
        if cost < best.cost:
            best = Fit(numbers, cost, strain, errors, make(numbers), covariance)
        if settled or not np.isfinite(cost) or cost > 4 * best.cost + 100:
            break
        errors = errors + change[: errors.size].reshape(errors.shape)
        numbers = numbers + change[errors.size :]
    return best


def _with_errors(scene: SceneOfMoments, errors: Float) -> SceneOfMoments:
    turn = matrix_from_quaternion(quaternion_from_rotation_vector(errors[:, 3:]))[:, None]
    return replace(scene, rotation=turn @ scene.rotation, position=scene.position + errors[:, None, :3])


def _constant_sigma(scene: SceneOfMoments) -> Float:
    """Return the standard deviations [C, 6] of the constant errors."""
    level = np.sqrt(np.maximum(scene.sigma[:, :2] ** 2 - scene.sigma[:, 4:] ** 2, 0.0))
    sigma: Float = np.repeat(np.maximum(level, _LEAST_SIGMA), 3, axis=1)
    return sigma


def _misses(joints: Float, position: Float, direction: Float) -> tuple[Float, Float]:
    """Return by how much rays miss joints [C, T, J, 3], over their depths, and the depths [C, T, J]."""
    toward = joints - position[:, :, None]
    along = (toward * direction).sum(axis=-1)
    far = np.maximum(np.abs(along), _NEAR_M)
    return (toward - along[..., None] * direction) / far[..., None], far


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _step(
    flight: Sampled, make: Make, numbers: Float, errors: Float, loose: Sequence[float]
) -> tuple[float, float, Float, Float]:
    """Return cost and strain, the changes of constant errors [C, 6] and numbers [n], and a covariance."""
    scene = _with_errors(make(numbers), errors)
    solved = solve(scene)
    used = solved.seen & (solved.views >= 2)
    unknowns = errors.size + len(numbers)
    if used.sum() < _FEWEST_RAYS:
        return np.inf, np.inf, np.zeros(unknowns), np.zeros((len(numbers), len(numbers)))
    times = used.shape[1]
    joints, place = np.nan_to_num(solved.joints), np.nan_to_num(scene.position)
    missed, far = _misses(joints, place, solved.direction)
    varying2 = _varying2(scene.sigma[:, 5], scene.sigma[:, 3], times)[:, None, None]
    varying2 = varying2 + _varying2(scene.sigma[:, 4], scene.sigma[:, 2], times)[:, None, None] / far**2
    variance = (pixel_variance(scene) / scene.focal_px**2)[:, None, None] + varying2
    sigmas = np.linalg.norm(missed, axis=-1) / np.sqrt(variance)
    # One picture is one observation: its keypoints err alike.
    seen = np.maximum(used.sum(axis=-1, keepdims=True), 1)
    scale = np.maximum(1.0, np.median(sigmas[used]))
    robust = np.where(sigmas > _HUBER * scale, _HUBER * scale / np.maximum(sigmas, 1e-12), 1.0)
    weight = np.where(used, robust / (variance * seen), 0.0)
    huber = np.where(sigmas > _HUBER, _HUBER * (2 * sigmas - _HUBER), sigmas**2)
    sigma = _constant_sigma(scene)
    placed, pull, extra = _placed(flight, solved)
    sized = size_sigmas(solved.joints)
    strain = float(((errors / sigma) ** 2).sum()) + extra + sized**2
    cost = float((np.where(used, huber, 0.0) / seen).sum()) + strain

    root = np.where(used, np.sqrt(weight), 0.0)[..., None]

    def slope(changed: tuple[Float, Float]) -> Float:
        return root * (changed[0] - missed) / _PROBE

    def stacked(slopes: list[Float]) -> Float:
        """Return weighted derivatives [C, T J, 3, n]."""
        return np.stack(slopes, axis=-1).reshape(len(errors), -1, 3, len(slopes))

    probes = _PROBE * np.eye(3)
    point = stacked([slope(_misses(joints + each, place, solved.direction)) for each in probes])
    turned = np.cross(_PROBE * np.eye(3)[:, None, None, None], solved.direction)
    moves = [slope(_misses(joints, place + each, solved.direction)) for each in probes]
    own = stacked(moves + [slope(_misses(joints, place, solved.direction + each)) for each in turned])
    of_numbers, of_size = [], np.zeros(unknowns)
    for k, probe in enumerate(_PROBE * np.eye(len(numbers))):
        probed = _with_errors(make(numbers + probe), errors)
        direction = np.where(used[..., None], _directions(probed), 0.0)
        of_numbers.append(slope(_misses(joints, np.nan_to_num(probed.position), direction)))
        of_size[errors.size + k] = (size_sigmas(solve(probed).joints) - sized) / _PROBE
    shared = stacked(of_numbers) if of_numbers else np.zeros((*own.shape[:3], 0))

    # Each camera has its own errors; the numbers are shared by all; the joints are eliminated.
    left = (root * missed).reshape(*own.shape[:3], 1)
    of_joint = np.swapaxes(point, -1, -2)
    mixed = np.moveaxis(of_joint @ own, 0, 2).reshape(own.shape[1], 3, -1)
    both = np.concatenate([mixed, (of_joint @ shared).sum(axis=0)], axis=-1)
    at_joint = (of_joint @ left).sum(axis=0) - pull.reshape(-1, 3, 1)
    firm = (placed.reshape(-1, 1, 1) + _FIRM) * np.eye(3)
    joined = np.concatenate([both, at_joint], axis=-1)
    solution = np.linalg.solve((of_joint @ point).sum(axis=0) + firm, joined).reshape(-1, unknowns + 1)
    coupled = both.reshape(-1, unknowns).T @ solution
    normal, right = -coupled[:, :-1], -coupled[:, -1]
    for camera in range(len(errors)):
        rows = np.concatenate([own[camera], shared[camera], left[camera]], axis=-1)
        rows = rows.reshape(-1, rows.shape[-1])
        product = rows[:, :-1].T @ rows
        place_of = [*range(6 * camera, 6 * camera + 6), *range(errors.size, unknowns)]
        normal[np.ix_(place_of, place_of)] += product[:, :-1]
        right[place_of] += product[:, -1]
    free = np.asarray(loose, dtype=np.float64)
    inverse = np.concatenate([1 / sigma.ravel() ** 2, 1 / free**2])
    normal += np.diag(inverse + 1e-9) + np.outer(of_size, of_size)
    right += inverse * np.concatenate([errors.ravel(), numbers]) + of_size * sized
    covariance = np.linalg.inv(normal)
    kept = errors.size if len(numbers) else 0
    return cost, strain, -covariance @ right, covariance[kept:, kept:]


def picture_variance(scene: SceneOfMoments) -> Float:
    """Return the variance [C] rad^2 of what a picture shows: keypoints, and errors of poses that change."""
    times = scene.rays.shape[1]
    turned2 = _varying2(scene.sigma[:, 5], scene.sigma[:, 3], times)
    moved2 = _varying2(scene.sigma[:, 4], scene.sigma[:, 2], times)
    variance: Float = pixel_variance(scene) / scene.focal_px**2 + turned2 + moved2 / _USUAL_M**2
    return variance


def _varying2(varying: Float, white: Float, times: int) -> Float:
    """Return the variance [C] of errors that vary, as of one of so many pictures with independent errors.

    What is not new in every pose is worth `_FEW` independent pictures, however many there are.
    """
    lasting2 = np.maximum(varying**2 - white**2, 0.0)
    variance: Float = white**2 + lasting2 * times / _FEW
    return variance


def _placed(flight: Sampled, solved: SolvedJoints) -> tuple[Float, Float, float]:
    """Pull hips to the logged actor; return weights [T, J], pulls [T, J, 3] and the cost."""
    weight, pull = np.zeros(solved.views.shape), np.zeros(solved.joints.shape)
    if flight.hips is None:
        return weight, pull, 0.0
    hips = [JOINTS.index("left_hip"), JOINTS.index("right_hip")]
    apart = flight.hips[:, None] - solved.joints[:, hips]
    known = np.asarray(np.isfinite(apart).all(axis=-1))
    apart = np.where(known[..., None], apart, 0.0)
    # The way there counts besides the place: a log turned about its zero leads elsewhere.
    each = _FEW / (_PLACED_M**2 * max(int(known.sum()), 1))
    weight[:, hips] = each * known
    pull[:, hips] = each * apart
    return weight, pull, each * float((apart**2).sum())
