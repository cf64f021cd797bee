"""Comparison of the detectors on a rendered and on a real recording: `python -m benchmarks.detectors`.

- The sample flight (`sample_data/mound_walk`, two drones, rendered pictures) with its true poses, so that
  all errors are the detector's. MPJPE absolute, and with the hips moved to their true place.
- A real recording of a walk by four static cameras (Pose2Sim's demo), which is not part of this repository:
  `MOCAP_REAL_DATA` names the folder that holds `pose2sim_single`. It has no truth. The reprojection error is
  the distance of the skeleton's joints from the keypoints over all views. The spread of bones is the
  variation of a bone's length.
- Milliseconds of the processor for one person in one picture: its crop, the landmark network on one thread
  and the reading of its heatmaps; the median over crops of the sample flight.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.videos.video import frames
from pipelines.ingest import ingest
from pipelines.reconstruct import Settings, reconstruct
from pipelines.session.registries import find_detector

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data" / "mound_walk"
REAL = Path(os.environ.get("MOCAP_REAL_DATA", ROOT.parent / "shared" / "data")) / "pose2sim_single"
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
DETECTORS = ("blazepose", "blazepose-heavy")
CROPS = 60


def main() -> None:
    """Print the table of docs/detector.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detectors", nargs="+", default=DETECTORS, help="as `--detector` takes them")
    parser.add_argument("--every", type=int, default=1, help="look at every k-th picture only")
    arguments = parser.parse_args()
    print(
        "| detector | sample flight, true poses: MPJPE mm | root-relative mm | PCK@150 mm | real recording:",
        end="",
    )
    print(" reprojection px, median | mean | spread of bones mm | ms a person and picture |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory(prefix="mocap-") as name:
        folder = Path(name)
        sample = ingest(SAMPLE / "true_poses.yaml", folder / "sample.session").folder
        real = None if not REAL.is_dir() else ingest(real_flight(folder), folder / "real.session").folder
        for detector in arguments.detectors:
            if None in find_detector(detector).models().values():
                print(f"{detector} was not measured: run `mocap models fetch {detector}`")
                continue
            cells = [*of_sample(sample, detector, arguments.every)]
            cells += ["", "", ""] if real is None else of_real(real, detector, arguments.every)
            print(f"| {detector} | {' | '.join([*cells, f'{person_ms(detector):.0f}'])} |", flush=True)
    if real is None:
        print(f"\n{REAL} is not here: the real recording was left out")


def real_flight(folder: Path) -> Path:
    """Write a flight.yaml of the real recording: its videos and its calibration, no keypoints."""
    calibration = REAL / "calibration" / "Calib_qualisys.toml"
    lines = ["schema: 1", "name: Walk", "cameras:"]
    for name in CAMERAS:
        video = REAL / "videos" / f"{name}.mp4"
        lines.append(
            f"  {name}: {{video: {video}, pose: {{static: {calibration}}}, intrinsics: {calibration}}}"
        )
    path = folder / "real.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def of_sample(session: Path, detector: str, every: int) -> Iterator[str]:
    """Yield MPJPE and root-relative MPJPE (mm), and PCK@150 (percent)."""
    metrics = found_by(session, detector, every)
    yield from (f"{metrics[name]:.1f}" for name in ("mpjpe_mm", "root_mpjpe_mm"))
    yield f"{100 * metrics['pck150']:.1f} %"


def of_real(session: Path, detector: str, every: int) -> Iterator[str]:
    """Yield median and mean reprojection error (px), and spread of bone lengths (mm)."""
    metrics = found_by(session, detector, every)
    yield from (f"{metrics['reprojection_px'][name]:.1f}" for name in ("median", "mean"))
    yield f"{metrics['shape']['bone_spread_mm']:.1f}"


def found_by(session: Path, detector: str, every: int) -> dict[str, Any]:
    """Reconstruct from a detector's keypoints and return the figures."""
    return reconstruct(session, Settings(detector=detector, every=every), workers=2).metrics


def person_ms(detector: str) -> float:
    """Measure the median processor time (ms) for one person in one picture, on one thread."""
    networks = find_detector(detector).load(threads=1)
    taken_s: list[float] = []
    for _, picture in frames(SAMPLE / "drone1.mp4", 0, CROPS):
        people = networks.find_people(picture)[:1]
        for region, _ in people:
            started_s = time.process_time()
            networks.locate(picture, [region])
            taken_s.append(time.process_time() - started_s)
    return 1e3 * float(np.median(taken_s))


if __name__ == "__main__":
    main()
