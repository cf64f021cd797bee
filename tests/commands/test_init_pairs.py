"""`mocap init` with several videos and drones' logs whose names say nothing: times and motion pair them."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from ruamel.yaml import YAML

from pipelines.draft import draft
from pipelines.drafting.matching import Answer, Question
from pipelines.formats.poses import TUM
from pipelines.geometry.geodesy import place_at
from pipelines.geometry.mounting import body_from_camera
from pipelines.geometry.poses import conjugate, matrix_from_quaternion, multiply
from tests.commands.runner import mocap
from tests.synthetic.drone_logs import HOME, DroneTruth, angles_of, ulog_rows, write_dataflash, write_ulog
from tests.synthetic.logged_flights import attitude_entry, pose_entry
from tests.synthetic.logs import write_mcap
from tests.synthetic.videos import even_ticks, write_video

SAMPLE = Path(__file__).parents[2] / "sample_data" / "mound_walk"
NIGHT_NS = 3_600_000_000_000


def drone_of_sample(name: str, later_ns: int = 0) -> DroneTruth:
    """Return what a drone of the sample flight would log with its camera on a gimbal."""
    flown = TUM.read_trajectory(SAMPLE / "truth" / f"{name}.tum")
    axes = matrix_from_quaternion(flown.quaternion_xyzw)
    places = [place_at(row, HOME) for row in flown.position]
    count = len(flown.t_ns)
    return DroneTruth(
        t_ns=flown.t_ns + later_ns,
        enu=flown.position,
        latitude_deg=np.array([place.latitude_deg for place in places]),
        longitude_deg=np.array([place.longitude_deg for place in places]),
        altitude_m=np.array([place.altitude_m for place in places]),
        body=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        body_ypr_deg=np.tile([90.0, 0.0, 0.0], (count, 1)),  # level, heading east
        gimbal_ypr_deg=angles_of(axes[:, :, 2], axes[:, :, 0]),
    )


def cameras_of(folder: Path) -> dict[str, Any]:
    stated = YAML(typ="safe", pure=True).load(draft([folder]).text)
    cameras: dict[str, Any] = stated["cameras"]
    return cameras


def copied(video: Path, path: Path, *, made_ns: int | None = None, pictures: int = 1000) -> None:
    """Copy the first pictures of a video, with the time of its creation in its metadata."""
    with av.open(str(video)) as source, av.open(str(path), "w") as target:
        if made_ns is not None:
            target.metadata["creation_time"] = datetime.fromtimestamp(made_ns // 10**9, UTC).isoformat()
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in islice(source.demux(source.streams.video[0]), pictures):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)


def write_topics(path: Path, topics: dict[str, str], down_deg: float | None = None) -> None:
    """Write the poses of the sample's cameras as topics of one log; of bodies if the tilt is stated."""
    entries = []
    for name, topic in topics.items():
        flown = TUM.read_trajectory(SAMPLE / "truth" / f"{name}.tum")
        turned = flown.quaternion_xyzw
        if down_deg is not None:
            turned = multiply(turned, conjugate(body_from_camera("forward", down_deg)))
        rows = zip(flown.t_ns.tolist(), flown.position.tolist(), turned.tolist(), strict=True)
        entries += [pose_entry(topic, *row) for row in rows]
    write_mcap(path, sorted(entries, key=lambda entry: entry.stamp_ns))


def test_recorders_names_leave_the_choice_between_topics_and_no_calibration(tmp_path: Path) -> None:
    write_topics(
        tmp_path / "rec_2023_A.mcap", {name: f"/{name}/camera_pose" for name in ("drone1", "drone2")}
    )
    for name in ("DJI_0007", "DJI_0008"):
        write_video(tmp_path / f"{name}.MP4", even_ticks(60))
    lens = "size = [64, 48]\nmatrix = [[90, 0, 31.5], [0, 90, 23.5], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\n"
    for name in ("left", "right"):
        still = f"[cam_{name}]\n{lens}rotation = [0, 0, 0]\ntranslation = [0, 0, 0]\n"
        (tmp_path / f"cam_{name}.toml").write_text(still, encoding="utf-8")
    result = draft([tmp_path])
    assert result.cameras == ["DJI_0007", "DJI_0008"]
    for line in ("/drone1/camera_pose", "/drone2/camera_pose"):
        assert result.text.count(f"# or pose: {{file: rec_2023_A.mcap, topic: {line}, of: ") == 2
    assert "pose: cam_" not in result.text
    assert result.text.count("# or intrinsics: cam_left.toml") == 2
    assert len(result.missing) == 2

    asked: list[Question] = []

    def ask(question: Question) -> Answer:
        asked.append(question)
        return Answer(0, stated=question.key == "intrinsics")  # what no other camera has comes first

    result = draft([tmp_path], overwrite=True, ask=ask)
    assert [(*each.cameras, each.key) for each in asked] == [
        (camera, key) for camera in ("DJI_0007", "DJI_0008") for key in ("pose", "intrinsics")
    ]
    assert [len(each.options) for each in asked] == [2, 2, 1, 2]  # one topic is taken
    assert not result.missing
    cameras = YAML(typ="safe", pure=True).load(result.text)["cameras"]
    assert [cameras[name]["intrinsics"] for name in cameras] == ["cam_left.toml", "cam_right.toml"]
    assert [cameras[name]["pose"]["topic"] for name in cameras] == [
        "/drone1/camera_pose",
        "/drone2/camera_pose",
    ]
    assert all(cameras[name]["pose"]["assumed"] for name in cameras)


def test_a_folder_without_a_camera_is_drafted_with_exit_status_1(tmp_path: Path) -> None:
    (tmp_path / "site.xyz").write_text("0 0 0\n1 1 1\n", encoding="utf-8")
    lens = "size = [64, 48]\nmatrix = [[90, 0, 31.5], [0, 90, 23.5], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\n"
    (tmp_path / "lens.toml").write_text(f"[cam_0]\n{lens}", encoding="utf-8")
    done = mocap("init", tmp_path)
    assert done.returncode == 1
    assert done.stdout.splitlines()[0] == "cameras: none"
    assert "Traceback" not in done.stderr


def test_videos_and_logs_of_one_flight_are_paired_by_motion(tmp_path: Path) -> None:
    copied(SAMPLE / "drone1.mp4", tmp_path / "north.mp4", pictures=180)
    copied(SAMPLE / "drone2.mp4", tmp_path / "lake.mp4", pictures=180)
    shutil.copyfile(SAMPLE / "drone2.mcap", tmp_path / "rec_2023_A.mcap")
    write_dataflash(tmp_path / "00000042.bin", drone_of_sample("drone1"))
    cameras = cameras_of(tmp_path)
    assert cameras["north"]["pose"] == {"file": "00000042.bin", "assumed": True}
    logged = {"file": "rec_2023_A", "topic": "/drone2/odometry", "of": "body", "assumed": True}
    assert cameras["lake"]["pose"] == logged
    assert cameras["lake"]["gimbal"] == {
        "file": "rec_2023_A",
        "topic": "/drone2/gimbal",
        "relative_to": "world",
        "assumed": True,
    }
    assert cameras["lake"]["intrinsics"]["topic"] == "/drone2/camera/camera_info"
    true = YAML(typ="safe", pure=True).load((SAMPLE / "flight.yaml").read_text())["cameras"]
    for name, drone in (("north", "drone1"), ("lake", "drone2")):
        start_s = float(cameras[name]["frame_times"]["start"])
        assert start_s == pytest.approx(float(true[drone]["frame_times"]["start"]), abs=0.1)


def test_motion_tells_poses_of_cameras_from_those_of_drones_and_the_tilt_of_a_mount(tmp_path: Path) -> None:
    shutil.copyfile(SAMPLE / "drone1.mp4", tmp_path / "left.mp4")
    shutil.copyfile(SAMPLE / "drone2.mp4", tmp_path / "IMG_4411.MOV")
    write_topics(tmp_path / "rec.mcap", {"drone1": "/alpha/pose"})
    write_topics(tmp_path / "other.mcap", {"drone2": "/bravo/pose"}, down_deg=30)
    for name, drone in (("cam_left", "drone1"), ("cam_right", "drone2")):
        lens = (SAMPLE / f"{drone}_camera.yaml").read_text(encoding="utf-8")
        (tmp_path / f"{name}.yaml").write_text(lens.replace(drone, "camera"), encoding="utf-8")
    cameras = cameras_of(tmp_path)
    assert cameras["left"]["pose"] == {"file": "rec", "topic": "/alpha/pose", "of": "camera", "assumed": True}
    assert "mount" not in cameras["left"]
    assert cameras["left"]["intrinsics"] == "cam_left.yaml"
    logged = {"file": "other", "topic": "/bravo/pose", "of": "body", "assumed": True}
    assert cameras["IMG_4411"]["pose"] == logged
    assert cameras["IMG_4411"]["mount"]["down_deg"] == 30
    assert cameras["IMG_4411"]["intrinsics"] == {"file": "cam_right.yaml", "assumed": True}


def test_videos_and_logs_of_different_hours_are_paired_by_time(tmp_path: Path) -> None:
    first = drone_of_sample("drone1")
    for name, later_ns in (("a", 0), ("b", NIGHT_NS)):
        write_ulog(
            tmp_path / f"log_{3 if later_ns else 8}.ulg", ulog_rows(drone_of_sample("drone1", later_ns))
        )
        film = write_video(tmp_path / "film.mp4", even_ticks(60))
        copied(film, tmp_path / f"{name}.mp4", made_ns=int(first.t_ns[0]) + later_ns + 3_000_000_000)
        film.unlink()
    cameras = cameras_of(tmp_path)
    assert cameras["a"]["pose"] == {"file": "log_8.ulg", "assumed": True}
    assert cameras["b"]["pose"] == {"file": "log_3.ulg", "assumed": True}


def test_videos_that_show_no_motion_are_not_paired(tmp_path: Path) -> None:
    for name, drone in (("north", "drone1"), ("lake", "drone2")):
        write_video(tmp_path / f"{name}.mp4", even_ticks(60))
        write_ulog(tmp_path / f"log_{drone[-1]}7.ulg", ulog_rows(drone_of_sample(drone)))
    assert not any("pose" in camera for camera in cameras_of(tmp_path).values())


def test_a_film_on_its_logged_places_gives_the_focal_length(tmp_path: Path) -> None:
    copied(SAMPLE / "drone1.mp4", tmp_path / "left.mp4", pictures=180)
    shutil.copyfile(SAMPLE / "truth" / "drone1.tum", tmp_path / "left.tum")
    lens = cameras_of(tmp_path)["left"]["intrinsics"]
    assert lens["fx"] == pytest.approx(640 / np.tan(np.radians(40)), rel=0.05)
    assert "assumed" not in lens


def test_angles_of_any_name_are_a_gimbal_where_pictures_turn_by_them(tmp_path: Path) -> None:
    copied(SAMPLE / "drone1.mp4", tmp_path / "clip.mp4", pictures=180)
    flown = TUM.read_trajectory(SAMPLE / "truth" / "drone1.tum")
    turned = multiply(flown.quaternion_xyzw, conjugate(body_from_camera("forward")))
    entries = []
    for t_ns, place, angles in zip(
        flown.t_ns.tolist(), flown.position.tolist(), turned.tolist(), strict=True
    ):
        entries += [pose_entry("/alpha/state", t_ns, place), attitude_entry("/alpha/mnt", t_ns, angles)]
    write_mcap(tmp_path / "rec.mcap", entries)
    (camera,) = cameras_of(tmp_path).values()
    assert (camera["gimbal"]["topic"], camera["gimbal"]["relative_to"]) == ("/alpha/mnt", "world")
