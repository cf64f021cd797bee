"""Poses corrected by the background: on the rendered pictures of the sample flight."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from pipelines.formats.videos.video import VideoReader
from pipelines.geometry.arrays import Intrinsics
from pipelines.geometry.cameras import undistort
from pipelines.geometry.noise import pose_errors
from pipelines.geometry.poses import (
    conjugate,
    interpolate_poses,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction.background import Background, PosePrior, SeenPoints, adjust
from pipelines.reconstruction.background_tracks import follow, off_people
from pipelines.session.camera_poses import noise_models
from pipelines.session.description import read_description
from tests.commands.runner import succeeds

SAMPLE = Path(__file__).parents[2] / "sample_data" / "mound_walk"
PERSON = np.array([[440.0, 140.0, 840.0, 580.0]])  # the cameras aim at the person, who is in the middle
SPAN_S = (6.0, 10.0)


@pytest.mark.slow
def test_the_background_of_the_sample_flight_halves_the_errors_of_attitudes(tmp_path: Path) -> None:
    """Use rendered pictures with known poses, 4 s of 12; results for all of both are in docs/results.md."""
    session = tmp_path / "sample.session"
    succeeds("ingest", SAMPLE / "flight.yaml", "-o", session)
    entry = read_description(session).cameras["drone2"]
    frames = pd.read_parquet(session / "cameras" / "drone2" / "frames.parquet")
    since_s = (frames["t_ns"] - frames["t_ns"].iloc[0]) / 1e9
    chosen = frames[(since_s >= SPAN_S[0]) & (since_s < SPAN_S[1])].iloc[::2]
    with VideoReader(SAMPLE / "drone2.mp4") as video:
        pictures = [cv2.cvtColor(video.read(int(k)), cv2.COLOR_BGR2GRAY) for k in chosen["frame"]]
    followed = follow([np.asarray(picture, dtype=np.uint8) for picture in pictures])
    tracks = off_people(followed, np.tile(PERSON, (len(chosen), 1, 1)))
    t_ns = chosen["t_ns"].to_numpy(np.int64)
    truth = pd.read_parquet(session / "truth_poses.parquet")
    poses = {
        "log": pd.read_parquet(session / "cameras" / "drone2" / "poses.parquet"),
        "truth": truth[truth["camera"] == "drone2"],
    }
    (at, turned), (_, true) = (
        interpolate_poses(
            table["t_ns"].to_numpy(np.int64),
            table[["x", "y", "z"]].to_numpy(),
            table[["qx", "qy", "qz", "qw"]].to_numpy(),
            t_ns,
            max_gap_ns=10**9,
            max_extrapolation_ns=10**8,
        )
        for table in poses.values()
    )
    lens: Intrinsics = entry.intrinsics.intrinsics()
    prior = PosePrior.of(pose_errors(noise_models("the flight", entry.pose_noise or {})))
    rays = undistort(tracks.xy, lens)
    points = SeenPoints(tracks.picture, tracks.point, rays)
    seen = Background(points.between, lens.fx, (t_ns - t_ns[0]) / 1e9)
    found = adjust(seen, at, matrix_from_quaternion(turned), prior)
    assert found.refused is None
    logged_rad, left_rad = (
        float(np.sqrt(np.mean(rotation_vector_from_quaternion(multiply(conjugate(true), other)) ** 2)))
        for other in (turned, quaternion_from_matrix(found.rotation))
    )
    assert left_rad < 0.5 * logged_rad
