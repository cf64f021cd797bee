"""`mocap reconstruct --method refined` as a command."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.session.people import mirrored
from pipelines.session.storage import read_json
from tests.commands.runner import ingested, measured, mocap, result_of, succeeds
from tests.synthetic.flights import SyntheticFlight, write_flight

NOISE = {"white": {"position_m": 0.2, "rotation_deg": 0.7}}
GOOD = {"white": {"position_m": 0.02, "rotation_deg": 0.1}}


def test_refined_halves_the_error_of_noisy_poses_and_writes_them(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, seconds=1.5, pose_noise=NOISE)
    session = ingested(flight)
    trusting = measured(session)
    metrics = result_of("reconstruct", session, "--method", "refined")
    assert metrics["refinement"]["fallback"] is None
    # White errors are independent from picture to picture; a smooth walk averages a dozen and more.
    assert metrics["mpjpe_mm"] < 0.5 * trusting["mpjpe_mm"]
    # True poses make narrow gates: at most the joint-frames with a missing or wrong view (12 %) go.
    assert metrics["reconstructed_share"] > trusting["reconstructed_share"] - 0.12
    assert metrics["clock_offsets_s"] == dict.fromkeys(flight.cameras, 0.0)

    cameras = pd.read_parquet(session / "reconstruct" / "cameras.parquet")
    assert list(cameras.groupby("camera").size()) == [len(flight.t_ns)] * 3
    errors = []
    for c, name in enumerate(flight.cameras):
        own = cameras[cameras["camera"] == name]
        assert (own["t_ns"].to_numpy() == flight.t_ns).all()
        apart = own[["x", "y", "z"]].to_numpy() - flight.camera_position[c]
        errors.append(np.linalg.norm(apart, axis=-1).mean())
    # The log's own errors are 0.2 m on each of three axes.
    assert np.mean(errors) < 0.2 * np.sqrt(3)


def test_refined_takes_the_sides_on_which_the_views_agreed(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=4, seconds=1.5, pose_noise=GOOD)
    # A camera that calls left right all the time: only the other cameras tell.
    exchange_sides(tmp_path / "drone1.json", flight.joints)
    session = ingested(flight)
    robust = measured(session)
    refined = result_of("reconstruct", session, "--method", "refined")
    counts = read_json(session / "reconstruct" / "stage.json")["counts"]
    assert counts["left_right_swaps"]["between_views"]["undone"] > 0
    # With a quarter of the views on the wrong sides it is no better than what it started from.
    assert refined["refinement"]["fallback"] is None
    assert refined["mpjpe_mm"] < 0.5 * robust["mpjpe_mm"]


def a_second_late(folder: Path) -> SyntheticFlight:
    """Write a flight with a wrong clock that is stated as known; no pose errors explain its keypoints.

    The three other cameras determine the noise of the keypoints. With two others, lasting errors of keypoints
    explain the wrong clock as well.
    """
    flight = write_flight(folder, cameras=4, seconds=2.5, pose_noise={})
    flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": 1.0, "sigma_s": 0}
    return flight


def half_a_second_long(folder: Path) -> SyntheticFlight:
    """Write a flight too short for refinement; its cameras are still, so `robust` uses its own loss."""
    flight = write_flight(folder, cameras=3, seconds=0.5, static=True)
    for camera in flight.settings["cameras"].values():
        del camera["pose_noise"]
    return flight


@pytest.mark.parametrize("written", [a_second_late, half_a_second_long])
def test_refined_falls_back_to_what_robust_gives_and_says_why(
    written: Callable[[Path], SyntheticFlight], tmp_path: Path
) -> None:
    flight = written(tmp_path)
    flight.save()
    session = ingested(flight)
    robust = measured(session)
    skeleton = (session / "reconstruct" / "skeleton.parquet").read_bytes()

    done = mocap("reconstruct", session, "--method", "refined", "--json")
    assert done.returncode == 0
    refined = json.loads(done.stdout)
    reason = refined["refinement"]["fallback"]
    assert reason
    assert any("robust" in line and line.endswith(reason) for line in done.stderr.splitlines())
    assert (session / "reconstruct" / "skeleton.parquet").read_bytes() == skeleton
    assert not (session / "reconstruct" / "cameras.parquet").exists()
    of_refined_alone = {"method", "method_used", "clock_offsets_s"}
    assert {name: refined[name] for name in robust.keys() - of_refined_alone} == {
        name: robust[name] for name in robust.keys() - of_refined_alone
    }
    assert set(refined["clock_offsets_s"].values()) == {0.0}


def exchange_sides(keypoints: Path, joints: tuple[str, ...]) -> None:
    """Name all left joints of an AlphaPose file right, and all right ones left."""
    mirror = [joints.index(mirrored(joint)) for joint in joints]
    people = json.loads(keypoints.read_text(encoding="utf-8"))
    for person in people:
        person["keypoints"] = np.reshape(person["keypoints"], (-1, 3))[mirror].ravel().tolist()
    keypoints.write_text(json.dumps(people), encoding="utf-8")


def test_a_person_whose_views_show_two_bodies_moves_no_cameras(tmp_path: Path) -> None:
    """Move the bystander in one camera by 25 px, 0.25 m at 10 m; the logs explain 0.1 m and 0.3 deg, 0.11 m.

    Their views still fit each other within the gates. The first person must come out as without them.
    """

    def reconstructed(name: str, people: int) -> dict[str, Any]:
        session = tmp_path / f"{name}.session"
        succeeds("ingest", flight.manifest, "-o", session)
        options = ("--method", "refined", "--persons", str(people), "--json")
        found: dict[str, Any] = json.loads(succeeds("reconstruct", session, *options))
        assert found["refinement"]["fallback"] is None
        return found

    noise = {"white": GOOD["white"], "bias": {"position_m": 0.1, "rotation_deg": 0.3}}
    flight = write_flight(tmp_path, cameras=3, seconds=1.5, bystander=True, pose_noise=noise)
    alone = reconstructed("alone", 1)
    both = reconstructed("both", 2)
    assert both["people"]["doubted"] == {}

    keypoints = tmp_path / "drone2.json"
    rows = json.loads(keypoints.read_text(encoding="utf-8"))
    for row in rows:
        if row["idx"] == 2:
            row["keypoints"][0::3] = [x + 25.0 for x in row["keypoints"][0::3]]
            row["keypoints"][1::3] = [y + 25.0 for y in row["keypoints"][1::3]]
    keypoints.write_text(json.dumps(rows), encoding="utf-8")
    mixed = reconstructed("mixed", 2)
    assert mixed["people"]["doubted"] == {"person1": "residual"}
    error_mm, alone_mm = (each["by_person"]["person0"]["mpjpe_mm"] for each in (mixed, alone))
    assert error_mm < 1.1 * alone_mm
