"""Maps from logs through the commands: stored with their times, like those of files, and replayed."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.maps import DAMAGED
from pipelines.formats.maps.octomap import FORMAT
from pipelines.session.maps import load_maps
from pipelines.session.records import Occupancy
from pipelines.session.storage import read_json
from tests.commands.runner import content, mocap, refused, succeeds
from tests.commands.test_logged_flights import session_of, write_flight
from tests.real_data import facts, real_data
from tests.synthetic.flights import SyntheticFlight
from tests.synthetic.flights import write_flight as write_synthetic_flight
from tests.synthetic.logs import Container, write_log
from tests.synthetic.map_logs import as_bt, octomap_entry

SECOND = 10**9


def site(side: int) -> Occupancy:
    grid = np.full((40, 40, 12), np.nan, dtype=np.float32)
    grid[:, :, 0] = 0.1192
    grid[4 : 4 + side, 6, :8] = 0.971
    return Occupancy(grid, np.array([-10.0, -10.0, 0.0]), 0.5)


def flight_with_maps(
    folder: Path, container: Container = "mcap-cdr", *, seconds: float = 1.0
) -> SyntheticFlight:
    """Write a flight with five published maps; the map grows once."""
    flight = write_synthetic_flight(
        folder, cameras=2, seconds=seconds, clean=True, keypoint_format="alphapose"
    )
    files = [as_bt(site(side), folder / "site") for side in (3, 3, 3, 6, 6)]
    start_ns = int(flight.t_ns[0])
    entries = [octomap_entry(file, start_ns + k * SECOND // 5) for k, file in enumerate(files)]
    log = write_log(folder / "logs", "ground", container, entries)
    flight.settings["map"] = {"file": str(log.relative_to(folder))}
    flight.save()
    return flight


@pytest.mark.parametrize("container", ["ros1", "ros2-sqlite3"])
def test_maps_of_a_log_are_stored_with_their_times(tmp_path: Path, container: Container) -> None:
    flight = flight_with_maps(tmp_path, container)
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0, done.stderr
    assert " /octomap, " in done.stderr
    assert re.search(r"\b2 maps\b.*\b3\b", done.stderr)
    session = tmp_path / "flight.session"
    start_ns = int(flight.t_ns[0])
    index = read_json(session / "map" / "index.json")["maps"]
    assert [(one["file"], one["from_ns"]) for one in index] == [
        ("0.npz", start_ns),
        ("1.npz", start_ns + 3 * SECOND // 5),
    ]
    for one, side in zip(load_maps(session), (3, 6), strict=True):
        assert int((one.probability >= 0.5).sum()) == 8 * side
        np.testing.assert_allclose(one.origin, [-10, -10, 0], rtol=0, atol=1e-9)
    stored = read_json(session / "session.json")
    assert stored["map"]["occupied"] == 48  # of the last one
    assert [(one["from_ns"], one["occupied"], one["free"]) for one in stored["map"]["maps"]] == [
        (start_ns, 24, 40 * 40 - 3),
        (start_ns + 3 * SECOND // 5, 48, 40 * 40 - 6),
    ]
    for one, entry in zip(stored["map"]["maps"], index, strict=True):
        assert (one["resolution_m"], one["shape"]) == (0.5, entry["shape"])
    assert stored["map"]["dropped"] == {}
    assert any(flight.settings["map"]["file"] in path for path in stored["sources"])


def test_the_same_map_from_a_file_and_from_a_log(tmp_path: Path) -> None:
    """Compare both byte for byte, except for the time from which the map is valid."""
    flight = flight_with_maps(tmp_path)
    start_ns = int(flight.t_ns[0])
    file = as_bt(site(6), tmp_path / "site")
    log = write_log(tmp_path / "logs", "once", "ros1", [octomap_entry(file, start_ns)])
    flight.settings["map"] = {"file": str(log.relative_to(tmp_path))}
    flight.save()
    succeeds("ingest", flight.manifest)
    (logged,) = load_maps(tmp_path / "flight.session")
    before = content(tmp_path / "flight.session")
    assert "unchanged" in succeeds("ingest", flight.manifest)
    session = flight.manifest.with_suffix(".session")
    assert content(session) == before
    flight.settings["map"] = "site/map.bt"
    flight.save()
    succeeds("ingest", flight.manifest)
    (filed,) = load_maps(tmp_path / "flight.session")
    np.testing.assert_array_equal(logged.probability, filed.probability)
    np.testing.assert_array_equal(logged.origin, filed.origin)
    assert (logged.from_ns, filed.from_ns) == (start_ns, 0)


def test_place_clock_and_axes_of_the_log_are_applied(tmp_path: Path) -> None:
    flight = flight_with_maps(tmp_path)
    place = {"translation": [100.0, 0.0, 5.0], "yaw_deg": 90}
    flight.settings["logs"] = {
        "ground": {
            "file": flight.settings["map"]["file"],
            "world_from_source": place,
            "clock": {"offset_s": -0.25},
            "axes": "ned",
        }
    }
    flight.settings["map"] = {"file": "ground"}
    flight.save()
    succeeds("ingest", flight.manifest)
    maps = load_maps(tmp_path / "flight.session")
    assert [one.from_ns - int(flight.t_ns[0]) for one in maps] == [-SECOND // 4, 7 * SECOND // 20]
    # NED [4..9, 6, 0..7] voxels are x -8..-5, y -7..-6.5, z 0..4; in ENU x -7..-6.5, y -8..-5, z -4..0;
    # turned by 90 degrees x 5..8, y -7..-6.5; then moved.
    occupied = np.argwhere(maps[-1].probability >= 0.5)
    low = maps[-1].origin + occupied.min(axis=0) * 0.5
    high = maps[-1].origin + (occupied.max(axis=0) + 1) * 0.5
    assert low == pytest.approx([105, -7, 1], abs=1e-9)
    assert high == pytest.approx([108, -6.5, 5], abs=1e-9)


def test_truncated_maps_are_counted_or_refused(tmp_path: Path) -> None:
    flight = flight_with_maps(tmp_path)
    start_ns, file = int(flight.t_ns[0]), as_bt(site(6), tmp_path / "site")
    entries = [octomap_entry(file[:-2], start_ns), octomap_entry(file, start_ns + 1)]
    for count in (1, 2):
        log = write_log(tmp_path / "logs", f"cut{count}", "mcap-cdr", entries[:count])
        flight.settings["map"]["file"] = str(log.relative_to(tmp_path))
        flight.save()
        if count == 1:
            assert re.search("/octomap: .*tree", refused("ingest", flight.manifest))
        else:
            assert f"map: dropped: 1 {DAMAGED}" in mocap("ingest", flight.manifest).stderr


# --- real recordings -----------------------------------------------------------------------------------
HUSKY = "logs/ros1/husky_gps_imu_odom.bag"


@pytest.mark.parametrize("name", ["octomap_geb079.bt", "octomap_ecmrv4_withfree.ot"])
def test_real_octomap_in_a_log(tmp_path: Path, name: str) -> None:
    """Put real octrees into messages and compare the voxel counts with those of OctoMap's own library."""
    expected = facts(f"maps/{name}")
    first_s = facts(HUSKY)["topics"]["/husky_velocity_controller/odom"]["header_stamp_range"][0]
    entry = octomap_entry(real_data(f"maps/{name}").read_bytes(), round(first_s * 1e9))
    log = write_log(tmp_path, "map", "ros2-sqlite3", [entry])
    pose = {"file": str(real_data(HUSKY)), "of": "body"}
    path = write_flight(tmp_path, pose, start_s=first_s + 1, map={"file": log.name})
    succeeds("ingest", path)
    stored = session_of(path)["map"]
    assert stored["resolution_m"] == expected["resolution"]
    assert stored["occupied"] == expected["occupied_voxels_at_finest"]
    assert stored["free"] == expected["free_voxels_at_finest"]
    (logged,) = load_maps(tmp_path / "flight.session")
    filed = FORMAT.read_map(real_data(f"maps/{name}"))
    np.testing.assert_array_equal(logged.probability, filed.probability)


@pytest.mark.slow
def test_real_lidar(tmp_path: Path) -> None:
    """Use five clouds of a car's lidar; the log does not state the sensor's pose."""
    name = "logs/ros1/embag_pointcloud2_lidar.bag"
    expected = facts(name)["topics"]["/luminar_pointcloud"]
    first_s = facts(HUSKY)["topics"]["/husky_velocity_controller/odom"]["header_stamp_range"][0]
    lidar: dict[str, Any] = {
        "file": str(real_data(name)),
        "clock": {"offset_s": first_s - expected["header_stamp_range"][0]},
    }
    pose = {"file": str(real_data(HUSKY)), "of": "body"}
    about: dict[str, Any] = {"file": "lidar", "topic": "/luminar_pointcloud"}
    path = write_flight(tmp_path, pose, start_s=first_s + 1, logs={"lidar": lidar}, map=about)
    assert re.search("(?s)'luminar_lidar'.*`parent:`", refused("ingest", path))
    about |= {"parent": "luminar_lidar", "resolution_m": 0.5}
    path = write_flight(tmp_path, pose, start_s=first_s + 1, logs={"lidar": lidar}, map=about)
    done = mocap("ingest", path)
    assert done.returncode == 0, done.stderr
    assert re.search(rf"\b{expected['count']} clouds .* {expected['count']} maps\b", done.stderr)
    maps = load_maps(tmp_path / "flight.session")
    assert len(maps) == expected["count"]
    counts = [int((one.probability == 1).sum()) for one in maps]
    assert counts == sorted(set(counts))
