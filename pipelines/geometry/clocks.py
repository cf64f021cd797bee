"""Clocks: offset, drift and steps between two of them from stamps of the same events; start of a video.

The start is found from the motion of points in the pictures and the logged motion of the camera. Between two
pictures, a point moves along a line that the camera's motion determines (epipolar geometry, Hartley and
Zisserman 2004, section 9.1). Only its place on the line depends on its depth. So a start can be judged
without knowing the scene: by the distance of points from the segment of that line between infinite depth and
the nearest possible depth. If the camera only rotates, the segment is a point.
"""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Bool, ClockFit, Float, Int64
from pipelines.geometry.poses import conjugate, interpolate_poses, matrix_from_quaternion, multiply, rotate

# --- tuning ---

# The slopes are those of all pairs of events, and so many events have 80,000 pairs.
_MAX_EVENTS = 400
# A drift, or a difference of log-likelihoods, is significant from this many standard deviations on.
_SIGNIFICANT_SIGMAS = 4.0
# Quartz is off by 100 ppm at most, so a larger drift is a jump or a wrong unit.
_MAX_DRIFT_PPM = 1000.0
# Delays of one radio link correlate over about this time.
_DELAY_CORRELATION_S = 10.0
# The approximate start of a video must be right to this time.
_START_TOLERANCE_S = 1.0
# This grid of poses is finer than the pictures of a video at 30 Hz.
_STEP_S = 0.02
# Poses of a log are noisy from row to row, so they are smoothed by a window of this standard deviation.
_SMOOTHING_SIGMA_S = 0.1
# Next to gaps and ends the mean of a window is biased, so this share of the window must be known.
_MIN_WINDOW_WEIGHT = 0.9
# Drones stay at least this far from anything that they film.
_MIN_DISTANCE_M = 2.0
# No picture shows points beside the camera, so directions have at least this share of their length as depth.
_MIN_DEPTH_SHARE = 0.1
# Tracking, and the poses between pictures, err by 0.4 px of pictures that are 320 px wide.
_SCATTER_RAD = 2e-3
# Starts are tried in these steps, and Newton's method refines the best of them.
_SEARCH_STEP_S = 0.08
# During the search the scatter is this share of the motion of points, so that the peak is wide enough.
_SEARCH_SCATTER_SHARE = 0.25
# All starts are tried with at most this many points, to bound the time.
_MAX_SEARCH_POINTS = 500
# A start at which the log covers less of the video cannot be compared with the others.
_MIN_COVERED_SHARE = 0.5
# A start this far from the best one counts as another one.
_OTHER_START_S = 0.5
# If every other step is halved, this many steps of Newton's method end shorter than 1e-5 s.
_MAX_NEWTON_STEPS = 30
# Finite differences span one step of the grid of poses.
_DIFFERENCE_STEP_S = 0.01
# Errors within a second may correlate.
_BLOCK_S = 1.0
# Three pictures of a 30 Hz video: a start known less well is of no use.
_MAX_START_SIGMA_S = 0.1


def fit_clock(this_ns: Int64, other_ns: Int64) -> ClockFit | None:
    """Fit a line between the readings of two clocks; return None for fewer than two events.

    The first slope is the median of the slopes between pairs (Theil 1950 and Sen 1968). Least squares without
    the events far from that line then gives the drift. A drift that is not significant (within four of its
    standard deviations of 0) is set to 0, because in short logs the delays of a link look like a drift.

    Args:
        this_ns: [N] readings of the one clock, in any order.
        other_ns: [N] readings of the other at the same events.
    """
    if len(this_ns) < 2:
        return None
    at_ns = int(np.sort(this_ns)[len(this_ns) // 2])
    lead_ns = other_ns - this_ns
    middle_ns = int(np.sort(lead_ns)[len(lead_ns) // 2])
    t_s = (this_ns - at_ns) / 1e9
    lead_s = (lead_ns - middle_ns) / 1e9
    drift = _median_slope(t_s, lead_s)
    if abs(drift) > _MAX_DRIFT_PPM * 1e-6:
        drift = 0.0
    inside, scatter = _inside(lead_s - drift * t_s)
    spread = float(np.std(t_s[inside]))
    if drift and spread > 0:  # one-sided outliers tilt the medians a little: fit again without them
        drift = float(np.polyfit(t_s[inside], lead_s[inside], 1)[0])
        inside, scatter = _inside(lead_s - drift * t_s)
    # Neighbouring delays correlate: there are at most as many independent ones as correlation times.
    independent = max(1.0, min(float(inside.sum()), np.ptp(t_s) / _DELAY_CORRELATION_S))
    sigma = max(scatter, 1e-9) / (spread * np.sqrt(independent)) if spread > 0 else np.inf
    if abs(drift) < _SIGNIFICANT_SIGMAS * sigma:
        drift = 0.0
    offset_s = float(np.median((lead_s - drift * t_s)[inside]))
    return ClockFit(
        at_ns=at_ns,
        offset_ns=middle_ns + round(offset_s * 1e9),
        drift_ppm=drift * 1e6,
        drift_sigma_ppm=min(float(sigma) * 1e6, 1e9),
        residual_s=scatter,
        events=len(this_ns),
        rejected=int(np.count_nonzero(~inside)),
    )


def _inside(residual_s: Float) -> tuple[Bool, float]:
    """Mark the events near the line, and compute their scatter about it."""
    centred = residual_s - np.median(residual_s)
    scatter = 1.4826 * float(np.median(np.abs(centred)))
    return np.abs(centred) <= 6 * max(scatter, 1e-9), scatter


def _median_slope(t_s: Float, lead_s: Float) -> float:
    """Compute the median slope over all pairs of events, which are thinned out evenly."""
    order = np.argsort(t_s, kind="stable")
    kept = order[np.unique(np.linspace(0, len(order) - 1, min(len(order), _MAX_EVENTS)).astype(np.intp))]
    first, second = np.triu_indices(len(kept), 1)
    step = t_s[kept][second] - t_s[kept][first]
    rise = lead_s[kept][second] - lead_s[kept][first]
    # Pairs far apart determine the drift; the slopes of close ones are dominated by delays.
    far = step > np.ptp(t_s) / 4
    return float(np.median(rise[far] / step[far])) if far.any() else 0.0


# --- start of a video ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrackedPoints:
    """Points tracked through stretches of a video, in normalised coordinates (x/z, y/z)."""

    begin_ns: Int64  # [S] of the video's own stamps, rising
    end_ns: Int64  # [S]
    stretch: Int64  # [P] index of a point's stretch, rising
    begin: Float  # [P, 2]
    end: Float  # [P, 2]


@dataclass(frozen=True)
class StartFit:
    """The start time of a video: the time at which its stamps are 0."""

    start_ns: int
    sigma_s: float
    moved: float  # median motion of points in a stretch, rad
    beside: float  # median distance of points from where the poses allow them, rad


@dataclass(frozen=True)
class _Path:
    """A camera's poses on a grid, smoothed."""

    position: Float  # [G, 3]
    quaternion: Float  # [G, 4]
    known: Bool  # [G]


@dataclass(frozen=True)
class _StartSearch:
    """Starts on a grid, and the log-likelihood gain of each over a camera that stands still."""

    path: _Path
    followed: TrackedPoints
    moved: float  # median motion of points in a stretch, rad
    scatter: float  # rad: expected residual of the best start of the grid
    starts_s: Float  # [K] after the first pose
    gain: Float  # [K]; -inf where the log covers too little

    def likeliest(self, among: Bool) -> tuple[float, float]:
        """Find the likeliest start among those marked [K]; return it and its standard deviation, in s."""
        best = np.argmax(np.where(among, self.gain, -np.inf))
        return _refined(self.path, self.followed, float(self.starts_s[best]), self.scatter)

    def explained(self, start_s: float) -> Float:
        """Compute the log-likelihood gain of a start for each stretch [S]; 0 where the log has no poses."""
        still = _still(self.followed, _SCATTER_RAD)
        return np.nan_to_num(still - _misfits(self.path, self.followed, start_s, _SCATTER_RAD))


def fit_start(
    t_ns: Int64,
    position: Float,
    quaternion_xyzw: Float,
    followed: TrackedPoints,
    *,
    max_gap_ns: int,
    near_ns: int | None = None,
) -> StartFit:
    """Find the time at which the video's stamps are 0, such that the points move as the poses predict.

    All starts on a grid are compared with a camera that stands still, by the likelihood of the points'
    distances (Cauchy's, so that the filmed person and lost points have little weight). The best start must be
    better than a still camera, and than the best start elsewhere, by four standard deviations of the
    difference (Vuong 1989, with independent stretches). It is refined by Newton's method. Its standard
    deviation allows any correlation of errors within a second (sums over blocks: Liang and Zeger 1986).

    Args:
        t_ns: [N] strictly increasing stamps of the poses.
        position: [N, 3] m, of the camera in the world.
        quaternion_xyzw: [N, 4] world_from_camera.
        followed: the points.
        max_gap_ns: there is no interpolation between poses further apart than this.
        near_ns: the start, right to 1 s; None for any time that the poses cover.

    Raises:
        ValueError: points and poses agree at no time or at several times; the message explains the reason.
    """
    if not len(followed.stretch):
        raise ValueError("nothing in them can be followed")
    search = _search(_path(t_ns, position, quaternion_xyzw, max_gap_ns), followed)
    if not np.isfinite(search.gain).any():
        raise ValueError("the poses cover less than half of them")
    near_s = None if near_ns is None else (near_ns - int(t_ns[0])) / 1e9
    possible = np.isfinite(search.gain) & (
        near_s is None or np.abs(search.starts_s - near_s) <= _START_TOLERANCE_S
    )
    if not possible.any():
        raise ValueError(
            f"the poses cover less than half of them within {_START_TOLERANCE_S:g} s of the stated start"
        )

    start_s, sigma_s = search.likeliest(possible)
    explained = search.explained(start_s)
    if near_s is not None:
        likeliest_s, _ = search.likeliest(np.ones(len(possible), np.bool_))
        apart_s = likeliest_s - near_s
        if abs(apart_s) > _START_TOLERANCE_S and _is_clear(search.explained(likeliest_s) - explained):
            raise ValueError(
                f"they move as the poses do {apart_s:+.2f} s from the stated start, which must be right to"
                f" {_START_TOLERANCE_S:g} s"
            )
    if not _is_clear(explained):
        raise ValueError("they do not move as the poses do")
    elsewhere = possible & (np.abs(search.starts_s - start_s) > _OTHER_START_S)
    if elsewhere.any():
        other_s, _ = search.likeliest(elsewhere)
        apart_s = abs(other_s - start_s)
        if apart_s > _OTHER_START_S / 2 and not _is_clear(explained - search.explained(other_s)):
            raise ValueError(
                f"they move as the poses do at several times, {apart_s:.2f} s apart: too little, too evenly,"
                " or again and again"
            )
    if not np.isfinite(sigma_s):
        raise ValueError("no start explains their motion better than those shortly before and after it")
    if sigma_s > _MAX_START_SIGMA_S:
        raise ValueError(f"their motion says when to {sigma_s:.2g} s only, not to {_MAX_START_SIGMA_S:g} s")
    return StartFit(
        start_ns=int(t_ns[0]) + round(start_s * 1e9),
        sigma_s=sigma_s,
        moved=search.moved,
        beside=float(np.nanmedian(_distances(search.path, followed, start_s))),
    )


def explain_motion(
    t_ns: Int64, position: Float, quaternion_xyzw: Float, followed: TrackedPoints, *, max_gap_ns: int
) -> tuple[Float, int] | None:
    """Compute how well a camera's poses explain the motion of points, at the start that fits best.

    Of several cameras' poses, those that explain a video clearly better than all others are its own
    (`explains_better`), even with a calibration that is only nearly right. `fit_start` is stricter.

    Args:
        t_ns: [N] strictly increasing stamps of the poses.
        position: [N, 3] m, of the camera in the world.
        quaternion_xyzw: [N, 4] world_from_camera.
        followed: the points.
        max_gap_ns: there is no interpolation between poses further apart than this.

    Returns:
        The log-likelihood gain of each stretch [S] over a camera that stands still, and the start; None if
        the poses cover less than half of the points, or there are none.
    """
    if not len(followed.stretch) or len(t_ns) < 2:
        return None
    search = _search(_path(t_ns, position, quaternion_xyzw, max_gap_ns), followed)
    possible = np.isfinite(search.gain)
    if not possible.any():
        return None
    start_s, _ = search.likeliest(possible)
    return search.explained(start_s), int(t_ns[0]) + round(start_s * 1e9)


def explains_better(gain: Float, other: Float) -> bool:
    """Test if gains of `explain_motion` [S] are clearly above others of the same video, or above 0."""
    return _is_clear(gain - other)


def _path(t_ns: Int64, position: Float, quaternion_xyzw: Float, max_gap_ns: int) -> _Path:
    from scipy.ndimage import gaussian_filter1d

    at_ns = t_ns[0] + np.arange(0, int(t_ns[-1] - t_ns[0]) + 1, round(_STEP_S * 1e9))
    moved, turned = interpolate_poses(
        t_ns, position, quaternion_xyzw, at_ns, max_gap_ns=max_gap_ns, max_extrapolation_ns=0
    )
    there: Bool = np.asarray(np.isfinite(moved).all(axis=1))
    width = _SMOOTHING_SIGMA_S / _STEP_S
    weight = gaussian_filter1d(there.astype(np.float64), width, mode="constant")

    def smoothed(values: Float) -> Float:
        held = np.where(there[:, None], values, 0.0)
        return gaussian_filter1d(held, width, axis=0, mode="constant") / np.maximum(weight, 1e-9)[:, None]

    centre = np.where(there[:, None], moved, 0.0).sum(axis=0) / max(int(there.sum()), 1)
    quaternion = smoothed(turned)
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    return _Path(
        position=smoothed(moved - centre),
        quaternion=quaternion / np.maximum(norm, 1e-9),
        known=there & np.asarray(weight > _MIN_WINDOW_WEIGHT),
    )


def _search(path: _Path, followed: TrackedPoints) -> _StartSearch:
    """Try all starts at which the video overlaps the log."""
    last_s, length_s = float(followed.end_ns[-1]) / 1e9, _STEP_S * (len(path.known) - 1)
    starts_s = np.arange(-last_s, length_s, _SEARCH_STEP_S)
    moved = float(np.median(np.linalg.norm(followed.end - followed.begin, axis=1)))
    scatter = max(_SCATTER_RAD, _SEARCH_SCATTER_SHARE * moved)
    gain = _gains(path, _thinned(followed), starts_s, scatter)
    return _StartSearch(path, followed, moved, scatter, starts_s, gain)


def _thinned(followed: TrackedPoints) -> TrackedPoints:
    """Keep every n-th point, so that many starts can be tried."""
    every = slice(None, None, max(1, len(followed.stretch) // _MAX_SEARCH_POINTS))
    return TrackedPoints(
        followed.begin_ns,
        followed.end_ns,
        followed.stretch[every],
        followed.begin[every],
        followed.end[every],
    )


def _gains(path: _Path, followed: TrackedPoints, starts_s: Float, scatter: float) -> Float:
    """Compute each start's log-likelihood gain over a still camera; -inf where the log covers too little."""
    still = _still(followed, scatter)
    gain = np.full(len(starts_s), -np.inf)
    for k, start_s in enumerate(starts_s.tolist()):
        better = still - _misfits(path, followed, start_s, scatter)
        known = np.isfinite(better)
        if known.mean() >= _MIN_COVERED_SHARE:
            gain[k] = better[known].sum()
    return gain


def _still(followed: TrackedPoints, scatter: float) -> Float:
    """Compute the misfits [S] of a camera that stands still."""
    return _summed(followed, np.linalg.norm(followed.end - followed.begin, axis=1), scatter)


def _misfits(path: _Path, followed: TrackedPoints, start_s: float, scatter: float) -> Float:
    """Compute the misfits [S] of a start, in s after the first pose; NaN where the log has no poses."""
    return _summed(followed, _distances(path, followed, start_s), scatter)


def _summed(followed: TrackedPoints, distance: Float, scatter: float) -> Float:
    """Sum the negative log-likelihoods of the points of each stretch, up to a constant."""
    each = np.log1p((distance / scatter) ** 2)
    return np.bincount(followed.stretch, each, len(followed.begin_ns)).astype(np.float64)


def _distances(path: _Path, followed: TrackedPoints, start_s: float) -> Float:
    """Compute the distances [P] of points from where a start allows them; NaN where the log has no poses."""
    from_position, from_quaternion = _at(path, start_s + followed.begin_ns / 1e9)
    to_position, to_quaternion = _at(path, start_s + followed.end_ns / 1e9)
    turn = matrix_from_quaternion(multiply(conjugate(to_quaternion), from_quaternion))
    shift = rotate(conjugate(to_quaternion), from_position - to_position) / _MIN_DISTANCE_M
    ray = np.einsum(
        "pij,pj->pi", turn[followed.stretch], np.column_stack([followed.begin, np.ones(len(followed.begin))])
    )
    infinite, nearest = _in_picture(ray), _in_picture(ray + shift[followed.stretch])
    line, beside = nearest - infinite, followed.end - infinite
    length2 = np.maximum((line**2).sum(axis=1), 1e-18)
    along = np.clip((beside * line).sum(axis=1) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(beside - along[:, None] * line, axis=1))


def _in_picture(ray: Float) -> Float:
    return ray[:, :2] / np.maximum(ray[:, 2:], _MIN_DEPTH_SHARE)


def _at(path: _Path, at_s: Float) -> tuple[Float, Float]:
    """Interpolate positions [S, 3] and quaternions [S, 4] at times after the first pose; NaN if not known."""
    place = at_s / _STEP_S
    before = np.clip(np.floor(place).astype(np.int64), 0, max(len(path.known) - 2, 0))
    after = np.minimum(before + 1, len(path.known) - 1)
    share = (place - before)[:, None]
    inside = (place >= 0) & (place <= len(path.known) - 1) & path.known[before] & path.known[after]
    position = (1 - share) * path.position[before] + share * path.position[after]
    quaternion = (1 - share) * path.quaternion[before] + share * path.quaternion[after]
    quaternion /= np.maximum(np.linalg.norm(quaternion, axis=1, keepdims=True), 1e-9)
    return np.where(inside[:, None], position, np.nan), np.where(inside[:, None], quaternion, np.nan)


def _is_clear(differences: Float) -> bool:
    """Test if a sum of differences of log-likelihoods is significantly above zero."""
    known = differences[np.isfinite(differences)]
    sigma = float(np.std(known, ddof=1)) * np.sqrt(len(known)) if len(known) > 1 else np.inf
    return float(known.sum()) > max(_SIGNIFICANT_SIGMAS * sigma, _SIGNIFICANT_SIGMAS**2 / 2)


def _refined(path: _Path, followed: TrackedPoints, start_s: float, scatter: float) -> tuple[float, float]:
    """Refine a start to a fraction of a step, with smaller and smaller scatter; return also its sigma in s.

    The limit on Newton's steps is halved each time they change direction. If points scatter little, their
    likelihood has a sharp peak, and full steps would jump from side to side of it. Beside the peak its
    curvature has the other sign; there a step goes downhill in misfit. The standard deviation is infinite if
    the likelihood has no peak near the start.
    """
    block = (followed.begin_ns / 1e9 / _BLOCK_S).astype(np.int64)
    sigma_s = np.inf
    while True:
        longest_s, before_s = _SEARCH_STEP_S, 0.0
        for _ in range(_MAX_NEWTON_STEPS):
            less, here, more = (
                _misfits(path, followed, start_s + k * _DIFFERENCE_STEP_S, scatter) for k in (-1, 0, 1)
            )
            slope = np.nan_to_num((more - less) / (2 * _DIFFERENCE_STEP_S))
            bend = float(np.nansum(more - 2 * here + less)) / _DIFFERENCE_STEP_S**2
            spread = float(np.sqrt((np.bincount(block, slope) ** 2).sum()))
            sigma_s = spread / bend if bend > 0 else np.inf
            downhill = -float(slope.sum())
            if bend <= 0 and not downhill:
                break  # the log has no poses here
            step_s = downhill / bend if bend > 0 else float(np.copysign(longest_s, downhill))
            if step_s * before_s < 0:
                longest_s /= 2
            step_s = float(np.clip(step_s, -longest_s, longest_s))
            start_s, before_s = start_s + step_s, step_s
            if abs(step_s) < 1e-5:
                break
        if scatter <= _SCATTER_RAD:
            return start_s, sigma_s
        scatter = max(scatter / 2, _SCATTER_RAD)


# --- steps of a clock -----------------------------------------------------------------------------------

# The stamp of a header minus that of receipt is minus the delay of the transport, plus the offset of the two
# clocks. A clock that is set changes it between two messages, for good, and by as much as the header's own
# interval is too long or too short. Delays change it, too, but leave the header's interval as it is.

# Transport delays of a good link change by less, and a pose 20 ms late is 2 cm off at 1 m/s.
_MIN_STEP_S = 0.02
# A clock that is set by more was never set before, or the log is played again: that is told, not mended.
MAX_STEP_S = 2.0
# A step is this many times the scatter of the messages before and after it.
_SIGNIFICANT_STEP_SIGMAS = 8.0
# A step holds for at least this time before and after.
_MIN_DURATION_S = 0.5
# The medians of fewer messages are not robust.
_MIN_MESSAGES = 5
# So many of the messages before and after lie nearer to their own median than to the other one.
_SEPARATED_SHARE = 0.9
# A log with more gaps loses messages all the time, and its gaps say nothing of clocks.
_MOST_GAPS = 3
# A mean velocity over less time is mostly noise.
_VELOCITY_S = 0.2
# Drones that film people accelerate by less, in m/s^2; as rotation, this many parts of a quaternion per s^2.
_MOST_ACCELERATION = 2.0


@dataclass(frozen=True)
class ClockStep:
    """Step of header stamps relative to the stamps of receipt, which go on evenly."""

    index: int  # of the first message after the step, in the order of receipt
    after_s: float  # from the first message's receipt
    step_s: float  # negative is backward
    is_clear: bool  # False if a queue that was emptied, its messages lost, would look the same

    def __str__(self) -> str:
        """Return one line, without the topic."""
        told = (
            f"the clock of the header stamps steps by {self.step_s:+.3f} s at {self.after_s:.2f} s"
            f" (message {self.index}) against those of receipt"
        )
        if self.is_clear:
            return f"{told}; taken out of the header stamps after it"
        return f"{told}, or messages were lost there; not taken out"


def find_steps(header_ns: Int64, receive_ns: Int64) -> list[ClockStep]:
    """Find the steps of a header clock; jitter, drift and bursts of delayed messages are none.

    Args:
        header_ns: [N] stamps of the headers; 0 without one.
        receive_ns: [N] stamps of receipt, in order.
    """
    (stamped,) = np.nonzero(header_ns)
    if len(stamped) < 2 * _MIN_MESSAGES:
        return []
    header, receive = header_ns[stamped], receive_ns[stamped]
    lead_s = (header - receive - (header[0] - receive[0])) / 1e9
    offset_s = float(header[0] - receive[0]) / 1e9
    interval_s = np.diff(header) / 1e9
    usual_s = max(float(np.median(np.diff(receive))) / 1e9, 1e-6)
    window = max(_MIN_MESSAGES, int(np.ceil(min(_MIN_DURATION_S / usual_s, len(stamped)))))
    found = []
    for k in _candidates(lead_s, interval_s).tolist():
        first, last = k + 1 - window, k + 1 + window
        if first < 0 or last > len(lead_s):
            continue
        lasted_s = min(receive[k] - receive[first], receive[last - 1] - receive[k + 1]) / 1e9
        before, after = lead_s[first : k + 1], lead_s[k + 1 : last]
        level_s, step_s = float(np.median(before)), float(np.median(after) - np.median(before))
        pause_s = float(np.diff(receive[k - 4 : k + 6]).max()) / 1e9
        near_s = float(np.median(after[:_MIN_MESSAGES]) - np.median(before[-_MIN_MESSAGES:]))
        off = np.abs(np.concatenate([before - level_s, after - level_s - step_s]))
        around_s = interval_s[first : last - 1]
        own_s = interval_s[k] - float(np.median(around_s))
        uneven_s = np.quantile(np.abs(around_s - np.median(around_s)), _SEPARATED_SHARE)
        least_s = max(_MIN_STEP_S, _SIGNIFICANT_STEP_SIGMAS * 1.4826 * float(np.median(off)))
        if (
            least_s < abs(step_s) <= MAX_STEP_S
            and abs(own_s - step_s) < abs(step_s) / 2
            and abs(near_s - step_s) < abs(step_s) / 4
            and pause_s < 3 * usual_s + abs(step_s) / 2  # the receipt goes on
            and uneven_s < abs(step_s) / 4
            and lasted_s > _MIN_DURATION_S / 2  # messages of a queue arrive at once
            and np.quantile(off, _SEPARATED_SHARE) < abs(step_s) / 2
        ):
            delay_s = -offset_s - level_s  # before the step, as if earlier steps had not been
            is_queue = 0 < step_s <= delay_s < MAX_STEP_S
            offset_s -= 0 if is_queue else step_s
            since_s = float(receive[k + 1] - receive[0]) / 1e9
            found.append(ClockStep(int(stamped[k + 1]), since_s, step_s, not is_queue))
    return found


def without_steps(header_ns: Int64, steps: list[ClockStep]) -> Int64:
    """Return header stamps [N] on the clock of the first of them; 0 stays 0, and so do unclear steps."""
    mended = header_ns.copy()
    for step in steps:
        if step.is_clear:
            after = mended[step.index :]
            after[after != 0] -= round(step.step_s * 1e9)
    return mended


def _candidates(lead_s: Float, interval_s: Float) -> Int64:
    """Return the intervals at which the header's own clock may step, by its interval and five messages."""
    five = np.median(np.lib.stride_tricks.sliding_window_view(lead_s, _MIN_MESSAGES), axis=1)
    changed = np.zeros(len(interval_s), np.bool_)
    steady = slice(_MIN_MESSAGES - 1, len(interval_s) - _MIN_MESSAGES + 1)
    changed[steady] = np.abs(five[_MIN_MESSAGES:] - five[:-_MIN_MESSAGES]) > _MIN_STEP_S / 2
    unusual = np.abs(interval_s - np.median(interval_s)) > _MIN_STEP_S / 2
    return np.flatnonzero(changed & unusual)


@dataclass(frozen=True)
class StampGap:
    """Interval of an even sequence of stamps that is too long, or that goes back."""

    index: int  # of the first message after it
    usual_s: float  # the other intervals
    excess_s: float  # by which it is longer; negative where the stamps go back


def find_gaps(stamps_ns: Int64) -> list[StampGap]:
    """Find the few gaps of an even sequence of stamps [N], which are in the order of writing."""
    interval_s = np.diff(stamps_ns) / 1e9
    if len(interval_s) < 4 * _MIN_MESSAGES:
        return []
    usual_s = float(np.median(interval_s))
    off_s = np.abs(interval_s - usual_s)
    least_s = max(_MIN_STEP_S, _SIGNIFICANT_STEP_SIGMAS * 1.4826 * float(np.median(off_s)))
    places = np.flatnonzero((off_s > least_s) & ((interval_s > 0) | (interval_s < -_MIN_STEP_S)))
    found = []
    for k in places.tolist() if len(places) <= _MOST_GAPS else []:
        before_s, after_s = off_s[max(k - 2 * _MIN_MESSAGES, 0) : k], off_s[k + 1 :][: 2 * _MIN_MESSAGES]
        around = np.concatenate([before_s, after_s])
        if min(k, len(interval_s) - 1 - k) >= _MIN_MESSAGES and (
            np.quantile(around, _SEPARATED_SHARE) < off_s[k] / 4
        ):
            found.append(StampGap(k + 1, usual_s, float(interval_s[k]) - usual_s))
    return found


def time_passed(t_ns: Int64, values: Float, gap: StampGap, at: int) -> bool | None:
    """Test by motion if the time of a gap passed; False if its clock stepped, None if motion does not tell.

    The mean of the velocities before and after says how far the body moves in the usual interval, and in the
    whole gap.

    Args:
        t_ns: [N] stamps.
        values: [N, D] positions in m, or quaternions of continuous sign.
        gap: the gap.
        at: the row of the first message after it.
    """
    t_s = (t_ns - t_ns[at]) / 1e9
    count = max(_MIN_MESSAGES, int(_VELOCITY_S / max(gap.usual_s, 1e-3)))
    sides = slice(max(at - count, 0), at), slice(at, at + count)
    if min(at, len(t_s) - at) < _MIN_MESSAGES:
        return None
    lines = [np.polyfit(t_s[side], values[side], 1) for side in sides]
    left = [values[side] - np.outer(t_s[side], b) - a for side, (b, a) in zip(sides, lines, strict=True)]
    scatter = float(np.sqrt(np.mean(np.concatenate(left) ** 2) * values.shape[1]))
    moved = lines[1][0] * t_s[at] + lines[1][1] - lines[0][0] * t_s[at - 1] - lines[0][1]
    velocity, change = (lines[0][0] + lines[1][0]) / 2, float(np.linalg.norm(lines[1][0] - lines[0][0]))

    def misfit(passed_s: float) -> float:
        """Return the distance from where the body should be, in units of what is usual."""
        off = float(np.linalg.norm(moved - velocity * passed_s))
        return off / (3 * scatter + _MOST_ACCELERATION * passed_s**2 / 8 + change * passed_s / 4 + 1e-6)

    stepped, passed = misfit(gap.usual_s), misfit(gap.usual_s + gap.excess_s)
    if stepped < 1 and passed > 2:
        return False
    return True if passed < 1 and stepped > 2 else None
