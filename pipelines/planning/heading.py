"""The actor's heading, and the zero of a formation's yaws."""

from __future__ import annotations

import math

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.planning.config import PlannerConfig

_SURE = 3.0  # standard deviations of the speed; its direction is used only above
_FIRST_WAY_M = 1.0


class YawZero:
    """The direction that yaws count from, over time: east, or with `yaw_frame` `heading` the actor's.

    The heading is the level direction of the filtered velocity. The actor stands if the level speed is below
    `heading_speed_mps`, or below three of its standard deviations; then the last heading holds, and before
    the first one `heading_rad`. The zero follows the heading the shorter way, no faster than a formation
    turns: an actor who turns on the spot must not send drones through the middle.

    Args:
        config: `yaw_frame`, `heading_speed_mps`, `yaw_rate_deg_per_s`.
        heading_rad: before the first one, counterclockwise from east; no matter in the world frame.
    """

    def __init__(self, config: PlannerConfig, heading_rad: float = 0.0) -> None:
        self._least_mps, self._rate = config.heading_speed_mps, config.slot_rates[0]
        self._from_s = 0.0
        self._from = self._goal = heading_rad if config.yaw_frame == "heading" else 0.0

    def follow(self, t_s: float, velocity: Float, covariance: Float) -> None:
        """Update the zero with the actor's motion.

        Args:
            t_s: now, not before an earlier one.
            velocity: [3] m/s.
            covariance: [2, 2] of position and velocity, per axis.
        """
        self._from, self._from_s = float(self.at(np.array([t_s]))[0]), t_s
        speed_mps = math.hypot(velocity[0], velocity[1])
        if speed_mps >= max(self._least_mps, _SURE * math.sqrt(covariance[1, 1])):
            way = math.atan2(velocity[1], velocity[0]) - self._from
            self._goal = self._from + math.remainder(way, 2 * math.pi)

    def at(self, t_s: Float) -> Float:
        """Return angles [T] from east, without jumps, at times [T] from the last `follow` on."""
        most = self._rate * np.maximum(t_s - self._from_s, 0.0)
        zero: Float = self._from + np.clip(self._goal - self._from, -most, most)
        return zero


def first_heading(actor: Float) -> float:
    """Find the direction in which a logged actor [A, 3] m first walks, counterclockwise from east.

    Rows with NaN were not measured. 0 for an actor who never comes a metre away from the first position.
    """
    level = actor[np.isfinite(actor).all(axis=1), :2]
    away = level - level[:1]
    far = np.hypot(away[:, 0], away[:, 1]) >= _FIRST_WAY_M
    if not far.any():
        return 0.0
    east_m, north_m = away[far.argmax()]
    return math.atan2(north_m, east_m)
