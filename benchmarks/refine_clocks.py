"""Accuracy of clock offsets by `mocap reconstruct --method refined`: two cameras, one with wrong stamps.

python -m benchmarks.refine_clocks [--seconds S] [--offsets S ...] [--sigma S] [--seeds N]

Simulated: a person walks in a circle of 4 m, keypoints of 2 px, poses logged at 200 Hz by a common clock.
Pictures of the second camera are stamped late or early. Moving cameras fly a turning ring and weave, so that
they accelerate; still ones do not, so that only the walk determines the clock.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from tests.commands.runner import succeeds
from tests.synthetic.flights import write_flight

Noise = Mapping[str, Mapping[str, float | str]]

POSES: Mapping[str, tuple[bool, Noise]] = {
    "still, true": (True, {}),
    "still, bias": (True, {"bias": {"frame": "world", "position_m": 0.1, "rotation_deg": 0.5}}),
    "moving, true": (False, {}),
    "moving, white": (False, {"white": {"position_m": 0.1, "rotation_deg": 0.5}}),
    "moving, bias": (False, {"bias": {"frame": "world", "position_m": 0.1, "rotation_deg": 0.5}}),
}


def main() -> None:
    """Print a row for each flight."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--offsets", type=float, nargs="*", default=[0.2, -0.2])
    parser.add_argument("--poses", nargs="*", default=list(POSES), choices=list(POSES))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--sigma", type=float, default=0.2, help="s, what the manifest says of the clock")
    arguments = parser.parse_args()
    print(
        "| cameras, poses | true offset ms | error ms | posterior sigma ms | robust mm | refined mm | CPU s |"
    )
    print("|" + " --- |" * 7)
    for name in arguments.poses:
        for offset_s in arguments.offsets:
            for seed in range(arguments.seeds):
                print(row_of(name, offset_s, arguments.sigma, seed, arguments.seconds), flush=True)


def row_of(name: str, offset_s: float, sigma_s: float, seed: int, seconds: float) -> str:
    """Simulate and reconstruct one flight; return its row of the table."""
    static, noise = POSES[name]
    with tempfile.TemporaryDirectory() as folder:
        flight = write_flight(Path(folder), seconds=seconds, static=static, pose_noise=noise, seed=seed)
        # Its pictures are stamped too early by the offset that its clock needs.
        flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": -offset_s, "sigma_s": sigma_s}
        flight.save()
        session = Path(folder) / "flight.session"
        succeeds("ingest", flight.manifest, "-o", session)
        robust = json.loads(succeeds("reconstruct", session, "--method", "robust", "--json"))
        began = time.process_time()
        refined = json.loads(succeeds("reconstruct", session, "--method", "refined", "--json"))
        took = time.process_time() - began
    fallback = refined["refinement"]["fallback"]
    found = fallback or f"{1e3 * (refined['clock_offsets_s']['drone2'] - offset_s):.1f}"
    sigma_ms = 1e3 * refined["clock_offset_sigmas_s"]["drone2"]
    return (
        f"| {name} | {1e3 * offset_s:.0f} | {found} | {sigma_ms:.1f}"
        f" | {robust['mpjpe_mm']:.0f} | {refined['mpjpe_mm']:.0f} | {took:.1f} |"
    )


if __name__ == "__main__":
    main()
