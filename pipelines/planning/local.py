"""Trajectory of each drone: covariant gradient descent about the slots (Bonatti et al. 2020; CHOMP).

J = J_smooth + l_obs J_obs + l_occ J_occ + l_form J_form + l_sep J_sep over N waypoints, start fixed by
position and velocity, end free (t_f = N step_s):

    J_smooth  1/(2 t_f) sum_d a_d int |x^(d)|^2, d = 1..3, finite differences
    J_form    1/(2 t_f) int |x - slot|^2
    J_obs     int c(x; eps_obs) s dt, s = sqrt(|v|^2 + v0^2)
    J_occ     int int c(p; eps_occ) |dp| s dt along the sight line, up to `sight_start_m` from the actor
    J_sep     1/t_f int sum max(0, soft - distance)^2 / 2 over the other drones' latest plans

c is CHOMP's hinge of the signed distance. With s = |v| (v0 = 0, as published) obstacles have no effect on a
drone at rest. Gradients are exact derivatives of the discretised sums, so that a small step along them lowers
the cost that is compared. In the limit they are the functional gradients of the papers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField
from pipelines.planning.local_kernels import Weights, descend, evaluate, factorise
from pipelines.planning.tracking import Plan

TERMS = ("smooth", "form", "obs", "occ", "sep")
_ASTRAY_M = 3.0  # a plan that ends farther off the slot may be in a local minimum
_ROUNDS = 10  # of projection, each a little farther than the one before
_MARGIN_M = 0.1  # projected waypoints keep this much more than the least distance


class Separation(StrEnum):
    """Action taken to keep the distance to the other drones' plans."""

    KEPT = "kept"
    PROJECTED = "projected"  # waypoints were pushed apart
    REJECTED = "rejected"  # projection failed: the previous plan goes on
    BROKEN = "broken"  # the previous plan fails as well; the plan with the largest distance is flown


@dataclass(frozen=True)
class LocalPlan:
    """Result of the local planner."""

    plan: Plan
    cost: float  # of the optimised path, before any projection
    evaluations: int
    separation: Separation


class LocalPlanner:
    """The optimiser of one configuration; it factorises its metric once and keeps no other state."""

    def __init__(self, config: PlannerConfig) -> None:
        self._config = config
        self._factor = factorise(config.waypoints, config.local_weights(1.0))
        self._weights: dict[float, Weights] = {}

    def plan(
        self,
        t_s: float,
        position: Float,
        velocity: Float,
        *,
        slots: Float,
        actor: Float,
        others: Sequence[Plan],
        field: DistanceField,
        previous: Plan | None,
    ) -> LocalPlan:
        """Plan from the drone's place and velocity.

        Args:
            t_s: now.
            position: [3] metres, world.
            velocity: [3] m/s.
            slots: [N, 3] wanted places of the drone at each waypoint's time.
            actor: [N, 3] forecast of the actor then.
            others: the latest plans of the other drones.
            field: the distance field of the obstacles.
            previous: this drone's previous plan, the initial guess; without one it is the slots.
        """
        config = self._config
        times = t_s + config.waypoint_s * np.arange(1, config.waypoints + 1, dtype=np.float64)
        waypoints = np.stack([p.at(np.append(t_s, times))[0] for p in others]) if others else _nobody(times)
        guess = slots if previous is None else previous.at(times)[0]
        path, cost, evaluations = self._descended(position, velocity, guess, slots, actor, waypoints, field)
        if previous is not None and np.linalg.norm(path[-1] - slots[-1]) > _ASTRAY_M:
            # Caught behind something: descend once more from the slots, and take the better result.
            other = self._descended(position, velocity, slots, slots, actor, waypoints, field)
            evaluations += other[2]
            if other[1] < cost:
                path, cost = other[:2]
        old = None if previous is None else np.concatenate([position[None], guess])
        kept, separation = _keep_apart(path[2:], waypoints, old, field, config.separation_m)
        return LocalPlan(Plan(t_s, kept, velocity.copy(), config.waypoint_s), cost, evaluations, separation)

    def _descended(
        self,
        position: Float,
        velocity: Float,
        guess: Float,
        slots: Float,
        actor: Float,
        others: Float,
        field: DistanceField,
    ) -> tuple[Float, float, int]:
        """Descend from a guess [N, 3]: path [N + 3, 3], cost, evaluations. `others` is [M, N + 1, 3]."""
        config = self._config
        return descend(
            _with_start(position, velocity, guess, config.waypoint_s),
            np.ascontiguousarray(slots),
            np.ascontiguousarray(actor),
            np.ascontiguousarray(others[:, 1:]),
            field.grid,
            self._weights_for(field),
            self._factor,
            config.iterations,
            config.tolerance,
            config.step_cap_m,
        )

    def cost(
        self,
        position: Float,
        velocity: Float,
        waypoints: Float,
        *,
        slots: Float,
        actor: Float,
        others: Float,
        field: DistanceField,
    ) -> tuple[float, dict[str, float], Float]:
        """Compute the cost of waypoints [N, 3]: in total, its unweighted terms, and the gradient [N, 3].

        `others` [M, N, 3] are the other drones' waypoints; the rest is as in `plan`.
        """
        terms, gradient = np.zeros(len(TERMS)), np.zeros_like(waypoints)
        path = _with_start(position, velocity, waypoints, self._config.waypoint_s)
        total = evaluate(path, slots, actor, others, field.grid, self._weights_for(field), terms, gradient)
        return total, dict(zip(TERMS, terms.tolist(), strict=True)), gradient

    def _weights_for(self, field: DistanceField) -> Weights:
        side = field.grid.resolution_m
        if side not in self._weights:
            self._weights[side] = self._config.local_weights(side)
        return self._weights[side]


def closest_approach(path: Float, others: Float) -> float:
    """Compute the least distance in metres between points that fly straight between waypoints.

    Args:
        path: [N + 1, 3].
        others: [M, N + 1, 3] at the same times.

    Returns:
        inf without other drones.
    """
    apart = path - others
    start, way = apart[:, :-1], np.diff(apart, axis=1)
    square = np.sum(way**2, axis=-1)
    u = np.clip(-np.sum(start * way, axis=-1) / np.maximum(square, 1e-12), 0.0, 1.0)
    distance = np.linalg.norm(start + u[..., None] * way, axis=-1)
    return float(distance.min(initial=np.inf))


def _with_start(position: Float, velocity: Float, waypoints: Float, step_s: float) -> Float:
    """Return [N + 3, 3]: past and present positions at the drone's velocity, and the waypoints."""
    back = np.array([-2.0, -1.0, 0.0])[:, None] * step_s
    return np.concatenate([position + back * velocity, waypoints])


def _nobody(times: Float) -> Float:
    return np.empty((0, len(times) + 1, 3))


def _keep_apart(
    path: Float, others: Float, old: Float | None, field: DistanceField, least_m: float
) -> tuple[Float, Separation]:
    """Return the path [N + 1, 3], pushed away from the others' [M, N + 1, 3] if need be, or the old one."""
    if closest_approach(path, others) >= least_m:
        return path, Separation.KEPT
    pushed = _pushed_apart(path, others, least_m + _MARGIN_M)
    free = field.sample(pushed[1:])[0].min() > min(0.0, field.sample(path[1:])[0].min())
    if free and closest_approach(pushed, others) >= least_m:
        return pushed, Separation.PROJECTED
    if old is not None and closest_approach(old, others) >= least_m:
        return old, Separation.REJECTED
    choices = [path] + ([pushed] if free else []) + ([] if old is None else [old])
    return max(choices, key=lambda choice: closest_approach(choice, others)), Separation.BROKEN


def _pushed_apart(path: Float, others: Float, least_m: float) -> Float:
    """Move waypoints aside until no way between them comes nearer to the others. The start stays.

    All waypoints near another drone move in the same direction, along the line that joins the two drones at
    their nearest. If each moved straight away from the other drone, those before and behind a crossing would
    move to opposite sides, and the drone would fly through the middle.
    """
    pushed = path.copy()
    for round_ in range(_ROUNDS):
        if closest_approach(pushed, others) >= least_m:
            break
        wanted_m = least_m * (1.0 + 0.05 * round_)
        for other in others:
            apart = pushed - other
            aside = _way_aside(apart)
            along = np.sum(apart * aside, axis=1)
            short = wanted_m**2 - np.sum(apart**2, axis=1)
            way = np.where(short > 0.0, np.sqrt(np.maximum(along**2 + short, 0.0)) - along, 0.0)
            # The neighbours go along: the ways between them must keep the distance too.
            way = np.maximum(way, np.maximum(np.append(way[1:], 0.0), np.append(0.0, way[:-1])))
            pushed[1:] += way[1:, None] * aside
    return pushed


def _way_aside(apart: Float) -> Float:
    """Return the unit vector [3] from the other drone to this one where [N + 1, 3] is nearest to zero."""
    start, way = apart[:-1], np.diff(apart, axis=0)
    u = np.clip(-np.sum(start * way, axis=1) / np.maximum(np.sum(way**2, axis=1), 1e-12), 0.0, 1.0)
    nearest = start + u[:, None] * way
    k = int(np.argmin(np.sum(nearest**2, axis=1)))
    aside = nearest[k]
    if np.sum(aside**2) < 1e-6:  # straight through each other: push to the left of the way, or east
        aside = np.array([-way[k, 1], way[k, 0], 0.0])
    length = float(np.sqrt(np.sum(aside**2)))
    return aside / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
