"""session.json of a foreign session, logged covariances, and truth between its samples."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.ingest import ingest
from pipelines.session.camera_poses import logged_covariance
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.people import DERIVED, SKELETONS, get_skeleton, mirrored, true_joints_at, with_derived
from pipelines.session.recognition import describe_unknown
from pipelines.session.records import JointMotion, Trajectory
from pipelines.survey import survey
from tests.commands.runner import refused
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ingest(write_flight(tmp_path_factory.mktemp("flight"), seconds=0.2).manifest).folder


def renamed(document: dict[str, Any], name: str) -> None:
    document["cameras"][name] = document["cameras"].pop("drone1")
    document["clock_reference"] = name
    document["truth"]["cameras"] = []


@pytest.mark.parametrize("name", ["../../other", "..", "a/b", "a\\b", "/other", "", "x" * 65, "DRONE2"])
def test_a_camera_that_names_no_folder_of_its_own_is_refused(session: Path, name: str) -> None:
    changed(session, lambda document: renamed(document, name), "camera")


@pytest.mark.parametrize("key", ["clock_reference", "plan", "truth"])
def test_what_names_no_camera_is_refused(session: Path, key: str) -> None:
    def change(document: dict[str, Any]) -> None:
        document["clock_reference"] = "../x" if key == "clock_reference" else "drone1"
        document["plan"] = {"../x": {"source": "", "count": 1, "dropped": {}}} if key == "plan" else None
        document["truth"]["cameras"] = ["../x"] if key == "truth" else []

    changed(session, change, "'../x' is no camera of this flight")


def changed(session: Path, change: Any, problem: str) -> None:
    """Change session.json, check that it is refused, and restore it."""
    path = session / "session.json"
    kept = path.read_bytes()
    document = json.loads(kept)
    change(document)
    try:
        path.write_text(json.dumps(document), encoding="utf-8")
        with pytest.raises(DataError) as told:
            read_description(session)
        assert told.value.source == path
        assert problem in str(told.value)
        assert problem in refused("export", session, "--to", "tum")
    finally:
        path.write_bytes(kept)


def test_names_that_flight_yaml_may_have_are_read(session: Path) -> None:
    path = session / "session.json"
    kept = path.read_bytes()
    document = json.loads(kept)
    renamed(document, "A_b-9")
    path.write_text(json.dumps(document), encoding="utf-8")
    assert list(read_description(session).cameras) == ["drone2", "A_b-9"]
    path.write_bytes(kept)


def logged(covariance: Float) -> Trajectory:
    count = len(covariance)
    still = quaternion_from_matrix(np.tile(np.eye(3), (count, 1, 1)))
    return Trajectory(np.arange(count, dtype=np.int64), np.zeros((count, 3)), still, covariance)


def test_what_logs_write_for_unknown_is_not_taken_at_its_word() -> None:
    good = np.diag([0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4])
    good[0, 1] = good[1, 0] = 0.005
    silent, absurd, negative, tied = (good.copy() for _ in range(4))
    silent[:] = 0
    absurd[2, 2] = 1e6
    absurd[0, 2] = absurd[2, 0] = 3.0
    negative[3, 3] = -1
    tied[0, 1] = tied[1, 0] = 0.5  # a correlation of 35
    found = logged_covariance(logged(np.stack([good, silent, absurd, negative, tied])))
    assert found is not None
    np.testing.assert_array_equal(found[0], good)
    # A silent pose has the median level of the others, alike on all axes: 0.02 and 2e-4; the absurd axis
    # the mean of the other two.
    np.testing.assert_allclose(np.diag(found[1]), [0.02] * 3 + [2e-4] * 3, rtol=0.3)
    assert np.count_nonzero(found[1]) == 6
    np.testing.assert_allclose(np.diag(found[2]), [0.01, 0.02, 0.015, 1e-4, 2e-4, 3e-4])
    assert found[2][0, 2] == 0
    assert found[2][0, 1] == 0.005
    np.testing.assert_allclose(np.diag(found[3])[3:], [2.5e-4, 2e-4, 3e-4])
    np.testing.assert_array_equal(found[4], np.diag(np.diag(good)))
    assert logged_covariance(logged(np.zeros((4, 6, 6)))) is None
    no_turn = good.copy()
    no_turn[3:, 3:] = 0
    assert logged_covariance(logged(no_turn[None])) is None


MS = 1_000_000
Int64 = NDArray[np.int64]


def known_at(t_ns: Int64, at_ns: Int64) -> NDArray[np.bool_]:
    """Test at which times a joint with constant velocity is known; check that it is then on its line."""
    x = t_ns / 1e9
    truth = JointMotion(t_ns, ("nose",), np.stack([x, 2 * x, -x], axis=1)[:, None, None])
    found = true_joints_at(truth, at_ns)[:, 0, 0]
    known = ~np.isnan(found[:, 0])
    at = at_ns[known] / 1e9
    np.testing.assert_allclose(found[known], np.stack([at, 2 * at, -at], axis=1), atol=1e-9)
    return known


def taking_turns(steps_ms: tuple[float, ...], turns: int, jitter_ms: float = 0.0) -> Int64:
    at_ms = np.concatenate([[0.0], np.cumsum(np.tile(steps_ms, turns))])
    at_ms += np.random.default_rng(1).uniform(-jitter_ms, jitter_ms, len(at_ms))
    return np.round(1000 * MS + at_ms * MS).astype(np.int64)


@pytest.mark.parametrize(
    ("steps_ms", "jitter_ms"),
    [
        ((8, 32), 0),
        ((32, 8), 1),
        ((1, 39), 0.3),
        ((15, 25), 2),
        ((3, 12, 25), 1),
        ((2, 2, 36), 0),
        ((40,), 2),
    ],
)
@pytest.mark.parametrize("turns", [6, 200])
def test_samples_that_take_turns_are_bridged_and_holes_are_not(
    steps_ms: tuple[float, ...], jitter_ms: float, turns: int
) -> None:
    t_ns = taking_turns(steps_ms, turns, jitter_ms)
    between = (t_ns[:-1] + t_ns[1:]) // 2
    assert known_at(t_ns, between).all()
    # A tenth of a second is missing: nothing is known there, and everything is elsewhere.
    first = len(t_ns) // 2
    last = int(np.searchsorted(t_ns, t_ns[first] + 100 * MS))
    whole = np.delete(t_ns, np.arange(first + 1, last))
    inside = (between > t_ns[first]) & (between < t_ns[last])
    np.testing.assert_array_equal(known_at(whole, between), ~inside)


def test_a_single_sample_that_is_missing_is_a_hole() -> None:
    t_ns = taking_turns((40,), 100)
    at_ns = np.array([t_ns[40] - 3 * MS, t_ns[40], t_ns[40] + 3 * MS])
    assert known_at(t_ns, at_ns).all()
    assert not known_at(np.delete(t_ns, 40), at_ns).any()


@given(st.integers(0, 2**32), st.floats(0.0, 0.12))
def test_regular_samples_of_which_some_are_missing_are_never_bridged(seed: int, share: float) -> None:
    every = np.arange(400, dtype=np.int64) * 10 * MS
    kept = np.random.default_rng(seed).uniform(size=400) >= share
    kept[[0, -1]] = True
    at_ns = every[:-1] + 5 * MS
    np.testing.assert_array_equal(known_at(every[kept], at_ns), kept[:-1] & kept[1:])


# Joints by number as the detectors' own documentation gives them, a few of each group.
NUMBERED = {
    "coco23": "16 right_ankle 17 left_big_toe 18 left_small_toe 19 left_heel 20 right_big_toe 22 right_heel",
    "coco18": "1 neck 2 right_shoulder 5 left_shoulder 8 right_hip 13 left_ankle 14 right_eye 17 left_ear",
    "coco17": "0 nose 1 left_eye 4 right_ear 5 left_shoulder 10 right_wrist 16 right_ankle",
    "halpe26": "16 right_ankle 17 head 18 neck 19 hip 20 left_big_toe 21 right_big_toe 22 left_small_toe "
    "24 left_heel 25 right_heel",
    "body25": "1 neck 2 right_shoulder 5 left_shoulder 8 hip 9 right_hip 14 left_ankle 15 right_eye "
    "18 left_ear 19 left_big_toe 20 left_small_toe 21 left_heel 22 right_big_toe 24 right_heel",
    "body25b": "1 left_eye 6 right_shoulder 12 right_hip 17 neck 18 head 19 left_big_toe 20 left_small_toe "
    "21 left_heel 22 right_big_toe 24 right_heel",
    "blazepose33": "1 left_eye_inner 5 right_eye 6 right_eye_outer 7 left_ear 9 left_mouth 11 left_shoulder "
    "18 right_pinky 19 left_index 22 right_thumb 23 left_hip 29 left_heel 32 right_big_toe",
}


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_joints_have_the_detectors_numbers(name: str) -> None:
    words = NUMBERED[name].split()
    joints = get_skeleton(name).joints
    assert [joints[int(number)] for number in words[::2]] == words[1::2]


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_bones_are_symmetric_and_join_joints_that_are_there(name: str) -> None:
    skeleton = get_skeleton(name)
    bones = {frozenset(bone) for bone in skeleton.bones}
    assert len(bones) == len(skeleton.bones)
    assert bones == {frozenset(mirrored(joint) for joint in bone) for bone in bones}
    assert set().union(*bones) <= set(skeleton.joints)
    assert {frozenset(("left_hip", "left_knee")), frozenset(("right_elbow", "right_wrist"))} <= bones


def test_neck_and_hip_are_the_midpoints_of_their_parents() -> None:
    coco = get_skeleton("coco17").joints
    position = np.arange(2 * 17 * 3, dtype=np.float64).reshape(2, 17, 3)
    position[1, coco.index("left_hip")] = np.nan
    joints, derived = with_derived(coco, position)
    assert joints == (*coco, "neck", "hip")
    np.testing.assert_array_equal(derived[:, :17], position)
    np.testing.assert_array_equal(derived[:, 17], (position[:, 5] + position[:, 6]) / 2)
    np.testing.assert_array_equal(derived[0, 18], (position[0, 11] + position[0, 12]) / 2)
    assert np.isnan(derived[1, 18]).all()
    assert [joint for joint, _ in DERIVED] == ["neck", "hip"]


SUBTITLE = "1\n00:00:00,000 --> 00:00:01,000\nHello\n"


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("empty.csv", b"", "empty"),
        ("a.mcap", b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 16384\n", "16384"),
        ("a.csv", "Höhe,Länge\n1,2\n".encode("cp1252"), "not UTF-8"),
        ("a.fit", bytes([14, 16, 0, 0, 1, 0, 0, 0]) + b".FIT" + bytes(9), "FIT"),
        ("a.nmea", b"$GPGGA,1,2,N,3,E,1\n", "NMEA"),
        ("a.csv", b"Time,Latitude,Longitude,Yaw\n1,2,3,4\n", "writer is not known"),
        ("a.srt", SUBTITLE.encode("utf-16-le"), "UTF-16"),
        ("a.toml", b"[cam1]\nsize = [9, 9]\nmatrix = [[1, 0, 4], [0, 1, 4], [0, 0, 1]]\n", "distortions"),
        ("FLY012.DAT", b"\xff\x01" * 200, "DJI"),
        ("a.txt", b"\x18\x02\0\0\0\0\0\0\xb4\x01\x0e\0" + bytes(range(256)), "DJI"),
        ("a.srt", SUBTITLE.encode(), "subtitles"),
        ("a.mcap", b"\x89MCAQ0\r\n" + bytes(100), "MCAP"),
        ("a.db3", bytes(100), "ROS 2 bag"),
        ("a.ulg", b"ULog\x02", "PX4"),
        ("a.json", b'{"one": 1, "two": 2}', "one, two"),
        ("a.json", b'{"one": 1', "JSON"),
        ("a.toml", b"[first]\nb = 1\n", "first"),
        ("a.yaml", b"%YAML:1.0\nfirst: 1\n", "first"),
        ("a.csv", b"lap,speed,gear\n1,2,3\n", "lap, speed, gear"),
        ("a.mp4", bytes(range(200)), "is called .mp4"),
        ("a.dat", b"\x01\x02\x03\x04\0\0", "01 02 03 04"),
        ("a.txt", b"Dear diary\n", "text"),
        ("a.npz", b"PK\x03\x04" + bytes(26) + b"camera.npy", "NumPy"),
        ("a.obj", b"# a\nmtllib a.mtl\nv 0.1 -2 3\n", "mesh"),
        ("a.csv", b"time,x,y,z,roll,pitch,yaw\n0,1,2,3,4,5,6\n", "angles"),
    ],
)
def test_the_line_names_what_the_file_looks_like(
    tmp_path: Path, name: str, content: bytes, word: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        survey(path)
    assert word in caught.value.problem
    assert caught.value.remedy
    assert "\n" not in str(caught.value)


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.binary(max_size=200), st.sampled_from([".json", ".toml", ".yaml", ".csv", ".srt", ".bin", ".mcap", ""])
)
def test_no_content_makes_it_raise(tmp_path: Path, content: bytes, suffix: str) -> None:
    path = tmp_path / f"file{suffix}"
    path.write_bytes(content)
    like = describe_unknown(path)
    assert like.problem
    assert "\n" not in like.problem + like.remedy
