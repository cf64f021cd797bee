"""Method `refined` for a flight: from cameras and the people's detections to a skeleton, poses and clocks.

The refinement starts from `robust` and ends with it: `robust` with the corrected poses decides which views
are inliers and which joints are reconstructed. Positions and covariances are those of the estimate.

A long flight is estimated in windows, because memory grows with their length. Neighbours overlap. About the
middle of the overlap the result goes over from one window to the other by a polynomial whose first two
derivatives are continuous, so that speeds and accelerations are. The covariance of such a mean
a X + (1 - a) Y is taken as a Cov X + (1 - a) Cov Y, which is its upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import WHITE_SHARE, PoseErrors
from pipelines.geometry.triangulation import (
    PIXEL_SIGMA_PX,
    ROWS_AT_ONCE,
    STATUS,
    Triangulation,
    Views,
    estimate_noise,
    reprojection_px,
    rows_of,
    triangulate,
    triangulate_pictures,
)
from pipelines.reconstruction.body_fit import landmarks_of
from pipelines.reconstruction.clocks import (
    FINE_STEP_S,
    MIN_OFFSET_BY_PEOPLE_S,
    MIN_SIGMAS_BY_PEOPLE,
    QUESTIONED_SIGMA_S,
    SEARCH_STEP_S,
    FoundClocks,
    meeting_best,
    searched_offsets_s,
    wrong_clocks,
)
from pipelines.reconstruction.observations import (
    Camera,
    Candidates,
    Observations,
    observe,
    on_sides,
    poses_of_cameras,
    sightings_of,
)
from pipelines.reconstruction.one_camera import STATED_STATURE_SIGMA_M, STATURE_M
from pipelines.reconstruction.picture_map import LIMB_SIGMA_SHARE
from pipelines.reconstruction.refinement.refine import SETTLED_S, Refined, corrected, refine
from pipelines.reconstruction.refinement.system import Sighting, UsualSize
from pipelines.reconstruction.results import poses_table
from pipelines.reconstruction.solving import MIN_SIGMA_M, pictures_of, position_sigma_m
from pipelines.session.description import Interpolation
from pipelines.session.parallel import Waiting, available_bytes, each_part
from pipelines.session.people import bones_of

# The search for clock offsets uses at most so many times of the skeleton; more find no other offset.
_SEARCHED = 300
# In a long flight it uses the middle: means over `LASTING_S` need times that are near each other.
_LONGEST_SEARCH_STEP_S = 0.5
# Clocks are moved at most so often; offsets of 0.2 s took one to five times.
_MOST_SHIFTS = 6
# A clock is determined if its posterior sigma is below this share of its prior sigma.
_UNDETERMINED = 0.5
# Fewer joints of limbs show no clock; then all joints are taken.
_FEWEST_LIMBS = 6
# The 75th percentile of a person's residuals: right views of half of a flight hide no others.
_WORST = 75.0
# People whose squared residuals exceed the first person's by this factor are doubted.
_LARGEST_RATIO = 2.0
# The joint estimate of three minutes of two cameras takes less than 1 GB.
MAX_WINDOW_S = 180.0
# Memory grows with the keypoints, and these take less than 1 GB.
MAX_KEYPOINTS = 280_000
# The levels of errors cannot be learned from a shorter window, however many keypoints it has.
MIN_WINDOW_S = 30.0
# Neighbours share this time, so that the ends of both are not used.
OVERLAP_S = 10.0
# The result goes over from one window to the next within this time.
BLENDED_S = 6.0
# Pictures of other cameras are needed this long before and after the times of a window.
AROUND_S = 2.0
# Unknown clocks are those of the whole flight: so many windows determine them.
CLOCK_WINDOWS = 3
# A process that estimates a window takes so much memory.
WINDOW_BYTES = 1 << 30

_OF_LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")  # ends of the names of limbs' joints
_HEAD = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")  # as rigid as a bone


@dataclass(frozen=True)
class RobustFlight:
    """Result of `robust` for one flight, with the uncertainties of its inputs."""

    cameras: Sequence[Camera]  # all of them
    found: Candidates  # every detection, at the times at which people were associated
    choice: Int64  # [T', C, P] each person's detection, see `observe`
    observations: Observations  # at the skeleton's times, on those sides
    sides: Int64  # [T, P, J, C] the joint whose view belongs to each joint, -1 for none, see `on_sides`
    views: Views  # the same, one row for each joint-frame
    result: Triangulation  # `robust` of the views
    prior: Sequence[PoseErrors] | None  # of each camera's pose; None without stated noise
    measured: bool  # the prior was measured, and not only stated
    clock_sigma_s: Float  # [C] prior standard deviation of each clock offset, 0 for a known clock
    between: Interpolation  # rules for interpolating between logged poses
    workers: int  # see `_refine_in_windows`
    executor: Executor | None  # works on the windows instead
    trusted: Bool  # [P] people who determine cameras and clocks; the others are triangulated afterwards
    stature_m: float | None = None  # of the people, as stated
    only_limbs: bool = False  # other joints are not refined
    waiting: Waiting = field(default_factory=Waiting)  # where large arrays wait

    @cached_property
    def windows(self) -> list[FlightWindow]:
        """Windows of the flight; some of them to find clocks."""
        _, people, joints, cameras = self.observations.confidence.shape
        windows = windows_of(self.t_s, people * joints * cameras)
        return spread(windows) if self.only_limbs else windows

    @property
    def limbs(self) -> Bool:
        """Joints [J] of limbs, if enough of them have names; else all joints."""
        limbs = np.array([name.endswith(_OF_LIMBS) for name in self.observations.joints])
        return limbs if limbs.sum() >= _FEWEST_LIMBS else np.ones_like(limbs)

    @property
    def start(self) -> Float:
        """Points [T, P, J, 3] m of `robust`."""
        return self.result.points.reshape(*self.observations.confidence.shape[:3], 3)

    @property
    def t_s(self) -> Float:
        """Seconds [T] since the skeleton's first time."""
        seconds: Float = (self.observations.t_ns - self.observations.t_ns[0]) / 1e9
        return seconds


@dataclass(frozen=True)
class RefinedFlight:
    """Result of the refinement for one flight; its inputs after a fallback."""

    observations: Observations
    views: Views
    result: Triangulation
    cameras: pd.DataFrame | None  # t_ns, camera and pose of every picture; None after a fallback
    metrics: dict[str, Any]
    warnings: list[str]


def doubted_people(
    observations: Observations, views: Views, result: Triangulation, doubts: Sequence[str]
) -> list[str]:
    """Say of each person [P] why they must not determine cameras and clocks; "" for those who do.

    Views that show different things pull their cameras. Pose errors move all people of a picture by about the
    same, so what a person's joints have in common in each picture is compared with the first person who is
    not doubted ("residual" if views disagree too much). `doubts` are causes that are known. If everybody is
    doubted, nobody is.
    """
    if len(doubts) == 1:
        return [""]
    shape = observations.confidence.shape
    away = result.points[:, None] - views.position[views.pose_index]
    x, y, depth = np.einsum("ncij,nci->jnc", views.rotation[views.pose_index], away)
    ahead = np.where((depth > 0) & (views.weight > 0), depth, np.nan)
    missed = (np.stack([x / ahead, y / ahead], axis=-1) - views.rays) * views.focal[:, None]
    missed = missed.reshape(*shape, 2)
    unseen: Bool = np.asarray(np.isnan(missed).all(axis=2, keepdims=True))
    common = np.nanmedian(np.where(unseen, 0.0, missed), axis=2)  # [T, P, C, 2] px
    count = (~unseen[:, :, 0, :, 0]).sum(axis=-1)
    squares = np.where(count > 1, (common**2).sum(axis=(-2, -1)) / np.maximum(2 * count - 3, 1), np.inf)
    met = (observations.confidence > 0).any(axis=2).sum(
        axis=-1
    ) > 1  # and of these, all joints may be refused
    levels = [
        float(np.percentile(own[seen], _WORST)) if seen.any() else np.inf
        for own, seen in zip(squares.T, met.T, strict=True)
    ]
    sure = [level for level, doubt in zip(levels, doubts, strict=True) if not doubt and np.isfinite(level)]
    if not sure:
        return [""] * len(levels)
    most = _LARGEST_RATIO * max(sure[0], PIXEL_SIGMA_PX**2)
    return [
        doubt or ("residual" if level > most else "") for level, doubt in zip(levels, doubts, strict=True)
    ]


def refine_flight(flight: RobustFlight) -> RefinedFlight:
    """Refine the result of `robust` for a flight."""
    refined, offset_s = _settle_clocks(flight, np.zeros(len(flight.cameras)))
    warnings = [*refined.warnings, *_unsettled_clocks(refined, flight.cameras)]
    metrics = _metrics(refined, flight, offset_s)
    if refined.fallback is not None:
        warnings.append(f"refined: fell back to robust, because {refined.fallback}")
        return RefinedFlight(flight.observations, flight.views, flight.result, None, metrics, warnings)

    observed, views = _observe_refined(refined, flight, offset_s)
    result = _gated(views, refined.position.reshape(-1, 3), refined.covariance.reshape(-1, 3, 3))
    return RefinedFlight(observed, views, result, _camera_table(flight, refined, offset_s), metrics, warnings)


def _gated(views: Views, points: Float, covariance: Float) -> Triangulation:
    """Refuse points [N, 3] m where `robust` does, and take its own where they are NaN.

    They and their covariances [N, 3, 3] become the result: those of a long flight are not in memory twice.
    """
    parts = []
    for first in range(0, max(len(points), 1), ROWS_AT_ONCE):
        own = slice(first, first + ROWS_AT_ONCE)
        seen = rows_of(views, own)
        gated = triangulate(seen, method="robust")
        other = (gated.status != STATUS.index("ok")) | np.isnan(points[own, 0])
        points[own][other], covariance[own][other] = gated.points[other], gated.covariance[other]
        parts.append((gated.inlier, gated.status, gated.views, reprojection_px(seen, points[own])))
    inlier, status, count, residual_px = map(np.concatenate, zip(*parts, strict=True))
    return Triangulation(points, inlier, status, covariance, count, residual_px)


# --- clocks --------------------------------------------------------------------------------------------


def find_clocks(flight: RobustFlight, stated: Bool) -> FoundClocks:
    """Find the clock offsets of a flight: by the refinement, or by its search alone where that is refused.

    Limbs are enough for that: fingers and faces move with them, and would take most of the time.

    A clock that rays do not show, because nobody moves, is held. So is one whose offset nobody stated (False
    in `stated` [C]) unless the search finds a whole step: lasting keypoint errors can pull a right clock by
    many standard deviations, by 40 ms in a real recording with synchronised cameras.
    """
    unknown_s, names = flight.clock_sigma_s, [camera.name for camera in flight.cameras]
    views_at, rows = _views_at(flight, unknown_s > 0)
    searched_s, shown = searched_offsets_s(views_at, flight.t_s[rows], unknown_s)
    searched_s = np.where(stated | (np.abs(searched_s) >= SEARCH_STEP_S), searched_s, 0.0)
    prior_s = np.where(shown & (stated | (searched_s != 0)), unknown_s, 0.0)
    offset_s, sigma_s = searched_s, np.where(shown, np.minimum(FINE_STEP_S, prior_s), stated * unknown_s)
    if prior_s.any():
        limbs = replace(flight, clock_sigma_s=prior_s, only_limbs=True)
        refined, settled_s = _settle_clocks(limbs, searched_s)
        settled = (prior_s > 0) & (np.abs(settled_s - searched_s) < SEARCH_STEP_S)
        settled &= refined.fallback is None
        offset_s = np.where(settled, settled_s, searched_s)
        sigma_s = np.where(settled, refined.clock_sigma_s, sigma_s)
        prior_s = np.where(settled, prior_s, 0.0)
    undetermined = np.array(names)[sigma_s > _UNDETERMINED * unknown_s].tolist()
    return FoundClocks(offset_s, sigma_s, prior_s, undetermined=tuple(undetermined))


def find_wrong_clocks(flight: RobustFlight, questioned: Bool, held: Bool, reference: str) -> FoundClocks:
    """Find which `questioned` [C] of the `held` [C] clocks rays contradict; `reference` is right."""
    none = np.zeros(len(held))
    offset_s, names = none.copy(), [camera.name for camera in flight.cameras]
    if held.sum() > 1:
        views_at, rows = _views_at(flight, np.ones_like(held))
        beside = [name for name, kept in zip(names, held, strict=True) if kept]
        offset_s[held] = wrong_clocks(
            lambda shift_s: views_at(shift_s).of(held),
            flight.t_s[rows],
            questioned[held],
            beside.index(reference) if reference in beside else 0,
        )
    suspect = offset_s != 0
    if not suspect.any():
        return FoundClocks(none, none, none)
    limbs = replace(flight, clock_sigma_s=QUESTIONED_SIGMA_S * suspect, only_limbs=True)
    refined, settled_s = _settle_clocks(limbs, offset_s)
    settled = suspect & (refined.fallback is None) & (np.abs(settled_s - offset_s) < SEARCH_STEP_S)
    offset_s = np.where(settled, settled_s, offset_s)
    sigma_s = np.where(settled, refined.clock_sigma_s, FINE_STEP_S)
    least_s = np.maximum(MIN_OFFSET_BY_PEOPLE_S, np.where(settled, MIN_SIGMAS_BY_PEOPLE * sigma_s, 0.0))
    wrong = suspect & (np.abs(offset_s) >= least_s)
    if any(position_sigma_m(errors) >= MIN_SIGMA_M for errors in flight.prior or ()):
        wrong &= settled  # rays of places that are metres off meet better at other times
    offset_s, sigma_s = np.where(wrong, [offset_s, sigma_s], 0.0)
    return FoundClocks(
        offset_s, sigma_s, none, wrong=dict.fromkeys(np.array(names)[wrong].tolist(), "keypoints")
    )


def late_logs(flight: RobustFlight, offset_s: Float, known: Bool) -> Bool:
    """Find the cameras [C] whose log is late, or early, and not their pictures.

    Their pictures were moved by `offset_s` [C], 0 for others, until backgrounds turn as logs do. So they do
    with the log moved back; then the rays of people meet those of cameras with `known` clocks [C] better.
    """
    held = np.zeros(len(offset_s), dtype=np.bool_)
    if known.sum() < 2:
        return held
    times_s = flight.t_s[_views_at(flight, held)[1]]

    def views_with(late: Bool) -> Views:
        moved_s = np.zeros(len(known))
        moved_s[known] = np.where(late, offset_s[known], 0.0)
        cameras = with_late_logs(shifted(flight.cameras, -moved_s), moved_s)
        position, rotation = poses_of_cameras(cameras, flight.found.t_ns, flight.between)
        found = replace(flight.found, position=position, rotation=rotation)
        return _views_at(replace(flight, cameras=cameras, found=found), held)[0](0.0).of(known)

    late = held.copy()
    late[known] = meeting_best(views_with, offset_s[known] != 0, times_s)
    return late


def _views_at(flight: RobustFlight, moved: Bool) -> tuple[Callable[[float], Views], slice]:
    """Return a function from a shift (s) of some clocks [C] to views at some times, and these."""
    times = len(flight.observations.t_ns)
    step_s = float(np.median(np.diff(flight.t_s))) if times > 1 else 1.0
    every = max(min(-(-times // _SEARCHED), int(_LONGEST_SEARCH_STEP_S / step_s)), 1)
    left_out = max(times - every * _SEARCHED, 0)
    rows = slice(left_out // 2, times - (left_out - left_out // 2), every)

    def views_at(shift_s: float) -> Views:
        observed, views = _observe_with_offsets(flight, np.where(moved, shift_s, 0.0), rows)
        weight = np.where(flight.trusted[:, None, None], observed.confidence, 0.0)
        return replace(views, weight=weight.reshape(views.weight.shape))

    return views_at, rows


def _settle_clocks(flight: RobustFlight, offset_s: Float) -> tuple[Refined, Float]:
    """Refine until the clocks settle; return the refinement and the total clock offsets [C] s.

    A picture is joined to the three times nearest to its stamp, which is not accurate for large offsets.
    Also, estimated levels of pose noise absorb part of a large offset. So the stamps are shifted by the
    estimated offsets, and the refinement is repeated until the remaining correction is small, or smaller than
    its standard deviation. The clocks of a long flight are found in some of its windows.
    """
    started = _start_with_offsets(flight, offset_s) if offset_s.any() else flight.start
    if len(flight.windows) > 1 and flight.clock_sigma_s.any() and not flight.only_limbs:
        settled, offset_s = _settle_clocks(replace(flight, only_limbs=True), offset_s)
        held = replace(flight, clock_sigma_s=np.zeros_like(offset_s))
        refined = _refine_with_offsets(held, offset_s, _start_with_offsets(flight, offset_s))
        return replace(refined, clock_sigma_s=settled.clock_sigma_s), offset_s
    before_s = np.zeros_like(offset_s)
    for _ in range(1 + _MOST_SHIFTS):
        refined = _refine_with_offsets(flight, offset_s, started)
        # This estimate had a prior with mean 0 at the shifted stamps. The stated one has mean 0 at the given
        # stamps, so it draws offsets back, the more the less pictures determine them.
        kept = np.square(
            refined.clock_sigma_s / np.where(flight.clock_sigma_s > 0, flight.clock_sigma_s, np.inf)
        )
        moved_s = refined.clock_offset_s - kept * offset_s
        moved_s = np.where(moved_s * before_s < 0, moved_s / 2, moved_s)  # offsets that swing to and fro
        offset_s, before_s = offset_s + moved_s, moved_s
        if (np.abs(moved_s) <= np.maximum(SETTLED_S, refined.clock_sigma_s)).all():
            break
        started = _start_with_offsets(flight, offset_s)
    return refined, offset_s


def _refine_with_offsets(flight: RobustFlight, offset_s: Float, started: Float) -> Refined:
    """Run the refinement with these clock offsets, starting from these points [T, P, J, 3]."""
    _, people, joints, _ = flight.observations.confidence.shape
    cameras = shifted(flight.cameras, offset_s)
    start = np.where(flight.trusted[:, None, None], started, np.nan)
    if flight.only_limbs:
        start = np.where(flight.limbs[:, None], start, np.nan)
    sightings = [_sighting(flight, c, camera) for c, camera in enumerate(cameras)]
    flight.waiting.release()
    order = _Order(
        flight.t_s,
        sightings,
        start.reshape(-1, people * joints, 3),
        rigid_pairs(flight.observations.joints, people),
        flight.prior,
        flight.clock_sigma_s,
        flight.measured,
        usual_size(flight.observations.joints, people, flight.stature_m),
    )
    return _refine_in_windows(order, flight.windows, flight.workers, flight.executor, flight.waiting)


def _start_with_offsets(flight: RobustFlight, offset_s: Float) -> Float:
    """Triangulate by `robust` with these clock offsets, window by window: [T, P, J, 3] m, NaN outside."""
    start = np.full((*flight.observations.confidence.shape[:3], 3), np.nan)
    for window in flight.windows:
        own = slice(window.first, window.stop)
        observed, views = _observe_with_offsets(flight, offset_s, own)
        found = triangulate_pictures(
            replace(views, pixel_sigma=estimate_noise(views)),
            picture=pictures_of(observed),
            pixel_sigma=np.full(len(flight.cameras), PIXEL_SIGMA_PX),
        )
        start[own] = found.points.reshape(-1, *start.shape[1:])
    return start


def _unsettled_clocks(refined: Refined, cameras: Sequence[Camera]) -> list[str]:
    """List clocks that the last estimate still moved."""
    return [
        f"refined: the clock of {camera.name} did not settle: the last of {1 + _MOST_SHIFTS} estimates still "
        f"moved it by {1e3 * abs(left):.1f} ms"
        for camera, left, sigma in zip(cameras, refined.clock_offset_s, refined.clock_sigma_s, strict=True)
        if refined.fallback is None and abs(left) > max(SETTLED_S, sigma)
    ]


# --- observations with other clocks and poses -----------------------------------------------------------


def _observe_with_offsets(
    flight: RobustFlight, offset_s: Float, times: slice = slice(None)
) -> tuple[Observations, Views]:
    """Observe with these clock offsets, at some times of the skeleton."""
    cameras = shifted(flight.cameras, offset_s)
    t_ns, sides = flight.observations.t_ns[times], flight.sides[times]
    observed = observe(cameras, flight.found, flight.choice, t_ns, flight.between, sides)
    rows = sides[..., 0].size
    return observed, replace(
        flight.views,
        rays=observed.rays.reshape(rows, len(cameras), 2),
        weight=observed.confidence.reshape(rows, len(cameras)),
        pose_index=flight.views.pose_index[:rows],
        position=observed.position,
        rotation=observed.rotation,
        pose_sigma=flight.views.pose_sigma[times],
    )


def _observe_refined(refined: Refined, flight: RobustFlight, offset_s: Float) -> tuple[Observations, Views]:
    """Observe with these clock offsets and the corrected poses, which count as exact."""
    observed, views = (
        _observe_with_offsets(flight, offset_s) if offset_s.any() else (flight.observations, flight.views)
    )
    views = replace(views, pixel_sigma=np.full(len(flight.cameras), PIXEL_SIGMA_PX))
    views = _with_corrected_poses(views, refined, flight.t_s)
    return replace(observed, position=views.position, rotation=views.rotation), views


def _with_corrected_poses(views: Views, refined: Refined, t_s: Float) -> Views:
    """Correct the poses [T] of views, which count as exact then, and estimate the noise of pixels."""
    position, rotation = views.position.copy(), views.rotation.copy()
    for c, correction in enumerate(refined.corrections):
        numbers = _numbers_at(correction, t_s - refined.clock_offset_s[c])
        position[:, c], rotation[:, c] = corrected(position[:, c], rotation[:, c], numbers)
    views = replace(views, position=position, rotation=rotation, pose_sigma=np.zeros_like(views.pose_sigma))
    return replace(views, pixel_sigma=estimate_noise(views))


def shifted(cameras: Sequence[Camera], offset_s: Float) -> list[Camera]:
    """Return the cameras with their clocks moved forward by offsets [C] s."""
    return [
        replace(camera, frame_t_ns=camera.frame_t_ns + round(1e9 * offset))
        for camera, offset in zip(cameras, offset_s, strict=True)
    ]


def with_clocks(cameras: Sequence[Camera], clocks: FoundClocks) -> list[Camera]:
    """Return the cameras with the found clocks of their pictures, and of their logs."""
    late_s = np.array([clocks.late_logs_s.get(camera.name, 0.0) for camera in cameras])
    return with_late_logs(shifted(cameras, clocks.offset_s), late_s)


def with_late_logs(cameras: Sequence[Camera], late_s: Float) -> list[Camera]:
    """Return the cameras with the times of their logs moved back by [C] s."""
    logs = [
        replace(camera.trajectory, t_ns=camera.trajectory.t_ns - round(1e9 * seconds))
        for camera, seconds in zip(cameras, late_s.tolist(), strict=True)
    ]
    return [replace(camera, trajectory=log) for camera, log in zip(cameras, logs, strict=True)]


def _sighting(flight: RobustFlight, c: int, camera: Camera) -> Sighting:
    """Build the sighting of camera `c`, its clock shifted, in its pictures, all people side by side."""
    t_ns, frame_t_ns = flight.observations.t_ns, camera.frame_t_ns
    nearest = np.searchsorted((t_ns[:-1] + t_ns[1:]) // 2, frame_t_ns)
    seen = sightings_of(camera, flight.found, c, flight.choice[:, c])
    rays, confidence = on_sides(*seen, flight.sides[nearest][..., c])
    position, rotation = camera.poses_at(frame_t_ns, flight.between)
    return Sighting(
        t_s=(frame_t_ns - t_ns[0]) / 1e9,
        rays=rays.reshape(len(frame_t_ns), -1, 2),
        confidence=np.nan_to_num(confidence.reshape(len(frame_t_ns), -1)),
        position=position,
        rotation=rotation,
        focal_px=camera.focal_px,
        pixel_sigma=PIXEL_SIGMA_PX,
        pose_covariance=None if flight.prior is None else white_covariance(camera, flight.prior[c]),
        loosened=None if camera.loosened is None else camera.loosened_at(frame_t_ns),
    )


def white_covariance(camera: Camera, prior: PoseErrors) -> Float | None:
    """Return covariances [F, 6, 6] of the white error of each picture's pose; None if not in the log."""
    if not prior.logged:
        return None
    logged = replace(camera, loosened=None).covariance_at(camera.frame_t_ns)
    return None if logged is None else WHITE_SHARE * logged


def rigid_pairs(joints: tuple[str, ...], people: int) -> Int64:
    """List pairs of joints [B, 2] with a nearly constant distance: bones, and the points of the head.

    Shoulders come nearer to the hips where a person bends, so the trunk is no bone.
    """
    number = {name: index for index, name in enumerate(joints)}
    head = [number[name] for name in _HEAD if name in number]
    bones = [pair for pair in bones_of(joints) if not _is_of_trunk(*pair)]
    pairs = {(number[a], number[b]) for a, b in bones} | {(i, j) for i in head for j in head}
    own = np.array(sorted({(min(p), max(p)) for p in pairs if p[0] != p[1]}), dtype=np.int64).reshape(-1, 2)
    return np.concatenate([own + person * len(joints) for person in range(people)])


def usual_size(joints: tuple[str, ...], people: int, stature_m: float | None) -> UsualSize | None:
    """Return the usual sizes of people by their legs among the rigid pairs; None without known landmarks."""
    found = landmarks_of(joints)
    if found is None:
        return None
    stature, sigma_m = STATURE_M if stature_m is None else (stature_m, STATED_STATURE_SIGMA_M)
    rest = dict(zip(found[0].joints, stature * found[0].at_rest, strict=True))
    pairs = [(joints[first], joints[second]) for first, second in rigid_pairs(joints, 1).tolist()]
    lengths = [
        float(np.linalg.norm(rest[a] - rest[b])) if "knee" in a + b and {a, b} <= {*rest} else 0.0
        for a, b in pairs
    ]
    of_all: Float = np.kron(np.eye(people), np.array(lengths))
    return UsualSize(of_all, float(np.hypot(LIMB_SIGMA_SHARE, sigma_m / stature)))


def _is_of_trunk(one: str, other: str) -> bool:
    ends = {name.removeprefix("left_").removeprefix("right_") for name in (one, other)}
    return "hip" in ends and not ends.isdisjoint(("neck", "shoulder"))


def _numbers_at(correction: tuple[Float, Float], t_s: Float) -> Float:
    """Interpolate the ten numbers [N, 10] of a camera to other times; constant outside its pictures."""
    when, numbers = correction
    if not len(when):
        return np.zeros((len(t_s), 10))
    return np.stack([np.interp(t_s, when, column) for column in numbers.T], axis=1)


# --- windows -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlightWindow:
    """A stretch of a flight."""

    first: int  # of the skeleton's times
    stop: int
    begin_s: float  # where it takes over from the window before; -inf for the first
    end_s: float

    def shares(self, t_s: Float) -> Float:
        """Compute its weight [T] in the result at given times: 1 in the middle, 0 outside."""
        return _risen(t_s - self.begin_s) * (1.0 - _risen(t_s - self.end_s))


def windows_of(t_s: Float, keypoints: int) -> list[FlightWindow]:
    """Divide the times [T] of so many keypoints into windows of equal length; a short flight is one."""
    duration_s = float(t_s[-1] - t_s[0])
    by_memory = min(len(t_s) * keypoints / MAX_KEYPOINTS, duration_s / MIN_WINDOW_S)
    count = int(np.ceil(max(duration_s / MAX_WINDOW_S, by_memory, 1.0)))
    edges = t_s[0] + np.linspace(0.0, duration_s, count + 1)
    edges[0], edges[-1] = -np.inf, np.inf
    reach_s = OVERLAP_S / 2
    found = []
    for begin_s, end_s in pairwise(edges.tolist()):
        first, stop = np.searchsorted(t_s, (begin_s - reach_s, end_s + reach_s)).tolist()
        found.append(FlightWindow(first, stop, begin_s, end_s))
    return found


def spread(windows: Sequence[FlightWindow]) -> list[FlightWindow]:
    """Choose the windows that determine the clocks."""
    rows = np.linspace(0, len(windows) - 1, min(CLOCK_WINDOWS, len(windows))).round().astype(int)
    return [windows[row] for row in rows.tolist()]


@dataclass(frozen=True)
class _Order:
    """Arguments of `refine`."""

    t_s: Float
    sightings: Sequence[Sighting]
    start: Float
    bones: Int64
    prior: Sequence[PoseErrors] | None
    clock_sigma_s: Float
    measured: bool
    size: UsualSize | None

    def within(self, window: FlightWindow) -> _Order:
        """Take the data of a window."""
        own = slice(window.first, window.stop)
        t_s = self.t_s[own]
        around = t_s[0] - AROUND_S, t_s[-1] + AROUND_S
        later_s = float(t_s[0] - self.t_s[0])
        return replace(
            self,
            t_s=t_s,
            sightings=[_within(sighting, *around) for sighting in self.sightings],
            start=self.start[own],
            prior=None if self.prior is None else [errors.later(later_s) for errors in self.prior],
        )


def _refine_in_windows(
    whole: _Order,
    windows: Sequence[FlightWindow],
    workers: int,
    executor: Executor | None,
    waiting: Waiting,
) -> Refined:
    """Run `refine` on some windows, and join the results: medians of clocks, NaN joints where none is."""
    if len(windows) == 1 and windows[0].stop - windows[0].first == len(whole.t_s):
        return _refine(whole)
    if executor is None:
        memory = available_bytes()
        workers = workers if memory is None else min(workers, max(memory // WINDOW_BYTES, 1))
    orders = [whole.within(window) for window in windows]
    joined = _Joined(whole, waiting)
    parts: list[Refined | None] = [None] * len(windows)
    for number, found in waiting.between(each_part(_refine, orders, workers=workers, executor=executor)):
        joined.add(windows[number], found)
        parts[number] = replace(found, position=whole.start[:0], covariance=whole.start[:0], corrections=())
    return joined.refined([part for part in parts if part is not None])


def _refine(order: _Order) -> Refined:
    return refine(**vars(order))


class _Joined:
    """Weighted sums over windows; at most two contribute to a time, so that their order does not count."""

    def __init__(self, whole: _Order, waiting: Waiting) -> None:
        self._t_s, shape = whole.t_s, whole.start.shape
        self._weight = np.zeros(shape[:2])
        self._position, self._covariance = waiting.put((np.zeros(shape), np.zeros((*shape, 3))))
        self._frames = [sighting.t_s for sighting in whole.sightings]
        self._numbers = [np.zeros((len(frames), 11)) for frames in self._frames]  # and their weight

    def add(self, window: FlightWindow, found: Refined) -> None:
        """Add the result of a window, unless it was refused."""
        if found.fallback is not None:
            return
        own = slice(window.first, window.stop)
        there = np.isfinite(found.position[..., 0])
        weight = window.shares(self._t_s[own])[:, None] * there
        self._weight[own] += weight
        self._position[own] += weight[..., None] * np.nan_to_num(found.position)
        self._covariance[own] += weight[..., None, None] * np.nan_to_num(found.covariance)
        for frames, sums, (when, numbers) in zip(self._frames, self._numbers, found.corrections, strict=True):
            shares = window.shares(frames)
            (used,) = np.nonzero(shares)
            for column in range(10 if len(when) else 0):
                sums[used, column] += shares[used] * np.interp(frames[used], when, numbers[:, column])
            sums[used, 10] += shares[used]

    def refined(self, parts: Sequence[Refined]) -> Refined:
        """Return the result of the flight; `parts` have what is no function of time."""
        used = [part for part in parts if part.fallback is None]
        if not used:
            return replace(parts[0], position=np.full_like(self._position, np.nan))
        with np.errstate(invalid="ignore", divide="ignore"):
            self._position /= self._weight[..., None]
            self._covariance /= self._weight[..., None, None]
        numbers = [sums[:, :10] / np.maximum(sums[:, 10:], 1e-12) for sums in self._numbers]
        warnings = dict.fromkeys(line for part in used for line in part.warnings)
        if len(used) < len(parts):
            reason = next(part.fallback for part in parts if part.fallback is not None)
            count = f"{len(parts) - len(used)} of {len(parts)} windows"
            warnings[f"refined: {count} fell back to robust, the first because {reason}"] = None
        names = dict.fromkeys(name for part in used for name in part.levels)
        return replace(
            used[0],
            position=self._position,
            covariance=self._covariance,
            corrections=tuple(zip(self._frames, numbers, strict=True)),
            clock_offset_s=np.median([part.clock_offset_s for part in used], axis=0),
            clock_sigma_s=np.median([part.clock_sigma_s for part in used], axis=0),
            levels={
                name: float(np.mean([part.levels[name] for part in used if name in part.levels]))
                for name in names
            },
            learned=any(part.learned for part in used),
            warnings=tuple(warnings),
        )


def _within(sighting: Sighting, first_s: float, last_s: float) -> Sighting:
    """Take a camera's pictures of a span of time."""
    rows = slice(*np.searchsorted(sighting.t_s, (first_s, last_s)).tolist())
    of_pictures = ("t_s", "rays", "confidence", "position", "rotation", "pose_covariance", "loosened")
    values = {name: getattr(sighting, name) for name in of_pictures}
    return replace(sighting, **{name: value[rows] for name, value in values.items() if value is not None})


def _risen(late_s: Float) -> Float:
    u = np.clip(late_s / BLENDED_S + 0.5, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2), dtype=np.float64)


# --- reporting ------------------------------------------------------------------------------------------


def _metrics(refined: Refined, flight: RobustFlight, offset_s: Float) -> dict[str, Any]:
    used, cameras = refined.fallback is None, flight.cameras
    learned = refined.learned or flight.prior is None
    offsets, sigmas = (
        {camera.name: float(value) if used else 0.0 for camera, value in zip(cameras, values, strict=True)}
        for values in (offset_s, refined.clock_sigma_s)
    )
    return {
        "clock_offsets_s": offsets,
        "clock_offset_sigmas_s": sigmas,
        "refinement": {
            "fallback": refined.fallback,
            "pose_noise": "estimated" if learned else "stated",
            "levels": refined.levels,
            "bone_lengths_m": refined.bone_lengths_m.tolist() if used else [],
        },
    }


def _camera_table(flight: RobustFlight, refined: Refined, offset_s: Float) -> pd.DataFrame:
    """Build the table of corrected poses of every picture that has one."""
    cameras = shifted(flight.cameras, offset_s)
    poses = []
    for c, camera in enumerate(cameras):
        t_s = (camera.frame_t_ns - flight.observations.t_ns[0]) / 1e9 - refined.clock_offset_s[c]
        logged = camera.poses_at(camera.frame_t_ns, flight.between)
        poses.append(corrected(*logged, _numbers_at(refined.corrections[c], t_s)))
    return poses_table(cameras, poses)


# --- cameras that share their times --------------------------------------------------------------------


def refined_points(
    views: Views,
    t_s: Float,
    joints: tuple[str, ...],
    prior: Sequence[PoseErrors],
    *,
    measured: bool = False,
) -> tuple[Views, Float, str | None]:
    """Estimate the points of one person in moving cameras with right clocks, by `refined`.

    Where that is refused, `robust` stays. Views are N = T * J joint-frames, joints fastest, with a row of
    poses for each of the T times; the `prior` of each camera's pose errors was `measured` if its background
    corrected its poses. Return the views with estimated noise and corrected poses, points [N, 3] m (NaN:
    none), and the reason of a fallback.
    """
    times, cameras = views.position.shape[:2]
    noisy = replace(views, pixel_sigma=estimate_noise(views))
    start = triangulate_pictures(noisy, picture=views.pose_index, pixel_sigma=views.pixel_sigma).points
    sightings = [
        Sighting(
            t_s=t_s,
            rays=views.rays[:, c].reshape(times, -1, 2),
            confidence=views.weight[:, c].reshape(times, -1),
            position=views.position[:, c],
            rotation=views.rotation[:, c],
            focal_px=float(views.focal[c]),
            pixel_sigma=float(views.pixel_sigma[c]),
        )
        for c in range(cameras)
    ]
    found = refine(
        t_s,
        sightings,
        start.reshape(times, len(joints), 3),
        rigid_pairs(joints, 1),
        prior,
        np.zeros(cameras),
        measured=measured,
    )
    if found.fallback is not None:
        return noisy, start, found.fallback
    moved = _with_corrected_poses(views, found, t_s)
    gated = triangulate(moved, method="robust")
    refined = found.position.reshape(-1, 3)
    ok = (gated.status == STATUS.index("ok")) & np.isfinite(refined[:, 0])
    return moved, np.where(ok[:, None], refined, gated.points), None
