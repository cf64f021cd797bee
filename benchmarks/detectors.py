"""Comparison of the detectors on a rendered and on a real recording: `python -m benchmarks.detectors`.

- The sample flight (`sample_data/mound_walk`, two drones, rendered pictures) with its true poses, so that
  all errors are the detector's. MPJPE absolute, and with the hips moved to their true place.
- A real recording of a walk by four static cameras (Pose2Sim's demo), which is not part of this repository:
  `MOCAP_REAL_DATA` names the folder that holds `pose2sim_single`. It has no truth. The reprojection error is
  the distance of the skeleton's joints from the keypoints over all views. The spread of bones is the
  variation of a bone's length. The distance from Pose2Sim is that from the skeleton which Pose2Sim 0.10.49
  made of OpenPose's keypoints, over the joints that both have: the median over joint-frames, and in a
  table of its own joint by joint.
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
import pandas as pd

from pipelines.formats.skeletons.trc import FORMAT as TRC
from pipelines.formats.videos.video import frames
from pipelines.geometry.arrays import Float
from pipelines.ingest import ingest
from pipelines.reconstruct import Settings, reconstruct
from pipelines.session.registries import find_detector
from pipelines.session.tables import motion_from

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data" / "mound_walk"
REAL = Path(os.environ.get("MOCAP_REAL_DATA", ROOT.parent / "shared" / "data")) / "pose2sim_single"
PEER = REAL / "pose-3d" / "single_0-99.trc"
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
    print(" reprojection px, median | mean | spread of bones mm | from Pose2Sim mm |", end="")
    print(" ms a person and picture |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    from_peer: dict[str, dict[str, Float]] = {}
    with tempfile.TemporaryDirectory(prefix="mocap-") as name:
        folder = Path(name)
        sample = ingest(SAMPLE / "true_poses.yaml", folder / "sample.session").folder
        real = None if not REAL.is_dir() else ingest(real_flight(folder), folder / "real.session").folder
        for detector in arguments.detectors:
            if None in find_detector(detector).models().values():
                print(f"{detector} was not measured: run `mocap models fetch {detector}`")
                continue
            cells = [*of_sample(sample, detector, arguments.every)]
            if real is None:
                cells += [""] * 4
            else:
                cells += of_real(real, detector, arguments.every)
                from_peer[detector] = offsets_from_peer(real)
                everywhere = np.concatenate(list(from_peer[detector].values()))
                cells.append(f"{np.median(lengths_mm(everywhere)):.1f}")
            print(f"| {detector} | {' | '.join([*cells, f'{person_ms(detector):.0f}'])} |", flush=True)
    if real is None:
        print(f"\n{REAL} is not here: the real recording was left out")
    for detector, offsets in from_peer.items():
        print_joints(detector, offsets)


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


def offsets_from_peer(session: Path) -> dict[str, Float]:
    """Return offsets [T, 3] (m) from Pose2Sim's joints by joint, at the times that both have.

    Axes are the body's: ahead, left and up. Left is the level direction from the right hip of Pose2Sim's
    skeleton to its left one.
    """
    peer = TRC.read_joints(PEER, unit=None, axes=None)
    ours = motion_from(pd.read_parquet(session / "reconstruct" / "skeleton.parquet"), peer.joints)
    hips = [peer.joints.index(name) for name in ("right_hip", "left_hip")]
    left = np.diff(peer.position[:, 0, hips], axis=1)[:, 0] * (1, 1, 0)
    left /= np.linalg.norm(left, axis=-1, keepdims=True)
    up = np.broadcast_to((0.0, 0.0, 1.0), left.shape)
    body_from_world = np.stack([np.cross(left, up), left, up], axis=1)
    offset = np.einsum("tij,tkj->tki", body_from_world, (ours.position - peer.position)[:, 0])
    both = np.isfinite(offset).all(axis=-1)
    return {name: offset[both[:, j], j] for j, name in enumerate(peer.joints) if both[:, j].any()}


def lengths_mm(offsets: Float) -> Float:
    """Compute the lengths (mm) [...] of offsets [..., 3] (m)."""
    lengths: Float = 1e3 * np.linalg.norm(offsets, axis=-1)
    return lengths


def print_joints(detector: str, offsets: dict[str, Float]) -> None:
    """Print the distance from Pose2Sim joint by joint, and what is left of it without the median offset."""
    print(f"\n{detector} against Pose2Sim, mm")
    print("| joint | distance, median | offset ahead | left | up | distance without that offset |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, own in offsets.items():
        middle = np.median(own, axis=0)
        apart = " | ".join(f"{1e3 * part:+.0f}" for part in middle)
        without = np.median(lengths_mm(own - middle))
        print(f"| {name} | {np.median(lengths_mm(own)):.0f} | {apart} | {without:.0f} |")


def found_by(session: Path, detector: str, every: int) -> dict[str, Any]:
    """Reconstruct from a detector's keypoints and return the figures."""
    return reconstruct(session, Settings(method="robust", detector=detector, every=every), workers=2).metrics


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
