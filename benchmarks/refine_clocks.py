"""Accuracy of clock offsets: by `mocap reconstruct --method refined`, and by backgrounds.

python -m benchmarks.refine_clocks [--seconds S] [--offsets S ...] [--sigma S] [--seeds N]
python -m benchmarks.refine_clocks --backgrounds tuning|kept|NAME ... [--draws N] [--sigma S]

Two cameras, one with wrong stamps. Simulated: a person walks in a circle of 4 m, keypoints of 2 px, poses
logged at 200 Hz by a common clock. Pictures of the second camera are stamped late or early. Moving cameras
fly a turning ring and weave, so that they accelerate; still ones do not, so that only the walk determines
the clock.

`--backgrounds`: `clocks_of_backgrounds` on the corpus (`benchmarks/corpus/README.md`; rendered). The stamps
of each camera are moved by up to the standard deviation of its clock, drawn anew for each draw of the logs'
errors, of which nothing is stated. Root mean squares over cameras and draws; `z` is the error over its
stated standard deviation, 1 if that holds. Cameras of which the background tells no clock are counted.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn
from unittest.mock import patch

import numpy as np

from benchmarks.accuracy import chosen_flights
from benchmarks.corpus.drawn import DrawnFlight, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS
from pipelines.detect import detect
from pipelines.follow import Following
from pipelines.reconstruct import Settings, reconstruct
from pipelines.reconstruction.background import clocks_of_backgrounds
from pipelines.reconstruction.observations import Camera
from pipelines.reconstruction.refining import shifted
from pipelines.session.stages import locked
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
    parser.add_argument("--backgrounds", nargs="+", help="tuning, kept, all, or names of flights")
    parser.add_argument("--draws", type=int, default=2)
    arguments = parser.parse_args()
    if arguments.backgrounds:
        by_backgrounds(arguments.backgrounds, arguments.draws, arguments.sigma)
        return
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


def by_backgrounds(names: Sequence[str], draws: int, sigma_s: float) -> None:
    """Print a row for each flight with pictures, and one for all."""
    print("| flight | cameras | with a clock | error ms | stated ms | z | CPU s a camera |")
    print("|" + " --- |" * 7)
    every: list[tuple[float, float, float]] = []
    for flight in chosen_flights(names, DETECTORS[0]):
        if not flight.with_pictures:
            continue
        with tempfile.TemporaryDirectory(prefix="clocks-") as folder:
            drawn = DrawnFlight(flight, Path(folder) / "shared")
            drawn.write_shared()
            found = [
                each
                for draw in range(draws)
                for each in clocks_of_draw(drawn, Path(folder) / f"draw{draw}", draw, sigma_s)
            ]
        print(_background_row(flight.name, found), flush=True)
        every += found
    if every:
        print(_background_row("all", every))


def _background_row(name: str, found: Sequence[tuple[float, float, float]]) -> str:
    error, sigma, took = np.array(found).T
    known = np.isfinite(error)
    figures = ["", "", ""]
    if known.any():
        z = error[known] / sigma[known]
        squares = [1e3 * error[known], 1e3 * sigma[known], z]
        figures = [f"{np.sqrt(np.mean(np.square(each))):.1f}" for each in squares]
    return f"| {name} | {len(error)} | {known.sum()} | {' | '.join(figures)} | {took.mean():.1f} |"


class _FoundError(Exception):
    """The cameras are loaded, and nothing else is of interest."""


def clocks_of_draw(
    drawn: DrawnFlight, place: Path, draw: int, sigma_s: float
) -> list[tuple[float, float, float]]:
    """Return error, standard deviation and processor time (s) of each camera's clock; NaN without one."""

    def stop(flight: Any, cameras: list[Camera], *_: object) -> NoReturn:
        rng = np.random.default_rng([draw, *drawn.flight.name.encode()])
        true_s = rng.uniform(-sigma_s, sigma_s, len(cameras))
        own_s = np.array([drone.clock_offset_s for drone in drawn.simulated.drones])
        for camera, late_s in zip(shifted(cameras, -true_s), true_s + own_s, strict=True):
            began = time.process_time()
            offset_s, stated_s = clocks_of_backgrounds(
                [camera],
                flight.followed,
                [None],
                np.array([sigma_s]),
                between=flight.description.pose_interpolation,
            )
            found.append((float(offset_s[0] - late_s), float(stated_s[0]), time.process_time() - began))
        raise _FoundError

    found: list[tuple[float, float, float]] = []
    session = drawn.session(place, draw, "nothing", DETECTORS[0])
    with (
        kept_in_place_of_pictures(drawn.flight, DETECTORS[0]),
        patch("pipelines.attempt.clocks_of", stop),
    ):
        with locked(session) as writable:
            detect(writable, detector=DETECTORS[0])
            Following(writable).finish()
        try:
            reconstruct(session, Settings(people=1))
        except _FoundError:
            return found
    raise AssertionError("`auto` looks for the clocks of every flight")


if __name__ == "__main__":
    main()
