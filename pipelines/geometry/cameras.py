"""Camera intrinsics with distortion: from points in the camera's frame to pixels and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
DistortionModel = Literal["none", "radtan", "fisheye"]


@dataclass(frozen=True)
class Intrinsics:
    """A camera's inner geometry, in pixels of a `width` x `height` picture.

    `radtan` is OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]], `fisheye` is OpenCV's k1 k2 k3 k4
    (equidistant). The centre of the top left pixel is (0, 0). `readout_s` is the time a rolling
    shutter takes from the first to the last row, 0 when unknown.
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
