"""Checked conversion of camera matrices, Rodrigues vectors and camera_from_world poses to our records.

The centre of the top left pixel is (0, 0), as in OpenCV; readers of other files (COLMAP) shift (cx, cy)
before.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import DistortionModel, Float, Intrinsics
from pipelines.geometry.cameras import camera_info
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera
from pipelines.session.storage import damaged

# OpenCV's further coefficients (thin prism, tilt) are rare and mostly zero.
_MOST_COEFFICIENTS = 8
# No length or angle is larger, and larger numbers overflow in later steps.
_LARGEST = 1e12


def intrinsics(
    source: Path | str,
    camera: str,
    *,
    size: Sequence[float],
    matrix: Float,
    distortion: Sequence[float],
    fisheye: bool,
) -> Intrinsics:
    """Build intrinsics, px, of OpenCV's coefficients; zeros are no distortion (of a fisheye: equidistant)."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or len(size) != 2:
        raise DataError(source, f"camera {camera} has no 3 x 3 matrix of numbers and size of two")
    skew, last = abs(matrix[0, 1]), matrix[2]
    if skew > 1e-6 * abs(matrix[0, 0]) or matrix[1, 0] != 0 or not np.array_equal(last, (0, 0, 1)):
        problem = f"camera {camera}: its matrix has skew {matrix[0, 1]:.4g} or is not fx 0 cx, 0 fy cy, 0 0 1"
        raise DataError(source, problem, "calibrate without skew")
    if any(distortion[_MOST_COEFFICIENTS:]):
        problem = f"camera {camera} has {len(distortion)} distortion coefficients (thin prism or tilt)"
        raise DataError(source, problem, f"calibrate with at most {_MOST_COEFFICIENTS}")
    coefficients = tuple(float(value) for value in distortion[:_MOST_COEFFICIENTS])
    if fisheye:
        return build_intrinsics(source, camera, size, matrix, "fisheye", coefficients or (0.0,) * 4)
    if not any(coefficients):
        return build_intrinsics(source, camera, size, matrix, "none", ())
    return build_intrinsics(source, camera, size, matrix, "radtan", coefficients)


def unstated_size(matrix: Float) -> tuple[float, float]:
    """Return the width and height of which the principal point of a camera matrix is the middle."""
    centre = matrix[:2, 2] if matrix.shape == (3, 3) and np.isfinite(matrix).all() else np.zeros(2)
    return float(np.rint(2 * centre[0] + 1)), float(np.rint(2 * centre[1] + 1))


def build_intrinsics(
    source: Path | str,
    camera: str,
    size: Sequence[float],
    matrix: Float,
    model: DistortionModel,
    coefficients: tuple[float, ...],
) -> Intrinsics:
    """Build the record; raise a DataError if its numbers are wrong."""
    width, height = (int(value) if float(value).is_integer() else 0 for value in size)
    fx, fy, cx, cy = (float(value) for value in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    try:
        return Intrinsics(width, height, fx, fy, cx, cy, model, coefficients)
    except ValueError as error:
        raise damaged(source, f"camera {camera}: {error}") from error


def invert_pose(source: Path, camera: str, rotation: Float, translation: Float) -> tuple[Float, Float]:
    """Return position [3] and quaternion [4] of world_from_camera, given camera_from_world.

    The rotation is a quaternion [4] xyzw, a vector [3] (Rodrigues, rad) or a matrix [3, 3].
    """
    from scipy.spatial.transform import Rotation

    # NaN fails the comparisons, too.
    is_turn = bool((np.abs(rotation) < _LARGEST).all())
    quaternion_xyzw = rotation
    if rotation.shape == (3,):
        quaternion_xyzw = Rotation.from_rotvec(rotation).as_quat() if is_turn else np.zeros(4)
    elif rotation.shape == (3, 3):
        is_turn &= np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
        quaternion_xyzw = Rotation.from_matrix(rotation).as_quat() if is_turn else np.zeros(4)
    if not is_turn or quaternion_xyzw.shape != (4,) or np.linalg.norm(quaternion_xyzw) < 1e-9:
        raise DataError(source, f"camera {camera}: what is given as its rotation is none")
    if translation.shape != (3,) or not (np.abs(translation) < _LARGEST).all():
        raise DataError(source, f"camera {camera}: its translation is no vector of three numbers")
    world_from_camera = Rotation.from_quat(quaternion_xyzw).inv()
    return -world_from_camera.apply(translation), world_from_camera.as_quat()


def describe_cameras(cameras: dict[str, CalibratedCamera]) -> dict[str, object]:
    """Describe every camera by name, on one line each."""
    return {"cameras": len(cameras), **{name: _camera_line(camera) for name, camera in cameras.items()}}


def _camera_line(camera: CalibratedCamera) -> str:
    parts = []
    if (lens := camera.intrinsics) is not None:
        size = f"{lens.width} x {lens.height} px" if camera.size_stated else "size not stated"
        parts.append(f"{size}, f {lens.fx:.1f} {lens.fy:.1f}, {lens.model}")
    if camera.position is not None:
        parts.append("at " + " ".join(f"{value + 0:.3f}" for value in camera.position))
    if camera.note:
        parts.append(camera.note)
    return ", ".join(parts)


def write_camera_info(path: Path, name: str, intrinsics: Intrinsics) -> None:
    """Write one camera; numbers keep their full precision."""
    info = camera_info(intrinsics)
    lines = [
        f"image_width: {intrinsics.width}",
        f"image_height: {intrinsics.height}",
        f"camera_name: {name}",
        *_written_matrix("camera_matrix", 3, 3, info["k"]),
        f"distortion_model: {info['distortion_model']}",
        *_written_matrix("distortion_coefficients", 1, len(info["d"]), info["d"]),
        *_written_matrix("rectification_matrix", 3, 3, info["r"]),
        *_written_matrix("projection_matrix", 3, 4, info["p"]),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _written_matrix(key: str, rows: int, columns: int, data: list[float]) -> list[str]:
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {data}"]
