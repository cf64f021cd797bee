"""Fit of the body (`geometry.body_model`) to the joints of one person.

Landmarks are a detector's keypoints as points that are fixed to a bone (`data/landmarks.csv`, made by
`tools/body_landmarks.py`). How far a landmark of one body lies from its place in the table is constant over a
flight and unknown: such offsets are estimated with the shape, with the table's spread as prior. So shape and
pose do not seem surer than landmarks are. Landmarks vary together: over bare legs both ankles, heels and
knees lie higher than over trousers. The table has the principal modes of this (factor analysis). Within a
flight landmarks of a limb or a face err together, too: the modes have an amplitude at every time besides.

The fit is a maximum a posteriori estimate: joints with their covariances and the spread of landmarks between
pictures, bounded (Cauchy); a prior of the shape; and the range of every joint, as a wide normal distribution
and a steep bound (`_RANGES_DEG`). Shape and offsets are determined from moments that are so far apart that
errors of the detector have changed; then each moment's pose is fitted by itself, since joints of the estimate
are smooth already. Every step is Gauss-Newton with the derivatives of world rotations R <- exp(d) R.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Float, Float32, Index, Int64
from pipelines.geometry.body_model import MEAN_SHAPE, SHAPE_SIGMA, BodyModel, body_model, turned
from pipelines.geometry.poses import (
    cross_matrix,
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from pipelines.geometry.rig import BONE, BONES, PARENT, SIDES, unit

_TABLE = Path(__file__).parent / "data" / "landmarks.csv"

# The trunk's joints give the first pose.
TRUNK = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
# With fewer joints, limbs would be of the prior alone.
MIN_LANDMARKS = 10
# A detector misplaces landmarks for as long as a posture lasts: with moments so far apart, errors of statures
# are as large as stated on the tuning flights (2 s), and larger than stated with 0.4 s.
_INDEPENDENT_S = 2.0
# More moments hardly make the shape surer, because offsets of landmarks stay.
_MOST_MOMENTS = 200
# Poses of so many moments at once take 50 MB.
_BLOCK = 128
_SHAPE_STEPS, _POSE_STEPS = 12, 6
# A landmark this many standard deviations off has half its weight.
_CAUCHY = 3.0
# Weights of landmarks and amplitudes of modes are computed in turn; after three rounds neither changes.
_AMPLITUDE_STEPS = 3
# A joint beyond its range is held back as if by a measurement this good.
_BOUND_RAD = np.radians(5.0)
# Who crouches or lies is far from usual in many joints: a joint beyond so many standard deviations has less
# than half of its weight.
_USUAL_CAUCHY = 1.0
# A relaxed arm bends its elbow by so much, degrees.
_USUAL_ELBOW_DEG = -20.0
# No landmark is surer than this, whatever a covariance says.
_LEAST_SIGMA_M = 1e-3
# Nearly parallel rays leave a landmark's depth open: beyond this it has no weight, and stays finite.
_MOST_SIGMA_M = 100.0
# A trunk that is shorter or narrower than this has no directions.
_LEAST_TRUNK_M = 0.02
# A landmark that a step puts behind the camera counts as this far before it.
_LEAST_DEPTH_M = 0.3
# A longer step leaves the range of the linear model.
_LONGEST_STEP_RAD = 0.5

_RANGES_DEG: dict[str, tuple[tuple[float, float], ...]] = {
    "spine": ((-12, 12), (-10, 30), (-15, 15)),
    "back": ((-12, 12), (-10, 30), (-15, 15)),
    "chest": ((-12, 12), (-10, 30), (-15, 15)),
    "neck": ((-23, 23), (-25, 25), (-35, 35)),
    "head": ((-23, 23), (-25, 25), (-35, 35)),
    "clavicle": ((-10, 40), (-10, 10), (-20, 20)),
    "upper_arm": ((-30, 150), (-180, 60), (-90, 90)),
    "forearm": ((-8, 8), (-150, 0), (-80, 80)),
    "hand": ((-70, 80), (-70, 80), (-10, 10)),
    "thigh": ((-30, 45), (-120, 30), (-45, 45)),
    "shank": ((-5, 5), (0, 150), (-15, 15)),
    "foot": ((-20, 20), (-20, 50), (-20, 20)),
    "toes": ((-3, 3), (-70, 45), (-3, 3)),
}
"""Rotation of a left bone against its parent about x (forward), y (left) and z (up), degrees from the
neutral pose. American Academy of Orthopaedic Surgeons (1965): thoracolumbar 80/25, 35 and 45 deg and cervical
45/45, 45 and 60 deg, each divided among its bones; right limbs are mirrored."""


@dataclass(frozen=True)
class Landmarks:
    """Keypoints as points of the body, K of them."""

    joints: tuple[str, ...]
    bone: Index  # [K]
    offset: Float  # [K, 3] from the bone's joint, neutral axes, relative to the stature
    body_sigma: Float  # [K, 3] spread of the offset between bodies beside the modes, relative to the stature
    modes: Float  # [K, 3, M] offsets that vary together, 1 is a standard deviation, relative to the stature
    picture_sigma: Float  # [K] spread within a flight, relative to the stature

    @property
    def at_rest(self) -> Float:
        """Places [K, 3] in the neutral pose from the pelvis, relative to the stature."""
        return np.asarray(body_model().centres[self.bone] + self.offset)


@cache
def _tables() -> dict[str, Landmarks]:
    """Read the landmarks of every kind of detector."""
    found = {}
    for kind, rows in pd.read_csv(_TABLE, comment="#").groupby("detector"):
        found[str(kind)] = Landmarks(
            tuple(rows["joint"]),
            np.array([BONE[name] for name in rows["bone"]]),
            rows[["x", "y", "z"]].to_numpy(np.float64),
            rows[["sx", "sy", "sz"]].to_numpy(np.float64),
            rows.filter(regex="^mode").to_numpy(np.float64).reshape(len(rows), 3, -1),
            rows["picture_sigma"].to_numpy(np.float64),
        )
    return found


def is_blazepose(joints: Sequence[str]) -> bool:
    """Test if keypoints are BlazePose's: no other detector finds corners of the mouth."""
    return "left_mouth" in joints


def landmarks_of(joints: Sequence[str]) -> tuple[Landmarks, Index] | None:
    """Return a skeleton's landmarks and columns; None for too few."""
    table = _tables()["blazepose" if is_blazepose(joints) else "coco"]
    kept = np.array([k for k, name in enumerate(table.joints) if name in joints], dtype=np.intp)
    names = [table.joints[k] for k in kept.tolist()]
    if len(kept) < MIN_LANDMARKS or not set(TRUNK).issubset(names):
        return None
    columns = np.array([list(joints).index(name) for name in names], dtype=np.intp)
    spread = table.body_sigma[kept], table.modes[kept], table.picture_sigma[kept]
    return Landmarks(tuple(names), table.bone[kept], table.offset[kept], *spread), columns


@dataclass(frozen=True)
class BodyFit:
    """One person's body over a flight."""

    shape: Float  # [12] `body_model.SHAPE`
    shape_covariance: Float  # [12, 12]
    row: Index  # [N] the times that have a pose, ascending
    rotation: Float  # [N, 22, 4] world_from_bone relative to the neutral pose
    centre: Float  # [N, 22, 3] m, joints of the bones, the pelvis's first
    rotation_covariance: Float32  # [N, 22, 3, 3] rad^2, of a rotation vector in the world
    centre_covariance: Float32  # [N, 22, 3, 3] m^2


@dataclass(frozen=True)
class Shared:
    """Unknowns of all moments, G = 12 + 3 K + 1: shape, offsets [K, 3], the ground's height (one camera)."""

    shape: Float
    offset: Float
    level_m: float = 0.0

    @property
    def vector(self) -> Float:
        """All of them [G]."""
        return np.concatenate([self.shape, self.offset.ravel(), [self.level_m]])

    def moved(self, step: Float) -> Shared:
        """Add a step [G]."""
        offset = self.offset + step[12:-1].reshape(-1, 3)
        return Shared(self.shape + step[:12], offset, self.level_m + float(step[-1]))


@dataclass(frozen=True)
class SharedPrior:
    """Normal distribution of the shared unknowns."""

    mean: Float  # [G]
    precision: Float  # [G, G]

    def cost(self, shared: Shared) -> float:
        """Compute the cost of values."""
        away = shared.vector - self.mean
        return float(away @ self.precision @ away)


@dataclass(frozen=True)
class Poses:
    """Unknowns of every moment, D = 3 + 66: the root [N, 3] and world rotations [N, 22, 3, 3]."""

    root: Float
    turn: Float

    def moved(self, step: Float) -> Poses:
        """Add steps [N, D] of roots and rotation vectors in the world."""
        vector = step[:, 3:].reshape(-1, len(BONES), 3)
        size = np.linalg.norm(vector, axis=-1, keepdims=True)
        vector = vector * np.minimum(1.0, _LONGEST_STEP_RAD / np.maximum(size, 1e-12))
        step_turn = matrix_from_quaternion(quaternion_from_rotation_vector(vector))
        return Poses(self.root + step[:, :3], step_turn @ self.turn)


@dataclass(frozen=True)
class Places:
    """Landmarks of N moments: places [N, K, 3] m, 0 where missing, and roots of weights [N, K, 3, 3]."""

    place: Float
    root_weight: Float  # L^T of the inverse covariance L L^T; 0 where missing

    def near(self, _: Float) -> Places:
        """Return itself: places do not depend on where the fit has the landmarks."""
        return self


@dataclass(frozen=True)
class Rays:
    """Landmarks of N moments as one camera sees them: directions [N, K, 3] in the world, 0 where missing."""

    camera: Float  # [N, 3] m
    direction: Float
    sigma: Float  # [N, K] rad per axis, above 0

    def near(self, points: Float) -> Places:
        """Return places and weights that have the errors and derivatives of directions to points [N, K, 3].

        With u from the camera to a point and z = u d along the ray d, the error is u / z - d. That is the
        weight (1 - u d' / z) / z times the point less its place z d on the ray.
        """
        away = points - self.camera[:, None]
        depth = np.maximum(np.sum(away * self.direction, axis=-1), _LEAST_DEPTH_M)[..., None]
        seen = np.asarray(self.direction.any(axis=-1))[..., None, None]
        weight = np.eye(3) - (away / depth)[..., None] * self.direction[..., None, :]
        weight = np.where(seen, weight / (depth * self.sigma[..., None])[..., None], 0.0)
        return Places(self.camera[:, None] + depth * self.direction, weight)


@dataclass(frozen=True)
class Normal:
    """Normal equations: of poses [N, D, D], of shared unknowns [G, G] and between; and minus gradients."""

    cost: Float  # [N]
    pose: Float
    pose_right: Float
    shared: Float
    shared_right: Float
    between: Float  # [N, D, G]


def fit_body(
    landmarks: Landmarks,
    t_ns: Int64,
    place: Float,
    errors: Callable[[Index], tuple[Float, Float, Float]],
    between: Callable[[range], Iterable[int]] = iter,
) -> BodyFit | None:
    """Fit the body to one person's K landmarks, `place` [T, K, 3] m, NaN where missing; None without one.

    `errors` gives for N of the times the covariances m^2 of each landmark's own error [N, K, 3, 3], and of
    the error that all landmarks of a time share [N, 3, 3], and the variance of the scale [N], which is taken
    for constant. The body has all times with both hips, both shoulders and ten landmarks. `between` gives
    memory back between parts of a long flight.
    """
    known = np.asarray(np.isfinite(place).all(axis=-1))
    trunk = [landmarks.joints.index(name) for name in TRUNK]
    left_hip, right_hip, left_shoulder, right_shoulder = (place[:, k] for k in trunk)
    sides = left_hip - right_hip, left_shoulder - right_shoulder, left_shoulder - left_hip
    whole = known[:, trunk].all(axis=1) & (known.sum(axis=1) >= MIN_LANDMARKS)
    whole &= np.min([np.linalg.norm(side, axis=1) for side in sides], axis=0) > _LEAST_TRUNK_M
    (row,) = np.nonzero(whole)
    if not len(row):
        return None
    model = body_model()
    points = Points(model, landmarks)
    chosen = row[_apart(t_ns[row])]
    first = _first_poses(model, landmarks, place[chosen])
    own, _, scale = errors(chosen)
    shared, shared_covariance = _fit_shared(points, first, _seen(place[chosen], own), float(np.median(scale)))
    joined: list[Any] = []  # filled part by part, because parts joined at last are in memory twice
    for start in between(range(0, len(row), _BLOCK)):
        rows = row[start : start + _BLOCK]
        own, common, _ = errors(rows)
        first, seen = _first_poses(model, landmarks, place[rows]), _seen(place[rows], own)
        turn, turn_covariance, centre, centre_covariance = _fit_poses(
            points, first, seen, shared, shared_covariance
        )
        quaternion = quaternion_from_matrix(turn)
        covariances = np.float32(turn_covariance), np.float32(centre_covariance + common[:, None])
        part: tuple[Any, ...] = (quaternion, centre, *covariances)
        joined = joined or [np.empty((len(row), *each.shape[1:]), each.dtype) for each in part]
        for of_all, each in zip(joined, part, strict=True):
            of_all[start : start + len(rows)] = each
    return BodyFit(shared.shape, shared_covariance[:12, :12], row, *joined)


def _seen(place: Float, covariance: Float) -> Places:
    """Invert the covariances of landmarks [N, K, 3]; a landmark without a place has no weight."""
    known = np.asarray(np.isfinite(place).all(axis=-1, keepdims=True))
    variance, axes = np.linalg.eigh(np.where(known[..., None], covariance, np.eye(3)))
    sigma = np.sqrt(np.clip(variance, 0.0, _MOST_SIGMA_M**2) + _LEAST_SIGMA_M**2)
    root = np.einsum("...ij,...j,...kj->...ik", axes, 1 / sigma, axes) * known[..., None]
    return Places(np.where(known, place, 0.0), root)


def _apart(t_ns: Int64) -> Index:
    """Choose moments that are at least `_INDEPENDENT_S` apart, at most `_MOST_MOMENTS` of them."""
    step_ns = max(_INDEPENDENT_S * 1e9, (t_ns[-1] - t_ns[0]) / _MOST_MOMENTS)
    _, first = np.unique(((t_ns - t_ns[0]) // step_ns).astype(np.int64), return_index=True)
    return first


# --- equations -----------------------------------------------------------------------------------------


class Points:
    """Landmarks, and joints of the bones, as functions of pose and shared unknowns."""

    # A range is taken as three standard deviations to both sides of the usual posture. On the tuning flights
    # bodies are 1 % worse with two, and statures are worse with four.
    usual_share = 1 / 3

    def __init__(self, model: BodyModel, landmarks: Landmarks) -> None:
        """Take the reach of every point."""
        self.model, self.bone = model, landmarks.bone
        self.reach = model.reach(landmarks.bone, landmarks.offset)  # [1 + 11, K, 22, 3]
        every = np.arange(len(BONES))
        self.centres = model.reach(every, np.zeros((len(BONES), 3)))
        self.prior = shared_prior(landmarks)
        self.together = landmarks.modes

    def vectors(self, shared: Shared) -> Float:
        """Return the vectors u [K, 22, 3] of the landmarks, relative to the stature."""
        found: Float = np.tensordot(np.array([1.0, *shared.shape[1:]]), self.reach, 1)
        found[np.arange(len(self.bone)), self.bone] += shared.offset
        return found

    def _whitened(
        self, poses: Poses, seen: Places | Rays, shared: Shared
    ) -> tuple[Float, Float, Float, Float, Float, Float]:
        """Return arms R_b u_b [N, K, 22, 3], weights, errors, cost [N], slopes by poses; see `_bounded`."""
        stature, count, many = shared.shape[0], len(poses.root), len(self.bone)
        arms = np.einsum("nbij,kbj->nkbi", poses.turn, self.vectors(shared), optimize=True)
        points = poses.root[:, None] + stature * arms.sum(axis=2)
        seen = seen.near(points)
        white = np.einsum("nkij,nkj->nki", seen.root_weight, seen.place - points)
        modes = stature * (seen.root_weight @ poses.turn[:, self.bone]) @ self.together
        bounded, cost, shift = _bounded(white, modes)
        root = seen.root_weight * bounded[..., None]
        slope = np.empty((count, many, 3, 1 + len(BONES), 3))
        slope[:, :, :, 0] = root
        crossed = -stature * cross_matrix(arms)  # [N, K, 22, 3, 3]
        slope[:, :, :, 1:] = np.einsum("nkij,nkbjl->nkibl", root, crossed, optimize=True)
        error = _less(shift, (white * bounded).reshape(count, -1, 1))[..., 0]
        return arms, root, error, cost, _less(shift, slope.reshape(count, 3 * many, -1)), shift

    def costs(self, poses: Poses, seen: Places | Rays, shared: Shared) -> Float:
        """Compute the cost [N] of each moment's landmarks."""
        return self._whitened(poses, seen, shared)[3]

    def normal(
        self, poses: Poses, seen: Places | Rays, shared: Shared, *, whole: bool, share: float = 1.0
    ) -> Normal:
        """Build the normal equations, with a `share` of the usual posture; of shared unknowns if `whole`."""
        stature, count, many = shared.shape[0], len(poses.root), len(self.bone)
        arms, root, white, cost, slope, shift = self._whitened(poses, seen, shared)
        transposed = np.swapaxes(slope, 1, 2)
        pose, right = transposed @ slope, (transposed @ white[..., None])[..., 0]
        cost = cost + _add_ranges(poses.turn, pose, right, share, self.usual_share * joint_ranges().half)
        if not whole:
            empty = np.zeros((0, 0))
            return Normal(cost, pose, right, empty, empty, empty)

        turned = poses.turn.transpose(0, 2, 1, 3).reshape(-1, 3 * len(BONES))
        by_mode = turned @ self.reach[1:].reshape(-1, 3 * len(BONES)).T
        by_mode = by_mode.reshape(count, 3, -1, many).transpose(0, 3, 1, 2)  # [N, K, 3, 11]
        by_shape = root @ np.concatenate([arms.sum(axis=2)[..., None], stature * by_mode], axis=-1)
        by_offset = stature * root @ poses.turn[:, self.bone]
        by_shared = np.zeros((count, many, 3, 13 + 3 * many))
        by_shared[..., :12] = by_shape
        for k in range(many):
            by_shared[:, k, :, 12 + 3 * k : 15 + 3 * k] = by_offset[:, k]
        shares = _less(shift, by_shared.reshape(count, 3 * many, -1))
        flat = shares.reshape(-1, shares.shape[-1])
        return Normal(
            cost,
            pose,
            right,
            flat.T @ flat + self.prior.precision,
            flat.T @ white.ravel() - self.prior.precision @ (shared.vector - self.prior.mean),
            transposed @ shares,
        )

    def spread(
        self, poses: Poses, shared: Shared, covariance: Float, answer: Float, shared_covariance: Float
    ) -> tuple[Float, Float]:
        """Compute places [N, K, 3] and covariances [N, K, 3, 3] of the landmarks; see `_spread`."""
        place, slope, by_shared = _slopes(poses, shared, self.reach, self.vectors(shared), answer)
        for k, bone in enumerate(self.bone.tolist()):
            by_shared[:, k, :, 12 + 3 * k : 15 + 3 * k] += shared.shape[0] * poses.turn[:, bone]
        return place, _spread(slope, by_shared, covariance, shared_covariance)

    def spread_of_joints(
        self, poses: Poses, shared: Shared, covariance: Float, answer: Float, shared_covariance: Float
    ) -> tuple[Float, Float, Float]:
        """Compute covariances of rotations [N, 22, 3, 3], and joints of the bones with theirs."""
        count, every = len(poses.root), np.arange(len(BONES))
        own = covariance[:, 3:, 3:].reshape(count, len(BONES), 3, len(BONES), 3)
        turning = own[:, every, :, every].transpose(1, 0, 2, 3)
        by_answer = answer[:, 3:].reshape(count, len(BONES), 3, -1)
        vectors = np.tensordot(np.array([1.0, *shared.shape[1:]]), self.centres, 1)
        place, slope, by_shared = _slopes(poses, shared, self.centres, vectors, answer)
        return (
            turning + _carried(by_answer, shared_covariance),
            place,
            _spread(slope, by_shared, covariance, shared_covariance),
        )


def _bounded(white: Float, modes: Float) -> tuple[Float, Float, Float]:
    """Bound whitened errors [N, K, 3] of landmarks (Cauchy) that modes [N, K, 3, M] move together.

    Return roots of weights [N, K, 1], the cost [N] with the best amplitudes (variance 1), and L [N, 3 K, M]:
    1 - L L^T is the root of the inverse of 1 + G G^T, the covariance of weighted errors with modes G.
    """
    count, landmarks, _, many = modes.shape
    flat, left = modes.reshape(count, 3 * landmarks, many), white
    for _ in range(_AMPLITUDE_STEPS):
        weight = 1 / (1 + np.sum(left**2, axis=-1, keepdims=True) / _CAUCHY**2)
        weighted = np.swapaxes((modes * weight[..., None]).reshape(flat.shape), 1, 2)
        amplitude = np.linalg.solve(weighted @ flat + np.eye(many), weighted @ white.reshape(count, -1, 1))
        left = white - (flat @ amplitude).reshape(white.shape)
    square = np.sum(left**2, axis=-1, keepdims=True) / _CAUCHY**2
    cost = _CAUCHY**2 * np.log1p(square).sum(axis=(1, 2)) + np.sum(amplitude**2, axis=(1, 2))
    bounded = 1 / np.sqrt(1 + square)
    flat = (modes * bounded[..., None]).reshape(flat.shape)
    size, axes = np.linalg.eigh(np.swapaxes(flat, 1, 2) @ flat)
    size = np.maximum(size, 1e-12)
    shift = flat @ (axes * np.sqrt((1 - 1 / np.sqrt(1 + size)) / size)[:, None])
    return bounded, cost, np.asarray(shift, np.float64)


def _less(shift: Float, columns: Float) -> Float:
    """Multiply columns [N, 3 K, C] by 1 - L L^T, see `_bounded`."""
    found: Float = columns - shift @ (np.swapaxes(shift, 1, 2) @ columns)
    return found


def _slopes(
    poses: Poses, shared: Shared, reach: Float, vectors: Float, answer: Float
) -> tuple[Float, Float, Float]:
    """Compute points [N, K, 3] and their derivatives by poses and by shared unknowns that poses follow."""
    stature, count = shared.shape[0], len(poses.root)
    arms = np.einsum("nbij,kbj->nkbi", poses.turn, vectors, optimize=True)
    by_part = np.zeros((*arms.shape[:2], 3, 1 + len(BONES), 3))
    by_part[:, :, :, 0] = np.eye(3)
    by_part[:, :, :, 1:] = np.swapaxes(-stature * cross_matrix(arms), 2, 3)
    slope = by_part.reshape(count, len(vectors), 3, -1)
    by_mode = np.einsum("nbij,mkbj->nkim", poses.turn, reach[1:], optimize=True)
    by_shared = np.einsum("nkid,ndg->nkig", slope, answer, optimize=True)
    by_shared[..., :12] += np.concatenate([arms.sum(axis=2)[..., None], stature * by_mode], axis=-1)
    return poses.root[:, None] + stature * arms.sum(axis=2), slope, by_shared


def _spread(slope: Float, by_shared: Float, covariance: Float, shared_covariance: Float) -> Float:
    """Carry covariances of poses [N, D, D] and of shared unknowns [G, G] to points [N, K]."""
    own = np.einsum("nkid,nde,nkje->nkij", slope, covariance, slope, optimize=True)
    return np.asarray(own + _carried(by_shared, shared_covariance), np.float64)


def shared_prior(landmarks: Landmarks, *, between_bones: bool = True) -> SharedPrior:
    """Return the prior of shape, offsets and level; landmarks of several bones vary together if wanted."""
    modes = landmarks.modes.reshape(-1, landmarks.modes.shape[-1])
    covariance = modes @ modes.T + np.diag(landmarks.body_sigma.ravel() ** 2)
    if not between_bones:
        bone = np.repeat(landmarks.bone, 3)
        covariance *= bone[:, None] == bone
    precision = np.eye(13 + len(modes))
    precision[:12, :12] = np.diag(SHAPE_SIGMA**-2)
    precision[12:-1, 12:-1] = np.linalg.inv(covariance)
    return SharedPrior(np.concatenate([MEAN_SHAPE, np.zeros(len(modes) + 1)]), precision)


@dataclass(frozen=True)
class JointRanges:
    """Ranges of the 21 joints, as rotation vectors of a bone from the middle frame, rad."""

    bone: Index  # [21]
    parent: Index  # [21]
    middle: Float  # [21, 3, 3] parent from middle
    usual: Float  # [21, 3] posture
    half: Float  # [21, 3] of the range
    low: Float  # [21, 3]
    high: Float  # [21, 3]


@cache
def joint_ranges() -> JointRanges:
    """Read the table of ranges; only an arm, which turns by 180 degrees, has a middle that is not neutral."""
    rows = []
    for name, parent in PARENT.items():
        if parent is None:
            continue
        side, _, part = name.partition("_") if name.partition("_")[0] in SIDES else ("", "", name)
        low, high = np.radians(_RANGES_DEG[part]).T
        if side == SIDES[1]:
            mirror = np.array([-1.0, 1.0, -1.0])
            low, high = np.minimum(low * mirror, high * mirror), np.maximum(low * mirror, high * mirror)
        half, middle = (high - low) / 2, (high + low) / 2 * (part == "upper_arm")
        turn = matrix_from_quaternion(quaternion_from_rotation_vector(middle))
        usual = -middle + [0.0, np.radians(_USUAL_ELBOW_DEG) * (part == "forearm"), 0.0]
        limits = low - middle, high - middle
        rows.append((BONE[name], BONE[parent], turn, usual, half, *limits))
    return JointRanges(*(np.array(column) for column in zip(*rows, strict=True)))


def _add_ranges(turn: Float, pose: Float, right: Float, share: float, sigma: Float) -> Float:
    """Add the ranges and usual spread of joints to normal equations, in place; return their cost [N]."""
    usual = joint_ranges()
    bones, parents, low, high = usual.bone, usual.parent, usual.low, usual.high
    frame = turn[:, parents] @ usual.middle  # world from the middle
    vector = rotation_vector_from_quaternion(
        quaternion_from_matrix(np.swapaxes(frame, -1, -2) @ turn[:, bones])
    )
    beyond = np.where(vector < low, vector - low, np.where(vector > high, vector - high, 0.0))
    steep = np.where(beyond == 0.0, 0.0, _BOUND_RAD**-2)
    away = vector - usual.usual
    square = np.sum((away / sigma) ** 2, axis=-1, keepdims=True) / _USUAL_CAUCHY**2
    weight = share * sigma**-2 / (1 + square)
    bound = np.sum(steep * beyond**2, axis=(1, 2))
    cost = share * _USUAL_CAUCHY**2 * np.log1p(square).sum(axis=(1, 2)) + bound

    slope = _inverse_left_jacobian(vector) @ np.swapaxes(frame, -1, -2)
    weighted = np.swapaxes(slope, -1, -2) * (weight + steep)[..., None, :]
    block = weighted @ slope
    pull = (np.swapaxes(slope, -1, -2) @ (weight * away + steep * beyond)[..., None])[..., 0]
    for k, (bone, parent) in enumerate(zip(bones.tolist(), parents.tolist(), strict=True)):
        one, other = slice(3 + 3 * bone, 6 + 3 * bone), slice(3 + 3 * parent, 6 + 3 * parent)
        pose[:, one, one] += block[:, k]
        pose[:, other, other] += block[:, k]
        pose[:, one, other] -= block[:, k]
        pose[:, other, one] -= block[:, k]
        right[:, one] -= pull[:, k]
        right[:, other] += pull[:, k]
    return np.asarray(cost)


def _inverse_left_jacobian(vector: Float) -> Float:
    """Return the inverse left Jacobians [..., 3, 3] of rotation vectors [..., 3] (Barfoot 2017, 7.37)."""
    angle = np.maximum(np.linalg.norm(vector, axis=-1), 1e-6)[..., None, None]
    across = cross_matrix(vector)
    share = 1 / angle**2 - 1 / (2 * angle * np.tan(angle / 2))
    found: Float = np.eye(3) - across / 2 + share * (across @ across)
    return found


# --- solving -------------------------------------------------------------------------------------------


def _fit_shared(points: Points, poses: Poses, seen: Places, scale: float) -> tuple[Shared, Float]:
    """Fit shape and offsets with the poses of some moments; return them and their covariance [G, G].

    An unknown scale of variance `scale` enlarges all places. What is fitted is its product with the stature.
    """
    mean, precision = points.prior.mean, points.prior.precision.copy()
    of_scale, of_stature = mean[0] ** 2 * scale, 1 / precision[0, 0]
    precision[0, 0] = 1 / (of_stature + of_scale)
    points.prior = SharedPrior(mean, precision)
    shared = Shared(MEAN_SHAPE.copy(), np.zeros((len(points.bone), 3)))
    normal = points.normal(poses, seen, shared, whole=True)
    cost, damping = normal.cost.sum() + points.prior.cost(shared), 1e-3
    for _ in range(_SHAPE_STEPS):
        inverse_between, inverse_right, reduced, reduced_right = _reduced(normal, damping)
        step = np.asarray(np.linalg.solve(reduced, reduced_right), np.float64)
        new_shared = shared.moved(step)
        new_poses = poses.moved(inverse_right - inverse_between @ step)
        new = points.normal(new_poses, seen, new_shared, whole=True)
        new_cost = new.cost.sum() + points.prior.cost(new_shared)
        if new_cost > cost:
            damping *= 10
            continue
        done = cost - new_cost < 1e-3 * len(poses.root)
        shared, poses, normal, cost, damping = new_shared, new_poses, new, new_cost, damping / 5
        if done:
            break
    _, _, reduced, _ = _reduced(normal, 0.0)
    covariance = np.asarray(np.linalg.inv(reduced), np.float64)
    share = of_stature * precision[0, 0]  # of the product's deviation that is the stature's
    shared.shape[0] = mean[0] + share * (shared.shape[0] - mean[0])
    covariance[0] *= share
    covariance[:, 0] *= share
    covariance[0, 0] += share * of_scale
    return shared, covariance


def _reduced(normal: Normal, damping: float) -> tuple[Float, Float, Float, Float]:
    """Eliminate the poses; return their answers to shared unknowns and right sides, and what is left."""
    solved = np.linalg.solve(
        _damped(normal.pose, np.full(len(normal.pose), damping)),
        np.concatenate([normal.between, normal.pose_right[..., None]], axis=-1),
    )
    answer, right = solved[..., :-1], solved[..., -1]
    reduced = normal.shared - np.einsum("ndg,ndh->gh", normal.between, answer, optimize=True)
    reduced_right = normal.shared_right - np.einsum("ndg,nd->g", normal.between, right)
    return answer, right, reduced, reduced_right


def _damped(pose: Float, damping: Float) -> Float:
    """Return matrices [N, D, D] whose diagonals are larger by a share [N] of their own."""
    found = pose.copy()
    diagonal = np.arange(pose.shape[-1])
    found[:, diagonal, diagonal] *= 1 + damping[:, None]
    return found


def settle(
    points: Points, poses: Poses, seen: Places | Rays, shared: Shared, steps: int
) -> tuple[Poses, Float]:
    """Fit each moment's pose by itself; return also the costs [N]."""
    normal = points.normal(poses, seen, shared, whole=False)
    damping = np.full(len(poses.root), 1e-3)
    for _ in range(steps):
        step = np.linalg.solve(_damped(normal.pose, damping), normal.pose_right[..., None])[..., 0]
        new_poses = poses.moved(np.asarray(step, np.float64))
        new = points.normal(new_poses, seen, shared, whole=False)
        better = new.cost <= normal.cost
        done = bool((normal.cost - new.cost < 0.03)[better].all() and better.all())
        damping = np.where(better, damping / 5, damping * 10)
        poses = Poses(
            np.where(better[:, None], new_poses.root, poses.root),
            np.where(better[:, None, None, None], new_poses.turn, poses.turn),
        )
        normal = replace(
            normal,
            cost=np.where(better, new.cost, normal.cost),
            pose=np.where(better[:, None, None], new.pose, normal.pose),
            pose_right=np.where(better[:, None], new.pose_right, normal.pose_right),
        )
        if done:
            break
    return poses, normal.cost


def _fit_poses(
    points: Points, poses: Poses, seen: Places, shared: Shared, shared_covariance: Float
) -> tuple[Float, Float, Float, Float]:
    """Fit each moment's pose; return rotations and joints of the bones, each with covariances."""
    poses, _ = settle(points, poses, seen, shared, _POSE_STEPS)
    whole = points.normal(poses, seen, shared, whole=True)
    inverse = np.asarray(np.linalg.inv(whole.pose), np.float64)
    answer = -inverse @ whole.between  # of the pose to shared unknowns
    turning, *joints = points.spread_of_joints(poses, shared, inverse, answer, shared_covariance)
    return poses.turn, turning, joints[0], joints[1]


def _carried(slope: Float, covariance: Float) -> Float:
    """Carry the covariance [G, G] of shared unknowns through slopes [N, B, 3, G]."""
    return (slope @ covariance) @ np.swapaxes(slope, -1, -2)


# --- first poses ---------------------------------------------------------------------------------------


def turns_of_bones(landmarks: Landmarks, place: Float) -> Float:
    """Return world rotations [N, 22, 3, 3] of bones the way landmarks [N, K, 3] point.

    A bone without landmarks turns as its parent does; all are NaN where the trunk is unknown.
    """
    return _first_poses(body_model(), landmarks, place).turn


def _first_poses(model: BodyModel, landmarks: Landmarks, place: Float) -> Poses:
    """Turn trunk and limbs the way landmarks [N, K, 3] point; a bone without them as its parent."""
    missing = np.full_like(place[:, 0], np.nan)
    of = {name: place[:, k] for k, name in enumerate(landmarks.joints)}

    def at(name: str) -> Float:
        return of.get(name, missing)

    up = at("left_shoulder") + at("right_shoulder") - at("left_hip") - at("right_hip")
    z, y = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    pelvis = turned((y, z), (at("left_hip") - at("right_hip"), up))
    chest = turned((z, y), (up, at("left_shoulder") - at("right_shoulder")))
    turn = np.repeat(chest[:, None], len(BONES), axis=1)
    turn[:, [BONE["pelvis"], BONE["spine"]]] = pelvis[:, None]
    ears = (at("left_ear") + at("right_ear")) / 2
    head = turned((y, np.array([1.0, 0.0, 0.0])), (at("left_ear") - at("right_ear"), at("nose") - ears))
    _put(turn, ("head", "neck"), head, chest)
    steps = model.steps[0]
    for side in SIDES:
        for sign, parent, bones, joints in (
            (-1.0, chest, ("upper_arm", "forearm", "hand"), ("shoulder", "elbow", "wrist")),
            (1.0, pelvis, ("thigh", "shank", "foot"), ("hip", "knee", "ankle")),
        ):
            start, middle, end = (at(f"{side}_{name}") for name in joints)
            one, two = unit(middle - start), unit(end - middle)
            # Next to straight a hinge shows no axis: then it is the parent's.
            axis = sign * np.cross(one, two) + 0.1 * parent[..., 1]
            upper_bone, lower_bone, last = (f"{side}_{name}" for name in bones)
            upper = turned((steps[BONE[lower_bone]], y), (one, axis))
            lower = turned((steps[BONE[last]], y), (two, axis))
            _put(turn, (upper_bone,), upper, parent)
            _put(turn, (lower_bone, last), lower, turn[:, BONE[upper_bone]])
        forward = at(f"{side}_big_toe") - at(f"{side}_heel")
        shank = turn[:, BONE[f"{side}_shank"]]
        foot = turned((np.array([1.0, 0.0, 0.0]), y), (forward, shank[..., 1]))
        _put(turn, (f"{side}_foot", f"{side}_toes"), foot, shank)
    hips = (steps[BONE["left_thigh"]] + steps[BONE["right_thigh"]]) / 2
    root = (at("left_hip") + at("right_hip")) / 2 - MEAN_SHAPE[0] * pelvis @ hips
    return Poses(root, turn)


def _put(turn: Float, bones: tuple[str, ...], found: Float, otherwise: Float) -> None:
    """Set the rotations of some bones where they are known, elsewhere to others."""
    known = np.asarray(np.isfinite(found).all(axis=(1, 2)))
    turn[:, [BONE[name] for name in bones]] = np.where(known[:, None, None], found, otherwise)[:, None]
