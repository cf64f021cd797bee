"""The arrays that functions take and return, by what they hold."""

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
