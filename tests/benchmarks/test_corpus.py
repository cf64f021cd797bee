"""Tests of the corpus: valid scenarios, all parts in both halves, and one flight that is measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.accuracy import FLOOR, Case, measure_draw, nees, peak_ratio
from benchmarks.corpus.drawn import DrawnFlight, SharedError, kept_in_place_of_pictures, shared_error
from benchmarks.corpus.stored import (
    CORPUS,
    HALVES,
    SAMPLE,
    Background,
    Flight,
    Half,
    Keypoints,
    flights,
    read_backgrounds,
    read_keypoints,
    write_backgrounds,
    write_keypoints,
)
from pipelines.detect import detect
from pipelines.follow import Following
from pipelines.ingest import ingest
from pipelines.reconstruct import Settings, reconstruct
from pipelines.session.registries import noise_models
from pipelines.session.stages import locked
from pipelines.simulation.scenario import Scenario

_MOST_BYTES = 30 * 2**20


def _own(half: Half) -> list[Flight]:
    return [flight for flight in flights([half]) if flight.name != SAMPLE.name]


def _motions(scenario: Scenario) -> set[str]:
    found = set()
    for person in scenario.people.values():
        steps = person.motion.steps or []
        found |= {name for step in steps for name in step.model_fields_set}
        if person.motion.bvh is not None:
            found.add("recorded")
    return found


@pytest.mark.parametrize("half", HALVES)
def test_each_half_holds_all_parts(half: Half) -> None:
    own = _own(half)
    scenarios = [flight.scenario for flight in own]
    assert len(own) == 12
    assert {scenario.drones.count for scenario in scenarios} == {2, 3, 4}
    together = set[str]().union(*map(_motions, scenarios))
    assert together >= {"walk", "jog", "kick", "crouch", "reach", "turn", "stand", "recorded"}
    assert sum(scenario.schema_version == 2 for scenario in scenarios) == 6
    assert sum(any(scenario.drones.clock_offsets_s) for scenario in scenarios) == 2
    assert sum(scenario.actors is not None for scenario in scenarios) >= 1
    assert sum(not flight.with_pictures for flight in own) == 2
    rates = {scenario.drones.formation.yaw_rate_deg_per_s == 0 for scenario in scenarios}
    assert rates == {True, False}, "hovering and moving formations"


@pytest.mark.parametrize("half", HALVES)
def test_each_half_has_every_kind_of_pose_error_at_two_levels(half: Half) -> None:
    kinds = []
    for flight in _own(half):
        stated = flight.scenario.drones.pose_noise
        noise_models(flight.name, stated)
        (first, *more) = stated.items()
        frame = first[1].get("frame", "")
        kinds.append("mixture" if more else f"{first[0]} {frame}")
    assert sorted(kinds) == sorted(
        2 * ["white ", "bias world", "bias body", "drift ", "gauss-markov ", "mixture"]
    )


def test_three_flights_have_a_second_person() -> None:
    assert sum(flight.scenario.actors is not None for flight in flights()) == 3


def test_no_flight_is_in_both_halves_and_each_is_described() -> None:
    names = [flight.name for flight in flights()]
    assert len(names) == len(set(names)) == 25
    text = (CORPUS / "README.md").read_text(encoding="utf-8")
    assert [name for name in names if name not in text] == []


def test_the_corpus_is_at_most_30_mb() -> None:
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) <= _MOST_BYTES


def test_keypoints_and_tracks_come_back_rounded(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    joints = ("nose", "left_hip")
    table = pd.DataFrame(
        {
            "frame": np.repeat(np.arange(50), 2),
            "person": 0,
            "joint": np.tile(np.array(joints, dtype=object), 50),
            "x": rng.uniform(-80, 1500, 100),
            "y": rng.uniform(-80, 900, 100),
            "confidence": rng.uniform(0, 1, 100),
        }
    )
    write_keypoints(tmp_path / "k.parquet", Keypoints(joints, {"drone1": {"frames": 50}}, {"drone1": table}))
    back = read_keypoints(tmp_path / "k.parquet")
    assert back.joints == joints
    assert back.counts == {"drone1": {"frames": 50}}
    pd.testing.assert_frame_equal(back.tables["drone1"], table, check_exact=False, atol=0.05001, rtol=0)
    seen = pd.DataFrame({"frame": np.repeat(np.arange(20), 3), "point": np.tile(np.arange(3), 20)})
    seen[["x", "y"]] = rng.uniform(0, 1500, (60, 2))
    flight = Flight("tuning", tmp_path)
    write_backgrounds(flight, {"drone1": Background(seen, {7: b"still"})})
    (background,) = read_backgrounds(flight).values()
    pd.testing.assert_frame_equal(background.tracks, seen, check_exact=False, atol=0.02501, rtol=0)
    assert background.stills == {7: b"still"}


def test_robust_is_measured_on_a_flight(tmp_path: Path) -> None:
    """Errors of a few centimetres in the poses: more than with true poses, less than half a metre."""
    flight = next(each for each in flights(["tuning"]) if each.name == "01-walk")
    found = {}
    for method in ("robust", FLOOR):
        drawn = DrawnFlight(flight, tmp_path / "shared")
        ((case, outcome),) = measure_draw(drawn, [Case(flight.name, method, "blazepose")], {})
        found[case.method] = outcome
    robust, floor = found["robust"], found[FLOOR]
    assert robust.error is None
    assert floor.mpjpe_mm is not None
    assert robust.mpjpe_mm is not None
    assert floor.mpjpe_mm < 60 < robust.mpjpe_mm < 500
    assert robust.measured_share is not None
    assert robust.measured_share > 0.9
    assert robust.nees is not None


def test_clocks_that_are_all_late_are_found_from_the_backgrounds(tmp_path: Path) -> None:
    """None is known, so none serves as the reference. Stated deviations are some 5 ms."""
    (flight,) = (flight for flight in flights(["tuning"]) if flight.name == "23-jog-and-crouch")
    drawn = DrawnFlight(flight, tmp_path / "shared")
    drawn.write_shared()
    place = tmp_path / "draw"
    session = drawn.session(place, 0, "model", "blazepose")
    text = (place / "flight.yaml").read_text(encoding="utf-8")
    late = text.replace("clock: {offset_s: 0, sigma_s: 0}", "clock: {offset_s: -0.12, sigma_s: 0.2}")
    assert late.count("-0.12") == 3
    (place / "flight.yaml").write_text(late, encoding="utf-8")
    ingest(place / "flight.yaml", session)
    with kept_in_place_of_pictures(flight, "blazepose"):
        with locked(session) as writable:
            detect(writable, detector="blazepose")
            Following(writable).finish()
        metrics = reconstruct(session, Settings(people=1, detector="blazepose")).metrics
    assert metrics["method_used"]["clocks"] == ["drone1", "drone2", "drone3"]
    for name, offset_s in metrics["clock_offsets_s"].items():
        sigma_s = metrics["clock_offset_sigmas_s"][name]
        assert 0 < sigma_s < 0.01
        assert abs(offset_s - 0.12) < 4 * sigma_s


def test_the_error_that_all_cameras_share_is_found(tmp_path: Path) -> None:
    """A rigid motion of all logs is found as it is, and moves the true poses onto them."""
    flight = next(each for each in flights(["tuning"]) if each.name == "01-walk")
    simulated = DrawnFlight(flight, tmp_path / "shared").simulated
    about = simulated.people[0].joints.mean(axis=(0, 1))
    error = SharedError(about, np.array([0.1, -0.2, 0.05]), np.array([0.01, 0.0, -0.02]))
    drones = []
    for drone in simulated.drones:
        position, quaternion = error.moved(drone.at_log)
        moved = replace(drone.log.camera, position=position, quaternion_xyzw=quaternion)
        drones.append(replace(drone, log=replace(drone.log, camera=moved)))
    found = shared_error(replace(simulated, drones=drones))
    # Turns of 0.02 rad are linear to half their square, over 10 m.
    assert found.shift == pytest.approx(error.shift, abs=10 * 0.02**2)
    assert found.turn == pytest.approx(error.turn, abs=0.02**2)


def test_the_squared_error_has_three_degrees_of_freedom() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(20_000, 3, 3))
    error = np.einsum("nij,nj->ni", root, rng.normal(size=(20_000, 3)))
    squared = nees(error, root @ np.swapaxes(root, 1, 2))
    # The mean of 20,000 chi-square values with 3 degrees of freedom has a deviation of sqrt(6 / 20,000).
    assert np.mean(squared) == pytest.approx(3, abs=5 * np.sqrt(6 / 20_000))


def test_the_peak_speed_of_a_shrunk_swing_is_as_much_smaller() -> None:
    t_ns = np.arange(0, 6 * 10**9, 4 * 10**7)
    swing = np.sin(2 * np.pi * t_ns / 1e9)
    truth = np.zeros((len(t_ns), 2, 3))
    truth[:, 0, 0] = swing
    joints = ("left_wrist", "nose")
    assert peak_ratio(0.8 * truth, truth, joints, t_ns) == pytest.approx(0.8)
    assert peak_ratio(truth, 0.01 * truth, joints, t_ns) is None, "slower than 1 m/s"
