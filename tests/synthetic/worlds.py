"""Random worlds with a flight through each: walls down to one voxel, boxes, forests, hills, overhangs.

Drones start beside obstacles, too. The planner's map is made of voxels; flights are checked against the
analytic surfaces that the voxels were made from.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.planning.arms import PLANNER_ARMS
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, distance_field
from pipelines.planning.formation import TILT, formation_slots, slot_of, slot_offsets
from pipelines.planning.replay import Start, replay
from pipelines.planning.scores import errors_of_views, score, seen_actor
from pipelines.session.records import Occupancy

Int64 = NDArray[np.int64]

ARMS = ("fixed", "adaptive", "joint")
KINDS = ("wall", "boxes", "forest", "hills", "overhang", "beside")

_SECONDS, _HIPS_M = 12.0, 1.0
_SIZE_M, _HIGH_M = 52.0, 16.0
_CLEAR_OF_ACTOR_M = 2.0  # least distance of obstacles from the actor's way
_CLEAR_OF_START_M = 0.8  # and from the drones' first slots, except for `beside`
_BESIDE_M = (0.1, 1.0)  # distance of an obstacle from a first slot for `beside`
_FINE = 4  # checks against the analytic surfaces per tracking step
_MOST_ERROR_M = 2.0  # value for an undetermined position
_CONFIG = PlannerConfig()


class Solid(Protocol):
    """Solid that drones must not touch."""

    def distance(self, points: Float) -> Float:
        """Compute signed distances [...] (m) from points [..., 3] to its surface, negative inside."""


@dataclass(frozen=True)
class Box:
    """Box, upright or lying, turned about the vertical."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    yaw_rad: float = 0.0

    def distance(self, points: Float) -> Float:
        """Compute the exact signed distance."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        away = points - np.array(self.centre)
        x, y = c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]
        over = np.abs(np.stack([x, y, away[..., 2]], axis=-1)) - np.array(self.half)
        outside = np.linalg.norm(np.maximum(over, 0.0), axis=-1)
        return np.asarray(outside + np.minimum(over.max(axis=-1), 0.0))


@dataclass(frozen=True)
class Tree:
    """Tree with a trunk and a round crown."""

    east_north: tuple[float, float]
    height_m: float
    crown_m: float

    def distance(self, points: Float) -> Float:
        """Compute the signed distance, exact outside of the tree."""
        level = np.linalg.norm(points[..., :2] - np.array(self.east_north), axis=-1)
        top = self.height_m - self.crown_m
        trunk = np.hypot(np.maximum(level - 0.4, 0.0), np.maximum(points[..., 2] - top, 0.0))
        crown = np.hypot(level, points[..., 2] - top) - self.crown_m
        inside = (level < 0.4) & (points[..., 2] < top)
        nearest: Float = np.minimum(np.where(inside, -0.1, trunk), crown)
        return nearest


@dataclass(frozen=True)
class Ground:
    """Ground at height 0 with Gaussian hills."""

    hills: tuple[tuple[float, float, float, float], ...] = ()  # east, north, sigma, height

    def height(self, east: Float, north: Float) -> Float:
        """Compute the height (m) above the plain."""
        total = np.zeros(np.broadcast(east, north).shape)
        for x, y, sigma, high in self.hills:
            total = total + high * np.exp(-((east - x) ** 2 + (north - y) ** 2) / (2 * sigma**2))
        return total

    def distance(self, points: Float) -> Float:
        """Compute a lower bound of the distance outside, with its sign: the gap over the steepest slope."""
        slope = sum(high / sigma * np.exp(-0.5) for _, _, sigma, high in self.hills)
        gap = points[..., 2] - self.height(points[..., 0], points[..., 1])
        return np.asarray(gap / np.sqrt(1.0 + slope**2))


@dataclass(frozen=True)
class World:
    """World with a flight through it."""

    seed: int
    kind: str
    drones: int
    yaw_rad: float
    resolution_m: float
    actor_t_ns: Int64
    actor: Float  # [A, 3]
    ground: Ground
    solids: tuple[Solid, ...]

    def distance(self, points: Float) -> Float:
        """Compute the analytic signed distance [...] to the nearest surface."""
        solids = (self.ground, *self.solids)
        nearest: Float = np.minimum.reduce([solid.distance(points) for solid in solids])
        return nearest

    def field(self) -> DistanceField:
        """Build the planner's map: a voxel is occupied if its centre is inside a solid or the ground."""
        side = self.resolution_m
        count = (round(_SIZE_M / side), round(_SIZE_M / side), round(_HIGH_M / side))
        origin = np.append(self.actor[:, :2].mean(axis=0) - _SIZE_M / 2, -2 * side)
        x, y, z = (origin[a] + side * (np.arange(count[a]) + 0.5) for a in range(3))
        flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        occupied = np.empty(count, dtype=np.float32)
        for k, level in enumerate(z):  # a layer at a time: all at once takes 0.5 GB
            points = np.concatenate([flat, np.full((*flat.shape[:2], 1), level)], axis=-1)
            occupied[..., k] = self.distance(points) < 0
        return distance_field(Occupancy(occupied, origin, side))

    def first_slots(self) -> Float:
        """Compute the start positions [N, 3] (m) of the drones."""
        slots = formation_slots(
            np.array(self.yaw_rad), self.drones, tilt_rad=_CONFIG.tilt_rad, range_m=_CONFIG.radius_m
        )
        places: Float = self.actor[0] + slot_offsets(slots)
        return places


def world_of(seed: int) -> World:
    """Build the world of a seed; equal seeds give equal worlds."""
    rng = np.random.default_rng([2026, seed])
    kind = KINDS[seed % len(KINDS)]
    t_s, way = _walk(rng)
    world = World(
        seed=seed,
        kind=kind,
        drones=(2, 3, 5)[seed // len(KINDS) % 3],
        yaw_rad=float(rng.uniform(-np.pi, np.pi)),
        resolution_m=(0.5, 0.4, 0.5, 0.25)[seed // (3 * len(KINDS)) % 4],
        actor_t_ns=(t_s * 1e9).astype(np.int64),
        actor=np.column_stack([way, np.full(len(way), _HIPS_M)]),
        ground=Ground(),
        solids=(),
    )
    while kind == "hills":
        ground = Ground(_hills(rng, way))
        actor = np.column_stack([way, ground.height(way[:, 0], way[:, 1]) + _HIPS_M])
        world = replace(world, ground=ground, actor=actor)
        if ground.distance(world.first_slots()).min() >= _CLEAR_OF_START_M:
            break
    wanted = {"wall": 3, "boxes": 6, "forest": 14, "hills": 2, "overhang": 3, "beside": 2}[kind]
    solids: list[Solid] = []
    if kind == "beside":
        solids.append(_beside(rng, world))
    for _ in range(200):
        if len(solids) == wanted:
            break
        solid = _solid(rng, world)
        if solid.distance(world.actor).min() < _CLEAR_OF_ACTOR_M:
            continue
        if solid.distance(world.first_slots()).min() < _CLEAR_OF_START_M:
            continue
        solids.append(solid)
    return replace(world, solids=tuple(solids))


def _walk(rng: np.random.Generator) -> tuple[Float, Float]:
    """Draw times [A] s and a winding way [A, 2] m, walked or jogged, sometimes with a stop."""
    t_s = np.arange(0.0, _SECONDS + 1e-9, 0.1)
    speed = np.full(len(t_s), rng.uniform(0.8, 2.5))
    if rng.random() < 0.2:
        speed *= np.clip(np.abs(t_s - rng.uniform(4, 8)) - 1.0, 0.0, 1.0)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(0, 0.06, len(t_s)))
    steps = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1) * 0.1
    return t_s, np.cumsum(steps, axis=0)


def _hills(rng: np.random.Generator, way: Float) -> tuple[tuple[float, float, float, float], ...]:
    """Draw hills beside the way."""
    found = []
    for _ in range(rng.integers(1, 4)):
        sigma = rng.uniform(2.5, 5.0)
        place = way[rng.integers(len(way))] + rng.uniform(-12, 12, 2)
        found.append((float(place[0]), float(place[1]), float(sigma), float(rng.uniform(2.0, 7.0))))
    return tuple(found)


def _solid(rng: np.random.Generator, world: World) -> Solid:
    """Draw a solid of the world's kind near the actor's way."""
    place = world.actor[rng.integers(len(world.actor)), :2] + rng.uniform(-13, 13, 2)
    east, north = float(place[0]), float(place[1])
    yaw = float(rng.uniform(0, np.pi))
    kind = world.kind
    if kind in ("hills", "beside"):
        kind = str(rng.choice(["wall", "boxes", "forest"]))
    if kind == "wall":
        thick = world.resolution_m * float(rng.choice([1.0, 1.0, 2.0, 4.0]))
        high, long = float(rng.uniform(3, 12)), float(rng.uniform(4, 16))
        return Box((east, north, high / 2), (long / 2, thick / 2, high / 2), yaw)
    if kind == "boxes":
        a, b, c = (float(side) for side in rng.uniform([1, 1, 2], [5, 5, 10]))
        return Box((east, north, c / 2), (a / 2, b / 2, c / 2), yaw)
    if kind == "forest":
        crown = float(rng.uniform(0.8, 2.0))
        return Tree((east, north), float(rng.uniform(3 + crown, 8)), crown)
    low, thick = float(rng.uniform(3.0, 7.0)), float(rng.choice([1.0, 2.0, 4.0])) * world.resolution_m
    a, b = (float(side) for side in rng.uniform(3, 9, 2))
    return Box((east, north, low + thick / 2), (a / 2, b / 2, thick / 2), yaw)


def _beside(rng: np.random.Generator, world: World) -> Solid:
    """Draw a wall so near to the first slot of one drone that it may lie within the drone's radius."""
    slot = world.first_slots()[rng.integers(world.drones)]
    thick = world.resolution_m * float(rng.choice([1.0, 2.0]))
    high, long = float(rng.uniform(4, 10)), float(rng.uniform(2, 6))
    away = slot[:2] - world.actor[0, :2]
    yaw = float(np.arctan2(away[1], away[0]) + np.pi / 2)
    gap = float(rng.uniform(*_BESIDE_M)) + thick / 2
    place = slot[:2] + away / np.linalg.norm(away) * (gap if rng.random() < 0.7 else -gap)
    return Box((float(place[0]), float(place[1]), high / 2), (long / 2, thick / 2, high / 2), yaw)


def fly(seed: int, arms: Sequence[str] = ARMS, config: PlannerConfig = _CONFIG) -> list[dict[str, Any]]:
    """Fly all arms through one world; return figures of each flight, measured on the analytic surfaces."""
    world = world_of(seed)
    field = world.field()
    rows = []
    for name in arms:
        result = replay(
            PLANNER_ARMS.get(name),
            world.actor_t_ns,
            world.actor,
            [field],
            Start(world.drones, world.yaw_rad),
            config=config,
        )
        place = _finely(result.position)
        slots_now = world.actor[0] + (result.position[:, 0] - result.actor[0])
        figures = score(result.t_s, result.position, result.actor, field, config)
        seen = seen_actor(result.position, result.actor, field, config)[None]
        error = errors_of_views(result.position, result.actor[None], seen, config).clip(0, _MOST_ERROR_M)
        broken = figures["limit_violations"]
        assert isinstance(broken, dict)
        away_m, tilt_rad = slot_of(result.position - result.actor)[..., [2, TILT]].T
        rows.append(
            {
                "seed": seed,
                "arm": name,
                "kind": world.kind,
                "drones": world.drones,
                "clearance_m": float(world.distance(place).min()),
                "first_m": float(world.distance(slots_now).min()),
                "ground_m": float((place[..., 2] - world.ground.height(place[..., 0], place[..., 1])).min()),
                "actor_m": float(away_m.min()),
                "farthest_m": float(away_m[-1].max()),
                "limits": sum(broken[key] for key in ("speed", "acceleration", "jerk", "separation")),
                "tilt_deg": float(np.degrees(tilt_rad).mean()),
                "hidden": figures["occluded_share"],
                "error_m": float(error.mean()),
                "safety": getattr(result, "safety", {}),
            }
        )
    return rows


def _finely(position: Float) -> Float:
    """Add points [N, S, 3] between the steps of the path."""
    share = (np.arange(_FINE) / _FINE)[:, None]
    start, end = position[:, :-1, None], position[:, 1:, None]
    between = start + share * (end - start)
    return np.concatenate([between.reshape(len(position), -1, 3), position[:, -1:]], axis=1)


def flown(seeds: Iterable[int], workers: int, arms: Sequence[str], config: PlannerConfig) -> Iterable[Any]:
    """Fly some worlds; yield their flights in the order of their seeds."""
    if workers == 1:
        for seed in seeds:
            yield from fly(seed, arms, config)
        return
    with ProcessPoolExecutor(workers) as pool:
        for rows in pool.map(partial(fly, arms=arms, config=config), seeds):
            yield from rows
