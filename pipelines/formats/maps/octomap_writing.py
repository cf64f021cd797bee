"""Writer of OctoMap's binary trees (.bt); module `octomap` explains the layout.

The tree is built from the grid upwards, level by level: eight children that are all free or all occupied
become one leaf, as OctoMap's own prune() makes them. A .bt keeps no probabilities, only free and occupied.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.maps.octree_kernels import DEPTH, FREE, INNER, OCCUPIED
from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy

States = NDArray[np.uint8]
Int64 = NDArray[np.int64]

_UNKNOWN = 0
_CENTRE = 1 << (DEPTH - 1)
_OFF_GRID = 1e-4  # of a voxel; origins are sums and products of rounded decimal numbers

_HEADER = """# Octomap OcTree binary file
# (feel free to add / change comments, but leave the first line as it is!)
#
id OcTree
size {nodes}
res {resolution_m!r}
data
"""


def write_octomap(path: Path, occupancy: Occupancy) -> None:
    """Write a map as a pruned .bt: at least 0.5 is occupied, below is free, NaN is left out.

    Raises:
        ValueError: the origin is not a multiple of the resolution, or nothing in the map is known.
        DataError: the map reaches further from the world's origin than an OctoMap of these voxels can
            (32768 voxels).
    """
    side_m = float(occupancy.resolution_m)
    first = _first_key(occupancy.origin, side_m)
    _check_reach(path, first, occupancy.probability.shape, side_m)
    states = np.full(occupancy.probability.shape, _UNKNOWN, dtype=np.uint8)
    states[occupancy.probability < 0.5] = FREE
    states[occupancy.probability >= 0.5] = OCCUPIED
    if not states.any():
        raise ValueError("nothing in the map is known")
    flat, begin, low, shape = _levels(states, first)
    words = np.empty(int((flat == INNER).sum()), dtype="<u2")
    leaves = _write_depth_first(flat, begin, low, shape, words)
    header = _HEADER.format(nodes=len(words) + leaves, resolution_m=side_m)
    path.write_bytes(header.encode() + words.tobytes())


def _first_key(origin: Float, side_m: float) -> Int64:
    """Return the finest voxel's key at the grid's corner, counted from the tree's lower end."""
    steps = np.asarray(origin, dtype=np.float64) / side_m
    nearest = np.rint(steps)
    if not (np.abs(steps - nearest) <= _OFF_GRID).all():
        raise ValueError(
            f"the origin {np.asarray(origin).tolist()} is not on OctoMap's grid, "
            f"the multiples of {side_m:g} m"
        )
    key: Int64 = nearest.astype(np.int64) + _CENTRE
    return key


def _check_reach(path: Path, first: Int64, shape: tuple[int, ...], side_m: float) -> None:
    end = first + np.array(shape)
    if (first < 0).any() or (end > 2 * _CENTRE).any():
        reach_m = max(int((_CENTRE - first).max()), int((end - _CENTRE).max())) * side_m
        raise DataError(
            path,
            f"an OctoMap of {side_m:g} m voxels ends {_CENTRE * side_m:g} m from the world's origin, "
            f"the map reaches {reach_m:g} m",
            "take larger voxels or a map nearer to the origin",
        )


def _levels(states: States, first: Int64) -> tuple[States, Int64, Int64, Int64]:
    """Compute the nodes of every level within the grid's box, root first.

    Returns:
        All states one level after another; the start of each level [DEPTH + 1]; the key of its first node
        [DEPTH + 1, 3], in nodes of that level; and its shape [DEPTH + 1, 3].
    """
    levels, lows = [states], [first]
    for _ in range(DEPTH):
        states, first = _merged(states, first)
        levels.append(states)
        lows.append(first)
    levels, lows = levels[::-1], lows[::-1]
    begin = np.cumsum([0, *(level.size for level in levels[:-1])])
    flat = np.concatenate([level.ravel() for level in levels])
    return flat, begin, np.array(lows), np.array([level.shape for level in levels], dtype=np.int64)


def _merged(states: States, first: Int64) -> tuple[States, Int64]:
    """Merge to the level above: a node has its children's state if they share one, else it is inner."""
    before = first % 2
    after = (before + states.shape) % 2
    padded = np.pad(states, np.stack([before, after], axis=1), constant_values=_UNKNOWN)
    x, y, z = (side // 2 for side in padded.shape)
    least = most = padded.reshape(x, 2, y, 2, z, 2)
    for axis in (5, 3, 1):
        least, most = least.min(axis=axis), most.max(axis=axis)
    return np.where(least == most, least, np.uint8(INNER)), first // 2


@cached
def _write_depth_first(
    flat: States, begin: Int64, low: Int64, shape: Int64, words: NDArray[np.uint16]
) -> int:
    """Write one word for every inner node, children after their parent; return the number of leaves."""
    stack = np.empty((8 * (DEPTH + 1), 4), dtype=np.int64)
    stack[0] = 0
    waiting, written, leaves = 1, 0, 0
    while waiting:
        waiting -= 1
        level = stack[waiting, 0] + 1  # of the children
        x0, y0, z0 = 2 * stack[waiting, 1], 2 * stack[waiting, 2], 2 * stack[waiting, 3]
        word = np.int64(0)
        for child in range(7, -1, -1):  # downwards, so that the first child is on top
            x, y, z = x0 + (child & 1), y0 + ((child >> 1) & 1), z0 + (child >> 2)
            i, j, k = x - low[level, 0], y - low[level, 1], z - low[level, 2]
            if not (0 <= i < shape[level, 0] and 0 <= j < shape[level, 1] and 0 <= k < shape[level, 2]):
                continue
            state = np.int64(flat[begin[level] + (i * shape[level, 1] + j) * shape[level, 2] + k])
            word |= state << (2 * child)
            if state == INNER:
                stack[waiting, 0] = level
                stack[waiting, 1] = x
                stack[waiting, 2] = y
                stack[waiting, 3] = z
                waiting += 1
            elif state != _UNKNOWN:
                leaves += 1
        words[written] = word
        written += 1
    return leaves
