"""Fragments: the pieces of surface that make up a pixel, each to be shaded once, gathered from samples."""

from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bytes, Float, Float32, Int32
from pipelines.geometry.compilation import cached
from pipelines.simulation.rendering.raster import GROUND, NOTHING, SHIFTS_PX, SMOOTH, SUBROWS, Band, Mesh


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
    """Find the fragments of a band's pixels, and their number.

    Samples of one face in one pixel become one fragment at their common centre, which lies on the face and
    inside it. Samples without a face see land below the horizon, and nothing above. The band was drawn with
    `SHIFTS_PX`, `first_row` is its first row in the picture. Filled are `fragments`, with room for as many
    as there are samples, and `sky` [R * W], the share of each pixel's samples that see nothing.
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
