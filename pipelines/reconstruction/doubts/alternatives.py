"""Alternatives to a flight's description: what is changed, in a sentence, as a scene and as a remedy.

An alternative has a price that grows with its freedom: for how many there are of its kind, and for its
numbers. So of two that explain as much, the one with less freedom is named first. Nothing is weighed here.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, permutations, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.mounting import level_heading
from pipelines.geometry.poses import (
    interpolate_rotations,
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
)
from pipelines.reconstruction.doubts import remedies
from pipelines.reconstruction.doubts.scene import (
    FEW,
    JOINTS,
    PLACED_M,
    STATURE_M,
    Body,
    Sampled,
    SceneOfMoments,
    scene_of,
    trunk_direction,
)
from pipelines.reconstruction.observations import Filmed

RATES = (25 / 30, 24 / 30, 30 / 25, 30 / 24, 2.0, 0.5)
"""Factors between frame rates that are mistaken for each other: 25 for 30, 24 for 30, half and double."""

PRICE_OF_ALL = 0.5
"""Price of an alternative of all cameras alike."""

PRICE_OF_ONE = 0.8
"""Price of an alternative of one camera, of which there are as many as cameras."""

LEAST_SIGMAS = 5.0
"""A stated value is doubted beyond this many of its standard deviations, because errors have heavy tails."""

_FLU_FROM_OPTICAL = matrix_from_quaternion(np.array([-0.5, 0.5, -0.5, 0.5]))
_ENU_FROM_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_FLU_FROM_FRD = np.diag([1.0, -1, -1])
_FOCAL_FACTORS = (0.5, 2.0, 2 / 3, 1.5, 0.75, 4 / 3)  # calibrations of pictures of another size, or cropped
_SIZE_FACTORS = (2.0, 0.5, 1.5, 2 / 3, 3.0, 1 / 3)  # pictures that a detector was given enlarged or reduced
_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048}
# Cameras film at these rates, or at 1000/1001 of them, but for rounding.
_USUAL_RATES_HZ, _SAME_RATE = (24.0, 25.0, 30.0, 50.0, 60.0), 2e-3
# Of the pictures of a detector few are looked at, so other rates than these may be right.
_PRICE_OF_UNUSUAL_RATE = 1.0
# Logs go on about as long as pictures: a rate pays this, times the share of logs that it leaves unfilmed.
_PRICE_OF_UNFILMED = 3.0
# A fitted number that is nearer to zero, in its own standard deviations, may be zero.
_LEAST_OWN_SIGMAS = 3.0
# Smaller faults do not matter beside the errors of good poses, whatever is stated of these.
_LEAST_SHIFT_M, _LEAST_TURN_RAD, _LEAST_ZOOM = 0.2, np.radians(2.0), 0.1
# Focal lengths are wrong by at most this logarithm: a factor of twenty.
_MOST_ZOOM = 3.0
# The nose is this share of the stature above the ankles (Winter 2009).
_NOSE_TO_ANKLES = 0.9
_LEFT_RIGHT = [
    JOINTS.index(name.replace("left", "@").replace("right", "left").replace("@", "right")) for name in JOINTS
]


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
    same_pictures: Callable[[], tuple[SceneOfMoments, Sampled]] | None = None
    flight: Sampled | None = None  # where a map and an actor are other than described


@dataclass(frozen=True)
class Numbers:
    """Numbers [n] of a description that a fit sets free."""

    make: Callable[[Float], SceneOfMoments]
    starts: Float  # [K, n]; the fit begins at the best of them
    alternative: Callable[[Float, Float], Alternative | None]  # of numbers [n] and their covariance [n, n]


class Trial:
    """The flight as described, beside which alternatives are made."""

    def __init__(self, flight: Sampled, described: SceneOfMoments) -> None:
        self.flight = flight
        self.cameras: tuple[Filmed, ...] = flight.cameras
        self.described = described
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

    def groups(self, members: Sequence[int]) -> Iterator[tuple[list[int], float]]:
        """Take all cameras together, then each, which is dearer."""
        if len(members) > 1:
            yield list(members), 0.5
        yield from (([index], 0.8) for index in members)

    @cached_property
    def mounts(self) -> Float:
        """Return body_from_camera [C, 1, 3, 3]; looking forwards where a camera is not fixed to a body."""
        stored = [camera.mount for camera in self.cameras]
        return np.array([_FLU_FROM_OPTICAL if each is None else each for each in stored])[:, None]

    def with_times(self, group: Sequence[int], late_s: float = 0.0, slower: float = 1.0) -> SceneOfMoments:
        """Add seconds to the times of cameras' pictures, and let them follow each other more slowly."""
        late, factor = np.zeros(len(self.names)), np.ones(len(self.names))
        late[list(group)], factor[list(group)] = late_s, slower
        return scene_of(self.flight, self.described, late_s=late, slower=factor)

    def with_all_times(self, late_s: float = 0.0, slower: float = 1.0) -> tuple[SceneOfMoments, Sampled]:
        """Change all times and look at the same pictures, at the moments at which they were taken then."""
        moved = self.flight.at_other_times(late_s, slower)
        late, factor = np.full(len(self.names), late_s), np.full(len(self.names), slower)
        return scene_of(moved, late_s=late, slower=factor), moved

    def with_pixels(self, group: Sequence[int], change: Callable[[Float, Filmed], Float]) -> SceneOfMoments:
        """Change the pixels [F, J, 2] of cameras."""
        pixels = [camera.pixels for camera in self.cameras]
        for index in group:
            pixels[index] = change(pixels[index], self.cameras[index])
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
        others = (hz for hz in _USUAL_RATES_HZ if abs(stated_hz / hz - 1) > _SAME_RATE)
        for factor in (stated_hz / hz for hz in others) if _is_usual(stated_hz) else RATES:
            unfilmed = [_unfilmed(trial.cameras[k], factor) - _unfilmed(trial.cameras[k]) for k in group]
            dearer = max(0.0, _PRICE_OF_UNFILMED * float(np.mean(unfilmed)))
            dearer += _PRICE_OF_UNUSUAL_RATE * (not _is_usual(stated_hz / factor))
            yield rate(trial, group, factor, price + dearer)


def rate(trial: Trial, group: list[int], factor: float, price: float = 0.0) -> Alternative:
    """Change the frame rate of one camera, or of all."""
    alike = len(group) == len(trial.names)
    return Alternative(
        "frame_rate",
        trial.named(group),
        f"the frame rate of {trial.whose(group)} is {1 / factor:.3g} times what is stated",
        remedies.frame_rate(trial.cameras, group, factor),
        price,
        trial.with_times(group, slower=factor),
        same_pictures=partial(trial.with_all_times, 0.0, factor) if alike else None,
    )


def _is_usual(rate_hz: float) -> bool:
    return min(abs(rate_hz / usual - 1) for usual in _USUAL_RATES_HZ) < _SAME_RATE


def _unfilmed(camera: Filmed, slower: float = 1.0) -> float:
    """Return the share of a camera's log after its last picture; of one that stands still, of its film."""
    first, last = camera.entry.frames.first_t_ns, camera.entry.frames.last_t_ns
    begin, end = (first, last) if camera.static else camera.camera.trajectory.t_ns[[0, -1]]
    return float(max(0, end - first - (last - first) * slower) / max(end - begin, 1))


def clock(trial: Trial, group: list[int], late_s: float) -> Alternative:
    """Move the clock of one camera, or of all."""
    alike = len(group) == len(trial.names)
    return Alternative(
        "clock",
        trial.named(group),
        f"the pictures of {trial.whose(group)} were taken {remedies.earlier_or_later(late_s)}",
        remedies.clock(trial.cameras, group, late_s),
        1.0 + abs(late_s) / 2,
        trial.with_times(group, late_s),
        same_pictures=partial(trial.with_all_times, late_s) if alike else None,
    )


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
# Two in three grown-ups have a stature within this share of the usual one.
STATURE_SHARE = 0.09
_UPS = {
    f"{sign}{axis}": turn * np.eye(3)[k]
    for sign, turn in (("", 1), ("-", -1))
    for k, axis in enumerate("xyz")
}


def level(trial: Trial, joints: Float) -> Iterator[Alternative]:
    """Find a world whose z does not point up: people and pictures are upright along another direction.

    Both must say so: somebody may lie, and a camera may be rolled or look straight down.
    """
    trunk = trunk_direction(joints)
    steady = float(np.linalg.norm(trunk))
    if not steady > LEAST_STEADY_TRUNK:
        return
    trunk, z = trunk / steady, np.array([0.0, 0.0, 1.0])
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
    tilt_deg, of_trunk_deg, left_deg = (
        float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) for cosine in (up @ z, trunk @ z, trunk @ up)
    )
    lost = float(np.nanmean(-rotation[..., 1] @ (z - up)))
    gain = float(cost[0] - cost[best])
    # Cameras that look the same way are not rolled where somebody lies along it: their edges must rise.
    is_rolled = rolled[0] - rolled[best] >= LEAST_GAIN_OF_UP / 2
    if (
        tilt_deg < AXIS_WITHIN_DEG
        or gain < LEAST_GAIN_OF_UP
        or left_deg > of_trunk_deg / 2
        or lost > (MOST_LOSS_OF_EDGES if is_rolled else -MOST_LOSS_OF_EDGES)
    ):
        return
    axis = max(_UPS, key=lambda name: float(_UPS[name] @ up))
    beside_deg = float(np.degrees(np.arccos(np.clip(_UPS[axis] @ up, -1, 1))))
    remedy = f"world.up: {axis}"
    if beside_deg > AXIS_WITHIN_DEG:
        remedy = remedies.turned_world(trial.cameras, up)
    yield Alternative(
        "level",
        trial.names,
        f"the world's z does not point up: people and pictures are upright {tilt_deg:.0f} deg from it",
        remedy,
        0.0,
        evidence={
            "tilt_deg": round(tilt_deg, 1),
            "beside_axis_deg": round(beside_deg, 1),
            "gain": round(gain, 1),
        },
    )


def scales(trial: Trial, joints: Float, stature: float, dearer: float) -> Iterator[Alternative]:
    """Scale all positions so that the person has a usual stature: rays that fit go on fitting.

    What else is placed in the world, as a map or an actor, is scaled with them, or is right as it is. The
    truth, if there is one, says which line changes no more than is wrong.
    """
    flight, described = trial.flight, trial.described
    # Any scale makes the person as tall as people are: that much surer the stature makes it (see `_freedom`).
    price = PRICE_OF_ALL + np.log(1 / STATURE_SHARE) / 2 + dearer
    size = STATURE_M / stature
    by_actor, sigma = _scaled_to_actor(trial, joints, size)
    # Units are far apart, so nearly all statures tell them.
    near = max(2 * sigma, STATURE_SHARE)
    unit = next((name for name, m in _UNITS_M.items() if abs(np.log(by_actor / m)) < near), None)
    alone = unit is not None
    if flight.truth_m is not None:
        alone = abs(np.log(flight.truth_m / STATURE_M)) < abs(np.log(size))
    for of_poses in (alone, not alone) if flight.truth_m is None and trial.located else (alone,):
        factor, code, cost, remedy = size, "scale", price, f"world.scale: {size:.3g}"
        placed, evidence = flight.scaled(size), {"scale_sigma_share": STATURE_SHARE}
        if of_poses:
            factor, remedy, placed = by_actor, remedies.scaled(trial.cameras, by_actor), flight
            evidence["scale_sigma_share"] = round(sigma, 3)
        what = f"all positions are {1 / factor:.2g} times what they should be:"
        what += f" the person is {stature:.3g} m tall"
        if of_poses and unit is not None:
            factor, code, evidence, cost = _UNITS_M[unit], "unit", {}, PRICE_OF_ALL
            what = f"the positions are in {unit}"
            remedy = remedies.pose(trial.cameras, trial.every, f"unit: {unit}")
        # Errors of positions are in the log's unit, too: so rays that fit go on fitting, and no better.
        of_places = np.array([factor, 1.0] * 3)
        scene = replace(described, position=described.position * factor, sigma=described.sigma * of_places)
        yield Alternative(code, trial.names, what, remedy, cost, scene, True, evidence, flight=placed)


def _scaled_to_actor(trial: Trial, joints: Float, size: float) -> tuple[float, float]:
    """Return the factor of all positions that the stature and a logged actor show, and its relative error."""
    if trial.flight.hips is None:
        return size, STATURE_SHARE
    hips = Body(joints).hips
    known = np.isfinite(hips + trial.flight.hips).all(axis=1)
    far2 = float((hips[known] ** 2).sum())
    factor = float((hips * trial.flight.hips)[known].sum()) / max(far2, 1e-9)
    if factor <= 0:
        return size, STATURE_SHARE
    # As for fits: an actor's errors wander, and count as few.
    weights = np.array([1 / STATURE_SHARE**2, FEW * factor**2 * far2 / known.sum() / PLACED_M**2])
    found = float(np.exp(weights @ np.log([size, factor]) / weights.sum()))
    return found, float(1 / np.sqrt(weights.sum()))


# --- alternatives without a number -----------------------------------------------------------------------


def discrete(trial: Trial) -> Iterator[Alternative]:
    """Try exchanged pictures, other mounts and gimbals, other conventions, and other keypoints."""
    yield from _exchanged_pictures(trial)
    scene = trial.described
    written: dict[tuple[str, bool], list[int]] = {}  # who wrote the poses
    for index in trial.moving:
        poses = trial.cameras[index].entry.poses
        written.setdefault((Path(poses.source).suffix.lower(), poses.topic is None), []).append(index)
    kinds: list[Sequence[int] | None] = [None, *(written.values() if len(written) > 1 else ())]
    conventions = chain.from_iterable(_conventions(trial, kind) for kind in kinds)
    kinds += [[index] for index in trial.moving if len(trial.moving) > 1 and [index] not in kinds]
    units = chain.from_iterable(_units(trial, kind) for kind in kinds)
    for row in chain(_mounts(trial), _gimbals(trial), conventions, units) if trial.moving else ():
        group = trial.moving if row.group is None else row.group
        rotation, position = scene.rotation.copy(), scene.position.copy()
        rotation[group] = row.rotation[group]
        if row.position is not None:
            position[group] = row.position[group]
        named = trial.names if row.group is None else trial.named(group)
        posed = replace(scene, rotation=rotation, position=position)
        yield Alternative(row.code, named, row.what, row.remedy, row.price, posed, row.same_scatter)
    yield from _keypoints(trial)
    for factor in _FOCAL_FACTORS:
        yield Alternative(
            "intrinsics",
            trial.names,
            f"the focal length of every camera is {factor:.3g} times what is stated",
            remedies.intrinsics(trial.cameras, trial.every, factor),
            PRICE_OF_ALL + np.log(len(_FOCAL_FACTORS)) / 2,
            changed(scene, "focal", trial.every, np.log([factor])),
        )


class Posed(NamedTuple):
    """A row of the table of other poses."""

    code: str
    what: str
    remedy: str
    rotation: Float  # [C, T, 3, 3] world_from_camera; those of the group are taken
    position: Float | None = None  # [C, T, 3]; None as described
    group: Sequence[int] | None = None  # None for all moving cameras
    price: float = PRICE_OF_ALL
    same_scatter: bool = False


def _exchanged_pictures(trial: Trial) -> Iterator[Alternative]:
    names = trial.names
    for order in permutations(trial.every) if 2 <= len(names) <= 5 else ():
        moved = [index for index in trial.every if order[index] != index]
        if moved:
            owners = ", ".join(f"{names[index]} has those of {names[order[index]]}" for index in moved)
            yield Alternative(
                "videos_swapped",
                trial.named(moved),
                f"pictures are exchanged: {owners}",
                remedies.videos(trial.cameras, order),
                0.5 if len(names) == 2 else 0.8,  # of more cameras there are more ways
                scene_of(trial.flight, trial.described, order=order),
            )


def _mounts(trial: Trial) -> Iterator[Posed]:
    """Try cameras that are rolled, or look another way, by right angles, and the other sign of tilts."""
    rotation, cameras, mounts = trial.described.rotation, trial.cameras, trial.mounts
    for (group, price), degrees in product(trial.groups(trial.moving), (90, 180, 270)):
        turn, whose = turn_about("z", degrees), trial.whose(group)
        signed = degrees if degrees <= 180 else degrees - 360
        rolled = f"{whose} is rolled by {signed} deg about the optical axis"
        remedy = remedies.mount(cameras, group, after=turn)
        yield Posed("mount", rolled, remedy, rotation @ turn, None, group, price)
        side = "left" if degrees <= 180 else "right"
        aside = f"{whose} is mounted {abs(signed)} deg to the {side} of where it is said to look"
        remedy = remedies.mount(cameras, group, before=turn)
        yield Posed("mount", aside, remedy, rotation @ mounts.mT @ turn @ mounts, None, group, price)
    down = {index: remedies.down_deg(cameras[index]) for index in trial.moving}
    tilted = {index: turn_about("x", 2 * degrees) for index, degrees in down.items() if abs(degrees) > 1}
    if tilted:
        what = "the tilt of every camera has the wrong sign"
        remedy = "; ".join(remedies.mount(cameras, [index], after=turn) for index, turn in tilted.items())
        turns = np.array([tilted.get(index, np.eye(3)) for index in trial.every])[:, None]
        yield Posed("mount", what, remedy, rotation @ turns, None, list(tilted))


_MEANT = {
    "world": "relative to the world",
    "body": "relative to the body",
    "heading": "relative to the body's heading and the horizon",
}


def _gimbals(trial: Trial) -> Iterator[Posed]:
    """Try the other axes of gimbals' angles, and angles that are relative to something else."""
    rotation, mounts = trial.described.rotation, trial.mounts
    of = {index: trial.cameras[index].entry.poses for index in trial.moving}

    def row(group: list[int], what: str, line: str, turned: Float) -> Posed:
        remedy = "; ".join(f"cameras.{trial.names[index]}.gimbal.{line}" for index in group)
        return Posed("gimbal", f"the gimbals' angles are {what}", remedy, turned, None, group)

    group = [index for index, poses in of.items() if poses.gimbal == "world" and not poses.gimbal_fixed]
    if group:
        right = "enu" if of[group[0]].gimbal_axes == "ned" else "ned"
        turned = _ENU_FROM_NED @ rotation @ mounts.mT @ _FLU_FROM_FRD @ mounts
        yield row(group, f"in {right.upper()}: tilts have the wrong sign", f"axes: {right}", turned)
    for meant, stated in _MEANT.items():
        turned, group = rotation.copy(), []
        for index, poses in of.items():
            body = _body(trial, index)
            if poses.gimbal not in _MEANT or poses.gimbal == meant or body is None:
                continue
            frames = _frames(body)
            if poses.gimbal_axes == "ned":
                frames = {
                    name: frame @ (_ENU_FROM_NED if name == "world" else _FLU_FROM_FRD)
                    for name, frame in frames.items()
                }
            turned[index] = frames[meant] @ frames[poses.gimbal].mT @ rotation[index]
            group.append(index)
        if group:
            yield row(group, stated, f"relative_to: {meant}", turned)


def _body(trial: Trial, index: int) -> Float | None:
    """Return the attitudes [T, 3, 3] of the body that carries a camera on a gimbal, if it is logged."""
    track, t_ns = trial.cameras[index].camera.trajectory, trial.flight.t_ns
    if track.body_xyzw is None:
        return None
    gap_ns = trial.flight.between.max_gap_ns
    limits = {"max_gap_ns": gap_ns, "max_extrapolation_ns": gap_ns}
    return matrix_from_quaternion(interpolate_rotations(track.t_ns, track.body_xyzw, t_ns, **limits))


def _frames(body: Float) -> dict[str, Float]:
    """Return what angles of a gimbal may be relative to [T, 3, 3], by name, on a body [T, 3, 3]."""
    level = level_heading(quaternion_from_matrix(np.where(np.isfinite(body), body, np.eye(3))))
    return {
        "world": np.broadcast_to(np.eye(3), body.shape),
        "body": body,
        "heading": np.where(np.isfinite(body), matrix_from_quaternion(level), np.nan),
    }


def _conventions(trial: Trial, kind: Sequence[int] | None) -> Iterator[Posed]:
    """Try other meanings of the logged poses: axes, inverses, orders of quaternions.

    `kind` are the cameras with logs of one kind; None for all that move.
    """
    moving = trial.moving if kind is None else kind
    price = PRICE_OF_ALL if kind is None else PRICE_OF_ONE
    scene, cameras, mounts = trial.described, trial.cameras, trial.mounts
    camera, place = scene.rotation, scene.position
    body, on_gimbal = _bodies(trial, moving)

    def carried_by(bodies: Float) -> Float:
        """Return the attitudes [C, T, 3, 3] of the cameras on bodies that are turned otherwise."""
        turned = bodies @ mounts
        for index, of in on_gimbal.items():
            if of is not None:
                before, after = _frames(body[index])[of], _frames(bodies[index])[of]
                turned[index] = after @ before.mT @ camera[index]
        return turned

    stated = cameras[moving[0]].entry.poses
    # The exchange of axes is its own inverse.
    axes, frame = ("enu", "FLU") if stated.axes == "ned" else ("ned", "FRD")
    in_axes = f"the poses are in {axes.upper()}, of"
    of_camera, of_body = (
        f"world_from_{of}" if stated.inverse else f"{of}_from_world" for of in ("camera", "body")
    )
    exchanged = remedies.pose(cameras, moving, f"axes: {axes}")
    upside_down = remedies.pose(cameras, moving, remedies.upside_down)
    inverted = remedies.pose(cameras, moving, lambda poses: f"inverse: {str(not poses.inverse).lower()}")
    its_own = remedies.pose(cameras, moving, remedies.OF_CAMERA)
    the_body = remedies.pose(cameras, moving, remedies.OF_BODY)
    z = "up" if stated.z == "down" else "down"
    turned = carried_by(_ENU_FROM_NED @ body @ _FLU_FROM_FRD)
    camera_back, body_back = camera.mT, body.mT
    camera_origin, body_origin = (
        -np.einsum("ctij,ctj->cti", back, place) for back in (camera_back, body_back)
    )
    ned, below, swapped = place @ _ENU_FROM_NED.T, place * [1.0, 1.0, -1.0], place[..., [1, 0, 2]]
    on_body, own = camera @ _FLU_FROM_OPTICAL, body_back @ mounts
    table: list[tuple[str, str, str, Float, Float]] = [
        ("axes", "the positions have x and y exchanged", "", camera, swapped),
        ("convention", f"the poses are {of_camera}", inverted, camera_back, camera_origin),
        ("convention", f"the poses are {of_body}", inverted, carried_by(body_back), body_origin),
        ("convention", f"the attitudes are {of_camera}, the positions are not", "", camera_back, place),
        ("convention", f"the attitudes are {of_body}, the positions are not", "", own, place),
        ("convention", "the poses are of the body, and are taken for the camera's", the_body, on_body, place),
        ("convention", "the poses are of the camera, and are taken for the body's", its_own, body, place),
    ]
    if np.nanmedian(place[moving, :, 2]) < 0:  # nobody takes off far above where they fly
        what = f"the positions count z {z}wards, the attitudes do not"
        table.append(("axes", what, upside_down, camera, below))
    held = [cameras[index].entry.poses for index in moving]
    if any(poses.mount or poses.in_gimbal for poses in held):
        table.append(("axes", f"{in_axes} a body with {frame} axes", exchanged, turned, ned))
    if any(poses.mount is None for poses in held):
        table.append(("axes", f"{in_axes} the camera", exchanged, _ENU_FROM_NED @ camera, ned))
    if any(poses.mount for poses in held):
        # Of poses of the camera itself, it would be a roll by 180 deg.
        remedy = remedies.mount(cameras, moving, before=_FLU_FROM_FRD)
        what = "the body's axes are FRD (forward, right, down)"
        table.append(("axes", what, remedy, body @ _FLU_FROM_FRD @ mounts, place))
    for attitudes, of_cameras in ((camera, np.asarray), (body, carried_by)):
        quaternion = quaternion_from_matrix(np.where(np.isfinite(attitudes), attitudes, np.eye(3)))
        for roll, order in ((-1, "wxyz"), (1, "xyzw")):
            turned = matrix_from_quaternion(np.roll(quaternion, roll, axis=-1))
            remedy = remedies.pose(cameras, moving, f"quaternion: {order}")
            what = f"the quaternions are written as {' '.join(order)}"
            table.append(("convention", what, remedy, of_cameras(turned), place))
    for code, what, remedy, rotation, position in table:
        yield Posed(
            code, what, remedy or f"write the log again, since {what}", rotation, position, kind, price
        )


def _bodies(trial: Trial, moving: Sequence[int]) -> tuple[Float, dict[int, str | None]]:
    """Return the attitudes of bodies [C, T, 3, 3], and what gimbals' angles are relative to."""
    body, on_gimbal = trial.described.rotation @ trial.mounts.mT, {}
    for index in moving:
        own = _body(trial, index)
        if own is not None:
            body[index] = own
            on_gimbal[index] = trial.cameras[index].entry.poses.gimbal
    return body, on_gimbal


def _units(trial: Trial, kind: Sequence[int] | None) -> Iterator[Posed]:
    """Try other units of the logged positions, of cameras as in `_conventions`."""
    moving = trial.moving if kind is None else kind
    price = PRICE_OF_ALL if kind is None else PRICE_OF_ONE
    camera, place = trial.described.rotation, trial.described.position
    whose = "" if kind is None else f" of {', '.join(trial.named(kind))}"
    # Lever arms are stated in metres, whatever the log's unit.
    levers = np.array([each.lever_m for each in trial.cameras])
    arms = np.einsum("ctij,cj->cti", _bodies(trial, moving)[0], levers)
    for name, metres in _UNITS_M.items():
        what, again = f"the positions{whose} are in {name}", f", and {1 / metres:.4g} times what is read"
        for unit, factor, known in ((name, metres, ""), ("m", 1 / metres, again)):
            shown = what.replace(f"in {name}", f"in {unit}") + known
            remedy = remedies.pose(trial.cameras, moving, f"unit: {unit}")
            there = (place - arms) * factor + arms
            yield Posed("unit", shown, remedy, camera, there, kind, price, same_scatter=kind is None)


def _keypoints(trial: Trial) -> Iterator[Alternative]:
    """Try keypoints of pictures of another size, and mirrored ones: of all cameras, then of each."""

    def x(pixels: Float, own: Filmed) -> Float:
        return np.stack([own.intrinsics.width - 1 - pixels[..., 0], pixels[..., 1]], axis=-1)

    def y(pixels: Float, own: Filmed) -> Float:
        return np.stack([pixels[..., 0], own.intrinsics.height - 1 - pixels[..., 1]], axis=-1)

    for group, price in trial.groups(trial.every):
        one = len(group) < len(trial.names)
        whose = f" of {trial.names[group[0]]}" if one else ""
        rows: list[tuple[str, str, str, float, Callable[[Float, Filmed], Float]]] = [
            (
                "keypoints_size",
                f"the keypoints{whose} are of pictures {1 / factor:.3g} times as large",
                remedies.keypoints_size(trial.cameras, group, 1 / factor),
                0.0,
                partial(lambda factor, pixels, _: pixels * factor, factor),
            )
            for factor in _SIZE_FACTORS
        ]
        of_pictures = f"the pictures{whose} were mirrored before the keypoints were found"
        flips = [
            ("true", of_pictures, 0.0, lambda pixels, own: x(pixels, own)[:, _LEFT_RIGHT]),
            ("x", f"the keypoints{whose} count x from the right", 0.0, x),
        ]
        if not one:  # a detector names and counts alike in all pictures
            names = "left and right are exchanged in the names of joints"
            flips.append(("y", "the keypoints count y from below", 0.0, y))
            flips.append(("names", names, 0.3, lambda pixels, _: pixels[:, _LEFT_RIGHT]))
        for value, what, dearer, change in flips:
            rows.append(("mirrored", what, remedies.mirrored(trial.cameras, group, value), dearer, change))
        for code, what, remedy, dearer, change in rows:
            scene = trial.with_pixels(group, change)
            yield Alternative(code, trial.named(group), what, remedy, price + dearer, scene)


# --- alternatives with numbers, which are fitted ---------------------------------------------------------

NUMBERS = {"shift": 3, "heading": 1, "north": 1, "zero": 4, "pitch": 1, "roll": 1, "focal": 1}
"""Numbers of a description that may be wrong, and how many of them each alternative sets free.

`shift`: the log has its zero elsewhere; `north`: it has its north elsewhere; `zero`: both. `heading`,
`pitch`, `roll`: the camera is turned where it is, about the vertical or its own x and z axes. `focal`: its
focal length is another; the number is then the logarithm of the factor.
"""

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
        position[chosen] = position[chosen] + numbers[:3]
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


def _matters(trial: Trial, kind: str, group: Sequence[int], numbers: Float) -> bool:
    """Test if numbers are beyond what is stated of the errors of the poses, and large enough to matter."""
    position_m, rotation_rad = LEAST_SIGMAS * trial.described.sigma[list(group), :2].max(axis=0)
    if kind == "focal":
        return abs(float(numbers[0])) >= _LEAST_ZOOM
    shift_m = float(np.linalg.norm(numbers[:3])) if NUMBERS[kind] >= 3 else 0.0
    turn_rad = abs(float(numbers[-1])) if kind != "shift" else 0.0
    return bool(shift_m >= max(position_m, _LEAST_SHIFT_M) or turn_rad >= max(rotation_rad, _LEAST_TURN_RAD))


def _is_sure(numbers: Float, covariance: Float) -> bool:
    """Test if fitted numbers differ from zero, by their own covariance."""
    return float(numbers @ np.linalg.pinv(covariance) @ numbers) > _LEAST_OWN_SIGMAS**2


def _numbers(trial: Trial, kind: str, group: list[int]) -> Numbers:
    """Set numbers of some cameras free, from where the rays miss each other least."""
    degrees = list(_STARTS_DEG.get(kind, range(-180, 180, 15)))
    starts = np.zeros((len(degrees), NUMBERS[kind]))
    starts[:, -1] = np.radians(degrees)
    return Numbers(
        lambda numbers: changed(trial.described, kind, group, numbers),
        starts,
        lambda numbers, covariance: _of_numbers(trial, kind, group, numbers, covariance),
    )


def _of_numbers(
    trial: Trial, kind: str, group: list[int], numbers: Float, covariance: Float
) -> Alternative | None:
    """State fitted numbers and their remedy; None if they are too small to matter."""
    if not _is_sure(numbers, covariance) or not _matters(trial, kind, group, numbers):
        return None
    cameras, whose, number = trial.cameras, trial.whose(group), float(numbers[-1])
    degrees = float(np.degrees(number)) if kind != "shift" else 0.0
    shift = numbers[:3] if NUMBERS[kind] >= 3 else np.zeros(3)
    far = f"{np.linalg.norm(shift):.1f} m"
    what = {
        "shift": f"the log of {whose} has its zero {far} from the world's",
        "north": f"the log of {whose} has its north {degrees:+.0f} deg from the world's",
        "zero": f"the log of {whose} has its zero {far} and its north {degrees:+.0f} deg from the world's",
        "heading": f"the heading of {whose} is {degrees:+.0f} deg from what is logged",
        "pitch": f"{whose} looks {abs(degrees):.0f} deg {'higher' if degrees > 0 else 'lower'} than stated",
        "roll": f"{whose} is rolled by {degrees:+.0f} deg about the optical axis",
        "focal": f"the focal length of {whose} is {zoom(number):.3g} times what is stated",
    }[kind]
    if kind == "focal":
        code, remedy = "intrinsics", remedies.intrinsics(cameras, group, zoom(number))
    elif kind in ("shift", "north", "zero"):
        code, remedy = "origin", remedies.origin(cameras, group[0], shift, np.radians(degrees))
    elif kind == "heading":
        code, remedy = "pose", _turned_about_vertical(trial, group, number)
    else:
        turn = turn_about("x" if kind == "pitch" else "z", degrees)
        code, remedy = "mount", remedies.mount(cameras, group, after=turn)
    variance = np.diag(covariance)
    evidence = {}
    if NUMBERS[kind] >= 3:
        evidence["shift_sigma_m"] = round(float(np.sqrt(variance[:3].sum())), 2)
    if kind not in ("shift", "focal") and variance.size:
        evidence["turn_sigma_deg"] = round(float(np.degrees(np.sqrt(variance[-1]))), 2)
    price = PRICE_OF_ONE if len(group) < len(trial.names) else _OF_ALL[kind]
    return Alternative(code, trial.named(group), what, remedy, price, evidence=evidence)


def _turned_about_vertical(trial: Trial, group: Sequence[int], angle_rad: float) -> str:
    """Turn mounts about the vertical as the cameras see it on average: they, and drones, are tilted."""
    vertical = np.nansum(trial.described.rotation[:, :, 2], axis=1)
    vertical /= np.maximum(np.linalg.norm(vertical, axis=1, keepdims=True), 1e-9)
    turns = matrix_from_quaternion(quaternion_from_rotation_vector(angle_rad * vertical))
    return "; ".join(remedies.mount(trial.cameras, [index], after=turns[index]) for index in group)


def own_origins(trial: Trial, cameras: tuple[str, ...], what: str) -> Numbers:
    """Place the logs of all drones, of which each counts from a place of its own.

    The search begins where each camera by itself sees a person of usual stature: as far away as they are
    tall in its pictures. Without a logged actor, the world is that of the first log.
    """
    flight, scene = trial.flight, trial.described
    moved = (
        trial.moving if flight.hips is not None or len(trial.moving) < len(trial.names) else trial.moving[1:]
    )
    hips = [JOINTS.index("left_hip"), JOINTS.index("right_hip")]
    away_m = scene.focal_px * STATURE_M * _NOSE_TO_ANKLES / np.maximum(scene.person_px, 1.0)
    rays = np.concatenate([scene.rays[:, :, hips], np.ones((*scene.rays.shape[:2], 2, 1))], axis=-1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).mean(axis=2)
    seen = scene.position + away_m[:, None, None] * np.einsum("ctij,ctj->cti", scene.rotation, rays)
    apart = (seen[0] if flight.hips is None else flight.hips) - seen
    start = [np.nanmedian(apart[i], axis=0) if np.isfinite(apart[i]).any() else np.zeros(3) for i in moved]

    def make(numbers: Float) -> SceneOfMoments:
        position = scene.position.copy()
        position[moved] += numbers.reshape(-1, 1, 3)
        return replace(scene, position=position)

    def alternative(numbers: Float, covariance: Float) -> Alternative | None:
        matters = all(_matters(trial, "shift", moved, shift) for shift in numbers.reshape(-1, 3))
        if not matters or not _is_sure(numbers, covariance):
            return None
        shifts = np.zeros((len(trial.names), 3))
        shifts[moved] = numbers.reshape(-1, 3)
        sigma_m = np.sqrt(np.diag(covariance).reshape(-1, 3).sum(axis=1)).max() if covariance.size else 0.0
        remedy, evidence = remedies.own_origins(trial.cameras, shifts), {"shift_sigma_m": round(sigma_m, 2)}
        return Alternative(
            "origin", cameras, what, remedy, PRICE_OF_ALL, same_scatter=True, evidence=evidence
        )

    return Numbers(make, np.concatenate(start)[None], alternative)


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
        tried = []
        for factor in _NOISE_FACTORS:
            sigma = trial.described.sigma.copy()
            sigma[group] *= factor
            tried.append(
                Alternative(
                    "pose" if whose else "noise",
                    trial.named(group),
                    f"errors of the poses{whose} are larger than {stated}, about {factor:g} times",
                    remedies.pose_noise(trial.cameras, group, factor),
                    np.inf,
                    replace(trial.described, sigma=sigma),
                )
            )
        yield tried
