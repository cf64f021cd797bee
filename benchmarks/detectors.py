"""Detectors on the sample flight and on a real recording: `python -m benchmarks.accuracy detectors`.

The sample has rendered pictures and its true poses, so all errors are the detector's. The real recording has
no truth: reprojection error is the distance of the skeleton's joints from the keypoints over all views,
spread the variation of a bone's length. The distance from Pose2Sim is the median over the joints that both
have. Detection runs on one thread; its time is for one person in one picture.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.flights import PEER, REAL, SAMPLE, real_flight
from benchmarks.results import fixed, markdown_table
from pipelines.formats.skeletons.trc import FORMAT as TRC
from pipelines.formats.videos.video import VideoReader
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.session.registries import find_detector
from pipelines.session.tables import motion_from

_CROPS = 60  # pictures in which a person is located


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--detectors", nargs="+", default=["blazepose", "blazepose-heavy"])


def run(options: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Reconstruct both recordings by `robust` with each detector."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="detectors-") as folder:
        sample = ingest(SAMPLE / "true_poses.yaml", Path(folder) / "sample.session").folder
        place = Path(folder)
        real = ingest(real_flight(place), place / "real.session").folder if REAL.is_dir() else None
        for detector in options.detectors:
            settings = ReconstructSettings(method="robust", detector=detector)
            found = reconstruct(sample, settings).metrics
            cells = [fixed(found[name], 1) for name in ("mpjpe_mm", "root_mpjpe_mm")]
            if real is None:
                cells += ["-"] * 3
            else:
                found = reconstruct(real, settings).metrics
                cells += [fixed(found["reprojection_px"]["median"], 1)]
                cells += [fixed(found["shape"]["bone_spread_mm"], 1), fixed(from_pose2sim_mm(real), 1)]
            rows.append([detector, *cells, fixed(person_ms(detector))])
    header = ["detector", "sample, true poses: MPJPE", "root-relative", "real: reprojection px"]
    header += ["spread of bones mm", "from Pose2Sim mm", "ms of one core"]
    yield "detectors", markdown_table(header, rows)


def from_pose2sim_mm(session: Path) -> float:
    """Return the median distance (mm) from Pose2Sim's joints, where both have them."""
    peer = TRC.read_joints(PEER, unit=None, axes=None)
    ours = motion_from(pd.read_parquet(session / "reconstruct" / "skeleton.parquet"), peer.joints)
    return 1e3 * float(np.nanmedian(np.linalg.norm(ours.position - peer.position, axis=-1)))


def person_ms(detector: str) -> float:
    """Measure the median processor time (ms) for one person in one picture, on one thread."""
    networks = find_detector(detector).load(threads=1)
    taken_s: list[float] = []
    with VideoReader(SAMPLE / "drone1.mp4") as film:
        for _, picture in film.frames(0, _CROPS):
            for region, _ in networks.find_people(picture)[:1]:
                started_s = time.process_time()
                networks.locate(picture, [region])
                taken_s.append(time.process_time() - started_s)
    return 1e3 * float(np.median(taken_s))
