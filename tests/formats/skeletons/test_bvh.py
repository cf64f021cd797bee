"""BVH: small files whose joints can be computed on paper, real ones, and rigs that were written."""

import re
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.formats.skeletons import bvh
from pipelines.formats.skeletons.bvh import read_motion
from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion, multiply, rotate
from pipelines.session.records import SkeletalMotion
from pipelines.session.registries import JointFormat
from tests.formats.exported import Listener, recording, walking
from tests.formats.scenes.test_gltf_writing import body_of
from tests.raising import refused
from tests.real_data import facts, real_data

READER: JointFormat = bvh.FORMAT

HIERARCHY = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Left Leg
  {
    OFFSET 10 -5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -40 2
    }
  }
  JOINT Spine
  {
    OFFSET 0 2e1 0.0
    CHANNELS 1 Yrotation
    End Site
    {
      OFFSET 0 30 0
    }
  }
}
"""
FRAMES = """MOTION
Frames: 2
Frame Time: 0.04
1 100 3 0 0 0  0 0 0  0
-1.5E0 1.0e+2 30 90 0 0  0 -90 0  45
"""
TEXT = HIERARCHY + FRAMES


def write(folder: Path, text: str) -> Path:
    path = folder / "a.bvh"
    path.write_bytes(text.encode())
    return path


def joint_places(motion: SkeletalMotion) -> tuple[Float, dict[int, Float]]:
    """Compute world positions of joints [T, B, 3] and of end sites, as in the record's docstring."""
    place, turn = np.empty((len(motion.t_s), len(motion.bones), 3)), motion.rotation.copy()
    for bone, parent in enumerate(motion.parent):
        if parent < 0:
            place[:, bone] = motion.root
        else:
            place[:, bone] = place[:, parent] + rotate(turn[:, parent], motion.offset[bone])
            turn[:, bone] = multiply(turn[:, parent], turn[:, bone])
    ends = {bone: place[:, bone] + rotate(turn[:, bone], end) for bone, end in motion.end.items()}
    return place, ends


def test_joints_are_where_they_are_on_paper(tmp_path: Path) -> None:
    path = write(tmp_path, TEXT)
    assert READER.recognises(path)
    motion = read_motion(path, unit="cm", axes="y-up")
    assert motion.bones == ("Hips", "Left Leg", "Spine")
    assert motion.parent == (-1, 0, 0)
    assert motion.t_s.tolist() == [0, 0.04]
    place, ends = joint_places(motion)
    # (x, y, z) of the file is (z, x, y) of the world.
    expected = [[0.03, 0.01, 1.0], [0.03, 0.11, 0.95], [0.03, 0.01, 1.2]]
    np.testing.assert_allclose(place[0], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ends[1][0], [0.05, 0.11, 0.55], rtol=0, atol=1e-12)
    # Then the hips are turned by 90 about z: file x becomes y, y becomes -x. The leg is at
    # (-1.5, 100, 30) + (5, 10, 0). Its own turn of -90 about x moves its end (0, -40, 2) to (0, 2, 40). The
    # hips' turn moves that to (-2, 0, 40).
    np.testing.assert_allclose(place[1, 1], [0.30, 0.035, 1.10], rtol=0, atol=1e-12)
    np.testing.assert_allclose(ends[1][1], [0.70, 0.015, 1.10], rtol=0, atol=1e-12)
    np.testing.assert_allclose(ends[2][1], [0.30, -0.515, 1.0], rtol=0, atol=1e-12)


def test_units_and_axes(tmp_path: Path) -> None:
    path = write(tmp_path, TEXT)
    metres = read_motion(path, unit="m", axes="z-up")
    assert metres.root[0].tolist() == [1, 100, 3]
    assert metres.offset[1].tolist() == [10, -5, 0]
    for unit, scale in (("cm", 0.01), ("mm", 0.001), ("inch", 0.0254)):
        np.testing.assert_allclose(
            read_motion(path, unit=unit, axes="z-up").end[1], metres.end[1] * scale, rtol=1e-15
        )
    # A turn of the axes turns every joint in the same way.
    upright, _ = joint_places(read_motion(path, unit="m", axes="y-up"))
    np.testing.assert_allclose(upright, joint_places(metres)[0][..., [2, 0, 1]], rtol=0, atol=1e-12)


def turn_about(axis: str, deg: float) -> Float:
    """Return the textbook rotation matrix about an axis."""
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array(
        {
            "X": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "Y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "Z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


angles = st.floats(-720, 720)


@given(
    st.sampled_from([*permutations("XYZ"), *permutations("XY"), ("Z",), ("Z", "X", "Z")]),
    st.tuples(angles, angles, angles),
)
def test_channels_turn_in_the_order_in_which_they_stand(
    tmp_path_factory: pytest.TempPathFactory, order: tuple[str, ...], deg: tuple[float, float, float]
) -> None:
    path = tmp_path_factory.mktemp("bvh") / "a.bvh"
    channels = " ".join(f"{axis}rotation" for axis in order)
    used = deg[: len(order)]
    path.write_text(
        f"HIERARCHY\nROOT a\n{{\nOFFSET 0 0 0\nCHANNELS {len(order)} {channels}\n}}\nMOTION\nFrames: 1\n"
        f"Frame Time: 1\n{' '.join(map(repr, used))}\n"
    )
    expected = np.eye(3)
    for axis, angle in zip(order, used, strict=True):
        expected = expected @ turn_about(axis, angle)
    found = matrix_from_quaternion(read_motion(path, unit="m", axes="z-up").rotation[0, 0])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)  # a rounding of 720 deg is 1e-13 rad


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("wrong-kind", ""),
        ("damaged", "HIERARCHY\nROOT a\n{\n"),
        ("damaged", TEXT.replace("}\n}\nMOTION", "}\nMOTION")),
        ("damaged", TEXT.replace("JOINT Spine", "JOINT Hips")),
        ("damaged", TEXT.replace("OFFSET 10 -5 0", "OFFSET 10 -5")),
        ("damaged", TEXT.replace("CHANNELS 1 Yrotation", "CHANNELS 2 Yrotation")),
        ("bad-value", TEXT.replace("Frame Time: 0.04", "Frame Time: 0")),
        ("damaged", TEXT.replace("Frames: 2", "Frames: 3")),
        ("damaged", TEXT.replace("  45\n", "")),
        ("damaged", TEXT.replace("-1.5E0", "nan")),
        ("empty", HIERARCHY + "MOTION\nFrames: 0\nFrame Time: 0.04\n"),
    ],
)
def test_faulty_content_is_refused(tmp_path: Path, code: str, text: str) -> None:
    path = write(tmp_path, text)
    with refused(code, path):
        read_motion(path, unit="cm", axes="y-up")


@pytest.mark.parametrize("name", ["cmu_10_04_walk", "cmu_10_01_soccer_kick", "xia_neutral_01_000"])
def test_real_files_hold_what_others_read(name: str) -> None:
    told = facts(f"motion/{name}.bvh")
    path = real_data(f"motion/{name}.bvh")
    assert READER.recognises(path)
    motion = read_motion(path, unit="m", axes="y-up")
    assert (len(motion.bones), len(motion.t_s)) == (told["joints"], told["frames"])
    assert list(motion.bones) == told["joint_names"]
    assert 1 / motion.t_s[1] == pytest.approx(told["fps"], rel=1e-4)
    place, _ = joint_places(motion)
    in_file = place[..., [1, 2, 0]]
    for joint, frames in told["fk_positions"].items():
        for frame, expected in frames.items():
            found = in_file[int(frame.removeprefix("frame_")), motion.bones.index(joint)]
            np.testing.assert_allclose(found, expected, rtol=0, atol=6e-5)  # references have 4 decimals


@pytest.mark.parametrize("name", ["cmu_10_04_walk", "cmu_10_01_soccer_kick"])
def test_real_joints_are_where_others_find_them(name: str) -> None:
    """Find CMU's unit, 0.0254 / 0.45 m, by the height of the rest pose; joints have our names."""
    told = facts(f"motion/{name}.bvh")["fk_positions"]
    truth = READER.read_joints(real_data(f"motion/{name}.bvh"), unit=None, axes=None)
    for bone, joint in {"LeftHand": "left_wrist", "RightFoot": "right_ankle", "Head": "Head"}.items():
        for frame, expected in told[bone].items():
            found = truth.position[int(frame.removeprefix("frame_")), 0, truth.joints.index(joint)]
            expected_m = np.array(expected)[[2, 0, 1]] * 0.0254 / 0.45
            np.testing.assert_allclose(found, expected_m, rtol=0, atol=6e-5)
    assert truth.t_ns[1] == 8_333_300 or abs(int(truth.t_ns[1]) - 8_333_333) < 1000


def test_a_body_is_written_from_its_first_to_its_last_pose(tmp_path: Path) -> None:
    motion = walking(30)
    whole = body_of(motion.t_ns)
    known = np.array([k for k in range(30) if k not in {0, 1, *range(10, 17), 29}])
    body = replace(whole, t_ns=whole.t_ns[known], centre=whole.centre[known], rotation=whole.rotation[known])
    listener = Listener()
    two = replace(motion, position=np.repeat(motion.position, 2, axis=1), covariance=None)
    described = replace(recording(), motion=two, bodies=lambda: [body], progress=listener)
    (path,) = bvh.EXPORT.write(described, tmp_path)
    back = read_motion(path, unit="cm", axes="y-up")
    rig, _ = bvh.rig_of_body(body, motion.t_ns)
    place = joint_places(back)[0][:, [back.bones.index(bone) for bone in rig.bones]]
    np.testing.assert_allclose(place[[0, 7, 15]], whole.centre[[2, 9, 17]], rtol=0, atol=2e-6)
    np.testing.assert_allclose(place[8:15], place[[7] * 7], rtol=0, atol=2e-6)
    without, note = listener.notes
    assert described.name_of(1) in without
    assert re.findall(r"(\d+) of (\d+) frames", note) == [("3", "30"), ("7", "27")]


def test_nobody_without_a_body_is_written(tmp_path: Path) -> None:
    with refused("no-body", recording().name):
        bvh.EXPORT.write(recording(), tmp_path)


def test_a_body_of_slow_pictures_is_written_whole() -> None:
    t_ns = np.arange(8) * 250_000_000 + np.arange(8) % 3 * 200_000
    assert bvh.rig_of_body(body_of(t_ns), np.arange(8) * 250_000_000)[1] == 0
