"""Cost of the stage `detect`: `python -m benchmarks.detection [--detectors NAME ...]`.

The least that detection can cost is decoding every picture, and one landmark pass for each person in it:
crop, network and the reading of its heatmaps. The table compares the processor time of the stage with that,
and counts passes and runs of the person detector. The aims are a ratio of at most 1.25 and at most 1.05
passes a person and picture, on two recordings:

- the sample flight (`sample_data/mound_walk`), rendered, two drones, one person, whom a log follows;
- Pose2Sim's demo, real, four still cameras and no log, which is not part of this repository:
  `MOCAP_REAL_DATA` names the folder that holds `pose2sim_single`. Two of its cameras see a bystander, too.

Both sides run on one thread and take turns; the fastest turn of each counts, because other work on the
machine only adds time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.detectors import CAMERAS, DETECTORS, REAL, SAMPLE, real_flight
from pipelines.detect import detect
from pipelines.formats.videos.video import frames, index_video
from pipelines.ingest import ingest
from pipelines.keypoints.blazepose import BlazePose, _Network
from pipelines.session.registries import KeypointNetworks, Region, find_detector
from pipelines.session.stages import locked

MOST_TIMES = 1.25
MOST_PASSES = 1.05
PEOPLE_OF_SAMPLE = {SAMPLE / "drone1.mp4": 1, SAMPLE / "drone2.mp4": 1}
PEOPLE_OF_REAL = {
    REAL / "videos" / f"{name}.mp4": people for name, people in zip(CAMERAS, (2, 2, 1, 1), strict=True)
}
"""People in every picture of a video, counted by eye."""


def main() -> None:
    """Print the table of docs/detector.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detectors", nargs="+", default=DETECTORS, help="as `--detector` takes them")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mocap-") as name:
        folder = Path(name)
        films = {
            "sample flight": (ingest(SAMPLE / "flight.yaml", folder / "s.session").folder, PEOPLE_OF_SAMPLE)
        }
        if REAL.is_dir():
            real = ingest(real_flight(folder), folder / "real.session").folder
            films["real recording"] = (real, PEOPLE_OF_REAL)
        print(
            "| detector | recording | pictures x people | landmark passes | for each | searches |"
            " least CPU s | stage CPU s | ratio |"
        )
        print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
        met = [
            row(detector, name, *film, arguments.repeats)
            for detector in arguments.detectors
            for name, film in films.items()
        ]
    print(f"\n{'PASS' if all(met) else 'FAIL'}: aims {MOST_PASSES} passes, ratio {MOST_TIMES}")
    if not REAL.is_dir():
        print(f"{REAL} is not here: the real recording was left out")


def row(detector: str, name: str, session: Path, people: Mapping[Path, int], repeats: int) -> bool:
    """Print a row of the table; return whether the aims are met."""
    networks = find_detector(detector).load(threads=1)
    with counted() as runs:
        stage(session, detector)
    needed = sum(shown * index_video(path).count for path, shown in people.items())
    turns = np.array(
        [(taken_s(least, networks, people), taken_s(stage, session, detector)) for _ in range(repeats)]
    )
    least_s, stage_s = turns.min(axis=0)
    passes = runs["landmarks"] / needed
    ratio = stage_s / least_s
    print(
        f"| {detector} | {name} | {needed} | {runs['landmarks']} | {passes:.3f} | {runs['searches']} |"
        f" {least_s:.1f} | {stage_s:.1f} | {ratio:.2f} |",
        flush=True,
    )
    return passes <= MOST_PASSES and ratio <= MOST_TIMES


def stage(session: Path, detector: str) -> None:
    """Run the stage on one thread."""
    with locked(session) as writable:
        detect(writable, detector=detector, force=True)


def least(networks: KeypointNetworks, people: Mapping[Path, int]) -> None:
    """Decode every picture, and locate as many people as it shows."""
    for path, shown in people.items():
        for _, picture in frames(path):
            height, width = picture.shape[:2]
            networks.locate(picture, [Region((width / 2, height / 2), height / 2)] * shown)


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Count the runs of BlazePose's networks: landmarks, and searches by the person detector."""
    runs: Counter[str] = Counter()
    call = _Network.__call__
    landmarks = BlazePose._locate

    def counting(network: _Network, picture: NDArray[np.uint8]) -> Any:
        runs["all"] += 1
        return call(network, picture)

    def locating(networks: BlazePose, picture: NDArray[np.uint8], region: Region) -> Any:
        runs["landmarks"] += 1
        return landmarks(networks, picture, region)

    with patch.object(_Network, "__call__", counting), patch.object(BlazePose, "_locate", locating):
        yield runs
        runs["searches"] = runs["all"] - runs["landmarks"]


def taken_s(function: Callable[..., object], *arguments: object) -> float:
    """Measure the processor time of a call, of all threads."""
    started_s = time.process_time()
    function(*arguments)
    return time.process_time() - started_s


if __name__ == "__main__":
    main()
