"""Comparison of arms, as in metrics.json: scores, differences with their intervals, and the verdict.

Intervals are those of `geometry.metrics`: over the trials for errors, which are independent draws, and over
stretches of the flight for figures that depend on the flight's course.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Float32, Int64
from pipelines.geometry.metrics import LEVEL, STRETCH_S, intervals
from pipelines.planning.config import PlannerConfig
from pipelines.planning.formation import TILT, slot_of
from pipelines.planning.replay import (
    LOGGED,
    ArmFlight,
    MeasuredJoints,
    aimed_at,
    blown,
    looks_rad,
    seen_people,
)
from pipelines.planning.scene import ReplayScene
from pipelines.planning.scores import blind_s, score, view_quality
from pipelines.planning.scores import coverage as viewed

REFERENCE = "fixed"
"""Arm that the others are compared with; the first arm where it is missing."""
# Nobody changes a planner for less than half a centimetre of error.
SMALLEST_DIFFERENCE_MM = 5.0
# Nobody changes a planner for less than one joint in a hundred within 150 mm.
SMALLEST_DIFFERENCE_POINTS = 1.0
# Intervals from fewer draws of noise are wide, and their coverage depends on how errors are distributed.
FEW_TRIALS = 20
# Errors of arms whose mean ranges differ by more are not compared at equal range.
SAME_RANGE_M = 0.3
# The field counts a joint as right within this distance (PCK at 150 mm).
PCK_M = 0.15
# Modelled differences are off from filmed ones by this: RMS of worlds 0 to 14 of `benchmarks.planner films`,
# in mm of those seven where both arms see as much (7.4). For each point less of `coverage`, what is measured
# is off by the second: worlds 0, 2 and 10 give 0.3, and three are few.
MODEL_SIGMA_MM, MODEL_SIGMA_MM_PER_HIDDEN, MODEL_SIGMA_POINTS = 8.0, 0.5, 6.2
# Student's factor for many draws.
_TWO_SIDED = 1.96

WORTH = f"{SMALLEST_DIFFERENCE_POINTS:g} point or {SMALLEST_DIFFERENCE_MM:g} mm"
"""The smallest differences of a practical size, as a verdict states them."""

# The figures that decide, how many of their units are a smallest difference, and the sign of better.
_DECISIVE = {"pck150": (SMALLEST_DIFFERENCE_POINTS / 100, 1), "mpjpe_mm": (SMALLEST_DIFFERENCE_MM, -1)}

MeanWithInterval = dict[str, Any]
"""`mean`, and `interval`: the ends that hold it with `LEVEL` probability; None where there is none."""


# The figures of arms without a skeleton.
_NOTHING: dict[str, MeanWithInterval | None] = dict.fromkeys(("mpjpe_mm", "coverage", "pck150"))


def mean_of_trials(values: Float) -> MeanWithInterval | None:
    """Compute the mean of a figure over trials [K]; None without any, no interval for a single one."""
    return _ratio(values[:, None], np.ones((len(values), 1)))


def mean_over_time(values: Float, t_ns: Int64, seed: int) -> MeanWithInterval | None:
    """Compute the mean of [T] values over a flight, resampled in stretches."""
    if not len(values):
        return None
    ends = intervals({"mean": (values, np.ones(len(values)))}, t_ns, seed=seed)["mean"]
    return {"mean": float(values.mean()), "interval": None if ends is None else list(ends)}


def _ratio(sums: Float, weights: Float, t_ns: Int64 | None = None) -> MeanWithInterval | None:
    """Compute a ratio of totals [K, T] over trials and times; None where nothing has a weight."""
    # With `t_ns` the trials share one film, whose errors are a draw, too: its own interval is added.
    if not weights.sum() > 0:
        return None
    mean = float(sums.sum() / weights.sum())
    parts = [intervals({"": (sums.sum(axis=1), weights.sum(axis=1))}, None)[""]]
    if t_ns is not None:
        parts.append(intervals({"": (sums.sum(axis=0), weights.sum(axis=0))}, t_ns)[""])
    reaches = [(ends[1] - ends[0]) / 2 for ends in parts if ends is not None]
    if len(reaches) < len(parts):
        return {"mean": mean, "interval": None}
    reach = float(np.hypot.reduce(reaches))
    return {"mean": mean, "interval": [mean - reach, mean + reach]}


def common_frames(errors: Mapping[str, Float32]) -> Bool:
    """Return the joint-frames [trials, T, J] that every arm measured that measured anything."""
    measured = [np.isfinite(error) for error in errors.values() if np.isfinite(error).any()]
    shape = next(iter(errors.values())).shape
    return np.logical_and.reduce(measured) if measured else np.zeros(shape, dtype=np.bool_)


def figures_of(
    measured: MeasuredJoints, less: MeasuredJoints | None, shared: Bool, t_ns: Int64 | None = None
) -> dict[str, MeanWithInterval | None]:
    """Compute the figures of one arm, or of one `less` another: means with intervals, by name.

    `mpjpe_mm` is over the joint-frames [K, T, J] that are `shared`. `coverage` and `pck150` are shares of all
    joint-frames with a truth that were measured, and that were within `PCK_M`: what was not measured is
    wrong. With `t_ns` [T] the errors are of one film (`_ratio`); else differences are modelled, and their
    intervals hold what a film would show.
    """
    arms = [measured] if less is None else [measured, less]
    counted = np.logical_and.reduce([shared, *(np.isfinite(arm.error_m) for arm in arms)])
    frames = np.full(counted.shape[:2], measured.joint_frames / max(counted.shape[1], 1))

    def found(sums: Callable[[Float32], Float], weights: Float) -> MeanWithInterval | None:
        each = [sums(arm.error_m) for arm in arms]
        return _ratio(each[0] if less is None else each[0] - each[1], weights, t_ns)

    figures = {
        "mpjpe_mm": found(
            lambda error_m: 1e3 * np.where(counted, error_m, 0.0).sum(axis=2, dtype=np.float64),
            counted.sum(axis=2, dtype=np.float64),
        ),
        "coverage": found(lambda error_m: np.isfinite(error_m).sum(axis=2, dtype=np.float64), frames),
        "pck150": found(lambda error_m: (error_m <= PCK_M).sum(axis=2, dtype=np.float64), frames),
    }
    if less is not None and t_ns is None:
        near = [float((np.abs(arm.error_m - PCK_M) <= MODEL_SIGMA_MM / 1e3).mean()) for arm in arms]
        hidden = 100 * (figures["coverage"] or {"mean": 0.0})["mean"]
        _widen(figures["mpjpe_mm"], float(np.hypot(MODEL_SIGMA_MM, MODEL_SIGMA_MM_PER_HIDDEN * hidden)))
        # Where many joints err by about 150 mm, a few millimetres are many points.
        _widen(figures["pck150"], float(np.hypot(MODEL_SIGMA_POINTS / 100, np.mean(near) / 2)))
    return figures


def _widen(found: MeanWithInterval | None, sigma: float) -> None:
    """Add what a model is off by to an interval."""
    if found is not None and found["interval"] is not None:
        reach = float(np.hypot(np.ptp(found["interval"]) / 2, _TWO_SIDED * sigma))
        found["interval"] = [found["mean"] - reach, found["mean"] + reach]


def capped_mm(measured: MeasuredJoints) -> Float:
    """Compute the mean error [K], each at most 150 mm (`PCK_M`), as joints count that were not measured."""
    error = np.where(np.isfinite(measured.error_m), measured.error_m, PCK_M).astype(np.float64)
    gained = (PCK_M - np.minimum(error, PCK_M)).sum(axis=(1, 2))
    capped: Float = 1e3 * (PCK_M - gained / max(measured.joint_frames, 1))
    return capped


@dataclass(frozen=True)
class ArmResult:
    """Flight of one arm, and what its cameras measured."""

    flight: ArmFlight
    measured: MeasuredJoints | None  # None without a skeleton


def compare(scene: ReplayScene, results: Mapping[str, ArmResult]) -> dict[str, Any]:
    """Score every arm and the differences to the reference, on joint-frames that all arms measured."""
    measured = {name: each.measured for name, each in results.items() if each.measured is not None}
    shared = common_frames({name: each.error_m for name, each in measured.items()}) if measured else None
    seen = {name: seen_people(scene, result.flight) for name, result in results.items()}
    arms = {name: _scores(scene, name, result, seen[name], shared) for name, result in results.items()}
    reference = REFERENCE if REFERENCE in results else next(iter(results))
    differences = [
        {"arm": name, "against": reference, **_difference(scene, results, seen, (name, reference), shared)}
        for name in results
        if name != reference
    ]
    alike = equal_ranges({name: arm["range_m"]["mean"] for name, arm in arms.items()})
    breaking = {name for name, arm in arms.items() if sum(arm["limit_violations"].values())}
    best = judge(measured, breaking)
    broken = [line for name, arm in arms.items() if (line := broken_limits(name, arm, scene.config))]
    settings, flight = scene.settings, scene.flight
    words = [*broken, verdict(best, list(arms))]
    if best is not None and best["untold"] and settings.trials >= FEW_TRIALS:  # more draws would not help
        words.append("the model may be off by as much: film them (--render, if the flight is simulated)")
    return {
        "schema": 1,
        "simulated": True,  # replays are, and every reconstruction error
        "drones": scene.drones,
        "yaw_deg": float(np.degrees(scene.yaw_rad)),
        "duration_s": float(scene.t_s[-1]),
        "actor": {"planned_with": flight.actor_source, "scored_against": scene.actor_source},
        "skeleton": flight.skeleton_source,
        "flown_poses": flight.poses_source,
        "pose_noise_from": flight.noise_source,
        "maps": len(scene.fields),
        "trials": settings.trials,
        "seed": settings.seed,
        "intervals": {"level": LEVEL, "errors_over": "trials", "flights_over_stretches_of_s": STRETCH_S},
        "smallest_difference": {"mm": SMALLEST_DIFFERENCE_MM, "points": SMALLEST_DIFFERENCE_POINTS},
        "arms": arms,
        "differences": differences,
        "best": best,
        "equal_ranges": [
            {
                "arms": names,
                "best": judge({name: measured[name] for name in names if name in measured}, breaking),
            }
            for names in alike
        ],
        "verdict": "; ".join(words),
        "notes": list(scene.notes),
        "warnings": [*broken, *_unequal(arms), *scene.warnings, *_warnings(scene, results)],
    }


def _scores(
    scene: ReplayScene, name: str, result: ArmResult, seen: Bool, shared: Bool | None
) -> dict[str, Any]:
    flown = result.flight
    found = score(
        scene.t_s,
        flown.position,
        aimed_at(scene, flown),
        scene.maps,
        scene.config,
        people=scene.people,
        seen=seen,
        pushed=0.0
        if name in LOGGED
        else blown(np.zeros_like(flown.position), scene.t_s, scene.config, scene.settings.seed),
    )
    own = result.measured
    figures = _NOTHING if own is None or shared is None else figures_of(own, None, shared)
    return {
        **found,
        "mpjpe_mm": figures["mpjpe_mm"] and figures["mpjpe_mm"]["mean"],
        "simulated": name not in LOGGED,
        "drones": len(flown.position),
        "safety": flown.safety or None,
        "reconstruction_error": {
            "simulated": True,
            **figures,
            "joint_frames": 0 if own is None else own.joint_frames,
        },
        **_by_person(scene, result, seen, shared),
    }


def _by_person(scene: ReplayScene, result: ArmResult, seen: Bool, shared: Bool | None) -> dict[str, Any]:
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
        by_person[name] = {
            "weight": float(scene.flight.weights[p]),
            "occluded_share": float(1.0 - seen[p].mean()),
            "blind_s": blind_s(scene.t_s, seen[p : p + 1]),
            "view_quality": each[p],
        }
        if result.measured is not None and shared is not None and scene.joints is not None:
            joints = shared.shape[2] // len(people)
            own = slice(p * joints, (p + 1) * joints)
            frames = int(np.isfinite(scene.joints[:, own, 0]).sum())
            one = MeasuredJoints(result.measured.error_m[:, :, own], frames)
            by_person[name] |= figures_of(one, None, shared[:, :, own])
    return over_all | {"by_person": by_person}


def _difference(
    scene: ReplayScene,
    results: Mapping[str, ArmResult],
    seen: Mapping[str, Bool],
    names: tuple[str, str],
    shared: Bool | None,
) -> dict[str, Any]:
    one, other = (results[name] for name in names)
    slots = [slot_of(each.flight.position - aimed_at(scene, each.flight)) for each in (one, other)]
    tilts = [np.degrees(each[..., TILT]).mean(axis=0) for each in slots]
    hidden = [1.0 - seen[name].mean(axis=(0, 1)) for name in names]
    seed = scene.settings.seed
    measured = one.measured, other.measured
    errors = _NOTHING
    if shared is not None and measured[0] is not None and measured[1] is not None:
        errors = figures_of(measured[0], measured[1], shared)
    return {
        "tilt_deg": mean_over_time(tilts[0] - tilts[1], scene.t_ns, seed),
        "occluded_share": mean_over_time(hidden[0] - hidden[1], scene.t_ns, seed),
        **errors,
        "simulated": True,
    }


def worth_flying(difference: Mapping[str, MeanWithInterval | None]) -> list[int]:
    """Judge by each decisive figure if an arm is better (1), worse (-1), or neither (0: noise, or small)."""
    found = []
    for name, (smallest, better) in _DECISIVE.items():
        change = difference[name]
        ends = change and change["interval"]
        if change is None or not ends or ends[0] <= 0.0 <= ends[1] or abs(change["mean"]) < smallest:
            found.append(0)
        else:
            found.append(better * int(np.sign(change["mean"])))
    return found


def is_untold(difference: Mapping[str, MeanWithInterval | None]) -> bool:
    """Test if a difference is large enough to be worth flying in a figure, but may be chance in all."""
    large = (abs(found["mean"]) >= _DECISIVE[name][0] for name in _DECISIVE if (found := difference[name]))
    return any(large) and not any(worth_flying(difference))


def judge(
    measured: Mapping[str, MeasuredJoints], breaking: Collection[str], t_ns: Int64 | None = None
) -> dict[str, Any] | None:
    """Find the arms that no other one beats; None if there are fewer than two, or nothing was measured.

    Arms that are `breaking` limits are left out, unless all are. With `t_ns` [T] the errors are of films.
    """
    share = {name: float((arm.error_m <= PCK_M).sum()) / arm.error_m.size for name, arm in measured.items()}
    ranked = sorted(share, key=lambda name: -share[name])
    kept = [name for name in ranked if name not in breaking] or ranked
    left_out = [name for name in ranked if name not in kept]
    if len(ranked) < 2 or not any(np.isfinite(arm.error_m).any() for arm in measured.values()):
        return None
    shared = common_frames({name: arm.error_m for name, arm in measured.items()})
    change = {
        (one, other): figures_of(measured[one], measured[other], shared, t_ns)
        for one, other in permutations(kept if len(kept) > 1 else ranked, 2)
    }
    judged = {pair: worth_flying(found) for pair, found in change.items()}
    beats = {pair for pair, signs in judged.items() if pair[0] in kept and max(signs) > 0 and min(signs) >= 0}
    unbeaten = [name for name in kept if not any(other == name for _, other in beats)]
    worse = [name for name in kept if any((one, name) in beats for one in unbeaten)]
    if len(unbeaten) + len(worse) < min(len(kept), 2):  # the others beat each other in a circle
        unbeaten, worse = kept, []
    first, second = unbeaten[0], (unbeaten[1:] or worse or left_out)[0]
    disagreeing = next((pair for pair in permutations(unbeaten, 2) if judged[pair] == [1, -1]), None)
    untold = next((pair for pair in permutations(unbeaten, 2) if is_untold(change[pair])), None)
    first, second = disagreeing or untold or (first, second)
    return {
        "arms": unbeaten,
        "disagree": disagreeing is not None,
        "untold": untold is not None and disagreeing is None,
        "worse": worse,
        "left_out": left_out,
        "difference": {"arm": first, "against": second, **change[first, second]},
    }


def outcome(best: Mapping[str, Any]) -> str:
    """Say which arm is better, that none is or can be told, or that the figures disagree."""
    arm, other = best["difference"]["arm"], best["difference"]["against"]
    worse = " and ".join(sorted(best["worse"]))
    if best["disagree"]:
        return f"the figures disagree: {arm} has more joints right, {other} is more accurate"
    if len(best["arms"]) == 1:
        return f"{arm} is better than {worse}" if worse else f"only {arm} keeps its limits"
    rest = f", at least one of them better than {worse}" if worse else ""
    none = "too uncertain to choose" if best["untold"] else f"no difference worth flying ({WORTH})"
    return f"{none} between {' and '.join(sorted(best['arms']))}{rest}"


def verdict(best: Mapping[str, Any] | None, names: Sequence[str]) -> str:
    """Say in one sentence which arm is better and by how much, that none is, or that the figures disagree."""
    if best is None:
        return f"{' and '.join(names)}: there is nothing to compare"
    difference = best["difference"]
    points = _with_interval(difference["pck150"], 100.0, "points of joints within 150 mm")
    figures = f"{points}, {_with_interval(difference['mpjpe_mm'], 1.0, 'mm of mean error')} (simulated)"
    left = f"; {' and '.join(best['left_out'])} left out for broken limits" if best["left_out"] else ""
    arm, other = difference["arm"], difference["against"]
    pair = "" if (best["arms"], best["worse"]) == ([arm], [other]) else f"; {arm} less {other}"
    return f"{outcome(best)}{pair}: {figures}{left}"


def filmed_verdict(
    best: Mapping[str, Any] | None, modelled: Mapping[str, Any] | None, names: Sequence[str]
) -> str:
    """Say what the films of the arms show; where the modelled measurement said otherwise, say that, too."""
    if best is not None and (best["difference"]["pck150"] or {}).get("interval") is None:
        return f"filmed: too few pictures to tell {' and '.join(names)} apart"
    words = f"filmed: {verdict(best, names)}"
    if best is None or modelled is None or modelled.get("untold") or outcome(best) == outcome(modelled):
        return words
    return f"{words}. The model said otherwise ({outcome(modelled)}): the film counts"


def _with_interval(found: MeanWithInterval | None, scale: float, unit: str) -> str:
    if found is None:
        return f"unknown {unit}"
    ends = found["interval"]
    interval = f"[{scale * ends[0]:+.1f}, {scale * ends[1]:+.1f}]" if ends else "(no interval)"
    return f"{scale * found['mean']:+.1f} {interval} {unit}"


def equal_ranges(range_m: Mapping[str, float]) -> list[list[str]]:
    """Group arms that can be compared without the gain of a nearer view: mean ranges within 0.3 m."""
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
        shown = ", ".join(f"{name} {count}" for name, count in counts.items())
        found.append(f"the arms have different numbers of drones ({shown}): more views measure better")
    ranges = {name: arm["range_m"]["mean"] for name, arm in arms.items()}
    if max(ranges.values()) - min(ranges.values()) > SAME_RANGE_M:
        shown = ", ".join(f"{name} {mean:.1f} m" for name, mean in ranges.items())
        found.append(f"the arms film from different mean ranges ({shown}), which may explain a difference")
    return found


def few_trials(trials: int) -> list[str]:
    """Warn of intervals from few draws, in one line."""
    if trials >= FEW_TRIALS:
        return []
    return [f"few draws of noise ({trials}): take {FEW_TRIALS} or more, or do not trust the intervals"]


def _warnings(scene: ReplayScene, results: Mapping[str, ArmResult]) -> list[str]:
    warnings = few_trials(scene.settings.trials) if scene.flight.skeleton is not None else []
    for name, result in results.items():
        gap_share = float(1.0 - result.flight.known.mean())
        if gap_share > 0:
            warnings.append(
                f"{name}: {100 * gap_share:.1f} % of its poses lie in gaps of the log, or behind the end of a"
                " battery: straight ways there, and no pictures"
            )
        if result.measured is not None and not np.isfinite(result.measured.error_m).any():
            warnings.append(f"{name}: not a single joint could be measured from its cameras")
    return warnings


def broken_limits(arm: str, scores: Mapping[str, Any], config: PlannerConfig) -> str | None:
    """Name every limit that an arm violates, and how often; None if it keeps all of them."""
    kinds = {
        "collision": "collides with an obstacle",
        "clearance": f"comes within {config.drone_radius_m:g} m of an obstacle",
        "actor": f"comes within {config.actor_distance_m:g} m of the actor",
        "separation": f"has two drones within {config.separation_m:g} m of each other",
        "speed": f"flies faster than {config.speed_mps:g} m/s",
        "acceleration": f"accelerates by more than {config.acceleration_mps2:g} m/s^2",
        "battery": f"needs more than {config.imperfections.battery_kj or 0:g} kJ",
        "jerk": f"has a jerk of more than {config.jerk_mps3:g} m/s^3",
    }
    counts = scores["limit_violations"]
    violations = [
        f"{words} ({'once' if counts[kind] == 1 else f'{counts[kind]} times'})"
        for kind, words in kinds.items()
        if counts.get(kind)
    ]
    return f"{arm} {', '.join(violations)}" if violations else None
