"""Stage `reconstruct`: compute a skeleton, its status and its errors from keypoints in moving cameras.

Load the session's tables; associate people; interpolate every camera to common times; triangulate all
joints at once; measure errors; store. Nothing is filled or smoothed without an option for it: a joint that
could not be measured is NaN with a status that gives the reason.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipelines.detect import cameras_to_detect, detect, hints_from, hints_of
from pipelines.follow import Following, cameras_to_follow
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import NoiseModel
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
    common_joints,
    is_time_unknown,
    load_cameras,
    load_clock_sigma,
    load_pose_errors,
    load_time_base,
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
    agreed_clocks,
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
    of_times,
    skeleton_table,
)
from pipelines.reconstruction.segments import (
    APART_M,
    LENGTH_S,
    OVERLAP_S,
    Segment,
    apart_m,
    divided,
    doubts_of_flight,
    figures_of_flight,
    joined,
    mean_angles,
    mean_poses,
    mean_skeleton,
    merged,
    nothing_seen,
    numbered,
    places,
    rows_of_people,
    same_people,
    sampled,
    warnings_of_flight,
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
from pipelines.session.clusters import Cluster, Processes, SharedSession, contents_of, write_contents
from pipelines.session.description import (
    Description,
    Doubt,
    Interpolation,
    read_description,
    said_assumptions,
    said_doubts,
    said_remedy,
)
from pipelines.session.errors import DataError, NoViewsError
from pipelines.session.maps import each_map
from pipelines.session.memory import Waiting, available_bytes, return_freed_arrays, return_unused
from pipelines.session.people import LoggedActor, logged_people, true_joints_at
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import JointMotion
from pipelines.session.stage_records import Stage, StageRecord
from pipelines.session.stages import Run, Session, WritableSession, locked
from pipelines.session.storage import jsonable, read_json, sha256_of, write_json
from pipelines.session.stores import published_version
from pipelines.session.tables import (
    ANGLES,
    CAMERA_POSES,
    GAIT,
    SKELETON,
    Span,
    join_tables,
    read_table,
    write_table,
)

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
        base, t_ns = load_time_base(folder, description, detected, settings.rate_hz)
        segments = divided(t_ns) if errors is None else []
        run = session.begin(
            RECONSTRUCT,
            settings=_stated(settings, detected) | _stated_segments(segments),
            inputs=_inputs(ingested, detected, background, measured),
            force=force,
        )
        if run.finished:
            metrics = read_json(folder / "reconstruct" / "metrics.json")
            _refuse_doubted(folder, metrics["doubts"], strict=strict)
            return Reconstructed(folder, run.record, metrics, skipped=True)

        source = _Source(folder, description, settings, detected, background is not None, left_out)
        if len(segments) > 1:
            outcome = _by_segments(run, source, segments, base, workers, cluster, strict, progress)
        else:
            outcome = _at_once(run.folder, source, errors, workers, strict, progress)
        record = run.publish(
            counts=outcome.counts,
            warnings=[
                *said_doubts(outcome.doubts),
                *said_assumptions(description.assumptions),
                *_hint_warnings(description, ingested, detected),
                *outcome.warnings,
            ],
        )
        _note_replaced(run, progress)
    return Reconstructed(folder, record, outcome.metrics, skipped=False)


@dataclass(frozen=True)
class _Source:
    """A session to reconstruct, with what was made of its pictures."""

    folder: Path
    description: Description
    settings: Settings
    detected: StageRecord | None
    background: bool  # its moving cameras were followed
    left_out: str | None  # the reason why `auto` goes without backgrounds

    def load(self, waiting: Waiting, span_ns: Span | None = None) -> _Loaded:
        """Load what is known of a span of time, or of all the time.

        Raises:
            DataError: see `load_cameras`; a table or map of the session is damaged.
        """
        folder, description, settings = self.folder, self.description, self.settings
        measured = measured_for(self.detected.settings["detector"]) if self.detected else None
        cameras, warnings = load_cameras(
            folder,
            description,
            self.detected,
            min_confidence=settings.min_confidence,
            pose_noise=settings.pose_noise,
            calibrated=read_calibration(measured).probabilities if measured else None,
            span_ns=span_ns,
        )
        cameras, swaps = _without_swaps(cameras)
        cameras = waiting.put(cameras)
        actors = logged_people(folder, description, span_ns)
        flight = _Flight(
            description,
            _followed(folder, cameras, self.left_out) if self.background or self.left_out else {},
            _stills(folder, cameras) if settings.method == "auto" else {},
            actors,
            ground_of(folder, description, actors[0] if actors else None),
            waiting.put(load_truth(folder, description, cameras[0].detections.joints, span_ns)),
            waiting,
        )
        return _Loaded(cameras, flight, warnings, swaps)

    def doubts(self, loaded: _Loaded, attempt: _Attempt) -> list[Doubt]:
        """Doubt what cannot be right in what was reconstructed.

        Raises:
            DataError: a table or map of the session is damaged.
        """
        timed = shifted(loaded.cameras, attempt.offset_s)
        return doubts_of(
            self.folder,
            self.description,
            timed,
            chosen=chosen_detections(timed, attempt.found, attempt.association),
            followed=loaded.flight.followed,
            pose_noise=self.settings.pose_noise,
        )


@dataclass(frozen=True)
class _Loaded:
    """The cameras of a flight, or of a stretch of it, and what all trials share."""

    cameras: list[Camera]
    flight: _Flight
    warnings: list[str]
    swaps: dict[str, dict[str, int]]  # of left and right that were undone over time, by camera


@dataclass(frozen=True)
class _Outcome:
    """Report of a reconstruction beside its tables."""

    metrics: dict[str, Any]
    doubts: list[Doubt]
    counts: dict[str, object]
    warnings: list[str]


def _at_once(
    place: Path,
    source: _Source,
    errors: Sequence[NoiseModel] | None,
    workers: int,
    strict: bool,
    progress: Progress,
) -> _Outcome:
    """Reconstruct a flight as a whole, with so many trials of pose errors, and write it into a folder."""
    folder, settings = source.folder, source.settings
    progress.start("Reconstructing", 1 + 3 * settings.trials)
    loaded = source.load(Waiting(place))
    cameras, warnings = loaded.cameras, list(loaded.warnings)
    progress.advance()
    attempts = (
        _attempt(
            loaded.flight,
            disturbed(cameras, errors, settings.seed, trial) if errors else cameras,
            settings,
            workers,
            progress,
        )
        for trial in range(settings.trials)
    )
    stored = next(attempts)
    doubts = source.doubts(loaded, stored)
    _refuse_nothing(folder, stored, doubts)
    gait, walks = gait_of(stored.observations, stored.result)
    metrics = stored.metrics | {"gait": walks, "doubts": [doubt.as_json() for doubt in doubts]}
    _refuse_doubted(folder, metrics["doubts"], strict=strict)
    if settings.disturb_poses is not None:
        every = [metrics, *(attempt.metrics for attempt in attempts)]
        metrics = metrics | {"trials": summary_of_trials(every, settings.disturb_poses, settings.seed)}
        warnings.append(_disturbance_warning(settings))
    metrics = jsonable(metrics)
    _write(place, stored, gait)
    write_json(place / "metrics.json", metrics)
    warnings += [*stored.warnings, *_unused_cameras(cameras, stored.result)]
    return _Outcome(metrics, doubts, _counts(metrics, stored, loaded.swaps), warnings)


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


def _write(folder: Path, attempt: _Attempt, gait: pd.DataFrame) -> None:
    skeleton = skeleton_table(attempt.observations, attempt.result)
    write_table(folder / "skeleton.parquet", skeleton, SKELETON)
    parts = angles_parts(attempt.observations, attempt.views, attempt.result)
    join_tables(folder / "angles.parquet", parts, ANGLES)
    write_table(folder / "gait.parquet", gait, GAIT)
    if attempt.poses is not None:
        write_table(folder / "cameras.parquet", attempt.poses, CAMERA_POSES)


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


# --- segments ------------------------------------------------------------------------------------------

_CLOCKED = 3  # segments in which unknown clocks are looked for: they are those of the whole flight
_SEGMENT_BYTES = 1 << 30  # of memory that a segment takes


@dataclass(frozen=True)
class _Order:
    """A segment for a worker."""

    session: SharedSession
    settings: Settings
    background: bool
    left_out: str | None
    segment: Segment
    threads: int
    clocks: Mapping[str, tuple[float, float]] | None = None  # offset and standard deviation (s) by camera
    common_sigma_s: float = 0.0  # of these clocks
    person: LoggedActor | None = None  # place of the person at the end of the segment before

    def load(self, waiting: Waiting) -> tuple[_Source, _Loaded]:
        """Load the segment from the session."""
        folder = self.session.opened()
        description = read_description(folder)
        detected = Session(folder).record("detect") if cameras_to_detect(description) else None
        source = _Source(folder, description, self.settings, detected, self.background, self.left_out)
        loaded = source.load(waiting, self.segment.span_ns)
        flight = replace(loaded.flight, segment=self.segment)
        if self.person is not None and not flight.actors:
            flight = replace(flight, actors=[self.person])
        if self.clocks is not None:
            known = np.array([self.clocks[camera.name] for camera in loaded.cameras])
            none = np.zeros(len(known))
            flight = replace(flight, clocks=FoundClocks(known[:, 0], known[:, 1], none, self.common_sigma_s))
        return source, replace(loaded, flight=flight)


def clocks_of_segment(order: _Order) -> dict[str, dict[str, float]]:
    """Find the clocks of a segment on a worker; see `agreed_clocks`."""
    return_freed_arrays()
    settings = (
        replace(order.settings, method="auto") if order.settings.method == "refined" else order.settings
    )
    with TemporaryDirectory() as place:
        try:
            _, loaded = order.load(Waiting(Path(place)))
            clocks, prior_s = _find_clocks(loaded.flight, loaded.cameras, settings, order.threads)
        except NoViewsError:
            return {"": {"common_sigma_s": 0.0}}
    if clocks is None:
        clocks = FoundClocks(np.zeros(len(prior_s)), np.zeros(len(prior_s)), prior_s)
    found = {
        camera.name: {"offset_s": float(offset), "sigma_s": float(sigma), "prior_s": float(prior)}
        for camera, offset, sigma, prior in zip(
            loaded.cameras, clocks.offset_s, clocks.sigma_s, prior_s, strict=True
        )
    }
    return found | {"": {"common_sigma_s": clocks.common_sigma_s}}


def reconstruct_segment(order: _Order) -> dict[str, bytes]:
    """Reconstruct a segment on a worker; return its files: the tables of a session, and part.json.

    Raises:
        DataError: the worker has no such session, or a table of it is damaged.
    """
    return_freed_arrays()
    with TemporaryDirectory() as place:
        made, waiting = Path(place, "made"), Path(place, "waiting")
        made.mkdir()
        waiting.mkdir()
        try:
            part = _made_of_segment(made, order, *order.load(Waiting(waiting)))
        except NoViewsError as error:
            part = _nothing_of_segment(made, order, str(error))
        write_json(made / "part.json", jsonable(part))
        return_unused()
        return contents_of(made)


def _made_of_segment(place: Path, order: _Order, source: _Source, loaded: _Loaded) -> dict[str, object]:
    """Reconstruct a segment; write its tables and return what is known of it."""
    attempt = _attempt(loaded.flight, loaded.cameras, order.settings, order.threads, Silent())
    doubts = source.doubts(loaded, attempt)
    gait, walks = gait_of(attempt.observations, attempt.result)
    corrected = [] if attempt.poses is None else attempt.poses["camera"].unique().tolist()
    timed = shifted(loaded.cameras, attempt.offset_s)
    logged = [camera for camera in timed if camera.name not in corrected]
    poses = [attempt.poses] if attempt.poses is not None else []
    if logged:
        poses.append(camera_poses_table(logged, source.description.pose_interpolation))
    _write(place, replace(attempt, poses=None), gait[gait["t_ns"].between(*order.segment.own_ns)])
    join_tables(place / "cameras.parquet", poses, CAMERA_POSES)
    metrics = attempt.metrics | {"gait": walks, "doubts": [doubt.as_json() for doubt in doubts]}
    return {
        "metrics": metrics,
        "counts": _counts(metrics, attempt, loaded.swaps),
        "corrected": corrected,
        "warnings": [
            *loaded.warnings,
            *attempt.warnings,
            *_unused_cameras(loaded.cameras, attempt.result),
        ],
        "reason": None,
    }


def _nothing_of_segment(place: Path, order: _Order, reason: str) -> dict[str, object]:
    """Write the rows of a segment in which no two cameras see anything."""
    folder = order.session.opened()
    description = read_description(folder)
    detected = Session(folder).record("detect") if cameras_to_detect(description) else None
    joints = common_joints(folder, description, detected)
    people = order.settings.people if isinstance(order.settings.people, int) else 1
    skeleton, angles = nothing_seen(order.segment, joints, people)
    write_table(place / "skeleton.parquet", skeleton, SKELETON)
    write_table(place / "angles.parquet", angles, ANGLES)
    own = order.segment.own
    count = (own.stop - own.start) * people * len(joints)
    return {"metrics": None, "reason": reason, "joint_frames": count}


def _stated_segments(segments: Sequence[Segment]) -> dict[str, object]:
    """Return how a long flight is divided, for the settings that determine its result; empty for others."""
    return {"segments": {"longest_s": LENGTH_S, "overlap_s": OVERLAP_S}} if len(segments) > 1 else {}


def _by_segments(
    run: Run,
    source: _Source,
    segments: Sequence[Segment],
    base: str,
    workers: int,
    cluster: Cluster | None,
    strict: bool,
    progress: Progress,
) -> _Outcome:
    """Reconstruct a long flight segment by segment, and join them.

    Args:
        run: keeps the segments that are finished, so that a later run goes on with the others.
        source: the session.
        segments: at least two.
        base: the camera whose pictures give the times of the skeleton.
        workers: the number of processes on this machine, as far as its memory allows.
        cluster: works on the segments instead.
        strict: refuse a flight that is doubted.
        progress: receives the progress.
    """
    folder = source.folder
    each: Each
    if cluster is not None and published_version(folder) is None:
        each, threads = partial(cluster.each, progress=progress), 1
    else:  # the pictures' results of a session in a store are on this machine only
        memory = available_bytes()
        most = workers if memory is None else min(workers, max(memory // _SEGMENT_BYTES, 1))
        count = min(most, len(segments))
        each, threads = Processes(count).each, max(workers // count, 1)
    progress.start("Reconstructing", len(segments))

    def order_of(segment: Segment) -> _Order:
        shared = SharedSession.at(folder)
        return _Order(shared, source.settings, source.background, source.left_out, segment, threads)

    clocks = _clocks_of_flight(run, source, [order_of(part) for part in sampled(segments, _CLOCKED)], each)
    if clocks is not None and source.settings.rate_hz is None:
        late_ns = round(1e9 * clocks[0][base][0])
        segments = [segment.later(late_ns) for segment in segments]
    orders = [order_of(segment) for segment in segments]
    if clocks is not None:
        orders = [replace(order, clocks=clocks[0], common_sigma_s=clocks[1]) for order in orders]
    missing = [order for order in orders if not run.has_chunk(order.segment.name)]
    progress.advance(len(orders) - len(missing))
    with closing(each(reconstruct_segment, missing)) as found:
        for number, contents in found:
            run.chunk(missing[number].segment.name, partial(write_contents, contents))
            progress.advance()
    flight = _Joined.of(run, source, orders)
    doubts = flight.doubts
    _refuse_nothing_of_segments(folder, flight, doubts)
    metrics = flight.metrics | {"doubts": [doubt.as_json() for doubt in doubts]}
    if clocks is not None:
        metrics["clock_offsets_s"] = {name: offset for name, (offset, _) in clocks[0].items()}
        metrics["clock_offset_sigmas_s"] = {
            name: float(np.hypot(sigma, clocks[1])) for name, (_, sigma) in clocks[0].items()
        }
    _refuse_doubted(folder, metrics["doubts"], strict=strict)
    metrics = jsonable(metrics)
    flight.write(run.folder)
    write_json(run.folder / "metrics.json", metrics)
    return _Outcome(metrics, doubts, flight.counts, flight.warnings)


Each = Callable[[Callable[[_Order], Any], Sequence[_Order]], Generator[tuple[int, Any]]]


def _clocks_of_flight(
    run: Run, source: _Source, orders: Sequence[_Order], each: Each
) -> tuple[dict[str, tuple[float, float]], float] | None:
    """Find offset and standard deviation (s) of every clock, and that of a common offset; None if known."""
    cameras = source.description.cameras
    names = list(cameras)
    if not any(entry.clock.prior_sigma_s > 0 for entry in cameras.values()):
        return None

    def find(place: Path) -> None:
        found: list[dict[str, dict[str, float]]] = [{}] * len(orders)
        with closing(each(clocks_of_segment, orders)) as parts:
            for number, clocks in parts:
                found[number] = clocks
        write_json(place / "clocks.json", {"segments": found})

    agreed = agreed_clocks(names, read_json(run.chunk("clocks", find) / "clocks.json")["segments"])
    by_camera = zip(names, agreed.offset_s.tolist(), agreed.sigma_s.tolist(), strict=True)
    return {name: (offset, sigma) for name, offset, sigma in by_camera}, agreed.common_sigma_s


@dataclass(frozen=True)
class _Joined:
    """The finished segments of a flight, and the number of each person over the flight."""

    description: Description
    segments: Sequence[Segment]
    folders: Sequence[Path]
    numbers: Sequence[Sequence[int]]
    strangers: Sequence[int]  # segments whose person is another one than before

    @classmethod
    def of(cls, run: Run, source: _Source, orders: Sequence[_Order]) -> _Joined:
        """Number the people of all segments; a segment that chose somebody else is made once more."""
        logged = len(source.description.logged_people)
        folders: list[Path] = []
        numbers: list[list[int]] = []
        strangers: list[int] = []
        before: tuple[Int64, Float] | None = None
        for k, order in enumerate(orders):
            place = run.chunk(order.segment.name, _never)
            first_ns = order.segment.own_ns[0]
            shared = (first_ns - round(0.5e9 * OVERLAP_S), first_ns + round(0.5e9 * OVERLAP_S))
            here = _places(place, shared)
            if before is None:
                numbers.append(list(range(here[1].shape[1])))
            else:
                distance = apart_m(before, here)
                alone = distance.shape == (1, 1) and not logged
                if alone and distance[0, 0] > APART_M:
                    known = np.isfinite(before[1][:, 0]).all(axis=1)
                    person = LoggedActor(before[0][known], before[1][known, 0])
                    again = replace(order, person=person)
                    made = run.chunk(f"{order.segment.name}-again", partial(_write_segment, again))
                    if apart_m(before, other := _places(made, shared))[0, 0] <= APART_M:
                        place, here, distance = made, other, apart_m(before, other)
                    else:
                        strangers.append(k)
                numbers.append(numbered(same_people(distance, logged), here[1].shape[1], numbers[-1]))
            folders.append(place)
            end_ns = order.segment.own_ns[1]
            before = _places(place, (end_ns - round(0.5e9 * OVERLAP_S), end_ns + round(0.5e9 * OVERLAP_S)))
        return cls(source.description, [order.segment for order in orders], folders, numbers, strangers)

    @cached_property
    def parts(self) -> list[dict[str, Any]]:
        """Figures, counts and warnings of each segment."""
        return [dict(read_json(folder / "part.json")) for folder in self.folders]

    @property
    def people(self) -> int:
        """Number of people in the flight."""
        return 1 + max(max(of) for of in self.numbers)

    @property
    def doubts(self) -> list[Doubt]:
        """Doubts of at least half of the segments."""
        return self._doubts[0]

    @cached_property
    def _doubts(self) -> tuple[list[Doubt], list[tuple[Doubt, int, int]]]:
        return doubts_of_flight([part["metrics"]["doubts"] for part in self.parts if part["metrics"]])

    @property
    def counts(self) -> dict[str, object]:
        """Counts of all segments."""
        counts = [part["counts"] for part in self.parts if part["metrics"]]
        return dict(merged(counts, [1.0] * len(counts), summed=True))

    @property
    def metrics(self) -> dict[str, Any]:
        """Figures of the flight, and what was used in each segment."""
        made = [part["metrics"] for part in self.parts if part["metrics"]]
        if not made:
            return {"doubts": [], "status_counts": {"ok": 0}}
        named = [
            self._named(part["metrics"], number)
            for part, number in zip(self.parts, self.numbers, strict=True)
            if part["metrics"]
        ]
        flight = figures_of_flight(named)
        gone = sum(part["joint_frames"] for part in self.parts if not part["metrics"])
        if gone:
            counts = flight["status_counts"]
            counts["all"] += gone
            counts["few_views"] = counts.get("few_views", 0) + gone
            flight["reconstructed_share"] = counts["ok"] / counts["all"]
        flight["people"]["names"] = self.description.names_of_people(self.people)
        start_ns = self.description.start_ns
        flight["segments"] = [
            {
                "first_s": (segment.own_ns[0] - start_ns) / 1e9,
                "last_s": (segment.own_ns[1] - start_ns) / 1e9,
                "used": part["metrics"]["method_used"]["summary"] if part["metrics"] else part["reason"],
                "doubts": [doubt["code"] for doubt in part["metrics"]["doubts"]] if part["metrics"] else [],
            }
            for segment, part in zip(self.segments, self.parts, strict=True)
        ]
        return flight

    def _named(self, metrics: Mapping[str, Any], number: Sequence[int]) -> dict[str, Any]:
        """Return figures of a segment with the names and numbers that its people have in the flight."""
        names = self.description.names_of_people(self.people)
        by_person = list(metrics["by_person"].values())
        here = dict(zip(metrics["people"]["names"], number, strict=True))
        doubted = {names[here[name]]: cause for name, cause in metrics["people"]["doubted"].items()}
        return dict(metrics) | {
            "people": metrics["people"] | {"doubted": doubted},
            "by_person": {names[k]: of for k, of in zip(number, by_person, strict=True)},
            "gait": {str(k): metrics["gait"].get(str(p)) for p, k in enumerate(number)},
        }

    @property
    def warnings(self) -> list[str]:
        """Warnings of all segments; those that differ in numbers alone are one."""
        start_ns = self.description.start_ns
        begins_s, ends_s = (
            [(segment.own_ns[end] - start_ns) / 1e9 for segment in self.segments] for end in (0, 1)
        )
        told = [
            f"from {begin_s:.0f} s to {end_s:.0f} s nothing could be reconstructed: {part['reason']}"
            for begin_s, end_s, part in zip(begins_s, ends_s, self.parts, strict=True)
            if not part["metrics"]
        ]
        told += [
            f"from {begins_s[k]:.0f} s on another person may be the actor: state --persons, or log the actor"
            for k in self.strangers
        ]
        made = [k for k, part in enumerate(self.parts) if part["metrics"]]
        told += [
            f"{count} of {len(made)} segments, first that from {begins_s[made[k]]:.0f} s to"
            f" {ends_s[made[k]]:.0f} s: {said_doubts([doubt])[0]}"
            for doubt, count, k in self._doubts[1]
        ]
        return told + warnings_of_flight([part["warnings"] for part in self.parts if part["metrics"]])

    def write(self, place: Path) -> None:
        """Write the tables of the flight."""

        def rows(name: str, schema: Any, kinds: str) -> Iterator[tuple[Segment, pd.DataFrame]]:
            for segment, folder, number in zip(self.segments, self.folders, self.numbers, strict=True):
                table = read_table(folder / name, schema)
                yield segment, rows_of_people(table, number, self.people, kinds)

        for name, schema, kind, mean in (
            ("skeleton.parquet", SKELETON, "joint", mean_skeleton),
            ("angles.parquet", ANGLES, "angle", mean_angles),
        ):
            keys = ("t_ns", "person", kind)
            join_tables(place / name, joined(rows(name, schema, kind), keys, mean), schema)
        there = [k for k, part in enumerate(self.parts) if part["metrics"]]
        walks = []
        for k in there:
            table = read_table(self.folders[k] / "gait.parquet", GAIT)
            walks.append(table.assign(person=np.array(self.numbers[k])[table["person"].to_numpy(np.int64)]))
        join_tables(place / "gait.parquet", walks, GAIT)
        corrected = {name for k in there for name in self.parts[k]["corrected"]}

        def poses(camera: str) -> Iterator[tuple[Segment, pd.DataFrame]]:
            for k in there:
                table = read_table(self.folders[k] / "cameras.parquet", CAMERA_POSES)
                yield self.segments[k], table[table["camera"] == camera]

        cameras = [name for name in self.description.cameras if name in corrected]
        parts = (joined(poses(camera), ("t_ns", "camera"), mean_poses) for camera in cameras)
        if cameras:
            join_tables(place / "cameras.parquet", chain.from_iterable(parts), CAMERA_POSES)


def _places(place: Path, within_ns: Span) -> tuple[Int64, Float]:
    """Load where the people of a segment are at some of its times, see `segments.places`."""
    return places(read_table(place / "skeleton.parquet", SKELETON, within_ns), within_ns)


def _write_segment(order: _Order, place: Path) -> None:
    write_contents(reconstruct_segment(order), place)


def _never(place: Path) -> None:
    raise RuntimeError(f"{place} was finished before")


def _refuse_nothing_of_segments(folder: Path, flight: _Joined, doubts: Sequence[Doubt]) -> None:
    """Refuse a flight without any joint, with the reasons of its segments."""
    counts = flight.metrics["status_counts"]
    if counts["ok"]:
        return
    reasons = [*flight.warnings, *(doubt.what for doubt in doubts[:1] if doubt.remedy)]
    remedies = [doubt.remedy for doubt in doubts[:1] if doubt.remedy]
    gates = ", ".join(f"{name} {count}" for name, count in counts.items() if name not in ("all", "ok"))
    raise DataError(
        folder,
        "; ".join([f"no joint could be reconstructed ({gates})", *reasons[:3]]),
        *(remedies or ["check calibration, clocks and poses, or state another pose noise with --pose-noise"]),
    )


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
    segment: Segment | None = None  # the stretch of the flight that is reconstructed; None for all of it
    clocks: FoundClocks | None = None  # that were found before

    def time_base(self, cameras: list[Camera], rate_hz: float | None) -> Int64:
        """Choose the times of the skeleton."""
        return time_base(cameras, rate_hz) if self.segment is None else self.segment.t_ns


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
    if flight.clocks is None:
        clocks, clock_sigma_s = _find_clocks(flight, cameras, settings, workers)
    else:
        clocks, clock_sigma_s = flight.clocks, np.zeros(len(cameras))
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
    refined, solves = None, settings.method
    if refines:
        refined = refine_flight(
            _robust_flight(flight, cameras, seen, views, result, clock_sigma_s, settings, workers)
        )
        observations, views = refined.observations, refined.views
        result = refused_people(refined.result, observations, seen.anybody)
        if refined.cameras is None:  # refinement rejected: fall back to `robust`, with its own loss
            solves = "robust"
            solve = solver_for(
                solves, cameras, observations, pixel_sigma=settings.pixel_sigma, threads=workers
            )
            result = refused_people(solve(views), observations, seen.anybody)
    if binding is not None:
        result = replace(result, covariance=result.covariance + binding.common)
    result, finished = finish(
        observations, views, result, fill_s=settings.fill_s, smoother=smoother(settings.smooth)
    )
    own = observations, views, result
    if flight.segment is not None:
        own = of_times(*own, flight.segment.own)
        solve = solver_for(solves, cameras, own[0], pixel_sigma=settings.pixel_sigma, threads=workers)
    truth = None if flight.truth is None else true_joints_at(flight.truth, own[0].t_ns)
    metrics = assess(
        *own,
        cameras=[camera.name for camera in cameras],
        method=settings.method,
        truth=truth,
        solve=solve,
    )
    people = {"people": _people_seen(description, cameras, seen.association, doubted)}
    metrics |= of_people(people["people"]["names"], own[0], own[2], truth)
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
        if any(refined.metrics["clock_offset_sigmas_s"].values()):  # else they were held
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
    base = flight.time_base(cameras, settings.rate_hz)
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
        more = f", the first of {len(doubts)} doubts" if len(doubts) > 1 else ""
        remedy = "; ".join(said_remedy(str(first["remedy"])))
        raise DataError(folder, f"is doubted: {first['what']} ({first['code']}){more}", remedy)


def _unused_cameras(cameras: list[Camera], result: Triangulation) -> list[str]:
    """Write a warning for cameras without inliers: wrong place, wrong time, or another person."""
    used = np.atleast_1d(result.inlier.any(axis=0))
    return [
        f"{camera.name}: none of its views was used"
        for camera, any_used in zip(cameras, used, strict=True)
        if not any_used
    ]
