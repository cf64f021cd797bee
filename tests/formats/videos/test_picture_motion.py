"""Points tracked through a video of a camera with known rotation, and the video's start estimated by them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.formats.videos.video import followed_points
from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import camera_matrix
from pipelines.geometry.poses import look_at
from pipelines.simulation.flight_files import write_tum
from tests.commands.runner import succeeds
from tests.keypoints.spotted_flights import FPS, write_pictures

START_S = 1_700_000_000
BEGINS_S = 7.2345  # start of the video after that of the log
LENS = Intrinsics(320, 240, 300.0, 300.0, 159.5, 119.5, "none", ())
SECONDS, LOG_SECONDS, LOG_HZ = 4, 20, 100


def turning(t_s: Float) -> Rotation:
    """Compute the camera's attitude against the wall it looks at: up to 12 deg, without repetition."""
    yaw = 8 * np.sin(1.3 * t_s) + 4 * np.sin(3.1 * t_s + 1)
    pitch = 3 * np.sin(1.9 * t_s)
    return Rotation.from_euler("YX", np.stack([yaw, pitch], axis=-1), degrees=True)


def pictures(attitudes: Rotation) -> Iterator[NDArray[np.uint8]]:
    """Render a wall at a great distance: noise, blurred to some pixels."""
    noise = np.random.default_rng(1).integers(0, 256, (800, 1000), dtype=np.uint8)
    wall = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    wall_camera = np.array([[300.0, 0, 500], [0, 300.0, 400], [0, 0, 1]])
    for attitude in attitudes:
        picture_from_wall = camera_matrix(LENS) @ attitude.inv().as_matrix() @ np.linalg.inv(wall_camera)
        grey = cv2.warpPerspective(wall, picture_from_wall, (LENS.width, LENS.height))
        yield np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a flight of one camera whose video does not state its start."""
    folder = tmp_path_factory.mktemp("panning")
    write_pictures(folder / "drone1.mp4", pictures(turning(np.arange(SECONDS * FPS) / FPS + BEGINS_S)))
    log_s = np.arange(LOG_SECONDS * LOG_HZ) / LOG_HZ
    level = Rotation.from_quat(look_at(np.zeros((1, 3)), np.array([[0.0, 5.0, 0.0]]))[0])
    write_tum(
        folder / "drone1.tum",
        START_S * 10**9 + np.round(log_s * 1e9).astype(np.int64),
        np.zeros((len(log_s), 3)),
        (level * turning(log_s)).as_quat(),
    )
    (folder / "flight.yaml").write_text(
        """\
schema: 1
cameras:
  drone1:
    video: drone1.mp4
    frame_times: {start_from: motion}
    pose: {file: drone1.tum}
    intrinsics: {width: 320, height: 240, fx: 300, fy: 300, cx: 159.5, cy: 119.5}
""",
        encoding="utf-8",
    )
    return folder


def test_points_are_followed_to_where_they_are(filmed: Path) -> None:
    followed = followed_points(
        filmed / "drone1.mp4", LENS, np.round(np.arange(40) / FPS * 1e9).astype(np.int64)
    )
    assert (followed.end_ns - followed.begin_ns >= 0.2e9).all()
    assert len(followed.begin_ns) >= 5
    begin_s, end_s = followed.begin_ns / 1e9 + BEGINS_S, followed.end_ns / 1e9 + BEGINS_S
    turn = (turning(end_s).inv() * turning(begin_s)).as_matrix()[followed.stretch]
    ray = np.einsum("pij,pj->pi", turn, np.column_stack([followed.begin, np.ones(len(followed.begin))]))
    error_px = 300 * np.linalg.norm(followed.end - ray[:, :2] / ray[:, 2:], axis=1)
    # Tracking has an error of a tenth of a pixel from picture to picture, and there are six or seven of them.
    assert np.median(error_px) < 0.1 * np.sqrt(7)


def test_a_video_begins_when_its_pictures_turn_as_the_poses_do(filmed: Path) -> None:
    succeeds("ingest", filmed / "flight.yaml")
    described = json.loads((filmed / "flight.session" / "session.json").read_text(encoding="utf-8"))
    camera = described["cameras"]["drone1"]
    error_s = camera["frames"]["first_t_ns"] / 1e9 - START_S - BEGINS_S
    sigma_s = camera["clock"]["sigma_s"]
    # 1 mrad a point against motion that changes by some 0.5 rad/s^2 in a fifth of a second, 0.1 rad/s: 10 ms.
    # With independent errors, 100 points in each of 19 stretches give a quarter of a millisecond.
    assert 1e-5 < sigma_s < 2e-3
    assert abs(error_s) < 4 * sigma_s + 1e-3  # the same test with formulas alone allows 1 ms
    assert any("motion" in line for line in described["warnings"])
