"""Refinement problem: pictures, the skeleton's times, the priors of errors, and the cost of a state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import EXACT, PoseErrors, Process
from pipelines.reconstruction.refinement import kernels
from pipelines.reconstruction.refinement.kernels import Entries, Equations, PictureArrays, State

CLOCK = 9
"""Index of the clock offset among a picture's ten numbers (see `kernels`)."""


REMEMBERED = 1.5
"""Memory (correlation length) of keypoint errors above which it is taken into account."""


@dataclass(frozen=True)
class Pictures:
    """G pictures of C cameras, sorted by `first`, the first of the three times around each, then camera."""

    first: Int64  # [G]
    camera: Int64  # [G]
    logged: Int64  # [G] row of its pose's covariance in `Problem.pose_covariance`, -1 for none
    when_s: Float  # [G] on the skeleton's clock
    rays: Float  # [G, J, 2]
    sharpness: Float  # [G, J] 1 / standard deviation of an image point
    position: Float  # [G, 3] m, the logged pose
    rotation: Float  # [G, 3, 3] world_from_camera
    speed: Float  # [G, 3] m/s, world
    turn: Float  # [G, 3] rad/s, camera
    loosened: Float  # [G, 2] m, rad: what poses in bad stretches of a log err by besides; 0 elsewhere


@dataclass(frozen=True)
class UnknownLayout:
    """Places of the unknowns other than joints: at knots in time, or shared by all times.

    A process adds to three of its camera's ten numbers. Shared unknowns are constant errors, then clocks,
    then bone lengths.
    """

    processes: tuple[tuple[int, Process], ...]  # (camera, process)
    place: tuple[tuple[bool, int], ...]  # of each process: at knots?, first column
    entries: Entries
    clock_sigma_s: Float  # [C]
    bone_column: int
    shared_count: int
    knot_t_s: Float  # [K]


def lay_out(errors: Sequence[PoseErrors], clock_sigma_s: Float, bones: int, knot_t_s: Float) -> UnknownLayout:
    """Assign a place to every unknown; `clock_sigma_s` is 0 for a known clock."""
    processes, place = [], []
    start, number, knot, column = [0], [], [], []
    knot_count = shared_count = 0
    clock_column = np.full(len(errors), -1, dtype=np.int64)
    for camera, error in enumerate(errors):
        for process in error.processes:
            at_knots = not process.constant
            first = knot_count if at_knots else shared_count
            if at_knots:
                knot_count += 3
            else:
                shared_count += 3
            processes.append((camera, process))
            place.append((at_knots, first))
            number += [process.number + axis for axis in range(3)]
            knot += [at_knots] * 3
            column += [first + axis for axis in range(3)]
        if clock_sigma_s[camera] > 0:
            clock_column[camera] = shared_count
            number.append(CLOCK)
            knot.append(False)
            column.append(shared_count)
            shared_count += 1
        start.append(len(number))
    return UnknownLayout(
        processes=tuple(processes),
        place=tuple(place),
        entries=Entries(
            np.array(start, dtype=np.int64),
            np.array(number, dtype=np.int64),
            np.array(knot, dtype=np.bool_),
            np.array(column, dtype=np.int64),
            clock_column,
            knot_count,
        ),
        clock_sigma_s=clock_sigma_s,
        bone_column=shared_count,
        shared_count=shared_count + bones,
        knot_t_s=knot_t_s,
    )


@dataclass(frozen=True)
class Knowledge:
    """Parameters of the prior of all errors and of motion."""

    poses: tuple[PoseErrors, ...]  # of each camera
    clock_sigma_s: Float  # [C]
    acceleration: Float  # [J, J] (m/s^2)^2, covariance of the joints' accelerations along an axis
    bone_sigma_m: Float  # [B] standard deviation of a bone's length over time
    size_m: float  # mean bone length of the body for which these two hold; they scale with it
    pixel_scale: float  # factor on the stated standard deviations of image points
    memory: float = 1.0
    """Number of neighbouring image points of a joint in a camera that count as one independent point.

    Accelerations count less by the same number, because a gait repeats and they are no white noise. If they
    outweighed the image points, swings would become smaller, and cameras would make up for it.
    """


# A size this many standard deviations off counts half: children are smaller than people usually are.
_SIZE_LOSS = 2.0


@dataclass(frozen=True)
class UsualSize:
    """Sizes of P people by the sums of some bones' lengths; a heavy tail leaves room for children."""

    lengths_m: Float  # [P, B] usual lengths, 0 for bones that do not count
    sigma: float  # standard deviation of a sum, relative to it

    def of_bones(self, kept: Bool) -> UsualSize | None:
        """Return the sizes by the bones that are kept [B]; None if none of them counts."""
        lengths = self.lengths_m[:, kept]
        lengths = lengths[lengths.any(axis=1)]
        return replace(self, lengths_m=lengths) if len(lengths) else None

    def equations(self, lengths: Float) -> tuple[Float, Float]:
        """Return derivatives [P, B] by lengths [B] m, and residuals [P], weighted standard deviations."""
        usual = self.lengths_m.sum(axis=1, keepdims=True)
        slope = (self.lengths_m > 0) / (self.sigma * usual)
        off = slope @ lengths - 1 / self.sigma
        weight = 1 / np.hypot(1, off / _SIZE_LOSS)
        return weight[:, None] * slope, weight * off

    def cost(self, lengths: Float) -> float:
        """Compute the cost of lengths [B] m by a Cauchy distribution of the sizes."""
        off = (lengths @ (self.lengths_m > 0).T / self.lengths_m.sum(axis=1) - 1) / self.sigma
        return float(_SIZE_LOSS**2 * np.log1p(np.square(off / _SIZE_LOSS)).sum())


@dataclass(frozen=True)
class Problem:
    """Refinement problem without the parameters of the prior."""

    t_s: Float  # [T] the skeleton's times, at least three
    pictures: Pictures
    bones: Int64  # [B, 2]
    knot_t_s: Float  # [K]
    size: UsualSize | None = None
    pose_covariance: Float = field(default_factory=lambda: np.empty((0, 6, 6)))
    """Covariances [L, 6, 6] of logged white pose errors: world shift (m), camera rotation vector (rad)."""

    @property
    def joints(self) -> int:
        """Number of joints of all people together."""
        return int(self.pictures.rays.shape[1])

    def intervals(self) -> tuple[Int64, Float]:
        """Find the knot before each skeleton time [T - 2], and each picture's fraction [G] of the span."""
        last = max(len(self.knot_t_s) - 2, 0)
        of_time = np.clip(np.searchsorted(self.knot_t_s, self.t_s[:-2], side="right") - 1, 0, last)
        if len(self.knot_t_s) < 2:
            return of_time, np.zeros(len(self.pictures.first))
        interval = of_time[self.pictures.first]
        span = np.diff(self.knot_t_s)[interval]
        return of_time, (self.pictures.when_s - self.knot_t_s[interval]) / span


# --- construction --------------------------------------------------------------------------------------


KNOT_S = 0.5
"""Distance of the knots between which slow pose errors are linear; deviations from that count as white."""

# A picture farther from its nearest time, in steps of the skeleton, is not used.
_NEAR = 0.75
# Rates of poses are taken over this time on both sides: over less, noise would exceed motion.
_RATE_S = 0.25
# If three consecutive times span more than so many usual steps, nothing is interpolated between them.
_GAP = 3.5


@dataclass(frozen=True)
class Sighting:
    """Keypoints of one camera in its F pictures, with its logged poses."""

    t_s: Float  # [F] strictly increasing, on the skeleton's clock
    rays: Float  # [F, J, 2] normalised, undistorted; NaN where nothing was seen
    confidence: Float  # [F, J]
    position: Float  # [F, 3] m, logged world_from_camera; NaN without a pose
    rotation: Float  # [F, 3, 3]
    focal_px: float
    pixel_sigma: float  # px per axis of a view of confidence 1
    pose_covariance: Float | None = None  # [F, 6, 6] of white pose errors, see `Problem`
    loosened: Float | None = None  # [F, 2], see `Pictures`

    @property
    def range_of(self) -> Bool:
        """True for pictures [F] with a pose and a keypoint."""
        return ~np.isnan(self.position[:, 0]) & ~np.isnan(self.rays[..., 0]).all(axis=1)


def build(t_s: Float, sightings: Sequence[Sighting], bones: Int64, size: UsualSize | None = None) -> Problem:
    """Build the problem of times [T] and `bones` [B, 2]; pictures near none of the times are left out."""
    step = float(np.median(np.diff(t_s)))
    covariances, logged, parts = [np.empty((0, 6, 6))], 0, []
    for camera, sighting in enumerate(sightings):
        first, near = _first_of_three(t_s, sighting.t_s, step)
        (kept,) = np.nonzero(near & sighting.range_of)
        seen = ~np.isnan(sighting.rays[kept, :, 0]) & (sighting.confidence[kept] > 0)
        speed, turn = _rates(sighting)
        sharpness = sighting.focal_px / sighting.pixel_sigma
        with_covariance = sighting.pose_covariance is not None
        loosened = np.zeros((len(sighting.t_s), 2)) if sighting.loosened is None else sighting.loosened
        part = Pictures(
            first=first[kept],
            camera=np.full(len(kept), camera),
            logged=logged + kept if with_covariance else np.full(len(kept), -1),
            when_s=sighting.t_s[kept],
            rays=np.where(seen[..., None], sighting.rays[kept], np.nan),
            sharpness=np.where(seen, sighting.confidence[kept], 0.0) * sharpness,
            position=sighting.position[kept],
            rotation=sighting.rotation[kept],
            speed=speed[kept],
            turn=turn[kept],
            loosened=loosened[kept],
        )
        parts.append(part)
        if sighting.pose_covariance is not None:
            covariances.append(sighting.pose_covariance)
            logged += len(sighting.t_s)
    names = [each.name for each in fields(Pictures)]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    order = np.lexsort((joined["camera"], joined["first"]))
    pictures = Pictures(**{name: values[order] for name, values in joined.items()})
    knots = max(int(np.ceil((t_s[-1] - t_s[0]) / KNOT_S)) + 1, 2)
    knot_t_s = np.linspace(t_s[0], t_s[-1], knots)
    return Problem(t_s, pictures, bones, knot_t_s, size, np.concatenate(covariances))


def _first_of_three(t_s: Float, at_s: Float, step: float) -> tuple[Int64, Bool]:
    """Find the first of three consecutive times of the skeleton around each time; mark if they exist."""
    after = np.clip(np.searchsorted(t_s, at_s), 1, len(t_s) - 1)
    nearest = np.where(at_s - t_s[after - 1] <= t_s[after] - at_s, after - 1, after)
    span = np.full(len(t_s) + 2, np.inf)  # of the three times that begin at index - 2
    span[2:-2] = t_s[2:] - t_s[:-2]
    choices = np.stack([nearest - 1, nearest - 2, nearest], axis=1)
    fits = span[np.clip(choices, -2, len(t_s) - 1) + 2] < _GAP * step
    first = np.take_along_axis(choices, fits.argmax(axis=1)[:, None], axis=1)[:, 0]
    near = fits.any(axis=1) & (np.abs(t_s[nearest] - at_s) <= _NEAR * step)
    return first.astype(np.int64), near


def _rates(sighting: Sighting) -> tuple[Float, Float]:
    """Compute speed [F, 3] (m/s, world) and turn rate [F, 3] (rad/s, camera) over half a second; or 0."""
    count = len(sighting.t_s)
    if count < 3:
        return np.zeros((count, 3)), np.zeros((count, 3))
    reach = max(round(_RATE_S / float(np.median(np.diff(sighting.t_s)))), 1)
    before, after = np.arange(count) - reach, np.arange(count) + reach
    before, after = np.maximum(before, 0), np.minimum(after, count - 1)
    elapsed_s = (sighting.t_s[after] - sighting.t_s[before])[:, None]
    speed = (sighting.position[after] - sighting.position[before]) / elapsed_s
    turned = np.einsum("tji,tjk->tik", sighting.rotation[before], sighting.rotation[after])
    antisymmetric = (turned - np.swapaxes(turned, 1, 2)) / 2
    axes = [antisymmetric[:, 2, 1], antisymmetric[:, 0, 2], antisymmetric[:, 1, 0]]
    return np.nan_to_num(speed), np.nan_to_num(np.stack(axes, axis=1) / elapsed_s)


# --- with its prior --------------------------------------------------------------------------------------

AT_ONCE = 4096
"""Pictures whose residuals are in memory together where only a sum over them is asked for."""


@dataclass(frozen=True)
class System:
    """Problem with its prior, ready to be linearised at any state."""

    problem: Problem
    knowledge: Knowledge
    layout: UnknownLayout
    bound2: float  # of the robust loss
    held: bool = False  # bone lengths stay as they are
    pictures: PictureArrays = field(init=False)
    white_precision: Float = field(init=False)  # [., 6, 6] of each camera, then of logged poses; inf without
    inverse_acceleration: Float = field(init=False)  # [J, J]
    of_time: Int64 = field(init=False)  # [T - 1] the knot before each eliminated time; the last but one
    usual_step_s: float = field(init=False)
    tie_kept: Float = field(init=False)  # [K - 1, c] share of a slow error that is left at the next knot
    tie_variance: Float = field(init=False)  # [K - 1, c] variance added from knot to knot

    def __post_init__(self) -> None:
        """Derive the values that every linearisation needs."""
        problem, known, seen = self.problem, self.knowledge, self.problem.pictures
        of_time, fraction = problem.intervals()
        white_row, white_precision = _loosened(problem, *_white_errors(problem, known.poses))
        kept, variance = _ties(self.layout)
        derived = {
            "pictures": PictureArrays(
                first=seen.first,
                camera=seen.camera,
                when_s=seen.when_s,
                rays=seen.rays,
                sharpness=seen.sharpness / (known.pixel_scale * np.sqrt(known.memory)),
                position=seen.position,
                rotation=seen.rotation,
                speed=seen.speed,
                turn=seen.turn,
                interval=of_time[seen.first],
                fraction=fraction,
                white_row=white_row,
            ),
            "white_precision": white_precision,
            "inverse_acceleration": np.linalg.inv(known.memory * known.acceleration),
            "of_time": np.append(of_time, max(len(problem.knot_t_s) - 2, 0)),
            "usual_step_s": float(np.median(np.diff(problem.t_s))),
            "tie_kept": kept,
            "tie_variance": variance,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of unknowns of a front."""
        return 9 * self.problem.joints + 2 * self.layout.entries.knot_count + self.layout.shared_count

    def equations(self, state: State) -> Equations:
        """Collect the arguments of the kernels."""
        return Equations(
            self.problem.t_s, state, self.pictures, self.layout.entries, self.bound2, self.white_precision
        )

    def grown(self, state: State) -> float:
        """Compute the ratio of the body's size to the one for which the prior of motion and bones holds."""
        lengths = state.shared[self.layout.bone_column :]
        return float(lengths.mean() / self.knowledge.size_m) if len(lengths) else 1.0


def _white_errors(problem: Problem, poses: Sequence[PoseErrors]) -> tuple[Int64, Float]:
    """Compute the inverse covariances [., 6, 6] of white errors, and the row [G] of each picture in them."""
    knot_s = float(problem.knot_t_s[1] - problem.knot_t_s[0])
    pictures, logged = problem.pictures, problem.pose_covariance
    level = np.array([np.repeat(errors.white_with_stray(knot_s), 3) for errors in poses])
    usual = np.full((len(poses), 6, 6), np.inf)
    has = level[:, 0] > 0
    usual[has] = level[has, :, None] ** -2.0 * np.eye(6)
    own = np.array([errors.logged for errors in poses])[pictures.camera] & (pictures.logged >= 0)
    if not own.any():
        return pictures.camera, usual
    stray2 = level**2 - np.repeat(np.square([errors.white for errors in poses]), 3, axis=1)
    of_camera = np.zeros(len(logged), dtype=np.int64)
    of_camera[pictures.logged[own]] = pictures.camera[own]
    added = np.maximum(stray2, EXACT**2)[of_camera]
    precision = np.linalg.inv(logged + added[:, :, None] * np.eye(6))
    return np.where(own, len(poses) + pictures.logged, pictures.camera), np.concatenate([usual, precision])


def _loosened(problem: Problem, row: Int64, precision: Float) -> tuple[Int64, Float]:
    """Add inverse covariances of the pictures in bad stretches of their logs."""
    (loose,) = np.nonzero((problem.pictures.loosened > 0).any(axis=1))
    if not len(loose):
        return row, precision
    known = precision[row[loose]]
    exact = ~np.isfinite(known[:, 0, 0])
    covariance = np.zeros(known.shape)
    covariance[~exact] = np.linalg.inv(known[~exact])
    added = np.maximum(problem.pictures.loosened[loose], EXACT) ** 2
    covariance += np.repeat(added, 3, axis=1)[..., None] * np.eye(6)
    row = row.copy()
    row[loose] = len(precision) + np.arange(len(loose))
    return row, np.concatenate([precision, np.linalg.inv(covariance)])


def _ties(layout: UnknownLayout) -> tuple[Float, Float]:
    """Compute the share kept and the variance added [K - 1, c] from each knot to the next."""
    elapsed_s = np.diff(layout.knot_t_s)
    kept, variance = (
        np.ones((len(elapsed_s), layout.entries.knot_count)),
        np.ones((len(elapsed_s), layout.entries.knot_count)),
    )
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        if at_knots:
            steps = np.array([process.step(float(span)) for span in elapsed_s])
            kept[:, column : column + 3] = steps[:, :1]
            variance[:, column : column + 3] = steps[:, 1:]
    return kept, variance


def misfit(system: System, state: State) -> tuple[float, Float, Float]:
    """Compute the pictures' loss, whitened residuals [G, J, 2] (NaN unseen) and numbers [G, 10]."""
    residual = np.empty(system.pictures.rays.shape)
    numbers = np.empty((len(residual), kernels.NUMBERS))
    equations = system.equations(state)
    return kernels.misfit(equations, 0, 0.0, residual, numbers), residual, numbers


def loss(system: System, state: State) -> float:
    """Compute the loss of the pictures."""
    equations = system.equations(state)
    pictures, joints, _ = system.pictures.rays.shape
    residual, numbers = np.empty((AT_ONCE, joints, 2)), np.empty((AT_ONCE, kernels.NUMBERS))
    total = 0.0
    for first in range(0, pictures, AT_ONCE):
        rows = min(AT_ONCE, pictures - first)
        total = kernels.misfit(equations, first, total, residual[:rows], numbers[:rows])
    return total


def prior_cost(system: System, state: State) -> float:
    """Compute minus twice the logarithm of the prior, up to a constant."""
    layout, rows = system.layout, system.pictures.white_row
    cost = _body_cost(system, state)
    for first in range(0, len(rows), AT_ONCE):
        precision = system.white_precision[rows[first : first + AT_ONCE]]
        there = np.isfinite(precision[:, 0, 0])
        white = state.white[first : first + AT_ONCE][there]
        cost += float(np.sum((precision[there] @ white[..., None])[..., 0] * white))
    for (_, process), (at_knots, column) in zip(layout.processes, layout.place, strict=True):
        begins = state.knots[0] if at_knots else state.shared
        cost += np.sum(begins[column : column + 3] ** 2) / process.sigma0**2
    changes = state.knots[1:] - system.tie_kept * state.knots[:-1]
    cost += np.sum(changes**2 / system.tie_variance)
    clocks = layout.entries.clock_column >= 0
    cost += np.sum((state.shared[layout.entries.clock_column[clocks]] / layout.clock_sigma_s[clocks]) ** 2)
    return float(cost)


def _body_cost(system: System, state: State) -> float:
    """Compute the part of `prior_cost` that is by motion and bones, some times at once."""
    problem, cost = system.problem, 0.0
    lengths = state.shared[system.layout.bone_column :]
    for first in range(0, len(problem.t_s), AT_ONCE):
        some = slice(first, first + AT_ONCE + 2)  # an acceleration takes three times
        t_s, position = problem.t_s[some], state.position[some]
        before, after = np.diff(t_s)[:-1], np.diff(t_s)[1:]
        slopes = np.diff(position, axis=0) / np.diff(t_s)[:, None, None]
        acceleration = 2 * np.diff(slopes, axis=0) / (before + after)[:, None, None]
        weight = 0.5 * (before + after) / system.usual_step_s
        inverse = system.inverse_acceleration
        cost += np.einsum("t,tji,jk,tki->", weight, acceleration, inverse, acceleration, optimize=True)
        ends = position[:AT_ONCE, problem.bones]
        missed = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1) - lengths
        cost += np.sum((missed / system.knowledge.bone_sigma_m) ** 2)
    cost /= system.grown(state) ** 2
    if problem.size is not None:
        cost += problem.size.cost(lengths)
    return float(cost)
