"""Mistakes that a flight's description can hold, each as the scene that undoes it.

A hypothesis has a penalty that grows with its freedom: a discrete one costs 0.5, one number of one camera 1.2
and more, so that what explains equally well with less freedom is named first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.mounting import level_heading
from pipelines.geometry.poses import interpolate_poses, matrix_from_quaternion, quaternion_from_matrix
from pipelines.reconstruction.doubts import remedies
from pipelines.reconstruction.doubts.scene import JOINTS, Sampled, SceneOfMoments, scene_of
from pipelines.reconstruction.doubts.score import (
    STATURE_M,
    Base,
    Score,
    score,
    solve,
    trunk_direction,
)

RATES = (25 / 30, 24 / 30, 30 / 25, 30 / 24, 2.0, 0.5)
"""Factors between frame rates that are mistaken for each other: 25 for 30, 24 for 30, half and double."""

TIMES = ("clock", "frame_rate")
"""Codes of what is tried on every flight."""

LEAST_GAIN_OF_TIMES = 1.0
"""Score that clocks and frame rates must gain to be scored exactly: half of what their margin asks."""

_FLU_FROM_OPTICAL = matrix_from_quaternion(np.array([-0.5, 0.5, -0.5, 0.5]))
_ENU_FROM_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_FLU_FROM_FRD = np.diag([1.0, -1, -1])
_BODY_AXES = {"enu": "FLU", "ned": "FRD"}
_FOCAL_FACTORS = (0.5, 2.0, 2 / 3, 1.5, 0.75, 4 / 3)  # calibrations of pictures of another size, or cropped
# Hypotheses whose scores are farther from the best need no exact score.
_SPARE = 2.0
# Beside a value of the grid that is worse than the description by more than this lies no better one.
_REACH = 10.0
# The grid of clocks is finer, and so is this limit.
_REACH_OF_TIMES = 1.0
# The statures of 95 % of grown-ups differ by less than this logarithm.
_USUAL_STATURE = 0.17
# Clocks that are off by more leave no pictures in common in short flights.
_LONGEST_CLOCK_S = 3.0
# Smaller offsets cannot be told from noise by the score.
_LEAST_CLOCK_S = 0.05
# Focal lengths that are wrong by less cannot be told from noise by the score.
_LEAST_OCTAVES = 0.15
_LEFT_RIGHT = [
    JOINTS.index(name.replace("left", "@").replace("right", "left").replace("@", "right")) for name in JOINTS
]


@dataclass(frozen=True)
class Hypothesis:
    """A mistake, the scene without it, and its score."""

    code: str
    cameras: tuple[str, ...]
    what: str
    remedy: str
    penalty: float
    scene: SceneOfMoments | None
    score: Score | None = None
    same_scatter: bool = False
    cost: float = np.inf  # chi^2 of a fitted fault, with 2 for each of its numbers
    sigmas: Mapping[str, float] = field(default_factory=dict)  # of its numbers, as evidence has them
    alike: tuple[float, float] | None = None  # of times of all cameras: seconds late, and factor between them

    @property
    def total(self) -> float:
        """The score with the penalty; what is seen directly, without a scene, wins over everything."""
        return -np.inf if self.score is None else self.score.total + self.penalty


class Trial:
    """The flight as described, with which hypotheses are made and scored."""

    def __init__(self, flight: Sampled, described: SceneOfMoments, base: Base) -> None:
        self.flight = flight
        self.described = described
        self.base = base
        self.best_total = base.total
        self.names = tuple(camera.name for camera in flight.cameras)
        self.every = range(len(self.names))
        self.moving = [index for index, camera in enumerate(flight.cameras) if not camera.static]

    def scored(self, hypothesis: Hypothesis) -> Hypothesis:
        """Score a hypothesis."""
        if hypothesis.scene is None:
            return hypothesis
        least = LEAST_GAIN_OF_TIMES if hypothesis.code in TIMES else -_SPARE
        found = score(
            self.flight,
            hypothesis.scene,
            self.base,
            same_scatter=hypothesis.same_scatter,
            limit=min(self.best_total + _SPARE, self.base.total - least),
        )
        scored = replace(hypothesis, score=found)
        self.best_total = min(self.best_total, scored.total)
        return scored

    def best(
        self,
        make: Callable[[float], Hypothesis],
        low: float,
        high: float,
        count: int,
        least: float,
        reach: float = _REACH,
    ) -> Hypothesis | None:
        """Search the value of a hypothesis with one number: a grid, then a golden section about its best.

        Returns:
            None if the best value is smaller than `least`: noise as stated explains that.
        """
        grid = np.linspace(low, high, count)
        tried = [self.scored(make(float(value))) for value in grid]
        best = min(range(count), key=lambda index: tried[index].total)
        chosen, at = tried[best], float(grid[best])
        if np.isfinite(chosen.total) and chosen.total < self.base.total + reach:
            inner, value = self._golden(
                make, float(grid[max(best - 1, 0)]), float(grid[min(best + 1, count - 1)])
            )
            if inner.total < chosen.total:
                chosen, at = inner, value
        return chosen if abs(at) >= least else None

    def _golden(
        self, make: Callable[[float], Hypothesis], low: float, high: float
    ) -> tuple[Hypothesis, float]:
        ratio = (np.sqrt(5) - 1) / 2
        left, right = high - ratio * (high - low), low + ratio * (high - low)
        at_left, at_right = self.scored(make(left)), self.scored(make(right))
        for _ in range(12):
            if at_left.total < at_right.total:
                high, right, at_right = right, left, at_left
                left = high - ratio * (high - low)
                at_left = self.scored(make(left))
            else:
                low, left, at_left = left, right, at_right
                right = low + ratio * (high - low)
                at_right = self.scored(make(right))
        return (at_left, left) if at_left.total < at_right.total else (at_right, right)

    # --- scenes that differ in one thing ----------------------------------------------------------------

    def turned_in_camera(self, turn: Float, cameras: Sequence[int]) -> SceneOfMoments:
        """Turn cameras [3, 3] about their own axes."""
        return self._rotated(lambda _, rotation: rotation @ turn, cameras)

    def turned_in_world(self, turn: Float, cameras: Sequence[int]) -> SceneOfMoments:
        """Turn cameras [3, 3] about the world's axes, where they are."""
        return self._rotated(lambda _, rotation: turn @ rotation, cameras)

    def turned_in_body(self, turn: Float, cameras: Sequence[int]) -> SceneOfMoments:
        """Turn cameras [3, 3] about the axes of the bodies that carry them."""
        return self._rotated(
            lambda index, rotation: rotation @ self.mount(index).T @ turn @ self.mount(index), cameras
        )

    def mount(self, index: int) -> Float:
        """Return body_from_camera [3, 3] of a camera; looking forwards where it is not fixed to a body."""
        stored = self.flight.cameras[index].mount
        return _FLU_FROM_OPTICAL if stored is None else stored

    def _rotated(self, turned: Callable[[int, Float], Float], cameras: Sequence[int]) -> SceneOfMoments:
        rotation = self.described.rotation.copy()
        for index in cameras:
            rotation[index] = turned(index, rotation[index])
        return self.described.with_rotation(rotation)

    def late(self, seconds: float, cameras: Sequence[int]) -> SceneOfMoments:
        """Add seconds to the times of cameras' pictures."""
        late_s = np.zeros(len(self.names))
        late_s[list(cameras)] = seconds
        return scene_of(self.flight, self.described, late_s=late_s)

    def as_stated(self, late_s: float, slower: float) -> tuple[Sampled, SceneOfMoments]:
        """Look at the pictures that another time of all cameras shows, at the times that are stated."""
        since = (self.flight.t_ns - self.flight.t_ns[0]) / slower - late_s * 1e9
        flight = self.flight._replace(t_ns=self.flight.t_ns[0] + since.astype(np.int64), hips=None)
        return flight, scene_of(flight)

    def focal(self, factor: float, cameras: Sequence[int]) -> SceneOfMoments:
        """Multiply the focal lengths of cameras."""
        rays, focal_px = self.described.rays.copy(), self.described.focal_px.copy()
        rays[list(cameras)] /= factor
        focal_px[list(cameras)] *= factor
        return replace(self.described, rays=rays, focal_px=focal_px)

    def with_pixels(
        self, change: Callable[[Float, Intrinsics], Float], cameras: Sequence[int]
    ) -> SceneOfMoments:
        """Change the pixels [F, J, 2] of cameras."""
        return scene_of(
            self.flight,
            self.described,
            pixels=[
                change(camera.pixels, camera.intrinsics) if index in cameras else camera.pixels
                for index, camera in enumerate(self.flight.cameras)
            ],
        )

    def shifted(self, scene: SceneOfMoments, index: int) -> tuple[SceneOfMoments, Float]:
        """Shift a camera [3] m to where its rays meet the others' best: linear, with a prior of 10 m."""
        solved = solve(scene)
        normals, distances = [], []
        for other in self.every:
            if other == index:
                continue
            normal = np.cross(solved.direction[index], solved.direction[other])
            length = np.linalg.norm(normal, axis=-1)
            used = solved.seen[index] & solved.seen[other] & (length > 0.1)
            unit = normal[used] / length[used][:, None]
            apart = np.broadcast_to((scene.position[index] - scene.position[other])[:, None, :], normal.shape)
            normals.append(unit)
            distances.append(-(unit * apart[used]).sum(axis=-1))
        design, right = np.concatenate(normals), np.concatenate(distances)
        shift = np.zeros(3)
        weight = np.ones(len(right))
        for _ in range(6 if len(right) else 0):
            weighted = design * weight[:, None]
            shift = np.linalg.solve(weighted.T @ design + 1e-5 * len(right) * np.eye(3), weighted.T @ right)
            weight = 1 / np.maximum(np.abs(design @ shift - right), 0.05)
        position = scene.position.copy()
        position[index] = position[index] + shift
        return replace(scene, position=position), shift

    def apart(self) -> SceneOfMoments:
        """Shift all cameras but the first that moves, each to where its rays meet the others' best."""
        scene = self.described
        for _ in range(8 if len(self.names) > 2 else 1):
            for index in self.moving[1:]:
                scene, _ = self.shifted(scene, index)
        return scene


def turn_about(axis: str, degrees: float) -> Float:
    """Return the rotation [3, 3] about an axis."""
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    if axis == "x":
        return np.array([[1.0, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])


# --- what is tried on every flight ---------------------------------------------------------------------


def of_times(trial: Trial) -> Iterator[Hypothesis]:
    """Try clocks of single cameras, and the frame rate of all."""
    described, names = trial.flight.cameras, trial.names
    for index in trial.every:
        found = trial.best(
            lambda seconds, index=index: Hypothesis(  # type: ignore[misc]
                "clock",
                pair_of(trial, [index]),
                f"the pictures of {names[index]} were taken {remedies.earlier_or_later(seconds)}",
                remedies.clock(described, [index], seconds),
                1.0 + abs(seconds) / 2,
                trial.late(seconds, [index]),
            ),
            -_LONGEST_CLOCK_S,
            _LONGEST_CLOCK_S,
            61,
            _LEAST_CLOCK_S,
            _REACH_OF_TIMES,
        )
        if found is not None:
            yield found
    groups = [
        (list(trial.every), "all cameras", 0.5),
        *(([index], names[index], 0.8) for index in trial.every),
    ]
    for group, said, penalty in groups:
        for factor in RATES:
            slower = np.ones(len(names))
            slower[group] = factor
            yield trial.scored(
                Hypothesis(
                    "frame_rate",
                    pair_of(trial, group),
                    f"the frame rate of {said} is {remedies.times_faster(factor)}",
                    remedies.frame_rate(described, group, factor),
                    penalty,
                    scene_of(trial.flight, trial.described, slower=slower),
                    alike=(0.0, factor) if len(group) == len(names) else None,
                )
            )


# --- what is tried where something is odd --------------------------------------------------------------


# Up is where neither people nor cameras say, if both say another direction that is this far from z.
LEAST_TILT_OF_WORLD_DEG = 40.0
# The trunk of somebody who does more than lie or stand points elsewhere in some pictures.
LEAST_STEADY_TRUNK = 0.7
# Upper edges of pictures must be higher by this cosine along the other direction.
LEAST_GAIN_OF_PICTURES = 0.25
# A direction this near to an axis is that axis, since people lean.
AXIS_WITHIN_DEG = 12.0
# Two in three grown-ups have a stature within this share of the usual one.
STATURE_SHARE = 0.09
_UNITS = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048}
_UPS = {
    f"{sign}{axis}": turn * np.eye(3)[k]
    for sign, turn in (("", 1), ("-", -1))
    for k, axis in enumerate("xyz")
}


def of_level(trial: Trial) -> Iterator[Hypothesis]:
    """Find a world whose z does not point up: people stand, and pictures are upright, along another axis.

    Both must say so: somebody may lie, and a camera may be rolled or look straight down.
    """
    up = trunk_direction(solve(trial.described).joints)
    steady = float(np.linalg.norm(up))
    if not steady > LEAST_STEADY_TRUNK:
        return
    up = up / steady
    tilt_deg = float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))
    edge = -trial.described.rotation[..., 1].reshape(-1, 3)  # of each picture, upwards
    higher = (edge @ (up - [0.0, 0.0, 1.0]))[np.isfinite(edge).all(axis=1)]
    gain = float(higher.mean()) if len(higher) else 0.0
    if tilt_deg < LEAST_TILT_OF_WORLD_DEG or gain < LEAST_GAIN_OF_PICTURES:
        return
    axis = max(_UPS, key=lambda name: float(_UPS[name] @ up))
    beside_deg = float(np.degrees(np.arccos(np.clip(_UPS[axis] @ up, -1, 1))))
    remedy = f"world.up: {axis}"
    if beside_deg > AXIS_WITHIN_DEG:
        remedy = remedies.turned_world(trial.flight.cameras, up)
    yield Hypothesis(
        "level",
        trial.names,
        f"the world's z does not point up: people and pictures are upright {tilt_deg:.0f} deg from it",
        remedy,
        0.0,
        None,
        sigmas={"tilt_deg": round(tilt_deg, 1), "beside_axis_deg": round(beside_deg, 1)},
    )


def of_scale(trial: Trial, stature: float) -> Hypothesis:
    """Scale all positions so that the person has a usual stature: rays that fit go on fitting."""
    factor, code = STATURE_M / stature, "scale"
    what = f"all positions are {1 / factor:.2g} times what they should be: the person is {stature:.3g} m tall"
    remedy, sigmas = f"world.scale: {factor:.3g}", {"scale_sigma_share": STATURE_SHARE}
    for unit, metres in _UNITS.items():
        if abs(np.log(factor / metres)) < STATURE_SHARE:
            factor, code, sigmas = metres, "unit", {}
            what, remedy = f"the positions are in {unit}", remedies.unit(trial.flight.cameras, unit)
    return Hypothesis(
        code,
        trial.names,
        what,
        remedy,
        0.5,
        replace(trial.described, position=trial.described.position * factor),
        same_scatter=True,
        sigmas=sigmas,
    )


def of_descriptions(trial: Trial) -> Iterator[Hypothesis]:
    """Try everything else."""
    for hypothesis in _discrete(trial):
        yield trial.scored(hypothesis)
    yield from _continuous(trial)


def _discrete(trial: Trial) -> Iterator[Hypothesis]:
    yield from _permuted(trial)
    yield from _mounted(trial)
    yield from _tilts_negated(trial)
    yield from _gimbals(trial)
    yield from _gimbals_of_others(trial)
    yield from _conventions(trial)
    yield from _pixels(trial)


def _permuted(trial: Trial) -> Iterator[Hypothesis]:
    names = trial.names
    if not 2 <= len(names) <= 5:
        return
    for order in permutations(trial.every):
        moved = [index for index in trial.every if order[index] != index]
        if moved:
            said = ", ".join(f"{names[index]} has those of {names[order[index]]}" for index in moved)
            yield Hypothesis(
                "videos_swapped",
                tuple(names[index] for index in moved),
                f"pictures are exchanged: {said}",
                remedies.videos(trial.flight.cameras, order),
                0.5 if len(names) == 2 else 0.8,  # of more cameras there are more ways
                scene_of(trial.flight, trial.described, order=order),
            )


def _mounted(trial: Trial) -> Iterator[Hypothesis]:
    """Try cameras that are rolled, or look another way, by right angles: all of them, then each."""
    groups = [(trial.moving, 0.5), *(([index], 0.8) for index in trial.moving)]
    for group, penalty in groups:
        if not group or (len(group) == 1 and penalty == 0.5):
            continue
        whose = _whose(trial, group)
        for degrees in (90, 180, 270):
            turn, side = turn_about("z", degrees), "left" if degrees <= 180 else "right"
            yield Hypothesis(
                "mount",
                tuple(trial.names[index] for index in group),
                f"{whose} rolled by {_signed(degrees)} deg about the optical axis",
                remedies.mount(trial.flight.cameras, group, _after(turn)),
                penalty,
                trial.turned_in_camera(turn, group),
            )
            yield Hypothesis(
                "mount",
                tuple(trial.names[index] for index in group),
                f"{whose} mounted {abs(_signed(degrees))} deg to the {side} of where it is said to look",
                remedies.mount(trial.flight.cameras, group, _before(turn)),
                penalty,
                trial.turned_in_body(turn, group),
            )


def _signed(degrees: int) -> int:
    """Return an angle of -180 to 180 deg."""
    return degrees if degrees <= 180 else degrees - 360


def _tilts_negated(trial: Trial) -> Iterator[Hypothesis]:
    """Try the other sign of `down_deg`, of all cameras whose mounts state one."""
    tilted = [index for index in trial.moving if abs(remedies.down_deg(trial.flight.cameras[index])) > 1]
    if tilted:
        cameras = trial.flight.cameras
        rotation = trial.described.rotation.copy()
        for index in tilted:
            rotation[index] = rotation[index] @ turn_about("x", 2 * remedies.down_deg(cameras[index]))
        yield Hypothesis(
            "mount",
            tuple(trial.names[index] for index in tilted),
            "the tilt of every camera has the wrong sign",
            "; ".join(
                remedies.mount(
                    cameras, [index], _after(turn_about("x", 2 * remedies.down_deg(cameras[index])))
                )
                for index in tilted
            ),
            0.5,
            trial.described.with_rotation(rotation),
        )


def _gimbals(trial: Trial) -> Iterator[Hypothesis]:
    """Try the other axes of gimbals' angles: tilts have the other sign, headings count the other way."""
    cameras = trial.flight.cameras
    entries = [camera.entry.poses for camera in cameras]
    turned = [i for i in trial.moving if entries[i].gimbal == "world" and not entries[i].gimbal_fixed]
    if turned:
        rotation = trial.described.rotation.copy()
        for index in turned:
            mount = trial.mount(index)
            rotation[index] = _ENU_FROM_NED @ rotation[index] @ mount.T @ _FLU_FROM_FRD @ mount
        axes = [cameras[index].entry.poses.gimbal_axes for index in turned]
        right = "enu" if axes[0] == "ned" else "ned"
        yield Hypothesis(
            "gimbal",
            tuple(trial.names[index] for index in turned),
            f"the gimbals' angles are in {right.upper()}: tilts have the wrong sign",
            "; ".join(f"cameras.{trial.names[index]}.gimbal.axes: {right}" for index in turned),
            0.5,
            trial.described.with_rotation(rotation),
        )


_MEANT = {
    "world": "relative to the world",
    "body": "relative to the body",
    "heading": "relative to the body's heading and the horizon",
}


def _gimbals_of_others(trial: Trial) -> Iterator[Hypothesis]:
    """Try gimbals' angles that are relative to something else: the world, the body, or its heading."""
    cameras = trial.flight.cameras
    logged = [index for index in trial.moving if cameras[index].camera.trajectory.body_xyzw is not None]
    stated = [index for index in logged if cameras[index].entry.poses.gimbal in _MEANT]
    turns = {index: _references(trial, index) for index in stated}
    for meant, said in _MEANT.items():
        turned = [index for index in stated if cameras[index].entry.poses.gimbal != meant]
        if not turned:
            continue
        rotation = trial.described.rotation.copy()
        for index in turned:
            of, axes = cameras[index].entry.poses.gimbal or "world", cameras[index].entry.poses.gimbal_axes
            known = np.swapaxes(turns[index][of, axes], -1, -2) @ rotation[index]
            rotation[index] = turns[index][meant, axes] @ known
        yield Hypothesis(
            "gimbal",
            tuple(trial.names[index] for index in turned),
            f"the gimbals' angles are {said}",
            "; ".join(f"cameras.{trial.names[index]}.gimbal.relative_to: {meant}" for index in turned),
            0.5,
            trial.described.with_rotation(rotation),
        )


def _references(trial: Trial, index: int) -> dict[tuple[str, str], Float]:
    """Return what turns the angles of a camera's gimbal [T, 3, 3], by what they are relative to and axes."""
    frames = _frames(_body(trial, index))
    in_ned = {name: _ENU_FROM_NED if name == "world" else _FLU_FROM_FRD for name in frames}
    return {(name, "enu"): frame for name, frame in frames.items()} | {
        (name, "ned"): frame @ in_ned[name] for name, frame in frames.items()
    }


def _body(trial: Trial, index: int) -> Float:
    """Return the attitudes [T, 3, 3] of the body that carries a camera on a gimbal."""
    track, t_ns = trial.flight.cameras[index].camera.trajectory, trial.flight.t_ns
    if track.body_xyzw is None:
        raise ValueError(f"{trial.names[index]} has no body")
    gap_ns = trial.flight.between.max_gap_ns
    xyzw = interpolate_poses(
        track.t_ns, track.position, track.body_xyzw, t_ns, max_gap_ns=gap_ns, max_extrapolation_ns=gap_ns
    )[1]
    return matrix_from_quaternion(xyzw)


def _frames(body: Float) -> dict[str, Float]:
    """Return what angles of a gimbal may be relative to [T, 3, 3], by name, on a body [T, 3, 3]."""
    level = level_heading(quaternion_from_matrix(np.where(np.isfinite(body), body, np.eye(3))))
    return {
        "world": np.broadcast_to(np.eye(3), body.shape),
        "body": body,
        "heading": np.where(np.isfinite(body), matrix_from_quaternion(level), np.nan),
    }


def _after(turn: Float) -> Callable[[Float], Float]:
    """Return what turns a mount about the camera's axes."""
    return lambda mount: mount @ turn


def _before(turn: Float) -> Callable[[Float], Float]:
    """Return what turns a mount about the body's axes."""
    return lambda mount: turn @ mount


def _whose(trial: Trial, group: Sequence[int]) -> str:
    return "every camera is" if len(group) == len(trial.names) else f"{trial.names[group[0]]} is"


def _conventions(trial: Trial) -> Iterator[Hypothesis]:
    """Try other meanings of the logged poses: axes, inverses, orders of quaternions, units."""
    if not trial.moving:
        return
    scene, names, cameras = trial.described, trial.names, trial.flight.cameras
    still = [index for index in trial.every if index not in trial.moving]

    def hypothesis(code: str, what: str, remedy: str, rotation: Float, position: Float) -> Hypothesis:
        rotation, position = rotation.copy(), position.copy()
        rotation[still], position[still] = scene.rotation[still], scene.position[still]
        changed = replace(scene, rotation=rotation, position=position)
        return Hypothesis(code, names, what, remedy or f"write the log again, since {what}", 0.5, changed)

    mounts = np.stack([trial.mount(index) for index in trial.every])[:, None]
    camera, place = scene.rotation, scene.position
    body = camera @ np.swapaxes(mounts, -1, -2)
    for index in trial.moving:
        if cameras[index].camera.trajectory.body_xyzw is not None:
            body[index] = _body(trial, index)

    def carried_by(bodies: Float) -> Float:
        """Return the attitudes [C, T, 3, 3] of the cameras on bodies that are turned otherwise."""
        turned = bodies @ mounts
        for index in trial.moving:
            of = cameras[index].entry.poses.gimbal
            if of is not None and cameras[index].camera.trajectory.body_xyzw is not None:
                before, after = _frames(body[index])[of], _frames(bodies[index])[of]
                turned[index] = after @ np.swapaxes(before, -1, -2) @ camera[index]
        return turned

    camera_inverse, body_inverse = np.swapaxes(camera, -1, -2), np.swapaxes(body, -1, -2)
    stated = cameras[trial.moving[0]].entry.poses
    inverse, z = stated.inverse, "up" if stated.z == "down" else "down"
    # The exchange of axes is its own inverse.
    right_axes = "enu" if stated.axes == "ned" else "ned"
    yield from (
        hypothesis(
            "axes",
            f"the poses are in {right_axes.upper()}, of a body with {_BODY_AXES[right_axes]} axes",
            remedies.pose(cameras, f"axes: {right_axes}"),
            carried_by(_ENU_FROM_NED @ body @ _FLU_FROM_FRD),
            place @ _ENU_FROM_NED.T,
        ),
        hypothesis(
            "axes",
            f"the poses are in {right_axes.upper()}, of the camera",
            remedies.pose(cameras, f"axes: {right_axes}"),
            _ENU_FROM_NED @ camera,
            place @ _ENU_FROM_NED.T,
        ),
        hypothesis(
            "axes",
            f"the positions count z {z}wards, the attitudes do not",
            remedies.upside_down(cameras),
            camera,
            place * [1.0, 1.0, -1.0],
        ),
        hypothesis("axes", "the positions have x and y exchanged", "", camera, place[..., [1, 0, 2]]),
        hypothesis(
            "convention",
            f"the poses are {_read('camera', inverse)}",
            remedies.inverse(cameras),
            camera_inverse,
            -np.einsum("ctij,ctj->cti", camera_inverse, place),
        ),
        hypothesis(
            "convention",
            f"the poses are {_read('body', inverse)}",
            remedies.inverse(cameras),
            carried_by(body_inverse),
            -np.einsum("ctij,ctj->cti", body_inverse, place),
        ),
        hypothesis(
            "convention",
            f"the attitudes are {_read('camera', inverse)}, the positions are not",
            "",
            camera_inverse,
            place,
        ),
        hypothesis(
            "convention",
            f"the attitudes are {_read('body', inverse)}, the positions are not",
            "",
            body_inverse @ mounts,
            place,
        ),
        hypothesis(
            "convention",
            "the poses are of the body, and are taken for the camera's",
            remedies.of_body(cameras),
            camera @ _FLU_FROM_OPTICAL,
            place,
        ),
        hypothesis(
            "convention",
            "the poses are of the camera, and are taken for the body's",
            remedies.of_camera(cameras),
            body,
            place,
        ),
    )
    if any(cameras[index].entry.poses.mount is not None for index in trial.moving):
        # Of poses of the camera itself, it would be a roll by 180 deg.
        yield hypothesis(
            "axes",
            "the body's axes are FRD (forward, right, down)",
            remedies.mount(cameras, trial.moving, lambda mount: _FLU_FROM_FRD @ mount),
            body @ _FLU_FROM_FRD @ mounts,
            place,
        )
    for attitudes, of_cameras in ((camera, np.asarray), (body, carried_by)):
        quaternion = quaternion_from_matrix(np.where(np.isfinite(attitudes), attitudes, np.eye(3)))
        for roll, order in ((-1, "wxyz"), (1, "xyzw")):
            turned = matrix_from_quaternion(np.roll(quaternion, roll, axis=-1))
            yield hypothesis(
                "convention",
                f"the quaternions are written as {' '.join(order)}",
                remedies.pose(cameras, f"quaternion: {order}"),
                of_cameras(turned),
                place,
            )
    # Lever arms are stated in metres, whatever the log's unit.
    levers = np.array([camera.lever_m for camera in cameras])
    arms = np.einsum("ctij,cj->cti", body, levers)
    arms[still] = place[still]
    for factor, unit in (
        (0.3048, "ft"),
        (1e-3, "mm"),
        (1e-2, "cm"),
        (1 / 0.3048, "m"),
        (1e3, "m"),
        (1e2, "m"),
    ):
        known = f"the positions are in {unit}"
        yield Hypothesis(
            "unit",
            names,
            known if factor < 1 else f"{known}, and {factor:.4g} times what is read",
            remedies.pose(cameras, f"unit: {unit}"),
            0.5,
            replace(scene, position=(place - arms) * factor + arms),
            same_scatter=True,
        )


def _read(of: str, inverse: bool) -> str:
    """Return how poses are written that were read as inverse, or not, by mistake."""
    return f"world_from_{of}" if inverse else f"{of}_from_world"


def _pixels(trial: Trial) -> Iterator[Hypothesis]:
    """Try keypoints of pictures of another size, and mirrored ones: of all cameras, then of each."""
    names, cameras, every = trial.names, trial.flight.cameras, list(trial.every)
    groups = [(every, ""), *(([index], f" of {names[index]}") for index in every)]

    def larger(factor: float) -> Callable[[Float, Intrinsics], Float]:
        return lambda pixels, _: pixels * factor

    def x(pixels: Float, own: Intrinsics) -> Float:
        return np.stack([own.width - 1 - pixels[..., 0], pixels[..., 1]], axis=-1)

    def y(pixels: Float, own: Intrinsics) -> Float:
        return np.stack([pixels[..., 0], own.height - 1 - pixels[..., 1]], axis=-1)

    def both(pixels: Float, own: Intrinsics) -> Float:
        return x(pixels, own)[:, _LEFT_RIGHT]

    def renamed(pixels: Float, _: Intrinsics) -> Float:
        return pixels[:, _LEFT_RIGHT]

    for group, whose in groups:
        dearer = 0.3 * (len(group) < len(every))
        named = tuple(names[index] for index in group)
        for factor in (2.0, 0.5, 1.5, 2 / 3, 3.0, 1 / 3):
            yield Hypothesis(
                "keypoints_size",
                named,
                f"the keypoints{whose} are of pictures {1 / factor:.3g} times as large",
                remedies.keypoints_size(cameras, group, 1 / factor),
                0.5 + dearer,
                trial.with_pixels(larger(factor), group),
            )
        for what, value, penalty, change in (
            (f"the pictures{whose} were mirrored before the keypoints were found", "true", 0.5, both),
            (f"the keypoints{whose} count x from the right", "x", 0.5, x),
            (f"the keypoints{whose} count y from below", "y", 0.5, y),
            (f"left and right are exchanged in the names of joints{whose}", "names", 0.8, renamed),
        ):
            if dearer and value in ("y", "names"):
                continue  # a detector names and counts alike in all pictures
            yield Hypothesis(
                "mirrored",
                named,
                what,
                remedies.mirrored(cameras, group, value),
                penalty + dearer,
                trial.with_pixels(change, group),
            )


def _continuous(trial: Trial) -> Iterator[Hypothesis]:
    for found in _each_number(trial):
        if found is not None:
            yield found
    if len(trial.names) > 2 and trial.moving:
        scene = trial.apart()
        yield trial.scored(
            Hypothesis(
                "origin",
                trial.names,
                "every log counts positions from a place of its own",
                remedies.own_origins(
                    trial.flight.cameras, np.nanmedian(scene.position - trial.described.position, axis=1)
                ),
                1.1 * (len(trial.moving) - 1),
                scene,
            )
        )


def _each_number(trial: Trial) -> Iterator[Hypothesis | None]:
    cameras, names, every = trial.flight.cameras, trial.names, list(trial.every)
    sigma = trial.described.sigma
    least_deg = max(3.0, 4 * float(np.degrees(sigma[:, 1].max())))

    def focal(group: list[int], penalty: float) -> Callable[[float], Hypothesis]:
        return lambda octaves: Hypothesis(
            "intrinsics",
            tuple(names[index] for index in group),
            f"the focal length of {_said(names, group)} is {2**octaves:.3g} times what is stated",
            remedies.intrinsics(cameras, group, 2**octaves),
            penalty,
            trial.focal(2**octaves, group),
        )

    def pitch(group: list[int], penalty: float) -> Callable[[float], Hypothesis]:
        return lambda degrees: Hypothesis(
            "mount",
            tuple(names[index] for index in group),
            f"{_said(names, group)} looks {abs(degrees):.0f} deg {higher_or_lower(degrees)} than stated",
            remedies.mount(cameras, group, lambda mount: mount @ turn_about("x", degrees)),
            penalty,
            trial.turned_in_camera(turn_about("x", degrees), group),
        )

    def heading(group: list[int], penalty: float) -> Callable[[float], Hypothesis]:
        return lambda degrees: Hypothesis(
            "pose",
            pair_of(trial, group),
            f"the heading of {_said(names, group)} is {degrees:+.0f} deg from what is logged"
            + relative_to(trial, group),
            remedies.mount(cameras, group, lambda mount: turn_about("z", degrees) @ mount),
            penalty,
            trial.turned_in_world(turn_about("z", degrees), group),
        )

    for factor in _FOCAL_FACTORS:
        yield trial.scored(focal(every, 0.5)(float(np.log2(factor))))
    yield trial.best(focal(every, 1.0), -1.5, 1.5, 19, _LEAST_OCTAVES)
    if trial.moving:
        moving = trial.moving
        yield trial.best(pitch(moving, 1.0), -90, 90, 37, least_deg)
        yield trial.best(heading(moving, 2.2), -180, 170, 36, least_deg)
        yield trial.best(
            lambda seconds: Hypothesis(
                "clock",
                names,
                f"the pictures of all cameras were taken {remedies.earlier_or_later(seconds)}",
                remedies.clock(cameras, every, seconds),
                1.0 + abs(seconds) / 2,
                trial.late(seconds, every),
                alike=(seconds, 1.0),
            ),
            -_LONGEST_CLOCK_S,
            _LONGEST_CLOCK_S,
            31,
            _LEAST_CLOCK_S,
        )


def higher_or_lower(degrees: float) -> str:
    """Say which way a turn about a camera's x axis tilts it."""
    return "higher" if degrees > 0 else "lower"


def _said(names: Sequence[str], group: Sequence[int]) -> str:
    return "every camera" if len(group) == len(names) else names[group[0]]


def pair_of(trial: Trial, group: Sequence[int]) -> tuple[str, ...]:
    """Name the cameras of a group; of two cameras both, since neither can be told to be the wrong one."""
    return trial.names if len(trial.names) == 2 else tuple(trial.names[index] for index in group)


def relative_to(trial: Trial, group: Sequence[int]) -> str:
    """Say of one of two cameras that the other may be the wrong one."""
    if len(trial.names) == 2 and len(group) == 1:
        return f" (relative to {trial.names[1 - group[0]]}: either may be wrong)"
    return ""
