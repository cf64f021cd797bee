"""Cameras that take their pictures at different times, at different rates, or irregularly."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.session.description import read_description
from pipelines.session.storage import read_json
from tests.commands.runner import ingested, mocap, result_of, succeeds
from tests.synthetic.flights import START_NS, SyntheticFlight, film_at, write_flight

# Between two pictures a joint is taken to move in a straight line in the picture. A foot in mid swing is
# accelerated by at most some 60 m/s^2, so that a period T costs up to a T^2 / 8: 8 mm at 30 Hz at the
# worst moment, and a tenth of that in the mean over all joints and times.
INTERPOLATED_MM = 1.5


def measured(flight: SyntheticFlight, *options: str) -> dict[str, Any]:
    session = ingested(flight)
    return result_of("reconstruct", session, "--method", "robust", *options)


def test_shutters_that_are_not_synchronised(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, clean=True)
    film_at(flight, "drone2", flight.t_ns + 11_000_000)
    film_at(flight, "drone3", flight.t_ns - 7_000_000)
    flight.save()
    result = measured(flight)
    assert result["mpjpe_mm"] < INTERPOLATED_MM
    assert result["reconstructed_share"] == 1.0


def test_clock_offset_that_is_stated_is_applied(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, clean=True)
    # The video's clock shows 0.2 s too little: world time = video time + 0.2 s.
    film_at(flight, "drone2", flight.t_ns)
    times = flight.manifest.parent / "drone2_times.csv"
    table = pd.read_csv(times)
    table["t_ns"] -= 200_000_000
    table.to_csv(times, index=False)
    flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": 0.2, "sigma_s": 0}
    flight.save()
    right_mm = measured(flight)["mpjpe_mm"]
    assert right_mm < 0.5
    flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": -0.2, "sigma_s": 0}
    flight.save()
    # The other sign is 0.4 s off: the walk goes on by half a metre meanwhile, and the drone with it.
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0
    wrong = mocap(
        "reconstruct", flight.manifest.with_suffix(".session"), "--method", "robust", "--json", "-q"
    )
    assert wrong.returncode == 1 or json.loads(wrong.stdout)["mpjpe_mm"] > 100 * right_mm


def test_missing_picture_is_not_bridged(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, clean=True)
    times = pd.DataFrame({"frame": np.arange(len(flight.t_ns)), "t_ns": flight.t_ns}).drop(index=10)
    times.to_csv(tmp_path / "times.csv", index=False)
    flight.settings["cameras"]["drone2"]["frame_times"] = {"file": "times.csv"}
    flight.save()
    measured(flight)
    skeleton = pd.read_parquet(tmp_path / "flight.session" / "reconstruct" / "skeleton.parquet")
    at_gap = skeleton[skeleton["t_ns"] == flight.t_ns[10]]
    assert set(at_gap["status"]) == {"few_views"}
    assert set(skeleton[skeleton["t_ns"] != flight.t_ns[10]]["status"]) == {"ok"}


def test_truth_is_not_bridged_over_missing_samples(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, clean=True)
    truth = pd.read_csv(tmp_path / "truth.csv")
    gone = truth["t_ns"].isin(flight.t_ns[10:16])
    truth[~gone].to_csv(tmp_path / "truth.csv", index=False)
    result = measured(flight)
    assert result["mpjpe_mm"] < 0.05
    assert result["joint_frames"] == (len(flight.t_ns) - 6) * len(flight.joints)


def test_guesses_stay_visible_until_they_are_confirmed(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, clean=True)
    cameras = flight.settings["cameras"]
    cameras["drone1"]["frame_times"]["assumed"] = True
    # The keypoints of drone3 count from 0, as its clock says: nothing else states when it began.
    cameras["drone3"] |= {"frame_times": {"fps": 30}, "clock": {"offset_s": START_NS // 10**9, "sigma_s": 0}}
    flight.save()
    told = mocap("ingest", flight.manifest).stderr
    session = read_json(tmp_path / "flight.session" / "session.json")
    assert session["assumptions"] == ["cameras.drone1.frame_times"]
    assert "cameras.drone1.frame_times" in told
    starts = {name: camera["clock"]["start"] for name, camera in session["cameras"].items()}
    assert starts == {"drone1": "assumed", "drone2": "stated", "drone3": "stated"}
    succeeds("reconstruct", tmp_path / "flight.session", "--method", "robust")
    record = read_json(tmp_path / "flight.session" / "reconstruct" / "stage.json")
    assert any("cameras.drone1.frame_times" in line for line in record["warnings"])
    del cameras["drone1"]["frame_times"]["assumed"]
    flight.save()
    succeeds("ingest", flight.manifest)
    session = read_json(tmp_path / "flight.session" / "session.json")
    assert not session["assumptions"]


def test_a_start_that_nothing_states_is_unknown_by_half_a_second(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, clean=True, static=True)
    for camera in flight.settings["cameras"].values():
        camera["frame_times"] = {"fps": 30}
        del camera["clock"]
    del flight.settings["truth"]
    flight.save()
    succeeds("ingest", flight.manifest)
    for camera in read_description(tmp_path / "flight.session").cameras.values():
        assert camera.clock.start == "none"
        assert camera.clock.prior_sigma_s == 0.5
