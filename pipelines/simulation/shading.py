"""Light of fragments and of the sky, with haze between them and the camera, and the texture of the ground.

All light is linear RGB, with about 1 for the light that a white, level surface reflects in full sun. The
ground is grass with bare soil between: a tile that repeats seamlessly, its mip maps, slow changes over the
site.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bytes, Float, Float32, Int32
from pipelines.geometry.compilation import cached, helper
from pipelines.simulation.raster import CameraView, Fragments

SUN_RGB = np.array([0.86, 0.79, 0.67])
SKY_RGB = np.array([0.21, 0.25, 0.31])  # from above, on a level surface
BOUNCE_RGB = np.array([0.09, 0.09, 0.06])  # from the ground, on a surface that faces down
HORIZON_RGB = np.array([0.50, 0.56, 0.62])
ZENITH_RGB = np.array([0.14, 0.25, 0.47])
# Haze has half of its effect at this distance.
HAZE_M = 700.0


def shade(
    fragments: Fragments,
    count: int,
    sun: Float32,
    sky: Float32,
    first_row: int,
    view: CameraView,
    light: Float32,
) -> None:
    """Write the light [R, W, 3] of the pixels of a band: the mean of the light at their samples.

    `sun` [N] is the cosine of the sun's incidence times the share of it that reaches a fragment, `sky` [R *
    W] the share of each pixel's samples that see sky, `first_row` the row of the picture that is the band's
    first.
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


def _fill_sky(share: Float32, first_row: int, turn: Float, pinhole: Float, light: Float32) -> None:
    """Fill in the sky: paler towards the horizon, and below it as at it; black where none is seen."""
    rows, width, _ = light.shape
    down = (first_row + np.arange(rows)[:, None] - pinhole[3]) / pinhole[1]
    right = (np.arange(width) - pinhole[2]) / pinhole[0]
    dz = turn[2, 0] * right + turn[2, 1] * down + turn[2, 2]
    sine = np.maximum(dz / np.sqrt(right * right + down * down + 1.0), 0.0)
    low = ((1.0 - sine) * (1.0 - sine) * (1.0 - sine))[..., None]
    light[:] = share[: rows * width].reshape(rows, width, 1) * (ZENITH_RGB + low * (HORIZON_RGB - ZENITH_RGB))


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


TILE_TEXELS, TILE_M = 2048, 10.24
SITE_TEXELS, SITE_M = 256, 71.3  # no multiple of the tile, so that nothing repeats in sight
# A texel of 255 means this factor.
FULL_SCALE = 3.0

_TEXELS_PER_M = TILE_TEXELS / TILE_M
_SITE_TEXELS_PER_M = SITE_TEXELS / SITE_M
_COARSEST = TILE_TEXELS.bit_length() - 3  # the level of 4 x 4 texels

_DITHER = (np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5]) + 0.5) / 16  # Bayer 1973

# A tile of the ground has so many blades of grass.
_BLADES = 240_000
# A blade is drawn in so many steps along its length.
_BLADE_STEPS = 24


class GroundTexture(NamedTuple):
    """Factors of the ground's colour; 1 on average over the tile, per channel."""

    texels: NDArray[np.uint32]  # [T] RGB in 3 bytes, fine to coarse, rows along y; FULL_SCALE at 255
    first: NDArray[np.int64]  # [L] first texel of each level; its side is TILE_TEXELS / 2 ** level
    site: Float32  # [SITE_TEXELS, SITE_TEXELS, 3], repeats too


@lru_cache(maxsize=2)
def ground_texture(seed: int) -> GroundTexture:
    """Make the texture of a seed."""
    rng = np.random.default_rng([seed, 0x67726173])
    levels = [_tile(rng)]
    while len(levels[-1]) > 4:
        side = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(side, 2, side, 2, 3).mean(axis=(1, 3)))
    whole = [np.rint(np.clip(level * (255 / FULL_SCALE), 0, 255)).astype(np.uint32) for level in levels]
    texels = [level[..., 0] | level[..., 1] << 8 | level[..., 2] << 16 for level in whole]
    first = np.cumsum([0, *(level.shape[0] ** 2 for level in levels[:-1])])
    return GroundTexture(
        np.concatenate([level.ravel() for level in texels]), first.astype(np.int64), _site(rng)
    )


def paint(texture: GroundTexture, fragments: Fragments, count: int, view: CameraView) -> None:
    """Multiply the colours of ground fragments by the texture, averaged over each fragment's footprint.

    A pixel's footprint on the ground is longer than it is wide. Mip maps (Williams, "Pyramidal
    parametrics", 1983) are square: their side is between the two, at least a third of the length.
    """
    _paint(
        *texture,
        fragments.on_ground[:count],
        fragments.point,
        fragments.colour,
        fragments.distance,
        fragments.slant,
        1 / view.pinhole[0],
    )


@cached
def _paint(
    texels: NDArray[np.uint32],
    first: NDArray[np.int64],
    site: Float32,
    on_ground: Bytes,
    point: Float32,
    colour: Float32,
    distance: Float32,
    slant: Float32,
    pixel_rad: float,
) -> None:
    for i in range(len(on_ground)):
        if on_ground[i] == 0:
            continue
        px, py = np.float64(point[i, 0]), np.float64(point[i, 1])
        across_m = distance[i] * pixel_rad
        along_m = across_m / max(slant[i], 1e-3)
        footprint = max(np.sqrt(across_m * along_m), along_m / 3.0) * _TEXELS_PER_M
        level = 0
        while footprint > 2.0 and level < _COARSEST:
            footprint *= 0.5
            level += 1
        # Two levels are mixed by taking the coarser one for its share of the pixels, in a 4 x 4 pattern.
        if footprint - 1.0 > _DITHER[on_ground[i] - 1] and level < _COARSEST:
            level += 1
        side = TILE_TEXELS >> level
        wrap, per_m, begin = side - 1, side / TILE_M, first[level]

        u, v = px * per_m - 0.5, py * per_m - 0.5
        a, b = np.int64(np.floor(u)), np.int64(np.floor(v))
        # Weights are whole 64ths; three channels, 21 bits apart, add up in one number.
        s, t = np.int64((u - a) * 64.0), np.int64((v - b) * 64.0)
        left, right = a & wrap, (a + 1) & wrap
        top, bottom = begin + (b & wrap) * side, begin + ((b + 1) & wrap) * side
        total = np.uint64((64 - s) * (64 - t)) * _spread(texels[np.uint64(top + left)])
        total += np.uint64(s * (64 - t)) * _spread(texels[np.uint64(top + right)])
        total += np.uint64((64 - s) * t) * _spread(texels[np.uint64(bottom + left)])
        total += np.uint64(s * t) * _spread(texels[np.uint64(bottom + right)])
        scale = FULL_SCALE / 255.0 / 4096.0

        u, v = px * _SITE_TEXELS_PER_M - 0.5, py * _SITE_TEXELS_PER_M - 0.5
        a, b = np.int64(np.floor(u)), np.int64(np.floor(v))
        s1, t1 = u - a, v - b
        left, right = a & (SITE_TEXELS - 1), (a + 1) & (SITE_TEXELS - 1)
        top, bottom = b & (SITE_TEXELS - 1), (b + 1) & (SITE_TEXELS - 1)
        for c in range(3):
            above = site[top, left, c] + s1 * (site[top, right, c] - site[top, left, c])
            below = site[bottom, left, c] + s1 * (site[bottom, right, c] - site[bottom, left, c])
            tile = np.int64(total >> np.uint64(21 * c) & np.uint64(0x1FFFFF))
            colour[i, c] *= scale * tile * (above + t1 * (below - above))


@helper
def _spread(texel: np.uint32) -> np.uint64:
    """Move three bytes 21 bits apart."""
    wide = np.uint64(texel)
    return (
        wide & np.uint64(0xFF)
        | (wide & np.uint64(0xFF00)) << np.uint64(13)
        | (wide & np.uint64(0xFF0000)) << np.uint64(26)
    )


def _tile(rng: np.random.Generator) -> Float32:
    """Draw blades of grass, one upon the other over soil; the later ones stand higher and are lighter."""
    n = TILE_TEXELS
    crumbs = _noise(rng, n, 0.6)
    clumps = _noise(rng, n, 2.6)
    soil = (1.0 + 0.16 * crumbs)[..., None] * np.array([1.35, 0.92, 0.95])
    tile = soil.astype(np.float32)

    start = rng.uniform(0, n, (_BLADES, 2))
    angle = rng.uniform(0, 2 * np.pi, _BLADES)
    bend = rng.normal(0, 0.6, _BLADES)
    length = rng.uniform(8, _BLADE_STEPS, _BLADES)
    high = np.linspace(0.0, 1.0, _BLADES)
    # Fewer blades where the soil is poor.
    cell = clumps[start[:, 1].astype(int), start[:, 0].astype(int)]
    grown = rng.uniform(size=_BLADES) > np.clip(0.45 * cell - 0.15, 0.0, 0.93)
    light = (0.45 + 0.75 * high) * rng.lognormal(0.0, 0.22, _BLADES)
    hue = rng.normal(0.0, 0.10, _BLADES)  # towards straw
    colour = light[:, None] * np.stack([0.95 + 1.2 * hue, 1.03 + 0.2 * hue, 0.9 - 0.6 * hue], axis=1)
    for step in range(_BLADE_STEPS):
        along = step / _BLADE_STEPS
        part = grown & (step < length)
        turned = angle[part] + bend[part] * along
        x = (start[part, 0] + step * np.cos(turned)).astype(int) % n
        y = (start[part, 1] + step * np.sin(turned)).astype(int) % n
        tile[y, x] = (colour[part] * (0.75 + 0.45 * along)).astype(np.float32)
    tile *= np.clip(1.0 + 0.10 * clumps, 0.5, 1.5)[..., None].astype(np.float32)
    normalised: Float32 = tile / tile.mean(axis=(0, 1))
    return normalised


def _site(rng: np.random.Generator) -> Float32:
    lush, dry = _noise(rng, SITE_TEXELS, 2.4), _noise(rng, SITE_TEXELS, 3.0)
    light = 1.0 + 0.09 * lush
    site = np.stack([light + 0.09 * dry, light + 0.02 * dry, light - 0.05 * dry], axis=-1)
    clipped: Float32 = np.clip(site / site.mean(axis=(0, 1)), 0.4, 1.8).astype(np.float32)
    return clipped


def _noise(rng: np.random.Generator, n: int, slope: float) -> Float:
    """Draw periodic noise [n, n] of mean 0 and deviation 1, its power falling as frequency ** -slope."""
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None]) * n
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.normal(size=(n, n))) * frequency ** (-slope / 2)
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(n, n))
    scaled: Float = noise / noise.std()
    return scaled
