"""Replay of an arm: its planner in flight (`Pilot`), offline, against the logged actor and the maps.

Equal arguments give equal replays. No measurement or map is used before its
time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import look_at
from pipelines.planning.arms import Arm, RollingOut
from pipelines.planning.config import MOST_DRONES, PlannerConfig
from pipelines.planning.distance_field import DistanceField, open_space, zone_edges
from pipelines.planning.forecast import ActorFilter, Forecast, PeopleFilter, YawZero, positions_at
from pipelines.planning.formation import (
    TILT,
    YAW,
    FormationPath,
    formation_slots,
    slot_of,
    slot_offsets,
    turned,
)
from pipelines.planning.guard import FlownMotion, Guard
from pipelines.planning.local import LocalPlanner
from pipelines.planning.tracking import DronePlan, tracking_times

# Times are sums of periods: what is due this much early is due.
DUE_ROUNDING_S = 1e-6


class Start(NamedTuple):
    """Formation at the start of a flight."""

    drones: int  # 1 to 16
    yaw_rad: float = 0.0  # of the first camera, counterclockwise from east
    heading_rad: float = 0.0  # the actor's before walking, from east, if `yaw_frame` is `heading`


@dataclass(frozen=True)
class Replay:
    """A replayed flight of N cameras at T times, one per tracking step."""

    t_ns: Int64  # [T] on the clock of the actor's log
    position: Float  # [N, T, 3] metres, world
    velocity: Float  # [N, T, 3] m/s
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera, aimed at the estimate
    slots: Float  # [N, T, 3] commanded: yaw (rad from east, continuous), tilt (rad), range (m)
    actor: Float  # [T, 3] the log, interpolated; of several people the weighted middle
    estimate: Float  # [N, T, 3] the planner's estimate of whom each camera films
    aim: Float  # [N, T, P] shares of people in the place that each camera films
    safety: dict[str, int]  # local plannings by `guard.FlownMotion`

    @property
    def t_s(self) -> Float:
        """Seconds [T] since the start."""
        seconds: Float = (self.t_ns - self.t_ns[0]) / 1e9
        return seconds

    @property
    def tilt_rad(self) -> Float:
        """Tilt [N, T] as flown, above the logged actor."""
        return slot_of(self.position - self.actor)[..., TILT]

    @property
    def formation_yaw_rad(self) -> Float:
        """Yaw [T] of the first camera's slot, continuous."""
        return self.slots[0, :, YAW]


class Pilot:
    """One arm in flight. Call `measure` at each measurement and `replan` at the tracking rate.

    Central planning, local planning and tracking have the rates of the configuration, counted from the
    first call. Drones plan one after the other, each with the latest plans of the others.

    Raises:
        ValueError: an impossible number of drones.
    """

    def __init__(
        self,
        arm: Arm,
        config: PlannerConfig,
        start: Start,
        *,
        weights: Sequence[float] = (1.0,),
    ) -> None:
        if not 1 <= start.drones <= MOST_DRONES:
            raise ValueError(f"{start.drones} drones: 1 to {MOST_DRONES} can be planned for")
        self._config = config
        self._zero = YawZero(config, start.heading_rad)
        yaw_rad = start.yaw_rad - float(self._zero.at(np.zeros(1))[0])
        self._formation_planner = arm.start(config, drones=start.drones, yaw_rad=yaw_rad)
        planner = self._formation_planner
        self._rolling_out = planner if isinstance(planner, RollingOut) else None
        self._local_planner = LocalPlanner(config)
        self._weight = np.array(weights, dtype=np.float64)
        self._by_weight = np.tile(self._weight / self._weight.sum(), (start.drones, 1))
        people = [ActorFilter(q=config.actor_q, sigma_m=config.tuning.actor_sigma_m) for _ in weights]
        self._filter = PeopleFilter(people, self._weight)
        slots = formation_slots(
            np.array([yaw_rad]), start.drones, tilt_rad=config.tilt_rad, range_m=config.radius_m
        )
        self._formation = FormationPath(np.zeros(1), slots, np.array(config.slot_rates))
        self._plans: list[DronePlan | None] = [None] * start.drones
        self._next_central_s = self._next_local_s = -np.inf
        self.guard: Guard | None = None
        """Filter of the local plans: it decides which motion is flown. Set by a replay; None otherwise."""

    def measure(self, t_s: float, position: Float, person: int = 0) -> None:
        """Take in the position [3] of the actor or of one of several people: the hips' middle, m, world.

        Times of a person must not go back. Everybody must be measured before the first `replan`.
        """
        self._filter.measure(t_s, position, person)

    def replan(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        """Replan if a plan is due.

        Args:
            t_s: now; at or after the latest measurement. There must be at least one.
            position: [N, 3] metres, world, of the drones.
            velocity: [N, 3] m/s.
            field: the distance field of the obstacles that are known now.
        """
        config = self._config
        if t_s >= self._next_central_s - DUE_ROUNDING_S:
            self._next_central_s = max(self._next_central_s, t_s) + 1.0 / config.tuning.central_hz
            self._plan_formation(t_s, position, velocity, field)
        if t_s >= self._next_local_s - DUE_ROUNDING_S:
            self._next_local_s = max(self._next_local_s, t_s) + 1.0 / config.tuning.local_hz
            self._plan_locally(t_s, position, velocity, field)

    @property
    def aim(self) -> Float:
        """Shares [N, P] of people in the place that each camera films: by weight, unless the arm chooses."""
        return self._by_weight if self._formation.aim is None else self._formation.aim

    @property
    def due_s(self) -> float:
        """Time from which `replan` makes the next plan."""
        return min(self._next_central_s, self._next_local_s) - DUE_ROUNDING_S

    def wanted(self, t_s: Float) -> tuple[Float, Float]:
        """Return commanded slots [T, N, 3], yaw from east, and the places [N, T, 3] that cameras aim at."""
        return self._slots_at(t_s, self._formation), self._aimed(t_s)

    def reference(self, t_s: float) -> tuple[Float, Float, Float]:
        """Return position, velocity, acceleration [N, 3] of the latest local plans, after `replan`."""
        asked = [plan.at(np.array([t_s])) for plan in self._plans if plan is not None]
        where, speed, change = (np.concatenate(part) for part in zip(*asked, strict=True))
        return where, speed, change

    def _aimed(self, t_s: Float) -> Float:
        """Return the places [N, T, 3] that cameras film, and about which their slots are."""
        people = self._filter.each(t_s)
        aimed: Float = self.aim @ people.reshape(len(people), -1)
        return aimed.reshape(-1, *people.shape[1:])

    def _slots_at(self, t_s: Float, path: FormationPath) -> Float:
        """Return the slots of a path, [T, N, 3], their yaws from east."""
        slots = path.at(t_s)
        return turned(slots, self._zero.at(t_s)) if self._config.yaw_frame == "heading" else slots

    def _plan_formation(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        config = self._config
        knots = t_s + config.tuning.knot_s * np.arange(1, config.horizon_knots + 1, dtype=np.float64)
        commanded = self._formation.at(np.array([t_s]))[0]
        if config.yaw_frame == "heading":
            self._zero.follow(t_s, *self._filter.at(t_s)[1:])
        people = self._filter.each(knots)
        actor = Forecast(self._filter.middle(people), self._zero.at(knots), people, self._weight)
        if self._rolling_out is not None:
            self._rolling_out.roll_out = partial(
                self._roll_out, t_s=t_s, position=position, velocity=velocity, field=field
            )
        self._formation = self._formation_planner.plan(t_s, commanded, actor, field)

    def _wanted_ahead(self, path: FormationPath, t_s: float) -> tuple[Float, Float]:
        """Return wanted places of drones [T, N, 3] and the places [N, T, 3] that they film, at waypoints."""
        config = self._config
        times = t_s + config.tuning.waypoint_s * np.arange(1, config.tuning.waypoints + 1, dtype=np.float64)
        aimed = self._aimed(times)
        return aimed.swapaxes(0, 1) + slot_offsets(self._slots_at(times, path)), aimed

    def _roll_out(
        self, path: FormationPath, *, t_s: float, position: Float, velocity: Float, field: DistanceField
    ) -> tuple[Float, Float]:
        """Predict the flight along a path (`arms.RollOut`): the drones plan locally, one after the other."""
        wanted, aimed = self._wanted_ahead(path, t_s)
        made: list[DronePlan] = []
        for i, previous in enumerate(self._plans):
            plan = self._local_planner.plan(
                t_s,
                position[i],
                velocity[i],
                slots=wanted[:, i],
                actor=aimed[i],
                others=made,
                field=field,
                previous=previous,
            )
            made.append(plan)
        return np.stack([plan.path[1:] for plan in made]), aimed[0]

    def _plan_locally(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        slots, aimed = self._wanted_ahead(self._formation, t_s)
        for i in range(len(self._plans)):
            made = self._local_planner.plan(
                t_s,
                position[i],
                velocity[i],
                slots=slots[:, i],
                actor=aimed[i],
                others=[plan for j, plan in enumerate(self._plans) if j != i and plan is not None],
                field=field,
                previous=self._plans[i],
            )
            self._plans[i] = (
                made if self.guard is None else self.guard.admit(i, t_s, made, self._filter, field)
            )


def replay(
    arm: Arm,
    actor_t_ns: Int64,
    actor: Float,
    fields: Sequence[DistanceField],
    start: Start,
    *,
    config: PlannerConfig,
    weights: Sequence[float] = (1.0,),
) -> Replay:
    """Fly an arm against a log.

    The drones start in their slots, at rest, and fly what `guard.Guard` admits. Several people are one actor
    for most arms, their weighted middle; `group` decides whom each drone films.

    Args:
        actor: [A, 3] metres, world, the middle of the hips; or [A, P, 3] of several people. Who is NaN was
            not measured then. The replay lasts while everybody is measured.
        fields: the maps by the time from which they hold; before the first one nothing is known.
        weights: of the people.

    Raises:
        ValueError: times that do not ascend, fewer than two measurements, an impossible number of drones.
    """
    people = actor if actor.ndim == 3 else actor[:, None]
    measured_then = np.isfinite(people.sum(axis=2))  # [A, P]
    rows = measured_then.any(axis=1)
    t_ns, measured, known = actor_t_ns[rows], people[rows], measured_then[rows]
    if known.sum(axis=0).min() < 2 or (np.diff(t_ns) <= 0).any():
        raise ValueError("a replay needs two measurements of the actor or more, their stamps ascending")
    first, last = int(known.argmax(axis=0).max()), len(t_ns) - int(known[::-1].argmax(axis=0).max())
    log_s = (t_ns - t_ns[first]) / 1e9
    maps = sorted(fields, key=lambda field: field.from_ns)
    replay_ns = tracking_times(t_ns[first:last], config)
    map_at = np.searchsorted([field.from_ns for field in maps], replay_ns, side="right")
    zones = zone_edges(config.zones)
    fields_known = [field.barring(zones) for field in (open_space(), *maps)]
    taken_in = np.searchsorted(t_ns, replay_ns, side="right")

    weight = np.array(weights, dtype=np.float64)
    pilot = Pilot(arm, config, start, weights=weights)
    for row, person in np.argwhere(known[: first + 1]):
        pilot.measure(log_s[row], measured[row, person], person)
    first_slots, first_estimate = pilot.wanted(np.zeros(1))
    guard = pilot.guard = Guard(first_estimate[:, 0] + slot_offsets(first_slots[0]), config)
    shape = (start.drones, len(replay_ns), 3)
    position, velocity, slots, estimate = (np.empty(shape) for _ in range(4))
    aim = np.empty((*shape[:2], len(weight)))
    done, k = first + 1, 0
    times_s = (replay_ns - t_ns[first]) / 1e9
    while k < len(times_s):
        if taken_in[k] > done:
            for row, person in np.argwhere(known[done : taken_in[k]]):
                pilot.measure(log_s[done + row], measured[done + row, person], person)
            done = int(taken_in[k])
        pilot.replan(float(times_s[k]), guard.position, guard.velocity, fields_known[map_at[k]])
        measured_next = int(np.searchsorted(taken_in, done, side="right"))
        planned_next = int(np.searchsorted(times_s, pilot.due_s))
        until = slice(k, max(min(measured_next, planned_next), k + 1))  # nothing new before
        wanted, estimate[:, until] = pilot.wanted(times_s[until])
        slots[:, until], aim[:, until] = wanted.swapaxes(0, 1), pilot.aim[:, None]
        position[:, until], velocity[:, until] = guard.fly(until.stop - k)
        k = until.stop
    return Replay(
        t_ns=replay_ns,
        position=position,
        velocity=velocity,
        quaternion_xyzw=look_at(position, estimate),
        slots=slots,
        actor=np.tensordot(weight / weight.sum(), positions_at(t_ns, measured, replay_ns), 1),
        estimate=estimate,
        aim=aim,
        safety={kind.value: guard.counts[kind] for kind in FlownMotion},
    )
