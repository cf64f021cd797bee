"""Planner arms past a mound, a wall and trees.

    python -m benchmarks.arms [--weights | --seeds N | --ahead | --teams]

Each scenario of sample_data/planning is simulated without video, ingested, and flown again by the fixed and
the adaptive formation with the weights of its planner.yaml, as `mocap replan-compare` does. All simulated.
`--weights` flies them with other weights and resolutions too, and prints the figures of each.
`--seeds` flies them, and the sample flight, many times with different noise of the actor's log, detector and
poses, and pairs the arms seed by seed. `--ahead` starts the sample flight where the adaptive formation must
turn past the actor's face, with its forecast and with the actor's way known, and flies `joint` from there.
`--teams` flies 2 to 5 drones past the mound by `adaptive` and by `joint`.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.results_page import ARM_COLUMNS, arm_figures, markdown_table
from pipelines.ingest import ingest
from pipelines.planning.arm_flights import fly_arm
from pipelines.planning.arms import PLANNER_ARMS
from pipelines.planning.comparison import mean_of_trials
from pipelines.planning.config import PlannerConfig
from pipelines.planning.loading import load_flight
from pipelines.planning.scene import Scene, Settings, build_scene
from pipelines.planning.scores import score
from pipelines.replan import planner_settings, replan
from pipelines.session.description import read_description
from pipelines.session.maps import load_maps
from pipelines.simulate import simulate

SCENARIOS = Path(__file__).parents[1] / "sample_data" / "planning"
NAMES = ("mound", "wall", "trees")
ARMS = ("adaptive", "fixed")
ACTOR_NOISE_M = 0.2
"""Standard deviation of the actor's log per axis and measurement, as given to the planners."""

AHEAD_DEG = (-20.0, -15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0, 20.0)
"""Yaws of the first camera at the start from which the sample's formation turns past the actor's face."""
TEAMS = (2, 3, 4, 5)
VARIANTS: tuple[Mapping[str, float], ...] = (
    {},
    {"yaws": 8, "knot_s": 2, "horizon_knots": 5},
    {"yaws": 16},
    {"l_form": 1},
    {"l_occ": 2},
    {"l_form": 1, "l_occ": 2, "yaws": 8, "knot_s": 2, "horizon_knots": 5},
)
"""Changes to the defaults; the last were the settings before the defaults were measured here."""


def main() -> None:
    """Print the tables of docs/measurements-planner.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20, help="draws of noise (default 20)")
    parser.add_argument("--weights", action="store_true", help="other weights instead (minutes)")
    parser.add_argument("--seeds", type=int, help="flights with noise of their own instead (minutes)")
    parser.add_argument("--ahead", action="store_true", help="starts ahead of the actor instead")
    parser.add_argument("--teams", action="store_true", help="2 to 5 drones past the mound instead")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        if arguments.ahead:
            _print_ahead(_sample(Path(temporary)))
            return
        if arguments.teams:
            _print_teams(_scene(_session("mound", Path(temporary))))
            return
        sessions = {name: _session(name, Path(temporary)) for name in NAMES}
        if arguments.seeds:
            _print_seeds({"sample": _sample(Path(temporary)), **sessions}, arguments.seeds)
        elif arguments.weights:
            _print_weights({name: _scene(session) for name, session in sessions.items()})
        else:
            _print_comparisons(sessions, arguments.trials)


def _session(name: str, folder: Path) -> Path:
    session = folder / f"{name}.session"
    simulate(SCENARIOS / f"{name}.yaml", folder / name, video=False)
    ingest(folder / name / "flight.yaml", session=session)
    return session


def _sample(folder: Path) -> Path:
    session = folder / "sample.session"
    ingest(SCENARIOS.parent / "mound_walk" / "flight.yaml", session=session)
    return session


def _print_ahead(session: Path) -> None:
    """Print tilt and hidden time by the yaw of the start, of `adaptive` with forecast and foresight, `joint`.

    `joint` flies once at the range of `adaptive`, and once at ranges of its own.
    """
    scene = _scene(session)
    same_range = _with_ranges(scene, scene.config.radius_m)
    rows = []
    for yaw_deg in AHEAD_DEG:
        yaw_rad = float(np.radians(yaw_deg))
        started, same = (replace(each, yaw_rad=yaw_rad) for each in (scene, same_range))
        rows.append(
            [
                f"{yaw_deg:g}",
                *(_figures(started, "adaptive", foresight=known) for known in (False, True)),
                _figures(same, "joint"),
                _figures(started, "joint"),
            ]
        )
    header = ["--yaw", "adaptive", "adaptive, way known", "joint, 10 m", "joint, 8 to 12 m"]
    print("\n".join(markdown_table(header, rows)))


def _print_teams(scene: Scene) -> None:
    """Print tilt and hidden time past the mound by the number of drones, at equal range."""
    rows = []
    for drones in TEAMS:
        team = replace(_with_ranges(scene, scene.config.radius_m), drones=drones)
        rows.append([str(drones), _figures(team, "adaptive"), _figures(team, "joint")])
    print("\n".join(markdown_table(["drones", "adaptive", "joint, 10 m"], rows)))


def _with_ranges(scene: Scene, *ranges_m: float) -> Scene:
    planner = replace(scene.config, ranges_m=ranges_m)
    return replace(scene, settings=replace(scene.settings, planner=planner))


def _print_comparisons(sessions: Mapping[str, Path], trials: int) -> None:
    settings = Settings(arms=ARMS, trials=trials, planner=planner_settings(SCENARIOS / "planner.yaml", {}))
    found = {name: replan(session, settings).metrics for name, session in sessions.items()}
    scores = {(name, arm): metrics["arms"][arm] for name, metrics in found.items() for arm in ARMS}
    rows = [[*of, *arm_figures(figures, f"{figures['mpjpe_mm']:.1f}")] for of, figures in scores.items()]
    print("\n".join(markdown_table(["scenario", "arm", *ARM_COLUMNS], rows)))
    rows = []
    for name, metrics in found.items():
        (difference,) = metrics["differences"]
        rows.append(
            [
                name,
                _with_interval(difference["tilt_deg"], 1),
                _with_interval(difference["tilt_near_obstacle_deg"], 1),
                _with_interval(difference["occluded_share"], 100),
                _with_interval(difference["mpjpe_mm"], 1),
            ]
        )
    header = ["adaptive minus fixed", "tilt deg", "near obstacle", "hidden, points of %", "MPJPE mm"]
    print("\n".join(markdown_table(header, rows)[:-1]))


def _print_seeds(sessions: Mapping[str, Path], seeds: int) -> None:
    """Print differences of whole flights, and the largest tilt of any."""
    columns = ("adaptive minus fixed", "tilt deg", "near obstacle", "hidden, points of %", "MPJPE mm")
    print("| " + " | ".join([*columns, "largest tilt deg: adaptive", "fixed"]) + " |")
    print("|" + " --- |" * 7)
    kinds = ("tilt_deg", "tilt_near_obstacle_deg", "occluded_share", "mpjpe_mm")
    for name, session in sessions.items():
        flown = [_flown(session, seed) for seed in range(seeds)]
        differences = [metrics["differences"][0] for metrics in flown]
        cells = []
        for kind in kinds:
            values = np.array([each[kind]["mean"] for each in differences if each[kind]])
            estimate = mean_of_trials(values, 0)
            scale = 100 if kind == "occluded_share" else 1
            cells.append("-" if estimate is None else _with_interval(estimate.as_json(), scale))
        largest = [f"{max(each['arms'][arm]['tilt_deg']['max'] for each in flown):.1f}" for arm in ARMS]
        print(f"| {' | '.join([name, *cells, *largest])} |", flush=True)


def _flown(session: Path, seed: int) -> dict[str, Any]:
    """Fly both arms with the noise of this seed: one draw of all errors."""
    planner = replace(PlannerConfig(), actor_noise_m=ACTOR_NOISE_M)
    settings = Settings(arms=ARMS, trials=1, seed=seed, planner=planner)
    return replan(session, settings).metrics


def _with_interval(estimate: Mapping[str, Any], scale: float) -> str:
    low, high = estimate["interval"]
    return f"{scale * estimate['mean']:+.1f} [{scale * low:+.1f}, {scale * high:+.1f}]"


def _scene(session: Path) -> Scene:
    description = read_description(session)
    flight = load_flight(session, description, None, pose_noise=None)
    return build_scene(flight, load_maps(session), description, Settings())


def _print_weights(scenes: Mapping[str, Scene]) -> None:
    print("| changed | " + " | ".join(f"{name}: {arm}" for name in scenes for arm in ARMS) + " |")
    print("|" + " --- |" * (1 + len(scenes) * len(ARMS)))
    for changed in VARIANTS:
        config = replace(PlannerConfig(), **changed)  # type: ignore[arg-type]  # ints and floats by name
        cells = [
            _figures(replace(scene, settings=replace(scene.settings, planner=config)), arm)
            for scene in scenes.values()
            for arm in ARMS
        ]
        said = ", ".join(f"{key} {value:g}" for key, value in changed.items()) or "nothing"
        print(f"| {said} | {' | '.join(cells)} |", flush=True)


def _figures(scene: Scene, arm: str, *, foresight: bool = False) -> str:
    """Format mean/max tilt (deg) and the share of the time without any view (%)."""
    flown = fly_arm(scene, PLANNER_ARMS.get(arm), foresight=foresight)
    scores = score(scene.t_s, flown.position, scene.actor, scene.maps, scene.config)
    tilt = np.degrees(
        np.arctan2(
            flown.position[..., 2] - scene.actor[:, 2],
            np.linalg.norm(flown.position[..., :2] - scene.actor[:, :2], axis=-1),
        )
    )
    return f"{tilt.mean():.1f}/{tilt.max():.1f}, {100 * float(str(scores['occluded_share'])):.1f} %"


if __name__ == "__main__":
    main()
