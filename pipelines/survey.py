"""Stage `survey`: what is in this file or folder? The answer of `mocap info`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from pipelines.session.registries import FORMATS, why_not
from pipelines.session.stages import open_session


@dataclass(frozen=True)
class Survey:
    """What a path holds."""

    path: Path
    title: str  # what it is
    facts: dict[str, Any]  # what is inside, JSON-able, in reading order


def survey(path: Path) -> list[Survey]:
    """Look into a session, a manifest or a file of any registered format; one answer for each reading.

    Raises:
        DataError: the path is missing, damaged, or of no known kind.
    """
    if not path.exists():
        raise DataError(path, "does not exist", "check the path")
    if (path / "session.json").is_file():
        return [Survey(path, "session", _of_session(path))]
    readings = [
        Survey(path, format_.title, format_.describe(path))
        for format_ in FORMATS.all()
        if format_.recognises(path)
    ]
    if readings:
        return readings
    if path.suffix in {".yaml", ".yml"}:
        return [Survey(path, "flight manifest", _of_manifest(path))]
    raise DataError(
        path, f"is of no known kind{why_not(path)}", f"known formats: {', '.join(FORMATS.names())}"
    )


def _of_session(path: Path) -> dict[str, Any]:
    session = open_session(path)
    description = read_description(path)
    facts: dict[str, Any] = {
        "flight": description.flight,
        "cameras": {
            name: {
                "picture": f"{camera.intrinsics.width}x{camera.intrinsics.height}",
                "frames": camera.frames.count,
                "rate_hz": camera.frames.rate_hz,
                "poses": camera.poses.count,
                "frames_without_pose": camera.poses.frames_without_pose,
                "detections": camera.keypoints.detections if camera.keypoints else 0,
            }
            for name, camera in description.cameras.items()
        },
        "truth": sorted(description.truth.joints) if description.truth else None,
        "warnings": description.warnings,
    }
    for stage in ("detect", "reconstruct", "replan", "report"):
        if record := session.record(stage):
            facts[stage] = {"settings": record.settings, "counts": record.counts}
    return facts


def _of_manifest(path: Path) -> dict[str, Any]:
    flight = read_flight(path)
    return {
        "name": flight.name,
        "clock_reference": flight.reference_camera,
        "cameras": {
            name: camera.model_dump(mode="json", exclude_defaults=True)
            for name, camera in flight.cameras.items()
        },
        "truth": flight.truth.model_dump(mode="json", exclude_defaults=True) if flight.truth else None,
    }
