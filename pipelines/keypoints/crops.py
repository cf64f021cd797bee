"""Crops of a picture as networks see them, and where their pixels lie in it.

Everywhere here the centre of the top left pixel is (0, 0), in pictures and in crops.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.session.records import Float
from pipelines.session.registries import Region

Picture = NDArray[np.uint8]


def sampled(picture: Picture, picture_from_crop: Float, size: tuple[int, int], *, beyond: str) -> Picture:
    """The RGB values [height, width, 3] of a BGR picture where a crop's pixels lie, bilinear.

    OpenCV 4 rounds positions to 1/32 px when it warps, as does the one inside MediaPipe; OpenCV 5 does
    not, which moves landmarks by 0.6 px (median) where the crop is coarser than the picture. Fixed-point
    maps are rounded the same way in both.

    Args:
        picture: [H, W, 3] BGR.
        picture_from_crop: [2, 3] from the crop's pixels to the picture's.
        size: width and height of the crop.
        beyond: what lies around the picture: `edge` repeats its border, `black` is 0.
    """
    import cv2

    x, y = np.empty((2, size[1], size[0]), np.float32)
    column, row = np.arange(size[0]), np.arange(size[1])[:, None]
    for place, line in zip((x, y), picture_from_crop, strict=True):
        # Added up in float64 and rounded once, without an array of float64 in between.
        np.add(line[0] * column, line[1] * row + line[2], out=place, casting="same_kind")
    whole, part = cv2.convertMaps(x, y, cv2.CV_16SC2)
    border = cv2.BORDER_REPLICATE if beyond == "edge" else cv2.BORDER_CONSTANT
    values = cv2.remap(picture, whole, part, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(cv2.cvtColor(values, cv2.COLOR_BGR2RGB), np.uint8)


def upright_crop(region: Region, size: tuple[int, int]) -> Float:
    """[2, 3] picture_from_crop of a region whose side becomes the crop's longer side.

    What MMPose's TopdownAffine makes of a box of 1.25 times the body: the aspect of the network's input
    is kept by widening the box, and the box is not turned. Its middle becomes the middle of the crop's
    pixels, ((width - 1) / 2, (height - 1) / 2); MMPose puts it half a crop pixel beside that, and its
    outputs as well, so that positions agree. They are read off through the same matrix here.
    """
    scale = region.side / max(size)
    middle = np.array([size[0] - 1, size[1] - 1]) / 2
    return np.column_stack([np.eye(2) * scale, np.array(region.centre) - scale * middle])


def in_picture(xy: Float, picture_from_crop: Float) -> Float:
    """Positions [..., 2] of a crop in the picture."""
    moved: Float = xy * np.diag(picture_from_crop[:, :2]) + picture_from_crop[:, 2]
    return moved


def side_of_box(width: float, height: float, size: tuple[int, int], padding: float) -> float:
    """The side of the region that holds a box with that padding, for a network of that input size."""
    longer = max(size)
    return float(padding * max(width * longer / size[0], height * longer / size[1]))
