"""Poses read at once equal those read one by one; if messages differ, nothing is read at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.messages import all_samples
from pipelines.formats.logs.trajectories import LoggedRows, poses_at_once, poses_one_by_one
from pipelines.session.registries import LogFormat, recognise
from tests.synthetic.logs import CONTAINERS, Container, Entry, write_log

TOPIC = "/pose"
TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
START_NS = 1_700_000_000_000_000_000


def entry(type_: str, k: int, rng: np.random.Generator, *, frame: str = "odom", child: str = "base") -> Entry:
    """Make a message of random numbers, with different stamps of header and receipt."""
    x, y, z = rng.standard_normal(3).tolist()
    turned = rng.standard_normal(4)
    # Some rows cannot be used, and both ways must report them alike.
    qx, qy, qz, qw = (turned / np.linalg.norm(turned) * (k % 7 != 3)).tolist()
    place, turn = {"x": x, "y": y, "z": z}, {"x": qx, "y": qy, "z": qz, "w": qw}
    pose: Any = {"position": place, "orientation": turn}
    fields: dict[str, Any] = {
        "header": {"stamp": START_NS + 10_000_000 * k + int(rng.integers(1000)), "frame_id": frame},
        "child_frame_id": child,
        "transform": {"translation": place, "rotation": turn},
        "pose": pose,
    }
    if "Covariance" in type_ or "Odometry" in type_:
        fields["pose"] = {"pose": pose, "covariance": rng.standard_normal(36)}
    return Entry(TOPIC, type_, START_NS + 10_000_000 * k + 3_000_000, fields)


def at_once(path: Path) -> LoggedRows | None:
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        return poses_at_once(log, TOPIC)


@pytest.mark.parametrize("frame", ["odom", "o", "", "drone1/öst"])
@pytest.mark.parametrize("type_", TYPES)
@pytest.mark.parametrize("container", CONTAINERS)
def test_the_same_as_one_by_one(tmp_path: Path, container: Container, type_: str, frame: str) -> None:
    rng = np.random.default_rng(5)
    path = write_log(tmp_path, "log", container, [entry(type_, k, rng, frame=frame) for k in range(30)])
    read = at_once(path)
    assert read is not None
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        samples = list(all_samples(log.messages([TOPIC]), "log"))
    assert read.frames == (samples[0].target, samples[0].source)  # type: ignore[union-attr]
    assert read.header_ns.tolist() == [sample.stamp_ns for sample in samples]
    assert read.receive_ns.tolist() == [sample.receive_ns for sample in samples]
    one_by_one = poses_one_by_one(iter(samples), "log")
    assert read.check() == one_by_one.check()
    expected, found = one_by_one.trajectory("log", "header"), read.trajectory("log", "header")
    for name in ("t_ns", "position", "quaternion_xyzw", "covariance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), strict=True)
    assert found.dropped == expected.dropped
    assert list(found.dropped.values()) == [4]


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("changed", [{"frame": "map"}, {"frame": "odom2"}, {"child": "bass"}])
def test_frames_that_change_are_left_to_the_slow_way(
    tmp_path: Path, container: Container, changed: dict[str, str]
) -> None:
    rng = np.random.default_rng(6)
    entries = [entry("nav_msgs/msg/Odometry", k, rng, **(changed if k == 7 else {})) for k in range(9)]
    assert at_once(write_log(tmp_path, "log", container, entries)) is None
