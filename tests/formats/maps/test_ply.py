"""PLY in every encoding and byte order, clouds and meshes, and a real cloud."""

from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.maps import point_files
from pipelines.session.registries import MapFormat
from tests.formats import clouds
from tests.real_data import facts, real_data

READER: MapFormat = point_files.PLY


def head(encoding: str, elements: str) -> bytes:
    return f"ply\nformat {encoding} 1.0\ncomment made here\n{elements}end_header\n".encode()


def write(path: Path, encoding: str) -> Path:
    """Write a mesh: two sensors before its vertices, with x last, and a face after them."""
    points = clouds.POINTS
    header = head(
        encoding,
        "element sensor 2\nproperty uchar id\nproperty double when\n"
        f"element vertex {len(points)}\nproperty float z\nproperty uint8 red\nproperty double y\n"
        "property float32 x\nelement face 1\nproperty list uchar int vertex_indices\n",
    )
    if encoding == "ascii":
        rows = [f"{z} 255 {y} {x}" for x, y, z in points.tolist()]
        path.write_bytes(header + "\n".join(["1 0.5", "2 0.75", *rows, "3 0 1 2", ""]).encode())
        return path
    order = "<" if encoding == "binary_little_endian" else ">"
    sensors = np.array([(1, 0.5), (2, 0.75)], dtype=[("id", "u1"), ("when", f"{order}f8")])
    kind = [("z", f"{order}f4"), ("red", "u1"), ("y", f"{order}f8"), ("x", f"{order}f4")]
    vertices = np.zeros(len(points), dtype=kind)
    vertices["x"], vertices["y"], vertices["z"] = points.T
    face = b"\3" + np.arange(3, dtype=f"{order}i4").tobytes()
    path.write_bytes(header + sensors.tobytes() + vertices.tobytes() + face)
    return path


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_voxels_hold_the_vertices(tmp_path: Path, encoding: str) -> None:
    clouds.assert_holds_the_points(READER, write(tmp_path / "a.ply", encoding))


def test_the_real_cloud_is_read_as_by_other_readers() -> None:
    path = real_data("maps/small_gicp_target.ply")
    clouds.finite_as_told(point_files.read_ply(path), facts("maps/small_gicp_target.ply"))
