"""A world that is turned, scaled or elsewhere, and the keys that undo it: the session is the same."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from pipelines.ingest import ingest
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps, write_grid
from pipelines.session.recognition import recognise
from pipelines.session.records import Occupancy
from pipelines.session.registries import CalibrationFormat
from pipelines.simulation.flight_files import write_tum
from pipelines.sources.world import UP_ROWS
from tests.raising import refused
from tests.synthetic.flights import START_NS, SyntheticFlight, pose2sim_table, write_flight
from tests.synthetic.logged_flights import header
from tests.synthetic.logs import Entry, write_log

NAMES = ("x", "y", "z")
TURNED = ("qx", "qy", "qz", "qw")
SCALE = 0.3
Change = Callable[[Any, Any], tuple[Any, Any]]


def rotation_to(up: str) -> Rotation:
    """Return a rotation that takes the world's z to an axis: by the shortest way, and then about it."""
    axis = np.eye(3)[NAMES.index(up[-1])] * (-1 if up[0] == "-" else 1)
    across = np.eye(3)[(NAMES.index(up[-1]) + 1) % 3]
    return Rotation.from_matrix(np.stack([across, np.cross(axis, across), axis], axis=1))


def rewrite_trajectories(flight: SyntheticFlight, change: Change, pattern: str = "drone?.tum") -> None:
    for path in flight.manifest.parent.glob(pattern):
        rows = np.loadtxt(path, comments="#")
        t_ns = START_NS + np.rint((rows[:, 0] - START_NS // 10**9) * 1e9).astype(np.int64)
        write_tum(path, t_ns, *change(rows[:, 1:4], rows[:, 4:]))


def rewrite_calibration(flight: SyntheticFlight, change: Change) -> None:
    path = flight.manifest.with_name("calibration.toml")
    cameras = recognise(path, CalibrationFormat, "calibration").read_calibration(path)
    tables = [
        pose2sim_table(name, *change(camera.position, camera.quaternion_xyzw))
        for name, camera in cameras.items()
    ]
    path.write_text("\n".join(tables), encoding="utf-8")


def tables(flight: SyntheticFlight) -> dict[str, pd.DataFrame]:
    session = ingest(flight.manifest, overwrite=True).folder
    paths = [
        *session.glob("cameras/*/poses.parquet"),
        session / "truth.parquet",
        session / "truth_poses.parquet",
    ]
    return {str(path.relative_to(session)): pd.read_parquet(path) for path in paths}


def assert_same(
    one: dict[str, pd.DataFrame], other: dict[str, pd.DataFrame], turn: Rotation, apart: float
) -> None:
    """Compare positions, and rotations, which may differ by a turn about the vertical."""
    assert one.keys() == other.keys()
    for name, table in one.items():
        again = other[name]
        moved = turn.apply(table[list(NAMES)].to_numpy(copy=True))
        np.testing.assert_allclose(again[list(NAMES)], moved, rtol=0, atol=apart)
        if "qx" in table:
            both = [Rotation.from_quat(each[list(TURNED)].to_numpy(copy=True)) for each in (table, again)]
            assert ((turn * both[0]) * both[1].inv()).magnitude().max() < 1e-6


@pytest.mark.parametrize("up", ["z", "-z", "y", "-y", "x", "-x"])
def test_a_turned_and_scaled_world_is_undone(tmp_path: Path, up: str) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    right = tables(flight)
    turn = rotation_to(up)
    rewrite_trajectories(
        flight,
        lambda place, turned: (SCALE * turn.apply(place), (turn * Rotation.from_quat(turned)).as_quat()),
        "*.tum",
    )
    joints = pd.read_csv(tmp_path / "truth.csv")
    joints[list(NAMES)] = SCALE * turn.apply(joints[list(NAMES)].to_numpy(copy=True))
    joints.to_csv(tmp_path / "truth.csv", index=False)
    flight.settings["world"] = {"up": up, "scale": 1 / SCALE}
    flight.save()
    found = tables(flight)
    # The manifest says where up is, not where east is: what is left is a turn about the vertical.
    first = right["truth.parquet"][list(NAMES)].to_numpy(copy=True)
    there = found["truth.parquet"][list(NAMES)].to_numpy(copy=True)
    left, _ = Rotation.align_vectors(there - there.mean(axis=0), first - first.mean(axis=0))
    np.testing.assert_allclose(left.apply([0, 0, 1]), [0, 0, 1], atol=1e-5)
    assert_same(right, found, left, 2e-5)  # files have micrometres, which are scaled


@pytest.mark.parametrize("still", [False, True])
def test_a_source_elsewhere_is_placed(tmp_path: Path, still: bool) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True, static=still)
    right = tables(flight)
    turn, shift = Rotation.from_euler("xyz", [20, -40, 100], degrees=True), np.array([3.0, -7.0, 2.0])
    back = {
        "rotation_xyzw": turn.inv().as_quat().tolist(),
        "translation": turn.inv().apply(-shift / SCALE).tolist(),
        "scale": 1 / SCALE,
    }

    def moved(place: Any, turned: Any) -> tuple[Any, Any]:
        return SCALE * turn.apply(place) + shift, (turn * Rotation.from_quat(turned)).as_quat()

    (rewrite_calibration if still else rewrite_trajectories)(flight, moved)
    for camera in flight.settings["cameras"].values():
        camera["pose"]["world_from_source"] = back
    flight.save()
    assert_same(right, tables(flight), Rotation.identity(), 2e-5)


def test_a_lever_arm_is_in_metres_whatever_the_scale_of_the_poses(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=1, seconds=0.2, clean=True)
    camera = flight.settings["cameras"]["drone1"]
    camera["pose"] |= {"of": "body"}
    camera["mount"] = {"looks": "forward", "translation": [0.1, 0.2, 0.3]}
    flight.save()
    right = tables(flight)
    rewrite_trajectories(flight, lambda place, turned: (SCALE * place, turned))
    camera["pose"]["world_from_source"] = {"scale": 1 / SCALE}
    flight.save()
    assert_same(right, tables(flight), Rotation.identity(), 2e-5)


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("cm", 0.01), ("ft", 0.3048)])
def test_still_cameras_have_a_unit(tmp_path: Path, unit: str, metres: float) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True, static=True)
    right = tables(flight)
    rewrite_calibration(flight, lambda place, turned: (place / metres, turned))
    for camera in flight.settings["cameras"].values():
        camera["pose"] = {"file": "calibration.toml", "unit": unit}
    flight.save()
    assert_same(right, tables(flight), Rotation.identity(), 1e-9)


def test_a_map_and_an_actor_turn_with_the_world(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    probability = np.zeros((2, 3, 4), np.float32)
    probability[1, 2, 3] = 1.0
    write_grid(tmp_path / "site.npz", Occupancy(probability, np.array([1.0, 2.0, 3.0]), 0.5))
    pose = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"w": 1.0}}
    entries = [
        Entry("/actor", "geometry_msgs/msg/PoseStamped", t, {"header": header(t, "map"), "pose": pose})
        for t in (START_NS, START_NS + 10**8)
    ]
    write_log(tmp_path, "actor", "mcap-cdr", entries)
    flight.settings.update({"map": "site.npz", "actor": {"file": "actor.mcap", "topic": "/actor"}})
    del flight.settings["truth"]
    flight.settings["world"] = {"up": "y", "scale": 2.0}
    flight.save()
    session = ingest(flight.manifest).folder
    (grid,) = load_maps(session)
    # y is up: east is z, north is x.
    assert grid.resolution_m == 1.0
    np.testing.assert_allclose(grid.origin, [6.0, 2.0, 4.0])
    assert np.argwhere(grid.probability == 1.0).tolist() == [[3, 1, 2]]
    actor = pd.read_parquet(session / "actor.parquet")
    np.testing.assert_allclose(actor[list(NAMES)].to_numpy(copy=True)[0], [6.0, 2.0, 4.0])


def test_separate_topics_of_positions_and_attitudes_are_scaled_and_turned_upright(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    half = float(np.sqrt(0.5))
    entries = []
    for t in range(START_NS - 10**8, START_NS + 4 * 10**8, 10**8):
        of = header(t, "map")
        point = {"header": of, "point": {"x": 1.0, "y": 2.0, "z": 3.0}}
        turned = {"header": of, "quaternion": {"x": half, "w": half}}
        entries += [
            Entry("/point", "geometry_msgs/msg/PointStamped", t, point),
            Entry("/turned", "geometry_msgs/msg/QuaternionStamped", t, turned),
        ]
    write_log(tmp_path, "log", "mcap-cdr", entries)
    camera = flight.settings["cameras"]["drone1"]
    camera["pose"] = {"file": "log.mcap", "topic": "/point", "attitude": "/turned", "of": "body"}
    camera["mount"] = {"looks": "forward", "translation": [0.0, 0.0, 0.1]}
    flight.settings["world"] = {"up": "y", "scale": 2.0}
    del flight.settings["truth"]
    flight.save()
    poses = pd.read_parquet(ingest(flight.manifest).folder / "cameras" / "drone1" / "poses.parquet")
    # y is up: east is z, north is x. The body is turned by 90 deg about x: its z points to -y, down.
    np.testing.assert_allclose(poses[list(NAMES)].to_numpy(copy=True)[0], [6.0, 2.0, 3.9], atol=1e-6)


def subjects(folder: Path, names: tuple[str, ...]) -> SyntheticFlight:
    """Write a flight whose truth names the subject before each joint; the second stands 5 m away."""
    flight = write_flight(folder, cameras=2, seconds=0.2, clean=True)
    joints = pd.read_csv(folder / "truth.csv")
    parts = [
        joints.assign(joint=f"{name}:" + joints["joint"], x=joints["x"] + 5 * k)
        for k, name in enumerate(names)
    ]
    pd.concat(parts).to_csv(folder / "truth.csv", index=False)
    return flight


def test_the_truth_is_of_the_subject_that_is_named(tmp_path: Path) -> None:
    right = tables(write_flight(tmp_path / "right", cameras=2, seconds=0.2, clean=True))["truth.parquet"]
    for names in (("P1",), ("P1", "P2")):
        flight = subjects(tmp_path / "-".join(names), names)
        stated = {"subject": "P1"} if len(names) > 1 else {}
        flight.settings["truth"] = {"file": "truth.csv", "poses": flight.settings["truth"]["poses"], **stated}
        flight.save()
        pd.testing.assert_frame_equal(tables(flight)["truth.parquet"], right)


@pytest.mark.parametrize(("stated", "code"), [({}, "ambiguous"), ({"subject": "P3"}, "no-such-name")])
def test_a_subject_that_is_not_clear_is_refused(tmp_path: Path, stated: dict[str, str], code: str) -> None:
    flight = subjects(tmp_path, ("P1", "P2"))
    flight.settings["truth"] |= stated
    flight.save()
    with pytest.raises(DataError) as caught:
        ingest(flight.manifest)
    assert caught.value.code == code
    assert "P1, P2" in caught.value.problem


@pytest.mark.parametrize("unit", ["cm", "mm"])
def test_truth_in_another_unit_than_its_file_says_is_refused_with_the_unit(tmp_path: Path, unit: str) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    right = tables(flight)["truth.parquet"]
    joints = pd.read_csv(tmp_path / "truth.csv")
    joints[["x", "y", "z"]] *= {"cm": 100, "mm": 1000}[unit]
    joints.to_csv(tmp_path / "truth.csv", index=False)

    with refused("unit-unknown", tmp_path / "truth.csv", f"unit: {unit}"):
        ingest(flight.manifest)
    flight.settings["truth"] |= {"unit": unit}
    flight.save()
    pd.testing.assert_frame_equal(tables(flight)["truth.parquet"], right)


def test_truth_of_zeros_is_missing_and_counted(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    joints = pd.read_csv(tmp_path / "truth.csv")
    joints.loc[::7, ["x", "y", "z"]] = 0.0
    joints.to_csv(tmp_path / "truth.csv", index=False)

    ingested = ingest(flight.manifest)

    truth = ingested.description.truth
    assert truth is not None
    assert truth.missing == sum(truth.dropped.values()) == len(joints.loc[::7])


@pytest.mark.parametrize("number", ["sync_index", None])
def test_truth_without_times_counts_frames(tmp_path: Path, number: str | None) -> None:
    """The second frame is left out by caliscope's numbers, and is blank without any."""
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    right = tables(flight)["truth.parquet"]
    joints = list(dict.fromkeys(right["joint"]))
    wide = right[["x", "y", "z"]].to_numpy().reshape(-1, 3 * len(joints))
    table = pd.DataFrame(wide, columns=[f"{joint}_{axis}" for joint in joints for axis in "xyz"])
    if number:
        table.insert(0, number, range(len(table)))
        table = table.drop(index=1)
    else:
        table.loc[1] = np.nan
    table.to_csv(tmp_path / "xyz.csv", index=False)
    flight.settings["truth"] = {"file": "xyz.csv", "poses": flight.settings["truth"]["poses"]}
    flight.save()
    with refused("clock-unknown", tmp_path / "xyz.csv", "fps"):
        ingest(flight.manifest)
    flight.settings["truth"] |= {"fps": 30, "offset_s": START_NS // 10**9}
    flight.save()
    found = tables(flight)["truth.parquet"]
    kept = right[right["t_ns"] != np.unique(right["t_ns"])[1]].reset_index(drop=True)
    found = found[np.isfinite(found["x"])].reset_index(drop=True)
    assert np.abs(found["t_ns"] - kept["t_ns"]).max() <= 1
    pd.testing.assert_frame_equal(found.drop(columns="t_ns"), kept.drop(columns="t_ns"))


@pytest.mark.parametrize("up", ["y", "-x"])
def test_the_axis_of_the_truth_is_stated_for_itself(tmp_path: Path, up: Any) -> None:
    """Joints of a file that is y up, in feet, beside poses that are z up."""
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    right = tables(flight)["truth.parquet"]
    joints = pd.read_csv(tmp_path / "truth.csv")
    written = joints[list(NAMES)].to_numpy(copy=True) @ np.array(UP_ROWS[up], dtype=float) / 0.3048
    joints[list(NAMES)] = written
    joints.to_csv(tmp_path / "truth.csv", index=False)
    flight.settings["truth"] |= {"up": up, "unit": "ft"}
    flight.save()
    found = tables(flight)["truth.parquet"]
    np.testing.assert_allclose(found[list(NAMES)], right[list(NAMES)], rtol=0, atol=1e-9)
