"""Pictures in logs: their times, and their pixels, as ROS' sensor_msgs/image_encodings.hpp names them."""

from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from pipelines.formats.logs.messages import all_samples
from pipelines.geometry.arrays import Int64, Picture
from pipelines.session.errors import DataError
from pipelines.session.records import PictureSample
from pipelines.session.registries import Log
from pipelines.session.storage import own_table

# Transport and decoding delay a picture by less.
_MAY_LEAP_NS = 1_000_000_000

_PIXELS = own_table(__file__, "pixels")
KNOWN = tuple(_PIXELS)
"""Encodings of raw pictures that can be decoded."""


class Stamps(NamedTuple):
    """Stamps of a picture, without its pixels."""

    stamp_ns: int  # of its header; 0 without one
    receive_ns: int


Stamped = TypeVar("Stamped", PictureSample, Stamps)


def picture_stamps(recording: Log, topic: str, source: Path | str) -> tuple[Int64, Int64]:
    """Return header stamps [N] (0 without one) and stamps of receipt [N] of a topic, in order of receipt."""
    header_ns, receive_ns = array("q"), array("q")
    for sample in all_samples(recording.messages([topic]), source):
        if not isinstance(sample, PictureSample):
            raise DataError(source, f"{topic} holds no pictures", "name another topic", code="no-pictures")
        header_ns.append(sample.stamp_ns)
        receive_ns.append(sample.receive_ns)
    return np.array(header_ns, np.int64), np.array(receive_ns, np.int64)


def later_pictures(pictures: Iterator[Stamped], stamps: str) -> Iterator[Stamped]:
    """Yield the pictures whose stamp is above all before: frame k of a topic is the k-th of these."""
    newest: Stamped | None = None
    leapt: Stamped | None = None
    for picture in pictures:
        if newest is not None:
            if stamp_of(picture, stamps) <= stamp_of(newest, stamps):
                continue
            # One damaged stamp far ahead must not cost all the pictures after it. If the clock was really set
            # forward, the next picture shows the same jump.
            if _leap_ns(newest, picture) > _MAY_LEAP_NS and (
                leapt is None or abs(_leap_ns(leapt, picture)) > _MAY_LEAP_NS
            ):
                leapt = picture
                continue
        newest, leapt = picture, None
        yield picture


def later_times(header_ns: Int64, receive_ns: Int64, stamps: str) -> Int64:
    """Return the stamps of the `later_pictures`, [n], strictly increasing, by header (0: none) or receipt."""
    pictures = map(Stamps, header_ns.tolist(), receive_ns.tolist())
    return np.array([stamp_of(picture, stamps) for picture in later_pictures(pictures, stamps)], np.int64)


def _leap_ns(before: Stamped, after: Stamped) -> int:
    """Return by how much the header clock advanced more than the receipt clock between two pictures, ns."""
    if not before.stamp_ns or not after.stamp_ns:
        return 0
    return (after.stamp_ns - before.stamp_ns) - (after.receive_ns - before.receive_ns)


def stamp_of(picture: PictureSample | Stamps, stamps: str) -> int:
    """Return the header stamp if it exists and is wanted, else the stamp of receipt."""
    return picture.stamp_ns if stamps == "header" and picture.stamp_ns else picture.receive_ns


def is_known(sample: PictureSample) -> bool:
    """Return True if pictures like this one can be decoded; compressed ones must be tried (True)."""
    return sample.width is None or sample.encoding.lower() in _PIXELS


def decode(sample: PictureSample) -> Picture | None:
    """Decode a logged picture to BGR [H, W, 3]; None if its bytes are damaged or its encoding is unknown."""
    try:
        decoded = _compressed(sample) if sample.width is None or sample.height is None else _raw(sample)
    except cv2.error:
        return None
    return decoded


def _compressed(sample: PictureSample) -> Picture | None:
    if not len(sample.data):
        return None
    decoded = cv2.imdecode(np.asarray(sample.data, np.uint8), cv2.IMREAD_COLOR)
    return None if decoded is None else np.asarray(decoded, np.uint8)


def _raw(sample: PictureSample) -> Picture | None:
    width, height = sample.width or 0, sample.height or 0
    if not is_known(sample):
        return None
    pixel, conversion = _PIXELS[sample.encoding.lower()]
    step = sample.step or width * pixel
    if not width or not height or step < width * pixel or len(sample.data) < step * height:
        return None
    rows = sample.data[: step * height].reshape(height, step)
    pixels = np.ascontiguousarray(rows[:, : width * pixel]).reshape(height, width, pixel)
    if not conversion:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}")), np.uint8)
