"""Position errors between cameras before and after `ground.bind_positions`, on the corpus.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.ground [--flights tuning|kept|NAME ...] [--draws 2]

Pictures are rendered (`benchmarks/corpus/README.md`). For each draw of the logs' errors the backgrounds
correct the poses, and patches of ground bind the cameras. flight.yaml gives the errors' model, or nothing.
The error of a camera is its mean position error less the mean of all cameras; the table has the root mean
square length over cameras and draws. NEES is that of these errors by the standard deviations stated
afterwards, divided by the degrees of freedom. Flights whose cameras were not bound have no figures.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.accuracy import GIVEN, chosen_flights
from benchmarks.corpus.drawn import DrawnFlight, Given, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS
from pipelines.detect import detect
from pipelines.follow import Following
from pipelines.geometry.arrays import Float
from pipelines.reconstruct import Settings, reconstruct
from pipelines.reconstruction.ground import GroundBinding, bind_positions
from pipelines.reconstruction.observations import Camera
from pipelines.session.camera_poses import poses_at
from pipelines.session.description import Interpolation
from pipelines.session.stages import locked
from pipelines.session.tables import CAMERA_POSES, read_table, trajectory_from


@dataclass(frozen=True)
class Bound:
    """Cameras of one draw before and after they were bound."""

    before: Sequence[Camera]
    binding: GroundBinding
    between: Interpolation
    taken_s: float


class _BoundError(Exception):
    """The cameras are bound, and nothing else is of interest."""


def main() -> None:
    """Print a row for each flight."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", nargs="+", default=["tuning"], help="tuning, kept, all, or names")
    parser.add_argument("--draws", type=int, default=2)
    arguments = parser.parse_args()
    print(
        "| flight | cameras | noise | pairs used | patches that agree | logged mm | bound mm | NEES | CPU s |"
    )
    print("|" + " --- |" * 9)
    for flight in chosen_flights(arguments.flights, DETECTORS[0]):
        if not flight.with_pictures:
            continue
        with tempfile.TemporaryDirectory(prefix="ground-") as folder:
            drawn = DrawnFlight(flight, Path(folder) / "shared")
            drawn.write_shared()
            for given in GIVEN:
                print(row_of(drawn, given, arguments.draws), flush=True)


def row_of(drawn: DrawnFlight, given: Given, draws: int) -> str:
    """Measure some draws of a flight; return its row of the table."""
    before, after, sigma, patches, counting, spent = [], [], [], [], [], []
    for draw in range(draws):
        with tempfile.TemporaryDirectory(prefix="ground-") as folder:
            session = drawn.session(Path(folder) / "flight", draw, given, DETECTORS[0])
            found = bound_cameras(drawn, session)
            true = _true_positions(session, found.before, found.between)
        entry = found.binding.entry
        patches.append(sum(each["agree"] for each in entry["patches"]))
        counting.append(sum(each["used"] for each in entry["patches"]))
        spent.append(found.taken_s)
        own = [each["against_the_others"] for each in entry["position_sigma_m"].values()]
        if None not in own:
            sigma.append(own)
            before.append(_apart(found.before, true, found.between))
            after.append(_apart(found.binding.cameras, true, found.between))
    figures = ["", "", ""]
    if sigma:
        cameras = len(sigma[0])
        squares = np.sum(np.square(after), axis=(1, 2)) / np.mean(np.square(sigma), axis=1)
        figures = [
            f"{_length_mm(before):.0f}",
            f"{_length_mm(after):.0f}",
            f"{squares.mean() / (3 * (cameras - 1)):.1f}",
        ]
    cells = [
        drawn.flight.name,
        str(drawn.flight.scenario.drones.count),
        {"model": "stated", "nothing": "not stated"}[given],
        ", ".join(map(str, counting)),
        ", ".join(map(str, patches)),
        *figures,
        f"{np.mean(spent):.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def bound_cameras(drawn: DrawnFlight, session: Path) -> Bound:
    """Reconstruct a session up to the cameras that are bound."""
    found: list[Bound] = []

    def bind(cameras: Sequence[Camera], *others: Any, between: Interpolation) -> GroundBinding:
        began = time.process_time()
        binding = bind_positions(cameras, *others, between=between)
        found.append(Bound(cameras, binding, between, time.process_time() - began))
        raise _BoundError

    with kept_in_place_of_pictures(drawn.flight, DETECTORS[0]):
        with locked(session) as writable:
            detect(writable, detector=DETECTORS[0])
            Following(writable).finish()
        with patch("pipelines.attempt.bind_positions", bind):
            try:
                reconstruct(session, Settings())
            except _BoundError:
                return found[-1]
    raise AssertionError("`auto` binds the cameras of every flight with pictures")


def _true_positions(session: Path, cameras: Sequence[Camera], between: Interpolation) -> list[Float]:
    table = read_table(session / "truth_poses.parquet", CAMERA_POSES)
    return [
        poses_at(trajectory_from(table[table["camera"] == camera.name]), camera.frame_t_ns, between)[0]
        for camera in cameras
    ]


def _apart(cameras: Sequence[Camera], true: Sequence[Float], between: Interpolation) -> Float:
    """Compute each camera's mean position error [C, 3] m, without the mean of all cameras."""
    offsets = [
        np.nanmean(camera.poses_at(camera.frame_t_ns, between)[0] - exact, axis=0)
        for camera, exact in zip(cameras, true, strict=True)
    ]
    return np.asarray(offsets - np.mean(offsets, axis=0), dtype=np.float64)


def _length_mm(vectors: Sequence[Float]) -> float:
    return float(1e3 * np.sqrt(np.sum(np.square(vectors), axis=-1).mean()))


if __name__ == "__main__":
    main()
