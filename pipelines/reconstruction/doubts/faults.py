"""Faults of one camera's poses, fitted with the constant errors that are stated of all poses.

Every camera may be off by a constant shift and a constant turn, with what is stated of them as prior. A fault
is a shift or a turn of one camera without a prior. The joints are eliminated, so that a fit of one fault
solves for 6 numbers of each camera and those of the fault. What the fit costs is a chi^2: the residuals of
all pictures, each as one observation, and the constant errors over their standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_rotation_vector
from pipelines.reconstruction.doubts.kernels import misses_of, normal_equations
from pipelines.reconstruction.doubts.scene import JOINTS, Sampled, SceneOfMoments
from pipelines.reconstruction.doubts.score import STATURE_M, SolvedJoints, pixel_variance, solve, stature_m

FREE = {
    "none": 0,
    "origins": 0,
    "shift": 3,
    "heading": 1,
    "north": 1,
    "zero": 4,
    "pitch": 1,
    "roll": 1,
    "focal": 1,
}
"""Faults by name, and how many numbers they have.

`shift`: the log has its zero elsewhere; `north`: it has its north elsewhere; `zero`: both. `heading`,
`pitch`, `roll`: the camera is turned where it is, about the vertical or its own x and z axes. `focal`: its
focal length is another; the turn is then the logarithm of the factor. `origins`: every log counts from a
place of its own; the shifts are then the constant errors, which nothing bounds.
"""

# Fits of faults converge in fewer steps than this.
_STEPS = 20
# Focal lengths are wrong by at most this logarithm: a factor of twenty.
_MOST_ZOOM = 3.0
# A step that changes the chi^2 by less is the last.
_CONVERGED = 0.05
_LEAST_SIGMA = (0.02, np.radians(0.1))  # of constant errors, m and rad
# The nose is this share of the stature above the ankles (Winter 2009).
_NOSE_TO_ANKLES = 0.9
# The shift of a fault has this standard deviation: any shift is as likely.
_LOOSE_M = 30.0
# Statures of grown-ups have this standard deviation of their logarithm.
_SIZE_SIGMA = 0.09
# Derivatives are taken over this distance, small against that of a person.
_PROBE_M = 0.05
# The logged hips of an actor err by this much.
_PLACED_M = 0.3
# Residuals beyond this many standard deviations count linearly.
_HUBER = 1.5
# Errors of a logged actor wander, and count as so many independent ones.
_FEW = 3
# A person is filmed from about this distance where none is known.
_USUAL_M = 10.0


@dataclass(frozen=True)
class Fault:
    """A fitted fault."""

    name: str  # of `FREE`
    index: int  # of the camera
    cost: float  # chi^2
    strain: float  # the part of it that is of constant errors, the logged actor and the person's stature
    shift: Float  # [3] m
    turn_rad: float
    scene: SceneOfMoments  # without the fault; constant errors stay
    errors: Float  # [C, 6] of all poses, m and rad, besides it
    covariance: (
        Float  # [n, n] of its numbers: what the constant errors leave of it; without a number, of all errors
    )

    @property
    def sigmas(self) -> dict[str, float]:
        """The standard deviations of its shift (of all axes together) and its turn."""
        variance = np.diag(self.covariance)
        moved, turned = variance[: 3 * (FREE[self.name] >= 3)], variance[3 * (FREE[self.name] >= 3) :]
        sigmas = {"shift_sigma_m": float(np.sqrt(moved.sum()))} if moved.size else {}
        if turned.size and self.name != "focal":
            sigmas["turn_sigma_deg"] = float(np.degrees(np.sqrt(turned[0])))
        return {name: round(value, 2) for name, value in sigmas.items()}

    @property
    def turn_deg(self) -> float:
        """The turn in degrees."""
        return float(np.degrees(self.turn_rad))


def fit(flight: Sampled, scene: SceneOfMoments, name: str, index: int, start_rad: float = 0.0) -> Fault:
    """Fit a fault of one camera, and the constant errors of all.

    Args:
        flight: the flight.
        scene: the scene as described.
        name: of `FREE`.
        index: of the camera.
        start_rad: where the search for the turn begins.
    """
    nothing = np.zeros(3)
    first = undone(scene, name, index, nothing, start_rad)
    errors = np.zeros((len(scene.focal_px), 6))
    fault = Fault(name, index, np.inf, np.inf, nothing, start_rad, first, errors, np.zeros((0, 0)))
    best, last = fault, np.inf
    for _ in range(_STEPS):
        cost, strain, change, covariance = _step(flight, _with_errors(fault.scene, errors), fault, errors)
        values = change[errors.size :]
        settled = abs(cost - last) < _CONVERGED
        last = cost
        if cost < best.cost:
            best = replace(fault, cost=cost, strain=strain, errors=errors, covariance=covariance)
        if settled or not np.isfinite(cost) or cost > 4 * best.cost + 100:
            break
        errors = errors + change[: errors.size].reshape(errors.shape)
        shift, turn_rad = fault.shift, fault.turn_rad
        if FREE[name] >= 3:
            shift = shift + values[:3]
        if FREE[name] in (1, 4):
            turn_rad = turn_rad + float(values[-1])
        changed = undone(scene, name, index, shift, turn_rad)
        fault = replace(fault, shift=shift, turn_rad=turn_rad, scene=changed)
    return best


def undone(scene: SceneOfMoments, name: str, index: int, shift: Float, turn_rad: float) -> SceneOfMoments:
    """Return the scene without a fault of one camera."""
    if name == "focal":
        factor = np.ones(len(scene.focal_px))
        factor[index] = zoom(turn_rad)
        return replace(scene, rays=scene.rays / factor[:, None, None, None], focal_px=scene.focal_px * factor)
    rotation, position = scene.rotation.copy(), scene.position.copy()
    turn = _rotation(_axis(name) * turn_rad)
    if name in ("pitch", "roll"):
        rotation[index] = rotation[index] @ turn
    else:
        rotation[index] = turn @ rotation[index]
    if name in ("north", "zero"):
        position[index] = position[index] @ turn.T
    position[index] = position[index] + shift
    return replace(scene, rotation=rotation, position=position)


def origins(flight: Sampled, scene: SceneOfMoments) -> tuple[Float, Float]:
    """Place the logs of all drones, of which each counts from a place of its own.

    The search begins where each camera by itself sees a person of usual stature: as far away as they are
    tall in its pictures. Then all shifts are fitted to the rays, the stature and the logged actor. Without
    an actor, nothing says where the world is: it is that of the first log.

    Args:
        flight: the flight.
        scene: the scene as described.

    Returns:
        Shifts [C, 3] m of the cameras' positions, 0 where a camera keeps its place, and their standard
        deviations [C], of all axes together.
    """
    hips = [JOINTS.index("left_hip"), JOINTS.index("right_hip")]
    away_m = scene.focal_px * STATURE_M * _NOSE_TO_ANKLES / np.maximum(scene.person_px, 1.0)
    rays = np.concatenate([scene.rays[:, :, hips], np.ones((*scene.rays.shape[:2], 2, 1))], axis=-1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).mean(axis=2)
    seen = scene.position + away_m[:, None, None] * np.einsum("ctij,ctj->cti", scene.rotation, rays)
    place = seen[0] if flight.hips is None else flight.hips
    start = np.zeros((len(seen), 3))
    moved = _moved(flight)
    start[moved] = [_median_of(place - seen[index]) for index in moved]
    begun = replace(scene, position=scene.position + start[:, None])
    found = fit(flight, begun, "origins", 0)
    shifts = np.zeros_like(start)
    shifts[moved] = start[moved] + found.errors[moved, :3]
    sigma = np.zeros(len(start))
    if found.covariance.size:
        sigma[moved] = [
            np.sqrt(np.diag(found.covariance)[6 * index : 6 * index + 3].sum()) for index in moved
        ]
    return shifts, sigma


def tilt_sigma_deg(flight: Sampled, scene: SceneOfMoments, group: Sequence[int]) -> float:
    """Return the standard deviation of one tilt that cameras have in common, beside all constant errors.

    With the normal matrix N of a fit without a fault, the inverse variances P of the constant errors, and the
    direction u in which the tilt turns the cameras, its information is u^T (P - P N^-1 P) u.

    Args:
        flight: the flight.
        scene: the scene with the tilts of the group undone.
        group: the cameras.

    Returns:
        NaN where the rays tell nothing of it.
    """
    covariance = fit(flight, scene, "none", 0).covariance
    if not covariance.any():
        return float("nan")
    direction = np.zeros((len(scene.focal_px), 6))
    direction[group, 3:] = np.nanmean(scene.rotation[group][..., 0], axis=1)
    pulled = direction.ravel() / _constant_sigma(scene).ravel() ** 2
    information = float(direction.ravel() @ pulled - pulled @ covariance @ pulled)
    return float(np.degrees(1 / np.sqrt(information))) if information > 0 else float("nan")


def _moved(flight: Sampled) -> list[int]:
    """Return the cameras whose places are open where every log counts from a place of its own."""
    moving = [index for index, camera in enumerate(flight.cameras) if not camera.static]
    return moving if flight.hips is not None or len(moving) < len(flight.cameras) else moving[1:]


def _median_of(apart: Float) -> Float:
    """Return the median [3] of vectors [T, 3] that are known; 0 if none is."""
    known = apart[np.isfinite(apart).all(axis=-1)]
    return np.median(known, axis=0) if len(known) else np.zeros(3)


def zoom(logarithm: float) -> float:
    """Return the factor of a focal length from the logarithm that a fit found, which may have run away."""
    return float(np.exp(np.clip(logarithm, -_MOST_ZOOM, _MOST_ZOOM)))


def _axis(name: str) -> Float:
    axis: Float = np.eye(3)[{"pitch": 0}.get(name, 2)]
    return axis


def _rotation(vector: Float) -> Float:
    matrix: Float = matrix_from_quaternion(quaternion_from_rotation_vector(vector))
    return matrix


def _with_errors(scene: SceneOfMoments, errors: Float) -> SceneOfMoments:
    turn = _rotation(errors[:, 3:])[:, None]
    return replace(scene, rotation=turn @ scene.rotation, position=scene.position + errors[:, None, :3])


def _constant_sigma(scene: SceneOfMoments) -> Float:
    """Return the standard deviations [C, 6] of the constant errors."""
    level = np.sqrt(np.maximum(scene.sigma[:, :2] ** 2 - scene.sigma[:, 4:] ** 2, 0.0))
    sigma: Float = np.repeat(np.maximum(level, _LEAST_SIGMA), 3, axis=1)
    return sigma


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _step(
    flight: Sampled, scene: SceneOfMoments, fault: Fault, errors: Float
) -> tuple[float, float, Float, Float]:
    """Return cost and strain of a scene, the changes of constant errors [C, 6] and a fault's numbers [n].

    Also the covariance [n, n] of these numbers.
    """
    solved = solve(scene)
    times = solved.seen.shape[1]
    used = solved.seen & (solved.views >= 2)
    missed, depth = misses_of(
        solved.joints, np.ascontiguousarray(scene.position), solved.direction, used, solved.depth
    )
    varying2 = _varying2(scene.sigma[:, 5], scene.sigma[:, 3], times)[:, None, None]
    varying2 = varying2 + _varying2(scene.sigma[:, 4], scene.sigma[:, 2], times)[:, None, None] / depth**2
    variance = (pixel_variance(scene) / scene.focal_px**2)[:, None, None] + varying2
    size = np.linalg.norm(missed, axis=-1) / np.sqrt(variance)
    if used.sum() < 60:
        free = FREE[fault.name]
        return np.inf, np.inf, np.zeros(errors.size + free), np.zeros((free, free))
    # One picture is one observation: its keypoints err alike.
    seen = np.maximum(used.sum(axis=-1, keepdims=True), 1)
    scale = np.maximum(1.0, np.median(size[used]))
    robust = np.where(size > _HUBER * scale, _HUBER * scale / np.maximum(size, 1e-12), 1.0)
    weight = np.where(used, robust / (variance * seen), 0.0)
    huber = np.where(size > _HUBER, _HUBER * (2 * size - _HUBER), size**2)
    sigma = _constant_sigma(scene)
    if fault.name == "origins":
        sigma[_moved(flight), :3] = _LOOSE_M
    cost = float((np.where(used, huber, 0.0) / seen).sum())

    placed, pull, extra = _placed(flight, solved)
    sized = _size(solved)
    strain = float(((errors / sigma) ** 2).sum()) + extra + sized**2
    cost += strain
    numbers = _basis(scene, fault)
    zoomed = scene.rotation[fault.index][..., 2] if fault.name == "focal" else np.zeros((0, 3))
    normal, right = normal_equations(
        solved.direction,
        missed,
        depth,
        weight,
        placed,
        pull,
        fault.index,
        numbers,
        np.ascontiguousarray(np.nan_to_num(zoomed)),
    )
    normal[range(errors.size), range(errors.size)] += 1 / sigma.ravel() ** 2
    right[: errors.size] += errors.ravel() / sigma.ravel() ** 2
    if fault.name in ("shift", "zero"):
        shift = slice(errors.size, errors.size + 3)
        slope = _size_by_shift(scene, fault.index, sized)
        normal[shift, shift] += np.outer(slope, slope) + np.eye(3) / _LOOSE_M**2
        right[shift] += slope * sized + fault.shift / _LOOSE_M**2
    for camera in _moved(flight) if fault.name == "origins" else ():
        slope = np.zeros(len(normal))
        slope[6 * camera : 6 * camera + 3] = _size_by_shift(scene, camera, sized)
        normal += np.outer(slope, slope)
        right += slope * sized
    normal += 1e-9 * np.eye(len(normal))
    covariance = np.linalg.inv(normal)
    kept = errors.size if FREE[fault.name] else 0
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


def _size(solved: SolvedJoints) -> float:
    """Return how far the person's stature is from a grown-up's, in standard deviations."""
    stature = stature_m(solved.joints)
    return float(np.log(stature / STATURE_M)) / _SIZE_SIGMA if np.isfinite(stature) else 0.0


def _size_by_shift(scene: SceneOfMoments, index: int, size: float) -> Float:
    """Return the derivative [3] of `_size` by a camera's position."""
    slope = np.zeros(3)
    for axis in range(3):
        position = scene.position.copy()
        position[index, :, axis] += _PROBE_M
        slope[axis] = (_size(solve(replace(scene, position=position))) - size) / _PROBE_M
    return slope


def _basis(scene: SceneOfMoments, fault: Fault) -> Float:
    """Return how a camera's shift and turn [T, 6] change with each number of the fault."""
    times = scene.position.shape[1]
    basis = np.zeros((times, 6, FREE[fault.name]))
    if fault.name in ("shift", "zero"):
        basis[:, :3, :3] = np.eye(3)
    if fault.name in ("heading", "north", "zero"):
        basis[:, 5, -1] = 1.0
    if fault.name in ("north", "zero"):
        unshifted = np.nan_to_num(scene.position[fault.index] - fault.shift)
        basis[:, 0, -1], basis[:, 1, -1] = -unshifted[:, 1], unshifted[:, 0]
    if fault.name in ("pitch", "roll"):
        basis[:, 3:, -1] = scene.rotation[fault.index] @ _axis(fault.name)
    return np.nan_to_num(basis)


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
