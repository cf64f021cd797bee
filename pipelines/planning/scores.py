"""Scores of a flight, and what its cameras see: the same figures for every arm, replayed or flown.

The ray model is the information of cameras before they have seen anything.
"""

from itertools import combinations

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.planning.config import ErrorModel, PlannerConfig
from pipelines.planning.distance_field import DistanceField, MapsInTurn, looked, visible
from pipelines.planning.formation import RANGE, TILT, YAW, slot_of, wrapped

Scores = dict[str, object]

# Plans change at 5 Hz, so that means over 0.1 s show every change of acceleration.
MOTION_HZ = 10.0
# Drones fly at their limits; differences of rounded positions exceed these by less than a millionth.
LIMIT_ROUNDING = 1.0 + 1e-6
# A point needs two views.
MIN_VIEWS = 2
# The person of Hughes et al. 2024 is a hexagonal prism with a lid.
PRISM_SIDES = 6
# The sides of that prism are this far from the axis.
PRISM_APOTHEM_M = 0.484
# The prism of Hughes et al. has this height.
PRISM_HEIGHT_M = 1.8
# The rotary-wing aircraft of Zeng, Xu & Zhang 2019 ("Energy Minimization for Wireless Communication with
# Rotary-Wing UAV", IEEE Trans. Wireless Commun. 18(4), table I and eq. 12) hovers with this blade power.
BLADE_POWER_W = 79.8563
# The aircraft of table I hovers with this induced power.
INDUCED_POWER_W = 88.6279
# The tips of its rotors have this speed (table I).
TIP_SPEED_MPS = 120.0
# The air through its rotors has this mean speed in hovering (table I).
INDUCED_SPEED_MPS = 4.03
# The factors are drag ratio, air density, solidity and disc area of table I.
PARASITE_W_PER_MPS3 = 0.5 * 0.6 * 1.225 * 0.05 * 0.503
# The aircraft of table I has this weight.
WEIGHT_N = 20.0
# A standing person of 1.75 m is a cylinder of this radius.
BODY_RADIUS_M = 0.25
# The cylinder reaches from the hips down to the ground.
BODY_BELOW_HIPS_M = 0.95
# The cylinder reaches from the hips up to the crown.
BODY_ABOVE_HIPS_M = 0.8


def ray_information(offset: Float, errors: ErrorModel) -> Float:
    """Compute one camera's expected information on a point: I = p (1 - d d')/s^2, none along the ray d.

    s^2 = sigma_key(tilt)^2 + (rho sigma_rot)^2 + sigma_pos^2, rho the distance. sigma_key is the detector's
    error in metres at the person and p the share of joints that it finds, both by tilt: by geometry alone,
    steep views would be as good. A detector's errors in pixels are shares of the person's height in the
    picture, so that distance and focal length cancel. Offsets [..., 3] m go from the point to the camera and
    are not zero; the result is [..., 3, 3] 1/m^2.
    """
    square = np.sum(offset**2, axis=-1)[..., None, None]
    across = np.eye(3) - offset[..., :, None] * offset[..., None, :] / square
    tilt_deg = np.degrees(np.arcsin(np.abs(offset[..., 2]) / np.sqrt(square[..., 0, 0])))
    placed = np.interp(tilt_deg, errors.tilts_deg, errors.placed_share)[..., None, None]
    keypoint = np.interp(tilt_deg, errors.tilts_deg, errors.keypoint_sigma_m)[..., None, None]
    turned = np.radians(errors.rotation_sigma_deg) ** 2
    information: Float = placed * across / (keypoint**2 + square * turned + errors.position_sigma_m**2)
    return information


def predicted_error(information: Float) -> Float:
    """Compute sqrt(tr I^-1), the expected error in m, of [..., 3, 3]; inf where a direction is unseen."""
    minors, determinant = _minors(information)
    with np.errstate(divide="ignore", invalid="ignore"):
        trace = np.sum(minors, axis=-1) / determinant
    # Singular up to rounding: the determinant is far below the cube of the trace.
    scale = np.trace(information, axis1=-2, axis2=-1) ** 3
    return np.sqrt(np.where(determinant > 1e-12 * scale, trace, np.inf))


def log_determinant(information: Float) -> Float:
    """Compute the logarithm of the determinant of positive definite [..., 3, 3]."""
    return np.log(_minors(information)[1])


def _minors(matrix: Float) -> tuple[Float, Float]:
    """Compute the three principal 2x2 minors [..., 3] and the determinant of symmetric matrices."""
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2]
    d, e, f = matrix[..., 1, 1], matrix[..., 1, 2], matrix[..., 2, 2]
    first = d * f - e * e
    determinant = a * first - b * (b * f - c * e) + c * (b * e - c * d)
    return np.stack([first, a * f - c * c, a * d - b * b], axis=-1), determinant


def hidden_by_people(camera: Float, target: Float, people: Float) -> Bool:
    """Test [...] if a body, an upright cylinder about hips [Q, ..., 3], stands in a line of sight."""
    way, aside = target - camera, people - camera
    level = np.maximum((way[..., :2] ** 2).sum(axis=-1), 1e-12)
    along = (aside[..., :2] * way[..., :2]).sum(
        axis=-1
    ) / level  # of the nearest point, as a share of the way
    away = np.linalg.norm(aside[..., :2] - along[..., None] * way[..., :2], axis=-1)
    height = along * way[..., 2] - aside[..., 2]
    between = (along > 0.0) & (along < 1.0) & (height > -BODY_BELOW_HIPS_M) & (height < BODY_ABOVE_HIPS_M)
    found: Bool = (between & (away < BODY_RADIUS_M)).any(axis=0)
    return found


def sights(
    camera: Float, looks_rad: Float, people: Float, maps: DistanceField | MapsInTurn, config: PlannerConfig
) -> Bool:
    """Test [P, N, T] which cameras [N, T, 3] see whom, by field of view, map and other people."""
    seen = []
    for p, person in enumerate(people):
        free = seen_actor(camera, person, maps, config)
        if len(people) > 1:
            free = free & in_view(camera, looks_rad, person, config.tuning.errors.fov_rad)
            free &= ~hidden_by_people(camera, person, np.delete(people, p, axis=0)[:, None])
        seen.append(free)
    return np.stack(seen)


def in_view(camera: Float, looks_rad: Float, person: Float, fov_rad: float) -> Bool:
    """Test [...] if people [..., 3] are in the level field of view of cameras [..., 3] with yaws [...]."""
    offset = person - camera
    aside = wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - looks_rad)
    return np.abs(aside) <= fov_rad / 2.0


def score(
    t_s: Float,
    position: Float,
    actor: Float,
    maps: DistanceField | MapsInTurn,
    config: PlannerConfig,
    *,
    people: Float | None = None,
    seen: Bool | None = None,
    pushed: Float | float = 0.0,
) -> Scores:
    """Compute the figures of one flight, JSON-able: degrees and metres by name, None where nothing counts.

    `position` [N, T, 3] m are the cameras, `actor` [T, 3] or [N, T, 3] whom they film, `people` [P, T, 3]:
    shares and errors are means over them, distances are to the nearest. `seen` is [P, N, T], by default the
    free lines of sight. `limit_violations` counts episodes of each drone or pair, speeds without the way [N,
    T, 3] to which gusts `pushed`. `blind_s` is the time in which fewer than two drones see the actor,
    `predicted_error_m` sqrt(tr S) of the ray model while it is determined.
    """
    slots = slot_of(position - actor)
    tilt_deg = np.degrees(slots[..., TILT])
    people = actor[None] if people is None else people
    seen = seen_actor(position, actor, maps, config)[None] if seen is None else seen
    near_m = np.linalg.norm(position - people[:, None], axis=-1).min(axis=0)
    clearance = looked(maps, lambda field, rows: field.sample(position[:, rows])[0], axis=1)
    pairs = list(combinations(range(len(position)), 2))
    apart = np.array([np.linalg.norm(position[i] - position[j], axis=-1) for i, j in pairs])
    turned = np.array([wrapped(slots[j, :, YAW] - slots[i, :, YAW]) for i, j in pairs])
    error = errors_of_views(position, people, seen, config)
    determined = np.isfinite(error)
    motion, energy_kj = _motion(t_s, position - pushed), used_kj(t_s, position, config)
    battery_kj = config.imperfections.battery_kj
    limits = {"speed": config.speed_mps, "acceleration": config.acceleration_mps2, "jerk": config.jerk_mps3}
    violations = {
        "collision": _episodes(clearance <= 0.0),
        "clearance": _episodes(clearance < config.drone_radius_m),
        "actor": _episodes(near_m < config.actor_distance_m),
        "separation": _episodes(apart < config.separation_m) if pairs else 0,
        **{name: _episodes(motion[name] > limit * LIMIT_ROUNDING) for name, limit in limits.items()},
        **({} if battery_kj is None else {"battery": _episodes(energy_kj > battery_kj)}),
    }
    return {
        "tilt_deg": {"mean": float(tilt_deg.mean()), "max": float(tilt_deg.max())},
        "range_m": _spread(slots[..., RANGE]),
        "yaw_separation_deg": _spread(np.degrees(np.abs(turned))) if pairs else None,
        "occluded_share": float(1.0 - seen.mean()),
        "blind_s": blind_s(t_s, seen),
        "path_m": float(np.linalg.norm(np.diff(position, axis=1), axis=-1).sum(axis=1).mean()),
        "energy_kj": float(energy_kj[:, -1].mean()),
        "min_actor_distance_m": float(near_m.min()),
        "min_clearance_m": float(clearance.min()) if _has_obstacles(maps) else None,
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


def blind_s(t_s: Float, seen: Bool) -> float:
    """Compute for how long fewer than two cameras see a person, the mean over people: of [P, N, T] sights."""
    blind = (seen.sum(axis=1) < MIN_VIEWS).mean(axis=0)
    return float(np.trapezoid(blind, t_s))


def coverage(
    position: Float, looks_rad: Float, people: Float, heading_rad: Float, *, fov_rad: float
) -> Float:
    """Compute how densely one camera sees the faces of people, [..., A, 7] 1/m^2: six sides and the lid.

    Each face counts with c = |d look| (-d n) / |d|^4 where d is from the camera [..., 3] to the face's centre
    and n its normal: pixels per area, times the cosine of the view (Hughes et al., "Multi-Robot Planning for
    Filming Groups of Moving Actors Leveraging Submodularity and Pixel Density", CDC 2024). Faces that look
    away have 0, and so have people [..., A, 3] (centres of the sides) out of the level field of view. Nobody
    hides anybody. Yaws, of the level axis [...] and of people [..., A], are from east.
    """
    yaw = heading_rad[..., None] + 2.0 * np.pi / PRISM_SIDES * np.arange(1, PRISM_SIDES + 1)
    normal = np.zeros((*people.shape[:-1], PRISM_SIDES + 1, 3))
    normal[..., :PRISM_SIDES, 0], normal[..., :PRISM_SIDES, 1] = np.cos(yaw), np.sin(yaw)
    centre = people[..., None, :] + PRISM_APOTHEM_M * normal
    normal[..., PRISM_SIDES, 2] = 1.0
    look = np.stack([np.cos(looks_rad), np.sin(looks_rad), np.zeros_like(looks_rad)], axis=-1)
    to_face = centre - position[..., None, None, :]
    facing = np.maximum(-(to_face * normal).sum(axis=-1), 0.0)
    along = np.abs((to_face * look[..., None, None, :]).sum(axis=-1))
    offset = people - position[..., None, :]
    aside = wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - looks_rad[..., None])
    inside = np.abs(aside) <= fov_rad / 2.0
    found: Float = along * facing / (to_face**2).sum(axis=-1) ** 2 * inside[..., None]
    return found


def view_quality(covered: Float, weight: Float) -> Float:
    """Sum what all cameras cover [..., A, 7] to the view quality [...] of people with `weight` [A].

    The root of a face's density counts with the face's area and the person's weight: a second view of the
    same face adds less than the first of another one (Hughes et al. 2024).
    """
    side_m = 2.0 * PRISM_APOTHEM_M * np.tan(np.pi / PRISM_SIDES)
    area = np.full(PRISM_SIDES + 1, side_m * PRISM_HEIGHT_M)
    area[-1] = 1.5 * np.sqrt(3.0) * side_m**2
    quality: Float = (weight[:, None] * area * np.sqrt(covered)).sum(axis=(-2, -1))
    return quality


def propulsion_w(level_mps: Float, climb_mps: Float) -> Float:
    """Compute the propulsion power (W) of a small drone of 20 N in still air.

    P = P0 (1 + 3 V^2/U^2) + Pi (sqrt(1 + V^4/(4 v0^4)) - V^2/(2 v0^2))^(1/2) + d rho s A V^3/2 at the level
    speed V (Zeng, Xu & Zhang 2019), and the weight times the speed of climbing. It compares arms: another
    drone needs another energy.
    """
    square = level_mps**2
    blade = BLADE_POWER_W * (1.0 + 3.0 * square / TIP_SPEED_MPS**2)
    ratio = square / (2.0 * INDUCED_SPEED_MPS**2)
    induced = INDUCED_POWER_W * np.sqrt(np.sqrt(1.0 + ratio**2) - ratio)
    power: Float = blade + induced + PARASITE_W_PER_MPS3 * level_mps**3
    return power + WEIGHT_N * np.maximum(climb_mps, 0.0)


def used_kj(t_s: Float, position: Float, config: PlannerConfig) -> Float:
    """Compute the energy [N, T] that each drone has used, from its mean velocities in the air at 10 Hz."""
    step_s = np.diff(_even(t_s))
    velocity = np.diff(_at_even_times(t_s, position), axis=-1) / step_s
    wind = np.array(config.imperfections.wind_mps)[:, None]
    power = propulsion_w(np.linalg.norm(velocity[:, :2] - wind, axis=1), velocity[:, 2])
    used = np.cumsum(power * step_s, axis=-1) / 1e3
    return np.array([np.interp(t_s, _even(t_s), np.concatenate([[0.0], own])) for own in used])


def seen_actor(
    position: Float, actor: Float, maps: DistanceField | MapsInTurn, config: PlannerConfig
) -> Bool:
    """Test [N, T] if cameras at [N, T, 3] see the actor [T, 3], by the map of each moment."""
    return looked(
        maps,
        lambda field, rows: visible(
            field, position[:, rows], actor[rows], start_m=config.tuning.sight_start_m
        ),
        axis=1,
    )


def _has_obstacles(maps: DistanceField | MapsInTurn) -> bool:
    fields = [maps] if isinstance(maps, DistanceField) else [field for _, field in maps]
    return any(field.has_obstacles for field in fields)


def errors_of_views(position: Float, people: Float, seen: Bool, config: PlannerConfig) -> Float:
    """Compute sqrt(tr S) [P, T] in metres of people [P, T, 3] whom cameras [N, T, 3] see [P, N, T]."""
    return predicted_error(
        (ray_information(position - people[:, None], config.tuning.errors) * seen[..., None, None]).sum(
            axis=1
        )
    )


def _motion(t_s: Float, position: Float) -> dict[str, Float]:
    """Compute magnitudes [N, ...] of the derivatives, from positions at 10 Hz."""
    value = _at_even_times(t_s, position)
    motion = {}
    for name in ("speed", "acceleration", "jerk"):
        value = np.diff(value, axis=-1) * MOTION_HZ
        motion[name] = np.linalg.norm(value, axis=1)
    return motion


def _even(t_s: Float) -> Float:
    return np.arange(t_s[0], t_s[-1] + 1e-9, 1.0 / MOTION_HZ)


def _at_even_times(t_s: Float, position: Float) -> Float:
    """Interpolate positions [N, T, 3] at 10 Hz, [N, 3, ...]."""
    even = _even(t_s)
    return np.array([[np.interp(even, t_s, axis) for axis in one.T] for one in position])


def _spread(values: Float) -> dict[str, float]:
    return {"mean": float(values.mean()), "min": float(values.min()), "max": float(values.max())}


def _episodes(broken: Bool) -> int:
    """Count the episodes in all [N, T] rows: the times at which a condition begins to hold."""
    before = np.concatenate([np.zeros((len(broken), 1), dtype=np.bool_), broken[:, :-1]], axis=1)
    return int((broken & ~before).sum())
