"""The skeleton's long table as dense arrays, and its distance from truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS
from pipelines.session.people import true_joints_at
from pipelines.session.records import POINT_COVARIANCE_COLUMNS, Int64
from pipelines.session.tables import motion_from

if TYPE_CHECKING:
    import pandas as pd

_NEVER_TOGETHER_M = 1e9  # distance of people without a common time: they are matched last


@dataclass(frozen=True)
class Motion:
    """Joints over time: T stamps, P people, J joints, in the order in which the table first names them."""

    t_ns: Int64  # [T], strictly increasing
    joints: tuple[str, ...]
    position: Float  # [T, P, J, 3] m
    covariance: Float  # [T, P, J, 6] m^2, upper triangle: POINT_COVARIANCE_COLUMNS
    reprojection_px: Float  # [T, P, J]
    status: NDArray[np.int8]  # [T, P, J] index into triangulation.STATUS, -1 where the table has no row
    views: Int64  # [T, P, J] number of cameras that the joint was taken from

    @property
    def measured(self) -> NDArray[np.bool_]:
        """True [T, P, J] where a joint was reconstructed from pictures; a filled joint was not."""
        measured: NDArray[np.bool_] = self.status == STATUS.index("ok")
        return measured

    @property
    def measured_position(self) -> Float:
        """Positions [T, P, J, 3] of measured joints, NaN elsewhere."""
        return np.where(self.measured[..., None], self.position, np.nan)

    @property
    def sigma_m(self) -> Float:
        """Standard deviation per axis of measured joints, sqrt(trace / 3), [T, P, J]; NaN if unknown."""
        trace = self.covariance[..., [0, 3, 5]].sum(axis=-1)
        return np.where(self.measured, np.sqrt(trace / 3), np.nan)


def motion_from_skeleton(table: pd.DataFrame) -> Motion:
    """Make dense arrays of a skeleton table (tables.SKELETON), in any order of its rows."""
    import pandas as pd

    t_ns, time = np.unique(table["t_ns"].to_numpy(dtype=np.int64), return_inverse=True)
    persons, person = np.unique(table["person"].to_numpy(dtype=np.int64), return_inverse=True)
    joint, joints = pd.factorize(table["joint"])
    shape = (len(t_ns), len(persons), len(joints))
    cell = (time, person, joint)

    def dense(*columns: str) -> Float:
        values = np.full((*shape, len(columns)), np.nan)
        values[cell] = table[list(columns)].to_numpy(dtype=np.float64)
        return values

    status = np.full(shape, -1, dtype=np.int8)
    status[cell] = pd.Index(STATUS).get_indexer(pd.Index(table["status"]))
    return Motion(
        t_ns=t_ns,
        joints=tuple(str(name) for name in joints),
        position=dense("x", "y", "z"),
        covariance=dense(*POINT_COVARIANCE_COLUMNS),
        reprojection_px=dense("reprojection_px")[..., 0],
        status=status,
        views=np.nan_to_num(dense("views")[..., 0]).astype(np.int64),
    )


def truth_at(truth: pd.DataFrame, motion: Motion) -> Float:
    """Return the true positions at the motion's times and joints, [T, P, J, 3].

    Each person is compared with the nearest true one, by `true_joints_at`; NaN also for joints and people
    that are not in the truth.
    """
    known = motion_from(truth, motion.joints)
    return _own_truth(motion.measured_position, true_joints_at(known, motion.t_ns))


def _own_truth(position: Float, truth: Float) -> Float:
    """Match each measured person of [T, P, J, 3] to the nearest true one on average, each taken once."""
    from scipy.optimize import linear_sum_assignment

    distance = np.linalg.norm(position[:, :, None] - truth[:, None], axis=-1)
    shared = np.isfinite(distance)
    count = shared.sum(axis=(0, 3))
    total = np.where(shared, distance, 0.0).sum(axis=(0, 3))
    person, match = linear_sum_assignment(
        np.where(count > 0, total / np.maximum(count, 1), _NEVER_TOGETHER_M)
    )
    own: Float = np.full(position.shape, np.nan)
    own[:, person] = truth[:, match]
    return own


def errors_mm(motion: Motion, truth: Float) -> Float:
    """Compute the distance of every measured joint from truth in mm, [T, P, J]; NaN if either is missing."""
    distance: Float = 1000 * np.linalg.norm(motion.measured_position - truth, axis=-1)
    return distance


def share_inside_95(motion: Motion, truth: Float) -> float | None:
    """Compute the share of true joints inside the 95 % ellipsoids; None if nothing can be compared.

    e' S^-1 e of a Gaussian in three dimensions is chi-square with 3 degrees of freedom, whose 95 %
    quantile is 7.815: a calibrated covariance gives a share of 0.95.
    """
    error = motion.measured_position - truth
    usable = np.isfinite(error).all(axis=-1) & np.isfinite(motion.covariance).all(axis=-1)
    covariance = motion.covariance[usable][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    positive = np.linalg.eigvalsh(covariance)[:, 0] > 0
    if not positive.any():
        return None
    e = error[usable][positive]
    weighted = np.linalg.solve(covariance[positive], e[:, :, np.newaxis])[:, :, 0]
    squared = (e * weighted).sum(axis=1)
    return float(np.mean(squared < 7.815))
