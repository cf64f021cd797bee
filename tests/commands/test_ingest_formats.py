"""Formats that need the other parts of a flight: a size from the pictures, a world from the first camera."""

from pathlib import Path

import cv2
import numpy as np

from pipelines.geometry.cameras import camera_matrix
from pipelines.session.description import read_description
from tests.commands.runner import ingested, refused
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
    session = ingested(flight)
    lenses = [read_description(session).cameras[name].intrinsics for name in ("drone1", "drone2")]
    assert (lenses[0].width, lenses[0].height, lenses[0].fx) == (*SIZE, LENS.fx)
    assert lenses[1].width == lenses[0].width

    half = np.diag([0.5, 0.5, 1.0]) @ camera_matrix(LENS)  # of pictures half as large
    _store(tmp_path / "camera.yaml", half)
    assert f"{SIZE[0]} x {SIZE[1]}" in refused("ingest", flight.manifest, "--overwrite")
