"""Gait events of walking people, and what follows from them: cadence, step length, speed.

Events are those of Zeni, Richards and Higginson 2008 (Gait and Posture 27:710), their coordinate method: a
heel strikes when it is furthest ahead of the pelvis, and toes leave the ground when they are furthest behind
it. Where a skeleton has no heels and toes, its ankles replace them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64

SIDES = ("left", "right")
HEEL_STRIKE, TOE_OFF = "heel_strike", "toe_off"

# Zeni et al. filter the feet with this low pass.
_CUTOFF_HZ = 6.0
# The pelvis sways with every step, so its trend lies below the rate of strides.
_TREND_HZ = 0.5
# Somebody who shifts weight stays below the speed of a slow walk.
_MIN_SPEED_MPS = 0.4
# A foot swings by a third of a slow step at least, against the pelvis.
_MIN_SWING_M = 0.2
_STEP_S = (0.2, 1.2)  # shortest and longest time between strikes of both feet: a sprint, a slow walk
# A shorter run of frames has no stride, and its filters have no start.
_MIN_RUN_S = 1.0
# Frames that are further apart than this many frame steps are in different runs.
_MAX_GAP_STEPS = 1.5
# Three strikes are two steps, the fewest that give a cadence.
_MIN_STRIKES = 3


@dataclass(frozen=True)
class GaitEvents:
    """Events of one person, sorted by time, then side. Rows of the same index belong together."""

    row: Int64  # [E] of the person's times
    side: Int64  # [E] index of `SIDES`
    is_strike: Bool  # [E] True for a heel strike, False for a toe-off
    foot: Float  # [E, 3] m, heel (of a strike) or toe, in the world
    step_s: Float  # [E] since the other foot's last strike; NaN for toe-offs and first strikes
    step_m: Float  # [E] how far ahead of the other heel, along the progression; NaN where `step_s` is
    speed_mps: Float  # [E] of the pelvis at that moment, level


def gait_events(joints: Sequence[str], t_ns: Int64, position: Float) -> GaitEvents | None:
    """Find heel strikes and toe-offs of `position` [T, J, 3] m, z up; None for less than two steps."""
    needed = ("left_hip", "right_hip", "left_ankle", "right_ankle")
    if len(t_ns) < 2 or not set(needed).issubset(joints):
        return None
    hips = _points(joints, position, "hip").mean(axis=0)
    heels, toes = (_points(joints, position, name) for name in ("heel", "big_toe"))
    found: list[tuple[int, int, bool, Float, float, float]] = []
    step_ns = float(np.median(np.diff(t_ns)))
    for run in _runs(t_ns, np.isfinite(np.concatenate([[hips], heels, toes])).all(axis=(0, 2)), step_ns):
        found += _events_of(run.start, hips[run], heels[:, run], toes[:, run], 1e9 / step_ns)
    found.sort(key=lambda event: event[:2])
    walked = _with_steps(found, t_ns)
    strikes = np.count_nonzero(np.isfinite(walked.step_s))
    return walked if strikes >= _MIN_STRIKES - 1 else None


def summary(events: GaitEvents, t_ns: Int64, joints: Sequence[str]) -> dict[str, object]:
    """Summarise the events of one person: figures of `metrics.json`."""
    steps = np.isfinite(events.step_s)
    lengths = {
        f"{side}_step_m": _mean_sd(events.step_m[steps & (events.side == index)])
        for index, side in enumerate(SIDES)
    }
    return {
        "strikes": int(events.is_strike.sum()),
        "toe_offs": int((~events.is_strike).sum()),
        "steps": int(steps.sum()),
        "cadence_per_min": 60.0 / float(np.mean(events.step_s[steps])),
        "step_s": _mean_sd(events.step_s[steps]),
        "step_m": _mean_sd(events.step_m[steps]),
        **lengths,
        "speed_mps": _mean_sd(events.speed_mps[events.is_strike]),
        "feet": "heels and toes" if {"left_heel", "left_big_toe"} <= set(joints) else "ankles",
        "from_ns": int(t_ns[events.row[0]]),
        "to_ns": int(t_ns[events.row[-1]]),
    }


def _mean_sd(values: Float) -> dict[str, float | int | None]:
    """Return mean, standard deviation between steps, and number; None where there are too few."""
    return {
        "mean": float(values.mean()) if len(values) else None,
        "sd": float(values.std(ddof=1)) if len(values) > 1 else None,
        "count": len(values),
    }


def _points(joints: Sequence[str], position: Float, name: str) -> Float:
    """Return [2, T, 3], left first; ankles for a part of the foot that the skeleton lacks."""
    there = all(f"{side}_{name}" in joints for side in SIDES)
    return np.stack([position[:, joints.index(f"{side}_{name if there else 'ankle'}")] for side in SIDES])


def _runs(t_ns: Int64, known: Bool, step_ns: float) -> list[slice]:
    begins = known & np.concatenate([[True], ~known[:-1] | (np.diff(t_ns) > _MAX_GAP_STEPS * step_ns)])
    starts = np.flatnonzero(begins)
    runs = []
    limits = [*starts[1:], len(known)][: len(starts)]  # none where no frame is known
    for start, limit in zip(starts, limits, strict=True):
        stop = start + int(np.argmin(np.append(known[start:limit], False)))
        if (stop - start) * step_ns >= _MIN_RUN_S * 1e9:
            runs.append(slice(int(start), stop))
    return runs


def _events_of(
    start: int, hips: Float, heels: Float, toes: Float, rate_hz: float
) -> list[tuple[int, int, bool, Float, float, float]]:
    """Find the events of one run: row, side, strike or not, foot, length of the step, speed."""
    trend = _low_pass(hips[:, :2], _TREND_HZ, rate_hz)
    velocity = np.gradient(trend, 1 / rate_hz, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    forward = velocity / np.maximum(speed, 1e-9)[:, None]
    found = []
    for side in range(2):
        for is_strike, feet in ((True, heels), (False, toes)):
            ahead = np.einsum("td,td->t", feet[side, :, :2] - hips[:, :2], forward)
            smooth = _low_pass(ahead, _CUTOFF_HZ, rate_hz)
            rows = _peaks(smooth if is_strike else -smooth, _MIN_SWING_M)
            for row in rows[speed[rows] >= _MIN_SPEED_MPS].tolist():
                apart = heels[side, row, :2] - heels[1 - side, row, :2]
                length = float(apart @ forward[row])
                found.append((start + row, side, is_strike, feet[side, row], length, float(speed[row])))
    return found


def _peaks(values: Float, prominence: float) -> Int64:
    """Find the rows of maxima that stand out by so much on both sides, up to the next higher value."""
    rises = np.diff(values)
    found = []
    for row in (1 + np.flatnonzero((rises[:-1] > 0) & (rises[1:] <= 0))).tolist():
        (higher,) = np.nonzero(values > values[row])
        place = int(np.searchsorted(higher, row))
        begin, end = np.concatenate([[-1], higher, [len(values)]])[place : place + 2]
        lowest = max(values[begin + 1 : row].min(), values[row + 1 : end].min())
        found += [row] if values[row] - lowest >= prominence else []
    return np.array(found, dtype=np.int64)


def _low_pass(values: Float, cutoff_hz: float, rate_hz: float) -> Float:
    """Filter along the first axis, without delay: Butterworth's second order, forwards and backwards.

    Both passes have the gain 1 / (1 + (tan(w / 2) / tan(c / 2))^4). So has the least of
    |S (x - y)|^2 + |D x|^2 / tan(c / 2)^4, with sums S and differences D of second order; its ends are free.
    Three values leave one combination open: fewer than four stay as they are.
    """
    from scipy.linalg import solveh_banded

    if cutoff_hz >= 0.45 * rate_hz or len(values) < 4:
        return values
    middle = values.mean(axis=0)  # far from the origin, rounding would count
    values = values - middle
    stiffness = np.tan(np.pi * cutoff_hz / rate_hz) ** -4
    count = len(values) - 2
    band, right = np.zeros((3, len(values))), np.zeros_like(values)
    summed = values[:-2] + 2 * values[1:-1] + values[2:]
    for i, of in enumerate((1.0, 2.0, 1.0)):
        right[i : i + count] += of * summed
        for j, other in enumerate((1.0, 2.0, 1.0)[i:]):
            sign = -1.0 if j == 1 else 1.0  # of neighbours in a difference
            band[j, i : i + count] += of * other * (1.0 + sign * stiffness)
    return np.asarray(solveh_banded(band, right, lower=True) + middle)


def _with_steps(found: list[tuple[int, int, bool, Float, float, float]], t_ns: Int64) -> GaitEvents:
    """Add to each strike the time since the strike of the other foot, if that is a step."""
    row = np.array([event[0] for event in found], np.int64)
    side = np.array([event[1] for event in found], np.int64)
    is_strike = np.array([event[2] for event in found], np.bool_)
    step_s, step_m = np.full(len(found), np.nan), np.full(len(found), np.nan)
    last: tuple[int, float] | None = None
    for index in np.flatnonzero(is_strike).tolist():
        now = float(t_ns[row[index]]) / 1e9
        if last is not None and last[0] != side[index] and _STEP_S[0] <= now - last[1] <= _STEP_S[1]:
            step_s[index], step_m[index] = now - last[1], found[index][4]
        last = (int(side[index]), now)
    foot = np.array([event[3] for event in found]).reshape(-1, 3)
    speed = np.array([event[5] for event in found])
    return GaitEvents(row, side, is_strike, foot, step_s, step_m, speed)
