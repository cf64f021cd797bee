"""What others can add: formats, exports, detectors, noise models and planner arms.

Each is found through an entry point, so adding one is one module and one line in a pyproject.toml,
in this package or in a package of the user's own. An entry point names an object of the protocol here.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.noise import NoiseModel, build, parse
from pipelines.session.errors import DataError
from pipelines.session.records import (
    CalibratedCamera,
    Detections,
    Float,
    JointMotion,
    Message,
    Occupancy,
    Recording,
    Topic,
    Trajectory,
    VideoIndex,
)
from pipelines.session.storage import is_special, refuse_special, sha256_of

T = TypeVar("T")


class Format(Protocol):
    """A foreign file format. The reading method depends on what the format holds (below)."""

    @property
    def name(self) -> str:
        """What the user writes after `format:`."""

    @property
    def title(self) -> str:
        """What `mocap info` calls it."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Endings of file names, lower case, to be quick; `recognises` decides by content."""

    def recognises(self, path: Path) -> bool:
        """Whether this file or folder is of this format, by its content. Never raises on bad content."""

    def describe(self, path: Path) -> dict[str, object]:
        """What is inside, for `mocap info`: names to numbers, text or lists, JSON-able, in reading order."""


@runtime_checkable
class KeypointFormat(Format, Protocol):
    """2D keypoints of one camera."""

    def read_keypoints(self, path: Path, *, skeleton: str | None, first_frame: int) -> Detections:
        """Read them all; `skeleton` where the user states it; file frame k becomes k - first_frame."""


@runtime_checkable
class TrajectoryFormat(Format, Protocol):
    """Poses over time."""

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read them in the axes of the file; rows that cannot be used are dropped and counted."""


@runtime_checkable
class CalibrationFormat(Format, Protocol):
    """Cameras that stand still: intrinsics, poses or both, by camera name."""

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read every camera; the world's axes are those of the file."""


@runtime_checkable
class JointFormat(Format, Protocol):
    """3D joints over time."""

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read them as metres, z up; `unit` (m, cm, mm), `axes` (z-up, y-up) where the user states them."""


class Log(Protocol):
    """An open recording of one or more files; a context manager that closes them."""

    @property
    def topics(self) -> Sequence[Topic]:
        """The channels, by name."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """What could not be read so far, counted by cause."""

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """The messages of some channels in the order of receipt, one at a time; others are not decoded."""

    def __enter__(self) -> Log:
        """The log itself."""

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
        """When its frames are shown, from the container alone: no picture but the first is decoded."""


@runtime_checkable
class MapFormat(Format, Protocol):
    """What stands around."""

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read it as voxels, in the axes of the file; `resolution_m` where the user states their size."""


@dataclass(frozen=True)
class Region:
    """A square of a picture in which one person is looked for; it may reach beyond the picture."""

    centre: tuple[float, float]  # px
    side: float  # px
    angle_rad: float = (
        0.0  # clockwise in the picture: how far the person's up is turned from the picture's up
    )


@dataclass(frozen=True)
class Person:
    """One person that a detector found in a region."""

    xy: Float  # [J, 2] px in the whole picture, NaN where a joint was not found
    confidence: Float  # [J] 0..1
    presence: float  # 0..1, whether there is a person at all
    region: Region  # where the same person is to be looked for in the next frame


class KeypointNetworks(Protocol):
    """The loaded networks of a detector; a context manager is not needed: they hold no files open."""

    @property
    def joints(self) -> tuple[str, ...]:
        """What the J joints are called."""

    def find_people(self, picture: NDArray[np.uint8]) -> list[tuple[Region, float]]:
        """People in a picture [H, W, 3] BGR looked at as a whole, and how sure it is; best first."""

    def locate(self, picture: NDArray[np.uint8], regions: Sequence[Region]) -> list[Person]:
        """The joints of the person in each region, whether or not there is one (see `presence`)."""


class Detector(Protocol):
    """A keypoint detector."""

    @property
    def name(self) -> str:
        """What the user writes after `--detector`, without paths: with the models, it decides the results."""

    @property
    def title(self) -> str:
        """What `mocap models` calls it."""

    def models(self) -> dict[str, Path | None]:
        """The files it needs: name to where they are, None for those that are missing."""

    def fetch(self, source: Path | None = None) -> None:
        """Get the missing files, from `source` where they are here already. DataError says what to do."""

    def load(self, *, threads: int) -> KeypointNetworks:
        """Load the networks. DataError where a file is missing or is not the one that was expected."""


@dataclass(frozen=True)
class Measured:
    """Accuracy and time of a detector, as docs/detector.md says they are measured."""

    sample_mpjpe_mm: float  # of the sample flight with true poses
    person_ms: float  # its networks' time for each person in each picture, on one thread


@runtime_checkable
class MeasuredDetector(Detector, Protocol):
    """A detector that `mocap models` lists with its accuracy and its time."""

    @property
    def measured(self) -> Measured:
        """Its accuracy and its time."""

    @property
    def advice(self) -> str | None:
        """One line on a detector that is more accurate, said where this one runs."""


@runtime_checkable
class DetectorFamily(Protocol):
    """Detectors that are told what to run, behind a colon: `--detector NAME:ARGUMENT`."""

    @property
    def name(self) -> str:
        """What the user writes before the colon."""

    @property
    def title(self) -> str:
        """What `mocap models` calls it."""

    @property
    def usage(self) -> str:
        """What the user writes after `--detector`, and what it means; one line each."""

    def configured(self, argument: str) -> Detector:
        """The detector of that argument. DataError says what is wrong with it."""


class Export(Protocol):
    """A way out of a session."""

    @property
    def name(self) -> str:
        """What the user writes after `--to`."""

    @property
    def title(self) -> str:
        """What the help text says of it, on one line."""

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write into an existing empty folder; the paths written, sorted. DataError without content.

        What is held, moved or thinned out is counted in a note to `recording.progress`.
        """


@runtime_checkable
class ChoiceOfAxes(Export, Protocol):
    """An export that heeds `recording.unit` and `recording.axes`; others write metres with z up."""

    @property
    def units(self) -> tuple[str, ...]:
        """The units of length that it can be written in, the usual one first."""

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes (z-up, y-up) that it can be written in, the usual ones first."""


class Arm(Protocol):
    """A way to plan formations.

    What it is handed and what it makes are types of the planning room, above this one: there
    `pipelines.planning.arms` states the same protocol with them.
    """

    @property
    def name(self) -> str:
        """What the user writes after `--arms`."""

    @property
    def title(self) -> str:
        """What reports call it."""

    def start(self, config: Any, *, drones: int, yaw_rad: float) -> Any:
        """The `FormationPlanner` of a `PlannerConfig` for a flight whose first camera starts at that yaw."""


class Registry(Generic[T]):
    """The objects that one group of entry points names, loaded when they are asked for."""

    def __init__(self, group: str, noun: str) -> None:
        self.group = group
        self.noun = noun

    @cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        return {entry.name: entry for entry in sorted(entry_points(group=self.group), key=lambda e: e.name)}

    def names(self) -> list[str]:
        """Every registered name, sorted."""
        return list(self._entries)

    def get(self, name: str) -> T:
        """The object of that name.

        Raises:
            DataError: no such name; the message lists those there are.
        """
        if name not in self._entries:
            raise DataError(name, f"no such {self.noun}", f"there are {', '.join(self.names()) or 'none'}")
        loaded: T = self._entries[name].load()
        return loaded

    def all(self) -> list[T]:
        """Every registered object, in the order of their names."""
        return [self.get(name) for name in self.names()]


FORMATS: Registry[Format] = Registry("mocap.formats", "format")
EXPORTS: Registry[Export] = Registry("mocap.exports", "export format")
DETECTORS: Registry[Detector | DetectorFamily] = Registry("mocap.detectors", "detector")
NOISE_MODELS: Registry[type[NoiseModel]] = Registry("mocap.noise_models", "pose noise model")
PLANNER_ARMS: Registry[Arm] = Registry("mocap.planner_arms", "planner arm")

F = TypeVar("F")


def find_detector(text: str) -> Detector:
    """The detector that a user asks for: a registered name, or that of a family, a colon and its argument.

    Raises:
        DataError: no such name, an argument where none is taken, none where one is needed, or a bad one.
    """
    name, colon, argument = text.partition(":")
    found = DETECTORS.get(name)
    if isinstance(found, DetectorFamily):
        if not argument:
            raise DataError(text, "does not say which model", f"write {found.usage.splitlines()[0]}")
        return found.configured(argument)
    if colon:
        raise DataError(text, f"{name} takes nothing behind its name", f"write {name}")
    return found


def advice_on(detector: Detector) -> list[str]:
    """What is said where a detector runs: a line on a more accurate one, where it knows one."""
    known = isinstance(detector, MeasuredDetector) and detector.advice
    return [known] if known else []


def hashes_of_models(detector: Detector) -> dict[str, str]:
    """The sha256 of the files of a detector that are there, by their names."""
    return {name: sha256_of(path) for name, path in detector.models().items() if path is not None}


def recognise(path: Path, protocol: type[F], noun: str, formats: Sequence[Format] | None = None) -> F:
    """The one registered format of a kind that recognises a file.

    Args:
        path: an existing file or folder.
        protocol: the kind, one of the runtime-checkable protocols above.
        noun: what the kind is called in messages ("keypoint file", "camera trajectory").
        formats: the candidates; every registered format by default.

    Raises:
        DataError: the path is missing, no format of the kind knows it, or several do.
    """
    if not path.exists():
        raise DataError(
            path, "does not exist", "check the path; paths are relative to the file that names them"
        )
    refuse_special(path)
    candidates = [f for f in (FORMATS.all() if formats is None else formats) if isinstance(f, protocol)]
    matches = [f for f in candidates if f.recognises(path)]
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(sorted(f.name for f in candidates))
    if not matches:
        raise DataError(path, f"not recognised as a {noun}{why_not(path)}", f"known formats: {known}")
    raise DataError(
        path,
        f"could be {' or '.join(sorted(f.name for f in matches))}",
        "say which with `format:`",
    )


def why_not(path: Path) -> str:
    """What may have kept a file from being recognised, to be put behind that; empty where nothing is seen."""
    if not path.is_file():
        return ": it is a pipe, a socket or a device" if is_special(path) else ""
    try:
        if path.stat().st_size == 0:
            return ": it is empty"
        if path.suffix.lower() == ".json":
            json.loads(path.read_bytes())
    except OSError as error:
        return f": it cannot be read ({error.strerror})"
    except (ValueError, RecursionError) as error:
        return f": it is no valid JSON ({str(error)[:100]}), perhaps cut off"
    return ""


def noise_models(place: str, parts: Mapping[str, Mapping[str, object]]) -> list[NoiseModel]:
    """The pose noise models that a manifest names; `place` is said where they cannot be built.

    Raises:
        DataError: an unknown model or parameter, or a value out of range.
    """
    return _built(place, parts.items())


def parsed_noise_models(place: str, text: str) -> list[NoiseModel]:
    """The pose noise models of a text like `white:position_m=0.3,rotation_deg=1 + bias:position_m=0.1`.

    Raises:
        DataError: the text does not read so, or names what there is not.
    """
    try:
        parts = parse(text)
    except ValueError as error:
        raise DataError(place, str(error), "write white:position_m=0.3,rotation_deg=1") from None
    return _built(place, parts)


def _built(place: str, parts: Iterable[tuple[str, Mapping[str, object]]]) -> list[NoiseModel]:
    classes = dict(zip(NOISE_MODELS.names(), NOISE_MODELS.all(), strict=True))
    try:
        return build(parts, classes)
    except ValueError as error:
        raise DataError(place, str(error)) from None
