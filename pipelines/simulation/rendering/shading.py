"""Light of fragments and of the sky, with haze between them and the camera.

All light is linear RGB, with about 1 for the light that a white, level surface reflects in full sun.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached
from pipelines.simulation.rendering.fragments import Fragments, View

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

SUN_RGB = np.array([0.86, 0.79, 0.67])
SKY_RGB = np.array([0.21, 0.25, 0.31])  # from above, on a level surface
BOUNCE_RGB = np.array([0.09, 0.09, 0.06])  # from the ground, on a surface that faces down
HORIZON_RGB = np.array([0.50, 0.56, 0.62])
ZENITH_RGB = np.array([0.14, 0.25, 0.47])
HAZE_M = 700.0  # distance at which haze has half its effect


def shade(
    fragments: Fragments, count: int, sun: Float32, sky: Float32, first_row: int, view: View, light: Float32
) -> None:
    """Write the light of the pixels of a band: the mean of the light at their samples.

    Args:
        fragments: of the band.
        count: of the fragments.
        sun: [N] cosine of the sun's incidence times the share of it that reaches a fragment.
        sky: [R * W] share of each pixel's samples that see sky.
        first_row: the row of the picture that is the band's first.
        view: the camera.
        light: [R, W, 3] the rows of the picture; written.
    """
    _fill_sky(sky, first_row, view.world_from_camera, view.pinhole, light)
    _add(
        fragments.pixel[:count],
        fragments.share,
        fragments.normal,
        fragments.colour,
        fragments.distance,
        sun,
        light.reshape(-1, 3),
    )


@cached
def _fill_sky(share: Float32, first_row: int, turn: Float, pinhole: Float, light: Float32) -> None:
    """Fill in the sky: paler towards the horizon, and below it as at it; black where none is seen."""
    width = light.shape[1]
    for row in range(light.shape[0]):
        down = (first_row + row - pinhole[3]) / pinhole[1]
        for x in range(width):
            seen = share[row * width + x]
            if seen == 0.0:
                light[row, x, 0] = light[row, x, 1] = light[row, x, 2] = 0.0
                continue
            right = (x - pinhole[2]) / pinhole[0]
            dz = turn[2, 0] * right + turn[2, 1] * down + turn[2, 2]
            sine = max(dz / np.sqrt(right * right + down * down + 1.0), 0.0)
            low = (1.0 - sine) * (1.0 - sine) * (1.0 - sine)
            for c in range(3):
                light[row, x, c] = seen * (ZENITH_RGB[c] + low * (HORIZON_RGB[c] - ZENITH_RGB[c]))


@cached
def _add(
    pixel: Int32,
    share: Float32,
    normal: Float32,
    colour: Float32,
    distance: Float32,
    sun: Float32,
    light: Float32,
) -> None:
    for i in range(len(pixel)):
        p = np.uint64(pixel[i])
        up = 0.5 + 0.5 * normal[i, 2]
        # A share of haze that needs no exponential: half at HAZE_M, all at the horizon.
        haze = distance[i] / (distance[i] + HAZE_M)
        for c in range(3):
            arriving = sun[i] * SUN_RGB[c] + up * SKY_RGB[c] + (1.0 - up) * BOUNCE_RGB[c]
            light[p, c] += share[i] * (haze * HORIZON_RGB[c] + (1.0 - haze) * colour[i, c] * arriving)
