"""Stage `reconstruct`: from keypoints in moving cameras to a skeleton, its status and its errors.

Load the session's tables; find out who is who; bring every camera to common times; triangulate all
joints at once; measure; store. Nothing is filled: a joint that could not be measured is NaN with a
status that says why.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.detect import detect
from pipelines.geometry.triangulation import (
    STATUS,
    Method,
    Triangulation,
    Views,
    estimate_noise,
    triangulate,
)
from pipelines.keypoints.association import Association, associate
from pipelines.keypoints.calibration import measured_for, read_calibration
from pipelines.keypoints.swaps import undo_swaps_of_tracks
from pipelines.keypoints.swaps_across_views import swaps_across_views
from pipelines.reconstruction.loading import (
    load_actor,
    load_cameras,
    load_clock_sigma,
    load_pose_errors,
    load_truth,
)
from pipelines.reconstruction.observations import (
    Camera,
    Candidates,
    Observations,
    candidates,
    observe,
    on_sides,
    time_base,
)
from pipelines.reconstruction.quality import assess
from pipelines.reconstruction.refining import RefinedFlight, refine_flight
from pipelines.reconstruction.reweighting import triangulate_heavy_tailed
from pipelines.session.description import Description, read_description
from pipelines.session.errors import DataError
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import Float, Int64
from pipelines.session.stages import Stage, StageRecord, locked
from pipelines.session.storage import jsonable, read_json, sha256_of, write_json
from pipelines.session.tables import CAMERA_POSES, SKELETON, write_table

if TYPE_CHECKING:
    import pandas as pd

RECONSTRUCT = Stage("reconstruct", revision=5)

_UNKNOWN_SIGMA = (0.3, np.radians(1.0))
"""Camera pose noise (m, rad) taken for telling people apart where nobody states it: METHODS' medium level."""


@dataclass(frozen=True)
class Settings:
    """What decides the result, next to the session itself."""

    method: Method | Literal["refined"] = "robust"
    rate_hz: float | None = None
    people: int = 1
    min_confidence: float = 0.3
    pixel_sigma: float = 3.0
    pose_noise: str | None = None
    detector: str = "blazepose"  # for cameras with pictures and without keypoints
    every: int = 1  # of their pictures
    start_s: float | None = None  # since the flight's first picture: what the detector looks at
    end_s: float | None = None


@dataclass(frozen=True)
class Reconstructed:
    """What a reconstruction left behind."""

    folder: Path
    record: StageRecord
    metrics: dict[str, Any]
    skipped: bool  # nothing had changed


def reconstruct(
    folder: Path,
    settings: Settings | None = None,
    *,
    workers: int = 1,
    force: bool = False,
    progress: Progress | None = None,
) -> Reconstructed:
    """Triangulate the people of a session and measure the errors.

    Args:
        folder: the session.
        settings: what decides the result.
        workers: threads; the result does not depend on them.
        force: do it again although nothing changed.
        progress: who watches.

    Raises:
        DataError: the session cannot be used, or nothing could be reconstructed; the message says
            which gate stopped it.
        BusyError: another process writes the session.
    """
    settings = settings or Settings()
    progress = progress or Silent()
    with locked(folder) as session:
        ingested = session.record("ingest")
        if ingested is None:
            raise DataError(folder, "was never ingested completely", "run `mocap ingest` again")
        detected = detect(
            session,
            detector=settings.detector,
            every=settings.every,
            start_s=settings.start_s,
            end_s=settings.end_s,
            workers=workers,
            progress=progress,
        )
        if detected is None and (settings.start_s, settings.end_s) != (None, None):
            raise DataError(
                folder,
                "every camera came with keypoints: no picture is looked at",
                "leave --start and --end out",
            )
        inputs = dict(ingested.outputs) | (detected.outputs if detected else {})
        measured = measured_for(detected.settings["detector"]) if detected else None
        if measured is not None:
            inputs["calibration of confidences"] = sha256_of(measured)
        # A model of the user's is known by what it found, not by where it lies.
        stated = asdict(settings) | {"detector": detected.settings["detector"] if detected else None}
        run = session.begin(RECONSTRUCT, settings=stated, inputs=inputs, force=force)
        if run.finished:
            metrics = read_json(folder / "reconstruct" / "metrics.json")
            return Reconstructed(folder, run.record, metrics, skipped=True)

        description = read_description(folder)
        progress.start("Reconstructing", 5)
        cameras, warnings = load_cameras(
            folder,
            description,
            detected,
            min_confidence=settings.min_confidence,
            pose_noise=settings.pose_noise,
            calibrated=read_calibration(measured).probabilities if measured else None,
        )
        cameras, swaps = _without_swaps(cameras)
        progress.advance()
        found, observations, association, seen = _observe(folder, cameras, description, settings)
        sigma = _ray_sigma(cameras, observations.t_ns, observations.position, settings)
        sides, between_views = _agreeing_sides(observations, sigma)
        xy, confidence = on_sides(observations.xy, observations.confidence, sides)
        observations = replace(observations, xy=xy, confidence=confidence)
        progress.advance()
        views = _views(cameras, observations, settings, workers)
        solve = _solver(cameras, observations, settings, workers)
        result = _refused_people(solve(views), observations, seen)
        _refuse_nothing(folder, views, result, association)
        progress.advance()
        refined = None
        if settings.method == "refined":
            refined = _refine(
                cameras,
                found,
                association,
                observations,
                sides,
                views,
                result,
                description,
                settings,
                workers,
            )
            observations, views = refined.observations, refined.views
            result = _refused_people(refined.result, observations, seen)
            warnings = [*warnings, *refined.warnings]
        progress.advance()
        metrics = jsonable(
            assess(
                observations,
                views,
                result,
                cameras=[camera.name for camera in cameras],
                method=settings.method,
                truth=load_truth(folder, description, observations.joints, observations.t_ns),
                solve=solve,
            )
            | (refined.metrics if refined else {})
        )
        write_table(run.folder / "skeleton.parquet", _skeleton_table(observations, result), SKELETON)
        if refined is not None and refined.cameras is not None:
            write_table(run.folder / "cameras.parquet", refined.cameras, CAMERA_POSES)
        write_json(run.folder / "metrics.json", metrics)
        record = run.publish(
            counts={
                **metrics["status_counts"],
                "association": _association_counts(association),
                "left_right_swaps": {"undone_over_time": swaps, "between_views": between_views},
            },
            warnings=[*warnings, *association.reasons, *_unused(cameras, result)],
        )
        progress.advance()
        for name, (before, now) in run.replaces.items():
            progress.note(f"replaced the reconstruction made with {name} = {before} (now {now})")
    return Reconstructed(folder, record, metrics, skipped=False)


# --- the work ------------------------------------------------------------------------------------------


def _observe(
    folder: Path, cameras: list[Camera], description: Description, settings: Settings
) -> tuple[Candidates, Observations, Association, NDArray[np.bool_]]:
    """All that was seen, what of each person, how people were told apart, when [T] anybody was seen."""
    limits = _pose_limits(description)
    found = candidates(cameras, **limits)
    association = associate(
        (found.t_ns - found.t_ns[0]) / 1e9,
        found.xy,
        found.confidence,
        found.position,
        found.rotation,
        _ray_sigma(cameras, found.t_ns, found.position, settings),
        actor=load_actor(folder, description, found.t_ns),
        people=settings.people,
    )
    observations = observe(
        cameras,
        found,
        association.choice,
        time_base(cameras, settings.rate_hz),
        **limits,
    )
    nearest = np.clip(np.searchsorted(found.t_ns, observations.t_ns), 0, len(found.t_ns) - 1)
    seen = np.asarray((found.confidence > 0).any(axis=(1, 2, 3)), dtype=np.bool_)[nearest]
    return found, observations, association, seen


def _without_swaps(cameras: list[Camera]) -> tuple[list[Camera], dict[str, dict[str, int]]]:
    """Left and right given back to the side they belong to, by how they move in each camera."""
    mended, counts = [], {}
    for camera in cameras:
        detections, counts[camera.name] = undo_swaps_of_tracks(camera.detections, camera.frame_t_ns)
        mended.append(replace(camera, detections=detections))
    return mended, counts


def _agreeing_sides(observations: Observations, sigma: Float) -> tuple[Int64, dict[str, int]]:
    """Left and right as most cameras see them [T, P, J, C]; see `swaps_across_views`."""
    sides = np.empty(observations.confidence.shape, dtype=np.int64)
    total: Counter[str] = Counter()
    for person in range(observations.xy.shape[1]):
        sides[:, person], counts = swaps_across_views(
            observations.xy[:, person],
            observations.position,
            observations.rotation,
            sigma,
            observations.joints,
        )
        total.update(counts)
    return sides, dict(sorted(total.items()))


def _pose_limits(description: Description) -> dict[str, int]:
    """How far poses are trusted between and beyond the stamps of their log, ns."""
    stated = description.pose_interpolation
    return {
        "max_gap_ns": round(stated.max_gap_s * 1e9),
        "max_extrapolation_ns": round(stated.max_extrapolation_s * 1e9),
    }


def _refine(
    cameras: list[Camera],
    found: Candidates,
    association: Association,
    observations: Observations,
    sides: Int64,
    views: Views,
    result: Triangulation,
    description: Description,
    settings: Settings,
    workers: int,
) -> RefinedFlight:
    return refine_flight(
        cameras,
        found,
        association.choice,
        observations,
        sides,
        views,
        result,
        prior=load_pose_errors(description, cameras, settings.pose_noise),
        clock_sigma_s=load_clock_sigma(description, cameras),
        pixel_sigma=settings.pixel_sigma,
        threads=workers,
        **_pose_limits(description),
    )


def _ray_sigma(cameras: list[Camera], t_ns: Int64, position: Float, settings: Settings) -> Float:
    """Standard deviation [T, C] in rad of a viewing ray, enough to tell people apart.

    The distance to the actor is not known yet: the distance to the middle of the cameras, which
    surround it, stands for it.
    """
    posed = ~np.isnan(position[..., 0])
    if not posed.any():
        raise DataError("the cameras", "have no pose at any picture", "check clocks and pose logs")
    middle = position[posed].mean(axis=0)
    columns = []
    for c, camera in enumerate(cameras):
        stated = camera.sigma_at(t_ns)
        sigma = np.tile(_UNKNOWN_SIGMA, (len(t_ns), 1)) if stated is None else stated
        away = position[posed[:, c], c] - middle
        distance = float(np.median(np.linalg.norm(away, axis=-1))) if len(away) else 1.0
        pixel = settings.pixel_sigma / camera.focal_px
        columns.append(np.sqrt(pixel**2 + sigma[:, 1] ** 2 + (sigma[:, 0] / max(distance, 1.0)) ** 2))
    return np.stack(columns, axis=1)


def _views(cameras: list[Camera], observations: Observations, settings: Settings, workers: int) -> Views:
    """All joint-frames in one row each, with the noise that the gates must know.

    Whatever the stated noise leaves unexplained is added as pixel noise: gates that know too little
    throw good views out.
    """
    times, people, joints, count = observations.confidence.shape
    focal = np.array([camera.focal_px for camera in cameras])
    stated = observations.pose_sigma
    views = Views(
        xy=observations.xy.reshape(-1, count, 2),
        weight=observations.confidence.reshape(-1, count),
        pose_index=np.repeat(np.arange(times), people * joints),
        position=observations.position,
        rotation=observations.rotation,
        focal=focal,
        pixel_sigma=np.full(count, settings.pixel_sigma),
        pose_sigma=np.zeros((times, count, 2)) if stated is None else stated,
    )
    return replace(views, pixel_sigma=estimate_noise(views, threads=workers))


def _solver(
    cameras: list[Camera], observations: Observations, settings: Settings, workers: int
) -> Callable[[Views], Triangulation]:
    """How views become points; robust has a loss for calibrated cameras and one for logged poses."""
    calibrated = observations.pose_sigma is None and all(camera.static for camera in cameras)
    if settings.method == "robust" and calibrated:
        return partial(triangulate_heavy_tailed, threads=workers)
    method = "robust" if settings.method == "refined" else settings.method
    return partial(triangulate, method=method, threads=workers)


def _refused_people(
    result: Triangulation, observations: Observations, seen: NDArray[np.bool_]
) -> Triangulation:
    """Joints of a person for whom no view was taken, although somebody was seen, are rejected."""
    shape = observations.confidence.shape[:3]
    status = result.status.reshape(shape)
    nobody = (status == STATUS.index("not_detected")).all(axis=2)
    refused = nobody & seen[:, None]
    marked = np.where(refused[:, :, None], STATUS.index("rejected"), status).astype(np.int8)
    return replace(result, status=marked.ravel())


def _said_noise(views: Views) -> str:
    """The noise that the gates were told of."""
    position_m, rotation_rad = np.median(views.pose_sigma, axis=(0, 1))
    pixels = float(np.median(views.pixel_sigma))
    rotation_deg = np.degrees(rotation_rad)
    return f"noise taken for poses {position_m:.3g} m and {rotation_deg:.3g} deg, pixels {pixels:.3g}"


def _refuse_nothing(folder: Path, views: Views, result: Triangulation, association: Association) -> None:
    """Where not a single joint came out, say which gate stopped them."""
    if (result.status == STATUS.index("ok")).any():
        return
    codes, counts = np.unique(result.status, return_counts=True)
    gates = ", ".join(f"{STATUS[code]} {count}" for code, count in zip(codes, counts, strict=True))
    reasons = "; ".join(association.reasons)
    raise DataError(
        folder,
        f"no joint could be reconstructed ({gates}; {_said_noise(views)})"
        + (f"; {reasons}" if reasons else ""),
        "check calibration, clocks and poses, or state another pose noise with --pose-noise",
    )


def _skeleton_table(observations: Observations, result: Triangulation) -> pd.DataFrame:
    import pandas as pd

    times, people, joints, _ = observations.confidence.shape
    covariance = result.covariance
    used = np.where(result.inlier, result.residual_px, np.nan)
    table = pd.DataFrame(
        {
            "t_ns": np.repeat(observations.t_ns, people * joints),
            "person": np.tile(np.repeat(np.arange(people), joints), times),
            "joint": np.tile(np.array(observations.joints, dtype=object), times * people),
        }
    )
    table[["x", "y", "z"]] = result.points
    for i, j in zip(*np.triu_indices(3), strict=True):
        table[f"c{'xyz'[i]}{'xyz'[j]}"] = covariance[:, i, j]
    table["views"] = result.views
    table["reprojection_px"] = _row_mean(used)
    table["status"] = np.array(STATUS, dtype=object)[result.status]
    return table


def _row_mean(values: Float) -> Float:
    """Mean of each row without its NaN; NaN for a row of nothing else."""
    count = (~np.isnan(values)).sum(axis=1)
    mean: Float = np.where(count > 0, np.nansum(values, axis=1) / np.maximum(count, 1), np.nan)
    return mean


def _unused(cameras: list[Camera], result: Triangulation) -> list[str]:
    """The cameras that contributed nothing: in the wrong place, at the wrong time, or of somebody else."""
    used = np.atleast_1d(result.inlier.any(axis=0))
    return [
        f"{camera.name}: none of its views was used"
        for camera, any_used in zip(cameras, used, strict=True)
        if not any_used
    ]


def _association_counts(association: Association) -> dict[str, list[int]]:
    """How the people were told apart, one number for each person."""
    names = ("views", "ambiguous", "switches", "refused", "resumed")
    return {name: getattr(association, name).tolist() for name in names}
