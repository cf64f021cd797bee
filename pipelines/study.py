"""Stage `study`: how an error depends on what is varied, over a simulated walk or over a session.

A study of a walk films a walking person from ideal positions, disturbs poses and keypoints in several trials,
and triangulates by every method; errors are on the joint-frames that all methods have. A study of a session
flies planner arms against its log with other settings, with the same draws. All figures are simulated.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import PCK_THRESHOLD_M, common, measure
from pipelines.geometry.noise import NoiseModel, pose_errors
from pipelines.geometry.triangulation import Views, triangulate
from pipelines.planning.comparison import (
    SMALLEST_DIFFERENCE_MM,
    capped_mm,
    compare,
    few_trials,
    figures_of,
    mean_of_trials,
    worth_flying,
)
from pipelines.planning.config import MOST_DRONES, PlannerConfig, planner_config
from pipelines.planning.scene import (
    LoggedFlight,
    OtherWalk,
    ReplanSettings,
    ReplayScene,
    build_scene,
    load_flight,
    map_doubts,
    walked_otherwise,
)
from pipelines.reconstruction.refining import refined_points
from pipelines.replan import (
    detector_errors,
    error_model,
    fly_and_measure,
    inputs_of,
    read_result,
    refuse_unknown,
    settings_by_name,
    settings_of,
)
from pipelines.reporting.studies import ENDS, Row, draw, estimates, rows_csv
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps
from pipelines.session.progress import Halt, Progress, Silent, side_by_side
from pipelines.session.records import Occupancy
from pipelines.session.stages import locked
from pipelines.session.storage import (
    STUDY_MARK,
    Making,
    hash_of,
    is_made,
    jsonable,
    read_json,
    refuse_sessions,
    sha256_of,
    whole_folder,
    write_json,
)
from pipelines.session.yaml_files import OPTION_CODES, checked, plain_yaml
from pipelines.session.yaml_models import YamlModel
from pipelines.simulate import recorded_motions
from pipelines.simulation.detector_errors import errors_of
from pipelines.simulation.flight import build_set
from pipelines.simulation.scenario import read_scenario
from pipelines.simulation.walks import (
    IMITATED,
    LEVELS,
    StudyMethod,
    Variables,
    Walk,
    WalkStudy,
    exact_keypoints,
    formation,
    model_keypoints,
    triangulate_robustly,
    varied_most,
    views_of,
    walk,
    walk_of,
)

# It is raised whenever the same study gives other figures than before.
_REVISION = 19
# A study with more combinations would take days.
_MAX_CELLS = 500
_COMMA = r",(?![^\[]*\])"  # not between brackets
_RANGE = re.compile(r"(-?[0-9.]+):(-?[0-9.]+):([0-9.]+)")
_MEASURED = (
    *("capped_mm", "mpjpe_mm", "pck150", "coverage", "mean_range_m", "mean_tilt_deg", "hidden_share"),
    *("blind_s", "path_m", "energy_kj", "min_clearance_m", "min_separation_m", "min_actor_distance_m"),
    *("violations", *chain(*ENDS.values())),
)
"""Figures of a combination, in the rows of a study of a session."""
_UNDIVIDED = ("config",)  # variables whose value may hold commas
# People walk up to a third slower or faster than usual, stand a while, and turn where they please.
_SPEEDS, _MOST_DELAY_S, _MOST_TURN_DEG = (0.7, 1.4), 3.0, 60.0
# A way that is turned into obstacles so often is not turned at all.
_MOST_TRIES = 50
_IMPERFECTION = "imperfections."  # variables that nobody chooses
_SETTINGS = {"range_m": "radius_m", "tilt_deg": "tilt_deg"}  # variables with the names of planner settings

Stated = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Studied:
    """Result of a study."""

    folder: Path
    metrics: dict[str, Any]
    skipped: bool  # True if the study existed already


def values_of(words: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Parse `VARIABLE=VALUES` words: values between commas (noise models: semicolons), or START:STOP:STEP."""
    stated: dict[str, tuple[str, ...]] = {}
    for word in words:
        name, _, text = word.partition("=")
        if name in stated:
            raise DataError(word, f"states {name} twice", "state it once", code="stated-twice")
        found = _RANGE.fullmatch(text)
        if found is not None:
            start, stop, step = map(float, found.groups())
            count = int((stop - start) / step + 1e-9) + 1 if step > 0 else 0
            values = tuple(f"{start + k * step:.12g}" for k in range(min(count, _MAX_CELLS)))
        elif name in _UNDIVIDED:
            values = (text,)
        else:
            models = name.endswith("noise") and ":" in text
            values = tuple(part.strip() for part in re.split(";" if models else _COMMA, text))
        if not values or not all(values):
            raise DataError(word, "states no value", "write 2,3,4 or 0:60:15", code="bad-value")
        stated[name] = values
    return stated


def study(
    words: Sequence[str],
    place: Path | None,
    folder: Path,
    *,
    workers: int = 1,
    overwrite: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> Studied:
    """Run a study; conditions that an interrupted run finished are kept, whatever `workers` is.

    `words` are the variables with their values, as `values_of` reads them; `place` a session, or the scenario
    of the walk, None for a walk on a circle. An earlier study in the folder is replaced, with `overwrite`
    anything. DataError: a variable or value is wrong, the folder cannot be written or is a session's, the
    session or the scenario cannot be used, or nothing was reconstructed. BusyError: another process works
    there.
    """
    progress = progress or Silent()
    stated = values_of(words)
    refuse_sessions(folder, mark=STUDY_MARK, option="--output")
    command = [f"{name}={_joined(values)}" for name, values in stated.items()]
    command += [place.name] if place is not None else []
    store = partial(_stored, folder, command=command, overwrite=overwrite, force=force)
    if place is not None and place.is_dir():
        return _study_session(stated, place, store, progress)
    return _study_walk(stated, place, store, workers, progress)


def _joined(values: Sequence[str]) -> str:
    has_commas = any(re.search(_COMMA, value) for value in values)
    return (";" if has_commas and len(values) > 1 else ",").join(values)


Produce = Callable[[Making], tuple[dict[str, Any], Sequence[Row]]]
Store = Callable[[dict[str, object], Produce], Studied]


def _stored(
    folder: Path,
    ingredients: dict[str, object],
    produce: Produce,
    *,
    command: list[str],
    overwrite: bool,
    force: bool,
) -> Studied:
    """Return the study of this key if it exists, else make it: its metrics, its rows and its figure."""
    key = hash_of({"revision": _REVISION, **ingredients})
    if not force and is_made(folder, key, mark=STUDY_MARK):
        return Studied(folder, read_json(folder / "metrics.json"), skipped=True)
    with whole_folder(folder, key, mark=STUDY_MARK, overwrite=overwrite) as making:
        metrics, rows = produce(making)
        metrics = jsonable({"schema": 1, "simulated": True, "command": command, **metrics})
        (making.folder / "table.csv").write_text(rows_csv(rows), encoding="utf-8", newline="\n")
        draw(making.folder, metrics)
        write_json(making.folder / "metrics.json", metrics)
        write_json(
            making.folder / STUDY_MARK, {"schema": 1, "simulated": True, "key": key, "command": command}
        )
        making.publish()
    return Studied(folder, metrics, skipped=False)


# --- a walk --------------------------------------------------------------------------------------------


class _Condition(NamedTuple):
    """One condition of a study of a walk: columns of its rows."""

    tilt_deg: float
    robots: int
    noise: str
    noise_model: str


def _study_walk(
    stated: Stated, place: Path | None, store: Store, workers: int, progress: Progress
) -> Studied:
    scenario = None if place is None else read_scenario(place)
    if scenario is not None and "seconds" not in stated:
        stated = {**stated, "seconds": (f"{scenario.duration_s:g}",)}
    settings, axis = checked(WalkStudy, stated, "study", OPTION_CODES), varied_most(stated)
    noise = {label: LEVELS.get(label, label) for label in settings.noise}
    shown = {"axis": axis, **settings.model_dump(), "noise": noise}
    ingredients: dict[str, object] = {"settings": shown}
    motions = {}
    if scenario is not None and place is not None:
        motions = recorded_motions(scenario, place)
        ingredients["scenario"] = scenario.identity()
        ingredients["motions"] = {
            name: sha256_of(file) for name, (file, _) in scenario.motion_files(place.parent).items()
        }
    imitated = IMITATED if scenario is None else scenario.keypoints.detector
    ingredients["errors"] = sha256_of(errors_of(imitated))
    keypoints = "exact" if settings.keypoints == "exact" else f"modelled after {imitated}"

    def produce(making: Making) -> tuple[dict[str, Any], Sequence[Row]]:
        if scenario is None:
            filmed = walk(settings.seconds, settings.rate_hz, settings.seed)
        else:
            performer = build_set(scenario, bvh=motions).people[0]
            filmed = walk_of(performer, scenario, settings.seconds, settings.rate_hz)
        conditions = [
            _Condition(*each, *of)
            for of in noise.items()
            for each in product(settings.tilts_deg, settings.robots)
        ]
        progress.start("Measuring", len(conditions) * settings.trials)
        halt = Halt()
        work = [
            (f"cell-{k:04d}", partial(_measure_condition, settings, filmed, each, halt, progress))
            for k, each in enumerate(conditions)
        ]
        parts = side_by_side(lambda each: making.part(*each), work, workers=workers, halt=halt)
        rows = [row for part in parts for row in read_json(part / "rows.json")["rows"]]
        cells = estimates(rows, axis)
        if not any(cell["metrics"]["mpjpe_mm"] for cell in cells):
            problem = "nothing was reconstructed by all methods"
            raise DataError("study", problem, "film longer, or at lower tilts", code="nothing-reconstructed")
        metrics = {
            "kind": "walk",
            "axis": axis,
            "scenario": None if scenario is None else scenario.name,
            "keypoints": keypoints,
            "settings": shown,
            "cells": cells,
        }
        return metrics, rows

    return store(ingredients, produce)


def _measure_condition(
    settings: WalkStudy, filmed: Walk, condition: _Condition, halt: Halt, progress: Progress, folder: Path
) -> None:
    cameras = formation(filmed, cameras=condition.robots, tilt_deg=condition.tilt_deg)
    exact = exact_keypoints(filmed, cameras)
    models = settings.models(condition.noise)
    rows: list[Row] = []
    for trial in range(settings.trials):
        halt.check()
        sightings = exact
        if settings.keypoints == "model":
            sightings = model_keypoints(filmed, cameras, exact, seed=settings.seed, trial=trial)
        views = views_of(*(filmed, cameras, sightings, models), seed=settings.seed, trial=trial)
        points, fell_back = {}, {}
        for method in settings.methods:
            points[method], doubt = _reconstructed(method, views, filmed, models)
            fell_back[method] = float(doubt is not None)
        for method, errors in _compared(points, filmed).items():
            own = {"trial": trial, "method": method, **errors, "fell_back": fell_back[method]}
            rows.append({**condition._asdict(), **own})
        progress.advance()
    write_json(folder / "rows.json", {"rows": rows})


def _reconstructed(
    method: StudyMethod, views: Views, filmed: Walk, models: Sequence[NoiseModel]
) -> tuple[Float, str | None]:
    """Triangulate views by a method: points [N, 3] m (NaN without any), and the reason for a fallback."""
    if method == "auto":
        elapsed_s = (filmed.t_ns - filmed.t_ns[0]) / 1e9
        prior = [pose_errors(models)] * views.position.shape[1]
        return refined_points(views, elapsed_s, tuple(filmed.person.joints), prior)[1:]
    if method == "robust":
        return triangulate_robustly(views)[1], None
    return triangulate(views, method=method).points, None


def _compared(points: Mapping[StudyMethod, Float], filmed: Walk) -> dict[StudyMethod, Row]:
    """Compute the errors of several methods on one walk, from points [T * J, 3] m of each, joints fastest."""
    truth = filmed.joints[:, None]
    found = {method: own.reshape(truth.shape) for method, own in points.items()}
    shared = common(*found.values())
    rows: dict[StudyMethod, Row] = {}
    for method, own in found.items():
        errors = measure(np.where(shared[..., None], own, np.nan), truth, filmed.person.joints, filmed.t_ns)
        distance = np.linalg.norm(own - truth, axis=-1)
        there = distance[np.isfinite(distance)]
        errors["common_share"] = errors["reconstructed_share"]
        errors["reconstructed_share"] = there.size / distance.size
        errors["own_mpjpe_mm"] = 1e3 * float(there.mean()) if there.size else None
        errors["pck150"] = int((there <= PCK_THRESHOLD_M).sum()) / distance.size
        near = np.maximum(0.0, 1 - there / PCK_THRESHOLD_M)
        errors["pck150_auc"] = float(near.sum()) / distance.size
        del errors["per_joint"]
        rows[method] = errors
    return rows


# --- a session -----------------------------------------------------------------------------------------


def _study_session(stated: Stated, place: Path, store: Store, progress: Progress) -> Studied:
    settings, varied = _replay_settings(stated)
    with locked(place) as session:
        description, reconstructed, inputs = inputs_of(session)
        cells = list(_cells(varied))
        ingredients: dict[str, object] = {
            "settings": settings_by_name(settings),
            "cells": cells,
            "inputs": inputs,
        }

        def produce(making: Making) -> tuple[dict[str, Any], Sequence[Row]]:
            flight = load_flight(place, description, reconstructed, pose_noise=settings.pose_noise)
            if flight.skeleton is None:
                raise _no_skeleton(place)
            errors = detector_errors(session)
            model = error_model(errors, flight.skeleton.joints)
            maps = sorted(load_maps(place), key=lambda one: one.from_ns) if description.map else []
            scenes: dict[str, ReplayScene] = {}
            progress.start("Replaying", len(cells))
            walks = _walks(stated, flight, maps, settings.seed)
            rows, capped, places = [], [], []
            for k, cell in enumerate(cells):
                own = replace(settings, planner=_planner_of(settings.planner, cell))
                # Distance, tilt and number change nothing that the replays share.
                shared = {name: cell[name] for name in cell if name not in ("arm", "robots", *_SETTINGS)}
                name = hash_of(shared)
                if name not in scenes:
                    walked = walks[shared["actor"]] if "actor" in shared else flight
                    scenes[name] = build_scene(walked, maps, description, own, errors=model)
                scene = _scene_of(scenes[name], cell)
                flown = making.part(f"cell-{k:04d}", partial(fly_and_measure, scene, errors, _arm_of(cell)))
                places.append(flown)
                result = read_result(flown)
                if result.measured is None:
                    raise _no_skeleton(place)
                capped.append(capped_mm(result.measured))
                arm = _arm_of(cell)
                scores = compare(scene, {arm: result})["arms"][arm]
                rows.append(_figures(scene, cell, scores, capped[-1]))
                progress.advance()
            every = rows
            if len(walks) > 1:
                groups = _by_combination(rows)
                rows = [_over_walks([every[k] for k in own]) for own in groups]
                capped = [np.array([capped[k].mean() for k in own]) for own in groups]
            best = [_mark_tradeoff(rows, capped, own) for own in _by_condition(rows)]
            if len(walks) > 1:
                for row, group in zip(rows, groups, strict=True):
                    for k in group:
                        every[k] |= {"best": row["best"], "tradeoff": row["tradeoff"]}
                by_walk = [[places[k] for k in own] for own in groups]
                for one in best:
                    one["walks"] = [_count_walks(by_walk[one["cell"]], own) for own in by_walk]
            metrics = {
                "kind": "session",
                "varied": [name for name in varied if name != "actor"],
                "walks": len(walks),
                "trials": settings.trials,
                "seed": settings.seed,
                "keypoints": f"modelled after {errors.detector}",
                "best": best,
                "cells": rows,
                "verdict": ". ".join(_verdict(rows, one) for one in best),
                "warnings": [*flight.warnings, *few_trials(settings.trials), *_doubts(scenes, maps)],
            }
            return metrics, every

        return store(ingredients, produce)


def _walks(
    stated: Stated, flight: LoggedFlight, maps: Sequence[Occupancy], seed: int
) -> dict[str, LoggedFlight]:
    """Return the flights of the walks that `actor` asks for: a number of them, or one for each value."""
    texts = stated.get("actor", ())
    if len(texts) != 1 or not texts[0].isdigit():
        return {text: walked_otherwise(flight, _walk_of(text), maps) for text in texts}
    walks = {_walk_name(0): flight}
    for k in range(1, len(_walk_names(texts))):
        rng = np.random.default_rng([seed, k])
        for tries in range(_MOST_TRIES):
            turn_deg = rng.uniform(-_MOST_TURN_DEG, _MOST_TURN_DEG) if tries < _MOST_TRIES - 1 else 0.0
            walk = OtherWalk(
                float(np.exp(rng.uniform(*np.log(_SPEEDS)))),
                float(rng.uniform(0.0, _MOST_DELAY_S)),
                float(turn_deg),
                float(rng.uniform(0.2, 0.8)),
            )
            with suppress(DataError):
                walks[_walk_name(k)] = walked_otherwise(flight, walk, maps)
                break
    return walks


def _walk_name(number: int) -> str:
    return f"walk {number}"


def _walk_names(texts: Sequence[str]) -> Sequence[str]:
    """Return the names of the walks that `actor` asks for."""
    if len(texts) == 1 and texts[0].isdigit():
        if not 1 <= (number := int(texts[0])) <= _MAX_CELLS:
            problem = f"is not between 1 and {_MAX_CELLS}"
            raise DataError(f"actor={texts[0]}", problem, "change it", code="bad-value")
        return [_walk_name(k) for k in range(number)]
    for text in texts:
        _walk_of(text)
    return texts


class _WalkWords(YamlModel):
    """Variations of a walk, as users write them."""

    speed: float = Field(1.0, ge=0.2, le=5.0)
    delay: float = Field(0.0, ge=0.0, le=60.0)
    turn: float = Field(0.0, ge=-180.0, le=180.0)


def _walk_of(text: str) -> OtherWalk:
    """Read a walk like `speed:0.8+delay:2+turn:30`; `logged` is the walk of the log."""
    words = dict(part.partition(":")[::2] for part in text.split("+")) if text != "logged" else {}
    return OtherWalk(*checked(_WalkWords, words, f"actor={text}", OPTION_CODES).model_dump().values())


def _doubts(scenes: Mapping[str, ReplayScene], maps: Sequence[Occupancy]) -> list[str]:
    """List what the maps lack for the first of the scenes, and in how many they lack something else."""
    first, *rest = (map_doubts(scene, maps) for scene in scenes.values())
    more = [doubts for doubts in rest if set(doubts) - set(first)]
    if not more:
        return first
    example = next(doubt for doubt in more[0] if doubt not in first)
    return [*first, f"in {len(more)} of {len(scenes)} walks or settings other map troubles, as: {example}"]


def _by_combination(rows: Sequence[Row]) -> list[list[int]]:
    """Group rows that differ by their walks alone."""
    groups: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        settings = {name: row[name] for name in row if name not in (*_MEASURED, "actor")}
        groups.setdefault(hash_of(settings), []).append(k)
    return list(groups.values())


def _over_walks(rows: Sequence[Row]) -> Row:
    """Average the rows of one combination over the walks, but take the least of distances."""
    row = {name: value for name, value in rows[0].items() if name != "actor"}
    for name in _MEASURED:
        known = [one[name] for one in rows if one[name] is not None]
        over = np.min if name.startswith("min_") else np.mean
        row[name] = float(over(known)) if known else None
    for name in ENDS:
        row |= _ends(name, mean_of_trials(np.array([one[name] for one in rows if one[name] is not None])))
    row["violations"] = sum(one["violations"] for one in rows)
    return row


def _count_walks(best: Sequence[Path], other: Sequence[Path]) -> dict[str, int]:
    """Count the walks in which the best combination is worth flying instead of another, and the reverse."""
    counts = {"better": 0, "worse": 0, "walks": len(best)}
    for places in zip(best, other, strict=True):
        one, two = (read_result(place).measured for place in places)
        if one is not None and two is not None:
            signs = worth_flying(figures_of(one, two, np.ones(one.error_m.shape, dtype=np.bool_)))
            counts["better"] += max(signs) > 0 and min(signs) >= 0
            counts["worse"] += min(signs) < 0 and max(signs) <= 0
    return counts


def _no_skeleton(place: Path) -> DataError:
    return DataError(
        place, "has no skeleton to measure", "run `mocap reconstruct` first", code="nothing-reconstructed"
    )


class _SessionStudy(Variables):
    """Variables of a study of a session besides the settings of the planner, which stay texts."""

    model_config = ConfigDict(extra="allow")

    arm: tuple[str, ...] = ("adaptive",)
    robots: tuple[Annotated[int, Field(ge=2, le=MOST_DRONES)], ...] = ()
    range_m: tuple[Annotated[float, Field(ge=0.5, le=500)], ...] = ()
    tilt_deg: tuple[Annotated[float, Field(ge=-10, le=85)], ...] = ()
    actor: tuple[str, ...] = ()
    config: tuple[str, ...] = ()
    trials: int = Field(ReplanSettings().trials, ge=1, le=10_000)
    seed: int = Field(0, ge=0, lt=2**32)
    pose_noise: tuple[str, ...] = ()


def _replay_settings(stated: Stated) -> tuple[ReplanSettings, Stated]:
    """Return the settings that all cells share, and the variables of the cells with their values."""
    given = checked(_SessionStudy, stated, "study", OPTION_CODES)
    refuse_unknown(given.arm, logged=False)
    settings = settings_of(
        given.config,
        arms=None,
        trials=given.trials,
        seed=given.seed,
        pose_noise=" + ".join(given.pose_noise) or None,
    )
    shared = ("config", "trials", "seed", "pose_noise")
    varied = {name: values for name, values in stated.items() if name not in shared}
    for cell in _cells(varied):
        _planner_of(settings.planner, cell)
    return settings, varied


def _cells(varied: Stated) -> Iterator[dict[str, Any]]:
    """Yield every combination of the values, by variable; the arm is `adaptive` if none is stated."""
    stated = {"arm": ("adaptive",), **varied}
    if "actor" in stated:
        stated["actor"] = tuple(_walk_names(stated["actor"]))
    count = int(np.prod([len(set(values)) for values in stated.values()]))
    if count > _MAX_CELLS:
        raise DataError("study", f"{count} combinations", f"ask for at most {_MAX_CELLS}", code="too-large")
    kept = [list(dict.fromkeys(values)) for values in stated.values()]
    for values in product(*kept):
        yield {
            name: value if name in ("arm", "actor") else plain_yaml(Path("study"), value)
            for name, value in zip(stated, values, strict=True)
        }


def _planner_of(planner: PlannerConfig, cell: Mapping[str, Any]) -> PlannerConfig:
    changes = {
        _SETTINGS.get(name, name): value
        for name, value in cell.items()
        if name not in ("arm", "robots", "actor")
    }
    imperfections = asdict(planner.imperfections)
    checked = planner_config({"imperfections": imperfections, **changes}, "study")
    return replace(planner, **{name.split(".")[0]: getattr(checked, name.split(".")[0]) for name in changes})


def _arm_of(cell: Mapping[str, Any]) -> str:
    return str(cell["arm"])


def _scene_of(scene: ReplayScene, cell: Mapping[str, Any]) -> ReplayScene:
    planner = _planner_of(scene.config, cell)
    robots = cell.get("robots", scene.drones)
    return replace(scene, drones=robots, settings=replace(scene.settings, planner=planner))


def _figures(
    scene: ReplayScene, cell: Mapping[str, Any], scores: dict[str, Any], capped: np.ndarray[Any, Any]
) -> Row:
    errors = scores["reconstruction_error"]
    found = {"capped_mm": mean_of_trials(capped), **errors}
    figures: Row = {}
    for name in ENDS:
        figures[name] = found[name] and found[name]["mean"]
        figures |= _ends(name, found[name])
    return {
        "arm": cell["arm"],
        **({"actor": cell["actor"]} if "actor" in cell else {}),
        "range_m": scene.config.radius_m,
        "tilt_deg": scene.config.tilt_deg,
        "robots": scene.drones,
        **{name: value for name, value in cell.items() if name not in _SessionStudy.model_fields},
        "best": False,
        "tradeoff": False,
        **figures,
        "mean_range_m": scores["range_m"]["mean"],
        "mean_tilt_deg": scores["tilt_deg"]["mean"],
        "hidden_share": scores["occluded_share"],
        "blind_s": scores["blind_s"],
        "path_m": scene.drones * scores["path_m"],
        "energy_kj": scene.drones * scores["energy_kj"],
        "min_clearance_m": scores["min_clearance_m"],
        "min_separation_m": scores["min_separation_m"],
        "min_actor_distance_m": scores["min_actor_distance_m"],
        "violations": sum(scores["limit_violations"].values()),
    }


def _ends(name: str, found: Mapping[str, Any] | None) -> Row:
    """Return the columns of the ends of a figure's interval; None where there is none."""
    ends = (found and found["interval"]) or (None, None)
    return dict(zip(ENDS[name], ends, strict=True))


def _condition(row: Row) -> str:
    """Name the imperfections under which a combination was flown: nobody chooses them, so none is best."""
    stated = (f"{name}={row[name]}" for name in row if name.startswith(_IMPERFECTION))
    return ", ".join(stated)


def _by_condition(rows: Sequence[Row]) -> list[list[int]]:
    """Group rows that were flown under the same imperfections."""
    groups: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        groups.setdefault(_condition(row), []).append(k)
    return list(groups.values())


def _mark_tradeoff(rows: list[dict[str, Any]], capped: Sequence[Any], cells: Sequence[int]) -> dict[str, Any]:
    """Mark the best of some cells and the trade-off; return the best, those alike, and those untold."""
    kept = [k for k in cells if not rows[k]["violations"]] or list(cells)
    best = min(kept, key=lambda k: float(rows[k]["capped_mm"]))
    if len(cells) < 2:
        return {"cell": best, "cells": list(cells), "alike": [], "untold": []}
    rows[best]["best"] = True

    def costs(k: int) -> tuple[float, float, float]:
        return rows[k]["capped_mm"], rows[k]["path_m"], -rows[k]["range_m"]

    for k in kept:
        beaten = any(
            costs(j) != costs(k) and all(a <= b for a, b in zip(costs(j), costs(k), strict=True))
            for j in kept
        )
        rows[k]["tradeoff"] = not beaten
    alike, untold = [], []
    for k in kept:
        found = mean_of_trials(capped[k] - capped[best])
        if k == best or found is None:
            continue
        if found["mean"] < SMALLEST_DIFFERENCE_MM or (found["interval"] and found["interval"][0] <= 0.0):
            alike.append(k)
            untold += [k] if found["mean"] >= SMALLEST_DIFFERENCE_MM else []
    return {"cell": best, "cells": list(cells), "alike": alike, "untold": untold}


def _verdict(rows: Sequence[Row], best: Mapping[str, Any]) -> str:
    own, group = rows[best["cell"]], [rows[k] for k in best["cells"]]
    ends = "" if own["low_mm"] is None else f" [{own['low_mm']:.1f}, {own['high_mm']:.1f}]"
    low, high = (own[end] for end in ENDS["pck150"])
    right = "" if low is None else f" [{100 * low:.1f}, {100 * high:.1f}]"
    under = f"With {condition} " if (condition := _condition(own)) else ""
    winner = "best is " if not best["alike"] else "least error has "
    winner = winner if len(group) > 1 else ""
    words = [
        f"{under}{winner}{_named(own)}: {own['capped_mm']:.1f}{ends} mm over all joints,"
        f" {100 * own['pck150']:.1f}{right} % within 150 mm,"
        f" {own['path_m']:.0f} m and {own['energy_kj']:.0f} kJ of all drones (simulated)"
    ]
    start = "On average no" if "walks" in best else "No"
    near = [k for k in best["alike"] if k not in best["untold"]]
    for said, cells in (
        (f"{start} difference worth flying to", near),
        ("Too uncertain to tell it from", best["untold"]),
    ):
        if cells:
            words.append(f"{said} {'; '.join(_named(rows[k], group) for k in cells)}")
    for k in best["cells"] if "walks" in best else ():
        if k != best["cell"]:
            counts = best["walks"][k]
            share = _share_interval(counts["better"], counts["walks"])
            words.append(
                f"It is better than {_named(rows[k], group)} in {counts['better']} of {counts['walks']} walks"
                f" (95 % interval: {share}), worse in {counts['worse']}"
            )
    least = min((row for row in group if row["tradeoff"]), key=lambda row: float(row["path_m"]), default=own)
    if least is not own:
        words.append(
            f"Shortest is {_named(least, group)}: {least['path_m']:.0f} m, {least['capped_mm']:.1f} mm"
        )
    return ". ".join(words)


def _share_interval(count: int, of: int) -> str:
    """Say the interval of a share that was counted (Wilson 1927), in percent."""
    z = 1.96
    middle, reach = count + z**2 / 2, z * np.sqrt(count * (of - count) / of + z**2 / 4)
    low, high = (100 * (middle + sign * reach) / (of + z**2) for sign in (-1, 1))
    return f"{low:.0f} to {high:.0f} %"


def _named(row: dict[str, Any], among: Sequence[dict[str, Any]] = ()) -> str:
    """Name a combination by its settings; among others by the arm and by what differs."""
    usual = (*_MEASURED, "arm", "actor", "range_m", "tilt_deg", "robots", "best", "tradeoff")
    words = {
        "range_m": f" from {row['range_m']:g} m",
        "tilt_deg": f" at {row['tilt_deg']:g} deg",
        "robots": f" with {row['robots']} drones",
    }
    words |= {
        name: f", {name}={value}"
        for name, value in row.items()
        if name not in usual and not name.startswith(_IMPERFECTION)
    }
    shown_names = [name for name in words if not among or len({str(other[name]) for other in among}) > 1]
    return f"{row['arm']}" + "".join(words[name] for name in shown_names)
