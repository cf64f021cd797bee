"""One arm of a comparison: its flight, replayed or logged, what its cameras measure, its table rows.

Measurements are simulated. The visibility of joints is exact, by field of view and map. The errors of the
detector and of the logged poses are random, with the same seeds for every arm of a comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Float32, Int64
from pipelines.geometry.cameras import Intrinsics, project, undistort
from pipelines.geometry.noise import NoiseModel, disturb, sum_sigma
from pipelines.geometry.poses import invert, look_at, matrix_from_quaternion, rates, transform
from pipelines.geometry.triangulation import Views, triangulate
from pipelines.planning.arms import Arm
from pipelines.planning.distance_field import DistanceField, MapsInTurn, looked, visible
from pipelines.planning.forecast import ActorFilter, PeopleFilter
from pipelines.planning.formation import TILT, YAW, slot_of
from pipelines.planning.loading import planned_positions
from pipelines.planning.replay import Start, replay
from pipelines.planning.scene import ReplayScene
from pipelines.planning.scores import errors_of_views, hidden_by_people, sights

if TYPE_CHECKING:
    import pandas as pd


FLOWN = "flown"
"""Name of the arm that is no planner: the flight in the log."""
PLANNED = "planned"
"""Name of the other arm that is no planner: the commands of the planner on board, as logged."""
LOGGED = (FLOWN, PLANNED)

# The same standard deviation of a good keypoint is the first guess of `mocap reconstruct`.
PIXEL_SIGMA_PX = 3.0
# Keypoints below this confidence are left out, as in `mocap reconstruct`.
MIN_CONFIDENCE = 0.3

_POSITION = ["x", "y", "z"]
_QUATERNION = ["qx", "qy", "qz", "qw"]
_SLOT = ["slot_yaw_rad", "slot_tilt_rad", "slot_range_m"]


@dataclass(frozen=True)
class ArmFlight:
    """Poses of the N cameras of an arm at the T times of the scene."""

    names: tuple[str, ...]
    position: Float  # [N, T, 3] m, world
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera
    slots: Float  # [N, T, 3] commanded yaw (rad, continuous), tilt (rad), range (m); NaN for `flown`
    aim: Float  # [N, T, P] shares of people in the place that each camera films
    known: Bool  # [N, T] False where a log has a gap and the position goes straight on
    safety: dict[str, int]  # local plannings by `guard.FlownMotion`; empty for logged arms


def logged_arm(scene: ReplayScene, name: str) -> ArmFlight:
    """Return the flight of one of `LOGGED`.

    The drones of `planned` are exactly at their commanded positions. Each has its own camera. The camera
    looks at the actor as the Kalman filter estimates it from the log, as in a replay.
    """
    if name == FLOWN:
        position, quaternion, known = scene.flown
        names = tuple(camera.name for camera in scene.flight.cameras)
        slots = np.full_like(position, np.nan)
        return ArmFlight(names, position, quaternion, slots, _on_the_middle(scene, known), known, {})
    position, known = planned_positions(scene.flight, scene.t_ns)
    estimates = _estimates(scene)
    slots = slot_of(position - estimates)
    slots[..., YAW] = np.unwrap(slots[..., YAW], axis=1)
    aim = _on_the_middle(scene, known)
    return ArmFlight(
        tuple(scene.flight.planned), position, look_at(position, estimates), slots, aim, known, {}
    )


def _on_the_middle(scene: ReplayScene, known: Bool) -> Float:
    """Return the aim [N, T, P] of cameras that film the weighted middle."""
    return np.broadcast_to(scene.weights, (*known.shape, len(scene.weights)))


def aimed_at(scene: ReplayScene, flown: ArmFlight) -> Float:
    """Compute the places [N, T, 3] that the cameras film, by the reference of the scores."""
    places: Float = np.einsum("ntp,ptx->ntx", flown.aim, scene.people)
    return places


def seen_people(scene: ReplayScene, flown: ArmFlight) -> Bool:
    """Test [P, N, T] who is seen from which camera."""
    return sights(flown.position, looks_rad(flown), scene.people, scene.maps, scene.config)


def looks_rad(flown: ArmFlight) -> Float:
    """Compute the yaw [N, T] of the optical axes from east."""
    axis = matrix_from_quaternion(flown.quaternion_xyzw)[..., 2]
    yaw: Float = np.arctan2(axis[..., 1], axis[..., 0])
    return yaw


def _estimates(scene: ReplayScene) -> Float:
    """Estimate the actor's positions [T, 3] as planners do, from no later measurement."""
    flight, config = scene.flight, scene.config
    each = [ActorFilter(q=config.actor_q, sigma_m=config.tuning.actor_sigma_m) for _ in scene.people]
    actor, known = PeopleFilter(each, scene.weights), np.isfinite(flight.actor[..., 0])
    log_s = (flight.actor_t_ns - flight.actor_t_ns[0]) / 1e9
    until = np.searchsorted(flight.actor_t_ns, scene.t_ns, side="right")
    found, taken = np.empty((len(scene.t_ns), 3)), 0
    for k, t_s in enumerate((scene.t_ns - flight.actor_t_ns[0]) / 1e9):
        for row, person in np.argwhere(known[taken : until[k]]):
            actor.measure(log_s[taken + row], flight.actor[taken + row, person], person)
        taken = int(until[k])
        found[k] = actor.middle(actor.each(np.array([t_s])))[0]
    return found


def fly_arm(scene: ReplayScene, arm: Arm) -> ArmFlight:
    """Fly a scene again with an arm's planner."""
    done = replay(
        arm,
        scene.flight.actor_t_ns,
        scene.flight.actor,
        scene.fields,
        Start(scene.drones, scene.yaw_rad, scene.heading_rad),
        config=scene.config,
        weights=scene.flight.weights,
    )
    return ArmFlight(
        names=tuple(scene.names),
        position=done.position,
        quaternion_xyzw=done.quaternion_xyzw,
        slots=done.slots,
        aim=done.aim,
        known=np.ones(done.position.shape[:2], dtype=np.bool_),
        safety=done.safety,
    )


def measure_arm(scene: ReplayScene, flown: ArmFlight, detect: Detect) -> MeasuredJoints | None:
    """Simulate what an arm's cameras measure of everybody's skeleton; None without a skeleton.

    It is known which keypoints belong to whom.
    """
    if scene.joints is None:
        return None
    cameras = scene.flight.cameras
    own = {camera.name: camera for camera in cameras}
    carried = [own.get(name, cameras[k % len(cameras)]) for k, name in enumerate(flown.names)]
    pictures = scene.pictures
    paths = CameraPaths(
        t_ns=scene.t_ns[pictures],
        position=flown.position[:, pictures],
        quaternion_xyzw=flown.quaternion_xyzw[:, pictures],
        known=flown.known[:, pictures],
        intrinsics=[camera.intrinsics for camera in carried],
        noise=[camera.noise for camera in carried],
        joints=scene.joints,
        middle=scene.actor[pictures],
    )
    people, each = scene.people[:, pictures], np.split(scene.joints, len(scene.people), axis=1)
    found = [
        measure(
            replace(paths, joints=each[p], middle=people[p], person=p, others=np.delete(people, p, axis=0)),
            scene.maps_at(paths.t_ns),
            detect,
            start_m=scene.config.tuning.sight_start_m,
            trials=scene.settings.trials,
            seed=scene.settings.seed,
        )
        for p in range(len(people))
    ]
    return joined(found)


def trajectories(scene: ReplayScene, flown: ArmFlight) -> pd.DataFrame:
    """Return the rows of `tables.REPLAN`."""
    import pandas as pd

    count, times = flown.position.shape[:2]
    position, slots = _rows(flown.position), _rows(flown.slots)
    seen = seen_people(scene, flown)
    error = errors_of_views(flown.position, scene.people, seen, scene.config).mean(axis=0)
    table = pd.DataFrame(
        {
            "t_ns": np.repeat(scene.t_ns, count),
            "camera": np.tile(np.array(flown.names, dtype=object), times),
        }
    )
    table[_POSITION] = position
    table[_QUATERNION] = _rows(flown.quaternion_xyzw)
    table["formation_yaw_rad"] = np.repeat(flown.slots[0, :, 0], count)
    table[_SLOT] = slots
    table["tilt_rad"] = _rows(slot_of(flown.position - aimed_at(scene, flown)))[:, TILT]
    table["visible"] = seen.any(axis=0).T.ravel()
    table["predicted_error_m"] = np.repeat(np.where(np.isfinite(error), error, np.nan), count)
    return table


def flight_from(table: pd.DataFrame, aim: Float, known: Bool, safety: dict[str, int]) -> ArmFlight:
    """Rebuild the flight that `trajectories` stored."""
    names, position, quaternion = poses_from(table)
    slots = _dense(table, _SLOT, len(names))
    return ArmFlight(names, position, quaternion, slots, aim, known, safety)


def poses_from(table: pd.DataFrame) -> tuple[tuple[str, ...], Float, Float]:
    """Return the cameras' names, positions [N, T, 3] and quaternions [N, T, 4] of stored trajectories."""
    names = tuple(dict.fromkeys(table["camera"]))
    return names, _dense(table, _POSITION, len(names)), _dense(table, _QUATERNION, len(names))


def _dense(table: pd.DataFrame, columns: list[str], cameras: int) -> Float:
    rows = table[columns].to_numpy(np.float64).reshape(-1, cameras, len(columns))
    return np.ascontiguousarray(rows.swapaxes(0, 1))


def _rows(values: Float) -> Float:
    """Return [N, T, K] as rows sorted by time, then camera."""
    return values.swapaxes(0, 1).reshape(-1, values.shape[2])


class Detect(Protocol):
    """Function that simulates a keypoint detector on one camera's pictures."""

    def __call__(
        self,
        pixels: Float,
        free: Bool,
        camera: Float,
        target: Float,
        focal_px: float,
        rng: np.random.Generator,
    ) -> tuple[Float, Float]:
        """Return keypoints [T, J, 2] px (NaN: missed) and confidences [T, J].

        Args:
            pixels: [T, J, 2] exact, NaN outside the picture.
            free: [T, J] True where nothing hides the joint.
            camera: [T, 3] m, world.
            target: [T, 3] m, world, the person's middle.
            rng: draws as many numbers for any visibility.
        """


@dataclass(frozen=True)
class CameraPaths:
    """Cameras N on their paths at the times T of their pictures, and the filmed person."""

    t_ns: Int64  # [T]
    position: Float  # [N, T, 3] m, world
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera
    known: Bool  # [N, T] True where the camera has a pose; other pictures are not used
    intrinsics: Sequence[Intrinsics]
    noise: Sequence[Sequence[NoiseModel]]
    joints: Float  # [T, J, 3] m, world; NaN where unknown
    middle: Float  # [T, 3] m, world, of the person
    person: int = 0  # number, for draws of their own
    others: Float | None = None  # [Q, T, 3] m, world: hips of others, who can stand in the way


@dataclass(frozen=True)
class MeasuredJoints:
    """Result of the simulated measurements."""

    error_m: Float32  # [trials, T, J]; NaN where the joint was not measured or the truth is unknown
    seen_share: float  # of known joints and cameras: in the picture and not hidden
    joint_frames: int  # with a truth


def measure(
    paths: CameraPaths,
    maps: DistanceField | MapsInTurn,
    detect: Detect,
    *,
    start_m: float,
    trials: int,
    seed: int,
) -> MeasuredJoints:
    """Measure a skeleton in several trials; sight is tested in the map of each moment.

    The last `start_m` of a sight line, next to the joint, is left out: maps contain the person. Trial k of
    camera i has the same random numbers for any other path.
    """
    joints = paths.joints
    cameras, times, count = len(paths.position), *joints.shape[:2]
    pixels = np.stack([_pixels(paths, i) for i in range(cameras)])
    known = np.isfinite(joints[..., 0])
    standing_in = np.where(known[..., None], joints, paths.middle[:, None])
    free = looked(
        maps,
        lambda field, rows: visible(field, paths.position[:, rows, None], standing_in[rows], start_m=start_m),
        axis=1,
    )
    if paths.others is not None and len(paths.others):
        eyes, others = paths.position[:, :, None], paths.others[:, None, :, None]
        free &= ~hidden_by_people(eyes, standing_in, others)
    sigma = np.stack([_pose_sigma(paths, i) for i in range(cameras)], axis=1)
    error = np.full((trials, times, count), np.nan, dtype=np.float32)
    for trial in range(trials):
        rays = np.empty((times, count, cameras, 2))
        weight = np.empty((times, count, cameras))
        logged_position, logged_rotation = np.empty((times, cameras, 3)), np.empty((times, cameras, 3, 3))
        for i, lens in enumerate(paths.intrinsics):
            rng = np.random.default_rng([seed, trial, i])
            path = paths.position[i]
            logged_position[:, i], turned = disturb(
                paths.noise[i], paths.t_ns, path, paths.quaternion_xyzw[i], rng
            )
            logged_rotation[:, i] = matrix_from_quaternion(turned)
            if paths.person:
                rng = np.random.default_rng([seed, trial, i, paths.person])
            xy, confidence = detect(pixels[i], free[i], path, paths.middle, _focal(lens), rng)
            rays[:, :, i] = undistort(xy, lens)
            weight[:, :, i] = np.where(confidence >= MIN_CONFIDENCE, confidence, 0.0)
        views = Views(
            rays=rays.reshape(-1, cameras, 2),
            weight=weight.reshape(-1, cameras),
            pose_index=np.repeat(np.arange(times), count),
            position=logged_position,
            rotation=logged_rotation,
            focal=np.array([_focal(lens) for lens in paths.intrinsics]),
            pixel_sigma=np.full(cameras, PIXEL_SIGMA_PX),
            pose_sigma=sigma,
        )
        points = triangulate(views, method="robust").points.reshape(joints.shape)
        points[~known] = np.nan
        error[trial] = np.sqrt(np.sum((points - joints) ** 2, axis=-1))
    seen = np.isfinite(pixels[..., 0]) & free
    total = cameras * int(known.sum())
    seen_share = float((seen & known).sum() / total) if total else 0.0
    return MeasuredJoints(error, seen_share, int(known.sum()))


def joined(people: Sequence[MeasuredJoints]) -> MeasuredJoints:
    """Join what was measured of several people: their joints in a row."""
    frames = [person.joint_frames for person in people]
    seen = sum(person.seen_share * count for person, count in zip(people, frames, strict=True))
    return MeasuredJoints(
        error_m=np.concatenate([person.error_m for person in people], axis=2),
        seen_share=seen / sum(frames) if sum(frames) else 0.0,
        joint_frames=sum(frames),
    )


def _pixels(paths: CameraPaths, i: int) -> Float:
    """Compute the exact pixels [T, J, 2] of one camera; NaN outside its picture and where it has no pose."""
    lens = paths.intrinsics[i]
    camera_from_world = invert(paths.position[i, :, None], paths.quaternion_xyzw[i, :, None])
    pixels = project(transform(camera_from_world, paths.joints), lens)
    inside = (pixels >= -0.5) & (pixels <= np.array([lens.width, lens.height]) - 0.5)
    return np.where(inside.all(axis=-1, keepdims=True) & paths.known[i, :, None, None], pixels, np.nan)


def _pose_sigma(paths: CameraPaths, i: int) -> Float:
    """Compute the sigmas [T, 2] per axis (m, rad) of one camera's poses for triangulation."""
    path, turned = paths.position[i], paths.quaternion_xyzw[i]
    elapsed_s = (paths.t_ns - paths.t_ns[0]) / 1e9
    return sum_sigma(paths.noise[i], elapsed_s, *rates(paths.t_ns, path, turned))


def _focal(lens: Intrinsics) -> float:
    return (lens.fx + lens.fy) / 2
