"""Large errors with status `ok`: counts on the sample flight and four rendered flights with other motions.

python -m benchmarks.legs [--folder FOLDER] [FLIGHT ...]

Every flight is reconstructed with the true camera poses and with the logged ones. The pictures are
rendered; the detector is real. The constants of `pipelines/keypoints/swaps.py` were tuned on the sample,
`walk` and `jog`; `kick` and `turns` were held out.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from pipelines.ingest import ingest
from pipelines.reconstruct import Settings, reconstruct
from pipelines.session.people import true_joints_at
from pipelines.session.tables import SKELETON, TRUTH, motion_from, read_table
from pipelines.simulate import simulate

SAMPLE = Path(__file__).parents[1] / "sample_data" / "mound_walk"
SECONDS, RATE_HZ = 7, 25
FLIGHTS = {
    "walk": """\
seed: 71
actor:
  body: {sex: male, height_m: 1.80, build: average, outfit: casual}
  start: [-4, 0]
  heading_deg: 20
  motion: [walk: {distance_m: 9, turn_deg: 60, speed_mps: 1.3}]
drones: {count: 2, formation: {yaw_deg: 130, tilt_deg: 15, radius_m: 10}, POSES}
""",
    "jog": """\
seed: 72
actor:
  body: {sex: female, height_m: 1.66, build: slim, outfit: dark}
  start: [-8, -2]
  heading_deg: -10
  motion: [jog: {distance_m: 18, turn_deg: -40, speed_mps: 2.6}]
world: {sun: [-0.6, 0.5, 0.5]}
drones: {count: 3, formation: {yaw_deg: 40, tilt_deg: 20, radius_m: 9}, POSES}
""",
    "kick": """\
seed: 73
actor:
  body: {sex: male, height_m: 1.75, build: heavy, outfit: bright}
  heading_deg: 75
  motion: [kick: {foot: right, run_up_m: 3}, kick: {foot: left, run_up_m: 2.5}]
world: {sun: [0.1, 0.7, 0.4]}
drones: {count: 2, formation: {yaw_deg: 200, tilt_deg: 12, radius_m: 9, yaw_rate_deg_per_s: 5}, POSES}
""",
    "turns": """\
seed: 74
actor:
  body: {sex: female, height_m: 1.72, build: average, outfit: sport}
  heading_deg: 160
  motion:
    - walk: {distance_m: 3, speed_mps: 1.2}
    - turn: {deg: 120}
    - walk: {distance_m: 5, turn_deg: -90, speed_mps: 1.4}
world: {sun: [0.3, 0.2, 0.9]}
drones: {count: 2, formation: {yaw_deg: -60, tilt_deg: 25, radius_m: 9}, POSES}
""",
}
POSES = """\
camera: {width: 1280, height: 720, hfov_deg: 80, rate_hz: RATE}, pose_noise: {white: {position_m: 0.02, \
rotation_deg: 0.2}, bias: {position_m: 0.05, rotation_deg: 0.3}}""".replace("RATE", str(RATE_HZ))
LARGE_MM, GOOD_MM = 300.0, 150.0


def main() -> None:
    """Simulate missing flights, reconstruct all, print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--folder", type=Path, help="keep the flights there")
    parser.add_argument("flights", nargs="*", help="sample, " + ", ".join(FLIGHTS))
    options = parser.parse_args()
    print("| flight | poses | ok above 300 mm | ok within 150 mm | not ok | mean of ok mm |")
    print("| --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.flights or ["sample", *FLIGHTS]:
            measure(name, options.folder or Path(temporary))


def measure(name: str, folder: Path) -> None:
    """Reconstruct one flight with both kinds of poses, print a row for each."""
    flight = SAMPLE if name == "sample" else folder / name
    if name != "sample" and not (flight / "flight.yaml").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        scenario = folder / f"{name}.yaml"
        text = f"schema: 1\nname: {name}\nduration_s: {SECONDS}\n" + FLIGHTS[name].replace("POSES", POSES)
        scenario.write_text(text, encoding="utf-8")
        simulate(scenario, flight)
    for manifest, poses in (("true_poses", "true"), ("flight", "logged")):
        session = ingest(flight / f"{manifest}.yaml", folder / f"{name}_{poses}.session").folder
        reconstruct(session, Settings(method="robust"))
        print(f"| {name} | {poses} | {row(session)} |", flush=True)


def row(session: Path) -> str:
    """Count the joint-frames of the actor by their error and status."""
    table = read_table(session / "reconstruct" / "skeleton.parquet", SKELETON)
    skeleton = motion_from(table, tuple(dict.fromkeys(table["joint"])))
    assert skeleton.status is not None
    truth = motion_from(read_table(session / "truth.parquet", TRUTH), skeleton.joints)
    true = true_joints_at(truth, skeleton.t_ns)[:, 0]
    error = 1e3 * np.linalg.norm(skeleton.position[:, 0] - true, axis=-1)
    ok = (skeleton.status[:, 0] == "ok") & np.isfinite(true[..., 0])
    large = int((ok & (error > LARGE_MM)).sum())
    good = int((ok & (error <= GOOD_MM)).sum())
    return f"{large} | {good} | {np.isfinite(true[..., 0]).sum() - ok.sum()} | {error[ok].mean():.1f}"


if __name__ == "__main__":
    main()
