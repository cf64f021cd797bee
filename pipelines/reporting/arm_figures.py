"""The figures of a comparison of planners.

The colour is the arm's in every figure and in the 3D viewer; the stroke is the drone's.
"""

from __future__ import annotations

from pipelines.reporting.arms_as_seen import draw_as_seen
from pipelines.reporting.arms_from_above import draw_from_above
from pipelines.reporting.arms_over_time import draw_arms_over_time
from pipelines.reporting.arms_yaw import draw_yaw
from pipelines.reporting.plates import Plate
from pipelines.reporting.replanned import Replan


def draw_arms(replan: Replan) -> dict[str, Plate]:
    """Draw every figure of a comparison, by its key; none where nothing flew."""
    if not replan.arms:
        return {}
    plates = [
        draw_from_above(replan),
        draw_arms_over_time(replan.arms),
        draw_yaw(replan.arms, replan.costs),
        draw_as_seen(replan),
    ]
    return {plate.key: plate for plate in plates if plate is not None}
