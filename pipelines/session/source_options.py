"""Options that stand in flight.yaml beside a `file:`; the format of the file decides which are allowed.

They follow from the kind of a format: a calibration holds cameras, a log holds topics. Of the options of
drones' own logs, a format lists those that it takes in an attribute `choices`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeVar

from pydantic import Field, ValidationError, model_validator

from pipelines.session.errors import DataError
from pipelines.session.registries import (
    CalibrationFormat,
    Format,
    KeypointFormat,
    LogFormat,
    TelemetryChoice,
    TelemetryFormat,
    TrajectoryFormat,
)
from pipelines.session.yaml_models import YamlModel, describe_problem

O = TypeVar("O", bound=YamlModel)


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
    attitude: str | None = None
    """Topic of attitudes, for a topic that has only positions."""

    @model_validator(mode="after")
    def _complete(self) -> LoggedPose:
        if (self.parent is None) != (self.child is None):
            raise ValueError("needs both parent and child, or neither")
        if self.attitude and self.parent:
            raise ValueError("has attitude beside frames: leave one of them out")
        return self

    @property
    def joins_topics(self) -> bool:
        """True if position and attitude come from separate topics."""
        return self.attitude is not None


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
    """Validate the options beside a file by the model that its format has for a part of the manifest.

    DataError if the format takes no such option, or not with this value; `place` names it in messages.
    """
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
