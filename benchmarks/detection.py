"""The stage `detect` beside what cannot be saved: `python -m benchmarks.detection`.

The floor is the time inside the networks and inside the decoder of the videos, measured where the stage
calls them, with one worker; the mark is a stage that takes at most 1.15 times as long. Videos are made
here: 1280x960, somebody made of three spots, seen by a pose model of 192x256 that takes about as long as
RTMPose-m (1.4 billion multiplications) and a person detector that takes no time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from pipelines.detect import detect
from pipelines.formats.video import VideoReader
from pipelines.ingest import ingest
from pipelines.keypoints import onnx_network
from pipelines.session.stages import locked
from tests.keypoints.spotted_flights import CAMERAS, spot_detector, write_spotted_flight


def main() -> None:
    """Print the table of docs/benchmarks.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300, help="of each of two cameras (default 300)")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    print("| frames | decoding, s | networks, s | stage, s | ratio |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory(prefix="mocap-") as name:
        folder = Path(name)
        session = folder / "flight.session"
        ingest(write_spotted_flight(folder, arguments.frames, scale=4), session)
        detector = spot_detector(folder, size=(192, 256), ballast=6)
        for _ in range(arguments.repeats):
            inside: dict[str, float] = {}
            with timed(inside):
                started = time.perf_counter()
                with locked(session) as writable:
                    detect(writable, detector=detector, force=True)
                stage_s = time.perf_counter() - started
            figures = [inside["decoding"], inside["networks"], stage_s, stage_s / sum(inside.values())]
            written = " | ".join(f"{figure:.2f}" for figure in figures)
            print(f"| {len(CAMERAS) * arguments.frames} | {written} |")


@contextmanager
def timed(inside: dict[str, float]) -> Iterator[None]:
    """Sum up the seconds spent in decoding and in networks."""
    load = onnx_network._session

    def loaded(*arguments: Any) -> Any:
        session = load(*arguments)
        return _Timed(session, inside)

    with (
        patch.object(onnx_network, "_session", loaded),
        patch.object(VideoReader, "read", clocked(VideoReader.read, inside, "decoding")),
    ):
        yield


class _Timed:
    """A session of ONNX Runtime whose runs are timed."""

    def __init__(self, session: Any, inside: dict[str, float]) -> None:
        self._session = session
        self.run = clocked(session.run, inside, "networks")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)


def clocked(function: Callable[..., Any], inside: dict[str, float], name: str) -> Callable[..., Any]:
    """The function, with its seconds added up under a name."""

    def call(*arguments: Any) -> Any:
        started = time.perf_counter()
        try:
            return function(*arguments)
        finally:
            inside[name] = inside.get(name, 0.0) + time.perf_counter() - started

    return call


if __name__ == "__main__":
    main()
