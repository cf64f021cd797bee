"""Comparison of arms, as in metrics.json: scores, differences with their intervals, and the verdict.

Intervals are those of `geometry.bootstrap`: over the trials for errors, which are independent draws, and over
stretches of the flight for figures that depend on the flight's course.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Float32, Int64
from pipelines.geometry.bootstrap import LEVEL, STRETCH_S, intervals
from pipelines.planning.arm_flights import LOGGED, ArmFlight
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import visible
from pipelines.planning.formation import TILT, slot_of
from pipelines.planning.scene import Scene
from pipelines.planning.scores import score

REFERENCE = "fixed"
"""Arm that the others are compared with; the first arm where it is missing."""
_ALIKE_DEG = 2.0  # smaller differences of tilt are not reported
_ALIKE_PERCENT = 1.0  # of the joints, likewise


@dataclass(frozen=True)
class Estimate:
    """A mean and the interval that holds it with `LEVEL` probability; None where it cannot be computed."""

    mean: float
    interval: tuple[float, float] | None

    def as_json(self) -> dict[str, object]:
        """Return the estimate as stored in metrics.json."""
        return {"mean": self.mean, "interval": None if self.interval is None else list(self.interval)}


def mean_of_trials(values: Float, seed: int) -> Estimate | None:
    """Compute the mean of a figure over trials [K]; None without any, no interval for a single one."""
    return _mean(values, None, seed)


def mean_over_time(values: Float, counted: Bool, t_ns: Int64, seed: int) -> Estimate | None:
    """Compute the mean over the moments that count, which are joined and resampled in stretches.

    Args:
        values: [T] or [N, T].
        counted: [T].
        t_ns: [T] strictly increasing.
    """
    return _mean(np.atleast_2d(values).mean(axis=0)[counted], t_ns[counted], seed)


def common_frames(errors: Mapping[str, Float32]) -> Bool:
    """Return the joint-frames [trials, T, J] that every arm measured.

    Arms that measured none do not count.
    """
    measured = [np.isfinite(error) for error in errors.values() if np.isfinite(error).any()]
    shape = next(iter(errors.values())).shape
    return np.logical_and.reduce(measured) if measured else np.zeros(shape, dtype=np.bool_)


def mpjpe_mm(error_m: Float32, counted: Bool) -> Float:
    """Compute the mean error of each trial over the joint-frames [K, T, J] that count.

    Returns:
        [K], or fewer: trials in which none counts are left out.
    """
    number = counted.sum(axis=(1, 2))
    total = np.where(counted, error_m, 0.0).sum(axis=(1, 2), dtype=np.float64)
    has_any = number > 0
    mean: Float = 1e3 * total[has_any] / number[has_any]
    return mean


def coverage(error_m: Float32, joint_frames: int) -> Float:
    """Compute the share [K] of the joint-frames with a truth that were measured, 0..1."""
    share: Float = np.isfinite(error_m).sum(axis=(1, 2)) / max(joint_frames, 1)
    return share


def _mean(values: Float, t_ns: Int64 | None, seed: int) -> Estimate | None:
    """Compute the mean of values over trials or times, and its interval."""
    if not len(values):
        return None
    interval = intervals({"mean": (values, np.ones(len(values)))}, t_ns, seed=seed)["mean"]
    return Estimate(float(values.mean()), interval)


@dataclass(frozen=True)
class ArmResult:
    """Flight of one arm, and what its cameras measured."""

    flight: ArmFlight
    error_m: Float32 | None  # [trials, P, J] NaN where not measured; None without a skeleton
    seen_share: float | None  # of joints and cameras
    joint_frames: int


def compare(scene: Scene, results: Mapping[str, ArmResult]) -> dict[str, Any]:
    """Score every arm and the differences to the reference.

    Errors are compared on common joint-frames: those that all arms measured in a trial, for `mpjpe_mm` and
    for the differences alike. `coverage` is the share that the arm itself measured.
    """
    errors = {name: result.error_m for name, result in results.items() if result.error_m is not None}
    shared = common_frames(errors) if errors else None
    arms = {name: _scores(scene, name, result, shared) for name, result in results.items()}
    reference = REFERENCE if REFERENCE in results else next(iter(results))
    differences = [
        {"arm": name, "against": reference, **_difference(scene, result, results[reference], shared)}
        for name, result in results.items()
        if name != reference
    ]
    settings, flight = scene.settings, scene.flight
    broken = [line for name, arm in arms.items() if (line := broken_limits(name, arm, scene.config))]
    return {
        "schema": 1,
        "simulated": True,  # replays are, and every reconstruction error
        "mode": settings.mode,
        "drones": scene.drones,
        "yaw_deg": float(np.degrees(scene.yaw_rad)),
        "duration_s": float(scene.t_s[-1]),
        "actor": {"planned_with": flight.actor_source, "scored_against": scene.actor_source},
        "skeleton": flight.skeleton_source,
        "flown_poses": flight.poses_source,
        "pose_noise_from": flight.noise_source,
        "maps": len(scene.fields),
        "near_obstacle_share": float(scene.near.mean()),
        "trials": settings.trials,
        "seed": settings.seed,
        "intervals": {"level": LEVEL, "errors_over": "trials", "flights_over_stretches_of_s": STRETCH_S},
        "arms": arms,
        "differences": differences,
        "verdict": _verdict(arms, differences, broken),
        "notes": list(scene.notes),
        "warnings": [*broken, *scene.warnings, *_warnings(results)],
    }


def _scores(scene: Scene, name: str, result: ArmResult, shared: Bool | None) -> dict[str, Any]:
    flown = result.flight
    found = score(scene.t_s, flown.position, scene.actor, scene.field, scene.config, near=scene.near)
    own, common, covered = _errors(scene, result, shared)
    return {
        **found,
        "mpjpe_mm": None if common is None else common.mean,
        "simulated": name not in LOGGED,
        "drones": len(flown.position),
        "local_plans": flown.separation or None,
        "safety": flown.safety or None,
        "reconstruction_error": {
            "simulated": True,
            "mpjpe_mm": _json(common),
            "mpjpe_of_all_it_measured_mm": _json(own),
            "coverage": _json(covered),
            "seen_share": result.seen_share,
            "joint_frames": result.joint_frames,
        },
    }


def _errors(
    scene: Scene, result: ArmResult, shared: Bool | None
) -> tuple[Estimate | None, Estimate | None, Estimate | None]:
    """Return the mean error of all measured joint-frames and of the common ones, and the coverage."""
    error, seed = result.error_m, scene.settings.seed
    if error is None or shared is None:
        return None, None, None
    measured = np.isfinite(error)
    own, common = (mean_of_trials(mpjpe_mm(error, rows), seed) for rows in (measured, shared & measured))
    return own, common, mean_of_trials(coverage(error, result.joint_frames), seed)


def _difference(scene: Scene, one: ArmResult, other: ArmResult, shared: Bool | None) -> dict[str, Any]:
    """Compute one minus the other, with intervals.

    Both have the same seeds, moments and joint-frames as in the table.
    """
    tilt_deg, hidden = (
        of(scene, one.flight).mean(axis=0) - of(scene, other.flight).mean(axis=0)
        for of in (_tilt_deg, _hidden)
    )
    always = np.ones(len(scene.t_ns), dtype=np.bool_)
    seed = scene.settings.seed
    error = cover = None
    if one.error_m is not None and other.error_m is not None and shared is not None:
        both = shared & np.isfinite(one.error_m) & np.isfinite(other.error_m)  # one may have measured none
        error = mean_of_trials(mpjpe_mm(one.error_m, both) - mpjpe_mm(other.error_m, both), seed)
        cover = mean_of_trials(
            coverage(one.error_m, one.joint_frames) - coverage(other.error_m, other.joint_frames), seed
        )
    return {
        "tilt_deg": _json(mean_over_time(tilt_deg, always, scene.t_ns, seed)),
        "tilt_near_obstacle_deg": _json(mean_over_time(tilt_deg, scene.near, scene.t_ns, seed)),
        "occluded_share": _json(mean_over_time(hidden, always, scene.t_ns, seed)),
        "mpjpe_mm": _json(error),
        "coverage": _json(cover),
        "simulated": True,
    }


def _tilt_deg(scene: Scene, flown: ArmFlight) -> Float:
    tilt_deg: Float = np.degrees(slot_of(flown.position - scene.actor)[..., TILT])
    return tilt_deg


def _hidden(scene: Scene, flown: ArmFlight) -> Float:
    seen = visible(scene.field, flown.position, scene.actor, start_m=scene.config.sight_start_m)
    return np.where(seen, 0.0, 1.0)


def _verdict(
    arms: Mapping[str, Mapping[str, Any]], differences: Sequence[Mapping[str, Any]], broken: Sequence[str]
) -> str:
    """Name the violated limits, and then compare the arms."""
    if differences:
        wanted = next((each for each in differences if each["arm"] == "adaptive"), differences[0])
        conclusion = verdict(wanted["arm"], wanted["against"], arms, wanted)
    else:
        conclusion = f"{next(iter(arms))} flew alone: there is nothing to compare it with"
    return ". ".join([*broken, conclusion])


def _warnings(results: Mapping[str, ArmResult]) -> list[str]:
    warnings = []
    for name, result in results.items():
        gap_share = float(1.0 - result.flight.known.mean())
        if gap_share > 0:
            warnings.append(
                f"{name}: {100 * gap_share:.1f} % of its poses lie in gaps of the log: straight ways there,"
                " and no pictures"
            )
        if result.error_m is not None and not np.isfinite(result.error_m).any():
            warnings.append(f"{name}: not a single joint could be measured from its cameras")
    return warnings


def _json(estimate: Estimate | None) -> dict[str, object] | None:
    return None if estimate is None else estimate.as_json()


def verdict(
    arm: str, against: str, arms: Mapping[str, Mapping[str, Any]], difference: Mapping[str, Any]
) -> str:
    """Compare an arm with another in one sentence: tilt, reconstruction error, coverage.

    `arms` and `difference` (of the two, arm minus against) are those of metrics.json.
    """
    return (
        f"{_about_tilt(arm, against, arms)}; {_about_error(difference)}{_about_coverage(arm, against, arms)}"
    )


def broken_limits(arm: str, scores: Mapping[str, Any], config: PlannerConfig) -> str | None:
    """Name every limit that an arm violates, and how often; None if it keeps all of them."""
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
    violations = [f"{words} ({_times(counts[kind])})" for kind, words in kinds.items() if counts.get(kind)]
    return f"{arm} {', '.join(violations)}" if violations else None


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
