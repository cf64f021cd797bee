"""Scores of a flight from positions over time: the same figures for every arm, replayed or flown."""

from itertools import combinations

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, visible
from pipelines.planning.formation import RANGE, TILT, YAW, slot_of, wrapped
from pipelines.planning.information import predicted_error, ray_information

Scores = dict[str, object]

NEAR_OBSTACLE_M = 15.0
_MOTION_HZ = 10.0  # speed, acceleration and jerk are means over this period: plans change at 5 Hz
_ROUNDING = 1.0 + 1e-6  # differences of positions; drones fly at their limits
_LOOKS_PER_S = 5.0  # rate of the search for obstacles near the slots


def score(
    t_s: Float,
    position: Float,
    actor: Float,
    field: DistanceField,
    config: PlannerConfig,
    *,
    near: Bool | None = None,
) -> Scores:
    """Compute the figures of one flight.

    Args:
        t_s: [T] seconds, ascending, at least four of them over half a second or more.
        position: [N, T, 3] metres, world, the cameras; finite.
        actor: [T, 3] metres, world; finite.
        field: the distance field of the last map.
        config: limits, `sight_start_m` and the ray model.
        near: [T] True while an obstacle is near (see `near_obstacle`); the same for all arms of a comparison.

    Returns:
        JSON-able: degrees and metres by name; None where there is nothing to count (no pair of drones,
        no obstacle at all, never near one). `limit_violations` counts episodes per drone (per pair for
        separation): in an obstacle (`collision`), within `drone_radius_m` of one (`clearance`), within
        `actor_distance_m` of the actor (`actor`), and beyond the other limits of the configuration.
        `predicted_error_m` is sqrt(tr S) of the ray model over the times at which two free views or more
        determine it, `undetermined_share` the share of the others.
    """
    slots = slot_of(position - actor)
    tilt_deg = np.degrees(slots[..., TILT])
    seen = visible(field, position, actor, start_m=config.sight_start_m)
    clearance = field.sample(position)[0]
    pairs = list(combinations(range(len(position)), 2))
    apart = np.array([np.linalg.norm(position[i] - position[j], axis=-1) for i, j in pairs])
    turned = np.array([wrapped(slots[j, :, YAW] - slots[i, :, YAW]) for i, j in pairs])
    error = predicted_error(_information(position - actor, seen, config))
    determined = np.isfinite(error)
    motion = _motion(t_s, position)
    limits = {"speed": config.speed_mps, "acceleration": config.acceleration_mps2, "jerk": config.jerk_mps3}
    violations = {
        "collision": _episodes(clearance <= 0.0),
        "clearance": _episodes(clearance < config.drone_radius_m),
        "actor": _episodes(slots[..., RANGE] < config.actor_distance_m),
        "separation": _episodes(apart < config.separation_m) if pairs else 0,
        **{name: _episodes(motion[name] > limit * _ROUNDING) for name, limit in limits.items()},
    }
    return {
        "tilt_deg": {
            "mean": float(tilt_deg.mean()),
            "max": float(tilt_deg.max()),
            "near_obstacle": None if near is None or not near.any() else float(tilt_deg[:, near].mean()),
        },
        "range_m": _spread(slots[..., RANGE]),
        "yaw_separation_deg": _spread(np.degrees(np.abs(turned))) if pairs else None,
        "occluded_share": float(1.0 - seen.mean()),
        "min_clearance_m": float(clearance.min()) if field.has_obstacles else None,
        "min_separation_m": float(apart.min()) if pairs else None,
        "max_speed_mps": float(motion["speed"].max()),
        "max_acceleration_mps2": float(motion["acceleration"].max()),
        "max_jerk_mps3": float(motion["jerk"].max()),
        "limit_violations": violations,
        "predicted_error_m": {
            "median": float(np.median(error[determined])) if determined.any() else None,
            "p95": float(np.percentile(error[determined], 95)) if determined.any() else None,
        },
        "undetermined_share": float(1.0 - determined.mean()),
    }


def predicted_errors(position: Float, actor: Float, field: DistanceField, config: PlannerConfig) -> Float:
    """Compute sqrt(tr S) [T] in metres of the free views, inf where they do not determine a point."""
    seen = visible(field, position, actor, start_m=config.sight_start_m)
    return predicted_error(_information(position - actor, seen, config))


def near_obstacle(t_s: Float, slot_position: Float, actor: Float, field: DistanceField) -> Bool:
    """Find the times [T] when something higher than the actor's hips is within 15 m (level) of a slot.

    The ground is always near. Obstacles for a drone at a low tilt rise above the actor. `t_s` [T] ascends,
    `slot_position` is [N, T, 3] and `actor` [T, 3] m, world. Tested five times a second, and constant until
    the next test.
    """
    grid = field.grid
    occupied = grid.distance_m < 0.0
    levels = np.arange(1, occupied.shape[2] + 1)
    top_m = grid.origin[2] + grid.resolution_m * (occupied * levels).max(axis=2)
    top_m[~occupied.any(axis=2)] = -np.inf  # the map may begin above the actor
    wanted = np.minimum(np.arange(t_s[0], t_s[-1] + 1e-9, 1.0 / _LOOKS_PER_S), t_s[-1])
    looks = np.unique(np.searchsorted(t_s, wanted))
    found = np.zeros(len(looks), dtype=np.bool_)
    centres = [grid.origin[a] + grid.resolution_m * (np.arange(top_m.shape[a]) + 0.5) for a in range(2)]
    for k, look in enumerate(looks):
        for x, y, _ in slot_position[:, look]:
            part = tuple(
                slice(*np.searchsorted(c, [v - NEAR_OBSTACLE_M, v + NEAR_OBSTACLE_M]))
                for c, v in zip(centres, (x, y), strict=True)
            )
            east, north = centres[0][part[0]], centres[1][part[1]]
            square = (east[:, None] - x) ** 2 + (north[None] - y) ** 2
            found[k] |= ((top_m[part] > actor[look, 2]) & (square <= NEAR_OBSTACLE_M**2)).any()
    latest = np.searchsorted(looks, np.arange(len(t_s)), side="right") - 1
    return found[latest]


def _information(offset: Float, seen: Bool, config: PlannerConfig) -> Float:
    """Sum the information [T, 3, 3] of all cameras that see the actor."""
    total: Float = (ray_information(offset, config) * seen[..., None, None]).sum(axis=0)
    return total


def _motion(t_s: Float, position: Float) -> dict[str, Float]:
    """Compute magnitudes [N, ...] of the derivatives, from positions at 10 Hz."""
    even = np.arange(t_s[0], t_s[-1] + 1e-9, 1.0 / _MOTION_HZ)
    value = np.array([[np.interp(even, t_s, axis) for axis in one.T] for one in position])
    motion = {}
    for name in ("speed", "acceleration", "jerk"):
        value = np.diff(value, axis=-1) * _MOTION_HZ
        motion[name] = np.linalg.norm(value, axis=1)
    return motion


def _spread(values: Float) -> dict[str, float]:
    return {"mean": float(values.mean()), "min": float(values.min()), "max": float(values.max())}


def _episodes(broken: Bool) -> int:
    """Count the episodes in all [N, T] rows: the times at which a condition begins to hold."""
    before = np.concatenate([np.zeros((len(broken), 1), dtype=np.bool_), broken[:, :-1]], axis=1)
    return int((broken & ~before).sum())
