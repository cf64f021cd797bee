"""The columns of every table of a session, with functions to read and write tables.

The files are plain Parquet that pandas reads without this program. The same frame gives the same
bytes: no index, no pandas metadata, fixed writer settings.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from pipelines.session.errors import DataError
from pipelines.session.records import POINT_COVARIANCE_COLUMNS

if TYPE_CHECKING:
    import pandas as pd

_POSE = [(name, pa.float64()) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
COVARIANCE_COLUMNS = tuple(f"c{i}{j}" for i in range(6) for j in range(i, 6))
"""Upper triangle of a pose covariance: position in world, rotation vector in camera."""

FRAMES = pa.schema([("frame", pa.int64()), ("t_ns", pa.int64()), ("pts_ns", pa.int64())])
POSES = pa.schema([("t_ns", pa.int64()), *_POSE])
POSES_WITH_COVARIANCE = pa.schema([*POSES, *[(name, pa.float64()) for name in COVARIANCE_COLUMNS]])
KEYPOINTS = pa.schema(
    [
        ("frame", pa.int64()),
        ("t_ns", pa.int64()),
        ("person", pa.int64()),
        ("joint", pa.string()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("confidence", pa.float64()),
    ]
)
ACTOR = pa.schema(
    [
        ("t_ns", pa.int64()),
        ("person", pa.int64()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("z", pa.float64()),
    ]
)
TRUTH = pa.schema(
    [
        ("t_ns", pa.int64()),
        ("person", pa.int64()),
        ("joint", pa.string()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("z", pa.float64()),
    ]
)
CAMERA_POSES = pa.schema([("t_ns", pa.int64()), ("camera", pa.string()), *_POSE])
"""truth_poses.parquet: the true pose of every camera."""

PLAN = pa.schema(
    [
        ("t_ns", pa.int64()),
        ("camera", pa.string()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("z", pa.float64()),
    ]
)
"""plan.parquet: the setpoints of the on-board planner for every drone."""

SKELETON = pa.schema(
    [
        ("t_ns", pa.int64()),
        ("person", pa.int64()),
        ("joint", pa.string()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("z", pa.float64()),
        *[(name, pa.float64()) for name in POINT_COVARIANCE_COLUMNS],
        ("views", pa.int64()),
        ("reprojection_px", pa.float64()),
        ("status", pa.string()),
    ]
)

REPLAN = pa.schema(
    [
        ("t_ns", pa.int64()),
        ("camera", pa.string()),
        *_POSE,
        ("formation_yaw_rad", pa.float64()),
        ("slot_yaw_rad", pa.float64()),
        ("slot_tilt_rad", pa.float64()),
        ("slot_range_m", pa.float64()),
        ("tilt_rad", pa.float64()),
        ("visible", pa.bool_()),
        ("predicted_error_m", pa.float64()),
    ]
)
"""replan/<arm>/trajectories.parquet, sorted by time, then camera: the pose (world_from_camera), the commanded
slot (yaw continuous, NaN for the flown trajectories), the tilt above the actor, `visible` (True if nothing
blocks the sight line), and the predicted error of all cameras together (NaN where not determined)."""
SEEN = pa.schema(
    [
        ("t_ns", pa.int64()),
        ("camera", pa.string()),
        ("joint", pa.string()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("status", pa.string()),
    ]
)
"""replan/<arm>/seen.parquet, once a second: the position of each known joint in the arm's pictures (exact px,
NaN outside) and its status: `seen`, `hidden` by the surroundings, or `outside` the picture."""
COST_MAP = pa.schema([("t_ns", pa.int64()), ("yaw_rad", pa.float64()), ("cost", pa.float64())])
"""replan/cost_map.parquet: the cost of a formation at a time, by the yaw of its first camera."""


def write_table(path: Path, frame: pd.DataFrame, schema: pa.Schema) -> None:
    """Write a table with exactly the columns of `schema`; NaN stays NaN."""
    import pyarrow.parquet as pq

    columns = [pa.array(frame[field.name].to_numpy(), type=field.type, from_pandas=False) for field in schema]
    # An open file, because pyarrow takes no path that is not UTF-8.
    with path.open("wb") as file:
        pq.write_table(pa.Table.from_arrays(columns, schema=schema), file, compression="zstd", version="2.6")


def read_table(path: Path, schema: pa.Schema) -> pd.DataFrame:
    """Read a table and check that it holds the columns of `schema` (more are allowed and kept).

    Raises:
        DataError: not a Parquet file, truncated, or columns are missing.
    """
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as file:
            table = pq.read_table(file)
    except (OSError, pa.ArrowException) as error:
        raise DataError(
            path, "cannot be read as Parquet", "run the stage that wrote it again with --force"
        ) from error
    missing = [name for name in schema.names if name not in table.column_names]
    if missing:
        raise DataError(path, f"lacks the columns {', '.join(missing)}", "run the stage again with --force")
    frame: pd.DataFrame = table.to_pandas()
    return frame
