"""Several people, who is found, missed and confused: `python -m benchmarks.accuracy people`.

Three drones with GPS of 0.1 m circle the first person; keypoints have the measured errors of the detector,
and a joint behind another person's body is hidden. Each scene is reconstructed with `--persons auto`, once
with everybody's log and once with none. Alone is the MPJPE of the first person in a flight of the same seed
in which nobody else is. Seeds 0 to 4 and 30 to 33 were looked at while the rules were made.

Seen: times at which two cameras or more see at least half of the joints of a true person. Coverage is the
share of these at which somebody reconstructed is within 0.5 m of them. All else is of metrics.json.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.flights import scenario_of, walker
from benchmarks.results import fixed, markdown_table
from pipelines.geometry.arrays import Bool
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.session.camera_poses import noise_models
from pipelines.session.people import true_joints_at
from pipelines.session.tables import SKELETON, TRUTH, motion_from, read_table
from pipelines.simulate import simulate
from pipelines.simulation.flight import fly_scenario, visible_joints
from pipelines.simulation.scenario import read_scenario

WITHIN_M = 0.5
JOG = {"distance_m": 14, "speed_mps": 2.4}

SCENES: dict[str, dict[str, dict[str, Any]]] = {
    "two cross": {"anna": walker(-3, 0, 0), "ben": walker(0.3, -3, 90)},
    "two hug": {
        "anna": walker(-2, 0, 0, {"walk": {"distance_m": 1.7, "speed_mps": 1.0}}, {"stand": {"seconds": 4}}),
        "ben": walker(2, 0, 180, {"walk": {"distance_m": 1.8, "speed_mps": 1.0}}, {"stand": {"seconds": 4}}),
    },
    "two run past": {"anna": walker(-6, 0, 0, {"jog": JOG}), "ben": walker(6, 0.5, 180, {"jog": JOG})},
    "one leaves": {
        "anna": walker(0, 0, 0, {"walk": {"distance_m": 5, "speed_mps": 0.8}}),
        "ben": walker(3, 2, 60, {"jog": {"distance_m": 20, "speed_mps": 3.0, "turn_deg": 330}}),
    },
    "three meet": {"anna": walker(-3, 0, 0), "ben": walker(2, -3, 120), "cleo": walker(2, 3, 240)},
    "crowd behind": {
        "anna": walker(-3, 0, 0),
        "ben": walker(3, 1, 180),
        **{
            f"crowd{k}": walker(-4 + 2.0 * k, 7 + 0.4 * (k % 2), 270, {"stand": {"seconds": 6}})
            for k in range(5)
        },
    },
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12])
    parser.add_argument("--scene", choices=SCENES, action="append")


def run(options: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Reconstruct the scenes."""
    yield "people", modelled_table(options.scene or list(SCENES), options.seeds)


def modelled_table(scenes: list[str], seeds: list[int]) -> list[str]:
    """Write a line for each scene with and without logs: sums and means over seeds."""
    rows = []
    for scene in scenes:
        people = SCENES[scene]
        alone = float(np.mean([alone_mm(people, seed) for seed in seeds]))
        for logs in ("all", "none"):
            own = [measured(people, seed, logs == "all") for seed in seeds]
            total = {key: sum(row[key] for row in own) for key in _SUMS}
            rows.append(
                [
                    *(scene, logs, f"{sum(row['found'] for row in own)} of {len(people) * len(own)}"),
                    f"{100 * total['covered'] / total['seen']:.1f}",
                    *(str(total[key]) for key in ("switches", "phantoms")),
                    fixed(float(np.mean([row["idf1"] for row in own])), 3),
                    fixed(float(np.mean([row["mpjpe_mm"] for row in own]))),
                    fixed(alone),
                ]
            )
    header = ["scene", "logs", "found", "coverage %", "switches", "phantoms", "IDF1", "MPJPE"]
    return markdown_table([*header, "first, alone"], rows)


_SUMS = ("covered", "seen", "switches", "phantoms")


def alone_mm(people: dict[str, dict[str, Any]], seed: int) -> float:
    """Return the MPJPE (mm) of the first person in a flight of their own."""
    return float(measured(dict([next(iter(people.items()))]), seed, logs=True)["mpjpe_mm"])


def measured(people: dict[str, dict[str, Any]], seed: int, logs: bool) -> dict[str, Any]:
    """Simulate, ingest and reconstruct a scene; return its figures."""
    place = _modelled(json.dumps(people), seed)
    manifest = place / "flight" / "flight.yaml"
    if not logs:
        lines = manifest.read_text(encoding="utf-8").splitlines(keepends=True)
        start = next(k for k, line in enumerate(lines) if line.startswith("actors:"))
        del lines[start : start + 1 + len(people)]
        manifest = manifest.with_name("unlogged.yaml")
        manifest.write_text("".join(lines), encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="people-") as folder:
        session = ingest(manifest, Path(folder) / "flight.session").folder
        return figures(session, place / "scenario.yaml")


_FLIGHTS: list[tempfile.TemporaryDirectory[str]] = []  # until the process ends


@cache
def _modelled(people: str, seed: int) -> Path:
    """Simulate a flight without pictures; return the folder of its scenario."""
    _FLIGHTS.append(tempfile.TemporaryDirectory(prefix="people-"))
    place = Path(_FLIGHTS[-1].name)
    scenario = place / "scenario.yaml"
    scenario.write_text(json.dumps(scenario_of(json.loads(people), seed)), encoding="utf-8")
    simulate(scenario, place / "flight", video=False)
    return place


def figures(session: Path, scenario: Path) -> dict[str, Any]:
    """Reconstruct everybody in a session, and compare with the truth."""
    metrics = reconstruct(session, ReconstructSettings(people="auto"), force=True).metrics
    tracking, names = metrics["tracking"], metrics["people"]["names"]
    times = coverage(session, scenario)
    return {
        "found": sum(metrics["by_person"][name]["mpjpe_mm"] is not None for name in names),
        "covered": int((times.covered & times.seen).sum()),
        "seen": int(times.seen.sum()),
        "mpjpe_mm": metrics["mpjpe_mm"],
        **{key: tracking[key] for key in ("switches", "phantoms", "idf1")},
    }


class Times(NamedTuple):
    """Times [T, Q] of true people."""

    covered: Bool  # somebody reconstructed is within 0.5 m
    seen: Bool  # two cameras or more see at least half of the joints


def coverage(session: Path, scenario: Path) -> Times:
    """Find when each true person is reconstructed and seen."""
    skeleton = read_table(session / "reconstruct" / "skeleton.parquet", SKELETON)
    skeleton = skeleton.assign(**{axis: skeleton[axis].where(skeleton["status"] == "ok") for axis in "xyz"})
    joints = tuple(skeleton["joint"].unique())
    motion = motion_from(skeleton, joints)
    truth = true_joints_at(motion_from(read_table(session / "truth.parquet", TRUTH), joints), motion.t_ns)
    offset = motion.position[:, :, None] - truth[:, None]
    both = np.isfinite(offset[..., 0])
    mean = np.where(both[..., None], offset, 0.0).sum(axis=3) / np.maximum(both.sum(axis=3), 1)[..., None]
    distance = np.where(both.any(axis=3), np.linalg.norm(mean, axis=-1), np.inf)  # [T, P, Q]

    plan = read_scenario(scenario)
    flight = fly_scenario(plan, noise_models(str(scenario), plan.drones.pose_noise))
    seen = np.zeros((len(motion.t_ns), len(flight.people)), np.int64)
    for drone in flight.drones:
        frame = np.abs(drone.at_frames.t_ns[None] + plan.start_ns - motion.t_ns[:, None]).argmin(axis=1)
        for q, person in enumerate(flight.people):
            seen[:, q] += (visible_joints(flight, drone, person)[1].mean(axis=1) >= 0.5)[frame]
    covered: Bool = np.asarray((distance <= WITHIN_M).any(axis=1))
    return Times(covered, seen >= 2)
