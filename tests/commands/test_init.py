"""`mocap init`: the draft describes the flight correctly, or says what is missing."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipelines.draft import Drafted, draft
from pipelines.ingest import ingest
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from tests.commands.runner import content, mocap, refused, succeeds
from tests.real_data import real_data
from tests.synthetic.flights import LENS, START_NS, SyntheticFlight, write_flight
from tests.synthetic.logged_flights import LEVER_ARM, header, write_logged_flight
from tests.synthetic.logs import Container, Entry, write_mcap
from tests.synthetic.videos import even_ticks, write_video


def drafted(folder: Path) -> tuple[Drafted, dict[str, Any]]:
    """Draft the manifest of a folder; return the result and its content as plain YAML."""
    result = draft([folder])
    return result, YAML(typ="safe", pure=True).load(result.text)


def edit(manifest: Path, edits: dict[str, str]) -> None:
    """Replace texts anywhere in the manifest, as a user would."""
    text = manifest.read_text(encoding="utf-8")
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new)
    manifest.write_text(text, encoding="utf-8")


def tables(session: Path) -> dict[str, str]:
    return {name: digest for name, digest in content(session).items() if name.endswith(".parquet")}


def write_lenses(flight: SyntheticFlight) -> None:
    """Write the intrinsics in the flight's manifest as a calibration file of all cameras."""
    matrix = [[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]]
    lines = [
        f'[cam_{k}]\nname = "{name}"\nsize = [{LENS.width}, {LENS.height}]\nmatrix = {matrix}\n'
        f"distortions = {list(LENS.distortion)}\n"
        for k, name in enumerate(flight.cameras)
    ]
    (flight.manifest.parent / "lenses.toml").write_text("\n".join(lines), encoding="utf-8")


@pytest.mark.parametrize(
    ("keypoints", "poses", "static"),
    [("alphapose", "tum", False), ("openpose", "csv", False), ("coco", "tum", True)],
)
def test_drafted_flights_are_ingested_as_they_were_written(
    tmp_path: Path, keypoints: str, poses: str, static: bool
) -> None:
    flight = write_flight(
        tmp_path, cameras=3, fps=25, keypoint_format=keypoints, pose_format=poses, static=static
    )
    ingest(flight.manifest, tmp_path / "written.session")
    flight.manifest.unlink()
    if not static:
        write_lenses(flight)

    result, stated = drafted(tmp_path)
    assert not result.missing
    assert result.cameras == flight.cameras
    assert any("fps 30" in remark for remark in result.assumed)
    assert {camera["frame_times"]["start"] for camera in stated["cameras"].values()} == {START_NS // 10**9}
    edit(result.path, {"fps: 30": "fps: 25"})
    ingest(result.path)
    assert tables(tmp_path / "flight.session") == tables(tmp_path / "written.session")


@pytest.mark.parametrize("container", ["ros1", "ros2-sqlite3", "mcap-cdr"])
def test_drafted_logs_are_ingested_as_they_were_flown(tmp_path: Path, container: Container) -> None:
    flight = write_logged_flight(tmp_path, container)
    ingest(flight.manifest, tmp_path / "written.session")
    flight.manifest.unlink()
    for name in flight.cameras:
        (
            tmp_path / f"{name}.tum"
        ).unlink()  # the camera's own poses: better than the body's, if they are there

    result, stated = drafted(tmp_path)
    assert not result.missing
    assert sorted(stated["logs"]) == flight.cameras
    for name, camera in stated["cameras"].items():
        assert camera["video"] == {"file": name, "topic": f"/{name}/image/compressed"}
        assert camera["pose"] == {"file": name, "topic": f"/{name}/odometry", "of": "body"}
        assert camera["intrinsics"] == {"file": name, "topic": f"/{name}/camera_info"}
    mount = "{looks: forward, down_deg: %g, translation: %s, assumed: true}"
    edit(result.path, {mount % (0, [0, 0, 0]): mount % (30, list(LEVER_ARM))})
    ingest(result.path)
    assert tables(tmp_path / "flight.session") == tables(tmp_path / "written.session")


def test_as_a_command(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, static=True)
    flight.manifest.unlink()
    (tmp_path / "notes.txt").write_text("windy", encoding="utf-8")
    (tmp_path / ".hidden.json").write_text("[]", encoding="utf-8")
    (tmp_path / "old.session").mkdir()
    (tmp_path / "old.session" / "session.json").write_text("{}", encoding="utf-8")
    (tmp_path / "frames").mkdir()
    for k in range(30):
        (tmp_path / "frames" / f"{k}.png").write_bytes(b"\x89PNG")

    done = mocap("init", tmp_path)
    assert done.returncode == 0
    assert done.stdout.splitlines()[0] == "cameras: drone1, drone2"
    told = done.stderr.splitlines()
    left_out = [line for line in told if line.startswith(str(tmp_path))]
    assert [line.split()[0] for line in left_out] == [f"{tmp_path}/notes.txt:", f"{tmp_path}/frames:"]
    assert [line for line in told if line.startswith("assumed: ")]
    succeeds("ingest", tmp_path / "flight.yaml")

    assert "--overwrite" in refused("init", tmp_path)
    result = json.loads(succeeds("init", tmp_path, "--overwrite", "--json", "-q"))
    assert result["cameras"] == ["drone1", "drone2"]
    assert result["missing"] == []
    assert mocap("init").returncode == 2
    assert "PATHS" in succeeds("init", "--help")


def test_what_is_missing_stands_where_it_belongs(tmp_path: Path) -> None:
    write_flight(tmp_path).manifest.unlink()
    for name in ("drone2.tum", "drone2_true.tum"):
        (tmp_path / name).unlink()
    result, stated = drafted(tmp_path)
    concerned = [remark.rpartition(": ")[0] for remark in sorted(result.missing)]
    assert concerned == ["drone1, drone2: intrinsics", "drone2: pose"]
    assert "pose" not in stated["cameras"]["drone2"]
    lines = result.text.splitlines()
    at = lines.index("  drone2:")
    assert any("# pose: {file: drone2.tum}  # missing" in line for line in lines[at:])
    with pytest.raises(DataError, match=r"cameras\.drone1\.intrinsics: .*missing"):
        read_flight(result.path)


def test_the_truth_stands_in_for_poses_only_with_a_word(tmp_path: Path) -> None:
    flight = write_flight(tmp_path)
    flight.manifest.unlink()
    write_lenses(flight)
    (tmp_path / "drone2.tum").unlink()
    result, stated = drafted(tmp_path)
    assert stated["cameras"]["drone2"]["pose"] == {"file": "drone2_true.tum", "assumed": True}
    assert stated["truth"]["poses"] == {"drone1": "drone1_true.tum"}
    assert any(remark.startswith("drone2: pose: ") and "truth" in remark for remark in result.assumed)


def test_files_that_cannot_be_read_are_listed_and_left_out(tmp_path: Path) -> None:
    write_flight(tmp_path, static=True).manifest.unlink()
    (tmp_path / "drone2.json").write_text('[{"image_id": "0.jpg", "keypoints"', encoding="utf-8")
    (tmp_path / "drone3.json").write_text(
        '[{"image_id": "0.jpg", "keypoints": [1], "idx": 1}]', encoding="utf-8"
    )
    result, _ = drafted(tmp_path)
    assert result.cameras == ["drone1"]
    reasons = {path.name: reason for path, reason in result.left_out.items()}
    assert reasons["drone3.json"].startswith("1 ")
    assert " JSON (" in reasons["drone2.json"]


HOSTILE = ["true", "x\n  pose: {file: y}\n", "bell\x07 'single' \"double\" \\", "line\u2028separator"]


@pytest.mark.parametrize("name", HOSTILE)
def test_names_hostile_to_yaml_stay_names(tmp_path: Path, name: str) -> None:
    source = tmp_path / "source"
    flight = write_flight(source, cameras=1)
    flight.manifest.unlink()
    folder = tmp_path / "hostile"
    folder.mkdir()
    for suffix in (".json", ".tum"):
        (source / f"drone1{suffix}").rename(folder / f"{name}{suffix}")
    # The same name twice: the second is in a comment.
    (folder / "again").mkdir()
    shutil.copy(folder / f"{name}.tum", folder / "again")
    write_lenses(flight)
    (source / "lenses.toml").rename(folder / f"{name}.toml")

    result, stated = drafted(folder)
    assert len(result.cameras) == 1
    assert not result.missing
    assert set(stated) == {"schema", "name", "world", "cameras"}
    [camera] = stated["cameras"].values()
    assert camera["keypoints"] == f"{name}.json"
    pose = camera["pose"]
    file = pose["file"] if isinstance(pose, dict) else pose  # with `assumed: true`
    assert file in {f"{name}.tum", f"again/{name}.tum"}
    assert camera["intrinsics"] == f"{name}.toml"
    assert all(line.isprintable() for line in result.text.split("\n"))
    ingest(result.path)


# --- where things lie ----------------------------------------------------------------------------------
def test_paths_are_relative_to_the_manifest_wherever_it_lies(tmp_path: Path) -> None:
    write_flight(tmp_path / "flight", static=True).manifest.unlink()
    (tmp_path / "manifests").mkdir()
    files = [tmp_path / "flight" / name for name in ("drone1.json", "drone2.json", "calibration.toml")]
    elsewhere = draft(files, tmp_path / "manifests" / "a.yaml")
    assert f"keypoints: {tmp_path}/flight/drone1.json" in elsewhere.text
    ingest(elsewhere.path)
    assert draft(files).path == tmp_path / "flight" / "flight.yaml"

    (tmp_path / "link").symlink_to(tmp_path / "manifests", target_is_directory=True)
    linked = draft(files, tmp_path / "link" / "b.yaml")
    assert not linked.missing
    ingest(linked.path)


def test_parts_of_a_log_beside_a_video_are_one_log_and_not_the_folder(tmp_path: Path) -> None:
    stamps = [START_NS + k * 10**8 for k in range(20)]
    odometry = [
        Entry("/odometry", "nav_msgs/msg/Odometry", t, {"header": header(t, "odom_ned")}) for t in stamps
    ]
    write_mcap(tmp_path / "drone1_0.mcap", odometry[:10])
    write_mcap(tmp_path / "drone1_1.mcap", odometry[10:])
    write_video(tmp_path / "drone1.mp4", even_ticks(30))
    result, stated = drafted(tmp_path)
    assert stated["logs"] == {"drone1": {"file": ["drone1_0.mcap", "drone1_1.mcap"], "stamps": "header"}}
    camera = stated["cameras"]["drone1"]
    assert camera["video"] == "drone1.mp4"
    # The container counts from 0, the log since the epoch.
    assert camera["frame_times"] == {"start": START_NS // 10**9, "assumed": True}
    [line] = [line for line in result.text.splitlines() if line.startswith("    pose: ")]
    assert "odom_ned " in line
    assert line.endswith(" axes: ned")
    assert any("ned" in remark for remark in result.assumed)


def test_the_whereabouts_of_a_gimbal_are_for_the_user_to_say(tmp_path: Path) -> None:
    def at(topic: str, type_: str, **fields: Any) -> Entry:
        return Entry(topic, type_, START_NS, {"header": header(START_NS, "map"), **fields})

    write_mcap(
        tmp_path / "drone1.mcap",
        [
            at("/drone1/image", "sensor_msgs/msg/CompressedImage", format="jpeg"),
            at("/drone1/odometry", "nav_msgs/msg/Odometry", child_frame_id="base_link"),
            at("/drone1/gimbal", "geometry_msgs/msg/Vector3Stamped"),
            at("/drone1/imu/mag", "geometry_msgs/msg/Vector3Stamped"),
            at("/actor/pose", "geometry_msgs/msg/PoseStamped"),
        ],
    )
    result, stated = drafted(tmp_path)
    assert "gimbal" not in stated["cameras"]["drone1"]
    assert "{file: drone1, topic: /drone1/gimbal, relative_to: world}" in result.text
    assert "mount" not in stated["cameras"]["drone1"]
    assert stated["actor"] == {"file": "drone1", "topic": "/actor/pose", "point": "hip", "assumed": True}
    assert [m for m in result.missing if "relative_to" in m]
    edit(result.path, {"# gimbal": "gimbal", "# intrinsics": "intrinsics"})
    assert read_flight(result.path).cameras["drone1"].gimbal is not None


def test_transforms_of_a_camera_are_named_by_their_frames(tmp_path: Path) -> None:
    def link(parent: str, child: str) -> dict[str, Any]:
        return {"header": header(START_NS, parent), "child_frame_id": child}

    transforms = {
        "/tf": link("map", "drone1/base_link"),
        "/tf_static": link("drone1/base_link", "drone1/optical"),
    }
    entries = [
        Entry(topic, "tf2_msgs/msg/TFMessage", START_NS, {"transforms": [transform]})
        for topic, transform in transforms.items()
    ]
    picture = Entry(
        "/drone1/image", "sensor_msgs/msg/CompressedImage", START_NS, {"header": header(START_NS, "")}
    )
    write_mcap(tmp_path / "flight.mcap", [*entries, picture])
    result, stated = drafted(tmp_path)
    assert result.path == tmp_path / "flight.yaml"  # one log in a folder is no bag
    assert stated["cameras"]["drone1"]["pose"] == {
        "file": "flight",
        "parent": "map",
        "child": "drone1/optical",
        "of": "camera",
    }


# --- real recordings -----------------------------------------------------------------------------------
def test_a_real_recording_of_four_cameras_needs_nothing_more(tmp_path: Path) -> None:
    recording = real_data("pose2sim_single")
    result = draft([recording], tmp_path / "flight.yaml")
    assert result.cameras == ["cam01", "cam02", "cam03", "cam04"]
    assert not result.missing
    assert not result.assumed  # the videos have stamps
    assert {path.name for path in result.left_out} == {"Config.toml", "LICENSE", "Calib.qca.txt"}
    done = ingest(result.path)
    assert [camera.frames.count for camera in done.description.cameras.values()] == [100] * 4
