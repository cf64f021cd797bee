"""Plain sentences: limits that an arm violates, and the comparison of the first arm with the second."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipelines.planning.config import PlannerConfig

_ALIKE_DEG = 2.0  # smaller differences of tilt are not reported
_ALIKE_PERCENT = 1.0  # of the joints, likewise


def verdict(
    arm: str, against: str, arms: Mapping[str, Mapping[str, Any]], difference: Mapping[str, Any]
) -> str:
    """Compare an arm with another in one sentence: tilt, reconstruction error, coverage.

    Args:
        arm: the arm that is judged.
        against: the arm that it is compared with.
        arms: scores by arm, as in metrics.json.
        difference: of the two, arm minus against, as in metrics.json.
    """
    return (
        f"{_about_tilt(arm, against, arms)}; {_about_error(difference)}{_about_coverage(arm, against, arms)}"
    )


def broken_limits(arm: str, scores: Mapping[str, Any], config: PlannerConfig) -> str | None:
    """Name every limit that an arm violates, and how often; None if it keeps all of them.

    Args:
        arm: its name.
        scores: of the arm, as in metrics.json.
        config: the limits.
    """
    kinds = {
        "collision": "collides with an obstacle",
        "clearance": f"comes within {config.drone_radius_m:g} m of an obstacle",
        "actor": f"comes within {config.actor_distance_m:g} m of the actor",
        "separation": f"has two drones within {config.separation_m:g} m of each other",
        "speed": f"flies faster than {config.speed_mps:g} m/s",
        "acceleration": f"accelerates by more than {config.acceleration_mps2:g} m/s^2",
        "jerk": f"has a jerk of more than {config.jerk_mps3:g} m/s^3",
    }
    counts = scores["limit_violations"]
    said = [f"{words} ({_times(counts[kind])})" for kind, words in kinds.items() if counts.get(kind)]
    return f"{arm} {', '.join(said)}" if said else None


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _about_tilt(arm: str, against: str, arms: Mapping[str, Mapping[str, Any]]) -> str:
    own, other = (arms[name]["tilt_deg"]["max"] for name in (arm, against))
    if abs(own - other) < _ALIKE_DEG:
        return f"{arm} and {against} tilt alike, up to {own:.0f} and {other:.0f} deg"
    if own < other:
        return f"{arm} keeps the tilt at {own:.0f} deg where {against} climbs to {other:.0f}"
    return f"{arm} climbs to a tilt of {own:.0f} deg where {against} keeps it at {other:.0f}"


def _about_coverage(arm: str, against: str, arms: Mapping[str, Mapping[str, Any]]) -> str:
    """Say which arm measured more joints; empty if they are alike.

    Errors are compared on joints that both measured, so the coverage must be reported as well.
    """
    found = [arms[name]["reconstruction_error"]["coverage"] for name in (arm, against)]
    if None in found:
        return ""
    own, other = (100 * each["mean"] for each in found)
    if abs(own - other) < _ALIKE_PERCENT:
        return ""
    return f", and it measures {own:.0f} % of the joints where {against} measures {other:.0f} %"


def _about_error(difference: Mapping[str, Any]) -> str:
    found = difference["mpjpe_mm"]
    if found is None:
        return "its reconstruction error could not be compared"
    mean, interval = found["mean"], found["interval"]
    if interval is None:
        return f"its reconstruction error differs by {mean:+.0f} mm in the only trial (simulated)"
    low, high = interval
    if low <= 0 <= high:
        return (
            "no difference in reconstruction error was found"
            f" ({mean:+.1f} mm [{low:+.1f}, {high:+.1f}], simulated)"
        )
    nearest, farthest = sorted((abs(low), abs(high)))
    which = "smaller" if mean < 0 else "larger"
    return (
        f"its reconstruction error is {abs(mean):.1f} mm [{nearest:.1f}, {farthest:.1f}] {which} (simulated)"
    )
