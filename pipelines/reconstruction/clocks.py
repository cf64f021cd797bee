"""Clock offsets that the rays of people show: limbs that move meet at the right times only.

Pose errors move all joints of a view together and must not count. So the disagreement of views is measured
beside the median residual of each view.

A clock that the manifest states is no exception. It is held, and questioned: `wrong_clocks` finds the cameras
whose views agree clearly better with the others at another time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, combinations
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.triangulation import PIXEL_SIGMA_PX, Views, triangulate

# --- tuning ---

# Limbs swing for longer than this: a step of the search cannot jump over the right offset.
SEARCH_STEP_S = 1 / 15

# An offset is searched to two standard deviations of what is stated of it.
SEARCH_REACH_SIGMAS = 2.0

# At most offsets, views must disagree more than at the best one by so many times what chance does.
MIN_CONTRAST = 2.0

# A stated clock is questioned with this prior (s): mistaken starts are off by up to a second.
QUESTIONED_SIGMA_S = 0.5

# A stated clock is moved only beyond both limits: smaller offsets of right clocks occur by chance.
MIN_SIGMAS_TO_MOVE = 5.0
# A smaller offset matters less than the keypoints' own errors.
MIN_OFFSET_TO_MOVE_S = 0.010

# Where a background would miss an offset of this size (s), the rays of people are asked, too.
OFFSET_TO_FIND_S = 0.05

# Keypoint errors pull right clocks by up to 18 ms. Rays of people therefore show offsets from here on only.
MIN_OFFSET_BY_PEOPLE_S = 0.030

# The search is the evidence against a clock. It is moved only where the new offset is surer than the old one.
MIN_SIGMAS_BY_PEOPLE = 2.0

# Correlations of residuals below this are chance.
LEAST_CORRELATION = 0.05

# Joints of a limb, a hand or a face err alike: a person has so many independent ones at most.
INDEPENDENT_JOINTS = 8

# A larger offset must explain more: a gait repeats, and people are mixed up. By this factor for each second.
RATIO_PER_S = 0.1

# Views that still disagree by so many standard deviations of a keypoint have another cause than a clock.
MAX_LEFT_SIGMAS = 2.0

# The mean residual of a joint over this time (s) is a lasting error of the detector.
LASTING_S = 2.0

# The largest tenth of residuals are outliers, and count as much as the next.
USUAL_SHARE = 0.9

# Residuals of fewer times say nothing, nor do those of less than this share of the times that are stated.
FEWEST_TIMES = 20
# Residuals of a smaller share of the stated times are another sample, and cannot be compared.
LEAST_SHARE_OF_TIMES = 0.5

# The search looks at steps of this size (s) around zero and around the best offset.
FINE_STEP_S = 1 / 60
# So many fine steps on each side reach over to the neighbouring coarse ones.
FINE_STEPS = 3

# Of so many suspects all sets are tried, which are fifteen at most.
MOST_IN_SETS = 4

# Of two cameras, a shift of either explains the same. Within this factor, the reference's clock is right.
ALIKE_RATIO = 1.05


@dataclass(frozen=True)
class FoundClocks:
    """Clock offsets that the backgrounds or the keypoints determine."""

    offset_s: Float  # [C] to add to the pictures' times
    sigma_s: Float  # [C] posterior standard deviation; a fine step where only the search found it, 0 if held
    prior_s: Float  # [C] prior standard deviation for later estimates; 0 for clocks that are held
    common_sigma_s: float = 0.0  # of an offset that all clocks share, apart from `sigma_s`
    wrong: Mapping[str, str] = field(default_factory=dict)  # evidence against each stated clock that is moved
    late_logs_s: Mapping[str, float] = field(default_factory=dict)  # to take off the times of logs
    undetermined: tuple[str, ...] = ()  # cameras whose clocks pictures do not determine

    def with_others(self, found: FoundClocks) -> FoundClocks:
        """Add the offsets that keypoints show for cameras that these already shift; their deviations stay."""
        sigma_s = np.where(self.sigma_s > 0, self.sigma_s, found.sigma_s)
        wrong = {**found.wrong, **self.wrong}
        offset_s, logs = self.offset_s + found.offset_s, self.late_logs_s
        return replace(found, offset_s=offset_s, sigma_s=sigma_s, wrong=wrong, late_logs_s=logs)

    def with_late_logs(self, names: Sequence[str], late: Bool) -> FoundClocks:
        """Move the logs of some cameras [C] against their pictures, in place of the pictures."""
        of_log = {name: float(self.offset_s[c]) for c, name in enumerate(names) if late[c]}
        wrong = {**self.wrong, **dict.fromkeys(of_log, "log")}
        return replace(self, offset_s=np.where(late, 0.0, self.offset_s), wrong=wrong, late_logs_s=of_log)

    def warnings(self) -> list[str]:
        """List clocks that pictures do not determine: nobody moved, or straight camera paths compensate."""
        return [
            f"the videos do not determine the clock of {name}: it is as uncertain as flight.yaml says"
            for name in self.undetermined
        ]

    def as_metrics(self, names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Return what metrics.json says of the clocks of all cameras."""
        offset_s = dict(zip(names, self.offset_s.tolist(), strict=True))
        sigmas = np.hypot(self.sigma_s, self.common_sigma_s).tolist()
        found: dict[str, dict[str, Any]] = {
            "clock_offsets_s": offset_s,
            "clock_offset_sigmas_s": dict(zip(names, sigmas, strict=True)),
        }
        if self.wrong:
            moved_s = offset_s | {name: -late_s for name, late_s in self.late_logs_s.items()}
            found["clocks_moved"] = {
                name: {"offset_s": moved_s[name], "sigma_s": found["clock_offset_sigmas_s"][name], "by": by}
                for name, by in self.wrong.items()
            }
        return found


def is_wrong(offset_s: Float, sigma_s: Float) -> Bool:
    """Test if the evidence against stated clocks is strong, and their offsets are large enough to matter."""
    least_s = np.maximum(MIN_SIGMAS_TO_MOVE * sigma_s, MIN_OFFSET_TO_MOVE_S)
    return np.asarray(np.abs(offset_s) > least_s)


def searched_offsets_s(
    views_at: Callable[[float], Views], t_s: Float, clock_sigma_s: Float
) -> tuple[Float, Bool]:
    """Find offsets [C] s of unknown clocks where views agree best, to a fine step, and if rays show them [C].

    `views_at` returns the views with all unknown clocks moved forward by seconds, the same number of
    joint-frames at each of the times `t_s` [T]; `clock_sigma_s` [C] is 0 for a known clock. Where nobody
    moves, views agree equally well at all offsets but for chance; such clocks stay. So do clocks whose best
    offset leaves less than half of the stated times, and all if none is known.
    """
    found_s, shown = np.zeros(len(clock_sigma_s)), np.zeros(len(clock_sigma_s), dtype=np.bool_)
    unknown = np.flatnonzero(clock_sigma_s > 0)
    if not len(unknown) or len(unknown) == len(found_s):
        return found_s, shown
    window, at = _window(t_s), {}

    def logarithm(camera: int, shift_s: float) -> tuple[float, Float]:
        if shift_s not in at:
            at[shift_s] = views_at(shift_s)
        beside = at[shift_s].of((clock_sigma_s == 0) | (np.arange(len(found_s)) == camera))
        missed = _missed_px(beside, len(t_s), int((clock_sigma_s[:camera] == 0).sum()))
        enough = len(missed) >= FEWEST_TIMES
        return (float(np.log(_changing_px(missed, window))) if enough else np.inf), missed

    for camera in unknown.tolist():
        steps = int(SEARCH_REACH_SIGMAS * clock_sigma_s[camera] / SEARCH_STEP_S)
        if not steps:
            shown[camera] = True  # the joint estimate finds less than one step
            continue
        shifts_s = SEARCH_STEP_S * np.arange(-steps, steps + 1)
        logarithms = np.array([logarithm(camera, each)[0] for each in shifts_s.tolist()])
        if not np.isfinite(logarithms).any():
            continue
        best_s = float(shifts_s[np.argmin(logarithms)])
        count = _independent(logarithm(camera, best_s)[1])
        cost = 2 * count * logarithms + (shifts_s / clock_sigma_s[camera]) ** 2
        best_s = float(shifts_s[np.argmin(cost)])
        # Chance changes the cost of so many independent residuals by this.
        usual = np.median(cost[np.isfinite(cost)])  # at other offsets the camera sees nothing
        clear = usual - cost.min() > MIN_CONTRAST * np.sqrt(2 * count)
        times, stated = (len(logarithm(camera, each)[1]) for each in (best_s, 0.0))
        shown[camera] = clear and times >= LEAST_SHARE_OF_TIMES * stated
        if shown[camera] and best_s != 0:
            around_s = best_s + FINE_STEP_S * np.arange(-FINE_STEPS, FINE_STEPS + 1)
            found_s[camera] = min(around_s.tolist(), key=lambda each: logarithm(camera, each)[0])
    return found_s, shown


def wrong_clocks(views_at: Callable[[float], Views], t_s: Float, questioned: Bool, reference: int) -> Float:
    """Find clocks [C] s at whose stated times views disagree clearly more than at other times; 0 for others.

    One clock after the other is moved: that which lowers the disagreement most, so most must be right.
    `views_at` is as for `searched_offsets_s`, `t_s` [T] the times, `questioned` [C] who may be wrong. Of two
    that explain the same, the clock of `reference` is right.
    """
    steps = int(SEARCH_REACH_SIGMAS * QUESTIONED_SIGMA_S / SEARCH_STEP_S)
    shifts_s = SEARCH_STEP_S * np.arange(-steps, steps + 1)
    shifts_s = np.union1d(shifts_s, [-2 * FINE_STEP_S, 2 * FINE_STEP_S])
    at = {shift_s: views_at(shift_s) for shift_s in shifts_s.tolist()}
    offset_s, current, open_ = np.zeros(len(questioned)), at[0.0], np.flatnonzero(questioned).tolist()
    window = _window(t_s)

    def missed_px(camera: int, shift_s: float) -> Float:
        if shift_s not in at:
            at[shift_s] = views_at(shift_s)
        return _missed_px(_with_camera(current, at[shift_s], camera), len(t_s), camera)

    def ratio(camera: int, shift_s: float) -> float:
        missed = missed_px(camera, shift_s)
        if len(missed) < LEAST_SHARE_OF_TIMES * times[camera]:
            return np.inf
        after = _changing_px(missed, window)
        price = 1 + RATIO_PER_S * abs(shift_s)
        return price * after / before[camera] if after <= MAX_LEFT_SIGMAS * PIXEL_SIGMA_PX else np.inf

    while open_ and np.count_nonzero(offset_s) < len(offset_s) - 1:  # one clock gives the time
        stated = {camera: _missed_px(current, len(t_s), camera) for camera in open_}
        open_ = [camera for camera in open_ if len(stated[camera]) >= FEWEST_TIMES]
        before = {camera: _changing_px(stated[camera], window) for camera in open_}
        times = {camera: len(stated[camera]) for camera in open_}
        best = {camera: min((ratio(camera, each), each) for each in shifts_s.tolist()) for camera in open_}
        least = min((value for value, _ in best.values()), default=np.inf)
        if not least < 1:
            break
        alike = [camera for camera in open_ if best[camera][0] <= ALIKE_RATIO * least]
        chosen = min(alike, key=lambda camera: (camera == reference, best[camera]))
        around_s = best[chosen][1] + FINE_STEP_S * np.arange(-FINE_STEPS, FINE_STEPS + 1)
        value, found_s = min((ratio(chosen, each), each) for each in around_s.tolist())
        gain = -2 * _independent(missed_px(chosen, found_s)) * np.log(value)
        if not gain >= MIN_SIGMAS_TO_MOVE**2:
            break
        open_.remove(chosen)
        if abs(found_s) >= MIN_OFFSET_BY_PEOPLE_S:
            offset_s[chosen], current = found_s, _with_camera(current, at[found_s], chosen)
    return offset_s


def meeting_best(views_with: Callable[[Bool], Views], suspects: Bool, t_s: Float) -> Bool:
    """Find the `suspects` [C] with whose change the rays of people meet best, none if not clearly.

    `views_with` returns the views after a change of some [C] of them, at the times `t_s` [T]. All sets of
    suspects are tried; of many suspects each one and all together.
    """
    (among,) = np.nonzero(suspects)
    none = np.zeros_like(suspects)
    before, best, most = views_with(none), none, MIN_CONTRAST
    sizes = range(1, len(among) + 1) if len(among) <= MOST_IN_SETS else (1, len(among))
    for some in chain.from_iterable(combinations(among.tolist(), size) for size in sizes):
        changed = none.copy()
        changed[list(some)] = True
        missed = [_missed_px(each, len(t_s), some[0]) for each in (before, views_with(changed))]
        if min(map(len, missed)) < FEWEST_TIMES:
            continue
        old, new = (_changing_px(each, _window(t_s)) for each in missed)
        count = _independent(missed[1])
        gain = np.sqrt(2 * count) * np.log(old / new)  # in units of what chance brings
        best, most = (changed, gain) if gain > most else (best, most)
    return best


def _independent(missed: Float) -> float:
    """Estimate how many independent residuals there are [T, J, C, 2]: neighbours in time are alike."""
    missed = missed - _mean(missed)
    variance, alike = float(np.nanmean(missed**2)), 1.0
    for lag in range(1, len(missed) // 4):
        correlation = float(np.nanmean(missed[lag:] * missed[:-lag])) / variance
        if correlation < LEAST_CORRELATION:
            break
        alike += 2 * correlation
    joints = int(np.isfinite(missed[..., 0]).any(axis=(0, 2)).sum())
    return float(len(missed) / alike * max(2 * missed.shape[2] - 3, 1) * min(joints, INDEPENDENT_JOINTS))


def _with_camera(views: Views, other: Views, camera: int) -> Views:
    """Take one camera's rays and poses from other views."""
    rays, weight = views.rays.copy(), views.weight.copy()
    position, rotation = views.position.copy(), views.rotation.copy()
    rays[:, camera], weight[:, camera] = other.rays[:, camera], other.weight[:, camera]
    position[:, camera], rotation[:, camera] = other.position[:, camera], other.rotation[:, camera]
    return replace(views, rays=rays, weight=weight, position=position, rotation=rotation)


def _window(t_s: Float) -> float:
    """Count the times over which the mean residual of a joint is a lasting error."""
    return LASTING_S / max(float(np.median(np.diff(t_s))), 1e-3) if len(t_s) > 1 else 1.0


def _changing_px(missed: Float, window: float) -> float:
    """Compute the rms of residuals [T, J, C, 2] px without each joint's mean in a camera over some times."""
    parts = np.array_split(missed, max(round(len(missed) / window), 1))
    apart = np.concatenate([np.linalg.norm(part - _mean(part), axis=-1).ravel() for part in parts])
    apart = apart[np.isfinite(apart)]
    return float(np.sqrt(np.mean(np.minimum(apart, np.quantile(apart, USUAL_SHARE)) ** 2)))


def _mean(values: Float) -> Float:
    """Compute the mean over the first axis without NaN; 0 where all are NaN."""
    count = np.isfinite(values).sum(axis=0)
    mean: Float = np.nansum(values, axis=0) / np.maximum(count, 1)
    return mean


def _missed_px(views: Views, instants: int, camera: int) -> Float:
    """Compute residuals [T', J, C, 2] px, beside the median of each view, at times when the camera sees."""
    points = triangulate(views, method="midpoint").points
    away = points[:, None] - views.position[views.pose_index]
    seen = np.einsum("ncij,nci->ncj", views.rotation[views.pose_index], away)
    depth = np.where(seen[..., 2] > 0, seen[..., 2], np.nan)
    missed = (seen[..., :2] / depth[..., None] - views.rays) * views.focal[:, None]
    missed[views.weight == 0] = np.nan
    missed = missed.reshape(instants, -1, missed.shape[1], 2)
    missed = missed[np.isfinite(missed[..., camera, 0]).any(axis=1)]
    unseen = np.isnan(missed).all(axis=1, keepdims=True)  # by one of the others
    of_view = np.nanmedian(np.where(unseen, 0.0, missed), axis=1, keepdims=True)
    return np.asarray(missed - of_view)
