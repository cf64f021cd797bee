"""Slots about the actor: yaw, tilt and range of every camera, and the motion of a formation between them."""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached

YAW, TILT, RANGE = range(3)
"""Indices of a slot: yaw (rad, counterclockwise from east), tilt (rad above the actor), range (m)."""


def spacing_rad(drones: int) -> float:
    """Return the yaw between neighbours: equal parts of a turn, but 90 deg for two.

    Two cameras must not face each other.
    """
    return np.pi / 2 if drones == 2 else 2 * np.pi / drones


def formation_slots(yaw_rad: Float, drones: int, *, tilt_rad: float, range_m: float) -> Float:
    """Return the slots [..., n, 3] of a formation whose first camera has these yaws [...]."""
    slots = np.empty((*np.shape(yaw_rad), drones, 3))
    slots[..., YAW] = np.asarray(yaw_rad)[..., None] + spacing_rad(drones) * np.arange(drones)
    slots[..., TILT] = tilt_rad
    slots[..., RANGE] = range_m
    return slots


def slot_offsets(slots: Float) -> Float:
    """Compute offsets from the actor to slots [..., 3]: metres, world (Ho et al., Sec. IV-A)."""
    yaw, tilt, distance = np.moveaxis(slots, -1, 0)
    level = distance * np.cos(tilt)
    return np.stack([level * np.cos(yaw), level * np.sin(yaw), distance * np.sin(tilt)], axis=-1)


def turned(slots: Float, angle_rad: Float) -> Float:
    """Convert slots [..., n, 3] whose yaws count from angles [...] to yaws from east."""
    result = np.array(slots)
    result[..., YAW] += angle_rad[..., None]
    return result


def slot_of(offset: Float) -> Float:
    """Compute the slot [..., 3] of an offset from the actor, yaw within -pi..pi."""
    x, y, z = np.moveaxis(offset, -1, 0)
    level = np.hypot(x, y)
    return np.stack([np.arctan2(y, x), np.arctan2(z, level), np.hypot(level, z)], axis=-1)


def wrapped(angle_rad: Float) -> Float:
    """Wrap angles to -pi..pi, half open."""
    within: Float = (angle_rad + np.pi) % (2 * np.pi) - np.pi
    return within


def yaw_set(yaws: int, start_rad: float) -> Float:
    """Return equidistant yaws [D] over -pi..pi, half open, one of them the yaw of the start.

    So a formation without a reason to turn stays exactly at its first yaw.
    """
    turns = np.arange(yaws, dtype=np.float64) / yaws
    return np.sort(wrapped(start_rad + 2 * np.pi * turns))


@dataclass(frozen=True)
class FormationPath:
    """Commands of a formation: slots at knots, approached from the commanded ones at limited rates."""

    knot_s: Float  # [K + 1] the first is the time of planning
    slots: Float  # [K + 1, n, 3] the first are those commanded then; yaw is continuous
    rates: Float  # [3] rad/s, rad/s, m/s
    aim: Float | None = None  # [n, P] shares of people in the place that each camera films; None: the middle

    def at(self, t_s: Float) -> Float:
        """Return commanded slots [T, n, 3] at times [T]; constant before the first knot and after the last.

        From knot to knot slots move at the full rate and then wait. An even approach would never arrive,
        because plans are replaced many times before the next knot; cells beyond the neighbour would stay out
        of reach.
        """
        slots = np.empty((len(t_s), *self.slots.shape[1:]))
        _commanded(self.knot_s, self.slots, self.rates, t_s, slots)
        return slots


@cached
def _commanded(knot_s: Float, slots: Float, rates: Float, t_s: Float, found: Float) -> None:
    last = knot_s.size - 1
    for p in range(t_s.size):
        k = 0
        while k < last and knot_s[k + 1] <= t_s[p]:
            k += 1
        after_s = max(t_s[p] - knot_s[k], 0.0)
        for i in range(slots.shape[1]):
            for axis in range(3):
                start = slots[k, i, axis]
                way = slots[min(k + 1, last), i, axis] - start
                most = rates[axis] * after_s
                found[p, i, axis] = start + min(max(way, -most), most)
