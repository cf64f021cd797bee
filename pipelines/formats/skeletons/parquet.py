"""Export to parquet: the skeleton's table and the cameras' poses, for pandas, polars and DuckDB."""

from pathlib import Path

import numpy as np

from pipelines.formats.common.exporting import write_tables
from pipelines.formats.skeletons.joint_files import joint_columns
from pipelines.session.records import POINT_COVARIANCE_COLUMNS, JointMotion, Recording, Trajectory
from pipelines.session.tables import POSES, POSES_WITH_COVARIANCE, SKELETON, pose_table, write_table


class ParquetExport:
    """Writer of `<name>.parquet` (the session's skeleton table) and `<name>_<camera>.parquet` (its poses).

    Metres, z up; one row for each time, person and joint, with NaN and a status if it is missing. The same
    recording gives the same bytes.
    """

    name = "parquet"
    title = "the same tables, typed and small, for pandas"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write all tables of the recording."""
        return write_tables(recording, folder, ".parquet", write_joints, write_poses)


def write_poses(path: Path, trajectory: Trajectory) -> None:
    """Write `tables.POSES`, with covariances if the trajectory has them."""
    schema = POSES if trajectory.covariance is None else POSES_WITH_COVARIANCE
    write_table(path, pose_table(trajectory), schema)


def write_joints(path: Path, motion: JointMotion) -> None:
    """Write `tables.SKELETON`; unknown values become NaN, 0 views or an empty status."""
    import pandas as pd

    shape = motion.position.shape[:3]
    unknown = np.full(shape, np.nan)
    covariance = np.full((*shape, 6), np.nan) if motion.covariance is None else motion.covariance
    reprojection = unknown if motion.reprojection_px is None else motion.reprojection_px
    views = np.zeros(shape, np.int64) if motion.views is None else motion.views
    status = np.full(shape, "") if motion.status is None else motion.status
    columns: dict[str, object] = {
        **joint_columns(motion),
        **dict(zip(POINT_COVARIANCE_COLUMNS, covariance.reshape(-1, 6).T, strict=True)),
        "views": views.ravel(),
        "reprojection_px": reprojection.ravel(),
        "status": status.ravel().astype(object),
    }
    write_table(path, pd.DataFrame(columns), SKELETON)


EXPORT = ParquetExport()
