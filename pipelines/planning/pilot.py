"""The planner in flight: it takes measurements, replans at fixed rates, and returns references."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.planning.arms import Arm
from pipelines.planning.config import MOST_DRONES, PlannerConfig
from pipelines.planning.distance_field import DistanceField
from pipelines.planning.forecast import ActorFilter, Forecast
from pipelines.planning.formation import FormationPath, formation_slots, slot_offsets, turned
from pipelines.planning.guard import Guard
from pipelines.planning.heading import YawZero
from pipelines.planning.local import LocalPlanner, Separation
from pipelines.planning.tracking import Plan

_NOW_S = 1e-6  # times are sums of periods: due this much early is due


@dataclass(frozen=True)
class Command:
    """Commands to the drones at one time; [N, 3] metres, world, but for the slots."""

    position: Float
    velocity: Float
    acceleration: Float
    slots: Float  # [N, 3] yaw rad from east, tilt rad, range m
    actor: Float  # [3] the estimate that cameras aim at


@dataclass
class PlanningTimes:
    """Measured seconds of every planning call; they differ from run to run."""

    central_s: list[float]
    local_s: list[float]


class Pilot:
    """One arm in flight. Call `measure` at each measurement and `step` at the tracking rate.

    Central planning, local planning and tracking have the rates of the configuration, counted from the
    first step. Drones plan one after the other, each with the latest plans of the others.

    Args:
        arm: the planner of the cameras' slots.
        config: weights and rates.
        drones: number of drones, 1 to 16.
        yaw_rad: of the first camera at the start, counterclockwise from east.
        heading_rad: the actor's heading before walking, from east, if `yaw_frame` is `heading`.
        clock: seconds, for `times`.

    Raises:
        ValueError: an impossible number of drones.
    """

    def __init__(
        self,
        arm: Arm,
        config: PlannerConfig,
        *,
        drones: int,
        yaw_rad: float,
        heading_rad: float = 0.0,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        if not 1 <= drones <= MOST_DRONES:
            raise ValueError(f"{drones} drones: 1 to {MOST_DRONES} can be planned for")
        self._config, self._clock = config, clock
        self._zero = YawZero(config, heading_rad)
        yaw_rad -= float(self._zero.at(np.zeros(1))[0])
        self._formation_planner = arm.start(config, drones=drones, yaw_rad=yaw_rad)
        self._local_planner = LocalPlanner(config)
        self._filter = ActorFilter(q=config.actor_q, sigma_m=config.actor_sigma_m)
        slots = formation_slots(
            np.array([yaw_rad]), drones, tilt_rad=config.tilt_rad, range_m=config.radius_m
        )
        self._formation = FormationPath(np.zeros(1), slots, np.array(config.slot_rates))
        self._plans: list[Plan | None] = [None] * drones
        self._next_central_s = self._next_local_s = -np.inf
        self.guard: Guard | None = None
        """Filter of the local plans: it decides which motion is flown. Set by a replay; None otherwise."""
        self.times = PlanningTimes([], [])
        self.separation: Counter[Separation] = Counter()

    def measure(self, t_s: float, position: Float) -> None:
        """Take in the actor's position [3] metres, world (the middle of the hips).

        Times must not go back.
        """
        self._filter.measure(t_s, position)

    def slots_now(self, t_s: float) -> tuple[Float, Float]:
        """Return commanded slots [N, 3], and their places about the actor's estimate, [N, 3] m, world."""
        slots = self._slots_at(np.array([t_s]))[0]
        return slots, self._filter.forecast(np.array([t_s]))[0] + slot_offsets(slots)

    def step(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> Command:
        """Replan if a plan is due, and return the commands for now.

        Args:
            t_s: now; at or after the latest measurement. There must be at least one.
            position: [N, 3] metres, world, of the drones.
            velocity: [N, 3] m/s.
            field: the distance field of the obstacles that are known now.
        """
        self.replan(t_s, position, velocity, field)
        return Command(*self.reference(t_s), *self.wanted(t_s))

    def replan(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        """Replan if a plan is due; arguments as in `step`."""
        config = self._config
        if t_s >= self._next_central_s - _NOW_S:
            self._next_central_s = max(self._next_central_s, t_s) + 1.0 / config.central_hz
            self._plan_formation(t_s, field)
        if t_s >= self._next_local_s - _NOW_S:
            self._next_local_s = max(self._next_local_s, t_s) + 1.0 / config.local_hz
            self._plan_locally(t_s, position, velocity, field)

    def wanted(self, t_s: float) -> tuple[Float, Float]:
        """Return commanded slots [N, 3], yaw from east, and the actor's estimate [3] that cameras aim at."""
        now = np.array([t_s])
        return self._slots_at(now)[0], self._filter.forecast(now)[0]

    def reference(self, t_s: float) -> tuple[Float, Float, Float]:
        """Return position, velocity, acceleration [N, 3] of the latest local plans, after the first step."""
        asked = [plan.at(np.array([t_s])) for plan in self._plans if plan is not None]
        where, speed, change = (np.concatenate(part) for part in zip(*asked, strict=True))
        return where, speed, change

    def _slots_at(self, t_s: Float) -> Float:
        """Return commanded slots [T, N, 3], their yaws from east."""
        slots = self._formation.at(t_s)
        return turned(slots, self._zero.at(t_s)) if self._config.yaw_frame == "heading" else slots

    def _plan_formation(self, t_s: float, field: DistanceField) -> None:
        config = self._config
        started = self._clock()
        knots = t_s + config.knot_s * np.arange(1, config.horizon_knots + 1, dtype=np.float64)
        commanded = self._formation.at(np.array([t_s]))[0]
        if config.yaw_frame == "heading":
            self._zero.follow(t_s, *self._filter.at(t_s)[1:])
        actor = Forecast(self._filter.forecast(knots), self._zero.at(knots))
        self._formation = self._formation_planner.plan(t_s, commanded, actor, field)
        self.times.central_s.append(self._clock() - started)

    def _plan_locally(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        config = self._config
        times = t_s + config.waypoint_s * np.arange(1, config.waypoints + 1, dtype=np.float64)
        actor = self._filter.forecast(times)
        slots = actor[:, None] + slot_offsets(self._slots_at(times))
        for i in range(len(self._plans)):
            started = self._clock()
            made = self._local_planner.plan(
                t_s,
                position[i],
                velocity[i],
                slots=slots[:, i],
                actor=actor,
                others=[plan for j, plan in enumerate(self._plans) if j != i and plan is not None],
                field=field,
                previous=self._plans[i],
            )
            self.times.local_s.append(self._clock() - started)
            self._plans[i] = (
                made.plan if self.guard is None else self.guard.admit(i, t_s, made.plan, self._filter, field)
            )
            self.separation[made.separation] += 1
