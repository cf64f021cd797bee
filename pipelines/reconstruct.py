"""Stage `reconstruct`: compute a skeleton, its status and its errors from keypoints in moving cameras.

Load the session's tables; associate people; interpolate every camera to common times; triangulate all
joints at once; measure errors; store. Nothing is filled or smoothed without an option for it: a joint that
could not be measured is NaN with a status that gives the reason.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipelines.detect import detect, hints_from, hints_of
from pipelines.follow import Following, cameras_to_follow
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.triangulation import (
    STATUS,
    Method,
    Triangulation,
    Views,
)
from pipelines.keypoints.association import Association, associate
from pipelines.keypoints.calibration import measured_for, read_calibration
from pipelines.keypoints.no_people import Ground, Scene, level_of
from pipelines.keypoints.swaps import swaps_across_views, undo_swaps_of_tracks
from pipelines.reconstruction.background import refine_cameras
from pipelines.reconstruction.background_tracks import Followed, Stills, load_stills, load_tracks
from pipelines.reconstruction.doubts.diagnosis import doubts_of
from pipelines.reconstruction.doubts.scene import Ground as GroundOfMap
from pipelines.reconstruction.doubts.turning import common_offset
from pipelines.reconstruction.finishing import finish
from pipelines.reconstruction.ground import bind_positions
from pipelines.reconstruction.loading import (
    is_time_unknown,
    load_cameras,
    load_clock_sigma,
    load_pose_errors,
    load_truth,
    source_of_pose_noise,
)
from pipelines.reconstruction.observations import (
    Camera,
    Candidates,
    Observations,
    candidates,
    observe,
    on_sides,
    readout_of,
    time_base,
)
from pipelines.reconstruction.refining import (
    FoundClocks,
    RefinedFlight,
    RobustFlight,
    doubted_people,
    find_clocks,
    refine_flight,
    shifted,
)
from pipelines.reconstruction.results import (
    angles_parts,
    assess,
    camera_poses_table,
    gait_of,
    method_used,
    of_people,
    skeleton_table,
)
from pipelines.reconstruction.smoothing import smoother
from pipelines.reconstruction.solving import (
    are_calibrated,
    noise_text,
    ray_sigma,
    refused_people,
    solver_for,
    views_with_noise,
)
from pipelines.reconstruction.trials import disturbances, disturbed, summary_of_trials
from pipelines.session.clusters import Cluster
from pipelines.session.description import (
    Description,
    Doubt,
    Interpolation,
    read_description,
    said_assumptions,
    said_doubts,
)
from pipelines.session.errors import DataError
from pipelines.session.maps import each_map
from pipelines.session.memory import Waiting, return_freed_arrays
from pipelines.session.people import LoggedActor, logged_people, true_joints_at
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import JointMotion
from pipelines.session.stage_records import Stage, StageRecord
from pipelines.session.stages import Run, WritableSession, locked
from pipelines.session.storage import jsonable, read_json, sha256_of, write_json
from pipelines.session.tables import ANGLES, CAMERA_POSES, GAIT, SKELETON, join_tables, write_table

if TYPE_CHECKING:
    import pandas as pd


RECONSTRUCT = Stage("reconstruct", revision=20)

_LONGEST_FILL_S = 10.0


@dataclass(frozen=True)
class Settings:
    """Settings that determine the result, in addition to the session itself."""

    method: Method | Literal["refined", "auto"] = "auto"
    rate_hz: float | None = None
    people: int | Literal["auto"] | None = None  # None: `auto` if several were logged by name, else 1
    min_confidence: float = 0.3
    pixel_sigma: float = 3.0
    pose_noise: str | None = None
    detector: str = "blazepose"  # for cameras with pictures and without keypoints
    every: int = 1  # of their pictures
    start_s: float | None = None  # since the flight's first picture: span of pictures for the detector
    end_s: float | None = None
    fill_s: float | None = None  # the longest gap that is filled
    smooth: str | None = None  # as `smoothing.smoother` reads it
    refine_cameras: Literal["background"] | None = None  # before the triangulation; `auto` does it unasked
    disturb_poses: str | None = None  # errors added to the logged poses, in the form of `--pose-noise`
    trials: int = 1  # draws of these errors
    seed: int = 0  # of these draws

    @property
    def asks_background(self) -> bool:
        """True if moving cameras with pictures have their poses corrected by their backgrounds."""
        return self.method == "auto" or self.refine_cameras == "background"


@dataclass(frozen=True)
class Reconstructed:
    """Result of a reconstruction."""

    folder: Path
    record: StageRecord
    metrics: dict[str, Any]
    skipped: bool  # True if nothing had changed


def reconstruct(
    folder: Path,
    settings: Settings | None = None,
    *,
    strict: bool = False,
    workers: int = 1,
    cluster: Cluster | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Reconstructed:
    """Triangulate the people of a session, measure the errors, and doubt what cannot be right.

    Args:
        folder: the session.
        settings: the settings that determine the result.
        strict: refuse a flight that is doubted.
        workers: the number of threads; the result does not depend on it.
        cluster: works on the pictures instead of threads; neither does the result depend on that.
        force: run it again even if nothing changed, and the detection too.
        progress: receives the progress.

    Raises:
        DataError: the session cannot be used, one of its tables or the pictures were changed, nothing could
            be reconstructed (the message gives the counts of the reasons, and the mistake that explains
            them), or the flight is doubted and `strict`.
        BusyError: another process writes the session.
    """
    settings = settings or Settings()
    progress = progress or Silent()
    errors = disturbances(settings.disturb_poses, settings.trials)
    smoother(settings.smooth)
    _check_fill(settings.fill_s)
    return_freed_arrays()
    with locked(folder) as session:
        ingested = session.intact_record("ingest")
        if ingested is None:
            raise DataError(folder, "was never ingested completely", "run `mocap ingest` again")
        description = read_description(folder)
        settings = replace(settings, people=settings.people or ("auto" if description.actors else 1))
        following, left_out = _following(session, description, settings, force)
        detected = _detected(session, settings, workers, force, following, cluster, progress)
        background = None
        if following is not None:
            background, left_out = _finished(following, settings, workers, cluster, progress)
        measured = measured_for(detected.settings["detector"]) if detected else None
        run = session.begin(
            RECONSTRUCT,
            settings=_stated(settings, detected),
            inputs=_inputs(ingested, detected, background, measured),
            force=force,
        )
        if run.finished:
            metrics = read_json(folder / "reconstruct" / "metrics.json")
            _refuse_doubted(folder, metrics["doubts"], strict=strict)
            return Reconstructed(folder, run.record, metrics, skipped=True)

        progress.start("Reconstructing", 1 + 3 * settings.trials)
        cameras, warnings = load_cameras(
            folder,
            description,
            detected,
            min_confidence=settings.min_confidence,
            pose_noise=settings.pose_noise,
            calibrated=read_calibration(measured).probabilities if measured else None,
        )
        cameras, swaps = _without_swaps(cameras)
        waiting = Waiting(run.folder)
        cameras = waiting.put(cameras)
        progress.advance()
        followed = _followed(folder, cameras, left_out) if background or left_out else {}
        actors = logged_people(folder, description)
        flight = _Flight(
            description,
            followed,
            _stills(folder, cameras) if settings.method == "auto" else {},
            actors,
            ground_of(folder, description, actors[0] if actors else None),
            waiting.put(load_truth(folder, description, cameras[0].detections.joints)),
            waiting,
        )
        attempts = (
            _attempt(
                flight,
                disturbed(cameras, errors, settings.seed, trial) if errors else cameras,
                settings,
                workers,
                progress,
            )
            for trial in range(settings.trials)
        )
        stored = next(attempts)
        timed = shifted(cameras, stored.offset_s)
        doubts = doubts_of(
            folder,
            description,
            timed,
            chosen=chosen_detections(timed, stored.found, stored.association),
            followed=followed,
            pose_noise=settings.pose_noise,
        )
        _refuse_nothing(folder, stored, doubts)
        gait, walks = gait_of(stored.observations, stored.result)
        metrics = stored.metrics | {"gait": walks, "doubts": [doubt.as_json() for doubt in doubts]}
        _refuse_doubted(folder, metrics["doubts"], strict=strict)
        if settings.disturb_poses is not None:
            every = [metrics, *(attempt.metrics for attempt in attempts)]
            metrics = metrics | {"trials": summary_of_trials(every, settings.disturb_poses, settings.seed)}
            warnings.append(_disturbance_warning(settings))
        metrics = jsonable(metrics)
        _write(run.folder, stored, gait, metrics)
        record = run.publish(
            counts=_counts(metrics, stored, swaps),
            warnings=[
                *said_doubts(doubts),
                *said_assumptions(description.assumptions),
                *_hint_warnings(description, ingested, detected),
                *warnings,
                *stored.warnings,
                *_unused_cameras(cameras, stored.result),
            ],
        )
        _note_replaced(run, progress)
    return Reconstructed(folder, record, metrics, skipped=False)


def ground_of(folder: Path, description: Description, actor: LoggedActor | None) -> Ground | None:
    """Return the ground of the last map, else the level of the logged actor; None without either."""
    if description.map is not None:
        last = deque(each_map(folder), maxlen=1)
        return GroundOfMap.of(last[0]).about if last else None
    return None if actor is None else level_of(actor.hips)


def _detected(
    session: WritableSession,
    settings: Settings,
    workers: int,
    force: bool,
    following: Following | None,
    cluster: Cluster | None,
    progress: Progress,
) -> StageRecord | None:
    """Run the stage `detect`; return None if every camera has imported keypoints."""
    detected = detect(
        session,
        detector=settings.detector,
        people=settings.people if isinstance(settings.people, int) else 2,
        every=settings.every,
        start_s=settings.start_s,
        end_s=settings.end_s,
        workers=workers,
        force=force,
        following=following,
        cluster=cluster,
        progress=progress,
    )
    if detected is None and (settings.start_s, settings.end_s) != (None, None):
        raise DataError(
            session.folder,
            "every camera came with keypoints: no picture is looked at",
            "leave --start and --end out",
        )
    if detected is None and settings.every > 1:
        progress.note("every camera came with keypoints: --every says nothing about them")
    return detected


def _stated(settings: Settings, detected: StageRecord | None) -> dict[str, object]:
    """Return the settings; the detector's name is that of the detection, without the paths of model files."""
    return asdict(settings) | {"detector": detected.settings["detector"] if detected else None}


def _inputs(
    ingested: StageRecord, detected: StageRecord | None, background: StageRecord | None, measured: Path | None
) -> dict[str, str]:
    """The hashes of what is read: tables, hints of the detector, and how its confidences were measured."""
    inputs = dict(ingested.outputs) | (detected.outputs | hints_from(detected) if detected else {})
    inputs |= background.outputs if background else {}
    return inputs if measured is None else inputs | {"calibration of confidences": sha256_of(measured)}


def _hint_warnings(
    description: Description, ingested: StageRecord, detected: StageRecord | None
) -> list[str]:
    """Say where keypoints were found with other clocks, poses or calibrations than were ingested last."""
    if detected is None or hints_from(detected) == hints_of(
        description, ingested, detected.counts["cameras"]
    ):
        return []
    return [
        "keypoints are those of an earlier ingest: the clocks, poses or calibrations that said where to look"
        " for the actor have changed since; --force detects them anew"
    ]


def _check_fill(fill_s: float | None) -> None:
    if fill_s is not None and not 0 < fill_s <= _LONGEST_FILL_S:
        raise DataError(
            "--fill",
            f"{fill_s:g} s is not between 0 and {_LONGEST_FILL_S:g} s",
            "a longer gap is no measurement: leave it open",
        )


def _disturbance_warning(settings: Settings) -> str:
    draws = "a single draw" if settings.trials == 1 else f"trial 0 of {settings.trials}"
    return (
        f"the poses were disturbed by {settings.disturb_poses}: the skeleton and the figures without `trials`"
        f" are those of {draws} (seed {settings.seed}), not the flight's"
    )


def _write(folder: Path, attempt: _Attempt, gait: pd.DataFrame, metrics: Mapping[str, object]) -> None:
    skeleton = skeleton_table(attempt.observations, attempt.result)
    write_table(folder / "skeleton.parquet", skeleton, SKELETON)
    parts = angles_parts(attempt.observations, attempt.views, attempt.result)
    join_tables(folder / "angles.parquet", parts, ANGLES)
    write_table(folder / "gait.parquet", gait, GAIT)
    if attempt.poses is not None:
        write_table(folder / "cameras.parquet", attempt.poses, CAMERA_POSES)
    write_json(folder / "metrics.json", metrics)


def _counts(metrics: Mapping[str, Any], attempt: _Attempt, swaps: Mapping[str, object]) -> dict[str, object]:
    """Count joints by status, undone swaps, filled and smoothed joints, and events of the association."""
    events = ("views", "ambiguous", "switches", "refused", "resumed")
    return {
        **metrics["status_counts"],
        "no_people": metrics["people"]["no_people"],
        "association": {name: getattr(attempt.association, name).tolist() for name in events},
        "left_right_swaps": {"undone_over_time": swaps, "between_views": attempt.between_views},
        "filled": metrics["filled"],
        "smoothing": metrics["smoothing"],
    }


def _note_replaced(run: Run, progress: Progress) -> None:
    """Report the changed settings of a replaced reconstruction, and the stages removed with it."""
    for name, (before, now) in run.replaces.items():
        progress.note(f"replaced the reconstruction made with {name} = {before} (now {now})")
    for name in run.outdated:
        progress.note(f"removed {name}/: it showed the reconstruction before")


# --- the work ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Flight:
    """Data that all trials share."""

    description: Description
    followed: Mapping[str, Followed | str]  # the backgrounds of the cameras that are refined by them
    stills: Mapping[str, Stills]  # some pictures of cameras that are bound to each other by the ground
    actors: list[LoggedActor]
    ground: Ground | None
    truth: JointMotion | None
    waiting: Waiting  # for large arrays of long flights


@dataclass(frozen=True)
class _Attempt:
    """Result of one reconstruction of the flight (one trial)."""

    offset_s: Float  # [C] of the clocks that were found, added to the pictures' times
    observations: Observations
    views: Views
    result: Triangulation
    found: Candidates
    association: Association
    between_views: dict[str, int]  # counts of left-right swaps, see `swaps_across_views`
    metrics: dict[str, Any]
    poses: pd.DataFrame | None  # of every picture, if they are not those of the log
    warnings: list[str]


def _attempt(
    flight: _Flight, cameras: list[Camera], settings: Settings, workers: int, progress: Progress
) -> _Attempt:
    description, refines = flight.description, settings.method in ("refined", "auto")
    clocks, clock_sigma_s = _find_clocks(flight, cameras, settings, workers)
    if clocks is not None:
        cameras = shifted(cameras, clocks.offset_s)
    logged = cameras
    background: dict[str, Any] = {"background": None}
    warnings: list[str] = []
    if flight.followed:
        cameras, background["background"], warnings = _refine_cameras(
            cameras, flight.followed, description, settings
        )
        cameras = flight.waiting.put(cameras)
    binding = None
    if len(flight.stills) > 1:
        binding = bind_positions(
            cameras, flight.followed, flight.stills, between=description.pose_interpolation
        )
        cameras, background["ground"] = binding.cameras, binding.entry
    seen, views, result, solve = _triangulated(flight, cameras, settings, workers)
    observations = seen.observations
    if settings.method == "auto" and are_calibrated(cameras, observations):
        refines = False
    progress.advance()
    doubted = doubted_people(observations, views, result, seen.association.doubts, settings.pixel_sigma)
    result = refused_people(result, observations, seen.anybody)
    progress.advance()
    refined = None
    if refines:
        refined = refine_flight(
            _robust_flight(flight, cameras, seen, views, result, clock_sigma_s, settings, workers)
        )
        observations, views = refined.observations, refined.views
        result = refused_people(refined.result, observations, seen.anybody)
        if refined.cameras is None:  # refinement rejected: fall back to `robust`, with its own loss
            solve = solver_for(
                "robust", cameras, observations, pixel_sigma=settings.pixel_sigma, threads=workers
            )
            result = refused_people(solve(views), observations, seen.anybody)
    if binding is not None:
        result = replace(result, covariance=result.covariance + binding.common)
    result, finished = finish(
        observations, views, result, fill_s=settings.fill_s, smoother=smoother(settings.smooth)
    )
    truth = None if flight.truth is None else true_joints_at(flight.truth, observations.t_ns)
    metrics = assess(
        observations,
        views,
        result,
        cameras=[camera.name for camera in cameras],
        method=settings.method,
        truth=truth,
        solve=solve,
    )
    people = {"people": _people_seen(description, cameras, seen.association, doubted)}
    metrics |= of_people(people["people"]["names"], observations, result, truth)
    readout = _readout(cameras, seen)
    parts = background | (refined.metrics if refined else {}) | _clock_metrics(cameras, clocks, refined)
    known = source_of_pose_noise(description, logged, settings.pose_noise)
    progress.advance()
    return _Attempt(
        np.zeros(len(cameras)) if clocks is None else clocks.offset_s,
        observations,
        views,
        result,
        seen.found,
        seen.association,
        seen.between_views,
        metrics
        | finished
        | people
        | readout
        | parts
        | {"method_used": method_used(parts, cameras, known, settings.method)},
        _poses_stored(cameras, refined, background["background"], description.pose_interpolation),
        [
            *warnings,
            *(refined.warnings if refined else []),
            *seen.association.reasons,
            *_people_warnings(people["people"]),
            *_readout_warnings(readout),
        ],
    )


def _find_clocks(
    flight: _Flight, cameras: list[Camera], settings: Settings, workers: int
) -> tuple[FoundClocks | None, Float]:
    """Estimate unknown clock offsets; return also their prior standard deviations [C], s, for later steps.

    Offsets between cameras are estimated from the rays of people. An offset that all cameras share hardly
    changes these rays. It is estimated from the turning of the backgrounds, if no camera's start is stated.
    """
    description, clocks = flight.description, None
    prior_s, stated = load_clock_sigma(description, cameras)
    if settings.method == "refined":  # it finds the clocks of which the manifest says that they are off
        return None, np.where(stated, prior_s, 0.0)
    if prior_s.any():
        seen, views, result, _ = _triangulated(flight, cameras, settings, workers)
        robust = _robust_flight(flight, cameras, seen, views, result, prior_s, settings, workers)
        clocks = find_clocks(robust, stated)
        cameras, prior_s = shifted(cameras, clocks.offset_s), clocks.prior_s
    if settings.method == "auto" and is_time_unknown(description, cameras):
        late = common_offset(cameras, flight.followed, description.pose_interpolation)
        if late is not None:
            zero = np.zeros(len(cameras))
            clocks = clocks or FoundClocks(zero, zero, zero)
            clocks = replace(clocks, offset_s=clocks.offset_s + late.late_s, common_sigma_s=late.sigma_s)
    return clocks, prior_s


def _triangulated(
    flight: _Flight, cameras: list[Camera], settings: Settings, workers: int
) -> tuple[_Seen, Views, Triangulation, Callable[[Views], Triangulation]]:
    """Observe and triangulate by the method, or by what it starts from; the last result is its solver."""
    seen = flight.waiting.put(_observe(flight, cameras, settings))
    flight.waiting.release()
    views = views_with_noise(cameras, seen.observations, pixel_sigma=settings.pixel_sigma, threads=workers)
    solve = solver_for(
        settings.method, cameras, seen.observations, pixel_sigma=settings.pixel_sigma, threads=workers
    )
    return seen, views, flight.waiting.put(solve(views)), solve


def _robust_flight(
    flight: _Flight,
    cameras: list[Camera],
    seen: _Seen,
    views: Views,
    result: Triangulation,
    clock_sigma_s: Float,
    settings: Settings,
    workers: int,
) -> RobustFlight:
    """Collect what the refinement starts from."""
    doubts = doubted_people(seen.observations, views, result, seen.association.doubts, settings.pixel_sigma)
    return RobustFlight(
        cameras,
        seen.found,
        seen.association.choice,
        seen.observations,
        seen.sides,
        views,
        result,
        prior=load_pose_errors(flight.description, cameras, settings.pose_noise),
        measured=any(camera.errors is not None for camera in cameras),
        clock_sigma_s=clock_sigma_s,
        pixel_sigma=settings.pixel_sigma,
        between=flight.description.pose_interpolation,
        threads=workers,
        trusted=np.array([not doubt for doubt in doubts]),
        waiting=flight.waiting,
    )


def _clock_metrics(
    cameras: Sequence[Camera], clocks: FoundClocks | None, refined: RefinedFlight | None
) -> dict[str, dict[str, float]]:
    """Collect the clock offsets of all steps and their standard deviations; empty without unknown clocks."""
    if clocks is None:
        return {}
    names = [camera.name for camera in cameras]
    offset_s = dict(zip(names, clocks.offset_s.tolist(), strict=True))
    sigma_s = dict(zip(names, clocks.sigma_s.tolist(), strict=True))
    if refined is not None and refined.cameras is not None:
        later = refined.metrics["clock_offsets_s"]
        offset_s = {name: offset + later[name] for name, offset in offset_s.items()}
        sigma_s = refined.metrics["clock_offset_sigmas_s"]
    sigma_s = {name: float(np.hypot(sigma, clocks.common_sigma_s)) for name, sigma in sigma_s.items()}
    return {"clock_offsets_s": offset_s, "clock_offset_sigmas_s": sigma_s}


@dataclass(frozen=True)
class _Seen:
    """All detections, and their association with people."""

    found: Candidates
    association: Association
    observations: Observations  # at the skeleton's times, on these sides
    sides: Int64  # [T, P, J, C], see `on_sides`
    between_views: dict[str, int]  # counts of left-right swaps, see `swaps_across_views`
    anybody: Bool  # [T] True if any person was detected


def _observe(flight: _Flight, cameras: list[Camera], settings: Settings) -> _Seen:
    """Associate people, interpolate their keypoints to common times, and correct left-right swaps."""
    between, pixel_sigma = flight.description.pose_interpolation, settings.pixel_sigma
    found, association, sigma = find_people(
        cameras,
        between,
        flight.actors,
        people=settings.people if isinstance(settings.people, int) else None,
        pixel_sigma=pixel_sigma,
        scene=Scene(flight.ground, np.array([camera.field for camera in cameras])),
    )
    base = time_base(cameras, settings.rate_hz)
    observations = observe(cameras, found, association.choice, base, between)
    nearest = np.clip(np.searchsorted(found.t_ns, observations.t_ns), 0, len(found.t_ns) - 1)
    anybody = np.asarray((found.confidence > 0).any(axis=(1, 2, 3)), dtype=np.bool_)[nearest]
    sides, between_views = _agreeing_sides(observations, sigma[nearest])
    rays, confidence = on_sides(observations.rays, observations.confidence, sides)
    observations = replace(observations, rays=rays, confidence=confidence)
    return _Seen(found, association, observations, sides, between_views, anybody)


def find_people(
    cameras: list[Camera],
    between: Interpolation,
    actors: Sequence[LoggedActor],
    *,
    people: int | None = 1,
    pixel_sigma: float = Settings.pixel_sigma,
    scene: Scene | None = None,
) -> tuple[Candidates, Association, Float]:
    """Collect all detections at common times, and associate them with people; those logged come first.

    With a scene, things that are no people by the ground and by the other cameras are left out.

    The last result is the uncertainty of rays, see `ray_sigma`.
    """
    found = candidates(cameras, between)
    sigma = ray_sigma(cameras, found.t_ns, found.position, pixel_sigma=pixel_sigma)
    association = associate(
        (found.t_ns - found.t_ns[0]) / 1e9,
        found.rays,
        found.confidence,
        found.position,
        found.rotation,
        sigma,
        actors=np.stack([actor.hips_at(found.t_ns) for actor in actors], axis=1) if actors else None,
        people=people,
        scene=scene,
    )
    return found, association, sigma


def chosen_detections(cameras: Sequence[Camera], found: Candidates, association: Association) -> list[Int64]:
    """Return for every picture [F] of each camera which of its detections the actor is; -1 for none."""
    chosen = []
    for index, camera in enumerate(cameras):
        of_frame = np.full(len(camera.frame_t_ns), -1, dtype=np.int64)
        frame, choice = found.frame[:, index], association.choice[:, index, 0]
        used = (frame >= 0) & (choice >= 0)
        of_frame[frame[used]] = choice[used]
        chosen.append(of_frame)
    return chosen


def _people_seen(
    description: Description, cameras: Sequence[Camera], association: Association, doubted: Sequence[str]
) -> dict[str, Any]:
    """Count people seen at once, times with more people than requested, and unused detections."""
    asked = association.choice.shape[2]
    names = description.names_of_people(asked)
    return {
        "asked": asked,
        "phantoms": association.phantoms,
        "names": names,
        "doubted": {name: cause for name, cause in zip(names, doubted, strict=True) if cause},
        "seen_at_once": int(association.people.max(initial=0)),
        "times": len(association.people),
        "times_with_more": int((association.people > asked).sum()),
        "detections_not_used": dict(
            zip([camera.name for camera in cameras], association.unused.tolist(), strict=True)
        ),
        "no_people": {
            cause: {camera.name: count for camera, count in zip(cameras, of, strict=True) if count}
            for cause, of in {c: n.tolist() for c, n in association.no_people.items()}.items()
        },
    }


def _people_warnings(people: Mapping[str, Any]) -> list[str]:
    """Write warnings on things that are no people, unused detections, and more people than requested."""
    return [
        *_no_people_warnings(people["no_people"]),
        *_phantom_warnings(people["phantoms"]),
        *_doubted_warnings(people["doubted"]),
        *_unused_warnings(people),
    ]


_NO_BODY = {
    "ground": "not on the ground",
    "size": "not of a person's size",
    "misfit": "seen at different places by different cameras",
}


def _doubted_warnings(doubted: Mapping[str, str]) -> list[str]:
    """Write who may be no person, and is therefore not used to correct cameras and clocks."""
    words = _NO_BODY | {"residual": "its views disagree more than those of the first person"}
    return [
        f"{name} may be nobody, or mixed up with others ({words[cause]}): cameras and clocks are corrected"
        f" without {name}"
        for name, cause in doubted.items()
    ]


def _phantom_warnings(phantoms: Mapping[str, int]) -> list[str]:
    """Write how many bodies that two cameras see were left out, by cause."""
    words = _NO_BODY | {
        "same": "a second image of a person",
        "bystander": "beyond the cameras and never in all of their pictures, a bystander",
    }
    causes = ", ".join(f"{count} {words[cause]}" for cause, count in phantoms.items())
    return [f"bodies that --persons auto left out: {causes}"] if causes else []


def _no_people_warnings(no_people: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Write which detections were taken for no people, by cause, and which were kept all the same."""
    words = {
        "ground": "detections left out, because nobody of their size could stand on the ground there: {}",
        "alone": "detections left out, because no other camera sees them although one shows every place"
        " where they could stand: {}",
        "kept": "nobody of their size could stand on the ground there, but this holds for the camera's most"
        " confident person, too: the detections are kept, and the poses or the ground may be wrong: {}",
    }
    return [
        words[cause].format(", ".join(f"{name} {count}" for name, count in cameras.items()))
        for cause, cameras in no_people.items()
        if cameras
    ]


def _unused_warnings(people: Mapping[str, Any]) -> list[str]:
    """Write a warning on unused detections, and on more people than requested."""
    unused = [f"{name} {count}" for name, count in people["detections_not_used"].items() if count]
    if not unused:
        return []
    line = f"detections that belong to nobody reconstructed: {', '.join(unused)}"
    if people["times_with_more"]:
        line += (
            f"; two cameras or more detect up to {people['seen_at_once']} at once, and more than"
            f" {people['asked']} at {people['times_with_more']} of {people['times']} times: if these are"
            f" people (detectors also take trees for them), --persons {people['seen_at_once']} reconstructs"
            " them"
        )
    return [line]


def _readout(cameras: Sequence[Camera], seen: _Seen) -> dict[str, Any]:
    """Count the keypoints of rolling shutters that were moved to the stamps; empty without such cameras."""
    rolling = {
        camera.name: readout_of(camera, seen.found, c, seen.association.choice[:, c])
        for c, camera in enumerate(cameras)
        if camera.intrinsics.readout_s
    }
    return {"readout": rolling} if rolling else {}


def _readout_warnings(readout: Mapping[str, Any]) -> list[str]:
    """Say which cameras have keypoints that could not be moved."""
    return [
        f"{name}: {counts['without_motion']} keypoints stand at the picture's time instead of their row's:"
        " no neighbouring picture shows the person"
        for name, counts in readout.get("readout", {}).items()
        if counts["without_motion"]
    ]


def _following(
    session: WritableSession, description: Description, settings: Settings, force: bool
) -> tuple[Following | None, str | None]:
    """Prepare to follow the backgrounds of moving cameras; None, with the reason where `auto` cannot."""
    if not settings.asks_background or (settings.method == "auto" and not cameras_to_follow(description)):
        return None, None
    try:
        span_s = (settings.start_s, settings.end_s)
        return Following(session, every=settings.every, span_s=span_s, force=force), None
    except DataError as error:
        if settings.refine_cameras is not None:
            raise
        return None, f"{Path(error.source).name} {error.problem}"


def _finished(
    following: Following, settings: Settings, workers: int, cluster: Cluster | None, progress: Progress
) -> tuple[StageRecord | None, str | None]:
    """Follow what the detector did not show; None with the reason why `auto` goes without backgrounds."""
    try:
        return following.finish(workers=workers, cluster=cluster, progress=progress), None
    except DataError as error:
        if settings.refine_cameras is not None:
            raise
        return None, f"{Path(error.source).name} {error.problem}"


def _followed(folder: Path, cameras: Sequence[Camera], left_out: str | None) -> dict[str, Followed | str]:
    """Load the background of every moving camera with pictures; for the others, return the reason."""
    followed: dict[str, Followed | str] = {}
    for camera in cameras:
        if camera.static:
            followed[camera.name] = "it stands still"
        else:
            tracks = None if left_out else load_tracks(folder, camera)
            followed[camera.name] = tracks or left_out or "it came without pictures"
    return followed


def _stills(folder: Path, cameras: Sequence[Camera]) -> dict[str, Stills]:
    """Load the stills of the cameras that have any."""
    stills = {camera.name: load_stills(folder, camera) for camera in cameras}
    return {name: own for name, own in stills.items() if own is not None}


def _refine_cameras(
    cameras: list[Camera],
    followed: Mapping[str, Followed | str],
    description: Description,
    settings: Settings,
) -> tuple[list[Camera], dict[str, Any], list[str]]:
    stated = [load_pose_errors(description, [camera], settings.pose_noise) for camera in cameras]
    errors = [None if of is None else of[0] for of in stated]
    return refine_cameras(cameras, followed, errors, between=description.pose_interpolation)


def _poses_stored(
    cameras: list[Camera],
    refined: RefinedFlight | None,
    background: Mapping[str, Any] | None,
    between: Interpolation,
) -> pd.DataFrame | None:
    """Make a table of the poses of all pictures, for the cameras whose poses are not those of the log."""
    if refined is not None and refined.cameras is not None:
        return refined.cameras
    corrected = [camera for camera in cameras if background is not None and background[camera.name]["used"]]
    return camera_poses_table(corrected, between) if corrected else None


def _without_swaps(cameras: list[Camera]) -> tuple[list[Camera], dict[str, dict[str, int]]]:
    """Undo left-right swaps over time, from the motion of joints in each camera; return also counts."""
    mended, counts = [], {}
    for camera in cameras:
        detections, counts[camera.name] = undo_swaps_of_tracks(camera.detections, camera.frame_t_ns)
        mended.append(replace(camera, detections=detections))
    return mended, counts


def _agreeing_sides(observations: Observations, sigma: Float) -> tuple[Int64, dict[str, int]]:
    """Find the sides [T, P, J, C] on which most cameras agree; see `swaps_across_views`."""
    sides = np.empty(observations.confidence.shape, dtype=np.int64)
    total: Counter[str] = Counter()
    for person in range(observations.rays.shape[1]):
        sides[:, person], counts = swaps_across_views(
            observations.rays[:, person],
            observations.position,
            observations.rotation,
            sigma,
            observations.joints,
        )
        total.update(counts)
    return sides, dict(sorted(total.items()))


def _refuse_nothing(folder: Path, attempt: _Attempt, doubts: Sequence[Doubt]) -> None:
    """Refuse a result without any joint; the message gives the counts by status, and the likely mistake."""
    status = attempt.result.status
    if (status == STATUS.index("ok")).any():
        return
    codes, counts = np.unique(status, return_counts=True)
    gates = ", ".join(f"{STATUS[code]} {count}" for code, count in zip(codes, counts, strict=True))
    reasons = [*attempt.association.reasons, *(doubt.what for doubt in doubts[:1] if doubt.remedy)]
    remedies = [doubt.remedy for doubt in doubts[:1] if doubt.remedy]
    raise DataError(
        folder,
        "; ".join([f"no joint could be reconstructed ({gates}; {noise_text(attempt.views)})", *reasons]),
        *(remedies or ["check calibration, clocks and poses, or state another pose noise with --pose-noise"]),
    )


def _refuse_doubted(folder: Path, doubts: Sequence[Mapping[str, Any]], *, strict: bool) -> None:
    """Refuse a flight with a doubt if `strict`."""
    if strict and doubts:
        first = doubts[0]
        more = f" ({len(doubts) - 1} more doubts)" if len(doubts) > 1 else ""
        raise DataError(folder, f"is doubted: {first['what']} ({first['code']}){more}", str(first["remedy"]))


def _unused_cameras(cameras: list[Camera], result: Triangulation) -> list[str]:
    """Write a warning for cameras without inliers: wrong place, wrong time, or another person."""
    used = np.atleast_1d(result.inlier.any(axis=0))
    return [
        f"{camera.name}: none of its views was used"
        for camera, any_used in zip(cameras, used, strict=True)
        if not any_used
    ]
