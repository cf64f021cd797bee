"""Conversion of logged pictures to BGR: compressed ones, and raw pixels in ROS's layouts.

Names and layouts are those of ROS' sensor_msgs/image_encodings.hpp, which Foxglove's RawImage also uses.
"""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Picture
from pipelines.session.records import PictureSample

_LAYOUTS: dict[str, tuple[int, str | None]] = {
    "mono8": (1, "GRAY2BGR"),
    "8uc1": (1, "GRAY2BGR"),
    "bgr8": (3, None),
    "8uc3": (3, None),
    "rgb8": (3, "RGB2BGR"),
    "bgra8": (4, "BGRA2BGR"),
    "rgba8": (4, "RGBA2BGR"),
    "bayer_rggb8": (1, "BayerRGGB2BGR"),
    "bayer_bggr8": (1, "BayerBGGR2BGR"),
    "bayer_gbrg8": (1, "BayerGBRG2BGR"),
    "bayer_grbg8": (1, "BayerGRBG2BGR"),
    "yuv422": (2, "YUV2BGR_UYVY"),
    "uyvy": (2, "YUV2BGR_UYVY"),
    "yuv422_yuy2": (2, "YUV2BGR_YUY2"),
    "yuyv": (2, "YUV2BGR_YUY2"),
}
"""Bytes of a pixel and the name of OpenCV's conversion (None if none is needed), by encoding."""

KNOWN = tuple(_LAYOUTS)
"""Encodings of raw pictures that can be decoded."""


def is_known(sample: PictureSample) -> bool:
    """Return True if pictures like this one can be decoded; compressed ones must be tried (True)."""
    return sample.width is None or sample.encoding.lower() in _LAYOUTS


def decode(sample: PictureSample) -> Picture | None:
    """Decode a logged picture to BGR [H, W, 3]; None if its bytes are damaged or its encoding is unknown."""
    import cv2

    try:
        decoded = _compressed(sample) if sample.width is None or sample.height is None else _raw(sample)
    except cv2.error:
        return None
    return decoded


def _compressed(sample: PictureSample) -> Picture | None:
    import cv2

    if not len(sample.data):
        return None
    decoded = cv2.imdecode(np.asarray(sample.data, np.uint8), cv2.IMREAD_COLOR)
    return None if decoded is None else np.asarray(decoded, np.uint8)


def _raw(sample: PictureSample) -> Picture | None:
    import cv2

    width, height = sample.width or 0, sample.height or 0
    if not is_known(sample):
        return None
    pixel, conversion = _LAYOUTS[sample.encoding.lower()]
    step = sample.step or width * pixel
    if not width or not height or step < width * pixel or len(sample.data) < step * height:
        return None
    rows = sample.data[: step * height].reshape(height, step)
    pixels = np.ascontiguousarray(rows[:, : width * pixel]).reshape(height, width, pixel)
    if conversion is None:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}")), np.uint8)
