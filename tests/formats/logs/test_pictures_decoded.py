"""CameraPictures of logs in every layout that ROS names: decoded colours equal the encoded ones."""

import numpy as np
import pytest

from pipelines.formats.logs.pictures import decode
from pipelines.geometry.arrays import Picture
from pipelines.session.records import PictureSample

WIDTH, HEIGHT = 16, 12
BLUE, GREEN, RED = 40, 120, 200
PLAIN = np.full((HEIGHT, WIDTH, 3), (BLUE, GREEN, RED), np.uint8)
GREY = 0.114 * BLUE + 0.587 * GREEN + 0.299 * RED


def mosaic(pattern: str) -> Picture:
    """Make the mosaic of a sensor for one colour; `pattern` names the filters of its first two rows."""
    level = {"r": RED, "g": GREEN, "b": BLUE}
    tile = np.array([level[letter] for letter in pattern], np.uint8).reshape(2, 2)
    return np.tile(tile, (HEIGHT // 2, WIDTH // 2))


def chroma() -> tuple[float, float, float]:
    """Compute Y, U and V of the colour, as in video: 16 to 235 and 16 to 240 (ITU-R BT.601)."""
    y = 16 + GREY * 219 / 255
    return y, 128 + (BLUE - GREY) / 1.772 * 224 / 255, 128 + (RED - GREY) / 1.402 * 224 / 255


def in_pairs(*order: int) -> Picture:
    """Encode two pixels in four bytes, with Y, U and V in this order."""
    values = [round(chroma()[k]) for k in order]
    return np.tile(np.array(values, np.uint8), (HEIGHT, WIDTH // 2))


def opaque(picture: Picture) -> Picture:
    return np.concatenate([picture, np.full((HEIGHT, WIDTH, 1), 255, np.uint8)], axis=2)


ENCODED: dict[str, Picture] = {
    "bgr8": PLAIN,
    "8UC3": PLAIN,
    "rgb8": PLAIN[..., ::-1],
    "bgra8": opaque(PLAIN),
    "rgba8": opaque(PLAIN[..., ::-1]),
    "mono8": np.full((HEIGHT, WIDTH), 77, np.uint8),
    "8UC1": np.full((HEIGHT, WIDTH), 77, np.uint8),
    "bayer_rggb8": mosaic("rggb"),
    "bayer_bggr8": mosaic("bggr"),
    "bayer_gbrg8": mosaic("gbrg"),
    "bayer_grbg8": mosaic("grbg"),
    "yuv422": in_pairs(1, 0, 2, 0),
    "uyvy": in_pairs(1, 0, 2, 0),
    "yuv422_yuy2": in_pairs(0, 1, 0, 2),
    "yuyv": in_pairs(0, 1, 0, 2),
}
# Y, U and V were rounded: half a step of each, times the factors of the inverse, and the result's rounding.
ROUNDED = 0.5 * (255 / 219 + 1.772 * 255 / 224) + 1


def sample(encoding: str, pixels: Picture, *, padding: int = 0, cut: int = 0) -> PictureSample:
    rows = pixels.reshape(HEIGHT, -1)
    padded = np.concatenate([rows, np.full((HEIGHT, padding), 9, np.uint8)], axis=1)
    data = padded.ravel()[: padded.size - cut]
    return PictureSample(1, 1, encoding, WIDTH, HEIGHT, padded.shape[1], data)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", ENCODED)
def test_colours_come_out_as_they_went_in(encoding: str, padding: int) -> None:
    found = decode(sample(encoding, ENCODED[encoding], padding=padding))
    assert found is not None
    expected = np.full_like(PLAIN, 77) if encoding in ("mono8", "8UC1") else PLAIN
    assert found.shape == expected.shape
    assert found.flags.c_contiguous
    assert np.abs(found.astype(int) - expected).max() <= (
        ROUNDED if "yu" in encoding or "uy" in encoding else 0
    )


@pytest.mark.parametrize("encoding", ENCODED)
def test_pictures_that_are_cut_short_are_missing(encoding: str) -> None:
    assert decode(sample(encoding, ENCODED[encoding], cut=1)) is None
