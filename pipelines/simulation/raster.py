"""Triangles to samples, samples to fragments, and the shadows on them.

A picture has `SUBROWS` sample rows per pixel row, each shifted in x (a rotated grid), so that edges near the
horizontal and the vertical get four steps where a regular 2 x 2 grid shows two. With one sample row per pixel
row the samples are the pixel centres. A fragment is a piece of surface that makes up a part of a pixel; it is
shaded once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Bytes, Float, Float32, Index, Int32, Intrinsics
from pipelines.geometry.compilation import cached


@dataclass(frozen=True)
class TriangleSurface:
    """Triangles coloured by corner, shaded by face unless `smooth`; `ground` has the renderer's texture."""

    vertices: Float  # [V, 3] m, world
    faces: NDArray[np.int32]  # [F, 3], counterclockwise seen from outside
    colour: NDArray[np.float32]  # [V, 3] RGB reflectance, 0..1, linear
    smooth: bool = True
    ground: bool = False


def joined(*surfaces: TriangleSurface) -> TriangleSurface:
    """Join several surfaces of one kind, all smooth or none, to one."""
    first = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    return TriangleSurface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + k for s, k in zip(surfaces, first, strict=True)]).astype(np.int32),
        np.concatenate([s.colour for s in surfaces]),
        surfaces[0].smooth,
        surfaces[0].ground,
    )


def hidden_by(surface: TriangleSurface, eye: Float, targets: Float) -> Bool:
    """Test if a surface stands between an eye [3] and targets [N, 3] m, world; False for NaN."""
    out = np.empty(len(targets), dtype=np.bool_)
    eye, targets = np.ascontiguousarray(eye, np.float64), np.ascontiguousarray(targets, np.float64)
    _meets(np.ascontiguousarray(surface.vertices, np.float64), surface.faces, eye, targets, out)
    return out


@cached
def _meets(vertices: Float, faces: NDArray[np.int32], eye: Float, targets: Float, out: Bool) -> None:
    """Moeller and Trumbore 1997, "Fast, minimum storage ray/triangle intersection", between two points."""
    for n in range(len(targets)):
        wx, wy, wz = targets[n, 0] - eye[0], targets[n, 1] - eye[1], targets[n, 2] - eye[2]
        out[n] = False
        for f in range(len(faces)):
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            px, py, pz = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
            volume = ux * px + uy * py + uz * pz
            if volume == 0.0:  # the line runs within the triangle's plane
                continue
            sx, sy, sz = eye[0] - a[0], eye[1] - a[1], eye[2] - a[2]
            first = (sx * px + sy * py + sz * pz) / volume
            if not 0.0 <= first <= 1.0:
                continue
            qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
            second = (wx * qx + wy * qy + wz * qz) / volume
            if second < 0.0 or first + second > 1.0:
                continue
            along = (vx * qx + vy * qy + vz * qz) / volume
            if 0.0 < along < 1.0:
                out[n] = True
                break


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
        normals(vertices, faces).astype(np.float32),
        np.ascontiguousarray(surface.colour, np.float32),
        np.full(len(faces), kind, np.uint8),
    )


def normals(vertices: Float, faces: Index | Int32) -> Float:
    """Compute outward unit normals [V, 3], means over the triangles around by area; zero where none are."""
    across = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    total = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(total, corner, across)
    unit: Float = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return unit


_EMPTY = TriangleSurface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))


# Four samples of a pixel with four distinct x and y smooth edges of any direction.
SUBROWS = 4
SHIFTS_PX = np.array([-0.125, 0.375, -0.375, 0.125])
CENTRES_PX = np.zeros(1)
"""Shift in x of the samples of each sample row from the pixel's centre; their y is evenly spaced."""

# Triangles are cut at this distance in front of the camera.
NEAR_M = 0.05
# No face has this number, so it marks samples that see none.
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
    x, y, z = (vertices - position).T[..., None]
    points: Float = x * world_from_camera[0] + y * world_from_camera[1] + z * world_from_camera[2]
    corners, source = _clipped(points, faces, pinhole, float(intrinsics.width), float(intrinsics.height))
    return Projected(corners, source)


def bands(triangles: Projected, height: int, rows: int) -> tuple[Int32, NDArray[np.int64]]:
    """Find the triangles [M] of each band of `rows` pixel rows, and the start [B + 1] of each band."""
    top, bottom = (of(triangles.corners[..., 1], axis=1) for of in (np.min, np.max))
    # A pixel row reaches half a pixel above and below its centre.
    first = (np.maximum(top + 0.5, 0.0) / rows).astype(np.int64)
    last = (np.minimum(bottom + 0.5, height - 0.5) / rows).astype(np.int64)
    touched = np.maximum(last + 1 - first, 0)
    triangle = np.repeat(np.arange(len(first), dtype=np.int32), touched)
    band = np.arange(len(triangle)) - np.repeat(np.cumsum(touched) - touched - first, touched)
    start = np.searchsorted(np.sort(band), np.arange((height + rows - 1) // rows + 1))
    return triangle[np.argsort(band, kind="stable")], start.astype(np.int64)


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
                for axis in range(3):
                    polygon[size, axis] = here[axis]
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
            for axis in range(3):
                corners[count, 0, axis] = polygon[0, axis]
                corners[count, 1, axis] = polygon[k, axis]
                corners[count, 2, axis] = polygon[k + 1, axis]
            source[count] = f
            count += 1
    return corners[:count], source[:count]


# --- fragments -----------------------------------------------------------------------------------------


class CameraView(NamedTuple):
    """The camera, and the land that goes on level where the ground's mesh ends."""

    position: Float  # [3] m
    world_from_camera: Float  # [3, 3]
    pinhole: Float  # [4] fx, fy, cx, cy
    land: Float  # [4] height in m (NaN without land) and mean RGB reflectance


class Fragments(NamedTuple):
    """Pieces of surface, in the order of their pixels; fields are filled up to a count."""

    pixel: Int32  # [N] of the band, row by row
    share: Float32  # [N] of the pixel's samples
    on_ground: Bytes  # [N] 0, or 1 + the pixel's place in a pattern of 4 x 4 for the texture
    point: Float32  # [N, 3] m, world
    normal: Float32  # [N, 3] unit, towards the camera's side of the face
    colour: Float32  # [N, 3] RGB reflectance
    distance: Float32  # [N] m from the camera
    slant: Float32  # [N] cosine between the normal and the direction to the camera


def room_for(count: int) -> Fragments:
    """Return fragments to be filled."""
    point, normal, colour = (np.empty((count, 3), np.float32) for _ in range(3))
    pixel, on_ground = np.empty(count, np.int32), np.empty(count, np.uint8)
    share, distance, slant = (np.empty(count, np.float32) for _ in range(3))
    return Fragments(pixel, share, on_ground, point, normal, colour, distance, slant)


@cached
def gather(
    band: Band, first_row: int, view: CameraView, mesh: Mesh, fragments: Fragments, sky: Float32
) -> int:
    """Find the fragments of a band's pixels, drawn with `SHIFTS_PX`, and their number.

    Samples of one face in one pixel become one fragment at their common centre, inside the face. Samples
    without a face see land below the horizon, and nothing above. `fragments` has room for as many as there
    are samples; `sky` [R * W] becomes the share of each pixel's samples that see nothing.
    """
    nearness, source = band
    position, turn, pinhole, land = view
    vertices, faces, normals, colours, kind = mesh
    pixel, share, on_ground, point, normal, colour, distance, slant = fragments
    width = nearness.shape[1]
    weight, per_fx, per_fy = 1.0 / SUBROWS, 1.0 / pinhole[0], 1.0 / pinhole[1]
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = turn
    ox, oy, oz = position
    count, known = 0, NOTHING
    for row in range(nearness.shape[0] // SUBROWS):
        top = row * SUBROWS
        for x in range(width):
            sky[row * width + x] = 0.0
            place = 1 + 4 * (row & 3) + (x & 3)
            done = 0  # a bit for each sample
            for first in range(SUBROWS):
                if done >> first & 1:
                    continue
                face = source[top + first, x]
                samples, near, right, down = 0, 0.0, 0.0, 0.0
                for k in range(SUBROWS):  # unrolled: the bounds are constants
                    if k >= first and source[top + k, x] == face:
                        done |= 1 << k
                        samples += 1
                        near += nearness[top + k, x]
                        right += SHIFTS_PX[k]
                        down += (k + 0.5) / SUBROWS - 0.5
                mean = 1.0 / samples
                right = (x + right * mean - pinhole[2]) * per_fx
                down = (first_row + row + down * mean - pinhole[3]) * per_fy
                dx = ax * right + bx * down + cx
                dy = ay * right + by * down + cy
                dz = az * right + bz * down + cz
                stretch = np.sqrt(dx * dx + dy * dy + dz * dz)  # metres of ray per metre of depth
                if face == NOTHING:
                    depth = (land[0] - oz) / dz
                    if not (0.0 < depth < 1e6):  # NaN where there is no land
                        sky[row * width + x] = samples * weight
                        continue
                    nx, ny, nz = 0.0, 0.0, 1.0
                    red, green, blue = land[1], land[2], land[3]
                    on_ground[count] = place
                else:
                    depth = samples / near
                    if face != known:  # neighbours in a row mostly see the same face
                        known = face
                        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                        smooth, ground = kind[face] & SMOOTH != 0, kind[face] & GROUND != 0
                        px, py, pz = vertices[a, 0], vertices[a, 1], vertices[a, 2]
                        ux, uy, uz = vertices[b, 0] - px, vertices[b, 1] - py, vertices[b, 2] - pz
                        vx, vy, vz = vertices[c, 0] - px, vertices[c, 1] - py, vertices[c, 2] - pz
                        gx, gy, gz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                        inverse = 1.0 / (gx * gx + gy * gy + gz * gz)
                        # Barycentric coordinates are linear: areas opposite the corners, over the whole.
                        sx, sy, sz = vy * gz - vz * gy, vz * gx - vx * gz, vx * gy - vy * gx
                        tx, ty, tz = gy * uz - gz * uy, gz * ux - gx * uz, gx * uy - gy * ux
                        # Level ground has one normal all over.
                        bent = False
                        for k in range(3):
                            level = normals[a, k] == normals[b, k] and normals[a, k] == normals[c, k]
                            bent = bent or (smooth and not level)
                        length = np.sqrt(inverse)
                        fx, fy, fz = gx * length, gy * length, gz * length
                    wx, wy, wz = ox + depth * dx - px, oy + depth * dy - py, oz + depth * dz - pz
                    s = (sx * wx + sy * wy + sz * wz) * inverse
                    t = (tx * wx + ty * wy + tz * wz) * inverse
                    s = min(max(s, 0.0), 1.0)
                    t = min(max(t, 0.0), 1.0 - s)
                    o = 1.0 - s - t
                    red = o * colours[a, 0] + s * colours[b, 0] + t * colours[c, 0]
                    green = o * colours[a, 1] + s * colours[b, 1] + t * colours[c, 1]
                    blue = o * colours[a, 2] + s * colours[b, 2] + t * colours[c, 2]
                    if bent:
                        nx = o * normals[a, 0] + s * normals[b, 0] + t * normals[c, 0]
                        ny = o * normals[a, 1] + s * normals[b, 1] + t * normals[c, 1]
                        nz = o * normals[a, 2] + s * normals[b, 2] + t * normals[c, 2]
                        scale = 1.0 / np.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-30))
                        nx, ny, nz = nx * scale, ny * scale, nz * scale
                    else:
                        nx, ny, nz = fx, fy, fz
                    on_ground[count] = place if ground else 0
                towards = -(nx * dx + ny * dy + nz * dz) / stretch
                side = 1.0 if towards > 0.0 else -1.0  # of the face that is seen
                pixel[count] = row * width + x
                share[count] = samples * weight
                point[count, 0] = ox + depth * dx
                point[count, 1] = oy + depth * dy
                point[count, 2] = oz + depth * dz
                normal[count, 0], normal[count, 1], normal[count, 2] = side * nx, side * ny, side * nz
                colour[count, 0], colour[count, 1], colour[count, 2] = red, green, blue
                distance[count] = depth * stretch
                slant[count] = side * towards
                count += 1
    return count


# --- shadows -------------------------------------------------------------------------------------------

# A shadow map has so many texels around its region, for the look-ups at its border.
_MARGIN = 4
# Neighbouring texels differ by more than this only at an edge, not on slopes that the sun lights well.
_STEP = 6.0


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
    """Draw a mesh's map over points [N, 3] m in texels of `finest_m`, or larger ones if they are too many."""
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
    x, y, z = fragments.normal[:count].T
    towards = axes[2]
    sun = np.asarray(np.maximum(x * towards[0] + y * towards[1] + z * towards[2], 0.0), np.float32)
    for each in maps:
        _cast(each, axes, fragments, sun)
    return sun


@cached
def _cast(shadow: ShadowMap, axes: Float, fragments: Fragments, sun: Float32) -> None:
    """Remove the light that one map shades: bilinear comparisons over 3 x 3 texels."""
    height, edge, corner, texel_m = shadow
    point, normal = fragments.point, fragments.normal
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


def _edges(height: Float32, step: float) -> Bytes:
    """Mark texels where heights within the 4 x 4 texels of a look-up differ by more than a step."""
    import cv2

    lowest, highest = (of(height, np.ones((4, 4), np.uint8), anchor=(1, 1)) for of in (cv2.erode, cv2.dilate))
    return np.asarray(highest > np.asarray(lowest, np.float64) + step, np.uint8)
