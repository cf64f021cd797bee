"""Conversion of log times to world time by the stated clock, and doubts about stamps."""

from __future__ import annotations

import numpy as np

from pipelines.formats.logs.trajectories import StampCheck
from pipelines.session.manifest import LogClock
from pipelines.session.records import Int64


def world_times(clock: LogClock, t_ns: Int64, since_ns: int) -> Int64:
    """Convert a log's own times to world times [N].

    Args:
        clock: the log's clock in the manifest.
        t_ns: [N].
        since_ns: the time from which the drift counts.
    """
    drift_ns = np.round((t_ns - since_ns) * (clock.drift_ppm * 1e-6)).astype(np.int64)
    world_ns: Int64 = t_ns + drift_ns + round(clock.offset_s * 1e9)
    return world_ns


def doubts_of_stamps(check: StampCheck, stamps: str) -> list[str]:
    """Describe how the stamps of a log disagree with each other, one line each.

    Args:
        check: statistics of the stamps.
        stamps: the stamps in use, header or receive.
    """
    used, doubts = f"{stamps} stamps are used", []
    if check.without_header:
        doubts.append(
            f"{check.without_header} of {check.count} messages have no header stamp, their time of receipt is"
            " taken"
        )
    if check.disagreeing:
        doubts.append(
            f"header and receive stamps disagree by up to {check.largest_disagreement_s:.3g} s in"
            f" {check.disagreeing} of {check.count} messages; {used}"
        )
    drift = check.drift
    if drift is not None and drift.drift_ppm and not check.jumps:
        doubts.append(
            f"header stamps drift {drift.drift_ppm:.1f} ppm (+- {drift.drift_sigma_ppm:.1g}) against those of"
            f" receipt; {used}, not corrected (logs: clock: drift_ppm does)"
        )
    doubts += [
        f"the clock jumps by {jump.jump_s:.3g} s at {jump.header_ns / 1e9:.3f} s; {used}"
        for jump in check.jumps[:5]
    ]
    return doubts
