"""Predicted against measured errors of arms in random worlds: `python -m benchmarks.prediction [--first N]`.

`--bound` also flies arms that know the whole way of the actor, with the same limits, and compares each arm
with the least error of these in every world. `joint` is compared with `adaptive` as both are handed out,
where it may come nearer (8 m instead of 10), and at equal range. `--keep FILE` stores the flights of each
world; worlds that are there are not flown again. `--joint` flies `joint` and `adaptive` alone. `--draws N`
flies every arm N times with 1 cm of noise on the actor's log and takes means over these flights: flights are
chaotic, and one of them says little about an arm.

Two arms are compared on common joint-frames, as in `replan-compare`: those that both measured. They are also
compared at equal flown range: each error is scaled by what the ray model predicts at these moments for the
same views and directions with all distances scaled, so that the flight's mean is the range that was asked
for. "By chance" is the number of worlds in which the noise that is left in means over draws would make an arm
worse.

Every arm flies through worlds of `benchmarks.worlds`. One posture of a walk, carried along by the actor, is
measured by triangulation with modelled keypoints and white pose noise (0.02 m, 0.2 deg), 32 draws. The
ray model predicts the error from the same noise and the detector's table. Correlations are over flights, and
within flights over seconds. All simulated. Worlds from 1000 on were tuned on, those from 2000 on kept aside.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.results_page import markdown_table
from benchmarks.worlds import world_of
from pipelines.geometry.arrays import Float, Float32
from pipelines.geometry.noise import White
from pipelines.planning.arm_flights import CameraPaths, measure
from pipelines.planning.arms import PLANNER_ARMS
from pipelines.planning.comparison import common_frames, mpjpe_mm, pck
from pipelines.planning.config import PlannerConfig
from pipelines.planning.replay import Start, replay
from pipelines.planning.scores import errors_of_views, predicted_errors, score, seen_actor
from pipelines.replan import detect_by_model, error_model
from pipelines.simulation.scenario import DetectorErrors, Lens
from pipelines.simulation.study.sightings import walk

ARMS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "fixed": ("fixed", {}),
    "adaptive": ("adaptive", {}),
    "covariance, 10 m only": ("covariance", {"ranges_m": (10.0,)}),
    "greedy, 10 m only": ("greedy", {"ranges_m": (10.0,)}),
    "joint, 10 m only": ("joint", {"ranges_m": (10.0,)}),
    "adaptive, 8 m": ("adaptive", {"radius_m": 8.0}),
    "covariance": ("covariance", {}),
    "greedy": ("greedy", {}),
    "joint": ("joint", {}),
    "joint, from 8 m": ("joint", {"radius_m": 8.0}),
    "adaptive, log 1 cm off": ("adaptive", {"actor_noise_m": 0.01}),
    "adaptive, 8 m, log 1 cm off": ("adaptive", {"radius_m": 8.0, "actor_noise_m": 0.01}),
}
"""Arms by their names in the tables, with changes of the settings: those of equal range beside each other."""
COMPARED: Mapping[str, str] = {
    "joint": "adaptive",
    "joint, 10 m only": "adaptive",
    "joint, from 8 m": "adaptive, 8 m",
    "adaptive, log 1 cm off": "adaptive",
    "adaptive, 8 m, log 1 cm off": "adaptive, 8 m",
    "joint, from 8 m, way known": "adaptive, 8 m, way known",
}
"""Arms that are compared with `adaptive`: `joint` as handed out, which may come nearer, then at equal range.

`adaptive` itself differs by chance: flights are chaotic."""
FINE: Mapping[str, Any] = {"lattice_yaws": 32, "lattice_knots": 1, "tilts_deg": (10.0, 15.0, 20.0)}
NEAREST_M = 8.0  # of all arms, but for those that stay at 10 m
KNOWING: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "adaptive, 8 m, way known": ("adaptive", {"radius_m": NEAREST_M}),
    "adaptive, 8 m, 10 deg, way known": ("adaptive", {"radius_m": NEAREST_M, "tilt_deg": 10.0}),
    "covariance, fine, way known": ("covariance", {**FINE, "ranges_m": (8.0, 9.0, 10.0, 11.0, 12.0)}),
    "greedy, way known": ("greedy", {}),
    "joint, from 8 m, way known": ("joint", {"radius_m": NEAREST_M}),
}
"""Arms that know the whole way: yaw alone, and yaw, tilt, range and spacing together."""
DRAWN_M = 0.01  # noise of the log with `--draws`, standard deviation per axis
OTHER_DRAWS = ("adaptive, log 1 cm off", "adaptive, 8 m, log 1 cm off")
"""Arms that take other draws with `--draws`, so that their difference to `adaptive` is chance."""
PAIRS = (*COMPARED, *COMPARED.values())
"""Arms of `--joint`."""
NOISE = White(position_m=0.02, rotation_deg=0.2)
TRIALS = 32
WORSE = 1.01  # ratio of errors above which an arm counts as worse in a world
EVERY = 2  # tracking steps from picture to picture
_FEWEST_SECONDS = 5  # of a flight with any spread, for a correlation


@dataclass(frozen=True)
class Flight:
    """One arm in one world: predicted and measured errors in mm."""

    seed: int
    arm: str
    drones: int
    predicted: Float  # [S] of each second, NaN where nothing was determined
    measured: Float  # [S] mean over trials and joints
    hidden: float
    right: float  # share of all joint-frames within 150 mm
    range_m: float
    draws: int = 0  # as asked for with `--draws`
    compared: tuple[tuple[float, float, float], ...] = ()
    """Draw by draw: MPJPE, mm, that of the arm in `COMPARED`, ratio of both factors to equal range."""


def arms_of(*, bound: bool, pairs: bool) -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Choose arms: with `bound` those that know the whole way, too; with `pairs` those of `PAIRS` alone."""
    every = {**ARMS, **KNOWING} if bound else ARMS
    return {name: arm for name, arm in every.items() if not pairs or name in PAIRS}


def fly(seed: int, arms: Mapping[str, tuple[str, Mapping[str, Any]]], draws: int = 0) -> list[Flight]:
    """Fly arms through one world and measure; with draws of the log's noise, the mean over these flights."""
    world = world_of(seed)
    field = world.field()
    walking = walk(1.0, 2.0, seed=0)
    names, posture = walking.person.joints, walking.joints[0] - walking.motion.root[0]
    errors = replace(
        error_model(DetectorErrors(), names),
        position_sigma_m=NOISE.position_m,
        rotation_sigma_deg=NOISE.rotation_deg,
    )
    found: dict[str, list[Flight]] = {arm: [] for arm in arms}
    measurements: dict[str, list[tuple[Float32, Float]]] = {arm: [] for arm in arms}
    for arm, (name, changes), draw in _draws(arms, draws):
        noise = {"actor_noise_m": DRAWN_M} if draws else {}
        config = replace(PlannerConfig(), errors=errors, **{**changes, **noise})
        done = replay(
            PLANNER_ARMS.get(name),
            world.actor_t_ns,
            world.actor,
            [field],
            Start(world.drones, world.yaw_rad),
            config=config,
            seed=draw,
            foresight=arm in KNOWING,
        )
        rows = slice(None, None, EVERY)
        joints = done.actor[rows, None] + posture
        lens = Lens().intrinsics()
        measured = measure(
            CameraPaths(
                t_ns=done.t_ns[rows],
                position=done.position[:, rows],
                quaternion_xyzw=done.quaternion_xyzw[:, rows],
                known=np.ones((world.drones, len(joints)), dtype=np.bool_),
                intrinsics=[lens] * world.drones,
                noise=[[NOISE]] * world.drones,
                joints=joints,
                middle=done.actor[rows],
            ),
            field,
            partial(detect_by_model, joints=names, errors=DetectorErrors()),
            start_m=config.sight_start_m,
            trials=TRIALS,
            seed=seed,
        )
        place, actor = done.position[:, rows], done.actor[rows]
        predicted = predicted_errors(place, actor, field, config)
        away = float(np.linalg.norm(done.position - done.actor, axis=-1).mean())
        placed = actor + (place - actor) * (config.radius_m / away)
        seen = seen_actor(place, actor, field, config)
        asked = errors_of_views(placed, actor[None], seen[None], config)[0]
        finite = np.isfinite(predicted + asked)
        figures = score(done.t_s, done.position, done.actor, field, config)
        second = done.t_s[rows].astype(int)
        to_range = np.full(len(predicted), np.nan)
        to_range[finite] = np.log(asked[finite] / predicted[finite])
        measurements[arm].append((measured.error_m, to_range))
        found[arm].append(
            Flight(
                seed,
                arm,
                world.drones,
                _by_second(np.where(finite, predicted, np.nan), second),
                _by_second(
                    np.moveaxis(measured.error_m, 1, 0).reshape(len(second), -1).astype(np.float64), second
                ),
                float(str(figures["occluded_share"])),
                float(pck(measured.error_m, measured.joint_frames).mean()),
                away,
                draws,
            )
        )
    return [
        replace(
            _mean(own), compared=_compared(measurements[arm], measurements.get(COMPARED.get(arm, ""), []))
        )
        for arm, own in found.items()
    ]


def _compared(
    own: Sequence[tuple[Float32, Float]], other: Sequence[tuple[Float32, Float]]
) -> tuple[tuple[float, float, float], ...]:
    """Compare two arms on common joint-frames, draw by draw: `Flight.compared`; empty without another arm.

    Args:
        own: by draw, errors [trials, T, J] m and the logarithm [T] of the factor to the range asked for.
        other: the same of the other arm.
    """
    compared = []
    for (mine, mine_to_range), (theirs, their_to_range) in zip(own, other, strict=bool(other)):
        shared = common_frames({"own": mine, "other": theirs})
        one, base = (float(mpjpe_mm(each, shared).mean()) for each in (mine, theirs))
        factor = (mine_to_range - their_to_range)[shared.any(axis=(0, 2))]
        compared.append((one, base, float(np.exp(np.nanmean(factor)))))
    return tuple(compared)


def _draws(
    arms: Mapping[str, tuple[str, Mapping[str, Any]]], draws: int
) -> Iterator[tuple[str, tuple[str, Mapping[str, Any]], int]]:
    """Yield the flights of each arm with the seeds of their noise; who knows the way flies once."""
    for name, arm in arms.items():
        first = draws if name in OTHER_DRAWS else 0
        for draw in range(1 if name in KNOWING else max(draws, 1)):
            yield name, arm, first + draw


def _mean(flights: Sequence[Flight]) -> Flight:
    """Average the flights of an arm through one world."""
    predicted, measured = (
        np.array([getattr(flight, key) for flight in flights]) for key in ("predicted", "measured")
    )
    return replace(
        flights[0],
        predicted=_mean_of_known(predicted),
        measured=_mean_of_known(measured),
        hidden=float(np.mean([flight.hidden for flight in flights])),
        right=float(np.mean([flight.right for flight in flights])),
        range_m=float(np.mean([flight.range_m for flight in flights])),
    )


def _mean_of_known(values: Float) -> Float:
    """Average finite values [D, S] over draws; NaN where there are none."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.asarray(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))


def _by_second(values: Float, second: Float) -> Float:
    """Average finite values [T] or [T, K] of each second, in mm; NaN where there are none."""
    found = []
    for each in np.unique(second):
        own = values[second == each]
        own = own[np.isfinite(own)]
        found.append(1e3 * float(own.mean()) if own.size else np.nan)
    return np.array(found)


def correlation(one: Float, other: Float) -> float:
    """Compute Pearson's correlation of finite pairs; NaN with too few of them or without any spread."""
    both = np.isfinite(one) & np.isfinite(other)
    if both.sum() < _FEWEST_SECONDS or not one[both].std() or not other[both].std():
        return float("nan")
    return float(np.corrcoef(one[both], other[both])[0, 1])


def main() -> None:
    """Fly, and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first world (default 1000)")
    parser.add_argument("--count", type=int, default=20, help="worlds (default 20)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--bound", action="store_true", help="compare with flights that know the whole way")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="store flights here, and go on from there")
    parser.add_argument("--joint", action="store_true", help="`joint` and `adaptive` alone")
    parser.add_argument("--draws", type=int, default=0, metavar="N", help="means of N flights with noise")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.count)
    arms = arms_of(bound=arguments.bound, pairs=arguments.joint)
    flights = list(_flown(seeds, arms, arguments.workers, arguments.keep, arguments.draws))
    _print_arms(flights)
    if arguments.bound:
        _print_bound(flights)
    if arguments.bound or arguments.joint or arguments.draws:
        _print_compared(flights)
    if arguments.bound:
        flights = [flight for flight in flights if flight.arm not in KNOWING]
    _print_correlations(flights)


def _flown(
    seeds: Sequence[int],
    arms: Mapping[str, tuple[str, Mapping[str, Any]]],
    workers: int,
    keep: Path | None,
    draws: int,
) -> Iterator[Flight]:
    """Yield the flights through some worlds: those kept, then those flown now, which are kept as well."""
    try:
        kept = [_read(line) for line in keep.read_text().splitlines()] if keep and keep.exists() else []
    except (KeyError, TypeError) as error:
        raise SystemExit(f"{keep}: flights of another version of this command, delete it") from error
    kept = [flight for flight in kept if flight.draws == draws]
    done = {seed for seed in seeds if set(arms) <= {flight.arm for flight in kept if flight.seed == seed}}
    yield from (flight for flight in kept if flight.seed in done and flight.arm in arms)
    with ProcessPoolExecutor(workers) as pool:
        left = [seed for seed in seeds if seed not in done]
        for flights in pool.map(partial(fly, arms=arms, draws=draws), left):
            yield from flights
            if keep:
                with keep.open("a") as file:
                    file.writelines(f"{_line(flight)}\n" for flight in flights)


def _line(flight: Flight) -> str:
    values = {**asdict(flight), "predicted": flight.predicted.tolist(), "measured": flight.measured.tolist()}
    return json.dumps(values)


def _read(line: str) -> Flight:
    values = json.loads(line)
    return Flight(
        **{
            **values,
            "predicted": np.array(values["predicted"], dtype=np.float64),
            "measured": np.array(values["measured"], dtype=np.float64),
            "compared": tuple(tuple(pair) for pair in values["compared"]),
        }
    )


def _print_arms(flights: Iterable[Flight]) -> None:
    rows = []
    for arm in (*ARMS, *KNOWING):
        own = [flight for flight in flights if flight.arm == arm]
        if not own:
            continue
        rows.append(
            [
                arm,
                f"{np.mean([flight.range_m for flight in own]):.1f}",
                f"{np.mean([np.nanmean(flight.measured) for flight in own]):.1f}",
                f"{np.mean([np.nanmean(flight.predicted) for flight in own]):.1f}",
                f"{100 * np.mean([flight.hidden for flight in own]):.2f}",
                f"{100 * np.mean([flight.right for flight in own]):.2f}",
            ]
        )
    header = ["arm", "range m", "measured mm", "predicted mm", "hidden %", "PCK150 %"]
    print("\n".join(markdown_table(header, rows)))


def _print_bound(flights: Sequence[Flight]) -> None:
    """Print each arm's error over the least of those that know the way, world by world, and what it hides."""
    rows = []
    for arm in dict.fromkeys(flight.arm for flight in flights if flight.arm in ARMS):
        ratios, hidden = [], []
        for flight in flights:
            if flight.arm == arm:
                knowing = [one for one in flights if one.seed == flight.seed and one.arm in KNOWING]
                least = min(knowing, key=lambda one: float(np.nanmean(one.measured)))
                ratios.append(np.nanmean(flight.measured) / np.nanmean(least.measured))
                hidden.append(flight.hidden - least.hidden)
        rows.append([arm, f"{np.mean(ratios):.3f}", f"{np.max(ratios):.3f}", f"{100 * np.mean(hidden):+.2f}"])
    header = ["arm", "error over the bound's, mean", "largest", "hidden, points of % more"]
    print("\n".join(markdown_table(header, rows)))


def _print_compared(flights: Sequence[Flight]) -> None:
    """Print arms over `adaptive`, world by world: error, hidden time, the worst world."""
    rows, scaled, worlds = [], [], []
    for arm, other in COMPARED.items():
        own, base = ({f.seed: f for f in flights if f.arm == name} for name in (arm, other))
        if not own:
            continue
        flown = [np.array(flight.compared).T for flight in own.values()]
        pairs = [(mine, others) for mine, others, _ in flown]
        ratios = np.array([mine.mean() / others.mean() for mine, others in pairs])
        hidden = 100 * np.mean([own[k].hidden - base[k].hidden for k in own])
        right = 100 * np.mean([own[k].right - base[k].right for k in own])
        worse = int((ratios > WORSE).sum())
        leveled = [(mine * to_range, others) for mine, others, to_range in flown]
        level = np.array([mine.mean() / others.mean() for mine, others in leveled])
        noise = np.array([_noise(*pair) for pair in leveled])
        beyond = sum(_is_worse_beyond_noise(*pair) for pair in leveled)
        chance = [stats.norm.sf((WORSE - mean) / noise).sum() for mean in (1.0, level.mean())]
        by_noise = [f"{beyond}", *(f"{number:.1f}" for number in chance)]
        if not np.isfinite(noise).all():
            by_noise = ["-"] * len(by_noise)
        scaled.append(
            [
                arm,
                f"{level.mean():.3f}",
                f"{level.max():.3f}",
                f"{(level > WORSE).sum()} of {len(level)}",
                *by_noise,
            ]
        )
        worlds += [
            f"{arm}, world {k}: error {ratio:.3f}, flown range {own[k].range_m - base[k].range_m:+.2f} m, "
            f"at equal range {same:.3f}, PCK150 {100 * (own[k].right - base[k].right):+.2f} points"
            for k, ratio, same in zip(own, ratios, level, strict=True)
            if max(ratio, same) > WORSE
        ]
        beyond = sum(_is_worse_beyond_noise(*pair) for pair in pairs)
        single = np.concatenate([mine / others > WORSE for mine, others in pairs])
        rows.append(
            [
                arm,
                other,
                f"{ratios.mean():.3f}",
                f"{ratios.max():.3f}",
                f"{worse} of {len(ratios)}",
                str(beyond) if all(mine.size > 1 for mine, _ in pairs) else "-",
                f"{single.sum()} of {single.size}",
                f"{hidden:+.2f}",
                f"{right:+.2f}",
            ]
        )
    header = ["arm", "over", "MPJPE on common joint-frames, mean", "largest", "worse by 1 %", "beyond noise"]
    header += ["single flights", "hidden, points", "PCK150, points"]
    print("\n".join(markdown_table(header, rows)))
    header = ["arm", "the same at equal flown range, mean", "largest", "worse by 1 %"]
    header += ["beyond noise", "by chance, of an equal arm", "of one with this mean in every world"]
    print("\n".join([*markdown_table(header, scaled), "Worse by 1 %:", *worlds]))


def _noise(own: Float, base: Float) -> float:
    """Compute the standard error over draws of own errors over base ones; NaN for fewer than two draws."""
    if len(own) < 2:
        return float("nan")
    return float(np.hypot(stats.sem(own), stats.sem(base)) / np.mean(base))


def _is_worse_beyond_noise(own: Float, base: Float) -> bool:
    """Test if the 95 % interval over draws of own errors over base ones lies above `WORSE`."""
    if len(own) < 2:
        return False
    excess = own - WORSE * base
    half = stats.t.ppf(0.975, len(excess) - 1) * stats.sem(excess)
    return bool(excess.mean() - half > 0)


def _print_correlations(flights: Iterable[Flight]) -> None:
    flights = list(flights)
    means = np.array([[np.nanmean(each.predicted), np.nanmean(each.measured)] for each in flights])
    print(f"over {len(flights)} flights: {correlation(*means.T):.3f}")
    for drones in sorted({each.drones for each in flights}):
        own = np.array([each.drones == drones for each in flights])
        print(f"over {own.sum()} flights with {drones} drones: {correlation(*means[own].T):.3f}")
    within = np.array([correlation(each.predicted, each.measured) for each in flights])
    within = within[np.isfinite(within)]
    tenth, median = np.percentile(within, [10, 50])
    print(f"within {len(within)} flights: mean {within.mean():.2f}, median {median:.2f}, tenth {tenth:.2f}")


if __name__ == "__main__":
    main()
