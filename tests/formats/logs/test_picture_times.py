"""Pictures read from their bytes equal decoded ones; unusual ones are left to the decoder."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.formats.logs.pictures import (
    later_pictures,
    later_times,
    stamp_of,
)
from pipelines.geometry.arrays import Int64
from pipelines.session.records import PictureSample
from tests.synthetic.logs import Entry

TOPIC = "/pictures"
COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
START_NS = 1_700_000_000_000_000_000


def fields(k: int, **others: Any) -> dict[str, Any]:
    rng = np.random.default_rng(k)
    data = rng.integers(0, 256, 24 + k, dtype=np.uint8)
    data[:3] = (0xFF, 0xD8, 0xFF)
    return {
        "header": {"stamp": START_NS + k, "frame_id": "camera"},
        "format": "JPEG",
        "height": 3,
        "width": 2 + k,
        "encoding": "bgr8",
        "step": 8,
        "data": data,
    } | others


def alike(k: int, received_ns: int) -> Entry:
    """Make a picture that differs from the others only in stamp and pixels, as those of a camera do."""
    stated = fields(0, header={"stamp": START_NS + k, "frame_id": "camera"})
    return Entry(TOPIC, COMPRESSED, received_ns, stated)


def stamps_of(arrays: tuple[Int64, Int64]) -> list[tuple[int, int]]:
    header_ns, receive_ns = arrays
    return list(zip(header_ns.tolist(), receive_ns.tolist(), strict=True))


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12),
    st.sampled_from(["header", "receive"]),
)
def test_later_times_are_those_of_the_later_pictures(rows: list[tuple[int, int]], stamps: str) -> None:
    """Draw seconds that repeat, go back, leap or are missing (0), or increase as those of a camera do."""
    rows = rows if len(rows) > 3 else [(k + 1, k + 1) for k in range(len(rows))]
    header_ns, receive_ns = (np.array([r[i] for r in rows], np.int64) * 10**9 for i in range(2))
    samples = [
        PictureSample(int(h), int(r), "jpeg", None, None, None, np.zeros(1, np.uint8))
        for h, r in zip(header_ns, receive_ns, strict=True)
    ]
    expected = [stamp_of(picture, stamps) for picture in later_pictures(iter(samples), stamps)]
    assert later_times(header_ns, receive_ns, stamps).tolist() == expected
