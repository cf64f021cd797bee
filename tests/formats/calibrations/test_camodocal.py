"""Calibrations of camodocal, as VINS has them: compared with OpenCV, and with Mei's formula."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.geometry.arrays import Intrinsics
from pipelines.geometry.cameras import project
from pipelines.session.recognition import recognise
from pipelines.session.registries import FORMATS, CalibrationFormat
from tests.raising import refused

# Rays up to 45 degrees from the optical axis.
POINTS = np.array([[x, y, 2.0] for x in (-1.4, -0.3, 0.2, 1.5) for y in (-1.1, 0.1, 1.3)])
HEAD = "%YAML:1.0\n---\nmodel_type: {}\ncamera_name: left\nimage_width: 752\nimage_height: 480\n"
PINHOLE = "distortion_parameters:\n   k1: -0.29\n   k2: 0.08\n   p1: 0.0004\n   p2: 0.0002\n"
PINHOLE += "projection_parameters:\n   fx: 461.6\n   fy: 460.3\n   cx: 363.0\n   cy: 248.1\n"
KANNALA = "projection_parameters:\n   k2: -0.01\n   k3: 0.02\n   k4: -0.005\n   k5: 0.001\n"
KANNALA += "   mu: 380.0\n   mv: 379.0\n   u0: 375.5\n   v0: 240.25\n"
# Of the order of VINS-Mono's own configuration of a fisheye.
MEI = {"xi": 1.99, "k1": -0.04, "k2": 0.15, "p1": 0.0002, "p2": -0.0005, "gamma": 670.0}


def lens_of(folder: Path, model: str, text: str) -> tuple[Intrinsics, str]:
    path = folder / "camera.yaml"
    path.write_text(HEAD.format(model) + text)
    assert [each.name for each in FORMATS.all() if each.recognises(path)] == ["camodocal"]
    cameras = recognise(path, CalibrationFormat, "calibration").read_calibration(path)
    lens = cameras["left"].intrinsics
    assert lens is not None
    assert (lens.width, lens.height) == (752, 480)
    return lens, cameras["left"].note


def mei(p2: float = MEI["p2"]) -> str:
    one = f"mirror_parameters:\n   xi: {MEI['xi']}\ndistortion_parameters:\n   k1: {MEI['k1']}\n"
    one += f"   k2: {MEI['k2']}\n   p1: {MEI['p1']}\n   p2: {p2}\nprojection_parameters:\n"
    return one + f"   gamma1: {MEI['gamma']}\n   gamma2: {MEI['gamma']}\n   u0: 370.0\n   v0: 241.0\n"


@pytest.mark.parametrize("more", [[], [0.03, 0.1, -0.05, 0.01]])
def test_a_pinhole_projects_as_opencv_does(tmp_path: Path, more: list[float]) -> None:
    full = "".join(f"   k{number}: {value}\n" for number, value in enumerate(more, start=3))
    text = PINHOLE.replace("distortion_parameters:\n", f"distortion_parameters:\n{full}")
    lens, note = lens_of(tmp_path, "PINHOLE_FULL" if more else "PINHOLE", text)
    matrix = np.array([[461.6, 0, 363.0], [0, 460.3, 248.1], [0, 0, 1]])
    near = POINTS * [0.4, 0.4, 1]
    expected, _ = cv2.projectPoints(
        near, np.zeros(3), np.zeros(3), matrix, np.array([-0.29, 0.08, 4e-4, 2e-4, *more])
    )
    np.testing.assert_allclose(project(near, lens), expected[:, 0], atol=1e-9)
    assert not note


def test_kannala_brandt_projects_as_opencvs_fisheye(tmp_path: Path) -> None:
    lens, note = lens_of(tmp_path, "KANNALA_BRANDT", KANNALA)
    matrix = np.array([[380.0, 0, 375.5], [0, 379.0, 240.25], [0, 0, 1]])
    coefficients = np.array([-0.01, 0.02, -0.005, 0.001])
    expected, _ = cv2.fisheye.projectPoints(POINTS[None], np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(project(POINTS, lens), expected[0], atol=1e-9)
    assert not note


def test_mei_is_off_by_no_more_than_its_note_says(tmp_path: Path) -> None:
    lens, note = lens_of(tmp_path, "MEI", mei())
    unit = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    x, y = (unit[:, :2] / (unit[:, 2:] + MEI["xi"])).T
    r2 = x**2 + y**2
    radial = 1 + MEI["k1"] * r2 + MEI["k2"] * r2**2
    u = x * radial + 2 * MEI["p1"] * x * y + MEI["p2"] * (r2 + 2 * x**2)
    v = y * radial + MEI["p1"] * (r2 + 2 * y**2) + 2 * MEI["p2"] * x * y
    expected = MEI["gamma"] * np.stack([u, v], axis=1) + [370.0, 241.0]
    said_px = float(note.split()[-2])
    assert 0 < said_px < 1
    assert np.linalg.norm(project(POINTS, lens) - expected, axis=1).max() <= said_px + 0.01


@pytest.mark.parametrize(
    ("model", "text"), [("SCARAMUZZA", "projection_parameters:\n   a: 1\n"), ("MEI", mei(0.02))]
)
def test_a_lens_that_none_of_ours_fits_is_refused(tmp_path: Path, model: str, text: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(HEAD.format(model) + text)
    reader = recognise(path, CalibrationFormat, "calibration")
    with refused("data" if model == "SCARAMUZZA" else "unsupported", path, model):
        reader.read_calibration(path)
