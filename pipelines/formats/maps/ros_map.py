"""Reader of floor plans of ROS's map_server: a YAML file and the PGM or PNG that it names.

The rules are nav2_map_server's (map_io.cpp). The picture's last row is the lowest y. `origin` is x, y, yaw of
the lower left corner. Darkness is 1 - shade, with `negate` the shade itself. Modes: trinary - above
`occupied_thresh` occupied, below `free_thresh` free, between them unknown; scale - between them in
proportion, transparent pixels unknown; raw - values 0 to 100 are percent, others unknown.

A plan has no heights: it is extruded from z = 0 to `HEIGHT_M`.
"""

import math
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.common.files import first_bytes, leads_out, numbers, read_bytes, read_head, read_yaml
from pipelines.formats.maps.voxel_grids import sampled
from pipelines.geometry.arrays import Bool, Float, Float32
from pipelines.session.errors import DataError
from pipelines.session.maps import check_resolution, check_size, describe_grid
from pipelines.session.records import Occupancy

HEIGHT_M = 2.5
"""Height of the walls: an ordinary storey. Drones above it are above the map."""

_MOST_PIXELS = 100_000_000
_MODES = ("trinary", "scale", "raw")
_SUFFIXES = (".pgm", ".png")
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = 33  # bytes: the signature and the chunk IHDR
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_DEFLATE_MOST = 1032  # bytes that one compressed byte can stand for
_MEND = "correct the YAML file"


@dataclass(frozen=True)
class _Plan:
    image: Path
    stated_image: str
    mode: str
    negate: bool
    resolution_m: float
    origin: tuple[float, float]
    yaw: float
    occupied_thresh: float
    free_thresh: float


class RosMap:
    """Reader into voxels of the plan's own resolution, or of a stated one.

    A plan that is turned (yaw), or read at another resolution, is sampled so densely that every pixel is
    met. A voxel takes the largest probability met in it: a wall may grow by a voxel, but never vanishes.
    """

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

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the YAML's values, pixels by state, and the extruded map."""
        plan = _read_plan(path)
        pixels = _probabilities(path, plan)
        summary: dict[str, object] = {"image": plan.image.name}
        if plan.image.name != plan.stated_image:
            summary["image named (absent)"] = plan.stated_image
        occupied, free = int((pixels >= 0.5).sum()), int((pixels < 0.5).sum())
        summary |= {
            "width": pixels.shape[0],
            "height": pixels.shape[1],
            "mode": plan.mode,
            "origin": [*plan.origin, plan.yaw],
            "occupied_pixels": occupied,
            "free_pixels": free,
            "unknown_pixels": pixels.size - occupied - free,
            "extruded_m": HEIGHT_M,
        }
        corner, shape = _box(plan, pixels.shape, plan.resolution_m)
        plane = _plane(plan, pixels, plan.resolution_m)
        return summary | describe_grid(
            plan.resolution_m,
            corner,
            shape,
            occupied=int((plane >= 0.5).sum()) * shape[2],
            free=int((plane < 0.5).sum()) * shape[2],
        )

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read, turn and extrude the plan; the grid's axes are the world's."""
        plan = _read_plan(path)
        side = plan.resolution_m if resolution_m is None else check_resolution(path, resolution_m)
        pixels = _probabilities(path, plan)
        corner, shape = _box(plan, pixels.shape, side)
        check_size(path, shape, side)
        plane = _plane(plan, pixels, side)
        return Occupancy(np.repeat(plane[:, :, None], shape[2], axis=2), corner, side)


def _read_plan(path: Path) -> _Plan:
    values = read_yaml(path)
    missing = [
        key
        for key in ("image", "resolution", "origin", "occupied_thresh", "free_thresh", "negate")
        if key not in values
    ]
    if missing:
        raise DataError(
            path, f"lacks {', '.join(missing)}", "map_server's files have them all", code="missing-column"
        )
    origin = numbers(path, "origin", values["origin"])
    resolution, occupied, free = numbers(
        path,
        "resolution, occupied_thresh, free_thresh",
        [values[k] for k in ("resolution", "occupied_thresh", "free_thresh")],
    ).tolist()
    mode, image = values.get("mode", "trinary"), values["image"]
    if len(origin) != 3 or not np.abs(origin).max() < 1e9:  # also true for NaN
        raise DataError(path, f"origin is {origin.tolist()} instead of x, y, yaw", _MEND, code="bad-value")
    if not 0 <= free <= occupied <= 1:
        raise DataError(
            path,
            f"free_thresh {free:g} and occupied_thresh {occupied:g} are not 0..1",
            _MEND,
            code="bad-value",
        )
    if mode not in _MODES:
        raise DataError(path, f"mode is {str(mode)[:40]!r}", f"known are {', '.join(_MODES)}")
    if values["negate"] not in (0, 1):
        raise DataError(path, f"negate is {str(values['negate'])[:40]!r}", "it must be 0 or 1")
    if not isinstance(image, str):
        raise DataError(path, f"image is {str(image)[:40]!r}", "it must name a PGM or PNG file")
    return _Plan(
        image=_find_image(path, image),
        stated_image=image,
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
        raise DataError(
            path,
            f"its picture {image[:200]} is not there",
            "put it beside the YAML file",
            code="no-such-file",
        ) from None


def _probabilities(path: Path, plan: _Plan) -> Float32:
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
        raise DataError(
            path, "is an empty map: every pixel is unknown", "check mode and thresholds", code="empty"
        )
    return np.ascontiguousarray(probability[::-1].T, dtype=np.float32)


def _picture(image: Path) -> tuple[Float, Bool]:
    """Read the mean of the colours [H, W], 0 black to 1 white, and True where the picture is opaque."""
    head = first_bytes(image, 32)
    if head[:2] in {b"P2", b"P5"}:
        shade = _read_pgm(image)
        return shade, np.ones(shade.shape, dtype=bool)
    if head.startswith(_PNG):
        return _read_png(image)
    raise DataError(image, "is no PGM or PNG picture", "convert it to one of them", code="wrong-kind")


def _read_pgm(image: Path) -> Float:
    content = read_bytes(image)
    # Four words (P5, width, height, largest value) with comments between them, and one blank after them.
    head = re.match(rb"P[25](?:(?:\s|#[^\n]*\n)+(\d{1,9})){3}\s", content)
    words = re.sub(rb"#[^\n]*\n", b" ", head[0]).split() if head else []
    if not head or len(words) != 4:
        raise DataError(image, "is a PGM whose header cannot be read", "save it again", code="damaged")
    width, height, most = (int(word) for word in words[1:])
    if not 0 < most < 1 << 16:
        raise DataError(image, f"is a PGM of values up to {most}", "save it again with 255")
    _check_pixels(image, width, height)
    body = content[head.end() :]
    if words[0] == b"P5":
        kind = np.dtype(">u2" if most > 255 else "u1")
        values: NDArray[Any] = np.frombuffer(
            body, kind, count=min(width * height, len(body) // kind.itemsize)
        )
    else:
        try:
            values = np.array([int(word) for word in body.split()[: width * height]], dtype=np.float64)
        except (ValueError, OverflowError) as error:
            raise DataError(
                image, f"is damaged ({str(error)[:100]})", "save it again", code="damaged"
            ) from error
    if len(values) < width * height:
        raise DataError(
            image,
            f"breaks off: {len(values)} of {width * height} pixels are there",
            "copy it again",
            code="damaged",
        )
    shade: Float = values.reshape(height, width) / most
    if shade.min() < 0 or shade.max() > 1:
        raise DataError(image, f"has values beyond {most}", "save it again")
    return shade


def _read_png(image: Path) -> tuple[Float, Bool]:
    import cv2

    content = read_bytes(image)
    if len(content) < _PNG_HEADER:
        raise DataError(image, "is a PNG that breaks off", "copy it again", code="damaged")
    width, height, bits, kind = struct.unpack_from(">IIBB", content, 16)
    _check_pixels(image, width, height)
    if width * height * bits * _PNG_CHANNELS.get(kind, 1) > 8 * _DEFLATE_MOST * len(content):
        raise DataError(
            image,
            f"does not hold the {width} x {height} pixels that it states",
            "copy it again",
            code="damaged",
        )
    try:
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise DataError(image, f"is damaged ({error.err})", "save it again", code="damaged") from error
    if decoded is None:
        raise DataError(image, "is a damaged PNG", "save it again", code="damaged")
    values = np.asarray(decoded).astype(np.float64) / np.iinfo(decoded.dtype).max
    if values.ndim == 2:
        return values, np.ones(values.shape, dtype=bool)
    opaque = values[..., 3] == 1 if values.shape[2] == 4 else np.ones(values.shape[:2], dtype=bool)
    return values[..., :3].mean(axis=2), opaque


def _check_pixels(image: Path, width: int, height: int) -> None:
    if not 0 < width * height <= _MOST_PIXELS:
        raise DataError(
            image, f"is {width} x {height} pixels", f"1 to {_MOST_PIXELS / 1e6:g} million are read: crop it"
        )


def _box(plan: _Plan, pixels: tuple[int, ...], side: float) -> tuple[Float, tuple[int, int, int]]:
    """Return the lowest corner of the grid that holds the turned plan, and its voxels along x, y, z."""
    extent = np.array(pixels) * plan.resolution_m
    corners = _world_from_plan(plan) @ (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * extent).T
    low, high = corners.min(axis=1), corners.max(axis=1)
    # Less a millionth, so that 3.0000000001 voxels count as three.
    columns, rows, layers = np.ceil(np.array([*(high - low), HEIGHT_M]) / side - 1e-6).astype(int).tolist()
    return np.array([*(low + plan.origin), 0.0]), (max(columns, 1), max(rows, 1), max(layers, 1))


def _world_from_plan(plan: _Plan) -> Float:
    c, s = math.cos(plan.yaw), math.sin(plan.yaw)
    return np.array([[c, -s], [s, c]])


def _plane(plan: _Plan, pixels: Float32, side: float) -> Float32:
    """Turn the plan to the world's axes, [X, Y] from the corner that `_box` returns."""
    if plan.yaw == 0 and side == plan.resolution_m:
        return pixels
    corner, (columns, rows, _) = _box(plan, pixels.shape, side)
    layer = Occupancy(pixels[:, :, None], np.zeros(3), plan.resolution_m)
    return sampled(layer, _world_from_plan(plan), corner[:2] - plan.origin, (columns, rows), side)[:, :, 0]


FORMAT = RosMap()
