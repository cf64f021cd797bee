"""`SCENARIO.yaml`: the actor, the motion, the world, and the drones that film.

Everything is stated in metres, seconds and degrees, in a world with x east, y north, z up whose ground
is at z = 0 where nothing rises.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from pipelines.geometry.arrays import COEFFICIENT_COUNTS, Intrinsics
from pipelines.session.yaml_files import read_yaml_model
from pipelines.session.yaml_models import SecondsAsNs, YamlModel

# Files with a larger number come from a later version.
SCHEMA = 2
# Schema 2 films as drones do: 1/500 s is between 1/240 s and less of daylight; OpenDroneMap lists readouts
# of 19 to 33 ms for DJI's cameras; the lens is that of a Phantom 3 Advanced in OpenAthena's table; DJI's
# drones record 0.24 to 0.40 bits of each pixel.
_EXPOSURE_MS, _READOUT_MS, _BITS_PER_PIXEL = 2.0, 20.0, 0.3
_DISTORTION = (-0.132, 0.111, 0.0, 0.0, -0.016)
# A larger map would take hundreds of megabytes.
_MOST_VOXELS = 20_000_000
_MOST_ACTORS, _LONGEST_NAME = 16, 50
# An OctoMap has no voxels further from the origin along an axis.
_FARTHEST_VOXEL = 32_768
# Logs begin before the flight and clocks run off; stamps in ROS are neither negative nor after January 2038.
_EARLIEST_NS, _LATEST_NS = 60 * 10**9, (2**31 - 60) * 10**9

Place = Annotated[list[Annotated[float, Field(ge=-10_000, le=10_000)]], Field(min_length=2, max_length=2)]
"""East and north, m."""
Seconds = Annotated[float, Field(gt=0, le=3600)]
Metres = Annotated[float, Field(gt=0, le=1000)]

# Flights that were simulated before these existed keep their hashes.
_SHOT = ("exposure_ms", "distortion", "readout_ms", "bitrate_mbps")


class Body(YamlModel):
    """Appearance of the actor."""

    sex: Literal["female", "male"] = "male"
    height_m: float = Field(1.75, ge=1.2, le=2.2)
    build: Literal["slim", "average", "heavy"] = "average"
    outfit: Literal["casual", "sport", "dark", "bright"] = "casual"


class Travel(YamlModel):
    """A way on foot: a straight line, an arc of `turn_deg` (left is positive), or to a place."""

    one_of = ("distance_m", "to")
    distance_m: Metres | None = None
    to: Place | None = None
    turn_deg: float = Field(0.0, ge=-36_000, le=36_000)
    speed_mps: float | None = Field(None, ge=0.3, le=6.0)

    @model_validator(mode="after")
    def _arc_has_room(self) -> Travel:
        if self.to is not None and self.turn_deg:
            raise ValueError("turn_deg goes with distance_m; a way `to` a place is straight")
        if self.distance_m and self.turn_deg and self.distance_m / abs(math.radians(self.turn_deg)) < 0.5:
            raise ValueError("the arc is tighter than 0.5 m: a person turns on the spot with `turn`")
        return self


class Stand(YamlModel):
    """A stand, breathing and swaying a little."""

    seconds: float = Field(ge=0.05, le=3600)


class Turn(YamlModel):
    """A turn on the spot, in small steps; left is positive."""

    deg: float = Field(ge=-720, le=720)


class Crouch(YamlModel):
    """A crouch: down, stay, up again."""

    seconds: Seconds = 2.0
    depth: float = Field(0.8, gt=0, le=1)  # 1 is as deep as people sit on their heels


class Reach(YamlModel):
    """A reach up and ahead with a hand, and back."""

    side: Literal["left", "right", "both"] = "right"
    height_m: float = Field(1.9, ge=0.3, le=2.6)
    seconds: Seconds = 2.0


class Kick(YamlModel):
    """The seed's soccer: a run-up, the kick, the follow-through, and back to a stand."""

    foot: Literal["left", "right"] = "right"
    run_up_m: float = Field(3.0, ge=1.0, le=10)


class Step(YamlModel):
    """One action of the actor."""

    one_of = ("walk", "jog", "stand", "turn", "crouch", "reach", "kick")
    walk: Travel | None = None
    jog: Travel | None = None
    stand: Stand | None = None
    turn: Turn | None = None
    crouch: Crouch | None = None
    reach: Reach | None = None
    kick: Kick | None = None


def _is_path(text: str) -> str:
    if not text or "\0" in text:
        raise ValueError("is no path of a file")
    return text


class ActorMotion(YamlModel):
    """The actor's actions one after another, or a BVH file. At the end the actor stands, or begins again."""

    shorthand = "steps"
    one_of = ("steps", "bvh")
    steps: Annotated[list[Step], Field(min_length=1, max_length=1000)] | None = None
    bvh: Annotated[str, AfterValidator(_is_path)] | None = None
    unit: Literal["m", "cm", "mm", "inch"] = "cm"  # of the BVH file
    axes: Literal["y-up", "z-up"] = "y-up"
    repeat: bool = False


class Actor(YamlModel):
    """One person: how they look and move, and how well their position was known in flight."""

    body: Body = Body()
    start: Place = [0.0, 0.0]
    heading_deg: float = 0.0  # counterclockwise from east
    motion: ActorMotion
    estimate_sigma_m: float = Field(0.2, ge=0, le=10)  # of the actor's logged position, per axis
    estimate_rate_hz: float = Field(10.0, gt=0, le=100)


def _is_topic(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", text) or len(text) > _LONGEST_NAME:
        raise ValueError(
            f"{text[:_LONGEST_NAME]!r} cannot name an actor, whose topic is /actor/NAME: take a letter, then"
            f" letters, digits and single underscores between them, at most {_LONGEST_NAME} in all"
        )
    return text


ActorName = Annotated[str, AfterValidator(_is_topic)]
"""Part of a ROS 2 topic."""


class GroundSquare(YamlModel):
    """The visible and mapped ground: a square about its centre."""

    centre: Place = [0.0, 0.0]
    size_m: float = Field(60.0, gt=1, le=1000)


class Mound(YamlModel):
    """A hill of Gaussian shape: the seed's mound."""

    centre: Place
    sigma_m: Annotated[list[Metres], Field(min_length=2, max_length=2)]  # along x and y before yaw
    height_m: float = Field(gt=0, le=100)
    yaw_deg: float = 0.0


class Tree(YamlModel):
    """A trunk and a crown."""

    position: Place
    height_m: float = Field(6.0, gt=0.5, le=60)
    crown_radius_m: float = Field(1.6, gt=0, le=20)


class Wood(YamlModel):
    """Trees strewn at random, none nearer to the actor's way than `clear_m`."""

    count: int = Field(ge=1, le=2000)
    centre: Place = [0.0, 0.0]
    radius_m: Metres = 25.0
    clear_m: float = Field(4.0, ge=0)
    height_m: float = Field(6.0, gt=0.5, le=60)


class Wall(YamlModel):
    """An upright slab along a line on the ground."""

    start: Place
    end: Place
    height_m: Metres = 2.5
    thickness_m: Metres = 0.3


class Mapping(YamlModel):
    """The occupancy map of the drones: voxels over the ground, up to a height."""

    resolution_m: float = Field(0.25, gt=0.01, le=10)
    height_m: Metres = 12.0


class WorldSettings(YamlModel):
    """The surroundings: ground, mounds, trees, walls, the map and the sun."""

    ground: GroundSquare = GroundSquare()
    mounds: Annotated[list[Mound], Field(max_length=100)] = []
    trees: Annotated[list[Tree], Field(max_length=2000)] = []
    wood: Wood | None = None
    walls: Annotated[list[Wall], Field(max_length=200)] = []
    map: Mapping = Mapping()
    sun: Annotated[list[float], Field(min_length=3, max_length=3)] = [0.45, -0.35, 0.82]  # towards it

    @model_validator(mode="after")
    def _map_fits(self) -> WorldSettings:
        side = self.ground.size_m / self.map.resolution_m
        voxels = side * side * self.map.height_m / self.map.resolution_m
        if voxels > _MOST_VOXELS:
            raise ValueError(
                f"map: {voxels:.3g} voxels are more than {_MOST_VOXELS:,}: take a coarser resolution_m, "
                "a smaller ground or a lower height_m"
            )
        reach_m = max(map(abs, self.ground.centre)) + self.ground.size_m / 2
        if max(reach_m, self.map.height_m) / self.map.resolution_m > _FARTHEST_VOXEL - 1:
            raise ValueError(
                f"map: it reaches {max(reach_m, self.map.height_m):g} m from the origin, further than "
                f"{_FARTHEST_VOXEL:,} voxels: take a coarser resolution_m or a ground nearer to the origin"
            )
        if self.sun[2] <= 0.1:
            raise ValueError("sun: it must stand above the horizon: z above 0.1")
        return self


class FormationSettings(YamlModel):
    """Slots of the drones about the actor, at yaw + i 360/n (90 for two)."""

    planner: str = "ring"  # or a planner arm: adaptive, fixed, ...
    radius_m: float = Field(10.0, ge=2, le=200)
    tilt_deg: float = Field(15.0, ge=-10, le=85)
    yaw_deg: float = 0.0
    yaw_rate_deg_per_s: float = Field(0.0, ge=-90, le=90)  # of the ring
    variation: float = Field(0.0, ge=0, le=3)  # deviation of each drone from its slot


class Limits(YamlModel):
    """Limits of a drone's motion."""

    speed_mps: float = Field(8.0, gt=0, le=50)
    acceleration_mps2: float = Field(4.0, gt=0, le=50)


class Lens(YamlModel):
    """The camera on every drone."""

    width: int = Field(1280, ge=64, le=7680, multiple_of=2)  # as H.264 has it
    height: int = Field(720, ge=64, le=4320, multiple_of=2)
    hfov_deg: float = Field(80.0, ge=5, le=150)
    rate_hz: float = Field(30.0, ge=1, le=240)
    dropped_share: float = Field(0.0, ge=0, lt=0.5)  # frames that the recorder lost
    shutters: Literal["free", "synchronised"] = "free"
    exposure_ms: float = Field(0.0, ge=0, le=50)
    distortion: Annotated[list[float], Field(max_length=8)] = []  # as `radtan` in flight.yaml
    readout_ms: float = Field(0.0, ge=0, le=100)  # from the first row to the last
    bitrate_mbps: float = Field(0.0, ge=0, le=1000)  # 0: constant quality

    @field_validator("distortion")
    @classmethod
    def _has_a_model(cls, value: list[float]) -> list[float]:
        if value and len(value) not in COEFFICIENT_COUNTS["radtan"]:
            raise ValueError(f"has {len(value)} coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6]] are 4, 5 or 8")
        return value

    @model_validator(mode="after")
    def _shutter_is_fast_enough(self) -> Lens:
        period_ms = 1000 / self.rate_hz
        for name in ("exposure_ms", "readout_ms"):
            if getattr(self, name) > period_ms:
                raise ValueError(
                    f"{name}: {getattr(self, name):g} ms do not fit between pictures {period_ms:.3g} ms apart"
                )
        return self

    def intrinsics(self) -> Intrinsics:
        """Return the intrinsics of a camera whose principal point is the middle, (width - 1) / 2."""
        focal = self.width / 2 / float(np.tan(np.radians(self.hfov_deg / 2)))
        return Intrinsics(
            self.width,
            self.height,
            focal,
            focal,
            (self.width - 1) / 2,
            (self.height - 1) / 2,
            "radtan" if self.distortion else "none",
            tuple(self.distortion),
            self.readout_ms / 1e3,
        )


class Drones(YamlModel):
    """The team."""

    count: int = Field(2, ge=1, le=16)
    formation: FormationSettings = FormationSettings()
    limits: Limits = Limits()
    camera: Lens = Lens()
    odometry_hz: float = Field(50.0, ge=1, le=1000)
    pose_noise: dict[str, dict[str, float | str]] = {}  # as in flight.yaml
    state_pose_noise: bool = True  # write it into flight.yaml as the prior
    clock_offsets_s: list[float] = []  # of each drone's pictures against its log, by drone; 0 where absent


ModelledDetector = Literal["blazepose", "blazepose-heavy"]
"""A detector whose errors were measured (`detector_errors`)."""


class DetectorErrors(YamlModel):
    """Errors of `--no-video` on true keypoints; more come with tilt and behind obstacles."""

    detector: ModelledDetector = "blazepose"  # whose measured errors
    scale: float = Field(1.0, ge=0, le=100)  # of the measured pixel error; 0 gives exact keypoints
    # At 15 degrees of tilt; their sum is the measured share of missed or grossly wrong joints.
    missed_share: float = Field(0.008, ge=0, lt=1)
    outlier_share: float = Field(0.004, ge=0, lt=1)
    swap_share: float = Field(0.005, ge=0, lt=1)  # of frames, left for right in one limb pair


class Scenario(YamlModel):
    """A flight to be simulated."""

    one_of = ("actor", "actors")
    schema_version: Literal[1, 2] = Field(alias="schema")
    name: str = Field("", max_length=1000)
    seed: int = Field(1, ge=0, lt=2**32)
    duration_s: Seconds
    start_ns: SecondsAsNs = Field(1_700_000_000_000_000_000, alias="start")
    actor: Actor | None = None
    actors: dict[ActorName, Actor] | None = Field(None, min_length=1, max_length=_MOST_ACTORS)
    world: WorldSettings = WorldSettings()
    drones: Drones = Drones()
    keypoints: DetectorErrors = DetectorErrors()

    @model_validator(mode="after")
    def _as_drones_film(self) -> Scenario:
        """State what schema 2 leaves unstated: blur, rolling shutter, distortion and bit rate of drones."""
        camera = self.drones.camera
        if self.schema_version == 1:
            return self
        period_ms, pixels = 1000 / camera.rate_hz, camera.width * camera.height
        usual = {
            "exposure_ms": min(_EXPOSURE_MS, period_ms),
            "distortion": list(_DISTORTION),
            "readout_ms": min(_READOUT_MS, period_ms),
            "bitrate_mbps": _BITS_PER_PIXEL * pixels * camera.rate_hz / 1e6,
        }
        unstated = {name: usual[name] for name in usual if name not in camera.model_fields_set}
        drones = self.drones.model_copy(update={"camera": camera.model_copy(update=unstated)})
        return self.model_copy(update={"schema_version": 1, "drones": drones})

    @model_validator(mode="after")
    def _has_stamps(self) -> Scenario:
        if not _EARLIEST_NS <= self.start_ns <= _LATEST_NS - self.duration_s * 1e9:
            raise ValueError("start: stamps in ROS lie between 1970 and January 2038, the flight does not")
        return self

    @model_validator(mode="after")
    def _an_offset_for_each(self) -> Scenario:
        if len(self.drones.clock_offsets_s) > self.drones.count:
            raise ValueError("drones.clock_offsets_s: there are more offsets than drones")
        if any(abs(offset) > 10 for offset in self.drones.clock_offsets_s):
            raise ValueError("drones.clock_offsets_s: an offset is beyond 10 s")
        return self

    @property
    def people(self) -> dict[str, Actor]:
        """Everybody by name, in the scenario's order; the drones follow the first."""
        if self.actor is not None:
            return {"actor": self.actor}
        return dict(self.actors or {})

    def motion_files(self, folder: Path) -> dict[str, tuple[Path, ActorMotion]]:
        """Return the BVH files that are named, by actor; relative ones lie in a folder."""
        motions = {name: actor.motion for name, actor in self.people.items()}
        return {
            name: (folder / motion.bvh, motion) for name, motion in motions.items() if motion.bvh is not None
        }

    def identity(self) -> dict[str, object]:
        """Return what decides the flight, to be hashed: equal for equal flights.

        A hash does not see the order of a mapping, but the first actor is followed. So actors become a list.
        The detector that keypoints imitate is left out: the hash of its errors takes part instead.
        """
        unused: dict[str, bool | set[str]] = {"actor" if self.actors else "actors": True}
        stated = self.model_dump(mode="json", exclude={**unused, "keypoints": {"detector"}})
        camera = stated["drones"]["camera"]
        stated["drones"]["camera"] = {key: camera[key] for key in camera if key not in _SHOT or camera[key]}
        if self.actors:
            stated["actors"] = list(stated["actors"].items())
        return stated


def read_scenario(path: Path) -> Scenario:
    """Read and validate a scenario; DataError: every problem that was found."""
    scenario = read_yaml_model(
        path,
        Scenario,
        "scenario",
        newest=SCHEMA,
        shape="a mapping with `schema: 1` and `actor:` or `actors:`",
    )
    return scenario if scenario.name else scenario.model_copy(update={"name": path.stem})
