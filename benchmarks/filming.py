"""Filming groups: view quality against the published figures of five planners, and a plan of our own.

    MOCAP_REAL_DATA=FOLDER python -m benchmarks.filming
    python -m benchmarks.filming --flights [--seeds 10 11 12 13 14 15]

The first: the scenes are those of Hughes et al. 2024 (`hughes_filming` in the folder of real data): four
robots at one height on a grid of 1 m, eight headings, 4 to 6 people who move. Their planners' solutions are
scored with `pipelines.planning.scores.view_quality`, frame by frame. Then every scene is planned here from
the same starts by the planner of the arm `group` (`pipelines.planning.groups.plan_in_turn`), under the same
limits: whole cells, two of them a step in x and in y at most, turns of 45 degrees at most. Only the view
quality counts.

The solutions are no logs of a flight: robots jump from cell to cell and turn by 45 degrees between frames
that have no times, and people have headings, which no log holds. So they are scored here and not as the arm
`flown` of a session.

The second compares planner arms by `mocap replan-compare` in modelled flights: four drones, people who stand
together, walk apart, come back and stand together, without obstacles. `first` is `adaptive` with the weight
of all others 0. Seed 0 was looked at while `group` was made.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.people import scenario_of, walker
from pipelines.formats.common.files import read_yaml
from pipelines.geometry.arrays import Float
from pipelines.ingest import ingest
from pipelines.planning.groups import Choice, Worth, plan_in_turn
from pipelines.planning.scene import Settings
from pipelines.planning.scores import coverage, view_quality
from pipelines.planning.search import Lattice
from pipelines.replan import replan
from pipelines.simulate import simulate

SCENES = ("cluster", "cross_mix", "four_split")
PLANNERS = ("formation", "greedy", "assignment", "myopic", "multipleroundsgreedy")
HEADINGS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")
VIEW_RAD = np.pi / 2
"""Field of view with which robots are planned for."""
SCORED_RAD = {"cluster": 2.0 * np.pi, "cross_mix": VIEW_RAD, "four_split": VIEW_RAD}
"""Field of view of the published figures. Those of `cluster` were made without one."""
HEIGHT_M = 5.0
STEP_CELLS, STEP_TURNS = 2, 1


@dataclass(frozen=True)
class Scene:
    """People over time, and the size of the grid."""

    people: Float  # [T, A, 3] m, on the ground
    heading_rad: Float  # [T, A]
    weight: Float  # [T, A]
    cells: tuple[int, int]
    fov_rad: float


def folder() -> Path | None:
    """Return the folder of the scenes, None without it."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    scenes = Path(os.environ.get("MOCAP_REAL_DATA", beside)) / "hughes_filming"
    return scenes if scenes.is_dir() else None


def scene_of(scenes: Path, name: str) -> Scene:
    """Read a scene."""
    document = json.loads((scenes / name / f"{name}_data.json").read_text(encoding="utf-8"))
    actors: list[list[dict[str, Any]]] = document["actor_positions"]
    rows = np.array(
        [[[*each["location"][:2], each["rotation"][2], each["weight"]] for each in row] for row in actors]
    )
    scale = document["scene"]["scale"]
    people = np.concatenate([rows[..., :2], np.zeros_like(rows[..., :1])], axis=-1)
    cells = int(scale["x"]), int(scale["y"])
    return Scene(people, rows[..., 2], rows[..., 3], cells, SCORED_RAD[name])


def solution_of(scenes: Path, name: str, planner: str) -> Float:
    """Read a planner's solution: x, y (m) and the number of the heading, [N, T, 3]."""
    document = json.loads((scenes / name / planner / "solution.json").read_text(encoding="utf-8"))
    states = [[each["state"] for each in path] for _, path in document["elements"]]
    return np.array(
        [[[s["x"], s["y"], HEADINGS.index(s["heading"])] for s in path] for path in states], dtype=np.float64
    )


def published_of(scenes: Path, name: str) -> dict[str, Float]:
    """Read the published view quality [T] by planner."""
    with (scenes / name / "ppa_evaluation.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {planner: np.array([float(row[planner]) for row in rows]) for planner in PLANNERS}


def covered(scene: Scene, states: Float, k: int) -> Float:
    """Compute what cameras in states [..., 3] cover at step k, [..., A, 7]."""
    position = np.concatenate([states[..., :2], np.full((*states.shape[:-1], 1), HEIGHT_M)], axis=-1)
    looks = states[..., 2] * np.pi / 4
    return coverage(position, looks, scene.people[k], scene.heading_rad[k], fov_rad=scene.fov_rad)


def quality(scene: Scene, paths: Float) -> Float:
    """Compute the view quality [T] of paths [N, T, 3]."""
    steps = range(len(scene.people))
    return np.array(
        [view_quality(covered(scene, paths[:, k], k).sum(axis=0), scene.weight[k]) for k in steps]
    )


def planned(scene: Scene, starts: Float) -> Float:
    """Plan paths [N, T, 3] from starts [N, 3] on the grid."""
    grid = grid_of(scene.cells)
    yaw, x, y = grid.states.T
    cells = np.stack([x, y, yaw / (np.pi / 4)], axis=-1)
    steps = len(scene.people) - 1
    seen = np.stack([covered(scene, cells, k + 1) for k in range(steps)])
    slots = Choice(grid, grid.states[0], np.zeros((steps, len(cells))), cells[None], seen)
    choices = [
        [slots._replace(start=np.array([heading * np.pi / 4, east, north]))]
        for east, north, heading in starts
    ]
    paths = plan_in_turn(choices, Worth(scene.weight[0], 1.0))
    return np.stack([np.vstack([start, cells[path]]) for start, (_, path) in zip(starts, paths, strict=True)])


def grid_of(cells: tuple[int, int]) -> Lattice:
    """Connect all cells and headings (states: yaw, x, y) by the steps and turns of the published planners."""
    x, y, heading = np.meshgrid(*(np.arange(n) for n in (*cells, len(HEADINGS))), indexing="ij")
    near = [
        (i, j, turn)
        for i in range(-STEP_CELLS, STEP_CELLS + 1)
        for j in range(-STEP_CELLS, STEP_CELLS + 1)
        for turn in range(-STEP_TURNS, STEP_TURNS + 1)
    ]
    near.sort(key=lambda step: sum(map(abs, step)))
    neighbours = np.empty((x.size, len(near)), dtype=np.int64)
    for k, (i, j, turn) in enumerate(near):
        east, north = x + i, y + j
        number = (east * cells[1] + north) * len(HEADINGS) + (heading + turn) % len(HEADINGS)
        inside = (east >= 0) & (east < cells[0]) & (north >= 0) & (north < cells[1])
        neighbours[:, k] = np.where(inside, number, -1).ravel()
    states = np.stack([heading * np.pi / 4, x + 1, y + 1], axis=-1).reshape(-1, 3).astype(np.float64)
    rates = np.array([STEP_TURNS * np.pi / 4, STEP_CELLS, STEP_CELLS])
    return Lattice(states, rates, 1.0, 0.0, neighbours, np.zeros(neighbours.shape))


WALK: dict[str, Any] = {"walk": {"distance_m": 9, "speed_mps": 1.2}}


def splitting(number: int) -> dict[str, dict[str, Any]]:
    """Return people of a scenario who stand together, walk apart, turn, come back and stand together."""
    people = {}
    for k in range(number):
        heading_deg = 360.0 / number * k
        east, north = (float(part(np.radians(heading_deg))) for part in (np.cos, np.sin))
        together, back = {"stand": {"seconds": 3}}, {"turn": {"deg": 180}}
        people[f"walker{k}"] = walker(east, north, heading_deg, together, WALK, back, WALK, together)
    return people


def compared(people: dict[str, dict[str, Any]], seed: int, arms: tuple[str, ...], alone: bool) -> Any:
    """Simulate a flight and compare arms on it; return metrics.json. `alone`: others have no weight."""
    plan = scenario_of(people, seed)
    plan["duration_s"] = 24
    plan["drones"] |= {"count": 4, "camera": {"rate_hz": 5}}
    with tempfile.TemporaryDirectory(prefix="filming-") as folder:
        scenario, manifest = Path(folder) / "scenario.yaml", Path(folder) / "flight" / "flight.yaml"
        scenario.write_text(json.dumps(plan), encoding="utf-8")
        simulate(scenario, manifest.parent, video=False)
        stated: Any = read_yaml(manifest)
        for k, actor in enumerate(stated["actors"].values()):
            actor["weight"] = 0.0 if alone and k else 1.0
        manifest.write_text(json.dumps(stated), encoding="utf-8")
        session = ingest(manifest, Path(folder) / "flight.session").folder
        return replan(session, Settings(arms=arms, trials=4)).metrics


def print_flights(seeds: list[int]) -> None:
    """Print the means over flights of each arm, over all people and for each."""
    print("| people | arm | within 150 mm | of each | measured | view quality | blind, s | limits violated |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for number in (2, 3):
        people = splitting(number)
        for name, arms, alone in (
            ("", ("group", "adaptive", "joint"), False),
            ("first", ("adaptive",), True),
        ):
            found = [compared(people, seed, arms, alone)["arms"] for seed in seeds]
            for arm in arms:
                rows = [row[arm] for row in found]
                errors = [row["reconstruction_error"] for row in rows]
                by_person = [list(row["by_person"].values()) for row in rows]
                each = np.mean([[one["pck150"]["mean"] for one in row] for row in by_person], axis=0)
                quality = np.mean([[one["view_quality"] for one in row] for row in by_person])
                right, measured = (
                    100 * np.mean([error[key]["mean"] for error in errors]) for key in ("pck150", "coverage")
                )
                print(
                    f"| {number} | {name or arm} | {right:.1f} %"
                    f" | {' '.join(f'{100 * share:.0f}' for share in each)} % | {measured:.1f} %"
                    f" | {quality:.3f} | {np.mean([row['blind_s'] for row in rows]):.1f}"
                    f" | {sum(sum(row['limit_violations'].values()) for row in rows)} |",
                    flush=True,
                )


def main() -> None:
    """Print the totals, the largest difference of a frame, and the plan's totals; or the flights."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", action="store_true", help="modelled flights")
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12, 13, 14, 15])
    arguments = parser.parse_args()
    if arguments.flights:
        print_flights(arguments.seeds)
        return
    scenes = folder()
    if scenes is None:
        raise SystemExit("MOCAP_REAL_DATA names no folder with hughes_filming")
    print("| scene | planner | published | here | frames within 2 % | largest difference of the others |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in SCENES:
        scene, published = scene_of(scenes, name), published_of(scenes, name)
        for planner in PLANNERS:
            ours = quality(scene, solution_of(scenes, name, planner))
            off = np.abs(ours / published[planner] - 1.0)
            far = off > 0.02
            said = ", ".join(f"frame {k + 1}: {off[k]:.0%}" for k in np.flatnonzero(far)) or "-"
            print(
                f"| {name} | {planner} | {published[planner].sum():.2f} | {ours.sum():.2f} |"
                f" {(~far).sum()} of {len(off)} | {said} |"
            )
        starts = solution_of(scenes, name, "greedy")[:, 0]
        total = quality(scene, planned(replace(scene, fov_rad=VIEW_RAD), starts)).sum()
        print(f"| {name} | planned here | | {total:.2f} | | |", flush=True)


if __name__ == "__main__":
    main()
