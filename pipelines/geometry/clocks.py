"""Clocks: offset, drift and steps between two of them, from stamps of the same events."""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Bool, ClockFit, Float, Int64

# The slopes are those of all pairs of events, and so many events have 80,000 pairs.
_MAX_EVENTS = 400
# A drift is significant from this many standard deviations on.
_SIGNIFICANT_SIGMAS = 4.0
# Quartz is off by 100 ppm at most, so a larger drift is a jump or a wrong unit.
_MAX_DRIFT_PPM = 1000.0
# Delays of one radio link correlate over about this time.
_DELAY_CORRELATION_S = 10.0


def fit_clock(this_ns: Int64, other_ns: Int64) -> ClockFit | None:
    """Fit a line between the readings [N] of two clocks; return None for fewer than two events.

    The first slope is the median of the slopes between pairs (Theil 1950 and Sen 1968). Least squares without
    the events far from that line then gives the drift. One within four of its standard deviations is set to
    0, because in short logs the delays of a link look like a drift.
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


# The stamp of a header minus that of receipt is minus the delay of the transport, plus the offset of the two
# clocks. A clock that is set changes it between two messages, for good, and by as much as the header's own
# interval is too long or too short. Delays change it, too, but leave the header's interval as it is.

# Transport delays of a good link change by less, and a pose 20 ms late is 2 cm off at 1 m/s.
_MIN_STEP_S = 0.02
# A clock that is set by more was never set before, or the log is played again: that is told, not mended.
MAX_STEP_S = 2.0
# A step is this many times the standard error of the medians of the messages before and after it, and a gap
# this many times the scatter of intervals.
_SIGNIFICANT_STEP_SIGMAS = 8.0
# A step holds for at least this time before and after.
_MIN_DURATION_S = 0.5
# The medians of fewer messages are not robust.
_MIN_MESSAGES = 5
# So many of the messages before and after lie nearer to their own median than to the other one.
_SEPARATED_SHARE = 0.9
# A log with more gaps loses messages all the time, and its gaps say nothing of clocks, but for the longest.
_MOST_GAPS = 3
# So many gaps count if the next one is shorter by this factor: two messages in a row are seldom lost.
_DISTINCT_GAP = 1.75
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
        told = (
            f"the clock of the header stamps steps by {self.step_s:+.3f} s at {self.after_s:.2f} s"
            f" (message {self.index}) against those of receipt"
        )
        if self.is_clear:
            return f"{told}; taken out of the header stamps after it"
        return f"{told}, or messages were lost there; not taken out"


def find_steps(header_ns: Int64, receive_ns: Int64) -> list[ClockStep]:
    """Find the steps of a header clock (stamps [N], 0: none); jitter, drift and bursts of delays are none."""
    (stamped,) = np.nonzero(header_ns)
    if len(stamped) < 2 * _MIN_MESSAGES:
        return []
    header, receive = header_ns[stamped], receive_ns[stamped]
    lead_s = (header - receive - (header[0] - receive[0])) / 1e9
    offset_s = float(header[0] - receive[0]) / 1e9
    interval_s = np.diff(header) / 1e9
    usual_s = max(float(np.median(interval_s)), 1e-6)
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
        around_s = np.delete(interval_s[first : last - 1], k - first)
        own_s = interval_s[k] - float(np.median(around_s))
        uneven_s = np.quantile(np.abs(around_s - np.median(around_s)), _SEPARATED_SHARE)
        scatter_s = 1.4826 * float(np.median(off)) * float(np.sqrt(np.pi))
        sigma_s, near_sigma_s = scatter_s / np.sqrt(window), scatter_s / np.sqrt(_MIN_MESSAGES)
        # The header's own interval is evidence, too, if all others are alike.
        is_even = uneven_s < _MIN_STEP_S / 10
        sigmas = _SIGNIFICANT_STEP_SIGMAS / (2 if is_even else 1)
        if (
            max(_MIN_STEP_S, sigmas * sigma_s) < abs(step_s) <= MAX_STEP_S
            and abs(own_s - step_s) < abs(step_s) / 2
            and abs(near_s - step_s) < abs(step_s) / 4 + 2 * near_sigma_s
            and pause_s < 3 * usual_s + abs(step_s) / 2  # the receipt goes on
            and uneven_s < abs(step_s) / 3
            and lasted_s > _MIN_DURATION_S / 2  # messages of a queue arrive at once
            and (is_even or np.quantile(off, _SEPARATED_SHARE) < abs(step_s) / 2)
        ):
            if uneven_s < sigma_s and abs(own_s - step_s) < max(usual_s / 2, 3 * sigma_s):
                step_s = own_s  # the header's own interval has less scatter
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

    @property
    def goes_back(self) -> bool:
        """True if a later stamp is clearly below an earlier one, which no loss of messages explains."""
        return self.usual_s + self.excess_s < -_MIN_STEP_S


def may_step(received_ns: Int64) -> bool:
    """Test if stamps of receipt [N] go back, or come late or early for longer than delays do."""
    window = 5 * _MIN_MESSAGES
    if len(received_ns) < 2 * window:
        return len(received_ns) >= 4 * _MIN_MESSAGES
    if (np.diff(received_ns) < -_MIN_STEP_S * 1e9).any():
        return True
    lead_s = (received_ns - received_ns[0]) / 1e9
    lead_s -= np.arange(len(lead_s)) * lead_s[-1] / (len(lead_s) - 1)
    level_s = np.median(np.lib.stride_tricks.sliding_window_view(lead_s, window), axis=1)
    change_s = level_s[window:] - level_s[:-window]
    return bool(np.abs(change_s - np.median(change_s)).max() > _MIN_STEP_S / 2)


def steps_alike(lead_ns: Int64, gap: StampGap) -> bool:
    """Test if the stamps of receipt have the header's gap, too, given header less receipt [N]."""
    width = 5 * _MIN_MESSAGES
    before, after = lead_ns[max(gap.index - width, 0) : gap.index], lead_ns[gap.index :][:width]
    return float(np.abs(np.median(after) - np.median(before))) / 1e9 < abs(gap.excess_s) / 2


def find_receipt_steps(header_ns: Int64, received_ns: Int64) -> list[tuple[int, float]]:
    """Find steps (first message, s) of the stamps of receipt [N] while even header stamps [N] go on.

    Delays scatter, so that the medians of many messages before and after tell. A queue that is emptied is no
    step: its messages arrive at once.
    """
    import pandas as pd

    delay_s = (received_ns - header_ns - (received_ns[0] - header_ns[0])) / 1e9
    interval_s = np.diff(header_ns) / 1e9
    usual_s = max(float(np.median(interval_s)), 1e-6)
    window = max(5 * _MIN_MESSAGES, int(np.ceil(_MIN_DURATION_S / usual_s)))
    found: list[tuple[int, float]] = []
    if len(delay_s) < 2 * window or np.quantile(np.abs(interval_s - usual_s), _SEPARATED_SHARE) > usual_s / 4:
        return found
    level_s = pd.Series(delay_s).rolling(window).median().to_numpy()[window - 1 :]
    change_s = level_s[window:] - level_s[:-window]
    # Delays behind each other in a queue correlate, which the usual change shows.
    least_s = max(_MIN_STEP_S, _SIGNIFICANT_STEP_SIGMAS * 1.4826 * float(np.median(np.abs(change_s))))
    while len(change_s):
        place = int(np.argmax(np.abs(change_s)))
        sides = delay_s[place : place + window], delay_s[place + window :][:window]
        step_s = float(change_s[place])
        off_s = np.concatenate([side - np.median(side) for side in sides])
        sigma_s = 1.4826 * float(np.median(np.abs(off_s))) * float(np.sqrt(np.pi / window))
        if abs(step_s) <= max(least_s, _SIGNIFICANT_STEP_SIGMAS * sigma_s):
            break
        change_s[max(place - window, 0) : place + window + 1] = 0
        # The message from which on the levels fit best.
        around = delay_s[place : place + 2 * window]
        misfit_s = np.cumsum(np.abs(around - np.median(sides[0])) - np.abs(around - np.median(sides[1])))
        at = place + int(np.argmin(misfit_s)) + 1
        received_s = received_ns[at - window // 2 : at] / 1e9, received_ns[at : at + window] / 1e9
        wide_s = delay_s[max(at - 10 * window, 0) : at], delay_s[at : at + 10 * window]
        lasting_s = float(np.median(wide_s[1]) - np.median(wide_s[0]))
        if (
            least_s < abs(lasting_s) <= MAX_STEP_S
            and abs(lasting_s - step_s) < abs(step_s) / 2
            and abs(interval_s[at - 1] - usual_s) < abs(step_s) / 4
            and min(np.ptp(received_s[0]), np.ptp(received_s[1])) > usual_s * window / 4
        ):
            found.append((at, lasting_s))
    return sorted(found)


def find_gaps(stamps_ns: Int64) -> list[StampGap]:
    """Find the few gaps of an even sequence of stamps [N], which are in the order of writing."""
    interval_s = np.diff(stamps_ns) / 1e9
    if len(interval_s) < 4 * _MIN_MESSAGES:
        return []
    usual_s = float(np.median(interval_s))
    off_s = interval_s - usual_s
    least_s = max(_MIN_STEP_S, _SIGNIFICANT_STEP_SIGMAS * 1.4826 * float(np.median(np.abs(off_s))))
    found = []
    for places in (np.flatnonzero(off_s < -least_s), np.flatnonzero(off_s > least_s)):
        lengths = np.sort(np.abs(off_s[places]))
        usual = _DISTINCT_GAP * lengths[-_MOST_GAPS - 1] if len(places) > _MOST_GAPS else 0.0
        for k in places[np.abs(off_s[places]) >= usual].tolist():
            before_s, after_s = off_s[max(k - 2 * _MIN_MESSAGES, 0) : k], off_s[k + 1 :][: 2 * _MIN_MESSAGES]
            around = np.abs(np.concatenate([before_s, after_s]))
            # A late message is followed by a shorter interval, and the step of a clock is not.
            lasting_s = float(off_s[max(k - 2, 0) : k + 3].sum())
            if (
                min(k, len(interval_s) - 1 - k) >= _MIN_MESSAGES
                and np.quantile(around, _SEPARATED_SHARE) < abs(off_s[k]) / 4
                and abs(lasting_s - off_s[k]) < abs(off_s[k]) / 2
            ):
                found.append(StampGap(k + 1, usual_s, float(off_s[k])))
    return sorted(found, key=lambda gap: gap.index)


def time_passed(t_ns: Int64, values: Float, gap: StampGap, at: int) -> bool | None:
    """Test by motion if the time of a gap before row `at` passed; False: its clock stepped; or None."""
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
    # Stamps with jitter leave the interval itself uncertain.
    scatter += float(np.linalg.norm(velocity) * max(np.std(np.diff(t_s[side])) for side in sides))

    def misfit(passed_s: float) -> float:
        """Return the distance from where the body should be, in units of what is usual."""
        off = float(np.linalg.norm(moved - velocity * passed_s))
        return off / (3 * scatter + _MOST_ACCELERATION * passed_s**2 / 8 + change * passed_s / 4 + 1e-6)

    stepped, passed = misfit(gap.usual_s), misfit(gap.usual_s + gap.excess_s)
    if stepped < 1 and passed > 2:
        return False
    return True if passed < 1 and stepped > 2 else None
