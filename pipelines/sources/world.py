"""Conversion of logged poses to the world: to its clock, its axes (east-north-up) and its origin; doubts."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.rows import METRES
from pipelines.formats.maps.voxel_grids import placed
from pipelines.geometry.arrays import Float, Int64, Place
from pipelines.geometry.geodesy import enu_from_geodetic
from pipelines.geometry.mounting import FLU_FROM_FRD, body_from_camera
from pipelines.geometry.poses import (
    ENU_FROM_NED,
    carried_covariance,
    conjugate,
    invert,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
)
from pipelines.session.errors import DataError
from pipelines.session.manifest import Axes, FiledPose, LogClock, Mount, Placement, PoseSource, Up, WorldAxes
from pipelines.session.records import Occupancy, Trajectory
from pipelines.session.registries import need

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])

# No drone flies so far from the origin, and eastings of UTM begin at 166 km.
MAX_DISTANCE_M = 100_000.0


UP_ROWS: dict[Up, tuple[tuple[int, int, int], ...]] = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "-y": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "-x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
}
"""Rotations from a world in which an axis points up to one with z up; y up turns as files of joints do."""


def upright(world: WorldAxes) -> Placement:
    """Return the placement that turns the files' world upright, in metres."""
    if world.up is None or world.up == "z":
        return Placement(scale=world.scale)
    turn = quaternion_from_matrix(np.array(UP_ROWS[world.up], dtype=np.float64))
    return Placement(rotation_xyzw=turn.tolist(), scale=world.scale)


def as_stated(trajectory: Trajectory, pose: PoseSource, options: FiledPose) -> Trajectory:
    """Return poses as the manifest states them, in metres; inverted ones lose their covariances."""
    if options.quaternion == "wxyz":
        trajectory = replace(trajectory, quaternion_xyzw=np.roll(trajectory.quaternion_xyzw, -1, axis=-1))
    if options.inverse:
        position, quaternion = invert(trajectory.position, trajectory.quaternion_xyzw)
        trajectory = replace(trajectory, position=position, quaternion_xyzw=quaternion, covariance=None)
    if options.z == "down":
        covariance = trajectory.covariance
        if covariance is not None:
            signs = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])
            covariance = covariance * np.outer(signs, signs)
        trajectory = replace(
            trajectory, position=trajectory.position * [1.0, 1.0, -1.0], covariance=covariance
        )
    return moved(trajectory, scale=METRES[pose.unit or "m"])


def moved(
    trajectory: Trajectory,
    *,
    turn: Float | None = None,
    shift: Float | None = None,
    scale: float = 1.0,
    new_from_old_body: Float | None = None,
) -> Trajectory:
    """Change the axes of poses: scale, turn and shift (m) the world, and turn the body's own axes."""
    position, quaternion = scale * trajectory.position, trajectory.quaternion_xyzw
    covariance, body = trajectory.covariance, trajectory.body_xyzw
    if turn is not None:
        position, quaternion = rotate(turn, position), multiply(turn, quaternion)
        body = None if body is None else multiply(turn, body)
    if new_from_old_body is not None:
        quaternion = multiply(quaternion, conjugate(new_from_old_body))
    if covariance is not None and not (turn is None and new_from_old_body is None and scale == 1.0):
        covariance = carried_covariance(
            covariance,
            position_xyzw=LEVEL if turn is None else turn,
            rotation_xyzw=LEVEL if new_from_old_body is None else new_from_old_body,
            scale=scale,
        )
    return replace(
        trajectory,
        position=position if shift is None else position + shift,
        quaternion_xyzw=quaternion,
        covariance=covariance,
        body_xyzw=body,
    )


def world_times(clock: LogClock, t_ns: Int64, since_ns: int) -> Int64:
    """Convert a log's own times to world times [N]; its drift counts from `since_ns`."""
    drift_ns = np.round((t_ns - since_ns) * (clock.drift_ppm * 1e-6)).astype(np.int64)
    return t_ns + drift_ns + clock.offset_ns


def in_enu(trajectory: Trajectory, axes: Axes, *, of_body: bool = False) -> Trajectory:
    """Convert poses to an ENU world; the body of a log in NED has FRD axes, which become FLU."""
    if axes == "enu":
        return trajectory
    return moved(trajectory, turn=ENU_FROM_NED, new_from_old_body=FLU_FROM_FRD if of_body else None)


def in_world(trajectory: Trajectory, place: Placement) -> Trajectory:
    """Scale and move a trajectory in the ENU axes of its source to where the source lies in the world."""
    if place == Placement():
        return trajectory
    return moved(trajectory, turn=turn_of(place), shift=np.array(place.translation), scale=place.scale)


def turn_of(place: Placement) -> Float:
    """Return the rotation [4] from a source's axes to the world's."""
    if place.rotation_xyzw is not None:
        return np.array(place.rotation_xyzw)
    return quaternion_from_rotation_vector(np.array([0.0, 0.0, np.radians(place.yaw_deg)]))


def refuse_projected(source: Path | str, position: Float, origin: Place, crs: str = "") -> None:
    """Refuse coordinates of a map projection, such as UTM: over 100 km from a known origin on Earth."""
    across = position[np.isfinite(position[:, :2]).all(axis=1), :2]
    if not len(across):
        return
    x_m, y_m = np.median(across, axis=0).tolist()
    away_m = float(np.hypot(x_m, y_m))
    if away_m > MAX_DISTANCE_M:
        place = f"latitude {origin.latitude_deg:.6f}, longitude {origin.longitude_deg:.6f}"
        away = f"{away_m / 1000:.0f} km from the world's origin ({place})"
        if crs:
            problem = f"lies {away} by its CRS, {crs}"
            remedy = "give the files of one place, or correct world.crs or map.crs"
            raise DataError(source, problem, remedy, code="place-unknown")
        problem = f"lies about x {x_m:.0f} m, y {y_m:.0f} m (UTM or another map projection), {away}"
        remedy = "state the CRS, world: {crs: EPSG:32632} or map: {crs: ...}; or give metres from that origin"
        raise DataError(source, problem, remedy, code="place-unknown")


def losses(dropped: dict[str, int]) -> str:
    """Format the losses by cause, in words."""
    return ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it is empty"


def mounted(mount: Mount | None) -> tuple[Float, Float]:
    """Return lever arm [3] and rotation [4] of a camera in its body, or in its gimbal if there is one."""
    if mount is None:  # the manifest's checks guarantee a gimbal in this case
        return np.zeros(3), body_from_camera("forward")
    if mount.rotation_xyzw is not None:
        return np.array(mount.translation), np.array(mount.rotation_xyzw)
    return np.array(mount.translation), body_from_camera(mount.looks or "forward", mount.down_deg)


# No flight is nearer to the zero of a grid that lies outside of its own area.
MIN_GRID_COORDINATE_M = 10_000.0

_NO_PLACE = "check the CRS: world.crs and map.crs are those of the numbers in the files"


def is_usable(name: str) -> bool:
    """Return True for a projected or geographic CRS that pyproj knows."""
    return _crs(name) is not None


def _crs(name: str) -> Any | None:
    pyproj: Any = need("pyproj", "places")
    try:
        crs = pyproj.CRS.from_user_input(name).to_2d()
    except pyproj.exceptions.CRSError:
        return None
    return crs if crs.is_projected or crs.is_geographic else None


class Projection:
    """One CRS, of east (or longitude), north (or latitude), height; DataError: it is not usable."""

    def __init__(self, name: str, place: str) -> None:
        pyproj: Any = need("pyproj", "places")
        crs = _crs(name)
        if crs is None:
            problem = f"{name!r} is no projected or geographic CRS"
            raise DataError(place, problem, "write one like EPSG:32632 (UTM 32 north)", code="place-unknown")
        authority = crs.to_authority(min_confidence=100)
        self.name = ":".join(authority) if authority else crs.name
        self._step = 1.0 if crs.is_projected else 1e-5  # a unit north by which grid north is found
        self._to_earth = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        # No flight is near the zero of a grid whose zero lies outside of the area that it is for, as in UTM.
        # Japan, Portugal and Norway have it in the middle of their grids.
        is_far = crs.is_projected and crs.area_of_use is not None and not self._has_zero_in(crs.area_of_use)
        self._nearest_m = MIN_GRID_COORDINATE_M if is_far else 0.0

    def _has_zero_in(self, area: Any) -> bool:
        """Test if x 0, y 0 lies in pyproj's area of use."""
        longitude, latitude = self._to_earth.transform(0.0, 0.0)
        in_longitude = area.west <= longitude <= area.east or area.west > area.east
        return bool(in_longitude and area.south <= latitude <= area.north)

    def first_place(self, source: Path | str, position: Float) -> Place:
        """Return the place on Earth of the first position [N, 3]; DataError: outside the CRS."""
        latitude, longitude, height = self._geodetic(source, position[:1])[0].tolist()
        return Place(latitude, longitude, height)

    def points(self, source: Path | str, position: Float, origin: Place) -> Float:
        """Convert [..., 3] to metres east, north, up of the origin, NaN stays; DataError: outside."""
        flat = position.reshape(-1, 3)
        latitude, longitude, height = self._geodetic(source, flat).T
        return enu_from_geodetic(latitude, longitude, height, origin).reshape(position.shape)

    def trajectory(self, source: Path | str, poses: Trajectory, origin: Place) -> Trajectory:
        """Convert poses in the grid's axes to the world; covariances of positions turn with them."""
        turned = moved(poses, turn=self._turn(source, poses.position, origin))
        return replace(turned, position=self.points(source, poses.position, origin))

    def map(self, source: Path | str, grid: Occupancy, origin: Place) -> tuple[Occupancy, float]:
        """Convert a map to the world about its own centre; return also the largest error (m) of that.

        The grid's scale, which differs from 1 by up to 0.04 % in UTM, is not applied to voxels.
        """
        half = np.array(grid.probability.shape) * grid.resolution_m / 2
        centre = grid.origin + half
        turn = self._turn(source, centre[None], origin)[0]
        middle = self.points(source, centre[None], origin)[0]
        found = placed(str(source), replace(grid, origin=-half), (middle, turn))
        corners = centre + half * [[-1, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0]]
        exact = self.points(source, corners, origin)[:, :2]
        kept = (corners - centre) @ matrix_from_quaternion(turn).T + middle
        return found, float(np.linalg.norm(exact - kept[:, :2], axis=1).max())

    def _geodetic(self, source: Path | str, position: Float) -> Float:
        """Return latitude, longitude (deg) and height (m) of positions [N, 3]."""
        known = position[np.isfinite(position[:, :2]).all(axis=1), :2]
        if len(known) and np.abs(known).max() < self._nearest_m:
            x, y = known[0].tolist()
            problem = f"its x {x:.0f}, y {y:.0f} are metres of a local frame, not coordinates in {self.name}"
            raise DataError(source, problem, _NO_PLACE, code="place-unknown")
        longitude, latitude = self._to_earth.transform(position[:, 0], position[:, 1])
        found = np.stack([latitude, longitude, position[:, 2]], axis=1)
        found[~np.isfinite(found).all(axis=1)] = np.nan  # pyproj says inf outside the CRS
        if len(found) and np.isnan(found[:, 0]).all():
            x, y = position[0, :2].tolist()
            problem = f"its x {x:.0f}, y {y:.0f} lies outside {self.name}"
            raise DataError(source, problem, _NO_PLACE, code="place-unknown")
        return found

    def _turn(self, source: Path | str, position: Float, origin: Place) -> Float:
        """Return the rotations [N, 4] from the grid's axes to the world's, about the vertical."""
        north = self.points(source, position + np.array([0, self._step, 0]), origin)
        north -= self.points(source, position, origin)
        yaw = np.arctan2(-north[:, 0], north[:, 1])
        still = np.zeros_like(yaw)
        return quaternion_from_rotation_vector(np.stack([still, still, yaw], axis=1))
