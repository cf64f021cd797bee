"""Voxel maps as npz, as written by a user's own script."""

from pathlib import Path

import numpy as np

from pipelines.formats.maps import voxel_grids
from pipelines.session import maps
from pipelines.session.registries import MapFormat
from tests.raising import refused

READER: MapFormat = voxel_grids.NPZ


def write(path: Path) -> Path:
    probability = np.full((4, 3, 2), np.nan)
    probability[0, 1, 0], probability[3, 2, 1] = 0.9, 0.1
    np.savez_compressed(path, probability=probability, origin=[-1.0, 2, 0], resolution_m=0.5)
    return path


def test_a_grid_of_ones_own_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "site.npz")
    assert READER.recognises(path)
    occupancy = READER.read_map(path)
    assert occupancy.origin.tolist() == [-1, 2, 0]
    assert np.argwhere(occupancy.probability > 0.5).tolist() == [[0, 1, 0]]
    said = READER.describe(path)
    assert said["size_voxels"] == [4, 3, 2]
    assert said["box_max_m"] == [1.0, 3.5, 1.0]
    assert (said["occupied_voxels"], said["free_voxels"], said["unknown_voxels"]) == (1, 1, 22)


def test_a_map_of_a_session_can_be_given_to_another_flight(tmp_path: Path) -> None:
    occupancy = READER.read_map(write(tmp_path / "site.npz"))
    maps.store_map(tmp_path, [occupancy])
    again = READER.read_map(tmp_path / "map/0.npz")
    np.testing.assert_array_equal(again.probability, occupancy.probability)


def test_its_resolution_is_its_own(tmp_path: Path) -> None:
    path = write(tmp_path / "site.npz")
    assert READER.read_map(path, resolution_m=0.5).resolution_m == 0.5
    with refused("data", path, 0.5, 0.2):
        READER.read_map(path, resolution_m=0.2)


def test_other_npz_files_are_not_taken_for_maps(tmp_path: Path) -> None:
    other, broken = tmp_path / "other.npz", tmp_path / "no.npz"
    np.savez(other, a=[1, 2])
    broken.write_bytes(b"PK\3\4 no zip")
    assert not READER.recognises(other)
    assert not READER.recognises(broken)
