"""COLMAP models, text and binary, against pycolmap's own writing and projection."""

import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from pipelines.formats.calibrations import colmap
from pipelines.geometry.cameras import project
from pipelines.session.errors import DataError
from pipelines.session.registries import CalibrationFormat
from tests.raising import refused
from tests.real_data import real_data

READER: CalibrationFormat = colmap.FORMAT
PARAMETERS = {
    "SIMPLE_PINHOLE": [700.0, 320, 240],
    "PINHOLE": [700.0, 710, 320, 240],
    "SIMPLE_RADIAL": [700.0, 320, 240, -0.1],
    "RADIAL": [700.0, 320, 240, -0.1, 0.02],
    "OPENCV": [700.0, 710, 320, 240, -0.1, 0.02, 0.001, -0.002],
    "FULL_OPENCV": [700.0, 710, 320, 240, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003],
    "OPENCV_FISHEYE": [700.0, 710, 320, 240, 0.02, -0.01, 0.003, 0.001],
    "SIMPLE_RADIAL_FISHEYE": [700.0, 320, 240, 0.02],
    "RADIAL_FISHEYE": [700.0, 320, 240, 0.02, -0.01],
}
POINTS = np.array([[0.1, -0.2, 2.0], [0.6, 0.4, 2.0], [-0.5, 0.3, 1.5]])


def model(cameras: dict[int, tuple[str, list[float]]], images: dict[str, int]) -> pycolmap.Reconstruction:
    """Make a reconstruction with pycolmap: camera id to model, image name to camera id, poses by rank."""
    reconstruction = pycolmap.Reconstruction()
    for camera, (name, parameters) in cameras.items():
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(model=name, width=640, height=480, params=parameters, camera_id=camera)
        )
    for index, (name, camera) in enumerate(images.items(), start=1):
        image = pycolmap.Image(name=name, camera_id=camera, image_id=index)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.5, 2.5]))] * (index % 3))
        reconstruction.add_image_with_trivial_frame(image, pose(index))
    return reconstruction


def pose(index: int) -> pycolmap.Rigid3d:
    rotation = Rotation.from_rotvec([0.3 * index, -0.2, 0.1])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.as_quat()), np.array([1.0, 2.0, 3.0 + index]))


@pytest.fixture(params=["text", "binary"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    every = dict(enumerate(PARAMETERS.items(), start=1))
    reconstruction = model(every, {f"{name}_a.jpg": k for k, (name, _) in every.items()})
    getattr(reconstruction, f"write_{request.param}")(str(tmp_path))
    return tmp_path


def test_every_model_and_pose_as_pycolmap_has_it(folder: Path) -> None:
    assert READER.recognises(folder)
    cameras = READER.read_calibration(folder)
    assert sorted(cameras) == sorted(f"{name}_a" for name in PARAMETERS)
    for index, (name, parameters) in enumerate(PARAMETERS.items(), start=1):
        camera = cameras[f"{name}_a"]
        theirs = pycolmap.Camera(model=name, width=640, height=480, params=parameters)
        assert camera.intrinsics is not None
        # Both compute in float64. COLMAP counts from the corner of the first pixel, we from its centre.
        expected = np.array([theirs.img_from_cam(point) for point in POINTS]) - 0.5
        np.testing.assert_allclose(project(POINTS, camera.intrinsics), expected, rtol=0, atol=1e-9)
        world_from_camera = pose(index).inverse()
        assert camera.position is not None
        assert camera.quaternion_xyzw is not None
        np.testing.assert_allclose(camera.position, world_from_camera.translation, atol=1e-12)
        np.testing.assert_allclose(
            Rotation.from_quat(camera.quaternion_xyzw).as_matrix(),
            world_from_camera.rotation.matrix(),
            atol=1e-12,
        )


def test_a_real_model() -> None:
    path = real_data("calib/colmap_maupertuis_txt")
    assert READER.recognises(path)
    cameras = READER.read_calibration(path)
    assert list(cameras) == ["00", "01", "02", "03"]
    theirs = pycolmap.Reconstruction(str(path))
    for image in theirs.images.values():
        camera = cameras[Path(image.name).stem]
        assert camera.position is not None
        # The file's six digits leave a quaternion's norm off by up to 1e-6. We normalise, pycolmap does
        # not: centres some ten metres from the origin differ by up to 2e-5 m.
        np.testing.assert_allclose(camera.position, image.projection_center(), atol=2e-5)
    lens = cameras["00"].intrinsics
    assert lens is not None
    assert (lens.width, lens.height, lens.fx, lens.cx, lens.model) == (1919, 1079, 1847.53, 959.0, "none")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_binary_model_that_is_cut_off_or_states_wrong_counts_is_refused(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(colmap, "READING_TIMEOUT_S", 2.0)  # pycolmap reads on for ever in some of them
    model({1: ("PINHOLE", PARAMETERS["PINHOLE"])}, {"a.jpg": 1, "b.jpg": 1}).write_binary(str(tmp_path))
    whole = (tmp_path / name).read_bytes()
    for content in (whole[: len(whole) - 5], struct.pack("<Q", 2**62) + whole[8:]):
        (tmp_path / name).write_bytes(content)
        with refused("damaged", tmp_path):
            READER.read_calibration(tmp_path)
    assert capfd.readouterr() == ("", "")


CAMERAS = "# comment\n1 PINHOLE 640 480 700 710 320 240\n"
IMAGES = "# comment\n1 1 0 0 0 0 0 5 1 a.jpg\n\n2 1 0 0 0 0 0 6 1 b.jpg\n\n"


def write(folder: Path, cameras: str = CAMERAS, images: str = IMAGES) -> Path:
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_text(images)
    (folder / "points3D.txt").write_text("")
    return folder


@pytest.mark.parametrize(
    ("cameras", "images"),
    [
        (CAMERAS, ""),
        (CAMERAS, IMAGES.replace("\n\n", "\n")),  # without the lines of points
        (CAMERAS, IMAGES.replace(" 1 a.jpg", " 9 a.jpg")),
        (CAMERAS, IMAGES.replace("1 1 0 0 0 0 0 5", "1 0 0 0 0 0 0 5")),
        (CAMERAS, IMAGES.replace("a.jpg", "/")),
        (CAMERAS, IMAGES.replace("b.jpg", "a.jpg")),
        (CAMERAS.replace(" 320 240", " 320"), IMAGES),
        (CAMERAS.replace("700", "-700"), IMAGES),
    ],
)
def test_faulty_text_is_refused(tmp_path: Path, cameras: str, images: str) -> None:
    with pytest.raises(DataError):
        READER.read_calibration(write(tmp_path, cameras, images))
