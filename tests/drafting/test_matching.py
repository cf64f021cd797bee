"""Matching by names and times, on descriptions alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.drafting.found import (
    Calibration,
    DroneLog,
    Edge,
    Findings,
    FrameTimes,
    Joints,
    Keypoints,
    Lens,
    Poses,
    Recording,
    Span,
    TopicFound,
    TopicKind,
    Video,
    chains,
    joined,
)
from pipelines.drafting.matching import CameraDraft, Choice, Draft, match

SECOND = 10**9


def span(first_s: float, last_s: float) -> Span:
    return Span(round(first_s * SECOND), round(last_s * SECOND))


def place(path: str) -> tuple[Path, tuple[str, ...]]:
    file = Path("/flight") / path
    return file, (*Path(path).parent.parts, Path(path).stem)


def keypoints(path: str) -> Keypoints:
    return Keypoints(*place(path), "alphapose", "AlphaPose keypoints", 100, 0, 99)


def video(path: str) -> Video:
    return Video(*place(path), "video", "video", 300, 10 * SECOND)


def poses(path: str, first_s: float = 0, last_s: float = 10) -> Poses:
    return Poses(*place(path), "tum", "TUM trajectory", span(first_s, last_s))


def calibration(path: str, *cameras: str, pose: bool = False) -> Calibration:
    return Calibration(*place(path), "anipose", "calibration", dict.fromkeys(cameras, Lens(True, pose)))


def topic(
    name: str, kind: TopicKind, type_: str = "", times: Span | None = None, source: str = ""
) -> TopicFound:
    types = {
        "poses": "nav_msgs/msg/Odometry",
        "pictures": "sensor_msgs/msg/Image",
        "intrinsics": "sensor_msgs/msg/CameraInfo",
        "angles": "geometry_msgs/msg/Vector3Stamped",
        "transforms": "tf2_msgs/msg/TFMessage",
    }
    return TopicFound(name, type_ or types[kind], kind, 100, times or span(0, 10), "map", source)


def recording(path: str, *topics: TopicFound, edges: tuple[Edge, ...] = ()) -> Recording:
    file, where = place(path)
    return Recording(file, where, "mcap", "MCAP log", (file,), topics, edges)


def camera(draft: Draft, name: str) -> CameraDraft:
    return next(found for found in draft.cameras if found.name == name)


def taken(choice: Choice | None) -> str:
    """Return the name of the chosen candidate; empty without one."""
    if choice is None:
        return ""
    settings = choice.taken.settings
    return str(settings.get("topic") or settings.get("child") or choice.taken.found.path.name)


def others(choice: Choice | None) -> list[str]:
    return [taken(Choice(other)) for other in choice.others] if choice else []


# --- cameras -------------------------------------------------------------------------------------------


def test_video_keypoints_poses_and_truth_meet_by_the_name_of_the_drone() -> None:
    draft = match(
        Findings(
            [
                video("drone2.mp4"),
                video("drone1.mp4"),
                keypoints("kp/drone1_alphapose.json"),
                keypoints("kp/drone_02.json"),
                poses("drone1_poses.tum"),
                poses("drone1_true.tum"),
                poses("drone2/odometry.tum"),
                calibration("drone1.yaml", "narrow"),
                calibration("drone2.yaml", "wide"),
            ]
        )
    )
    assert [c.name for c in draft.cameras] == ["drone1", "drone2"]
    assert [taken(c.poses) for c in draft.cameras] == ["drone1_poses.tum", "odometry.tum"]
    assert [taken(c.intrinsics) for c in draft.cameras] == ["drone1.yaml", "drone2.yaml"]
    assert [c.keypoints[0].found.path.name for c in draft.cameras] == [
        "drone1_alphapose.json",
        "drone_02.json",
    ]
    assert taken(draft.cameras[0].true_poses) == "drone1_true.tum"
    assert draft.cameras[1].true_poses is None
    assert not draft.unused


def test_ten_drones_are_listed_in_the_order_of_their_numbers() -> None:
    draft = match(Findings([*[video(f"drone{k}.mp4") for k in range(10, 0, -1)]]))
    assert [c.name for c in draft.cameras] == [f"drone{k}" for k in range(1, 11)]


def test_of_two_sets_of_keypoints_the_one_for_most_cameras_is_taken() -> None:
    draft = match(Findings([keypoints("a/cam01.json"), keypoints("b/cam01.json"), keypoints("b/cam02.json")]))
    assert [[str(k.found.path.parent.name) for k in c.keypoints] for c in draft.cameras] == [
        ["b", "a"],
        ["b"],
    ]


def test_the_last_video_and_the_last_keypoints_are_a_pair_unless_they_are_counted() -> None:
    draft = match(Findings([video("DJI_0001.mp4"), keypoints("walk.json")]))
    assert [c.paired for c in draft.cameras] == [True]
    counted = match(Findings([video("drone1.mp4"), keypoints("drone2.json")]))
    assert [c.name for c in counted.cameras] == ["drone1", "drone2"]


def test_files_of_one_name_in_numbered_folders_are_several_cameras() -> None:
    draft = match(Findings([video("drone1/DJI_0001.mp4"), video("drone2/DJI_0001.mp4")]))
    assert [c.name for c in draft.cameras] == ["drone1", "drone2"]


def test_two_cameras_of_one_drone_share_its_poses() -> None:
    log = recording(
        "flight.mcap",
        topic("/drone1/front/image_raw", "pictures"),
        topic("/drone1/back/image_raw", "pictures"),
        topic("/drone1/front/camera_info", "intrinsics"),
        topic("/drone1/back/camera_info", "intrinsics"),
        topic("/drone1/odometry", "poses"),
    )
    draft = match(Findings([log]))
    assert sorted(c.name for c in draft.cameras) == ["back", "front"]
    assert {taken(c.poses) for c in draft.cameras} == {"/drone1/odometry"}
    assert taken(camera(draft, "back").intrinsics) == "/drone1/back/camera_info"


def test_without_pictures_whatever_has_poses_is_a_camera() -> None:
    log = recording("flight.mcap", topic("/uav1/odometry", "poses"), topic("/uav2/odometry", "poses"))
    draft = match(Findings([log]))
    assert [c.name for c in draft.cameras] == ["uav1", "uav2"]
    assert not any(c.videos or c.keypoints for c in draft.cameras)


def test_depth_is_no_picture() -> None:
    log = recording(
        "d1.mcap",
        topic("/drone1/depth/image_raw", "pictures"),
        topic("/drone1/color/image_raw", "pictures"),
    )
    draft = match(Findings([log]))
    assert [c.name for c in draft.cameras] == ["drone1"]
    assert [v.settings["topic"] for v in draft.cameras[0].videos] == ["/drone1/color/image_raw"]


# --- poses ---------------------------------------------------------------------------------------------


def test_topics_without_a_prefix_are_called_after_their_log() -> None:
    logs = [
        recording(f"{name}.bag", topic("/odometry", "poses"), topic("/camera/image_raw", "pictures"))
        for name in ("red", "blue")
    ]
    draft = match(Findings([*logs]))
    assert {c.name: c.poses.taken.settings["log"] for c in draft.cameras if c.poses} == {
        "red": "red",
        "blue": "blue",
    }


def test_time_decides_between_two_flights_of_one_drone() -> None:
    flown = recording("cameras.mcap", topic("/drone1/image_raw", "pictures", times=span(100, 160)))
    draft = match(Findings([flown, poses("a/drone1.tum", 0, 60), poses("b/drone1.tum", 90, 170)]))
    assert draft.cameras[0].poses
    assert draft.cameras[0].poses.taken.found.path.parent.name == "b"
    assert len(draft.cameras[0].poses.others) == 1


def test_time_shared_with_the_other_drones_decides_where_pictures_have_no_stamps() -> None:
    draft = match(
        Findings(
            [
                video("drone1.mp4"),
                video("drone2.mp4"),
                poses("a/drone1.tum", 0, 60),
                poses("b/drone1.tum", 205, 250),
                poses("drone2.tum", 200, 250),
            ]
        )
    )
    choice = camera(draft, "drone1").poses
    assert choice
    assert choice.taken.found.path.parent.name == "b"


def test_a_second_more_of_a_lesser_kind_does_not_beat_odometry() -> None:
    log = recording(
        "flight.mcap",
        topic("/drone1/image_raw", "pictures", times=span(0, 60)),
        topic("/drone1/mocap/pose", "poses", "geometry_msgs/msg/PoseStamped", span(0, 60)),
        topic("/drone1/odometry", "poses", times=span(1, 60)),
        topic("/drone1/setpoint/pose", "poses", times=span(0, 60)),
        topic("/drone1/ground_truth/odom", "poses", times=span(0, 60)),
        topic("/person/odom", "poses", times=span(0, 60)),
    )
    draft = match(Findings([log]))
    assert taken(draft.cameras[0].poses) == "/drone1/odometry"
    assert others(draft.cameras[0].poses) == ["/drone1/mocap/pose"]
    assert [actor.settings["topic"] for actor in draft.actors] == ["/person/odom"]


def test_poses_of_a_camera_come_before_those_of_a_body() -> None:
    log = recording(
        "flight.mcap",
        topic("/drone1/image_raw", "pictures"),
        topic("/drone1/odometry", "poses", source="drone1/base_link"),
        topic("/tf", "transforms"),
        edges=(
            Edge("/tf", "map", "drone1/base_link", False),
            Edge("/tf_static", "drone1/base_link", "drone1/camera_link", True),
            Edge("/tf_static", "drone1/camera_link", "drone1/camera_optical_frame", True),
            Edge("/tf_static", "map", "camera_optical_on_a_tripod", True),
        ),
    )
    assert chains(log) == [("map", "drone1/camera_optical_frame", 0), ("map", "drone1/base_link", 0)]
    choice = match(Findings([log])).cameras[0].poses
    assert choice
    assert choice.taken.settings == {"log": "flight", "parent": "map", "child": "drone1/camera_optical_frame"}
    assert not choice.taken.of_body
    assert others(choice) == ["/drone1/odometry", "drone1/base_link"]


def test_a_loop_of_transforms_ends() -> None:
    edges = (Edge("/tf", "a", "base_link", False), Edge("/tf", "base_link", "a", False))
    assert chains(recording("a.mcap", edges=edges)) == []


def test_nothing_named_like_it_is_not_guessed_among_several_cameras() -> None:
    draft = match(Findings([video("drone1.mp4"), video("drone2.mp4"), poses("drone1.tum")]))
    assert taken(camera(draft, "drone1").poses) == "drone1.tum"
    assert camera(draft, "drone2").poses is None


def test_a_lone_camera_takes_what_lies_beside_it_whatever_its_name() -> None:
    draft = match(Findings([video("DJI_0001.mp4"), poses("walk.tum"), calibration("mavic.yaml", "x")]))
    assert taken(draft.cameras[0].poses) == "walk.tum"
    assert taken(draft.cameras[0].intrinsics) == "mavic.yaml"
    assert draft.cameras[0].poses
    assert not draft.cameras[0].poses.named


def test_a_lone_camera_takes_the_likeliest_topic_of_the_only_log() -> None:
    topics = topic("/vision/pose", "poses", "geometry_msgs/msg/PoseStamped"), topic("/odom", "poses")
    draft = match(Findings([video("DJI_0001.mp4"), recording("flight.mcap", *topics)]))
    choice = draft.cameras[0].poses
    assert choice
    assert (taken(choice), others(choice), choice.named) == ("/odom", ["/vision/pose"], False)
    two = [recording(f"{name}.mcap", *topics) for name in ("a", "b")]
    assert match(Findings([video("DJI_0001.mp4"), *two])).cameras[0].poses is None
    of_others = [topic(f"/drone{k}/odom", "poses") for k in (2, 3)]
    assert match(Findings([video("drone1.mp4"), recording("f.mcap", *of_others)])).cameras[0].poses is None


def drone_log(path: str, first_s: float, *, turned: bool, films: tuple[Span, ...] = ()) -> DroneLog:
    times = span(first_s, first_s + 20)
    return DroneLog(*place(path), "dji", "DJI", "dji", times, 20, SECOND, True, turned, turned, films=films)


def test_poses_with_attitudes_of_the_same_time_come_before_those_of_the_camera_s_name() -> None:
    noon = 1_700_000_000
    filmed, subtitles = video("DJI_7.mp4"), drone_log("DJI_7.SRT", noon, turned=False)
    times = FrameTimes(*place("DJI_7.SRT"), "frame_times", "times", "srt", 20, subtitles.span)
    record = drone_log("record.csv", noon - 5, turned=True)
    found = match(Findings([filmed, subtitles, times, record])).cameras[0]
    assert found.poses
    assert (taken(found.poses), others(found.poses), found.poses.named) == (
        "record.csv",
        ["DJI_7.SRT"],
        False,
    )
    assert taken(found.frame_times) == "DJI_7.SRT"
    # Of another clock, the only recording of the video's length is its own, and the subtitles' are not.
    apart = drone_log("record.csv", noon + 7200, turned=True, films=(span(noon + 7205, noon + 7215),))
    found = match(Findings([filmed, subtitles, times, apart])).cameras[0]
    assert (taken(found.poses), found.frame_times) == ("record.csv", None)
    # Where two fit, or none, they are alternatives.
    for free in ([record, drone_log("other.csv", noon, turned=True)], [replace(apart, films=())]):
        found = match(Findings([filmed, subtitles, times, *free])).cameras[0]
        assert taken(found.poses) == "DJI_7.SRT"
        assert sorted(others(found.poses)) == sorted(log.path.name for log in free)


def test_of_two_records_of_one_hour_each_goes_to_the_drone_that_was_there() -> None:
    noon = 1_700_000_000
    own = [drone_log(f"DJI_{k}.SRT", noon, turned=False) for k in (1, 2)]
    records = [drone_log(f"{name}.csv", noon, turned=True) for name in "ab"]
    films = [video(f"DJI_{k}.mp4") for k in (1, 2)]

    def distance(log: DroneLog, other: DroneLog) -> float | None:
        return (
            0.0
            if (log.path.name, other.path.name) in {("DJI_1.SRT", "b.csv"), ("DJI_2.SRT", "a.csv")}
            else 8.0
        )

    draft = match(Findings([*films, *own, *records]), distance=distance)
    assert [taken(c.poses) for c in draft.cameras] == ["b.csv", "a.csv"]
    # A single record goes to the drone that was there, and none where all were elsewhere.
    draft = match(
        Findings([*films, *own, records[0]]), distance=lambda log, _: 50.0 * (log.path.name == "DJI_1.SRT")
    )
    assert [taken(c.poses) for c in draft.cameras] == ["DJI_1.SRT", "a.csv"]
    assert not any(taken(c.poses) == "a.csv" for c in match(Findings([*films, *own, records[0]])).cameras)


def test_logged_maps_in_the_frame_of_the_poses_come_first() -> None:
    maps = [
        topic("/plan", "maps", "nav_msgs/msg/OccupancyGrid"),
        topic("/site", "maps", "octomap_msgs/msg/Octomap"),
        topic("/cloud", "maps", "sensor_msgs/msg/PointCloud2"),
        replace(topic("/local", "maps", "octomap_msgs/msg/Octomap"), target="base"),
    ]
    draft = match(Findings([video("a.mp4"), recording("f.mcap", topic("/odom", "poses"), *maps)]))
    found = [(c.settings["topic"], c.placed) for c in draft.logged_maps]
    assert found == [("/site", True), ("/plan", True), ("/local", False), ("/cloud", False)]


def test_static_poses_serve_where_no_log_has_any() -> None:
    files = [keypoints("cam1.json"), keypoints("cam2.json")]
    shared = calibration("calibration.toml", "cam1", "cam2", pose=True)
    draft = match(Findings([*files, shared, poses("cam1.tum"), poses("cam2_true.tum")]))
    assert taken(camera(draft, "cam1").poses) == "cam1.tum"
    assert others(camera(draft, "cam1").poses) == ["calibration.toml"]
    assert taken(camera(draft, "cam2").poses) == "calibration.toml"
    assert taken(camera(draft, "cam2").true_poses) == "cam2_true.tum"


def test_truth_is_used_as_poses_only_where_there_is_nothing_else() -> None:
    draft = match(Findings([video("drone1.mp4"), poses("drone1_gt.tum")]))
    assert taken(draft.cameras[0].poses) == "drone1_gt.tum"
    assert draft.cameras[0].true_poses is None


# --- calibrations, gimbals, frame times ------------------------------------------------------------------


def test_one_calibration_without_a_name_serves_all_and_says_so() -> None:
    draft = match(Findings([video("a.mp4"), video("b.mp4"), calibration("gopro.yaml", "camera")]))
    choices = [c.intrinsics for c in draft.cameras]
    assert [taken(choice) for choice in choices] == ["gopro.yaml", "gopro.yaml"]
    assert not any(choice.named for choice in choices if choice)


def test_the_calibration_of_another_drone_is_not_taken() -> None:
    draft = match(
        Findings(
            [
                video("drone1.mp4"),
                video("drone2.mp4"),
                video("drone3.mp4"),
                calibration("drone1.yaml", "camera"),
                calibration("drone2.yaml", "camera"),
            ]
        )
    )
    assert [taken(c.intrinsics) for c in draft.cameras] == ["drone1.yaml", "drone2.yaml", ""]


def test_camera_info_beside_the_pictures_is_taken() -> None:
    log = recording(
        "flight.mcap",
        topic("/drone1/rgb/image_raw", "pictures"),
        topic("/drone1/ir/camera_info", "intrinsics"),
        topic("/drone1/rgb/camera_info", "intrinsics"),
    )
    draft = match(Findings([log]))
    assert taken(draft.cameras[0].intrinsics) == "/drone1/rgb/camera_info"


def test_angles_are_a_gimbal_only_by_name_and_for_poses_of_a_body() -> None:
    log = recording(
        "flight.mcap",
        topic("/drone1/image_raw", "pictures"),
        topic("/drone1/odometry", "poses", source="base_link"),
        topic("/drone1/imu/mag", "angles"),
        topic("/drone1/gimbal_angles", "angles"),
    )
    assert taken(match(Findings([log])).cameras[0].gimbal) == "/drone1/gimbal_angles"
    of_camera = match(Findings([log, poses("drone1.tum")]))
    assert of_camera.cameras[0].gimbal is None


def test_frame_times_go_to_the_video_of_their_name() -> None:
    stamps = [
        FrameTimes(*place(f"DJI_000{k}.SRT"), "frame_times", "frame times", "srt", 300, span(0, 10))
        for k in (1, 2)
    ]
    draft = match(Findings([video("DJI_0001.mp4"), video("DJI_0002.mp4"), *stamps]))
    assert [taken(c.frame_times) for c in draft.cameras] == ["DJI_0001.SRT", "DJI_0002.SRT"]


@pytest.mark.parametrize(
    ("rows", "clock", "own"),
    [(300, False, True), (280, False, True), (900, False, False), (300, True, False)],
)
def test_subtitles_of_another_name_are_taken_only_for_a_film_of_their_length(
    rows: int, clock: bool, own: bool
) -> None:
    stamps = FrameTimes(*place("DJI_0001.SRT"), "frame_times", "frame times", "srt", rows, span(0, 10))
    inside = drone_log("GX010009.MP4", 0, turned=False)
    draft = match(Findings([video("GX010009.MP4"), stamps, *([inside] if clock else [])]))
    assert [taken(c.frame_times) for c in draft.cameras] == ["DJI_0001.SRT" if own else ""]
    assert [found.path.name for found in draft.unused] == ([] if own else ["DJI_0001.SRT"])


def test_joints_are_true_only_by_name_or_folder() -> None:
    names = ("result.trc", "truth.trc", "truth/walk.trc")
    joints = [Joints(*place(name), "trc", "TRC", span(0, 10)) for name in names]
    draft = match(Findings([video("a.mp4"), *joints]))
    assert [found.path.name for found in draft.true_joints] == ["truth.trc", "walk.trc"]
    assert [found.path.name for found in draft.unused] == ["result.trc"]


# --- split logs ----------------------------------------------------------------------------------------


def test_parts_of_a_log_are_one_recording_and_logs_of_two_drones_are_not() -> None:
    parts = [
        recording(f"d1_{k}.mcap", topic("/odometry", "poses", times=span(10 * k, 10 * k + 9.9)))
        for k in range(12)
    ]
    [whole] = joined(parts[::-1])
    assert [path.name for path in whole.parts] == [f"d1_{k}.mcap" for k in range(12)]
    assert whole.topics[0].span == span(0, 119.9)
    assert whole.topics[0].count == 1200
    at_once = [replace(part, topics=(topic("/odometry", "poses"),)) for part in parts[:2]]
    assert len(joined(at_once)) == 2
    assert len(joined([parts[0], parts[2]])) == 2


def test_only_logs_that_are_named_stand_in_the_manifest() -> None:
    logs = [
        recording("d1.mcap", topic("/drone1/image", "pictures"), topic("/drone1/odom", "poses")),
        recording("other.mcap"),
    ]
    draft = match(Findings([*logs]))
    assert list(draft.logs) == ["d1"]
    assert [found.path.name for found in draft.unused] == ["other.mcap"]
