"""Occupancy maps of a session: `map/0.npz`, `map/1.npz`, ... and `map/index.json`.

One npz holds one grid. Any program may write one:

- `probability`: float [X, Y, Z], 0..1, NaN where nothing is known. Instead of it `occupancy`: bool, or
  integers as in nav_msgs/OccupancyGrid (0 to 100 percent, -1 unknown).
- `origin`: [3], metres, the corner of voxel (0, 0, 0); `resolution_m`: the side of a voxel.
- `from_ns`: the time from which the map holds; optional, 0.
"""

import math
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import HeldMap, Occupancy
from pipelines.session.storage import as_data_error, jsonable, read_json, refuse_special, write_json

MOST_VOXELS = 200_000_000
"""The most voxels of a grid (0.8 GB as float32); a larger one is refused."""

# After more doublings, voxels of 0.2 m are wider than the trees and walls that they stand for.
MAX_DOUBLINGS_OF_RESOLUTION = 5

FINEST_M, COARSEST_M = 1e-4, 1e4
"""The smallest and the largest side of a voxel; anything else is a mistake in the file."""

# Origin, resolution and time have at most some hundred bytes with their header.
MAX_SMALL_MEMBER_BYTES = 4096
_WRITE_AGAIN = "write it again: probability [X, Y, Z], origin [3], resolution_m"

# zipfile, zlib and numpy's parser of headers raise these on damaged files.
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, EOFError, KeyError, NotImplementedError, OverflowError),
    *(RuntimeError, SyntaxError, TokenError, TypeError, ValueError),
)


def check_resolution(source: Path | str, resolution_m: float) -> float:
    """Return the side of a voxel; DataError if it does not lie within 0.1 mm and 10 km."""
    if not FINEST_M <= resolution_m <= COARSEST_M:
        problem = f"voxels of {resolution_m:g} m are no map"
        raise DataError(source, problem, f"the resolution must lie between {FINEST_M:g} and {COARSEST_M:g} m")
    return resolution_m


class MapSizeError(DataError):
    """Map with too many voxels; `fitting_m` is a resolution, doubled until it fits, or None."""

    def __init__(self, source: Path | str, problem: str, remedy: str, fitting_m: float | None) -> None:
        self.fitting_m = fitting_m
        super().__init__(source, problem, remedy)


def check_size(source: Path | str, shape: Sequence[float], resolution_m: float, remedy: str = "") -> None:
    """Refuse a grid that would not fit, with a MapSizeError and its `remedy`, before it is allocated."""
    voxels = math.prod(float(side) for side in shape)
    if voxels <= MOST_VOXELS:
        return
    fitting_m = next(
        (
            resolution_m * 2**k
            for k in range(1, MAX_DOUBLINGS_OF_RESOLUTION)
            if math.prod(side / 2**k + 1 for side in shape) <= MOST_VOXELS
        ),
        None,
    )
    sides = " x ".join(f"{side:.6g}" for side in shape)
    coarser = f"state resolution_m: {fitting_m:g} or more" if fitting_m else "state a larger resolution_m"
    raise MapSizeError(
        source,
        f"its box is {sides} voxels of {resolution_m:g} m, {voxels * 4 / 1e9:.3g} GB; "
        f"at most {MOST_VOXELS / 1e6:g} million voxels are read",
        f"{remedy}, or {coarser}" if remedy else coarser,
        fitting_m,
    )


def describe_map(occupancy: Occupancy) -> dict[str, object]:
    """Describe a voxel map for `mocap info`: its box, and the number of voxels in each state."""
    held, corner = HeldMap.of(occupancy), occupancy.origin
    return {
        "resolution_m": occupancy.resolution_m,
        "size_voxels": [*held.shape],
        "box_min_m": [round(v, 4) for v in corner.tolist()],
        "box_max_m": [round(v, 4) for v in (corner + np.array(held.shape) * occupancy.resolution_m).tolist()],
        "occupied_voxels": held.occupied,
        "free_voxels": held.free,
        "unknown_voxels": occupancy.probability.size - held.occupied - held.free,
    }


def store_map(folder: Path, occupancies: Iterable[Occupancy]) -> list[HeldMap]:
    """Write `map/` into an existing folder, one map in memory at a time; return the entry of each."""
    place = folder / "map"
    place.mkdir()
    index, held = [], []
    for k, occupancy in enumerate(occupancies):
        write_grid(place / f"{k}.npz", occupancy)
        held.append(HeldMap.of(occupancy))
        index.append(
            {
                "file": f"{k}.npz",
                "from_ns": occupancy.from_ns,
                "shape": occupancy.probability.shape,
                "origin": occupancy.origin,
                "resolution_m": occupancy.resolution_m,
            }
        )
    write_json(place / "index.json", jsonable({"maps": index}))
    return held


def load_maps(session: Path) -> list[Occupancy]:
    """Load the maps of a session in the order they were stored; see `each_map`."""
    return list(each_map(session))


def each_map(session: Path) -> Iterator[Occupancy]:
    """Yield the maps of a session in their order, one in memory at a time; DataError if one is damaged."""
    place = session / "map"
    if not place.exists():
        return
    maps = read_json(place / "index.json").get("maps")
    if not isinstance(maps, list):
        remedy = "ingest the flight again with --force"
        raise DataError(place / "index.json", "holds no list of maps", remedy, code="wrong-kind")
    for k in range(len(maps)):
        yield read_grid(place / f"{k}.npz")


def write_grid(path: Path, occupancy: Occupancy) -> None:
    """Write one map as npz; equal maps give equal bytes."""
    np.savez_compressed(
        path,
        probability=np.ascontiguousarray(occupancy.probability, dtype=np.float32),
        origin=np.asarray(occupancy.origin, dtype=np.float64),
        resolution_m=np.float64(occupancy.resolution_m),
        from_ns=np.int64(occupancy.from_ns),
    )


def read_grid(path: Path) -> Occupancy:
    """Read a map in the layout of the module; DataError: damaged, another layout, too many voxels."""
    refuse_special(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(path, archive)
    except OSError as error:
        raise as_data_error(error, path) from error
    except DataError:
        raise
    except _DAMAGED as error:
        problem = f"is no readable npz ({str(error)[:200]})"
        raise DataError(path, problem, _WRITE_AGAIN, code="damaged") from error


def _read(path: Path, archive: zipfile.ZipFile) -> Occupancy:
    names = {name.removesuffix(".npy") for name in archive.namelist()}
    missing = sorted({"origin", "resolution_m"} - names)
    if len(grid := names & {"probability", "occupancy"}) != 1:
        missing.insert(0, "either probability or occupancy")
    if missing:
        raise DataError(path, f"lacks {', '.join(missing)}", _WRITE_AGAIN, code="missing-column")
    small = {"resolution_m": ("fiu", ()), "origin": ("fiu", (3,)), "from_ns": ("iu", ())}
    for name in names & set(small):
        if archive.getinfo(f"{name}.npy").file_size > MAX_SMALL_MEMBER_BYTES:
            raise ValueError(f"{name} is larger than {MAX_SMALL_MEMBER_BYTES} bytes")
        kinds, shape = small[name]
        if (found := _header(archive, name))[0] != shape or found[1].kind not in kinds:
            problem = f"{name} is {found[1]} {list(found[0])} instead of numbers {list(shape)}"
            raise DataError(path, problem, _WRITE_AGAIN, code="bad-value")
    resolution_m = check_resolution(path, float(_array(archive, "resolution_m")))
    origin: Float = _array(archive, "origin").astype(np.float64)
    if not np.isfinite(origin).all():
        raise DataError(path, "origin is not finite", _WRITE_AGAIN, code="bad-value")
    (name,) = grid
    shape, dtype = _header(archive, name)
    if len(shape) != 3 or dtype.kind not in {"probability": "f", "occupancy": "biu"}[name] or min(shape) < 1:
        raise DataError(path, f"{name} is {dtype} {list(shape)}", _WRITE_AGAIN, code="bad-value")
    check_size(path, shape, resolution_m, "store a coarser or smaller grid")
    values = _array(archive, name)
    is_percent = name == "occupancy" and values.dtype != bool
    low, high = (-1, 100) if is_percent else (0, 1)
    least, largest = np.fmin.reduce(values, axis=None), np.fmax.reduce(values, axis=None)
    if least < low or largest > high:
        worst = least if least < low else largest
        raise DataError(path, f"{name} holds {worst}", "0..1, or -1 and 0..100 percent", code="bad-value")
    if is_percent:
        values = np.where(values == -1, np.nan, values / 100)
    from_ns = int(_array(archive, "from_ns")) if "from_ns" in names else 0
    return Occupancy(values.astype(np.float32), origin, resolution_m, from_ns)


def _header(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of an array; other versions of npy than 1 and 2 are refused."""
    with archive.open(f"{name}.npy") as file:
        readers = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
        shape, _, dtype = readers[np.lib.format.read_magic(file)[0]](file)
    return shape, dtype


def _array(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    with archive.open(f"{name}.npy") as file:
        array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


@dataclass(frozen=True)
class MapSurface:
    """N cubes of whole voxels that cover the surface of a map."""

    middle: Float  # [N, 3] m, world
    cube_m: float  # their side
    voxels: int  # of the map's surface


def surface_of(occupancy: Occupancy, most: int, *, above_m: float = -math.inf) -> MapSurface:
    """Find occupied voxels with a free neighbour that rise above a height, in at most so many cubes."""
    from scipy.ndimage import binary_erosion

    occupied = occupancy.probability >= 0.5  # False where nothing is known
    voxels = np.argwhere(occupied & ~binary_erosion(occupied))
    top_m = occupancy.origin[2] + occupancy.resolution_m * (voxels[:, 2] + 1)
    voxels = voxels[top_m > above_m - 1e-9 * occupancy.resolution_m]
    gathered, cubes = 1, voxels
    while len(cubes) > most:
        gathered += 1
        cubes = np.unique(voxels // gathered, axis=0)
    cube_m = occupancy.resolution_m * gathered
    return MapSurface(occupancy.origin + cube_m * (cubes + 0.5), cube_m, len(voxels))
