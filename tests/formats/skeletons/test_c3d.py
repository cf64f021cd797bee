"""C3D: our files read by ezc3d and by our reader; files of other programs; damaged files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.formats.skeletons import c3d
from pipelines.formats.skeletons.joint_files import at_even_times
from pipelines.session.errors import DataError
from pipelines.session.progress import Silent
from pipelines.session.records import JointMotion
from pipelines.session.registries import ExportWithChoices, JointFormat, need
from tests.formats.exported import SIGMA_M, START_NS, recording, stamps, walking, without
from tests.raising import refused

READER: JointFormat = c3d.FORMAT
WRITER: ExportWithChoices = c3d.EXPORT
FLOAT32 = 2.0**-24  # half a step of a float of 24 bits, relative


def read(path: Path, unit: str | None = None, axes: str | None = None) -> JointMotion:
    return READER.read_joints(path, unit=unit, axes=axes)


def write(path: Path, motion: JointMotion, unit: str = "mm", axes: str = "z-up") -> Path:
    c3d.write_joints(path, at_even_times("x", motion, Silent()), 0, unit=unit, axes=axes)
    return path


def foreign(path: Path, points: Any, labels: list[str], unit: str = "mm", first: int = 0) -> Path:
    """Write points [3, N, T] with ezc3d, as another program does."""
    file = need("ezc3d", "c3d").c3d()
    file["data"]["points"] = np.concatenate([points, np.ones((1, *points.shape[1:]))])
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file["header"]["points"]["first_frame"] = first
    file.write(str(path))
    return path


@pytest.mark.parametrize("unit", ["mm", "cm", "m"])
@pytest.mark.parametrize("axes", ["z-up", "y-up"])
def test_joints_come_back_within_float32(tmp_path: Path, unit: str, axes: str) -> None:
    motion = without(walking(), "left_wrist", [3, 4])
    path = write(tmp_path / "a.c3d", motion, unit, axes)
    assert READER.recognises(path)
    back = read(path)
    assert back.joints == motion.joints
    assert np.abs(back.t_ns - motion.t_ns).max() <= 1  # stamps were rounded to nanoseconds
    np.testing.assert_allclose(back.position, motion.position, rtol=FLOAT32, atol=0)


def test_ezc3d_reads_unit_axes_rate_labels_and_residuals(tmp_path: Path) -> None:
    asked = replace(recording(), unit="m", axes="y-up")
    (path,) = WRITER.write(asked, tmp_path)
    assert path.name == "Mound_walk.c3d"
    file = need("ezc3d", "c3d").c3d(str(path))
    point = file["parameters"]["POINT"]
    assert point["UNITS"]["value"] == ["m"]
    assert [point[f"{axis}_SCREEN"]["value"] for axis in "XY"] == [["+X"], ["+Y"]]
    assert point["RATE"]["value"][0] == pytest.approx(30, rel=1e-6)
    assert point["LABELS"]["value"][:2] == ["Nose", "LEye"]
    residual = file["data"]["meta_points"]["residuals"][0]
    wrist = point["LABELS"]["value"].index("LWrist")
    # sqrt((1 + 4 + 9) / 3) cm = 21.6 mm, in whole millimetres.
    expected = np.full(residual.shape, 0.001 * round(1000 * np.sqrt(np.square(SIGMA_M).sum() / 3)))
    expected[wrist, 7] = -1
    np.testing.assert_allclose(residual, expected, rtol=1e-6)
    # With y up, the nose's second coordinate is its height.
    assert asked.motion is not None
    np.testing.assert_allclose(file["data"]["points"][1, 0], asked.motion.position[:, 0, 0, 2], rtol=FLOAT32)


def test_more_frames_than_the_header_counts(tmp_path: Path) -> None:
    count = 65_600
    position = np.zeros((count, 1, 1, 3))
    position[:, 0, 0] = np.arange(count)[:, None] * [0.001, 0.002, 0.003]
    position[65_590] = np.nan
    path = write(tmp_path / "a.c3d", JointMotion(stamps(count), ("nose",), position))
    trial = need("ezc3d", "c3d").c3d(str(path))["parameters"]["TRIAL"]
    assert [int(v) & 0xFFFF for v in trial["ACTUAL_END_FIELD"]["value"]] == [count - 65_536, 1]
    back = read(path)
    assert len(back.t_ns) == count
    np.testing.assert_allclose(back.position, position, rtol=FLOAT32, atol=0)
    start = 512 * (need("ezc3d", "c3d").c3d(str(path))["parameters"]["POINT"]["DATA_START"]["value"][0] - 1)
    path.write_bytes(path.read_bytes()[: start + 16 * 65_590])
    with refused("damaged", path, 65600):
        read(path)


def test_files_of_others_begin_at_their_first_frame(tmp_path: Path) -> None:
    points = np.arange(18.0).reshape(3, 2, 3)
    points[:, 1, 1] = np.nan
    path = foreign(tmp_path / "a.c3d", points, ["RHip", "LASI"], first=50)
    motion = read(path)
    assert motion.joints == ("right_hip", "LASI")
    assert motion.t_ns.tolist() == [500_000_000, 510_000_000, 520_000_000]
    np.testing.assert_allclose(motion.position[:, 0], points.transpose(2, 1, 0) / 1000, rtol=1e-7)
    turned = read(path, unit="m", axes="y-up").position[0, 0, 0]
    assert turned.tolist() == points[[2, 0, 1], 0, 0].tolist()
    facts = READER.describe(path)
    assert (facts["POINT:UNITS"], facts["rows"], facts["joints"]) == ("mm", 3, ["right_hip", "LASI"])


def test_faulty_content_is_refused(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.c3d", walking(30)).read_bytes()
    for size in (600, 1400, len(whole) - 4000):
        cut = tmp_path / f"{size}.c3d"
        cut.write_bytes(whole[:size])
        with pytest.raises(DataError):
            read(cut)
    other = foreign(tmp_path / "b.c3d", np.ones((3, 1, 2)), ["A"], unit="furlong")
    with refused("unit-unknown", other, "'furlong'"):
        read(other)
    (tmp_path / "text.c3d").write_text("no C3D")
    assert not READER.recognises(tmp_path / "text.c3d")


@pytest.mark.parametrize("name", [b"POINT", b"LABELS", b"RATE", b"FIRST_T_NS"])
def test_damaged_parameters_are_refused(tmp_path: Path, name: bytes) -> None:
    damaged = bytearray(write(tmp_path / "a.c3d", walking(30)).read_bytes())
    behind = damaged.index(name) + len(name)  # the distance to the next one, then type and dimensions
    damaged[behind : behind + 4] = bytes([0x77]) * 4
    (tmp_path / "a.c3d").write_bytes(damaged)
    with refused("damaged", tmp_path / "a.c3d", "parameters"):
        read(tmp_path / "a.c3d")


def test_a_header_that_counts_too_many_frames_is_outvoted_by_point_frames(tmp_path: Path) -> None:
    """Optotrak writes such files; ezc3d reads them."""
    path = write(tmp_path / "a.c3d", walking(40))
    content = bytearray(path.read_bytes())
    content[8:10] = (400).to_bytes(2, "little")  # the last frame
    path.write_bytes(content)
    assert len(read(path).t_ns) == 40
    path.write_bytes(content[: len(content) // 2])
    with refused("damaged", path):
        read(path)


def test_counts_of_a_trial_may_be_a_table(tmp_path: Path) -> None:
    """Theia3D writes TRIAL:ACTUAL_END_FIELD as 2 x 1; ezc3d cannot."""
    path = write(tmp_path / "a.c3d", walking(40))
    start = 512 * (need("ezc3d", "c3d").c3d(str(path))["parameters"]["POINT"]["DATA_START"]["value"][0] - 1)
    content = bytearray(path.read_bytes())
    place = content.index(b"ACTUAL_END_FIELD") + len("ACTUAL_END_FIELD")
    content[place] += 1  # the distance to the next parameter
    content[place + 3] = 2  # dimensions
    content.insert(place + 5, 1)
    del content[start]
    path.write_bytes(content)
    assert len(read(path).t_ns) == 40


def test_gait_events_are_read_by_ezc3d(tmp_path: Path) -> None:
    walked = recording(60)
    rows = {
        "t_ns": START_NS + np.array([250, 900, 65_500]) * 1_000_000,
        "person": [0, 0, 0],
        "side": ["left", "right", "left"],
        "event": ["heel_strike", "toe_off", "heel_strike"],
    }
    (path,) = WRITER.write(replace(walked, gait=lambda: pd.DataFrame(rows)), tmp_path)
    events = need("ezc3d", "c3d").c3d(str(path))["parameters"]["EVENT"]
    assert events["USED"]["value"].tolist() == [3]
    assert events["CONTEXTS"]["value"] == ["Left", "Right", "Left"]
    assert events["LABELS"]["value"] == ["Foot Strike", "Foot Off", "Foot Strike"]
    np.testing.assert_allclose(events["TIMES"]["value"], np.array([[0, 0, 1], [0.25, 0.9, 5.5]]), atol=1e-6)
