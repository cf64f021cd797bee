"""Times of the planners beside the 1.3 ms of Ho et al.: `python -m benchmarks.planning`.

The mound of tests/planning/worlds.py (sigma 7 x 3 m, 6 m high), an actor who walks past it at 1.2 m/s.
Times are of warm code on one core, for figures that other work on the machine disturbs: best of several.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import replace
from functools import partial

import numpy as np

from pipelines.planning.arms import ADAPTIVE, COVARIANCE, FIXED, GREEDY
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField
from pipelines.planning.formation import formation_slots
from pipelines.planning.replay import replay
from pipelines.planning.scores import score
from tests.planning.worlds import mound, trees, walker, wall

SEPARATIONS = ((3.5, 50.0), (3.5, 200.0), (4.5, 50.0), (4.5, 200.0))


def main() -> None:
    """Print the tables of docs/planner.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=200, help="central plans per figure (default 200)")
    parser.add_argument("--separation", action="store_true", help="also weigh the distances (minutes)")
    arguments = parser.parse_args()
    print_central(arguments.repeats)
    print_replays()
    if arguments.separation:
        print_separations()


def print_central(repeats: int) -> None:
    """The formation search, cost map included, by its size."""
    field = mound(resolution_m=0.2)
    print("| arm | D | T | n | median ms | best ms |")
    print("| --- | --- | --- | --- | --- | --- |")
    sizes = [(8, 5, 2), (24, 5, 2), (72, 5, 2), (72, 20, 2), (8, 5, 5), (72, 20, 5)]
    for arm, (yaws, knots, drones) in [
        *((ADAPTIVE, size) for size in sizes),
        (COVARIANCE, (8, 5, 2)),
        (GREEDY, (8, 5, 2)),
        (GREEDY, (8, 5, 3)),
    ]:
        config = replace(PlannerConfig(), yaws=yaws, horizon_knots=knots, knot_s=10.0 / knots)
        planner = arm.start(config, drones=drones, yaw_rad=0.7)
        yaw = np.array([0.7])
        commanded = formation_slots(yaw, drones, tilt_rad=config.tilt_rad, range_m=config.radius_m)[0]
        times = []
        for k in range(repeats + 1):
            walked = 40.0 * k / repeats + 1.2 * config.knot_s * np.arange(1, knots + 1)
            actor = np.stack([walked, 0 * walked, 0 * walked + 1], axis=1)
            started = time.perf_counter()
            planner.plan(0.0, commanded, actor, field)
            times.append(1e3 * (time.perf_counter() - started))
        figures = f"{np.median(times[1:]):.3f} | {min(times[1:]):.3f}"
        print(f"| {arm.name} | {yaws} | {knots} | {drones} | {figures} |")


def print_replays() -> None:
    """Closed-loop flights of 75 s with 2 drones: local planner, whole replay, and what came of it."""
    print("\n| world | arm | local mean ms | p95 ms | replay s | tilt mean deg | max | occluded |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    config = PlannerConfig()
    for field, name in ((mound(), "mound"), (mound(resolution_m=0.2), "mound, 0.2 m")):
        for arm in (FIXED, ADAPTIVE, COVARIANCE, GREEDY):
            fly = partial(replay, arm, fields=[field], config=config, drones=2, yaw_rad=np.pi / 4)
            fly(*walker(2.0))  # compiles
            started = time.perf_counter()
            result = fly(*walker(75.0))
            took = time.perf_counter() - started
            local = 1e3 * np.array(result.times.local_s)
            figures = score(result.t_s, result.position, result.actor, field, config)
            tilt = np.degrees(result.tilt_rad)
            print(
                f"| {name} | {arm.name} | {local.mean():.2f} | {np.percentile(local, 95):.2f} | {took:.2f} | "
                f"{tilt.mean():.1f} | {tilt.max():.1f} | {figures['occluded_share']:.3f} |"
            )


def print_separations() -> None:
    """How often plans had to be pushed apart, by where and how strongly they begin to avoid each other."""
    print("\n| soft m | l_sep | local plans | projected | rejected | broken | nearest m |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    worlds: list[DistanceField] = [trees(), wall(), mound()]
    for soft_m, weight in SEPARATIONS:
        config = replace(PlannerConfig(), soft_separation_m=soft_m, l_sep=weight)
        counts = dict.fromkeys(("kept", "projected", "rejected", "broken"), 0)
        nearest = np.inf
        cases = itertools.product(worlds, (ADAPTIVE, COVARIANCE, GREEDY), (2, 3, 5), (-90.0, 45.0))
        for field, arm, drones, yaw_deg in cases:
            result = replay(
                arm, *walker(25.0), [field], config=config, drones=drones, yaw_rad=np.radians(yaw_deg)
            )
            for name, count in result.separation.items():
                counts[name] += count
            for i, j in itertools.combinations(range(drones), 2):
                apart = np.linalg.norm(result.position[i] - result.position[j], axis=-1)
                nearest = min(nearest, float(apart.min()))
        figures = " | ".join(str(counts[name]) for name in ("projected", "rejected", "broken"))
        print(f"| {soft_m} | {weight:g} | {sum(counts.values())} | {figures} | {nearest:.2f} |")


if __name__ == "__main__":
    main()
