"""Pictures of people in a world, as a camera in daylight takes them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Bytes, Float, Float32
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.simulation.rendering.camera import DistortingLens, developed
from pipelines.simulation.rendering.fragments import CameraView, gather, room_for
from pipelines.simulation.rendering.raster import (
    CENTRES_PX,
    GROUND,
    NOTHING,
    SHIFTS_PX,
    SUBROWS,
    Band,
    Mesh,
    bands,
    draw,
    empty_band,
    mesh_of,
    projected,
    stacked,
)
from pipelines.simulation.rendering.shading import ground_texture, paint, shade
from pipelines.simulation.rendering.shadows import ShadowMap, shadow_map, sun_axes, sunlight
from pipelines.simulation.surfaces import TriangleSurface

_BAND_ROWS = 16  # pixel rows whose samples fit a processor's cache
_STATIC_TEXEL_M, _STATIC_TEXELS = 0.02, 2048
_PERSON_TEXEL_M, _PERSON_TEXELS = 0.008, 1024
_LEVEL_M = 0.05  # ground this close to its median height casts no shadow worth a map


class ExposedMoment(NamedTuple):
    """The camera's pose and the people before it at one moment."""

    position: Float  # [3] m, of the camera in the world
    quaternion_xyzw: Float  # [4] world_from_camera
    people: Sequence[TriangleSurface]  # whoever moves


class Renderer:
    """A world and a camera that takes pictures of it; several threads may share one.

    Everything is opaque and matt. The sun casts shadows, the sky lights without them. Where the mesh of
    the ground ends, land goes on level at the height of its lowest point, to the horizon.

    Args:
        static: the surfaces that do not move.
        intrinsics: the camera. Its readout is up to the caller, who asks for several moments (`exposed`).
        sun: [3] direction towards it, of any length.
        seed: of the ground's texture and of the sensor's noise.

    Raises:
        ValueError: distortion whose model does not reach the whole picture, or a sun that is not above the
            horizon.
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
        """Render the camera's picture.

        Args:
            position: [3] m, of the camera in the world.
            quaternion_xyzw: [4] world_from_camera.
            people: the surfaces that move.
            frame: number of the picture; with the seed and the position it fixes the noise.

        Returns:
            [H, W, 3] BGR; equal arguments give equal bytes.
        """
        return self.exposed(
            [ExposedMoment(position, quaternion_xyzw, people)], np.ones((1, self._size[0])), frame
        )

    def exposed(self, moments: Sequence[ExposedMoment], weights: Float, frame: int) -> Bytes:
        """Render what the camera sees while its rows are exposed.

        Args:
            moments: K of them, the picture's own time in the middle.
            weights: [K, H] how much of each row's light is each moment's; columns add up to 1.
            frame: number of the picture; with the seed and the middle moment's position it fixes the noise.

        Returns:
            [H, W, 3] BGR; equal arguments give equal bytes.
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
            paint(self._texture, fragments, count, view)
            sun = sunlight(shadows, self._axes, fragments, count)
            shade(fragments, count, sun, sky, first_row, view, rows)
        return light[part.start - top : part.stop - top]

    def silhouette(
        self,
        position: Float,
        quaternion_xyzw: Float,
        person: TriangleSurface,
        others: Sequence[TriangleSurface] = (),
    ) -> Bool:
        """Return the pixels [H, W] at whose centres the camera sees the person, without distortion.

        `others` are surfaces that may stand in front, besides the static ones; poses are those of
        `picture`.
        """
        meshes = [mesh_of([person]), self._static, *(mesh_of([other]) for other in others)]
        seen = self._at_centres(position, quaternion_xyzw, stacked(meshes)).source
        mine: Bool = (seen != NOTHING) & (seen < len(person.faces))
        return mine

    def depth(
        self, position: Float, quaternion_xyzw: Float, people: Sequence[TriangleSurface] = ()
    ) -> Float32:
        """Return the depth [H, W] m at pixels' centres, along the optical axis, without distortion.

        It is infinite where no surface is seen; poses are those of `picture`.
        """
        mesh = stacked([self._static, *(mesh_of([person]) for person in people)])
        nearness = self._at_centres(position, quaternion_xyzw, mesh).nearness
        depth = np.full_like(nearness, np.inf)
        return np.divide(np.float32(1), nearness, out=depth, where=nearness > 0)

    def _at_centres(self, position: Float, quaternion_xyzw: Float, mesh: Mesh) -> Band:
        rotation = matrix_from_quaternion(np.asarray(quaternion_xyzw, np.float64))
        position = np.asarray(position, np.float64)
        triangles = projected(mesh.vertices, mesh.faces, position, rotation, self._intrinsics)
        band = empty_band(self._intrinsics.height, self._intrinsics.width)
        draw(triangles, np.arange(len(triangles.source), dtype=np.int32), CENTRES_PX, 0, band)
        return band


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


def _noise_key(seed: int, frame: int, position: Float) -> int:
    """Compute the key of a picture's noise."""
    where = np.ascontiguousarray(position).view(np.uint32).tolist()
    return int(np.random.SeedSequence([seed, frame, *where]).generate_state(1, np.uint64)[0])
