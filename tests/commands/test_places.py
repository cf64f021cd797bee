"""Flights whose sources are in a map projection: everything lies where it was flown."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.maps.point_files import PCD
from pipelines.formats.poses import write_tum as write_trajectory
from pipelines.geometry.arrays import Float, Place
from pipelines.geometry.geodesy import enu_from_geodetic, place_at
from pipelines.geometry.poses import multiply, quaternion_from_rotation_vector
from pipelines.ingest import ingest
from pipelines.session.maps import read_grid, write_grid
from pipelines.session.records import Occupancy, Trajectory
from pipelines.sources.world import Projection
from tests.commands.runner import refused
from tests.commands.test_drone_flights import errors
from tests.formats.maps.test_las import write as write_las
from tests.real_data import real_data
from tests.synthetic.drone_logs import HOME
from tests.synthetic.flights import SyntheticFlight, write_flight

ZONE, CENTRAL_DEG = "EPSG:32617", -81.0  # UTM 17 north, where HOME is


def utm(latitude_deg: float, longitude_deg: float, central_deg: float = CENTRAL_DEG) -> tuple[float, float]:
    """Compute UTM's easting and northing by Krueger's series to the third order (IOGP 7-2, method 9807)."""
    a, f = 6_378_137.0, 1 / 298.257223563
    n = f / (2 - f)
    scale = a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    e = np.sqrt(f * (2 - f))
    phi, away = np.radians(latitude_deg), np.radians(longitude_deg - central_deg)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(away)), np.arctanh(np.sin(away) / np.sqrt(1 + t * t))
    series = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    north, east = xi, eta
    for k, h in enumerate(series, 1):
        north += h * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
        east += h * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
    return 500_000 + 0.9996 * scale * east, 0.9996 * scale * north


def in_utm(enu: Float) -> Float:
    """Convert metres from HOME [N, 3] to UTM and heights."""
    places = [place_at(row, HOME) for row in enu]
    return np.array([(*utm(p.latitude_deg, p.longitude_deg), p.altitude_m) for p in places])


def grid_north_rad() -> float:
    """Compute by how much grid north is east of true north at HOME, from two points."""
    south, north = (utm(HOME.latitude_deg + d, HOME.longitude_deg) for d in (-1e-4, 1e-4))
    return -float(np.arctan2(north[0] - south[0], north[1] - south[1]))


def flown_in_utm(folder: Path) -> SyntheticFlight:
    """Write a flight whose poses are in UTM: grid axes for positions and attitudes."""
    flight = write_flight(folder, cameras=2, seconds=1.0, clean=True)
    turn = quaternion_from_rotation_vector(np.array([0, 0, grid_north_rad()]))
    for k, name in enumerate(flight.cameras):
        turned = multiply(turn, flight.camera_quaternion[k])
        write_trajectory(
            folder / f"{name}.tum", Trajectory(flight.t_ns, in_utm(flight.camera_position[k]), turned)
        )
        flight.settings["cameras"][name]["pose"] = {"file": f"{name}.tum"}
    flight.settings["world"] |= {"crs": ZONE}
    names = ("latitude_deg", "longitude_deg", "altitude_m")
    flight.settings["world"]["origin"] = {name: getattr(HOME, name) for name in names}
    flight.settings.pop("truth", None)
    flight.save()
    return flight


def test_poses_in_utm_are_where_and_as_they_were_flown(tmp_path: Path) -> None:
    flight = flown_in_utm(tmp_path)
    # 0.68 deg between grid and true north: it cannot be missed.
    assert abs(np.degrees(grid_north_rad())) > 0.6
    ingest(flight.manifest)
    for k in range(2):
        off_m, off_deg = errors(flight, k)
        assert off_m < 1e-3  # the series is exact to 0.1 mm
        assert off_deg < 1e-3  # meridians converge by 1e-4 deg over the flight


def test_a_map_in_utm_stands_where_it_was_measured(tmp_path: Path) -> None:
    flight = flown_in_utm(tmp_path)
    pillar = np.array([30.0, -20.0, 4.0])  # m from HOME
    east, north, height = in_utm(pillar[None])[0]
    grid = np.zeros((20, 20, 20), np.float32)
    grid[10, 10, 10] = 1.0
    corner = np.array([east, north, height]) - 10.5  # the middle of that voxel is the pillar
    write_grid(tmp_path / "b.npz", Occupancy(grid, corner, 1.0))
    flight.settings["world"].pop("crs")
    for name in flight.cameras:
        flight.settings["cameras"][name]["pose"] = {"file": f"{name}_local.tum"}
    for k, name in enumerate(flight.cameras):
        local = Trajectory(flight.t_ns, flight.camera_position[k], flight.camera_quaternion[k])
        write_trajectory(tmp_path / f"{name}_local.tum", local)
    flight.settings["map"] = {"file": "b.npz", "crs": ZONE}
    flight.save()
    session = ingest(flight.manifest)
    stored = read_grid(next((flight.manifest.with_suffix(".session") / "map").glob("*.npz")))
    occupied = np.argwhere(stored.probability >= 0.5)
    middles = stored.origin + (occupied + 0.5) * stored.resolution_m
    # A turned voxel may touch its neighbours: the nearest of them holds the pillar.
    assert np.abs(middles - pillar).max(axis=1).min() <= 0.51
    assert np.abs(middles - pillar).max() <= 2
    assert not session.description.doubts


def test_a_real_cloud_in_utm_is_moved_as_pyproj_moves_its_points() -> None:
    pyproj = pytest.importorskip("pyproj")
    path = real_data("second/isprs_samp11-utm.pcd")
    origin = Place(48.78, 9.17, 300.0)
    grid = PCD.read_map(path, resolution_m=2.0)
    found, error_m = Projection("EPSG:32632", "map.crs").map(path, grid, origin)
    to_earth = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    middles = grid.origin + (np.argwhere(grid.probability >= 0.5) + 0.5) * 2.0
    longitude, latitude = to_earth.transform(middles[:, 0], middles[:, 1])
    expected = enu_from_geodetic(latitude, longitude, middles[:, 2], origin)
    assert error_m < 0.1  # 0.04 % of 160 m
    cells = np.floor((expected - found.origin) / found.resolution_m).astype(int)
    occupied = found.probability >= 0.5
    shifts = [np.array(shift) - 1 for shift in np.ndindex(3, 3, 3)]
    last = np.array(occupied.shape) - 1
    near = [occupied[tuple(np.clip(cells + shift, 0, last).T)] for shift in shifts]
    assert np.any(near, axis=0).all()
    assert np.hypot(*expected[:, :2].mean(axis=0)) < 5000


@pytest.mark.parametrize("crs", ["EPSG:1", "UTM zone of the team", "EPSG:4978", "EPSG:5703"])
def test_a_crs_that_is_none_is_refused(tmp_path: Path, crs: str) -> None:
    flight = flown_in_utm(tmp_path)
    flight.settings["world"]["crs"] = crs
    flight.save()
    said = refused("ingest", flight.manifest)
    assert "world.crs" in said
    assert "EPSG:32632" in said


@pytest.mark.parametrize(
    ("crs", "latitude_deg", "longitude_deg"), [("EPSG:6677", 36.0, 139 + 5 / 6), ("EPSG:27391", 58.0, 6.052)]
)
def test_a_grid_whose_zero_is_in_its_country_is_flown_there(
    crs: str, latitude_deg: float, longitude_deg: float
) -> None:
    place = Projection(crs, "world.crs").first_place("poses", np.array([[0.0, 0.0, 30.0]]))
    assert (place.latitude_deg, place.longitude_deg) == pytest.approx((latitude_deg, longitude_deg), abs=2e-3)


@pytest.mark.parametrize(
    ("change", "code", "named"),
    [
        (lambda p: p + np.array([512_767.0, 5_403_710.0, 0.0]), "origin", "UTM"),
        (lambda p: p + np.array([0.0, 9000.0, 0.0]), "origin", "drone2"),
        (lambda p: 1000 * (p + np.array([30.0, 0, 0])), "unit", "mm"),
    ],
)
def test_poses_that_cannot_lie_in_one_place_are_doubted(
    tmp_path: Path, change: Any, code: str, named: str
) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=1.0, clean=True)
    poses = Trajectory(flight.t_ns, change(flight.camera_position[1]), flight.camera_quaternion[1])
    write_trajectory(tmp_path / "b.tum", poses)
    flight.settings["cameras"]["drone2"]["pose"] = {"file": "b.tum"}
    flight.save()
    (doubt,) = ingest(flight.manifest).description.doubts
    assert (doubt.code, doubt.cameras) == (code, ["drone2"])
    assert named in f"{doubt.what} {doubt.remedy}"


@pytest.mark.parametrize(
    ("stated", "factor", "right"), [("mm", 1, "m"), (None, 1000, "mm"), ("m", 100, "cm")]
)
def test_a_unit_in_which_no_team_stands_is_doubted(
    tmp_path: Path, stated: str | None, factor: float, right: str
) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.5, clean=True)
    for k, (name, camera) in enumerate(flight.settings["cameras"].items()):
        poses = Trajectory(flight.t_ns, factor * flight.camera_position[k], flight.camera_quaternion[k])
        write_trajectory(tmp_path / f"{name}.tum", poses)
        camera["pose"] = {"file": f"{name}.tum"} | ({"unit": stated} if stated else {})
    flight.save()
    (doubt,) = ingest(flight.manifest).description.doubts
    assert (doubt.code, doubt.cameras) == ("unit", ["drone1", "drone2"])
    assert doubt.remedy.endswith(f".pose.unit: {right}")


def test_a_map_far_from_all_cameras_is_doubted(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=1.0, clean=True)
    flight.settings["map"] = {"file": str(real_data("second/isprs_samp11-utm.pcd")), "resolution_m": 2.0}
    flight.save()
    (doubt,) = ingest(flight.manifest).description.doubts
    assert (doubt.code, doubt.cameras) == ("origin", [])
    assert "map.crs" in doubt.remedy
    apart_m = doubt.evidence["apart_m"]
    assert isinstance(apart_m, float)
    assert apart_m > 5_000_000


@pytest.mark.parametrize(
    ("own", "stated", "apart_m"), [(32617, None, None), (32617, "EPSG:26917", None), (32618, ZONE, 500_000.0)]
)
def test_the_crs_in_a_cloud_places_it_unless_another_is_stated(
    tmp_path: Path, own: int, stated: str | None, apart_m: float | None
) -> None:
    """NAD83 (26917) and WGS84 (32617) are one place here; zone 18 is 6 degrees away from zone 17."""
    pyproj = pytest.importorskip("pyproj")
    flight = flown_in_utm(tmp_path)
    pillar = np.array([30.0, -20.0, 4.0])  # m from HOME
    write_las(tmp_path / "site.laz", in_utm(pillar[None]), crs=pyproj.CRS.from_epsg(own))
    flight.settings["map"] = {"file": "site.laz"} | ({"crs": stated} if stated else {})
    flight.save()
    doubts = ingest(flight.manifest).description.doubts
    grid = read_grid(next((flight.manifest.with_suffix(".session") / "map").glob("*.npz")))
    middles = grid.origin + (np.argwhere(grid.probability >= 0.5) + 0.5) * grid.resolution_m
    assert np.abs(middles - pillar).max() < 0.5
    if apart_m is None:
        assert not doubts
    else:
        assert [doubt.code for doubt in doubts] == ["origin"]
        assert doubts[0].evidence["apart_m"] == pytest.approx(apart_m, rel=0.5)
