"""Flights with poses from the drones' own logs, through the commands: every camera's poses are right."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.geometry.geodesy import place_at
from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.ingest import ingest
from pipelines.session.errors import DataError
from pipelines.session.storage import read_json
from tests.commands.runner import succeeds
from tests.synthetic.drone_logs import (
    HOME,
    LEVER_ARM,
    DroneTruth,
    drone_of,
    ulog_rows,
    write_dataflash,
    write_record,
    write_srt,
    write_tlog,
    write_ulog,
)
from tests.synthetic.flights import SyntheticFlight, write_flight
from tests.synthetic.logged_flights import attitude_entry, fix_entry, header, turned
from tests.synthetic.logs import Entry, write_log

WORLD = {
    "origin": {
        "latitude_deg": HOME.latitude_deg,
        "longitude_deg": HOME.longitude_deg,
        "altitude_m": HOME.altitude_m,
    }
}
ON_GIMBAL = {"looks": "forward", "translation": LEVER_ARM.tolist()}


def session_of(flight: SyntheticFlight) -> dict[str, Any]:
    stored = flight.manifest.with_suffix(".session") / "session.json"
    return read_json(stored)


def poses_of(flight: SyntheticFlight, name: str) -> pd.DataFrame:
    return pd.read_parquet(flight.manifest.with_suffix(".session") / "cameras" / name / "poses.parquet")


def errors(flight: SyntheticFlight, k: int) -> tuple[float, float]:
    """Compute the largest errors of a camera's poses, in m and deg, over the frames that have one."""
    poses = poses_of(flight, flight.cameras[k]).set_index("t_ns")
    # Clocks in whole microseconds or milliseconds: cameras move by 1 mm in a ms at most.
    times = poses.index.to_numpy()
    nearest = np.abs(flight.t_ns[:, None] - times[None]).argmin(axis=0)
    assert np.abs(flight.t_ns[nearest] - times).max() < 1_100_000
    position = poses[["x", "y", "z"]].to_numpy() - flight.camera_position[k][nearest]
    turned = multiply(
        conjugate(flight.camera_quaternion[k][nearest]), poses[["qx", "qy", "qz", "qw"]].to_numpy()
    )
    return float(np.abs(position).max()), float(np.degrees(2 * np.abs(turned[:, :3])).max())


def with_poses(folder: Path, poses: Any, mount: dict[str, Any] | None = None) -> SyntheticFlight:
    """Write a clean flight of two cameras; `poses` writes a drone's log and returns its manifest entry."""
    flight = write_flight(folder, cameras=2, seconds=1.0, clean=True)
    flight.settings["world"] |= WORLD
    for k, name in enumerate(flight.cameras):
        camera = flight.settings["cameras"][name]
        camera["pose"] = poses(folder, name, drone_of(flight, k))
        if mount is not None:
            camera["mount"] = mount
    flight.save()
    return flight


def test_subtitles_with_gimbal_angles_on_two_drones(tmp_path: Path) -> None:
    # Their body's attitude is not in them: the lever arm turns with a level body that heads with the gimbal.
    flight = with_poses(tmp_path, _srt)
    said = succeeds("ingest", flight.manifest)
    assert f": {HOME.latitude_deg:.7f}, {HOME.longitude_deg:.7f}, 280.00 m (world.origin)" in said
    assert session_of(flight)["origin"]["source"] == "world.origin"
    for k in range(2):
        metres, degrees = errors(flight, k)
        # Without a mount the camera is where the body is: off by the lever arm, 0.147 m.
        assert metres == pytest.approx(np.abs(rotate(drone_of(flight, k).body, LEVER_ARM)).max(), abs=1e-3)
        assert degrees < 1e-4


def _srt(folder: Path, name: str, truth: DroneTruth) -> dict[str, Any]:
    write_srt(folder / f"{name}.SRT", truth)
    return {"file": f"{name}.SRT", "altitude": "absolute"}


def _record(folder: Path, name: str, truth: DroneTruth) -> dict[str, Any]:
    write_record(folder / f"{name}.csv", truth)
    return {"file": f"{name}.csv", "altitude": "absolute"}


def _ulog(folder: Path, name: str, truth: DroneTruth) -> dict[str, Any]:
    write_ulog(folder / f"{name}.ulg", ulog_rows(truth))
    return {"file": f"{name}.ulg"}


def _dataflash(folder: Path, name: str, truth: DroneTruth) -> dict[str, Any]:
    write_dataflash(folder / f"{name}.bin", truth)
    return {"file": f"{name}.bin", "position": "local"}


def _osdk(folder: Path, name: str, truth: DroneTruth) -> dict[str, Any]:
    entries: list[Entry] = []
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        yaw, pitch, roll = truth.gimbal_ypr_deg[row].tolist()
        angles = {"header": header(stamp_ns, ""), "vector": {"x": pitch, "y": roll, "z": yaw}}
        entries += [
            fix_entry("/dji_sdk/gps_position", stamp_ns, _place(truth, row)),
            attitude_entry("/dji_sdk/attitude", stamp_ns, truth.body[row]),
            Entry("/dji_sdk/gimbal_angle", "geometry_msgs/msg/Vector3Stamped", stamp_ns, angles),
        ]
    write_log(folder, name, "ros1", entries)
    return {"file": f"{name}.bag", "topic": "/dji_sdk/gps_position", "attitude": "/dji_sdk/attitude"}


def _on_gimbals_of_osdk(folder: Path) -> SyntheticFlight:
    """Write a flight whose bags hold gimbal angles in NED from north, as pitch, roll, yaw."""
    flight = with_poses(folder, _osdk, ON_GIMBAL)
    for camera in flight.settings["cameras"].values():
        angles = {"file": camera["pose"]["file"], "topic": "/dji_sdk/gimbal_angle", "order": "pry"}
        camera["gimbal"] = {**angles, "axes": "ned", "relative_to": "world"}
        camera["pose"]["of"] = "body"
    flight.save()
    return flight


def _tlog(folder: Path, name: str, truth: DroneTruth) -> dict[str, Any]:
    write_tlog(folder / f"{name}.tlog", truth)
    return {"file": f"{name}.tlog"}


def _place(truth: DroneTruth, row: int) -> tuple[float, ...]:
    return truth.latitude_deg[row], truth.longitude_deg[row], truth.altitude_m[row]


@pytest.mark.parametrize(
    ("write", "metres", "degrees"),
    [
        # Floats of 32 bits hold 10 m to 1e-6, quaternions to 1e-7; clocks are whole microseconds.
        (_ulog, 1e-4, 1e-4),
        # Angles of the body to 0.005 deg on a lever arm of 0.15 m; GPS time, by which the clock is set, to a
        # ms (at 1 m/s), and the origin to 1e-7 deg (11 mm).
        (_dataflash, 0.013, 0.1),
        (_tlog, 0.015, 0.1),  # 1e-7 deg are 11 mm, and a ms of the boot time 1 mm and 0.06 deg
        (_record, 1e-3, 1e-4),  # 1e-9 deg are 0.1 mm
    ],
)
def test_drones_that_log_body_and_gimbal(tmp_path: Path, write: Any, metres: float, degrees: float) -> None:
    flight = with_poses(tmp_path, write, ON_GIMBAL)
    ingest(flight.manifest)
    for k in range(2):
        off_m, off_deg = errors(flight, k)
        assert off_m < metres
        assert off_deg < degrees


def test_topics_of_djis_onboard_sdk_with_one_origin_for_all_where_none_is_stated(tmp_path: Path) -> None:
    flight = _on_gimbals_of_osdk(tmp_path)
    ingest(flight.manifest)
    assert max(max(errors(flight, k)) for k in range(2)) < 1e-4
    del flight.settings["world"]["origin"]
    flight.save()
    ingest(flight.manifest)
    origin, truth = session_of(flight)["origin"], drone_of(flight, 0)
    assert (origin["latitude_deg"], origin["longitude_deg"]) == (
        truth.latitude_deg[0],
        truth.longitude_deg[0],
    )
    assert origin["source"] == "drone1.bag"
    first, second = (poses_of(flight, name)[["x", "y", "z"]].to_numpy()[0] for name in flight.cameras)
    true = flight.camera_position[1][0] - flight.camera_position[0][0]
    # 15 m from HOME the vertical is turned by 2.4e-6: 15 m apart, 0.04 mm.
    np.testing.assert_allclose(second - first, true, atol=1e-4)


def test_fixes_and_attitudes_of_any_driver_an_actor_with_a_receiver_and_triggers(tmp_path: Path) -> None:
    flight = with_poses(tmp_path, _any_driver, {"looks": "forward", "translation": LEVER_ARM.tolist()})
    hip = flight.position[:, [flight.joints.index(f"{side}_hip") for side in ("left", "right")]].mean(axis=1)
    places = [place_at(row, HOME) for row in hip]
    entries = [
        fix_entry("/tag", t, (place.latitude_deg, place.longitude_deg, place.altitude_m))
        for t, place in zip(flight.t_ns, places, strict=True)
    ]
    write_log(tmp_path, "tag", "ros1", entries)
    flight.settings["actor"] = {"file": "tag.bag", "topic": "/tag"}
    for k, name in enumerate(flight.cameras):
        camera = flight.settings["cameras"][name]
        yaw, pitch, roll = drone_of(flight, k).gimbal_ypr_deg[0].tolist()
        camera["gimbal"] = {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
        camera["frame_times"] = {"file": f"{name}.bag", "topic": "/picture"}
    flight.save()
    ingest(flight.manifest)
    for k, name in enumerate(flight.cameras):
        poses = poses_of(flight, name)[["x", "y", "z"]].to_numpy()
        np.testing.assert_allclose(poses, flight.camera_position[k], atol=1e-4)
        session = flight.manifest.with_suffix(".session")
        frames = pd.read_parquet(session / "cameras" / name / "frames.parquet")
        np.testing.assert_array_equal(frames["t_ns"], flight.t_ns)
    actor = pd.read_parquet(flight.manifest.with_suffix(".session") / "actor.parquet")
    np.testing.assert_allclose(actor[["x", "y", "z"]].to_numpy(), hip, atol=1e-5)
    # Without a place on Earth for the world, the actor's position is not known.
    del flight.settings["world"]["origin"]
    for name in flight.cameras:
        camera = flight.settings["cameras"][name]
        del camera["mount"], camera["gimbal"]
        camera["pose"] = {"file": f"{name}.tum"}
    flight.save()
    with pytest.raises(DataError):
        ingest(flight.manifest)


def _any_driver(folder: Path, name: str, truth: DroneTruth) -> dict[str, Any]:
    entries: list[Entry] = []
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        stamped = header(stamp_ns, "")
        imu = {"header": stamped, "orientation": turned(truth.body[row])}
        entries += [
            fix_entry("/fix", stamp_ns, _place(truth, row)),
            Entry("/imu", "sensor_msgs/msg/Imu", stamp_ns, imu),
            Entry("/picture", "sensor_msgs/msg/CompressedImage", stamp_ns, {"header": stamped}),
        ]
    write_log(folder, name, "ros1", entries)
    return {"file": f"{name}.bag", "topic": "/fix", "attitude": "/imu"}


def test_frames_at_the_triggers_of_an_autopilot(tmp_path: Path) -> None:
    flight = with_poses(tmp_path, _ulog, ON_GIMBAL)
    for camera in flight.settings["cameras"].values():
        camera["frame_times"] = dict(camera["pose"])
    flight.save()
    ingest(flight.manifest)
    for name in flight.cameras:
        session = flight.manifest.with_suffix(".session")
        frames = pd.read_parquet(session / "cameras" / name / "frames.parquet")
        # Two clocks of whole microseconds.
        assert np.abs(frames["t_ns"].to_numpy() - flight.t_ns).max() <= 2000


def test_a_video_starts_at_the_time_of_its_container(tmp_path: Path) -> None:
    import av

    flight = write_flight(tmp_path, cameras=1, seconds=1.0, clean=True)
    with av.open(str(tmp_path / "drone1.mp4"), "w") as container:
        container.metadata["creation_time"] = "2023-11-14T22:13:20.000000Z"  # 1700000000
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 1280, 720, "yuv420p"
        picture = av.VideoFrame.from_ndarray(np.zeros((720, 1280, 3), np.uint8), format="rgb24")
        for _ in range(3):
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    camera = flight.settings["cameras"]["drone1"]
    camera |= {"video": "drone1.mp4", "frame_times": {"start": "container"}}
    del camera["clock"]
    flight.save()
    described = ingest(flight.manifest).description
    assert described.cameras["drone1"].frames.first_t_ns == int(flight.t_ns[0])
    assert any("say clock: {sigma_s: 1}" in line for line in described.warnings)
    assert any("one camera" in line for line in described.warnings)
