"""Conversion of messages of every schema to samples: the same content gives the same samples."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.messages import all_samples, samples
from pipelines.geometry.arrays import Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.records import AngleSample, IntrinsicsSample, PoseSample
from tests.formats.foxglove_protobuf import protobuf
from tests.formats.log_values import (
    STORES,
    camera_info,
    from_json,
    header,
    message,
    odometry,
    part,
    pose,
    ros,
    transform_stamped,
)

STAMP = 1_700_000_000_123_456_789
RECEIVED = STAMP + 5_000_000
POSITION, QUATERNION = (1.0, -2.5, 3.0), (0.0, 0.6, 0.0, 0.8)
XYZ, XYZW = dict(zip("xyz", POSITION, strict=True)), dict(zip("xyzw", QUATERNION, strict=True))
JSON_STAMP = {"sec": STAMP // 10**9, "nsec": STAMP % 10**9}
PROTOBUF_STAMP = {"seconds": STAMP // 10**9, "nanos": STAMP % 10**9}
COVARIANCE = np.arange(36.0).reshape(6, 6)

both_ros = pytest.mark.parametrize("version", ["ros1", "ros2"])


def only(value: Any, type_name: str) -> Any:
    (sample,) = samples(message(value, type_name, RECEIVED), "d1.mcap")
    return sample


def is_the_pose(sample: PoseSample, target: str, source: str) -> bool:
    return (sample.stamp_ns, sample.receive_ns, sample.position, sample.quaternion_xyzw) == (
        STAMP,
        RECEIVED,
        POSITION,
        QUATERNION,
    ) and (sample.target, sample.source) == (target, source)


@both_ros
def test_odometry_keeps_its_covariance_and_both_frames(version: str) -> None:
    sample = only(odometry(version, STAMP, POSITION, QUATERNION, COVARIANCE), "nav_msgs/msg/Odometry")
    assert is_the_pose(sample, "odom", "base_link")
    np.testing.assert_array_equal(sample.covariance, COVARIANCE)


@both_ros
@pytest.mark.parametrize("type_name", ["tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"])
def test_transforms(version: str, type_name: str) -> None:
    stated = [
        transform_stamped(version, STAMP, ("map", "base"), POSITION, QUATERNION),
        transform_stamped(version, STAMP, ("base", "camera"), (0, 0, 1)),
    ]
    first, second = samples(message(SimpleNamespace(transforms=stated), type_name, RECEIVED), "d1.mcap")
    assert isinstance(first, PoseSample)
    assert isinstance(second, PoseSample)
    assert is_the_pose(first, "map", "base")
    assert (second.target, second.source, second.position) == ("base", "camera", (0, 0, 1))
    assert is_the_pose(only(stated[0], "geometry_msgs/msg/TransformStamped"), "map", "base")


def path(*stamps_ns: int, first: float = 0.0) -> Any:
    stamped = STORES["ros2"].types["geometry_msgs/msg/PoseStamped"]
    poses = [
        stamped(header=header("ros2", stamp), pose=pose("ros2", (first + k, 0.0, 0.0), (0, 0, 0, 1)))
        for k, stamp in enumerate(stamps_ns)
    ]
    return ros("ros2", "nav_msgs/msg/Path", header=header("ros2", stamps_ns[-1]), poses=poses)


def test_a_path_gives_each_pose_at_its_own_stamp_and_was_received_when_its_last_pose_was() -> None:
    found = list(samples(message(path(10, 20, 40), "nav_msgs/msg/Path", 1000), "d1.mcap"))
    assert [s.stamp_ns for s in found] == [10, 20, 40]
    assert [s.receive_ns for s in found] == [970, 980, 1000]


def test_growing_paths_give_each_pose_once_as_it_was_first_published() -> None:
    growing = [path(10), path(10, 20), path(20, 30, 40, first=7), path(30, 40, first=9)]
    messages = [message(value, "nav_msgs/msg/Path", 100 * k) for k, value in enumerate(growing)]
    found = list(all_samples(messages, "d1.mcap"))
    assert [(s.stamp_ns, s.position[0]) for s in found if isinstance(s, PoseSample)] == [
        (10, 0),
        (20, 1),
        (30, 8),
        (40, 9),
    ]


@pytest.mark.parametrize(
    "value",
    [
        from_json(timestamp=JSON_STAMP, frame_id="world", pose={"position": XYZ, "orientation": XYZW}),
        protobuf(
            "PoseInFrame",
            timestamp=PROTOBUF_STAMP,
            frame_id="world",
            pose={"position": XYZ, "orientation": XYZW},
        ),
    ],
    ids=["json", "protobuf"],
)
def test_foxglove_poses(value: Any) -> None:
    assert is_the_pose(only(value, "foxglove.PoseInFrame"), "world", "")


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_foxglove_transforms(encoding: str) -> None:
    fields = {"parent_frame_id": "map", "child_frame_id": "base", "translation": XYZ, "rotation": XYZW}
    if encoding == "json":
        one = from_json(timestamp=JSON_STAMP, **fields)
        several = from_json(transforms=[{"timestamp": JSON_STAMP, **fields}] * 2)
    else:
        one = protobuf("FrameTransform", timestamp=PROTOBUF_STAMP, **fields)
        several = protobuf("FrameTransforms", transforms=[{"timestamp": PROTOBUF_STAMP, **fields}] * 2)
    assert is_the_pose(only(one, "foxglove.FrameTransform"), "map", "base")
    found = list(samples(message(several, "foxglove.FrameTransforms", RECEIVED), "d1.mcap"))
    assert len(found) == 2
    assert all(isinstance(s, PoseSample) and is_the_pose(s, "map", "base") for s in found)


@both_ros
def test_gimbal_angles(version: str) -> None:
    name = "geometry_msgs/msg/Vector3Stamped"
    value = ros(version, name, header=header(version, STAMP), vector=part(version, "Vector3", 45, -20, 0))
    assert only(value, name) == AngleSample(STAMP, RECEIVED, (45, -20, 0), None)
    name = "geometry_msgs/msg/QuaternionStamped"
    value = ros(
        version, name, header=header(version, STAMP), quaternion=part(version, "Quaternion", *QUATERNION)
    )
    assert only(value, name) == AngleSample(STAMP, RECEIVED, None, QUATERNION)


def lens(value: Any, type_name: str = "sensor_msgs/msg/CameraInfo") -> Intrinsics:
    sample = only(value, type_name)
    assert isinstance(sample, IntrinsicsSample)
    assert sample.intrinsics is not None
    return sample.intrinsics


@both_ros
@pytest.mark.parametrize(
    ("stated", "model", "distortion"),
    [
        ({}, "radtan", (-0.2, 0.1, 0.001, 0.002, 0.0)),
        ({"d": np.zeros(5)}, "none", ()),
        ({"d": [], "distortion_model": ""}, "none", ()),
        ({"d": np.zeros(5), "distortion_model": "None"}, "none", ()),
        (
            {"distortion_model": "rational_polynomial", "d": [1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0]},
            "radtan",
            (1, 2, 3, 4, 5, 6, 7, 8),
        ),
        ({"distortion_model": "equidistant", "d": [1, 2, 3, 4]}, "fisheye", (1, 2, 3, 4)),
        ({"distortion_model": "kannala_brandt", "d": [1, 2, 3, 4]}, "fisheye", (1, 2, 3, 4)),
        ({"distortion_model": "fisheye", "d": np.zeros(4)}, "fisheye", (0, 0, 0, 0)),
    ],
)
def test_camera_info(version: str, stated: Any, model: str, distortion: tuple[float, ...]) -> None:
    assert lens(camera_info(version, **stated)) == Intrinsics(
        *(640, 480, 800, 800, 320, 240),
        model,  # type: ignore[arg-type]  # one of the literals
        distortion,
    )


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_foxglove_calibration(encoding: str) -> None:
    fields = {
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "D": [-0.2, 0.1, 0.0, 0.0, 0.0],
        "K": [800.0, 0, 320, 0, 810, 240, 0, 0, 1],
    }
    if encoding == "json":
        value = from_json(timestamp=JSON_STAMP, **fields)
    else:
        value = protobuf("CameraCalibration", timestamp=PROTOBUF_STAMP, **fields)
    expected = Intrinsics(640, 480, 800, 810, 320, 240, "radtan", (-0.2, 0.1, 0, 0, 0))
    assert lens(value, "foxglove.CameraCalibration") == expected
    assert lens(value, "foxglove_msgs/msg/CameraCalibration") == expected


def test_a_region_of_interest_and_binning_are_applied() -> None:
    """Map the sensor's pixel (u, v) to ((u - 100) / 2, (v - 40) / 4) of the picture."""
    region = {"x_offset": 100, "y_offset": 40, "width": 400, "height": 200}
    found = lens(camera_info("ros1", roi=region, binning_x=2, binning_y=4))
    assert (found.width, found.height) == (200, 50)
    assert (found.fx, found.fy, found.cx, found.cy) == (400, 200, 110, 50)


@pytest.mark.parametrize(
    "stated",
    [
        {"distortion_model": "CylinderCameraModel"},
        {"distortion_model": ""},
        {"distortion_model": "none"},
        {"roi": {"x_offset": 600, "width": 100, "height": 100}},
        {"width": 0},
        {"k": [800, 5, 320, 0, 800, 240, 0, 0, 1]},
    ],
)
def test_what_is_no_camera_is_refused(stated: Any) -> None:
    with pytest.raises(DataError) as error:
        lens(camera_info("ros2", **stated))
    assert str(error.value).startswith("d1.mcap: ")
