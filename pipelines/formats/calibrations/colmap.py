"""COLMAP models: a folder with cameras and images as .txt or .bin (Schoenberger, colmap.github.io/format).

Only cameras and images are read: points, rigs and frames are not needed, and the images of every
version from 3.0 to 4 carry their own pose (camera_from_world).

COLMAP puts (0, 0) at the corner of the top left pixel, we at its centre: cx and cy lose half a pixel.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from pipelines.formats.calibrations.camera_matrices import build_intrinsics, describe_cameras, invert_pose
from pipelines.formats.common.files import read_text
from pipelines.geometry.cameras import DistortionModel, Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera
from pipelines.session.storage import code_of

_BINARY_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
"""Names of camera models; the index is the number that binary files use (colmap/sensor/models.h)."""


@dataclass(frozen=True)
class _Model:
    """Layout of a camera model's parameters: one or two focal lengths, cx, cy, then coefficients."""

    focals: int
    distortion: DistortionModel
    coefficients: int
    padded: int  # coefficients of our model; the missing ones are zero

    @property
    def parameters(self) -> int:
        return self.focals + 2 + self.coefficients


_CENTRE_PX = 0.5  # of the top left pixel, in COLMAP's pixels

_MODELS = {
    "SIMPLE_PINHOLE": _Model(1, "none", 0, 0),
    "PINHOLE": _Model(2, "none", 0, 0),
    "SIMPLE_RADIAL": _Model(1, "radtan", 1, 4),
    "RADIAL": _Model(1, "radtan", 2, 4),
    "OPENCV": _Model(2, "radtan", 4, 4),
    "FULL_OPENCV": _Model(2, "radtan", 8, 8),
    "OPENCV_FISHEYE": _Model(2, "fisheye", 4, 4),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, "fisheye", 1, 4),
    "RADIAL_FISHEYE": _Model(1, "fisheye", 2, 4),
}


@dataclass(frozen=True)
class _Image:
    name: str
    camera: int
    wxyz_xyz: tuple[float, ...]  # camera_from_world as the file has it


_MOST_IMAGES = 50_000


class ColmapModel:
    """Reader of COLMAP models: one camera for each image, named after it without folder and suffix.

    If two images would get one name (cam1/000.jpg, cam2/000.jpg), all images of that name keep
    their folder: "cam1/000", "cam2/000".
    """

    name = "colmap"
    title = "COLMAP model"
    suffixes: tuple[str, ...] = ("",)

    def recognises(self, path: Path) -> bool:
        """Return True if a folder holds cameras and images, both as text or both binary."""
        return _suffix_of(path) is not None

    def describe(self, path: Path) -> dict[str, object]:
        """Describe every image's camera."""
        return describe_cameras(self.read_calibration(path))

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read the camera and pose of every image; binary files before text, as COLMAP does.

        Raises:
            DataError: files are missing, truncated or malformed, a camera model is unsupported, or no image.
        """
        suffix = _suffix_of(path)
        if suffix is None:
            raise DataError(
                path, "has no cameras and images, .bin or .txt", "name the folder with the COLMAP model"
            )
        camera_file, image_file = path / f"cameras{suffix}", path / f"images{suffix}"
        if suffix == ".bin":
            cameras, images = dict(_binary_cameras(camera_file)), list(_binary_images(image_file))
        else:
            cameras, images = dict(_text_cameras(camera_file)), list(_text_images(image_file))
        if not images:
            raise DataError(image_file, "holds no image with a pose", "COLMAP registered none; map again")
        named = sorted(_named(image_file, images), key=lambda pair: pair[0])
        return {name: _posed(image_file, image, cameras) for name, image in named}


def _suffix_of(path: Path) -> str | None:
    """Return the suffix of the form that a folder holds, .bin before .txt; None if it holds neither."""
    return next(
        (s for s in (".bin", ".txt") if all((path / (n + s)).is_file() for n in ("cameras", "images"))), None
    )


def _named(source: Path, images: list[_Image]) -> Iterator[tuple[str, _Image]]:
    paths = [PurePosixPath(image.name.replace("\\", "/")) for image in images]
    if not all(path.name for path in paths):
        raise DataError(source, "holds an image without a name", "export the model again")
    paths = [path.with_suffix("") for path in paths]
    shared = Counter(path.name for path in paths)
    names = [path.name if shared[path.name] == 1 else str(path) for path in paths]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise DataError(source, f"two images are called {twice[0]}", "rename one", code="stated-twice")
    return zip(names, images, strict=True)


def _posed(source: Path, image: _Image, cameras: dict[int, Intrinsics]) -> CalibratedCamera:
    if image.camera not in cameras:
        raise DataError(
            source, f"image {image.name} uses camera {image.camera}, which does not exist", code="damaged"
        )
    w, x, y, z, *translation = image.wxyz_xyz
    pose = invert_pose(source, image.name, np.array([x, y, z, w]), np.array(translation))
    return CalibratedCamera(cameras[image.camera], *pose)


def _intrinsics(
    source: Path, camera: int, model: str, size: tuple[float, float], parameters: tuple[float, ...]
) -> Intrinsics:
    layout = _MODELS[model]
    focals, rest = parameters[: layout.focals], parameters[layout.focals :]
    cx, cy = rest[0] - _CENTRE_PX, rest[1] - _CENTRE_PX
    matrix = np.array([[focals[0], 0, cx], [0, focals[-1], cy], [0, 0, 1]])
    coefficients = rest[2:] + (0.0,) * (layout.padded - layout.coefficients)
    return build_intrinsics(source, str(camera), size, matrix, layout.distortion, coefficients)


def _layout(source: Path, camera: int, model: str) -> _Model:
    if model not in _MODELS:
        raise DataError(
            source,
            f"camera {camera} has the model {model}, which is not supported",
            f"use one of {', '.join(_MODELS)}",
        )
    return _MODELS[model]


def _text_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield every line with its number, as cells; skip comments, but not blank lines."""
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        if not line.lstrip().startswith("#"):
            yield number, line.split()


def _text_cameras(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    for number, cells in _text_lines(path):
        if not cells:
            continue
        try:
            camera, model, (width, height) = int(cells[0]), cells[1], (float(cells[2]), float(cells[3]))
            parameters = tuple(float(cell) for cell in cells[4:])
        except (ValueError, IndexError) as error:
            raise _bad_line(path, number, "a camera: id, model, width, height, parameters") from error
        expected = _layout(path, camera, model).parameters
        if len(parameters) != expected:
            raise _bad_line(path, number, f"a {model} with {expected} parameters (it has {len(parameters)})")
        yield camera, _intrinsics(path, camera, model, (width, height), parameters)


def _text_images(path: Path) -> Iterator[_Image]:
    lines = _text_lines(path)
    for number, cells in lines:
        if not cells:
            continue
        try:
            image = _Image(" ".join(cells[9:]), int(cells[8]), tuple(float(cell) for cell in cells[1:8]))
        except (ValueError, IndexError) as error:
            raise _bad_line(path, number, "an image: id, qw qx qy qz, tx ty tz, camera, name") from error
        yield image
        # The line below holds the image's points. It exists even if it is blank.
        points_number, points = next(lines, (number + 1, []))
        if len(points) % 3:
            raise _bad_line(path, points_number, f"the points of image {image.name} (threes of numbers)")


def _bad_line(path: Path, number: int, expected: str) -> DataError:
    return DataError(path, f"line {number} is not {expected}", "export the model again")


class _Bytes:
    """Binary file, read in order. No memory is allocated by the counts in it, because they may be wrong."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._content = path.read_bytes()
        except OSError as error:
            raise DataError(
                path, f"cannot be read ({error.strerror})", "check its permissions", code=code_of(error)
            ) from error
        self._at = 0

    def take(self, layout: str) -> tuple[float, ...]:
        """Return the next numbers, little-endian."""
        start = self._at
        self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self._content, start)

    def integer(self, layout: str) -> int:
        """Return the next integer."""
        return int(self.take(layout)[0])

    def name(self) -> str:
        """Return the next text, which ends with a zero byte."""
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise self._truncated()
        text = self._content[self._at : end].decode("utf-8", errors="replace")
        self._at = end + 1
        return text

    def skip(self, size: int) -> None:
        """Skip `size` bytes."""
        self._at += size
        if self._at > len(self._content):
            raise self._truncated()

    def _truncated(self) -> DataError:
        return DataError(self.path, f"ends early ({len(self._content)} bytes)", "copy or export it again")


def _binary_cameras(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    data = _Bytes(path)
    for _ in range(data.integer("Q")):
        camera, model_id = data.integer("I"), data.integer("i")
        width, height = data.take("QQ")
        known = 0 <= model_id < len(_BINARY_MODELS)
        model = _BINARY_MODELS[model_id] if known else f"number {model_id}"
        parameters = data.take(f"{_layout(path, camera, model).parameters}d")
        yield camera, _intrinsics(path, camera, model, (width, height), parameters)


def _binary_images(path: Path) -> Iterator[_Image]:
    data = _Bytes(path)
    for number in range(data.integer("Q")):
        if number == _MOST_IMAGES:
            raise DataError(path, f"holds more than {_MOST_IMAGES} images", "export those of this flight")
        data.skip(4)  # the image's number
        pose, camera, name = data.take("7d"), data.integer("I"), data.name()
        data.skip(24 * data.integer("Q"))  # its points: x, y and the 3D point's number
        yield _Image(name, camera, pose)


FORMAT = ColmapModel()
