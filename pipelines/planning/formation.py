"""Slots about the actor, the costs of formations, and the cheapest sequence of them by dynamic programming.

As printed, Alg. 1 of Ho et al. adds the index of the best neighbour instead of its value, and leaves out the
time of the costs. Here V[T] = C[T] and V[t, i] = C[t, i] + min over neighbours j of (V[t + 1, j] + move).
The kernels have no threads and no fastmath: the same numbers give the same bytes.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import (
    DIAGONAL,
    ROUNDING,
    DistanceField,
    Grid,
    Sight,
    interpolate,
    look,
    nearest,
    occupied_samples,
    sampling,
)

# A slot too near to another drone's costs more than any gain.
TOO_NEAR = 100.0
# A cell exactly as far as the rates allow is a neighbour: this margin covers the rounding.
REACH_MARGIN_S = 1e-9
# Teams change little after so many rounds, and each costs as much as the first.
MAX_TEAM_ROUNDS = 4

YAW, TILT, RANGE = range(3)
"""Indices of a slot: yaw (rad, counterclockwise from east), tilt (rad above the actor), range (m)."""


def spacing_rad(drones: int) -> float:
    """Return the yaw between neighbours: equal parts of a turn, 90 deg for two, not to face each other."""
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


def slot_of(offset: Float) -> Float:
    """Compute the slot [..., 3] of an offset from the actor, yaw within -pi..pi."""
    x, y, z = np.moveaxis(offset, -1, 0)
    level = np.hypot(x, y)
    return np.stack([np.arctan2(y, x), np.arctan2(z, level), np.hypot(level, z)], axis=-1)


def wrapped(angle_rad: Float) -> Float:
    """Wrap angles to -pi..pi, half open."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def yaw_set(yaws: int, start_rad: float) -> Float:
    """Return equidistant yaws [D] over -pi..pi with the start's: nothing turns without a reason."""
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
        """Return slots [T, n, 3] at times [T]; they move at the full rate, then wait for the next knot."""
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


# --- search ---


class Lattice(NamedTuple):
    """States of a formation (or of one drone), and the neighbours that can follow each."""

    states: Float  # [S, 3] yaw, tilt, range
    rates: Float  # [3] per second
    knot_s: float
    w_turn: float
    neighbours: Int64  # [S, K] nearest first, itself at the front; -1 fills up
    move: Float  # [S, K] cost of going there


class Formations(NamedTuple):
    """Formations to choose from."""

    lattice: Lattice
    slots: Float  # [S, n, 3] of each state
    offsets: Float  # [S, n, 3] m, the same from the actor


class TeamViews(NamedTuple):
    """Slots that any drone of a team can take."""

    lattice: Lattice
    offsets: Float  # [S, 3] m from the actor
    information: Float  # [S, 6] 1/m^2 of a free view: xx, xy, xz, yy, yz, zz
    formations: Int64  # [S, n] states of a team of equal spacing whose first drone has each state
    as_asked: Bool  # [S] the tilt and range of the settings


class TeamWeights(NamedTuple):
    """Weights of the search for a team, by name; see `PlannerConfig`."""

    w_error: float
    prior: float  # 1/m^2, of a joint without any camera
    apart_m: float  # slots of two drones are farther apart


class SlotWeights(NamedTuple):
    """Weights of the search, by name; see `PlannerConfig`."""

    w_obs: float
    w_occ: float
    eps_obs_m: float
    sight_start_m: float


def slot_weights(config: PlannerConfig) -> SlotWeights:
    """Return the weights of the search's kernels."""
    return SlotWeights(config.w_obs, config.w_occ, config.tuning.eps_obs_m, config.tuning.sight_start_m)


@helper
def _look_at_slots(
    grid: Grid,
    sight: Sight,
    actor: Float,
    offsets: Float,
    eps_obs_m: float,
    start_m: float,
    reached: Bool,
    obstacle: Float,
    share: Float,
) -> None:
    """Compute the results of `_slot_costs`, into arrays of zeros, for the states that are reached [T, S]."""
    times, (states, cameras, _) = actor.shape[0], offsets.shape
    side_m = grid.resolution_m
    rules, counts = np.zeros((states, cameras, 11)), np.zeros((states, cameras), np.int64)
    longest_m = 0.0
    for s in range(states):
        for i in range(cameras):
            x, y, z = offsets[s, i]
            counts[s, i] = sampling(x, y, z, start_m, side_m, rules[s, i])
            longest_m = max(longest_m, rules[s, i, 10])
    clear = math.ceil(2.0 * eps_obs_m / side_m + 1.0)  # from this leap on the nearest obstacle costs nothing
    per_m = 1.0 / side_m
    for t in range(times):
        spare_m = nearest(grid, actor[t, 0], actor[t, 1], actor[t, 2]) - DIAGONAL * side_m
        if spare_m > longest_m + eps_obs_m + (DIAGONAL + ROUNDING) * side_m:
            continue
        free_m = spare_m + (0.5 - ROUNDING) * side_m  # about the actor
        ax = (actor[t, 0] - grid.origin[0]) / side_m
        ay = (actor[t, 1] - grid.origin[1]) / side_m
        az = (actor[t, 2] - grid.origin[2]) / side_m
        # Neighbouring sight lines follow each other, so that their look-ups hit the cache.
        for i in range(cameras):
            for s in range(states):
                if not reached[t, s]:
                    continue
                rule, count = rules[s, i], counts[s, i]
                x, y, z = offsets[s, i]
                is_occupied, leap = look(sight, ax + x * per_m, ay + y * per_m, az + z * per_m)
                if is_occupied or leap < clear:
                    distance = interpolate(grid, actor[t, 0] + x, actor[t, 1] + y, actor[t, 2] + z)[0]
                    obstacle[t, s, i] = min(max(1.0 - distance / eps_obs_m, 0.0), 1.0)
                first = max(int((free_m - start_m) * rule[9] - 0.5), 0)
                end = count if is_occupied else count - leap
                if first < end:
                    share[t, s, i] = (
                        occupied_samples(sight, ax, ay, az, rule, float(first), float(end)) / count
                    )


@cached
def _slot_costs(
    grid: Grid, sight: Sight, actor: Float, offsets: Float, eps_obs_m: float, start_m: float
) -> tuple[Float, Float]:
    """Compute obstacle cost and occupied share of the sight line, [T, S, n] each; see `costs_of_slots`."""
    shape = (actor.shape[0], offsets.shape[0], offsets.shape[1])
    obstacle, share, reached = np.zeros(shape), np.zeros(shape), np.ones(shape[:2], np.bool_)
    _look_at_slots(grid, sight, actor, offsets, eps_obs_m, start_m, reached, obstacle, share)
    return obstacle, share


@helper
def _weigh(obstacle: Float, share: Float, w_obs: float, w_occ: float) -> Float:
    """Compute the cost map [T, S] from the results of `_slot_costs`."""
    times, states, cameras = obstacle.shape
    cost = np.zeros((times, states))
    for t in range(times):
        for s in range(states):
            for i in range(cameras):
                cost[t, s] += w_obs * obstacle[t, s, i] + w_occ * share[t, s, i]
    return cost


@helper
def _first_step(lattice: Lattice, start: Float) -> tuple[Bool, Float]:
    """Test which states [S] can follow slots anywhere between the states; return the time to each, too."""
    states = lattice.states.shape[0]
    within, nearest_s = np.zeros(states, np.bool_), math.inf
    reach_s, way_s = np.zeros(states), np.zeros(states)
    for s in range(states):
        for axis in range(3):
            way = abs(lattice.states[s, axis] - start[axis])
            if axis == YAW:
                way = abs(_wrapped(way))
            reach_s[s] = max(reach_s[s], way / lattice.rates[axis])
            way_s[s] += way / lattice.rates[axis]
        nearest_s = min(nearest_s, reach_s[s])
    for s in range(states):
        within[s] = reach_s[s] <= max(lattice.knot_s, nearest_s) + REACH_MARGIN_S
    return within, way_s


@helper
def _reached(lattice: Lattice, start: Float, times: int) -> Bool:
    """Test which states a sequence can be in at each time, [T, S]."""
    reached = np.zeros((times, lattice.states.shape[0]), np.bool_)
    within = _first_step(lattice, start)[0]
    for s in range(within.shape[0]):
        reached[0, s] = within[s]
    for t in range(times - 1):
        for s in range(reached.shape[1]):
            if reached[t, s]:
                for k in range(lattice.neighbours.shape[1]):
                    if lattice.neighbours[s, k] >= 0:
                        reached[t + 1, lattice.neighbours[s, k]] = True
    return reached


@helper
def _search(cost: Float, lattice: Lattice, start: Float) -> tuple[Int64, float]:
    times, states = cost.shape
    value = cost.copy()
    following = np.zeros((times, states), np.int64)
    for t in range(times - 2, -1, -1):
        for s in range(states):
            best = math.inf
            for k in range(lattice.neighbours.shape[1]):
                j = lattice.neighbours[s, k]
                if j >= 0 and value[t + 1, j] + lattice.move[s, k] < best:
                    best = value[t + 1, j] + lattice.move[s, k]
                    following[t, s] = j
            value[t, s] = cost[t, s] + best

    within, way_s = _first_step(lattice, start)
    sequence = np.zeros(times, np.int64)
    total = nearest = math.inf
    for s in range(states):
        through = value[0, s] + lattice.w_turn / 2.0 * way_s[s]
        if within[s] and (through < total or (through == total and way_s[s] < nearest)):
            total, nearest = through, way_s[s]
            sequence[0] = s
    for t in range(times - 1):
        sequence[t + 1] = following[t, sequence[t]]
    return sequence, total


@helper
def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


@helper
def _log_error(i: Float) -> float:
    """Compute the logarithm of sqrt(tr I^-1) of [6], the upper triangle of a positive definite matrix."""
    first = i[3] * i[5] - i[4] * i[4]
    determinant = i[0] * first - i[1] * (i[1] * i[5] - i[2] * i[4]) + i[2] * (i[1] * i[4] - i[2] * i[3])
    minors = first + i[0] * i[5] - i[2] * i[2] + i[0] * i[3] - i[1] * i[1]
    return 0.5 * math.log(minors / determinant)


@helper
def _start_information(total: Float, prior: float) -> None:
    """Set the information [6] of a joint without any camera."""
    for k in range(6):
        total[k] = prior if k in (0, 3, 5) else 0.0


@helper
def _add_view(total: Float, share: float, views: TeamViews, s: int) -> None:
    for k in range(6):
        total[k] += share * views.information[s, k]


@helper
def _is_near(views: TeamViews, s: int, r: int, apart_m: float) -> bool:
    square = 0.0
    for axis in range(3):
        square += (views.offsets[s, axis] - views.offsets[r, axis]) ** 2
    return square < apart_m * apart_m


@helper
def _team_cost(
    price: Float, free: Float, views: TeamViews, w: TeamWeights, commanded: Float, team: Int64
) -> float:
    """Compute what `best_teams` minimises, of states [n, T]."""
    drones, times = team.shape
    known = np.zeros(6)
    total = 0.0
    for t in range(times):
        _start_information(known, w.prior)
        for i in range(drones):
            s = team[i, t]
            total += price[t, s]
            _add_view(known, free[t, s], views, s)
            for j in range(i):
                if _is_near(views, s, team[j, t], w.apart_m):
                    total += TOO_NEAR
            for axis in range(3):
                before = commanded[i, axis] if t == 0 else views.lattice.states[team[i, t - 1], axis]
                way = views.lattice.states[s, axis] - before
                if axis == YAW:
                    way = _wrapped(way)
                total += views.lattice.w_turn / 2.0 * abs(way) / views.lattice.rates[axis]
        total += w.w_error * _log_error(known)
    return total


@helper
def _improve_team(
    price: Float, free: Float, views: TeamViews, w: TeamWeights, commanded: Float, order: Int64, team: Int64
) -> None:
    """Replace each drone's states by the cheapest ones, given the others', until nobody finds better ones."""
    drones, times = team.shape
    cost = np.empty(price.shape)
    others, known = np.zeros(6), np.zeros(6)
    for _ in range(MAX_TEAM_ROUNDS):
        changed = False
        for i in order:
            for t in range(times):
                _start_information(others, w.prior)
                for j in range(drones):
                    if j != i and team[j, t] >= 0:
                        _add_view(others, free[t, team[j, t]], views, team[j, t])
                for s in range(price.shape[1]):
                    for k in range(6):
                        known[k] = others[k]
                    _add_view(known, free[t, s], views, s)
                    cost[t, s] = price[t, s] + w.w_error * _log_error(known)
                    for j in range(drones):
                        if j != i and team[j, t] >= 0 and _is_near(views, s, team[j, t], w.apart_m):
                            cost[t, s] += TOO_NEAR
            found = _search(cost, views.lattice, commanded[i])[0]
            for t in range(times):
                changed = changed or found[t] != team[i, t]
                team[i, t] = found[t]
        if not changed:
            return


@helper
def _cheapest_formation(
    price: Float, free: Float, views: TeamViews, w: TeamWeights, commanded: Float
) -> Int64:
    """Find the cheapest states [n, T] of equal spacing."""
    (times, states), drones = price.shape, commanded.shape[0]
    cost = np.zeros(price.shape)
    known = np.zeros(6)
    for t in range(times):
        for s in range(states):
            _start_information(known, w.prior)
            for i in range(drones):
                r = views.formations[s, i]
                cost[t, s] += price[t, r]
                _add_view(known, free[t, r], views, r)
            cost[t, s] += w.w_error * _log_error(known)
    sequence = _search(cost, views.lattice, commanded[0])[0]
    team = np.empty((drones, times), np.int64)
    for t in range(times):
        for i in range(drones):
            team[i, t] = views.formations[sequence[t], i]
    return team


def best_teams(
    price: Float, free: Float, views: TeamViews, w: TeamWeights, commanded: Float, before: Int64
) -> Int64:
    """Find states of a team that are worth flying: [K, n, T], the cheapest first.

    The cost is the sum of the slots' prices [T, S], of turning from the commanded slots [n, 3], and of the
    logarithm of the predicted error of the free shares [T, S]. It is descended, drone by drone, from the plan
    before [n, T], from the cheapest formation of equal spacing (a result, too), from the cheapest one with
    the error left out (at the tilt and range that are asked for), and from nothing: the drone with the
    dearest slots chooses first.
    """
    drones, times = before.shape
    dear = price[np.arange(times), before].cumsum(axis=1)[:, -1]
    orders = np.stack([np.arange(drones), np.argsort(-dear, kind="stable")])
    level = price + np.where(views.as_asked, 0.0, TOO_NEAR)
    teams = np.full((5, drones, times), -1)
    teams[0] = before
    costs = _improve_teams(price, level, free, views, w, commanded, orders, teams)
    return np.asarray(teams[np.argsort(costs, kind="stable")])


@cached
def _improve_teams(
    price: Float,
    level: Float,
    free: Float,
    views: TeamViews,
    w: TeamWeights,
    commanded: Float,
    orders: Int64,
    teams: Int64,
) -> Float:
    """Fill and improve teams [5, n, T] in place, the last one in the second order; return their costs [5]."""
    formation = _cheapest_formation(price, free, views, w, commanded)
    plain = _cheapest_formation(price, free, views, TeamWeights(0.0, w.prior, w.apart_m), commanded)
    for i in range(teams.shape[1]):
        for t in range(teams.shape[2]):
            teams[1, i, t] = teams[3, i, t] = formation[i, t]
            teams[2, i, t] = plain[i, t]
    costs = np.empty(teams.shape[0])
    for k in range(teams.shape[0]):
        if k != 3:
            _improve_team(level if k == 2 else price, free, views, w, commanded, orders[k // 4], teams[k])
        costs[k] = _team_cost(price, free, views, w, commanded, teams[k])
    return costs


@helper
def _turn_the_shorter_way(slots: Float) -> None:
    """Make the yaws of slots [T, n, 3] continuous, from knot to knot."""
    for i in range(slots.shape[1]):
        first, before, turned = slots[0, i, YAW], slots[0, i, YAW], 0.0
        for t in range(1, slots.shape[0]):
            yaw = slots[t, i, YAW]
            turned += _wrapped(yaw - before)
            slots[t, i, YAW] = first + turned
            before = yaw


@cached
def cheapest_slots(
    grid: Grid, sight: Sight, actor: Float, formations: Formations, w: SlotWeights, commanded: Float
) -> Float:
    """Plan a formation from the slots [n, 3] commanded now: [T + 1, n, 3] at the knots, yaw continuous."""
    shape = (actor.shape[0], formations.slots.shape[0], formations.slots.shape[1])
    obstacle, share = np.zeros(shape), np.zeros(shape)
    reached = _reached(formations.lattice, commanded[0], shape[0])
    _look_at_slots(
        grid, sight, actor, formations.offsets, w.eps_obs_m, w.sight_start_m, reached, obstacle, share
    )
    sequence, _ = _search(_weigh(obstacle, share, w.w_obs, w.w_occ), formations.lattice, commanded[0])
    through = np.empty((shape[0] + 1, shape[2], 3))
    for i in range(shape[2]):
        for axis in range(3):
            through[0, i, axis] = commanded[i, axis]
            for t in range(shape[0]):
                through[t + 1, i, axis] = formations.slots[sequence[t], i, axis]
    _turn_the_shorter_way(through)
    return through


def lattice(states: Float, *, rates: Float, knot_s: float, w_turn: float) -> Lattice:
    """Connect states [S, 3] (yaw rad, tilt rad, range m) that are within reach of each other.

    `rates` [3] are the largest changes per second, `w_turn` the cost of 2 s of change at the full rate.
    """
    way = states - states[:, None]
    way[..., YAW] = wrapped(way[..., YAW])
    time_s = np.abs(way) / rates
    reach, cost = time_s.max(axis=-1), w_turn / 2.0 * time_s.sum(axis=-1)
    within = reach <= knot_s + REACH_MARGIN_S
    order = np.argsort(np.where(within, time_s.sum(axis=-1), np.inf), axis=1, kind="stable")
    width = int(within.sum(axis=1).max())
    neighbours = order[:, :width].astype(np.int64)
    inside = np.take_along_axis(within, neighbours, axis=1)
    move = np.take_along_axis(cost, neighbours, axis=1)
    return Lattice(states, rates, knot_s, w_turn, np.where(inside, neighbours, -1), move)


@cached
def best_sequence(cost: Float, grid: Lattice, start: Float) -> tuple[Int64, float]:
    """Find the cheapest way through a finite cost map [T, S]: [T] indices of states, and the sum of costs.

    `start` [3] is commanded now, anywhere between the states. The first step reaches the states that the
    rates allow, or else the nearest. Ties go to the same state, or else the nearest one.
    """
    return _search(cost, grid, start)


def turn_the_shorter_way(slots: Float) -> None:
    """Make the yaws of slots [T, n, 3] continuous, from knot to knot, in place."""
    steps = wrapped(np.diff(slots[..., YAW], axis=0))
    slots[1:, :, YAW] = slots[0, :, YAW] + np.cumsum(steps, axis=0)


class SlotCosts(NamedTuple):
    """Costs of every slot of every state at every time, [T, S, n]."""

    obstacle: Float  # O = clip(1 - M/eps_obs, 0, 1)
    occluded: Float  # share of the sight line that is occupied


def costs_of_slots(field: DistanceField, actor: Float, offsets: Float, config: PlannerConfig) -> SlotCosts:
    """Compute the costs of every slot, offsets [S, n, 3] m from the actor's forecast [T, 3] m, world.

    The integrand of the obstacle cost that Ho et al. print ignores its variable; here it is one minus the
    signed distance over the local planner's `eps_obs_m`, so that both planners keep the same distance.
    """
    actor = np.ascontiguousarray(actor)
    eps_m, start_m = config.tuning.eps_obs_m, config.tuning.sight_start_m
    return SlotCosts(*_slot_costs(field.grid, field.sight, actor, offsets, eps_m, start_m))


def cost_map(costs: SlotCosts, config: PlannerConfig) -> Float:
    """Compute C [T, S] = w_obs sum O + w_occ sum of occupied shares over the drones."""
    cost: Float = config.w_obs * costs.obstacle.sum(axis=-1) + config.w_occ * costs.occluded.sum(axis=-1)
    return cost
