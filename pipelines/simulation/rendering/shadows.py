"""Depth maps of the sun, orthographic along its rays (Williams, "Casting curved shadows", 1978)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bytes, Float, Float32
from pipelines.geometry.compilation import cached
from pipelines.simulation.rendering.fragments import Fragments
from pipelines.simulation.rendering.raster import CENTRES_PX, Mesh, Projected, draw, empty_band

_MARGIN = 4  # texels around the region
_STEP = 6.0  # texels of height between neighbours: more than on slopes that the sun lights well


class ShadowMap(NamedTuple):
    """Height of the topmost surface above each cell of a plane across the sun's rays."""

    height: Float32  # [H, W] m towards the sun, -inf where the sun hits nothing
    edge: Bytes  # [H, W] 1 where a filtered look-up may find lit and shaded texels side by side
    corner: Float  # [2] m, corner of the first texel, along the axes of `sun_axes`
    texel_m: float


def sun_axes(sun: Float) -> Float:
    """Return orthonormal rows [3, 3], the last one the direction towards the sun."""
    towards = sun / np.sqrt(np.sum(sun**2))
    helper = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    across = np.cross(helper, towards)
    across /= np.sqrt(np.sum(across**2))
    return np.stack([across, np.cross(towards, across), towards])


def shadow_map(mesh: Mesh, region: Float, axes: Float, *, finest_m: float, most_texels: int) -> ShadowMap:
    """Draw the map of a mesh over the part of the plane that some points [N, 3] m, one at least, cover.

    Faces outside that region are left out. The side of a texel is `finest_m`, or larger if the map needs
    more than `most_texels` along a side.
    """
    covered = np.einsum("ij,nj->ni", axes[:2], region)
    low, high = covered.min(axis=0), covered.max(axis=0)
    texel = max(finest_m, float((high - low).max()) / (most_texels - 2 * _MARGIN - 1))
    corner = low - _MARGIN * texel
    width, height = np.ceil((high - low) / texel).astype(int) + 2 * _MARGIN

    light = np.einsum("ij,nj->ni", axes, mesh.vertices)
    light[:, :2] = (light[:, :2] - corner) / texel - 0.5
    corners = light[mesh.faces]
    reached = (corners[..., :2].max(axis=1) > -0.5) & (corners[..., :2].min(axis=1) < [width, height])
    faces = np.nonzero(reached.all(axis=1))[0].astype(np.int32)
    triangles = Projected(corners[faces], faces)
    band = empty_band(int(height), int(width))
    draw(triangles, np.arange(len(faces), dtype=np.int32), CENTRES_PX, 0, band)
    return ShadowMap(band.nearness, _edges(band.nearness, _STEP * texel), corner, texel)


def sunlight(maps: Sequence[ShadowMap], axes: Float, fragments: Fragments, count: int) -> Float32:
    """Compute the cosine of the sun's incidence times its share that reaches each fragment, [N]."""
    sun = np.empty(count, np.float32)
    _face_sun(fragments.normal, axes[2], sun)
    for each in maps:
        _cast(*each, axes, fragments.point, fragments.normal, sun)
    return sun


@cached
def _face_sun(normal: Float32, towards: Float, sun: Float32) -> None:
    for i in range(len(sun)):
        cosine = normal[i, 0] * towards[0] + normal[i, 1] * towards[1] + normal[i, 2] * towards[2]
        sun[i] = max(cosine, 0.0)


@cached
def _cast(
    height: Float32,
    edge: Bytes,
    corner: Float,
    texel_m: float,
    axes: Float,
    point: Float32,
    normal: Float32,
    sun: Float32,
) -> None:
    """Remove the light that one map shades: bilinear comparisons over 3 x 3 texels."""
    rows, width = height.shape
    (ux, uy, uz), (vx, vy, vz), (wx, wy, wz) = axes
    per_m, u0, v0 = 1.0 / texel_m, corner[0] / texel_m + 0.5, corner[1] / texel_m + 0.5
    for i in range(len(sun)):
        if sun[i] <= 0.0:
            continue
        x, y, z = point[i, 0], point[i, 1], point[i, 2]
        u, v = (ux * x + uy * y + uz * z) * per_m - u0, (vx * x + vy * y + vz * z) * per_m - v0
        if not (-2.0 <= u < width and -2.0 <= v < rows):
            continue
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        # The look-up reaches two texels across the rays, over which a plane rises by two texels times
        # the tangent of the incidence: a step off the surface of two texels times the sine lifts it by
        # that, and the surface does not shade itself.
        cosine = nx * wx + ny * wy + nz * wz
        step = 2.0 * texel_m * np.sqrt(max(1.0 - cosine * cosine, 0.0))
        x, y, z = x + step * nx, y + step * ny, z + step * nz
        u, v = (ux * x + uy * y + uz * z) * per_m - u0, (vx * x + vy * y + vz * z) * per_m - v0
        if not (1.0 <= u < width - 3.0 and 1.0 <= v < rows - 3.0):
            continue
        above = wx * x + wy * y + wz * z + 0.5 * texel_m
        a, b = int(u), int(v)
        if edge[b, a] == 0:
            below = above - height[b, a]
            if below >= 0.0:
                continue
            if below < -_STEP * texel_m:
                sun[i] = 0.0
                continue
        s, t = u - a, v - b
        lit = 0.0
        for row in range(4):
            inside = 0.0
            for column in range(4):
                if above >= height[b + row - 1, a + column - 1]:
                    inside += 1.0 - s if column == 0 else s if column == 3 else 1.0
            lit += inside * (1.0 - t if row == 0 else t if row == 3 else 1.0)
        sun[i] *= lit / 9.0


@cached
def _edges(height: Float32, step: float) -> Bytes:
    """Mark texels where heights within the 4 x 4 texels of a look-up differ by more than a step."""
    rows, width = height.shape
    lowest, highest = np.empty((rows, width), np.float32), np.empty((rows, width), np.float32)
    for i in range(rows):
        for j in range(width):
            begin, end = max(j - 1, 0), min(j + 2, width - 1)
            low, high = height[i, begin], height[i, begin]
            for c in range(begin + 1, end + 1):
                low, high = min(low, height[i, c]), max(high, height[i, c])
            lowest[i, j], highest[i, j] = low, high
    edge = np.empty((rows, width), np.uint8)
    for i in range(rows):
        begin, end = max(i - 1, 0), min(i + 2, rows - 1)
        for j in range(width):
            low, high = lowest[begin, j], highest[begin, j]
            for r in range(begin + 1, end + 1):
                low, high = min(low, lowest[r, j]), max(high, highest[r, j])
            edge[i, j] = 1 if high > low + step else 0
    return edge
