"""Registries of extensions: formats, exports, detectors, noise models, planner arms; optional libraries.

Each is found through an entry point, which names an object that has the protocol defined here. Where an
extension needs an optional library that is missing, the error gives the command that installs it.
"""

import re
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points, requires
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipelines.geometry.arrays import Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import (
    Attitudes,
    CalibratedCamera,
    Detections,
    JointMotion,
    Message,
    Occupancy,
    Recording,
    Telemetry,
    Topic,
    Trajectory,
    VideoIndex,
)
from pipelines.session.storage import sha256_of
from pipelines.session.yaml_models import YamlModel

T = TypeVar("T")


class Named(Protocol):
    """An extension with a name for commands and files, and one for people."""

    @property
    def name(self) -> str:
        """The name that the user writes: after `format:`, `--detector` (with an argument) or `--to`.

        Of a detector, this and the model files together determine the results.
        """

    @property
    def title(self) -> str:
        """The name, or line of help, that commands print."""


class Format(Named, Protocol):
    """A foreign file format. Its reading method depends on its kind (the protocols below)."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Endings of file names, lower case, for a quick choice; `recognises` decides by content."""

    def recognises(self, path: Path) -> bool:
        """Test by content if a file or folder is of this format. Never raise on bad content."""

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the content for `mocap info`: names to numbers, text or lists, JSON-able, in order."""


@runtime_checkable
class KeypointFormat(Format, Protocol):
    """2D keypoints of one camera."""

    def read_keypoints(self, path: Path, *, skeleton: str | None, first_frame: int) -> Detections:
        """Read all keypoints; `skeleton` if the user states it; file frame k becomes k - first_frame."""


@runtime_checkable
class TrajectoryFormat(Format, Protocol):
    """Poses over time."""

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read the poses in the axes of the file; unusable rows are dropped and counted."""


@runtime_checkable
class CalibrationFormat(Format, Protocol):
    """Cameras that stand still: intrinsics, poses or both, by camera name."""

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read every camera; the world's axes are those of the file."""


class TelemetryChoice(YamlModel):
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
    """Logs that drones write themselves; an attribute `choices` lists the options that users may state."""

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


@runtime_checkable
class JointFormat(Format, Protocol):
    """3D joints over time."""

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read the joints as metres, z up; `unit` (m, cm, mm), `axes` (z-up, y-up) if the user gives them."""


class Log(AbstractContextManager["Log"], Protocol):
    """An open recording of one or more files; a context manager that closes them."""

    @property
    def topics(self) -> Sequence[Topic]:
        """The channels, by name."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Counts by cause of what could not be read so far."""

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some channels in the order of receipt; others are not decoded."""

    def __exit__(self, *exception: object) -> None:
        """Close the files."""


@runtime_checkable
class LogFormat(Format, Protocol):
    """Recordings of messages."""

    def open_log(self, paths: Sequence[Path]) -> Log:
        """Open a recording: one file, the parts of a split one in order, or a bag's folder."""


@runtime_checkable
class VideoFormat(Format, Protocol):
    """Pictures over time."""

    def index(self, path: Path) -> VideoIndex:
        """Read the presentation times of the frames from the container; only the first frame is decoded."""


@runtime_checkable
class MapFormat(Format, Protocol):
    """Maps of the surroundings."""

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read the map as voxels, in the axes of the file; `resolution_m` if the user states their size."""


@dataclass(frozen=True)
class Region:
    """A square of a picture in which a detector searches one person; it may reach beyond the picture."""

    centre: tuple[float, float]  # px
    side: float  # px
    angle_rad: float = 0.0  # clockwise in the picture, from the picture's up to the person's up


@dataclass(frozen=True)
class Person:
    """One person that a detector found in a region."""

    xy: Float  # [J, 2] px in the whole picture, NaN where a joint was not found
    confidence: Float  # [J] 0..1
    presence: float  # 0..1, confidence that there is a person at all
    region: Region  # in which to search the same person in the next frame


class KeypointNetworks(Protocol):
    """The loaded networks of a detector. They hold no files open, so no context manager is needed."""

    @property
    def joints(self) -> tuple[str, ...]:
        """The names of the J joints."""

    def find_people(self, picture: NDArray[np.uint8]) -> list[tuple[Region, float]]:
        """Find people in a whole picture [H, W, 3] BGR; return regions with confidences, best first."""

    def locate(self, picture: NDArray[np.uint8], regions: Sequence[Region]) -> list[Person]:
        """Locate the joints of one person in each region; `presence` says if there is one at all."""


class Detector(Named, Protocol):
    """A keypoint detector."""

    def models(self) -> dict[str, Path | None]:
        """List the files that it needs: name to path, None for those that are missing."""

    def fetch(self, source: Path | None = None) -> None:
        """Get the missing files, from `source` if that holds them. A DataError says what to do."""

    def load(self, *, threads: int) -> KeypointNetworks:
        """Load the networks. Raise DataError if a file is missing or is not the expected one."""


@dataclass(frozen=True)
class Measured:
    """Accuracy and time of a detector, measured as docs/results.md describes."""

    sample_mpjpe_mm: float  # of the sample flight with true poses
    person_ms: float  # processor time for one person in one picture, on one thread of a busy machine


@runtime_checkable
class MeasuredDetector(Detector, Protocol):
    """A detector that `mocap models` lists with its accuracy and its time."""

    @property
    def measured(self) -> Measured:
        """The accuracy and the time of the detector."""


@runtime_checkable
class DetectorFamily(Named, Protocol):
    """Detectors with an argument after a colon that says which model to run: `--detector NAME:ARGUMENT`."""

    @property
    def usage(self) -> str:
        """The text that the user writes after `--detector`, and its meaning; one line each."""

    def configured(self, argument: str) -> Detector:
        """Return the detector for an argument. A DataError says what is wrong with the argument."""


class Export(Named, Protocol):
    """A format in which sessions are exported."""

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write into an existing empty folder and return the paths written, sorted.

        What is held, moved or thinned out is counted in a note to `recording.progress`. DataError if there is
        nothing.
        """


@runtime_checkable
class ExportFamily(Export, Protocol):
    """An export with an argument after a colon: `--to NAME:ARGUMENT`."""

    def configured(self, argument: str) -> Export:
        """Return the export for an argument. A DataError says what is wrong with the argument."""


@runtime_checkable
class ExportWithChoices(Export, Protocol):
    """An export that obeys `recording.unit` and `recording.axes`, or counts from `recording.zero_ns`.

    Others write metres with z up at the session's own times.
    """

    @property
    def choices(self) -> Mapping[str, tuple[str, ...]]:
        """The values of `unit`, `axes` (z-up, y-up) and `time` (zero, epoch), the default of each first."""


class Registry(Generic[T]):
    """The objects that one group of entry points names, loaded on request."""

    def __init__(self, group: str, noun: str) -> None:
        self.group = group
        self.noun = noun

    @cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        return {entry.name: entry for entry in sorted(entry_points(group=self.group), key=lambda e: e.name)}

    def names(self) -> list[str]:
        """List every registered name, sorted."""
        return list(self._entries)

    def get(self, name: str) -> T:
        """Load the object of a name; DataError with the existing names if it is none of them."""
        if name not in self._entries:
            remedy = f"there are {', '.join(self.names()) or 'none'}"
            raise DataError(name, f"no such {self.noun}", remedy, code="no-such-name")
        loaded: T = self._entries[name].load()
        return loaded

    @cached_property
    def _kinds(self) -> dict[tuple[type, ...], list[T]]:
        return {}

    def all(self, kinds: tuple[type, ...] = (object,)) -> list[T]:
        """Load every registered object of some kinds, in the order of their names."""
        if kinds not in self._kinds:  # a protocol looks at each of an object's attributes
            self._kinds[kinds] = [
                self.get(name) for name in self.names() if isinstance(self.get(name), kinds)
            ]
        return list(self._kinds[kinds])


FORMATS: Registry[Format] = Registry("mocap.formats", "format")
EXPORTS: Registry[Export] = Registry("mocap.exports", "export format")
DETECTORS: Registry[Detector | DetectorFamily] = Registry("mocap.detectors", "detector")


def find_detector(text: str) -> Detector:
    """Find a detector: a name, or a family's name, a colon and its argument; DataError: one is wrong."""
    name, colon, argument = text.partition(":")
    found = DETECTORS.get(name)
    if not isinstance(found, DetectorFamily):
        _refuse_argument(text, name, colon)
        return found
    if not argument:
        remedy = f"write {found.usage.splitlines()[0]}"
        raise DataError(text, "does not say which model", remedy, code="bad-option")
    return found.configured(argument)


def find_export(text: str) -> Export:
    """Find an export: a name, for some a colon and an argument; DataError: one is wrong."""
    name, colon, argument = text.partition(":")
    found = EXPORTS.get(name.lower())
    if colon and isinstance(found, ExportFamily):
        return found.configured(argument)
    _refuse_argument(text, name, colon)
    return found


def _refuse_argument(text: str, name: str, colon: str) -> None:
    if colon:
        raise DataError(text, f"{name} takes nothing behind its name", f"write {name}", code="bad-option")


def hashes_of_models(detector: Detector) -> dict[str, str]:
    """Hash the existing files of a detector; return their SHA-256 by name."""
    return {name: sha256_of(path) for name, path in detector.models().items() if path is not None}


_OF_EXTRA = re.compile(r"(?P<requirement>[^;]+?)\s*;\s*extra == ['\"](?P<extra>[^'\"]+)['\"]")


def need(module: str, extra: str) -> Any:
    """Import an optional library, which an extra of this package lists; DataError if it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # SWIG's wrappers deprecate themselves
            return import_module(module)
    except ImportError as error:
        problem = "is not installed"
        raise DataError(module, problem, f"run `{install_command(extra)}`", code="missing-library") from error


def install_command(extra: str) -> str:
    """Write the command that installs an extra's libraries: pip does not know `mocap-pipeline[extra]`."""
    listed = [_OF_EXTRA.fullmatch(line) for line in requires("mocap-pipeline") or ()]
    names = [found["requirement"] for found in listed if found and found["extra"] == extra]
    if not names:
        raise ValueError(f"mocap-pipeline has no extra {extra!r}")
    return " ".join(["pip install", *(f'"{name}"' for name in sorted(names))])
