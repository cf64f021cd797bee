"""Reader of voxel maps as npz: the layout of a session's own maps, simple enough to write from any script.

    np.savez_compressed("site.npz", probability=p, origin=[x, y, z], resolution_m=0.2)

`pipelines.session.maps` documents each array; this module makes it a format for `map:`.
"""

import math
import zipfile
from pathlib import Path

from pipelines.session.errors import DataError
from pipelines.session.maps import describe_stored, read_grid
from pipelines.session.records import Occupancy


class GridNpz:
    """Reader of a dense grid in its own voxels."""

    name = "npz"
    title = "voxel map (npz)"
    suffixes: tuple[str, ...] = (".npz",)

    def recognises(self, path: Path) -> bool:
        """Return True for an npz that holds a grid and its place."""
        if path.suffix.lower() not in self.suffixes or not path.is_file():
            return False
        try:
            with zipfile.ZipFile(path) as archive:
                names = set(archive.namelist())
        except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
            return False
        return "origin.npy" in names and bool(names & {"probability.npy", "occupancy.npy"})

    def describe(self, path: Path) -> dict[str, object]:
        """Describe box, voxels and their states; the arrays are read part by part."""
        return describe_stored(path)

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read the grid as it is."""
        occupancy = read_grid(path)
        if resolution_m is not None and not math.isclose(resolution_m, occupancy.resolution_m, rel_tol=1e-6):
            raise DataError(
                path,
                f"its voxels are {occupancy.resolution_m:g} m, not {resolution_m:g} m",
                "leave resolution_m out, or store the grid at that resolution",
            )
        return occupancy


FORMAT = GridNpz()
