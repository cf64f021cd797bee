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
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field

from pipelines.formats.common.files import leads_out, read_head, read_yaml
from pipelines.formats.maps.voxel_grids import MapFile, extruded
from pipelines.geometry.arrays import Bool, Float, Float32
from pipelines.session.errors import DataError
from pipelines.session.maps import check_resolution
from pipelines.session.records import Occupancy
from pipelines.session.storage import bad_value, damaged, refuse_special
from pipelines.session.yaml_files import checked
from pipelines.session.yaml_models import YamlModel

if TYPE_CHECKING:
    from PIL import Image

HEIGHT_M = 2.5
"""Height of the walls: an ordinary storey. Drones above it are above the map."""

# A larger plan would exhaust the memory once it is raised to voxels.
_MOST_PIXELS = 100_000_000
_SUFFIXES = (".pgm", ".png")
# White in each of Pillow's modes without colours.
_GREYS = {"1": 1, "L": 255, "I": 65535, "I;16": 65535, "I;16B": 65535}


_Threshold = Annotated[float, Field(ge=0, le=1)]
_Place = Annotated[float, Field(gt=-1e9, lt=1e9)]


class _FloorPlan(YamlModel):
    model_config = ConfigDict(extra="ignore")

    image: str
    mode: Literal["trinary", "scale", "raw"] = "trinary"
    negate: bool
    resolution: float
    origin: tuple[_Place, _Place, _Place]  # x, y, yaw
    occupied_thresh: _Threshold
    free_thresh: _Threshold


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
        return [_find_image(path, _read_plan(path).image)]

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read, turn and extrude the plan; the grid's axes are the world's."""
        plan = _read_plan(path)
        side_m = plan.resolution if resolution_m is None else check_resolution(path, resolution_m)
        x, y, yaw = plan.origin
        turned = np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
        return extruded(
            str(path),
            _probabilities(path, plan),
            plan.resolution,
            (np.array([x, y, 0.0]), turned),
            side_m=side_m,
            height_m=HEIGHT_M,
        )


def _read_plan(path: Path) -> _FloorPlan:
    plan = checked(_FloorPlan, read_yaml(path), path)
    check_resolution(path, plan.resolution)
    if plan.free_thresh > plan.occupied_thresh:
        problem = f"free_thresh {plan.free_thresh:g} is above occupied_thresh {plan.occupied_thresh:g}"
        raise bad_value(path, problem)
    return plan


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
    shade, opaque = _picture(_find_image(path, plan.image))
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
