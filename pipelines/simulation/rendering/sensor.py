"""The sensor, from light to the bytes of a picture: the lens's softness, noise, the tone curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.compilation import cached

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

EXPOSURE = 1.6
NOISE = 1.8  # standard deviation, in steps of 8 bits
_SOFTNESS = 0.11  # share of the light that goes to either neighbour, per axis: a blur of 0.47 px
_CURVE_STEPS = 1024
_BRIGHTEST = 4.0  # of the exposed light; the curve is constant above


def developed(light: Float32, key: int) -> UInt8:
    """Convert a field of light to the bytes of a picture.

    Args:
        light: [H, W, 3] linear RGB.
        key: of the noise, 64 bits; the same key gives the same noise.

    Returns:
        [H, W, 3] BGR.
    """
    return _developed(light, np.uint64(key), _CURVE)


def _curve() -> Float32:
    """Return 8-bit values by the square root of the exposed light: sRGB, with a soft shoulder above 0.8."""
    root = np.linspace(0.0, np.sqrt(_BRIGHTEST), _CURVE_STEPS)
    linear = root**2
    knee = 0.8
    rolled = np.where(linear < knee, linear, 1 - (1 - knee) * np.exp(-(linear - knee) / (1 - knee)))
    srgb = np.where(rolled <= 0.0031308, 12.92 * rolled, 1.055 * rolled ** (1 / 2.4) - 0.055)
    return (255 * srgb).astype(np.float32)


_CURVE = _curve()


@cached
def _developed(light: Float32, key: np.uint64, curve: Float32) -> UInt8:
    height, width, _ = light.shape
    picture = np.empty((height, width, 3), np.uint8)
    side, middle = np.float32(_SOFTNESS), np.float32(1 - 2 * _SOFTNESS)
    # Four fields of five bits add up to a deviation of sqrt(4 (32^2 - 1) / 12) about 62.
    gain = np.float32(NOISE / 18.466185)
    finest = np.float32((_CURVE_STEPS - 1) / np.sqrt(_BRIGHTEST))
    exposure = np.float32(EXPOSURE)
    column = np.empty((width + 2, 3), np.float32)
    for y in range(height):
        above, here, below = light[max(y - 1, 0)], light[y], light[min(y + 1, height - 1)]
        for x in range(width):
            for c in range(3):
                column[x + 1, c] = exposure * (side * (above[x, c] + below[x, c]) + middle * here[x, c])
        column[0], column[width + 1] = column[1], column[width]
        for x in range(width):
            # splitmix64 (Steele, Lea & Flood 2014) of the pixel's number
            bits = key + np.uint64(y * width + x) * np.uint64(0x9E3779B97F4A7C15)
            bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            bits ^= bits >> np.uint64(31)
            for c in range(3):
                soft = side * (column[x, c] + column[x + 2, c]) + middle * column[x + 1, c]
                at = min(int(np.sqrt(soft) * finest + np.float32(0.5)), _CURVE_STEPS - 1)
                noise = np.int64(0)
                for _ in range(4):
                    noise += np.int64(bits & np.uint64(31))
                    bits >>= np.uint64(5)
                value = curve[at] + gain * np.float32(noise - 62) + np.float32(0.5)
                picture[y, x, 2 - c] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))
    return picture
