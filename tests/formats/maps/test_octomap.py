"""OctoMap: trees written here by another algorithm than the reader's, and real maps with known contents."""

import math
import struct
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.formats.maps import octomap
from pipelines.session.registries import MapFormat
from tests.real_data import facts, real_data

READER: MapFormat = octomap.FORMAT
FREE, OCCUPIED = np.float32(0.1192), np.float32(0.971)

Leaf = float | None  # log odds; None if unknown
Node = Leaf | list["Node"]

# Below 13 fixed levels, so that there are at most 8 x 8 x 8 finest voxels.
leaf_values = st.sampled_from([None, -2.0, 3.5])


def eight(children: st.SearchStrategy[Node]) -> st.SearchStrategy[list[Node]]:
    """Draw an inner node, which has at least one child."""
    return st.lists(children, min_size=8, max_size=8).filter(lambda node: node != [None] * 8)


subtrees = eight(leaf_values | eight(leaf_values | eight(leaf_values)))
paths = st.lists(st.integers(0, 7), min_size=13, max_size=13)


def at(path: list[int], node: Node) -> Node:
    """Return the tree whose only branch is a path of child numbers, with a node at its end."""
    for child in reversed(path):
        parent: list[Node] = [None] * 8
        parent[child] = node
        node = parent
    return node


def count(node: Node) -> int:
    return 0 if node is None else 1 + sum(map(count, node)) if isinstance(node, list) else 1


def bt_body(node: Node) -> bytes:
    assert isinstance(node, list)
    word = 0
    for i, child in enumerate(node):
        state = 3 if isinstance(child, list) else 0 if child is None else 2 if child >= 0 else 1
        word |= state << (2 * i)
    return struct.pack("<H", word) + b"".join(bt_body(child) for child in node if isinstance(child, list))


def ot_body(node: Node, extra: bytes = b"", inner: float = math.nan) -> bytes:
    if not isinstance(node, list):
        return struct.pack("<f", node) + extra + b"\0"
    mask = sum(1 << i for i, child in enumerate(node) if child is not None)
    below = b"".join(ot_body(child, extra, inner) for child in node if child is not None)
    return struct.pack("<f", inner) + extra + bytes([mask]) + below


def file_of(
    node: Node,
    kind: Literal["bt", "ot"] = "bt",
    *,
    res: str = "0.2",
    size: object = None,
    tree: str = "OcTree",
    body: bytes | None = None,
) -> bytes:
    first = "# Octomap OcTree binary file" if kind == "bt" else "# Octomap OcTree file"
    header = (
        f"{first}\n# a comment\nid {tree}\nsize {count(node) if size is None else size}\nres {res}\ndata\n"
    )
    if body is None:
        body = bt_body(node) if kind == "bt" else ot_body(node)
    return header.encode() + body


def painted(path: list[int], node: Node, finest: float) -> dict[tuple[int, int, int], float]:
    """Return every known finest voxel by its index from the world's origin, by halving cubes."""
    voxels: dict[tuple[int, int, int], float] = {}

    def visit(node: Node, low: tuple[int, int, int], side: int) -> None:
        if node is None:
            return
        if not isinstance(node, list):
            for x in range(side):
                for y in range(side):
                    for z in range(side):
                        voxels[low[0] + x, low[1] + y, low[2] + z] = node
            return
        half = side // 2
        for i, child in enumerate(node):
            x, y, z = (low[axis] + (half if i >> axis & 1 else 0) for axis in range(3))
            visit(child, (x, y, z), half)

    low, side = [-32768] * 3, 65536
    for child in path:
        side //= 2
        low = [low[axis] + (side if child >> axis & 1 else 0) for axis in range(3)]
    visit(node, (low[0], low[1], low[2]), side)
    return voxels


@settings(deadline=None)  # the first call compiles
@given(paths, subtrees, st.sampled_from(["bt", "ot"]))
def test_every_voxel_is_where_halving_the_cube_puts_it(
    tmp_path_factory: pytest.TempPathFactory, path: list[int], node: list[Node], kind: Literal["bt", "ot"]
) -> None:
    file = tmp_path_factory.mktemp("tree") / f"a.{kind}"
    file.write_bytes(file_of(at(path, node), kind))
    assert READER.recognises(file)
    expected = painted(path, node, 0.2)
    index = np.array(list(expected))
    occupancy = READER.read_map(file)
    assert occupancy.probability.dtype == np.float32
    np.testing.assert_allclose(occupancy.origin, index.min(axis=0) * 0.2, rtol=0, atol=1e-9)
    grid = np.full(np.ptp(index, axis=0) + 1, np.nan)
    log_odds = np.array(list(expected.values()))
    # Limits of a .bt are OctoMap's; a .ot has its own: p = 1 - 1 / (1 + exp(log odds)).
    limits = np.where(log_odds > 0, OCCUPIED, FREE)
    grid[*(index - index.min(axis=0)).T] = limits if kind == "bt" else 1 - 1 / (1 + np.exp(log_odds))
    np.testing.assert_allclose(occupancy.probability, grid, rtol=0, atol=2e-7)  # float32


@settings(deadline=None)  # the first call compiles
@given(paths, subtrees, st.integers(1, 4))
def test_merged_voxels_keep_the_largest_probability(
    tmp_path_factory: pytest.TempPathFactory, path: list[int], node: list[Node], halvings: int
) -> None:
    file = tmp_path_factory.mktemp("tree") / "a.ot"
    file.write_bytes(file_of(at(path, node), "ot"))
    merged = READER.read_map(file, resolution_m=0.2 * 2**halvings)
    assert merged.resolution_m == pytest.approx(0.2 * 2**halvings)
    best: dict[tuple[int, ...], float] = {}
    for index, log_odds in painted(path, node, 0.2).items():
        place = tuple(i // 2**halvings for i in index)
        best[place] = max(best.get(place, -math.inf), 1 / (1 + math.exp(-log_odds)))
    first = np.rint(merged.origin / merged.resolution_m).astype(int)
    found = {
        tuple((np.array(index) + first).tolist()): float(merged.probability[tuple(index)])
        for index in np.argwhere(~np.isnan(merged.probability))
    }
    assert found == pytest.approx(best, abs=2e-7)


@pytest.mark.parametrize("name", ["octomap_geb079.bt", "octomap_simple.bt", "octomap_ecmrv4_withfree.ot"])
def test_real_maps_are_read_as_by_octomap(name: str) -> None:
    told = facts(f"maps/{name}")
    file = real_data(f"maps/{name}")
    assert READER.recognises(file)
    said = READER.describe(file)
    assert said["occupied_voxels"] == told["occupied_voxels_at_finest"]
    assert said["free_voxels"] == told["free_voxels_at_finest"]
    assert said["resolution_m"] == told["resolution"]
    for end in ("min", "max"):
        assert said[f"box_{end}_m"] == pytest.approx(told["metric_bbox"][end], abs=1e-9)
