"""Conversion of records to rows of a session's tables, and back.

A table has one row per measurement. A joint that was not found has no row, and is read back as NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.session.records import POINT_COVARIANCE_COLUMNS, Detections, Int64, JointMotion, Trajectory
from pipelines.session.tables import COVARIANCE_COLUMNS

if TYPE_CHECKING:
    import pandas as pd

_POSITION = ["x", "y", "z"]
_QUATERNION = ["qx", "qy", "qz", "qw"]


def frames_table(frame: Int64, t_ns: Int64, pts_ns: Int64) -> pd.DataFrame:
    """Make rows of `tables.FRAMES` from frames, their world times and their presentation times."""
    import pandas as pd

    return pd.DataFrame({"frame": frame, "t_ns": t_ns, "pts_ns": pts_ns})


def rows_between(since_ns: Int64, start_s: float | None, end_s: float | None) -> range:
    """Find the rows of sorted times [F] at or after `start_s` and before `end_s`; None is no bound."""
    first = 0 if start_s is None else int(np.searchsorted(since_ns, round(start_s * 1e9), side="left"))
    stop = len(since_ns) if end_s is None else int(np.searchsorted(since_ns, round(end_s * 1e9), side="left"))
    return range(first, max(first, stop))


def actor_table(trajectory: Trajectory) -> pd.DataFrame:
    """Make rows of `tables.ACTOR` from the actor's trajectory; the person is 0."""
    import pandas as pd

    table = pd.DataFrame({"t_ns": trajectory.t_ns, "person": 0})
    table[_POSITION] = trajectory.position
    return table


def pose_table(trajectory: Trajectory) -> pd.DataFrame:
    """Make rows of `tables.POSES` from a trajectory, with its covariance if it has one."""
    import pandas as pd

    table = pd.DataFrame({"t_ns": trajectory.t_ns})
    table[_POSITION] = trajectory.position
    table[_QUATERNION] = trajectory.quaternion_xyzw
    if trajectory.covariance is not None:
        table[list(COVARIANCE_COLUMNS)] = trajectory.covariance[:, *np.triu_indices(6)]
    return table


def trajectory_from(table: pd.DataFrame) -> Trajectory:
    """Rebuild the trajectory that `pose_table` stored."""
    covariance = None
    if set(COVARIANCE_COLUMNS) <= set(table.columns):
        covariance = np.zeros((len(table), 6, 6))
        rows, columns = np.triu_indices(6)
        covariance[:, rows, columns] = table[list(COVARIANCE_COLUMNS)].to_numpy()
        covariance[:, columns, rows] = covariance[:, rows, columns]
    return Trajectory(
        t_ns=table["t_ns"].to_numpy(np.int64),
        position=table[_POSITION].to_numpy(np.float64),
        quaternion_xyzw=table[_QUATERNION].to_numpy(np.float64),
        covariance=covariance,
    )


def keypoints_table(detections: Detections, known_frame: Int64, t_ns: Int64) -> pd.DataFrame:
    """Make rows of `tables.KEYPOINTS` from the joints that were found.

    Args:
        detections: in known frames only.
        known_frame: [F] sorted.
        t_ns: [F] their times.
    """
    import pandas as pd

    row, joint = np.nonzero(~np.isnan(detections.xy[..., 0]))
    frame = detections.frame[row]
    return pd.DataFrame(
        {
            "frame": frame,
            "t_ns": t_ns[np.searchsorted(known_frame, frame)],
            "person": detections.person[row],
            "joint": np.array(detections.joints, dtype=object)[joint],
            "x": detections.xy[row, joint, 0],
            "y": detections.xy[row, joint, 1],
            "confidence": detections.confidence[row, joint],
        }
    )


def detections_from(table: pd.DataFrame, joints: tuple[str, ...]) -> Detections:
    """Rebuild the detections that `keypoints_table` stored, with only these joints, in this order."""
    joint = _index_of(table["joint"], joints)
    table, joint = table[joint >= 0], joint[joint >= 0]
    keys = table[["frame", "person"]].to_numpy(np.int64)
    people, row = np.unique(keys, axis=0, return_inverse=True)
    xy = np.full((len(people), len(joints), 2), np.nan)
    confidence = np.zeros((len(people), len(joints)))
    xy[row, joint] = table[["x", "y"]].to_numpy(np.float64)
    confidence[row, joint] = table["confidence"].to_numpy(np.float64)
    return Detections(
        joints=joints,
        frame=people[:, 0],
        person=people[:, 1],
        xy=xy,
        confidence=confidence,
        frames_listed=np.unique(people[:, 0]),
    )


def most_confident(detections: Detections, most: int) -> tuple[Detections, int]:
    """Keep the `most` most confident people of each frame; return also the number left out."""
    frame = detections.frame
    order = np.lexsort((detections.person, -detections.confidence.sum(axis=1), frame))
    rank = np.arange(len(frame)) - np.searchsorted(frame[order], frame[order], side="left")
    kept = np.sort(order[rank < most])
    if len(kept) == len(frame):
        return detections, 0
    chosen = replace(
        detections,
        frame=frame[kept],
        person=detections.person[kept],
        xy=detections.xy[kept],
        confidence=detections.confidence[kept],
    )
    return chosen, len(frame) - len(kept)


def motion_table(motion: JointMotion) -> pd.DataFrame:
    """Make rows of `tables.TRUTH` from the joints that are not NaN."""
    import pandas as pd

    t, person, joint = np.nonzero(~np.isnan(motion.position[..., 0]))
    table = pd.DataFrame(
        {
            "t_ns": motion.t_ns[t],
            "person": person,
            "joint": np.array(motion.joints, dtype=object)[joint],
        }
    )
    table[_POSITION] = motion.position[t, person, joint]
    return table


def motion_from(table: pd.DataFrame, joints: tuple[str, ...]) -> JointMotion:
    """Rebuild the motion of these joints from a table of `tables.TRUTH` or `tables.SKELETON`."""
    joint = _index_of(table["joint"], joints)
    # Times without any of these joints are kept.
    t_ns, row = np.unique(table["t_ns"].to_numpy(np.int64), return_inverse=True)
    table, row, joint = table[joint >= 0], row[joint >= 0], joint[joint >= 0]
    person = table["person"].to_numpy(np.int64)
    shape = (len(t_ns), int(person.max(initial=0)) + 1, len(joints))
    position = np.full((*shape, 3), np.nan)
    position[row, person, joint] = table[_POSITION].to_numpy(np.float64)
    status = reprojection = views = covariance = None
    if "status" in table:
        status = np.full(shape, "not_detected", dtype="U16")
        status[row, person, joint] = table["status"].to_numpy(str)
        reprojection = np.full(shape, np.nan)
        reprojection[row, person, joint] = table["reprojection_px"].to_numpy(np.float64)
        views = np.zeros(shape, np.int64)
        views[row, person, joint] = table["views"].to_numpy(np.int64)
        covariance = np.full((*shape, 6), np.nan)
        covariance[row, person, joint] = table[list(POINT_COVARIANCE_COLUMNS)].to_numpy(np.float64)
    return JointMotion(t_ns, joints, position, status, reprojection, views, covariance)


def _index_of(names: pd.Series[str], wanted: Sequence[str]) -> NDArray[np.intp]:
    """Find the index of every name among the wanted ones, -1 for names that are not wanted."""
    import pandas as pd

    return pd.Index(wanted).get_indexer(pd.Index(names))
