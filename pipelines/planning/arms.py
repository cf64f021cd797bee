"""The arms that are compared: ways to choose the slots of the cameras.

All share forecast, local planner and tracking. An arm is one object with a name that starts a
`FormationPlanner` for a flight; a package adds one by an entry point in `mocap.planner_arms`. The plan for
several people maximises a submodular worth of all views together, so that planning in turn is a good solution
(Hughes et al., "Multi-Robot Planning for Filming Groups of Moving Actors Leveraging Submodularity and Pixel
Density", CDC 2024): a view of what nobody sees yet adds more than another one of the same.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, visible
from pipelines.planning.forecast import Forecast
from pipelines.planning.formation import (
    RANGE,
    TILT,
    TOO_NEAR,
    YAW,
    FormationPath,
    Formations,
    Lattice,
    TeamViews,
    TeamWeights,
    best_sequence,
    best_teams,
    cheapest_slots,
    cost_map,
    costs_of_slots,
    formation_slots,
    lattice,
    slot_of,
    slot_offsets,
    slot_weights,
    turn_the_shorter_way,
    wrapped,
    yaw_set,
)
from pipelines.planning.scores import (
    coverage,
    hidden_by_people,
    in_view,
    log_determinant,
    predicted_error,
    ray_information,
    view_quality,
)
from pipelines.session.registries import Registry

# Drones do not fly below the ground, and cameras do not look straight down.
TILT_LIMITS_DEG = (-10.0, 85.0)
# Times are sums of periods: a plan is due this much early.
TIME_ROUNDING_S = 1e-6
# More rounds of planning in turn change no path in practice.
MAX_ROUNDS_IN_TURN = 10

RollOut = Callable[[FormationPath], tuple[Float, Float]]
"""Predicts the places of the drones [n, N, 3] and of the actor [N, 3], in m, at the times of N waypoints."""


class FormationPlanner(Protocol):
    """Planner that chooses the slots of the cameras during one flight."""

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        """Plan anew from the commanded slots [n, 3] (yaw rad, tilt rad, range m).

        `actor` is the forecast at the knots t_s + knot_s, t_s + 2 knot_s, ...
        """


@runtime_checkable
class RollingOut(Protocol):
    """Formation planner that compares what is flown of paths, once somebody sets `roll_out`."""

    roll_out: RollOut | None


class Arm(Protocol):
    """A way to plan formations."""

    @property
    def name(self) -> str:
        """Name that the user writes after `--arms`."""

    @property
    def title(self) -> str:
        """Name in reports."""

    def start(self, config: PlannerConfig, *, drones: int, yaw_rad: float) -> FormationPlanner:
        """Return a planner for a flight whose first camera starts at that yaw."""


@dataclass(frozen=True)
class PlannerArm:
    """An arm whose planner is made from the settings, the number of drones and the first yaw."""

    name: str
    title: str
    make: Callable[[PlannerConfig, int, float], FormationPlanner]

    def start(self, config: PlannerConfig, *, drones: int, yaw_rad: float) -> FormationPlanner:
        """Return a planner for a flight whose first camera starts at that yaw."""
        return self.make(config, drones, yaw_rad)


PLANNER_ARMS: Registry[Arm] = Registry("mocap.planner_arms", "planner arm")


class _FixedPlanner:
    """Planner that keeps the yaw of the start; only the local planner gives way."""

    def __init__(self, config: PlannerConfig, drones: int, yaw_rad: float) -> None:
        self._slots = formation_slots(
            np.array([yaw_rad]), drones, tilt_rad=config.tilt_rad, range_m=config.radius_m
        )
        self._rates = np.array(config.slot_rates)

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:  # noqa: ARG002
        return FormationPath(np.array([t_s]), self._slots, self._rates)


class _AdaptivePlanner:
    """Planner of the formation's yaw (Ho et al.), at one tilt and range."""

    def __init__(self, config: PlannerConfig, drones: int, yaw_rad: float) -> None:
        yaws = yaw_set(config.tuning.yaws, yaw_rad)
        states = _all_states(yaws, np.array([config.tilt_rad]), np.array([config.radius_m]))
        slots = states[:, None] + formation_slots(np.zeros(len(states)), drones, tilt_rad=0.0, range_m=0.0)
        self._lattice = _lattice_of(states, config)
        self._formations = Formations(self._lattice, slots, slot_offsets(slots))
        self._config, self._rates = config, np.array(config.slot_rates)

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        position = np.ascontiguousarray(actor.position)
        weights = slot_weights(self._config)
        through = cheapest_slots(field.grid, field.sight, position, self._formations, weights, commanded)
        return FormationPath(_knots(t_s, through, self._lattice), through, self._rates)


class _TeamPlanner:
    """Planner that plans twice a second and keeps its path in between."""

    _path: FormationPath | None = None
    _config: PlannerConfig

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        period_s = self._config.tuning.team_plan_period_s - TIME_ROUNDING_S
        if self._path is None or t_s - self._path.knot_s[0] >= period_s:
            self._path = self._planned(t_s, commanded, actor, field)
        return self._path

    def _planned(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        raise NotImplementedError


class _JointPlanner(_TeamPlanner):
    """Planner of yaw, tilt and range of every drone for the least error of all views together."""

    def __init__(self, config: PlannerConfig, drones: int, yaw_rad: float) -> None:
        _, tilt_step, range_step = np.array(config.slot_rates) * config.tuning.knot_s
        neighbour = _in_a_turn(drones)
        self._yaws = max(round(config.tuning.yaws / neighbour), 1) * neighbour
        tilts = np.clip(config.tilt_rad + tilt_step * np.arange(-1, 2), *np.radians(TILT_LIMITS_DEG))
        reached = (*config.ranges_m, config.radius_m)
        low, high = (round((end - config.radius_m) / range_step) for end in (min(reached), max(reached)))
        ranges = config.radius_m + range_step * np.arange(low, high + 1, dtype=np.float64)
        states = _all_states(yaw_set(self._yaws, yaw_rad), np.unique(tilts), ranges)
        self._lattice = _lattice_of(states, config)
        self._offsets = slot_offsets(states)
        information = ray_information(self._offsets, config.tuning.errors)[:, *np.triu_indices(3)]
        per_yaw = len(states) // self._yaws
        first = np.arange(len(states))[:, None] + np.arange(drones) * (self._yaws // neighbour) * per_yaw
        formations = first % len(states)
        off_tilt, off_range = (
            np.abs(states[:, axis] - value) > 1e-9  # rad, m: rounding
            for axis, value in ((TILT, config.tilt_rad), (RANGE, config.radius_m))
        )
        self._views = TeamViews(
            self._lattice,
            self._offsets,
            np.ascontiguousarray(information),
            formations,
            ~(off_tilt | off_range),
        )
        self._weights = TeamWeights(
            config.tuning.w_error, config.tuning.prior_sigma_m**-2, config.soft_separation_m
        )
        off_start = np.abs(wrapped(states[:, YAW] - yaw_rad)) + np.abs(states[:, TILT] - config.tilt_rad)
        start = formations[int((off_start + np.abs(states[:, RANGE] - config.radius_m)).argmin())]
        self._team = np.repeat(start[:, None], config.horizon_knots, axis=1)  # [n, T]
        self._config, self._rates = config, np.array(config.slot_rates)
        self.roll_out: RollOut | None = None
        self._adaptive = _AdaptivePlanner(config, drones, yaw_rad)
        self._as_adaptive = False

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        path = super().plan(t_s, commanded, actor, field)
        if self._as_adaptive and path.knot_s[0] < t_s:  # nothing was better: plan as often as `adaptive`
            return self._adaptive.plan(t_s, commanded, actor, field)
        return path

    def _planned(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        states = self._lattice.states
        slots = costs_of_slots(field, actor.position, self._offsets[:, None], self._config)
        free = (slots.occluded[..., 0] == 0.0).astype(np.float64)
        free = (free + self._beside(free)) / 2.0  # drones are not exactly in their slots
        price = cost_map(slots, self._config) + self._config.tuning.w_hidden * (1.0 - free)
        teams = best_teams(price, free, self._views, self._weights, commanded, self._team)
        paths = []
        for team in teams:
            through = _through(commanded, states[team.T])
            paths.append(FormationPath(_knots(t_s, through, self._lattice), through, self._rates))
        if self.roll_out is None:
            self._team = teams[0]
            return paths[0]
        paths.append(self._adaptive.plan(t_s, commanded, actor, field))
        costs = [self._flown(*self.roll_out(path), field) for path in paths]
        self._team = teams[int(np.argmin(costs[:-1]))]
        best = int(np.argmin(costs))
        self._as_adaptive = best == len(teams)
        return paths[best]

    def _flown(self, places: Float, actor: Float, field: DistanceField) -> float:
        """Compute the mean cost of the next seconds for drones at [n, N, 3] and the actor at [N, 3] m."""
        config = self._config
        soon = max(round(config.tuning.rolled_out_s / config.tuning.waypoint_s), 1)
        places, actor = places[:, :soon], actor[:soon]
        seen = visible(field, places, actor, start_m=config.tuning.sight_start_m)
        information = ray_information(places - actor, config.tuning.errors) * seen[..., None, None]
        known = information.sum(axis=0) + np.eye(3) / config.tuning.prior_sigma_m**2
        slots = slot_of(places - actor)
        steep = np.maximum(slots[..., TILT] - config.tilt_rad - np.radians(config.tuning.steeper_deg), 0.0)
        near = np.maximum(config.actor_distance_m + config.tuning.near_actor_m - slots[..., RANGE], 0.0)
        cost = config.tuning.w_error * np.log(predicted_error(known)) + config.tuning.w_hidden * (~seen).sum(
            axis=0
        )
        cost += config.tuning.w_avoided * (steep + near).sum(axis=0)
        return float(cost.mean())

    def _beside(self, values: Float) -> Float:
        """Return the mean of values [T, S] at the two neighbouring yaws."""
        by_yaw = values.reshape(len(values), self._yaws, -1)
        return ((np.roll(by_yaw, 1, axis=1) + np.roll(by_yaw, -1, axis=1)) / 2.0).reshape(values.shape)


def _in_a_turn(drones: int) -> int:
    """Return how many neighbours of a formation fill a turn: so many equal parts of it hold their yaws."""
    return 4 if drones == 2 else drones


def _all_states(yaws: Float, tilts: Float, ranges: Float) -> Float:
    """Return every combination, [S, 3]."""
    return np.stack(np.meshgrid(yaws, tilts, ranges, indexing="ij"), axis=-1).reshape(-1, 3)


def _lattice_of(states: Float, config: PlannerConfig) -> Lattice:
    return lattice(
        states, rates=np.array(config.slot_rates), knot_s=config.tuning.knot_s, w_turn=config.tuning.w_turn
    )


def _through(commanded: Float, slots: Float) -> Float:
    """Return the commanded slots [n, 3], then slots [T, n, 3], each turn the shorter way round."""
    through = np.concatenate([commanded[None], slots])
    turn_the_shorter_way(through)
    return through


def _knots(t_s: float, through: Float, grid: Lattice) -> Float:
    return t_s + grid.knot_s * np.arange(len(through), dtype=np.float64)


# --- several people ---


class SlotChoice(NamedTuple):
    """Slots among which a drone has a path, and what it would see from them: T times, S slots, P people."""

    lattice: Lattice
    start: Float  # [3] state from which it starts
    price: Float  # [T, S] costs of the slots
    position: Float  # [T, S, 3] metres, world
    covered: Float  # [T, S, P, 7] see `scores.coverage`
    information: Float | None = None  # [T, S, P, 3, 3] 1/m^2; None where it does not count


class Worth(NamedTuple):
    """Worth of a team's views: view quality, and the logarithm of the information's determinant."""

    weight: Float  # [P] of the people
    quality: float  # of a unit of view quality
    information: float = 0.0  # of a unit of the logarithm
    prior: float = 1.0  # 1/m^2, of a joint without any camera
    apart_m: float = 0.0  # slots of two drones are farther apart; 0 where that does not matter

    def of(self, covered: Float, information: Float | None) -> Float:
        """Compute the worth [...] of views that cover [..., P, 7] and hold information [..., P, 3, 3]."""
        found = self.quality * view_quality(covered, self.weight)
        if information is not None:
            known = log_determinant(information + self.prior * np.eye(3))
            found = found + self.information * (known * self.weight).sum(axis=-1)
        return found


Path = tuple[int, Int64]
"""Number of the choice that a drone takes, and its states [T]."""


def plan_in_turn(choices: Sequence[Sequence[SlotChoice]], worth: Worth) -> list[Path]:
    """Plan a team, one drone's cheapest path after the other, until nobody finds a better one."""
    taken: dict[int, Path] = {}
    for _ in range(MAX_ROUNDS_IN_TURN):
        changed = False
        for i, own in enumerate(choices):
            others = [(choices[j][choice], path) for j, (choice, path) in taken.items() if j != i]
            found = _best_path(own, others, worth)
            before = taken.get(i)
            changed |= before is None or found[0] != before[0] or not np.array_equal(found[1], before[1])
            taken[i] = found
        if not changed:
            break
    return [taken[i] for i in range(len(choices))]


def _best_path(
    choices: Sequence[SlotChoice], others: Sequence[tuple[SlotChoice, Int64]], worth: Worth
) -> Path:
    best, least = (0, np.zeros(0, np.int64)), np.inf
    for number, choice in enumerate(choices):
        cost = choice.price.copy()
        for t in range(len(cost)):
            covered, information = choice.covered[t], choice.information
            before = sum((other.covered[t, path[t]] for other, path in others), np.zeros(covered.shape[1:]))
            known, knows = None, None
            if information is not None:
                known, knows = np.zeros(information.shape[2:]), information[t]
                for other, path in others:
                    if other.information is not None:
                        known = known + other.information[t, path[t]]
                knows = known + knows
            cost[t] += worth.of(before, known) - worth.of(before + covered, knows)
            for other, path in others if worth.apart_m else ():
                apart = np.linalg.norm(choice.position[t] - other.position[t, path[t]], axis=-1)
                cost[t] += np.where(apart < worth.apart_m, TOO_NEAR, 0.0)
        path, total = best_sequence(cost, choice.lattice, choice.start)
        if total < least:
            best, least = (number, path), total
    return best


class _GroupPlanner(_TeamPlanner):
    """Planner for several people: for each drone its yaw, and whom it films."""

    def __init__(self, config: PlannerConfig, drones: int, yaw_rad: float) -> None:
        neighbour = _in_a_turn(drones)
        yaws = yaw_set(max(round(config.tuning.yaws / neighbour), 1) * neighbour, yaw_rad)
        states = _all_states(yaws, np.array([config.tilt_rad]), np.array([config.radius_m]))
        self._lattice = _lattice_of(states, config)
        self._config, self._rates = config, np.array(config.slot_rates)
        self._aims: list[Float] | None = None  # [P] of each drone

    def _planned(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        config = self._config
        people = actor.position[None] if actor.people is None else actor.people  # [P, T, 3]
        weight = np.ones(len(people)) if actor.weight is None else actor.weight
        shares = weight / weight.sum()
        aims = [*np.eye(len(people))[weight > 0.0], *([shares] if len(people) > 1 else [])]
        views = [self._views(aim, people, field) for aim in aims]
        choices, kept = [], []
        for slot, before in zip(commanded, self._aims or [shares] * len(commanded), strict=True):
            place = before @ people[:, 0] + slot_offsets(slot)
            kept.append([np.array_equal(aim, before) for aim in aims])
            choices.append(
                [
                    view._replace(start=slot)
                    if same
                    else self._from_elsewhere(view, place, aim @ people[:, 0])
                    for aim, view, same in zip(aims, views, kept[-1], strict=True)
                ]
            )
        face = float(view_quality(np.eye(1, 7) / config.radius_m**2, np.ones(1)))
        paths = plan_in_turn(
            choices,
            Worth(
                len(people) * shares,
                config.tuning.w_error / face,
                config.tuning.w_error,
                config.tuning.prior_sigma_m**-2,
                config.soft_separation_m,
            ),
        )
        self._aims = [aims[choice] for choice, _ in paths]
        slots = self._lattice.states[np.stack([path for _, path in paths], axis=1)]  # [T, n, 3]
        stays = np.array([own[choice] for own, (choice, _) in zip(kept, paths, strict=True)])
        through = _through(np.where(stays[:, None], commanded, slots[0]), slots)
        return FormationPath(_knots(t_s, through, self._lattice), through, self._rates, np.stack(self._aims))

    def _views(self, aim: Float, people: Float, field: DistanceField) -> SlotChoice:
        """Compute prices and views of all slots about a place among people [P, T, 3]."""
        config = self._config
        place = aim @ people.swapaxes(0, 1)  # [T, 3]
        states = self._lattice.states
        offsets = slot_offsets(states)
        position = place[:, None] + offsets  # [T, S, 3]
        looks_rad = np.tile(states[:, YAW] + np.pi, (len(place), 1))
        at_knots = people.swapaxes(0, 1)[:, None]  # [T, 1, P, 3]
        eyes = position[:, :, None]
        seen = visible(field, eyes, at_knots, start_m=config.tuning.sight_start_m)
        if len(people) > 1:
            seen &= in_view(eyes, looks_rad[..., None], at_knots, config.tuning.errors.fov_rad)
            for p in range(len(people)):
                others = np.delete(people, p, axis=0)[:, :, None]
                seen[..., p] &= ~hidden_by_people(position, at_knots[:, :, p], others)
        covered = coverage(
            position, looks_rad, at_knots, np.zeros(at_knots.shape[:-1]), fov_rad=config.tuning.errors.fov_rad
        )
        offset = eyes - at_knots
        costs = costs_of_slots(field, place, offsets[:, None], config)
        near = (
            np.linalg.norm(offset, axis=-1).min(axis=-1)
            < config.actor_distance_m + config.tuning.group_margin_m
        )
        return SlotChoice(
            lattice=self._lattice,
            start=states[0],
            price=cost_map(costs, config) + np.where(near, TOO_NEAR, 0.0),
            position=position,
            covered=covered * seen[..., None],
            information=ray_information(offset, config.tuning.errors) * seen[..., None, None],
        )

    def _from_elsewhere(self, view: SlotChoice, place: Float, about: Float) -> SlotChoice:
        """Return the views of a drone that begins to film somebody else: none before it can have arrived."""
        config = self._config
        way = np.linalg.norm(view.position - place, axis=-1)
        acceleration_mps2, speed_mps = config.acceleration_mps2, config.ground_speed_mps
        most_m = speed_mps**2 / acceleration_mps2
        takes_s = np.where(way < most_m, 2.0 * np.sqrt(way / acceleration_mps2), (way + most_m) / speed_mps)
        there = takes_s <= config.tuning.knot_s * np.arange(1, len(way) + 1)[:, None]
        return view._replace(
            start=slot_of(place - about),
            covered=view.covered * there[..., None, None],
            information=None if view.information is None else view.information * there[..., None, None, None],
        )


# --- all arms ---


FIXED = PlannerArm("fixed", "fixed yaw", _FixedPlanner)
ADAPTIVE = PlannerArm("adaptive", "adaptive formation", _AdaptivePlanner)
JOINT = PlannerArm("joint", "all drones together, any spacing", _JointPlanner)
GROUP = PlannerArm("group", "several people, each drone films whom the others miss", _GroupPlanner)
