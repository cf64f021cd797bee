"""The turning of pictures: by formula for points, and through a video whose camera turned as it is known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.formats.videos.picture_motion import rotation_of_flow, turning_of_pictures
from pipelines.geometry.cameras import Intrinsics, camera_matrix
from pipelines.geometry.poses import look_at
from pipelines.simulation.flight_files import write_tum
from tests.commands.runner import refused, succeeds
from tests.keypoints.spotted_flights import FPS, write_pictures

Float = NDArray[np.float64]

START_S = 1_700_000_000
BEGINS_S = 7.2345  # the video, after the log
LENS = Intrinsics(320, 240, 300.0, 300.0, 159.5, 119.5, "none", ())
SECONDS, LOG_SECONDS, LOG_HZ = 4, 20, 100


def turning(t_s: Float) -> Rotation:
    """The camera's attitude against the wall that it looks at: up to 12 deg, never twice alike."""
    yaw = 8 * np.sin(1.3 * t_s) + 4 * np.sin(3.1 * t_s + 1)
    pitch = 3 * np.sin(1.9 * t_s)
    return Rotation.from_euler("YX", np.stack([yaw, pitch], axis=-1), degrees=True)


def pictures(attitudes: Rotation) -> Iterator[NDArray[np.uint8]]:
    """What a camera sees of something very far away: noise, blurred to some pixels."""
    noise = np.random.default_rng(1).integers(0, 256, (800, 1000), dtype=np.uint8)
    wall = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    wall_camera = np.array([[300.0, 0, 500], [0, 300.0, 400], [0, 0, 1]])
    for attitude in attitudes:
        picture_from_wall = camera_matrix(LENS) @ attitude.inv().as_matrix() @ np.linalg.inv(wall_camera)
        grey = cv2.warpPerspective(wall, picture_from_wall, (LENS.width, LENS.height))
        yield np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of one camera whose video says nothing of when it began."""
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
    pose: {tum: drone1.tum}
    intrinsics: {width: 320, height: 240, fx: 300, fy: 300, cx: 159.5, cy: 119.5}
""",
        encoding="utf-8",
    )
    return folder


def test_flow_of_a_rotation_gives_it_back() -> None:
    rotation = np.radians([0.8, -1.5, 2.0])
    begin = np.random.default_rng(2).uniform(-0.6, 0.6, (100, 2))
    rays = np.column_stack([begin, np.ones(100)]) @ Rotation.from_rotvec(rotation).as_matrix()  # R' x
    end = rays[:, :2] / rays[:, 2:]
    # The flow's formula is that of small angles, at the middle of the path: right to the third order of
    # 0.046 rad, 1e-4 rad at most.
    np.testing.assert_allclose(rotation_of_flow(begin, end), rotation, atol=1e-4)
    end[:30] += [0.2, -0.1]  # somebody walks through the picture
    np.testing.assert_allclose(rotation_of_flow(begin, end), rotation, atol=3e-4)


def test_turning_of_a_video_is_that_of_its_camera(filmed: Path) -> None:
    turned = turning_of_pictures(filmed / "drone1.mp4", LENS, 40)
    attitudes = turning(np.arange(40) / FPS + BEGINS_S)
    error_deg = np.degrees(turned - (attitudes[:-1].inv() * attitudes[1:]).as_rotvec())
    # A corner is followed to a tenth of a pixel, 0.02 deg; that there are dozens pays for the axis of sight,
    # about which they show the less (they lie 0.4 focal lengths from it). A key frame of the codec moves all
    # of them together once a second: hence the mean, and thrice as much for one picture.
    assert np.sqrt((error_deg**2).mean(axis=0)).max() < 0.02
    assert np.abs(error_deg).max() < 3 * 0.02


def test_a_video_begins_when_its_pictures_turn_as_the_poses_do(filmed: Path) -> None:
    succeeds("ingest", filmed / "flight.yaml")
    described = json.loads((filmed / "flight.session" / "session.json").read_text(encoding="utf-8"))
    camera = described["cameras"]["drone1"]
    error_s = camera["frames"]["first_t_ns"] / 1e9 - START_S - BEGINS_S
    sigma_s = camera["clock"]["sigma_s"]
    # 0.02 deg a picture, 0.6 deg/s, against turning that changes by some 30 deg/s^2 says when to 20 ms; 120
    # pictures to 2 ms.
    assert 1e-5 < sigma_s < 2e-3
    assert abs(error_s) < 4 * sigma_s + 1e-3  # the same test of formulas alone allows 1 ms
    assert any("by the turning of its pictures" in line for line in described["warnings"])


def test_a_drone_that_hardly_turns_is_refused(filmed: Path, tmp_path: Path) -> None:
    manifest = (filmed / "flight.yaml").read_text(encoding="utf-8").replace("drone1.", f"{filmed}/drone1.")
    still = tmp_path / "still.tum"
    rows = (filmed / "drone1.tum").read_text(encoding="utf-8").splitlines()
    stamps = [row.split()[0] for row in rows if not row.startswith("#")]
    still.write_text("".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in stamps), encoding="utf-8")
    path = tmp_path / "flight.yaml"
    path.write_text(manifest.replace(f"{filmed}/drone1.tum", str(still)), encoding="utf-8")
    line = refused("ingest", path)
    assert "do not say when the video began: they do not turn as the poses do" in line
    path.write_text(manifest.replace("{start_from: motion}", "{start: 3, start_from: motion}"))
    assert "leave one of them out" in refused("ingest", path)
