"""Trajectories built from samples: stamps compared, losses counted, transforms chained."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from pipelines.formats.logs.messages import Source, Stamps, all_samples
from pipelines.formats.logs.trajectories import (
    Gathered,
    attitudes_of,
    chained,
    logged_poses,
    trajectory_of,
    transforms_of,
)
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.session.records import AngleSample, Message, PoseSample, Sample, Topic
from tests.raising import refused
from tests.real_data import real_data

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
LEVEL = (0.0, 0.0, 0.0, 1.0)


def gathered_from(samples: Iterable[Sample], source: Source, *, stamps: Stamps) -> Gathered:
    rows = logged_poses(samples, source)
    return Gathered(trajectory_of(rows, source, stamps), rows.frames, tuple(rows.notes(source, stamps)))


def flown(
    count: int = 10, *, rate_hz: int = 10, lag_ns: int = 2_000_000, frames: tuple[str, str] = ("odom", "base")
) -> list[PoseSample]:
    """Make poses that move east at 1 m/s, received a little after their header stamps."""
    stamps = [EPOCH + k * S // rate_hz for k in range(count)]
    return [
        PoseSample(t, t + lag_ns, frames[0], frames[1], ((t - EPOCH) / S, 0.0, 0.0), LEVEL) for t in stamps
    ]


def test_the_stamp_of_header_or_of_receipt() -> None:
    header = gathered_from(flown(), "d1", stamps="header")
    receive = gathered_from(flown(), "d1", stamps="receive")
    np.testing.assert_array_equal(header.trajectory.t_ns, EPOCH + np.arange(10) * S // 10)
    np.testing.assert_array_equal(receive.trajectory.t_ns - header.trajectory.t_ns, 2_000_000)
    np.testing.assert_allclose(header.trajectory.position[:, 0], np.arange(10) / 10, atol=1e-15)
    assert header.frames == ("odom", "base")
    assert header.trajectory.covariance is None
    assert header.notes == receive.notes == ()


def test_a_missing_header_stamp_takes_the_one_of_receipt_and_is_counted() -> None:
    stated = flown()
    stated[3:5] = [replace(sample, stamp_ns=0) for sample in stated[3:5]]
    found = gathered_from(stated, "d1", stamps="header")
    assert found.trajectory.t_ns[3] == stated[3].receive_ns
    assert ["2 of 10" in note for note in found.notes] == [True]


@pytest.mark.parametrize("jump_s", [-3.0, 40.0])
def test_a_clock_jump_is_told_with_its_place_and_size(jump_s: float) -> None:
    stated = flown(20)
    stated[12:] = [replace(sample, stamp_ns=sample.stamp_ns + round(jump_s * S)) for sample in stated[12:]]
    stated[5] = replace(stated[5], stamp_ns=0)  # a row without a stamp is no jump
    found = gathered_from(stated, "d1", stamps="header")
    told = f"jumps by {jump_s:.3g} s at {stated[12].stamp_ns / 1e9:.3f} s"
    assert [told in note for note in found.notes] == [False, False, True]
    assert f"up to {jump_s - 0.002:.3g} s in 8 of 20" in found.notes[1]
    if jump_s < 0:  # no stamp after the jump is later than those before it
        assert list(found.trajectory.dropped.values()) == [8]
    else:
        assert found.trajectory.dropped == {}


def test_covariances_turn_with_the_body() -> None:
    """Head north: a variance about the world's x (east) is then one about the body's y, to the right."""
    north = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])
    stated = [replace(s, quaternion_xyzw=north, covariance=covariance) for s in flown()]
    found = gathered_from(stated, "d1", stamps="header").trajectory.covariance
    assert found is not None
    np.testing.assert_allclose(found, np.tile(np.diag([1.0, 2, 3, 5, 4, 6]), (10, 1, 1)), atol=1e-14)
    unknown = [replace(s, covariance=np.zeros((6, 6))) for s in flown()]
    assert gathered_from(unknown, "d1", stamps="header").trajectory.covariance is None


def test_gimbal_angles_and_quaternions_say_the_same() -> None:
    angles = np.random.default_rng(5).uniform(-80, 80, size=(20, 3))
    turned = Rotation.from_euler("ZYX", angles, degrees=True)
    stamps = [EPOCH + k * S for k in range(20)]
    as_angles = [
        AngleSample(t, t, (float(r), float(p), float(y)), None)
        for t, (y, p, r) in zip(stamps, angles, strict=True)
    ]
    as_quaternions = [
        AngleSample(t, t, None, tuple(q)) for t, q in zip(stamps, turned.as_quat().tolist(), strict=True)
    ]
    for stated in (as_angles, as_quaternions):
        found = attitudes_of(stated, "d1", stamps="header", order="rpy", units="deg").trajectory
        assert found.t_ns.tolist() == stamps
        np.testing.assert_allclose(
            matrix_from_quaternion(found.quaternion_xyzw), turned.as_matrix(), rtol=0, atol=1e-12
        )
        assert not found.position.any()


def static(frames: tuple[str, str], position: tuple[float, float, float]) -> PoseSample:
    return PoseSample(0, EPOCH, frames[0], frames[1], position, LEVEL)


def test_chains_of_moving_and_static_transforms() -> None:
    odometry = flown(50, rate_hz=50)
    correction = [
        replace(s, position=(0.0, 100.0, 0.0)) for s in flown(5, rate_hz=5, frames=("/map", "odom"))
    ]
    transforms = transforms_of(
        sorted(odometry + correction, key=lambda s: s.receive_ns),
        "d1",
        static=[static(("base", "camera"), (0.5, 0.0, 0.0))],
    )
    found = chained(transforms, "d1", parent="map", child="/camera", stamps="header", max_gap_ns=S)
    # 5 Hz ends at 0.8 s, so the last nine stamps of 0.00 to 0.98 s at 50 Hz have no correction.
    assert list(found.trajectory.dropped.values()) == [9]
    np.testing.assert_allclose(
        found.trajectory.position, [[k / 50 + 0.5, 100, 0] for k in range(41)], rtol=0, atol=1e-12
    )
    assert found.frames == ("map", "camera")


@pytest.mark.parametrize("stamped", [False, True])
@pytest.mark.parametrize("beside_moving", [False, True])
@pytest.mark.parametrize("apart_m", [0.01, 1.0])
def test_each_value_of_a_static_transform_holds_from_its_publication_on(
    beside_moving: bool, stamped: bool, apart_m: float
) -> None:
    odometry = flown(50, rate_hz=50, frames=("map", "base"))
    times = [EPOCH + S // 10, EPOCH + S // 2]  # the first is published after the first poses
    arm, moved = (
        replace(static(("base", "camera"), (0.5, 0.0, z)), receive_ns=t, stamp_ns=t if stamped else 0)
        for t, z in zip(times, (0.0, apart_m), strict=True)
    )
    x, y, z, w = moved.quaternion_xyzw
    turned_alike = replace(moved, quaternion_xyzw=(-x, -y, -z, -w), receive_ns=times[1] + 1)
    transforms = transforms_of(
        [*odometry, *([moved] if beside_moving else [])],
        "d1",
        static=[arm] if beside_moving else [arm, moved, turned_alike],
    )
    found = chained(transforms, "d1", parent="map", child="camera", stamps="header", max_gap_ns=S)
    assert found.trajectory.dropped == {}
    np.testing.assert_allclose(found.trajectory.position[:, 2], np.where(np.arange(50) < 25, 0, apart_m))
    assert [f"{apart_m:.3g} m apart" in note for note in found.notes] == [True]


def test_frames_that_cannot_be_chained_are_refused() -> None:
    late = [replace(s, stamp_ns=s.stamp_ns + 1000 * S) for s in flown(frames=("base", "camera"))]
    transforms = transforms_of([*flown(), *late], "d1.mcap")
    with refused("data", "d1.mcap", "'bace'", "base", "`parent`", "`child`"):
        chained(transforms, "d1.mcap", parent="odom", child="bace", stamps="header", max_gap_ns=S)
    with refused("data", "d1.mcap", "'odom'", "'camera'", "--max-pose-gap"):
        chained(transforms, "d1.mcap", parent="odom", child="camera", stamps="header", max_gap_ns=S)
    with refused("data", "d1.mcap", "topic", "transforms"):
        transforms_of([AngleSample(1, 1, (0, 0, 0), None)], "d1.mcap")


def real_messages(path: Path, topics: Sequence[str]) -> Iterator[Message]:
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic in topics]
        for connection, receive_ns, data in reader.messages(connections=connections):
            topic = Topic(connection.topic, connection.msgtype, "ros1", connection.msgcount, None, None)
            yield Message(topic, receive_ns, reader.deserialize(data, connection.msgtype))


def test_the_odometry_of_a_real_robot() -> None:
    path = real_data("logs/ros1/husky_gps_imu_odom.bag")
    messages = real_messages(path, ["/husky_velocity_controller/odom"])
    found = gathered_from(all_samples(messages, path), path, stamps="header")
    assert len(found.trajectory.t_ns) == 3952
    assert found.trajectory.dropped == {}
    assert found.frames == ("odom", "base_link")
    covariance = found.trajectory.covariance
    assert covariance is not None
    # The robot turns about the vertical alone, so its covariance is the same in world and body.
    np.testing.assert_allclose(covariance[0], np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 0.03]), atol=1e-12)


def test_the_transforms_of_two_real_turtles() -> None:
    """Read a turtle that follows another one by steering for a carrot 1 m before the other's nose."""
    path = real_data("logs/ros1/foxglove_example.bag")
    transforms = transforms_of(
        all_samples(real_messages(path, ["/tf"]), path),
        path,
        static=all_samples(real_messages(path, ["/tf_static"]), path),
    )
    to_carrot, to_turtle = (
        chained(transforms, path, parent="world", child=child, stamps="header", max_gap_ns=S).trajectory
        for child in ("carrot", "turtle1")
    )
    assert len(to_turtle.t_ns) == 1344
    nose = matrix_from_quaternion(to_turtle.quaternion_xyzw)[:, :, 0]
    np.testing.assert_allclose(to_carrot.position, to_turtle.position + nose, rtol=0, atol=1e-12)
    follower = chained(transforms, path, parent="turtle2", child="carrot", stamps="header", max_gap_ns=S)
    distance = np.linalg.norm(follower.trajectory.position, axis=1)
    assert distance[0] > 4
    assert distance[-1] < 1
