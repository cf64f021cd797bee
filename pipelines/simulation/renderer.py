"""Pictures of people in a world, as a camera in daylight takes them: lens, exposure, light and sensor."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bytes, Float, Float32, Intrinsics
from pipelines.geometry.cameras import undistort
from pipelines.geometry.compilation import cached, helper
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.simulation.raster import (
    GROUND,
    SHIFTS_PX,
    SUBROWS,
    CameraView,
    Fragments,
    Mesh,
    ShadowMap,
    TriangleSurface,
    bands,
    draw,
    empty_band,
    gather,
    mesh_of,
    projected,
    room_for,
    shadow_map,
    stacked,
    sun_axes,
    sunlight,
)

SUN_RGB = np.array([0.86, 0.79, 0.67])
SKY_RGB = np.array([0.21, 0.25, 0.31])  # from above, on a level surface
BOUNCE_RGB = np.array([0.09, 0.09, 0.06])  # from the ground, on a surface that faces down
HORIZON_RGB = np.array([0.50, 0.56, 0.62])
ZENITH_RGB = np.array([0.14, 0.25, 0.47])
# Haze has half of its effect at this distance.
HAZE_M = 700.0


def shade(
    fragments: Fragments, sun: Float32, sky: Float32, first_row: int, view: CameraView, light: Float32
) -> None:
    """Write the light [R, W, 3] of a band's pixels, from the fragments' `sun` [N] and the share of `sky`.

    The sky is paler towards the horizon, and below it as at it.
    """
    turn, pinhole = view.world_from_camera, view.pinhole
    rows, width, _ = light.shape
    down = (first_row + np.arange(rows)[:, None] - pinhole[3]) / pinhole[1]
    right = (np.arange(width) - pinhole[2]) / pinhole[0]
    dz = turn[2, 0] * right + turn[2, 1] * down + turn[2, 2]
    sine = np.maximum(dz / np.sqrt(right * right + down * down + 1.0), 0.0)
    low = ((1.0 - sine) * (1.0 - sine) * (1.0 - sine))[..., None]
    light[:] = sky[: rows * width].reshape(rows, width, 1) * (ZENITH_RGB + low * (HORIZON_RGB - ZENITH_RGB))
    _add(fragments, sun, light.reshape(-1, 3))


@cached
def _add(fragments: Fragments, sun: Float32, light: Float32) -> None:
    pixel, share, _, _, normal, colour, distance, _ = fragments
    for i in range(len(sun)):
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
    lush, dry = _noise(rng, SITE_TEXELS, 2.4), _noise(rng, SITE_TEXELS, 3.0)
    light = 1.0 + 0.09 * lush
    site = np.stack([light + 0.09 * dry, light + 0.02 * dry, light - 0.05 * dry], axis=-1)
    clipped: Float32 = np.clip(site / site.mean(axis=(0, 1)), 0.4, 1.8).astype(np.float32)
    return GroundTexture(np.concatenate([level.ravel() for level in texels]), first.astype(np.int64), clipped)


@cached
def paint(texture: GroundTexture, fragments: Fragments, count: int, pixel_rad: float) -> None:
    """Multiply the colours of ground fragments by the texture, averaged over each fragment's footprint.

    A pixel's footprint on the ground is longer than it is wide. Mip maps (Williams, "Pyramidal
    parametrics", 1983) are square: their side is between the two, at least a third of the length.
    """
    texels, first, site = texture
    _, _, on_ground, point, _, colour, distance, slant = fragments
    for i in range(count):
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


def _noise(rng: np.random.Generator, n: int, slope: float) -> Float:
    """Draw periodic noise [n, n] of mean 0 and deviation 1, its power falling as frequency ** -slope."""
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None]) * n
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.normal(size=(n, n))) * frequency ** (-slope / 2)
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(n, n))
    scaled: Float = noise / noise.std()
    return scaled


# A cubic spline between rays so far apart is right to 1e-5 px.
_KNOT_PX = 8
# Cubic interpolation takes two pixels on each side.
_MARGIN_PX = 3


class DistortingLens:
    """A lens that bends a pinhole's light; ValueError: its model does not reach the whole picture."""

    pinhole: Intrinsics
    """The camera whose picture holds all that the lens sees."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        rays = _rays(intrinsics)
        low, high = rays.min(axis=(0, 1)), rays.max(axis=(0, 1))
        focal = np.array([intrinsics.fx, intrinsics.fy])
        centre = _MARGIN_PX - low * focal
        width, height = (int(n) for n in np.ceil((high - low) * focal) + 2 * _MARGIN_PX + 1)
        self.pinhole = Intrinsics(width, height, *focal.tolist(), *centre.tolist())
        self._map = (rays * focal + centre).astype(np.float32)

    def rows(self, part: slice) -> slice:
        """Return the rows of the pinhole's picture that some rows of the lens's picture need."""
        of = self._map[part, :, 1]
        return slice(int(of.min()) - _MARGIN_PX + 1, int(of.max()) + _MARGIN_PX)

    def bent(self, light: Float32, first_row: int, part: slice) -> Float32:
        """Bend the pinhole's light [S, V, 3] from `first_row` on (`rows`) to `part` of the lens's rows."""
        import cv2

        to: NDArray[Any] = self._map[part] - np.array([0, first_row], np.float32)
        bent = cv2.remap(light, to, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        # Cubics overshoot beside edges; there is no light below none.
        return np.maximum(np.asarray(bent, np.float32), np.float32(0))


def _rays(intrinsics: Intrinsics) -> Float:
    """Compute the undistorted normalised coordinates [H, W, 2] of every pixel's centre."""
    from scipy.interpolate import RectBivariateSpline

    rows, columns = np.arange(intrinsics.height), np.arange(intrinsics.width)
    down, right = (np.linspace(0, len(axis) - 1, max(4, len(axis) // _KNOT_PX)) for axis in (rows, columns))
    y, x = np.meshgrid(down, right, indexing="ij")
    solved = undistort(np.stack([x, y], axis=-1), intrinsics)
    if np.isnan(solved).any():
        raise ValueError(f"no ray reaches some pixels with the distortion {list(intrinsics.distortion)}")
    return np.stack(
        [RectBivariateSpline(down, right, solved[..., axis])(rows, columns) for axis in range(2)], axis=-1
    )


# Light is multiplied by this before the tone curve.
EXPOSURE = 1.6
# The noise of the sensor has this standard deviation in steps of 8 bits.
NOISE = 1.8
# This share of the light goes to either neighbour, which is a blur of 0.47 px.
_SOFTNESS = 0.11
# The tone curve is looked up in a table of so many steps.
_CURVE_STEPS = 1024
# The tone curve is constant for exposed light above this.
_BRIGHTEST = 4.0


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
def developed(light: Float32, key: np.uint64) -> Bytes:
    """Convert linear RGB light [H, W, 3] to BGR bytes; the same key gives the same noise."""
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
                value = _CURVE[at] + gain * np.float32(noise - 62) + np.float32(0.5)
                picture[y, x, 2 - c] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))
    return picture


STEP_S = 1e-3
"""Longest time between moments: 1 px of an image that moves by 1,000 px/s.

A camera that yaws by 60 degrees a second then films within 0.25 of 255 (rms) of moments 0.25 ms apart, a
seventh of the sensor's noise."""


def exposed_moments(rows: int, *, exposure_s: float, readout_s: float) -> tuple[Float, Float]:
    """Choose a readout's moments [K] s about the picture's time and weights [K, rows]; columns add up to 1.

    A row's light is the mean over its exposure of light that changes linearly between the ascending moments.
    The middle of the middle row's exposure is the picture's time; `readout_s` is from first row to last.
    """
    # An even number of steps: the picture's own time is one of the moments.
    steps = 2 * int(np.ceil((exposure_s + readout_s) / (2 * STEP_S) - 1e-9))
    if not steps:
        return np.zeros(1), np.ones((1, rows))
    moments = (np.arange(steps + 1) / steps - 0.5) * (exposure_s + readout_s)
    middle = (np.arange(rows) / max(rows - 1, 1) - 0.5) * readout_s
    if not exposure_s:
        return moments, np.stack([np.interp(middle, moments, one) for one in np.eye(len(moments))])
    whole = _integral(moments, middle + exposure_s / 2) - _integral(moments, middle - exposure_s / 2)
    return moments, whole / exposure_s


def _integral(moments: Float, until: Float) -> Float:
    """Compute weights [K, N] of the integral of what is linear between moments, from the first one on."""
    step_s = moments[1] - moments[0]
    cell = np.clip(((until - moments[0]) / step_s).astype(np.int64), 0, len(moments) - 2)
    share = (until - moments[cell]) / step_s
    number = np.arange(len(moments))[:, None]
    # A step that was passed gives half of it to both of its ends.
    passed = np.where(number < cell, 0.5, 0.0) + np.where((number > 0) & (number <= cell), 0.5, 0.0)
    passed += np.where(number == cell, share - share**2 / 2, 0.0)
    passed += np.where(number == cell + 1, share**2 / 2, 0.0)
    weights: Float = step_s * passed
    return weights


# --- pictures ------------------------------------------------------------------------------------------

# The samples of so many pixel rows fit into the cache of a processor.
_BAND_ROWS = 16
_STATIC_TEXEL_M, _STATIC_TEXELS = 0.02, 2048
_PERSON_TEXEL_M, _PERSON_TEXELS = 0.008, 1024
# Ground this close to its median height casts no shadow worth a map.
_LEVEL_M = 0.05


class ExposedMoment(NamedTuple):
    """The camera's pose and the people before it at one moment."""

    position: Float  # [3] m, of the camera in the world
    quaternion_xyzw: Float  # [4] world_from_camera
    people: Sequence[TriangleSurface]  # whoever moves


class Renderer:
    """A world and a camera that takes pictures of it; several threads may share one.

    Everything is opaque and matt. The sun, in the direction [3], casts shadows, the sky lights without them.
    Where the mesh of the ground ends, land goes on level at the height of its lowest point, to the horizon. A
    readout is up to the caller, who asks for several moments (`exposed`). The seed is that of the ground's
    texture and of the sensor's noise. ValueError: distortion whose model does not reach the whole picture, or
    a sun that is not above the horizon.
    """

    def __init__(
        self, static: Sequence[TriangleSurface], intrinsics: Intrinsics, *, sun: Float, seed: int
    ) -> None:
        direction = np.asarray(sun, np.float64)
        if direction.shape != (3,) or not np.isfinite(direction).all() or direction[2] <= 0:
            raise ValueError(f"the sun must stand above the horizon, not at {direction.tolist()}")
        self._lens = DistortingLens(intrinsics) if any(intrinsics.distortion) else None
        self._size = intrinsics.height, intrinsics.width
        self._intrinsics = intrinsics if self._lens is None else self._lens.pinhole
        self._seed = seed
        self._texture = ground_texture(seed)
        self._axes = sun_axes(direction)
        self._static = mesh_of(static)
        self._land = _land(self._static)
        self._static_shadows = _static_maps(self._static, self._axes)

    def picture(
        self, position: Float, quaternion_xyzw: Float, people: Sequence[TriangleSurface], frame: int
    ) -> Bytes:
        """Render [H, W, 3] BGR with people's surfaces; noise follows from seed, position, `frame`."""
        return self.exposed(
            [ExposedMoment(position, quaternion_xyzw, people)], np.ones((1, self._size[0])), frame
        )

    def exposed(self, moments: Sequence[ExposedMoment], weights: Float, frame: int) -> Bytes:
        """Render [H, W, 3] BGR, its rows exposed one after the other; equal arguments give equal bytes.

        `weights` [K, H], columns adding up to 1, are the shares of the moments in each row's light. The
        picture's own time is in the middle; noise is that of `picture` there.
        """
        light = np.zeros((*self._size, 3), np.float32)
        for moment, share in zip(moments, np.asarray(weights, np.float32), strict=True):
            (rows,) = np.nonzero(share)
            if len(rows):
                part = slice(int(rows[0]), int(rows[-1]) + 1)
                light[part] += share[part, None, None] * self._light(moment, part)
        middle = np.asarray(moments[len(moments) // 2].position, np.float64)
        return developed(light, _noise_key(self._seed, frame, middle))

    def _light(self, moment: ExposedMoment, part: slice) -> Float32:
        """Render the light [R, W, 3] of some rows of the picture at one moment."""
        if self._lens is None:
            return self._pinhole_light(moment, part)
        needed = self._lens.rows(part)
        return self._lens.bent(self._pinhole_light(moment, needed), needed.start, part)

    def _pinhole_light(self, moment: ExposedMoment, part: slice) -> Float32:
        """Render the same before the lens distorts it; rows count from `part.start` on."""
        width = self._intrinsics.width
        position = np.asarray(moment.position, np.float64)
        rotation = matrix_from_quaternion(np.asarray(moment.quaternion_xyzw, np.float64))
        of_people = [mesh_of([person]) for person in moment.people if len(person.faces)]
        mesh = stacked([self._static, *of_people])
        shadows = [*self._static_shadows, *(_person_map(each, self._axes) for each in of_people)]
        pinhole = np.array(
            [self._intrinsics.fx, self._intrinsics.fy, self._intrinsics.cx, self._intrinsics.cy]
        )
        view = CameraView(position, rotation, pinhole, self._land)

        triangles = projected(mesh.vertices, mesh.faces, position, rotation, self._intrinsics)
        first_band, last_band = part.start // _BAND_ROWS, -(-part.stop // _BAND_ROWS)
        chosen, start = bands(triangles, self._intrinsics.height, _BAND_ROWS)
        top, bottom = _BAND_ROWS * first_band, min(_BAND_ROWS * last_band, self._intrinsics.height)
        light = np.empty((bottom - top, width, 3), np.float32)
        fragments = room_for(SUBROWS * _BAND_ROWS * width)
        sky = np.empty(_BAND_ROWS * width, np.float32)
        for k in range(first_band, last_band):
            first_row = _BAND_ROWS * k
            rows = light[first_row - top : first_row - top + _BAND_ROWS]
            band = empty_band(SUBROWS * len(rows), width)
            draw(triangles, chosen[start[k] : start[k + 1]], SHIFTS_PX, SUBROWS * first_row, band)
            count = gather(band, first_row, view, mesh, fragments, sky)
            paint(self._texture, fragments, count, 1 / self._intrinsics.fx)
            sun = sunlight(shadows, self._axes, fragments, count)
            shade(fragments, sun, sky, first_row, view, rows)
        return light[part.start - top : part.stop - top]


def _land(static: Mesh) -> Float:
    """Return height and mean reflectance [4] of the land around the ground; NaN without ground."""
    corners = np.unique(static.faces[static.kind & GROUND != 0])
    if len(corners) == 0:
        return np.full(4, np.nan)
    return np.array([static.vertices[corners, 2].min(), *static.colour[corners].mean(axis=0)], np.float64)


def _static_maps(static: Mesh, axes: Float) -> list[ShadowMap]:
    """Return one map, over all that stands on the ground or rises from it; none if nothing does."""
    ground = np.zeros(len(static.vertices), np.bool_)
    ground[static.faces[static.kind & GROUND != 0]] = True
    height = static.vertices[:, 2]
    level = np.median(height[ground]) if ground.any() else np.nan
    casting = static.vertices[~(ground & (np.abs(height - level) < _LEVEL_M))]
    if len(casting) == 0:
        return []
    return [shadow_map(static, casting, axes, finest_m=_STATIC_TEXEL_M, most_texels=_STATIC_TEXELS)]


def _person_map(person: Mesh, axes: Float) -> ShadowMap:
    return shadow_map(person, person.vertices, axes, finest_m=_PERSON_TEXEL_M, most_texels=_PERSON_TEXELS)


def _noise_key(seed: int, frame: int, position: Float) -> np.uint64:
    where = np.ascontiguousarray(position).view(np.uint32).tolist()
    return np.uint64(np.random.SeedSequence([seed, frame, *where]).generate_state(1, np.uint64)[0])
