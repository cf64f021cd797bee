"""PCD in every encoding, with fields in any order and of any type, and real clouds."""

import struct
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.maps import point_files
from pipelines.formats.maps.octree import decompress
from pipelines.geometry.arrays import Float
from pipelines.session.registries import MapFormat
from tests.formats import clouds
from tests.real_data import facts, real_data

READER: MapFormat = point_files.PCD

# Packed by liblzf: x, intensity, y, z of 36 points, one field after the other.
PACKED_BY_LIBLZF = bytes.fromhex(
    "070000803f00008040200340074003e0760b400000016001000260010003600100046001000560010006600100076001"
    "0008600100096001000a6001000b6001200020c700a0200340074003e0030b0114c18013e00717e00323e0470b004020"
    "8b00c0200300602003e0770b016040"
)


def literals(content: bytes) -> bytes:
    """Pack as LZF without any repetition: runs of up to 32 bytes."""
    runs = [content[k : k + 32] for k in range(0, len(content), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def unpacked(packed: bytes, size: int) -> bytes | None:
    target = np.zeros(size, dtype=np.uint8)
    written = decompress(np.frombuffer(packed, np.uint8), target)
    return target[:written].tobytes() if written >= 0 else None


def header(fields: str, sizes: str, types: str, counts: str, points: int, data: str) -> bytes:
    return (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\n"
        f"TYPE {types}\nCOUNT {counts}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {points}\nDATA {data}\n"
    ).encode()


def mixed(points: Float) -> tuple[tuple[str, str, str, str], np.ndarray]:
    """Make records with z first, x as a double, padding, and a field of three values in between."""
    kind = np.dtype([("z", "<f4"), ("pad", "u1", (2,)), ("x", "<f8"), ("hist", "<u2", (3,)), ("y", "<f4")])
    records = np.zeros(len(points), kind)
    records["x"], records["y"], records["z"] = points.T
    records["hist"] = 7
    return ("z _ x hist y", "4 1 8 2 4", "F U F U F", "1 2 1 3 1"), records


def write(path: Path, encoding: str, points: Float = clouds.POINTS) -> Path:
    (fields, sizes, types, counts), records = mixed(points)
    head = header(fields, sizes, types, counts, len(points), encoding)
    if encoding == "ascii":
        rows = (f"{z} 0 0 {x} 7 7 7 {y}" for x, y, z in points.tolist())
        body = ("\n".join(rows) + "\n").encode()
    elif encoding == "binary":
        body = records.tobytes()
    else:
        assert records.dtype.names is not None
        content = b"".join(records[name].tobytes() for name in records.dtype.names)
        packed = literals(content)
        body = struct.pack("<II", len(packed), len(content)) + packed
    path.write_bytes(head + body)
    return path


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_voxels_hold_the_points(tmp_path: Path, encoding: str) -> None:
    path = write(tmp_path / "a.pcd", encoding)
    clouds.assert_holds_the_points(READER, path)
    assert READER.read_map(path, resolution_m=0.1).probability.shape == (3, 3, 11)


def test_lzf_reads_what_liblzf_wrote() -> None:
    points = np.tile(np.array([[1, 2, 3], [4, 5, 6], [1, 2, 3.5]], "<f4"), (12, 1))
    points[7, 1] = -9.25
    intensity = np.arange(36, dtype="<u2") // 3
    fields = [points[:, 0], intensity, points[:, 1], points[:, 2]]
    assert unpacked(PACKED_BY_LIBLZF, 504) == b"".join(field.tobytes() for field in fields)


@pytest.mark.parametrize("name", ["pcl_bunny_ascii", "pcl_colored_cloud", "ndt_omp_251370668"])
def test_real_clouds_are_read_as_by_other_readers(name: str) -> None:
    path = real_data(f"maps/{name}.pcd")
    assert READER.recognises(path)
    finite = clouds.finite_as_told(point_files.read_pcd(path), facts(f"maps/{name}.pcd"))
    occupied = np.count_nonzero(READER.read_map(path).probability == 1)
    assert occupied == len(np.unique(np.floor(finite / 0.2), axis=0))
