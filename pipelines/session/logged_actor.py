"""The actor's logged positions in a session."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import interpolate_points
from pipelines.session.description import Description
from pipelines.session.records import Int64
from pipelines.session.tables import ACTOR, read_table

_GAP_NS = 2_000_000_000  # no interpolation between two stamps that are further apart


@dataclass(frozen=True)
class LoggedActor:
    """The actor's hips over time; from a logged head or feet, those of a standing person of 1.75 m."""

    t_ns: Int64  # [A] ascending
    hips: Float  # [A, 3] m, world

    def hips_at(self, t_ns: Int64) -> Float:
        """Interpolate the hips [T, 3] at given times; NaN where no logged position is near enough."""
        return interpolate_points(self.t_ns, self.hips, t_ns, max_gap_ns=_GAP_NS)


def logged_actor(folder: Path, description: Description) -> LoggedActor | None:
    """Load the actor of a session; None where none was logged.

    Raises:
        DataError: the table is damaged.
    """
    if description.actor is None:
        return None
    table = read_table(folder / "actor.parquet", ACTOR)
    above_m = np.array([0.0, 0.0, description.actor.hip_above_m])
    return LoggedActor(
        table["t_ns"].to_numpy(np.int64), table[["x", "y", "z"]].to_numpy(np.float64) + above_m
    )
