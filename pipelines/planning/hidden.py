"""Shares of a flight during which the map hid the actor from each camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import OCCUPIED, DistanceField
from pipelines.planning.field_kernels import Grid
from pipelines.planning.loading import LoggedFlight, flown_poses
from pipelines.planning.sight import visible
from pipelines.session.description import Description
from pipelines.session.records import Occupancy

_RATE_HZ = 10.0


def hidden_shares(
    flight: LoggedFlight,
    description: Description,
    maps: Sequence[Occupancy],
    *,
    start_m: float = PlannerConfig().sight_start_m,
) -> dict[str, float]:
    """Compute the share of moments in which an occupied voxel stood between a camera and the actor.

    Ten moments a second, while the camera's pose is known; true poses and hips where they are known. Each
    map counts from its own time on; unknown voxels are free.

    Args:
        flight: the poses of the cameras and the actor's positions.
        description: the session's.
        maps: in any order, one at least.
        start_m: the end of the sight line next to the actor is left out, this much of it: maps contain the
            actor.

    Returns:
        By camera; those without a pose at any of the moments are left out.
    """
    first_ns, last_ns = int(flight.actor_t_ns[0]), int(flight.actor_t_ns[-1])
    count = max(2, round((last_ns - first_ns) / 1e9 * _RATE_HZ) + 1)
    t_ns = np.linspace(first_ns, last_ns, count).round().astype(np.int64)
    actor, _ = flight.scored_actor(t_ns)
    position, _, known = flown_poses(flight, description, t_ns)
    hidden = np.zeros(known.shape, dtype=np.bool_)
    for occupancy in sorted(maps, key=lambda one: one.from_ns):
        (later,) = np.nonzero(t_ns >= occupancy.from_ns)  # a later map replaces an earlier one
        field = _standing(occupancy)
        hidden[:, later] = ~visible(field, position[:, later], actor[later], start_m=start_m)
    return {
        camera.name: float(hidden[c, known[c]].mean())
        for c, camera in enumerate(flight.cameras)
        if known[c].any()
    }


def _standing(occupancy: Occupancy) -> DistanceField:
    """Return a field that has only the occupied voxels, no distances: sight lines need no more."""
    with np.errstate(invalid="ignore"):
        occupied: NDArray[np.bool_] = occupancy.probability >= OCCUPIED
    sign = np.where(occupied, np.float32(-1), np.float32(1))
    return DistanceField(Grid(sign, np.array(occupancy.origin, dtype=np.float64), occupancy.resolution_m))
