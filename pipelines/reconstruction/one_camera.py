"""Bodies of people whom a single camera sees.

Rays of one camera do not show how far away a person is. The body does: its stature is known to some
centimetres, it stands on the ground, its joints have ranges, and it moves smoothly. The fit is that of
`body_fit`, with the directions of landmarks in the place of their positions, and with four more terms:

- the pelvis is upright to some 20 degrees, bounded (Cauchy);
- the lowest point of soles, knees, fingertips, head and trunk is on the ground, and no other is below it.
  How much higher the ground is than thought, in the camera's frame, is an unknown that all moments share;
- accelerations of the root and angular accelerations of the bones are normal, bounded (Cauchy);
- the prior of the stature is narrow.

Moments are 0.2 s apart. A second difference couples three of them; two moments make one block of a block
tridiagonal matrix, which is eliminated in the order of time. Shape, offsets and level are its border. A
single view of a limb fits two poses, towards the camera and away from it. So each moment is first fitted by
itself from the likeliest of 32 postures (eight headings; upright, upside down, on the face and on the back),
and the smoothest sequence is chosen (Viterbi).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Index, Int64
from pipelines.geometry.body_model import MEAN_SHAPE, body_model
from pipelines.geometry.poses import (
    cross_matrix,
    interpolate_poses,
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from pipelines.geometry.rig import BONE, BONES, SIDES
from pipelines.reconstruction.body_fit import (
    MIN_LANDMARKS,
    BodyFit,
    Landmarks,
    Normal,
    Places,
    Points,
    Poses,
    Rays,
    Shared,
    SharedPrior,
    joint_ranges,
    settle,
    shared_prior,
)

STATURE_M = (float(MEAN_SHAPE[0]), 0.08)
"""Stature of an adult of unknown sex and its standard deviation."""
# A stated stature is that of bare feet or of shoes.
STATED_STATURE_SIGMA_M = 0.02
# Of a level that nobody knows: it is determined by the stature alone.
UNKNOWN_LEVEL_SIGMA_M = 100.0

# People move little in a fifth of a second, and a detector's errors are alike.
_MOMENT_NS = 200_000_000
# Between moments that are further apart a person is not interpolated.
_LONGEST_GAP_NS = 450_000_000
# So many moments are fitted at once, a minute; the others have what these show of shape and ground as prior.
_WINDOW, _OVERLAP = 300, 5
# Landmarks of neighbouring moments err alike, and so do accelerations. A moment of both counts less: 1.7 is
# the root of (1 + r) / (1 - r) with the correlation r of 0.5 after 0.2 s on the tuning flights.
_ALIKE = 1.7
# Pelvises of recorded people who walk, crouch and dance tilt by less in 19 of 20 moments.
_UPRIGHT_RAD = np.radians(20.0)
# Soles are flat and stiff in the body, and neither in people.
_CONTACT_SIGMA_M = 0.03
# A jump leaves the ground: beyond this many standard deviations a sole has less than half of its weight.
_CONTACT_CAUCHY = 2.0
# A blow or a turn is quicker than the rest: beyond it an acceleration has less than half of its weight.
_MOTION_CAUCHY = 4.0
# Four times what hips of people who jog accelerate by: a narrow one would make bodies small and near, because
# small ones accelerate less.
_ROOT_MPS2 = 10.0
# Angular accelerations per axis, between those of a dance and of a kick among the simulated motions.
_BONE_RADPS2 = {
    **dict.fromkeys(("pelvis", "chest", "neck", "clavicle"), 6.0),
    **dict.fromkeys(("spine", "back"), 5.0),
    **dict.fromkeys(("upper_arm", "thigh"), 25.0),
    **dict.fromkeys(("foot", "hand", "toes"), 45.0),
    "head": 8.0,
    "forearm": 40.0,
    "shank": 35.0,
}
# Mean cost of a landmark where the detector errs as usual, on the tuning flights: 0.06 to 0.12.
_USUAL_MISFIT = 0.12
# A detector fails for about as long: covariances grow with the mean misfit of so many moments.
_ALIKE_MOMENTS = 5
# Limbs that bend towards the camera unseen make a person look nearer: on the tuning flights distances err by
# this share beside what the fit says.
_DISTANCE_SHARE = 0.02
# Headings that are 45 deg apart reach every other one within the range of the linear model. Each moment is
# fitted from so many of the postures.
_HEADINGS, _KEPT_POSTURES = 8, 3
# Bones turn by this in the root of a second, rad, when the smoothest sequence of poses is chosen.
_TURN_RAD = 1.5
# A jump to another sequence of poses costs no more than this.
_MOST_JUMP = 200.0
# A detector errs by about this in a picture of a person 10 m away; it only weighs the first headings.
_FIRST_SIGMA_RAD = 0.003
_FIRST_STEPS, _STEPS = 8, 25
# A prior of this weight holds the shape that a whole flight gave.
_HELD = 1e6
# Steps end when the cost of each moment falls by less.
_SETTLED = 1e-3


class GroundHeight(NamedTuple):
    """Height of the ground under places [N, 3], [N] m, and the standard deviation of its common error."""

    under: Callable[[Float], Float]
    sigma_m: float


@dataclass(frozen=True)
class SeenBody:
    """A body from one camera, with its landmarks at the same times."""

    body: BodyFit
    place: Float  # [N, K, 3] m
    covariance: Float  # [N, K, 3, 3] m^2


def fit_seen_body(
    landmarks: Landmarks,
    t_ns: Int64,
    rays: Rays,
    ground: GroundHeight,
    stature_m: tuple[float, float],
    pose_sigma: Float,
) -> SeenBody | None:
    """Fit the body to one person's K landmarks in the pictures of one camera, between moments of ten or more.

    `sigma` of the rays is relative: 1 for a landmark of which the detector is sure. `stature_m` is the mean
    of its prior and its standard deviation. Errors of poses, `pose_sigma` [T, 2] m and rad per axis, are part
    of the level's, and are added to all covariances. None if there is no body.
    """
    (row,) = np.nonzero(rays.direction.any(axis=-1).sum(axis=1) >= MIN_LANDMARKS)
    if not len(row):
        return None
    _, first = np.unique((t_ns[row] - t_ns[row[0]]) // _MOMENT_NS, return_index=True)
    row = row[first]
    rays, every = _of(rays, row), rays
    points = StandingPoints(landmarks, ground, stature_m)
    first_turns = _usual_turns()
    error, root = _roots(points, replace(rays, sigma=_FIRST_SIGMA_RAD * rays.sigma), first_turns)
    distance = np.linalg.norm(root[error.argmin(axis=0), np.arange(len(row))], axis=-1)
    middle = np.median(distance)
    distance = np.clip(distance, middle / 2, 2 * middle)[:, None]
    position_m, rotation_rad = np.median(pose_sigma[row], axis=0)
    level_m = np.sqrt(ground.sigma_m**2 + position_m**2 + (middle * rotation_rad) ** 2)
    points.prior.precision[-1, -1] = level_m**-2
    across_m = _ALIKE * MEAN_SHAPE[0] * landmarks.picture_sigma
    rays = replace(rays, sigma=rays.sigma * across_m / distance)
    poses, level = _first_poses(points, rays, first_turns, (t_ns[row] - t_ns[row[0]]) / 1e9)
    shared = Shared(points.prior.mean[:12].copy(), np.zeros((len(landmarks.bone), 3)), level)
    found = _fit_windows(points, t_ns, row, rays, poses, shared)
    known = found.body.row
    ray = found.body.centre[:, 0] - every.camera[known]
    across = pose_sigma[known, 0] ** 2 + np.sum(ray**2, axis=1) * pose_sigma[known, 1] ** 2
    # The fit takes this share of the distance from sizes, and the rest from the ground.
    by_size = 1 / (1 + (stature_m[1] / stature_m[0] * ray[:, 2] / level_m) ** 2)
    along = (_DISTANCE_SHARE * by_size[:, None, None]) ** 2 * ray[:, :, None] * ray[:, None]
    common = (across[:, None, None] * np.eye(3) + along)[:, None]
    body = replace(found.body, centre_covariance=found.body.centre_covariance + common.astype(np.float32))
    return SeenBody(body, found.place, found.covariance + common)


def _fit_windows(
    points: StandingPoints, t_ns: Int64, row: Index, rays: Rays, poses: Poses, shared: Shared
) -> SeenBody:
    """Fit windows one after the other, and all again with the shape of all if there are several."""
    starts, whole = range(0, len(row), _WINDOW), None
    for start in starts if len(starts) > 1 else ():
        part = np.arange(start, min(start + _WINDOW, len(row)))
        fit = _fit(points, t_ns[row[part]], _of(rays, part), _poses_of(poses, part), shared)
        shared, whole = fit.shared, fit.shared_covariance
        points.prior = SharedPrior(shared.vector, np.asarray(np.linalg.inv(whole), np.float64))
    if whole is not None:  # every picture has told of the shape: none tells again
        points.prior = SharedPrior(shared.vector, _HELD * points.prior.precision)
    parts = []
    for start in starts:
        stop = min(start + _WINDOW, len(row))
        part = np.arange(max(0, start - _OVERLAP), min(stop + _OVERLAP, len(row)))
        fit = _fit(points, t_ns[row[part]], _of(rays, part), _poses_of(poses, part), shared)
        fit = fit if whole is None else fit._replace(shared=shared, shared_covariance=whole)
        inner = slice(start - part[0], stop - part[0])
        own = _poses_of(fit.poses, inner), fit.shared, fit.covariance[inner], fit.answer[inner]
        turning, *joints = points.spread_of_joints(*own, fit.shared_covariance)
        places = points.spread(*own, fit.shared_covariance)
        wider = _misfit(points, _of(rays, part), fit)[inner, None, None, None]
        widened = (wider * each for each in (turning, joints[1], places[1]))
        parts.append((own[0].turn, own[0].root, *widened))
    turn, root, *covariances = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _at_every_time(points, t_ns, row, Poses(root, turn), fit, covariances)


def _misfit(points: StandingPoints, rays: Rays, fit: _Fit) -> Float:
    """Return the factor [N] of variances, 1 or more: misfits of landmarks relative to usual ones.

    A detector that sees people upside down or lying errs by more than the table of landmarks says. Misfits
    show it: this is the a posteriori variance factor of adjustments, of moments near each other.
    """
    cost = points.costs(fit.poses, rays, fit.shared) / rays.direction.any(axis=-1).sum(axis=1)
    near, half = np.cumsum(np.concatenate([[0.0], cost])), _ALIKE_MOMENTS // 2
    first = np.maximum(np.arange(len(cost)) - half, 0)
    last = np.minimum(np.arange(len(cost)) + half + 1, len(cost))
    mean = (near[last] - near[first]) / (last - first)
    return np.asarray(np.maximum(mean / _USUAL_MISFIT, 1.0))


def _at_every_time(
    points: StandingPoints, t_ns: Int64, row: Index, poses: Poses, fit: _Fit, covariances: list[Float]
) -> SeenBody:
    """Interpolate poses and covariances from moments to the times between them."""
    quaternion = quaternion_from_matrix(poses.turn)
    parts = [
        interpolate_poses(t_ns[row], poses.root, quaternion[:, bone], t_ns, max_gap_ns=_LONGEST_GAP_NS)
        for bone in range(len(BONES))
    ]
    (known,) = np.nonzero(np.isfinite(parts[0][0]).all(axis=-1))
    rotation = np.stack([each[1][known] for each in parts], axis=1)
    every = Poses(parts[0][0][known], matrix_from_quaternion(rotation))
    after = np.clip(np.searchsorted(t_ns[row], t_ns[known]), 1, max(len(row) - 1, 1))
    before, after = after - 1, np.minimum(after, len(row) - 1)
    step = np.maximum(t_ns[row[after]] - t_ns[row[before]], 1)
    share = ((t_ns[known] - t_ns[row[before]]) / step)[:, None, None, None]
    turning, of_joints, of_places = (
        each[before] + share * (each[after] - each[before]) for each in covariances
    )
    shares = np.array([1.0, *fit.shared.shape[1:]])
    body = BodyFit(
        fit.shared.shape,
        fit.shared_covariance[:12, :12],
        known,
        rotation,
        _placed(every, fit.shared.shape[0], np.tensordot(shares, points.centres, 1)),
        turning.astype(np.float32),
        of_joints.astype(np.float32),
    )
    return SeenBody(body, _placed(every, fit.shared.shape[0], points.vectors(fit.shared)), of_places)


def _placed(poses: Poses, stature_m: float, vectors: Float) -> Float:
    """Place points [N, K, 3] with vectors [K, 22, 3] of the bones."""
    found: Float = poses.root[:, None] + stature_m * np.einsum(
        "nbij,kbj->nki", poses.turn, vectors, optimize=True
    )
    return found


def _of(rays: Rays, part: Index) -> Rays:
    return Rays(rays.camera[part], rays.direction[part], rays.sigma[part])


def _poses_of(poses: Poses, part: Index | slice | Bool) -> Poses:
    return Poses(poses.root[part], poses.turn[part])


# --- terms of one moment -------------------------------------------------------------------------------


@cache
def _contacts() -> tuple[Index, Float]:
    """Return bones [34] and offsets [34, 3] of soles, knees, fingertips, and the outermost of the trunk."""
    model = body_model()
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(BONES), 1))
    surface = model.surface(np.array([1.0, *np.zeros(11)]), np.zeros(3), upright)
    centres = model.centres
    bones, offsets = [], []
    for sign, side in zip((1.0, -1.0), SIDES, strict=True):
        for part, ends in (("foot", (np.min, np.max)), ("toes", (np.max,))):
            bone = BONE[f"{side}_{part}"]
            own = surface[model.weights.argmax(axis=1) == bone]
            lowest = own[own[:, 2] <= np.quantile(own[:, 2], 0.15)]
            for end in ends:
                bones.append(bone)
                point = np.array([end(lowest[:, 0]), lowest[:, 1].mean(), own[:, 2].min()])
                offsets.append(point - centres[bone])
        for part in ("shank", "hand", "head", "chest", "pelvis"):
            bone = BONE[part if part in BONE else f"{side}_{part}"]
            own = surface[(model.weights.argmax(axis=1) == bone) & (sign * surface[:, 1] > 0)] - centres[bone]
            x, y, z = own.T
            keys = {"shank": [x], "hand": [np.linalg.norm(own, axis=1)]}.get(part, [x, -x, sign * y, z])
            bones += [bone] * len(keys)
            offsets += [own[key.argmax()] for key in keys]
    return np.array(bones), np.array(offsets)


class StandingPoints(Points):
    """Landmarks of a body that is upright and stands on the ground."""

    # With a third, places are 5 % worse, and their stated errors are smaller.
    usual_share = 1 / 2

    def __init__(self, landmarks: Landmarks, ground: GroundHeight, stature_m: tuple[float, float]) -> None:
        super().__init__(body_model(), landmarks)
        self.ground = ground
        self.contacts = self.model.reach(*_contacts())  # [12, 34, 22, 3]
        # Offsets that several bones share look like another distance here: with them bodies are 3 % worse,
        # so modes take no part.
        prior = shared_prior(landmarks, between_bones=False)
        precision, mean = prior.precision, prior.mean
        mean[0] = stature_m[0]
        precision[0, 0], precision[-1, -1] = stature_m[1] ** -2, ground.sigma_m**-2
        self.prior = SharedPrior(mean, precision)
        self.together = self.together[..., :0]

    def normal(
        self, poses: Poses, seen: Places | Rays, shared: Shared, *, whole: bool, share: float = 1.0
    ) -> Normal:
        """Add what holds the pelvis upright and the lowest point on the ground."""
        found = super().normal(poses, seen, shared, whole=whole, share=share)
        away, lying = _lying(poses.turn)
        slope = -cross_matrix(poses.turn[:, 0, :, 2]) / _UPRIGHT_RAD
        transposed = share * np.swapaxes(slope, 1, 2) / np.exp(lying)[:, None, None]
        found.pose[:, 3:6, 3:6] += transposed @ slope
        found.pose_right[:, 3:6] -= (transposed @ away[..., None])[..., 0]
        cost = found.cost + share * lying

        stature, count = shared.shape[0], len(poses.root)
        vectors = np.tensordot(np.array([1.0, *shared.shape[1:]]), self.contacts, 1)
        arms = np.einsum("nbij,kbj->nkbi", poses.turn, vectors, optimize=True)
        point = poses.root[:, None] + stature * arms.sum(axis=2)
        height = point[..., 2] - self.ground.under(point.reshape(-1, 3)).reshape(count, -1) - shared.level_m
        touching = (height < 0) | (height == height.min(axis=1, keepdims=True))
        # Relative to the stature: else the smallest body would stand best.
        sigma_m = _CONTACT_SIGMA_M * stature / MEAN_SHAPE[0]
        error = np.where(touching, height / sigma_m, 0.0)
        square = (error / _CONTACT_CAUCHY) ** 2
        bounded = np.sqrt(share) * touching / np.sqrt(1 + square) / sigma_m
        error *= bounded * sigma_m
        by_pose = np.zeros((*height.shape, found.pose.shape[1]))
        by_pose[..., 2] = 1.0
        by_pose[..., 3:] = (-stature * cross_matrix(arms)[..., 2, :]).reshape(*height.shape, -1)
        by_pose *= bounded[..., None]
        transposed = np.swapaxes(by_pose, 1, 2)
        pose = found.pose + transposed @ by_pose
        right = found.pose_right - (transposed @ error[..., None])[..., 0]
        cost = cost + _CONTACT_CAUCHY**2 * np.log1p(square).sum(axis=1)
        if not whole:
            return replace(found, cost=cost, pose=pose, pose_right=right)
        by_shared = np.zeros((*height.shape, len(found.shared)))
        by_shared[..., 0] = arms.sum(axis=2)[..., 2] - height / stature
        by_shared[..., -1] = -1.0
        by_shared[..., 1:12] = stature * np.einsum(
            "nbj,mkbj->nkm", poses.turn[:, :, 2], self.contacts[1:], optimize=True
        )
        by_shared *= bounded[..., None]
        flat = by_shared.reshape(-1, by_shared.shape[-1])
        return Normal(
            cost,
            pose,
            right,
            found.shared + flat.T @ flat,
            found.shared_right - flat.T @ error.ravel(),
            found.between + transposed @ by_shared,
        )


def _lying(turn: Float) -> tuple[Float, Float]:
    """Return how far pelvises point away from upwards [N, 3], and the cost [N], which is bounded (Cauchy)."""
    away = (turn[:, 0, :, 2] - [0.0, 0.0, 1.0]) / _UPRIGHT_RAD
    return away, np.log1p((away**2).sum(axis=1))


# --- motion --------------------------------------------------------------------------------------------


class _Motion(NamedTuple):
    """Accelerations of N - 2 moments: their cost, errors, weights, and shares of the three moments."""

    cost: float
    error: Float  # [N - 2, D]
    weight: Float  # [N - 2, D]
    share: Float  # [N - 2, 3]


@cache
def _precision_of_motion() -> Float:
    """Return the precisions [D] of accelerations."""
    parts = [name.removeprefix("left_").removeprefix("right_") for name in BONES]
    sigma = _ALIKE * np.repeat([_ROOT_MPS2, *(_BONE_RADPS2[part] for part in parts)], 3)
    return np.asarray(sigma**-2, np.float64)


def _motion(poses: Poses, t_s: Float) -> _Motion:
    """Compute accelerations; derivatives take rotations between moments for small."""
    step = np.diff(t_s)
    middle = (step[1:] + step[:-1]) / 2
    back = np.swapaxes(poses.turn[:-1], -1, -2)
    turned = rotation_vector_from_quaternion(quaternion_from_matrix(poses.turn[1:] @ back))
    way = np.concatenate([np.diff(poses.root, axis=0)[:, None], turned], axis=1) / step[:, None, None]
    error = np.diff(way, axis=0) / middle[:, None, None]
    precision = _precision_of_motion().reshape(-1, 3)
    square = np.sum(precision * error**2, axis=-1, keepdims=True) / _MOTION_CAUCHY**2
    share = np.stack([1 / step[:-1], -1 / step[:-1] - 1 / step[1:], 1 / step[1:]], axis=1) / middle[:, None]
    size = (len(error), 3 * (1 + len(BONES)))  # no acceleration in fewer than three moments
    weight = (precision / (1 + square)).reshape(size)
    return _Motion(float(_MOTION_CAUCHY**2 * np.log1p(square).sum()), error.reshape(size), weight, share)


class _Fit(NamedTuple):
    """A fitted window with covariances."""

    poses: Poses
    shared: Shared
    covariance: Float  # [N, D, D] of poses where shared unknowns are exact
    answer: Float  # [N, D, G] of poses to shared unknowns
    shared_covariance: Float  # [G, G]


def _fit(points: StandingPoints, t_ns: Int64, rays: Rays, poses: Poses, shared: Shared) -> _Fit:
    """Fit poses and shared unknowns of one window (Levenberg and Marquardt)."""
    t_s = (t_ns - t_ns[0]) / 1e9
    normal, motion = points.normal(poses, rays, shared, whole=True), _motion(poses, t_s)
    cost, damping = normal.cost.sum() + motion.cost + points.prior.cost(shared), 1e-2
    for _ in range(_STEPS):
        chain = _Chain(normal, motion, damping)
        border = normal.shared - np.einsum("ndg,ndh->gh", normal.between, chain.answer, optimize=True)
        border[np.diag_indices_from(border)] *= 1 + damping
        right = normal.shared_right - np.einsum("ndg,nd->g", normal.between, chain.step)
        step = np.asarray(np.linalg.solve(border, right), np.float64)
        new_shared, new_poses = shared.moved(step), poses.moved(chain.step - chain.answer @ step)
        new, new_motion = points.normal(new_poses, rays, new_shared, whole=True), _motion(new_poses, t_s)
        new_cost = new.cost.sum() + new_motion.cost + points.prior.cost(new_shared)
        if not new_cost <= cost:
            damping *= 8
            continue
        done = cost - new_cost < _SETTLED * len(t_s)
        poses, shared, normal, motion = new_poses, new_shared, new, new_motion
        cost, damping = new_cost, damping / 5
        if done:
            break
    # Postures last: what is usual is evidence in each moment for the estimate, but not for its covariance.
    normal = points.normal(poses, rays, shared, whole=True, share=_ALIKE**-2)
    chain = _Chain(normal, motion, 0.0)
    border = normal.shared - np.einsum("ndg,ndh->gh", normal.between, chain.answer, optimize=True)
    covariance = np.asarray(np.linalg.inv(border), np.float64)
    return _Fit(poses, shared, chain.covariance(), -chain.answer, covariance)


class _Chain:
    """Poses of a window, eliminated in time order: `step` solves the right sides, `answer` the coupling."""

    def __init__(self, normal: Normal, motion: _Motion, damping: float) -> None:
        from scipy.linalg import cho_factor, cho_solve

        self._solve = cho_solve
        count, size = normal.pose_right.shape
        blocks = (count + 1) // 2
        diagonal, every = np.zeros((2 * blocks, size, size)), np.arange(size)
        diagonal[:] = np.eye(size)  # of a moment that makes the last block whole
        diagonal[:count] = normal.pose
        diagonal[:count, every, every] *= 1 + damping
        right = np.zeros((2 * blocks, size, 1 + normal.between.shape[2]))
        right[:count, :, 0], right[:count, :, 1:] = normal.pose_right, normal.between
        beside = np.zeros((3, 2 * blocks + 3, size))  # diagonals of what couples a moment with later ones
        inner = count - 2
        for one in range(3 if inner > 0 else 0):
            share = motion.share[:, one, None]
            diagonal[one : one + inner, every, every] += motion.weight * share**2
            right[one : one + inner, :, 0] -= motion.weight * share * motion.error
            for later in range(1, 3 - one):
                own = motion.weight * share * motion.share[:, one + later, None]
                beside[later, one : one + inner] += own
        whole = np.zeros((blocks, 2, size, 2, size))
        after = np.zeros((blocks, 2, size, 2, size))
        for half in (0, 1):
            whole[:, half, :, half] = diagonal[half::2]
            after[:, half, every, half, every] = beside[2, half : 2 * blocks : 2]
        whole[:, 0, every, 1, every] = whole[:, 1, every, 0, every] = beside[1, 0 : 2 * blocks : 2]
        after[:, 1, every, 0, every] = beside[1, 1 : 2 * blocks : 2]
        block = whole.reshape(blocks, 2 * size, 2 * size)
        self._after = after.reshape(blocks, 2 * size, 2 * size)
        solved = right.reshape(blocks, 2 * size, -1)
        self._factors: list[Any] = []
        self._links: list[Float] = []
        for k in range(blocks):
            if k:
                block[k] -= self._after[k - 1].T @ self._links[-1]
                solved[k] -= self._after[k - 1].T @ solved[k - 1]
            self._factors.append(cho_factor(block[k], lower=True))
            solved[k] = cho_solve(self._factors[-1], solved[k])
            self._links.append(cho_solve(self._factors[-1], self._after[k]))
        for k in range(blocks - 2, -1, -1):
            solved[k] -= self._links[k] @ solved[k + 1]
        found = solved.reshape(2 * blocks, size, -1)[:count]
        self.step, self.answer = found[..., 0], found[..., 1:]

    def covariance(self) -> Float:
        """Compute the covariances [N, D, D] of poses (Takahashi's recursion)."""
        count, size = self.step.shape
        found = np.zeros((len(self._factors) * 2, size, size))
        later = np.zeros((2 * size, 2 * size))
        for k in range(len(self._factors) - 1, -1, -1):
            link = self._links[k]
            later = self._solve(self._factors[k], np.eye(2 * size)) + link @ later @ link.T
            found[2 * k], found[2 * k + 1] = later[:size, :size], later[size:, size:]
        return found[:count]


# --- first poses ---------------------------------------------------------------------------------------


def _usual_turns() -> Float:
    """Return rotations [H, 22, 3, 3] of a body in its usual posture: upright, upside down and lying."""
    usual = joint_ranges()
    turn = np.zeros((len(BONES), 3, 3))
    turn[0] = np.eye(3)
    bent = matrix_from_quaternion(quaternion_from_rotation_vector(usual.usual))
    for k, (bone, parent) in enumerate(zip(usual.bone.tolist(), usual.parent.tolist(), strict=True)):
        turn[bone] = turn[parent] @ usual.middle[k] @ bent[k]
    heading, tilts = np.zeros((_HEADINGS, 3)), np.zeros((4, 3))
    heading[:, 2] = np.arange(_HEADINGS) * (2 * np.pi / _HEADINGS)
    tilts[1:, 1] = np.pi, np.pi / 2, -np.pi / 2  # on the head, the face and the back
    headings, tilted = (matrix_from_quaternion(quaternion_from_rotation_vector(v)) for v in (heading, tilts))
    first = headings[:, None] @ tilted
    return np.asarray(first.reshape(-1, 1, 3, 3) @ turn)


def _roots(points: StandingPoints, rays: Rays, turns: Float) -> tuple[Float, Float]:
    """Place bodies [H] of one posture nearest to the rays: errors [H, N], and roots from the camera."""
    if len(rays.camera) > _WINDOW:  # arrays of all landmarks and postures are large
        half = np.array_split(np.arange(len(rays.camera)), 2)
        (one, first), (other, second) = (_roots(points, _of(rays, part), turns) for part in half)
        return np.concatenate([one, other], axis=1), np.concatenate([first, second], axis=1)
    stature, seen = points.prior.mean[0], np.asarray(rays.direction.any(axis=-1))[..., None, None]
    across = np.where(seen, np.eye(3) - rays.direction[..., None] * rays.direction[..., None, :], 0.0)
    arms = stature * np.einsum("hbij,kbj->hki", turns, points.reach[0], optimize=True)
    right = np.einsum("nkij,hkj->hni", across, -arms, optimize=True)
    root = np.linalg.solve(across.sum(axis=1), right[..., None])[..., 0]
    point = root[:, :, None] + arms[:, None]
    away = np.einsum("nkij,hnkj->hnki", across, point, optimize=True)
    depth = np.maximum(np.sum(point * rays.direction, axis=-1), 0.1)
    error = np.sum(away**2, axis=-1) / (depth * rays.sigma) ** 2
    return np.log1p(error).sum(axis=-1) + _lying(turns)[1][:, None], root


def _first_poses(points: StandingPoints, rays: Rays, turns: Float, t_s: Float) -> tuple[Poses, float]:
    """Fit each moment from its likeliest headings, and choose the smoothest sequence; also the level."""
    error, root = _roots(points, rays, turns)
    root = root + rays.camera
    level = 0.0
    if points.ground.sigma_m >= UNKNOWN_LEVEL_SIGMA_M:
        sole = points.contacts[0].sum(axis=1)[:, 2].min()
        likeliest = root[error.argmin(axis=0), np.arange(len(t_s))]
        level = float(np.median(likeliest[:, 2]) + points.prior.mean[0] * sole)
    shared = Shared(points.prior.mean[:12].copy(), np.zeros((len(points.bone), 3)), level)
    found, costs = [], []
    order = np.argsort(error, axis=0)[:_KEPT_POSTURES]
    for heading in order:
        start = Poses(root[heading, np.arange(len(t_s))], turns[heading])
        parts = [
            settle(points, _poses_of(start, part), _of(rays, part), shared, _FIRST_STEPS)
            for part in np.array_split(np.arange(len(t_s)), -(-len(t_s) // _WINDOW))
        ]
        found.append(
            Poses(*(np.concatenate([getattr(own, name) for own, _ in parts]) for name in ("root", "turn")))
        )
        costs.append(np.concatenate([cost for _, cost in parts]))
    chosen = _smoothest(np.stack([poses.turn for poses in found]), np.stack(costs), np.diff(t_s))
    at = chosen, np.arange(len(t_s))
    return Poses(
        np.stack([poses.root for poses in found])[at], np.stack([poses.turn for poses in found])[at]
    ), level


def _smoothest(turn: Float, cost: Float, step_s: Float) -> Index:
    """Choose one of H poses at each moment (Viterbi), from rotations [H, N, 22, 3, 3] and costs [H, N]."""
    best, back = cost[:, 0], []
    for k, step in enumerate(step_s.tolist()):
        trace = np.einsum("abij,cbij->acb", turn[:, k], turn[:, k + 1], optimize=True)
        angle = np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0))
        jump = np.minimum(np.sum(angle**2, axis=-1) / (_TURN_RAD**2 * step), _MOST_JUMP)
        total = best[:, None] + jump
        back.append(total.argmin(axis=0))
        best = total.min(axis=0) + cost[:, k + 1]
    path = [int(best.argmin())]
    for before in reversed(back):
        path.append(int(before[path[-1]]))
    return np.array(path[::-1], dtype=np.intp)
