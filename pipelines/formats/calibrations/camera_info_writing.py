"""Writer of camera calibrations in the form of ROS's camera_info_manager."""

from __future__ import annotations

from pathlib import Path

from pipelines.geometry.cameras import Intrinsics


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
        *_matrix("camera_matrix", 3, 3, matrix),
        f"distortion_model: {model}",
        *_matrix("distortion_coefficients", 1, len(distortion), distortion),
        *_matrix("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        *_matrix("projection_matrix", 3, 4, projection),
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


def _matrix(key: str, rows: int, columns: int, data: list[float]) -> list[str]:
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {data}"]
