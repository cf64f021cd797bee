"""Crops of a picture for networks, and the positions of their pixels in the picture.

Everywhere here the centre of the top left pixel is (0, 0), in pictures and in crops.
"""

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Picture
from pipelines.geometry.compilation import cached, helper
from pipelines.session.registries import Region

# OpenCV 4 rounds a position between two pixels to this many steps.
_STEPS_PER_PIXEL = 32


def sampled(picture: Picture, picture_from_crop: Float, size: tuple[int, int], *, beyond: str) -> Picture:
    """Sample the RGB values [height, width, 3] of a BGR picture at a crop's pixels, bilinear.

    OpenCV 4 rounds positions to 1/32 px when it warps, as does the one inside MediaPipe; OpenCV 5 does
    not, which moves landmarks by 0.6 px (median) where the crop is coarser than the picture. Fixed-point
    maps are rounded the same way in both.

    Args:
        picture: [H, W, 3] BGR.
        picture_from_crop: [2, 3] from the crop's pixels to the picture's.
        size: width and height of the crop.
        beyond: values around the picture: `edge` repeats its border, `black` is 0.
    """
    import cv2

    whole, part = fixed_point_maps(np.ascontiguousarray(picture_from_crop, np.float64), *size)
    border = cv2.BORDER_REPLICATE if beyond == "edge" else cv2.BORDER_CONSTANT
    values = cv2.remap(picture, whole, part, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(cv2.cvtColor(values, cv2.COLOR_BGR2RGB), np.uint8)


@helper
def _as_int16(whole: np.int64) -> np.int64:
    if whole < -32768:
        return np.int64(-32768)
    return whole if whole < 32767 else np.int64(32767)


@cached
def fixed_point_maps(
    picture_from_crop: Float, width: int, height: int
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Compute the maps of `cv2.convertMaps` for a crop's pixels in one pass, in a third of its time.

    Args:
        picture_from_crop: [2, 3] from the crop's pixels to the picture's.
        width: width of the crop (px).
        height: height of the crop (px).

    Returns:
        Whole pixels [height, width, xy], and parts of them [height, width] as 32 * y + x in 1/32 px.
    """
    whole = np.empty((height, width, 2), np.int16)
    part = np.empty((height, width), np.uint16)
    steps = np.float32(_STEPS_PER_PIXEL)
    for row in range(height):
        x_begin = picture_from_crop[0, 1] * row + picture_from_crop[0, 2]
        y_begin = picture_from_crop[1, 1] * row + picture_from_crop[1, 2]
        for column in range(width):
            # OpenCV takes positions as float32.
            x = np.int64(np.rint(np.float32(picture_from_crop[0, 0] * column + x_begin) * steps))
            y = np.int64(np.rint(np.float32(picture_from_crop[1, 0] * column + y_begin) * steps))
            whole[row, column] = _as_int16(x >> 5), _as_int16(y >> 5)
            part[row, column] = (y & 31) * _STEPS_PER_PIXEL + (x & 31)
    return whole, part


def upright_crop(region: Region, size: tuple[int, int]) -> Float:
    """Compute picture_from_crop [2, 3] for a region whose side becomes the crop's longer side.

    Equivalent to MMPose's TopdownAffine for a box of 1.25 times the body: the box is widened to the aspect
    of the network's input and is not turned. Its middle becomes the middle of the crop's
    pixels, ((width - 1) / 2, (height - 1) / 2); MMPose puts it half a crop pixel beside that, and its
    outputs as well, so that positions agree. They are read off through the same matrix here.
    """
    scale = region.side / max(size)
    middle = np.array([size[0] - 1, size[1] - 1]) / 2
    return np.column_stack([np.eye(2) * scale, np.array(region.centre) - scale * middle])


def in_picture(xy: Float, picture_from_crop: Float) -> Float:
    """Convert positions [..., 2] from crop pixels to picture pixels."""
    moved: Float = xy * np.diag(picture_from_crop[:, :2]) + picture_from_crop[:, 2]
    return moved


def side_of_box(width: float, height: float, size: tuple[int, int], padding: float) -> float:
    """Compute the side of the region that holds a padded box, for a network's input size (width, height)."""
    longer = max(size)
    return float(padding * max(width * longer / size[0], height * longer / size[1]))
