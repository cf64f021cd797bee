"""Input of the refinement: pictures, the skeleton's times, and the priors of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import Bias, Drift, GaussMarkov, Latency, NoiseModel, White

Int64 = NDArray[np.int64]

SHIFT_IN_WORLD, ROTATION, SHIFT_IN_CAMERA, CLOCK = 0, 3, 6, 9
"""First index of each part of a picture's ten numbers (see `kernels`)."""

EXACT = 1e-5
"""Constant error (m and rad) that stands for none, so that the equations stay well posed."""

NEW_SHARE = 0.5
"""White share of a logged variance; a log gives the size of errors, not their correlation over time."""


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
    xy: Float  # [G, J, 2]
    sharpness: Float  # [G, J] 1 / standard deviation of an image point
    trust: Float  # [G, J] 0 for points that must not be used
    position: Float  # [G, 3] m, the logged pose
    rotation: Float  # [G, 3, 3] world_from_camera
    speed: Float  # [G, 3] m/s, world
    turn: Float  # [G, 3] rad/s, camera


@dataclass(frozen=True)
class Process:
    """Pose error of one kind over time, the same on three axes: sigma0 at the start, then a random walk.

    With a correlation time it is a Gauss-Markov process whose standard deviation is always sigma0.
    """

    number: int  # SHIFT_IN_WORLD, ROTATION or SHIFT_IN_CAMERA
    sigma0: float  # m or rad
    rate: float = 0.0  # m or rad per sqrt(s)
    correlation_s: float = np.inf

    @property
    def constant(self) -> bool:
        """True if it never changes."""
        return self.rate == 0 and not np.isfinite(self.correlation_s)

    def stray(self, elapsed_s: float) -> float:
        """Compute the mean variance about the straight line between two values `elapsed_s` apart.

        That of a Brownian bridge, rate^2 s (T - s) / T, over its length; a Gauss-Markov process is
        a walk of rate sigma sqrt(2 / correlation time) over short times.
        """
        rate2 = self.rate**2
        if np.isfinite(self.correlation_s):
            rate2 += 2 * self.sigma0**2 / self.correlation_s
        return min(rate2 * elapsed_s / 6, max(self.sigma0, self.rate) ** 2)

    def step(self, elapsed_s: float) -> tuple[float, float]:
        """Compute the share that is left after some time, and the added variance."""
        if np.isfinite(self.correlation_s):
            kept = float(np.exp(-elapsed_s / self.correlation_s))
            return kept, self.sigma0**2 * (1 - kept**2)
        return 1.0, self.rate**2 * elapsed_s


@dataclass(frozen=True)
class PoseErrors:
    """Prior of one camera's pose errors."""

    white: tuple[float, float]  # m, rad per axis; 0, 0 for none
    processes: tuple[Process, ...]
    logged: bool = False
    """True if white errors have the logged covariance of each pose; `white` is then its level."""

    def white_with_stray(self, knot_s: float) -> Float:
        """Compute the standard deviation [2] (m, rad) of white errors, with slow errors between knots."""
        variance = np.square(self.white)
        for process in self.processes:
            variance[1 if process.number == ROTATION else 0] += process.stray(knot_s)
        if variance.any():
            variance = np.maximum(variance, EXACT**2)
        return np.sqrt(variance)


def pose_errors(models: Sequence[NoiseModel]) -> PoseErrors:
    """Convert stated noise models to a prior.

    Latency is left to the clock: a delayed log and a clock offset differ only where cameras accelerate.

    Raises:
        ValueError: a model is not one of flight.yaml's.
    """
    white = np.zeros(2)
    merged: dict[int, tuple[float, float]] = {}
    processes = []

    def add(number: int, sigma0: float, rate: float) -> None:
        old = merged.get(number, (0.0, 0.0))
        merged[number] = (float(np.hypot(old[0], sigma0)), float(np.hypot(old[1], rate)))

    for model in models:
        match model:
            case White():
                white += np.square([model.position_m, np.radians(model.rotation_deg)])
            case Bias():
                add(_shift(model.frame), model.position_m, 0.0)
                add(ROTATION, float(np.radians(model.rotation_deg)), 0.0)
            case Drift():
                add(_shift(model.frame), 0.0, model.position_m_per_sqrt_s)
                add(ROTATION, 0.0, float(np.radians(model.rotation_deg_per_sqrt_s)))
            case GaussMarkov():
                sizes = ((_shift(model.frame), model.position_m), (ROTATION, np.radians(model.rotation_deg)))
                processes += [
                    Process(number, float(size), correlation_s=model.correlation_s)
                    for number, size in sizes
                    if size > 0
                ]
            case Latency():
                pass
            case _:
                raise ValueError(f"{type(model).__name__} cannot be a prior of the refinement")
    processes += [
        Process(number, max(sigma0, EXACT), rate)
        for number, (sigma0, rate) in sorted(merged.items())
        if sigma0 > 0 or rate > 0
    ]
    # A position without noise beside a rotation with noise (or the reverse) is a very small noise.
    known = np.sqrt(white)
    if known.any():
        known = np.maximum(known, EXACT)
    return PoseErrors((float(known[0]), float(known[1])), tuple(processes))


def _shift(frame: str) -> int:
    return SHIFT_IN_WORLD if frame == "world" else SHIFT_IN_CAMERA


@dataclass(frozen=True)
class Layout:
    """Places of the unknowns other than joints: at knots in time, or shared by all times.

    A process adds to three of its camera's ten numbers. An entry links an unknown to the number it adds to.
    Shared unknowns are constant errors, then clocks, then bone lengths.
    """

    processes: tuple[tuple[int, Process], ...]  # (camera, process)
    place: tuple[tuple[bool, int], ...]  # of each process: at knots?, first column
    entry_start: Int64  # [C + 1]
    entry_number: Int64
    entry_knot: NDArray[np.bool_]
    entry_column: Int64
    clock_column: Int64  # [C], -1 for a known clock
    clock_sigma_s: Float  # [C]
    knot_count: int  # unknowns of one knot
    bone_column: int
    shared_count: int
    knot_t_s: Float  # [K]


def lay_out(errors: Sequence[PoseErrors], clock_sigma_s: Float, bones: int, knot_t_s: Float) -> Layout:
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
    return Layout(
        processes=tuple(processes),
        place=tuple(place),
        entry_start=np.array(start, dtype=np.int64),
        entry_number=np.array(number, dtype=np.int64),
        entry_knot=np.array(knot, dtype=np.bool_),
        entry_column=np.array(column, dtype=np.int64),
        clock_column=clock_column,
        clock_sigma_s=clock_sigma_s,
        knot_count=knot_count,
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
        return int(self.pictures.xy.shape[1])

    def intervals(self) -> tuple[Int64, Float]:
        """Find the knot before each skeleton time [T - 2], and each picture's fraction [G] of the span."""
        last = max(len(self.knot_t_s) - 2, 0)
        of_time = np.clip(np.searchsorted(self.knot_t_s, self.t_s[:-2], side="right") - 1, 0, last)
        if len(self.knot_t_s) < 2:
            return of_time, np.zeros(len(self.pictures.first))
        interval = of_time[self.pictures.first]
        span = np.diff(self.knot_t_s)[interval]
        return of_time, (self.pictures.when_s - self.knot_t_s[interval]) / span


@dataclass(frozen=True)
class State:
    """Values of the unknowns."""

    position: Float  # [T, J, 3] m
    knots: Float  # [K, knot_count]
    shared: Float  # [shared_count]
    white: Float  # [G, 6]

    def moved(self, step: State, share: float) -> State:
        """Return the state moved by a share of a step."""
        return replace(
            self,
            position=self.position + share * step.position,
            knots=self.knots + share * step.knots,
            shared=self.shared + share * step.shared,
            white=self.white + share * step.white,
        )
