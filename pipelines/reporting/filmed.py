"""The cameras of a reconstructed session, for drawing on their pictures: frames, poses and keypoints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.reporting.overlays import FilmedCamera
from pipelines.reporting.placing import estimated_clocks
from pipelines.session.description import Description
from pipelines.session.records import Trajectory
from pipelines.session.stage_records import StageRecord
from pipelines.session.storage import read_json
from pipelines.session.tables import CAMERA_POSES, KEYPOINTS, POSES, read_table, trajectory_from

if TYPE_CHECKING:
    import pandas as pd


def refined_poses(folder: Path, record: StageRecord) -> dict[str, Trajectory]:
    """Read the poses of the cameras that a session's reconstruction, of this record, refined."""
    name = "reconstruct/cameras.parquet"
    if name not in record.outputs:
        return {}
    table = read_table(folder / name, CAMERA_POSES)
    return {str(name): trajectory_from(own.sort_values("t_ns")) for name, own in table.groupby("camera")}


def read_filmed(
    folder: Path, description: Description, record: StageRecord, frames: Mapping[str, pd.DataFrame]
) -> dict[str, FilmedCamera]:
    """Read cameras with logged or refined poses, and frames by the estimated clocks.

    Args:
        folder: the session.
        description: its session.json.
        record: of its reconstruction: keypoints below its least confidence are left out.
        frames: the frame tables of the cameras that are wanted.
    """
    offset_ns = estimated_clocks(read_json(folder / "reconstruct" / "metrics.json"))
    refined = refined_poses(folder, record)
    filmed = {}
    for name, table in frames.items():
        entry = description.cameras[name]
        stage = "cameras" if entry.keypoints is not None else "detect"
        keypoints = read_table(folder / stage / name / "keypoints.parquet", KEYPOINTS)
        logged = trajectory_from(read_table(folder / "cameras" / name / "poses.parquet", POSES))
        filmed[name] = FilmedCamera(
            name=name,
            intrinsics=entry.intrinsics.intrinsics(),
            frame=table["frame"].to_numpy(np.int64),
            frame_t_ns=table["t_ns"].to_numpy(np.int64) + offset_ns.get(name, 0),
            keypoints=keypoints[keypoints["confidence"] >= record.settings["min_confidence"]],
            track=refined.get(name, logged),
            static=entry.poses.static,
            between=description.pose_interpolation,
        )
    return filmed
