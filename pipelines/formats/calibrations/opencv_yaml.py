"""Calibrations in OpenCV's FileStorage: those of its own samples, and the settings of ORB-SLAM 1 to 3."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import accumulate
from pathlib import Path

import numpy as np

from pipelines.formats.calibrations.camera_matrices import (
    describe_cameras,
    intrinsics,
    invert_matrix,
    invert_rodrigues,
    unstated_size,
)
from pipelines.formats.common.files import read_head, read_text
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera

# OpenCV's own samples spell their keys in more than one way.
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")
_WIDTH = ("image_width", "image_Width", "width")
_HEIGHT = ("image_height", "image_Height", "height")
# A calibration has far fewer characters, and OpenCV's parser is slow.
_LARGEST = 1 << 20
# OpenCV's parser calls itself for each level, until the process ends.
_DEEPEST = 200
# A larger matrix is a mistake of its size and must never be allocated.
_MOST_CELLS = 64


class OpencvStorage:
    """Reader of the keys camera_matrix, distortion_coefficients, image_width, image_height.

    Without a size, the pictures decide. Optional: camera_name (else "camera"), `fisheye_model: 1` or
    `distortion_model: equidistant`, and the pose camera_from_world as R (3 x 3) or rvec with T or tvec, in
    metres.
    """

    name = "opencv"
    title = "OpenCV calibration"
    suffixes: tuple[str, ...] = (".yaml", ".yml", ".xml")

    def recognises(self, path: Path) -> bool:
        """Return True if FileStorage wrote the file and it names a camera matrix."""
        head = read_head(path, self.suffixes)
        stored = "!!opencv-matrix" in head or "<opencv_storage>" in head
        return stored and re.search(rf"(?m)^\s*<?(?:{'|'.join(_MATRIX)})\b", head) is not None

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the camera."""
        return describe_cameras(self.read_calibration(path))

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read the one camera."""
        storage = Storage(path)
        name = storage.text("camera_name") or "camera"
        size = storage.vector("image_size") or [storage.number(_WIDTH), storage.number(_HEIGHT)]
        matrix, distortion = storage.matrix(*_MATRIX), storage.matrix(*_DISTORTION)
        if matrix is None or distortion is None:
            raise DataError(path, "has no camera_matrix or no distortion_coefficients", "add them")
        stated = any(size)
        size = size if stated else [*unstated_size(matrix)]
        model = storage.text("distortion_model").lower()
        fisheye = bool(storage.number(("fisheye_model",))) or model in {"equidistant", "fisheye"}
        lens = intrinsics(
            path, name, size=size, matrix=matrix, distortion=distortion.ravel().tolist(), fisheye=fisheye
        )
        return {name: _with_pose(path, name, storage, CalibratedCamera(lens, size_stated=stated))}


class EasyMocap:
    """Reader of EasyMocap's intri.yml with the extri.yml beside it: K_, dist_, Rot_ or R_, T_ by camera."""

    name = "easymocap"
    title = "EasyMocap calibration"
    suffixes: tuple[str, ...] = (".yml", ".yaml")

    def recognises(self, path: Path) -> bool:
        """Return True if FileStorage wrote names of cameras and a matrix for each."""
        head = read_head(path, self.suffixes)
        return "!!opencv-matrix" in head and bool(re.search(r"(?m)^names:(?s:.*)^(?:K|R|Rot)_\w+:", head))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe every camera."""
        return describe_cameras(self.read_calibration(path))

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read every camera; poses are camera_from_world, in metres."""
        ways = [path.with_name(path.name.replace(*pair)) for pair in (("extri", "intri"), ("intri", "extri"))]
        if not ways[0].is_file():
            raise DataError(ways[0], "is not there", "put it beside extri.yml", code="no-such-file")
        lenses = Storage(ways[0])
        places = Storage(ways[1]) if ways[1].is_file() and ways[1] != ways[0] else None
        found = {}
        for name in lenses.texts("names"):
            matrix, distortion = lenses.matrix(f"K_{name}"), lenses.matrix(f"dist_{name}")
            if matrix is None or distortion is None:
                raise DataError(ways[0], f"has no K_{name} or no dist_{name}", "calibrate again")
            size = [lenses.number((f"{side}_{name}",)) for side in "WH"]
            lens = intrinsics(
                ways[0], name, size=size if any(size) else [*unstated_size(matrix)], matrix=matrix,
                distortion=distortion.ravel().tolist(), fisheye=False,
            )  # fmt: skip
            camera = CalibratedCamera(lens, size_stated=any(size))
            keys = (f"Rot_{name}", f"R_{name}"), (f"T_{name}",)
            found[name] = _with_pose(ways[1], name, places, camera, keys) if places else camera
        if not found:
            raise DataError(path, "names no camera", "calibrate again", code="empty")
        return found


EASYMOCAP = EasyMocap()


def _with_pose(
    path: Path,
    name: str,
    storage: Storage,
    camera: CalibratedCamera,
    keys: tuple[tuple[str, ...], tuple[str, ...]] = (("R", "rvec"), ("T", "tvec")),
) -> CalibratedCamera:
    rotation, translation = (storage.matrix(*each) for each in keys)
    if rotation is None and translation is None:
        return camera
    if rotation is None or translation is None:
        raise DataError(
            path, "has a rotation or a translation, but not both", "give R and T, or rvec and tvec"
        )
    if rotation.size == 3:
        pose = invert_rodrigues(path, name, rotation.ravel(), translation.ravel())
    else:
        pose = invert_matrix(path, name, rotation, translation.ravel())
    return replace(camera, position=pose[0], quaternion_xyzw=pose[1])


def _depth(text: str) -> int:
    """Return a bound of the levels to which a file's elements, brackets or indented blocks are nested."""
    tags = re.findall(r"<[^!?][^<>]*", text) if text.lstrip().startswith("<") else []
    steps = [-1 if tag[1] == "/" else 0 if tag.endswith("/") else 1 for tag in tags]
    brackets = [1 if sign in "[{" else -1 for sign in re.findall(r"[][{}]", text)]
    indented = max(map(len, re.findall(r"(?m)^[ \t?:-]+", text)), default=0)
    return max(indented, *accumulate(steps, initial=0), *accumulate(brackets, initial=0))


class Storage:
    """Checked access to the top level of a FileStorage."""

    def __init__(self, path: Path) -> None:
        import cv2

        self._path = path
        self._cv2 = cv2
        text = read_text(path)
        if len(text) > _LARGEST or _depth(text) > _DEEPEST:
            # OpenCV's parser calls itself for each level, until the process ends.
            raise DataError(path, "is too large or nested too deeply", "write the calibration again")
        try:
            # From memory: OpenCV's own file access fails on some names, and unpacks archives.
            self._file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            self._root = self._file.root()
            whole = self._root.isMap()
        except (
            cv2.error,
            SystemError,
        ) as error:  # SystemError is how the binding reports a failed constructor
            raise DataError(path, "OpenCV cannot parse it", "it may be truncated; write it again") from error
        if not whole:
            raise DataError(path, "is empty", "write the calibration again", code="empty")

    def text(self, key: str) -> str:
        """Return a string; empty if there is none."""
        node = self._root.getNode(key)
        return str(node.string()) if node.isString() else ""

    def texts(self, key: str) -> list[str]:
        """Return a list of strings; empty if there is none."""
        node = self._root.getNode(key)
        return [str(node.at(k).string()) for k in range(node.size())] if node.isSeq() else []

    def number(self, keys: tuple[str, ...]) -> float:
        """Return the number of the first key that has one; 0 if none does."""
        nodes = (self._root.getNode(key) for key in keys)
        return next((float(node.real()) for node in nodes if node.isInt() or node.isReal()), 0.0)

    def vector(self, key: str) -> list[float]:
        """Return a list of numbers; empty if there is none."""
        node = self._root.getNode(key)
        if not node.isSeq() or node.size() > _MOST_CELLS:
            return []
        return [float(node.at(i).real()) for i in range(node.size())]

    def matrix(self, *keys: str) -> Float | None:
        """Return the matrix of the first key that has one; None if none does."""
        for key in keys:
            node = self._root.getNode(key)
            if node.isMap():
                return self._cells(key)
        return None

    def _cells(self, key: str) -> Float:
        node = self._root.getNode(key)
        rows, columns = (node.getNode(side).real() for side in ("rows", "cols"))
        cells = node.getNode("data").size()
        if not 0 < cells <= _MOST_CELLS or rows * columns != cells:
            raise DataError(
                self._path, f"{key} is {rows:g} x {columns:g} but has {cells} numbers", "write it again"
            )
        try:
            return np.asarray(node.mat(), dtype=np.float64).reshape(int(rows), int(columns))
        except (self._cv2.error, TypeError, ValueError) as error:
            raise DataError(self._path, f"{key} is not a matrix of numbers", "write it again") from error


OPENCV = OpencvStorage()


_LENS = ("fx", "fy", "cx", "cy")
_RADTAN = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE = ("k1", "k2", "k3", "k4")
_PROJECTIONS = {"": False, "pinhole": False, "kannalabrandt8": True}  # True for a fisheye


class OrbSlamSettings:
    """Reader of cameras without pose, called Camera, Camera1 and Camera2 as in the file.

    The size is `Camera.width` and `Camera.height`; without them the pictures decide.
    """

    name = "orbslam"
    title = "ORB-SLAM settings"
    suffixes: tuple[str, ...] = (".yaml", ".yml")

    def recognises(self, path: Path) -> bool:
        """Return True if the file has the four numbers of a camera."""
        head = read_head(path, self.suffixes)
        return all(re.search(rf"(?m)^Camera1?\.{key}\s*:", head) for key in _LENS)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the cameras."""
        return describe_cameras(self.read_calibration(path))

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read every camera."""
        storage = Storage(path)
        projection = storage.text("Camera.type")
        if projection.lower() not in _PROJECTIONS:
            raise DataError(
                path, f"has the projection {projection[:40]!r}", "calibrate it as PinHole or KannalaBrandt8"
            )
        fisheye = _PROJECTIONS[projection.lower()]
        names = [name for name in ("Camera", "Camera1", "Camera2") if storage.number((f"{name}.fx",))]
        return {name: _camera(path, storage, name, fisheye) for name in names}


def _camera(path: Path, storage: Storage, name: str, fisheye: bool) -> CalibratedCamera:
    fx, fy, cx, cy = (storage.number((f"{name}.{key}",)) for key in _LENS)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    size = [storage.number((f"{name}.{side}", f"Camera.{side}")) for side in ("width", "height")]
    lens = intrinsics(
        path,
        name,
        size=size if any(size) else unstated_size(matrix),
        matrix=matrix,
        distortion=[storage.number((f"{name}.{key}",)) for key in (_FISHEYE if fisheye else _RADTAN)],
        fisheye=fisheye,
    )
    return CalibratedCamera(lens, size_stated=any(size))


ORBSLAM = OrbSlamSettings()
