"""Comparison of arms, as in metrics.json: scores, differences with their intervals, and the verdict.

Intervals are those of `geometry.metrics`: over the trials for errors, which are independent draws, and over
stretches of the flight for figures that depend on the flight's course.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Float32, Int64
from pipelines.geometry.metrics import LEVEL, STRETCH_S, intervals
from pipelines.planning.arm_flights import LOGGED, ArmFlight, aimed_at, looks_rad, seen_people
from pipelines.planning.config import PlannerConfig
from pipelines.planning.formation import TILT, slot_of
from pipelines.planning.scene import ReplayScene
from pipelines.planning.scores import blind_s, score, view_quality
from pipelines.planning.scores import coverage as viewed

REFERENCE = "fixed"
"""Arm that the others are compared with; the first arm where it is missing."""
# Smaller differences of the largest tilt are not worth a sentence.
SAME_TILT_DEG = 2.0
# Smaller differences of the measured share are not worth a sentence.
SAME_COVERAGE_PERCENT = 1.0
# Errors of arms whose mean ranges differ by more are not compared at equal range.
SAME_RANGE_M = 0.3
# The field counts a joint as right within this distance (PCK at 150 mm).
PCK_M = 0.15


MeanWithInterval = dict[str, Any]
"""`mean`, and `interval`: the ends that hold it with `LEVEL` probability; None where there is none."""


def mean_of_trials(values: Float, seed: int) -> MeanWithInterval | None:
    """Compute the mean of a figure over trials [K]; None without any, no interval for a single one."""
    return _mean(values, None, seed)


def mean_over_time(values: Float, counted: Bool, t_ns: Int64, seed: int) -> MeanWithInterval | None:
    """Compute the mean of [T] or [N, T] over the moments [T] that count, resampled in stretches."""
    return _mean(np.atleast_2d(values).mean(axis=0)[counted], t_ns[counted], seed)


def _mean(values: Float, t_ns: Int64 | None, seed: int) -> MeanWithInterval | None:
    if not len(values):
        return None
    ends = intervals({"mean": (values, np.ones(len(values)))}, t_ns, seed=seed)["mean"]
    return {"mean": float(values.mean()), "interval": None if ends is None else list(ends)}


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


def pck(error_m: Float32, joint_frames: int) -> Float:
    """Compute the share [K] of the joint-frames with a truth whose error is at most `PCK_M`, 0..1.

    Joints that were not measured count as wrong.
    """
    share: Float = (error_m <= PCK_M).sum(axis=(1, 2)) / max(joint_frames, 1)
    return share


def capped_mm(error_m: Float32, joint_frames: int) -> Float:
    """Compute the mean error [K] over all joint-frames with a truth, each at most 150 mm (`PCK_M`).

    Joints that were not measured count as 150 mm off, so that missing joints cannot flatter.
    """
    error = np.where(np.isfinite(error_m), error_m, PCK_M).astype(np.float64)
    gained = (PCK_M - np.minimum(error, PCK_M)).sum(axis=(1, 2))
    capped: Float = 1e3 * (PCK_M - gained / max(joint_frames, 1))
    return capped


def coverage(error_m: Float32, joint_frames: int) -> Float:
    """Compute the share [K] of the joint-frames with a truth that were measured, 0..1."""
    share: Float = np.isfinite(error_m).sum(axis=(1, 2)) / max(joint_frames, 1)
    return share


@dataclass(frozen=True)
class ArmResult:
    """Flight of one arm, and what its cameras measured."""

    flight: ArmFlight
    error_m: Float32 | None  # [trials, P, J] NaN where not measured; None without a skeleton
    seen_share: float | None  # of joints and cameras
    joint_frames: int


def compare(scene: ReplayScene, results: Mapping[str, ArmResult]) -> dict[str, Any]:
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
    best = _best(scene, results, arms, shared)
    alike = equal_ranges({name: arm["range_m"]["mean"] for name, arm in arms.items()})
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
        "zones": [asdict(zone) for zone in scene.config.zones],
        "near_obstacle_share": float(scene.near.mean()),
        "trials": settings.trials,
        "seed": settings.seed,
        "intervals": {"level": LEVEL, "errors_over": "trials", "flights_over_stretches_of_s": STRETCH_S},
        "arms": arms,
        "differences": differences,
        "best": best,
        "equal_ranges": [
            {
                "arms": names,
                "best": _best(scene, {name: results[name] for name in names}, arms, shared)
                if len(alike) > 1
                else best,
            }
            for names in alike
        ],
        "verdict": _verdict(arms, differences, broken, best),
        "notes": list(scene.notes),
        "warnings": [*broken, *_unequal(arms), *scene.warnings, *_warnings(results)],
    }


def measure_alone(scene: ReplayScene, name: str, result: ArmResult) -> dict[str, Any]:
    """Score one arm as in metrics.json; `mpjpe_mm` is that of all joint-frames that it measured."""
    return _scores(scene, name, result, None if result.error_m is None else np.isfinite(result.error_m))


def _scores(scene: ReplayScene, name: str, result: ArmResult, shared: Bool | None) -> dict[str, Any]:
    flown = result.flight
    seen = seen_people(scene, flown)
    found = score(
        scene.t_s,
        flown.position,
        aimed_at(scene, flown),
        scene.maps,
        scene.config,
        near=scene.near,
        people=scene.people,
        seen=seen,
    )
    own, common, covered = _errors(scene, result, shared)
    return {
        **found,
        "mpjpe_mm": None if common is None else common["mean"],
        "simulated": name not in LOGGED,
        "drones": len(flown.position),
        "local_plans": flown.separation or None,
        "safety": flown.safety or None,
        "reconstruction_error": {
            "simulated": True,
            "mpjpe_mm": common,
            "mpjpe_of_all_it_measured_mm": own,
            "coverage": covered,
            "pck150": _pck(scene, result),
            "seen_share": result.seen_share,
            "joint_frames": result.joint_frames,
        },
        **_by_person(scene, result, seen, shared),
    }


def _by_person(scene: ReplayScene, result: ArmResult, seen: Bool, shared: Bool | None) -> dict[str, Any]:
    """Compute the view quality over all people, and of several people the figures of each."""
    flown, people = result.flight, scene.people
    covered = viewed(
        flown.position,
        looks_rad(flown),
        people.swapaxes(0, 1),
        np.zeros(people.shape[1::-1]),
        fov_rad=scene.config.tuning.errors.fov_rad,
    )
    covered = (covered * seen.transpose(1, 2, 0)[..., None]).sum(axis=0)  # [T, P, 7]
    each = [float(view_quality(covered[:, [p]], np.ones(1)).mean()) for p in range(len(people))]
    over_all = {"view_quality": float(scene.weights @ each)}
    if len(people) == 1:
        return over_all
    by_person: dict[str, Any] = {}
    for p, name in enumerate(scene.flight.people):
        figures = by_person[name] = {
            "weight": float(scene.flight.weights[p]),
            "occluded_share": float(1.0 - seen[p].mean()),
            "blind_s": blind_s(scene.t_s, seen[p : p + 1]),
            "view_quality": each[p],
        }
        if result.error_m is None or shared is None or scene.joints is None:
            continue
        joints = result.error_m.shape[2] // len(people)
        own = slice(p * joints, (p + 1) * joints)
        error, frames = result.error_m[:, :, own], int(np.isfinite(scene.joints[:, own, 0]).sum())
        seed = scene.settings.seed
        figures |= {
            "mpjpe_mm": mean_of_trials(mpjpe_mm(error, shared[:, :, own]), seed),
            "coverage": mean_of_trials(coverage(error, frames), seed),
            "pck150": mean_of_trials(pck(error, frames), seed),
        }
    return over_all | {"by_person": by_person}


def _errors(
    scene: ReplayScene, result: ArmResult, shared: Bool | None
) -> tuple[MeanWithInterval | None, MeanWithInterval | None, MeanWithInterval | None]:
    """Return the mean error of all measured joint-frames and of the common ones, and the coverage."""
    error, seed = result.error_m, scene.settings.seed
    if error is None or shared is None:
        return None, None, None
    measured = np.isfinite(error)
    own, common = (mean_of_trials(mpjpe_mm(error, rows), seed) for rows in (measured, shared & measured))
    return own, common, mean_of_trials(coverage(error, result.joint_frames), seed)


def _pck(scene: ReplayScene, result: ArmResult) -> MeanWithInterval | None:
    if result.error_m is None:
        return None
    return mean_of_trials(pck(result.error_m, result.joint_frames), scene.settings.seed)


def _difference(scene: ReplayScene, one: ArmResult, other: ArmResult, shared: Bool | None) -> dict[str, Any]:
    """Compute one minus the other, with intervals."""
    tilt_deg, hidden = (
        of(scene, one.flight).mean(axis=0) - of(scene, other.flight).mean(axis=0)
        for of in (_tilt_deg, _hidden)
    )
    always = np.ones(len(scene.t_ns), dtype=np.bool_)
    seed = scene.settings.seed
    error = cover = right = None
    over_flights: dict[str, object] = {"mpjpe_mm": None, "pck150": None}
    if one.error_m is not None and other.error_m is not None and shared is not None:
        both = shared & np.isfinite(one.error_m) & np.isfinite(other.error_m)  # one may have measured none
        error = mean_of_trials(mpjpe_mm(one.error_m, both) - mpjpe_mm(other.error_m, both), seed)
        cover = mean_of_trials(
            coverage(one.error_m, one.joint_frames) - coverage(other.error_m, other.joint_frames), seed
        )
        right = mean_of_trials(
            pck(one.error_m, one.joint_frames) - pck(other.error_m, other.joint_frames), seed
        )
        over_flights = _over_flights(scene, one.error_m, other.error_m, both)
    return {
        "tilt_deg": mean_over_time(tilt_deg, always, scene.t_ns, seed),
        "tilt_near_obstacle_deg": mean_over_time(tilt_deg, scene.near, scene.t_ns, seed),
        "occluded_share": mean_over_time(hidden, always, scene.t_ns, seed),
        "mpjpe_mm": error,
        "coverage": cover,
        "pck150": right,
        "interval_over_flights": over_flights,
        "simulated": True,
    }


def _over_flights(scene: ReplayScene, one: Float32, other: Float32, both: Bool) -> dict[str, object]:
    """Compute the intervals of the differences over stretches of the flight, noise averaged over trials."""
    t_ns = scene.t_ns[scene.pictures]
    known = np.zeros(one.shape[1]) if scene.joints is None else np.isfinite(scene.joints[..., 0]).sum(axis=1)
    right = ((one <= PCK_M).sum(axis=2, dtype=np.float64) - (other <= PCK_M).sum(axis=2)).mean(axis=0)
    further = np.where(both, one - other, 0.0).sum(axis=2, dtype=np.float64).mean(axis=0)
    series = {
        "mpjpe_mm": (1e3 * further, both.sum(axis=2).mean(axis=0)),
        "pck150": (right, known.astype(np.float64)),
    }
    found = intervals(series, t_ns, seed=scene.settings.seed)
    return {name: None if ends is None else list(ends) for name, ends in found.items()}


def _tilt_deg(scene: ReplayScene, flown: ArmFlight) -> Float:
    tilt_deg: Float = np.degrees(slot_of(flown.position - aimed_at(scene, flown))[..., TILT])
    return tilt_deg


def _hidden(scene: ReplayScene, flown: ArmFlight) -> Float:
    hidden: Float = 1.0 - seen_people(scene, flown).mean(axis=0)
    return hidden


def _best(
    scene: ReplayScene,
    results: Mapping[str, ArmResult],
    arms: Mapping[str, Mapping[str, Any]],
    shared: Bool | None,
) -> dict[str, Any] | None:
    """Name the best arm, the runner-up, and their difference; None if fewer than two measured anything."""
    measured = [
        name
        for name, arm in arms.items()
        if name in results and (arm["reconstruction_error"]["pck150"] or {}).get("mean")
    ]
    kept = [name for name in measured if not sum(arms[name]["limit_violations"].values())] or measured
    if len(kept) < 2:
        return None

    def right(name: str) -> float:
        return float(arms[name]["reconstruction_error"]["pck150"]["mean"])

    def less(one: str, other: str) -> dict[str, Any]:
        return _difference(scene, results[one], results[other], shared)

    leader = max(kept, key=right)
    close = [name for name in kept if name == leader or not _told_apart(less(leader, name)["pck150"])]
    by_error = [name for name in close if arms[name]["mpjpe_mm"] is not None]
    best = min(by_error, key=lambda name: float(arms[name]["mpjpe_mm"])) if by_error else leader
    against = {name: less(best, name) for name in kept if name != best}
    alike = [
        name
        for name in close
        if name != best and not any(_told_apart(against[name][key]) for key in ("pck150", "mpjpe_mm"))
    ]
    others = [name for name in against if name not in alike] or list(against)
    runner_up = max(others, key=right)
    return {
        "arm": best,
        "alike": alike,
        "runner_up": runner_up,
        "left_out": [name for name in measured if name not in kept],
        "difference": {"arm": best, "against": runner_up, **against[runner_up]},
    }


def _told_apart(found: Mapping[str, Any] | None) -> bool:
    """Test if an interval over trials excludes zero; without an interval any difference counts."""
    if found is None or not found["mean"]:
        return False
    ends = found["interval"]
    return ends is None or not ends[0] <= 0.0 <= ends[1]


def _about_best(best: Mapping[str, Any], arms: Mapping[str, Mapping[str, Any]]) -> str:
    """Name the best arm with its difference to the runner-up and both intervals."""
    name, other, difference = best["arm"], best["runner_up"], best["difference"]
    share = 100 * arms[name]["reconstruction_error"]["pck150"]["mean"]
    own = f"{share:.1f} % of all joints within {1e3 * PCK_M:.0f} mm"
    words = [
        f"{100 * difference['pck150']['mean']:+.1f} points of % against {other}"
        f" ({_two_intervals(difference, 'pck150', 100.0)})"
    ]
    if difference["mpjpe_mm"] is not None:
        words.append(
            f"{difference['mpjpe_mm']['mean']:+.1f} mm where both measured"
            f" ({_two_intervals(difference, 'mpjpe_mm', 1.0)})"
        )
    if best["alike"]:
        first = f"best are {' and '.join([name, *best['alike']])}, which the noise does not tell apart: {own}"
    else:
        first = f"best is {name}: {own}"
    left = best["left_out"]
    dropped = f"; {' and '.join(left)} left out for broken limits" if left else ""
    return f"{first}, {', '.join(words)}, simulated{dropped}"


def _two_intervals(difference: Mapping[str, Any], key: str, scale: float) -> str:
    """Format the interval over draws of noise and that over stretches of the flight."""
    over = {"noise": difference[key]["interval"], "flight": difference["interval_over_flights"][key]}
    parts = [
        f"{name} [{scale * ends[0]:+.1f}, {scale * ends[1]:+.1f}]" for name, ends in over.items() if ends
    ]
    return ", ".join(parts) or "a single draw"


def equal_ranges(range_m: Mapping[str, float]) -> list[list[str]]:
    """Group arms by their mean ranges, the nearest first: within a group they differ by at most 0.3 m.

    Arms of one group can be compared without the gain of a nearer view.
    """
    groups: list[list[str]] = []
    for name in sorted(range_m, key=lambda name: range_m[name]):
        if groups and range_m[name] - range_m[groups[-1][0]] <= SAME_RANGE_M:
            groups[-1].append(name)
        else:
            groups.append([name])
    return groups


def _unequal(arms: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """List what makes the comparison unequal: numbers of drones, and ranges, one line each."""
    found = []
    counts = {name: arm["drones"] for name, arm in arms.items()}
    if len(set(counts.values())) > 1:
        said = ", ".join(f"{name} {count}" for name, count in counts.items())
        found.append(f"the arms have different numbers of drones ({said}): more views measure better")
    ranges = {name: arm["range_m"]["mean"] for name, arm in arms.items()}
    if max(ranges.values()) - min(ranges.values()) > SAME_RANGE_M:
        said = ", ".join(f"{name} {mean:.1f} m" for name, mean in ranges.items())
        found.append(f"the arms film from different mean ranges ({said}), which may explain a difference")
    return found


def _verdict(
    arms: Mapping[str, Mapping[str, Any]],
    differences: Sequence[Mapping[str, Any]],
    broken: Sequence[str],
    best: Mapping[str, Any] | None,
) -> str:
    """Name the violated limits and the best arm, and then compare the arms."""
    if differences:
        wanted = next((each for each in differences if each["arm"] == "adaptive"), differences[0])
        conclusion = verdict(wanted["arm"], wanted["against"], arms, wanted)
    else:
        conclusion = f"{next(iter(arms))} flew alone: there is nothing to compare it with"
    named = [] if best is None else [_about_best(best, arms)]
    unequal = [f"{said[0].upper()}{said[1:]}" for said in _unequal(arms)]
    return ". ".join([*broken, *named, conclusion, *unequal])


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
        "zone": "enters a no-fly zone",
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
    if abs(own - other) < SAME_TILT_DEG:
        return f"{arm} and {against} tilt alike, up to {own:.0f} and {other:.0f} deg"
    if own < other:
        return f"{arm} keeps the tilt at {own:.0f} deg where {against} climbs to {other:.0f}"
    return f"{arm} climbs to a tilt of {own:.0f} deg where {against} keeps it at {other:.0f}"


def _about_coverage(arm: str, against: str, arms: Mapping[str, Mapping[str, Any]]) -> str:
    """Say which arm measured more joints; empty if they are alike."""
    found = [arms[name]["reconstruction_error"]["coverage"] for name in (arm, against)]
    if None in found:
        return ""
    own, other = (100 * each["mean"] for each in found)
    if abs(own - other) < SAME_COVERAGE_PERCENT:
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
