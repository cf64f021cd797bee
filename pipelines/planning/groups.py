"""Filming several people: who is seen by whom, and a team's plan that is improved one drone after the other.

The plan maximises a submodular worth of all views together, so that planning in turn is a good solution
(Hughes et al., "Multi-Robot Planning for Filming Groups of Moving Actors Leveraging Submodularity and Pixel
Density", CDC 2024): a view of what nobody sees yet adds more than another one of the same.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, MapsInTurn
from pipelines.planning.formation import wrapped
from pipelines.planning.information import log_determinant
from pipelines.planning.scores import seen_actor, view_quality
from pipelines.planning.search import TOO_NEAR, Lattice, best_sequence

_MOST_ROUNDS = 10
_BODY_RADIUS_M = 0.25
_BELOW_HIPS_M, _ABOVE_HIPS_M = 0.95, 0.8  # a standing person of 1.75 m


def hidden_by_people(camera: Float, target: Float, people: Float) -> Bool:
    """Test if somebody's body, an upright cylinder, stands in a sight line.

    Args:
        camera: [..., 3] metres, world.
        target: [..., 3] metres, world.
        people: [Q, ..., 3] metres, world; hips of those who may stand in the way, not of the target.

    Returns:
        [...], all shapes broadcast.
    """
    way, aside = target - camera, people - camera
    level = np.maximum((way[..., :2] ** 2).sum(axis=-1), 1e-12)
    along = (aside[..., :2] * way[..., :2]).sum(
        axis=-1
    ) / level  # of the nearest point, as a share of the way
    away = np.linalg.norm(aside[..., :2] - along[..., None] * way[..., :2], axis=-1)
    height = along * way[..., 2] - aside[..., 2]
    between = (along > 0.0) & (along < 1.0) & (height > -_BELOW_HIPS_M) & (height < _ABOVE_HIPS_M)
    found: Bool = (between & (away < _BODY_RADIUS_M)).any(axis=0)
    return found


def sights(
    camera: Float,
    looks_rad: Float,
    people: Float,
    maps: DistanceField | MapsInTurn,
    config: PlannerConfig,
) -> Bool:
    """Test [P, N, T] which cameras see which people.

    The person is in the level field of view, and neither the map nor anybody else stands between. A single
    person is in the picture of every camera that films them, so that only the map counts.

    Args:
        camera: [N, T, 3] metres, world.
        looks_rad: [N, T] yaw of the optical axis from east.
        people: [P, T, 3] metres, world, the middle of the hips.
        maps: the distance field, or the map of each of the T moments.
        config: `sight_start_m` and the field of view.
    """
    seen = []
    for p, person in enumerate(people):
        free = seen_actor(camera, person, maps, config)
        if len(people) > 1:
            free = free & in_view(camera, looks_rad, person, config.errors.fov_rad)
            free &= ~hidden_by_people(camera, person, np.delete(people, p, axis=0)[:, None])
        seen.append(free)
    return np.stack(seen)


def in_view(camera: Float, looks_rad: Float, person: Float, fov_rad: float) -> Bool:
    """Test [...] if people [..., 3] are in the level field of view of cameras [..., 3] with yaws [...]."""
    offset = person - camera
    aside = wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - looks_rad)
    inside: Bool = np.abs(aside) <= fov_rad / 2.0
    return inside


class Choice(NamedTuple):
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


def plan_in_turn(choices: Sequence[Sequence[Choice]], worth: Worth) -> list[Path]:
    """Plan a team: one drone after the other, given the paths of the others, until nobody finds a better one.

    Each path is the cheapest of all choices of its drone (dynamic programming): its price and turning, less
    what its views add to the worth of those of the others.

    Args:
        choices: of each drone.
        worth: of the views of all.
    """
    taken: dict[int, Path] = {}
    for _ in range(_MOST_ROUNDS):
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


def _best_path(choices: Sequence[Choice], others: Sequence[tuple[Choice, Int64]], worth: Worth) -> Path:
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
