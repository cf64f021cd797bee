"""Flights written for the command tests: reading back a clean one gives the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.calibrations.rigs import ANIPOSE
from pipelines.formats.keypoint_files.result_files import ALPHAPOSE, COCO, OPENPOSE
from pipelines.formats.poses.trajectory_files import POSE_CSV, TUM
from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import undistort
from pipelines.geometry.poses import interpolate_poses, rotate
from pipelines.session.manifest import read_flight
from pipelines.session.records import Detections, Trajectory
from tests.synthetic.flights import LENS, SyntheticFlight, write_flight

READ_KEYPOINTS: dict[str, Callable[..., Detections]] = {
    "alphapose": ALPHAPOSE.read_keypoints,
    "coco": COCO.read_keypoints,
    "openpose": OPENPOSE.read_keypoints,
}
READ_POSES: dict[str, Callable[[Path], Trajectory]] = {
    "tum": TUM.read_trajectory,
    "csv": POSE_CSV.read_trajectory,
}

# Pixels are rounded by up to 0.0005: 0.007 mm at 10.5 m and 762 px, at worst twice that where two rays
# cross at 90 degrees; interpolated poses add 0.003 mm, rounded ones 0.0005 mm.
TOLERANCE_M = 2.5e-5


def closest_points(position: Float, quaternion: Float, pixels: Float) -> Float:
    """Compute the least-squares points [T, J, 3] of the viewing rays.

    Inputs are positions [N, T, 3], quaternions [N, T, 4] and pixels [N, T, J, 2].
    """
    rays = np.concatenate([undistort(pixels, LENS), np.ones((*pixels.shape[:-1], 1))], axis=-1)
    rays = rotate(quaternion[:, :, None], rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    across = np.eye(3) - rays[..., None] * rays[..., None, :]
    towards = (across @ position[:, :, None, :, None]).sum(0)
    return np.linalg.solve(across.sum(0), towards)[..., 0]


def keypoints(flight: SyntheticFlight, form: str) -> Float:
    paths = [
        flight.manifest.parent / (name if form == "openpose" else f"{name}.json") for name in flight.cameras
    ]
    return np.stack([READ_KEYPOINTS[form](p, skeleton="coco17", first_frame=0).xy for p in paths])


@pytest.mark.parametrize(
    ("keypoint_format", "pose_format"), [("alphapose", "tum"), ("coco", "csv"), ("openpose", "tum")]
)
def test_a_clean_moving_flight_is_exact(tmp_path: Path, keypoint_format: str, pose_format: str) -> None:
    flight = write_flight(
        tmp_path, cameras=2, clean=True, keypoint_format=keypoint_format, pose_format=pose_format
    )
    read_flight(flight.manifest)
    logs = [READ_POSES[pose_format](tmp_path / f"{name}.{pose_format}") for name in flight.cameras]
    poses = [
        interpolate_poses(
            log.t_ns,
            log.position,
            log.quaternion_xyzw,
            flight.t_ns,
            max_gap_ns=10**8,
            max_extrapolation_ns=0,
        )
        for log in logs
    ]
    position, quaternion = (np.stack(rows) for rows in zip(*poses, strict=True))
    found = closest_points(position, quaternion, keypoints(flight, keypoint_format))
    assert np.abs(found - flight.position).max() < TOLERANCE_M


def test_a_clean_static_flight_is_exact(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, clean=True, static=True, fps=10)
    read_flight(flight.manifest)
    calibration = ANIPOSE.read_calibration(tmp_path / "calibration.toml")
    assert list(calibration) == flight.cameras
    assert calibration["drone1"].intrinsics == LENS
    frames = len(flight.t_ns)
    position, quaternion = (
        np.stack([np.tile(getattr(camera, part), (frames, 1)) for camera in calibration.values()])
        for part in ("position", "quaternion_xyzw")
    )
    found = closest_points(position, quaternion, keypoints(flight, "alphapose"))
    assert np.abs(found - flight.position).max() < TOLERANCE_M


def test_noise_reaches_the_files_and_the_manifest(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, bystander=True)
    manifest = read_flight(flight.manifest)
    noise = manifest.cameras["drone1"].pose_noise
    assert noise is not None
    assert noise["bias"]["position_m"] == pytest.approx(0.05)
    seen = ALPHAPOSE.read_keypoints(tmp_path / "drone1.json", skeleton=None, first_frame=0)
    assert set(seen.person.tolist()) == {1, 2}
    error = seen.xy[seen.person == 1] - flight.pixels[0]
    assert 1.0 < np.nanmedian(np.linalg.norm(error, axis=-1)) < 4.0  # 2 px on each axis: 2.35
    assert np.isnan(error).any()


def test_a_changed_manifest_is_saved(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, seconds=0.2)
    flight.settings["name"] = "Another"
    flight.save()
    assert read_flight(flight.manifest).name == "Another"
