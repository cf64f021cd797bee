"""Records that readers return and writers take: plain frozen dataclasses of numpy arrays.

World ENU in metres, camera x right, y down, z forward, stamps int64 ns, quaternions xyzw, missing is NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import ClockFit, Float, Int64, Intrinsics, Place, RelativeTo
from pipelines.session.progress import Progress, Silent

if TYPE_CHECKING:
    import pandas as pd

POINT_COVARIANCE_COLUMNS = ("cxx", "cxy", "cxz", "cyy", "cyz", "czz")
"""Upper triangle of a joint's covariance, m^2, as tables name it."""


def full_covariance(upper: Float) -> Float:
    """Return matrices [..., 3, 3] of their upper triangles [..., 6]: POINT_COVARIANCE_COLUMNS."""
    return upper[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*upper.shape[:-1], 3, 3)


@dataclass(frozen=True)
class Trajectory:
    """Logged poses of an object: rising stamps, finite numbers, bad rows counted by cause in `dropped`."""

    t_ns: Int64  # [N]
    position: Float  # [N, 3] m
    quaternion_xyzw: Float  # [N, 4] unit, world_from_body
    covariance: Float | None = None  # [N, 6, 6] position in world (m^2), then rotation vector in body (rad^2)
    dropped: dict[str, int] = field(default_factory=dict)
    body_xyzw: Float | None = None  # [N, 4] unit, world_from_body of what carries a camera on a gimbal


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera of a calibration file; either part may be absent from the file.

    Without a stated size of the pictures it is that of which the principal point is the middle, `size_stated`
    is False, and the pictures decide. `note` says what else the file states and is not used, or used
    otherwise.
    """

    intrinsics: Intrinsics | None
    position: Float | None = None  # [3] m, world_from_camera
    quaternion_xyzw: Float | None = None  # [4] unit, world_from_camera
    size_stated: bool = True
    note: str = ""


@dataclass(frozen=True)
class Detections:
    """People that a keypoint detector found in one camera's frames, sorted by frame, then person.

    A joint that was not found has NaN in `xy` and 0 confidence. `person` is the detector's own id, or the
    rank within the frame where it has none.
    """

    joints: tuple[str, ...]
    frame: Int64  # [M]
    person: Int64  # [M]
    xy: Float  # [M, J, 2] px, the centre of the top left pixel is (0, 0)
    confidence: Float  # [M, J] 0..1 if the detector keeps to that range
    frames_listed: Int64  # [F] sorted: every frame that the files list, with or without people
    image_size: tuple[int, int] | None = None  # width, height
    dropped: dict[str, int] = field(default_factory=dict)
    adjusted: dict[str, int] = field(
        default_factory=dict
    )  # values that are kept, but not as the file has them


@dataclass(frozen=True)
class JointMotion:
    """3D joints of people at rising times: truth, or a skeleton; NaN marks a joint that is missing then."""

    t_ns: Int64  # [T]
    joints: tuple[str, ...]
    position: Float  # [T, P, J, 3] m, world
    status: NDArray[np.str_] | None = None  # [T, P, J] words of triangulation.STATUS, if known
    reprojection_px: Float | None = None  # [T, P, J]
    views: Int64 | None = None  # [T, P, J] cameras that measured the joint
    covariance: Float | None = None  # [T, P, J, 6] m^2: xx, xy, xz, yy, yz, zz
    dropped: dict[str, int] = field(default_factory=dict)  # positions in the file that are left out, by cause
    timed: bool = True  # False: the file states no times, and `t_ns` counts its frames as seconds


@dataclass(frozen=True)
class SkeletalMotion:
    """A chain of bones with the rotations of its joints, as in BVH files. Parents come before children.

    A bone's world rotation is its parent's times its own; in the rest pose all are the identity.
    """

    t_s: Float  # [T] seconds since the first frame
    bones: tuple[str, ...]  # as the file calls them
    parent: tuple[int, ...]  # -1 for the root
    offset: Float  # [B, 3] m, from the parent's joint in the rest pose, z up
    end: dict[int, Float]  # bone to the position of its end site, [3] m
    root: Float  # [T, 3] m, position of the root's joint
    rotation: Float  # [T, B, 4] unit quaternions xyzw, parent_from_bone


@dataclass(frozen=True)
class PlannedArm:
    """Flights of a planner's arm in the last comparison."""

    name: str
    drones: Mapping[str, Trajectory]  # world_from_camera
    ground_m: float  # height of the ground under the actor at the start, world
    broken: str = ""  # limits that it breaks, with how often


@dataclass(frozen=True)
class MovingBody:
    """A person's body whose surface is known at some times, by `geometry.body_model`."""

    person: int
    t_ns: Int64  # [T]
    shape: Float  # [12]
    centre: Float  # [T, 22, 3] m, joints of the bones
    rotation: Float  # [T, 22, 4] world_from_bone relative to the neutral pose
    sigma_m: Float  # [T, 22] root of the trace of the joints' covariances; NaN if unknown


@dataclass(frozen=True)
class Recording:
    """Everything that an export may need: the skeleton, the cameras that it was made with, and the maps.

    Maps and pictures are large, so they are yielded one at a time. Each call starts from the beginning.
    """

    name: str
    motion: JointMotion | None
    cameras: dict[str, Trajectory]  # world_from_camera, as logged
    refined: dict[str, Trajectory] = field(default_factory=dict)  # and as the reconstruction corrected them
    lenses: dict[str, Intrinsics] = field(default_factory=dict)
    maps: Callable[[], Iterable[Occupancy]] = tuple
    pictures: Callable[[str], Iterable[tuple[int, NDArray[np.uint8]]]] = field(default=lambda _: ())
    """Pictures of a camera in order, at the rate that was asked for: world time, [height, width, 3] BGR."""
    overlays: Callable[[str], Iterable[tuple[int, NDArray[np.uint8]]]] = field(default=lambda _: ())
    """The same pictures with the skeleton drawn into them."""
    film: Callable[[str, Sequence[str], Progress], tuple[Int64, Iterator[NDArray[np.uint8]]] | None] = field(
        default=lambda *_: None
    )
    """World times of all pictures of a camera, and these with skeleton and named angles; None without any."""
    angles: Callable[[], pd.DataFrame | None] = field(default=lambda: None)
    """Rows of `tables.ANGLES`, sorted by time, then person; None without a reconstruction."""
    gait: Callable[[], pd.DataFrame | None] = field(default=lambda: None)
    """Rows of `tables.GAIT`; None without a reconstruction."""
    bodies: Callable[[], Sequence[MovingBody]] = tuple
    """The bodies that were fitted to people."""
    doubts: Callable[[], Sequence[str]] = tuple
    """Sentences on what contradicts itself in the flight."""
    planned: Callable[[], Sequence[PlannedArm]] = tuple
    """The arms of the last comparison of planners; none without one."""
    place: Place | None = None  # where the world's zero lies on Earth, if known
    unit: str | None = None  # of lengths, if the user chooses one that the export has
    axes: str | None = None  # z-up or y-up, if the user chooses them
    zero_ns: int = 0  # the time that formats in seconds count from, if they have the choice; 0 is the epoch
    progress: Progress = field(default_factory=Silent)  # receives notes on held, moved and thinned samples
    people: tuple[str, ...] = ()  # names of the people of `motion`, in order, as far as they have any

    def name_of(self, person: int) -> str:
        """Return a person's name; `person0` and so on without one."""
        return self.people[person] if person < len(self.people) else f"person{person}"

    @property
    def tracks(self) -> dict[str, Trajectory]:
        """The refined poses of every camera, else its logged ones; cameras without poses are left out."""
        best = {name: self.refined.get(name, logged) for name, logged in self.cameras.items()}
        return {name: track for name, track in best.items() if len(track.t_ns)}


@dataclass(frozen=True)
class Topic:
    """A channel of a log."""

    name: str
    type: str  # in the spelling of ROS 2 (nav_msgs/msg/Odometry) or the schema's own (foxglove.PoseInFrame)
    encoding: str  # ros1, cdr, json, protobuf
    count: int
    first_ns: int | None  # receive stamps; None without messages
    last_ns: int | None


@dataclass(frozen=True, slots=True)
class Message:
    """One decoded message: `value` has the schema's fields as attributes, for every encoding."""

    topic: Topic
    receive_ns: int
    value: Any


@dataclass(frozen=True, slots=True)
class PoseSample:
    """target_from_source at one moment: poses, odometry, transforms."""

    stamp_ns: int  # header
    receive_ns: int
    target: str  # frame ids, as the message states them
    source: str
    position: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    covariance: Float | None = None  # [6, 6] as ROS orders it: x y z, then rotation about fixed x y z axes


@dataclass(frozen=True, slots=True)
class AngleSample:
    """A gimbal's attitude at one moment: three angles in the order and unit of the log, or a quaternion."""

    stamp_ns: int
    receive_ns: int
    angles: tuple[float, float, float] | None
    quaternion_xyzw: tuple[float, float, float, float] | None


@dataclass(frozen=True, slots=True)
class IntrinsicsSample:
    """The intrinsics of a CameraInfo message; None from a camera that is not calibrated (its K is 0)."""

    stamp_ns: int
    receive_ns: int
    intrinsics: Intrinsics | None
    note: str = ""  # on what was assumed


@dataclass(frozen=True, slots=True)
class PictureSample:
    """A picture in a log, still encoded; `data` may be a view into the message."""

    stamp_ns: int
    receive_ns: int
    encoding: str  # jpeg, png, or the pixel layout of a raw image: rgb8, bgr8, mono8, bayer_rggb8, ...
    width: int | None  # None for compressed pictures
    height: int | None
    step: int | None  # bytes of a row
    data: NDArray[np.uint8]


Sample = PoseSample | AngleSample | IntrinsicsSample | PictureSample


UNTIMED, SHARED_SECONDS = "pictures without times", "pictures of whole seconds"
"""Codecs of pictures that have no times of their own, and of those whose times are spread over a second."""


@dataclass(frozen=True)
class VideoIndex:
    """Presentation times of the frames of a video. Frame k is the k-th in presentation order, from 0.

    Every frame that the container lists has a row, from the first one that a decoder gives on. Frames that
    the file no longer holds are counted in `dropped`.
    """

    pts_ns: Int64  # [N] strictly increasing, since the first frame: pts_ns[0] is 0
    start_ns: int  # the first frame's own stamp in the container, often 0
    width: int  # px, as shown: turned by rotation_deg, as OpenCV and players do
    height: int
    rotation_deg: int  # 0, 90, 180 or 270: how far the coded picture is turned counter-clockwise to show it
    codec: str
    dropped: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # on what was assumed

    @property
    def count(self) -> int:
        """The number of frames."""
        return len(self.pts_ns)

    @property
    def span_s(self) -> float:
        """The time from the first frame's stamp to the last one's."""
        return int(self.pts_ns[-1]) / 1e9

    @property
    def rate_hz(self) -> float | None:
        """The average rate; None for a single frame."""
        return (self.count - 1) / self.span_s if self.count > 1 else None


@dataclass(frozen=True)
class Occupancy:
    """A voxel map: probability of being occupied, 0.5 and above is occupied, NaN where nothing is known.

    `dropped` counts by cause what a reader left out. `crs` is what the file names for its axes (WKT or
    `EPSG:n`).
    """

    probability: NDArray[np.float32]  # [X, Y, Z]
    origin: Float  # [3] m, the corner of voxel (0, 0, 0), world
    resolution_m: float
    from_ns: int = 0  # the time from which it holds
    dropped: dict[str, int] = field(default_factory=dict)
    crs: str | None = None


@dataclass(frozen=True)
class HeldMap:
    """A stored map with its voxel counts; unknown voxels count neither as occupied nor as free."""

    from_ns: int  # it holds from then on, until the next one does
    resolution_m: float
    shape: list[int]
    occupied: int
    free: int

    @classmethod
    def of(cls, occupancy: Occupancy) -> HeldMap:
        """Return the entry of a map."""
        probability = occupancy.probability  # NaN is neither
        return cls(
            from_ns=occupancy.from_ns,
            resolution_m=occupancy.resolution_m,
            shape=list(probability.shape),
            occupied=int(np.count_nonzero(probability >= 0.5)),
            free=int(np.count_nonzero(probability < 0.5)),
        )


# --- drones' own logs ---

Height = Literal["sea level", "ellipsoid", "take-off", "stated", "unknown"]
"""The zero level of the heights of geodetic positions."""


@dataclass(frozen=True)
class PositionTrack:
    """A drone's positions, on Earth or in m from its estimator's origin; as in `Trajectory`."""

    name: str  # as the log calls it, for messages
    t_ns: Int64  # [N]
    values: Float  # [N, 3] latitude deg, longitude deg, height m; or metres east, north, up
    on_earth: bool  # True for latitude, longitude, height; False for metres
    height: Height = "unknown"  # of positions on Earth
    origin: Place | None = None  # of metres: the place on Earth of their zero, if known
    accuracy_m: tuple[float, float] | None = None  # horizontal and vertical sigma from the log itself


@dataclass(frozen=True)
class AttitudeTrack:
    """The attitude of a body or a gimbal over time; stamps strictly increase.

    A body (FLU) is relative to an ENU world, a gimbal (FLU, x along the view) to the world, to its body, or
    to a level frame with the heading of the body.
    """

    name: str
    t_ns: Int64  # [N]
    quaternion_xyzw: Float  # [N, 4] unit
    relative_to: RelativeTo = "world"
    stated: Mapping[RelativeTo, Float] = field(default_factory=dict)
    """[N, 4] of a gimbal: its logged angles (FRD), by the reference frame that the user may state."""
    dropped: dict[str, int] = field(default_factory=dict)  # for a log that holds only this track


@dataclass(frozen=True)
class Telemetry:
    """A drone's positions, attitudes and gimbal angles from its own log, at times of one clock."""

    position: PositionTrack
    body: AttitudeTrack | None
    gimbal: AttitudeTrack | None
    clock: str  # zero of the times: "UTC by GPS", "boot", "the drone's clock", "the video's start"
    fit: ClockFit | None = None  # of the log's own clock to GPS time, if it was used
    notes: tuple[str, ...] = ()  # choices that the reader made, and doubts
    dropped: dict[str, int] = field(default_factory=dict)
    video_began: tuple[int, float] | None = None
    """Start of the video that holds the log, ns, by the clock of its times, with standard deviation, s."""


@dataclass(frozen=True)
class Attitudes:
    """Attitudes of a camera by a log that may lack positions."""

    camera: AttitudeTrack  # relative to the world
    clock: str  # as in `Telemetry`
    notes: tuple[str, ...] = ()
