"""Alternatives to a flight's description: what is changed, in a sentence, as a scene and as a remedy.

An alternative has a price that grows with its freedom: for how many there are of its kind, and for its
numbers. So of two that explain as much, the one with less freedom is named first. Nothing is weighed here.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, permutations, product
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.mounting import FLU_FROM_FRD, body_from_camera, level_heading
from pipelines.geometry.poses import (
    ENU_FROM_NED,
    interpolate_rotations,
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
)
from pipelines.geometry.rig import between
from pipelines.reconstruction.doubts import remedies
from pipelines.reconstruction.doubts.scene import (
    HIPS,
    JOINTS,
    SIZE_SIGMA,
    STATURE_M,
    Sampled,
    SceneOfMoments,
    scene_of,
    trunk_direction,
)
from pipelines.reconstruction.observations import Filmed
from pipelines.reconstruction.solving import NOSE_TO_ANKLES
from pipelines.session.people import mirrored

PRICE_OF_ALL = 0.5
"""Price of an alternative of all cameras alike."""

# Price of an alternative of one camera, of which there are as many as cameras.
_PRICE_OF_ONE = 0.8
_FLU_FROM_OPTICAL, _FLU_FROM_FRD, _ENU_FROM_NED = (
    matrix_from_quaternion(each).round() for each in (body_from_camera("forward"), FLU_FROM_FRD, ENU_FROM_NED)
)
_FOCAL_FACTORS = (0.5, 2.0, 2 / 3, 1.5, 0.75, 4 / 3)  # calibrations of pictures of another size, or cropped
_SIZE_FACTORS = (2.0, 0.5, 1.5, 2 / 3, 3.0, 1 / 3)  # pictures that a detector was given enlarged or reduced
_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048}
# Cameras film at these rates, or at 1000/1001 of them, but for rounding.
_USUAL_RATES_HZ, _SAME_RATE = (24.0, 25.0, 30.0, 50.0, 60.0), 2e-3
# Logs go on about as long as pictures: a rate pays this, times the share of logs that it leaves unfilmed.
_PRICE_OF_UNFILMED = 3.0
# A stated value is doubted beyond this many of its standard deviations, because errors have heavy tails.
_LEAST_SIGMAS = 5.0
# A fitted number that is nearer to zero, in its own standard deviations, may be zero.
_LEAST_OWN_SIGMAS = 3.0
# Smaller faults do not matter beside the errors of good poses, whatever is stated of these.
_LEAST_SHIFT_M, _LEAST_TURN_RAD, _LEAST_ZOOM = 0.2, np.radians(2.0), 0.1
# Focal lengths are wrong by at most this logarithm: a factor of twenty.
_MOST_ZOOM = 3.0
_LEFT_RIGHT = [JOINTS.index(mirrored(name)) for name in JOINTS]


@dataclass(frozen=True)
class Alternative:
    """Something that may be otherwise than described, the scene of that, and how well it fits."""

    code: str
    cameras: tuple[str, ...]
    what: str
    remedy: str
    price: float
    scene: SceneOfMoments | None = None  # None of what is seen directly
    same_scatter: bool = False
    evidence: Mapping[str, float] = field(default_factory=dict)
    # Of times of all cameras: the scene of the same pictures, at the moments of the flight beside it.
    same_pictures: Callable[[], SceneOfMoments] | None = None


Group = tuple[list[int], float]
"""Cameras of an alternative, and its price."""


@dataclass(frozen=True)
class Numbers:
    """Numbers [n] of a description that a fit sets free."""

    make: Callable[[Float], SceneOfMoments]
    starts: Float  # [K, n]; the fit begins at the best of them
    alternative: Callable[[Float, Float], Alternative | None]  # of numbers [n] and their covariance [n, n]


class Trial:
    """The flight as described, beside which alternatives are made."""

    def __init__(self, flight: Sampled, described: SceneOfMoments) -> None:
        self.flight, self.described = flight, described
        self.cameras: tuple[Filmed, ...] = flight.cameras
        self.names = tuple(camera.name for camera in flight.cameras)
        self.every = list(range(len(self.names)))
        self.moving = [index for index, camera in enumerate(flight.cameras) if not camera.static]
        # Whether anything but the cameras says where the world is.
        self.located = flight.hips is not None or flight.ground is not None
        self.is_loose_pair = not self.located and len(self.moving) == len(self.names) == 2

    def named(self, group: Sequence[int]) -> tuple[str, ...]:
        """Name the cameras of a group."""
        return tuple(self.names[index] for index in group)

    def whose(self, group: Sequence[int]) -> str:
        """Return the name of one camera, or `every camera`."""
        return self.names[group[0]] if len(group) == 1 < len(self.names) else "every camera"

    def groups(self, members: Sequence[int]) -> Iterator[Group]:
        """Take all cameras together, then each, which is dearer."""
        if len(members) > 1:
            yield list(members), PRICE_OF_ALL
        yield from (([index], _PRICE_OF_ONE) for index in members)

    def kinds_of_logs(self) -> list[list[int]]:
        """Group the cameras whose poses one program wrote, where there are several such and others."""
        kinds: dict[str, list[int]] = {}
        for index in self.moving:
            kinds.setdefault(Path(self.cameras[index].entry.poses.source).suffix.lower(), []).append(index)
        return [kind for kind in kinds.values() if 1 < len(kind) < len(self.moving)]

    def lines(self, group: Sequence[int], line_of: Callable[..., str], *values: Any, **named: Any) -> str:
        """Write the lines of a remedy for the cameras of a group."""
        return remedies.lines([self.cameras[index] for index in group], line_of, *values, **named)

    @cached_property
    def mounts(self) -> Float:
        """Return body_from_camera [C, 1, 3, 3]; looking forwards where a camera is not fixed to a body."""
        stored = [camera.mount for camera in self.cameras]
        return np.array([_FLU_FROM_OPTICAL if each is None else each for each in stored])[:, None]

    @cached_property
    def bodies(self) -> tuple[Float, dict[int, str | None]]:
        """Return attitudes of bodies [C, T, 3, 3]; of those with gimbals, what the angles are relative to."""
        body, on_gimbal = self.described.rotation @ self.mounts.mT, {}
        gap_ns, t_ns = self.flight.between.max_gap_ns, self.flight.t_ns
        for index in self.moving:
            track = self.cameras[index].camera.trajectory
            if track.body_xyzw is not None:
                limits = {"max_gap_ns": gap_ns, "max_extrapolation_ns": gap_ns}
                known = interpolate_rotations(track.t_ns, track.body_xyzw, t_ns, **limits)
                body[index] = matrix_from_quaternion(known)
                on_gimbal[index] = self.cameras[index].entry.poses.gimbal
        return body, on_gimbal

    def with_times(self, group: Sequence[int], late_s: float, slower: float) -> SceneOfMoments:
        """Add seconds to the times of cameras' pictures, and let them follow each other more slowly."""
        return scene_of(self.flight, self.described, times=dict.fromkeys(group, (late_s, slower)))

    def with_all_times(self, late_s: float, slower: float) -> SceneOfMoments:
        """Change all times and look at the same pictures, at the moments at which they were taken then."""
        moved = self.flight.at_other_times(late_s, slower)
        return scene_of(moved, times=dict.fromkeys(self.every, (late_s, slower)))

    def posed(
        self, code: str, what: str, remedy: str, of: Group, rotation: Float, position: Float | None = None
    ) -> Alternative:
        """Take the attitudes [C, T, 3, 3] and places [C, T, 3] of some cameras from other ones."""
        group, price = of
        turned, moved = self.described.rotation.copy(), self.described.position.copy()
        turned[group], moved[group] = rotation[group], (moved if position is None else position)[group]
        scene = replace(self.described, rotation=turned, position=moved)
        same_scatter = code == "unit" and group == self.moving  # larger errors of larger positions
        return Alternative(code, self.named(group), what, remedy, price, scene, same_scatter)

    def with_pixels(
        self, group: Sequence[int], factor: float = 1.0, flipped: Set[str] = frozenset()
    ) -> SceneOfMoments:
        """Enlarge the pixels of cameras; mirror their `x` or `y`, or the `names` of left and right joints."""
        pixels, both = [camera.pixels for camera in self.cameras], ["x" in flipped, "y" in flipped]
        for index in group:
            own = self.cameras[index].intrinsics
            last = np.array([own.width, own.height]) - 1
            other = np.where(both, last - pixels[index], factor * pixels[index])
            pixels[index] = other[:, _LEFT_RIGHT] if "names" in flipped else other
        return scene_of(self.flight, self.described, pixels=pixels)


def turn_about(axis: str, degrees: float) -> Float:
    """Return the rotation [3, 3] about an axis."""
    return matrix_from_quaternion(
        quaternion_from_rotation_vector(np.radians(degrees) * np.eye(3)["xyz".index(axis)])
    )


# --- times -----------------------------------------------------------------------------------------------


def rates(trial: Trial) -> Iterator[Alternative]:
    """Try other frame rates of all cameras and of each."""
    for group, price in trial.groups(trial.every):
        stated_hz = remedies.rate_hz(trial.cameras[group[0]])
        for factor in (stated_hz / hz for hz in _USUAL_RATES_HZ if abs(stated_hz / hz - 1) > _SAME_RATE):
            unfilmed = [_unfilmed(trial.cameras[k], factor) - _unfilmed(trial.cameras[k]) for k in group]
            dearer = max(0.0, _PRICE_OF_UNFILMED * float(np.mean(unfilmed)))
            yield of_times(trial, group, slower=factor, price=price + dearer)


def _unfilmed(camera: Filmed, slower: float = 1.0) -> float:
    """Return the share of a camera's log after its last picture; of one that stands still, of its film."""
    first, last = camera.entry.frames.first_t_ns, camera.entry.frames.last_t_ns
    begin, end = (first, last) if camera.static else camera.camera.trajectory.t_ns[[0, -1]]
    return float(max(0, end - first - (last - first) * slower) / max(end - begin, 1))


def of_times(
    trial: Trial, group: list[int], late_s: float = 0.0, slower: float = 1.0, price: float = 0.0
) -> Alternative:
    """Move the clock of one camera, or of all, or change the frame rate at a price."""
    if slower == 1:
        code, price = "clock", 1.0 + abs(late_s) / 2
        what = f"the pictures of {trial.whose(group)} were taken {remedies.earlier_or_later(late_s)}"
        remedy = trial.lines(group, remedies.clock, late_s)
    else:
        code, remedy = "frame_rate", trial.lines(group, remedies.frame_rate, slower)
        what = f"the frame rate of {trial.whose(group)} is {1 / slower:.3g} times what is stated"
    same = partial(trial.with_all_times, late_s, slower) if len(group) == len(trial.names) else None
    scene = trial.with_times(group, late_s, slower)
    return Alternative(code, trial.named(group), what, remedy, price, scene, same_pictures=same)


# --- the world -------------------------------------------------------------------------------------------

# The trunk of somebody who does more than lie or stand points elsewhere in some pictures.
LEAST_STEADY_TRUNK = 0.7
# People lean by this much, and cameras are rolled, beside what is stated of their attitudes.
LEAN_DEG, ROLL_DEG = 10.0, 3.0
# Pictures and people must be upright by so many squared standard deviations more along another direction.
LEAST_GAIN_OF_UP = 25.0
# A direction this near to an axis is that axis, since people lean: so the world is no less tilted than this.
AXIS_WITHIN_DEG = 12.0
# Upper edges of pictures are lower by at most this cosine along the other direction, as cameras look down.
MOST_LOSS_OF_EDGES = 0.25
# Directions about the trunk are searched so far, which is farther than people lean.
_SEARCHED = np.tan(np.radians(np.arange(-24.0, 25.0, 2.0)))


def level(trial: Trial, joints: Float) -> Iterator[Alternative]:
    """Find a world whose z does not point up: people and pictures are upright along another direction.

    Both must say so: somebody may lie, and a camera may be rolled or look straight down.
    """
    trunk, z = trunk_direction(joints), np.array([0.0, 0.0, 1.0])
    steady = float(np.linalg.norm(trunk))
    if not steady > LEAST_STEADY_TRUNK:
        return
    trunk = trunk / steady
    across = np.linalg.svd(trunk[None])[2][1:]
    about = np.stack(np.meshgrid(_SEARCHED, _SEARCHED), axis=-1).reshape(-1, 2) @ across
    ups = np.vstack([z, (trunk + about) / np.linalg.norm(trunk + about, axis=1, keepdims=True)])
    posed = [camera for camera in trial.every if np.isfinite(trial.described.rotation[camera]).any()]
    rotation = trial.described.rotation[posed]
    rolls2 = np.nanmean((rotation[..., 0] @ ups.T) ** 2, axis=1)  # [C, U]
    sigma2 = np.radians(ROLL_DEG) ** 2 + trial.described.sigma[posed, 1] ** 2
    rolled = (rolls2 / sigma2[:, None]).sum(axis=0)
    cost = rolled + ((ups - trunk) ** 2).sum(axis=1) / np.radians(LEAN_DEG) ** 2
    best = int(np.argmin(cost))
    up = ups[best]
    largest = int(np.argmax(np.abs(up)))
    tilt_deg, of_trunk_deg, left_deg, beside_deg = (
        float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        for cosine in (up @ z, trunk @ z, trunk @ up, abs(up[largest]))
    )
    lost, gain = float(np.nanmean(-rotation[..., 1] @ (z - up))), float(cost[0] - cost[best])
    # Cameras that look the same way are not rolled where somebody lies along it: their edges must rise.
    is_rolled = rolled[0] - rolled[best] >= LEAST_GAIN_OF_UP / 2
    if (
        tilt_deg < AXIS_WITHIN_DEG
        or gain < LEAST_GAIN_OF_UP
        or left_deg > of_trunk_deg / 2
        or lost > (MOST_LOSS_OF_EDGES if is_rolled else -MOST_LOSS_OF_EDGES)
    ):
        return
    remedy = f"world.up: {'-' if up[largest] < 0 else ''}{'xyz'[largest]}"
    if beside_deg > AXIS_WITHIN_DEG:
        turn = matrix_from_quaternion(between(up, z))
        remedy = trial.lines(trial.every, remedies.placed, np.zeros(3), turn)
    what = f"the world's z does not point up: people and pictures are upright {tilt_deg:.0f} deg from it"
    evidence = {"tilt_deg": tilt_deg, "beside_axis_deg": beside_deg, "gain": gain}
    evidence = {name: round(value, 1) for name, value in evidence.items()}
    yield Alternative("level", trial.names, what, remedy, 0.0, evidence=evidence)


def scaled(scene: SceneOfMoments, numbers: Float) -> SceneOfMoments:
    """Scale all positions by the factor whose logarithm is the one of the numbers [1].

    Errors of positions are in the log's unit, too: so rays that fit go on fitting, and no better.
    """
    place, sigma = scene.position.copy(), scene.sigma.copy()
    place *= np.exp(numbers[0])
    sigma[:, ::2] *= np.exp(numbers[0])
    return replace(scene, position=place, sigma=sigma)


def scales(trial: Trial, stature: float, fitted: tuple[float, float], dearer: float) -> Iterator[Alternative]:
    """Scale all positions so that the person has a usual stature: rays that fit go on fitting.

    What else is placed in the world, as a map or an actor, is scaled with them, or is right as it is. The
    truth, if there is one, says which line changes no more than is wrong. `fitted` is the logarithm of the
    factor that the stature and a logged actor show, and its standard deviation.
    """
    flight, size, (number, sigma) = trial.flight, STATURE_M / stature, fitted
    # Units are far apart, so nearly all statures tell them.
    near = max(2 * sigma, SIZE_SIGMA)
    unit = next((name for name, m in _UNITS_M.items() if abs(number - np.log(m)) < near), None)
    alone = unit is not None
    if flight.truth_m is not None:
        alone = abs(np.log(flight.truth_m / STATURE_M)) < abs(np.log(size))
    for of_poses in (alone, not alone) if flight.truth_m is None and trial.located else (alone,):
        hips, ground = flight.hips, flight.ground
        if not of_poses:
            hips, ground = None if hips is None else size * hips, ground and ground.scaled(size)
        if of_poses and unit is not None:
            factor, code, price, evidence = _UNITS_M[unit], "unit", PRICE_OF_ALL, {}
            what = f"the positions are in {unit}"
            remedy = trial.lines(trial.every, remedies.pose, f"unit: {unit}")
        else:
            factor, share = (float(np.exp(number)), sigma) if of_poses else (size, SIZE_SIGMA)
            code, evidence = "scale", {"scale_sigma_share": round(share, 3)}
            # Any scale makes the person as tall as people are: that much surer the stature makes it.
            price = PRICE_OF_ALL + np.log(1 / SIZE_SIGMA) / 2 + dearer
            what = f"all positions are {1 / factor:.2g} times what they should be:"
            what += f" the person is {stature:.3g} m tall"
            of_logs = trial.lines(trial.every, remedies.placed, np.zeros(3), factor=factor)
            remedy = of_logs if of_poses else f"world.scale: {size:.3g}"
        scene = replace(scaled(trial.described, np.log([factor])), hips=hips, ground=ground)
        yield Alternative(code, trial.names, what, remedy, price, scene, True, evidence)


# --- alternatives without a number -----------------------------------------------------------------------


def discrete(trial: Trial) -> Iterator[Alternative]:
    """Try exchanged pictures, other mounts and gimbals, other conventions, and other keypoints."""
    yield from _exchanged_pictures(trial)
    if trial.moving:
        groups = [*trial.groups(trial.moving), *((kind, _PRICE_OF_ONE) for kind in trial.kinds_of_logs())]
        yield from chain(_mounts(trial), _gimbals(trial), *(_conventions(trial, of) for of in groups))
        yield from chain(*(_units(trial, of) for of in groups))
    yield from _keypoints(trial)
    price = PRICE_OF_ALL + np.log(len(_FOCAL_FACTORS)) / 2
    for factor in _FOCAL_FACTORS:
        what = f"the focal length of every camera is {factor:.3g} times what is stated"
        remedy = trial.lines(trial.every, remedies.lens, factor)
        scene = changed(trial.described, "focal", trial.every, np.log([factor]))
        yield Alternative("intrinsics", trial.names, what, remedy, price, scene)


def _exchanged_pictures(trial: Trial) -> Iterator[Alternative]:
    names, cameras = trial.names, trial.cameras
    price = PRICE_OF_ALL if len(names) == 2 else _PRICE_OF_ONE  # of more cameras there are more ways
    for order in permutations(trial.every) if 2 <= len(names) <= 5 else ():
        moved = [index for index in trial.every if order[index] != index]
        if moved:
            owners = ", ".join(f"{names[index]} has those of {names[order[index]]}" for index in moved)
            remedy = "; ".join(
                trial.lines([index], remedies.pictures_of, cameras[order[index]]) for index in moved
            )
            scene = scene_of(trial.flight, trial.described, order=order)
            what = f"pictures are exchanged: {owners}"
            yield Alternative("videos_swapped", trial.named(moved), what, remedy, price, scene)


def _mounts(trial: Trial) -> Iterator[Alternative]:
    """Try cameras that are rolled, or look another way, by right angles, and the other sign of tilts."""
    rotation, mounts = trial.described.rotation, trial.mounts
    for of, degrees in product(trial.groups(trial.moving), (90, 180, 270)):
        group, _ = of
        turn, whose, signed = turn_about("z", degrees), trial.whose(group), (degrees + 179) % 360 - 179
        rolled = f"{whose} is rolled by {signed} deg about the optical axis"
        remedy = trial.lines(group, remedies.mount, after=turn)
        yield trial.posed("mount", rolled, remedy, of, rotation @ turn)
        side, aside = "left" if signed > 0 else "right", rotation @ mounts.mT @ turn @ mounts
        what = f"{whose} is mounted {abs(signed)} deg to the {side} of where it is said to look"
        remedy = trial.lines(group, remedies.mount, before=turn)
        yield trial.posed("mount", what, remedy, of, aside)
    down = {index: remedies.down_deg(trial.cameras[index]) for index in trial.moving}
    tilted = {index: turn_about("x", 2 * degrees) for index, degrees in down.items() if abs(degrees) > 1}
    if tilted:
        remedy = "; ".join(trial.lines([i], remedies.mount, after=turn) for i, turn in tilted.items())
        turns = np.array([tilted.get(index, np.eye(3)) for index in trial.every])[:, None]
        what = "the tilt of every camera has the wrong sign"
        yield trial.posed("mount", what, remedy, (list(tilted), PRICE_OF_ALL), rotation @ turns)


_MEANT = {
    "world": "relative to the world",
    "body": "relative to the body",
    "heading": "relative to the body's heading and the horizon",
}


def _gimbals(trial: Trial) -> Iterator[Alternative]:
    """Try the other axes of gimbals' angles, and angles that are relative to something else."""
    rotation, mounts, rows = trial.described.rotation, trial.mounts, []
    body, on_gimbal = trial.bodies
    of = {index: trial.cameras[index].entry.poses for index in trial.moving}
    group = [index for index, poses in of.items() if poses.gimbal == "world" and not poses.gimbal_fixed]
    if group:
        right = "enu" if of[group[0]].gimbal_axes == "ned" else "ned"
        turned = _ENU_FROM_NED @ rotation @ mounts.mT @ _FLU_FROM_FRD @ mounts
        rows.append((group, f"in {right.upper()}: tilts have the wrong sign", f"axes: {right}", turned))
    for meant, stated in _MEANT.items():
        turned, group = rotation.copy(), []
        for index, relative_to in on_gimbal.items():
            if relative_to not in _MEANT or relative_to == meant:
                continue
            poses, frames = of[index], _frames(body[index])
            if poses.gimbal_axes == "ned":
                for name in frames:
                    frames[name] = frames[name] @ (_ENU_FROM_NED if name == "world" else _FLU_FROM_FRD)
            turned[index] = frames[meant] @ frames[relative_to].mT @ rotation[index]
            group.append(index)
        rows += [(group, stated, f"relative_to: {meant}", turned)] if group else []
    for group, stated, line, turned in rows:
        remedy = "; ".join(f"cameras.{name}.gimbal.{line}" for name in trial.named(group))
        what = f"the gimbals' angles are {stated}"
        yield trial.posed("gimbal", what, remedy, (group, PRICE_OF_ALL), turned)


def _frames(body: Float) -> dict[str, Float]:
    """Return what angles of a gimbal may be relative to [T, 3, 3], by name, on a body [T, 3, 3]."""
    level = level_heading(quaternion_from_matrix(np.where(np.isfinite(body), body, np.eye(3))))
    return {
        "world": np.broadcast_to(np.eye(3), body.shape),
        "body": body,
        "heading": np.where(np.isfinite(body), matrix_from_quaternion(level), np.nan),
    }


def _conventions(trial: Trial, of: Group) -> Iterator[Alternative]:
    """Try other meanings of the logged poses: axes, inverses, orders of quaternions."""
    moving = of[0]
    mounts, camera, place = trial.mounts, trial.described.rotation, trial.described.position
    body, on_gimbal = trial.bodies

    def carried_by(bodies: Float) -> Float:
        """Return the attitudes [C, T, 3, 3] of the cameras on bodies that are turned otherwise."""
        turned = bodies @ mounts
        for index, base in on_gimbal.items():
            if base is not None:
                before, after = _frames(body[index])[base], _frames(bodies[index])[base]
                turned[index] = after @ before.mT @ camera[index]
        return turned

    held = [trial.cameras[index].entry.poses for index in moving]
    # The exchange of axes is its own inverse.
    axes, frame = ("enu", "FLU") if held[0].axes == "ned" else ("ned", "FRD")
    in_axes, z = f"the poses are in {axes.upper()}, of", "up" if held[0].z == "down" else "down"
    of_camera, of_body = (
        f"world_from_{each}" if held[0].inverse else f"{each}_from_world" for each in ("camera", "body")
    )
    back, body_back, ned = camera.mT, body.mT, place @ _ENU_FROM_NED.T
    origin, body_origin = (-np.einsum("ctij,ctj->cti", each, place) for each in (back, body_back))
    on_body, own = camera @ _FLU_FROM_OPTICAL, body_back @ mounts
    to_body, to_camera = remedies.OF_BODY, remedies.OF_CAMERA
    table: list[tuple[str, str, remedies.Options, Float, Float]] = [
        ("axes", "the positions have x and y exchanged", "", camera, place[..., [1, 0, 2]]),
        ("convention", f"the poses are {of_camera}", remedies.inverse, back, origin),
        ("convention", f"the poses are {of_body}", remedies.inverse, carried_by(body_back), body_origin),
        ("convention", f"the attitudes are {of_camera}, the positions are not", "", back, place),
        ("convention", f"the attitudes are {of_body}, the positions are not", "", own, place),
        ("convention", "the poses are of the body, and are taken for the camera's", to_body, on_body, place),
        ("convention", "the poses are of the camera, and are taken for the body's", to_camera, body, place),
    ]
    if np.nanmedian(place[moving, :, 2]) < 0:  # nobody takes off far above where they fly
        what = f"the positions count z {z}wards, the attitudes do not"
        table.append(("axes", what, remedies.upside_down, camera, place * [1.0, 1.0, -1.0]))
    if any(poses.mount or poses.in_gimbal for poses in held):
        turned = carried_by(_ENU_FROM_NED @ body @ _FLU_FROM_FRD)
        table.append(("axes", f"{in_axes} a body with {frame} axes", f"axes: {axes}", turned, ned))
    if any(poses.mount is None for poses in held):
        table.append(("axes", f"{in_axes} the camera", f"axes: {axes}", _ENU_FROM_NED @ camera, ned))
    for attitudes, of_cameras in ((camera, np.asarray), (body, carried_by)):
        quaternion = quaternion_from_matrix(np.where(np.isfinite(attitudes), attitudes, np.eye(3)))
        for roll, order in ((-1, "wxyz"), (1, "xyzw")):
            turned = of_cameras(matrix_from_quaternion(np.roll(quaternion, roll, axis=-1)))
            what = f"the quaternions are written as {' '.join(order)}"
            table.append(("convention", what, f"quaternion: {order}", turned, place))
    for code, what, options, rotation, position in table:
        again = f"write the log again, since {what}"
        remedy = trial.lines(moving, remedies.pose, options) if options else again
        yield trial.posed(code, what, remedy, of, rotation, position)
    if any(poses.mount for poses in held):
        # Of poses of the camera itself, it would be a roll by 180 deg.
        remedy = trial.lines(moving, remedies.mount, before=_FLU_FROM_FRD)
        what, turned = "the body's axes are FRD (forward, right, down)", body @ _FLU_FROM_FRD @ mounts
        yield trial.posed("axes", what, remedy, of, turned)


def _units(trial: Trial, of: Group) -> Iterator[Alternative]:
    """Try other units of the logged positions, of cameras as in `_conventions`."""
    moving = of[0]
    camera, place = trial.described.rotation, trial.described.position
    whose = "" if moving == trial.moving else f" of {', '.join(trial.named(moving))}"
    # Lever arms are stated in metres, whatever the log's unit.
    levers = np.array([each.lever_m for each in trial.cameras])
    arms = np.einsum("ctij,cj->cti", trial.bodies[0], levers)
    for name, metres in _UNITS_M.items():
        again = f", and {1 / metres:.4g} times what is read"
        for unit, factor, known in ((name, metres, ""), ("m", 1 / metres, again)):
            what, there = f"the positions{whose} are in {unit}{known}", (place - arms) * factor + arms
            remedy = trial.lines(moving, remedies.pose, f"unit: {unit}")
            yield trial.posed("unit", what, remedy, of, camera, there)


# What is mirrored, if a detector does it alike in all pictures, its price, and its sentence.
_MIRRORED = {
    "true": (False, 0.0, "the pictures{} were mirrored before the keypoints were found"),
    "x": (False, 0.0, "the keypoints{} count x from the right"),
    "y": (True, 0.0, "the keypoints count y from below"),
    "names": (True, 0.3, "left and right are exchanged in the names of joints"),
}


def _keypoints(trial: Trial) -> Iterator[Alternative]:
    """Try keypoints of pictures of another size, and mirrored ones: of all cameras, then of each."""
    for group, price in trial.groups(trial.every):
        one, named = len(group) < len(trial.names), trial.named(group)
        whose = f" of {named[0]}" if one else ""
        for factor in _SIZE_FACTORS:
            what = f"the keypoints{whose} are of pictures {1 / factor:.3g} times as large"
            remedy = trial.lines(group, remedies.keypoints_size, 1 / factor)
            scene = trial.with_pixels(group, factor)
            yield Alternative("keypoints_size", named, what, remedy, price, scene)
        for value, (of_all, dearer, what) in _MIRRORED.items():
            if not (one and of_all):
                scene = trial.with_pixels(group, flipped=remedies.MIRRORS[value])
                remedy = remedies.mirrored([trial.cameras[index] for index in group], value)
                yield Alternative("mirrored", named, what.format(whose), remedy, price + dearer, scene)


# --- alternatives with numbers, which are fitted ---------------------------------------------------------

NUMBERS = {"shift": 3, "heading": 1, "north": 1, "zero": 4, "pitch": 1, "roll": 1, "focal": 1}
"""Numbers of a description that may be wrong, and how many of them each alternative sets free.

`shift`: each log has its zero elsewhere, by numbers of its own; `north`: it has its north elsewhere; `zero`:
both. `heading`, `pitch`, `roll`: the camera is turned where it is, about the vertical or its own x and z
axes. `focal`: its focal length is another; the number is then the logarithm of the factor.
"""

# The code and the sentence of each.
_FAULTS = {
    "shift": ("origin", "the log of {whose} has its zero {far_m:.1f} m from the world's"),
    "north": ("origin", "the log of {whose} has its north {degrees:+.0f} deg from the world's"),
    "zero": (
        "origin",
        "the log of {whose} has its zero {far_m:.1f} m and its north {degrees:+.0f} deg from the world's",
    ),
    "heading": ("pose", "the heading of {whose} is {degrees:+.0f} deg from what is logged"),
    "pitch": ("mount", "{whose} looks {tilt} than stated"),
    "roll": ("mount", "{whose} is rolled by {degrees:+.0f} deg about the optical axis"),
    "focal": ("intrinsics", "the focal length of {whose} is {factor:.3g} times what is stated"),
}
# Prices of what all cameras have in common. Right positions with headings that are all wrong are rare.
_OF_ALL = {"focal": PRICE_OF_ALL, "pitch": PRICE_OF_ALL, "heading": 3.0}
# A fit finds the best angle from within some 10 deg; those that are not here are tried all around.
_STARTS_DEG = {"pitch": range(-90, 91, 15), "focal": (0,), "shift": (0,)}


def changed(scene: SceneOfMoments, kind: str, group: Sequence[int], numbers: Float) -> SceneOfMoments:
    """Return the scene with numbers [n] of some cameras changed."""
    chosen = list(group)
    if kind == "focal":
        factor = np.ones(len(scene.focal_px))
        factor[chosen] = zoom(numbers[0])
        return replace(scene, rays=scene.rays / factor[:, None, None, None], focal_px=scene.focal_px * factor)
    rotation, position = scene.rotation.copy(), scene.position.copy()
    if kind != "shift":
        turn = turn_about("x" if kind == "pitch" else "z", float(np.degrees(numbers[-1])))
        own = kind in ("pitch", "roll")
        rotation[chosen] = rotation[chosen] @ turn if own else turn @ rotation[chosen]
        if kind in ("north", "zero"):
            position[chosen] = position[chosen] @ turn.T
    if kind in ("shift", "zero"):
        position[chosen] += numbers[: len(numbers) // 3 * 3].reshape(-1, 1, 3)
    return replace(scene, rotation=rotation, position=position)


def zoom(logarithm: float) -> float:
    """Return the factor of a focal length from the logarithm that a fit found, which may have run away."""
    return float(np.exp(np.clip(logarithm, -_MOST_ZOOM, _MOST_ZOOM)))


def sizes(numbers: Float) -> Float:
    """Return the sizes [n] of fitted numbers: of shifts, in threes, and of an angle or logarithm at the end.

    How large a mistake is, nobody knows before: all magnitudes are alike likely.
    """
    of_shifts = len(numbers) // 3 * 3
    lengths = np.linalg.norm(numbers[:of_shifts].reshape(-1, 3), axis=1)
    return np.concatenate([np.repeat(lengths, 3), np.abs(numbers[of_shifts:])])


def numbers_of_all(trial: Trial) -> Iterator[Numbers]:
    """Set free what all cameras have in common, and each log's own zero."""
    for kind in _OF_ALL:
        if group := trial.every if kind == "focal" else trial.moving:
            yield _numbers(trial, kind, group)
    if len(trial.names) > 2 and trial.moving:
        yield own_origins(trial, trial.names, "every log counts positions from a place of its own")


def numbers_of_one(trial: Trial) -> Iterator[Numbers]:
    """Set free what one camera has: where its log has zero and north, how it is turned, its focal length."""
    for index, kind in product(trial.every, NUMBERS):
        if index not in trial.moving and kind != "focal":
            continue
        if kind in ("shift", "north", "zero") and index == 0 and trial.is_loose_pair:
            continue  # of two, one alone can be placed beside the other
        yield _numbers(trial, kind, [index])


def _is_fault(trial: Trial, kind: str, group: Sequence[int], numbers: Float, covariance: Float) -> bool:
    """Test if numbers differ from zero, and matter beside what is stated of the errors of the poses."""
    if not numbers @ np.linalg.pinv(covariance) @ numbers > _LEAST_OWN_SIGMAS**2:
        return False
    if kind == "focal":
        return abs(float(numbers[0])) >= _LEAST_ZOOM
    position_m, rotation_rad = _LEAST_SIGMAS * trial.described.sigma[list(group), :2].max(axis=0)
    shifts = numbers[: len(numbers) // 3 * 3].reshape(-1, 3)
    least_m = np.linalg.norm(shifts, axis=1).min(initial=np.inf)
    turn_rad = abs(float(numbers[-1])) if kind != "shift" else 0.0
    is_moved = bool(len(shifts)) and least_m >= max(position_m, _LEAST_SHIFT_M)
    return bool(is_moved or turn_rad >= max(rotation_rad, _LEAST_TURN_RAD))


def _numbers(trial: Trial, kind: str, group: list[int]) -> Numbers:
    """Set numbers of some cameras free, from where the rays miss each other least."""
    degrees = list(_STARTS_DEG.get(kind, range(-180, 180, 15)))
    starts = np.zeros((len(degrees), NUMBERS[kind]))
    starts[:, -1] = np.radians(degrees)
    make = partial(changed, trial.described, kind, group)
    return Numbers(make, starts, partial(_of_numbers, trial, kind, group))


def _of_numbers(
    trial: Trial, kind: str, group: list[int], numbers: Float, covariance: Float
) -> Alternative | None:
    """State fitted numbers and their remedy; None if they are too small to matter."""
    if not _is_fault(trial, kind, group, numbers, covariance):
        return None
    number, variance, (code, sentence) = float(numbers[-1]), np.diag(covariance), _FAULTS[kind]
    degrees = float(np.degrees(number)) if kind != "shift" else 0.0
    shifts = numbers[: len(numbers) // 3 * 3].reshape(-1, 3)
    measured = {"far_m": np.linalg.norm(shifts), "degrees": degrees, "factor": zoom(number)}
    tilt = f"{abs(degrees):.0f} deg {'higher' if degrees > 0 else 'lower'}"
    what = sentence.format(whose=trial.whose(group), tilt=tilt, **measured)
    turn = turn_about("x" if kind == "pitch" else "z", degrees)
    if kind == "focal":
        remedy = trial.lines(group, remedies.lens, zoom(number))
    elif code == "origin":
        moved = zip(group, shifts if len(shifts) else np.zeros((1, 3)), strict=True)
        remedy = "; ".join(trial.lines([index], remedies.placed, shift, turn) for index, shift in moved)
    elif code == "mount":
        remedy = trial.lines(group, remedies.mount, after=turn)
    else:
        remedy = _turned_about_vertical(trial, group, number)
    evidence = {}
    if shifts.size and variance.size:
        parts = variance[: shifts.size].reshape(-1, 3).sum(axis=1)
        evidence["shift_sigma_m"] = round(float(np.sqrt(parts.max())), 2)
    if kind not in ("shift", "focal") and variance.size:
        evidence["turn_sigma_deg"] = round(float(np.degrees(np.sqrt(variance[-1]))), 2)
    price = _PRICE_OF_ONE if len(group) < len(trial.names) else _OF_ALL.get(kind, PRICE_OF_ALL)
    return Alternative(code, trial.named(group), what, remedy, price, evidence=evidence)


def _turned_about_vertical(trial: Trial, group: Sequence[int], angle_rad: float) -> str:
    """Turn mounts about the vertical as the cameras see it on average: they, and drones, are tilted."""
    vertical = np.nansum(trial.described.rotation[:, :, 2], axis=1)
    vertical /= np.maximum(np.linalg.norm(vertical, axis=1, keepdims=True), 1e-9)
    turns = matrix_from_quaternion(quaternion_from_rotation_vector(angle_rad * vertical))
    return "; ".join(trial.lines([index], remedies.mount, after=turns[index]) for index in group)


def own_origins(trial: Trial, cameras: tuple[str, ...], what: str) -> Numbers:
    """Place the logs of all drones, of which each counts from a place of its own.

    The search begins where each camera by itself sees a person of usual stature: as far away as they are
    tall in its pictures. Without a logged actor, the world is that of the first log.
    """
    flight, scene = trial.flight, trial.described
    is_fixed = flight.hips is not None or len(trial.moving) < len(trial.names)
    moved = trial.moving if is_fixed else trial.moving[1:]
    away_m = scene.focal_px * STATURE_M * NOSE_TO_ANKLES / np.maximum(scene.person_px, 1.0)
    rays = np.concatenate([scene.rays[:, :, HIPS], np.ones((*scene.rays.shape[:2], 2, 1))], axis=-1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).mean(axis=2)
    seen = scene.position + away_m[:, None, None] * np.einsum("ctij,ctj->cti", scene.rotation, rays)
    apart = (seen[0] if flight.hips is None else flight.hips) - seen
    start = [np.nanmedian(apart[i], axis=0) if np.isfinite(apart[i]).any() else np.zeros(3) for i in moved]

    def alternative(numbers: Float, covariance: Float) -> Alternative | None:
        found = _of_numbers(trial, "shift", moved, numbers, covariance)
        return found and replace(found, cameras=cameras, what=what, price=PRICE_OF_ALL, same_scatter=True)

    return Numbers(partial(changed, scene, "shift", moved), np.concatenate(start)[None], alternative)


# --- errors that are larger than stated ------------------------------------------------------------------

_NOISE_FACTORS = (2.0, 5.0, 12.0, 36.0)  # with the last, poses of one camera hardly count


def larger_errors(trial: Trial) -> Iterator[list[Alternative]]:
    """Let errors be some times larger than stated: of all poses, or of one camera's.

    Their score says nothing, since larger errors excuse everything; only their cost counts.
    """
    groups = [trial.every] if all(trial.cameras[index].states_noise for index in trial.moving) else []
    groups += [[index] for index in trial.moving] if len(trial.names) > 2 else []  # of two, either errs more
    for group in groups if trial.moving else ():
        whose = "" if len(group) == len(trial.names) else f" of {trial.names[group[0]]}"
        stated = "stated" if trial.cameras[group[0]].states_noise else "usual"
        tried, code = [], "pose" if whose else "noise"
        for factor in _NOISE_FACTORS:
            sigma = trial.described.sigma.copy()
            sigma[group] *= factor
            what = f"errors of the poses{whose} are larger than {stated}, about {factor:g} times"
            moving = [index for index in group if index in trial.moving]
            remedy = trial.lines(moving, remedies.pose_noise, factor)
            scene = replace(trial.described, sigma=sigma)
            tried.append(Alternative(code, trial.named(group), what, remedy, np.inf, scene))
        yield tried
