"""Conversion of latitude, longitude and height to metres east, north and up of a place (WGS84).

By earth-centred, earth-fixed coordinates, in closed form. Formulas: IOGP Guidance Note 7-2 (EPSG methods 9602
and 9837). Heights are metres above the ellipsoid; heights above sea level, where all are, stretch horizontal
distances by less than 2e-5. NaN in gives NaN out.
"""

import numpy as np

from pipelines.geometry.arrays import Float, Place

# WGS 84 defines its ellipsoid by this semi-major axis.
_SEMI_MAJOR_M = 6_378_137.0
# WGS 84 defines its ellipsoid by this flattening.
_FLATTENING = 1 / 298.257223563
# The eccentricity of an ellipse follows from its flattening.
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)


def ecef_from_geodetic(latitude_deg: Float, longitude_deg: Float, altitude_m: Float) -> Float:
    """Compute earth-centred coordinates [..., 3] m of points on Earth; arguments broadcast."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    # The radius of curvature in the prime vertical.
    normal_m = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    from_axis = (normal_m + altitude_m) * np.cos(latitude)
    z = ((1 - _ECCENTRICITY_SQUARED) * normal_m + altitude_m) * np.sin(latitude)
    return np.stack(
        np.broadcast_arrays(from_axis * np.cos(longitude), from_axis * np.sin(longitude), z), axis=-1
    )


def geodetic_from_ecef(from_centre: Float) -> tuple[Float, Float, Float]:
    """Compute latitude, longitude (deg) and height (m) of [..., 3] by one step of Bowring 1976, to 1e-6 m."""
    x, y, z = np.moveaxis(from_centre, -1, 0)
    from_axis = np.hypot(x, y)
    semi_minor_m = _SEMI_MAJOR_M * (1 - _FLATTENING)
    reduced = np.arctan2(z * _SEMI_MAJOR_M, from_axis * semi_minor_m)
    second_squared = _ECCENTRICITY_SQUARED / (1 - _ECCENTRICITY_SQUARED)
    latitude = np.arctan2(
        z + second_squared * semi_minor_m * np.sin(reduced) ** 3,
        from_axis - _ECCENTRICITY_SQUARED * _SEMI_MAJOR_M * np.cos(reduced) ** 3,
    )
    # The projection on the normal has no division that vanishes, at the equator or at the poles.
    to_surface_m = _SEMI_MAJOR_M * np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    altitude = from_axis * np.cos(latitude) + z * np.sin(latitude) - to_surface_m
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude


def geodetic_from_enu(enu: Float, origin: Place) -> tuple[Float, Float, Float]:
    """Compute latitude and longitude in degrees and height in metres of points [..., 3] m of a place."""
    return geodetic_from_ecef(enu @ _enu_axes(origin) + _ecef_of(origin))


def place_at(enu: Float, origin: Place) -> Place:
    """Find the place that lies at metres [3] east, north and up of another."""
    latitude, longitude, altitude = geodetic_from_enu(enu, origin)
    return Place(float(latitude), float(longitude), float(altitude))


def enu_from_geodetic(latitude_deg: Float, longitude_deg: Float, altitude_m: Float, origin: Place) -> Float:
    """Compute metres [..., 3] east, north and up of a place for points on Earth; arguments broadcast."""
    from_centre = ecef_from_geodetic(latitude_deg, longitude_deg, altitude_m) - _ecef_of(origin)
    return from_centre @ _enu_axes(origin).T


def enu_from_enu(of: Place, origin: Place) -> tuple[Float, Float]:
    """Compute the rotation [3, 3] and position [3] m of one place's axes in those of another."""
    axes = _enu_axes(origin)
    return axes @ _enu_axes(of).T, axes @ (_ecef_of(of) - _ecef_of(origin))


def _ecef_of(place: Place) -> Float:
    return ecef_from_geodetic(
        np.asarray(place.latitude_deg), np.asarray(place.longitude_deg), np.asarray(place.altitude_m)
    )


def _enu_axes(place: Place) -> Float:
    """Compute the directions east, north and up [3, 3] at a place, one row each, in earth-centred axes."""
    latitude, longitude = np.radians(place.latitude_deg), np.radians(place.longitude_deg)
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
