"""Stage `survey`: description of a file or folder, for `mocap info`."""

from collections.abc import Callable, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.formats.common.files import read_yaml
from pipelines.planning.config import SETTINGS
from pipelines.planning.scene import replan_settings
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.manifest import Manifest, read_flight
from pipelines.session.recognition import EXPECTED, describe_unknown, refuse_pointers
from pipelines.session.registries import FORMATS
from pipelines.session.stages import STAGES, open_session, outdated
from pipelines.session.storage import SIMULATION_MARK, STUDY_MARK, read_json, refuse_newer, refuse_special
from pipelines.session.yaml_models import YamlModel, keys_of
from pipelines.simulation.scenario import Scenario, read_scenario


@dataclass(frozen=True)
class Survey:
    """Description of a path."""

    path: Path
    title: str  # name of its kind
    facts: dict[str, Any]  # its content, JSON-able, in reading order


def survey(path: Path) -> list[Survey]:
    """Describe a result, a file written for mocap, or one of a registered format, once for each of these."""
    if not path.exists():
        raise DataError(path, "does not exist", "check the path", code="no-such-file")
    refuse_special(path)
    refuse_pointers(path)
    if (path / "session.json").is_file():
        return [Survey(path, "session", _of_session(path))]
    if made := _of_summary(path):
        return [made]
    readings = [
        Survey(path, format_.title, format_.describe(path))
        for format_ in FORMATS.all()
        if format_.recognises(path)
    ]
    if readings:
        return readings
    if path.suffix in {".yaml", ".yml"} and path.is_file():
        return [_of_yaml(path)]
    like = describe_unknown(path)
    raise DataError(path, like.problem, like.remedy or EXPECTED, code="wrong-kind")


def _of_session(path: Path) -> dict[str, Any]:
    session = open_session(path)
    description = read_description(path)
    records = {stage: record for stage in STAGES if (record := session.record(stage))}
    detected = records["detect"].counts["cameras"] if "detect" in records else {}
    facts: dict[str, Any] = {
        "flight": description.flight,
        "cameras": {
            name: {
                "picture": f"{camera.intrinsics.width}x{camera.intrinsics.height}",
                "frames": camera.frames.count,
                "rate_hz": camera.frames.rate_hz,
                "poses": camera.poses.count,
                "frames_without_pose": camera.poses.frames_without_pose,
                "detections": (
                    camera.keypoints.detections
                    if camera.keypoints
                    else detected.get(name, {}).get("detections")
                ),
            }
            for name, camera in description.cameras.items()
        },
        "truth": sorted(description.truth.joints) if description.truth else None,
        "warnings": description.warnings,
    }
    for stage, record in records.items():
        if stage == "ingest":
            continue
        said = {"warnings": record.warnings} if record.warnings else {}  # doubts are the first of them
        facts[stage] = said | {"settings": record.settings, "counts": record.counts}
    for stage in outdated(records, description.recorded):
        facts[stage]["out of date"] = "what it was made of has changed since: run it again"
    return facts


def _of_summary(path: Path) -> Survey | None:
    """Describe a folder of `mocap simulate` or `mocap study`, or its summary; None if it is neither."""
    for mark, title, reader in (
        (SIMULATION_MARK, "simulated flight", _of_simulation),
        (STUDY_MARK, "study, simulated", _of_study),
    ):
        file = path / mark if path.is_dir() else path
        if file.name != mark or not file.is_file():
            continue
        summary: Mapping[str, Any] = {}
        with suppress(DataError):  # damaged, or another program's file of that name: described as any file
            summary = read_json(file)
        if summary.get("simulated") is True:
            if mark == STUDY_MARK:
                file = file.with_name("metrics.json")
                summary = read_json(file)
            return Survey(path, title, _described(file, summary, reader))
    return None


def _described(
    file: Path, summary: Mapping[str, Any], reader: Callable[[Mapping[str, Any]], dict[str, Any]]
) -> dict[str, Any]:
    refuse_newer(file, summary, "make the folder again")
    try:
        return reader(summary)
    except (KeyError, TypeError, AttributeError):
        problem = "lacks what it should hold"
        raise DataError(file, problem, "make the folder again", code="wrong-kind") from None


def _of_simulation(summary: Mapping[str, Any]) -> dict[str, Any]:
    return {name: summary[name] for name in ("name", "seed", "duration_s", "pictures", "frames", "poses")}


def _of_study(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Describe the command of a study, and the mean error of every condition."""
    errors: dict[str, Any] = {}
    for cell in metrics["cells"]:
        condition = f"{cell['tilt_deg']:g} deg, {cell['robots']} drones"
        if metrics["kind"] == "session":
            errors[f"{cell['arm']}, {cell['range_m']:g} m, {condition}"] = cell["mpjpe_mm"]
        else:
            error = cell["metrics"]["mpjpe_mm"]
            own = errors.setdefault(f"{condition}, noise {cell['noise']}", {})
            own[cell["method"]] = None if error is None else error["mean"]
    return {"study": " ".join(metrics["command"]), "keypoints": metrics["keypoints"], "mpjpe_mm": errors}


def _of_yaml(path: Path) -> Survey:
    """Describe a flight manifest, a scenario or planner settings; the kind is that of most of the keys."""
    stated = read_yaml(path)
    kinds: dict[str, tuple[Set[str], Callable[[Path], YamlModel] | None]] = {
        "flight manifest": (keys_of(Manifest), read_flight),
        "scenario": (keys_of(Scenario), read_scenario),
        "planner settings": ({*SETTINGS, "yaw_deg", "mode"}, None),
    }
    known = {title: len(keys & stated.keys()) for title, (keys, _) in kinds.items()}
    title, most = max(known.items(), key=lambda each: each[1])
    if list(known.values()).count(most) > 1:  # `schema` and `name` are keys of several kinds
        like = describe_unknown(path)
        keys = "flight manifests have `cameras:`, scenarios `drones:`, planner settings keys like `w_obs:`"
        raise DataError(path, like.problem, like.remedy or keys, code="wrong-kind")
    read = kinds[title][1]
    if read is None:
        replan_settings(stated, path)
        return Survey(path, title, stated)
    return Survey(path, title, read(path).model_dump(mode="json", exclude_defaults=True))
