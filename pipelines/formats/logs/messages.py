"""Conversion of decoded log messages to samples: poses, transforms, gimbal angles, intrinsics and pictures.

Messages of ROS 1 and ROS 2 and Foxglove's schemas have the same content under slightly different names, which
this module alone handles. A sample with `stamp_ns` 0 has only the time of its receipt.
"""

import base64
import operator
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.calibrations.camera_matrices import intrinsics
from pipelines.geometry.arrays import FAR_OFF_CENTRE, Float, Int64, Intrinsics
from pipelines.geometry.clocks import ClockStep, find_steps, fit_clock, without_steps
from pipelines.session.errors import DataError
from pipelines.session.records import (
    AngleSample,
    IntrinsicsSample,
    Message,
    PictureSample,
    PoseSample,
    Sample,
    Topic,
)
from pipelines.session.storage import damaged

Kind = Literal["poses", "transforms", "angles", "intrinsics", "pictures"]
Stamps = Literal["header", "receive"]
Source = Path | str
Edge = tuple[str, str]
"""Target and source of a transform."""

# Larger stamps (after the year 2116) are no times, and their differences would not fit int64.
LATEST_NS = 2**62

_FISHEYE_MODELS = {"equidistant", "fisheye", "kannala_brandt"}
_RADTAN_MODELS = {"plumb_bob", "rational_polynomial", "radtan"}
_NO_MODELS = {"", "none"}  # without distortion

_SIGNATURES = {b"\xff\xd8\xff": "jpeg", b"\x89PNG": "png"}


def kind_of(topic: Topic) -> Kind | None:
    """Return the kind of a topic's messages by their type ("poses" of one body); None if it is not read."""
    known = _READERS.get(topic.type)
    return known[0] if known else None


def samples(message: Message, source: Source) -> Iterator[Sample]:
    """Convert one message to samples.

    A nav_msgs/Path gives every pose at its own stamp. The receive stamp belongs to its last pose; earlier
    ones are earlier by the difference of the stamps. A CameraInfo's K is of the full sensor; region of
    interest and binning are applied, so that the intrinsics are those of the pictures beside it.
    """
    known = _READERS.get(message.topic.type)
    if known is None:
        raise DataError(source, f"topic {message.topic.name} holds {message.topic.type}, which is not read")
    try:
        _checked(message.receive_ns)
        yield from known[1](message, source)
    except FAULTS as error:
        raise unreadable(message, source, error) from error


def all_samples(messages: Iterable[Message], source: Source) -> Iterator[Sample]:
    """Convert many messages to samples, in order; see `samples`.

    A nav_msgs/Path repeats earlier paths and adds to them. Of each only the poses later than all before on
    its topic are given: as they were first published, whatever a loop closure moves later.
    """
    newest: dict[str, int] = {}
    for message in messages:
        if message.topic.type != _PATH:
            yield from samples(message, source)
            continue
        for sample in samples(message, source):
            if sample.stamp_ns > newest.get(message.topic.name, -LATEST_NS):
                newest[message.topic.name] = sample.stamp_ns
                yield sample


FAULTS = (AttributeError, TypeError, ValueError, OverflowError)
"""Exceptions from reading a message with a missing field or with a value of another type."""


def unreadable(message: Message, source: Source, error: Exception) -> DataError:
    """Return the error for a message that raised one of `FAULTS`."""
    topic = message.topic
    problem = f"cannot be read ({error})"
    if isinstance(error, AttributeError):
        problem = f"lacks the field {error.name!r}"
    return damaged(source, f"topic {topic.name}: a message of type {topic.type} {problem}")


# --- poses, transforms, gimbal angles ------------------------------------------------------------------


def _pose(message: Message, _: Source) -> Iterator[Sample]:
    """Yield the pose of a Pose, PoseStamped, PoseWithCovariance(Stamped), Odometry or PoseInFrame."""
    value = pose = message.value
    covariance = getattr(value, "covariance", None)
    while hasattr(pose, "pose"):
        pose = pose.pose
        covariance = getattr(pose, "covariance", covariance)
    header = getattr(value, "header", None)
    frame = value.frame_id if _is_foxglove(message) else header.frame_id if header is not None else ""
    yield PoseSample(
        _stamp_ns(message) if header is not None or _is_foxglove(message) else 0,
        message.receive_ns,
        str(frame),
        str(getattr(value, "child_frame_id", "")),
        _vector(pose.position),
        _quaternion(pose.orientation),
        None if covariance is None else np.asarray(covariance, dtype=np.float64).reshape(6, 6),
    )


def _path(message: Message, source: Source) -> Iterator[Sample]:
    stamps = [nanoseconds(pose.header.stamp) for pose in message.value.poses]
    if 0 in stamps:
        problem = f"topic {message.topic.name}: the poses of a path have no stamps of their own"
        raise DataError(source, problem, "name a topic of Odometry or PoseStamped instead")
    for pose, stamp_ns in zip(message.value.poses, stamps, strict=True):
        receive_ns = _checked(message.receive_ns + stamp_ns - stamps[-1])
        yield from _pose(replace(message, receive_ns=receive_ns, value=pose), source)


def _transforms(message: Message, _: Source) -> Iterator[Sample]:
    """Yield the transforms of a message, or the only one that it is."""
    for stated in getattr(message.value, "transforms", (message.value,)):
        if _is_foxglove(message):
            stamp, frame, moved = stated.timestamp, stated.parent_frame_id, stated
        else:
            stamp, frame, moved = stated.header.stamp, stated.header.frame_id, stated.transform
        yield PoseSample(
            nanoseconds(stamp),
            message.receive_ns,
            str(frame),
            str(stated.child_frame_id),
            _vector(moved.translation),
            _quaternion(moved.rotation),
        )


def _angles(message: Message, _: Source) -> Iterator[Sample]:
    """Yield the angles of a Vector3Stamped, or the rotation of a Quaternion or QuaternionStamped."""
    value = message.value
    stamp_ns = _stamp_ns(message) if hasattr(value, "header") else 0
    if hasattr(value, "vector"):
        yield AngleSample(stamp_ns, message.receive_ns, _vector(value.vector), None)
    else:
        turned = _quaternion(getattr(value, "quaternion", value))
        yield AngleSample(stamp_ns, message.receive_ns, None, turned)


# --- intrinsics ----------------------------------------------------------------------------------------


def _camera_info(message: Message, source: Source) -> Iterator[Sample]:
    value = message.value
    # ROS 1, and Foxglove outside ROS 2, write the matrices in capitals.
    stated_matrix, stated_distortion = (value.k, value.d) if hasattr(value, "k") else (value.K, value.D)
    matrix = np.asarray(stated_matrix, dtype=np.float64).reshape(3, 3)
    distortion = np.asarray(stated_distortion, dtype=np.float64).tolist()
    stamp_ns, lens, note = _stamp_ns(message), None, ""
    if matrix[0, 0] and matrix[1, 1]:
        lens, note = _lens(message, source, matrix, distortion)
    yield IntrinsicsSample(stamp_ns, message.receive_ns, lens, note)


def _lens(message: Message, source: Source, matrix: Float, distortion: list[float]) -> tuple[Intrinsics, str]:
    """Return the intrinsics of the pictures beside a CameraInfo, and a note."""
    # Some drivers state binning with a K of the binned pictures: then its principal point is in their middle.
    value, topic = message.value, message.topic.name
    model = value.distortion_model.lower()
    known = _FISHEYE_MODELS | _RADTAN_MODELS
    if model not in known and (model not in _NO_MODELS or any(distortion)):
        problem = (
            f"topic {topic}: its distortion model {value.distortion_model!r} is none of"
            f" {', '.join(sorted(known))}"
        )
        raise DataError(source, problem, "give a calibration file under `intrinsics`")
    full = intrinsics(
        source,
        topic,
        size=(value.width, value.height),
        matrix=matrix,
        distortion=distortion,
        fisheye=model in _FISHEYE_MODELS,
    )
    binned = _of_the_picture(full, value)
    undivided = replace(full, width=binned.width, height=binned.height)
    if binned.off_centre > FAR_OFF_CENTRE >= undivided.off_centre:
        size = f"{binned.width} x {binned.height} px"
        return undivided, f"topic {topic}: its K is of the binned {size} already, by its principal point"
    return binned, ""


def _of_the_picture(full: Intrinsics, value: Any) -> Intrinsics:
    """Cut the sensor's intrinsics to the region of interest, then bin them (sensor_msgs/CameraInfo)."""
    bin_x, bin_y = max(getattr(value, "binning_x", 0), 1), max(getattr(value, "binning_y", 0), 1)
    region = getattr(value, "roi", None)
    if region is None or not region.width or not region.height:  # zero means the whole sensor
        left, top, width, height = 0, 0, full.width, full.height
    else:
        left, top, width, height = region.x_offset, region.y_offset, region.width, region.height
    if left < 0 or top < 0 or left + width > full.width or top + height > full.height:
        raise ValueError(
            f"its region of interest {width} x {height} at {left}, {top} leaves the sensor's"
            f" {full.width} x {full.height}"
        )
    return replace(
        full,
        width=width // bin_x,
        height=height // bin_y,
        fx=full.fx / bin_x,
        fy=full.fy / bin_y,
        cx=(full.cx - left) / bin_x,
        cy=(full.cy - top) / bin_y,
    )


# --- pictures ------------------------------------------------------------------------------------------


def _compressed_image(message: Message, _: Source) -> Iterator[Sample]:
    data = bytes_of(message.value.data)
    encoding = _codec(data, str(getattr(message.value, "format", "")))
    yield PictureSample(_stamp_ns(message), message.receive_ns, encoding, None, None, None, data)


def _codec(data: NDArray[np.uint8], stated: str) -> str:
    """Return the codec by the first bytes; `stated` may be "jpeg", "bgr8; jpeg compressed bgr8" or empty."""
    start = data[:4].tobytes()
    for signature, name in _SIGNATURES.items():
        if start.startswith(signature):
            return name
    return stated.lower()


def _image(message: Message, _: Source) -> Iterator[Sample]:
    value = message.value
    yield PictureSample(
        stamp_ns=_stamp_ns(message),
        receive_ns=message.receive_ns,
        encoding=str(value.encoding),
        width=operator.index(value.width),
        height=operator.index(value.height),
        step=operator.index(value.step),
        data=bytes_of(value.data),
    )


# --- fields --------------------------------------------------------------------------------------------


def _is_foxglove(message: Message) -> bool:
    return message.topic.type.startswith("foxglove")


def _stamp_ns(message: Message) -> int:
    value = message.value
    return nanoseconds(value.timestamp if _is_foxglove(message) else value.header.stamp)


def header_ns(message: Message) -> int:
    """Return the stamp that a message of any type has of its own (the first transform's); 0 without one."""
    value = message.value
    stated = next(iter(getattr(value, "transforms", ())), value)
    stamp = getattr(getattr(stated, "header", None), "stamp", None) or getattr(stated, "timestamp", None)
    try:
        return 0 if stamp is None else nanoseconds(stamp)
    except FAULTS:
        return 0


def nanoseconds(stamp: Any) -> int:
    """Convert a stamp to ns: ROS (sec, nanosec), protobuf (seconds, nanos), Foxglove's JSON (sec, nsec)."""
    if hasattr(stamp, "seconds"):
        whole, fraction = stamp.seconds, stamp.nanos
    elif hasattr(stamp, "nanosec"):
        whole, fraction = stamp.sec, stamp.nanosec
    else:
        whole, fraction = stamp.sec, stamp.nsec
    return _checked(operator.index(whole) * 1_000_000_000 + operator.index(fraction))


def _checked(stamp_ns: int) -> int:
    if abs(stamp_ns) >= LATEST_NS:
        raise ValueError(f"its stamp of {stamp_ns // 1_000_000_000} s is no time")
    return stamp_ns


def _vector(value: Any) -> tuple[float, float, float]:
    return float(value.x), float(value.y), float(value.z)


def _quaternion(value: Any) -> tuple[float, float, float, float]:
    return float(value.x), float(value.y), float(value.z), float(value.w)


def bytes_of(data: Any) -> NDArray[np.uint8]:
    """Return data as an array of bytes: arrays as views, base64 (JSON) decoded."""
    if isinstance(data, np.ndarray):
        if data.dtype.itemsize != 1:
            raise ValueError(f"its data are {data.dtype}, not bytes")
        return data.view(np.uint8)
    if isinstance(data, str):
        data = base64.b64decode(data, validate=True)
    if isinstance(data, list):
        data = bytes(data)
    return np.frombuffer(data, dtype=np.uint8)


_Reader = Callable[[Message, Source], Iterator[Sample]]
_PATH = "nav_msgs/msg/Path"

_ROS_READERS: dict[str, tuple[Kind, _Reader]] = {
    "geometry_msgs/msg/Pose": ("poses", _pose),
    "geometry_msgs/msg/PoseStamped": ("poses", _pose),
    "geometry_msgs/msg/PoseWithCovariance": ("poses", _pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("poses", _pose),
    "geometry_msgs/msg/Quaternion": ("angles", _angles),
    "geometry_msgs/msg/QuaternionStamped": ("angles", _angles),
    "geometry_msgs/msg/TransformStamped": ("poses", _transforms),
    "geometry_msgs/msg/Vector3Stamped": ("angles", _angles),
    "nav_msgs/msg/Odometry": ("poses", _pose),
    _PATH: ("poses", _path),
    "sensor_msgs/msg/CameraInfo": ("intrinsics", _camera_info),
    "sensor_msgs/msg/CompressedImage": ("pictures", _compressed_image),
    "sensor_msgs/msg/Image": ("pictures", _image),
    "tf/msg/tfMessage": ("transforms", _transforms),
    "tf2_msgs/msg/TFMessage": ("transforms", _transforms),
}
_FOXGLOVE_READERS: dict[str, tuple[Kind, _Reader]] = {
    "CameraCalibration": ("intrinsics", _camera_info),
    "CompressedImage": ("pictures", _compressed_image),
    "FrameTransform": ("transforms", _transforms),
    "FrameTransforms": ("transforms", _transforms),
    "PoseInFrame": ("poses", _pose),
    "RawImage": ("pictures", _image),
}
_READERS: dict[str, tuple[Kind, _Reader]] = {
    **_ROS_READERS,
    **{f"foxglove.{name}": reader for name, reader in _FOXGLOVE_READERS.items()},
    **{f"foxglove_msgs/msg/{name}": reader for name, reader in _FOXGLOVE_READERS.items()},
}


# --- numbers of one body -------------------------------------------------------------------------------

# Transport and decoding take less than this between the header and the receive stamp.
_MAY_DISAGREE_S = 0.5
# A clock that jumps by more between two messages is named.
_MAY_JUMP_S = 1.0
# More jumps than this are counted and not listed.
_MOST_JUMPS = 5


@dataclass(frozen=True)
class LoggedRows:
    """Numbers of one body as logged, in the order of receipt, with both stamps of each row."""

    header_ns: Int64  # [N]; 0 without one
    receive_ns: Int64  # [N]
    values: Float  # [N, W]; of poses position, then quaternion xyzw
    covariance: Float | None = None  # [N, 36], for poses that have one
    frames: Edge = ("", "")  # as the log names them; empty if it names none

    @cached_property
    def steps(self) -> list[ClockStep]:
        """Steps of the header's clock."""
        return find_steps(self.header_ns, self.receive_ns)

    def times(self, stamps: Stamps) -> Int64:
        """Return the stamps asked for [N], without steps; without a header stamp, that of receipt."""
        if stamps == "receive":
            return self.receive_ns
        header_ns = without_steps(self.header_ns, self.steps)
        return np.where(header_ns == 0, self.receive_ns, header_ns)

    def notes(self, place: Source, stamps: Stamps) -> list[str]:
        """Describe steps of the header's clock that are used, and how header and receipt disagree."""
        notes = [str(step) for step in self.steps if stamps == "header"]
        (stamped,) = np.nonzero(self.header_ns)
        used = f"{stamps} stamps are used"
        if without := len(self.header_ns) - len(stamped):
            notes.append(
                f"{without} of {len(self.header_ns)} messages have no header stamp, their time of receipt is"
                " taken"
            )
        header_ns, receive_ns = without_steps(self.header_ns, self.steps)[stamped], self.receive_ns[stamped]
        lead_s = (header_ns - receive_ns) / 1e9
        if disagreeing := int(np.count_nonzero(np.abs(lead_s) > _MAY_DISAGREE_S)):
            largest_s = float(lead_s[np.argmax(np.abs(lead_s))])
            notes.append(
                f"header and receive stamps disagree by up to {largest_s:.3g} s in"
                f" {disagreeing} of {len(self.header_ns)} messages; {used}"
            )
        jumps_s = np.diff(lead_s)
        jumps = np.flatnonzero(np.abs(jumps_s) > _MAY_JUMP_S)[:_MOST_JUMPS].tolist()
        notes += [
            f"the clock jumps by {jumps_s[k]:.3g} s at {header_ns[k + 1] / 1e9:.3f} s; {used}" for k in jumps
        ]
        drift = fit_clock(receive_ns, header_ns) if lead_s.any() and not jumps else None
        if drift is not None and drift.drift_ppm:
            notes.append(
                f"header stamps drift {drift.drift_ppm:.1f} ppm (+- {drift.drift_sigma_ppm:.1g}) against"
                f" those of receipt; {used}, not corrected (logs: clock: drift_ppm does)"
            )
        return [f"{place}: {note}" for note in notes]


class Samples:
    """Samples of one body, gathered into flat arrays."""

    def __init__(self) -> None:
        self._header_ns = array("q")
        self._receive_ns = array("q")
        self._values = array("d")
        self._covariances = array("d")

    def add(self, header_ns: int, receive_ns: int, values: Iterable[float]) -> None:
        """Add one sample; the number of values must always be the same."""
        self._header_ns.append(header_ns)
        self._receive_ns.append(receive_ns)
        self._values.extend(values)

    def add_pose(self, pose: PoseSample) -> None:
        """Add one pose; either all poses have a covariance or none."""
        self.add(pose.stamp_ns, pose.receive_ns, pose.position + pose.quaternion_xyzw)
        if pose.covariance is not None:
            self._covariances.frombytes(pose.covariance.tobytes())

    def rows(self, width: int) -> LoggedRows:
        """Return the rows, with `width` values each."""
        return LoggedRows(
            header_ns=np.frombuffer(self._header_ns, dtype=np.int64),
            receive_ns=np.frombuffer(self._receive_ns, dtype=np.int64),
            values=np.frombuffer(self._values, dtype=np.float64).reshape(-1, width),
            covariance=np.frombuffer(self._covariances, dtype=np.float64).reshape(-1, 36),
        )
