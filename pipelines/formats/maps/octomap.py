"""Reader of OctoMap trees: `.bt` (each leaf occupied or free) and `.ot` (each node's log odds).

Layout (octomap 1.10, OcTreeBaseImpl.hxx and OccupancyOcTreeBase.hxx), little-endian, nodes depth first:

- a text header: one of the first lines below, `id`, `size` (nodes), `res` (side of the finest voxel), `data`;
  or, in the oldest .bt, 16 bytes: int32 3, float64 res, uint32 size.
- .bt: two bytes for every inner node, two bits for every child: 0 unknown, 1 free, 2 occupied, 3 inner.
- .ot: for every node its float32 log odds (then three bytes of colour in a ColorOcTree) and a byte whose bits
  mark the children that follow. The values of inner nodes summarise their leaves and are ignored.

Child i lies on the upper side of x, y, z if its bits 0, 1, 2 are set. The root is 2 ** 16 finest voxels
wide and centred on the world's origin; a leaf above the finest depth stands for all voxels within it.
"""

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import first_bytes, read_bytes, split_header
from pipelines.formats.maps.voxel_grids import MapFile
from pipelines.geometry.arrays import Bytes, Float32, Int32, Int64
from pipelines.session.errors import DataError
from pipelines.session.maps import check_resolution, check_size
from pipelines.session.records import Occupancy
from pipelines.session.storage import bad_value, damaged

# OctoMap's trees always have this many levels.
DEPTH = 16
# The world's origin lies in the middle of the tree.
_CENTRE = 1 << (DEPTH - 1)

# A .bt has no probabilities. Its leaves get the limits to which OctoMap clamps by default
# (AbstractOccupancyOcTree's constructor), as in OctoMap itself.
FREE_PROBABILITY, OCCUPIED_PROBABILITY = 0.1192, 0.971

_BINARY = b"# Octomap OcTree binary file"
_FULL = b"# Octomap OcTree file"
_LEGACY = struct.Struct("<idI")
# The oldest .bt files begin with this number.
_LEGACY_TYPE = 3
_RECORD_BYTES = {"OcTree": 5, "ColorOcTree": 8}  # of a node in a .ot


@dataclass(frozen=True)
class Leaves:
    """Known leaves of a tree."""

    key: Int32  # [L, 3] lowest corner, in finest voxels, 0 at the lower end of the tree
    depth: Bytes  # [L] 0 root, 16 finest
    log_odds: Float32  # [L] ln(p / (1 - p))
    nodes: int

    def extent(self) -> tuple[Int64, Int64]:
        """Return the lowest and highest corner of all leaves, in finest voxels from the world's origin."""
        key = self.key.astype(np.int64)
        corner = key + (1 << (DEPTH - self.depth.astype(np.int64)))[:, None]
        return key.min(axis=0) - _CENTRE, corner.max(axis=0) - _CENTRE


class OctomapFormat(MapFile):
    """Reader into the tree's voxels, or 2, 4, 8, ... times wider ones with the largest probability inside."""

    name = "octomap"
    title = "OctoMap"
    suffixes: tuple[str, ...] = (".bt", ".ot")

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins like OctoMap's files."""
        head = first_bytes(path, 64, suffixes=self.suffixes)
        return head.startswith((_BINARY, _FULL)) or _is_legacy(head)

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read the whole tree into a grid of its box."""
        finest_m, leaves = _read(path)
        return occupancy_from(path, leaves, finest_m, resolution_m)


def occupancy_from(
    source: Path | str, leaves: Leaves, finest_m: float, resolution_m: float | None
) -> Occupancy:
    """Build the dense grid of a tree's box with a leaf; `resolution_m` is `finest_m` or so many times 2."""
    from pipelines.formats.maps.octree import fill

    halvings = _halvings(source, finest_m, resolution_m)
    side_m = finest_m * 2**halvings
    low, high = leaves.extent()
    first, end = low >> halvings, -(-high >> halvings)
    shape = tuple((end - first).tolist())
    check_size(source, shape, side_m, "crop the map")
    grid = np.full(shape, np.nan, dtype=np.float32)
    with np.errstate(over="ignore"):  # exp(large) is inf, and the probability 0
        probability = (1 / (1 + np.exp(-leaves.log_odds))).astype(np.float32)
    fill(grid, leaves.key, leaves.depth, probability, first + (_CENTRE >> halvings), halvings)
    return Occupancy(grid, first.astype(np.float64) * side_m, side_m)


def leaves_of(source: Path | str, payload: Bytes, *, is_binary: bool, tree: str) -> Leaves:
    """Find the leaves of the bytes behind the header of a .bt (`is_binary`) or .ot, as octomap_msgs has."""
    if is_binary:
        return binary_leaves(source, payload)
    if tree not in _RECORD_BYTES:
        problem = f"is a {tree[:40]}, whose nodes are not known"
        raise DataError(source, problem, f"save it as {' or '.join(_RECORD_BYTES)}, or as .bt")
    return full_leaves(source, payload, _RECORD_BYTES[tree])


def binary_leaves(source: Path | str, payload: Bytes) -> Leaves:
    """Find the leaves of a .bt's data, also as in octomap_msgs/Octomap."""
    from pipelines.formats.maps.octree import walk_binary

    words = payload[: len(payload) // 2 * 2].view("<u2")
    # The bit pairs 01 and 10 are leaves: those whose bits differ.
    leaves = int(np.bitwise_count((words ^ (words >> 1)) & 0x5555).sum(dtype=np.int64))
    key, depth = np.empty((leaves, 3), np.int32), np.empty(leaves, np.uint8)
    log_odds = np.empty(leaves, np.float32)
    used = walk_binary(
        words, key, depth, log_odds, _log_odds(FREE_PROBABILITY), _log_odds(OCCUPIED_PROBABILITY)
    )
    _check_walk(source, used, 2, len(payload))
    return Leaves(key, depth, log_odds, nodes=used + leaves)


def full_leaves(source: Path | str, payload: Bytes, record_bytes: int) -> Leaves:
    """Find the leaves of a .ot's data, also as in octomap_msgs/Octomap."""
    from pipelines.formats.maps.octree import walk_full

    records = payload[: len(payload) // record_bytes * record_bytes].reshape(-1, record_bytes)
    children = np.ascontiguousarray(records[:, -1])
    leaves = int((children == 0).sum())
    node, key = np.empty(leaves, np.int32), np.empty((leaves, 3), np.int32)
    depth = np.empty(leaves, np.uint8)
    used = walk_full(children, node, key, depth)
    _check_walk(source, used, record_bytes, len(payload))
    log_odds = np.ascontiguousarray(records[node, :4]).view("<f4")[:, 0]
    if not np.isfinite(log_odds).all():
        bad = int((~np.isfinite(log_odds)).sum())
        raise bad_value(source, f"{bad} leaves have log odds that are not finite")
    return Leaves(key, depth, log_odds, nodes=used)


def _read(path: Path) -> tuple[float, Leaves]:
    """Return the side of the finest voxel, and the leaves."""
    content = read_bytes(path)
    tree, is_binary = "OcTree", not content.startswith(_FULL)
    if _is_legacy(content):
        _, resolution_m, nodes = _LEGACY.unpack_from(content)
        payload = np.frombuffer(content, np.uint8)[_LEGACY.size :]
    elif not content.startswith((_BINARY, _FULL)):
        problem = "is no OctoMap file"
        raise DataError(path, problem, f"its first line must be {_BINARY.decode()!r}", code="wrong-kind")
    else:
        lines, payload = split_header(path, content, "data")
        values = {words[0]: words[1] for words in lines if len(words) == 2}
        try:
            resolution_m = float(values["res"])
            nodes = int(values["size"]) if "size" in values else None
        except KeyError as error:
            raise damaged(path, "its header states no res") from error
        except ValueError as error:
            raise damaged(path, f"its header cannot be read ({str(error)[:100]})") from error
        tree = values.get("id", tree)
    check_resolution(path, resolution_m)
    leaves = leaves_of(path, payload, is_binary=is_binary, tree=tree)
    if nodes not in (None, leaves.nodes):
        raise damaged(path, f"has {leaves.nodes} nodes where its header states {nodes}")
    if not len(leaves.depth):
        raise DataError(path, "is an empty map: nothing in it is known", "leave `map:` out", code="empty")
    return resolution_m, leaves


def _is_legacy(content: bytes) -> bool:
    return len(content) >= _LEGACY.size and _LEGACY.unpack_from(content)[0] == _LEGACY_TYPE


def _check_walk(source: Path | str, used: int, unit_bytes: int, payload_bytes: int) -> None:
    from pipelines.formats.maps.octree import BREAKS_OFF, TOO_DEEP

    if used == BREAKS_OFF:
        raise damaged(source, f"its tree breaks off after {payload_bytes} bytes")
    if used == TOO_DEEP:
        raise damaged(source, f"its tree is damaged: deeper than {DEPTH} levels")
    if used * unit_bytes != payload_bytes:
        extra = payload_bytes - used * unit_bytes
        raise damaged(source, f"has {extra} bytes beyond its tree")


def _log_odds(probability: float) -> float:
    return math.log(probability / (1 - probability))


def _halvings(source: Path | str, finest_m: float, resolution_m: float | None) -> int:
    """Return the number of tree levels that are merged to reach a resolution."""
    if resolution_m is None:
        return 0
    halvings = round(math.log2(check_resolution(source, resolution_m) / finest_m))
    if not 0 <= halvings <= DEPTH or not math.isclose(finest_m * 2**halvings, resolution_m, rel_tol=1e-6):
        problem = f"its voxels of {finest_m:g} m cannot be merged to {resolution_m:g} m"
        remedy = f"state resolution_m: {finest_m:g}, {2 * finest_m:g}, {4 * finest_m:g}, ..."
        raise DataError(source, problem, remedy)
    return halvings


FORMAT = OctomapFormat()
