"""Triangles to samples: one mesh, projection, clipping, bands of rows, a rasteriser with a depth buffer.

A picture has `SUBROWS` sample rows per pixel row, each with its own shift in x (a rotated grid), so a
pixel has four samples with four distinct x and four distinct y: edges near the horizontal and the
vertical, where a regular 2 x 2 grid shows two steps, get four. With one sample row per pixel row the
samples are the pixel centres.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Float32, Int32
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.compilation import cached
from pipelines.simulation.surfaces import TriangleSurface

SMOOTH, GROUND = 1, 2


class Mesh(NamedTuple):
    """Triangles of all surfaces together."""

    vertices: Float  # [V, 3] m, world
    faces: Int32  # [F, 3]
    normals: Float32  # [V, 3] unit, averaged over the faces that meet, weighed by their areas
    colour: Float32  # [V, 3] RGB reflectance, linear
    kind: NDArray[np.uint8]  # [F] SMOOTH and GROUND, or-ed


def mesh_of(surfaces: Sequence[TriangleSurface]) -> Mesh:
    """Join the surfaces, one after another; an empty mesh for none."""
    parts = [_single(surface) for surface in surfaces]
    return stacked(parts) if parts else _single(_EMPTY)


def stacked(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes, one after another; their corners stay apart."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + k for mesh, k in zip(meshes, first, strict=True)]).astype(np.int32),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.colour for mesh in meshes]),
        np.concatenate([mesh.kind for mesh in meshes]),
    )


def _single(surface: TriangleSurface) -> Mesh:
    vertices = np.ascontiguousarray(surface.vertices, np.float64)
    faces = np.ascontiguousarray(surface.faces, np.int32)
    kind = (SMOOTH if surface.smooth else 0) | (GROUND if surface.ground else 0)
    return Mesh(
        vertices,
        faces,
        _corner_normals(vertices, faces),
        np.ascontiguousarray(surface.colour, np.float32),
        np.full(len(faces), kind, np.uint8),
    )


@cached
def _corner_normals(vertices: Float, faces: Int32) -> Float32:
    sums = np.zeros_like(vertices)
    for f in range(len(faces)):
        a, b, c = faces[f]
        ux, uy, uz = vertices[b] - vertices[a]
        vx, vy, vz = vertices[c] - vertices[a]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for k in (a, b, c):
            sums[k, 0] += nx
            sums[k, 1] += ny
            sums[k, 2] += nz
    normals = np.empty(vertices.shape, np.float32)
    for i in range(len(sums)):
        x, y, z = sums[i]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-30)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length
    return normals


_EMPTY = TriangleSurface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))


SUBROWS = 4
SHIFTS_PX = np.array([-0.125, 0.375, -0.375, 0.125])
CENTRES_PX = np.zeros(1)
"""Shift in x of the samples of each sample row from the pixel's centre; their y is evenly spaced."""

NEAR_M = 0.05
NOTHING = -1


class Projected(NamedTuple):
    """Triangles in the picture."""

    corners: Float  # [N, 3, 3]: x and y in px, and nearness 1 / z in 1/m
    source: Int32  # [N] the face each comes from; a face that is clipped can give two


class Band(NamedTuple):
    """Faces seen at the samples of some consecutive sample rows."""

    nearness: Float32  # [R, W] 1/m (or metres towards the sun, in a shadow map)
    source: Int32  # [R, W] the face, or NOTHING


def projected(
    vertices: Float, faces: Int32, position: Float, world_from_camera: Float, intrinsics: Intrinsics
) -> Projected:
    """Project the faces [F, 3] that may touch a pinhole's picture, cut at `NEAR_M` in front of the camera.

    Vertices [V, 3] and the position [3] are in m, world; `world_from_camera` is a rotation [3, 3].
    """
    pinhole = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    points = _in_camera(vertices, position, world_from_camera)
    corners, source = _clipped(points, faces, pinhole, float(intrinsics.width), float(intrinsics.height))
    return Projected(corners, source)


def bands(triangles: Projected, height: int, rows: int) -> tuple[Int32, NDArray[np.int64]]:
    """Find the triangles that each band of `rows` pixel rows has to draw.

    Returns:
        [M] rows of `triangles`, band after band, and [B + 1] the start of each band.
    """
    return _sorted_into_bands(triangles.corners, height, rows)


def empty_band(sample_rows: int, width: int) -> Band:
    """Return samples that see nothing."""
    nearness = np.full((sample_rows, width), -np.inf, np.float32)
    return Band(nearness, np.full((sample_rows, width), NOTHING, np.int32))


@cached
def draw(triangles: Projected, chosen: Int32, shifts_px: Float, first_sample_row: int, band: Band) -> None:
    """Draw the chosen triangles in order into a band: a sample keeps the nearest, the first of equals.

    A sample on an edge belongs to both triangles, so that neighbours leave no gap. `shifts_px` is
    `SHIFTS_PX` or `CENTRES_PX`, `first_sample_row` the picture's sample row that is the band's first.
    """
    corners, source = triangles
    nearness, seen = band
    rows, width = nearness.shape
    per_pixel = len(shifts_px)
    last_sample_row = first_sample_row + rows - 1
    slack = 1e-9  # px; beyond rounding, below anything visible
    for t in chosen:
        x0, y0, n0 = corners[t, 0]
        x1, y1, n1 = corners[t, 1]
        x2, y2, n2 = corners[t, 2]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if abs(area) < 1e-12:  # seen from the edge
            continue
        # Nearness is linear in the picture (and so is height in a shadow map).
        per_x = ((n1 - n0) * (y2 - y0) - (n2 - n0) * (y1 - y0)) / area
        per_y = ((n2 - n0) * (x1 - x0) - (n1 - n0) * (x2 - x0)) / area
        # Sample row s lies at y = (s + 0.5) / per_pixel - 0.5.
        top = (min(y0, y1, y2) - slack + 0.5) * per_pixel - 0.5
        bottom = (max(y0, y1, y2) + slack + 0.5) * per_pixel - 0.5
        first = int(np.ceil(max(top, float(first_sample_row))))
        last = int(np.floor(min(bottom, float(last_sample_row))))
        if first > last:
            continue
        slope01 = (x1 - x0) / (y1 - y0) if y1 != y0 else 0.0
        slope12 = (x2 - x1) / (y2 - y1) if y2 != y1 else 0.0
        slope20 = (x0 - x2) / (y0 - y2) if y0 != y2 else 0.0
        face = source[t]
        for s in range(first, last + 1):
            y = (s + 0.5) / per_pixel - 0.5
            shift = shifts_px[s % per_pixel]
            left, right = np.inf, -np.inf
            if min(y0, y1) - slack <= y <= max(y0, y1) + slack:
                a = min(max(x0 + (y - y0) * slope01, min(x0, x1)), max(x0, x1))
                b = a if y0 != y1 else x1
                left, right = min(left, a, b), max(right, a, b)
            if min(y1, y2) - slack <= y <= max(y1, y2) + slack:
                a = min(max(x1 + (y - y1) * slope12, min(x1, x2)), max(x1, x2))
                b = a if y1 != y2 else x2
                left, right = min(left, a, b), max(right, a, b)
            if min(y2, y0) - slack <= y <= max(y2, y0) + slack:
                a = min(max(x2 + (y - y2) * slope20, min(x2, x0)), max(x2, x0))
                b = a if y2 != y0 else x0
                left, right = min(left, a, b), max(right, a, b)
            begin = max(left - shift - slack, 0.0)
            end = min(right - shift + slack, width - 1.0)
            if begin > end:
                continue
            i0, i1 = int(np.ceil(begin)), int(np.floor(end))
            start = np.float32(n0 + per_x * (i0 + shift - x0) + per_y * (y - y0))
            step = np.float32(per_x)
            # Unsigned indices need no look for negative ones, so the loop compiles to vector code.
            row, column = np.uint64(s - first_sample_row), np.uint64(i0)
            for k in range(np.uint32(i1 + 1 - i0)):
                value = start + step * np.float32(np.int32(k))
                if value > nearness[row, column + np.uint64(k)]:
                    nearness[row, column + np.uint64(k)] = value
                    seen[row, column + np.uint64(k)] = face


@cached
def _in_camera(vertices: Float, position: Float, world_from_camera: Float) -> Float:
    points = np.empty_like(vertices)
    for i in range(len(vertices)):
        x = vertices[i, 0] - position[0]
        y = vertices[i, 1] - position[1]
        z = vertices[i, 2] - position[2]
        for k in range(3):
            points[i, k] = (
                x * world_from_camera[0, k] + y * world_from_camera[1, k] + z * world_from_camera[2, k]
            )
    return points


@cached
def _clipped(points: Float, faces: Int32, pinhole: Float, width: float, height: float) -> tuple[Float, Int32]:
    corners = np.empty((2 * len(faces), 3, 3))
    source = np.empty(2 * len(faces), np.int32)
    polygon = np.empty((4, 3))
    fx, fy, cx, cy = pinhole
    count = 0
    for f in range(len(faces)):
        # Sutherland and Hodgman (1974), against one plane: three corners become none, three or four.
        size = 0
        for k in range(3):
            here, there = points[faces[f, k]], points[faces[f, (k + 1) % 3]]
            if here[2] >= NEAR_M:
                polygon[size] = here
                size += 1
            if (here[2] >= NEAR_M) != (there[2] >= NEAR_M):
                share = (NEAR_M - here[2]) / (there[2] - here[2])
                polygon[size, 0] = here[0] + share * (there[0] - here[0])
                polygon[size, 1] = here[1] + share * (there[1] - here[1])
                polygon[size, 2] = NEAR_M
                size += 1
        if size == 0:
            continue
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for k in range(size):
            nearness = 1.0 / polygon[k, 2]
            x, y = fx * polygon[k, 0] * nearness + cx, fy * polygon[k, 1] * nearness + cy
            polygon[k, 0], polygon[k, 1], polygon[k, 2] = x, y, nearness
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        if right < -0.5 or left > width - 0.5 or bottom < -0.5 or top > height - 0.5:
            continue
        for k in range(1, size - 1):
            corners[count, 0] = polygon[0]
            corners[count, 1] = polygon[k]
            corners[count, 2] = polygon[k + 1]
            source[count] = f
            count += 1
    return corners[:count], source[:count]


@cached
def _sorted_into_bands(corners: Float, height: int, rows: int) -> tuple[Int32, NDArray[np.int64]]:
    count = (height + rows - 1) // rows
    first = np.empty(len(corners), np.int32)
    last = np.empty(len(corners), np.int32)
    start = np.zeros(count + 1, np.int64)
    for t in range(len(corners)):
        top = min(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1])
        bottom = max(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1])
        # A pixel row reaches half a pixel above and below its centre.
        first[t] = int(max(top + 0.5, 0.0) / rows)
        last[t] = int(min(bottom + 0.5, height - 0.5) / rows)
        for band in range(first[t], last[t] + 1):
            start[band + 1] += 1
    for band in range(count):
        start[band + 1] += start[band]
    chosen = np.empty(start[count], np.int32)
    filled = start[:-1].copy()
    for t in range(len(corners)):
        for band in range(first[t], last[t] + 1):
            chosen[filled[band]] = t
            filled[band] += 1
    return chosen, start
