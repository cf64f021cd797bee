"""Score of a scene: how well it fits itself, and how much its people are people.

Lower is better. A score adds three things:

- the distances of rays from the joints that they make, over what keypoints and poses are stated to err by;
- how odd the body, its place and its motion are, each against what is published of people;
- the scatter of two cameras' rays within one picture, after a constant error of each pose was fitted with
  its stated standard deviation as prior. Clocks and wrong conventions leave it, constant errors do not.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64, known_median
from pipelines.geometry.compilation import cached, helper
from pipelines.geometry.poses import cross_matrix, matrix_from_quaternion, quaternion_from_rotation_vector
from pipelines.geometry.triangulation import MIN_PARALLAX_DEG
from pipelines.reconstruction.doubts.scene import (
    FEW,
    HIPS,
    PLACED_M,
    SIZE_SIGMA,
    Body,
    Oddity,
    SceneOfMoments,
    median,
    quantile,
    size_sigmas,
)

# Good keypoints err by this much at least.
_KEYPOINT_PX = 3.0
# Keypoints err by this share of the size of the person in the picture.
_KEYPOINT_SHARE = 0.015
# Joints are taken to be this far away where no distance is known.
_USUAL_M = 10.0
_NEAREST_M, _FARTHEST_RAY_M = 1e-3, 1e5
# A ray's angle to a joint that is nearer than this is not larger.
_NEAR_M = 0.5
# This share of a joint's weight keeps its equations regular.
_FIRM = 1e-9
# Fits converge in fewer steps than this.
_STEPS = 20
# A step that changes the chi^2 by less is the last.
_CONVERGED = 0.05
_LEAST_SIGMA = (0.02, np.radians(0.1))  # of constant errors, m and rad
# Numbers that nothing shows stay within this, in m, rad or logarithms.
_LOOSE = 30.0
# Derivatives are taken over this step of m, rad and logarithms.
_PROBE = 1e-4
# Residuals beyond this many standard deviations count linearly.
_HUBER = 1.5
# With fewer rays or joints nothing can be said.
_FEWEST = 60

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
    return _KEYPOINT_PX**2 + (_KEYPOINT_SHARE * scene.person_px) ** 2


def _directions(scene: SceneOfMoments) -> Float:
    """Return the unit rays [C, T, J, 3] in the world."""
    x, y = scene.rays[..., 0], scene.rays[..., 1]
    local = np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(x * x + y * y + 1)[..., None]
    return local @ np.swapaxes(scene.rotation, -1, -2)


def solve(scene: SceneOfMoments) -> SolvedJoints:
    """Triangulate by least squares of distances to rays, weighted by what keypoints and poses err by."""
    direction = _directions(scene)
    seen: Bool = np.isfinite(direction[..., 0] + scene.position.sum(axis=-1)[..., None])
    direction, centre = np.where(seen[..., None], direction, 0.0), np.nan_to_num(scene.position)
    angle2 = pixel_variance(scene) / scene.focal_px**2 + scene.sigma[:, 1] ** 2
    views = seen.sum(axis=0)
    joints, chi2, depth = _meet(direction, centre, seen, angle2, scene.sigma[:, 0] ** 2)
    joints[views < 2] = np.nan
    in_front: Bool = np.asarray(((depth > 0) | ~seen).all(axis=0))
    return SolvedJoints(joints, chi2, views, in_front, direction, seen, depth)


@helper
def _inverse(matrix: Float) -> Float:
    """Invert a symmetric matrix [3, 3] by its cofactors."""
    inverse = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            j, m, n, o = (i + 1) % 3, (i + 2) % 3, (k + 1) % 3, (k + 2) % 3
            inverse[i, k] = matrix[j, n] * matrix[m, o] - matrix[j, o] * matrix[m, n]
    inverse /= (matrix[0] * inverse[0]).sum()
    return inverse


@cached
def _meet(
    direction: Float, centre: Float, seen: Bool, angle2: Float, place2: Float
) -> tuple[Float, Float, Float]:
    """Return the joints [T, J, 3] nearest to rays, their chi^2 [T, J] and depths [C, T, J]; 0 if unseen."""
    cameras, times, names = seen.shape
    joints, chi2, depth = np.zeros((times, names, 3)), np.zeros((times, names)), np.zeros(seen.shape)
    matrix, right, weight = np.empty((3, 3)), np.empty(3), np.empty(cameras)
    for at in range(2 * times * names):
        second, t, j = at % 2, at // 2 // names, at // 2 % names
        for i in range(3):
            right[i] = 0.0
            for k in range(3):
                matrix[i, k] = 0.0
        for c in range(cameras):
            if not seen[c, t, j]:
                continue
            ray, along = direction[c, t, j], 0.0
            away = min(max(abs(depth[c, t, j]), _NEAREST_M), _FARTHEST_RAY_M) if second else _USUAL_M
            weight[c] = 1 / (away**2 * angle2[c] + place2[c])
            for i in range(3):
                along += ray[i] * centre[c, t, i]
            for i in range(3):
                right[i] += weight[c] * (centre[c, t, i] - ray[i] * along)
                matrix[i, i] += weight[c] * (1 + _FIRM) + 1e-30
                for k in range(3):
                    matrix[i, k] -= weight[c] * ray[i] * ray[k]
        if matrix[0, 0] == 0.0:
            continue
        inverse = _inverse(matrix)
        for i in range(3):
            joints[t, j, i] = inverse[i, 0] * right[0] + inverse[i, 1] * right[1] + inverse[i, 2] * right[2]
        chi2[t, j] = 0.0
        for c in range(cameras):
            if not seen[c, t, j]:
                continue
            ray, along = direction[c, t, j], 0.0
            for i in range(3):
                along += (joints[t, j, i] - centre[c, t, i]) * ray[i]
            depth[c, t, j] = along
            for i in range(3):
                chi2[t, j] += weight[c] * (joints[t, j, i] - centre[c, t, i] - along * ray[i]) ** 2
    return joints, chi2, depth


@dataclass(frozen=True)
class Fit:
    """Fitted numbers, and the constant errors of all poses beside them."""

    numbers: Float  # [n]
    cost: float  # chi^2
    strain: float  # the part of it that is of constant errors, the logged actor and the person's stature
    scene: SceneOfMoments  # of the numbers; the constant errors stay in it
    errors: Float  # [C, 6] m and rad
    covariance: Float  # [n, n] of the numbers: what the constant errors leave of it; without, of all errors


def fit(make: Make, start: Sequence[float] | Float = (), beside: Fit | None = None) -> Fit:
    """Fit the numbers of an alternative, and the constant errors of all poses, by Gauss-Newton.

    Args:
        make: the scene of given numbers.
        start: the numbers [n] at which the search begins; by default there are none.
        beside: the fit of a scene that differs little, whose constant errors the search begins with.
    """
    numbers = np.array(start, dtype=np.float64)
    scene = make(numbers)
    errors = np.zeros((len(scene.focal_px), 6)) if beside is None else beside.errors
    best, last = Fit(numbers, np.inf, np.inf, scene, errors, np.zeros((0, 0))), np.inf
    for _ in range(_STEPS):
        cost, strain, change, covariance = _step(make, numbers, errors)
        settled = abs(cost - last) < _CONVERGED
        last = cost
        if cost < best.cost:
            best = Fit(numbers, cost, strain, make(numbers), errors, covariance)
        if settled or not np.isfinite(cost) or cost > 4 * best.cost + 100:
            break
        errors = errors + change[: errors.size].reshape(errors.shape)
        numbers = numbers + change[errors.size :]
    return best


def _with_errors(scene: SceneOfMoments, errors: Float) -> SceneOfMoments:
    turn = matrix_from_quaternion(quaternion_from_rotation_vector(errors[:, 3:]))[:, None]
    return replace(scene, rotation=turn @ scene.rotation, position=scene.position + errors[:, None, :3])


def _misses(joints: Float, position: Float, direction: Float) -> tuple[Float, Float]:
    """Return by how much rays miss joints [C, T, J, 3], over their depths, and the depths [C, T, J]."""
    toward = joints - position[:, :, None]
    along = (toward * direction).sum(axis=-1)
    far = np.maximum(np.abs(along), _NEAR_M)
    return (toward - along[..., None] * direction) / far[..., None], far


@cached
def _solved_for_joints(rows: Float, placed: Float, pull: Float) -> tuple[Float, Float]:
    """Solve for the joints, by whose places misses change as by the cameras' shifts, the other way.

    `rows` [C, T, J, 3, 6 + n + 1] are weighted derivatives of misses by each camera's shift and turn, by n
    numbers, and the misses; `placed` [T, J] are weights of known places, `pull` [T, J, 3] leads there. Return
    the derivatives by joints times all of them [3 T J, 6 C + n + 1], and this with the joints solved.
    """
    cameras, times, names, _, own = rows.shape
    others, matrix = 6 * cameras, np.empty((3, 3))
    both = np.zeros((3 * times * names, others + own - 6))
    solution = np.zeros(both.shape)
    for at in range(times * names):
        t, j, first = at // names, at % names, 3 * at
        for i in range(3):
            for k in range(3):
                matrix[i, k] = 0.0
            matrix[i, i] = placed[t, j] + _FIRM
            both[first + i, -1] = -pull[t, j, i]
        for c in range(cameras):
            for m in range(3):
                row = rows[c, t, j, m]
                for i in range(3):
                    for k in range(3):
                        matrix[i, k] += row[i] * row[k]
                    for k in range(own):
                        both[first + i, 6 * c + k if k < 6 else others + k - 6] -= row[i] * row[k]
        inverse = _inverse(matrix)
        for i in range(3):
            for m in range(3):
                for k in range(others + own - 6):
                    solution[first + i, k] += inverse[i, m] * both[first + m, k]
    return both, solution


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _step(make: Make, numbers: Float, errors: Float) -> tuple[float, float, Float, Float]:
    """Return cost and strain, the changes of constant errors [C, 6] and numbers [n], and a covariance."""
    scene = _with_errors(make(numbers), errors)
    solved = solve(scene)
    used = solved.seen & (solved.views >= 2)
    unknowns = errors.size + len(numbers)
    if used.sum() < _FEWEST:
        return np.inf, np.inf, np.zeros(unknowns), np.zeros((len(numbers), len(numbers)))
    joints, place = np.nan_to_num(solved.joints), np.nan_to_num(scene.position)
    missed, far = _misses(joints, place, solved.direction)
    turned2, moved2 = (each[:, None, None] for each in _changing2(scene))
    variance = turned2 + moved2 / far**2
    sigmas = np.linalg.norm(missed, axis=-1) / np.sqrt(variance)
    # One picture is one observation: its keypoints err alike.
    seen = np.maximum(used.sum(axis=-1, keepdims=True), 1)
    scale = np.maximum(1.0, np.median(sigmas[used]))
    robust = np.where(sigmas > _HUBER * scale, _HUBER * scale / np.maximum(sigmas, 1e-12), 1.0)
    weight = np.where(used, robust / (variance * seen), 0.0)
    huber = np.where(sigmas > _HUBER, _HUBER * (2 * sigmas - _HUBER), sigmas**2)
    level = np.sqrt(np.maximum(scene.sigma[:, :2] ** 2 - scene.sigma[:, 4:] ** 2, 0.0))
    sigma = np.repeat(np.maximum(level, _LEAST_SIGMA), 3, axis=1)
    placed, pull, extra = _placed(scene, solved)
    sized = size_sigmas(solved.joints)
    strain = float(((errors / sigma) ** 2).sum()) + extra + sized**2
    cost = float((np.where(used, huber, 0.0) / seen).sum()) + strain

    # Farther away, errors of places are smaller angles: the misses and their standard deviations alike.
    parts = []
    for probe in _PROBE * np.eye(len(numbers)):
        probed = _with_errors(make(numbers + probe), errors)
        ray = np.where(used[..., None], _directions(probed), 0.0)
        moved, away = _misses(joints, np.nan_to_num(probed.position), ray)
        moved *= np.sqrt(variance / (turned2 + moved2 / away**2))[..., None]
        parts.append((moved - missed) / _PROBE)
    # Misses shrink with distance, and so do the parts of their standard deviations that come from places. A
    # camera that turns moves joints the other way about itself, and the misses with it.
    shrinks = np.where(far > _NEAR_M, np.sign(solved.depth) * turned2 / variance, 0.0)
    leaning = solved.direction + shrinks[..., None] * missed
    by_joint = (np.eye(3) - leaning[..., :, None] * solved.direction[..., None, :]) / far[..., None, None]
    by_turn = by_joint @ cross_matrix(joints - place[:, :, None]) - cross_matrix(missed)
    rows = np.concatenate([-by_joint, by_turn, np.stack([*parts, missed], axis=-1)], axis=-1)
    rows *= np.sqrt(weight)[..., None, None]
    both, solution = _solved_for_joints(rows, placed, pull)
    # Each camera has its own errors; the numbers are shared by all.
    equations = -both.T @ solution
    for camera, own in enumerate(rows.reshape(len(rows), -1, rows.shape[-1])):
        place_of = np.r_[6 * camera : 6 * camera + 6, errors.size : unknowns + 1]
        equations[np.ix_(place_of, place_of)] += own.T @ own
    # The person grows by what moves the joints away from their middle at each moment.
    known = np.isfinite(solved.joints).all(axis=2, keepdims=True)
    middle = joints.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1)
    about = np.where(known, joints - middle, 0.0).ravel()
    of_size = -(about @ solution[:, :-1]) / (max(float(about @ about), 1e-9) * SIZE_SIGMA)
    normal, right = equations[:-1, :-1], equations[:-1, -1]
    inverse = np.concatenate([1 / sigma.ravel() ** 2, np.full(len(numbers), 1 / _LOOSE**2)])
    normal += np.diag(inverse + 1e-9) + np.outer(of_size, of_size)
    right += inverse * np.concatenate([errors.ravel(), numbers]) + of_size * sized
    covariance: Float = np.asarray(np.linalg.inv(normal), np.float64)
    kept = errors.size if len(numbers) else 0
    return cost, strain, -covariance @ right, covariance[kept:, kept:]


def picture_variance(scene: SceneOfMoments) -> Float:
    """Return the variance [C] rad^2 of what a picture shows: keypoints, and errors of poses that change."""
    turned2, moved2 = _changing2(scene)
    return turned2 + moved2 / _USUAL_M**2


def _changing2(scene: SceneOfMoments) -> tuple[Float, Float]:
    """Return variances [C], rad^2 of keypoints and turns and m^2 of places, of errors as of one picture.

    Those that vary slowly are alike in pictures beside each other: all of them are worth `FEW` pictures.
    """
    white2, varying2 = scene.sigma[:, 2:4] ** 2, scene.sigma[:, 4:] ** 2
    moved2, turned2 = (white2 + np.maximum(varying2 - white2, 0.0) * scene.rays.shape[1] / FEW).T
    return pixel_variance(scene) / scene.focal_px**2 + turned2, moved2


def _placed(scene: SceneOfMoments, solved: SolvedJoints) -> tuple[Float, Float, float]:
    """Pull hips to the logged actor; return weights [T, J], pulls [T, J, 3] and the cost."""
    weight, pull = np.zeros(solved.views.shape), np.zeros(solved.joints.shape)
    if scene.hips is None:
        return weight, pull, 0.0
    apart = scene.hips[:, None] - solved.joints[:, HIPS]
    known = np.asarray(np.isfinite(apart).all(axis=-1))
    apart = np.where(known[..., None], apart, 0.0)
    # The way there counts besides the place: a log turned about its zero leads elsewhere.
    each = FEW / (PLACED_M**2 * max(int(known.sum()), 1))
    weight[:, HIPS], pull[:, HIPS] = each * known, each * apart
    return weight, pull, each * float((apart**2).sum())


# --- score ------

# Score of a scene in which next to nothing is seen by two cameras.
_IMPOSSIBLE = 99.0
# A joint that is farther away does not tell how far stated errors move it.
_FARTHEST_M = 30.0
# Rays that cross by less than this sine tell no distance.
_PARALLEL = 0.15
# Where nothing says how high zero is, drones that all fly lower than this below it count heights downwards:
# the rays may be alike with z upwards, so it is as odd as a margin of alternatives needs.
_BELOW_M, _BELOW_SIGMAS = 1.0, 10.0
# Ankles of somebody who stands are this high above the ground.
_ANKLE_ABOVE_GROUND_M = 0.08
# Rays that miss each other by more standard deviations cannot be used.
_UNUSED_SIGMAS = 4.0
# Right flights have less than 0.01 of joints that cannot be used.
_USUALLY_UNUSED = 0.2
# Two in three right flights have a camera with a smaller share of pictures that outlast its log.
_UNPOSED_SIGMA = 0.015
# A log that ends early is no mistake of the description, however early.
_MOST_UNPOSED = 0.14
# Ground that no map shows is no steeper than this.
_SLOPE = 0.3
# Half of a body is this long: turning it moves its ends by the angle times that.
_HALF_BODY_M = 0.5
# The scatter of rays counts this much beside what is odd about a person.
SCATTER_WEIGHT = 12.0
SCATTER_RANGE = (0.4, 30.0)  # what is less is no better, where it is not worse in the same pixels


class Score(NamedTuple):
    """The score of a scene, and what it is made of."""

    total: float
    misfit: float  # of rays, standard deviations
    scatter: float  # of rays within pictures, over the pixel noise
    odd: dict[str, Oddity]
    stature_m: float
    person_px: Float = np.zeros(0)  # [C] as of the scene
    covered: float = 0.0  # share of joints and moments that two cameras see


@np.errstate(invalid="ignore", divide="ignore")
def score(
    scene: SceneOfMoments,
    base: Score | None = None,
    *,
    same_scatter: bool = False,
    limit: float = np.inf,
) -> Score:
    """Score a scene.

    Args:
        scene: the scene.
        base: the score of the scene as described; None if it is that.
        same_scatter: True where an alternative can only seem to change the scatter, as a unit does.
        limit: a score above it need not be exact: what takes time is left out once that is certain.
    """
    solved = solve(scene)
    good = solved.views >= 2
    if good.sum() < _FEWEST or (base is not None and good.mean() < 0.4 * base.covered):
        return Score(_IMPOSSIBLE, np.inf, np.inf, {}, np.nan)
    misfit = _misfit(solved, good)
    # Two cameras have one draw of constant errors between them: chi^2 of few.
    soft = 2.0 if len(scene.focal_px) == 2 else 1.5
    share_behind = 1 - float(solved.in_front[good].mean())
    behind = Oddity(share_behind / 0.05, {"behind_share": share_behind})
    total = float(2 * np.log1p((misfit / soft) ** 2) + np.log1p(behind.sigmas**2))
    reference = None if base is None or same_scatter else base.scatter
    gain = 0.0 if reference is None else SCATTER_WEIGHT * np.log(max(reference / SCATTER_RANGE[0], 1.0))
    if total - gain > limit:
        return Score(total, misfit, np.inf, {"behind": behind}, np.nan)
    pairs = combinations(range(len(scene.focal_px)), 2)
    found = [value for pair in pairs if (value := _scatter(scene, solved, pair)) is not None]
    scatter = float(np.mean(found)) if found else 9.0
    if base is not None and reference is not None:
        floor, top = SCATTER_RANGE
        # In the same pixels, keypoints scatter as much; a wrong focal length bends what little they do.
        if scatter > reference and np.array_equal(scene.person_px, base.person_px):
            floor = min(floor, reference)
        total += SCATTER_WEIGHT * float(np.log(np.clip(scatter, floor, top) / np.clip(reference, floor, top)))
        if total > limit:
            return Score(total, misfit, scatter, {"behind": behind}, np.nan)
    body = Body(solved.joints)
    stature = median(body.statures)
    if np.isfinite(body.statures).sum() < 5 or not stature > 0:
        return Score(_IMPOSSIBLE, misfit, np.inf, {}, np.nan)
    pairs = combinations(scene.position, 2)
    apart_m = np.max([np.linalg.norm(one - other, axis=-1) for one, other in pairs], axis=0)
    loose = float(np.sqrt(2) * scene.sigma[:, 0].mean() / max(median(apart_m), 1e-9))  # share of the scale
    odd = body.proportions(stature, loose) | body.posture()
    odd |= _place(scene, body, solved, stature)
    freedom, gate = 2 * solved.views[good] - 3, (_UNUSED_SIGMAS * max(misfit, 1.0)) ** 2
    unused = float((solved.chi2[good] > gate * freedom).mean())
    odd["unused"] = Oddity(max(0.0, unused - _USUALLY_UNUSED) / 0.05, {"unused_share": unused})
    sine = _best_sine(solved)
    parallax = {"parallax_deg": float(np.degrees(np.arcsin(sine)))}
    odd["parallax"] = Oddity(max(0.0, 0.1 / max(sine, 1e-4) - 1), parallax)
    odd = {name: each for name, each in odd.items() if np.isfinite(each.sigmas)}
    total += sum(surprise(each) for each in odd.values())
    odd |= {"behind": behind, "unposed": unposed(scene)}
    return Score(total, misfit, scatter, odd, stature, scene.person_px, float(good.mean()))


def surprise(odd: Oddity) -> float:
    """Return what an oddity adds to a score: it has heavy tails, and an end."""
    return float(np.log1p(min(odd.sigmas, 50.0) ** 2))


def unposed(scene: SceneOfMoments) -> Oddity:
    """Measure pictures before or after their cameras' logs: it is read beside the score, as rays are.

    Whom the pictures show says nothing about it, so it tells other times of all cameras from chance. One
    log may end early.
    """
    share = min((float(each) for each in scene.unposed if np.isfinite(each)), default=0.0)
    return Oddity(min(share, _MOST_UNPOSED) / _UNPOSED_SIGMA, {"unposed_share": share})


def _misfit(solved: SolvedJoints, good: Bool) -> float:
    """Return the root of the median chi^2 over that of right rays: 1 where all is as stated.

    The median of chi^2 with k degrees of freedom is k (1 - 2 / 9 k)^3 (Wilson and Hilferty 1931).
    """
    freedom = 2 * solved.views[good] - 3
    return float(np.sqrt(median(solved.chi2[good] / (freedom * (1 - 2 / (9 * freedom)) ** 3))))


def _best_sine(solved: SolvedJoints) -> float:
    """Return the sine of the angle at which the rays of the best pair of cameras cross."""
    sine = 0.0
    for one, other in combinations(range(len(solved.seen)), 2):
        both = solved.seen[one] & solved.seen[other]
        if both.any():
            cosine = (solved.direction[one][both] * solved.direction[other][both]).sum(axis=-1)
            sine = max(sine, median(np.sqrt(np.maximum(0.0, 1.0 - cosine**2))))
    return sine


def _scatter(scene: SceneOfMoments, solved: SolvedJoints, pair: tuple[int, int]) -> float | None:
    """Fit constant errors of two poses to the rays' distances, and measure what they leave over the noise."""
    shape, pixel2 = solved.seen.shape[1:], pixel_variance(scene) / scene.focal_px**2
    two, views = list(pair), (scene.position, scene.rotation, scene.sigma, pixel2)
    used, design, apart, noise2 = _crossings(
        solved.direction[two], solved.depth[two], solved.seen[two], *(each[two] for each in views)
    )
    if len(used) < _FEWEST:
        return None
    noise = np.sqrt(median(noise2))
    share = shape[0] / len(apart)  # a picture is one observation of a constant error
    weight = np.ones(len(apart))
    for _ in range(3):
        weighted = design * (weight * share / noise**2)[:, None]
        constant = np.linalg.solve(weighted.T @ design + np.eye(design.shape[1]), weighted.T @ apart)
        left = apart - design @ constant
        weight = 1 / np.maximum(np.abs(left) / (1.5 * noise), 1.0)
    residual = np.full(shape, np.nan)
    residual.ravel()[used] = left
    return float(1.48 * median(np.abs(residual - known_median(residual, 1)[:, None])) / noise)


@cached
def _crossings(
    ray: Float, depth: Float, seen: Bool, place: Float, rotation: Float, sigma: Float, pixel2: Float
) -> tuple[Int64, Float, Float, Float]:
    """Compare the rays [2, T, J, 3] of two cameras along their common normals.

    That distance changes by the normal with a shift of a camera, and by the lever (distance times ray) across
    the normal with a turn; `pixel2` [2] rad^2 are variances of keypoints. Return indices [N] of joints whose
    rays cross; the derivatives [N, 12] of their distances by shift and turn of each camera, in standard
    deviations; the distances [N] m and their variances [N] m^2.
    """
    _, times, names = seen.shape
    used, design = np.empty(times * names, np.int64), np.zeros((times * names, 12))
    apart, noise2, normal, n = np.zeros(times * names), np.zeros(times * names), np.empty(3), 0
    for at in range(times * names):
        t, j = at // names, at % names
        a, b, length2 = ray[0, t, j], ray[1, t, j], 0.0
        for i in range(3):
            normal[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]
            length2 += normal[i] ** 2
        if not (seen[0, t, j] and seen[1, t, j] and length2 > _PARALLEL**2):
            continue
        used[n] = at
        for i in range(3):
            normal[i] /= np.sqrt(length2)
            apart[n] += normal[i] * (place[1, t, i] - place[0, t, i])
        for c in range(2):
            sign, away = 2 * c - 1, min(max(abs(depth[c, t, j]), 1e-4), 1e5)
            for i in range(3):
                one, other = (i + 1) % 3, (i + 2) % 3
                lever = ray[c, t, j, one] * normal[other] - ray[c, t, j, other] * normal[one]
                design[n, 6 * c + i] = sign * sigma[c, 0] * normal[i]
                for k in range(3):
                    design[n, 6 * c + 3 + k] += sign * sigma[c, 1] * away * lever * rotation[c, t, i, k]
            # What is new in every pose turns the person in the picture, besides moving them.
            turned, moved = _HALF_BODY_M * sigma[c, 3], _HALF_BODY_M * sigma[c, 2] / max(away, 1.0)
            noise2[n] += away**2 * pixel2[c] + turned**2 + moved**2
        n += 1
    return used[:n], design[:n], apart[:n], noise2[:n]


def _place(scene: SceneOfMoments, body: Body, solved: SolvedJoints, stature: float) -> dict[str, Oddity]:
    """Measure how the person moves, and how far they are from under drones, the ground, the logged actor."""
    known = solved.seen & (solved.views >= 2)
    far = [median(np.abs(depth[used])) for depth, used in zip(solved.depth, known, strict=True)]
    far_m = np.minimum(np.nan_to_num(np.array(far), nan=10.0), _FARTHEST_M)
    stated_m, white_m = _moved_by(scene.sigma[:, :2], far_m), _moved_by(scene.sigma[:, 2:4], far_m)
    keypoint_m = float(np.sqrt(np.mean(pixel_variance(scene)) * np.mean((far_m / scene.focal_px) ** 2)))
    # The cameras that see a joint change, and with them the errors that they have in common.
    limp = float(np.nanmedian([_spread(length) for length, _ in body.lengths]))
    odd = {"limp": Oddity(limp / (0.10 + 0.5 * stated_m), {"limb_spread": limp})}
    odd |= body.motion(scene, stature, white_m, keypoint_m)
    moves = np.isfinite(scene.unposed)
    if moves.any():
        above_m = median(body.hips[:, 2]) - median(scene.position[..., 2])
        odd["above"] = Oddity(max(0.0, above_m) / 2.0, {"above_m": above_m})
        below_m = -float(np.nanmax(scene.position[moves, :, 2]))
        if scene.hips is None and scene.ground is None and below_m > _BELOW_M:
            odd["below"] = Oddity(_BELOW_SIGMAS, {"below_m": below_m})
    if scene.ground is not None:
        foot = np.fmin(body["left_ankle"][:, 2], body["right_ankle"][:, 2])
        under = scene.ground.under(body.hips)
        on_map = np.isfinite(under)
        share = float(on_map.sum() / max(np.isfinite(body.hips[:, 0]).sum(), 1))
        if share < 0.5:
            odd["beside"] = Oddity(6.0, {"on_map_share": share})
        else:
            height_m = median((foot - under)[on_map]) - _ANKLE_ABOVE_GROUND_M
            above = max(0.0, abs(height_m) - 0.25 - 2 * stated_m) / float(np.hypot(0.25, stated_m))
            odd["ground"] = Oddity(above, {"feet_above_ground_m": height_m})
    else:
        lowest = np.fmin.reduce(body.joints[..., 2], axis=1)
        rise_m = quantile(lowest, 0.9) - quantile(lowest, 0.1)
        walked_m = math.hypot(*(quantile(xy, 0.95) - quantile(xy, 0.05) for xy in body.hips[:, :2].T))
        excused_m = 0.5 + _SLOPE * walked_m + 3 * white_m
        odd["level"] = Oddity(max(0.0, rise_m - excused_m) / 0.3, {"rise_m": rise_m, "walked_m": walked_m})
    if scene.hips is not None and np.isfinite(scene.hips[:, 0]).any():
        apart = body.hips - scene.hips
        constant = np.array([median(apart[:, axis]) for axis in range(3)])
        apart_m = float(np.linalg.norm(constant))
        path_m = median(np.linalg.norm(apart - constant, axis=-1))
        away = max(0.0, apart_m - 0.25 - 2 * stated_m) / float(np.hypot(0.4, stated_m))
        odd["actor"] = Oddity(away, {"from_actor_m": apart_m})
        odd["actor_path"] = Oddity(max(0.0, path_m - 0.45 - 2 * white_m) / 0.3, {"path_apart_m": path_m})
    return odd


def _moved_by(sigma: Float, far_m: Float) -> float:
    """Return by how much errors of poses, position m and rotation rad [C, 2], move a person at a distance."""
    return float(np.sqrt(np.mean(sigma[:, 0] ** 2 + (far_m * sigma[:, 1]) ** 2)))


def _spread(values: Float) -> float:
    """Return the standard deviation of a length over its median, from its quartiles."""
    return 0.74 * (quantile(values, 0.75) - quantile(values, 0.25)) / max(median(values), 1e-9)


def residuals_px(scene: SceneOfMoments) -> list[float]:
    """Return the median distances (px) of keypoints from joints: of all, then by camera; NaN without any.

    Joints whose rays do not cross fall into the cameras, and are missed by nothing: they do not count.
    """
    solved = solve(scene)
    missed, _ = _misses(solved.joints, np.nan_to_num(scene.position), solved.direction)
    pixels = np.linalg.norm(missed, axis=-1) * scene.focal_px[:, None, None]
    mean = solved.direction.sum(axis=0) / np.maximum(solved.views, 1)[..., None]
    crossing = 1 - (mean**2).sum(axis=-1) > np.sin(np.radians(MIN_PARALLAX_DEG) / 2) ** 2
    pixels = np.where(solved.seen & crossing, pixels, np.nan)
    return [round(median(each), 2) for each in (pixels, *pixels)]
