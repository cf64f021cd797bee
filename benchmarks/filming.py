"""Filming groups: view quality against the published figures of five planners, and a plan of our own.

    MOCAP_REAL_DATA=FOLDER python -m benchmarks.filming

The scenes are those of Hughes et al. 2024 (`hughes_filming` in the folder of real data): four robots at one
height on a grid of 1 m, eight headings, 4 to 6 people who move. Their planners' solutions are scored with
`pipelines.planning.scores.view_quality`, frame by frame. Then every scene is planned here from the same
starts under the same limits: whole cells, two of them a step in x and in y at most, turns of 45 degrees at
most. One robot after the other takes the best path there is, given those before (dynamic programming over
all cells and headings), in rounds until no robot finds a better one.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter

from pipelines.geometry.arrays import Float, Int64
from pipelines.planning.scores import coverage, view_quality

SCENES = ("cluster", "cross_mix", "four_split")
PLANNERS = ("formation", "greedy", "assignment", "myopic", "multipleroundsgreedy")
HEADINGS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")
FOV_RAD = np.pi / 2  # of the published evaluation, whatever the robots'
HEIGHT_M = 5.0
STEP_CELLS, STEP_TURNS = 2, 1
_ROUNDS = 10
_FIRST: Int64 = np.array([1, 1, 0])  # the first cell and heading


@dataclass(frozen=True)
class Scene:
    """People over time, and the size of the grid."""

    people: Float  # [T, A, 3] m, on the ground
    heading_rad: Float  # [T, A]
    weight: Float  # [T, A]
    cells: tuple[int, int]


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
    return Scene(people, rows[..., 2], rows[..., 3], (int(scale["x"]), int(scale["y"])))


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
    return coverage(position, looks, scene.people[k], scene.heading_rad[k], fov_rad=FOV_RAD)


def quality(scene: Scene, paths: Float) -> Float:
    """Compute the view quality [T] of paths [N, T, 3]."""
    steps = range(len(scene.people))
    return np.array(
        [view_quality(covered(scene, paths[:, k], k).sum(axis=0), scene.weight[k]) for k in steps]
    )


def planned(scene: Scene, starts: Float) -> Float:
    """Plan paths [N, T, 3] from starts [N, 3]: one robot after the other, then again while it gets better."""
    paths: dict[int, Float] = {}
    best = -np.inf
    for _ in range(_ROUNDS):
        for i, start in enumerate(starts):
            paths[i] = _path(scene, start, [path for j, path in paths.items() if j != i])
        total = quality(scene, np.array([paths[i] for i in range(len(starts))])).sum()
        if total <= best + 1e-9:
            break
        best = total
    return np.array([paths[i] for i in range(len(starts))])


def _path(scene: Scene, start: Float, others: list[Float]) -> Float:
    """Return the path [T, 3] from a start that adds most to the others' view quality."""
    x, y = (np.arange(1, n + 1) for n in scene.cells)
    states = np.stack(np.meshgrid(x, y, np.arange(len(HEADINGS)), indexing="ij"), axis=-1).astype(np.float64)
    steps = len(scene.people)
    gain = np.empty((steps, *states.shape[:-1]))
    for k in range(steps):
        before = sum((covered(scene, path[k], k) for path in others), np.zeros((scene.people.shape[1], 7)))
        gain[k] = view_quality(before + covered(scene, states, k), scene.weight[k])
    reach = (2 * STEP_CELLS + 1, 2 * STEP_CELLS + 1, 2 * STEP_TURNS + 1)
    for k in range(steps - 2, -1, -1):
        gain[k] += maximum_filter(gain[k + 1], size=reach, mode=("nearest", "nearest", "wrap"))
    at: Int64 = np.rint(start).astype(np.int64) - _FIRST
    path = [at]
    for k in range(1, steps):
        low = np.maximum(at[:2] - STEP_CELLS, 0)
        high = np.minimum(at[:2] + STEP_CELLS + 1, scene.cells)
        turns = (at[2] + np.arange(-STEP_TURNS, STEP_TURNS + 1)) % len(HEADINGS)
        near = gain[k, low[0] : high[0], low[1] : high[1]][..., turns]
        i, j, turn = np.unravel_index(int(near.argmax()), near.shape)
        at = np.array([low[0] + i, low[1] + j, turns[turn]], dtype=np.int64)
        path.append(at)
    found: Float = (np.array(path) + _FIRST).astype(np.float64)
    return found


def main() -> None:
    """Print the totals, the largest difference of a frame, and the plan's totals."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
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
        total = quality(scene, planned(scene, starts)).sum()
        print(f"| {name} | planned here | | {total:.2f} | | |", flush=True)


if __name__ == "__main__":
    main()
