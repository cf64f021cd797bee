"""Decoded messages in the form of the log readers: ROS 1, ROS 2, Foxglove's JSON and protobuf."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from pipelines.session.records import Message, Topic

STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "ros2": get_typestore(Stores.ROS2_HUMBLE)}


def message(
    value: Any, type_name: str, receive_ns: int = 0, name: str = "/t", encoding: str = "cdr"
) -> Message:
    return Message(Topic(name, type_name, encoding, 1, None, None), receive_ns, value)


def ros(ros_version: str, type_name: str, **fields: Any) -> Any:
    """Make a rosbags message by serialising and deserialising it."""
    store = STORES[ros_version]
    value = store.types[type_name](**fields)
    if ros_version == "ros1":
        return store.deserialize_ros1(store.serialize_ros1(value, type_name), type_name)
    return store.deserialize_cdr(store.serialize_cdr(value, type_name), type_name)


def header(ros_version: str, stamp_ns: int, frame: str = "world") -> Any:
    store = STORES[ros_version]
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    extra = {"seq": 0} if ros_version == "ros1" else {}
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)


def part(ros_version: str, type_name: str, *values: float) -> Any:
    """Make a Point, Vector3 or Quaternion of geometry_msgs."""
    fields = dict(zip("xyzw", values, strict=False))
    return STORES[ros_version].types[f"geometry_msgs/msg/{type_name}"](**fields)


def pose(ros_version: str, position: tuple[float, ...], quaternion: tuple[float, ...]) -> Any:
    return STORES[ros_version].types["geometry_msgs/msg/Pose"](
        position=part(ros_version, "Point", *position),
        orientation=part(ros_version, "Quaternion", *quaternion),
    )


def transform_stamped(
    ros_version: str,
    stamp_ns: int,
    frames: tuple[str, str],
    position: tuple[float, ...],
    quaternion: tuple[float, ...] = (0, 0, 0, 1),
) -> Any:
    types = STORES[ros_version].types
    return types["geometry_msgs/msg/TransformStamped"](
        header=header(ros_version, stamp_ns, frames[0]),
        child_frame_id=frames[1],
        transform=types["geometry_msgs/msg/Transform"](
            translation=part(ros_version, "Vector3", *position),
            rotation=part(ros_version, "Quaternion", *quaternion),
        ),
    )


def odometry(
    ros_version: str,
    stamp_ns: int,
    position: tuple[float, ...],
    quaternion: tuple[float, ...],
    covariance: Any,
) -> Any:
    types = STORES[ros_version].types
    still = types["geometry_msgs/msg/Twist"](
        linear=part(ros_version, "Vector3", 0, 0, 0), angular=part(ros_version, "Vector3", 0, 0, 0)
    )
    return ros(
        ros_version,
        "nav_msgs/msg/Odometry",
        header=header(ros_version, stamp_ns, "odom"),
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](
            pose=pose(ros_version, position, quaternion), covariance=np.ravel(covariance).astype(np.float64)
        ),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=still, covariance=np.zeros(36)),
    )


def camera_info(ros_version: str, stamp_ns: int = 0, **changed: Any) -> Any:
    """Make a camera of 640 x 480, f = 800, centre (320, 240), with some (lower-case) keys changed."""
    types = STORES[ros_version].types
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    fields: dict[str, Any] = {
        "height": 480,
        "width": 640,
        "distortion_model": "plumb_bob",
        "d": [-0.2, 0.1, 0.001, 0.002, 0.0],
        "k": [800, 0, 320, 0, 800, 240, 0, 0, 1],
        "r": np.eye(3),
        "p": np.zeros(12),
        "binning_x": 0,
        "binning_y": 0,
    } | changed
    fields["roi"] = types["sensor_msgs/msg/RegionOfInterest"](**(region | changed.get("roi", {})))
    for matrix in "dkrp":
        values = np.asarray(fields.pop(matrix), dtype=np.float64).ravel()
        fields[matrix.upper() if ros_version == "ros1" else matrix] = values
    return ros(ros_version, "sensor_msgs/msg/CameraInfo", header=header(ros_version, stamp_ns), **fields)


def from_json(**fields: Any) -> Any:
    """Convert fields through JSON to attribute objects."""
    return json.loads(json.dumps(fields), object_hook=lambda mapping: SimpleNamespace(**mapping))
