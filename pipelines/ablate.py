"""Stage `ablate`: study of the reconstruction error against tilt, number of drones and pose noise.

Film a simulated walk from every formation, disturb poses and keypoints in several trials, triangulate by
every method, compute errors on the joint-frames that all methods have, and report means with their
intervals. Everything here is simulated.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import PCK_THRESHOLD_M, common, measure
from pipelines.geometry.noise import NoiseModel
from pipelines.geometry.triangulation import Views, locate
from pipelines.keypoints.hints import project_actor
from pipelines.keypoints.tracking import FollowedPeople
from pipelines.reconstruction.refining import refined_points
from pipelines.reporting.studies import Row, draw, estimates, results_csv
from pipelines.session.errors import DataError
from pipelines.session.progress import Halt, Progress, Silent, side_by_side
from pipelines.session.registries import Detector, find_detector, hashes_of_models
from pipelines.session.storage import hash_of, jsonable, read_json, sha256_of, write_json
from pipelines.session.whole_folders import STUDY_MARK, is_made, refuse_sessions, whole_folder
from pipelines.simulation.detector_errors import errors_of
from pipelines.simulation.rendering.renderer import Renderer
from pipelines.simulation.scenario import World
from pipelines.simulation.study.settings import Noise, Settings, StudyMethod
from pipelines.simulation.study.sightings import (
    IMITATED,
    Formation,
    Sightings,
    Walk,
    exact_keypoints,
    formation,
    model_keypoints,
    triangulate_robustly,
    views_of,
    walk,
)
from pipelines.simulation.world.scene import build_world

_REVISION = 5
_PER_JOINT = ("mpjpe_mm", "root_mpjpe_mm", "pa_mpjpe_mm")
_HINT_SIGMA_M = 0.1  # of the detector's hint of the person's position: the camera looks exactly there


# --- the study -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ablated:
    """Result of a study."""

    folder: Path
    summary: dict[str, Any]
    skipped: bool  # True if the study existed already


@dataclass(frozen=True)
class Cell:
    """One condition of a study."""

    tilt_deg: float
    drones: int
    noise: Noise

    @property
    def filmed(self) -> tuple[float, int]:
        """The settings on which its keypoints depend: tilt in deg and number of drones."""
        return self.tilt_deg, self.drones


def ablate(
    settings: Settings,
    folder: Path,
    *,
    workers: int = 1,
    overwrite: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> Ablated:
    """Run a study; conditions that an interrupted run finished are kept.

    Args:
        folder: the output folder; an earlier study there is replaced.
        workers: the number of conditions in parallel; the results do not depend on it.
        overwrite: replace a folder that is no study.

    Raises:
        DataError: the folder cannot be written or is a session's, the detector is missing, or nothing was
            reconstructed.
        BusyError: another process makes the same folder.
    """
    progress = progress or Silent()
    refuse_sessions(folder, mark=STUDY_MARK, option="--output")
    detector = None if settings.detector is None else find_detector(settings.detector)
    key = _key(settings, detector)
    if not force and is_made(folder, key, mark=STUDY_MARK):
        return Ablated(folder, read_json(folder / STUDY_MARK), skipped=True)
    if detector is not None:
        detector.load(threads=1)  # raises an error at once if a file is missing
    with whole_folder(folder, key, mark=STUDY_MARK, overwrite=overwrite) as making:
        filmed = walk(settings.seconds, settings.rate_hz, settings.seed)
        cells = list(_cells(settings))
        seen: dict[tuple[float, int], Sightings] = {}
        if detector is not None:
            seen = _detect_all(filmed, cells, detector, settings.seed, workers, making.part, progress)
        progress.start("Measuring", len(cells) * settings.trials)
        halt = Halt()
        work = [
            (f"cell-{k:04d}", partial(_measure_cell, settings, filmed, cell, seen, halt, progress))
            for k, cell in enumerate(cells)
        ]
        parts = _parts(work, making.part, workers, halt)
        rows = [row for part in parts for row in read_json(part / "rows.json")["rows"]]
        summary = jsonable(_summary(settings, key, rows))
        _refuse_nothing(folder, summary)
        (making.folder / "results.csv").write_text(results_csv(rows), encoding="utf-8", newline="\n")
        draw(making.folder, summary)
        write_json(making.folder / STUDY_MARK, summary)
        making.publish()
    return Ablated(folder, summary, skipped=False)


def _key(settings: Settings, detector: Detector | None) -> str:
    """Compute the key of a study; it is equal for equal results."""
    ingredients: dict[str, object] = {"revision": _REVISION, "settings": asdict(settings)}
    if detector is None:
        ingredients["errors"] = sha256_of(errors_of(IMITATED))
    else:
        ingredients["detector"] = detector.name
        ingredients["models"] = hashes_of_models(detector)
    return hash_of(ingredients)


def _cells(settings: Settings) -> Iterator[Cell]:
    for noise in settings.noise:
        for tilt_deg in settings.tilts_deg:
            for drones in settings.drones:
                yield Cell(tilt_deg, drones, noise)


Part = Callable[[str, Callable[[Path], None]], Path]


def _parts(
    work: Sequence[tuple[str, Callable[[Path], None]]], part: Part, workers: int, halt: Halt
) -> list[Path]:
    """Run the work in parallel and return the folders of the parts, in the order of the work."""
    return side_by_side(lambda each: part(*each), work, workers=workers, halt=halt)


def _refuse_nothing(folder: Path, summary: Mapping[str, Any]) -> None:
    """Refuse an empty study, which would look like success."""
    if not any(cell["metrics"]["mpjpe_mm"] for cell in summary["cells"]):
        raise DataError(
            folder,
            "nothing was reconstructed by all methods",
            "film longer, or at lower tilts",
            code="nothing-reconstructed",
        )


# --- one condition -------------------------------------------------------------------------------------


def _measure_cell(
    settings: Settings,
    filmed: Walk,
    cell: Cell,
    seen: Mapping[tuple[float, int], Sightings],
    halt: Halt,
    progress: Progress,
    folder: Path,
) -> None:
    """Write the rows of every trial and method."""
    cameras = formation(filmed, cameras=cell.drones, tilt_deg=cell.tilt_deg)
    exact = exact_keypoints(filmed, cameras)
    models = cell.noise.models()
    rows: list[Row] = []
    for trial in range(settings.trials):
        halt.check()
        if settings.detector is not None:
            sightings = seen[cell.filmed]
        elif settings.keypoints == "model":
            sightings = model_keypoints(filmed, cameras, exact, seed=settings.seed, trial=trial)
        else:
            sightings = exact
        views = views_of(filmed, cameras, sightings, models, seed=settings.seed, trial=trial)
        points, fell_back = {}, dict.fromkeys(settings.methods, 0.0)
        for method in settings.methods:
            points[method], doubt = reconstructed(method, views, filmed, models)
            fell_back[method] = float(doubt is not None)
        for method, errors in compared(points, filmed).items():
            fallback = {"fell_back": fell_back[method]}
            rows.append({**_condition(cell), "trial": trial, "method": method, **errors, **fallback})
        progress.advance()
    write_json(folder / "rows.json", {"rows": rows})


def _condition(cell: Cell) -> Row:
    return {
        "tilt_deg": cell.tilt_deg,
        "drones": cell.drones,
        "noise": cell.noise.label,
        "noise_model": cell.noise.model,
    }


def reconstructed(
    method: StudyMethod, views: Views, filmed: Walk, models: Sequence[NoiseModel]
) -> tuple[Float, str | None]:
    """Triangulate views by a method: points [N, 3] m, NaN where there is none, and the reason for a fallback.

    All methods know the standard deviations of the poses. `robust` and `auto` also estimate the noise of
    keypoints. `auto` also knows the noise models, and so the correlation of pose errors in time.
    """
    if method == "auto":
        elapsed_s = (filmed.t_ns - filmed.t_ns[0]) / 1e9
        return refined_points(views, elapsed_s, tuple(filmed.person.joints), models)[1:]
    if method == "robust":
        return triangulate_robustly(views)[1], None
    return locate(views, method=method).points, None


def compared(points: Mapping[StudyMethod, Float], filmed: Walk) -> dict[StudyMethod, Row]:
    """Compute the errors of several methods on one walk, from points [T * J, 3] m of each, joints fastest.

    Returns:
        By method the result of `measure` on the joint-frames that all methods have (per joint only the three
        MPJPEs). These figures are for all joint-frames of the method itself: `reconstructed_share`,
        `own_mpjpe_mm`, and `pck150` and `pck150_auc`, which count missing joints as wrong.
    """
    truth = filmed.joints[:, None]
    estimates = {method: own.reshape(truth.shape) for method, own in points.items()}
    shared = common(*estimates.values())
    rows: dict[StudyMethod, Row] = {}
    for method, own in estimates.items():
        errors = measure(np.where(shared[..., None], own, np.nan), truth, filmed.person.joints, filmed.t_ns)
        distance = np.linalg.norm(own - truth, axis=-1)
        there = distance[np.isfinite(distance)]
        errors["common_share"] = errors["reconstructed_share"]
        errors["reconstructed_share"] = there.size / distance.size
        errors["own_mpjpe_mm"] = 1e3 * float(there.mean()) if there.size else None
        errors["pck150"] = int((there <= PCK_THRESHOLD_M).sum()) / distance.size
        near = np.maximum(0.0, 1 - there / PCK_THRESHOLD_M)
        errors["pck150_auc"] = float(near.sum()) / distance.size
        of_joints: Any = errors["per_joint"]
        errors["per_joint"] = {
            joint: {name: own[name] for name in _PER_JOINT} for joint, own in of_joints.items()
        }
        rows[method] = errors
    return rows


# --- pictures ------------------------------------------------------------------------------------------


def _detect_all(
    filmed: Walk,
    cells: Sequence[Cell],
    detector: Detector,
    seed: int,
    workers: int,
    part: Part,
    progress: Progress,
) -> dict[tuple[float, int], Sightings]:
    """Film the walk from every formation and detect keypoints in the pictures."""
    geometries = sorted({cell.filmed for cell in cells})
    cameras = [(tilt, drones, k) for tilt, drones in geometries for k in range(drones)]
    progress.start("Filming", len(cameras) * len(filmed.t_ns))
    halt = Halt()
    world = World()
    surfaces = build_world(world, seed, keep_clear=filmed.motion.root[:, :2]).surfaces()
    lens = formation(filmed, cameras=2, tilt_deg=0.0).lens
    renderer = Renderer(surfaces, lens, sun=np.array(world.sun), seed=seed)

    def film(tilt_deg: float, drones: int, camera: int) -> Callable[[Path], None]:
        seen_by = formation(filmed, cameras=drones, tilt_deg=tilt_deg)
        return partial(_film, filmed, seen_by, camera, renderer, detector, halt, progress)

    work = [(f"pictures-{tilt:g}-{drones}-{k}", film(tilt, drones, k)) for tilt, drones, k in cameras]
    found: dict[tuple[float, int], list[tuple[Float, Float]]] = {}
    for (tilt, drones, _), made in zip(cameras, _parts(work, part, workers, halt), strict=True):
        with np.load(made / "keypoints.npz") as stored:
            found.setdefault((tilt, drones), []).append((stored["xy"], stored["confidence"]))
    return {
        geometry: Sightings(*(np.stack(each) for each in zip(*own, strict=True)))
        for geometry, own in found.items()
    }


def _film(
    filmed: Walk,
    seen_by: Formation,
    camera: int,
    renderer: Renderer,
    detector: Detector,
    halt: Halt,
    progress: Progress,
    folder: Path,
) -> None:
    """Write the keypoints of a detector in the pictures of one camera: xy [T, J, 2], confidence [T, J]."""
    names = filmed.person.joints
    follower = FollowedPeople(detector.load(threads=1), names, only_one=True)
    xy = np.full((len(filmed.t_ns), len(names), 2), np.nan)
    confidence = np.zeros(xy.shape[:-1])
    for frame in range(len(filmed.t_ns)):
        halt.check()
        pose = seen_by.position[camera, frame], seen_by.quaternion_xyzw[camera, frame]
        surface = filmed.person.surface(filmed.motion.root[frame], filmed.motion.rotation[frame])
        picture = renderer.picture(*pose, [surface], frame)
        hint = project_actor(filmed.aim[frame], pose, seen_by.lens, sigma_m=_HINT_SIGMA_M, sigma_rad=0.0)
        found, sure = follower.step(picture, hints=[hint])
        if len(found):
            xy[frame], confidence[frame] = found[0], sure[0]
        progress.advance()
    np.savez(folder / "keypoints.npz", xy=xy, confidence=confidence)


def _summary(settings: Settings, key: str, rows: Sequence[Row]) -> dict[str, Any]:
    return {
        "schema": 1,
        "key": key,
        "study": settings.study,
        "simulated": True,
        "keypoints": _keypoints(settings),
        "settings": {**asdict(settings), "noise": {each.label: each.model for each in settings.noise}},
        "cells": estimates(rows, settings.study, seed=settings.seed),
    }


def _keypoints(settings: Settings) -> str:
    if settings.detector is not None:
        return f"{settings.detector} on rendered pictures"
    return "exact" if settings.keypoints == "exact" else f"modelled after {IMITATED}"
