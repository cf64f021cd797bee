"""The actor's log, a gimbal's angles, and a floor plan with its picture, through the commands."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.mounting import body_from_camera
from pipelines.geometry.poses import conjugate, multiply, quaternion_from_rotation_vector, rotate
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from pipelines.session.storage import read_json
from tests.commands.runner import ingested, measured, mocap, refused, succeeds
from tests.synthetic.flights import SyntheticFlight, bystander_at, write_flight
from tests.synthetic.logged_flights import attitude_entry, fix_entry, pose_entry
from tests.synthetic.logs import Entry, write_log
from tests.synthetic.walk import COCO17


def write_actor(flight: SyntheticFlight, folder: Path) -> None:
    """Write a log of the actor's hip, as from a tracker on board."""
    write_log(
        folder, "actor", "ros2-mcap", _logged("/actor", flight.t_ns, hips(flight.joints, flight.position))
    )
    flight.settings["actor"] = {"file": "actor", "topic": "/actor"}
    flight.save()


def write_actors(flight: SyntheticFlight, folder: Path) -> None:
    """Write a log of the bystander's and the actor's hips; the bystander, abe, is the first."""
    passing = hips(COCO17, bystander_at(flight.t_ns))
    entries = _logged("/abe", flight.t_ns, passing)
    entries += _logged("/zoe", flight.t_ns, hips(flight.joints, flight.position))
    write_log(folder, "people", "ros2-mcap", entries)
    flight.settings["actors"] = {name: {"file": "people", "topic": f"/{name}"} for name in ("abe", "zoe")}
    flight.save()


def hips(joints: tuple[str, ...], position: Float) -> Float:
    """Return the middle of the hips [T, 3]."""
    middle: Float = position[:, [joints.index(f"{side}_hip") for side in ("left", "right")]].mean(axis=1)
    return middle


def _logged(topic: str, t_ns: Int64, position: Float) -> list[Entry]:
    return [pose_entry(topic, stamp, at) for stamp, at in zip(t_ns.tolist(), position.tolist(), strict=True)]


def test_the_logged_actor_decides_who_it_is(tmp_path: Path) -> None:
    # Both people are seen by all cameras in every frame: nothing but the log tells the actor.
    flight = write_flight(tmp_path, cameras=3, bystander=True, clean=True)
    write_actor(flight, tmp_path)
    succeeds("ingest", flight.manifest)
    actor = pd.read_parquet(tmp_path / "flight.session" / "actor.parquet")
    assert list(actor["t_ns"]) == list(flight.t_ns)
    result = measured(tmp_path / "flight.session")
    assert result["mpjpe_mm"] < 0.5


def test_several_logged_people_are_reconstructed_under_their_names(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, bystander=True, clean=True)
    write_actors(flight, tmp_path)
    session = ingested(flight)
    succeeds("reconstruct", session, "--method", "robust")
    metrics = read_json(session / "reconstruct" / "metrics.json")
    assert metrics["people"]["names"] == ["abe", "zoe"]
    assert list(metrics["by_person"]) == ["abe", "zoe"]
    assert metrics["by_person"]["zoe"]["coverage"] == 1
    assert metrics["tracking"]["switches"] == 0
    assert metrics["tracking"]["misses"] == 0
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    for person, truth in enumerate((bystander_at(flight.t_ns), flight.position)):
        rows = skeleton[(skeleton["person"] == person) & (skeleton["joint"] == "nose")]
        found = rows[["x", "y", "z"]].to_numpy()
        there = np.isfinite(found[:, 0])
        assert there.mean() > 0.9
        np.testing.assert_allclose(found[there], truth[there, flight.joints.index("nose")], atol=1e-3)


@pytest.mark.parametrize("names", [["person1"], ["a/b"], ["ben", "Ben"]])
def test_names_of_people_that_cannot_be_in_file_names_are_refused(tmp_path: Path, names: list[str]) -> None:
    flight = write_flight(tmp_path, cameras=2, clean=True, seconds=0.2)
    flight.settings["actors"] = {name: {"file": "people", "topic": "/abe"} for name in names}
    flight.save()
    with pytest.raises(DataError):
        read_flight(flight.manifest)


@pytest.mark.parametrize("relative_to", ["world", "heading"])
def test_gimbal_angles_of_a_topic_do_not_lean_with_the_body(tmp_path: Path, relative_to: str) -> None:
    flight = write_flight(tmp_path, cameras=2, clean=True)
    lever_arm = np.array([0.0, 0.0, -0.2])
    for k, name in enumerate(flight.cameras):
        # A body that heads anywhere and leans; what looks at the actor is the gimbal alone.
        heading = quaternion_from_rotation_vector(np.array([0.0, 0.0, 0.3 + k]))
        body = multiply(heading, quaternion_from_rotation_vector(np.array([0.0, 0.2, 0.0])))
        body = multiply(body, quaternion_from_rotation_vector(np.array([-0.1, 0.0, 0.0])))
        logged_gimbal = multiply(flight.camera_quaternion[k], conjugate(body_from_camera("forward")))
        if relative_to == "heading":
            logged_gimbal = multiply(conjugate(heading), logged_gimbal)
        position = flight.camera_position[k] - rotate(body, lever_arm)
        entries: list[Entry] = []
        for stamp_ns, at, turned in zip(flight.t_ns, position, logged_gimbal, strict=True):
            entries += [
                pose_entry("/pose", stamp_ns, at.tolist(), body.tolist()),
                attitude_entry("/gimbal", stamp_ns, turned),
            ]
        write_log(tmp_path, f"{name}_log", "mcap-cdr", entries)
        camera = flight.settings["cameras"][name]
        camera["pose"] = {"file": f"{name}_log.mcap", "topic": "/pose", "of": "body"}
        camera["mount"] = {"looks": "forward", "translation": lever_arm.tolist()}
        camera["gimbal"] = {"file": f"{name}_log.mcap", "topic": "/gimbal", "relative_to": relative_to}
    flight.save()
    succeeds("ingest", flight.manifest)
    for k, name in enumerate(flight.cameras):
        poses = pd.read_parquet(tmp_path / "flight.session" / "cameras" / name / "poses.parquet")
        logged = poses[["qx", "qy", "qz", "qw"]].to_numpy()
        assert np.abs(poses[["x", "y", "z"]].to_numpy() - flight.camera_position[k]).max() < 1e-9
        assert np.abs(multiply(conjugate(flight.camera_quaternion[k]), logged)[:, :3]).max() < 1e-9


def test_a_floor_plan_is_read_again_when_its_picture_changes(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, clean=True)
    picture = np.full((4, 5), 254, np.uint8)
    cv2.imwrite(str(tmp_path / "site.png"), picture)
    (tmp_path / "site.yaml").write_text(
        "image: site.png\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.25\n",
        encoding="utf-8",
    )
    flight.settings["map"] = "site.yaml"
    flight.save()
    succeeds("ingest", flight.manifest)
    stored = tmp_path / "flight.session" / "session.json"
    assert read_json(stored)["map"]["occupied"] == 0
    assert "unchanged" in succeeds("ingest", flight.manifest)
    picture[2, 3] = 0
    cv2.imwrite(str(tmp_path / "site.png"), picture)
    done = mocap("ingest", flight.manifest)
    assert "written" in done.stdout
    described = read_json(stored)["map"]
    assert described["occupied"] == described["shape"][2]


def test_what_the_logs_of_a_gimbal_and_an_actor_lose_is_counted(tmp_path: Path) -> None:
    """Use invalid quaternions of a gimbal and invalid fixes of an actor, each in its own log."""
    flight = write_flight(tmp_path, cameras=2, clean=True)
    camera = flight.settings["cameras"]["drone1"]
    angles = [(0.0, 0.0, 0.0, 1.0)] * len(flight.t_ns)
    angles[3], angles[7] = (float("nan"), 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.5)
    entries = [
        attitude_entry("/gimbal", stamp_ns, turned)
        for stamp_ns, turned in zip(flight.t_ns, angles, strict=True)
    ]
    write_log(tmp_path, "gimbal", "mcap-cdr", entries)
    camera["pose"] |= {"of": "body"}
    camera["gimbal"] = {"file": "gimbal.mcap", "topic": "/gimbal", "relative_to": "world"}
    places = [(float("nan") if row == 9 else 47.5, 8.25, 400.0) for row in range(len(flight.t_ns))]
    fixes = [
        fix_entry("/tag", stamp_ns, place, status=-1 if row in {2, 5, 6} else 0)
        for row, (stamp_ns, place) in enumerate(zip(flight.t_ns, places, strict=True))
    ]
    write_log(tmp_path, "tag", "ros1", fixes)
    flight.settings["actor"] = {"file": "tag.bag", "topic": "/tag"}
    flight.settings["world"]["origin"] = {"latitude_deg": 47.5, "longitude_deg": 8.25, "altitude_m": 400}
    flight.save()
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0, done.stderr
    stored = read_json(tmp_path / "flight.session" / "session.json")
    no_fix, not_finite = stored["actor"]["dropped"].items()
    assert (no_fix[1], not_finite[1]) == (3, 1)
    assert stored["actor"]["count"] == len(flight.t_ns) - 4
    lost = stored["cameras"]["drone1"]["poses"]["dropped"]
    of_gimbal = [cause for cause, count in lost.items() if cause.startswith("gimbal angles: ") and count == 1]
    assert len(of_gimbal) == 2
    assert f"actor: dropped: 3 {no_fix[0]}, 1 {not_finite[0]}" in done.stderr
    assert f"drone1: poses dropped: 1 {of_gimbal[0]}" in done.stderr
    line = refused("ingest", flight.manifest, "--strict")
    assert f"actor: 3 {no_fix[0]}" in line
    assert of_gimbal[0] in line
