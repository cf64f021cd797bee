"""Pictures for recordings: small JPEGs, with the intrinsics of that size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.cameras import Intrinsics, rescaled
from pipelines.session.errors import DataError

_WIDEST_PX = 960
_QUALITY = 85


def as_jpeg(camera: str, picture: NDArray[np.uint8], lens: Intrinsics) -> tuple[Intrinsics, bytes]:
    """Shrink a BGR picture [height, width, 3] to at most 960 px in width; return its intrinsics and JPEG.

    Raises:
        DataError: the picture cannot be encoded.
    """
    import cv2

    height, width = picture.shape[:2]
    if width > _WIDEST_PX:
        size = (_WIDEST_PX, round(height * _WIDEST_PX / width))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise DataError(camera, "has a picture that cannot be encoded as JPEG", "add --pictures-hz 0")
    return rescaled(lens, picture.shape[1], picture.shape[0]), jpeg.tobytes()
