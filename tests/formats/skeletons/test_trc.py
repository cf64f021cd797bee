"""TRC: real files of Pose2Sim, small ones, and our own."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.skeletons import trc
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, Recording
from pipelines.session.registries import Export, JointFormat
from tests.real_data import real_data

READER: JointFormat = trc.FORMAT
WRITER: Export = trc.EXPORT

HEADER = (
    "PathFileType\t4\t(X/Y/Z)\ta.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    "60\t60\t99\t2\tmm\t60\t1\t99\n"
    "Frame#\tTime\tRBigToe\t\t\tC7\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n"
)


def write(folder: Path, text: str) -> Path:
    path = folder / "a.trc"
    path.write_text(text)
    return path


def read(path: Path, unit: str | None = None, axes: str | None = None) -> JointMotion:
    return READER.read_joints(path, unit=unit, axes=axes)


def test_units_axes_names_and_blank_cells(tmp_path: Path) -> None:
    path = write(tmp_path, HEADER + "\n1\t0.0\t1000\t2000\t3000\t\t\t\n2\t0.016666666\t1\t2\t3\t4\t5\t6\t\n")
    assert READER.recognises(path)
    motion = read(path)
    assert motion.joints == ("right_big_toe", "C7")
    assert motion.t_ns.tolist() == [0, 16_666_666]
    assert motion.position.shape == (2, 1, 2, 3)
    # y up: world x is the file's z, world y its x, world z its y.
    assert motion.position[0, 0, 0].tolist() == [3, 1, 2]
    assert np.isnan(motion.position[0, 0, 1]).all()
    assert read(path, axes="z-up").position[0, 0, 0].tolist() == [1, 2, 3]
    assert read(path, unit="m").position[0, 0, 0].tolist() == [3000, 1000, 2000], "the user's word counts"


@pytest.mark.parametrize(
    "relative",
    [
        "pose2sim_single/pose-3d/single_0-99.trc",
        "pose2sim_single/published_0.4.15/Balancing_for_IK.trc",
        "motion/pose2sim_markers.trc",
    ],
)
def test_real_files(relative: str) -> None:
    path = real_data(relative)
    assert READER.recognises(path)
    motion = read(path)
    assert motion.position.shape == (100, 1, 21, 3)
    assert {"right_hip", "left_big_toe", "neck", "head", "nose", "left_wrist"} <= set(motion.joints)
    np.testing.assert_allclose(np.diff(motion.t_ns), 1e9 / 60, atol=1)
    # Metres with z up: a person who balances on the floor (z = 0), head above hips above heels.
    height = {joint: motion.position[:, 0, k, 2].mean() for k, joint in enumerate(motion.joints)}
    assert height["head"] > height["right_hip"] > height["right_heel"]
    assert 1.4 < height["head"] < 1.9


@pytest.mark.parametrize(
    "text",
    [
        "",
        HEADER + "1\t0\t1\t2\n",
        HEADER + "1\t0\t1\t2\t3\t4\tx\t6\n",
        HEADER + "1\tnan\t1\t2\t3\t4\t5\t6\n",
        HEADER.replace("mm", "furlong") + "1\t0\t1\t2\t3\t4\t5\t6\n",
        HEADER.replace("C7", ""),
    ],
)
def test_faulty_content_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError):
        read(write(tmp_path, text))


def test_export_is_what_opensim_expects(tmp_path: Path) -> None:
    position = np.full((4, 2, 2, 3), np.nan)
    position[:, 0, 0] = [1.0, 2.0, 3.0]
    position[1:, 1, 1] = [4.0, 5.0, 6.0]
    t_ns = np.array([0, 33_333_333, 66_666_667, 100_000_000])
    motion = JointMotion(t_ns, ("right_hip", "nose"), position)
    paths = WRITER.write(Recording("Mound walk", motion, {}), tmp_path)
    assert [path.name for path in paths] == ["Mound_walk_person0.trc", "Mound_walk_person1.trc"]
    lines = paths[0].read_text().split("\n")
    assert lines[0] == "PathFileType\t4\t(X/Y/Z)\tMound_walk_person0.trc"
    assert dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True)) == {
        "DataRate": "30",
        "CameraRate": "30",
        "NumFrames": "4",
        "NumMarkers": "2",
        "Units": "m",
        "OrigDataRate": "30",
        "OrigDataStartFrame": "1",
        "OrigNumFrames": "4",
    }
    assert lines[3] == "Frame#\tTime\tRHip\t\t\tNose\t\t"
    assert lines[4] == "\t\tX1\tY1\tZ1\tX2\tY2\tZ2"
    # World x 1, y 2, z 3 (up) are OpenSim's z, x, y (up).
    assert lines[6] == "1\t0.000000000\t2.0000000\t3.0000000\t1.0000000\tNaN\tNaN\tNaN"
    assert {len(line.split("\t")) for line in lines[6:10]} == {8}


def opensim() -> Any:
    """Import OpenSim, and keep it from writing opensim.log into the working folder."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # SWIG's wrappers are deprecated
        library = pytest.importorskip("opensim", reason="opensim, the reader of TRC files, is not installed")
    library.Logger.removeFileSink()
    return library


def test_spellings_of_other_programs(tmp_path: Path) -> None:
    rows = "1\t0.0\t1.5\t2\t3\t4\t5\t6\n2\t0.1\t1.5\t2\t3\t\t\t\n"
    expected = read(write(tmp_path, HEADER + rows)).position
    padded = HEADER.replace("Frame#", " frame #").replace("Units", " units").replace("\tmm", "\t Mm\0 ")
    commas = padded + rows.replace(".", ",").replace("\t\t\t\n", "\n")
    np.testing.assert_array_equal(read(write(tmp_path, commas)).position, expected)
    assert np.isnan(expected[1, 0, 1]).all()
