"""Stage `reconstruct`: compute a skeleton, its status and its errors from keypoints in moving cameras.

Nothing is filled or smoothed without an option for it: a joint that could not be measured is NaN with a
status that gives the reason.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from pipelines.detect import cameras_to_follow, detect, follow, hints_from, hints_of
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import PoseErrors
from pipelines.geometry.triangulation import STATUS, Method, Triangulation, Views
from pipelines.keypoints.association import (
    Association,
    Ground,
    Surroundings,
    associate,
    associate_one_camera,
    level_of,
)
from pipelines.keypoints.bodies import SightLines
from pipelines.keypoints.corrections import (
    measured_for,
    read_calibration,
    swaps_across_views,
    undo_swaps_of_tracks,
)
from pipelines.reconstruction.background import (
    clocks_of_backgrounds,
    refine_cameras,
    turned_aside,
    with_known_mount,
)
from pipelines.reconstruction.background_tracks import Followed, Stills, load_stills, load_tracks
from pipelines.reconstruction.bodies import (
    bodies_of_one_camera,
    body_figures,
    body_parts,
    fit_bodies,
    shape_rows,
)
from pipelines.reconstruction.body_fit import BodyFit
from pipelines.reconstruction.clocks import (
    MIN_SIGMAS_TO_MOVE,
    OFFSET_TO_FIND_S,
    QUESTIONED_SIGMA_S,
    FoundClocks,
    is_wrong,
)
from pipelines.reconstruction.doubts.diagnosis import doubts_of, doubts_of_clocks
from pipelines.reconstruction.doubts.scene import GroundOfMap
from pipelines.reconstruction.doubts.turning import common_offset
from pipelines.reconstruction.finishing import finish, smoother
from pipelines.reconstruction.ground import bind_positions
from pipelines.reconstruction.loading import (
    PoseDisturbance,
    disturbed,
    is_time_unknown,
    load_cameras,
    load_clock_sigma,
    load_pose_errors,
    load_truth,
    shared_position_variance,
    source_of_pose_noise,
    with_reference,
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
from pipelines.reconstruction.one_camera import STATURE_M
from pipelines.reconstruction.refining import (
    RefinedFlight,
    RobustFlight,
    doubted_people,
    find_clocks,
    find_wrong_clocks,
    late_logs,
    refine_flight,
    shifted,
    with_clocks,
)
from pipelines.reconstruction.results import (
    angles_parts,
    assess,
    camera_poses_table,
    gait_of,
    method_used,
    of_people,
    other_place_of_truth,
    people_warnings,
    skeleton_parts,
    summary_of_trials,
    write_figures,
)
from pipelines.reconstruction.solving import (
    MIN_SIGMA_M,
    are_calibrated,
    noise_text,
    placed_by_size,
    position_sigma_m,
    ray_sigma,
    refused_people,
    solver_for,
    views_with_noise,
)
from pipelines.reconstruction.view_errors import without_view_errors
from pipelines.session.description import (
    Description,
    Doubt,
    Interpolation,
    assumptions_as_warnings,
    read_description,
)
from pipelines.session.errors import DataError
from pipelines.session.maps import each_map
from pipelines.session.parallel import Waiting, return_freed_arrays
from pipelines.session.people import LoggedActor, logged_people, true_joints_at
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import JointMotion
from pipelines.session.stages import Stage, StageRecord, WritableSession, locked
from pipelines.session.storage import jsonable, read_json, sha256_of
from pipelines.session.tables import (
    ANGLES,
    BODY,
    BODY_SHAPE,
    CAMERA_POSES,
    GAIT,
    SKELETON,
    join_tables,
    write_table,
)

RECONSTRUCT = Stage("reconstruct", revision=60)
# A longer gap is no measurement.
_LONGEST_FILL_S = 10.0
# Where held rotations triangulate so many times as many joints, those found are of other pictures.
_MORE_MEASURED = 1.02


@dataclass(frozen=True)
class ReconstructSettings:
    """Settings that determine the result, in addition to the session itself.

    `rate_hz` is that of the skeleton (None: pictures of the camera with the most). `people` of None is `auto`
    if several were logged by name, else 1. Keypoints below `min_confidence` are not used. `pose_noise`
    replaces that of flight.yaml. The `detector` looks at cameras with pictures and without keypoints: at one
    picture in `every`, from `start_s` to `end_s` after the flight's first. `fill_s` is the longest gap that
    is filled, `smooth` a filter ("butterworth:cutoff_hz=6"). `refine_cameras` corrects poses by backgrounds
    before other methods than `auto`. `disturb_poses` adds errors ("white:position_m=0.3 x20 seed=3").
    """

    method: Method | Literal["refined", "auto"] = "auto"
    rate_hz: float | None = None
    people: int | Literal["auto"] | None = None
    min_confidence: float = 0.3
    pose_noise: str | None = None
    detector: str = "blazepose"
    every: int = 1
    start_s: float | None = None
    end_s: float | None = None
    fill_s: float | None = None
    smooth: str | None = None
    refine_cameras: Literal["background"] | None = None
    disturb_poses: str | None = None

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
    settings: ReconstructSettings = ReconstructSettings(),
    *,
    workers: int = 1,
    executor: Executor | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Reconstructed:
    """Triangulate the people of a session, measure the errors, and doubt what cannot be right.

    The result depends neither on `workers`, the number of processes and threads, nor on an `executor` that
    takes their place. `force` runs it again even if nothing changed, and the detection too.

    DataError: the session cannot be used, one of its tables or the pictures were changed, or nothing could be
    reconstructed (with the counts of the reasons). BusyError: another process writes the session.
    """
    progress = progress or Silent()
    disturbance = PoseDisturbance.parse(settings.disturb_poses) if settings.disturb_poses else None
    smoother(settings.smooth)
    _check_fill(settings.fill_s)
    return_freed_arrays()
    with locked(folder) as session:
        ingested = session.ingested()
        description = read_description(folder)
        settings = replace(settings, people=settings.people or ("auto" if description.actors else 1))
        detected = _detected(session, settings, workers, force, executor, progress)
        background, left_out = _followed(session, description, settings, workers, force, executor, progress)
        measured = measured_for(detected.settings["detector"]) if detected else None
        inputs = dict(ingested.outputs) | (detected.outputs | hints_from(detected) if detected else {})
        inputs |= background.outputs if background else {}
        inputs |= {"calibration of confidences": sha256_of(measured)} if measured else {}
        run = session.begin(
            RECONSTRUCT,
            # The detector's name is that of the detection, without the paths of model files.
            settings=asdict(settings) | {"detector": detected.settings["detector"] if detected else None},
            inputs=inputs,
            force=force,
        )
        if run.finished:
            metrics = read_json(folder / "reconstruct" / "metrics.json")
            return Reconstructed(folder, run.record, metrics, skipped=True)

        trials = 1 if disturbance is None else disturbance.trials
        progress.start("Reconstructing", 1 + 3 * trials)
        flight = load_flight(
            folder,
            description,
            settings,
            detected,
            left_out if background is None else None,
            Waiting(run.folder),
            workers=workers,
            executor=executor,
        )
        flight.waiting.release()
        progress.advance()
        attempts = (
            reconstruct_once(
                flight,
                disturbed(flight.cameras, disturbance.models, disturbance.seed, trial)
                if disturbance
                else flight.cameras,
                progress,
            )
            for trial in range(trials)
        )
        stored = next(attempts)
        doubts = _doubts(flight, stored)
        flight.waiting.release()
        _raise_if_nothing_was_measured(folder, stored, doubts)
        gait, walks = gait_of(stored.observations, stored.result)
        bodies = stored.bodies
        if bodies is None:
            bodies = flight.waiting.put(
                fit_bodies(stored.observations, stored.views, stored.result, flight.waiting.between)
            )
        flight.waiting.release()
        metrics = stored.metrics | {
            "gait": walks,
            "body": body_figures(stored.observations.t_ns, stored.metrics["people"]["names"], bodies, folder),
            "doubts": [doubt.as_json() for doubt in doubts],
        }
        warnings = [
            *(doubt.as_warning() for doubt in doubts),
            *assumptions_as_warnings(description.assumptions),
            *_hint_warnings(description, ingested, detected),
            *flight.warnings,
        ]
        if disturbance is not None:
            every = [metrics, *(attempt.metrics for attempt in attempts)]
            metrics |= {"trials": summary_of_trials(every, disturbance.text, disturbance.seed)}
            draws = "a single draw" if disturbance.trials == 1 else f"trial 0 of {disturbance.trials}"
            warnings.append(
                f"the poses were disturbed by {disturbance.text}: the skeleton and the figures without"
                f" `trials` are those of {draws} (seed {disturbance.seed}), not the flight's"
            )
        _write_tables(run.folder, stored, gait, bodies, flight.waiting)
        metrics = write_figures(run.folder, jsonable(metrics), description)
        warnings += [*stored.warnings, *_unused_cameras(flight.cameras, stored.result)]
        record = run.publish(counts=_counts(metrics, stored, flight.swaps), warnings=warnings)
        for name, (before, now) in run.replaces.items():
            progress.note(f"replaced the reconstruction made with {name} = {before} (now {now})")
    return Reconstructed(folder, record, metrics, skipped=False)


def _detected(
    session: WritableSession,
    settings: ReconstructSettings,
    workers: int,
    force: bool,
    executor: Executor | None,
    progress: Progress,
) -> StageRecord | None:
    detected = detect(
        session,
        detector=settings.detector,
        people=settings.people if isinstance(settings.people, int) else 2,
        every=settings.every,
        start_s=settings.start_s,
        end_s=settings.end_s,
        workers=workers,
        force=force,
        executor=executor,
        progress=progress,
    )
    if detected is None and (settings.start_s, settings.end_s) != (None, None):
        problem = "every camera came with keypoints: no picture is looked at"
        raise DataError(session.folder, problem, "leave the span out of --pictures", code="no-pictures")
    unused = {
        "--pictures": settings.every > 1,
        "--detector": settings.detector != ReconstructSettings.detector,
    }
    for option in (option for option, is_stated in unused.items() if is_stated and detected is None):
        progress.note(f"every camera came with keypoints: {option} has no effect on them")
    return detected


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
        problem = f"max_s: {fill_s:g} s is not between 0 and {_LONGEST_FILL_S:g} s"
        remedy = "a longer gap is no measurement: leave it open"
        raise DataError("--smooth", problem, remedy, code="bad-value")


def _followed(
    session: WritableSession,
    description: Description,
    settings: ReconstructSettings,
    workers: int,
    force: bool,
    executor: Executor | None,
    progress: Progress,
) -> tuple[StageRecord | None, str | None]:
    """Follow the backgrounds of moving cameras; None, with the reason where `auto` cannot."""
    if not settings.asks_background or (settings.method == "auto" and not cameras_to_follow(description)):
        return None, None
    try:
        record = follow(
            session,
            every=settings.every,
            span_s=(settings.start_s, settings.end_s),
            workers=workers,
            force=force,
            executor=executor,
            progress=progress,
        )
    except DataError as error:
        if settings.refine_cameras is not None or error.code == "changed":
            raise
        return None, f"{Path(error.source).name} {error.problem}"
    return record, None


def _raise_if_nothing_was_measured(folder: Path, attempt: Attempt, doubts: Sequence[Doubt]) -> None:
    status = attempt.result.status
    if (status == STATUS.index("ok")).any():
        return
    codes, counts = np.unique(status, return_counts=True)
    gates = ", ".join(f"{STATUS[code]} {count}" for code, count in zip(codes, counts, strict=True))
    causes = [doubt for doubt in doubts[:2] if doubt.remedy and doubts[0].remedy]
    why = [f"{gates}, {noise_text(attempt.views)}", *attempt.association.reasons]
    if causes:  # what explains nearly as much is said beside the first
        why = [", or ".join(doubt.what for doubt in causes)]
    advice = f"`mocap check {folder}` looks for the mistake; or state another pose noise with --pose-noise"
    raise DataError(
        folder,
        "; ".join(["no joint could be reconstructed", *why]),
        causes[0].remedy if causes else advice,
        code="nothing-reconstructed",
    )


def _write_tables(
    folder: Path, attempt: Attempt, gait: pd.DataFrame, bodies: Sequence[BodyFit | None], waiting: Waiting
) -> None:
    observations, views, result = attempt.observations, attempt.views, attempt.result
    angles = angles_parts(observations, views, result, bodies)
    join_tables(folder / "skeleton.parquet", waiting.between(skeleton_parts(observations, result)), SKELETON)
    join_tables(folder / "angles.parquet", waiting.between(angles), ANGLES)
    write_table(folder / "gait.parquet", gait, GAIT)
    if any(body is not None for body in bodies):
        join_tables(folder / "body.parquet", waiting.between(body_parts(observations.t_ns, bodies)), BODY)
        write_table(folder / "body_shape.parquet", shape_rows(bodies), BODY_SHAPE)
    if attempt.poses is not None:
        write_table(folder / "cameras.parquet", attempt.poses, CAMERA_POSES)


def _counts(metrics: Mapping[str, Any], attempt: Attempt, swaps: Mapping[str, object]) -> dict[str, object]:
    """Count joints by status, undone swaps, filled and smoothed joints, and events of the association."""
    events = ("views", "refused", "resumed")
    return {
        **metrics["status_counts"],
        "association": {name: getattr(attempt.association, name).tolist() for name in events},
        "left_right_swaps": {"undone_over_time": swaps, "between_views": attempt.between_views},
        "filled": metrics["filled"],
        "smoothing": metrics["smoothing"],
    }


def _doubts(flight: LoadedFlight, attempt: Attempt) -> list[Doubt]:
    cameras = flight.cameras
    if attempt.clocks is not None:
        cameras = with_clocks(cameras, attempt.clocks)
    doubts = doubts_of(
        flight.folder,
        flight.description,
        cameras,
        chosen=chosen_detections(cameras, attempt.found, attempt.association),
        followed=flight.followed,
        aside=turned_aside,
        pose_noise=flight.settings.pose_noise,
    )
    moved = attempt.metrics.get("clocks_moved", {})
    # The estimate knows these clocks better than doubts do, which would contradict it.
    others = [of for of in doubts if of.code != "clock" or not of.cameras or {*of.cameras} - {*moved}]
    seen = [of for of in others if of.code == "clock" and "turning_gain" in of.evidence]
    untrue = [
        of for of in seen if _are_in_time(flight, [each for each in cameras if each.name in of.cameras])
    ]
    return [*doubts_of_clocks(flight.description, moved), *(of for of in others if of not in untrue)]


def _are_in_time(flight: LoadedFlight, cameras: Sequence[Camera]) -> bool:
    """Test if the adjustment of poses surely finds clocks right; a wrong compass hardly misleads it."""
    stated, sigma_s = np.ones(len(cameras), dtype=np.bool_), np.full(len(cameras), QUESTIONED_SIGMA_S)
    errors, between = flight.errors(cameras), flight.between
    late_s, sigma_s = clocks_of_backgrounds(
        cameras, flight.followed, errors, sigma_s, stated, between=between
    )
    return bool(((late_s == 0.0) & (MIN_SIGMAS_TO_MOVE * sigma_s <= OFFSET_TO_FIND_S)).all())


def _unused_cameras(cameras: Sequence[Camera], result: Triangulation) -> list[str]:
    """Write a warning for cameras without inliers: wrong place, wrong time, or another person."""
    used = np.atleast_1d(result.inlier.any(axis=0))
    return [
        f"{camera.name}: none of its views was used"
        for camera, any_used in zip(cameras, used, strict=True)
        if not any_used
    ]


# --- the flight ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LoadedFlight:
    """Data that all trials share."""

    folder: Path
    description: Description
    settings: ReconstructSettings
    cameras: list[Camera]
    followed: Mapping[str, Followed | str]  # the backgrounds of the cameras that are refined by them
    stills: Mapping[str, Stills]  # some pictures of cameras that are bound to each other by the ground
    actors: list[LoggedActor]
    ground: Ground | None
    truth: JointMotion | None
    warnings: list[str]
    swaps: dict[str, dict[str, int]]  # of left and right that were undone over time, by camera
    waiting: Waiting  # for large arrays of long flights
    workers: int
    executor: Executor | None

    @property
    def between(self) -> Interpolation:
        """Rules for interpolating between logged poses."""
        return self.description.pose_interpolation

    def errors(self, cameras: Sequence[Camera]) -> list[PoseErrors | None]:
        """Load the errors of each camera's log that were stated; None where nobody did."""
        noise = self.settings.pose_noise
        stated = [load_pose_errors(self.description, [camera], noise) for camera in cameras]
        return [None if of is None else of[0] for of in stated]


def load_flight(
    folder: Path,
    description: Description,
    settings: ReconstructSettings,
    detected: StageRecord | None,
    left_out: str | None,
    waiting: Waiting,
    *,
    workers: int,
    executor: Executor | None,
) -> LoadedFlight:
    """Load cameras, logged people, backgrounds (or why `left_out`), ground and truth of a session."""
    measured = measured_for(detected.settings["detector"]) if detected else None
    cameras, warnings = load_cameras(
        folder,
        description,
        detected,
        min_confidence=settings.min_confidence,
        pose_noise=settings.pose_noise,
        calibrated=read_calibration(measured).probabilities if measured else None,
    )
    cameras, swaps = _without_swaps(cameras, waiting)
    followed: dict[str, Followed | str] = {}
    if settings.asks_background and cameras_to_follow(description):
        for camera in cameras:
            tracks = None if left_out or camera.static else load_tracks(folder, camera)
            reason = "it stands still" if camera.static else left_out or "it came without pictures"
            followed[camera.name] = tracks or reason
    stills = {camera.name: load_stills(folder, camera) for camera in cameras if settings.method == "auto"}
    actors = logged_people(folder, description)
    return LoadedFlight(
        folder,
        description,
        settings,
        cameras,
        followed,
        {name: own for name, own in stills.items() if own is not None},
        actors,
        _ground(folder, description, actors),
        waiting.put(load_truth(folder, description, cameras[0].detections.joints)),
        warnings,
        swaps,
        waiting,
        workers,
        executor,
    )


def _ground(folder: Path, description: Description, actors: Sequence[LoggedActor]) -> Ground | None:
    """Return the ground of the last map, else the level of the logged actor; None without either."""
    if description.map is not None:
        last = deque(each_map(folder), maxlen=1)
        return GroundOfMap.of(last[0]).about if last else None
    return level_of(actors[0].hips) if actors else None


def _without_swaps(cameras: list[Camera], waiting: Waiting) -> tuple[list[Camera], dict[str, dict[str, int]]]:
    """Undo left-right swaps over time, from the motion of joints in each camera; return also counts."""
    mended, counts = [], {}
    while cameras:  # one after the other gives its memory back
        camera = cameras.pop(0)
        detections, counts[camera.name] = undo_swaps_of_tracks(camera.detections, camera.frame_t_ns)
        mended.append(waiting.put(replace(camera, detections=detections)))
    return mended, counts


# --- the recipe ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Attempt:
    """Result of one reconstruction of the flight (one trial)."""

    bodies: list[BodyFit | None] | None  # of a single camera, which has no result without them
    clocks: FoundClocks | None  # those that were found, of all cameras; None where all are held
    observations: Observations
    views: Views
    result: Triangulation
    found: Candidates
    association: Association
    between_views: dict[str, int]  # counts of left-right swaps, see `swaps_across_views`
    metrics: dict[str, Any]
    poses: pd.DataFrame | None  # of every picture, if they are not those of the log
    warnings: list[str]


def reconstruct_once(flight: LoadedFlight, cameras: list[Camera], progress: Progress) -> Attempt:
    """Do one trial; NoViewsError if no two cameras see anything at the same times."""
    description, settings = flight.description, flight.settings
    clocks, clock_sigma_s, made = clocks_of(flight, cameras)
    if clocks is not None:
        cameras = with_clocks(cameras, clocks)
    logged = cameras
    background: dict[str, Any] = {"background": None}
    warnings = [] if clocks is None else clocks.warnings()
    if flight.followed:
        errors = flight.errors(cameras)
        cameras, background["background"], stayed = _refined_by_backgrounds(flight, cameras, errors)
        cameras, moved = _brought_together(flight, cameras, errors)
        warnings += [*stayed, *moved]
        cameras = flight.waiting.put(cameras)
    binding = None
    if len(flight.stills) > 1:
        binding = bind_positions(cameras, flight.followed, flight.stills, between=flight.between)
        cameras, background["ground"] = binding.cameras, binding.entry
    if made is None or cameras is not logged:
        made = _triangulated(flight, cameras)
    cameras, made = _without_view_errors(flight, cameras, made)
    flight.waiting.release()
    seen, views, solve = made.seen, made.views, made.solve
    observations = seen.observations
    progress.advance()
    doubted = _doubted(made) if made.bodies is None else [""] * len(made.bodies)
    result = refused_people(made.result, observations, seen.anybody)
    progress.advance()
    refined = None
    calibrated = settings.method == "auto" and are_calibrated(cameras, observations)
    if settings.method in ("refined", "auto") and not calibrated and len(cameras) > 1:
        robust = _robust_flight(flight, cameras, replace(made, result=result), clock_sigma_s)
        refined = flight.waiting.put(refine_flight(robust))
        flight.waiting.release()
        observations, views = refined.observations, refined.views
        result = refused_people(refined.result, observations, seen.anybody)
        if refined.cameras is None:  # refinement rejected: fall back to `robust`, with its own loss
            solve = solver_for("robust", cameras, observations)
            result = refused_people(solve(views), observations, seen.anybody)
    common = shared_position_variance(flight.errors(logged)) * np.eye(3)
    common += 0.0 if binding is None else binding.common
    if common.any():
        result = replace(result, covariance=result.covariance + common)
    result, finished = finish(
        observations, views, result, fill_s=settings.fill_s, smoother=smoother(settings.smooth)
    )
    result = flight.waiting.put(result)
    flight.waiting.release()
    truth = None if flight.truth is None else true_joints_at(flight.truth, observations.t_ns)
    names = [camera.name for camera in cameras]
    method = settings.method if made.bodies is None else "auto"
    if method != settings.method:
        why = "one camera measures no depth, so a body was fitted as by auto"
        warnings.append(f"method {settings.method} was not used: {why}")
    metrics = assess(observations, views, result, cameras=names, method=method, truth=truth, solve=solve)
    people = _people_seen(description, names, seen.association, doubted)
    unseen = [description.names_of_people(k + 1)[k] for k in seen.association.unseen]
    metrics |= of_people(people["names"], observations, result, truth)
    other_place = other_place_of_truth(observations, result, truth)
    readout = {
        camera.name: readout_of(camera, seen.found, c, seen.association.choice[:, c])
        for c, camera in enumerate(cameras)
        if camera.intrinsics.readout_s
    }
    parts = background | (refined.metrics if refined else {}) | _clock_metrics(names, clocks, refined)
    known = source_of_pose_noise(description, logged, settings.pose_noise)
    progress.advance()
    return Attempt(
        made.bodies,
        clocks,
        observations,
        views,
        result,
        seen.found,
        seen.association,
        seen.between_views,
        metrics
        | finished
        | {"people": people}
        | ({"readout": readout} if readout else {})
        | parts
        | {"method_used": method_used(parts, cameras, known, settings.method)}
        | ({} if made.bodies is None else {"with_second_drone_mm": made.with_second_drone_mm}),
        _poses_stored(cameras, refined, background["background"], flight.between),
        [
            *warnings,
            *([other_place] if other_place else []),
            *(refined.warnings if refined else []),
            *seen.association.reasons,
            *(f"nobody is seen near the log of {name}" for name in unseen),
            *people_warnings(people),
            *(
                f"{name}: {counts['without_motion']} keypoints stand at the picture's time instead of their"
                " row's: no neighbouring picture shows the person"
                for name, counts in readout.items()
                if counts["without_motion"]
            ),
        ],
    )


def _refined_by_backgrounds(
    flight: LoadedFlight, cameras: list[Camera], errors: Sequence[PoseErrors | None]
) -> tuple[list[Camera], dict[str, Any], list[str]]:
    """Refine cameras by their backgrounds; all rotations are held as logged if that triangulates more joints.

    Pictures of another flight or camera show a rotation, too.
    """
    refine = partial(refine_cameras, cameras, flight.followed, errors, between=flight.between)
    refined = refine()
    if len(cameras) == 1 or not any("aside_deg" in entry for entry in refined[1].values()):
        return refined

    def measured(found: tuple[list[Camera], dict[str, Any], list[str]]) -> int:
        return int((_triangulated(flight, found[0]).result.status == STATUS.index("ok")).sum())

    held = refine(search=False)
    return held if measured(held) > _MORE_MEASURED * measured(refined) else refined


def _brought_together(
    flight: LoadedFlight, cameras: list[Camera], errors: Sequence[PoseErrors | None]
) -> tuple[list[Camera], list[str]]:
    """Shift cameras whose logs are metres off to where all see the person; say so."""
    stated_m = [position_sigma_m(of) for of in errors]
    if len(cameras) < 2 or max(stated_m) < MIN_SIGMA_M:
        return cameras, []
    found, joints = candidates(cameras, flight.between), cameras[0].detections.joints
    hips = flight.actors[0].hips_at(found.t_ns) if flight.actors else None
    stature_m = flight.description.stature_m or STATURE_M[0]
    shift = placed_by_size(joints, found, stated_m, hips, stature_m)
    if not shift.any():
        return cameras, []
    moved = [
        replace(camera, trajectory=replace(camera.trajectory, position=camera.trajectory.position + by))
        for camera, by in zip(cameras, shift, strict=True)
    ]
    far = ", ".join(f"{c.name} {np.linalg.norm(by):.1f} m" for c, by in zip(cameras, shift, strict=True))
    return moved, [
        f"logged positions are metres off: cameras were moved until people look {stature_m:g} m tall ({far})"
    ]


def clocks_of(
    flight: LoadedFlight, cameras: list[Camera]
) -> tuple[FoundClocks | None, Float, _Triangulated | None]:
    """Estimate unknown clock offsets, and question stated ones.

    A camera that turns has its clock from its background. The others are compared with these by the rays of
    people, or with each other. An offset that all cameras share is estimated from all backgrounds together.
    Rays of cameras whose mounts nobody knows meet by chance, so backgrounds turn their logs first. People say
    whether a log is late, or its pictures.
    Return the clocks (None where all are held), their prior standard deviations [C], s, and what was
    triangulated if all were held.
    """
    description, settings = flight.description, flight.settings
    prior_s, stated = load_clock_sigma(description, cameras)
    none, clocks, known = np.zeros(len(cameras)), None, np.zeros(len(cameras), dtype=np.bool_)
    exact = (prior_s == 0) & (settings.method == "auto")
    questioned_s = np.where(exact, QUESTIONED_SIGMA_S, prior_s)
    if flight.followed and questioned_s.any():
        followed, errors, between = flight.followed, flight.errors(cameras), flight.between
        cameras = [
            with_known_mount(camera, followed[camera.name], of, between)
            for camera, of in zip(cameras, errors, strict=True)
        ]
        offset_s, sigma_s = clocks_of_backgrounds(
            cameras, followed, errors, questioned_s, exact, between=between
        )
        wrong = exact & is_wrong(np.nan_to_num(offset_s), np.nan_to_num(sigma_s))
        held = exact & ~wrong
        known = np.isfinite(offset_s) & ~(held & (MIN_SIGMAS_TO_MOVE * sigma_s > OFFSET_TO_FIND_S))
        moved = known & ~held
        if moved.any():
            by = {cameras[c].name: "background" for c in np.flatnonzero(wrong)}
            offset_s, sigma_s = np.where(moved, [offset_s, sigma_s], 0.0)
            clocks = FoundClocks(offset_s, sigma_s, none, wrong=by)
            prior_s, as_stated = np.where(known, sigma_s, prior_s), cameras
            cameras = shifted(cameras, offset_s)
            if by and len(cameras) > 1:
                robust = _robust_flight(flight, cameras, _triangulated(flight, cameras), prior_s)
                of_log = late_logs(robust, np.where(wrong, offset_s, 0.0), exact | known)
                clocks = clocks.with_late_logs([camera.name for camera in cameras], of_log)
                cameras, prior_s = with_clocks(as_stated, clocks), np.where(of_log, 0.0, prior_s)
            stated = stated | known
    prior_s = with_reference(description, cameras, prior_s)
    if len(cameras) == 1:  # rays of one camera meet nothing that could show its clock
        return clocks, prior_s, None
    made = None
    if (exact & ~known).any():
        made = _triangulated(flight, cameras)
        robust = _robust_flight(flight, cameras, made, prior_s)
        late = find_wrong_clocks(robust, exact & ~known, prior_s == 0, description.clock_reference)
        if late.wrong:
            cameras, made = shifted(cameras, late.offset_s), None
            clocks = late if clocks is None else clocks.with_others(late)
    if prior_s.any():
        made = made or _triangulated(flight, cameras)
        found = find_clocks(_robust_flight(flight, cameras, made, prior_s), stated)
        cameras, prior_s = shifted(cameras, found.offset_s), found.prior_s
        clocks = found if clocks is None else clocks.with_others(found)
    unknown = not known.any() and is_time_unknown(description, cameras)
    if settings.method == "auto" and unknown:
        late_of_all = common_offset(cameras, flight.followed, flight.between)
        if late_of_all is not None:
            clocks = clocks or FoundClocks(none, none, none)
            offset_s = clocks.offset_s + late_of_all.late_s
            clocks = replace(clocks, offset_s=offset_s, common_sigma_s=late_of_all.sigma_s)
    return clocks, prior_s, None if clocks is not None else made


@dataclass(frozen=True)
class _Triangulated:
    """Observations, and what the method, or what it starts from, makes of them."""

    seen: _Seen
    views: Views
    result: Triangulation
    solve: Callable[[Views], Triangulation]
    bodies: list[BodyFit | None] | None = None  # of a single camera
    with_second_drone_mm: float | None = None


def _triangulated(flight: LoadedFlight, cameras: list[Camera]) -> _Triangulated:
    seen = flight.waiting.put(_observe(flight, cameras))
    flight.waiting.release()
    return _solved(flight, cameras, seen)


def _solved(flight: LoadedFlight, cameras: list[Camera], seen: _Seen) -> _Triangulated:
    views = views_with_noise(cameras, seen.observations)
    solve = solver_for(flight.settings.method, cameras, seen.observations)
    if len(cameras) == 1:
        one = bodies_of_one_camera(
            seen.observations,
            views,
            ground=flight.ground,
            of_map=flight.description.map is not None,
            stature_m=flight.description.stature_m,
            static=cameras[0].static,
        )
        return _Triangulated(
            seen, views, flight.waiting.put(one.result), solve, one.bodies, one.with_second_drone_mm
        )
    return _Triangulated(seen, views, flight.waiting.put(solve(views)), solve)


def _without_view_errors(
    flight: LoadedFlight, cameras: list[Camera], made: _Triangulated
) -> tuple[list[Camera], _Triangulated]:
    """Remove the errors of the detector that depend on the side that it sees; triangulate again."""
    if not any(camera.blazepose for camera in cameras):
        return cameras, made
    seen = made.seen
    choice, seen_by = seen.association.choice, (seen.observations, seen.sides)
    cameras = without_view_errors(
        cameras, seen.found, choice, *seen_by, made.result, flight.description.stature_m
    )
    observations = observe(cameras, seen.found, choice, seen.observations.t_ns, flight.between, seen.sides)
    seen = flight.waiting.put(replace(seen, observations=observations))
    return cameras, _solved(flight, cameras, seen)


def _doubted(made: _Triangulated) -> list[str]:
    """Say of each person why they must not determine cameras and clocks; "" for those who do."""
    seen = made.seen
    return doubted_people(seen.observations, made.views, made.result, seen.association.doubts)


def _robust_flight(
    flight: LoadedFlight, cameras: list[Camera], made: _Triangulated, clock_sigma_s: Float
) -> RobustFlight:
    seen = made.seen
    return RobustFlight(
        cameras,
        seen.found,
        seen.association.choice,
        seen.observations,
        seen.sides,
        made.views,
        made.result,
        prior=load_pose_errors(flight.description, cameras, flight.settings.pose_noise),
        measured=any(camera.errors is not None for camera in cameras),
        clock_sigma_s=clock_sigma_s,
        between=flight.between,
        workers=flight.workers,
        executor=flight.executor,
        trusted=np.array([not doubt for doubt in _doubted(made)]),
        stature_m=flight.description.stature_m,
        waiting=flight.waiting,
    )


def _clock_metrics(
    names: Sequence[str], clocks: FoundClocks | None, refined: RefinedFlight | None
) -> dict[str, Any]:
    """Collect the clock offsets of all steps; empty without unknown clocks."""
    if clocks is None:
        return {}
    offset_s, sigma_s = clocks.offset_s, clocks.sigma_s
    if refined is not None and refined.cameras is not None:
        later, sigmas = (
            np.array([refined.metrics[part][name] for name in names])
            for part in ("clock_offsets_s", "clock_offset_sigmas_s")
        )
        offset_s = offset_s + later
        sigma_s = np.where(sigmas > 0, sigmas, sigma_s)  # others were held
    return replace(clocks, offset_s=offset_s, sigma_s=sigma_s).as_metrics(names)


@dataclass(frozen=True)
class _Seen:
    """All detections, and their association with people."""

    found: Candidates
    association: Association
    observations: Observations  # at the skeleton's times, on these sides
    sides: Int64  # [T, P, J, C], see `on_sides`
    between_views: dict[str, int]  # counts of left-right swaps, see `swaps_across_views`
    anybody: Bool  # [T] True if any person was detected


def _observe(flight: LoadedFlight, cameras: list[Camera]) -> _Seen:
    """Associate people, interpolate their keypoints to common times, and correct left-right swaps."""
    between, people = flight.between, flight.settings.people
    found, association, sigma = find_people(
        cameras,
        between,
        flight.actors,
        people=people if isinstance(people, int) else None,
        scene=Surroundings(flight.ground, np.array([camera.field for camera in cameras])),
    )
    base = time_base(cameras, flight.settings.rate_hz)
    observations = observe(cameras, found, association.choice, base, between)
    nearest = np.clip(np.searchsorted(found.t_ns, observations.t_ns), 0, len(found.t_ns) - 1)
    anybody = np.asarray((found.confidence > 0).any(axis=(1, 2, 3)), dtype=np.bool_)[nearest]
    sides, between_views = agreeing_sides(observations, sigma[nearest])
    rays, confidence = on_sides(observations.rays, observations.confidence, sides)
    observations = replace(observations, rays=rays, confidence=confidence)
    return _Seen(found, association, observations, sides, between_views, anybody)


def find_people(
    cameras: list[Camera],
    between: Interpolation,
    actors: Sequence[LoggedActor],
    *,
    people: int | None = 1,
    scene: Surroundings | None = None,
) -> tuple[Candidates, Association, Float]:
    """Collect all detections at common times, associate them with people, logged first; see `ray_sigma`."""
    found = candidates(cameras, between)
    sigma = ray_sigma(cameras, found)
    time_s = (found.t_ns - found.t_ns[0]) / 1e9
    views = SightLines(found.rays, found.confidence, found.position, found.rotation, sigma)
    logged = np.stack([actor.hips_at(found.t_ns) for actor in actors], axis=1) if actors else None
    if len(cameras) == 1:
        association = associate_one_camera(time_s, views, actors=logged, people=people)
    else:
        association = associate(time_s, *views, actors=logged, people=people, scene=scene)
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
    description: Description, cameras: Sequence[str], association: Association, doubted: Sequence[str]
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
        "detections_not_used": dict(zip(cameras, association.unused.tolist(), strict=True)),
    }


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


def agreeing_sides(observations: Observations, sigma: Float) -> tuple[Int64, dict[str, int]]:
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
