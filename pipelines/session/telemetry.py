"""Records of drones' own logs: positions on Earth or in metres, attitudes, gimbal angles, triggers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from pydantic import Field

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.clocks import ClockFit
from pipelines.geometry.geodesy import Place
from pipelines.geometry.mounting import RelativeTo
from pipelines.session.registries import Format
from pipelines.session.yaml_files import Part

Height = Literal["sea level", "ellipsoid", "take-off", "stated", "unknown"]
"""The zero level of the heights of geodetic positions."""


@dataclass(frozen=True)
class PositionTrack:
    """A drone's positions over time: on Earth, or in metres from the origin of its estimator.

    Stamps strictly increase and every number is finite, as in `Trajectory`.
    """

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

    A body (FLU) is relative to an ENU world. A gimbal (FLU, x along the camera's view) is relative to the
    world, to its body, or to a level frame with the heading of the body.
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
    """Attitudes of a camera by the telemetry of its video, or by another log, which may lack positions."""

    camera: AttitudeTrack  # relative to the world
    clock: str  # as in `Telemetry`
    knows_north: bool = True  # False: it looks north in the first picture, and only its turns are known
    video_began_ns: int | None = None  # by the clock of the times; None for a log that is no video
    notes: tuple[str, ...] = ()


class TelemetryChoice(Part):
    """Options of a drone's own log."""

    position: Literal["local", "global", "gps"] | None = None
    """Estimate of the position that is read."""
    instance: int | None = Field(None, ge=0, le=255)
    """Number of the estimator, receiver or vehicle."""
    time: Literal["gps", "boot"] | None = None
    """Clock of the times: UTC by GPS, or seconds since the start of the autopilot."""
    altitude: Literal["relative", "absolute"] | float | None = None
    """Heights above the take-off, above the sea, or a height in metres that was held throughout."""


@runtime_checkable
class TelemetryFormat(Format, Protocol):
    """Logs that drones write themselves: positions, attitudes, gimbal angles, moments of pictures.

    An attribute `choices` lists the fields of `TelemetryChoice` that users may state; without it, none.
    """

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read position and attitudes, in ENU and FLU; raise DataError if there is no position."""


@runtime_checkable
class AttitudeFormat(Format, Protocol):
    """Logs whose angles of the camera are of use without their positions."""

    def read_attitudes(self, path: Path) -> Attitudes:
        """Read the attitudes of the camera, in ENU and FLU; raise DataError if there are none."""


@runtime_checkable
class TriggerFormat(Format, Protocol):
    """Logs with the times at which pictures were triggered."""

    def picture_times(self, path: Path, choice: TelemetryChoice) -> Int64:
        """Read the trigger times of pictures, ns, increasing; raise DataError if the log has none."""
