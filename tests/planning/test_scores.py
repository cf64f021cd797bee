"""Figures of flights that are known by construction."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import open_space
from pipelines.planning.formation import formation_slots, slot_offsets
from pipelines.planning.scores import predicted_errors, propulsion_w, score
from tests.planning.worlds import wall

CONFIG = PlannerConfig()
T_S = np.arange(0, 20.001, 0.02)


def ring(drones: int, tilt_deg: float, *, rate_rad_per_s: float = 0.0) -> tuple[Float, Float]:
    actor = np.stack([0 * T_S + 5, 0 * T_S, 0 * T_S + 1], axis=1)
    yaw = rate_rad_per_s * T_S
    slots = formation_slots(yaw, drones, tilt_rad=np.radians(tilt_deg), range_m=10.0)
    return actor + np.swapaxes(slot_offsets(slots), 0, 1), actor


def test_a_still_formation_in_the_open() -> None:
    position, actor = ring(2, 30.0)
    figures = score(T_S, position, actor, open_space(), CONFIG)
    assert figures["tilt_deg"] == pytest.approx({"mean": 30, "max": 30})
    assert figures["range_m"] == pytest.approx({"mean": 10, "min": 10, "max": 10})
    assert figures["yaw_separation_deg"] == pytest.approx({"mean": 90, "min": 90, "max": 90})
    assert figures["occluded_share"] == 0
    assert figures["min_clearance_m"] is None
    assert figures["undetermined_share"] == 0
    assert figures["max_speed_mps"] == pytest.approx(0)
    assert figures["limit_violations"] == dict.fromkeys(
        ("speed", "acceleration", "jerk", "separation", "collision", "clearance", "actor"), 0
    )
    assert figures["min_separation_m"] == pytest.approx(10 * np.cos(np.radians(30)) * np.sqrt(2))
    # cos gamma = cos^2 30 cos 90 + sin^2 30 = 1/4; the detector's errors are those at 30 deg.
    errors = CONFIG.tuning.errors
    keypoint_m, placed = (
        np.interp(30.0, errors.tilts_deg, values) for values in (errors.keypoint_sigma_m, errors.placed_share)
    )
    s2 = (keypoint_m**2 + (10 * np.radians(1.0)) ** 2 + 0.3**2) / placed
    error = np.sqrt(s2 * (0.5 + 2 / (1 - 1 / 16)))
    assert figures["predicted_error_m"] == pytest.approx({"median": error, "p95": error})
    assert predicted_errors(position, actor, open_space(), CONFIG) == pytest.approx(np.full(len(T_S), error))


def test_the_energy_of_hovering_turning_and_climbing() -> None:
    """Hovering takes P0 + Pi; a circle of 10 m at 0.5 rad/s that of 5 m/s; climbing the weight besides.

    Chords at 10 Hz are shorter than the arc by (w h)^2/24, 1e-4.
    """
    hover_w = 79.8563 + 88.6279
    assert propulsion_w(np.zeros(1), np.zeros(1))[0] == pytest.approx(hover_w)
    assert propulsion_w(np.zeros(1), np.array([2.0]))[0] == pytest.approx(hover_w + 40.0)
    assert propulsion_w(np.zeros(1), np.array([-2.0]))[0] == pytest.approx(hover_w)
    # The published model is least between 9 and 11 m/s (10.2 m/s there).
    speeds = np.linspace(0, 20, 201)
    assert speeds[propulsion_w(speeds, 0 * speeds).argmin()] == pytest.approx(10.2, abs=0.2)
    position, actor = ring(2, 0.0, rate_rad_per_s=0.5)
    figures = score(T_S, position, actor, open_space(), CONFIG)
    seconds = float(T_S[-1] - T_S[0])
    assert figures["path_m"] == pytest.approx(5.0 * seconds, rel=2e-4)
    assert figures["energy_kj"] == pytest.approx(
        propulsion_w(np.full(1, 5.0), np.zeros(1))[0] * seconds / 1e3, rel=2e-4
    )
    assert figures["blind_s"] == 0
    assert figures["min_actor_distance_m"] == pytest.approx(10.0)


def test_what_the_wall_hides_and_who_flies_into_it() -> None:
    """Two cameras at 90 deg, one of them behind the wall from 5 s to 10 s, through its middle."""
    position, actor = ring(2, 0.0)
    behind = (T_S >= 5) & (T_S < 10)
    position[1, behind] = [5.0, 8.0, 1.0]
    position[1, ~behind] = [5.0, -10.0, 1.0]
    figures = score(T_S, position, actor, wall(), CONFIG)
    assert figures["occluded_share"] == pytest.approx(0.5 * behind.mean())
    assert figures["undetermined_share"] == pytest.approx(behind.mean())
    assert figures["blind_s"] == pytest.approx(5.0, abs=0.05)
    assert figures["min_clearance_m"] == pytest.approx(-1.0, abs=0.5)  # the wall covers y = 6.5 to 9.5
    assert isinstance(figures["limit_violations"], dict)
    assert figures["limit_violations"]["collision"] == figures["limit_violations"]["clearance"] == 1
    assert figures["tilt_deg"] == pytest.approx({"mean": 0, "max": 0}, abs=1e-9)
