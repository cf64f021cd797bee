"""Poses of moving cameras corrected by points of the static background.

Each camera's background is followed through its pictures once (`background_tracks`). Then its poses are
adjusted and replace the logged poses in all later steps. Where the background says nothing, or contradicts
the log, the logged poses stay, with the reason in one line.

One estimate serves far and near points, hovering and flying cameras. A point is a direction and an inverse
depth, which may be 0, so it needs no parallax. A camera that only turns gets the changing part of its
attitudes from directions, and their constant part stays at the log's. Where a camera flies, an attitude error
also changes the motion of the background against the logged path. That determines the constant part too,
except about a straight path. The position of the whole path is never determined.

Unknowns are the error of every logged pose and, as its prior, the constant, slow and white errors of the log.
Points are eliminated (Schur complement). A point is followed for about a second and then counts as another
one, so that the normal matrix has a band: the work grows linearly with the pictures. Cauchy's loss handles
points off the background and lost tracks.

Levels of errors that nobody stated are estimated by MacKay's rule, as in `refinement.estimate`. A constant
error is always possible, and one draw of it says little of its level. The position's stays wide; those of a
rotation that the pictures show and of a lever arm count beside usual ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import (
    EXACT,
    ROTATION,
    SHIFT_IN_CAMERA,
    SHIFT_IN_WORLD,
    SURVEYED_M,
    UNKNOWN_SIGMA,
    USUAL_CONSTANT,
    USUAL_COUNT,
    PoseErrors,
    Process,
)
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction.background_kernels import (
    BackgroundPoints,
    BackgroundSightings,
    PosePriorArrays,
    add_ties,
    eliminate_points,
    inverse_in_band,
    move_points,
)
from pipelines.reconstruction.background_tracks import Followed, rays_at_stamps
from pipelines.reconstruction.doubts.turning import common_offset
from pipelines.reconstruction.observations import Camera, ErrorModes
from pipelines.session.description import Interpolation
from pipelines.session.records import Trajectory

STRETCH = 1500
"""Pictures adjusted together: memory stays bounded, and so many poses average their white errors."""

# Neighbouring stretches share a tenth of their pictures on each side, over which one hands over to the next.
_REACH = 10
# Followed points err by 0.15 px, but neighbouring pictures and points share their errors.
_PIXEL_SIGMA = 1.0
# A sighting this many standard deviations off counts half.
_LOSS = 1.0
# Losses that come before it: where logged poses are many pixels off, a narrow one rejects all sightings
# (graduated non-convexity: Blake and Zisserman 1987; Yang et al. 2020).
_WIDE = (30.0, 5.0)
# Attitudes that are further off begin where a search finds them and a stiff path turns them.
_FAR_RAD, _FAR_ROUNDS, _STIFF_STARTS = 0.1, 24, 2
# Two sightings of a point determine its direction and depth and test nothing.
_FEWEST_SIGHTINGS = 3
_LONGEST_S, _LONGEST = 1.0, (12, 30)  # sightings of a point: time, and at least and at most these pictures
# So many points in a picture show relative attitudes to 0.003 deg; more only take time.
_POINTS = 120
# Fewer points bind a picture to the one before too loosely for its attitude.
_FEWEST_SHARED = 8
# A background that loses more of the pictures than this share leaves too much to the log.
_MOST_UNBOUND = 0.2
_KINDS = (slice(0, 3), slice(3, 6))  # of the six numbers of an error: position, rotation
# A start is sought this far from the log, in steps from half of which the least squares converge.
_FARTHEST_DEG, _TRIED_STEP_DEG = 75.0, 15.0
# So many points tell the turns of the search apart; more only take time.
_SEARCHED_POINTS = 1000
# A ray that turned by nearly 90 deg or more has lost its point.
_BEHIND = 0.05
# Points far from where they begin are where cameras see them after so many steps.
_SETTLE_ROUNDS = 8
_INVERSE_DEPTH = np.array([0.0, 0.01])  # mean (1/m) and precision (m^2) of the prior: farther than 1 m
# A static background moves against itself by less.
_WORST_PX = 2.0
_ROUNDS, _CONVERGED = 20, (3e-4, 3e-5)  # m, rad: a tenth of what their posteriors leave
# Poses that are farther from the log than this contradict it.
_SIGMAS = 4.0
# Changing errors that are this much larger are not as stated.
_AS_STATED = 1.3
# A constant rotation error that is larger is said.
_SIGMAS_ASIDE = 5.0
# Slow errors are linear between knots this far apart; what they do in between counts as white.
_KNOT_S = 0.2
# Slow errors are counted over this time in the level of all errors.
_SLOW_S = 10.0
_UNKNOWN_WHITE, _UNKNOWN_RATE = (0.02, UNKNOWN_SIGMA[1]), (0.05, UNKNOWN_SIGMA[1] / 10)
"""Start of estimated levels. White positions that are free by more confuse far and near points at first."""

_UNKNOWN_ARM_M, _USUAL_ARM_M = 0.05, 0.03  # constant shift in the camera: a lever arm that is wrong
# Mounts and compasses of usual drones have a constant error of this angle.
_USUAL_TURN = float(np.radians(0.15))
# A stated level of it counts as so many numbers: errors have Student's distribution, not a normal one.
_STATED_COUNT = 10.0
# No compass and no mount is better than this, whatever is stated.
_LEAST_TURN = float(np.radians(0.05))
# A mount that nobody knows, or a wrong compass, may be off by this.
_ANY_TURN_RAD = 0.5
# Satellite positions that wander by 1.5 m turn the attitudes that backgrounds show by up to 3.5 deg.
_LEAST_ASIDE_RAD = float(np.radians(5.0))
# The level of the constant rotation halves its distance to the fixed point in each of these steps.
_LEVEL_STEPS = 20
# So many draws of the posterior give its levels to 2 %; 32 gave 1.15 m where it was 1.31 m.
_DRAWS = 512
# Multirotors accelerate by this much per axis, so what changes faster in a log is its error.
_ACCELERATION_MPS2 = 5.0
# Levels have settled after so many rounds, or where that of a constant rotation changes by a smaller share.
_LEVEL_ROUNDS, _LEVEL_SETTLED = 6, 0.1
# Errors that grow and bend over a flight are told apart by so many polynomials of time.
_POLYNOMIALS = 4
# MacKay's rule leaps where pictures determine a smaller share of a level's errors.
_LEAST_DETERMINED = 0.3
_LEAST_WHITE, _LEAST_RATE = (1e-3, 1e-4), (1e-4, 1e-5)  # m, rad, and per sqrt(s)
# Fewer pictures do not tell a camera that stands from one that flies.
_FEWEST_STANDING = 8
# The log of a camera that stands moves by less than this many standard deviations of all errors.
_SIGMAS_STANDING = 2.0
# A log that changes by less is that of a surveyed position, or frozen.
_NEVER_MOVES_M = 1e-6
# A camera that only turns leaves residuals of half this size, in the median.
_STANDS_PX = 0.3
# A free path that saves less misfit (px^2) than this fits noise, not parallax.
_STANDS = 0.03
# Slow errors of a camera that stands are read off its log over this time.
_SLOW_LAG_S = 1.0
# So many pictures show the clock; more only take time.
_CLOCK_PICTURES = 600
# Some seconds show an offset of 50 ms by ten standard deviations where a camera turns.
_QUICK_CLOCK_PICTURES = 150
# Stamps are moved at most so often.
_CLOCK_ROUNDS = 8
# An offset has settled when the next change is at most this share of its standard deviation.
_SETTLED = 0.5
# What is left of the offset in each round has this prior standard deviation.
_ANY_CLOCK_S = 0.5
# Rays of people show a clock better than a background that is less sure than this.
_MOST_CLOCK_SIGMA_S = 0.03
_LEAST_TURNING = UNKNOWN_SIGMA[1]  # rms: followed points drift by as much as a hovering camera turns
# The speed of turning is computed over this time before and after a picture.
_RATE_S = 0.1
# Poses of a camera that stands are averaged to at most so many, which bounds the time to solve for its
# place.
_MOST_MEANS = 200
# Slow errors whose variance is a smaller share of the constant one are counted to it.
_SMALL = 0.02
# Few pictures show a clock roughly. A stated one within so many standard deviations needs no closer look.
SIGMAS_TO_LOOK_CLOSER = 3.0


@dataclass(frozen=True)
class PosePrior:
    """Standard deviations per axis of logged pose errors."""

    white: tuple[float, float]  # m, rad: new in every pose
    constant: tuple[float, float, float]  # m in the world, rad, m in the camera
    slow: tuple[Process, Process]  # shift in the world and rotation
    estimated: bool = False  # the levels of white and slow errors are only the start of an estimate
    held: tuple[bool, bool] = (False, False)  # but those of slow positions, rotations were stated
    clock_s: float = 0.0  # of the offset of the pictures' clock, 0 for a known one
    assumed: bool = False  # nobody stated the constant errors either
    usual_turn: float = _USUAL_TURN  # rad: about this the level of constant rotation is estimated; 0: held

    @classmethod
    def of(cls, errors: PoseErrors | None) -> PosePrior:
        """Build the prior from stated pose errors; None for unknown ones.

        Beside a large constant rotation, what nobody stated is estimated: no log is exact in itself.
        """
        unknown = _unknown(SHIFT_IN_WORLD, _UNKNOWN_RATE[0]), _unknown(ROTATION, _UNKNOWN_RATE[1])
        if errors is None:
            return cls(
                _UNKNOWN_WHITE, (*UNKNOWN_SIGMA, _UNKNOWN_ARM_M), unknown, estimated=True, assumed=True
            )
        constant = dict.fromkeys((SHIFT_IN_WORLD, ROTATION, SHIFT_IN_CAMERA), 0.0)
        changing: dict[int, list[Process]] = {SHIFT_IN_WORLD: [], ROTATION: []}
        for process in errors.processes:
            if process.constant:
                constant[process.number] = float(np.hypot(constant[process.number], process.sigma0))
            else:
                changing[ROTATION if process.number == ROTATION else SHIFT_IN_WORLD].append(process)
        whole = (constant[SHIFT_IN_WORLD], constant[ROTATION], constant[SHIFT_IN_CAMERA])
        slow = (_sum(SHIFT_IN_WORLD, changing[SHIFT_IN_WORLD]), _sum(ROTATION, changing[ROTATION]))
        if not any(errors.white) and whole[1] > _FAR_RAD:
            held = bool(changing[SHIFT_IN_WORLD]), bool(changing[ROTATION])
            either = (slow[0] if held[0] else unknown[0], slow[1] if held[1] else unknown[1])
            return cls(_UNKNOWN_WHITE, whole, either, estimated=True, held=held)
        turn = max(whole[1], _LEAST_TURN)
        return cls(errors.white, (whole[0], turn, whole[2]), slow, usual_turn=turn)

    @property
    def changing(self) -> Float:
        """Standard deviation of white and slow parts together [2] (m, rad), slow ones over some seconds."""
        slow = [process.sigma0**2 + process.rate**2 * _SLOW_S for process in self.slow]
        return np.maximum(np.sqrt(np.square(self.white) + slow), EXACT)

    @property
    def level(self) -> Float:
        """Standard deviation of all parts together [2] (m, rad), slow ones over some seconds."""
        return np.hypot(self.changing, [np.hypot(self.constant[0], self.constant[2]), self.constant[1]])


def _unknown(number: int, rate: float) -> Process:
    """Build the stationary process of slow errors that nobody stated, from their rate (per root of s)."""
    return Process(number, rate * float(np.sqrt(_SLOW_S / 2)), correlation_s=_SLOW_S)


def _rate(process: Process) -> float:
    """Compute the rate of a process over short times."""
    return float(np.sqrt(process.rate**2 + 2 * process.sigma0**2 / process.correlation_s))


def _sum(number: int, processes: Sequence[Process]) -> Process:
    """Build one process for the sum of several; that of different kinds is a random walk."""
    if len(processes) == 1:
        return replace(processes[0], number=number)
    sigma2 = sum(process.sigma0**2 for process in processes)
    rate2 = sum(_rate(process) ** 2 for process in processes)
    return Process(number, max(float(np.sqrt(sigma2)), EXACT), float(np.sqrt(rate2)))


@dataclass(frozen=True)
class Adjusted:
    """Poses after adjustment of T pictures."""

    position: Float  # [T, 3] m
    rotation: Float  # [T, 3, 3] world_from_camera
    covariance: Float  # [T, 6, 6] position in the world (m^2), rotation vector in the camera (rad^2), or NaN
    left: PoseErrors | None  # errors that remain; None where refused
    modes: Float  # [T, 6, R] of the errors that remain (`ErrorModes`), but for a constant shift
    shift_m: float  # standard deviation of that shift
    turn: Float  # [3] rad, mean rotation error that was taken off
    prior: PosePrior  # with levels as estimated
    points: int  # that were used
    reprojection_px: float  # median; NaN where there is no solution
    refused: str | None  # reason why the logged poses stay, in one line
    stands: bool = False  # a camera that only turns explains its pictures as well as a free path
    frozen: bool = False  # its logged position never changes, and its pictures do not fit that


@dataclass(frozen=True)
class SeenPoints:
    """K sightings of points of the background in the pictures of a camera."""

    picture: Int64  # [K] row of the pictures
    point: Int64  # [K]
    rays: Float  # [K, 2] undistorted normalised image coordinates

    def between(self, first: int, stop: int) -> SeenPoints:
        """Return those in pictures from `first` to before `stop`."""
        mine = (self.picture >= first) & (self.picture < stop)
        return SeenPoints(self.picture[mine], self.point[mine], self.rays[mine])


@dataclass(frozen=True)
class Background:
    """Background of one camera with T pictures."""

    between: Callable[[int, int], SeenPoints]  # in pictures from the first number to before the second
    focal_px: float
    t_s: Float  # [T]
    loosened: Float | None = None  # [T, 2] m, rad: what logged poses in bad stretches err by besides
    alike: tuple[float, float] = (1.0, 1.0)
    """Pictures between two logged positions, and rotations, which share the white errors of these."""


def adjust(seen: Background, position: Float, rotation: Float, prior: PosePrior) -> Adjusted:
    """Refine logged poses [T, 3] m (NaN: none) and [T, 3, 3] of one camera by its background.

    If a stretch is refused, all logged poses stay. Where nobody stated the noise, a position that never
    changes was surveyed, to `SURVEYED_M`, if pictures fit a camera that only turns; else the log may be
    `frozen`.
    """
    posed = position[np.isfinite(position[:, 0])]
    if not prior.estimated or not len(posed) or np.ptp(posed, axis=0).max() >= _NEVER_MOVES_M:
        return _adjust(seen, position, rotation, prior)
    surveyed = replace(prior, constant=(SURVEYED_M, prior.constant[1], 0.0))  # nor has it a lever arm
    found = _adjust(seen, position, rotation, surveyed)
    if found.refused is None and found.stands and found.reprojection_px < _STANDS_PX:
        return found
    return replace(_adjust(seen, position, rotation, prior), frozen=bool(np.isfinite(found.reprojection_px)))


def _adjust(seen: Background, position: Float, rotation: Float, prior: PosePrior) -> Adjusted:
    posed = np.flatnonzero(np.isfinite(position[:, 0]))

    errors, covariance = np.zeros((len(position), 6)), np.full((len(position), 6, 6), np.nan)

    def refused(reason: str, px: float = np.nan) -> Adjusted:
        modes, (shift_m, *_), turn = np.empty((len(position), 6, 0)), prior.constant, np.zeros(3)
        unknown = np.full_like(covariance, np.nan)
        return Adjusted(position, rotation, unknown, None, modes, shift_m, turn, prior, 0, px, reason)

    if not len(posed):
        return refused("none of its pictures has a pose")
    covariance[posed] = 0.0
    unbound, points, results = 0, 0, []
    parts = np.array_split(posed, -(-len(posed) // STRETCH))
    # What several stretches share of a flight is constant.
    modes = np.zeros((len(position), 6, 6 * (_POLYNOMIALS if len(parts) == 1 else 1)))
    for rows, weight in _overlapping(parts):
        stretch = _Stretch.of(seen, rows, position, rotation)
        unbound += stretch.unbound
        if len(posed) < 2 or unbound > _MOST_UNBOUND * (len(posed) - 1):
            return refused(
                f"{unbound} of {len(posed)} pictures share fewer than {_FEWEST_SHARED} points of the"
                " background with the one before"
            )
        found = stretch.solve_with_levels(prior)
        if found is None:
            return refused("the adjustment did not converge")
        points += len(stretch.points.inverse_depth)
        errors[rows] += weight[:, None] * found.errors
        # The covariance of a mean is at most the mean of covariances, whatever the correlation.
        covariance[rows] += weight[:, None, None] * found.covariance
        modes[rows] += weight[:, None, None] * found.modes[..., : modes.shape[2]]
        results.append(found)
    covariance[posed[:, None], range(3), range(3)] += prior.constant[0] ** 2
    pixels = float(np.median(np.concatenate([found.missed for found in results])))
    if pixels > _WORST_PX:
        return refused(f"the background moves by {pixels:.1f} px against itself", pixels)
    surprise = max(of.surprise(prior.level) for of in results)
    if surprise > _SIGMAS:
        return refused(f"its poses would be {surprise:.0f} standard deviations from the log", pixels)
    left = [_remaining(of.draws, float(np.median(np.diff(seen.t_s))), prior.constant[0]) for of in results]
    return Adjusted(
        *_without(errors, position, rotation),
        covariance,
        # Stretches are alike: the one in the middle speaks for all.
        replace(left[len(left) // 2], assumed=prior.assumed),
        modes,
        float(np.hypot(prior.constant[0], results[len(results) // 2].place_m)),
        errors[posed, 3:].mean(axis=0),
        results[len(results) // 2].prior,
        points,
        pixels,
        None,
        all(found.stands for found in results),
    )


def _overlapping(parts: Sequence[Int64]) -> Iterator[tuple[Int64, Float]]:
    """Lengthen parts of a sequence on both sides, with weights that add up to 1 at each place."""
    rows = np.concatenate(parts)
    bounds = np.cumsum([0, *(len(part) for part in parts)])
    reach = min(STRETCH // _REACH, min(len(part) for part in parts) // 2)
    share = (np.arange(2 * reach) + 0.5) / max(2 * reach, 1)
    rise = share**2 * (3 - 2 * share)
    for begin, end in pairwise(bounds.tolist()):
        longer = rows[max(begin - reach, 0) : end + reach]
        weight = np.ones(len(longer))
        if begin > 0:
            weight[: 2 * reach] = rise
        if end < len(rows):
            weight[len(weight) - 2 * reach :] = 1 - rise
        yield longer, weight


def clock_offset(
    seen: Background,
    poses_at: Callable[[float], tuple[Float, Float]],
    prior: PosePrior,
    *,
    quick: bool = False,
) -> tuple[float, float, float] | None:
    """Find by how much (s) pictures were taken later than their stamps, and the standard deviation of that.

    The log turns as the background then; the root mean square (rad) by which it errs besides is the third
    number. `poses_at` gives the poses for `adjust` so many seconds after the stamps. `quick` looks at few
    pictures once, and is rough for larger offsets. None: the camera turns too little in the middle of the
    flight, the adjustment fails, or no offset is stable.
    """
    offset_s, before_s, levels = 0.0, 0.0, replace(prior, clock_s=_ANY_CLOCK_S)
    for again in range(_CLOCK_ROUNDS):
        position, rotation = poses_at(offset_s)
        posed = np.flatnonzero(np.isfinite(position[:, 0]))
        pictures = _QUICK_CLOCK_PICTURES if quick else _CLOCK_PICTURES
        skipped = max(len(posed) - pictures, 0) // 2
        rows = posed[skipped : skipped + pictures]
        if len(rows) < 2:
            return None
        stretch = _Stretch.of(seen, rows, position, rotation)
        solved = stretch._solved(levels, level_rounds=1 if again or quick else _LEVEL_ROUNDS)
        if solved is None or solved.clock is None:
            return None
        levels = solved.prior
        _, turned = _without(solved.errors, position[rows], rotation[rows])
        away = rotation_vector_from_quaternion(quaternion_from_matrix(turned[:1].swapaxes(1, 2) @ turned))
        if np.sqrt(np.var(away, axis=0).sum()) < _LEAST_TURNING:
            return None
        late_s, sigma_s = solved.clock
        left_rad = float(np.sqrt(np.mean(solved.errors[:, 3:] ** 2)))
        if quick:
            return late_s, sigma_s, left_rad
        offset_s += late_s if late_s * before_s >= 0 else late_s / 2  # steps that swing to and fro
        before_s = late_s
        if abs(late_s) <= _SETTLED * sigma_s:
            return (offset_s, sigma_s, left_rad) if sigma_s <= _MOST_CLOCK_SIGMA_S else None
    return None


def _without(errors: Float, position: Float, rotation: Float) -> tuple[Float, Float]:
    """Remove errors [T, 6] from logged poses: (p - e, R exp(-w))."""
    back = matrix_from_quaternion(quaternion_from_rotation_vector(-errors[:, 3:]))
    return position - errors[:, :3], rotation @ back


def _sigma_of_constants(prior: PosePrior) -> Float:
    """Collect standard deviations [9] of constant errors, [10] with a clock; a shift leaves no trace."""
    sigma = np.repeat([0.0, *prior.constant[1:]], 3)
    return np.append(sigma, prior.clock_s) if prior.clock_s > 0 else sigma


def _remaining(draws: Float, period_s: float, shift: float) -> PoseErrors:
    """Describe errors [M, T, 6] drawn from the posterior as white, constant and slow; add `shift` (m).

    Differences of neighbours beyond those of pictures two apart are white, the mean over the flight is
    constant, the rest a Gauss-Markov process with the lag at which it has lost 1 / e.
    """
    white, processes = [0.0, 0.0], []
    for kind, number in enumerate((SHIFT_IN_WORLD, ROTATION)):
        part = draws[..., _KINDS[kind]]
        whole, constant = float(np.mean(part**2)), float(np.mean(part.mean(axis=1) ** 2))
        near, next_ = (_structure(part, lag) for lag in (1, 2))
        fresh = min(max(2 * near - next_, 0.0), near)
        slow = max(whole - constant - fresh, 0.0)
        constant += 0.0 if kind else shift**2
        white[kind] = max(float(np.sqrt(fresh)), EXACT)
        if slow > _SMALL * min(constant, USUAL_CONSTANT[kind] ** 2):
            lags = np.unique(np.geomspace(1, max(part.shape[1] // 2, 1), 24).astype(np.int64))
            grown = np.array([_structure(part, int(lag)) for lag in lags]) - fresh
            reached = np.flatnonzero(grown >= (1 - np.exp(-1)) * slow)
            lag = lags[reached[0]] if len(reached) else lags[-1]
            processes.append(Process(number, float(np.sqrt(slow)), correlation_s=float(lag * period_s)))
        else:
            constant += slow
        processes.append(Process(number, max(float(np.sqrt(constant)), EXACT)))
    return PoseErrors((white[0], white[1]), tuple(processes))


def _structure(errors: Float, lag: int) -> float:
    """Compute half of the mean square of differences over a number of pictures."""
    return float(np.mean((errors[:, lag:] - errors[:, :-lag]) ** 2)) / 2 if errors.shape[1] > lag else 0.0


@dataclass(frozen=True)
class _SolvedStretch:
    """Result of one stretch of T pictures."""

    errors: Float  # [T, 6] of the logged poses
    covariance: Float  # [T, 6, 6] of them
    draws: Float  # [M, T, 6] of what the errors may be more, from the posterior
    modes: Float  # [T, 6, R] of the same
    missed: Float  # [K] residuals, px
    prior: PosePrior
    clock: tuple[float, float] | None  # its offset and standard deviation (s), if it was unknown
    loosened: Float  # [T, 2] m, rad
    stands: bool = False
    place_m: float = 0.0  # standard deviation of the place of a camera that stands

    def surprise(self, level: Float) -> float:
        """Compute the largest rms error of the axes, in standard deviations of the log's [2].

        A constant rotation is none if the prior gave way to it, and changing errors are as stated beside it.
        Positions that wander look like one, too, but bend.
        """

        def largest(errors: Float, of: Float) -> float:
            sigma = np.repeat(np.hypot(of, self.loosened), 3, axis=1)
            return float(np.sqrt(np.mean((errors / sigma) ** 2, axis=0)).max())

        errors, changing = self.errors.copy(), self.errors - self.errors.mean(axis=0)
        gave_way = not self.prior.estimated and self.prior.constant[1] > self.prior.usual_turn > 0
        if gave_way and largest(changing, self.prior.changing) < _AS_STATED:
            errors[:, 3:] = changing[:, 3:]
        return largest(errors, level)


@dataclass(frozen=True)
class _StretchState:
    """Estimates of the unknowns."""

    errors: Float  # [T, 6]
    knots: Float  # [N, 6] slow errors
    constant: Float  # [9]: shift in the world, rotation, shift in the camera; [10] with an unknown clock (s)


@dataclass(frozen=True)
class _Factored:
    """Normal equations of the last step, factored: of pictures and knots, and of the constant errors."""

    band: Float  # [width, n] Cholesky factor, in columns from the diagonal down
    border: Float  # [n, 9 or 10] inverse of the band's matrix times the constant errors' columns
    corner: Float  # [9, 9] or [10, 10] covariance of the constant errors


@dataclass(frozen=True)
class _Stretch:
    """Pictures that are adjusted together, and the points seen in them."""

    rows: Int64  # [T] of the camera's pictures
    position: Float  # [T, 3]
    rotation: Float  # [T, 3, 3]
    seen: BackgroundSightings
    points: BackgroundPoints
    place: Int64  # [T] first unknown of each picture
    knot_place: Int64  # [N]
    knot_t_s: Float  # [N]
    knot: Int64  # [T] the knot before each picture
    share: Float  # [T] of the knot after it
    loosened: Float  # [T, 2] m, rad
    alike: tuple[float, float]  # pictures that share the white errors of a logged position, and rotation
    focal_px: float
    unbound: int  # pictures that share too few points with the one before
    turn: Float  # [3] constant error that was taken out of the attitudes

    @classmethod
    def of(cls, whole: Background, rows: Int64, position: Float, rotation: Float) -> _Stretch:
        """Build a stretch of some pictures."""
        seen = whole.between(int(rows[0]), int(rows[-1]) + 1)
        t_s = whole.t_s[rows]
        period_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 1.0
        longest = int(np.clip(round(_LONGEST_S / max(period_s, 1e-3)), *_LONGEST))
        row_of = np.full(len(position), -1)
        row_of[rows] = np.arange(len(rows))
        mine = row_of[seen.picture] >= 0
        picture, point, rays = row_of[seen.picture[mine]], seen.point[mine], seen.rays[mine]
        order = np.lexsort((picture, point))
        picture, point, rays = picture[order], point[order], rays[order]
        kept, first = _pieces(picture, point, longest)
        picture, rays = picture[kept], rays[kept]
        steps = (t_s[-1] - t_s[0]) / _KNOT_S if len(t_s) else 0.0
        knot_t_s = np.linspace(t_s[0], t_s[-1], max(int(np.ceil(steps)), 1) + 1)
        knot = np.clip(np.searchsorted(knot_t_s, t_s, side="right") - 1, 0, len(knot_t_s) - 2)
        share = (t_s - knot_t_s[knot]) / np.maximum(knot_t_s[knot + 1] - knot_t_s[knot], 1e-9)
        place, knot_place = _places(t_s, knot_t_s)
        middle = picture[(first[:-1] + first[1:]) // 2] if len(first) > 1 else first[:0]
        return cls(
            rows,
            position[rows],
            rotation[rows],
            BackgroundSightings(first, picture, rays, _PIXEL_SIGMA / whole.focal_px),
            _far_points(first, picture, rays, position[rows][middle], rotation[rows]),
            place,
            knot_place,
            knot_t_s,
            knot,
            share,
            np.zeros((len(rows), 2)) if whole.loosened is None else whole.loosened[rows],
            whole.alike,
            whole.focal_px,
            int((_shared(first, picture, len(rows)) < _FEWEST_SHARED).sum()),
            np.zeros(3),
        )

    def solve_with_levels(self, prior: PosePrior) -> _SolvedStretch | None:
        """Solve, with levels of errors estimated if they are unknown; None without convergence.

        A camera that stands sees no parallax, whatever its log says. Inverse depths near 0 fit that with any
        path, and the small errors of followed points then choose one. So a log that hardly moves is compared
        with a camera that does not move at all.
        """
        stands = self._standing(prior)
        begun, state = self._begun(prior)
        free = begun._solved(prior, state)
        if free is not None:
            whole = multiply(
                quaternion_from_rotation_vector(free.errors[:, 3:]),
                quaternion_from_rotation_vector(begun.turn),
            )
            free.errors[:, 3:] = rotation_vector_from_quaternion(whole)
        if stands is None or (free is not None and _misfit(stands) > _misfit(free) + _STANDS):
            return free
        return stands

    def _standing(self, prior: PosePrior) -> _SolvedStretch | None:
        """Solve for a camera that only turns; None if its log moves more than its errors do."""
        t_s = self._times_s()
        away = self.position - self.position.mean(axis=0)
        if len(t_s) < _FEWEST_STANDING or np.sqrt(np.mean(away**2)) > _SIGMAS_STANDING * prior.level[0]:
            return None
        if prior.estimated:
            white, rate = _levels_of_standing(t_s, self.position)
            prior = _with_position_levels(prior, white, _unknown(SHIFT_IN_WORLD, rate))
            arm = min(prior.constant[2], _USUAL_ARM_M)
            prior = replace(prior, constant=(*prior.constant[:2], arm))
        place, variance = _place_of_standing(t_s, self.position, prior)
        variance += prior.constant[2] ** 2  # nothing moves that could tell it from a shift of the place
        origin = np.tile(place, (len(self.points.origin), 1))
        still = replace(
            self,
            position=np.tile(place, (len(t_s), 1)),
            points=BackgroundPoints(origin, *(array.copy() for array in self.points[1:])),
        )
        tight = replace(prior, constant=(*prior.constant[:2], 0.0))
        tight = _with_position_levels(tight, EXACT, _unknown(SHIFT_IN_WORLD, EXACT))
        found = still._solved(tight, positions_known=True)
        if found is None:
            return None
        errors, covariance, draws = found.errors.copy(), found.covariance.copy(), found.draws.copy()
        errors[:, :3] += self.position - place
        covariance[:, range(3), range(3)] += variance
        rng = np.random.default_rng(0)
        draws[..., :3] += np.sqrt(variance) * rng.standard_normal((len(draws), 1, 3))
        levels = _with_position_levels(found.prior, prior.white[0], prior.slow[0])
        return replace(
            found,
            errors=errors,
            covariance=covariance,
            draws=draws,
            prior=levels,
            stands=True,
            place_m=variance**0.5,
        )

    def _times_s(self) -> Float:
        """Return the times of the pictures [T], from the knots about them."""
        step = self.knot_t_s[self.knot + 1] - self.knot_t_s[self.knot]
        return np.asarray(self.knot_t_s[self.knot] + self.share * step)

    def _begun(self, prior: PosePrior) -> tuple[_Stretch, _StretchState | None]:
        """Take the constant rotation error out of the log, roughly, where it may be large; return a start."""
        if prior.constant[1] <= _FAR_RAD or len(self.seen.first) < 2:
            return self, None
        # A path that is free to bend may bend where the camera should turn: a stiff one turns first.
        stiff = _with_position_levels(prior, prior.white[0], _unknown(SHIFT_IN_WORLD, _UNKNOWN_RATE[0]))
        begun, state, turn = self, self._zero(prior), self._searched(prior)
        for _ in range(_STIFF_STARTS):
            begun, zero = begun._turned(turn), self._zero(prior)
            found = begun._solve(zero, stiff, rounds=_FAR_ROUNDS, loss=_WIDE[0], settle=_SETTLE_ROUNDS)
            if found is None:
                return self, None
            state, turn = found[0], found[0].constant[3:6]
        return begun, state

    def _zero(self, prior: PosePrior) -> _StretchState:
        constant = np.zeros(len(_sigma_of_constants(prior)))
        return _StretchState(np.zeros((len(self.rows), 6)), np.zeros((len(self.knot_t_s), 6)), constant)

    def _turned(self, turn: Float) -> _Stretch:
        """Take a constant error [3] out of the attitudes, so that small ones are left."""
        rotation = self.rotation @ matrix_from_quaternion(quaternion_from_rotation_vector(-turn))
        points = _far_points(self.seen.first, self.seen.picture, self.seen.rays, self.points.origin, rotation)
        whole = multiply(quaternion_from_rotation_vector(turn), quaternion_from_rotation_vector(self.turn))
        return replace(self, rotation=rotation, points=points, turn=rotation_vector_from_quaternion(whole))

    def _searched(self, prior: PosePrior) -> Float:
        """Search for a constant rotation error [3] with which rays move away from where the camera flies.

        Any inverse depth up to that of 1 m fits, so a likely error decides where the path is straight.
        """
        every = -(-(len(self.seen.first) - 1) // _SEARCHED_POINTS)
        ends = self.seen.first[:-1:every], self.seen.first[1::every] - 1
        picture = [self.seen.picture[end] for end in ends]
        ray = [np.insert(self.seen.rays[end], 2, 1.0, axis=1) for end in ends]
        ray = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in ray]
        way = self.position[picture[1]] - self.position[picture[0]]
        best, least = np.zeros(3), np.inf
        steps = np.radians(np.arange(-_FARTHEST_DEG, _FARTHEST_DEG + 1, _TRIED_STEP_DEG))
        for turn in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3):
            if np.linalg.norm(turn) > np.radians(_FARTHEST_DEG):
                continue
            back = matrix_from_quaternion(quaternion_from_rotation_vector(-turn))
            first, last = (
                np.einsum("kij,kj->ki", self.rotation[rows], each @ back.T)
                for rows, each in zip(picture, ray, strict=True)
            )
            ahead = np.maximum((first * last).sum(axis=1, keepdims=True), _BEHIND)
            moved = last / ahead - first
            across = (first * way).sum(axis=1, keepdims=True) * first - way
            square = np.maximum(np.square(across).sum(axis=1, keepdims=True), EXACT)
            inverse = np.clip((moved * across).sum(axis=1, keepdims=True) / square, 0.0, 1.0)
            missed = np.square((moved - inverse * across) * self.focal_px / _WIDE[0]).sum(axis=1)
            cost = float(np.log1p(missed).sum() + np.square(turn / prior.constant[1]).sum() / 2)
            if cost < least:
                best, least = turn, cost
        return best

    def _solved(
        self,
        prior: PosePrior,
        state: _StretchState | None = None,
        *,
        positions_known: bool = False,
        level_rounds: int = _LEVEL_ROUNDS,
    ) -> _SolvedStretch | None:
        stages = _WIDE if state is None else _WIDE[1:]
        state = self._zero(prior) if state is None else state
        for loss in stages:
            settle = _SETTLE_ROUNDS if loss == _WIDE[0] else 0
            found = self._solve(state, prior, rounds=2, loss=loss, settle=settle)
            if found is None:
                return None
            state = found[0]
        for _ in range(level_rounds):
            found = self._solve(state, prior, rounds=2)
            if found is None:
                return None
            state, factored, _ = found
            levels, turn = prior, prior.constant[1]
            if prior.estimated:
                levels = self._estimated(state, self._draws(factored, 8), prior)
            if positions_known:
                levels = _with_position_levels(levels, prior.white[0], prior.slow[0])
            prior = with_constant_levels(levels, self._of_log(state.constant)[3:9], factored.corner[3:9, 3:9])
            if not prior.estimated and abs(prior.constant[1] - turn) <= _LEVEL_SETTLED * turn:
                break
        found = self._solve(state, prior, rounds=_ROUNDS)
        if found is None:
            return None
        state, factored, missed = found
        errors = self._draws(factored, _DRAWS)[0]
        late = float(state.constant[-1]), float(np.sqrt(factored.corner[-1, -1]))
        clock = late if prior.clock_s > 0 else None
        missed *= _PIXEL_SIGMA
        covariance, modes = self._covariance(factored), self._modes(factored)
        return _SolvedStretch(state.errors, covariance, errors, modes, missed, prior, clock, self.loosened)

    def _solve(
        self, state: _StretchState, prior: PosePrior, rounds: int, loss: float = _LOSS, settle: int = 0
    ) -> tuple[_StretchState, _Factored, Float] | None:
        """Make Gauss-Newton steps; return the estimate, the last equations, and residuals [K] in sigmas."""
        from scipy.linalg.lapack import dpbtrf, dpbtrs

        ties = self._ties(prior)
        steady = 1 / np.maximum(_sigma_of_constants(prior), EXACT) ** 2
        kept = np.zeros((len(self.points.inverse_depth), 12))
        missed = np.full(len(self.seen.picture), np.nan)
        size = int(max(self.place[-1], self.knot_place[-1])) + 6
        for _ in range(rounds):
            at, turn = _without(state.errors, self.position, self.rotation)
            band, force = np.zeros((size, self._width())), np.zeros(size)
            border = np.zeros((size, len(steady)))
            corner, pull = np.diag(steady), -steady * self._of_log(state.constant)
            eliminate_points(
                self.seen,
                self.points,
                at,
                turn,
                loss,
                _INVERSE_DEPTH,
                settle,
                self.place,
                band,
                force,
                missed,
                kept,
            )
            # Linear moves of points are too long where attitudes turn by much.
            settle = 1 if prior.constant[1] > _FAR_RAD else 0
            add_ties(ties, self._design(turn, prior), *_parts(state), band, force, border, corner, pull)
            self._add_motion(at, band, force)
            factor, failed = dpbtrf(band.T, lower=1, overwrite_ab=1)
            if failed:
                return None
            both = dpbtrs(factor, np.concatenate([border, force[:, None]], axis=1), lower=1)[0]
            covariance = np.linalg.inv(corner - border.T @ both[:, :-1])
            shift = covariance @ (pull - border.T @ both[:, -1])
            step = both[:, -1] - both[:, :-1] @ shift
            if not (np.isfinite(step).all() and (np.diagonal(covariance) > 0).all()):
                return None
            move_points(self.seen, self.points, at, turn, loss, kept, self.place, step)
            state = _StretchState(
                state.errors + step[self.place[:, None] + np.arange(6)],
                state.knots + step[self.knot_place[:, None] + np.arange(6)],
                state.constant + shift,
            )
            if (np.abs(step).reshape(-1, 2, 3).max(axis=(0, 2)) < _CONVERGED).all():
                break
        return state, _Factored(factor, both[:, :-1], covariance), missed[np.isfinite(missed)]

    def _of_log(self, constant: Float) -> Float:
        """Return the constant errors of the log as it was, before it was turned."""
        whole = constant.copy()
        whole[3:6] += self.turn
        return whole

    def _design(self, rotation: Float, prior: PosePrior) -> Float:
        """Compute the derivatives [T, 6, 9 or 10] of the errors by the constant ones."""
        # A late picture is turned farther than its log says; its position tells nothing of a clock.
        design = np.zeros((len(rotation), 6, len(_sigma_of_constants(prior))))
        design[:, :3, :3] = design[:, 3:, 3:6] = np.eye(3)
        design[:, :3, 6:9] = self.rotation
        if prior.clock_s > 0:
            t_s = self._times_s()
            reach = max(1, round(_RATE_S / float(np.median(np.diff(t_s)))))
            before = np.maximum(np.arange(len(t_s)) - reach, 0)
            after = np.minimum(np.arange(len(t_s)) + reach, len(t_s) - 1)
            turn = np.swapaxes(rotation[before], 1, 2) @ rotation[after]
            vector = rotation_vector_from_quaternion(quaternion_from_matrix(turn))
            design[:, 3:, 9] = -vector / (t_s[after] - t_s[before])[:, None]
        return design

    def _ties(self, prior: PosePrior) -> PosePriorArrays:
        """Build the prior of errors about slow and constant ones, and of slow ones over time."""
        steps = np.diff(self.knot_t_s)
        variance = np.square(prior.white)
        if not prior.estimated:  # an estimated level already holds what slow errors do between knots
            variance += [process.stray(float(steps.max(initial=0.0))) for process in prior.slow]
        white = 1 / np.repeat(
            np.maximum(np.multiply(self.alike, variance) + self.loosened**2, EXACT**2), 3, axis=1
        )
        left, added = np.empty((len(steps), 6)), np.empty((len(steps), 6))
        for k, step in enumerate(steps):
            both = [process.step(float(step)) for process in prior.slow]
            left[k] = np.repeat([one[0] for one in both], 3)
            added[k] = 1 / np.maximum(np.repeat([one[1] for one in both], 3), EXACT**2)
        start = 1 / np.maximum(np.repeat([process.sigma0 for process in prior.slow], 3), EXACT) ** 2
        return PosePriorArrays(self.place, self.knot_place, self.knot, self.share, white, start, left, added)

    def _add_motion(self, position: Float, band: Float, force: Float) -> None:
        """Add that cameras at `position` [T, 3] accelerate little, to the normal equations of the poses.

        A stamp that is wrong by as much as it is irregular moves its picture along the path.
        """
        steps = np.diff(self._times_s())
        before, after, usual = steps[:-1], steps[1:], float(np.median(steps))
        lag = int(np.clip(round(1 / usual), 1, len(steps)))
        speed = np.median(np.linalg.norm(position[lag:] - position[:-lag], axis=1)) / (lag * usual)
        late_m = speed * np.maximum(np.abs(before - usual), np.abs(after - usual))
        share = np.stack([1 / before, -1 / before - 1 / after, 1 / after])  # of three places, [3, T - 2]
        share *= 2 / (before + after)
        share /= np.hypot(_ACCELERATION_MPS2, late_m * np.linalg.norm(share, axis=0))
        count = len(before)
        excess = sum(share[k][:, None] * position[k : k + count] for k in range(3))
        for k, axis in product(range(3), range(3)):
            column = self.place[k : k + count] + axis
            force[column] += share[k] * excess[:, axis]
            for m in range(k, 3):
                band[column, self.place[m : m + count] + axis - column] += share[k] * share[m]

    def _width(self) -> int:
        """Compute the width of the band: the farthest pair of unknowns that meet in an equation."""
        last = self.seen.picture[self.seen.first[1:] - 1]
        first = self.seen.picture[self.seen.first[:-1]]
        widest = (self.place[last] - self.place[first]).max(initial=0)
        widest = max(widest, (self.place[2:] - self.place[:-2]).max(initial=0))
        widest = max(widest, np.diff(self.knot_place).max(initial=0))
        before = np.abs(self.place - self.knot_place[self.knot]).max()
        after = np.abs(self.place - self.knot_place[self.knot + 1]).max()
        return int(max(widest, before, after)) + 6

    def _draws(self, factored: _Factored, count: int) -> tuple[Float, Float, Float]:
        """Draw deviations of errors [M, T, 6], knots [M, N, 6] and constants [M, 9 or 10] (posterior)."""
        from scipy.linalg.lapack import dtbtrs

        rng = np.random.default_rng(0)
        free = rng.standard_normal((factored.band.shape[1], count))
        free = dtbtrs(factored.band, free, uplo="L", trans="T")[0]
        values, vectors = np.linalg.eigh(factored.corner)
        constant = rng.standard_normal((count, len(values))) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        free -= factored.border @ constant.T
        errors, knots = (
            np.moveaxis(free[place[:, None] + np.arange(6)], 2, 0) for place in (self.place, self.knot_place)
        )
        return errors, knots, constant

    def _covariance(self, factored: _Factored) -> Float:
        """Compute the posterior covariance [T, 6, 6] of each picture's error."""
        inverse = inverse_in_band(np.ascontiguousarray(factored.band.T))
        row, column = np.tril_indices(6)
        own = np.zeros((len(self.rows), 6, 6))
        own[:, row, column] = inverse[self.place[:, None] + column, row - column]
        own[:, column, row] = own[:, row, column]
        border = factored.border[self.place[:, None] + np.arange(6)]
        return np.asarray(own + border @ factored.corner @ np.swapaxes(border, 1, 2))

    def _modes(self, factored: _Factored) -> Float:
        """Compute the response [T, 6, R] of the errors to independent standard normal numbers (`ErrorModes`).

        The numbers determine coefficients of polynomials of time, the mean over the stretch first. If L L' is
        their covariance and C [T, 6, R] that of errors and coefficients, the response is C L'^-1.
        """
        from scipy.linalg.lapack import dpbtrs

        count = min(_POLYNOMIALS, len(self.rows))
        powers = np.vander(self._times_s() - self._times_s().mean(), count, increasing=True)
        moments = np.zeros((factored.band.shape[1], count, 6))
        polynomials = np.linalg.qr(powers)[0]
        for k in range(6):
            moments[self.place + k, :, k] = polynomials
        moment = moments.reshape(len(moments), -1)
        shared = dpbtrs(factored.band, moment, lower=1)[0]
        shared += factored.border @ (factored.corner @ (factored.border.T @ moment))
        root = np.linalg.cholesky(moment.T @ shared + EXACT**2 * np.eye(moment.shape[1]))
        response = np.zeros((len(self.rows), 6, 6 * _POLYNOMIALS))
        response[..., : root.shape[1]] = np.linalg.solve(root, shared.T).T[self.place[:, None] + np.arange(6)]
        return response

    def _estimated(
        self, state: _StretchState, draws: tuple[Float, Float, Float], prior: PosePrior
    ) -> PosePrior:
        """Estimate the levels of white and slow errors again by MacKay's rule."""
        design = self._design(_without(state.errors, self.position, self.rotation)[1], prior)
        usual = ~(self.loosened > 0).any(axis=1)
        usual |= not usual.any()  # a log that repeats each pose is loosened everywhere, and little
        fresh = self._fresh(state, design)[usual]
        spread = np.stack(
            [self._fresh(_StretchState(*draw), design)[usual] for draw in zip(*draws, strict=True)]
        )
        white = [
            _level(fresh[:, of], spread[..., of], sigma, least, alike)
            for of, sigma, least, alike in zip(_KINDS, prior.white, _LEAST_WHITE, self.alike, strict=True)
        ]
        scale = 1 / np.sqrt(np.diff(self.knot_t_s))[:, None]
        steps, spread = np.diff(state.knots, axis=0) * scale, np.diff(draws[1], axis=1) * scale
        rate = [
            _level(steps[:, of], spread[..., of], _rate(process), least)
            for of, process, least in zip(_KINDS, prior.slow, _LEAST_RATE, strict=True)
        ]
        found = _unknown(SHIFT_IN_WORLD, rate[0]), _unknown(ROTATION, rate[1])
        slow = (prior.slow[0] if prior.held[0] else found[0], prior.slow[1] if prior.held[1] else found[1])
        return replace(prior, white=(white[0], white[1]), slow=slow)

    def _fresh(self, state: _StretchState, design: Float) -> Float:
        """Compute the white part [T, 6] of the errors."""
        share = self.share[:, None]
        slow = (1 - share) * state.knots[self.knot] + share * state.knots[self.knot + 1]
        return np.asarray(state.errors - slow - design @ state.constant)


def with_constant_levels(prior: PosePrior, found: Float, covariance: Float) -> PosePrior:
    """Estimate the levels of the constant rotation (rad) and lever arm (m) from their posterior, mean [6].

    They say little, so a usual level counts as `USUAL_COUNT` more numbers, a stated one as `_STATED_COUNT`
    (inverse gamma prior; expectation maximisation). A usual turn of 0 holds the level. What rests on a
    drifting path gives way: a rotation to the log, an arm to none. A rotation of which pictures say little
    keeps its wide level; an arm's never grows, or it would bend the path.
    """
    place, turn, arm = prior.constant
    determined = 1 - np.trace(covariance[:3, :3]) / (3 * turn**2)
    if turn <= prior.usual_turn or (prior.usual_turn and determined >= _LEAST_DETERMINED):
        count = USUAL_COUNT if prior.estimated else _STATED_COUNT
        turn = _constant_level(found[:3], covariance[:3, :3], turn, prior.usual_turn, count)
    if arm > 0 and prior.estimated:  # a camera that stands has none
        arm = min(arm, _constant_level(found[3:], covariance[3:, 3:], arm, _USUAL_ARM_M))
    return replace(prior, constant=(place, turn, arm))


def _constant_level(
    found: Float, covariance: Float, level: float, usual: float, count: float = USUAL_COUNT
) -> float:
    precision = np.linalg.inv(covariance)
    pull, of_data = precision @ found, precision - np.eye(3) / level**2
    variance = max(level**2, float(np.sum((np.linalg.pinv(of_data) @ pull) ** 2)))
    for _ in range(_LEVEL_STEPS):
        posterior = np.linalg.inv(of_data + np.eye(3) / variance)
        squares = np.sum((posterior @ pull) ** 2) + np.trace(posterior)
        variance = min((count * usual**2 + squares) / (count + 3), _ANY_TURN_RAD**2)
    return float(np.sqrt(variance))


def _parts(state: _StretchState) -> tuple[Float, Float, Float]:
    return state.errors, state.knots, state.constant


def _level(estimates: Float, draws: Float, sigma: float, least: float, alike: float = 1.0) -> float:
    """Estimate a standard deviation: squares of estimates over the number that the data determine.

    So many are `alike`: they had that many times its square as the variance of their prior.

    Where the data determine little, the step is that of expectation maximisation (Dempster et al. 1977):
    it has the same fixed point, and is smaller.
    """
    left = np.mean(draws**2) / alike
    determined = 1 - left / sigma**2
    if determined < _LEAST_DETERMINED:
        variance = np.mean(estimates**2) + left
    else:
        variance = np.mean(estimates**2) / determined
    return max(float(np.sqrt(np.clip(variance, 0.04 * sigma**2, 6.0 * sigma**2))), least)


# --- cameras that stand ---------------------------------------------------------------------------------


def _misfit(solved: _SolvedStretch) -> float:
    """Compute what a solution leaves of a sighting (px^2 if it is small), by Cauchy's loss."""
    return float(np.mean(np.log1p((solved.missed / _PIXEL_SIGMA) ** 2)))


def _with_position_levels(prior: PosePrior, white: float, slow: Process) -> PosePrior:
    return replace(prior, white=(white, prior.white[1]), slow=(slow, prior.slow[1]))


def _levels_of_standing(t_s: Float, position: Float) -> tuple[float, float]:
    """Read white errors (m) and the rate of slow ones (m per sqrt(s)) off a log that stands."""
    period_s = float(np.median(np.diff(t_s)))
    lag = int(np.clip(round(_SLOW_LAG_S / period_s), 2, len(t_s) // 2))
    near, far = (float(np.mean((position[k:] - position[:-k]) ** 2)) for k in (1, lag))
    rate2 = max(far - near, 0.0) / ((lag - 1) * period_s)
    white = float(np.sqrt(max(near - rate2 * period_s, 0.0) / 2))
    return max(white, _LEAST_WHITE[0]), max(float(np.sqrt(rate2)), _LEAST_RATE[0])


def _place_of_standing(t_s: Float, position: Float, prior: PosePrior) -> tuple[Float, float]:
    """Estimate the place [3] of a camera that stands, and its variance, by generalised least squares."""
    parts = np.array_split(np.arange(len(t_s)), min(len(t_s), _MOST_MEANS))
    at_s = np.array([t_s[part].mean() for part in parts])
    means = np.array([position[part].mean(axis=0) for part in parts])
    slow = prior.slow[0]
    covariance = np.diag([prior.white[0] ** 2 / len(part) + EXACT**2 for part in parts])
    covariance += slow.rate**2 * np.minimum(at_s[:, None], at_s)
    covariance += slow.sigma0**2 * np.exp(-np.abs(at_s[:, None] - at_s) / slow.correlation_s)
    weight = np.linalg.solve(covariance, np.ones(len(parts)))
    variance = 1 / float(weight.sum())
    return np.asarray(variance * weight @ means), variance


# --- points ---------------------------------------------------------------------------------------------


def _pieces(picture: Int64, point: Int64, longest: int) -> tuple[Bool, Int64]:
    """Cut tracks, sorted by point and picture; return the sightings used, and each piece's first of them."""
    if not len(picture):
        return np.zeros(0, dtype=np.bool_), np.zeros(1, dtype=np.int64)
    begins = np.append(True, (np.diff(point) != 0) | (np.diff(picture) != 1))
    start = np.maximum.accumulate(np.where(begins, np.arange(len(point)), 0))
    # Tracks that begin together are cut at different times.
    phase = (longest * ((0.6180339887498949 * point) % 1.0)).astype(np.int64)
    part = (np.arange(len(point)) - start + phase) // longest
    begins[1:] |= np.diff(part) != 0
    piece = np.cumsum(begins) - 1
    length = np.bincount(piece)
    long = length >= _FEWEST_SIGHTINGS
    mean = length[long].sum() / max(len(np.unique(picture)), 1)
    chosen = long & ((0.7548776662466927 * np.arange(len(length))) % 1.0 < _POINTS / max(mean, 1.0))
    first = np.concatenate([[0], np.cumsum(length[chosen])])
    return np.asarray(chosen[piece]), first.astype(np.int64)


def _shared(first: Int64, picture: Int64, pictures: int) -> Int64:
    """Count the points [T - 1] that are seen in each picture and in the one after it."""
    ends = np.zeros(len(picture), dtype=np.bool_)
    ends[first[1:] - 1] = True
    return np.bincount(picture[~ends], minlength=pictures)[: pictures - 1]


def _far_points(
    first: Int64, picture: Int64, rays: Float, origin: Float, rotation: Float
) -> BackgroundPoints:
    """Place each piece's point far away, in the mean direction of its rays."""
    ray = np.einsum("kij,kj->ki", rotation[picture], np.append(rays, np.ones((len(rays), 1)), axis=1))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    if not len(origin):
        return BackgroundPoints(origin, origin.copy(), np.zeros(0), np.zeros((0, 2, 3)))
    direction = np.add.reduceat(ray, first[:-1], axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    least = np.eye(3)[np.abs(direction).argmin(axis=1)]
    side = np.cross(direction, least)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    across = np.stack([side, np.cross(direction, side)], axis=1)
    return BackgroundPoints(np.ascontiguousarray(origin), direction, np.full(len(origin), 0.05), across)


def _places(t_s: Float, knot_t_s: Float) -> tuple[Int64, Int64]:
    """Give every picture and knot six unknowns in the order of time; return the first of each."""
    order = np.argsort(np.concatenate([t_s, knot_t_s]), kind="stable")
    place = np.empty(len(order), dtype=np.int64)
    place[order] = 6 * np.arange(len(order))
    return place[: len(t_s)], place[len(t_s) :]


# --- cameras of a flight --------------------------------------------------------------------------------


def refine_cameras(
    cameras: Sequence[Camera],
    followed: Mapping[str, Followed | str],
    errors: Sequence[PoseErrors | None],
    *,
    between: Interpolation,
    search: bool = True,
) -> tuple[list[Camera], dict[str, Any], list[str]]:
    """Refine cameras by the backgrounds `followed`: cameras, remaining errors, metrics and warnings.

    With `search`, a background that would be refused is believed if it shows that its camera looks beside the
    log, and one that shows a constant rotation far beyond what is stated.
    """
    refined: list[Camera] = []
    entries: dict[str, Any] = {}
    warnings: list[str] = []
    for camera, stated in zip(cameras, errors, strict=True):
        seen = followed[camera.name]
        if isinstance(seen, str):
            refined.append(camera)
            entries[camera.name] = {"used": False, "reason": seen}
        else:
            t_ns = camera.frame_t_ns[seen.rows]
            prior = PosePrior.of(stated)
            prior = prior if search or prior.estimated else replace(prior, usual_turn=0.0)
            if stated is None and camera.stepped_m:  # a level of its own, that other cameras do not share
                constant = (float(np.hypot(prior.constant[0], camera.stepped_m)), *prior.constant[1:])
                prior = replace(prior, constant=constant, assumed=False)
            found = adjust(background_of(camera, seen), *camera.poses_at(t_ns, between), prior)
            aside = _found_aside(camera, seen, between) if search and found.refused is not None else None
            found, angle = (found, float(np.linalg.norm(found.turn))) if aside is None else aside[:2]
            is_odd = search and not prior.estimated and angle > _SIGMAS_ASIDE * prior.level[1]
            is_aside = aside is not None or is_odd
            if is_aside:
                warnings.append(
                    f"{camera.name}: corrected by its background, which shows that it looks"
                    f" {np.degrees(angle):.1f} deg beside its logged attitudes"
                )
            refined.append(_with_poses(camera, t_ns, found))
            used = found.refused is None
            turn = np.diagonal(found.covariance[:, 3:, 3:], axis1=1, axis2=2).mean(axis=1)
            prior = found.prior
            entries[camera.name] = {
                "used": used,
                "reason": found.refused,
                "pictures": len(found.position),
                "points": found.points,
                "reprojection_px": found.reprojection_px if used else None,
                "rotation_sigma_deg": {
                    "log": float(np.degrees(prior.level[1])),
                    "background": float(np.degrees(np.sqrt(np.nanmedian(turn)))) if used else None,
                },
            } | ({"aside_deg": float(np.degrees(angle))} if is_aside else {})
            if found.frozen:
                warnings.append(
                    f"{camera.name}: its logged position never changes, but its pictures do not show a camera"
                    " that stands: is the log frozen?"
                )
        if entries[camera.name]["reason"] is not None:
            reason = entries[camera.name]["reason"]
            warnings.append(f"{camera.name}: its logged poses stay, because {reason}")
    return refined, entries, warnings


def with_known_mount(
    camera: Camera, followed: Followed | str, stated: PoseErrors | None, between: Interpolation
) -> Camera:
    """Take a constant rotation error that may be large out of a log, as far as the background shows it.

    Attitudes still change as logged, so that the log can be read at other times than those of its pictures.
    """
    prior, log = PosePrior.of(stated), camera.trajectory
    if isinstance(followed, str) or prior.constant[1] <= _FAR_RAD:
        return camera
    at = camera.poses_at(camera.frame_t_ns[followed.rows], between)
    back = quaternion_from_rotation_vector(-adjust(background_of(camera, followed), *at, prior).turn)
    return replace(camera, trajectory=replace(log, quaternion_xyzw=multiply(log.quaternion_xyzw, back)))


def turned_aside(camera: Camera, followed: Followed, between: Interpolation) -> tuple[float, float] | None:
    """Estimate by how much a camera looks beside its logged attitudes, and the standard deviation, in rad.

    The camera may be turned by any constant rotation in its own axes. None if the background does not tell,
    or if the angle is one of usual mounts, compasses and satellite positions.
    """
    found = _found_aside(camera, followed, between)
    return None if found is None else found[1:]


def _found_aside(
    camera: Camera, followed: Followed, between: Interpolation
) -> tuple[Adjusted, float, float] | None:
    prior = PosePrior.of(None)
    position, _, arm = prior.constant
    at = camera.poses_at(camera.frame_t_ns[followed.rows], between)
    found = adjust(
        background_of(camera, followed), *at, replace(prior, constant=(position, _ANY_TURN_RAD, arm))
    )
    if found.refused is not None or found.stands:
        return None
    posed = np.isfinite(at[0][:, 0])
    turns = quaternion_from_matrix(np.swapaxes(at[1][posed], 1, 2) @ found.rotation[posed])
    turn = rotation_vector_from_quaternion(turns).mean(axis=0)
    precision = np.linalg.inv(found.covariance[posed, 3:, 3:].mean(axis=0))
    angle, sigmas = float(np.linalg.norm(turn)), float(np.sqrt(turn @ precision @ turn))
    return (found, angle, angle / sigmas) if angle > _LEAST_ASIDE_RAD and sigmas > _SIGMAS else None


def clocks_of_backgrounds(
    cameras: Sequence[Camera],
    followed: Mapping[str, Followed | str],
    errors: Sequence[PoseErrors | None],
    clock_sigma_s: Float,
    stated: Bool | None = None,
    *,
    between: Interpolation,
) -> tuple[Float, Float]:
    """Find the clock offset of each camera that turns: its log turns as its background does.

    The adjustment of poses finds the offset. It begins at the stamps, and with some tenths of a second that a
    rough search finds, which slow errors of a log can mislead: that counts with which the log errs least.
    `clock_sigma_s` [C] is 0 for a known clock; for `stated` ones a quick look decides first, and is another
    beginning. Return offsets [C] to add to the pictures' times and their standard deviations, s; NaN where
    the clock is known or not determined.
    """
    found = np.full((len(cameras), 2), np.nan)
    for c, (camera, stated_errors) in enumerate(zip(cameras, errors, strict=True)):
        seen = followed[camera.name]
        if clock_sigma_s[c] == 0 or isinstance(seen, str):
            continue
        background, prior, starts_s = background_of(camera, seen), PosePrior.of(stated_errors), [0.0]
        if stated is not None and stated[c]:
            poses_at = partial(_poses_late, camera, camera.frame_t_ns[seen.rows], 0.0, between)
            look = clock_offset(background, poses_at, prior, quick=True)
            if look is None or abs(look[0]) <= SIGMAS_TO_LOOK_CLOSER * look[1]:
                found[c] = (np.nan, np.nan) if look is None else (0.0, look[1])
                continue
            starts_s.append(look[0])
        rough = common_offset([camera], {camera.name: seen}, between)
        starts_s += [] if rough is None else [rough.late_s]
        tried = []
        for about_s in starts_s:
            poses_at = partial(_poses_late, camera, camera.frame_t_ns[seen.rows], about_s, between)
            if (clock := clock_offset(background, poses_at, prior)) is not None:
                late_s, sigma_s, left_rad = clock
                tried.append((left_rad, about_s + late_s, sigma_s))
        if tried:
            _, late_s, sigma_s = min(tried)
            share = clock_sigma_s[c] ** 2 / (clock_sigma_s[c] ** 2 + sigma_s**2)
            found[c] = share * late_s, np.sqrt(share) * sigma_s
    return found[:, 0], found[:, 1]


def _poses_late(
    camera: Camera, t_ns: Int64, about_s: float, between: Interpolation, late_s: float
) -> tuple[Float, Float]:
    return camera.poses_at(t_ns + round(1e9 * (about_s + late_s)), between)


def background_of(camera: Camera, followed: Followed) -> Background:
    """Return a camera's background as it is adjusted."""
    t_ns = camera.frame_t_ns[followed.rows]

    def between(first: int, stop: int) -> SeenPoints:
        parts = [SeenPoints(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))]
        for tracks in followed.between(first, stop):
            # Of whole parts: velocities need the neighbours.
            rays = rays_at_stamps(tracks, camera.intrinsics, t_ns)
            parts.append(SeenPoints(tracks.picture, tracks.point, rays).between(first, stop))
        picture, point, rays = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("picture", "point", "rays")
        )
        return SeenPoints(picture, point, rays)

    loosened = None if camera.loosened is None else camera.loosened_at(t_ns)
    alike = _pictures_alike(camera, t_ns, 0), _pictures_alike(camera, t_ns, 1)
    return Background(between, camera.focal_px, (t_ns - t_ns[0]) / 1e9, loosened, alike)


def _pictures_alike(camera: Camera, t_ns: Int64, kind: int) -> float:
    """Count the pictures between two logged positions (0) or rotations (1) that are no bridge; 1 or more."""
    logged_ns = camera.trajectory.t_ns
    if camera.loosened is not None:
        logged_ns = logged_ns[camera.loosened[:, kind] == 0]
    if min(len(logged_ns), len(t_ns)) < 2:
        return 1.0
    after = np.clip(np.searchsorted(logged_ns, t_ns, side="right"), 1, len(logged_ns) - 1)
    gap_ns = float(np.median(logged_ns[after] - logged_ns[after - 1]))
    return max(1.0, gap_ns / max(float(np.median(np.diff(t_ns))), 1.0))


def _with_poses(camera: Camera, t_ns: Int64, found: Adjusted) -> Camera:
    if found.left is None:
        return camera
    posed = np.isfinite(found.position[:, 0])
    trajectory = Trajectory(t_ns[posed], found.position[posed], quaternion_from_matrix(found.rotation[posed]))
    covariance, every = found.covariance[posed], -(-int(posed.sum()) // STRETCH)
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    return replace(
        camera,
        trajectory=trajectory,
        sigma=np.sqrt(variances.mean(axis=2)),
        covariance=covariance,
        errors=found.left,
        modes=ErrorModes(t_ns[posed][::every], found.modes[posed][::every], found.shift_m),
        loosened=_loosened_still(camera.loosened_at(t_ns[posed]), variances.mean(axis=2)),
    )


def _loosened_still(loosened: Float, variance: Float) -> Float | None:
    """Compute what is left of loosened poses [T, 2], from the variances [T, 2] that all poses have now."""
    if not loosened.any():
        return None
    more = np.sqrt(np.maximum(variance - np.median(variance, axis=0), 0.0))
    return np.where((loosened > 0).any(axis=1, keepdims=True), more, 0.0)
