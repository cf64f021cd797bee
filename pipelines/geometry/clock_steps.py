"""Steps of a clock that is set while it stamps messages, seen against the clock of their receipt.

The stamp of a header minus that of receipt is minus the delay of the transport, plus the offset of the two
clocks. A clock that is set changes it between two messages, for good, and by as much as the header's own
interval is too long or too short. Delays change it, too, but leave the header's interval as it is.
"""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float, Int64

# --- tuning ---

# Transport delays of a good link change by less, and a pose 20 ms late is 2 cm off at 1 m/s.
_MIN_STEP_S = 0.02
# A clock that is set by more was never set before, or the log is played again: that is told, not mended.
_MAX_STEP_S = 2.0
# A step is this many times the scatter of the messages before and after it.
_SIGNIFICANT_SIGMAS = 8.0
# A step holds for at least this time before and after.
_MIN_DURATION_S = 0.5
# The medians of fewer messages are not robust.
_MIN_MESSAGES = 5
# So many of the messages before and after lie nearer to their own median than to the other one.
_SEPARATED_SHARE = 0.9


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
        least_s = max(_MIN_STEP_S, _SIGNIFICANT_SIGMAS * 1.4826 * float(np.median(off)))
        if (
            least_s < abs(step_s) <= _MAX_STEP_S
            and abs(own_s - step_s) < abs(step_s) / 2
            and abs(near_s - step_s) < abs(step_s) / 4
            and pause_s < 3 * usual_s + abs(step_s) / 2  # the receipt goes on
            and uneven_s < abs(step_s) / 4
            and lasted_s > _MIN_DURATION_S / 2  # messages of a queue arrive at once
            and np.quantile(off, _SEPARATED_SHARE) < abs(step_s) / 2
        ):
            delay_s = -offset_s - level_s  # before the step, as if earlier steps had not been
            is_queue = 0 < step_s <= delay_s < _MAX_STEP_S
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
