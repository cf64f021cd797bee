"""Maps of a session: they are stored and read back byte for byte, and bad files are refused."""

import io
import json
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from pipelines.session import maps
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy

probabilities = st.just(np.float32(np.nan)) | st.floats(0, 1, width=32)
grids = arrays(np.float32, array_shapes(min_dims=3, max_dims=3, max_side=4), elements=probabilities)


def occupancy(from_ns: int = 0, resolution_m: float = 0.2) -> Occupancy:
    grid = np.full((3, 4, 5), np.nan, dtype=np.float32)
    grid[1, 2, 3], grid[0, 0, 4] = 0.971, 0.1192
    return Occupancy(grid, np.array([-69.8, 1e-7, 3.0]), resolution_m, from_ns)


def same(a: Occupancy, b: Occupancy) -> None:
    np.testing.assert_array_equal(a.probability, b.probability)
    assert a.probability.dtype == b.probability.dtype == np.float32
    np.testing.assert_array_equal(a.origin, b.origin)
    assert (a.resolution_m, a.from_ns) == (b.resolution_m, b.from_ns)


@given(grids, st.floats(1e-4, 1e4), st.integers(0, 2**63 - 1))
def test_grids_come_back(
    tmp_path_factory: pytest.TempPathFactory, grid: NDArray[np.float32], side: float, from_ns: int
) -> None:
    path = tmp_path_factory.mktemp("grid") / "a.npz"
    stored = Occupancy(grid, np.array([1e6, -0.3, 2.0]), side, from_ns)
    maps.write_grid(path, stored)
    same(maps.read_grid(path), stored)
    with np.load(path, allow_pickle=False) as arrays_of:  # without this program
        np.testing.assert_array_equal(arrays_of["probability"], grid)
        assert float(arrays_of["resolution_m"]) == side


def test_a_session_keeps_its_maps_in_order(tmp_path: Path) -> None:
    first, second = occupancy(5), occupancy(7, 0.4)
    maps.store_map(tmp_path, iter([first, second]))
    loaded = maps.load_maps(tmp_path)
    assert len(loaded) == 2
    same(loaded[0], first)
    same(loaded[1], second)
    index = json.loads((tmp_path / "map/index.json").read_text())["maps"]
    assert index[1] == {
        "file": "1.npz",
        "from_ns": 7,
        "shape": [3, 4, 5],
        "origin": [-69.8, 1e-7, 3.0],
        "resolution_m": 0.4,
    }


def test_equal_maps_are_equal_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps.write_grid(tmp_path / "a.npz", occupancy())
    monkeypatch.setattr(time, "time", lambda: 2e9)
    monkeypatch.setattr(time, "localtime", lambda *_: time.gmtime(2e9))
    in_columns = occupancy()
    in_columns = Occupancy(np.asfortranarray(in_columns.probability), in_columns.origin, 0.2)
    maps.write_grid(tmp_path / "b.npz", in_columns)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def archive(path: Path, **members: bytes | NDArray[Any] | list[Any] | float) -> Path:
    """Write an npz of arrays, or of bytes in place of an array; None leaves one out."""
    content: dict[str, Any] = {"origin": [0.0, 0, 0], "resolution_m": 0.2, **members}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, value in content.items():
            if value is not None:
                file.writestr(f"{name}.npy", value if isinstance(value, bytes) else npy(value))
    return path


def npy(value: object) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(value), allow_pickle=True)
    return buffer.getvalue()


def claiming(shape: object, descr: str = "<f4", body: bytes = b"\0" * 64) -> bytes:
    """Make an npy with a given header, which may not match its content."""
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + body


GRID = np.full((2, 3, 4), 0.25)


@pytest.mark.parametrize(
    ("members", "problem"),
    [
        ({}, "lacks either probability or occupancy"),
        ({"probability": GRID, "occupancy": GRID > 1}, "either probability or occupancy"),
        ({"probability": GRID, "origin": None}, "lacks origin"),
        ({"probability": GRID, "resolution_m": None}, "lacks resolution_m"),
        ({"probability": GRID, "resolution_m": 0.0}, "voxels of 0 m"),
        ({"probability": GRID, "resolution_m": [0.2]}, r"resolution_m is float64 \[1\]"),
        ({"probability": GRID, "origin": [0.0, np.inf, 0]}, "origin is not finite"),
        ({"probability": GRID, "origin": [0.0, 1]}, r"origin is float64 \[2\]"),
        ({"probability": GRID, "origin": np.array([{}, 1, 2])}, "origin is object"),
        ({"probability": GRID[0]}, r"probability is float64 \[3, 4\]"),
        ({"probability": GRID.astype(object)}, r"probability is object"),
        ({"probability": GRID[:0]}, r"probability is float64 \[0, 3, 4\]"),
        ({"probability": GRID * 5}, r"probability holds 1\.25"),
        ({"occupancy": np.full((1, 1, 1), 101, np.uint8)}, "occupancy holds 101"),
        ({"probability": claiming((10**4, 10**4, 10**4))}, r"10000 x 10000 x 10000 voxels of 0\.2 m"),
        ({"probability": claiming((-1, 4, 4))}, r"probability is float32 \[-1, 4, 4\]"),
        ({"probability": claiming((400, 400, 400))}, "no readable npz"),
        ({"probability": claiming((2, 2, 2), "nonsense")}, "no readable npz"),
        ({"probability": b"not an array"}, "no readable npz"),
    ],
)
def test_unusable_grids_are_one_clear_line(tmp_path: Path, members: dict[str, Any], problem: str) -> None:
    path = archive(tmp_path / "bad.npz", **members)
    with pytest.raises(DataError, match=problem) as caught:
        maps.read_grid(path)
    assert "\n" not in str(caught.value)


def test_arrays_of_other_scripts_are_read(tmp_path: Path) -> None:
    asymmetric = np.arange(24).reshape(2, 3, 4) / 24
    for name, value in {
        "columns": np.asfortranarray(asymmetric),
        "big endian": asymmetric.astype(">f8"),
        "half": asymmetric.astype(np.float16),
    }.items():
        path = archive(tmp_path / f"{name}.npz", probability=value, origin=[1, 2, 3], resolution_m=1)
        found = maps.read_grid(path)
        assert found.origin.tolist() == [1, 2, 3]
        np.testing.assert_allclose(found.probability, asymmetric, rtol=0, atol=1e-3)  # half: 2 ** -11
        assert maps.describe_map(found)["occupied_voxels"] == 12


def test_percent_and_yes_or_no_become_probabilities(tmp_path: Path) -> None:
    percent = np.array([[[-1, 0, 50, 100]]], dtype=np.int8)
    found = maps.read_grid(archive(tmp_path / "a.npz", occupancy=percent))
    np.testing.assert_array_equal(found.probability, np.array([[[np.nan, 0, 0.5, 1]]], dtype=np.float32))
    said = maps.describe_map(found)
    assert (said["occupied_voxels"], said["free_voxels"], said["unknown_voxels"]) == (2, 1, 1)
    found = maps.read_grid(archive(tmp_path / "b.npz", occupancy=percent > 0))
    assert found.probability.ravel().tolist() == [0, 0, 1, 1]
