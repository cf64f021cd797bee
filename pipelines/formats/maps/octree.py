"""Compiled walks of OctoMap's trees, from a stream to leaves, and of LZF streams.

This module is imported where it is used, because numba takes long to import.
"""

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bytes, Float32, Int32, Int64
from pipelines.geometry.compilation import cached

# OctoMap's trees always have this many levels.
DEPTH = 16
UNKNOWN, FREE, OCCUPIED, INNER = 0, 1, 2, 3  # values of the two bits that a .bt has for every child
BREAKS_OFF, TOO_DEEP = -1, -2


# The stack holds at most seven siblings of every level above the current node, and its eight children.
_STACK = 8 * (DEPTH + 1)


@cached
def walk_binary(
    words: NDArray[np.uint16], key: Int32, depth: Bytes, log_odds: Float32, free: float, occupied: float
) -> int:
    """Write the leaves of a .bt tree, a word per inner node; return the number of words, or an error."""
    stack = np.empty((_STACK, 4), dtype=np.int64)
    stack[0] = 0
    waiting, read, leaves = 1, 0, 0
    while waiting:
        waiting -= 1
        x, y, z, level = stack[waiting]
        if read == len(words):
            return BREAKS_OFF
        word = np.int64(words[read])
        read += 1
        half = 1 << (DEPTH - 1 - level)
        for child in range(7, -1, -1):  # downwards, so that the first child is on top
            state = (word >> (2 * child)) & 3
            if state == 0:
                continue
            child_x = x + half * (child & 1)
            child_y = y + half * ((child >> 1) & 1)
            child_z = z + half * (child >> 2)
            if state == INNER:
                if level + 1 == DEPTH:
                    return TOO_DEEP
                stack[waiting, 0] = child_x
                stack[waiting, 1] = child_y
                stack[waiting, 2] = child_z
                stack[waiting, 3] = level + 1
                waiting += 1
            else:
                key[leaves, 0] = child_x
                key[leaves, 1] = child_y
                key[leaves, 2] = child_z
                depth[leaves] = level + 1
                log_odds[leaves] = occupied if state == OCCUPIED else free
                leaves += 1
    return read


@cached
def walk_full(children: Bytes, node: Int32, key: Int32, depth: Bytes) -> int:
    """Find the leaves of a .ot tree, `children` [N] its bit masks: record and position; see `walk_binary`."""
    stack = np.empty((_STACK, 4), dtype=np.int64)
    stack[0] = 0
    waiting, read, leaves = 1, 0, 0
    while waiting:
        waiting -= 1
        x, y, z, level = stack[waiting]
        if read == len(children):
            return BREAKS_OFF
        mask = np.int64(children[read])
        if mask == 0:
            node[leaves] = read
            key[leaves, 0] = x
            key[leaves, 1] = y
            key[leaves, 2] = z
            depth[leaves] = level
            leaves += 1
        elif level == DEPTH:
            return TOO_DEEP
        read += 1
        half = 1 << max(DEPTH - 1 - level, 0)
        for child in range(7, -1, -1):
            if (mask >> child) & 1:
                stack[waiting, 0] = x + half * (child & 1)
                stack[waiting, 1] = y + half * ((child >> 1) & 1)
                stack[waiting, 2] = z + half * (child >> 2)
                stack[waiting, 3] = level + 1
                waiting += 1
    return read


@cached
def fill(grid: Float32, key: Int32, depth: Bytes, probability: Float32, low: Int64, halvings: int) -> None:
    """Set voxels of `grid` (2 ** halvings wide, from key `low`) to the largest probability inside them."""
    for leaf in range(len(depth)):
        side = max(1, (1 << (DEPTH - np.int64(depth[leaf]))) >> halvings)
        x0 = (np.int64(key[leaf, 0]) >> halvings) - low[0]
        y0 = (np.int64(key[leaf, 1]) >> halvings) - low[1]
        z0 = (np.int64(key[leaf, 2]) >> halvings) - low[2]
        value = probability[leaf]
        for x in range(x0, x0 + side):
            for y in range(y0, y0 + side):
                for z in range(z0, z0 + side):
                    if not grid[x, y, z] >= value:  # also true for NaN, the unknown voxels
                        grid[x, y, z] = value


@cached
def decompress(packed: Bytes, target: Bytes) -> int:
    """Fill `target` from an LZF stream; return the bytes written, or -1 if it is damaged.

    The stream (liblzf by Marc Lehmann, lzf_d.c) is a sequence of instructions, each with a byte c first. c <
    32: copy the c + 1 bytes that follow. Else repeat (c >> 5) + 2 bytes of the output (if c >> 5 is 7, a byte
    to add to the length follows) from ((c & 31) << 8) + next byte + 1 bytes back; the two may overlap.
    """
    read, written = 0, 0
    while read < len(packed):
        control = int(packed[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > len(packed) or written + length > len(target):
                return -1
            for k in range(length):
                target[written + k] = packed[read + k]
            read += length
        else:
            length = (control >> 5) + 2
            if length == 9 and read < len(packed):
                length += int(packed[read])
                read += 1
            if read >= len(packed):
                return -1
            source = written - ((control & 31) << 8) - int(packed[read]) - 1
            read += 1
            if source < 0 or written + length > len(target):
                return -1
            for k in range(length):  # one by one, because the two ranges may overlap
                target[written + k] = target[source + k]
        written += length
    return written
