"""LAS and LAZ, written by laspy."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.maps import point_files
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.registries import MapFormat, need

READER: MapFormat = point_files.LAS
# Two voxels of 0.5 m beside each other and one above, in UTM 32 north.
POINTS = np.array([[500000.1, 5300000.1, 400.1], [500000.2, 5300000.2, 400.2], [500000.6, 5300000.1, 400.1],
                   [500000.1, 5300000.1, 400.9]])  # fmt: skip


def write(path: Path, points: Float = POINTS, classes: list[int] | None = None, crs: Any = None) -> Path:
    laspy = need("laspy", "las")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.full(3, 0.001)
    if crs is not None:
        header.add_crs(crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    if classes:
        cloud.classification = classes
    cloud.write(path)
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_points_become_voxels_where_they_are(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"cloud{suffix}")
    assert recognise(path, MapFormat, "map") is READER
    grid = READER.read_map(path, resolution_m=0.5)
    assert grid.origin.tolist() == [500000.0, 5300000.0, 400.0]
    assert np.argwhere(grid.probability == 1).tolist() == [[0, 0, 0], [0, 0, 1], [1, 0, 0]]
    assert np.isnan(grid.probability[1, 0, 1])
    assert grid.crs is None


def test_noise_and_withheld_points_are_left_out_and_counted(tmp_path: Path) -> None:
    path = write(tmp_path / "cloud.las", classes=[2, 7, 18, 5])
    grid = READER.read_map(path, resolution_m=0.5)
    assert list(grid.dropped.values()) == [2]
    assert grid.probability.shape == (1, 1, 2)


def test_the_reference_system_is_kept(tmp_path: Path) -> None:
    pyproj = pytest.importorskip("pyproj")
    path = write(tmp_path / "cloud.laz", crs=pyproj.CRS.from_epsg(25832))
    crs = READER.read_map(path).crs
    assert crs is not None
    assert pyproj.CRS.from_user_input(crs).to_epsg() == 25832


@pytest.mark.parametrize(("suffix", "least"), [(".las", 0.5), (".laz", 0.0)])
def test_a_cut_file_gives_the_points_that_it_holds(tmp_path: Path, suffix: str, least: float) -> None:
    """LAS keeps its points one after the other; LAZ has its table of chunks at the end."""
    rng = np.random.default_rng(0)
    path = write(tmp_path / f"cloud{suffix}", rng.uniform(0, 10, (200_000, 3)))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 3 // 4])
    try:
        found = READER.read_map(path)
    except DataError:
        assert suffix == ".laz"
        return
    assert 0 < found.dropped["points cut off"] <= (1 - least) * 200_000
