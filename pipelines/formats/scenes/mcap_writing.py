"""Export to mcap: one log of ROS 2 messages for Foxglove.

| topic | type | |
| --- | --- | --- |
| /skeleton, /uncertainty | visualization_msgs/MarkerArray | bones and joints; 95 % ellipsoids at 10 Hz |
| /angles, /angles/sigma | sensor_msgs/JointState | angles of the joints and their standard deviations, rad |
| /sigma | sensor_msgs/JointState | standard deviations of the joints, per axis, m, in the field `position` |
| /doubts | rcl_interfaces/Log | what contradicts itself in the flight, as warnings at the beginning |
| /tf | tf2_msgs/TFMessage | the cameras in `world`, at most 50 times a second |
| /CAMERA/path | nav_msgs/Path | the camera's path, at most 10 poses a second, written once |
| /CAMERA/camera_info | sensor_msgs/CameraInfo | with every picture, else every second: the frustum |
| /CAMERA/image/video | foxglove_msgs/CompressedVideo | H.264, at most 960 px wide |
| /map | sensor_msgs/PointCloud2 | the middles of the map's surface voxels |

World axes as in the session, cameras with x right, y down, z forward. Poses are the refined ones if there are
any. The same recording gives the same bytes; frames are never all in memory.
"""

import heapq
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from pipelines.formats.common.exporting import (
    ellipsoids_95,
    note_no_skeleton,
    safe_file_name,
    shown_surface,
    thinned,
)
from pipelines.formats.videos.video_writing import H264Stream
from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import camera_info, rescaled
from pipelines.session.errors import DataError
from pipelines.session.people import bones_of, side_of, with_derived
from pipelines.session.records import JointMotion, Recording, Trajectory

# Foxglove loads chunks of this size quickly.
_CHUNK_BYTES = 1 << 20
_STAMPS = {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}
_COMPRESSED_VIDEO = """\
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
"""
"""Foxglove's schema (foxglove_msgs/CompressedVideo), which ROS 2 itself does not have."""
_BYTES = {"bool": "bool", "byte": "uint8", "char": "uint8", "octet": "uint8"}


class Ros2Recording(AbstractContextManager["Ros2Recording"]):
    """Log that is being written; a context manager. The same messages give the same bytes."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._store.register(get_types_from_msg(_COMPRESSED_VIDEO, "foxglove_msgs/msg/CompressedVideo"))
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="mocap")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call]  # left without annotations there
        finally:
            self._file.close()

    def write(self, topic: str, type_: str, receive_ns: int, fields: Mapping[str, Any]) -> None:
        """Add a message of a type in the spelling of ROS 2 (nav_msgs/msg/Odometry), in the order of receipt.

        `fields` are all that are not zero; a stamp is a plain number of nanoseconds.
        """
        data = bytes(self._store.serialize_cdr(build(self._store, type_, fields), type_))
        number = self._sequence.get(topic, 0)
        self._sequence[topic] = number + 1
        self._writer.add_message(
            self._channel(topic, type_), receive_ns, data, publish_time=receive_ns, sequence=number
        )

    def _channel(self, topic: str, type_: str) -> int:
        if topic not in self._channels:
            if type_ not in self._schemas:
                definition = self._store.generate_msgdef(type_, ros_version=2)[0].encode()
                self._schemas[type_] = self._writer.register_schema(type_, "ros2msg", definition)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[type_])
        return self._channels[topic]


def build(store: Typestore, type_: str, fields: Mapping[str, Any]) -> Any:
    """Build a message of a ROS 2 type; `fields` are all that are not zero, stamps plain nanoseconds."""
    if type_ in _STAMPS:
        raise TypeError("stamps are plain numbers")
    _, described = store.fielddefs[type_]
    # ROS 1 spells CameraInfo's d, k, r and p in capitals.
    values = [_value(store, kind, fields.get(name, fields.get(name.lower()))) for name, kind in described]
    return store.types[type_](*values)


def _value(store: Typestore, kind: Any, given: Any) -> Any:
    if kind[0] == Nodetype.NAME:
        if kind[1] in _STAMPS:
            return store.types[kind[1]](*divmod(given or 0, 10**9))
        return build(store, kind[1], given or {})
    if kind[0] == Nodetype.BASE:
        return given if given is not None else ("" if kind[1][0] == "string" else 0)
    (inner, name), length = kind[1]
    if inner == Nodetype.NAME:
        return [build(store, name, item) for item in given or [{}] * length]
    if name[0] == "string":
        return list(given or [""] * length)
    dtype = _BYTES.get(name[0], name[0])
    if isinstance(given, bytes):
        return np.frombuffer(given, dtype)
    return np.zeros(length, dtype) if given is None else np.asarray(given, dtype).ravel()


_TF_HZ, _ELLIPSOIDS_HZ, _PATH_HZ, _STANDING_HZ = 50.0, 10.0, 10.0, 1.0
# Stamps of ROS count seconds in 31 bits.
_LATEST_NS = (1 << 31) * 10**9
_LINE_LIST, _SPHERE, _SPHERE_LIST = 5, 2, 7
_DELETE_ALL = {"header": {"frame_id": "world"}, "action": 3}
_COLOURS = {"left": (0.35, 0.72, 0.96), "right": (1.0, 0.62, 0.36), "": (0.87, 0.89, 0.90)}
# PointField means float32 by this number.
_FLOAT32 = 7
# A message of rcl_interfaces/Log means a warning by this number.
_WARNING = 30

Entry = tuple[int, str, str, Mapping[str, Any]]  # time, topic, type, fields


class McapExport:
    """Writer of `<name>.mcap`: skeleton, uncertainty, series of angles and sigmas, doubts, cameras, map."""

    name = "mcap"
    title = "a log of ROS 2 messages to look at in Foxglove: skeleton, cameras, map, pictures"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write all parts of the recording; drop and count rows from before 1970."""
        tracks = {name: _countable(recording, name, track) for name, track in recording.tracks.items()}
        tracks = {name: track for name, track in tracks.items() if len(track.t_ns)}
        motion = recording.motion
        times = [track.t_ns for track in tracks.values()] + ([motion.t_ns] if motion is not None else [])
        if not times:
            raise DataError(recording.name, "holds neither joints nor camera poses", "reconstruct it first")
        note_no_skeleton(recording, self.name)
        start_ns, end_ns = min(int(t[0]) for t in times), max(int(t[-1]) for t in times)
        if start_ns < 0 or end_ns >= _LATEST_NS:
            problem = "has times outside of 1970 to 2038, which ROS cannot count"
            raise DataError(recording.name, problem, "export csv")
        topics = topics_of(list(tracks))
        streams = [_map(recording, start_ns), _doubts(recording, start_ns)]
        for name, track in tracks.items():
            lens = recording.lenses.get(name)
            streams += [_path(topics[name], track, start_ns), _transforms(name, track)]
            if lens is not None:
                streams.append(_pictures(recording, name, topics[name], lens, (start_ns, end_ns)))
        if motion is not None:
            streams += [_skeleton(motion), _uncertainty(motion), _sigmas(recording, motion)]
            recording.progress.start("Writing mcap", len(motion.t_ns))
        streams.append(_angles(recording, (start_ns, end_ns)))
        path = folder / f"{safe_file_name(recording.name)}.mcap"
        with Ros2Recording(path) as log:
            for stamp_ns, topic, type_, fields in heapq.merge(*streams, key=lambda entry: entry[0]):
                log.write(topic, type_, stamp_ns, fields)
                if topic == "/skeleton":
                    recording.progress.advance()
        return [path]


def _countable(recording: Recording, name: str, track: Trajectory) -> Trajectory:
    """Drop rows from before time 0: logs without a time of day may begin before their first picture."""
    early = int(np.count_nonzero(track.t_ns < 0))
    if not early:
        return track
    recording.progress.note(f"mcap: {early} poses of {name} from before time 0 were left out")
    return Trajectory(track.t_ns[early:], track.position[early:], track.quaternion_xyzw[early:])


def topics_of(cameras: list[str]) -> dict[str, str]:
    """Return a valid ROS topic name for each camera, without duplicates."""
    topics: dict[str, str] = {}
    for name in cameras:
        word = re.sub(r"[^A-Za-z0-9_]", "_", name)
        word = word if word[:1].isalpha() else f"camera_{word}"
        while f"/{word}" in topics.values():
            word += "_"
        topics[name] = f"/{word}"
    return topics


# --- the person ----------------------------------------------------------------------------------------


def _skeleton(motion: JointMotion) -> Iterator[Entry]:
    joints, position = with_derived(motion.joints, motion.position)
    bones = [(joints.index(a), joints.index(b), a) for a, b in bones_of(joints)]
    for t_ns, people in zip(motion.t_ns.tolist(), position, strict=True):
        header = {"stamp": t_ns, "frame_id": "world"}
        markers: list[Mapping[str, Any]] = [_DELETE_ALL]
        for person, body in enumerate(people):
            known = np.isfinite(body).all(axis=1)
            whole = [(a, b, name) for a, b, name in bones if known[a] and known[b]]
            if not known.any():
                continue
            common = {"header": header, "id": person, "pose": _POSE}
            if whole:
                ends = np.array([[a, b] for a, b, _ in whole]).ravel()
                sides = [_colour(name) for _, _, name in whole for _ in range(2)]
                markers.append(
                    common
                    | {"ns": "bones", "type": _LINE_LIST, "scale": {"x": 0.02}, "color": {"a": 1.0}}
                    | {"points": _points(body[ends]), "colors": sides}
                )
            size = {"x": 0.05, "y": 0.05, "z": 0.05}
            colours = [_colour(name) for name, there in zip(joints, known, strict=True) if there]
            markers.append(
                common
                | {"ns": "joints", "type": _SPHERE_LIST, "scale": size, "color": {"a": 1.0}}
                | {"points": _points(body[known]), "colors": colours}
            )
        yield t_ns, "/skeleton", "visualization_msgs/msg/MarkerArray", {"markers": markers}


def _uncertainty(motion: JointMotion) -> Iterator[Entry]:
    if motion.covariance is None:
        return
    for row in thinned(motion.t_ns, _ELLIPSOIDS_HZ).tolist():
        t_ns = int(motion.t_ns[row])
        half, turn = ellipsoids_95(motion.covariance[row])
        markers: list[Mapping[str, Any]] = [_DELETE_ALL]
        joints = len(motion.joints)
        for person, joint in np.argwhere(np.isfinite(half[..., 0])).tolist():
            at = motion.position[row, person, joint]
            if np.isfinite(at).all():
                markers.append(
                    {
                        "header": {"stamp": t_ns, "frame_id": "world"},
                        "ns": "ellipsoids_95",
                        "id": person * joints + joint,
                        "type": _SPHERE,
                        "pose": {"position": _xyz(at), "orientation": _xyzw(turn[person, joint])},
                        "scale": _xyz(2 * half[person, joint]),
                        "color": _colour(motion.joints[joint], 0.3),
                    }
                )
        yield t_ns, "/uncertainty", "visualization_msgs/msg/MarkerArray", {"markers": markers}


# --- series: JointState, which Foxglove, PlotJuggler and rqt plot by the names in it ---------------------


def _labels(recording: Recording, names: Sequence[str], people: Sequence[int]) -> list[str]:
    """Label series: those of other people than the first begin with the person's name."""
    return [
        f"{recording.name_of(person)}/{name}" if person else name
        for name, person in zip(names, people, strict=True)
    ]


def _series(t_ns: int, topic: str, labels: Sequence[str], values: Sequence[float]) -> Entry:
    fields = {"header": {"stamp": t_ns, "frame_id": ""}, "name": list(labels), "position": list(values)}
    return t_ns, topic, "sensor_msgs/msg/JointState", fields


def _sigmas(recording: Recording, motion: JointMotion) -> Iterator[Entry]:
    """Yield the standard deviation of each joint that has one: the root mean square of its three axes'."""
    if motion.covariance is None:
        return
    for t_ns, covariance, at in zip(motion.t_ns.tolist(), motion.covariance, motion.position, strict=True):
        sigma = np.sqrt(covariance[..., [0, 3, 5]].mean(axis=-1))  # xx, yy, zz
        person, joint = np.nonzero(np.isfinite(sigma) & np.isfinite(at).all(axis=-1))
        names = [motion.joints[k] for k in joint.tolist()]
        labels = _labels(recording, names, person.tolist())
        yield _series(t_ns, "/sigma", labels, sigma[person, joint].tolist())


def _angles(recording: Recording, span_ns: tuple[int, int]) -> Iterator[Entry]:
    """Yield the angles that are known and their standard deviations, in rad as JointState asks for."""
    table = recording.angles()
    if table is None:
        return
    known = table[np.isfinite(table["value_deg"]) & table["t_ns"].between(*span_ns)]
    for t_ns, rows in known.groupby("t_ns", sort=True):
        names, people = rows["angle"].tolist(), rows["person"].tolist()
        labels = _labels(recording, names, people)
        for topic, column in (("/angles", "value_deg"), ("/angles/sigma", "sigma_deg")):
            yield _series(int(t_ns), topic, labels, np.radians(rows[column].to_numpy()).tolist())


def _doubts(recording: Recording, start_ns: int) -> Iterator[Entry]:
    for text in recording.doubts():
        fields = {"stamp": start_ns, "level": _WARNING, "name": "mocap", "msg": text}
        yield start_ns, "/doubts", "rcl_interfaces/msg/Log", fields


# --- the cameras ---------------------------------------------------------------------------------------


def _transforms(name: str, track: Trajectory) -> Iterator[Entry]:
    for row in thinned(track.t_ns, _TF_HZ).tolist():
        t_ns = int(track.t_ns[row])
        moved = {
            "header": {"stamp": t_ns, "frame_id": "world"},
            "child_frame_id": name,
            "transform": {
                "translation": _xyz(track.position[row]),
                "rotation": _xyzw(track.quaternion_xyzw[row]),
            },
        }
        yield t_ns, "/tf", "tf2_msgs/msg/TFMessage", {"transforms": [moved]}


def _path(topic: str, track: Trajectory, start_ns: int) -> Iterator[Entry]:
    poses = [
        {
            "header": {"stamp": int(track.t_ns[row]), "frame_id": "world"},
            "pose": {"position": _xyz(track.position[row]), "orientation": _xyzw(track.quaternion_xyzw[row])},
        }
        for row in thinned(track.t_ns, _PATH_HZ).tolist()
    ]
    fields = {"header": {"stamp": start_ns, "frame_id": "world"}, "poses": poses}
    yield start_ns, f"{topic}/path", "nav_msgs/msg/Path", fields


def _pictures(
    recording: Recording, name: str, topic: str, lens: Intrinsics, span_ns: tuple[int, int]
) -> Iterator[Entry]:
    """Yield pictures with their CameraInfo; without pictures the CameraInfo alone, every second."""
    is_empty = True
    stream = H264Stream()
    for t_ns, picture in recording.pictures(name):
        if span_ns[0] <= t_ns <= span_ns[1]:
            unit, _ = stream.encode(picture)
            yield _info(t_ns, name, topic, rescaled(lens, *stream.size))
            video = {"timestamp": t_ns, "frame_id": name, "format": "h264", "data": unit}
            yield t_ns, f"{topic}/image/video", "foxglove_msgs/msg/CompressedVideo", video
            is_empty = False
    if is_empty:
        for t_ns in range(span_ns[0], span_ns[1] + 1, round(1e9 / _STANDING_HZ)):
            yield _info(t_ns, name, topic, lens)


def _info(t_ns: int, name: str, topic: str, lens: Intrinsics) -> Entry:
    fields = {"header": {"stamp": t_ns, "frame_id": name}, **camera_info(lens)}
    return t_ns, f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo", fields


# --- the map -------------------------------------------------------------------------------------------


def _map(recording: Recording, start_ns: int) -> Iterator[Entry]:
    for occupancy in recording.maps():
        surface = shown_surface(recording, occupancy, "mcap")
        stamp_ns = max(occupancy.from_ns, start_ns)
        yield (
            stamp_ns,
            "/map",
            "sensor_msgs/msg/PointCloud2",
            {
                "header": {"stamp": stamp_ns, "frame_id": "world"},
                "height": 1,
                "width": len(surface.middle),
                "fields": [
                    {"name": axis, "offset": 4 * k, "datatype": _FLOAT32, "count": 1}
                    for k, axis in enumerate("xyz")
                ],
                "point_step": 12,
                "row_step": 12 * len(surface.middle),
                "data": surface.middle.astype("<f4").tobytes(),
                "is_dense": True,
            },
        )


# --- pieces --------------------------------------------------------------------------------------------

_POSE = {"orientation": {"w": 1.0}}


def _xyz(point: Float) -> dict[str, float]:
    return dict(zip("xyz", point.tolist(), strict=True))


def _xyzw(quaternion: Float) -> dict[str, float]:
    return dict(zip("xyzw", quaternion.tolist(), strict=True))


def _points(points: Float) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": z} for x, y, z in points.tolist()]


def _colour(joint: str, alpha: float = 1.0) -> dict[str, float]:
    return {**dict(zip("rgb", _COLOURS[side_of(joint)], strict=True)), "a": alpha}


EXPORT = McapExport()
