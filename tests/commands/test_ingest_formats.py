"""Formats that need the other parts of a flight: a size from the pictures, a world from the first camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from pipelines.geometry.cameras import camera_matrix
from pipelines.session.description import read_description
from tests.commands.runner import refused, succeeds
from tests.synthetic.flights import LENS, write_flight

SIZE = [LENS.width, LENS.height]


def _store(path: Path, matrix: np.ndarray) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", np.array([LENS.distortion or [0.0] * 5]))
    storage.release()


def test_a_calibration_without_a_size_takes_that_of_the_pictures(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, clean=True, seconds=0.2)
    camera = flight.settings["cameras"]["drone1"]
    _store(tmp_path / "camera.yaml", camera_matrix(LENS))
    camera["intrinsics"] = {"file": "camera.yaml"}
    flight.save()
    refused("ingest", flight.manifest)  # neither the calibration nor the keypoints have a size
    camera["keypoints"]["image_size"] = SIZE
    flight.save()
    succeeds("ingest", flight.manifest)
    session = flight.manifest.with_suffix(".session")
    lenses = [read_description(session).cameras[name].intrinsics for name in ("drone1", "drone2")]
    assert (lenses[0].width, lenses[0].height, lenses[0].fx) == (*SIZE, LENS.fx)
    assert lenses[1].width == lenses[0].width

    half = np.diag([0.5, 0.5, 1.0]) @ camera_matrix(LENS)  # of pictures half as large
    _store(tmp_path / "camera.yaml", half)
    assert f"{SIZE[0]} x {SIZE[1]}" in refused("ingest", flight.manifest, "--overwrite")


def test_a_kitti_trajectory_gives_the_poses_of_its_camera(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, clean=True, seconds=0.2)
    logged = np.loadtxt(tmp_path / "drone1.tum")
    kitti_from_world = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # right, down, ahead of x, y, z up
    turned = kitti_from_world @ Rotation.from_quat(logged[:, 4:]).as_matrix()
    rows = np.concatenate([turned, (logged[:, 1:4] @ kitti_from_world.T)[:, :, None]], axis=2)
    np.savetxt(tmp_path / "00.txt", rows.reshape(-1, 12), fmt="%.12e")
    stamps = [
        line.split()[0] for line in (tmp_path / "drone1.tum").read_text().splitlines() if line[0] != "#"
    ]
    (tmp_path / "times.txt").write_text("\n".join(stamps))
    succeeds("ingest", flight.manifest, "--output", tmp_path / "a.session")
    flight.settings["cameras"]["drone1"]["pose"] = {"file": "00.txt", "of": "camera"}
    flight.save()
    succeeds("ingest", flight.manifest, "--output", tmp_path / "b.session")
    poses = [pd.read_parquet(tmp_path / f"{name}.session/cameras/drone1/poses.parquet") for name in "ab"]
    assert poses[0]["t_ns"].tolist() == poses[1]["t_ns"].tolist()
    np.testing.assert_allclose(poses[0][["x", "y", "z"]], poses[1][["x", "y", "z"]], rtol=0, atol=1e-9)
    both = [Rotation.from_quat(each[["qx", "qy", "qz", "qw"]].to_numpy()) for each in poses]
    assert (both[0] * both[1].inv()).magnitude().max() < 1e-9
