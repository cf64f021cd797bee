"""Stage `reconstruct`: from keypoints in moving cameras to a skeleton, its status and its errors.

Load the session's tables; find out who is who; bring every camera to common times; triangulate all
joints at once; measure; store. Nothing is filled: a joint that could not be measured is NaN with a
status that says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.geometry.noise import sum_sigma
from pipelines.geometry.poses import interpolate_points, rates
from pipelines.geometry.triangulation import (
    STATUS,
    Method,
    Triangulation,
    Views,
    estimate_noise,
    triangulate,
)
from pipelines.keypoints.association import Association, associate
from pipelines.reconstruction.observations import Camera, Observations, candidates, observe, time_base
from pipelines.reconstruction.quality import assess
from pipelines.reconstruction.reweighting import triangulate_heavy_tailed
from pipelines.session.description import CameraEntry, Description, read_description
from pipelines.session.errors import DataError
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import Float, Int64, Trajectory
from pipelines.session.registries import noise_models, parsed_noise_models
from pipelines.session.stages import Stage, StageRecord, locked
from pipelines.session.storage import jsonable, read_json, write_json
from pipelines.session.tables import ACTOR, FRAMES, KEYPOINTS, POSES, SKELETON, TRUTH, read_table, write_table
from pipelines.session.tabular import detections_from, motion_from, trajectory_from

if TYPE_CHECKING:
    import pandas as pd

RECONSTRUCT = Stage("reconstruct", revision=1)

_TRUTH_GAP_NS = 250_000_000
_ACTOR_GAP_NS = 2_000_000_000
_UNKNOWN_SIGMA = (0.3, np.radians(1.0))
"""Camera pose noise (m, rad) taken for telling people apart where nobody states it: METHODS' medium level."""


@dataclass(frozen=True)
class Settings:
    """What decides the result, next to the session itself."""

    method: Method = "robust"
    rate_hz: float | None = None
    people: int = 1
    min_confidence: float = 0.3
    pixel_sigma: float = 3.0
    pose_noise: str | None = None


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
        run = session.begin(
            RECONSTRUCT, settings=asdict(settings), inputs=dict(ingested.outputs), force=force
        )
        if run.finished:
            metrics = read_json(folder / "reconstruct" / "metrics.json")
            return Reconstructed(folder, run.record, metrics, skipped=True)
        for name, (before, now) in run.replaces.items():
            progress.note(f"replaces the reconstruction made with {name} = {before} (now {now})")

        description = read_description(folder)
        progress.start("Reconstructing", 4)
        cameras = _load_cameras(folder, description, settings)
        progress.advance()
        observations, association = _observe(folder, cameras, description, settings)
        progress.advance()
        views = _views(cameras, observations, settings, workers)
        solve = _solver(cameras, observations, settings, workers)
        result = solve(views)
        _refuse_nothing(folder, result, association)
        progress.advance()
        metrics = jsonable(
            assess(
                observations,
                views,
                result,
                cameras=[camera.name for camera in cameras],
                method=settings.method,
                truth=_load_truth(folder, description, observations),
                solve=solve,
            )
        )
        write_table(run.folder / "skeleton.parquet", _skeleton_table(observations, result), SKELETON)
        write_json(run.folder / "metrics.json", metrics)
        record = run.publish(
            counts={**metrics["status_counts"], "association": _association_counts(association)},
            warnings=association.reasons,
        )
        progress.advance()
    return Reconstructed(folder, record, metrics, skipped=False)


# --- loading -------------------------------------------------------------------------------------------


def _load_cameras(folder: Path, description: Description, settings: Settings) -> list[Camera]:
    with_keypoints = {name: entry for name, entry in description.cameras.items() if entry.keypoints}
    if len(with_keypoints) < 2:
        raise DataError(
            folder, f"has keypoints of {len(with_keypoints)} camera", "a skeleton needs two cameras at least"
        )
    joints = _common_joints(folder, with_keypoints)
    return [_load_camera(folder, name, entry, joints, settings) for name, entry in with_keypoints.items()]


def _common_joints(folder: Path, entries: Mapping[str, CameraEntry]) -> tuple[str, ...]:
    """The joints that two cameras at least can see, in the order of the camera that knows the most."""
    known = [entry.keypoints.joints for entry in entries.values() if entry.keypoints]
    shared = [name for name in max(known, key=len) if sum(name in joints for joints in known) > 1]
    if not shared:
        raise DataError(
            folder, "has no joint that two cameras' detectors both know", "use one skeleton for all"
        )
    return tuple(shared)


def _load_camera(
    folder: Path, name: str, entry: CameraEntry, joints: tuple[str, ...], settings: Settings
) -> Camera:
    tables = folder / "cameras" / name
    trajectory = trajectory_from(read_table(tables / "poses.parquet", POSES))
    frames = read_table(tables / "frames.parquet", FRAMES)
    keypoints = read_table(tables / "keypoints.parquet", KEYPOINTS)
    confident = keypoints[keypoints["confidence"] >= settings.min_confidence]
    detections = detections_from(confident, joints)
    return Camera(
        name=name,
        intrinsics=entry.intrinsics.intrinsics(),
        frame_t_ns=frames["t_ns"].to_numpy(np.int64),
        trajectory=trajectory,
        static=entry.poses.static,
        sigma=_stated_sigma(name, entry, trajectory, settings),
        # From here on frames count the rows of the table: pictures without a time are not in it.
        detections=replace(detections, frame=np.searchsorted(frames["frame"].to_numpy(), detections.frame)),
    )


def _stated_sigma(name: str, entry: CameraEntry, trajectory: Trajectory, settings: Settings) -> Float | None:
    """The pose noise [N, 2] as somebody states it: the command line, flight.yaml, or the log itself."""
    if settings.pose_noise:
        models = parsed_noise_models("--pose-noise", settings.pose_noise)
    elif entry.pose_noise:
        models = noise_models(f"pose_noise of {name}", entry.pose_noise)
    else:
        return _logged_sigma(trajectory)
    elapsed_s = (trajectory.t_ns - trajectory.t_ns[0]) / 1e9
    return sum_sigma(
        models, elapsed_s, *rates(trajectory.t_ns, trajectory.position, trajectory.quaternion_xyzw)
    )


def _logged_sigma(trajectory: Trajectory) -> Float | None:
    """Mean standard deviation per axis of the logged covariance; all zero means that it is unknown."""
    covariance = trajectory.covariance
    if covariance is None or not np.any(covariance):
        return None
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    sigma: Float = np.sqrt(np.stack([variances[:, :3].mean(axis=1), variances[:, 3:].mean(axis=1)], axis=1))
    return sigma


def _load_truth(folder: Path, description: Description, observations: Observations) -> Float | None:
    """The true joints [T, P, J, 3] at the skeleton's times; NaN for joints that only the skeleton has."""
    if description.truth is None or not description.truth.joints:
        return None
    truth = motion_from(read_table(folder / "truth.parquet", TRUTH), observations.joints)
    return interpolate_points(truth.t_ns, truth.position, observations.t_ns, max_gap_ns=_TRUTH_GAP_NS)


def _load_actor(folder: Path, description: Description, t_ns: Int64) -> Float | None:
    """The logged actor [T, 3] at given times, NaN where the log says nothing."""
    if description.actor is None:
        return None
    table = read_table(folder / "actor.parquet", ACTOR)
    position = table[["x", "y", "z"]].to_numpy(np.float64)
    return interpolate_points(table["t_ns"].to_numpy(np.int64), position, t_ns, max_gap_ns=_ACTOR_GAP_NS)


# --- the work ------------------------------------------------------------------------------------------


def _observe(
    folder: Path, cameras: list[Camera], description: Description, settings: Settings
) -> tuple[Observations, Association]:
    max_gap_ns = round(description.pose_interpolation.max_gap_s * 1e9)
    max_extrapolation_ns = round(description.pose_interpolation.max_extrapolation_s * 1e9)
    found = candidates(cameras, max_gap_ns=max_gap_ns, max_extrapolation_ns=max_extrapolation_ns)
    association = associate(
        (found.t_ns - found.t_ns[0]) / 1e9,
        found.xy,
        found.confidence,
        found.position,
        found.rotation,
        _ray_sigma(cameras, found.t_ns, found.position, settings),
        actor=_load_actor(folder, description, found.t_ns),
        people=settings.people,
    )
    observations = observe(
        cameras,
        found,
        association.choice,
        time_base(cameras, settings.rate_hz),
        max_gap_ns=max_gap_ns,
        max_extrapolation_ns=max_extrapolation_ns,
    )
    return observations, association


def _ray_sigma(cameras: list[Camera], t_ns: Int64, position: Float, settings: Settings) -> Float:
    """Standard deviation [T, C] in rad of a viewing ray, enough to tell people apart.

    The distance to the actor is not known yet: the distance to the middle of the cameras, which
    surround it, stands for it.
    """
    middle = np.nanmean(position, axis=(0, 1))
    columns = []
    for c, camera in enumerate(cameras):
        stated = camera.sigma_at(t_ns)
        sigma = np.tile(_UNKNOWN_SIGMA, (len(t_ns), 1)) if stated is None else stated
        distance = np.nanmedian(np.linalg.norm(position[:, c] - middle, axis=-1))
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
    return partial(triangulate, method=settings.method, threads=workers)


def _refuse_nothing(folder: Path, result: Triangulation, association: Association) -> None:
    """Where not a single joint came out, say which gate stopped them."""
    if (result.status == STATUS.index("ok")).any():
        return
    codes, counts = np.unique(result.status, return_counts=True)
    gates = ", ".join(f"{STATUS[code]} {count}" for code, count in zip(codes, counts, strict=True))
    reasons = "; ".join(association.reasons)
    raise DataError(
        folder,
        f"no joint could be reconstructed ({gates})" + (f"; {reasons}" if reasons else ""),
        "check calibration, clocks and poses, or state the pose noise with --pose-noise",
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


def _association_counts(association: Association) -> dict[str, list[int]]:
    """How the people were told apart, one number for each person."""
    names = ("views", "ambiguous", "switches", "refused", "resumed")
    return {name: getattr(association, name).tolist() for name in names}
