"""Stored results of a reconstruction, as rows of the session's tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.geometry.triangulation import STATUS, Triangulation
from pipelines.reconstruction.observations import Camera, Observations
from pipelines.session.description import Interpolation
from pipelines.session.records import POINT_COVARIANCE_COLUMNS

if TYPE_CHECKING:
    import pandas as pd


def skeleton_table(observations: Observations, result: Triangulation) -> pd.DataFrame:
    """Build the rows of `tables.SKELETON`: every joint of every person at every time."""
    import pandas as pd

    times, people, joints, _ = observations.confidence.shape
    used = np.where(result.inlier, result.residual_px, np.nan)
    table = pd.DataFrame(
        {
            "t_ns": np.repeat(observations.t_ns, people * joints),
            "person": np.tile(np.repeat(np.arange(people), joints), times),
            "joint": np.tile(np.array(observations.joints, dtype=object), times * people),
        }
    )
    table[["x", "y", "z"]] = result.points
    table[list(POINT_COVARIANCE_COLUMNS)] = result.covariance[:, *np.triu_indices(3)]
    table["views"] = result.views
    table["reprojection_px"] = _row_mean(used)
    table["status"] = np.array(STATUS, dtype=object)[result.status]
    return table


def camera_poses_table(cameras: Sequence[Camera], between: Interpolation) -> pd.DataFrame:
    """Build the rows of `tables.CAMERA_POSES`: the poses of cameras at their pictures.

    Pictures without a pose, for example in a pause of the log, have no row.
    """
    import pandas as pd

    parts = []
    for camera in cameras:
        position, rotation = camera.poses_at(camera.frame_t_ns, between)
        (posed,) = np.nonzero(np.isfinite(position[:, 0]))
        table = pd.DataFrame({"t_ns": camera.frame_t_ns[posed], "camera": camera.name})
        table[["x", "y", "z"]] = position[posed]
        table[["qx", "qy", "qz", "qw"]] = quaternion_from_matrix(rotation[posed])
        parts.append(table)
    return pd.concat(parts, ignore_index=True)


def _row_mean(values: Float) -> Float:
    """Compute the mean of each row without its NaN; NaN for a row of only NaN."""
    count = (~np.isnan(values)).sum(axis=1)
    mean: Float = np.where(count > 0, np.nansum(values, axis=1) / np.maximum(count, 1), np.nan)
    return mean
