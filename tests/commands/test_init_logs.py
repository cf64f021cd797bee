"""`mocap init` beside logs of drivers and of drones: what it drafts, `mocap ingest` takes."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.ingest import ingest
from tests.commands.runner import refused, succeeds
from tests.commands.test_init import drafted
from tests.real_data import real_data
from tests.synthetic.drone_logs import drone_of, ulog_rows, write_record, write_srt, write_tlog, write_ulog
from tests.synthetic.flights import LENS, START_NS, write_flight
from tests.synthetic.logged_flights import fix_entry, header
from tests.synthetic.logs import Entry, write_log, write_mcap
from tests.synthetic.map_logs import grid_entry
from tests.synthetic.video_tracks import write_gopro
from tests.synthetic.videos import SIZE, even_ticks, write_video

FRAMES = 30
UPTIME_NS = 900_000_000_000  # a stamp of simulation time


def write_pictures(folder: Path, name: str = "keypoints") -> None:
    """Write keypoints without times, and a calibration."""
    joints = [value for j in range(17) for value in (100 + j, 200, 0.9)]
    people = [{"image_id": k, "category_id": 1, "keypoints": joints, "score": 1.0} for k in range(FRAMES)]
    (folder / f"{name}.json").write_text(json.dumps(people), encoding="utf-8")
    matrix = [[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]]
    text = (
        f"[cam_0]\nsize = [{LENS.width}, {LENS.height}]\nmatrix = {matrix}\ndistortions = [0, 0, 0, 0, 0]\n"
    )
    (folder / "lenses.toml").write_text(text, encoding="utf-8")


def frames_with_poses(manifest: Path) -> int:
    camera = next(iter(ingest(manifest).description.cameras.values()))
    return camera.frames.count - camera.poses.frames_without_pose


def poses(topic: str, ahead_ns: int | None, *, bare: bool = False) -> list[Entry]:
    """List poses at 30 Hz over 20 s, whose header stamps are ahead of their receipt."""
    entries = []
    for k in range(600):
        t = START_NS + k * 33_333_333
        at = {"position": {"x": 0.01 * k, "y": 0.1 * (k % 7)}, "orientation": {"w": 1.0}}
        if bare:
            entries.append(Entry(topic, "geometry_msgs/msg/Pose", t, at))
        else:
            stamped = header(t + (ahead_ns or 0), "map")
            entries.append(Entry(topic, "geometry_msgs/msg/PoseStamped", t, {"header": stamped, "pose": at}))
    return entries


def test_a_real_log_of_simulation_time_is_drafted_as_it_is_ingested(tmp_path: Path) -> None:
    shutil.copyfile(real_data("second/ros2_nav2_turtlebot.mcap"), tmp_path / "turtle.mcap")
    write_pictures(tmp_path)
    result, stated = drafted(tmp_path)
    assert not result.missing
    assert stated["logs"]["turtle"] == {"file": "turtle.mcap", "stamps": "header", "assumed": True}
    (camera,) = stated["cameras"].values()
    assert 900 < camera["frame_times"]["start"] < 1100  # the receipt is in the year 2026
    ingest(result.path)  # which refused a start of which no pose has the time


@pytest.mark.parametrize(
    ("others", "stamps"),
    [
        ([], "header"),
        ([("/other/pose", UPTIME_NS - START_NS, False)], "header"),
        ([("/other/pose", 0, False)], "receive"),  # two clocks in one log
        ([("/other/pose", None, True)], "receive"),  # no header at all: only the receipt is there
    ],
)
def test_one_kind_of_stamps_is_chosen_for_all(tmp_path: Path, others: list[Any], stamps: str) -> None:
    entries = poses("/drone1/pose", UPTIME_NS - START_NS)
    entries += [entry for topic, ahead_ns, bare in others for entry in poses(topic, ahead_ns, bare=bare)]
    write_mcap(tmp_path / "drone1.mcap", sorted(entries, key=lambda entry: entry.stamp_ns))
    write_pictures(tmp_path, "drone1")
    result, stated = drafted(tmp_path)
    assert stated["logs"]["drone1"]["stamps"] == stamps
    start_s = (UPTIME_NS if stamps == "header" else START_NS) / 1e9
    assert float(stated["cameras"]["drone1"]["frame_times"]["start"]) == pytest.approx(start_s, abs=1e-3)
    assert frames_with_poses(result.path) == FRAMES


def test_fixes_with_attitudes_are_drafted(tmp_path: Path) -> None:
    entries = []
    for k in range(30):
        t = START_NS + k * 33_333_333
        place = {"header": header(t, "gps"), "latitude": 47.5 + 1e-6 * k, "longitude": 8.5, "altitude": 400.0}
        turned = {"header": header(t, "base_link"), "orientation": {"w": 1.0}}
        entries += [
            Entry("/drone2/gps", "gps_common/msg/GPSFix", t, place),
            Entry("/drone2/imu/data_raw", "sensor_msgs/msg/Imu", t, turned),
            Entry("/drone2/imu/data", "sensor_msgs/msg/Imu", t, turned),
        ]
    write_log(tmp_path, "drone2", "ros1", entries)
    write_pictures(tmp_path, "drone2")
    result, stated = drafted(tmp_path)
    assert not result.missing
    assert stated["cameras"]["drone2"]["pose"] == {
        "file": "drone2",
        "topic": "/drone2/gps",
        "attitude": "/drone2/imu/data",
        "of": "body",
    }
    assert all(
        camera.frames.count - camera.poses.frames_without_pose == FRAMES
        for camera in ingest(result.path).description.cameras.values()
    )


def test_a_flight_record_says_when_the_video_of_its_length_began(tmp_path: Path) -> None:
    heading = "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),isVideo"
    heading += ",gimbal_heading(degrees),gimbal_pitch(degrees),gimbal_roll(degrees)"
    films = {*range(100, 130), *range(200, 280)}  # of 3 s and of 8 s
    rows = [
        f"{100 * k},2024-05-01 10:00:{k // 10:02d},47.5,{8.25 + 1e-6 * k},{k},{int(k in films)},90,-30,0"
        for k in range(400)
    ]
    (tmp_path / "drone1.csv").write_text("\n".join([heading, *rows]), encoding="utf-8")
    write_video(tmp_path / "drone1.mp4", even_ticks(90))
    write_pictures(tmp_path, "drone1")
    _, stated = drafted(tmp_path)
    camera = stated["cameras"]["drone1"]
    assert camera["pose"] == {"file": "drone1.csv", "assumed": True}
    assert camera["frame_times"]["start"] == pytest.approx(1_714_557_610, abs=0.1)
    assert camera["frame_times"]["assumed"] is True
    assert camera["clock"]["sigma_s"] == 1


def write_lens(folder: Path) -> None:
    """Write a calibration of the small videos."""
    matrix = [[300.0, 0.0, SIZE[0] / 2], [0.0, 300.0, SIZE[1] / 2], [0.0, 0.0, 1.0]]
    text = f"[cam_0]\nsize = {list(SIZE)}\nmatrix = {matrix}\ndistortions = [0, 0, 0, 0, 0]\n"
    (folder / "lenses.toml").write_text(text, encoding="utf-8")


def test_a_video_begins_when_the_telemetry_in_it_says(tmp_path: Path) -> None:
    truth = drone_of(write_flight(tmp_path / "x", cameras=1, seconds=1.1, clean=True), 0)
    shutil.rmtree(tmp_path / "x")
    write_gopro(tmp_path / "GOPR1.MP4", truth, pictures=33)
    write_lens(tmp_path)
    result, stated = drafted(tmp_path)
    (camera,) = stated["cameras"].values()
    assert camera["pose"] == {"file": "GOPR1.MP4", "attitude": "pictures"}
    assert float(camera["frame_times"]["start"]) == pytest.approx(START_NS / 1e9, abs=1e-6)
    assert camera["frame_times"]["assumed"] is True
    assert camera["clock"]["sigma_s"] == 0.2  # a packet of a second has but its own time
    assert not result.missing
    assert "gimbal: {yaw_deg:" in refused("ingest", result.path)  # its pictures show nothing
    text = result.path.read_text(encoding="utf-8").replace("# gimbal: {yaw_deg", "gimbal: {yaw_deg")
    result.path.write_text(text.replace(", attitude: pictures", ""), encoding="utf-8")
    assert frames_with_poses(result.path) == 33


def test_logs_of_which_one_has_simulation_time_are_ordered_by_receipt(tmp_path: Path) -> None:
    write_mcap(tmp_path / "drone1.mcap", poses("/pose", UPTIME_NS - START_NS))
    write_mcap(tmp_path / "drone2.mcap", poses("/pose", 0))
    write_pictures(tmp_path, "drone1")
    shutil.copyfile(tmp_path / "drone1.json", tmp_path / "drone2.json")
    result, stated = drafted(tmp_path)
    assert [log["stamps"] for log in stated["logs"].values()] == ["receive"] * 2
    apart = [line for line in result.text.splitlines() if " behind receipt" in line]
    assert [line.split(":")[0].strip() for line in apart] == ["drone1"]  # nothing is wrong with drone2's own
    assert len(ingest(result.path).description.cameras) == 2


def test_a_map_in_the_frame_of_the_poses_is_drafted(tmp_path: Path) -> None:
    entries = [*poses("/drone1/pose", 0), grid_entry(np.full((4, 4), 100, np.int8), START_NS)]
    write_mcap(tmp_path / "flight.mcap", sorted(entries, key=lambda entry: entry.stamp_ns))
    write_pictures(tmp_path, "drone1")
    result, stated = drafted(tmp_path)
    assert stated["map"] == {"file": "flight", "topic": "/map"}
    succeeds("ingest", result.path)
    assert (tmp_path / "flight.session" / "map").is_dir()


def test_a_watch_beside_a_drone_on_earth_is_the_actor(tmp_path: Path) -> None:
    truth = drone_of(write_flight(tmp_path / "x", cameras=1, seconds=1.0, clean=True), 0)
    shutil.rmtree(tmp_path / "x")
    write_ulog(tmp_path / "drone1.ulg", ulog_rows(truth))
    place = 40.4433, -79.9436, 280.0
    fixes = [fix_entry("/fix", t, place) for t in range(START_NS, START_NS + 10**9, 10**8)]
    for name in ("watch", "mast"):
        write_log(tmp_path, name, "ros1", fixes)
    write_pictures(tmp_path, "drone1")
    result, stated = drafted(tmp_path)
    assert stated["actor"] == {"file": "watch", "topic": "/fix", "point": "hip", "assumed": True}
    assert list(stated["logs"]) == ["watch"]
    assert "mast.bag" in result.text
    succeeds("ingest", result.path)
    assert (tmp_path / "flight.session" / "actor.parquet").exists()


def test_a_map_is_drafted_as_it_fits_and_its_crs_is_missing_beside_gps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = drone_of(write_flight(tmp_path / "x", cameras=1, seconds=0.2, clean=True), 0)
    shutil.rmtree(tmp_path / "x")
    write_ulog(tmp_path / "drone1.ulg", ulog_rows(truth))
    write_pictures(tmp_path, "drone1")
    points = np.array([[500_000.0, 5_300_000.0, 0.0], [500_003.9, 5_300_003.9, 3.9]])
    text = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
    head = "VERSION .7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n"
    (tmp_path / "site.pcd").write_text(f"{head}DATA ascii\n{text}\n")
    monkeypatch.setattr("pipelines.session.maps.MOST_VOXELS", 20**3 - 1)  # 0.2 m takes 20 voxels a side
    result, stated = drafted(tmp_path)
    assert stated["map"] == {"file": "site.pcd", "resolution_m": 0.4}
    assert [line for line in result.missing if line.startswith("map: crs")] == result.missing
    assert "crs" in refused("ingest", result.path)
    text = result.path.read_text(encoding="utf-8")
    result.path.write_text(text.replace("resolution_m: 0.4", "resolution_m: 0.4, crs: EPSG:32617"))
    assert "by its CRS, EPSG:32617" in refused("ingest", result.path)  # another place in that zone


def test_each_vehicle_of_a_ground_station_s_log_goes_to_the_camera_of_its_number(tmp_path: Path) -> None:
    flight = write_flight(tmp_path / "x", cameras=2, seconds=1.0, clean=True)
    parts = [
        write_tlog(tmp_path / "x" / f"{k}.tlog", drone_of(flight, k), system=k + 1).read_bytes()
        for k in range(2)
    ]
    (tmp_path / "team.tlog").write_bytes(b"".join(parts))
    shutil.rmtree(tmp_path / "x")
    for name in ("drone1", "drone2"):
        write_pictures(tmp_path, name)
    result, stated = drafted(tmp_path)
    assert not result.missing
    for k in (1, 2):
        assert stated["cameras"][f"drone{k}"]["pose"] == {"file": "team.tlog", "instance": k}
    poses_of = [
        pd.read_parquet(ingest(result.path).folder / "cameras" / name / "poses.parquet")
        for name in ("drone1", "drone2")
    ]
    apart = poses_of[0][["x", "y"]].to_numpy()[0] - poses_of[1][["x", "y"]].to_numpy()[0]
    assert np.linalg.norm(apart) > 1


def test_subtitles_and_a_film_are_a_whole_flight(tmp_path: Path) -> None:
    """Places, time and focal length are in the subtitles; the film says how the camera turned."""
    flight = write_flight(tmp_path / "x", cameras=2, seconds=1.0, clean=True)
    for k in range(2):
        path = write_srt(tmp_path / f"DJI_{k}.SRT", drone_of(flight, k), gimbal=False)
        path.write_text(path.read_text().replace("[iso", f"[focal_len : {240 if k else 24.0}] [iso"))
        write_video(tmp_path / f"DJI_{k}.mp4", even_ticks(15, step=6000))
    shutil.rmtree(tmp_path / "x")
    result, stated = drafted(tmp_path)
    assert not result.missing
    for k, camera in enumerate(stated["cameras"].values()):
        assert camera["pose"]["attitude"] == "pictures"
        assert camera["pose"]["file"] == f"DJI_{k}.SRT"
        assert not {"gimbal", "mount"} & camera.keys()
        assert camera["intrinsics"]["fx"] == pytest.approx(24 / 36 * SIZE[0], abs=0.1)
        assert camera["intrinsics"]["assumed"] is True
        (tmp_path / f"DJI_{k}.SRT").unlink()
    result.path.unlink()
    assert drafted(tmp_path)[0].text.count("# or pose: pictures ") == 2


def test_a_film_turns_the_camera_of_a_log_with_fixes_alone(tmp_path: Path) -> None:
    entries = [
        Entry("/fix", "sensor_msgs/msg/NavSatFix", START_NS + k * 10**8, {
            "header": header(START_NS + k * 10**8, "gps"), "latitude": 47.5 + 1e-6 * k, "longitude": 8.5,
        })
        for k in range(20)
    ]  # fmt: skip
    write_mcap(tmp_path / "d1.mcap", entries)
    write_video(tmp_path / "d1.mp4", even_ticks(15, step=6000))
    write_lens(tmp_path)
    result, stated = drafted(tmp_path)
    assert not result.missing
    (camera,) = stated["cameras"].values()
    assert camera["pose"].items() >= {"file": "d1", "topic": "/fix", "attitude": "pictures"}.items()


def test_two_drones_of_dji_get_their_own_flight_records(tmp_path: Path) -> None:
    """Subtitles without gimbal angles name the video; the records, of one hour, have the angles."""
    flight = write_flight(tmp_path / "x", cameras=2, seconds=1.0, clean=True)
    for k, record in enumerate(("late", "early")):
        truth = drone_of(flight, k)
        path = write_srt(tmp_path / f"DJI_{k}.SRT", truth)
        path.write_text(re.sub(r"\[gb_yaw[^]]*\]", "", path.read_text()))
        write_record(tmp_path / f"{record}.csv", truth)
        write_video(tmp_path / f"DJI_{k}.mp4", even_ticks(15, step=6000))
    shutil.rmtree(tmp_path / "x")
    write_lens(tmp_path)
    result, stated = drafted(tmp_path)
    assert not result.missing
    assert [camera["pose"]["file"] for camera in stated["cameras"].values()] == ["late.csv", "early.csv"]
    assert frames_with_poses(result.path) == 15
