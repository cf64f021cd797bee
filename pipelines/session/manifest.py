"""`flight.yaml`: the files of one flight and how they belong together (DESIGN, section 4).

The whole schema is defined here, including the parts that have no reader yet. Those are valid, but the
stage that needs them refuses them. All problems of a manifest are reported in one message, an unknown key
with the nearest known one.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from pipelines.geometry.mounting import RelativeTo
from pipelines.session.storage import refuse_camera_names, refuse_names_of_people
from pipelines.session.yaml_files import Part, SecondsAsNs, nanoseconds, read_yaml_model

SCHEMA = 1

_MOST_FRAMES = 10**9  # a year at 30 Hz

Axes = Literal["enu", "ned"]
Side = Annotated[int, Field(gt=0, le=100_000)]
"""Pixels along one side of a picture."""
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Quaternion = Annotated[list[float], Field(min_length=4, max_length=4)]


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
    if not Fraction(1, 1000) <= fps <= 100_000:
        raise ValueError("is no frame rate; it must lie between 0.001 and 100000")
    return fps


def _seconds(value: float) -> float:
    nanoseconds(value)
    return value


Fps = Annotated[Fraction, BeforeValidator(_fps)]
Seconds = Annotated[float, AfterValidator(_seconds)]
"""Seconds that can be added to any time."""


class Guess(Part):
    """A mapping of which something may be a guess of `mocap init` that nobody has confirmed yet."""

    assumed: bool = False


class Origin(Part):
    """Place on Earth of the world's origin."""

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-180, le=180)
    altitude_m: float = 0.0


class World(Guess):
    """The axes of all sources that do not state their own, and the world's origin."""

    frame: Axes = "enu"
    origin: Origin | None = None
    crs: str | None = None  # of positions in metres that are those of a map projection: EPSG:32632


class LogClock(Part):
    """Relation of a recorder's clock to the world's: the offset at the first message, and the drift since."""

    offset_s: Seconds = 0.0
    drift_ppm: float = Field(0.0, ge=-100_000, le=100_000)


class WorldFromLog(Part):
    """Pose in the world of the origin of a drone's estimator."""

    translation: Vector = [0.0, 0.0, 0.0]
    yaw_deg: float = 0.0


class Log(Guess):
    """A recording: one file or several parts of it."""

    shorthand = "path"
    path: Annotated[
        list[str], BeforeValidator(lambda v: [v] if isinstance(v, str) else v), Field(min_length=1)
    ]
    stamps: Literal["header", "receive"] = "header"
    axes: Axes | None = None
    clock: LogClock = LogClock()
    world_from_log: WorldFromLog = WorldFromLog()


class Video(Guess):
    """A video file, or pictures in a log."""

    shorthand = "path"
    one_of = ("path", "log")
    path: str | None = None
    log: str | None = None
    topic: str | None = None


_COUNTED = (("start", "start_ns"), ("start_from", "start_from"), ("fps", "fps"))  # not with other keys


TriggerLog = Literal["ulog", "ardupilot", "tlog"]


class FrameTimes(Guess):
    """Source of the frames' times; by default the container's stamps, counted from `start`."""

    start_ns: SecondsAsNs = Field(0, alias="start")
    # container: the creation time that the video states; motion: the start at which the pictures turn as
    # the poses do.
    start_from: Literal["container", "motion"] | None = None
    fps: Fps | None = None
    csv: str | None = None
    log: str | None = None
    topic: str | None = None
    srt: str | None = None
    ulog: str | None = None  # triggers that an autopilot logged, one for each frame
    ardupilot: str | None = None
    tlog: str | None = None

    @model_validator(mode="after")
    def _from_one_place(self) -> FrameTimes:
        every = ("csv", "srt", "log", "ulog", "ardupilot", "tlog")
        stated = [name for name in every if getattr(self, name) is not None]
        counted = [key for key, name in _COUNTED if name in self.model_fields_set]
        if len(stated) > 1 or (stated and counted):
            problem = f"has {', '.join(stated + counted)}, which say different things of the same pictures"
            raise ValueError(f"{problem}: leave all but one of them out")
        if self.topic is not None and self.log is None:
            raise ValueError("topic: needs the log that holds it")
        return self

    @property
    def has_start(self) -> bool:
        """True if a start is stated, even 0."""
        return "start_ns" in self.model_fields_set

    @property
    def is_placed(self) -> bool:
        """True if the times are world times: more than a rate, or the container's stamps from 0 on."""
        named = (self.start_from, self.csv, self.log, self.srt, self.triggers)
        return self.has_start or any(source is not None for source in named)

    @property
    def triggers(self) -> tuple[TriggerLog, str] | None:
        """Format and log of the triggers in a drone's own log; None without one."""
        stated: dict[TriggerLog, str | None] = {
            "ulog": self.ulog,
            "ardupilot": self.ardupilot,
            "tlog": self.tlog,
        }
        return next(((kind, log) for kind, log in stated.items() if log is not None), None)


class Clock(Guess):
    """World time = video time + offset; sigma 0 means that it is known."""

    offset_ns: SecondsAsNs = Field(0, alias="offset_s")
    sigma_s: float = Field(0.2, ge=0)


class StaticPose(Part):
    """A calibration file with the pose of a camera that stands still."""

    shorthand = "path"
    path: str
    camera: str | None = None


OwnLog = Literal["dji", "ulog", "ardupilot", "tlog", "gopro"]
"""The key of a drone's own log in a pose."""


class PoseSource(Guess):
    """Source of a camera's poses."""

    one_of = ("log", "tum", "csv", "static", *get_args(OwnLog))
    log: str | None = None
    topic: str | None = None
    parent: str | None = None
    child: str | None = None
    preset: Literal["dji_osdk", "mavros", "px4"] | None = None  # the usual topics of a driver, in a log
    namespace: str | None = None  # of the preset's topics, where a log holds several drones: /uav1
    attitude: str | None = None  # topic of attitudes, if `topic` has only positions (NavSatFix, PointStamped)
    tum: str | None = None
    csv: str | None = None
    static: StaticPose | None = None
    dji: str | None = None  # subtitles beside a video, a flight record as CSV, or pictures
    ulog: str | None = None  # PX4
    ardupilot: str | None = None  # DataFlash .bin
    tlog: str | None = None  # of a ground station
    gopro: str | None = None  # video with a track of GPMF
    position: Literal["local", "global", "gps"] | None = None  # which of a drone's own estimates
    instance: int | None = Field(None, ge=0, le=255)
    time: Literal["gps", "boot"] | None = None
    altitude: Literal["relative", "absolute"] | float | None = None  # or metres, held throughout
    of: Literal["camera", "body"] | None = None
    axes: Axes | None = None
    inverse: bool = False  # the file has camera_from_world, or body_from_world
    quaternion: Literal["xyzw", "wxyz"] | None = None  # the order in which the file has it [its format's]
    unit: Literal["m", "cm", "mm", "ft"] = "m"  # of its positions
    z: Literal["up", "down"] = "up"  # where its positions count to, where its axes are east, north, up else
    world_from_source: WorldFromLog = WorldFromLog()  # where the file's zero and north lie in the world

    @model_validator(mode="after")
    def _only_where_it_belongs(self) -> PoseSource:
        autopilot = any(part is not None for part in (self.ulog, self.ardupilot, self.tlog))
        allowed = {
            ("topic", "parent", "child", "preset", "attitude"): (self.log is not None, "from a log"),
            ("namespace",): (self.preset is not None, "by a preset"),
            ("position",): (autopilot or self.preset is not None, "by ulog, ardupilot, tlog or a preset"),
            ("instance", "time"): (autopilot, "by ulog, ardupilot or tlog"),
            ("altitude",): (self.dji is not None, "by dji"),
            ("axes",): (
                not self.is_telemetry or self.attitude is not None,
                "that is no drone's own log (those state theirs)",
            ),
            ("inverse", "quaternion", "unit", "z"): (
                not self.is_telemetry and self.static is None,
                "from a log, tum or csv",
            ),
            ("world_from_source",): (self.static is None, "that moves"),
        }
        for names, (may, whose) in allowed.items():
            unasked = {name: type(self).model_fields[name].default for name in names}
            stated = [name for name, default in unasked.items() if getattr(self, name) != default]
            if stated and not may:
                raise ValueError(f"{', '.join(stated)}: only a pose {whose} has that")
        if (self.parent is None) != (self.child is None):
            raise ValueError("needs both parent and child, or neither")
        if self.preset and (self.topic or self.parent):
            raise ValueError("has a preset and names topics or frames: leave one of them out")
        if self.attitude and (self.topic is None or self.preset or self.parent):
            raise ValueError(
                "attitude: needs the topic of the positions beside it, and neither preset nor frames"
            )
        return self

    @property
    def is_telemetry(self) -> bool:
        """True if position and attitude come separately, from a drone's own log or its driver's topics."""
        return self.own_log is not None or self.preset is not None or self.attitude is not None

    @property
    def own_log(self) -> tuple[OwnLog, str] | None:
        """Key and path of the drone's own log; None for poses of another kind."""
        keys: tuple[OwnLog, ...] = get_args(OwnLog)
        return next(((key, stated) for key in keys if (stated := getattr(self, key)) is not None), None)

    @property
    def telemetry_source(self) -> str:
        """The log of positions and attitudes as the manifest names it."""
        return self.own_log[1] if self.own_log else self.log or ""


class RigidTransform(Part):
    """Translation in metres and a unit quaternion."""

    translation: Vector
    rotation_xyzw: Annotated[Quaternion, AfterValidator(_unit_quaternion)]


class Mount(Guess):
    """Pose of the camera on the body."""

    looks: Literal["forward", "backward", "left", "right", "down", "up"] | None = None
    down_deg: float = 0.0
    translation: Vector = [0.0, 0.0, 0.0]
    body_from_camera: RigidTransform | None = None
    one_of = ("looks", "body_from_camera")


class FixedAngles(Part):
    """Constant direction of a camera in DJI's angles: yaw from north to east, pitch up, roll right."""

    yaw_deg: float = Field(ge=-360, le=360)
    pitch_deg: float = Field(ge=-180, le=180)
    roll_deg: float = Field(0.0, ge=-180, le=180)


AngleLog = Literal["dji", "gopro"]
"""The key of a log in a gimbal, whose angles of the camera are used without its positions."""


_ANGLE_LOGS: tuple[AngleLog, ...] = get_args(AngleLog)


class Gimbal(Guess):
    """Source of the gimbal's angles: a topic, fixed angles, another log, or the log that gives the pose."""

    log: str | None = None
    topic: str | None = None
    fixed: FixedAngles | None = None
    dji: str | None = None  # flight record or subtitles
    gopro: str | None = None  # video with a track of GPMF
    yaw_deg: float | None = Field(None, ge=-360, le=360)  # heading of the first picture, where none is logged
    relative_to: RelativeTo | None = None
    order: Literal["ypr", "rpy", "pry"] = "ypr"
    units: Literal["deg", "rad"] = "deg"
    axes: Axes | None = None

    @model_validator(mode="after")
    def _complete(self) -> Gimbal:
        sources: dict[str, object] = {"a log": self.log, "fixed angles": self.fixed}
        sources |= {key: getattr(self, key) for key in _ANGLE_LOGS}
        if len(stated := [name for name, source in sources.items() if source is not None]) > 1:
            raise ValueError(f"has {' and '.join(stated)}: leave all but one of them out")
        if self.gopro is not None and self.yaw_deg is None:
            raise ValueError(
                "lacks yaw_deg, the heading of the first picture from north to east: a GoPro logs how it"
                " turned from there on, not where north is"
            )
        if self.gopro is None and self.yaw_deg is not None:
            raise ValueError("yaw_deg: only a gopro has that; write fixed: {yaw_deg, pitch_deg}")
        if self.gopro is not None and self.relative_to not in {None, "world"}:
            raise ValueError("relative_to: a GoPro's attitudes are those in the world, leave it out")
        if self.own_log is not None and self.topic is None:
            return self
        if self.log is not None:
            missing = [name for name in ("topic", "relative_to") if getattr(self, name) is None]
            if missing:
                raise ValueError(f"lacks {', '.join(missing)}")
        elif self.topic is not None:
            raise ValueError("topic: needs the log that holds it")
        elif self.fixed is None and self.relative_to is None:
            raise ValueError("needs log and topic, fixed angles, or what the drone's own are relative_to")
        return self

    @property
    def own_log(self) -> tuple[AngleLog, str] | None:
        """Key and path of the log whose angles are used without its positions; None for another source."""
        return next(((key, path) for key in _ANGLE_LOGS if (path := getattr(self, key)) is not None), None)

    @property
    def is_of_pose(self) -> bool:
        """True if the angles are those of the log that gives the pose."""
        return self.log is None and self.fixed is None and self.own_log is None


class IntrinsicsSource(Guess):
    """A calibration file (and which of its cameras), a topic, or the numbers themselves."""

    shorthand = "path"
    one_of = ("path", "log", "fx")
    path: str | None = None
    camera: str | None = None
    log: str | None = None
    topic: str | None = None
    width: Side | None = None
    height: Side | None = None
    fx: float | None = Field(None, gt=0)
    fy: float | None = Field(None, gt=0)
    cx: float | None = None
    cy: float | None = None
    model: Literal["radtan", "fisheye"] = "radtan"
    distortion: list[float] = []
    readout_s: float = Field(0.0, ge=0)

    @model_validator(mode="after")
    def _complete(self) -> IntrinsicsSource:
        if self.fx is not None:
            missing = [n for n in ("width", "height", "fy", "cx", "cy") if getattr(self, n) is None]
            if missing:
                raise ValueError(f"lacks {', '.join(missing)}")
        return self


class KeypointSource(Guess):
    """2D keypoints of this camera, made by a detector of the user's own."""

    shorthand = "path"
    path: str
    format: str | None = None
    skeleton: str | None = None
    first_frame: int = Field(0, ge=-_MOST_FRAMES, le=_MOST_FRAMES)
    # true: found in mirrored pictures; x counts from the right, y from below; names: left is right
    mirrored: bool | Literal["x", "y", "names"] = False
    image_size: Annotated[list[Side], Field(min_length=2, max_length=2)] | None = None


class Camera(Part):
    """One camera in the air (or on the ground)."""

    video: Video | None = None
    frame_times: FrameTimes | None = None
    clock: Clock | None = None
    pose: PoseSource
    mount: Mount | None = None
    gimbal: Gimbal | None = None
    intrinsics: IntrinsicsSource
    keypoints: KeypointSource | None = None
    pose_noise: dict[str, dict[str, float | str]] | None = None

    @model_validator(mode="after")
    def _has_pictures(self) -> Camera:
        if self.video is None and self.keypoints is None:
            raise ValueError("needs a video or keypoints")
        carried = self.mount is not None or self.gimbal is not None
        if self.pose.of == "body" and not carried:
            raise ValueError("pose is of the body: say how the camera sits on it with `mount` or `gimbal`")
        may_carry = (self.pose.log or self.pose.is_telemetry) and self.pose.of is None
        if carried and self.pose.of != "body" and not may_carry:
            raise ValueError("a mount or gimbal needs the pose of the body: add `of: body` to `pose`")
        gimbal = self.gimbal
        if gimbal and gimbal.is_of_pose and not self.pose.is_telemetry:
            raise ValueError("gimbal: needs log and topic, or fixed: {yaw_deg: 90, pitch_deg: -30}")
        if self.pose.static and self.pose.of == "body":
            raise ValueError("a still camera's pose is its own: leave `of: body` and the mount out")
        times = self.frame_times
        found = times is not None and times.start_from == "motion" and not times.has_start
        if found and self.clock is not None and self.clock.offset_ns:
            raise ValueError(
                "clock.offset_s: start_from: motion finds the start in world time: leave the offset out, or"
                " state the start that it is added to"
            )
        return self


class Actor(Guess):
    """Source of the actor's positions, logged in flight."""

    log: str
    topic: str | None = None
    point: Literal["hip", "head", "feet", "centre"] = "hip"
    weight: float = Field(1.0, ge=0, allow_inf_nan=False)  # of several people, for the planners


class Map(Part):
    """Source of the map of the surroundings."""

    shorthand = "path"
    one_of = ("path", "log")
    path: str | None = None
    log: str | None = None
    topic: str | None = None
    parent: str | None = None  # the frame that is the log's world
    crs: str | None = None  # of its coordinates [world.crs]
    unknown: Literal["free", "occupied"] = "free"
    resolution_m: float | None = Field(None, gt=0)
    height_m: float | None = Field(None, gt=0, le=1000)  # of obstacles on a logged floor plan

    @model_validator(mode="after")
    def _only_of_logs(self) -> Map:
        stated = [name for name in ("topic", "parent", "height_m") if getattr(self, name) is not None]
        if stated and self.log is None:
            raise ValueError(f"{', '.join(stated)}: only a map from a log has that")
        return self


class TruthJoints(Part):
    """True joints, with unit and axes where the file leaves them open."""

    shorthand = "path"
    path: str
    format: str | None = None
    unit: Literal["m", "cm", "mm"] | None = None
    axes: Literal["z-up", "y-up", "ned"] | None = None
    offset_s: Seconds = 0.0  # added to the times of the file: those of a C3D begin at 0


class Truth(Part):
    """Sources of ground truth: joints, and camera poses by camera."""

    shorthand = "joints"
    joints: TruthJoints | None = None
    poses: dict[str, str] = {}


class PlannedTopic(Part):
    """A topic of commanded positions, and its log where that is not the plan's `log`."""

    shorthand = "topic"
    topic: str
    log: str | None = None


class Plan(Part):
    """Setpoints of the on-board planner by camera: topics of a log, or files of poses."""

    log: str | None = None
    topics: dict[str, PlannedTopic] = {}
    files: dict[str, str] = {}

    @model_validator(mode="after")
    def _complete(self) -> Plan:
        if not self.topics and not self.files:
            raise ValueError("needs `topics` or `files` by camera: {drone1: /drone1/setpoint}")
        twice = [name for name in self.topics if name in self.files]
        if twice:
            raise ValueError(f"{twice[0]} has a topic and a file: leave one of them out")
        without = [name for name, stated in self.topics.items() if not (stated.log or self.log)]
        if without:
            raise ValueError(f"the topic of {without[0]} needs a `log`")
        return self

    @property
    def cameras(self) -> list[str]:
        """The cameras that have a topic or a file."""
        return [*self.topics, *self.files]

    def log_of(self, camera: str) -> str:
        """Return the log of a camera's topic."""
        return self.topics[camera].log or self.log or ""


class Flight(Part):
    """One flight, as `flight.yaml` states it."""

    schema_version: Literal[1] = Field(alias="schema")
    name: str = Field("", max_length=1000)
    world: World = World()
    simulated: bool = False
    clock_reference: str | None = None
    logs: dict[str, Log] = {}
    cameras: dict[str, Camera] = Field(min_length=1, max_length=128)
    actor: Actor | None = None
    actors: dict[str, Actor] = {}
    map: Map | None = None
    truth: Truth | None = None
    plan: Plan | None = None

    @model_validator(mode="after")
    def _names_exist(self) -> Flight:
        refuse_camera_names(self.cameras)
        refuse_names_of_people(self.actors)
        if self.actor is not None and self.actors:
            raise ValueError("actor and actors: leave one of them out")
        if self.logged_people and not any(actor.weight for actor in self.logged_people.values()):
            raise ValueError("weight: somebody must have one above 0")
        named = [self.clock_reference] if self.clock_reference else []
        named += list(self.truth.poses) if self.truth else []
        named += self.plan.cameras if self.plan else []
        for name in named:
            if name not in self.cameras:
                near = difflib.get_close_matches(name, self.cameras, n=1)
                raise ValueError(
                    f"{name!r} is no camera of this flight" + (f", did you mean {near[0]!r}?" if near else "")
                )
        return self

    @property
    def logged_people(self) -> dict[str, Actor]:
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


def _assumed_in(mapping: Mapping[str, Any], place: str) -> Iterator[str]:
    if mapping.get("assumed"):
        yield place
    for key, value in mapping.items():
        if isinstance(value, dict):
            yield from _assumed_in(value, f"{place}.{key}" if place else key)


def read_flight(path: Path) -> Flight:
    """Read and validate a manifest.

    Raises:
        DataError: the file is missing, no YAML, or does not keep to the schema; the message holds
            every problem that was found.
    """
    flight = read_yaml_model(
        path,
        Flight,
        "flight manifest",
        newest=SCHEMA,
        shape="a mapping with `schema: 1` and `cameras:`",
        made="`mocap init FOLDER` drafts one",
    )
    return flight if flight.name else flight.model_copy(update={"name": path.stem})
