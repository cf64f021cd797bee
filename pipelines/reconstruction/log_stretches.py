"""Stretches of a log that lose their weight: it stood still and then jumped, or it jumped away and back.

Positions that jump and stay there count from another place since. They are moved to that of most of the time.

An estimator that hangs repeats its last pose, and a log that is stepped repeats each pose until the next. The
poses that are repeated are wrong as soon as the camera moves on. They are bridged: interpolated between the
last pose before and the first one after, and loosened by how far a drone may leave that line meanwhile.
Positions and rotations are judged apart, as they come from different sensors.

A camera that stands, or hovers, takes no such step, and is left as it is. Where a log is rounded to more than
`LEAST_STEP` it does; its poses are then loosened by no more than the step.
"""

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import interpolate_poses, multiply, rotation_vector_from_quaternion
from pipelines.session.records import Trajectory

# --- tuning ---

# The least step (m, rad) after equal poses, and of a jump: noise of logs that are rounded to cm is smaller.
LEAST_STEP = (0.05, float(np.radians(0.5)))
LEAST_JUMP = (0.5, float(np.radians(5.0)))

# A jump is so many times larger than nine of ten steps of the log.
STEPS_OF_JUMP = 8.0

# A log that comes back from a jump later than this (s) has another origin since, rather than a fault.
LONGEST_JUMP_S = 5.0

# A larger step of positions is one of their origin: drones accelerate by less (m/s^2), and in normal noise no
# step is so many times as large as nine of ten.
MOST_ACCELERATION_MPS2, STEPS_OF_ORIGIN = 15.0, 3.0

# A step beside which another one leads back by this share of it is one of a pair.
BACK = 0.75

# Lines are laid through the positions of this time (s) before and after, and through so many at most.
FITTED_S, MOST_FITTED = 0.2, 8

# A drone leaves a straight line by this in a second (m, rad), and by the square of the time in longer ones.
LEFT_IN_A_SECOND = (0.25, 0.025)

# With these standard deviations (m, rad) a log has no weight: more are not needed.
MOST_SIGMA = (1.0, 0.1)


@dataclass(frozen=True)
class Mended:
    """Log without its wrong stretches."""

    trajectory: Trajectory
    loosened: Float | None  # [N, 2] added standard deviations (m, rad) of its poses; None without a stretch
    frozen: int  # stretches of equal poses before a step
    jumps: int  # stretches that begin and end with a jump
    poses: int  # that are bridged
    longest_s: float
    steps: int = 0  # of positions that stay
    stepped_m: float = 0.0  # standard deviation per axis of a constant error that they leave


def mend(log: Trajectory) -> Mended:
    """Bridge the wrong stretches of a log of N poses."""
    loosened = np.zeros((len(log.t_ns), 2))
    counts, longest_s = np.zeros(2, dtype=np.int64), 0.0
    bridged = log
    quaternion = log.quaternion_xyzw
    turns = rotation_vector_from_quaternion(multiply(quaternion[:-1] * [-1, -1, -1, 1], quaternion[1:]))
    turns[(quaternion[1:] == quaternion[:-1]).all(axis=1)] = 0.0
    for kind, steps in enumerate((np.diff(log.position, axis=0), turns)):
        stretches = _frozen(steps, LEAST_STEP[kind])
        away = _jumps(log.t_ns, steps, LEAST_JUMP[kind])
        counts += [len(stretches), len(away)]
        # A log that stands, and then steps a little, was never further away than that.
        sizes = [float(np.linalg.norm(steps[after - 1])) for _, after in stretches]
        for (before, after), most in zip([*stretches, *away], [*sizes, *len(away) * [np.inf]], strict=True):
            inside = slice(before + 1, after)
            span_s = float(log.t_ns[after] - log.t_ns[before]) / 1e9
            longest_s = max(longest_s, span_s)
            bridged = _bridged(bridged, before, after, kind)
            sigma = min(LEFT_IN_A_SECOND[kind] * span_s**2, most, MOST_SIGMA[kind])
            loosened[inside, kind] = np.maximum(loosened[inside, kind], sigma)
    poses = int((loosened > 0).any(axis=1).sum())
    mended = Mended(bridged, loosened, int(counts[0]), int(counts[1]), poses, longest_s)
    return _of_one_origin(mended if poses else Mended(log, None, 0, 0, 0, 0.0))


def _frozen(steps: Float, least: float) -> list[tuple[int, int]]:
    """Find the pose that is repeated and the first one after it, of every stretch of equal poses."""
    size = np.linalg.norm(steps, axis=1)
    edges = np.flatnonzero(np.diff(size == 0.0, prepend=False, append=False)).reshape(-1, 2)
    return [(int(first), int(last) + 1) for first, last in edges if last < len(size) and size[last] >= least]


def _jumps(t_ns: Int64, steps: Float, least: float) -> list[tuple[int, int]]:
    """Find the last pose before a jump and the first after the way back."""
    size = np.linalg.norm(steps, axis=1)
    usual = float(np.quantile(size, 0.9)) if len(size) else 0.0
    far = np.flatnonzero(size > max(least, STEPS_OF_JUMP * usual)).tolist()
    found: list[tuple[int, int]] = []
    for out, back in pairwise(far):
        if found and found[-1][1] > out:
            continue
        returns = np.linalg.norm(steps[out] + steps[back]) < 0.5 * size[out]
        if returns and t_ns[back] - t_ns[out] < 1e9 * LONGEST_JUMP_S:
            found.append((out, back + 1))
    return found


def _of_one_origin(mended: Mended) -> Mended:
    """Move the parts of a log between steps that no drone can fly to the origin of most of its time."""
    log = mended.trajectory
    t_s = (log.t_ns - log.t_ns[0]) / 1e9
    count = int(np.clip(round(FITTED_S / np.median(np.diff(t_s))), 2, MOST_FITTED)) if len(t_s) > 1 else 2
    if len(t_s) < 2 * count:
        return mended
    window = partial(np.lib.stride_tricks.sliding_window_view, window_shape=count, axis=0)
    times, places = window(t_s), window(log.position)
    mean_s, mean = times.mean(axis=1), places.mean(axis=2)
    apart_s = times - mean_s[:, None]
    speed = np.einsum("nak,nk->na", places, apart_s) / np.sum(apart_s**2, axis=1)[:, None]
    # Lines through the poses before and after the middle of each step; by how much they miss each other. An
    # acceleration that turns round in the middle lets two pairs of poses miss by a twelfth of a t^2.
    middle_s = (t_s[count - 1 : -count] + t_s[count : len(t_s) - count + 1]) / 2
    before, after = slice(None, -count), slice(count, None)
    ends = [mean[of] + (middle_s - mean_s[of])[:, None] * speed[of] for of in (before, after)]
    beyond = ends[1] - ends[0]
    size = np.linalg.norm(beyond, axis=1)
    least = np.maximum(
        MOST_ACCELERATION_MPS2 / 12 * (times[after, -1] - times[before, 0]) ** 2, LEAST_JUMP[0]
    )
    least = np.maximum(least, STEPS_OF_ORIGIN * np.quantile(size, 0.9))
    largest = maximum_filter1d(size, 2 * count + 1)
    (at,) = np.nonzero((size > least) & (size == largest))
    # Poses that are wrong for a moment step away and back by more than lines lean beside a step that stays.
    near = [beyond[max(k - 2 * count, 0) : k + 2 * count + 1] @ beyond[k] for k in at.tolist()]
    stay = [bool(each.min() > -BACK * size[k] ** 2) for k, each in zip(at.tolist(), near, strict=True)]
    at = at[np.array(stay, dtype=np.bool_)]
    beyond, at = beyond[at], at + count - 1
    if not len(at) or (len(at) - 1) * LONGEST_JUMP_S > t_s[-1] - t_s[0]:  # a log that always steps has one
        return mended
    origin = np.concatenate([np.zeros((1, 3)), np.cumsum(beyond, axis=0)])
    bounds = np.concatenate([[0], at + 1, [len(t_s)]])
    lasts_s = t_s[bounds[1:] - 1] - t_s[bounds[:-1]]
    apart = np.linalg.norm(origin[:, None] - origin, axis=-1)
    away = origin - origin[np.argmax((apart < LEAST_JUMP[0]) @ lasts_s)]
    moved = replace(log, position=log.position - np.repeat(away, np.diff(bounds), axis=0))
    stepped_m = np.sqrt(lasts_s @ np.sum(away**2, axis=1) / lasts_s.sum() / 3)
    return replace(mended, trajectory=moved, steps=len(at), stepped_m=float(stepped_m))


def _bridged(log: Trajectory, before: int, after: int, kind: int) -> Trajectory:
    """Interpolate positions (kind 0) or rotations (1) between two poses."""
    ends, inside = [before, after], slice(before + 1, after)
    position, quaternion = interpolate_poses(
        log.t_ns[ends],
        log.position[ends],
        log.quaternion_xyzw[ends],
        log.t_ns[inside],
        max_gap_ns=int(log.t_ns[after] - log.t_ns[before]),
    )
    if kind == 0:
        own = log.position.copy()
        own[inside] = position
        return replace(log, position=own)
    own = log.quaternion_xyzw.copy()
    own[inside] = quaternion
    return replace(log, quaternion_xyzw=own)


def warnings_of_stretches(name: str, mended: Mended) -> list[str]:
    """State which poses of a camera's log lost their weight."""
    jumps = f"{name}: its logged positions jump as no drone flies, and stay there (jumps: {mended.steps})"
    moved = f"{jumps}; they are moved to the origin of most of the time" if mended.steps else ""
    if not mended.poses:
        return [moved] if moved else []
    what = [
        f"{count} {word}"
        for count, word in (
            (mended.frozen, "stretches of equal poses before a step"),
            (mended.jumps, "jumps and back"),
        )
        if count
    ]
    return [
        f"{name}: its log has {' and '.join(what)}, for up to {mended.longest_s:.2f} s:"
        f" {mended.poses} poses are interpolated over them and count less",
        *([moved] if moved else []),
    ]
