"""Topics of trigger times of pictures, without the pictures."""

from __future__ import annotations

from array import array

import numpy as np

from pipelines.formats.logs.messages import FAULTS, nanoseconds, unreadable
from pipelines.session.errors import DataError
from pipelines.session.records import Int64
from pipelines.session.registries import Log

TRIGGER_TYPES = (
    "std_msgs/msg/Header",
    "sensor_msgs/msg/TimeReference",
    "mavros_msgs/msg/CameraImageCaptured",
    "mavros_msgs/msg/CamIMUStamp",
)


def read_triggers(recording: Log, source: str, topic: str) -> tuple[Int64, int]:
    """Read the times at which pictures were triggered, increasing, and count messages without a new time.

    The time is the message's own stamp: that of its header, or CamIMUStamp's frame_stamp.

    Raises:
        DataError: a message cannot be read, or none states a time.
    """
    stated = array("q")
    messages = 0
    for message in recording.messages([topic]):
        value = message.value
        messages += 1
        try:
            holder = getattr(value, "header", value)
            stamp = getattr(value, "frame_stamp", None) or holder.stamp
            stated.append(nanoseconds(stamp))
        except FAULTS as error:
            raise unreadable(message, source, error) from error
    t_ns = np.unique(np.frombuffer(stated, dtype=np.int64))
    t_ns = t_ns[t_ns > 0]
    if not len(t_ns):
        raise DataError(source, f"{topic} states no time", "name another topic")
    return t_ns, messages - len(t_ns)
