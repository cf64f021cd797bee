"""Acclaim's motion, written byte by byte after its description, with joints in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.skeletons import amc
from pipelines.session.errors import DataError
from pipelines.session.registries import JointFormat, recognise
from tests.formats.refusals import refuses

READER: JointFormat = amc.FORMAT
UNIT_M = 0.0254 / 0.45

# A root, a hip joint to the file's left (+x), a thigh down (-y) and a shin down. The thigh's angles count in
# axes that are turned by 90 deg about z: its rx is a turn about the file's y.
ASF = """# AST/ASF file
:version 1.10
:name VICON
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
   .ast/.asf automatically generated
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name lhipjoint
     direction 1 0 0
     length 2
     axis 0 0 0  XYZ
  end
  begin
     id 2
     name lfemur
     direction 0 -1 0
     length 7
     axis 0 0 90  XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
     id 3
     name ltibia
     direction 0 -1 0
     length 6
     axis 0 0 0  XYZ
    dof rx
    limits (-10.0 170.0)
  end
  begin
     id 4
     name lfoot
     direction 0 0 1
     length 1
     axis 0 0 0  XYZ
  end
:hierarchy
  begin
    root lhipjoint
    lhipjoint lfemur
    lfemur ltibia
    ltibia lfoot
  end
"""
FRAMES = ["root 0 10 0 0 0 0\nlfemur 0 0 0\nltibia 0", "root 1 10 0 0 90 0\nlfemur 0 0 0\nltibia 90",
          "root 0 10 0 0 0 0\nlfemur 0 90 0\nltibia 0"]  # fmt: skip


def write(folder: Path, frames: list[str] = FRAMES, skeleton: str = "10.asf") -> Path:
    (folder / skeleton).write_text(ASF)
    path = folder / "10_04.amc"
    numbered = "".join(f"{k}\n{frame}\n" for k, frame in enumerate(frames, 1))
    path.write_text("#!OML:ASF F:\\VICON\n:FULLY-SPECIFIED\n:DEGREES\n" + numbered)
    return path


def test_joints_are_where_the_angles_put_them(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert recognise(path, JointFormat, "file of true joints") is READER
    motion = READER.read_joints(path, unit=None, axes=None)
    assert motion.t_ns.tolist() == [0, 8333333, 16666667]
    assert motion.joints == ("hip", "lhipjoint", "left_hip", "left_knee", "left_ankle")
    in_file = motion.position[:, 0][..., [1, 2, 0]] / UNIT_M
    straight = [[0, 10, 0], [0, 10, 0], [2, 10, 0], [2, 3, 0], [2, -3, 0]]
    # The root turns by 90 deg about y: x becomes -z. The shin bends by 90 deg about its own x, which is -z
    # then: down becomes -z of the thigh, and that is -x.
    turned = [[1, 10, 0], [1, 10, 0], [1, 10, -2], [1, 3, -2], [-5, 3, -2]]
    # ry of 90 deg in axes turned by 90 deg about z is a turn about -x: down becomes +z.
    swung = [[0, 10, 0], [0, 10, 0], [2, 10, 0], [2, 10, 7], [2, 10, 13]]
    np.testing.assert_allclose(in_file, [straight, turned, swung], rtol=0, atol=1e-9)


@pytest.mark.parametrize("skeleton", ["10.asf", "10_04.asf", "subject.ASF"])
def test_the_skeleton_lies_beside(tmp_path: Path, skeleton: str) -> None:
    assert READER.describe(write(tmp_path, skeleton=skeleton))["skeleton"] == skeleton
    (tmp_path / skeleton).unlink()
    with refuses(tmp_path / "10_04.amc", 0, "10_04.asf"):
        READER.read_joints(tmp_path / "10_04.amc", unit=None, axes=None)


def test_a_last_frame_that_is_cut_is_left_out_and_counted(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_text(path.read_text()[: -len("\nltibia 0\n")])
    motion = READER.read_joints(path, unit=None, axes=None)
    assert len(motion.t_ns) == 2
    assert list(motion.dropped.values()) == [1]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("dof rx ry rz", "dof rx ry l"),
        ("axis XYZ", "axis XYW"),
        (":hierarchy", ":tree"),
        ("length 7", "length"),
        ("length 7", "length 1e99"),
        ("length 0.45", "length 0"),
        ("axis 0 0 90", "axis -inf 0 90"),
        ("orientation 0 0 0", "orientation nan 0 0"),
    ],
)
def test_faulty_skeletons_are_refused(tmp_path: Path, old: str, new: str) -> None:
    path = write(tmp_path)
    (tmp_path / "10.asf").write_text(ASF.replace(old, new))
    with pytest.raises(DataError):
        READER.read_joints(path, unit=None, axes=None)


@pytest.mark.parametrize("frame", ["root 0 0 0\nlfemur 0 0 0\nltibia 0", "root 0 1 0 0 0 0\nlhand 1"])
def test_faulty_frames_are_refused(tmp_path: Path, frame: str) -> None:
    with pytest.raises(DataError):
        READER.read_joints(write(tmp_path, [frame, FRAMES[0]]), unit=None, axes=None)
