"""Coordinates of a map projection (UTM and any other CRS) in the world, by pyproj (extra `places`).

Positions become latitude and longitude, then metres east, north and up of the world's origin: exact at any
distance. Attitudes turn by the angle from true to grid north at each position. Heights stay as they are.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.maps.voxel_grids import placed
from pipelines.geometry.arrays import Float
from pipelines.geometry.geodesy import Place, enu_from_geodetic
from pipelines.geometry.poses import (
    carried_covariance,
    matrix_from_quaternion,
    multiply,
    quaternion_from_rotation_vector,
)
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy, Trajectory
from pipelines.session.registries import need

_NEAREST_M = 10_000.0
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
    """One CRS, of positions x east (or longitude), y north (or latitude) and height.

    Raises:
        DataError: pyproj is missing, or the CRS is unknown or no projected or geographic one.
    """

    def __init__(self, name: str, place: str) -> None:
        pyproj: Any = need("pyproj", "places")
        crs = _crs(name)
        if crs is None:
            raise DataError(
                place,
                f"{name!r} is no projected or geographic CRS",
                "write one like EPSG:32632 (UTM 32 north)",
                code="place-unknown",
            )
        authority = crs.to_authority(min_confidence=100)
        self.name = ":".join(authority) if authority else crs.name
        self._step = 1.0 if crs.is_projected else 1e-5  # a unit north by which grid north is found
        self._to_earth = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        # No flight is near the zero of a grid whose zero lies outside of the area that it is for, as in UTM.
        # Japan, Portugal and Norway have it in the middle of their grids.
        is_far = crs.is_projected and crs.area_of_use is not None and not self._has_zero_in(crs.area_of_use)
        self._nearest_m = _NEAREST_M if is_far else 0.0

    def _has_zero_in(self, area: Any) -> bool:
        """Test if x 0, y 0 lies in pyproj's area of use."""
        longitude, latitude = self._to_earth.transform(0.0, 0.0)
        in_longitude = area.west <= longitude <= area.east or area.west > area.east
        return bool(in_longitude and area.south <= latitude <= area.north)

    def first_place(self, source: Path | str, position: Float) -> Place:
        """Return the place on Earth of the first position [N, 3].

        Raises:
            DataError: it lies outside the CRS.
        """
        latitude, longitude, height = self._geodetic(source, position[:1])[0].tolist()
        return Place(latitude, longitude, height)

    def points(self, source: Path | str, position: Float, origin: Place) -> Float:
        """Convert positions [..., 3] to metres east, north and up of the origin; NaN stays NaN.

        Raises:
            DataError: none of them lies inside the CRS.
        """
        flat = position.reshape(-1, 3)
        latitude, longitude, height = self._geodetic(source, flat).T
        return enu_from_geodetic(latitude, longitude, height, origin).reshape(position.shape)

    def trajectory(self, source: Path | str, poses: Trajectory, origin: Place) -> Trajectory:
        """Convert poses in the grid's axes to the world; covariances of positions turn with them."""
        position = self.points(source, poses.position, origin)
        turn = self._turn(source, poses.position, origin)
        covariance = poses.covariance
        if covariance is not None:
            rotated = np.tile(np.eye(6), (len(turn), 1, 1))
            rotated[:, :3, :3] = matrix_from_quaternion(turn)  # the rotation part stays in the body
            covariance = carried_covariance(rotated, covariance)
        quaternion = multiply(turn, poses.quaternion_xyzw)
        return replace(poses, position=position, quaternion_xyzw=quaternion, covariance=covariance)

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
            raise DataError(
                source, f"its x {x:.0f}, y {y:.0f} lies outside {self.name}", _NO_PLACE, code="place-unknown"
            )
        return found

    def _turn(self, source: Path | str, position: Float, origin: Place) -> Float:
        """Return the rotations [N, 4] from the grid's axes to the world's, about the vertical."""
        north = self.points(source, position + np.array([0, self._step, 0]), origin)
        north -= self.points(source, position, origin)
        yaw = np.arctan2(-north[:, 0], north[:, 1])
        still = np.zeros_like(yaw)
        return quaternion_from_rotation_vector(np.stack([still, still, yaw], axis=1))
