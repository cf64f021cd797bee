"""Attitudes from pictures on rendered flights: `python -m benchmarks.attitudes`.

The points that were followed through the films of the corpus are mapped once for each moving camera, by the
same calls as `mocap ingest` with `pose.attitude: pictures`. The camera's true places are then disturbed many
times, as two kinds of logs (`LOGS`) would.

`off` is the median over draws of the root mean square angle between found and true attitudes of key pictures.
`NEES` is the mean squared common error over its predicted variance: 1 where the standard deviation is right.
Flights of 6 s move by some metres only, so `off` is some degrees with the errors of a satellite receiver.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.corpus.drawn import DrawnFlight
from benchmarks.corpus.stored import flights, read_backgrounds
from benchmarks.results import markdown_table, parser_of, show
from pipelines.geometry.arrays import Int64, Intrinsics
from pipelines.geometry.noise import Bias, GaussMarkov, NoiseModel, White, disturb, pose_errors
from pipelines.geometry.poses import (
    conjugate,
    interpolate_poses,
    multiply,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction.background_tracks import Tracks
from pipelines.reconstruction.picture_map import (
    NoAttitudesError,
    PictureMap,
    followed_features,
    key_rows,
    lay_on_places,
    map_pictures,
)
from pipelines.session.records import Trajectory

TUNED = ("01-walk", "02-jog", "06-turn", "07-jog", "15-two-people", "16-two-people", "05-dance")
KEPT = ("08-walk", "14-dance", "24-two-people-dance", "18-stand")
"""Flights that no constant was chosen on. The last of each half hovers."""
LOGS: dict[str, tuple[list[NoiseModel], float]] = {
    "rtk": ([White(position_m=0.02), Bias(position_m=0.05)], 0.1),
    "gps": ([GaussMarkov(position_m=1.5, correlation_s=100)], 1.0),
}
"""Errors of places, and the time between two of them, s."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--kept", action="store_true", help="measure on the flights that are kept aside")
    parser.add_argument("--flights", nargs="+", help="names, instead of all of that half")
    parser.add_argument("--draws", type=int, default=20)


def run(options: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Map, and compare with the truth."""
    names = options.flights or (KEPT if options.kept else TUNED)
    heading = ["flight", "camera", "moves m", "mapped", "cpu s"]
    for log in LOGS:
        heading += [f"{log} refused", f"{log} off deg", f"{log} NEES"]
    rows = [row for name in names for row in measured(name, options.draws)]
    yield "attitudes-kept" if options.kept else "attitudes-tuned", markdown_table(heading, rows)


def measured(name: str, draws: int) -> Iterator[list[str]]:
    """Measure every camera of a flight."""
    (flight,) = [each for each in flights() if each.name == name]
    backgrounds = read_backgrounds(flight)
    with TemporaryDirectory() as folder:
        drones = DrawnFlight(flight, Path(folder)).simulated.drones
    for drone in drones:
        true, lens = drone.at_frames, drone.intrinsics
        own = Trajectory(true.t_ns, true.camera_position, true.camera_quaternion_xyzw)
        t_ns = own.t_ns
        keys, began_s = key_rows(t_ns), time.process_time()
        seen = backgrounds[drone.name].tracks
        picture, point = (seen[column].to_numpy(np.int64) for column in ("frame", "point"))
        tracks = Tracks(picture, point, seen[["x", "y"]].to_numpy(np.float64))
        row = [name, drone.name, f"{np.linalg.norm(own.position[-1] - own.position[0]):.1f}"]
        try:
            features = followed_features(tracks, np.arange(len(t_ns)), keys, lens, t_ns)
            found = map_pictures(features, lens)
        except NoAttitudesError as error:
            yield [*row, str(error).split(" of ")[0], f"{time.process_time() - began_s:.0f}", *6 * ["-"]]
            continue
        row += [f"{len(found.key)} of {len(keys)}", f"{time.process_time() - began_s:.0f}"]
        for log in LOGS.values():
            row += _figures(found, lens, t_ns[keys], own, log, draws)
        yield row


def _figures(
    found: PictureMap,
    lens: Intrinsics,
    key_t_ns: Int64,
    own: Trajectory,
    log: tuple[list[NoiseModel], float],
    draws: int,
) -> list[str]:
    """Lay a map on places with errors drawn anew; return refusals, errors and NEES."""
    (models, step_s), t_ns, position, turned = log, own.t_ns, own.position, own.quaternion_xyzw
    wide = {"max_gap_ns": 10**9, "max_extrapolation_ns": 10**9}
    true = interpolate_poses(t_ns, position, turned, key_t_ns[found.key], **wide)[1]
    step = max(round(step_s * 1e9 / float(np.median(np.diff(t_ns)))), 1)
    off, nees, refused = [], [], 0
    for draw in range(draws):
        places, _ = disturb(models, t_ns, position, turned, np.random.default_rng([3, draw]))
        try:
            laid = lay_on_places(found, lens, key_t_ns, t_ns[::step], places[::step], pose_errors(models))
        except NoAttitudesError:
            refused += 1
            continue
        apart = rotation_vector_from_quaternion(multiply(laid.quaternion_xyzw, conjugate(true)))
        off.append(np.degrees(np.sqrt(np.square(apart).sum(axis=1).mean())))
        nees.append(np.square(apart.mean(axis=0)).sum() / (3 * laid.common_sigma_rad**2))
    shown = [f"{np.median(off):.2f}", f"{np.mean(nees):.1f}"] if off else ["-", "-"]
    return [f"{refused} of {draws}", *shown]


if __name__ == "__main__":
    parser = parser_of(__doc__)
    add_arguments(parser)
    asked = parser.parse_args()
    for key, lines in run(asked):
        show(key, lines, write=asked.write)
