"""The arrays that functions take and return, by what they hold, and small types beside them."""

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
