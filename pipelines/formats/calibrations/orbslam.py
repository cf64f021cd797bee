"""Reader of the settings of ORB-SLAM (1, 2 and 3): the intrinsics of its camera, or of its two.

Settings are OpenCV's YAML with keys `Camera.fx` (until ORB-SLAM 3, version 0.4) or `Camera1.fx` and
`Camera2.fx` (since, with `File.version`). Distortion is OpenCV's k1 k2 p1 p2 k3, or k1 k2 k3 k4 where
`Camera.type` is KannalaBrandt8.
"""

import re
from pathlib import Path

import numpy as np

from pipelines.formats.calibrations.camera_matrices import describe_cameras, intrinsics, unstated_size
from pipelines.formats.calibrations.opencv_yaml import Storage
from pipelines.formats.common.files import read_head
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera

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


FORMAT = OrbSlamSettings()
