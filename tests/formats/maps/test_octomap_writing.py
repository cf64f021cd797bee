"""Our .bt files, read by our own reader and by OctoMap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from pipelines.formats.maps import octomap
from pipelines.formats.maps.octomap import write_octomap
from pipelines.session.records import Occupancy

FREE, OCCUPIED = np.float32(octomap.FREE_PROBABILITY), np.float32(octomap.OCCUPIED_PROBABILITY)

Voxels = dict[tuple[int, int, int], bool]

# Blocks of one value beside single voxels, so that several levels are pruned.
fine = hnp.arrays(
    np.float32, st.tuples(*[st.integers(1, 5)] * 3), elements=st.sampled_from([0.0, 1.0, np.nan])
)
coarse = st.tuples(fine, st.sampled_from([1, 2, 4])).map(
    lambda pair: np.kron(pair[0], np.ones((pair[1],) * 3, dtype=np.float32))
)
grids = coarse.filter(lambda grid: not np.isnan(grid).all())
corners = st.tuples(*[st.integers(-9, 9)] * 3)


def voxels_of(occupancy: Occupancy) -> Voxels:
    """Return True if occupied, for every known voxel by its index from the world's origin."""
    first = np.rint(occupancy.origin / occupancy.resolution_m).astype(int)
    known = np.argwhere(~np.isnan(occupancy.probability))
    states = (occupancy.probability[tuple(known.T)] >= 0.5).tolist()
    return {(x, y, z): state for (x, y, z), state in zip((known + first).tolist(), states, strict=True)}


@settings(deadline=None)  # the first call compiles
@given(grids, corners)
def test_our_reader_gets_every_voxel_back(
    tmp_path_factory: pytest.TempPathFactory, grid: NDArray[np.float32], corner: tuple[int, int, int]
) -> None:
    file = tmp_path_factory.mktemp("map") / "a.bt"
    written = Occupancy(grid, np.array(corner) * 0.2, 0.2)
    write_octomap(file, written)
    read = octomap.FORMAT.read_map(file)
    assert voxels_of(read) == voxels_of(written)
    known = read.probability[~np.isnan(read.probability)]
    # The reader's log odds are float32 of at most 3.5, which round probabilities by 2e-7.
    np.testing.assert_allclose(known, np.where(known >= 0.5, OCCUPIED, FREE), rtol=0, atol=2e-7)


def test_octomap_reads_the_same_leaves(tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap")
    rng = np.random.default_rng(7)
    grid = rng.choice(np.array([0, 1, np.nan], dtype=np.float32), (9, 6, 5), p=[0.6, 0.3, 0.1])
    grid[2:6, :4, :4] = 1
    occupancy = Occupancy(grid, np.array([-0.4, 0.0, -0.1]), 0.1)
    file = tmp_path / "a.bt"
    write_octomap(file, occupancy)
    tree = pyoctomap.OcTree(1.0)
    assert tree.readBinary(str(file))
    assert tree.getResolution() == 0.1
    found: Voxels = {}
    for leaf in tree.begin_leafs():
        side = round(leaf.getSize() / 0.1)
        low = np.rint(np.array(leaf.getCoordinate()) / 0.1 - side / 2).astype(int)
        for x, y, z in np.ndindex(side, side, side):
            place = (int(low[0]) + x, int(low[1]) + y, int(low[2]) + z)
            found[place] = bool(tree.isNodeOccupied(leaf))
    assert found == voxels_of(occupancy)
    described = octomap.FORMAT.describe(file)
    assert described["nodes"] == tree.size()
    assert described["leaves"] == tree.getNumLeafNodes()
