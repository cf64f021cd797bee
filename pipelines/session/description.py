"""`session.json`: the contents of a session and the warnings of its ingest.

Only ingest writes it. Every later stage reads it through this module and does not open the manifest again.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pipelines.geometry.arrays import ClockFit, Intrinsics, Place
from pipelines.session.errors import DataError
from pipelines.session.records import HeldMap
from pipelines.session.storage import hash_of, read_json, refuse_names, refuse_newer


class Entry(BaseModel):
    """A mapping of session.json; unknown keys, which a later version added, are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True, populate_by_name=True)


class FramesEntry(Entry):
    """The pictures of a camera, in world time."""

    count: int
    first_t_ns: int
    last_t_ns: int
    rate_hz: float | None  # None for a single frame
    dropped: dict[str, int] = {}  # frames that the video has lost


class MountEntry(Entry):
    """Pose of a camera that is fixed to the body whose poses are logged: body_from_camera."""

    translation: tuple[float, float, float]  # m
    rotation_xyzw: tuple[float, float, float, float]


class PlaceEntry(Entry):
    """Zero and north of a log, as `pose.world_from_source` states them."""

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    yaw_deg: float = 0.0
    rotation_xyzw: tuple[float, float, float, float] | None = None  # in place of the yaw
    scale: float = 1.0


class PosesEntry(Entry):
    """The poses of a camera, and the number of frames without a pose."""

    source: str
    static: bool
    count: int
    rate_hz: float | None
    gaps_ns: list[tuple[int, int]]  # stretches of the log longer than the largest gap that is bridged
    frames_without_pose: int
    dropped: dict[str, int]
    stamps: str | None = None  # of a log's messages: header or receive
    topic: str | None = None  # of the log
    gimbal: str | None = None  # what a gimbal's angles of a topic, or fixed ones, are relative to
    gimbal_fixed: bool = False  # they are fixed
    gimbal_axes: Literal["enu", "ned"] = "enu"  # that they are in
    gimbal_log: str | None = None  # that holds the gimbal's angles
    gimbal_topic: str | None = None  # of that log
    mount: MountEntry | None = None  # None where poses are the camera's own, or a gimbal turns it
    in_gimbal: MountEntry | None = None  # how the camera sits in the gimbal that turns it
    axes: Literal["enu", "ned"] = "enu"  # that the source's poses are read in
    inverse: bool = False  # the source's poses are read as camera_from_world
    z: Literal["up", "down"] = "up"  # where its positions are taken to count to
    world_from_source: PlaceEntry = PlaceEntry()


class KeypointsEntry(Entry):
    """The keypoints that came with a camera."""

    source: str
    format: str
    joints: list[str]
    detections: int
    people_at_once: int
    frames_without_person: int
    dropped: dict[str, int]
    adjusted: dict[str, int] = {}  # values that are in the tables, but not as the file has them
    mirrored: bool | str = False  # as flight.yaml states it


UNSTATED_CLOCK_SIGMA_S = 0.5
"""Standard deviation of a camera's clock where its start was assumed or is not stated."""


class ClockEntry(Entry):
    """World time = camera time + offset; the offset is already applied to the tables."""

    offset_s: float
    sigma_s: float
    # The start of the pictures in world time: "stated" by the manifest, by a file or log that it names or by
    # the motion in the pictures; "assumed" by `mocap init`; "none": nothing states it.
    start: Literal["stated", "assumed", "none"] = "stated"

    @property
    def prior_sigma_s(self) -> float:
        """The standard deviation of the offset: `sigma_s`, or 0.5 s where the start is not stated."""
        return self.sigma_s if self.sigma_s or self.start == "stated" else UNSTATED_CLOCK_SIGMA_S


class MediaEntry(Entry):
    """Files that hold the pictures of a camera; overlays and keypoint detection need them."""

    paths: list[str]  # relative to the session's folder: a video file, or the files of a log
    sources: list[str]  # the same files as `Description.sources` names them
    topic: str | None = None  # of the log
    stamps: str = "header"  # by which the log's pictures are ordered


class OriginEntry(Entry):
    """Place on Earth of the world's origin; all cameras with positions on Earth share it."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    source: str  # "world.origin", or the log whose first position is the origin

    @property
    def place(self) -> Place:
        """The place itself."""
        return Place(self.latitude_deg, self.longitude_deg, self.altitude_m)


class PictureMapEntry(Entry):
    """The map of key pictures from which a camera's attitudes were found."""

    key: str  # hash of pictures, lens and settings, by which the map is kept
    key_pictures: int
    mapped: int  # of them
    points: int
    error_px: float  # median reprojection error
    residual_m: float | None  # root mean square distance of the logged places from the map
    common_sigma_deg: float  # per axis, of the error that all attitudes share
    picture_sigma_deg: float  # per axis, of the error of each picture
    focal_ratio: float = 1.0  # refined focal length over the stated one
    unlike_log: int = 0  # key pictures whose attitude the log has otherwise


class CameraEntry(Entry):
    """One camera."""

    intrinsics: Intrinsics
    frames: FramesEntry
    poses: PosesEntry
    keypoints: KeypointsEntry | None
    clock: ClockEntry
    log_clock: ClockFit | None = None  # fit of a drone log's clock to UTC, already applied to the tables
    pose_noise: dict[str, dict[str, float | str]] | None
    media: MediaEntry | None
    picture_map: PictureMapEntry | None = None  # where `pose.attitude: pictures` is stated


# These are the heights of the hips above the logged point of a standing person of 1.75 m.
HIP_ABOVE_POINT_M = {"hip": 0.0, "centre": 0.0, "feet": 0.95, "head": -0.70}


class ActorEntry(Entry):
    """The logged positions of the actor, or of one of several people."""

    name: str = ""  # of one of several
    source: str
    sources: list[str] = []  # the files of that log as `Description.sources` names them
    topic: str | None = None  # as the manifest states it
    point: str  # of the body: hip, head, feet, centre
    weight: float = 1.0  # for the planners
    count: int
    dropped: dict[str, int]

    @property
    def hip_above_m(self) -> float:
        """Height of the hips above the logged point, m, for a standing person of 1.75 m."""
        return HIP_ABOVE_POINT_M[self.point]


class MapEntry(Entry):
    """The maps of the surroundings; the figures beside `maps` are those of the last map."""

    source: str
    unknown: Literal["free", "occupied", "avoided"]  # state that the planner assumes for unknown voxels
    resolution_m: float
    shape: list[int]
    occupied: int
    free: int
    dropped: dict[str, int]
    maps: list[HeldMap] = []  # all maps, as in map/index.json; empty in sessions of older versions


class PlannedEntry(Entry):
    """The logged setpoints of one drone."""

    source: str
    count: int
    dropped: dict[str, int]


class TruthEntry(Entry):
    """The ground truth of a session: joints and camera poses."""

    joints: list[str]
    people: int
    first_t_ns: int
    last_t_ns: int
    cameras: list[str]
    missing: int = 0  # positions that are absent, counted over all times, people and joints
    dropped: dict[str, int] = {}  # those of them that the file has but that cannot be used, by cause
    poses_dropped: dict[str, dict[str, int]] = {}  # of the true poses, by camera


class Interpolation(Entry):
    """Limits of interpolation between, and extrapolation beyond, the stamps of a pose log."""

    max_gap_s: float
    max_extrapolation_s: float

    @property
    def max_gap_ns(self) -> int:
        """The longest time between two logged poses that is bridged."""
        return round(self.max_gap_s * 1e9)

    @property
    def max_extrapolation_ns(self) -> int:
        """The longest time for which a pose is held before its log begins or after it ends."""
        return round(self.max_extrapolation_s * 1e9)


class Doubt(Entry):
    """A contradiction in a flight, as session.json and metrics.json hold it."""

    code: str
    cameras: list[str]
    what: str  # one sentence
    evidence: dict[str, float | dict[str, float]]
    remedy: str  # the lines of flight.yaml to change; empty where no cause was found

    def as_json(self) -> dict[str, object]:
        """Return the mapping that is stored."""
        return self.model_dump(mode="json")

    def as_warning(self) -> str:
        """State the doubt in one line, with the lines that mend it."""
        remedy = f"; {as_instruction(self.remedy)}" if self.remedy else ""
        return f"doubt ({self.code}): {self.what}{remedy}"

    @property
    def instructions(self) -> list[str]:
        """The lines of the remedy, each as an instruction."""
        return [as_instruction(line) for line in self.remedy.split("; ")] if self.remedy else []


def as_instruction(remedy: str) -> str:
    """Return a remedy as an instruction: keys of flight.yaml are set, anything else is said as it is."""
    return f"set {remedy}" if remedy.startswith(("cameras.", "map.", "world.")) else remedy


class Description(Entry):
    """The whole of session.json."""

    schema_version: int = Field(alias="schema")
    flight: str  # the name in the manifest
    simulated: bool = False  # as the manifest states it: not a real flight
    clock_reference: str
    pose_interpolation: Interpolation
    origin: OriginEntry | None = None
    cameras: dict[str, CameraEntry]
    actor: ActorEntry | None = None  # the only one who was logged, or the first of `actors`
    actors: list[ActorEntry] = []  # person 0, 1, ..., if the manifest names them
    stature_m: float | None = None  # of the people, as stated
    map: MapEntry | None = None
    truth: TruthEntry | None
    plan: dict[str, PlannedEntry] | None = None  # by camera
    sources: dict[str, str]  # path as the manifest states it -> sha256
    assumptions: list[str] = []  # keys of the manifest that `mocap init` guessed and nobody confirmed
    doubts: list[Doubt] = []  # that the logs raise by themselves; those of the pictures are in metrics.json
    warnings: list[str]

    @model_validator(mode="after")
    def _names_are_of_cameras(self) -> Self:
        """Refuse names that are unsafe as folders: those of a foreign session must not lead out of it."""
        refuse_names(self.cameras, "camera")
        named = [self.clock_reference, *(self.plan or {}), *(self.truth.cameras if self.truth else [])]
        strange = [name for name in named if name not in self.cameras]
        if strange:
            raise ValueError(f"{strange[0]!r} is no camera of this flight")
        return self

    @property
    def logged_people(self) -> list[ActorEntry]:
        """The people who were logged: person 0, 1, ... in this order."""
        return self.actors or ([self.actor] if self.actor else [])

    def names_of_people(self, count: int) -> list[str]:
        """Name person 0 to `count` - 1: as the manifest names the logged ones, else person0, person1, ..."""
        named = [actor.name for actor in self.actors[:count]]
        return named + [f"person{k}" for k in range(len(named), count)]

    @property
    def has_true_joints(self) -> bool:
        """True if the session holds ground truth for joints."""
        return self.truth is not None and bool(self.truth.joints)

    @property
    def guessed_lenses(self) -> list[str]:
        """The cameras whose focal length is a guess that no calibration and no film confirmed."""
        maps = {name: entry.picture_map for name, entry in self.cameras.items()}
        guessed = [name for name in maps if f"cameras.{name}.intrinsics.fx" in self.assumptions]
        return [name for name in guessed if (found := maps[name]) is None or found.focal_ratio == 1.0]

    @property
    def guessed_rates(self) -> list[str]:
        """The cameras without a film, which would state its rate, whose frame times are a guess."""
        unfilmed = [name for name, entry in self.cameras.items() if entry.media is None]
        return [name for name in unfilmed if f"cameras.{name}.frame_times" in self.assumptions]

    @property
    def recorded(self) -> dict[str, str]:
        """The hashes of recordings, as inputs of stages; clocks and calibrations do not change them."""
        recorded = {
            f"pictures of {name}": hash_of(
                [
                    [self.sources.get(source) for source in entry.media.sources],
                    entry.media.topic,
                    entry.media.stamps,
                ]
            )
            for name, entry in self.cameras.items()
            if entry.media is not None
        }
        for actor in self.logged_people:
            log = [self.sources.get(source) for source in actor.sources]
            recorded[f"log of {actor.name or 'the actor'}"] = hash_of([log, actor.topic, actor.point])
        return recorded

    @property
    def start_ns(self) -> int:
        """Time of the flight's first frame of any camera; seconds that users give count from it."""
        return min(entry.frames.first_t_ns for entry in self.cameras.values())


def assumptions_as_warnings(assumptions: Sequence[str]) -> list[str]:
    """Count and list what was guessed and nobody has confirmed, in one warning if there is anything."""
    noun = "assumption" if len(assumptions) == 1 else "assumptions"
    remedy = "confirm each in flight.yaml and take its `assumed: true` away"
    return [f"{len(assumptions)} {noun}: {', '.join(assumptions)}; {remedy}"] if assumptions else []


def read_description(session: Path) -> Description:
    """Read session.json of a session folder; DataError if it is damaged or of a later version."""
    path = session / "session.json"
    remedy = "ingest the flight again with --force"
    document = read_json(path, remedy)
    refuse_newer(path, document, remedy)
    try:
        return Description.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        place = "".join(f"{part}: " for part in [".".join(map(str, first["loc"]))] if part)
        raise DataError(path, f"is damaged ({place}{first['msg']})", remedy, code="damaged") from None
