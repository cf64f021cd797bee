"""`flight.yaml`: the files of one flight and how they belong together.

A source is a file, or a topic of a log. Its format is recognised by content, and the options of the format
stand beside it. Of the options of drones' own logs, a format lists those that it takes in an attribute
`choices`. All problems of a manifest are reported in one message, an unknown key with the nearest known one.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from pipelines.geometry.arrays import RelativeTo
from pipelines.geometry.mounting import Looks
from pipelines.session.errors import DataError
from pipelines.session.registries import (
    FORMATS,
    CalibrationFormat,
    Format,
    KeypointFormat,
    LogFormat,
    TelemetryChoice,
    TelemetryFormat,
    TrajectoryFormat,
)
from pipelines.session.storage import refuse_names
from pipelines.session.yaml_files import read_yaml_model
from pipelines.session.yaml_models import SecondsAsNs, YamlModel, describe_problem, nanoseconds, unknown_key

O = TypeVar("O", bound=YamlModel)

# The first version of flight.yaml is the only one so far.
SCHEMA = 1

# A year at 30 Hz has fewer frames: a larger number was misread.
_MAX_FRAME_NUMBER = 10**9

PICTURES = "pictures"
"""Value of `pose.attitude` for attitudes that are found by the camera's film."""

Axes = Literal["enu", "ned"]
Up = Literal["z", "-z", "y", "-y", "x", "-x"]
Unit = Literal["m", "cm", "mm", "ft"]
Side = Annotated[int, Field(gt=0, le=100_000)]
"""Pixels along one side of a picture."""
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


def _unit_quaternion(value: list[float]) -> list[float]:
    norm = math.sqrt(sum(component * component for component in value))
    if abs(norm - 1) > 1e-3:
        raise ValueError(f"is no unit quaternion (norm {norm:.4g})")
    return [component / norm for component in value]


def _fps(value: object) -> Fraction:
    try:
        text = str(value).replace(" ", "")
        if "e" in text.lower():  # an exponent of millions would make an integer of as many digits
            raise ValueError(text)
        fps = Fraction(text)
    except (ValueError, ZeroDivisionError):
        raise ValueError("is no frame rate; write 30, 29.97 or 30000/1001") from None
    if not Fraction(1, 1000) <= fps <= 1000:  # rates above it were percentages or forgotten points
        raise ValueError("is no frame rate of a film, 0.001 to 1000 a second; write 30 or 29.97")
    return fps


Quaternion = Annotated[list[float], Field(min_length=4, max_length=4), AfterValidator(_unit_quaternion)]
Fps = Annotated[Fraction, BeforeValidator(_fps)]
Start = Annotated[
    int | Literal["container"], BeforeValidator(lambda v: v if v == "container" else nanoseconds(v))
]


# --- options of files ----------------------------------------------------------------------------------


class FiledPose(YamlModel):
    """Options of poses in a trajectory."""

    inverse: bool = False
    """True if the file has camera_from_world or body_from_world."""
    quaternion: Literal["xyzw", "wxyz"] | None = None
    """Order of the quaternion's numbers in the file; without it, the format's."""
    z: Literal["up", "down"] = "up"
    """Direction in which positions count z where the attitudes are in east, north, up."""


class FramedSource(YamlModel):
    """A source in a frame of its own."""

    parent: str | None = None
    """Frame that is the log's world."""


class LoggedPose(FiledPose, FramedSource):
    """Options of poses in a log of topics."""

    child: str | None = None
    """Frame of the camera or body, for poses that are chained from transforms."""

    @model_validator(mode="after")
    def _complete(self) -> LoggedPose:
        if (self.parent is None) != (self.child is None):
            raise ValueError("needs both parent and child, or neither")
        return self


class LoggedAngles(YamlModel):
    """Options of a gimbal's angles in a log of topics."""

    order: Literal["ypr", "rpy", "pry"] = "ypr"
    """Order of yaw, pitch and roll in a message of three numbers."""
    units: Literal["deg", "rad"] = "deg"
    """Unit of the angles in a message of three numbers."""


class LoggedMap(FramedSource):
    """Options of a map in a log of topics."""

    height_m: float | None = Field(None, gt=0, le=1000)
    """Height of what stands on a floor plan, m."""


class CameraOfCalibration(YamlModel):
    """Options of a calibration."""

    camera: str | None = None
    """Name of the camera in a calibration of several."""


class DetectorOutput(YamlModel):
    """Options of keypoints."""

    skeleton: str | None = None
    """Skeleton of the keypoints, where the file does not name it."""


class NoOptions(YamlModel):
    """Nothing: files of this kind take no options."""


_BY_KIND: Mapping[str, tuple[tuple[type, type[YamlModel]], ...]] = {
    "pose": (
        (CalibrationFormat, CameraOfCalibration),
        (TrajectoryFormat, FiledPose),
        (LogFormat, LoggedPose),
        (TelemetryFormat, TelemetryChoice),
    ),
    "gimbal": ((LogFormat, LoggedAngles),),
    "map": ((LogFormat, LoggedMap),),
    "intrinsics": ((CalibrationFormat, CameraOfCalibration),),
    "keypoints": ((KeypointFormat, DetectorOutput),),
}
"""Options by part of the manifest and kind of format."""


def option_models(part: str) -> list[type[YamlModel]]:
    """List the models of all options that a part of the manifest may have."""
    return [model for _, model in _BY_KIND.get(part, ())]


def option_names(part: str) -> list[str]:
    """List the names of all options that a part of the manifest may have."""
    return sorted({name for model in option_models(part) for name in model.model_fields})


def options_of(place: str, part: str, format_: Format, stated: Mapping[str, object], wanted: type[O]) -> O:
    """Validate the options beside a file by its format's model for a part of the manifest; or DataError."""
    found = next((model for kind, model in _BY_KIND.get(part, ()) if isinstance(format_, kind)), NoOptions)
    allowed = set(getattr(format_, "choices", found.model_fields if found is not TelemetryChoice else ()))
    if strange := [name for name in stated if name not in allowed]:
        takes = f"only {', '.join(sorted(allowed))}" if allowed else "none"
        problem = f"{', '.join(strange)}: no option of this file ({format_.title})"
        raise DataError(place, problem, f"leave it out; such a file takes {takes}", code="wrong-option")
    try:
        made = found.model_validate(dict(stated))
    except ValidationError as error:
        problems = [describe_problem(problem, found) for problem in error.errors()]
        raise DataError(place, "; ".join(dict.fromkeys(problems)), code="bad-value") from None
    if not isinstance(made, wanted):
        raise TypeError(f"{part} has options {found.__name__}, not {wanted.__name__}")
    return made


# --- parts of a flight ---------------------------------------------------------------------------------


class Guess(YamlModel):
    """A mapping that `mocap init` may have guessed."""

    assumed: bool = False
    """True for what `mocap init` guessed and nobody has confirmed yet."""


class FileSource(Guess):
    """A file, or a topic of a log, with the options of its format."""

    model_config = ConfigDict(extra="allow")
    shorthand = "file"
    part: ClassVar[str] = ""
    """Name of the part of the manifest, by which formats declare their options."""

    needs_file: ClassVar[bool] = True
    file: str = ""
    """Path or URL of a file or folder, or the name of one of the `logs`; its content says what it is."""
    topic: str | None = None
    """Topic, where the file is a log; without it, the only one of its kind."""
    format: str | None = None
    """Name of the file's format, where several recognise its content."""

    @model_validator(mode="after")
    def _options_exist(self) -> FileSource:
        known = option_names(self.part)
        for key in self.options:
            if key not in known:
                own = [field.alias or name for name, field in type(self).model_fields.items()]
                raise ValueError(f"{key}: {unknown_key(key, [*own, *known])}")
        if self.needs_file and not self.file:
            raise ValueError("file: is missing")
        return self

    @property
    def options(self) -> dict[str, Any]:
        """The options that belong to the file's format, as they were stated."""
        return dict(self.model_extra or {})


class RigidTransform(YamlModel):
    """A place and a rotation."""

    translation: Vector = [0.0, 0.0, 0.0]
    """Place, m: of the camera on its body (forward, left, up), or of a source's zero in the world."""
    rotation_xyzw: Quaternion | None = None
    """Rotation body_from_camera or world_from_source, in place of `looks` or `yaw_deg`."""


class ScaledSource(YamlModel):
    """Positions in a unit of their own."""

    scale: float = Field(1.0, gt=0)
    """Metres in the world for a metre of the source."""


class Placement(RigidTransform, ScaledSource):
    """Pose in the world of the origin of a source."""

    yaw_deg: float = 0.0
    """Angle from the world's axes to the source's about the vertical, degrees."""

    @model_validator(mode="after")
    def _one_rotation(self) -> Placement:
        if self.yaw_deg and self.rotation_xyzw is not None:
            raise ValueError("has yaw_deg and rotation_xyzw: leave one of them out")
        return self


class OwnAxes(YamlModel):
    """A source with axes of its own."""

    axes: Axes | None = None
    """Axes; without them, those of the log or the world."""


class PlacedSource(OwnAxes):
    """A source with a place of its own."""

    world_from_source: Placement = Placement()
    """Place in the world of the source's zero, and its axes."""


class UprightSource(YamlModel):
    """A source with an up axis of its own."""

    up: Up | None = None
    """Axis that points up, z if nothing says so; of the world, in all sources without axes of their own."""


class ProjectedSource(YamlModel):
    """Coordinates that may be those of a map projection."""

    crs: str | None = None
    """Map projection of the coordinates, `EPSG:32632` for example; of the world, in all sources."""


class MeasuredSource(YamlModel):
    """Numbers with a unit of length."""

    unit: Unit | None = None
    """Unit of the positions, m unless the file states another one."""


class DelayedSource(YamlModel):
    """Times with a zero of their own."""

    offset_ns: SecondsAsNs = Field(0, alias="offset_s")
    """Seconds that are added to the times."""


class WorldOrigin(YamlModel):
    """Place on Earth of the world's origin."""

    latitude_deg: float = Field(ge=-90, le=90)
    """Latitude, degrees north."""
    longitude_deg: float = Field(ge=-180, le=180)
    """Longitude, degrees east."""
    altitude_m: float = 0.0
    """Height, m."""


class WorldAxes(Guess, UprightSource, ProjectedSource, ScaledSource):
    """The axes of all sources that do not state their own, and the world's origin."""

    frame: Axes = "enu"
    """Axes of all sources that do not state their own: east, north, up or north, east, down."""
    origin: WorldOrigin | None = None
    """Place on Earth of the world's origin; without it, the first position of the first camera."""

    @model_validator(mode="after")
    def _one_way_up(self) -> WorldAxes:
        if self.frame == "ned" and self.up not in {None, "z"}:
            raise ValueError("up: frame: ned has z down: leave one of them out")
        return self


class LogClock(DelayedSource):
    """Relation of a recorder's clock to the world's."""

    drift_ppm: float = Field(0.0, ge=-100_000, le=100_000)
    """Drift of the log's clock since its first message, parts per million."""


class LogSource(Guess, PlacedSource):
    """A recording: one file or several parts of it."""

    shorthand = "file"
    file: Annotated[
        list[str], BeforeValidator(lambda v: [v] if isinstance(v, str) else v), Field(min_length=1)
    ]
    """A file, the folder of a bag, or the parts of a split log in their order."""
    stamps: Literal["header", "receive"] = "header"
    """Times that count: those in the messages, or those at which the recorder received them."""
    clock: LogClock = LogClock()
    """Relation of the log's clock to the world's."""


class VideoSource(FileSource):
    """A video, a folder of pictures, or pictures in a log."""


class FrameTimes(FileSource):
    """Source of the frames' times; by default the container's stamps, counted from `start`."""

    needs_file = False
    start_ns: Start = Field(0, alias="start")
    """Time of the first picture, s; or `container`: the video's metadata have it."""
    fps: Fps | None = None
    """Frame rate, which replaces the stamps of the video: 30, 29.97 or 30000/1001."""

    @model_validator(mode="after")
    def _from_one_place(self) -> FrameTimes:
        counted = (("start", "start_ns"), ("fps", "fps"))
        stated = [key for key, name in counted if name in self.model_fields_set]
        if self.file and stated:
            problem = f"has {', '.join(['file', *stated])}, which say different things of the same pictures"
            raise ValueError(f"{problem}: leave all but one of them out")
        if self.topic is not None and not self.file:
            raise ValueError("topic: needs the file of the log that holds it")
        return self

    @property
    def has_start(self) -> bool:
        """True if a start is stated, even 0."""
        return "start_ns" in self.model_fields_set

    @property
    def is_placed(self) -> bool:
        """True if the times are world times: more than a rate, or the container's stamps from 0 on."""
        return self.has_start or bool(self.file)


class CameraClock(Guess, DelayedSource):
    """World time = video time + offset."""

    sigma_s: float = Field(0.2, ge=0)
    """Standard deviation of the offset, s; 0 means that it is known."""


class PoseSource(PlacedSource, MeasuredSource, FileSource):
    """Source of a camera's poses: a trajectory, a log, a drone's own log or a calibration."""

    part = "pose"
    needs_file = False
    of: Literal["camera", "body"] | None = None
    """Object of the poses: the camera, or the body that carries it by a mount or gimbal."""
    attitude: str | None = None
    """Topic of attitudes, for a topic of positions; or `pictures`: the camera's film shows how it turned."""

    @model_validator(mode="before")
    @classmethod
    def _of_no_file(cls, value: object) -> object:
        return {"attitude": PICTURES} if value in (PICTURES, {"file": PICTURES}) else value

    @model_validator(mode="after")
    def _complete(self) -> PoseSource:
        if not self.file and not (self.by_pictures and self.model_fields_set == {"attitude"}):
            raise ValueError("file: is missing; `pose: pictures` alone says that no log has any place")
        return self

    @property
    def by_pictures(self) -> bool:
        """True if the attitudes are found by the camera's film; without a file, the places, too."""
        return self.attitude == PICTURES


class Mount(Guess, RigidTransform):
    """Pose of the camera on the body."""

    one_of = ("looks", "rotation_xyzw")
    looks: Looks | None = None
    """Direction in which the camera looks, seen from the body."""
    down_deg: float = 0.0
    """Angle by which the camera looks down from there, degrees."""


class GimbalSource(OwnAxes, FileSource):
    """Source of the gimbal's angles: a topic, fixed angles, another log, or the log that gives the pose."""

    needs_file = False
    part = "gimbal"
    yaw_deg: float | None = Field(None, ge=-360, le=360)
    """Constant yaw from north to east, degrees."""
    pitch_deg: float | None = Field(None, ge=-180, le=180)
    """Constant pitch, up, degrees."""
    roll_deg: float = Field(0.0, ge=-180, le=180)
    """Constant roll to the right, degrees."""
    relative_to: RelativeTo | None = None
    """Reference of the angles: the world, the body, or a level frame with the body's heading."""

    @model_validator(mode="after")
    def _complete(self) -> GimbalSource:
        if not self.file:
            if self.topic is not None:
                raise ValueError("topic: needs the file of the log that holds it")
            if (self.yaw_deg is None) != (self.pitch_deg is None):
                raise ValueError("constant angles need both yaw_deg and pitch_deg")
            if not self.is_fixed and self.relative_to is None:
                raise ValueError(
                    "needs a file, constant angles {yaw_deg, pitch_deg}, or what the drone's own angles are"
                    " relative_to: world, body or heading"
                )
        elif self.pitch_deg is not None:
            raise ValueError("has a file and constant angles: leave one of them out")
        elif self.topic is not None and self.relative_to is None:
            raise ValueError("lacks relative_to: world, body or heading, which its angles are relative to")
        return self

    @property
    def is_fixed(self) -> bool:
        """True if the angles are constant."""
        return self.pitch_deg is not None

    @property
    def is_of_pose(self) -> bool:
        """True if the angles are those of the log that gives the pose."""
        return not self.file and not self.is_fixed


class IntrinsicsSource(FileSource):
    """A calibration file (and which of its cameras), a topic, or the numbers themselves."""

    needs_file = False
    part = "intrinsics"
    one_of = ("file", "fx")
    width: Side | None = None
    """Width of the pictures, px."""
    height: Side | None = None
    """Height of the pictures, px."""
    fx: float | None = Field(None, gt=0)
    """Focal length across, px."""
    fy: float | None = Field(None, gt=0)
    """Focal length down, px."""
    cx: float | None = None
    """Column of the principal point, px from the centre of the first pixel."""
    cy: float | None = None
    """Row of the principal point, px from the centre of the first pixel."""
    model: Literal["radtan", "fisheye"] = "radtan"
    """Model of the distortion."""
    distortion: list[float] = []
    """Coefficients of the distortion, as OpenCV orders them."""
    readout_s: float = Field(0.0, ge=0)
    """Time from the first to the last row of a rolling shutter, s."""

    @model_validator(mode="after")
    def _complete(self) -> IntrinsicsSource:
        if self.fx is not None:
            missing = [n for n in ("width", "height", "fy", "cx", "cy") if getattr(self, n) is None]
            if missing:
                raise ValueError(f"lacks {', '.join(missing)}")
        return self


class KeypointSource(FileSource):
    """2D keypoints of this camera, made by a detector of the user's own."""

    part = "keypoints"
    first_frame: int = Field(0, ge=-_MAX_FRAME_NUMBER, le=_MAX_FRAME_NUMBER)
    """Number that the file gives to the first picture of the video."""
    mirrored: bool | Literal["x", "y", "names"] = False
    """True for mirrored pictures; `x`, `y` or `names` where only columns, rows or left and right are."""
    image_size: Annotated[list[Side], Field(min_length=2, max_length=2)] | None = None
    """Width and height of the pictures that the detector saw, px."""


class CameraSources(YamlModel):
    """One camera in the air, or on the ground."""

    video: VideoSource | None = None
    """The pictures."""
    frame_times: FrameTimes | None = None
    """Times of the pictures."""
    clock: CameraClock | None = None
    """Clock of the pictures, relative to the world's."""
    pose: PoseSource = Field(
        examples=[
            "pose: drone1.tum, {file: drone1.mcap, topic: /odometry, of: body}, a calibration with poses, or"
            " `pictures` for two or more cameras that move and have no log at all"
        ]
    )
    """Poses of the camera."""
    mount: Mount | None = None
    """Pose of the camera on the body whose poses are logged."""
    gimbal: GimbalSource | None = None
    """Angles of the gimbal that turns the camera."""
    intrinsics: IntrinsicsSource = Field(
        examples=[
            "intrinsics: lens.yaml (OpenCV, ROS, Kalibr, TOML, COLMAP), {file: drone1.mcap, topic: /info}, or"
            " {width: 1920, height: 1080, fx: 1400, fy: 1400, cx: 959.5, cy: 539.5}"
        ]
    )
    """Lens."""
    keypoints: KeypointSource | None = None
    """Keypoints of a detector of your own."""
    pose_noise: dict[str, dict[str, float | str]] | None = None
    """Known errors of the poses: parameters by noise model."""

    @model_validator(mode="after")
    def _has_pictures(self) -> CameraSources:
        if self.video is None and self.keypoints is None:
            raise ValueError("needs a video or keypoints: write video: drone1.mp4 or keypoints: drone1.json")
        if self.pose.of == "body" and not self.is_carried:
            raise ValueError("pose is of the body: say how the camera sits on it with `mount` or `gimbal`")
        if self.pose.of == "camera" and self.is_carried:
            raise ValueError("a mount or gimbal needs the pose of the body: add `of: body` to `pose`")
        if self.pose.by_pictures and self.is_carried:
            raise ValueError("pose.attitude: pictures gives the camera's own: leave mount and gimbal out")
        if self.pose.by_pictures and self.video is None:
            raise ValueError("pose.attitude: pictures needs a video")
        if not self.pose.file:
            if self.frame_times is None or not self.frame_times.is_placed:
                raise ValueError(
                    "pose: pictures needs the time of the first picture, frame_times: {start: container} or"
                    " {start: SECONDS}: cameras are joined by people at equal times"
                )
            if self.pose_noise:
                raise ValueError("pose: pictures finds its own errors: leave pose_noise out")
        return self

    @property
    def is_carried(self) -> bool:
        """True if the camera has a mount or a gimbal."""
        return self.mount is not None or self.gimbal is not None


class ActorSource(FileSource):
    """Source of a person's positions, logged in flight."""

    point: Literal["hip", "head", "feet", "centre"] = "hip"
    """Point of the person that the positions follow."""
    weight: float = Field(1.0, ge=0, allow_inf_nan=False)
    """Weight of this person for the planners, among several."""


class MapSource(ProjectedSource, FileSource):
    """Source of the map of the surroundings."""

    part = "map"
    unknown: Literal["free", "occupied", "avoided"] = "free"
    """Voxels that nothing is known of: free, occupied, or avoided by drones but not in a camera's way."""
    resolution_m: float | None = Field(None, gt=0)
    """Side of the voxels that a cloud of points is divided into, m."""

    @field_validator("unknown", mode="before")
    @classmethod
    def _in_two_words(cls, stated: object) -> object:
        """Read `{fly: no, see: yes}` as one word; nothing that hides can be flown through."""
        if not isinstance(stated, dict) or set(stated) != {"fly", "see"}:
            return stated
        if any(each not in (True, False, "yes", "no") for each in stated.values()):
            return stated
        fly, see = (stated[key] in (True, "yes") for key in ("fly", "see"))
        if fly:
            return "free" if see else stated
        return "avoided" if see else "occupied"


class TruthSource(OwnAxes, UprightSource, MeasuredSource, DelayedSource, FileSource):
    """Sources of ground truth: joints, and camera poses by camera."""

    needs_file = False
    subject: str | None = None
    """Name of the person before the joints' names, in a file of several."""
    fps: float | None = Field(None, gt=0, le=100_000)
    """Frames a second of a file of joints without times; `offset_s` is then the time of frame 0."""
    poses: dict[str, str] = {}
    """Files of true poses by camera."""
    body: str | None = None
    """Table of true bodies of a simulated flight, `body.parquet`, beside its `body_shape.parquet`."""


def shape_file(body: str) -> str:
    """Return the file of shapes that stands beside a table of bodies."""
    return body.removesuffix(".parquet") + "_shape.parquet"


class PlanSource(FileSource):
    """Setpoints of the on-board planner for one drone."""


class Manifest(YamlModel):
    """One flight, as `flight.yaml` describes it."""

    schema_version: Literal[1] = Field(alias="schema")
    """Version of this description: 1."""
    name: str = Field("", max_length=1000)
    """Name of the flight; without it, that of the file."""
    world: WorldAxes = WorldAxes()
    """Axes and origin of the world."""
    simulated: bool = False
    """True for a flight of `mocap simulate`."""
    clock_reference: str | None = None
    """Camera whose clock is held when no clock is known; without it, the first."""
    logs: dict[str, LogSource] = {}
    """Recordings by name, for settings that all their topics share."""
    cameras: dict[str, CameraSources] = Field(min_length=1, max_length=128)
    """Cameras by name."""
    actor: ActorSource | None = None
    """Logged positions of the actor."""
    actors: dict[str, ActorSource] = {}
    """Logged positions of several people by name."""
    stature_m: float | None = Field(None, ge=0.5, le=2.5)
    """Height of the people who are filmed, m: with it, a single camera places them better."""
    map: MapSource | None = None
    """Map of the surroundings."""
    truth: TruthSource | None = None
    """Ground truth of joints and camera poses."""
    plan: dict[str, PlanSource] = {}
    """Commands of the on-board planner by camera."""

    @model_validator(mode="after")
    def _names_exist(self) -> Manifest:
        refuse_names(self.cameras, "camera")
        refuse_names(self.actors, "person")
        if self.actor is not None and self.actors:
            raise ValueError("actor and actors: leave one of them out")
        if self.logged_people and not any(actor.weight for actor in self.logged_people.values()):
            raise ValueError("weight: somebody must have one above 0")
        lone = [name for name, camera in self.cameras.items() if not camera.pose.file]
        if lone and (len(lone) == 1 or len(lone) < len(self.cameras)):
            raise ValueError(
                f"cameras.{lone[0]}.pose: pictures joins two or more cameras, and all of a flight: name a log"
                " of its places, {file: LOG, attitude: pictures}"
            )
        placed = [key for key in ("actor", "actors", "map", "truth", "plan") if getattr(self, key)]
        placed += ["world.origin"] * (self.world.origin is not None)
        if lone and placed:
            raise ValueError(f"{placed[0]}: `pose: pictures` has a frame of its own: leave it out")
        named = [("clock_reference", self.clock_reference)] if self.clock_reference else []
        named += [("truth.poses", name) for name in (self.truth.poses if self.truth else ())]
        named += [("plan", name) for name in self.plan]
        for key, name in named:
            if name not in self.cameras:
                near = difflib.get_close_matches(name, self.cameras, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(self.cameras)}"
                raise ValueError(f"{key}: {name!r} is no camera of this flight, {hint}")
        for part in ("video", "keypoints"):
            owners: dict[object, str] = {}
            for name, camera in self.cameras.items():
                source = getattr(camera, part)
                same = source and owners.setdefault((source.file, source.topic), name)
                if same not in {None, name}:
                    raise ValueError(f"cameras.{name}.{part}: is that of {same}, {source.file}")
        return self

    @property
    def logged_people(self) -> dict[str, ActorSource]:
        """The people who were logged, by name; whom `actor:` states has none (the empty name)."""
        return {"": self.actor} if self.actor else self.actors

    @property
    def assumptions(self) -> list[str]:
        """The keys of all mappings with `assumed: true`, as `cameras.drone1.frame_times`."""
        return list(_assumed_in(self.model_dump(), ""))

    @property
    def reference_camera(self) -> str:
        """The camera whose clock offset is held where none is known and no background shows one."""
        return self.clock_reference or next(iter(self.cameras))

    @property
    def files(self) -> list[str]:
        """Every path and URL that the manifest states, each once, spelled as in it."""
        sources: list[FileSource | None] = [
            *self.logged_people.values(),
            self.map,
            *self.plan.values(),
            self.truth,
        ]
        for camera in self.cameras.values():
            sources += [camera.pose, camera.intrinsics, camera.keypoints, camera.gimbal]
            sources += [camera.frame_times, camera.video]
        named = [source.file for source in sources if source is not None and source.file]
        if self.truth:
            named += list(self.truth.poses.values())
            named += [self.truth.body, shape_file(self.truth.body)] if self.truth.body else []
        return list(dict.fromkeys(path for name in named for path in self.paths_of(name)))

    def paths_of(self, file: str) -> list[str]:
        """Return the paths of a `file:`, several if it names a split log."""
        return self.logs[file].file if file in self.logs else [file]


def _assumed_in(mapping: Mapping[str, Any], place: str) -> Iterator[str]:
    if mapping.get("assumed"):
        yield f"{place}.fx" if mapping.get("fx") else place  # a lens without a calibration is a guess
    for key, value in mapping.items():
        if isinstance(value, dict):
            yield from _assumed_in(value, f"{place}.{key}" if place else key)


def read_flight(path: Path) -> Manifest:
    """Read and validate a manifest; one DataError holds every problem that was found."""
    others = []
    if path.suffix.lower() not in {".yaml", ".yml"} and path.exists():
        others = [format_.title for format_ in FORMATS.all() if format_.recognises(path)]
    if path.is_dir() or others:
        problem = f"is no flight manifest but {' or '.join(others) or 'a folder'}"
        raise DataError(path, problem, "`mocap run FOLDER` drafts one and runs its flight", code="wrong-kind")
    flight = read_yaml_model(
        path,
        Manifest,
        "flight manifest",
        newest=SCHEMA,
        shape="a mapping with `schema: 1` and `cameras:`",
        made="`mocap init FOLDER` drafts one",
    )
    return flight if flight.name else flight.model_copy(update={"name": path.stem})
