"""What drones log of themselves: positions on Earth or in metres, attitudes, gimbal angles, triggers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from pipelines.geometry.clocks import ClockFit
from pipelines.geometry.geodesy import Place
from pipelines.geometry.mounting import RelativeTo
from pipelines.session.records import Float, Int64
from pipelines.session.registries import Format

Height = Literal["sea level", "ellipsoid", "take-off", "stated", "unknown"]
"""What heights of geodetic positions are counted from."""


@dataclass(frozen=True)
class PositionTrack:
    """Where a drone was over time: on Earth, or in metres from where its estimator began.

    Stamps strictly increase and every number is finite, as in `Trajectory`.
    """

    name: str  # what the log calls it, for messages
    t_ns: Int64  # [N]
    values: Float  # [N, 3] latitude deg, longitude deg, height m; or metres east, north, up
    on_earth: bool  # which of the two
    height: Height = "unknown"  # of positions on Earth
    origin: Place | None = None  # of metres: where on Earth they count from, where that is known
    accuracy_m: tuple[float, float] | None = None  # horizontal and vertical sigma, as the log itself has it


@dataclass(frozen=True)
class AttitudeTrack:
    """How something was turned over time; stamps strictly increase.

    Of a body (FLU) in an ENU world; of a gimbal (FLU, x where the camera looks) in that, in its body, or in a
    level one that heads as the body does.
    """

    name: str
    t_ns: Int64  # [N]
    quaternion_xyzw: Float  # [N, 4] unit
    relative_to: RelativeTo = "world"
    stated: Mapping[RelativeTo, Float] = field(default_factory=dict)
    """[N, 4] of a gimbal: its angles as the log states them (FRD), by what the user says they count from."""
    dropped: dict[str, int] = field(default_factory=dict)  # of a log that holds it alone


@dataclass(frozen=True)
class Telemetry:
    """What a drone's own log says of where it was and where its camera looked, at times of one clock."""

    position: PositionTrack
    body: AttitudeTrack | None
    gimbal: AttitudeTrack | None
    clock: str  # what the times count from: "UTC by GPS", "boot", "the drone's clock", "the video's start"
    fit: ClockFit | None = None  # of the log's own clock to GPS time, where it was used
    notes: tuple[str, ...] = ()  # what was chosen and what is doubtful
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class TelemetryChoice:
    """What of a drone's log is wanted where it holds several; None leaves the choice to the reader."""

    position: Literal["local", "global", "gps"] | None = None
    instance: int | None = None  # of an estimator or a receiver
    time: Literal["gps", "boot"] | None = None
    altitude: Literal["relative", "absolute"] | float | None = None


@runtime_checkable
class TelemetryFormat(Format, Protocol):
    """Logs that drones write themselves: positions, attitudes, gimbal angles, moments of pictures."""

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read position and attitudes, in ENU and FLU; DataError where there is no position."""


@runtime_checkable
class TriggerFormat(Format, Protocol):
    """Logs that say when pictures were triggered."""

    def picture_times(self, path: Path, choice: TelemetryChoice) -> Int64:
        """When pictures were triggered, ns, increasing; DataError where the log does not say."""
