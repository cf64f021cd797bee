"""Arrays by what they hold, and the plain types that every other module shares: lens, place, clock."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Index = NDArray[np.intp]
Int8 = NDArray[np.int8]
Bytes = NDArray[np.uint8]
Picture = NDArray[np.uint8]  # [height, width, 3], blue, green, red; or [height, width], grey

RelativeTo = Literal["world", "body", "heading"]
"""The reference of a gimbal's angles. Heading: yaw from the nose, pitch and roll from the horizon."""


DistortionModel = Literal["none", "radtan", "fisheye"]

COEFFICIENT_COUNTS: dict[str, tuple[int, ...]] = {"none": (0,), "radtan": (4, 5, 8), "fisheye": (4,)}
"""The allowed numbers of distortion coefficients of each model."""


# Over the picture's width. A fisheye lens of 220 deg whose circle is half as wide as the picture has 0.13.
MIN_FOCAL_SHARE = 0.05

# Of the sides: principal points of whole pictures lie nearer to the middle (a few per cent), and those of
# calibrations of another usual size (3/4, 2/3, 1/2 of it) farther.
FAR_OFF_CENTRE = 0.1


@dataclass(frozen=True)
class Intrinsics:
    """The intrinsic parameters of a camera, in pixels of a `width` x `height` picture.

    `radtan` is OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]], `fisheye` is OpenCV's k1 k2 k3 k4 (equidistant).
    The centre of the top left pixel is (0, 0). `readout_s` is the time a rolling shutter takes from the first
    to the last row; a picture's stamp is its middle row's. ValueError names all that is wrong with the
    numbers.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        problems = []
        if not all(float(size).is_integer() and size > 0 for size in (self.width, self.height)):
            problems.append(f"picture size {self.width} x {self.height} is not positive whole numbers")
        if not all(np.isfinite(focal) and focal > 0 for focal in (self.fx, self.fy)):
            problems.append(f"focal lengths {self.fx}, {self.fy} px are not positive")
        elif min(self.fx, self.fy) < MIN_FOCAL_SHARE * self.width:
            shortest_px = MIN_FOCAL_SHARE * self.width
            problems.append(f"focal lengths {self.fx:g}, {self.fy:g} are below {shortest_px:g} px: in mm?")
        if not np.isfinite([self.cx, self.cy]).all():
            problems.append(f"principal point {self.cx}, {self.cy} px is not finite")
        if not (np.isfinite(self.readout_s) and self.readout_s >= 0):
            problems.append(f"readout time {self.readout_s} s is not a time")
        counts = COEFFICIENT_COUNTS.get(self.model)
        if counts is None:
            problems.append(f"distortion model {self.model} is none of {', '.join(COEFFICIENT_COUNTS)}")
        elif len(self.distortion) not in counts:
            expected = " or ".join(str(count) for count in counts)
            problems.append(f"{self.model} has {len(self.distortion)} coefficients instead of {expected}")
        if not np.isfinite(self.distortion).all():
            problems.append(f"distortion coefficients {list(self.distortion)} are not all finite")
        if problems:
            raise ValueError("; ".join(problems))
        # A reader may give numbers of NumPy, which JSON does not take.
        plain = {"width": int, "height": int, "fx": float, "fy": float, "cx": float, "cy": float}
        for name, kind in plain.items():
            object.__setattr__(self, name, kind(getattr(self, name)))
        object.__setattr__(self, "distortion", tuple(map(float, self.distortion)))

    @property
    def off_centre(self) -> float:
        """Distance of the principal point from the middle of the picture, as a share of its sides."""
        x, y = (self.cx + 0.5) / self.width, (self.cy + 0.5) / self.height
        return max(abs(x - 0.5), abs(y - 0.5))


@dataclass(frozen=True)
class Place:
    """A point on Earth, WGS84."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


@dataclass(frozen=True)
class ClockFit:
    """The other clock's reading is `at_ns + offset_ns + (t - at_ns) * drift`, for a reading t of this one."""

    at_ns: int  # reading of this clock, in the middle of the events
    offset_ns: int  # other - this, at `at_ns`
    drift_ppm: float  # 0 if it is not significant
    drift_sigma_ppm: float
    residual_s: float  # scatter of the events about the line: 1.4826 times their median deviation
    events: int  # that were compared
    rejected: int  # of them, further than six times the scatter from the line
    steps_s: tuple[float, ...] = ()  # of the other clock, taken out so that its last readings count

    def other_ns(self, t_ns: Int64) -> Int64:
        """Convert times of this clock to readings of the other; exact integers except for the drift."""
        drifted = np.rint((t_ns - self.at_ns) * (self.drift_ppm * 1e-6)).astype(np.int64)
        moved: Int64 = t_ns + (self.offset_ns + drifted)
        return moved


def known_median(values: Float, axis: int) -> Float:
    """Return the median without NaN along an axis, by sorting; NaN where there is nothing else."""
    ordered = np.sort(values, axis=axis)
    count = np.isfinite(ordered).sum(axis=axis, keepdims=True)
    low, high = np.maximum((count - 1) // 2, 0), np.maximum(count // 2, 0)
    middle = (np.take_along_axis(ordered, low, axis) + np.take_along_axis(ordered, high, axis)) / 2
    return np.asarray(np.squeeze(middle, axis))


def nearest_rows(ascending: Int64, values: Int64) -> Int64:
    """Find the row of ascending numbers that is nearest to each value; of two the earlier."""
    last = len(ascending) - 1
    after = np.clip(np.searchsorted(ascending, values), min(1, last), last)
    before = np.maximum(after - 1, 0)
    is_after = ascending[after] - values < values - ascending[before]
    return np.where(is_after, after, before).astype(np.int64)


def best_pairs(worth: Float | Int64) -> tuple[Int64, Int64]:
    """Pair rows and columns [N, M] so that the sum of their worth is the largest: rows and columns."""
    if worth.size and 1 in worth.shape:
        best = int(worth.argmax())
        return np.array([best // worth.shape[1]]), np.array([best % worth.shape[1]])
    from scipy.optimize import linear_sum_assignment  # takes longer to load than all the rest

    row, column = linear_sum_assignment(worth, maximize=True)
    return row, column
