"""Reader of floor plans of ROS's map_server: a YAML file and the PGM or PNG that it names.

The rules are nav2_map_server's (map_io.cpp). The picture's last row is the lowest y. `origin` is x, y, yaw of
the lower left corner. Darkness is 1 - shade, with `negate` the shade itself. Modes: trinary - above
`occupied_thresh` occupied, below `free_thresh` free, between them unknown; scale - between them in
proportion, transparent pixels unknown; raw - values 0 to 100 are percent, others unknown. A plan is extruded
from z = 0 to `HEIGHT_M`.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.formats.common.files import leads_out, numbers, read_head, read_yaml
from pipelines.formats.maps.voxel_grids import MapFile, extruded
from pipelines.geometry.arrays import Bool, Float, Float32
from pipelines.session.errors import DataError
from pipelines.session.maps import check_resolution
from pipelines.session.records import Occupancy
from pipelines.session.storage import bad_value, damaged, refuse_special

if TYPE_CHECKING:
    from PIL import Image

HEIGHT_M = 2.5
"""Height of the walls: an ordinary storey. Drones above it are above the map."""

# A larger plan would exhaust the memory once it is raised to voxels.
_MOST_PIXELS = 100_000_000
_MODES = ("trinary", "scale", "raw")
_SUFFIXES = (".pgm", ".png")
# White in each of Pillow's modes without colours.
_GREYS = {"1": 1, "L": 255, "I": 65535, "I;16": 65535, "I;16B": 65535}


@dataclass(frozen=True)
class _FloorPlan:
    image: Path
    mode: str
    negate: bool
    resolution_m: float
    origin: tuple[float, float]
    yaw: float
    occupied_thresh: float
    free_thresh: float


class RosMap(MapFile):
    """Reader into voxels with the largest probability met in each: a wall may grow, but never vanishes."""

    name = "ros_map"
    title = "ROS floor plan"
    suffixes: tuple[str, ...] = (".yaml", ".yml")

    def recognises(self, path: Path) -> bool:
        """Return True if the file has the keys that map_server requires."""
        head = read_head(path, self.suffixes)
        keys = ("image", "resolution", "origin", "occupied_thresh")
        return all(re.search(rf"(?m)^{key}\s*:", head) for key in keys)

    def pictures(self, path: Path) -> list[Path]:
        """Return the files that the YAML refers to, because they too determine the map."""
        return [_read_plan(path).image]

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read, turn and extrude the plan; the grid's axes are the world's."""
        plan = _read_plan(path)
        side_m = plan.resolution_m if resolution_m is None else check_resolution(path, resolution_m)
        turned = np.array([0.0, 0.0, math.sin(plan.yaw / 2), math.cos(plan.yaw / 2)])
        return extruded(
            str(path),
            _probabilities(path, plan),
            plan.resolution_m,
            (np.array([*plan.origin, 0.0]), turned),
            side_m=side_m,
            height_m=HEIGHT_M,
        )


def _read_plan(path: Path) -> _FloorPlan:
    values = read_yaml(path)
    missing = [
        key
        for key in ("image", "resolution", "origin", "occupied_thresh", "free_thresh", "negate")
        if key not in values
    ]
    if missing:
        problem = f"lacks {', '.join(missing)}"
        raise DataError(path, problem, "map_server's files have them all", code="missing-column")
    origin = numbers(path, "origin", values["origin"])
    resolution, occupied, free = numbers(
        path,
        "resolution, occupied_thresh, free_thresh",
        [values[k] for k in ("resolution", "occupied_thresh", "free_thresh")],
    ).tolist()
    mode, image = values.get("mode", "trinary"), values["image"]
    if len(origin) != 3 or not np.abs(origin).max() < 1e9:  # also true for NaN
        raise bad_value(path, f"origin is {origin.tolist()} instead of x, y, yaw")
    if not 0 <= free <= occupied <= 1:
        raise bad_value(path, f"free_thresh {free:g} and occupied_thresh {occupied:g} are not 0..1")
    if mode not in _MODES:
        raise DataError(path, f"mode is {str(mode)[:40]!r}", f"known are {', '.join(_MODES)}")
    if values["negate"] not in (0, 1):
        raise DataError(path, f"negate is {str(values['negate'])[:40]!r}", "it must be 0 or 1")
    if not isinstance(image, str):
        raise DataError(path, f"image is {str(image)[:40]!r}", "it must name a PGM or PNG file")
    return _FloorPlan(
        image=_find_image(path, image),
        mode=str(mode),
        negate=bool(values["negate"]),
        resolution_m=check_resolution(path, resolution),
        origin=(float(origin[0]), float(origin[1])),
        yaw=float(origin[2]),
        occupied_thresh=occupied,
        free_thresh=free,
    )


def _find_image(path: Path, image: str) -> Path:
    """Find the picture that is named, or one beside the YAML with its stem, as both are often renamed."""
    named = [] if leads_out(image) else [path.parent / image]
    candidates = [*named, *(path.with_suffix(suffix) for suffix in _SUFFIXES)]
    try:
        return next(candidate for candidate in candidates if candidate.is_file())
    except (StopIteration, OSError, ValueError):  # OSError, ValueError: too long or invalid a name
        problem = f"its picture {image[:200]} is not there"
        raise DataError(path, problem, "put it beside the YAML file", code="no-such-file") from None


def _probabilities(path: Path, plan: _FloorPlan) -> Float32:
    """Read probabilities [W, H] from the lower left corner; NaN is unknown."""
    shade, opaque = _picture(plan.image)
    if plan.mode == "raw":
        percent = np.rint(shade * 255)
        probability = np.where(percent <= 100, percent / 100, np.nan)
    else:
        dark = shade if plan.negate else 1 - shade
        span = max(plan.occupied_thresh - plan.free_thresh, 1e-9)
        between = np.rint((dark - plan.free_thresh) / span * 100) / 100 if plan.mode == "scale" else np.nan
        probability = np.where(
            dark > plan.occupied_thresh, 1.0, np.where(dark < plan.free_thresh, 0.0, between)
        )
        if plan.mode == "scale":
            probability = np.where(opaque, probability, np.nan)
    if np.isnan(probability).all():
        problem = "is an empty map: every pixel is unknown"
        raise DataError(path, problem, "check mode and thresholds", code="empty")
    return np.ascontiguousarray(probability[::-1].T, dtype=np.float32)


def _picture(image: Path) -> tuple[Float, Bool]:
    """Read the mean of the colours [H, W], 0 black to 1 white, and True where the picture is opaque."""
    from PIL import Image, UnidentifiedImageError

    refuse_special(image)
    try:
        with warnings.catch_warnings(), _opened(image) as picture:
            warnings.simplefilter("ignore")  # of Pillow, about damaged tags
            if picture.mode in _GREYS:
                values = np.asarray(picture, dtype=np.float64) / _GREYS[picture.mode]
                return values, np.ones(values.shape, dtype=bool)
            colours = np.asarray(picture.convert("RGBA"), dtype=np.float64) / 255
            return colours[..., :3].mean(axis=2), colours[..., 3] == 1
    except UnidentifiedImageError as error:
        problem = "is no PGM or PNG picture"
        raise DataError(image, problem, "convert it to one of them", code="wrong-kind") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise damaged(image, f"cannot be read as a picture ({str(error)[:100]})") from error


@contextmanager
def _opened(image: Path) -> Iterator[Image.Image]:
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        with Image.open(image, formats=("PPM", "PNG")) as picture:
            width, height = picture.size
            if not 0 < width * height <= _MOST_PIXELS:
                remedy = f"1 to {_MOST_PIXELS / 1e6:g} million are read: crop it"
                raise DataError(image, f"is {width} x {height} pixels", remedy, code="too-large")
            yield picture


FORMAT = RosMap()
