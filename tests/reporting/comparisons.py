"""A comparison of planners in closed form: an actor who walks east, drones on a circle about him, a block."""

from typing import Any

import numpy as np
import pandas as pd

from pipelines.reporting.content import ReplanContent
from pipelines.session.records import Occupancy
from pipelines.session.tables import ACTOR, REPLAN

from .conftest import START_NS, _looking_at

TIMES = 501
RATE_HZ = 50
DRONES = ("drone1", "drone2")
RANGE_M = 10.0
SPEED_MPS = 1.0
HIDDEN_S = (2.0, 4.0)
"""Seconds from and to which drone1 of `fixed` sees nothing."""
BLOCK = (slice(20, 28), slice(50, 56), slice(0, 10))
"""Voxels of 0.5 m that rise from the ground of one layer: 8 x 6 columns, 4.5 m above it."""


def seconds() -> np.ndarray:
    return np.arange(TIMES) / RATE_HZ


def stamps() -> np.ndarray:
    stamps: np.ndarray = START_NS + np.round(1e9 * seconds()).astype(np.int64)
    return stamps


def actor() -> np.ndarray:
    """Return the actor's positions [T, 3] m."""
    t_s = seconds()
    return np.stack([SPEED_MPS * t_s, 0 * t_s, 1 + 0 * t_s], axis=-1)


def yaw_deg(arm: str) -> np.ndarray:
    """Return the yaw [T] of the first drone: `adaptive` turns by 10 deg/s, the others stay."""
    return 45 + (10 * seconds() if arm == "adaptive" else 0 * seconds())


def tilt_deg(arm: str) -> np.ndarray:
    """Return the tilt [T] of all drones: 15 deg, rising by 1 deg/s where the arm is not `adaptive`."""
    return 15 + (0 * seconds() if arm == "adaptive" else seconds())


def positions(arm: str, drone: int) -> np.ndarray:
    """Return a drone's positions [T, 3] m."""
    yaw, tilt = np.radians(yaw_deg(arm) + 90 * drone), np.radians(tilt_deg(arm))
    way = np.stack([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)], axis=-1)
    return actor() + RANGE_M * way


def make_arm(arm: str) -> pd.DataFrame:
    t_s, tables = seconds(), []
    for k, name in enumerate(DRONES):
        position = positions(arm, k)
        table = pd.DataFrame({"t_ns": stamps(), "camera": name})
        table[["x", "y", "z"]] = position
        table[["qx", "qy", "qz", "qw"]] = _looking_at(position, actor())
        logged = arm == "flown"
        table["formation_yaw_rad"] = np.nan if logged else np.radians(yaw_deg(arm))
        table["slot_yaw_rad"] = np.nan if logged else np.radians(yaw_deg(arm) + 90 * k)
        table["slot_tilt_rad"] = np.nan if logged else np.radians(15)
        table["slot_range_m"] = np.nan if logged else RANGE_M
        table["tilt_rad"] = np.radians(tilt_deg(arm))
        hidden = (arm == "fixed") & (k == 0) & (t_s >= HIDDEN_S[0]) & (t_s < HIDDEN_S[1])
        table["visible"] = ~hidden
        alone = (arm == "fixed") & (t_s >= HIDDEN_S[0]) & (t_s < HIDDEN_S[1])
        table["predicted_error_m"] = np.where(alone, np.nan, {"adaptive": 0.3}.get(arm, 0.5))
        table["known"] = True
        tables.append(table[REPLAN.names])
    rows: pd.DataFrame = pd.concat(tables).sort_values(["t_ns", "camera"]).reset_index(drop=True)
    return rows


def make_map() -> Occupancy:
    probability = np.full((80, 100, 20), 0.1, dtype=np.float32)
    probability[:, :, 0] = 0.9
    probability[BLOCK] = 0.9
    probability[:5, :, 5:] = np.nan
    return Occupancy(probability, np.array([-20.0, -25.0, 0.0]), 0.5)


def _estimate(mean: float, low: float, high: float) -> dict[str, object]:
    return {"mean": mean, "interval": [low, high]}


def make_scores(arm: str) -> dict[str, object]:
    return {
        "tilt_deg": {"mean": 17.25, "max": 23.5},
        "drones": len(DRONES),
        "range_m": {"mean": 10.0, "min": 9.25, "max": 10.75},
        "occluded_share": 0.125,
        "blind_s": 1.25,
        "path_m": 87.5,
        "energy_kj": 12.75,
        "min_clearance_m": -0.25,
        "min_separation_m": 14.125,
        "limit_violations": {"speed": 0, "collision": 3, "separation": 0},
        "predicted_error_m": {"median": 0.3125, "p95": 0.5},
        "mpjpe_mm": 61.0,
        "simulated": arm != "flown",
        "reconstruction_error": {
            "simulated": True,
            "pck150": _estimate(0.75, 0.6875, 0.8125),
            "mpjpe_mm": _estimate(61.0, 58.5, 63.5),
            "coverage": _estimate(0.875, 0.8125, 0.9375),
        },
    }


def make_comparison(*arms: str, verdict: str = "adaptive is better") -> ReplanContent:
    """Make the stored comparison of some arms; `adaptive`, `fixed` and `flown` by default."""
    arms = arms or ("adaptive", "fixed", "flown")
    metrics: dict[str, Any] = {
        "schema": 1,
        "drones": 2,
        "yaw_deg": 45.0,
        "duration_s": 10.0,
        "skeleton": "truth",
        "trials": 20,
        "intervals": {"level": 0.95},
        "arms": {arm: make_scores(arm) for arm in arms},
        "differences": [
            {
                "arm": arm,
                "against": arms[1],
                "tilt_deg": _estimate(-5.0, -5.5, -4.5),
                "occluded_share": _estimate(-0.0625, -0.125, 0.0),
                "pck150": _estimate(0.0625, 0.03125, 0.09375),
                "mpjpe_mm": _estimate(1.5, 1.25, 1.75),
                "coverage": None,
            }
            for arm in arms
            if arm != arms[1]
        ],
        "equal_ranges": [{"arms": list(arms), "best": None}],
        "verdict": verdict,
        "notes": [f"formations start at 45.0 deg, where {DRONES[0]} was"],
        "warnings": [],
    }
    table = pd.DataFrame({"t_ns": stamps(), "person": 0})
    table[["x", "y", "z"]] = actor()
    return ReplanContent(
        metrics=metrics, arms={arm: make_arm(arm) for arm in arms}, actor=table[ACTOR.names], map=make_map()
    )
