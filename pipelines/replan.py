"""Stage `replan`: fly the formation planners again, offline, with the logged actor and the maps.

Every arm is replayed, what its cameras measure of the actor's skeleton is simulated, and all are scored
alike; metrics.json marks what was simulated. The stage's folder holds the last comparison, and every one by
its name in a folder of its own.
"""

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.formats.common.files import read_yaml
from pipelines.planning.arms import PLANNER_ARMS
from pipelines.planning.comparison import ArmResult, compare
from pipelines.planning.config import ErrorModel, Imperfections
from pipelines.planning.replay import (
    FLOWN,
    LOGGED,
    PLANNED,
    MeasuredJoints,
    flight_from,
    fly_arm,
    logged_arm,
    measure_arm,
    trajectories,
)
from pipelines.planning.scene import (
    PICTURES_HZ,
    LoggedFlight,
    ReplanSettings,
    ReplayScene,
    build_scene,
    load_flight,
    replan_settings,
)
from pipelines.session.description import Description, read_description
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps
from pipelines.session.parallel import return_freed_arrays, return_unused
from pipelines.session.progress import Progress, Silent
from pipelines.session.stages import Stage, StageRecord, WritableSession, key_of, locked, usable_record
from pipelines.session.storage import jsonable, read_json, sha256_of, write_json
from pipelines.session.tables import ACTOR, REPLAN, read_table, write_table
from pipelines.session.yaml_files import plain_yaml
from pipelines.simulation.detector_errors import (
    ANY_JOINT,
    MEDIAN_PER_SIGMA,
    PERSON_HEIGHT_M,
    detect_by_model,
    errors_of,
    filmed_errors,
    read_errors,
)
from pipelines.simulation.scenario import DetectorErrors

REPLAN_STAGE = Stage("replan", revision=23)

_SKELETON = "reconstruct/skeleton.parquet"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_ENDINGS = (".json", ".parquet")  # of the tables beside the folders of comparisons


@dataclass(frozen=True)
class Replanned:
    """Result of a comparison."""

    folder: Path
    record: StageRecord
    metrics: dict[str, Any]
    skipped: bool  # True if nothing had changed


def settings_of(stated: Sequence[str], **others: Any) -> ReplanSettings:
    """Make settings of YAML files and of texts KEY=VALUE, the last one counts; DataError: one is wrong."""
    values: dict[str, object] = {}
    source: Path | str = "--config"
    for one in stated:
        key, equals, value = one.partition("=")
        if equals and not Path(one).exists():
            values[key.strip()] = plain_yaml(Path(one), value)
        else:
            source = Path(one)
            values |= read_yaml(source)
    return replan_settings(values, source, **others)


def replan(
    folder: Path,
    settings: ReplanSettings = ReplanSettings(),  # noqa: B008  # it is frozen
    *,
    name: str | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Replanned:
    """Replay the planners on a session, and compare them; run again even if nothing changed with `force`.

    `name` is that of the folder in which the comparison stays: by default the first digits of the key.
    DataError: the session cannot be used (it has no positions of the actor, or a table was changed), or a
    setting is wrong. BusyError: another process writes the session.
    """
    progress = progress or Silent()
    return_freed_arrays()
    refuse_unknown(settings.arms or ())
    refuse_name(name)
    with locked(folder) as session:
        description, reconstructed, inputs = inputs_of(session)
        stated = settings_by_name(settings)
        name = name or f"run-{key_of(REPLAN_STAGE, stated, inputs)[:8]}"
        run = session.begin(REPLAN_STAGE, settings=stated | {"name": name}, inputs=inputs, force=force)
        if run.finished:
            metrics = read_json(folder / "replan" / "metrics.json")
            return Replanned(folder, run.record, metrics, skipped=True)

        flight = load_flight(folder, description, reconstructed, pose_noise=settings.pose_noise)
        arms = _arms(folder, settings.arms, flight)
        errors = detector_errors(session)
        maps = load_maps(folder) if description.map else []
        joints = flight.skeleton.joints if flight.skeleton else ()
        scene = build_scene(flight, maps, description, settings, errors=error_model(errors, joints))
        for note in scene.notes:
            progress.note(note)
        progress.start("Replaying", len(arms))
        made = {}
        for arm in arms:
            made[arm] = run.chunk(arm, partial(fly_and_measure, scene, errors, arm))
            (run.folder / arm).mkdir()
            for table in made[arm].glob("*.parquet"):
                shutil.copyfile(table, run.folder / arm / table.name)
            return_unused(cycles=False)
            progress.advance()
        results = {arm: read_result(place) for arm, place in made.items()}
        keypoints = f"modelled after {errors.detector}"
        metrics = jsonable({"name": name} | compare(scene, results) | {"keypoints": keypoints})
        actor = pd.DataFrame({"t_ns": scene.t_ns, "person": 0})
        actor[["x", "y", "z"]] = scene.actor
        write_table(run.folder / "actor.parquet", actor, ACTOR)
        write_json(run.folder / "metrics.json", metrics)
        kept, lost = _keep_by_name(
            session, run.folder, name, {"settings": jsonable(stated), "inputs": inputs}
        )
        counts = {
            "kept": kept,
            "moments": len(scene.t_ns),
            "pictures": len(scene.t_ns[scene.pictures]),
            "joint_frames": {
                name: read_json(place / "facts.json")["joint_frames"] for name, place in made.items()
            },
            "safety": {name: result.flight.safety for name, result in results.items()},
        }
        record = run.publish(counts=counts, warnings=metrics["warnings"])
        for setting, (before, now) in run.replaces.items():
            if setting != "name":
                progress.note(f"the comparison before was made with {setting} = {before} (now {now})")
        for other in lost:
            progress.note(f"replan/{other} was changed by hand since: it is no longer kept")
    return Replanned(folder, record, metrics, skipped=False)


def refuse_name(name: str | None) -> None:
    """Refuse, with a DataError, a name that cannot be a folder of its own among those of tables and arms."""
    if name is None:
        return
    if not _NAME.fullmatch(name) or name.casefold().endswith(_ENDINGS):
        problem, remedy = "cannot be a folder", "take letters, digits, points, - and _, without an ending"
        raise DataError(f"--name {name!r}", problem, remedy, code="not-a-folder")
    if name.casefold() in {arm.casefold() for arm in (*PLANNER_ARMS.names(), *LOGGED)}:
        raise DataError(f"--name {name}", "is the name of an arm", "take another one", code="bad-option")


def _keep_by_name(
    session: WritableSession, folder: Path, name: str, made_of: Mapping[str, object]
) -> tuple[list[str], list[str]]:
    """Copy the comparison in `folder` into a folder of its name, and earlier ones from the stage before."""
    own = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    for path in own:
        target = folder / name / path.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    write_json(folder / name / "settings.json", made_of)
    before = usable_record(session.folder / "replan" / "stage.json")
    earlier: dict[str, dict[str, str]] = {}
    for output, digest in ({} if before is None else before.outputs).items():
        earlier.setdefault(output.split("/")[1], {})[output] = digest
    kept, lost = [name], []
    for other, files in earlier.items():
        if other == name or f"replan/{other}/metrics.json" not in files:
            continue
        paths = {session.folder / output: digest for output, digest in files.items()}
        if all(path.is_file() and sha256_of(path) == digest for path, digest in paths.items()):
            shutil.copytree(session.folder / "replan" / other, folder / other)
            kept.append(other)
        else:
            lost.append(other)
    return sorted(kept), lost


def inputs_of(session: WritableSession) -> tuple[Description, StageRecord | None, dict[str, str]]:
    """Load the inputs: all that was ingested, and the reconstruction if there is no truth or no actor."""
    ingested = session.ingested()
    description = read_description(session.folder)
    inputs = dict(ingested.outputs)
    needs_it = description.actor is None or not description.has_true_joints
    reconstructed = session.intact_record("reconstruct") if needs_it else None
    if reconstructed is not None:
        inputs[_SKELETON] = reconstructed.outputs[_SKELETON]
    errors = detector_errors(session)
    if errors != filmed_errors(None):
        inputs["errors of the detector"] = sha256_of(errors_of(errors.detector))
    return description, reconstructed, inputs


def detector_errors(session: WritableSession) -> DetectorErrors:
    """Choose the errors of the detector that ran on the session's pictures, if measured; else the default."""
    detected = session.record("detect")
    name = None if detected is None else detected.settings["detector"]
    return filmed_errors(name)


def error_model(errors: DetectorErrors, joints: tuple[str, ...]) -> ErrorModel:
    """Build the ray model's errors from a detector's table: RMS over joints, or its row for any joint."""
    table = read_errors(errors_of(errors.detector))
    tilts_deg = np.unique(np.concatenate([rows[:, 0] for rows in table.rows.values()]))
    share, missed, _ = table.at(tilts_deg, joints or (ANY_JOINT,))
    sigma_m = errors.scale * PERSON_HEIGHT_M * np.sqrt(np.mean(share**2, axis=1)) / MEDIAN_PER_SIGMA
    return ErrorModel(
        tilts_deg=tuple(tilts_deg.tolist()),
        keypoint_sigma_m=tuple(sigma_m.tolist()),
        placed_share=tuple((1.0 - missed.mean(axis=1)).tolist()),
    )


def settings_by_name(settings: ReplanSettings) -> dict[str, object]:
    """Flatten the settings to names and values, so that a change of each planner setting can be reported."""
    stated = asdict(settings)
    planner = stated.pop("planner")
    del planner["tuning"]  # no settings
    usual, own = asdict(Imperfections()), planner.pop("imperfections")
    planner |= {f"imperfections.{name}": value for name, value in own.items() if value != usual[name]}
    return stated | {f"planner.{name}": value for name, value in planner.items()}


def refuse_unknown(arms: Sequence[str], *, logged: bool = True) -> None:
    """Refuse arms that do not exist; with `logged` those of the log exist, too."""
    known = [*PLANNER_ARMS.names(), *(LOGGED if logged else ())]
    for arm in arms:
        if arm not in known:
            problem = "no such planner arm"
            raise DataError(f"--arms {arm}", problem, f"there are {', '.join(known)}", code="no-such-name")


def _arms(folder: Path, asked: tuple[str, ...] | None, flight: LoggedFlight) -> list[str]:
    if asked is None:
        return [
            *(["group"] if len(flight.people) > 1 else []),
            "adaptive",
            "fixed",
            *(["joint"] if len(flight.people) < 2 else []),
            *([FLOWN] if flight.moves else []),
            *([PLANNED] if flight.planned else []),
        ]
    if FLOWN in asked and not flight.moves:
        problem = "has no flight to compare with: its cameras stand still"
        raise DataError(folder, problem, f"leave {FLOWN} out")
    if PLANNED in asked and not flight.planned:
        problem = "holds no commands of a planner on board"
        raise DataError(folder, problem, f"name them under `plan:`, or leave {PLANNED} out")
    return list(dict.fromkeys(asked))


def fly_and_measure(scene: ReplayScene, errors: DetectorErrors, arm: str, folder: Path) -> None:
    """Fly one arm and measure from its cameras; write everything that the comparison needs to the folder."""
    flown = logged_arm(scene, arm) if arm in LOGGED else fly_arm(scene, PLANNER_ARMS.get(arm))
    joints = scene.flight.skeleton.joints if scene.flight.skeleton else ()
    measured = measure_arm(
        scene, flown, partial(detect_by_model, joints=joints, errors=errors, rate_hz=PICTURES_HZ)
    )
    write_table(folder / "trajectories.parquet", trajectories(scene, flown), REPLAN)
    np.save(folder / "aim.npy", flown.aim)
    facts: dict[str, object] = {"safety": flown.safety, "joint_frames": 0}
    if measured is not None:
        np.save(folder / "error_m.npy", measured.error_m)
        facts |= {"joint_frames": measured.joint_frames}
    write_json(folder / "facts.json", facts)


def read_result(folder: Path) -> ArmResult:
    """Read what `fly_and_measure` wrote."""
    facts = read_json(folder / "facts.json")
    table = read_table(folder / "trajectories.parquet", REPLAN)
    errors = folder / "error_m.npy"
    return ArmResult(
        flight=flight_from(table, np.load(folder / "aim.npy"), facts["safety"]),
        measured=MeasuredJoints(np.load(errors), facts["joint_frames"]) if errors.exists() else None,
    )
