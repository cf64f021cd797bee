"""Observations: keypoints and poses of all cameras as arrays over one time base, from a session's tables.

Cameras keep their own frames until each person's detections are chosen. Only then are the person's keypoints
interpolated to the common times, and never across a frame without them.

A rolling shutter takes each row at a time of its own. A joint's image moves on from its row's time to the
picture's stamp by its own velocity in the picture. So the camera's turning and the joint's motion during the
readout both count, and everything after that may take each picture for one of a single moment.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Float32, Int64, Intrinsics, nearest_rows
from pipelines.geometry.cameras import row_delay_s, undistort
from pipelines.geometry.noise import PoseErrors
from pipelines.geometry.poses import interpolate_points, matrix_from_quaternion, velocities
from pipelines.session.camera_poses import poses_at
from pipelines.session.description import CameraEntry, Interpolation
from pipelines.session.records import Detections, Trajectory

# Keypoints are not interpolated between frames that are farther apart than this, and than usual.
_FRAME_GAP_NS = 500_000_000
# A gap of more than this many median frame periods is a missing picture.
_USUAL = 1.5


@dataclass(frozen=True)
class ErrorModes:
    """Remaining pose errors of a camera whose poses were refined by its background.

    The error at time t is the response at t times R unknown numbers. These are independent, with mean 0 and
    standard deviation 1. A constant shift of the whole path is added.
    """

    t_ns: Int64  # [S], two or more
    response: Float  # [S, 6, R] of position in the world (m) and rotation vector in the camera (rad)
    shift_m: float  # standard deviation of the constant shift

    def at(self, t_ns: Int64) -> Float:
        """Interpolate the response [..., 6, R] at times [...] ns; beyond the ends, the nearest."""
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        before = self.t_ns[after - 1]
        share = np.clip((t_ns - before) / (self.t_ns[after] - before), 0.0, 1.0)[..., None, None]
        return np.asarray((1 - share) * self.response[after - 1] + share * self.response[after])


@dataclass(frozen=True)
class Camera:
    """Camera of a session.

    `sigma` is the standard deviation per axis of position (m) and rotation (rad) at each pose of the
    trajectory, from the stated pose noise or the log's covariance; None without either. `covariance` is the
    log's own if `sigma` comes from it: position in world, rotation vector in camera. Detections count
    frames by their row in `frame_t_ns`; where `follows` is False, pictures are missing before that row.
    """

    name: str
    intrinsics: Intrinsics
    frame_number: Int64  # [F] as the pictures count them
    frame_t_ns: Int64  # [F]
    follows: Bool  # [F] True if the frame is the next picture after the row before
    trajectory: Trajectory
    static: bool
    sigma: Float | None  # [N, 2]
    detections: Detections
    covariance: Float | None = None  # [N, 6, 6]
    errors: PoseErrors | None = None  # remaining errors of its poses, if they were refined beforehand
    loosened: Float | None = None  # [N, 2] m, rad: what poses in bad stretches of the log err by besides
    stepped_m: float = 0.0  # per axis: what positions of a log that jumps and stays err by besides
    modes: ErrorModes | None = None  # of what its background leaves open, if its poses were refined by it
    blazepose: bool = False  # True if that network placed its keypoints
    aside: Float32 | None = None  # [M, J, 2] errors of detections' rays by the side seen (`view_errors`)

    @cached_property
    def focal_px(self) -> float:
        """Mean focal length (px), to convert pixels to angles."""
        return (self.intrinsics.fx + self.intrinsics.fy) / 2

    @cached_property
    def field(self) -> Float:
        """Left, top, right and bottom of its picture [4] as undistorted normalised image coordinates."""
        right, bottom = self.intrinsics.width - 1.0, self.intrinsics.height - 1.0
        x, y = right / 2, bottom / 2
        middles = undistort(np.array([[0.0, y], [x, 0.0], [right, y], [x, bottom]]), self.intrinsics)
        return middles[np.arange(4), [0, 1, 0, 1]]

    def seen(self) -> tuple[Float, Float]:
        """Compute its keypoints: rays [F, D, J, 2], NaN where nothing was found; confidences [F, D, J]."""
        found = self.detections
        rays = np.full((len(self.frame_t_ns), self.most_people, len(found.joints), 2), np.nan)
        confidence = np.zeros(rays.shape[:-1])
        seen = undistort(found.xy, self.intrinsics)
        rays[found.frame, self._rank] = seen if self.aside is None else seen - self.aside
        confidence[found.frame, self._rank] = found.confidence
        confidence[np.isnan(rays[..., 0])] = 0.0
        return rays, confidence

    def row_delay_s(self) -> Float:
        """Compute the delay (s) of each keypoint [F, D, J] against its frame's stamp."""
        found = self.detections
        dense = np.full((len(self.frame_t_ns), self.most_people, len(found.joints)), np.nan)
        dense[found.frame, self._rank] = row_delay_s(found.xy[..., 1], self.intrinsics)
        return dense

    @cached_property
    def bridged(self) -> Bool:
        """[F - 1] True for frames after the first that may be interpolated to from the frame before."""
        step_ns = np.diff(self.frame_t_ns)
        return np.asarray(self.follows[1:] & (step_ns <= self.largest_gap_ns))

    @property
    def largest_gap_ns(self) -> int:
        """The longest time between two of its frames over which keypoints are interpolated."""
        stamps = self.frame_t_ns
        period = int(np.median(np.diff(stamps))) if len(stamps) > 1 else 0
        return max(_FRAME_GAP_NS, int(_USUAL * period))

    @cached_property
    def _rank(self) -> NDArray[np.intp]:
        """Index of every detection among those of its frame; detections are sorted by frame."""
        frame = self.detections.frame
        first_of_frame = np.searchsorted(frame, frame, side="left")
        return np.arange(len(frame)) - first_of_frame

    @cached_property
    def most_people(self) -> int:
        """The most people in one of its pictures, at least 1."""
        return int(self._rank.max(initial=0)) + 1

    def poses_at(self, t_ns: Int64, between: Interpolation) -> tuple[Float, Float]:
        """Return world_from_camera at given times: position [T, 3], rotation [T, 3, 3]; NaN if unknown."""
        position, quaternion = poses_at(self.trajectory, t_ns, between, static=self.static)
        return position, matrix_from_quaternion(quaternion)

    def sigma_at(self, t_ns: Int64) -> Float | None:
        """Return the pose noise [T, 2] at given times, that of the logged pose before each."""
        if self.sigma is None:
            return None
        sigma = self.sigma[self._pose_before(t_ns)]
        return sigma if self.loosened is None else np.hypot(sigma, self.loosened_at(t_ns))

    def covariance_at(self, t_ns: Int64) -> Float | None:
        """Return the logged pose covariance [T, 6, 6] at given times, that of the logged pose before each."""
        if self.covariance is None:
            return None
        covariance = self.covariance[self._pose_before(t_ns)]
        if self.loosened is None:
            return covariance
        return covariance + np.repeat(self.loosened_at(t_ns) ** 2, 3, axis=1)[..., None] * np.eye(6)

    def loosened_at(self, t_ns: Int64) -> Float:
        """Return what poses [T, 2] err by besides in bad stretches, by the logged ones before and after."""
        if self.loosened is None:
            return np.zeros((len(t_ns), 2))
        before = self._pose_before(t_ns)
        after = np.minimum(before + 1, len(self.loosened) - 1)
        return np.maximum(self.loosened[before], self.loosened[after])

    def _pose_before(self, t_ns: Int64) -> NDArray[np.intp]:
        before = np.searchsorted(self.trajectory.t_ns, t_ns, side="right") - 1
        return np.clip(before, 0, len(self.trajectory.t_ns) - 1)


@dataclass(frozen=True)
class Candidates:
    """Detections of all cameras at common times, not yet assigned to people."""

    t_ns: Int64  # [T]
    frame: Int64  # [T, C] the camera's frame nearest in time, -1 if none is near
    rays: Float  # [T, C, D, J, 2]
    confidence: Float  # [T, C, D, J]
    position: Float  # [T, C, 3]
    rotation: Float  # [T, C, 3, 3]


@dataclass(frozen=True)
class Observations:
    """Keypoints of each person in every camera at the common times."""

    t_ns: Int64  # [T]
    joints: tuple[str, ...]
    rays: Float  # [T, P, J, C, 2] undistorted normalised image coordinates, NaN where not seen
    confidence: Float  # [T, P, J, C]
    position: Float  # [T, C, 3]
    rotation: Float  # [T, C, 3, 3]
    pose_sigma: Float | None  # [T, C, 2]; None if no camera has known pose noise


def time_base(cameras: list[Camera], rate_hz: float | None) -> Int64:
    """Choose the skeleton's times: the frames of the first camera with most, or a rate over all spans."""
    if rate_hz is None:
        return max(cameras, key=lambda camera: len(camera.frame_t_ns)).frame_t_ns
    first = min(int(camera.frame_t_ns[0]) for camera in cameras)
    last = max(int(camera.frame_t_ns[-1]) for camera in cameras)
    steps = int((last - first) * rate_hz / 1e9) + 1
    return first + np.round(np.arange(steps) * (1e9 / rate_hz)).astype(np.int64)


def candidates(cameras: list[Camera], between: Interpolation) -> Candidates:
    """Collect all detections on one timeline that contains every frame of every camera."""
    t_ns = _timeline(cameras)
    frame = np.stack([_nearest_frame(camera.frame_t_ns, t_ns) for camera in cameras], axis=1)
    people = max(camera.most_people for camera in cameras)
    joints = len(cameras[0].detections.joints)
    rays = np.full((len(t_ns), len(cameras), people, joints, 2), np.nan)
    confidence = np.zeros(rays.shape[:-1])
    for c, camera in enumerate(cameras):
        (near,) = np.nonzero(frame[:, c] >= 0)
        own_rays, own_confidence = camera.seen()
        rays[near, c, : camera.most_people] = own_rays[frame[near, c]]
        confidence[near, c, : camera.most_people] = own_confidence[frame[near, c]]
    return Candidates(t_ns, frame, rays, confidence, *poses_of_cameras(cameras, t_ns, between))


def poses_of_cameras(cameras: list[Camera], t_ns: Int64, between: Interpolation) -> tuple[Float, Float]:
    """Interpolate world_from_camera of all cameras: position [T, C, 3], rotation [T, C, 3, 3]."""
    poses = [camera.poses_at(t_ns, between) for camera in cameras]
    position, rotation = (np.stack(part, axis=1) for part in zip(*poses, strict=True))
    return position, rotation


def observe(
    cameras: list[Camera],
    found: Candidates,
    choice: Int64,
    t_ns: Int64,
    between: Interpolation,
    sides: Int64 | None = None,
) -> Observations:
    """Interpolate chosen detections' keypoints [T', C, P] (-1: none) and poses to common times [T].

    Each joint has the view of its side, see `on_sides`; None: of its own.
    """
    views, weights, sigmas = [], [], []
    for c, camera in enumerate(cameras):
        rays, confidence = sightings_of(camera, found, c, choice[:, c])
        views.append(_at(camera, rays, t_ns))
        weights.append(_at(camera, confidence, t_ns))
        sigmas.append(camera.sigma_at(t_ns))
    rows = np.minimum(np.searchsorted(found.t_ns, t_ns), len(found.t_ns) - 1)
    if (found.t_ns[rows] == t_ns).all():
        position, rotation = found.position[rows], found.rotation[rows]
    else:
        position, rotation = poses_of_cameras(cameras, t_ns, between)
    stated = [sigma for sigma in sigmas if sigma is not None]
    pose_sigma = _all_sigmas(cameras, sigmas) if stated else None
    rays, confidence = np.stack(views, axis=3), np.nan_to_num(np.stack(weights, axis=3))
    if sides is not None:
        rays, confidence = on_sides(rays, confidence, sides)
    return Observations(
        t_ns=t_ns,
        joints=cameras[0].detections.joints,
        rays=rays,
        confidence=confidence,
        position=position,
        rotation=rotation,
        pose_sigma=pose_sigma,
    )


def on_sides(rays: Float, confidence: Float, sides: Int64) -> tuple[Float, Float]:
    """Give each joint [T, P, J, ...] the view of the joint in `sides`, -1 for none: NaN and 0 then."""
    kept, joint = sides >= 0, np.maximum(sides, 0)
    own_xy = np.take_along_axis(rays, joint[..., None], axis=2)
    own_confidence = np.take_along_axis(confidence, joint, axis=2)
    return np.where(kept[..., None], own_xy, np.nan), np.where(kept, own_confidence, 0.0)


def _all_sigmas(cameras: list[Camera], sigmas: list[Float | None]) -> Float:
    """Build pose noise [T, C, 2] as stated, else the others' median; a static camera without it is exact."""
    stated = [sigma for sigma in sigmas if sigma is not None]
    usual = np.median(stated, axis=0)
    return np.stack(
        [
            sigma if sigma is not None else (np.zeros_like(usual) if camera.static else usual)
            for camera, sigma in zip(cameras, sigmas, strict=True)
        ],
        axis=1,
    )


def _timeline(cameras: list[Camera]) -> Int64:
    """List the times of the fastest camera's frames, and of other frames that are nearest to none of them."""
    t_ns = time_base(cameras, None)
    for camera in cameras:
        visited = np.unique(_nearest_frame(camera.frame_t_ns, t_ns))
        unvisited = np.setdiff1d(np.arange(len(camera.frame_t_ns)), visited)
        t_ns = np.union1d(t_ns, camera.frame_t_ns[unvisited])
    return t_ns


def _nearest_frame(frame_t_ns: Int64, t_ns: Int64) -> Int64:
    """Find the frame [T] nearest to each time, -1 where none lies within a frame period."""
    nearest = nearest_rows(frame_t_ns, t_ns)
    period = int(np.median(np.diff(frame_t_ns))) if len(frame_t_ns) > 1 else 0
    return np.where(np.abs(frame_t_ns[nearest] - t_ns) <= period, nearest, -1)


def sightings_of(camera: Camera, found: Candidates, c: int, choice: Int64) -> tuple[Float, Float]:
    """Return rays [F, P, J, 2] and confidence [F, P, J] of people in a camera's own frames; NaN unseen."""
    rays, confidence, delay_s = _chosen(camera, found, c, choice)
    if camera.intrinsics.readout_s:
        rays = rays - np.nan_to_num(_velocity(camera, rays, delay_s) * delay_s[..., None])
    return rays, confidence


def readout_of(camera: Camera, found: Candidates, c: int, choice: Int64) -> dict[str, float | int]:
    """Say how many of a camera's chosen keypoints were moved from their rows' times to the stamps.

    The others have no velocity: no neighbouring picture shows any joint of the person. They stay as they are.
    """
    rays, _, delay_s = _chosen(camera, found, c, choice)
    seen = int(np.isfinite(rays[..., 0]).sum())
    moved = int(np.isfinite(_velocity(camera, rays, delay_s)[..., 0])[np.isfinite(rays[..., 0])].sum())
    return {"readout_s": camera.intrinsics.readout_s, "keypoints": moved, "without_motion": seen - moved}


def _velocity(camera: Camera, rays: Float, delay_s: Float) -> Float:
    """Estimate velocities [F, P, J, 2] of keypoints at their rows' times; NaN of people in a lone picture.

    Of the velocities from the picture before and to the one after, and the median of all joints of the person
    on both sides, the median: an outlier in one picture then moves the keypoints beside it little. Where one
    neighbour is missing, the other one decides; without any, the person's median.
    """
    t_s = (camera.frame_t_ns - camera.frame_t_ns[0])[:, None, None] / 1e9 + delay_s
    before, after = velocities(t_s, rays, camera.bridged[:, None, None])
    sides = np.concatenate([before, after], axis=2)
    known = np.isfinite(sides).any(axis=2, keepdims=True)
    body = np.where(known, np.nanmedian(np.where(known, sides, 0.0), axis=2, keepdims=True), np.nan)
    middle = np.median(np.stack([before, after, np.broadcast_to(body, before.shape)]), axis=0)
    either = np.where(np.isnan(before), after, before)
    return np.where(np.isfinite(middle), middle, np.where(np.isfinite(either), either, body))


def _chosen(camera: Camera, found: Candidates, c: int, choice: Int64) -> tuple[Float, Float, Float]:
    """Gather rays, confidence and delay (s, of rolling shutters) of each person's keypoints, as taken."""
    shape = (len(camera.frame_t_ns), choice.shape[1], len(camera.detections.joints))
    rays = np.full((*shape, 2), np.nan)
    confidence, delay_s = np.full(shape, np.nan), np.full(shape, np.nan)
    own_rays, own_confidence = camera.seen()
    own_delay_s = camera.row_delay_s() if camera.intrinsics.readout_s else None
    for person in range(choice.shape[1]):
        frames, rows, _ = frames_of(camera, found, c, choice[:, person])
        detection = choice[rows, person]
        rays[frames, person] = own_rays[frames, detection]
        confidence[frames, person] = own_confidence[frames, detection]
        if own_delay_s is not None:
            delay_s[frames, person] = own_delay_s[frames, detection]
    confidence[np.isnan(rays[..., 0])] = np.nan
    return rays, confidence, delay_s


def frames_of(camera: Camera, found: Candidates, c: int, choice: Int64) -> tuple[Int64, Int64, Int64]:
    """List the frames in which a person [T'] was chosen, their times' rows in `found`, and the detections."""
    frame, row_of = found.frame[:, c], np.full(len(camera.frame_t_ns), -1)
    nearest_last = np.argsort(-np.abs(found.t_ns - camera.frame_t_ns[frame]), kind="stable")
    rows = nearest_last[(frame[nearest_last] >= 0) & (choice[nearest_last] >= 0)]
    row_of[frame[rows]] = rows
    frames = np.flatnonzero(row_of >= 0)
    rows = row_of[frames]
    return frames, rows, np.searchsorted(camera.detections.frame, frames) + choice[rows]


def _at(camera: Camera, values: Float, t_ns: Int64) -> Float:
    """Interpolate values [F, ...] of a camera's frames to times [T, ...]; NaN where pictures are missing."""
    stamps = camera.frame_t_ns
    # A missing picture is a row of NaN between its neighbours.
    breaks = np.flatnonzero(~camera.follows[1:]) + 1
    between = (stamps[breaks - 1] + stamps[breaks]) // 2
    apart = (between > stamps[breaks - 1]) & (between < stamps[breaks])
    return interpolate_points(
        np.insert(stamps, breaks[apart], between[apart]),
        np.insert(values, breaks[apart], np.nan, axis=0),
        t_ns,
        max_gap_ns=camera.largest_gap_ns,
    )


# --- cameras of a diagnosis ------------------------------------------------------------------------------

# Of poses whose noise nobody states, in a usual flight.
UNSTATED = (0.3, np.radians(1.0), 0.1, np.radians(0.3), 0.1, np.radians(0.3))


class PoseSigma(NamedTuple):
    """Standard deviations per axis of a camera's poses, and of parts of them."""

    position_m: float
    rotation_rad: float
    white_position_m: float  # new in every pose
    white_rotation_rad: float
    varying_position_m: float  # not constant in this flight; with the white part
    varying_rotation_rad: float


@dataclass(frozen=True)
class Filmed:
    """One camera with the pixels of the person that it shows most."""

    name: str
    intrinsics: Intrinsics
    t_ns: Int64  # [F] of its pictures
    pixels: Float  # [F, J, 2] of the joints that are looked at; NaN where nothing was found
    camera: Camera
    entry: CameraEntry
    sigma: PoseSigma

    @property
    def static(self) -> bool:
        """True if the camera stands still."""
        return self.camera.static

    @property
    def states_noise(self) -> bool:
        """False if the errors of its poses are a guess: those of usual flights."""
        return self.sigma != PoseSigma(*UNSTATED)

    @property
    def mount(self) -> Float | None:
        """body_from_camera [3, 3] of a camera that is fixed to the body whose pose is logged, else None.

        Of a camera on a gimbal, gimbal_from_camera.
        """
        stored = self.entry.poses.mount or self.entry.poses.in_gimbal
        return None if stored is None else matrix_from_quaternion(np.array(stored.rotation_xyzw))

    @property
    def lever_m(self) -> Float:
        """The camera's place [3] on the body whose pose is logged; 0 where nothing is said of it."""
        stored = self.entry.poses.mount or self.entry.poses.in_gimbal
        return np.zeros(3) if stored is None else np.array(stored.translation)
