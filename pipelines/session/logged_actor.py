"""Where the logs of a session say that the actor was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.geometry.poses import interpolate_points
from pipelines.session.description import Description
from pipelines.session.records import Float, Int64
from pipelines.session.tables import ACTOR, read_table

_GAP_NS = 2_000_000_000  # between two stamps further apart nobody knows


@dataclass(frozen=True)
class LoggedActor:
    """The actor's way. Of one whose head or feet were logged, the hips of somebody 1.75 m tall who stands."""

    t_ns: Int64  # [A] ascending
    hips: Float  # [A, 3] m, world

    def hips_at(self, t_ns: Int64) -> Float:
        """The hips [T, 3] at given times, NaN where the log says nothing."""
        return interpolate_points(self.t_ns, self.hips, t_ns, max_gap_ns=_GAP_NS)


def logged_actor(folder: Path, description: Description) -> LoggedActor | None:
    """The actor of a session; None where none was logged.

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
