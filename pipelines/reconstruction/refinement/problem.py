"""Refinement problem: pictures, the skeleton's times, the priors of errors, and their construction."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import PoseErrors, Process
from pipelines.reconstruction.refinement.kernels import Entries

CLOCK = 9
"""Index of the clock offset among a picture's ten numbers (see `kernels`)."""


REMEMBERED = 1.5
"""Memory (correlation length) of keypoint errors above which it is taken into account."""


@dataclass(frozen=True)
class Pictures:
    """G pictures of C cameras, sorted by `first`, then camera.

    Image points are normalised and undistorted, NaN for joints not seen. `first` is the first of the
    three times of the skeleton between which a picture's joints are interpolated.
    """

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
    """Number of neighbouring image points of a joint in a camera that count as one independent point."""


@dataclass(frozen=True)
class Problem:
    """Refinement problem without the parameters of the prior."""

    t_s: Float  # [T] the skeleton's times, at least three
    pictures: Pictures
    bones: Int64  # [B, 2]
    knot_t_s: Float  # [K]
    pose_covariance: Float = field(default_factory=lambda: np.empty((0, 6, 6)))
    """Covariances [L, 6, 6] of logged white pose errors: world shift (m), camera rotation vector (rad)."""
    threads: int = 1
    """Largest number of threads; the results do not depend on it."""

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


def build(
    t_s: Float,
    sightings: Sequence[Sighting],
    bones: Int64,
    *,
    threads: int = 1,
) -> Problem:
    """Build the problem: sort pictures by the skeleton's times around them; leave out those near none.

    Args:
        t_s: [T] strictly increasing times of the skeleton, at least three.
        sightings: keypoints and poses of each camera.
        bones: [B, 2] joints with a nearly constant distance.
        threads: see `Problem`.
    """
    step = float(np.median(np.diff(t_s)))
    covariances, logged = [np.empty((0, 6, 6))], 0
    firsts, kepts = [], []
    for sighting in sightings:
        first, near = _first_of_three(t_s, sighting.t_s, step)
        (kept,) = np.nonzero(near & sighting.range_of)
        firsts.append(first[kept])
        kepts.append(kept)
    first = np.concatenate(firsts)
    camera = np.repeat(np.arange(len(sightings)), [len(kept) for kept in kepts])
    order = np.lexsort((camera, first))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    pictures = _empty_pictures(len(order), sightings[0].rays.shape[1])
    pictures.first[place], pictures.camera[place] = first, camera
    for number, (sighting, kept) in enumerate(zip(sightings, kepts, strict=True)):
        _fill(pictures, place[camera == number], sighting, kept, logged)
        if sighting.pose_covariance is not None:
            covariances.append(sighting.pose_covariance)
            logged += len(sighting.t_s)
    knots = max(int(np.ceil((t_s[-1] - t_s[0]) / KNOT_S)) + 1, 2)
    knot_t_s = np.linspace(t_s[0], t_s[-1], knots)
    return Problem(t_s, pictures, bones, knot_t_s, np.concatenate(covariances), threads)


def _empty_pictures(count: int, joints: int) -> Pictures:
    """Make room for pictures."""
    return Pictures(
        first=np.empty(count, dtype=np.int64),
        camera=np.empty(count, dtype=np.int64),
        logged=np.full(count, -1),
        when_s=np.empty(count),
        rays=np.empty((count, joints, 2)),
        sharpness=np.empty((count, joints)),
        position=np.empty((count, 3)),
        rotation=np.empty((count, 3, 3)),
        speed=np.empty((count, 3)),
        turn=np.empty((count, 3)),
        loosened=np.zeros((count, 2)),
    )


def _fill(pictures: Pictures, place: Int64, sighting: Sighting, kept: Int64, logged: int) -> None:
    """Write a camera's pictures to their places; its logged poses begin at row `logged`."""
    speed, turn = _rates(sighting)
    seen = ~np.isnan(sighting.rays[kept, :, 0]) & (sighting.confidence[kept] > 0)
    sharpness = np.where(seen, sighting.confidence[kept], 0.0) * sighting.focal_px / sighting.pixel_sigma
    if sighting.pose_covariance is not None:
        pictures.logged[place] = logged + kept
    pictures.when_s[place] = sighting.t_s[kept]
    pictures.rays[place] = np.where(seen[..., None], sighting.rays[kept], np.nan)
    pictures.sharpness[place] = sharpness
    pictures.position[place] = sighting.position[kept]
    pictures.rotation[place] = sighting.rotation[kept]
    pictures.speed[place], pictures.turn[place] = speed[kept], turn[kept]
    if sighting.loosened is not None:
        pictures.loosened[place] = sighting.loosened[kept]


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
    """Compute speed [F, 3] (m/s) in the world and turn rate [F, 3] (rad/s) in the camera; 0 where unknown.

    Rates are taken over half a second. From picture to picture, noisy poses would give rates larger than
    people's motion, and estimated clock offsets would be too small.
    """
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
