"""Guard that keeps replayed drones out of obstacles, away from each other and from the actor.

Invariant: every drone has a committed motion that ends at rest, keeps `drone_radius_m` from the map and
`separation_m` from the committed motions of all others. A new plan is flown only if following it until the
next one, and braking to a stop from there, keeps the invariant. Otherwise the drone follows the last plan
that does, climbs, gives way, or goes on with its committed motion, which is braking. By induction no drone
ever leaves free space, for any plan. Three cases cannot be guaranteed and are reported by
`scores`: an actor who walks at a drone, a map that changes, a start inside the radius.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached, helper
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, Grid, interpolate
from pipelines.planning.forecast import ActorFilter
from pipelines.planning.local import (
    ACTOR_AHEAD_S,
    POSITION,
    VELOCITY,
    DronePlan,
    flying_of,
    roll_out,
    stopping_ticks,
)

# At 8 m/s a drone flies 0.4 m between two checks; every half voxel is checked as well.
CHECK_PERIOD_S = 0.05
# Distances are sums of a few roundings.
ROUNDING_M = 1e-6
# A drone that is nearer to an obstacle by more than this leaves first.
INSIDE_M = 1e-3
# Ways out end this much beyond the radius, or tracking errors would lead back inside.
WAY_OUT_MARGIN_M = 0.1
# A drone stops from 2 m/s within its radius of half a metre.
CLIMB_MPS = 2.0
# A way aside is shorter than a climb.
ASIDE_MPS = 1.5
# A drone takes up another velocity with this share of its acceleration; tracking needs the rest.
ACCELERATION_SHARE = 0.75
# Somebody who turns back at 5 m/s comes 4 m nearer before measurements tell it.
REVERSES_S = 0.8
# A way out is nearly always within this window, and larger ones cost the cube of their size.
FIRST_WINDOW_M = 4.0


class FlownMotion(StrEnum):
    """Motion of a drone after a local planning."""

    PLANNED = "planned"
    PREVIOUS = "previous"  # the plan before
    CLIMBED = "climbed"
    GAVE_WAY = "gave_way"  # sideways, or away from the actor
    BRAKED = "braked"
    LEFT = "left"  # an obstacle that was within its radius, by the shortest way
    UNSAFE = "unsafe"  # no motion keeps all distances; the one that comes nearest to that


class _Around(NamedTuple):
    """Things that a drone must keep away from; K + 1 times, one per period from now on."""

    field: DistanceField
    others: Float  # [M, K + 1, 3] m, committed positions of the other drones
    people: Float  # [P, K + 1, 3] m, forecast of the actor, or of everybody who is filmed


@dataclass(frozen=True)
class _Motion:
    """A motion that ends at rest, and its least distances."""

    kind: FlownMotion
    plan: DronePlan
    states: Float  # [K + 1, 4, 3], see `tracking`
    clearance_m: float
    separation_m: float
    actor_m: float


class Guard:
    """The drones of one replayed flight, first at rest; flies only the safe ones of the planner's wishes."""

    def __init__(self, position: Float, config: PlannerConfig) -> None:
        self._config, self._flying = config, flying_of(config)
        self._ticks = math.ceil(config.tuning.tracking_hz / config.tuning.local_hz - 1e-9)
        rows = self._ticks + stopping_ticks(self._flying) + 1
        self._ticks_ahead = min(round(ACTOR_AHEAD_S * config.tuning.tracking_hz), rows - 1)
        self._states = np.zeros((len(position), rows, 4, 3))
        self._states[:, :, POSITION] = position[:, None]
        self._age = np.zeros(len(position), dtype=np.int64)  # periods since a drone's motion was committed
        self._last: list[DronePlan | None] = [None] * len(position)
        self.counts: Counter[FlownMotion] = Counter()

    @property
    def position(self) -> Float:
        """Positions of the drones [N, 3] m, world."""
        return self._now(POSITION)

    @property
    def velocity(self) -> Float:
        """Velocities of the drones [N, 3] m/s."""
        return self._now(VELOCITY)

    def fly(self, periods: int) -> tuple[Float, Float]:
        """Fly for some periods: positions [N, P, 3] m and velocities [N, P, 3] m/s at the start of each."""
        drones, last = np.arange(len(self._age))[:, None], self._states.shape[1] - 1
        flown = self._states[drones, np.minimum(self._age[:, None] + np.arange(periods), last)]
        self._age = np.minimum(self._age + periods, last)
        return flown[:, :, POSITION], flown[:, :, VELOCITY]

    def committed(self) -> list[Float]:
        """Return the motion of each drone from now on, [K, 4, 3], which ends at rest."""
        return [states[age:] for states, age in zip(self._states, self._age, strict=True)]

    def admit(
        self, drone: int, t_s: float, plan: DronePlan, actor: ActorFilter, field: DistanceField
    ) -> DronePlan:
        """Commit a drone to the best safe motion for the local `plan`; return the plan that is flown."""
        after_s = self._flying.period_s * np.arange(self._states.shape[1], dtype=np.float64)
        around = _Around(field, self._others(drone), actor.each(t_s + after_s))
        place = self._states[drone, self._age[drone], POSITION]
        now = _distances_now(around.field.grid, place, around.others, around.people)
        least = self._least(now, around)
        tried = []
        for motion in self._motions(drone, t_s, plan, around, now[0]):
            tried.append(motion)
            if _shortfall(motion, least) == _NONE:
                break
        chosen = min(tried, key=lambda motion: _shortfall(motion, least))
        self.counts[chosen.kind if _shortfall(chosen, least) == _NONE else FlownMotion.UNSAFE] += 1
        self._last[drone] = (
            chosen.plan if chosen.kind in (FlownMotion.PLANNED, FlownMotion.PREVIOUS) else None
        )
        self._states[drone], self._age[drone] = chosen.states, 0
        return chosen.plan

    def _now(self, row: int) -> Float:
        now: Float = self._states[np.arange(len(self._age)), self._age, row]
        return now

    def _others(self, drone: int) -> Float:
        """Return the committed positions [M, K + 1, 3] of the other drones from now on."""
        others, rows = np.arange(len(self._age)) != drone, np.arange(self._states.shape[1])
        ahead = np.minimum(self._age[others, None] + rows, rows[-1])
        return np.asarray(self._states[others.nonzero()[0][:, None], ahead, POSITION])

    def _least(self, now: tuple[float, float, float], around: _Around) -> tuple[float, float, float]:
        """Return the distances to map, drones and actor that must be kept."""
        config = self._config
        # The actor's estimate errs by about the log's noise.
        stated = (
            wanted_clearance_m(config, around.field.grid),
            config.separation_m,
            config.actor_distance_m + config.tuning.actor_sigma_m if config.actor_distance_m else 0.0,
        )
        map_m, drones_m, actor_m = (
            min(one, other) - ROUNDING_M for one, other in zip(stated, now, strict=True)
        )
        return map_m, drones_m, actor_m

    def _motions(
        self, drone: int, t_s: float, plan: DronePlan, around: _Around, clearance_m: float
    ) -> Iterator[_Motion]:
        """Yield motions from the best to the last resort, from a place of this clearance."""
        here, field = self._states[drone, self._age[drone]], around.field

        def follow(kind: FlownMotion, followed: DronePlan) -> _Motion:
            states, stopped = self._rolled_out(t_s, here, followed, self._ticks)
            ahead, _ = self._rolled_out(t_s, here, followed, self._ticks_ahead, stops=False)
            return self._measured(kind, followed, states, stopped, ahead, around)

        place, wanted_m = here[POSITION], wanted_clearance_m(self._config, field.grid)
        if clearance_m < wanted_m - INSIDE_M:
            goal = nearest_free(field, place, wanted_m + WAY_OUT_MARGIN_M)
            if goal is not None:
                way = goal - place
                length = float(np.linalg.norm(way))
                speed = min(ASIDE_MPS, 2.0 * length)  # no farther than the goal within a second
                yield follow(FlownMotion.LEFT, self._steered(t_s, here, way * (speed / max(length, 1e-9))))
        yield follow(FlownMotion.PLANNED, plan)
        previous = self._last[drone]
        if previous is not None:
            yield follow(FlownMotion.PREVIOUS, previous)
        for kind, velocity in self._ways_out(here, around):
            yield follow(kind, self._steered(t_s, here, velocity))
        rows = np.minimum(self._age[drone] + np.arange(self._states.shape[1]), self._states.shape[1] - 1)
        committed = self._states[drone, rows]
        braked = self._plan_of(t_s, committed)
        yield self._measured(FlownMotion.BRAKED, braked, committed, len(committed) - 1, committed, around)

    def _rolled_out(
        self, t_s: float, here: Float, plan: DronePlan, ticks: int, *, stops: bool = True
    ) -> tuple[Float, int]:
        """Return states [K + 1, 4, 3] of a drone that follows a plan and stops, and the row of the stop."""
        stopping = self._states.shape[1] - self._ticks if stops else 1
        states = np.empty((ticks + stopping, 4, 3))
        states[0] = here
        after_s = t_s - plan.start_s
        stopped = roll_out(plan.path, plan.velocity, plan.step_s, after_s, ticks, self._flying, states)
        return states, stopped

    def _ways_out(self, here: Float, around: _Around) -> list[tuple[FlownMotion, Float]]:
        place = here[POSITION]
        actor = around.people[np.linalg.norm(around.people[:, 0] - place, axis=-1).argmin()]
        up = np.array([0.0, 0.0, CLIMB_MPS])
        level = around.field.sample(place)[1] * [1.0, 1.0, 0.0]
        off = level / max(float(np.linalg.norm(level)), 1e-9) * ASIDE_MPS
        pace_mps = float(np.linalg.norm(actor[1] - actor[0])) / self._flying.period_s
        away = (place - actor[0]) * [1.0, 1.0, 0.0]
        away *= (pace_mps + CLIMB_MPS) / max(float(np.linalg.norm(away)), 1e-9)
        return [
            (FlownMotion.CLIMBED, up),
            (FlownMotion.CLIMBED, up + off),
            (FlownMotion.GAVE_WAY, away + up / 2.0),
            (FlownMotion.GAVE_WAY, away),
        ]

    def _measured(
        self, kind: FlownMotion, plan: DronePlan, states: Float, stopped: int, ahead: Float, around: _Around
    ) -> _Motion:
        """Measure the least distances of a motion to the map and to drones, and of its plan to the actor."""
        distances = least_distances(
            around.field.grid,
            states,
            stopped,
            around.others,
            ahead[: self._ticks_ahead + 1],
            around.people,
            self._flying.period_s,
        )
        return _Motion(kind, plan, states, *distances)

    def _steered(self, t_s: float, here: Float, velocity: Float) -> DronePlan:
        """Return a plan that takes up a velocity [3] m/s with a constant acceleration."""
        config = self._config
        after = config.tuning.waypoint_s * np.arange(config.tuning.waypoints + 1, dtype=np.float64)[:, None]
        change = velocity - here[VELOCITY]
        until = float(np.linalg.norm(change)) / (ACCELERATION_SHARE * self._config.acceleration_mps2)
        share = np.minimum(after, until)
        gained = change * (share**2 / (2.0 * max(until, 1e-9)) + after - share)
        path = here[POSITION] + here[VELOCITY] * after + gained
        return DronePlan(t_s, path, here[VELOCITY].copy(), self._config.tuning.waypoint_s)

    def _plan_of(self, t_s: float, states: Float) -> DronePlan:
        """Return the plan that other drones see of a motion that is already committed."""
        every = max(round(self._config.tuning.waypoint_s * self._config.tuning.tracking_hz), 1)
        rows = np.minimum(every * np.arange(self._config.tuning.waypoints + 1), len(states) - 1)
        return DronePlan(
            t_s, states[rows, POSITION], states[0, VELOCITY].copy(), self._config.tuning.waypoint_s
        )


def wanted_clearance_m(config: PlannerConfig, grid: Grid) -> float:
    """Return the field's value at which a drone keeps its radius from all occupied voxels.

    The field is the distance to the face of the nearest voxel, as if seen along an axis. Corners are farther
    out by 0.37 voxels, and trilinear interpolation errs by about a tenth: half a voxel covers both.
    """
    return config.drone_radius_m + grid.resolution_m / 2.0


def nearest_free(field: DistanceField, point: Float, wanted_m: float) -> Float | None:
    """Find the nearest centre [3] of a voxel at least `wanted_m` from obstacles; None without one."""
    grid = field.grid
    size = np.array(grid.distance_m.shape)
    middle = np.floor((point - grid.origin) / grid.resolution_m).astype(np.int64)
    reach = math.ceil(FIRST_WINDOW_M / grid.resolution_m)
    while True:
        low, high = np.clip(middle - reach, 0, size - 1), np.clip(middle + reach + 1, 1, size)
        part = grid.distance_m[tuple(slice(*ends) for ends in zip(low, high, strict=True))]
        free = np.argwhere(part >= wanted_m)
        if len(free):
            centres = grid.origin + grid.resolution_m * (low + free + 0.5)
            away = np.linalg.norm(centres - point, axis=1)
            # Outside of the window voxels may be nearer than in its corners.
            if away.min() <= reach * grid.resolution_m or ((low == 0).all() and (high == size).all()):
                nearest: Float = centres[int(away.argmin())]
                return nearest
        elif (low == 0).all() and (high == size).all():
            return None
        reach *= 2


@helper
def _least_clearance(grid: Grid, states: Float, last: int, period_s: float) -> float:
    """Compute the least distance to obstacles along a motion [K + 1, 4, 3] up to a row."""
    least = math.inf
    for k in range(last + 1):
        x, y, z = states[k, 0, 0], states[k, 0, 1], states[k, 0, 2]
        if k == last:
            return float(min(least, interpolate(grid, x, y, z)[0]))
        dx, dy, dz = states[k + 1, 0, 0] - x, states[k + 1, 0, 1] - y, states[k + 1, 0, 2] - z
        moved = math.sqrt(dx * dx + dy * dy + dz * dz)
        pieces = max(math.ceil(period_s / CHECK_PERIOD_S), math.ceil(2.0 * moved / grid.resolution_m), 1)
        for piece in range(pieces):
            u = piece / pieces
            least = min(least, interpolate(grid, x + u * dx, y + u * dy, z + u * dz)[0])
    return float(least)


@helper
def _apart(a: Float, b: Float) -> float:
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@cached
def least_distances(
    grid: Grid, states: Float, stopped: int, others: Float, ahead: Float, people: Float, period_s: float
) -> tuple[float, float, float]:
    """Compute the least distances of a motion to obstacles and drones, and of its plan to people, or inf.

    The motion `states` [K + 1, 4, 3] rests from row `stopped` on; `others` [M, K + 1, 3] are other drones;
    `ahead` [A, 4, 3] follows the plan without the stop. People [P, A or more, 3] may walk on as forecast,
    stop, or turn back for `REVERSES_S`.
    """
    drones_m = people_m = math.inf
    for k in range(states.shape[0]):
        for other in range(others.shape[0]):
            drones_m = min(drones_m, _apart(others[other, k], states[k, 0]))
    for k in range(ahead.shape[0]):
        for person in range(people.shape[0]):
            people_m = min(people_m, _apart(people[person, k], ahead[k, 0]))
            people_m = min(people_m, _apart(people[person, 0], ahead[k, 0]))
            back = min(k, round(REVERSES_S / period_s))
            people_m = min(people_m, _apart(2.0 * people[person, 0] - people[person, back], ahead[k, 0]))
    return _least_clearance(grid, states, stopped, period_s), drones_m, people_m


@cached
def _distances_now(grid: Grid, place: Float, others: Float, people: Float) -> tuple[float, float, float]:
    """Compute the distances of a place [3] to obstacles, and to the first rows of drones and people."""
    drones_m = people_m = math.inf
    for other in range(others.shape[0]):
        drones_m = min(drones_m, _apart(others[other, 0], place))
    for person in range(people.shape[0]):
        people_m = min(people_m, _apart(people[person, 0], place))
    return interpolate(grid, place[0], place[1], place[2])[0], drones_m, people_m


_NONE = (0.0, 0.0, 0.0)


def _shortfall(motion: _Motion, least: Sequence[float]) -> tuple[float, float, float]:
    """Return by how much a motion comes too near to the map, to drones and to the actor; 0 if it does not."""
    found = (motion.clearance_m, motion.separation_m, motion.actor_m)
    map_m, drones_m, actor_m = (max(wanted - got, 0.0) for wanted, got in zip(least, found, strict=True))
    return map_m, drones_m, actor_m
