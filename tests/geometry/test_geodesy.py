"""Conversion of latitude and longitude to metres, against published examples and an independent inverse."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Place
from pipelines.geometry.geodesy import ecef_from_geodetic, enu_from_enu, enu_from_geodetic, geodetic_from_ecef

# IOGP Guidance Note 7-2, method 9837: the topocentric origin of the worked example.
NORTH_SEA = Place(55.0, 5.0, 200.0)


def _deg(degrees: float, minutes: float, seconds: float) -> float:
    return degrees + minutes / 60 + seconds / 3600


def test_geocentric_coordinates_of_the_published_example() -> None:
    # IOGP Guidance Note 7-2, method 9602; printed to the millimetre, its angles to 0.001" (0.03 m).
    point = ecef_from_geodetic(np.array(_deg(53, 48, 33.820)), np.array(_deg(2, 7, 46.380)), np.array(73.0))
    np.testing.assert_allclose(point, [3771793.968, 140253.342, 5124304.349], atol=0.02)


def test_topocentric_coordinates_of_the_published_example() -> None:
    # Method 9837: the point of method 9602 seen from the North Sea, printed to the millimetre.
    enu = enu_from_geodetic(
        np.array(_deg(53, 48, 33.82)), np.array(_deg(2, 7, 46.38)), np.array(73.0), NORTH_SEA
    )
    np.testing.assert_allclose(enu, [-189013.869, -128642.040, -4220.171], atol=0.02)


@pytest.mark.parametrize("origin", [NORTH_SEA, Place(-33.9, 151.2, 40.0), Place(89.9, -170.0, 0.0)])
def test_an_independent_inverse_gives_the_degrees_back(origin: Place) -> None:
    rng = np.random.default_rng(3)
    latitude = np.clip(origin.latitude_deg + rng.uniform(-0.05, 0.05, 50), -89.99, 89.99)
    longitude = origin.longitude_deg + rng.uniform(-0.05, 0.05, 50)
    altitude = rng.uniform(-100, 3000, 50)
    back = _geodetic(ecef_from_geodetic(latitude, longitude, altitude))
    np.testing.assert_allclose(back[:, 0], latitude, atol=1e-9)  # 0.1 mm
    np.testing.assert_allclose((back[:, 1] - longitude + 180) % 360 - 180, 0, atol=1e-6)
    np.testing.assert_allclose(back[:, 2], altitude, atol=1e-3)


def test_the_inverse_gives_the_degrees_back_anywhere() -> None:
    rng = np.random.default_rng(5)
    latitude, longitude = rng.uniform(-90, 90, 500), rng.uniform(-180, 180, 500)
    altitude = rng.uniform(-400, 9000, 500)
    latitude[:2], latitude[2] = (90, -90), 0
    back = geodetic_from_ecef(ecef_from_geodetic(latitude, longitude, altitude))
    np.testing.assert_allclose(back[0], latitude, atol=1e-11)  # 1 micrometre
    np.testing.assert_allclose(back[2], altitude, atol=1e-6)
    inland = np.abs(latitude) < 89
    np.testing.assert_allclose(back[1][inland], longitude[inland], atol=1e-9)


def test_from_one_place_to_another_is_the_same_as_directly() -> None:
    here, there = Place(47.0, 8.0, 400.0), Place(47.02, 8.03, 450.0)
    latitude, longitude, altitude = (
        np.array([47.021, 47.019]),
        np.array([8.031, 8.029]),
        np.array([460.0, 470.0]),
    )
    rotation, position = enu_from_enu(there, here)
    by_way = enu_from_geodetic(latitude, longitude, altitude, there) @ rotation.T + position
    # Earth-centred coordinates have 7 digits before the point: doubles leave 1e-9 m of them.
    np.testing.assert_allclose(by_way, enu_from_geodetic(latitude, longitude, altitude, here), atol=1e-7)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def _geodetic(ecef: Float) -> Float:
    """Compute latitude, longitude, altitude by iteration (Hofmann-Wellenhof, GPS, ch. 10.2.1)."""
    flattening = 1 / 298.257223563
    e2 = flattening * (2 - flattening)
    x, y, z = ecef.T
    from_axis = np.hypot(x, y)
    latitude = np.arctan2(z, from_axis * (1 - e2))
    for _ in range(20):
        normal = 6378137.0 / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + e2 * normal * np.sin(latitude), from_axis)
    normal = 6378137.0 / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    altitude = from_axis * np.cos(latitude) + z * np.sin(latitude) - normal * (1 - e2 * np.sin(latitude) ** 2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude], axis=1)
