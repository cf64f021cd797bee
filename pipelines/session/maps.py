"""Occupancy maps of a session: `map/0.npz`, `map/1.npz`, ... and `map/index.json`.

One npz (a zip of .npy files) holds one grid. Any program may write one, so these are the rules:

- `probability`: float [X, Y, Z], 0..1, NaN where nothing is known. Instead of it `occupancy`: bool, or
  integers as in nav_msgs/OccupancyGrid (0 to 100 percent, -1 unknown).
- `origin`: [3], metres, the corner of voxel (0, 0, 0); `resolution_m`: the side of a voxel.
- `from_ns`: the time from which the map holds; optional, 0.

The same map gives the same bytes. Nothing in a file is unpickled, and nothing is used before it is checked.
"""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.session.description import HeldMap
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy
from pipelines.session.storage import as_data_error, jsonable, read_json, refuse_special, write_json

MOST_VOXELS = 200_000_000
"""The most voxels of a grid (0.8 GB as float32); a larger one is refused."""

# After more doublings, voxels of 0.2 m are wider than the trees and walls that they stand for.
MAX_DOUBLINGS_OF_RESOLUTION = 5

FINEST_M, COARSEST_M = 1e-4, 1e4
"""The smallest and the largest side of a voxel; anything else is a mistake in the file."""

# A grid is decoded in slabs of this size, so that it is never in memory twice.
SLAB_BYTES = 16 << 20
# Origin, resolution and time have at most some hundred bytes with their header.
MAX_SMALL_MEMBER_BYTES = 4096
_WRITE_AGAIN = "write it again: probability [X, Y, Z], origin [3], resolution_m"

# Exceptions that zipfile, zlib and numpy's header parser raise on damaged files.
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    KeyError,
    NotImplementedError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    TokenError,
    TypeError,
    ValueError,
    struct.error,
)


def check_resolution(source: Path | str, resolution_m: float) -> float:
    """Return the side of a voxel, or refuse one that cannot be right.

    Raises:
        DataError: not a number, or not within 0.1 mm and 10 km.
    """
    if not FINEST_M <= resolution_m <= COARSEST_M:
        raise DataError(
            source,
            f"voxels of {resolution_m:g} m are no map",
            f"the resolution must lie between {FINEST_M:g} and {COARSEST_M:g} m",
        )
    return resolution_m


class MapSizeError(DataError):
    """Map with too many voxels; `fitting_m` is a resolution, doubled until it fits, or None."""

    def __init__(self, source: Path | str, problem: str, remedy: str, fitting_m: float | None) -> None:
        self.fitting_m = fitting_m
        super().__init__(source, problem, remedy)


def check_size(source: Path | str, shape: Sequence[float], resolution_m: float, remedy: str = "") -> None:
    """Refuse a grid that would not fit, before anything is allocated for it.

    Args:
        source: for the message.
        shape: voxels along each axis; floats where they come from unchecked coordinates.
        resolution_m: side of a voxel.
        remedy: what the user can do to make it smaller, beside a larger resolution.

    Raises:
        MapSizeError: more than `MOST_VOXELS`, or a shape that is not finite.
    """
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


def describe_grid(
    resolution_m: float, origin: Float, shape: Sequence[int], *, occupied: int, free: int
) -> dict[str, object]:
    """Describe a voxel map for `mocap info`: its box, and the number of voxels in each state."""
    corner = origin + np.asarray(shape) * resolution_m
    return {
        "resolution_m": resolution_m,
        "size_voxels": [int(side) for side in shape],
        "box_min_m": [round(v, 4) for v in origin.tolist()],
        "box_max_m": [round(v, 4) for v in corner.tolist()],
        "occupied_voxels": occupied,
        "free_voxels": free,
        "unknown_voxels": math.prod(int(side) for side in shape) - occupied - free,
    }


def store_map(folder: Path, occupancies: Iterable[Occupancy]) -> list[HeldMap]:
    """Write `map/` into an existing folder (a session, or a stage that is being written).

    The maps are taken one at a time, so that a log's many maps need not be in memory together.

    Args:
        occupancies: at least one, in the order of the times from which they hold.

    Returns:
        The entry of each map, in the same order.
    """
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
    """Load the maps of a session in the order they were stored; an empty list without `map/`.

    Raises:
        DataError: the index or a map is missing or damaged.
    """
    return list(each_map(session))


def each_map(session: Path) -> Iterator[Occupancy]:
    """Yield the maps of a session in the order they were stored, one in memory at a time.

    Raises:
        DataError: the index or a map is missing or damaged.
    """
    place = session / "map"
    if not place.exists():
        return
    maps = read_json(place / "index.json").get("maps")
    if not isinstance(maps, list):
        raise DataError(
            place / "index.json",
            "holds no list of maps",
            "ingest the flight again with --force",
            code="wrong-kind",
        )
    for k in range(len(maps)):
        yield read_grid(place / f"{k}.npz")


def write_grid(path: Path, occupancy: Occupancy) -> None:
    """Write one map as npz; equal maps give equal bytes (numpy's own savez writes the time of day)."""
    members: dict[str, NDArray[Any]] = {
        "probability": np.ascontiguousarray(occupancy.probability, dtype=np.float32),
        "origin": np.asarray(occupancy.origin, dtype=np.float64),
        "resolution_m": np.asarray(occupancy.resolution_m, dtype=np.float64),
        "from_ns": np.asarray(occupancy.from_ns, dtype=np.int64),
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in members.items():
            info = zipfile.ZipInfo(f"{name}.npy")  # its date is 1980-01-01
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3  # the same on every system
            info.external_attr = 0o644 << 16
            with archive.open(info, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, version=(1, 0), allow_pickle=False)


def read_grid(path: Path) -> Occupancy:
    """Read one map in the layout of the module's docstring, whichever program wrote it.

    Raises:
        DataError: no zip, damaged, arrays missing or of another shape or kind, a probability outside 0..1,
            an impossible resolution, or more than `MOST_VOXELS`.
    """
    with _StoredGrid(path) as stored:
        probability = np.empty(stored.header.shape, dtype=np.float32)
        for place, slab in stored.slabs():
            probability[place] = slab
        return Occupancy(probability, stored.origin, stored.resolution_m, stored.from_ns)


def describe_stored(path: Path) -> dict[str, object]:
    """Describe a stored map (box, voxels, states), one slab in memory at a time.

    Raises:
        DataError: as `read_grid`.
    """
    with _StoredGrid(path) as stored:
        occupied = known = 0
        for _, slab in stored.slabs():
            occupied += int((slab >= 0.5).sum())
            known += int((~np.isnan(slab)).sum())
        return {
            "array": stored.header.name,
            "dtype": str(stored.header.dtype),
            **describe_grid(
                stored.resolution_m,
                stored.origin,
                stored.header.shape,
                occupied=occupied,
                free=known - occupied,
            ),
            "from_ns": stored.from_ns,
        }


@dataclass(frozen=True)
class _Header:
    name: str  # probability or occupancy
    shape: tuple[int, int, int]
    fortran_order: bool
    dtype: np.dtype[Any]
    offset: int  # where the numbers begin


class _StoredGrid:
    """An open npz whose header and small arrays were checked."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> _StoredGrid:
        refuse_special(self._path)
        try:
            self._archive = zipfile.ZipFile(self._path)
        except OSError as error:
            raise as_data_error(error, self._path) from error
        except _DAMAGED as error:
            raise self._damaged(error) from error
        try:
            self._read_headers()
        except BaseException:
            self._archive.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    def _read_headers(self) -> None:
        names = set(self._archive.namelist())
        grids = [name for name in ("probability", "occupancy") if f"{name}.npy" in names]
        missing = [name for name in ("origin", "resolution_m") if f"{name}.npy" not in names]
        if len(grids) != 1:
            missing.insert(0, "either probability or occupancy")
        if missing:
            raise DataError(self._path, f"lacks {', '.join(missing)}", _WRITE_AGAIN, code="missing-column")
        self.resolution_m = check_resolution(self._path, float(self._small("resolution_m", "fiu", ())))
        self.origin: Float = self._small("origin", "fiu", (3,)).astype(np.float64)
        if not np.isfinite(self.origin).all():
            raise DataError(self._path, "origin is not finite", _WRITE_AGAIN, code="bad-value")
        self.from_ns = int(self._small("from_ns", "iu", ())) if "from_ns.npy" in names else 0
        try:
            self.header = self._grid_header(grids[0])
        except (*_DAMAGED, OSError) as error:
            raise self._damaged(error) from error

    def _small(self, name: str, kinds: str, shape: tuple[int, ...]) -> NDArray[Any]:
        member = f"{name}.npy"
        try:
            info = self._archive.getinfo(member)
            if max(info.file_size, info.compress_size) > MAX_SMALL_MEMBER_BYTES:
                raise ValueError(f"{name} is larger than {MAX_SMALL_MEMBER_BYTES} bytes")
            array: NDArray[Any] = np.lib.format.read_array(
                BytesIO(self._archive.read(member)), allow_pickle=False
            )
        except (*_DAMAGED, OSError) as error:
            raise self._damaged(error) from error
        if array.dtype.kind not in kinds or array.shape != shape:
            raise DataError(
                self._path,
                f"{name} is {array.dtype} {list(array.shape)} instead of numbers {list(shape)}",
                _WRITE_AGAIN,
                code="bad-value",
            )
        return array

    def _grid_header(self, name: str) -> _Header:
        with self._archive.open(f"{name}.npy") as file:
            version = np.lib.format.read_magic(file)
            read = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }.get(version)
            if read is None:
                raise ValueError(f"npy version {version}")
            shape, fortran_order, dtype = read(file)
            offset = file.tell()
        if len(shape) != 3 or dtype.kind not in {"probability": "f", "occupancy": "biu"}[name]:
            raise DataError(self._path, f"{name} is {dtype} {list(shape)}", _WRITE_AGAIN)
        if min(shape) < 1:
            raise DataError(self._path, f"{name} is empty, {list(shape)}", _WRITE_AGAIN)
        check_size(self._path, shape, self.resolution_m, "store a coarser or smaller grid")
        stated = self._archive.getinfo(f"{name}.npy").file_size
        if stated != offset + math.prod(shape) * dtype.itemsize:
            raise ValueError(f"{stated} bytes do not hold {list(shape)} of {dtype}")
        return _Header(name, shape, fortran_order, dtype, offset)

    def slabs(self) -> Iterator[tuple[tuple[slice, ...], NDArray[np.float32]]]:
        """Yield the place of each part in the grid and its probabilities, part after part."""
        header = self.header
        stored_shape = header.shape[::-1] if header.fortran_order else header.shape
        layer_bytes = stored_shape[1] * stored_shape[2] * header.dtype.itemsize
        step = max(1, SLAB_BYTES // layer_bytes)
        try:
            with self._archive.open(f"{header.name}.npy") as file:
                file.read(header.offset)
                for first in range(0, stored_shape[0], step):
                    last = min(first + step, stored_shape[0])
                    slab = np.frombuffer(_read_exactly(file, (last - first) * layer_bytes), header.dtype)
                    slab = slab.reshape(last - first, *stored_shape[1:])
                    place = (slice(first, last), slice(None), slice(None))
                    if header.fortran_order:
                        slab, place = slab.T, place[::-1]
                    yield place, self._as_probability(slab)
        except (*_DAMAGED, OSError) as error:
            raise self._damaged(error) from error

    def _as_probability(self, values: NDArray[Any]) -> NDArray[np.float32]:
        if self.header.name == "probability":
            usable, probability = np.isnan(values) | ((values >= 0) & (values <= 1)), values
        elif values.dtype == bool:
            usable, probability = np.True_, values
        else:
            usable = (values <= 100) & ((values >= 0) | (values == -1))
            probability = np.where(values == -1, np.nan, values / 100)
        if not np.all(usable):
            worst = values[~usable].flat[0]
            raise DataError(self._path, f"{self.header.name} holds {worst}", "0..1, or -1 and 0..100 percent")
        with np.errstate(invalid="ignore"):  # a NaN that signals becomes one that does not
            return probability.astype(np.float32)

    def _damaged(self, error: BaseException) -> DataError:
        return DataError(self._path, f"is no readable npz ({str(error)[:200]})", _WRITE_AGAIN, code="damaged")


def _read_exactly(file: IO[bytes], size: int) -> bytearray:
    content = bytearray()
    while len(content) < size:
        part = file.read(size - len(content))
        if not part:
            raise EOFError(f"it breaks off, {size - len(content)} bytes are missing")
        content += part
    return content
