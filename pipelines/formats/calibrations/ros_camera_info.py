"""ROS camera calibrations: the YAML of camera_info_manager, read and written, and the older INI (ost.txt)."""

import re
from pathlib import Path

import numpy as np

from pipelines.formats.calibrations.camera_matrices import describe_cameras, intrinsics
from pipelines.formats.common.files import numbers, read_head, read_text, read_yaml
from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera

_FISHEYE = {"equidistant", "fisheye"}
# Drivers write an empty model if they were never calibrated, or if the lens has no distortion.
_RADTAN = {"plumb_bob", "rational_polynomial", ""}
_YAML = (".yaml", ".yml")


class RosCameraInfo:
    """Reader of one camera per file, for the raw picture (not rectified).

    YAML: image_width, image_height, camera_matrix, distortion_model, distortion_coefficients, camera_name.
    INI: [image] with width and height, then the camera's section with camera matrix and distortion.
    Rectification and projection are ignored, because pictures are used as the camera delivers them.
    The camera has the name that the file gives, else "camera".
    """

    name = "camera_info"
    title = "ROS camera calibration"
    suffixes: tuple[str, ...] = (*_YAML, ".ini", ".txt")

    def recognises(self, path: Path) -> bool:
        """Return True if the file has the keys of a camera_info and OpenCV's FileStorage did not write it."""
        head = read_head(path, self.suffixes)
        if path.suffix.lower() not in _YAML:
            return bool(re.search(r"(?m)^\[image\]", head) and re.search(r"(?m)^camera matrix\s*$", head))
        keys = ("image_width", "image_height", "camera_matrix")
        return "!!opencv-matrix" not in head and all(re.search(rf"(?m)^{key}\s*:", head) for key in keys)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the camera."""
        return describe_cameras(self.read_calibration(path))

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read the one camera."""
        return _read_yaml(path) if path.suffix.lower() in _YAML else _read_ini(path)


def _read_yaml(path: Path) -> dict[str, CalibratedCamera]:
    keys = read_yaml(path)
    wanted = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
    missing = [key for key in wanted if key not in keys]
    if missing:
        raise DataError(
            path, f"lacks {', '.join(missing)}", "write the calibration again", code="missing-column"
        )
    return _camera(
        path,
        str(keys.get("camera_name") or ""),
        numbers(path, "image_width, image_height", [keys["image_width"], keys["image_height"]]),
        _matrix(path, "camera_matrix", keys["camera_matrix"]),
        _matrix(path, "distortion_coefficients", keys["distortion_coefficients"]),
        str(keys.get("distortion_model") or ""),
    )


def _matrix(path: Path, name: str, value: object) -> Float:
    """Read a matrix from its rows, cols and data."""
    block = value if isinstance(value, dict) else {}
    cells = numbers(path, f"{name}.data", block.get("data"))
    rows, columns = block.get("rows"), block.get("cols")
    # isinstance takes `true` for an integer, so compare the type itself.
    if type(rows) is not int or type(columns) is not int or min(rows, columns) < 0:
        raise DataError(path, f"{name} states no rows and cols", "write the calibration again")
    if rows * columns != len(cells):
        raise DataError(path, f"{name} is {rows} x {columns} but has {len(cells)} numbers", "write it again")
    return cells.reshape(rows, columns) if len(cells) else cells.reshape(0, 0)


def _read_ini(path: Path) -> dict[str, CalibratedCamera]:
    """Read sections in brackets, a line of words for each key, and lines of numbers below it."""
    blocks: dict[str, list[list[str]]] = {}
    name, key = "", ""
    for line in read_text(path).split("\n"):
        text = line.partition("#")[0].partition(";")[0].strip()
        if section := re.fullmatch(r"\[(.*)\]", text):
            name, key = section[1] if section[1] not in {"image", "externals"} else name, ""
        elif re.match(r"(?!nan|inf)[A-Za-z]", text, re.IGNORECASE):
            key = text
        elif text:
            blocks.setdefault(key, []).append(text.split())
    missing = [key for key in ("width", "height", "camera matrix", "distortion") if key not in blocks]
    if missing:
        raise DataError(
            path, f"lacks {', '.join(missing)}", "write the calibration again", code="missing-column"
        )
    size = [_rows(path, key, blocks[key]).ravel() for key in ("width", "height")]
    return _camera(
        path,
        name,
        np.concatenate(size),
        _rows(path, "camera matrix", blocks["camera matrix"]),
        _rows(path, "distortion", blocks["distortion"]),
        "",
    )


def _rows(path: Path, key: str, rows: list[list[str]]) -> Float:
    try:
        return np.array([[float(cell) for cell in row] for row in rows])
    except ValueError as error:  # a word among the numbers, or rows of unequal length
        raise DataError(
            path, f"{key} is no table of numbers", "write the calibration again", code="bad-value"
        ) from error


def _camera(
    path: Path, name: str, size: Float, matrix: Float, distortion: Float, model: str
) -> dict[str, CalibratedCamera]:
    name = name or "camera"
    if model not in _FISHEYE | _RADTAN:
        raise DataError(
            path,
            f"camera {name} has the distortion model {model[:40]!r}",
            "calibrate it as plumb_bob, rational_polynomial or equidistant",
        )
    lens = intrinsics(
        path,
        name,
        size=size.tolist(),
        matrix=matrix,
        distortion=distortion.ravel().tolist(),
        fisheye=model in _FISHEYE,
    )
    return {name: CalibratedCamera(lens)}


# --- writing -------------------------------------------------------------------------------------------


def write_camera_info(path: Path, name: str, intrinsics: Intrinsics) -> None:
    """Write one camera; numbers keep their full precision."""
    model, distortion = ros_distortion(intrinsics)
    fx, fy, cx, cy = (float(v) for v in (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy))
    matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    projection = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    lines = [
        f"image_width: {intrinsics.width}",
        f"image_height: {intrinsics.height}",
        f"camera_name: {name}",
        *_written_matrix("camera_matrix", 3, 3, matrix),
        f"distortion_model: {model}",
        *_written_matrix("distortion_coefficients", 1, len(distortion), distortion),
        *_written_matrix("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        *_written_matrix("projection_matrix", 3, 4, projection),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def ros_distortion(intrinsics: Intrinsics) -> tuple[str, list[float]]:
    """Return the model's name in ROS, and as many coefficients as that model takes there."""
    coefficients = [float(v) for v in intrinsics.distortion]
    if intrinsics.model == "fisheye":
        return "equidistant", coefficients
    if len(coefficients) > 5:
        return "rational_polynomial", coefficients
    return "plumb_bob", [*coefficients, *[0.0] * (5 - len(coefficients))]


def _written_matrix(key: str, rows: int, columns: int, data: list[float]) -> list[str]:
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {data}"]


FORMAT = RosCameraInfo()
