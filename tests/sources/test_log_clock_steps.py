"""A clock that steps in flight: poses, pictures and positions of a log stay at the right times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.presets import read_pair
from pipelines.session.manifest import LogSource, Manifest
from pipelines.session.registries import LogFormat, recognise
from pipelines.sources.logs import FlightLogs
from tests.synthetic.logs import Entry, write_log

EPOCH_NS, INTERVAL_NS, DELAY_NS, STEP_AT = 1_700_000_000_000_000_000, 50_000_000, 4_000_000, 60
TIMES_NS = EPOCH_NS + INTERVAL_NS * np.arange(120)
TYPES = {
    "/pose": "geometry_msgs/msg/PoseStamped",
    "/pictures": "sensor_msgs/msg/CompressedImage",
    "/point": "geometry_msgs/msg/PointStamped",
    "/turned": "geometry_msgs/msg/QuaternionStamped",
}


def entries(step_ns: int) -> list[Entry]:
    logged = []
    for k, t_ns in enumerate(TIMES_NS.tolist()):
        header = {"stamp": t_ns + (step_ns if k >= STEP_AT else 0), "frame_id": "map"}
        place, turned = {"x": 0.1 * k, "y": 0.0, "z": 5.0}, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        contents: dict[str, dict[str, Any]] = {
            "/pose": {"pose": {"position": place, "orientation": turned}},
            "/pictures": {"format": "jpeg", "data": np.array([0xFF, 0xD8, 0xFF], np.uint8)},
            "/point": {"point": place},
            "/turned": {"quaternion": turned},
        }
        logged += [
            Entry(topic, TYPES[topic], t_ns + DELAY_NS, {"header": header, **fields})
            for topic, fields in contents.items()
        ]
    return logged


@pytest.mark.parametrize("step_ns", [-800_000_000, -100_000_000, 100_000_000, 450_000_000])
def test_what_a_stepping_clock_stamped_is_at_the_right_times(tmp_path: Path, step_ns: int) -> None:
    log = write_log(tmp_path, "log", "mcap-cdr", entries(step_ns))
    camera = {"pose": {"file": "a", "topic": "/pose"}, "intrinsics": "x", "keypoints": "y"}
    notes: list[str] = []
    stated = {"schema": 1, "cameras": {"c": camera}, "logs": {"a": LogSource(file=[log.name])}}
    with FlightLogs(Manifest.model_validate(stated), tmp_path, notes.append) as logs:
        poses = logs.trajectory("a", "/pose", None, None, max_gap_ns=10**9)
        pictures = logs.frames("a", "/pictures")
    np.testing.assert_array_equal(poses.t_ns, TIMES_NS)
    np.testing.assert_allclose(poses.position[:, 0], 0.1 * np.arange(120), atol=1e-12)
    assert poses.dropped == {}
    # Pictures are numbered by their own stamps, so those that a step back repeats stay left out.
    repeated = -step_ns // INTERVAL_NS if step_ns < 0 else 0
    expected = np.delete(TIMES_NS, np.arange(STEP_AT, STEP_AT + repeated))
    np.testing.assert_array_equal(pictures.t_ns, expected)
    told = f"steps by {step_ns / 1e9:+.3f} s at 3.00 s (message 60)"
    assert [told in note for note in notes] == [True, True]
    assert "/pose: " in notes[0]
    assert "/pictures: " in notes[1]

    with recognise(log, LogFormat, "log").open_log([log]) as recording:
        pair = read_pair(recording, "log", "/point", "/turned", "enu", "header")
    np.testing.assert_array_equal(pair.position.t_ns, TIMES_NS)
    assert pair.body is not None
    np.testing.assert_array_equal(pair.body.t_ns, TIMES_NS)
    assert [told in note for note in pair.notes] == [True, True]
