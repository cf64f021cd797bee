"""Files of a simulated flight, in the formats that a real one has: manifest, log messages, keypoints, truth.

Numbers are written such that reading them back costs less than 0.01 mm at 10 m. Messages are those of ROS 2,
their fields plain numbers by name; a stamp is nanoseconds since the epoch, and fields that are zero may be
left out. Axes are the world's, east-north-up.
"""

import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from ruamel.yaml import YAML

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.body_model import SHAPE, body_model, shape_of
from pipelines.geometry.cameras import camera_info
from pipelines.geometry.poses import conjugate, pose_covariance_in_body
from pipelines.geometry.rig import BONES, joint_centres
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.storage import write_json
from pipelines.session.tables import BODY, BODY_ROTATION_COLUMNS, BODY_SHAPE, write_table
from pipelines.simulation.flight import (
    SimulatedDrone,
    SimulatedFlight,
    SimulatedPerson,
    keypoints_of,
    picture_stamps,
    visible_joints,
)
from pipelines.simulation.flying import LEVER_ARM

# The box of a person detector is about this much larger than the extent of the joints.
_BOX_MARGIN = 0.15


class TrackedKeypoints(NamedTuple):
    """One person over all frames of one camera."""

    track: int  # the tracker's id of the person
    xy: Float  # [T, J, 2] px, NaN where missed
    confidence: Float  # [T, J]


def write_tum(path: Path, t_ns: Int64, position: Float, quaternion_xyzw: Float) -> None:
    """Write poses [N] as `t x y z qx qy qz qw`, t in seconds to the nanosecond."""
    lines = ["# t x y z qx qy qz qw"]
    for stamp, xyz, xyzw in zip(t_ns.tolist(), position.tolist(), quaternion_xyzw.tolist(), strict=True):
        numbers = [*(f"{v:.6f}" for v in xyz), *(f"{v:.9f}" for v in xyzw)]
        seconds, rest = divmod(abs(stamp), 10**9)
        lines.append(" ".join([f"{'-' if stamp < 0 else ''}{seconds}.{rest:09d}", *numbers]))
    write_lines(path, lines)


def write_joints(
    path: Path, t_ns: Int64, names: tuple[str, ...], people: Sequence[Float], *, numbered: bool
) -> None:
    """Write joints [T, J, 3] of each person as a long CSV: t_ns, person if numbered, joint, x, y, z in m."""
    rows = pd.MultiIndex.from_product([t_ns, range(len(people)), names], names=["t_ns", "person", "joint"])
    _write_csv(path, pd.DataFrame(np.stack(people, axis=1).reshape(-1, 3), rows, [*"xyz"]), numbered=numbered)


def _write_csv(path: Path, table: pd.DataFrame, *, numbered: bool) -> None:
    """Write a table with its index, of which `person` is left out unless people are numbered."""
    table = table if numbered else table.droplevel("person")
    table.to_csv(path, float_format="%.6f", lineterminator="\n")


def write_alphapose(path: Path, people: Iterable[TrackedKeypoints]) -> None:
    """Write keypoints as AlphaPose does with its tracker; frame k is picture `00000k.jpg`, missed is 0."""
    entries = [
        (frame, _alphapose_entry(frame, person))
        for person in people
        for frame in np.flatnonzero(np.isfinite(person.xy).all(axis=-1).any(axis=-1)).tolist()
    ]
    entries.sort(key=lambda pair: pair[0])
    write_lines(path, ["[", ",\n".join(json.dumps(e, separators=(",", ":")) for _, e in entries), "]"])


def _alphapose_entry(frame: int, person: TrackedKeypoints) -> dict[str, object]:
    xy, confidence = person.xy[frame], person.confidence[frame]
    keypoints = np.nan_to_num(np.concatenate([xy, confidence[:, None]], axis=1), nan=0.0)
    low, high = np.nanmin(xy, axis=0), np.nanmax(xy, axis=0)
    low, size = low - _BOX_MARGIN * (high - low), (1 + 2 * _BOX_MARGIN) * (high - low)
    return {
        "image_id": f"{frame:06d}.jpg",
        "category_id": 1,
        "keypoints": [round(v, 3) for v in keypoints.ravel().tolist()],
        # AlphaPose adds the mean and the best keypoint score to the box's own (here 1).
        "score": round(1.0 + float(confidence.mean() + 1.25 * confidence.max()), 3),
        "box": [round(v, 1) for v in (*low.tolist(), *size.tolist())],
        "idx": person.track,
    }


def write_lines(path: Path, lines: list[str]) -> None:
    """Write lines of text that end as on Linux, on every system."""
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def write_truth(folder: Path, flight: SimulatedFlight) -> None:
    """Write the truth at the times of pictures and logs."""
    start_ns = flight.scenario.start_ns
    truth = folder / "truth"
    truth.mkdir()
    stamps, joint_names = flight.t_ns + start_ns, flight.people[0].person.joints
    numbered = flight.scenario.actors is not None
    joints = [each.joints for each in flight.people]
    write_joints(truth / "joints.csv", stamps, joint_names, joints, numbered=numbered)
    write_table(truth / "body.parquet", true_bodies(flight), BODY)
    write_table(truth / "body_shape.parquet", true_shapes(flight), BODY_SHAPE)
    if numbered:
        write_json(truth / "people.json", {"people": [each.name for each in flight.people]})
    for drone in flight.drones:
        poses = drone.at_log
        write_tum(
            truth / f"{drone.name}.tum",
            poses.t_ns + start_ns,
            poses.camera_position,
            poses.camera_quaternion_xyzw,
        )
        _write_csv(truth / f"{drone.name}_visible.csv", _visible_table(flight, drone), numbered=numbered)
    offsets = {drone.name: drone.clock_offset_s for drone in flight.drones}
    write_json(truth / "clocks.json", {"clock_offsets_s": offsets})


def true_bodies(flight: SimulatedFlight) -> pd.DataFrame:
    """Make the rows of `tables.BODY`, without covariances."""
    unknown = dict.fromkeys((*POINT_COVARIANCE_COLUMNS, *BODY_ROTATION_COLUMNS), np.nan)
    tables = []
    for number, each in enumerate(flight.people):
        rotation, times = body_model().rotations(each.person.world_from_rest(each.motion)), len(flight.t_ns)
        table = pd.DataFrame({"t_ns": np.repeat(flight.t_ns + flight.scenario.start_ns, len(BONES))})
        table = table.assign(person=number, bone=np.tile(np.array(BONES, dtype=object), times), **unknown)
        table[["x", "y", "z"]] = joint_centres(each.person.rig, each.motion).reshape(-1, 3)
        table[["qx", "qy", "qz", "qw"]] = rotation.reshape(-1, 4)
        tables.append(table)
    return pd.concat(tables, ignore_index=True).sort_values(["t_ns", "person"], kind="stable")


def true_shapes(flight: SimulatedFlight) -> pd.DataFrame:
    """Make the rows of `tables.BODY_SHAPE`, with standard deviations of 0."""
    looks = [each.look.body for each in flight.people]
    rows = [
        (number, name, value, 0.0)
        for number, look in enumerate(looks)
        for name, value in zip(SHAPE, shape_of(look.sex, look.build, look.height_m).tolist(), strict=True)
    ]
    return pd.DataFrame(rows, columns=["person", "number", "value", "sigma"])


def _visible_table(flight: SimulatedFlight, drone: SimulatedDrone) -> pd.DataFrame:
    """Make a row of each frame and person, with 1 or 0 for each joint."""
    visible = np.stack([visible_joints(flight, drone, each)[1] for each in flight.people], axis=1)
    rows = pd.MultiIndex.from_product([*map(range, visible.shape[:2])], names=["frame", "person"])
    joints = [*flight.people[0].person.joints]
    return pd.DataFrame(visible.reshape(-1, len(joints)).astype(int), rows, joints)


def write_keypoints(folder: Path, flight: SimulatedFlight, drone: SimulatedDrone) -> None:
    """Write what a detector would have found, as AlphaPose does, and the times of the pictures."""
    people = [
        TrackedKeypoints(1 + k, *keypoints_of(flight, drone, person))
        for k, person in enumerate(flight.people)
    ]
    write_alphapose(folder / f"{drone.name}_keypoints.json", people)
    stamps = picture_stamps(flight, drone)
    lines = ["frame,t_ns", *(f"{frame},{stamp}" for frame, stamp in enumerate(stamps.tolist()))]
    write_lines(folder / f"{drone.name}_frames.csv", lines)


# Someone who starts cameras by hand knows their clocks to about a third of a second.
_UNKNOWN_CLOCK_SIGMA_S = 0.3


def manifest_text(flight: SimulatedFlight, *, video: bool, true_poses: bool = False) -> str:
    """Write the manifest, which states what a user would know, with `true_poses` the true ones as logged."""
    scenario, drones = flight.scenario, flight.drones
    notes = ["Simulated by `mocap simulate` from scenario.yaml; simulation.json says how."]
    if not video:
        notes.append(f"The keypoints have the measured errors of {scenario.keypoints.detector}.")
    notes += _shot(flight)
    people = {each.name: {"file": "drone1", "topic": each.topic, "point": "hip"} for each in flight.people}
    manifest = {
        "schema": 1,
        "name": scenario.name,
        "simulated": True,
        "world": {"frame": "enu"},
        "logs": {drone.name: {"file": f"{drone.name}.mcap"} for drone in drones},
        "cameras": {
            drone.name: _pictures(flight, drone, video) | _poses(flight, drone, true_poses)
            for drone in drones
        },
        **({"actors": people} if scenario.actors is not None else {"actor": next(iter(people.values()))}),
        "map": "site.npz",
        "truth": {
            "file": "truth/joints.csv",
            "poses": {drone.name: f"truth/{drone.name}.tum" for drone in drones},
            "body": "truth/body.parquet",
        },
    }
    yaml, text = YAML(), StringIO()
    yaml.default_flow_style, yaml.width = None, sys.maxsize  # the innermost mappings stand on one line
    yaml.dump(manifest, text)
    return "".join(f"# {note}\n" for note in notes) + text.getvalue()


def _shot(flight: SimulatedFlight) -> list[str]:
    """Write a comment on exposure, readout and bit rate; none where all are off."""
    lens = flight.scenario.drones.camera
    parts = [
        f"exposure {lens.exposure_ms:g} ms" if lens.exposure_ms else "",
        f"readout {lens.readout_ms:g} ms" if lens.readout_ms else "",
        f"{lens.bitrate_mbps:g} Mbit/s" if lens.bitrate_mbps else "",
    ]
    if not any(parts):
        return []
    stamps = "a picture's time is the middle of the exposure of its middle row"
    return [f"Pictures: {', '.join(part for part in parts if part)}; {stamps}."]


def _pictures(flight: SimulatedFlight, drone: SimulatedDrone, video: bool) -> dict[str, object]:
    name, readout_s = drone.name, drone.intrinsics.readout_s
    if video:
        start_s = int(picture_stamps(flight, drone)[0]) / 10**9
        pictures: dict[str, object] = {"video": f"{name}.mp4", "frame_times": {"start": start_s}}
    else:
        found = {"file": f"{name}_keypoints.json", "format": "alphapose", "skeleton": "coco17"}
        pictures = {"frame_times": {"file": f"{name}_frames.csv"}, "keypoints": found}
    is_unknown = any(other.clock_offset_s for other in flight.drones)
    lens = f"{name}_camera.yaml"
    return {
        **pictures,
        "clock": {"offset_s": 0, "sigma_s": _UNKNOWN_CLOCK_SIGMA_S if is_unknown else 0},
        "intrinsics": {"file": lens, "readout_s": readout_s} if readout_s else lens,
    }


def _poses(flight: SimulatedFlight, drone: SimulatedDrone, true_poses: bool) -> dict[str, object]:
    name, drones = drone.name, flight.scenario.drones
    if true_poses:
        return {"pose": {"file": f"truth/{name}.tum"}}
    noise = {model: dict(of) for model, of in drones.pose_noise.items() if drones.state_pose_noise}
    return {
        "pose": {"file": name, "topic": f"/{name}/odometry", "of": "body"},
        "mount": {"looks": "forward", "translation": list(LEVER_ARM)},
        "gimbal": {"file": name, "topic": f"/{name}/gimbal", "relative_to": "world"},
        **({"pose_noise": noise} if noise else {}),
    }


# The recorder on board receives a message about 2 ms after its own stamp.
_RECEIVED_NS = 2_000_000
# Drivers repeat the calibration about once a second.
_CAMERA_INFO_NS = 1_000_000_000


class LoggedMessage(NamedTuple):
    """One message, as received."""

    received_ns: int
    topic: str
    type: str
    fields: dict[str, Any]


def logged_messages(flight: SimulatedFlight, drone: SimulatedDrone) -> list[LoggedMessage]:
    """Return the messages of one drone in the order of receipt; the first drone receives the actors, too."""
    messages = [*_odometry(flight, drone), *_gimbal(flight, drone), *_camera_infos(flight, drone)]
    if drone is flight.drones[0]:
        for person in flight.people:
            messages += _actor(flight, person)
    return sorted(messages, key=lambda message: message[:2])


def _received(stamp_ns: int, topic: str, type_: str, fields: dict[str, Any]) -> LoggedMessage:
    return LoggedMessage(stamp_ns + _RECEIVED_NS, topic, type_, fields)


def _odometry(flight: SimulatedFlight, drone: SimulatedDrone) -> Iterator[LoggedMessage]:
    body = drone.log.body
    covariance = np.zeros((len(body.t_ns), 6, 6))
    if body.covariance is not None:  # ROS turns about fixed axes
        covariance = pose_covariance_in_body(body.covariance, conjugate(body.quaternion_xyzw))
    for k, stamp_ns in enumerate((body.t_ns + flight.scenario.start_ns).tolist()):
        pose = {"position": _xyz(body.position[k]), "orientation": _xyzw(body.quaternion_xyzw[k])}
        fields = {
            "header": {"stamp": stamp_ns, "frame_id": "world"},
            "child_frame_id": f"{drone.name}/body",
            "pose": {"pose": pose, "covariance": covariance[k]},
        }
        yield _received(stamp_ns, f"/{drone.name}/odometry", "nav_msgs/msg/Odometry", fields)


def _gimbal(flight: SimulatedFlight, drone: SimulatedDrone) -> Iterator[LoggedMessage]:
    stamps = (drone.log.body.t_ns + flight.scenario.start_ns).tolist()
    for stamp_ns, attitude in zip(stamps, drone.log.gimbal_xyzw, strict=True):
        header = {"stamp": stamp_ns, "frame_id": "world"}
        fields = {"header": header, "quaternion": _xyzw(attitude)}
        yield _received(stamp_ns, f"/{drone.name}/gimbal", "geometry_msgs/msg/QuaternionStamped", fields)


def _camera_infos(flight: SimulatedFlight, drone: SimulatedDrone) -> Iterator[LoggedMessage]:
    fields = camera_info(drone.intrinsics)
    first, last = drone.log.body.t_ns[[0, -1]] + flight.scenario.start_ns
    for stamp_ns in range(int(first), int(last), _CAMERA_INFO_NS):
        stamped = {"header": {"stamp": stamp_ns, "frame_id": f"{drone.name}/camera"}, **fields}
        topic = f"/{drone.name}/camera/camera_info"
        yield _received(stamp_ns, topic, "sensor_msgs/msg/CameraInfo", stamped)


def _actor(flight: SimulatedFlight, person: SimulatedPerson) -> Iterator[LoggedMessage]:
    sigma = person.look.estimate_sigma_m
    covariance = np.diag([sigma**2] * 3 + [0.0] * 3)
    for stamp_ns, place in zip(
        (person.estimate_ns + flight.scenario.start_ns).tolist(), person.estimate, strict=True
    ):
        pose = {"position": _xyz(place), "orientation": {"w": 1.0}}
        fields = {
            "header": {"stamp": stamp_ns, "frame_id": "world"},
            "pose": {"pose": pose, "covariance": covariance},
        }
        yield _received(stamp_ns, person.topic, "geometry_msgs/msg/PoseWithCovarianceStamped", fields)


def _xyz(vector: np.ndarray[Any, Any]) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def _xyzw(quaternion: np.ndarray[Any, Any]) -> dict[str, float]:
    return dict(zip("xyzw", quaternion.tolist(), strict=True))
