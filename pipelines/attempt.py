"""One reconstruction of a flight, or of a stretch of it: everything that follows detection.

Load the session's tables; associate people; interpolate every camera to common times; triangulate all
joints at once; measure errors. Nothing is filled or smoothed without an option for it: a joint that could
not be measured is NaN with a status that gives the reason.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import PoseErrors
from pipelines.geometry.triangulation import Method, Triangulation, Views
from pipelines.keypoints.association import Association, associate
from pipelines.keypoints.calibration import measured_for, read_calibration
from pipelines.keypoints.no_people import Ground, Surroundings, level_of
from pipelines.keypoints.swaps import swaps_across_views, undo_swaps_of_tracks
from pipelines.reconstruction.background import clocks_of_backgrounds, refine_cameras
from pipelines.reconstruction.background_tracks import Followed, Stills, load_stills, load_tracks
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
    is_time_unknown,
    load_cameras,
    load_clock_sigma,
    load_pose_errors,
    load_truth,
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
from pipelines.reconstruction.refining import (
    RefinedFlight,
    RobustFlight,
    doubted_people,
    find_clocks,
    find_wrong_clocks,
    refine_flight,
    shifted,
)
from pipelines.reconstruction.results import (
    angles_parts,
    assess,
    camera_poses_table,
    method_used,
    of_people,
    of_times,
    skeleton_table,
)
from pipelines.reconstruction.segments import Segment
from pipelines.reconstruction.solving import (
    are_calibrated,
    ray_sigma,
    refused_people,
    solver_for,
    views_with_noise,
)
from pipelines.session.description import Description, Doubt, Interpolation
from pipelines.session.errors import DataError
from pipelines.session.maps import each_map
from pipelines.session.memory import Waiting
from pipelines.session.people import LoggedActor, logged_people, true_joints_at
from pipelines.session.progress import Progress
from pipelines.session.records import JointMotion
from pipelines.session.stages import StageRecord
from pipelines.session.tables import ANGLES, CAMERA_POSES, GAIT, SKELETON, Span, join_tables, write_table

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ReconstructSettings:
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
    smooth: str | None = None  # as `finishing.smoother` reads it
    refine_cameras: Literal["background"] | None = None  # before the triangulation; `auto` does it unasked
    disturb_poses: str | None = None  # errors added to the logged poses, as `PoseDisturbance.parse` reads it

    @property
    def asks_background(self) -> bool:
        """True if moving cameras with pictures have their poses corrected by their backgrounds."""
        return self.method == "auto" or self.refine_cameras == "background"


@dataclass(frozen=True)
class Source:
    """A session to reconstruct, with what was made of its pictures."""

    folder: Path
    description: Description
    settings: ReconstructSettings
    detected: StageRecord | None
    background: bool  # its moving cameras were followed
    left_out: str | None  # the reason why `auto` goes without backgrounds

    def load(self, waiting: Waiting, span_ns: Span | None = None) -> Loaded:
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
        flight = LoadedFlight(
            description,
            _followed(folder, cameras, self.left_out) if self.background or self.left_out else {},
            _stills(folder, cameras) if settings.method == "auto" else {},
            actors,
            ground_of(folder, description, actors[0] if actors else None),
            waiting.put(load_truth(folder, description, cameras[0].detections.joints, span_ns)),
            waiting,
        )
        return Loaded(cameras, flight, warnings, swaps)

    def doubts(self, loaded: Loaded, attempt: Attempt) -> list[Doubt]:
        """Doubt what cannot be right in what was reconstructed.

        Raises:
            DataError: a table or map of the session is damaged.
        """
        timed = attempt.timed(loaded.cameras)
        doubts = doubts_of(
            self.folder,
            self.description,
            timed,
            chosen=chosen_detections(timed, attempt.found, attempt.association),
            followed=loaded.flight.followed,
            pose_noise=self.settings.pose_noise,
        )
        return [*doubts_of_clocks(self.description, attempt.metrics.get("clocks_moved", {})), *doubts]


@dataclass(frozen=True)
class Loaded:
    """The cameras of a flight, or of a stretch of it, and what all trials share."""

    cameras: list[Camera]
    flight: LoadedFlight
    warnings: list[str]
    swaps: dict[str, dict[str, int]]  # of left and right that were undone over time, by camera


@dataclass(frozen=True)
class ReconstructionOutcome:
    """Report of a reconstruction beside its tables."""

    metrics: dict[str, Any]
    doubts: list[Doubt]
    counts: dict[str, object]
    warnings: list[str]


def ground_of(folder: Path, description: Description, actor: LoggedActor | None) -> Ground | None:
    """Return the ground of the last map, else the level of the logged actor; None without either."""
    if description.map is not None:
        last = deque(each_map(folder), maxlen=1)
        return GroundOfMap.of(last[0]).about if last else None
    return None if actor is None else level_of(actor.hips)


def write_attempt(folder: Path, attempt: Attempt, gait: pd.DataFrame) -> None:
    """Write the tables of an attempt: skeleton, angles, gait, and poses that are not those of the log."""
    skeleton = skeleton_table(attempt.observations, attempt.result)
    write_table(folder / "skeleton.parquet", skeleton, SKELETON)
    parts = angles_parts(attempt.observations, attempt.views, attempt.result)
    join_tables(folder / "angles.parquet", parts, ANGLES)
    write_table(folder / "gait.parquet", gait, GAIT)
    if attempt.poses is not None:
        write_table(folder / "cameras.parquet", attempt.poses, CAMERA_POSES)


def counts_of(metrics: Mapping[str, Any], attempt: Attempt, swaps: Mapping[str, object]) -> dict[str, object]:
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


@dataclass(frozen=True)
class LoadedFlight:
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
class Attempt:
    """Result of one reconstruction of the flight (one trial)."""

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

    def timed(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Return the cameras with the clocks that were found."""
        return list(cameras) if self.clocks is None else shifted(cameras, self.clocks.offset_s)


def reconstruct_once(
    flight: LoadedFlight,
    cameras: list[Camera],
    settings: ReconstructSettings,
    workers: int,
    progress: Progress,
) -> Attempt:
    """Find clocks, correct cameras by background and ground, triangulate, refine, and measure the errors.

    Raises:
        NoViewsError: no two cameras see anything at the same times.
    """
    description, refines = flight.description, settings.method in ("refined", "auto")
    made = None
    if flight.clocks is None:
        clocks, clock_sigma_s, made = clocks_of(flight, cameras, settings, workers)
    else:
        clocks, clock_sigma_s = flight.clocks if flight.clocks.moves else None, np.zeros(len(cameras))
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
    if made is None or cameras is not logged:
        made = _triangulated(flight, cameras, settings)
    seen, views, result, solve = made.seen, made.views, made.result, made.solve
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
            _robust_flight(flight, cameras, replace(made, result=result), clock_sigma_s, settings, workers)
        )
        observations, views = refined.observations, refined.views
        result = refused_people(refined.result, observations, seen.anybody)
        if refined.cameras is None:  # refinement rejected: fall back to `robust`, with its own loss
            solves = "robust"
            solve = solver_for(solves, cameras, observations, pixel_sigma=settings.pixel_sigma)
            result = refused_people(solve(views), observations, seen.anybody)
    if binding is not None:
        result = replace(result, covariance=result.covariance + binding.common)
    result, finished = finish(
        observations, views, result, fill_s=settings.fill_s, smoother=smoother(settings.smooth)
    )
    own = observations, views, result
    if flight.segment is not None:
        own = of_times(*own, flight.segment.own)
        solve = solver_for(solves, cameras, own[0], pixel_sigma=settings.pixel_sigma)
    truth = None if flight.truth is None else true_joints_at(flight.truth, own[0].t_ns)
    metrics = assess(
        *own,
        cameras=[camera.name for camera in cameras],
        method=settings.method,
        truth=truth,
        solve=solve,
    )
    people = {"people": _people_seen(description, cameras, seen.association, doubted)}
    unseen = [description.names_of_people(k + 1)[k] for k in seen.association.unseen]
    metrics |= of_people(people["people"]["names"], own[0], own[2], truth)
    readout = _readout(cameras, seen)
    parts = background | (refined.metrics if refined else {}) | _clock_metrics(cameras, clocks, refined)
    known = source_of_pose_noise(description, logged, settings.pose_noise)
    progress.advance()
    return Attempt(
        clocks,
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
            *(f"nobody is seen near the log of {name}" for name in unseen),
            *_people_warnings(people["people"]),
            *_readout_warnings(readout),
        ],
    )


def clocks_of(
    flight: LoadedFlight, cameras: list[Camera], settings: ReconstructSettings, workers: int
) -> tuple[FoundClocks | None, Float, _Triangulated | None]:
    """Estimate unknown clock offsets, and question stated ones.

    Returns:
        The clocks, None where all are held; their prior standard deviations [C], s, for later steps; and what
        was triangulated with clocks that all were held.

    A camera that turns has its clock from its background. The others are compared with these by the rays of
    people, or with each other. An offset that all cameras share hardly changes these rays: if no camera's
    start is stated and no background shows a clock by itself, it is estimated from all backgrounds together.
    """
    description = flight.description
    prior_s, stated = load_clock_sigma(description, cameras)
    if settings.method == "refined":  # it finds the clocks of which the manifest says that they are off
        return None, np.where(stated, with_reference(description, cameras, prior_s), 0.0), None
    none, clocks, known = np.zeros(len(cameras)), None, np.zeros(len(cameras), dtype=np.bool_)
    exact = (prior_s == 0) & (settings.method == "auto")
    questioned_s = np.where(exact, QUESTIONED_SIGMA_S, prior_s)
    if flight.followed and questioned_s.any():
        offset_s, sigma_s = clocks_of_backgrounds(
            cameras,
            flight.followed,
            _stated_errors(cameras, description, settings),
            questioned_s,
            exact,
            between=description.pose_interpolation,
        )
        wrong = exact & is_wrong(np.nan_to_num(offset_s), np.nan_to_num(sigma_s))
        held = exact & ~wrong
        known = np.isfinite(offset_s) & ~(held & (MIN_SIGMAS_TO_MOVE * sigma_s > OFFSET_TO_FIND_S))
        moved = known & ~held
        if moved.any():
            by = {cameras[c].name: "background" for c in np.flatnonzero(wrong)}
            offset_s, sigma_s = np.where(moved, [offset_s, sigma_s], 0.0)
            clocks = FoundClocks(offset_s, sigma_s, none, wrong=by)
            cameras, prior_s = shifted(cameras, clocks.offset_s), np.where(known, 0.0, prior_s)
    prior_s = with_reference(description, cameras, prior_s)
    made = None
    if (exact & ~known).any():
        made = _triangulated(flight, cameras, settings)
        robust = _robust_flight(flight, cameras, made, prior_s, settings, workers)
        late = find_wrong_clocks(robust, exact & ~known, prior_s == 0, description.clock_reference)
        if late.wrong:
            cameras, made = shifted(cameras, late.offset_s), None
            clocks = late if clocks is None else clocks.with_others(late)
    if prior_s.any():
        made = made or _triangulated(flight, cameras, settings)
        found = find_clocks(_robust_flight(flight, cameras, made, prior_s, settings, workers), stated)
        cameras, prior_s = shifted(cameras, found.offset_s), found.prior_s
        clocks = found if clocks is None else clocks.with_others(found)
    unknown = not known.any() and is_time_unknown(description, cameras)
    if settings.method == "auto" and unknown:
        late_of_all = common_offset(cameras, flight.followed, description.pose_interpolation)
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


def _triangulated(
    flight: LoadedFlight, cameras: list[Camera], settings: ReconstructSettings
) -> _Triangulated:
    """Observe and triangulate by the method, or by what it starts from."""
    seen = flight.waiting.put(_observe(flight, cameras, settings))
    flight.waiting.release()
    views = views_with_noise(cameras, seen.observations, pixel_sigma=settings.pixel_sigma)
    solve = solver_for(settings.method, cameras, seen.observations, pixel_sigma=settings.pixel_sigma)
    return _Triangulated(seen, views, flight.waiting.put(solve(views)), solve)


def _robust_flight(
    flight: LoadedFlight,
    cameras: list[Camera],
    made: _Triangulated,
    clock_sigma_s: Float,
    settings: ReconstructSettings,
    workers: int,
) -> RobustFlight:
    """Collect what the refinement starts from."""
    seen = made.seen
    doubts = doubted_people(
        seen.observations, made.views, made.result, seen.association.doubts, settings.pixel_sigma
    )
    return RobustFlight(
        cameras,
        seen.found,
        seen.association.choice,
        seen.observations,
        seen.sides,
        made.views,
        made.result,
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
) -> dict[str, Any]:
    """Collect the clock offsets of all steps and their standard deviations; empty without unknown clocks."""
    if clocks is None:
        return {}
    offset_s, sigma_s = clocks.offset_s, clocks.sigma_s
    names = [camera.name for camera in cameras]
    if refined is not None and refined.cameras is not None:
        later, sigmas = (
            np.array([refined.metrics[part][name] for name in names])
            for part in ("clock_offsets_s", "clock_offset_sigmas_s")
        )
        offset_s = offset_s + later
        sigma_s = sigmas if sigmas.any() else sigma_s  # else they were held
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


def _observe(flight: LoadedFlight, cameras: list[Camera], settings: ReconstructSettings) -> _Seen:
    """Associate people, interpolate their keypoints to common times, and correct left-right swaps."""
    between, pixel_sigma = flight.description.pose_interpolation, settings.pixel_sigma
    found, association, sigma = find_people(
        cameras,
        between,
        flight.actors,
        people=settings.people if isinstance(settings.people, int) else None,
        pixel_sigma=pixel_sigma,
        scene=Surroundings(flight.ground, np.array([camera.field for camera in cameras])),
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
    pixel_sigma: float = ReconstructSettings.pixel_sigma,
    scene: Surroundings | None = None,
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
    settings: ReconstructSettings,
) -> tuple[list[Camera], dict[str, Any], list[str]]:
    errors = _stated_errors(cameras, description, settings)
    return refine_cameras(cameras, followed, errors, between=description.pose_interpolation)


def _stated_errors(
    cameras: Sequence[Camera], description: Description, settings: ReconstructSettings
) -> list[PoseErrors | None]:
    """Load the errors of each camera's log that were stated; None where nobody did."""
    stated = [load_pose_errors(description, [camera], settings.pose_noise) for camera in cameras]
    return [None if of is None else of[0] for of in stated]


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


def refuse_doubted(folder: Path, doubts: Sequence[Mapping[str, Any]], *, strict: bool) -> None:
    """Refuse a flight with a doubt if `strict`."""
    if strict and doubts:
        first = Doubt.model_validate(doubts[0])
        more = f", the first of {len(doubts)} doubts" if len(doubts) > 1 else ""
        remedy = "; ".join(first.instructions)
        raise DataError(folder, f"is doubted: {first.what} ({first.code}){more}", remedy, code="doubted")


def unused_cameras(cameras: list[Camera], result: Triangulation) -> list[str]:
    """Write a warning for cameras without inliers: wrong place, wrong time, or another person."""
    used = np.atleast_1d(result.inlier.any(axis=0))
    return [
        f"{camera.name}: none of its views was used"
        for camera, any_used in zip(cameras, used, strict=True)
        if not any_used
    ]
