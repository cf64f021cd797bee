"""The cost map C[t, s] of the formation search: obstacles at the slots and in the sight lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField
from pipelines.planning.forecast import Forecast
from pipelines.planning.formation import slot_offsets, turned
from pipelines.planning.information import predicted_error, ray_information
from pipelines.planning.search_kernels import slot_costs, weighed


class SlotCosts(NamedTuple):
    """Costs of every slot of every state at every time, [T, S, n]."""

    obstacle: Float  # O = clip(1 - M/eps_obs, 0, 1)
    occluded: Float  # share of the sight line that is occupied


def costs_of_slots(field: DistanceField, actor: Float, offsets: Float, config: PlannerConfig) -> SlotCosts:
    """Compute the costs of every slot.

    The integrand of the obstacle cost that Ho et al. print ignores its variable; here it is one minus the
    signed distance over the local planner's `eps_obs_m`, so that both planners keep the same distance.

    Args:
        field: the distance field of the obstacles.
        actor: [T, 3] forecast, metres, world.
        offsets: [S, n, 3] metres, the slots of each state from the actor.
        config: `eps_obs_m`, `sight_start_m`.
    """
    actor = np.ascontiguousarray(actor)
    eps_m, start_m = config.eps_obs_m, config.sight_start_m
    return SlotCosts(*slot_costs(field.grid, field.sight, actor, offsets, eps_m, start_m))


def costs_in_frame(field: DistanceField, actor: Forecast, slots: Float, config: PlannerConfig) -> SlotCosts:
    """Compute the costs of slots [S, n, 3] whose yaws count from the actor's heading at each time."""
    looks = [
        costs_of_slots(
            field, position[None], slot_offsets(turned(slots, np.full(slots.shape[:-2], heading))), config
        )
        for position, heading in zip(*actor, strict=True)
    ]
    return SlotCosts(*(np.concatenate(parts) for parts in zip(*looks, strict=True)))


def cost_map(costs: SlotCosts, config: PlannerConfig) -> Float:
    """Compute C [T, S] = w_obs sum O + w_occ sum of occupied shares over the drones."""
    return weighed(costs.obstacle, costs.occluded, config.w_obs, config.w_occ)


def error_map(costs: SlotCosts, offsets: Float, config: PlannerConfig) -> Float:
    """Predict the error [T, S] in metres of the views that are free.

    A weak prior limits the error where too few views are free.
    """
    information = ray_information(offsets, config)
    free = (costs.occluded == 0.0).astype(np.float64)
    total = np.einsum("tsn,snij->tsij", free, information) + np.eye(3) / config.prior_sigma_m**2
    return predicted_error(total)
