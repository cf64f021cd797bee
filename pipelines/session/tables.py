"""The columns of every table of a session, and the conversion of records to rows and back.

The files are plain Parquet: no index, no pandas metadata, and the same bytes for the same frame. A joint that
was not found has no row, and is read back as NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import (
    POINT_COVARIANCE_COLUMNS,
    Detections,
    JointMotion,
    MovingBody,
    Trajectory,
)
from pipelines.session.storage import as_data_error, own_table, refuse_special

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow.parquet as pq

TABLES: dict[str, dict[str, Any]] = own_table(__file__, "tables")
"""File, columns and content of each table of a session, by the name of its schema here."""


def _schema(name: str) -> pa.Schema:
    columns = TABLES[name]["columns"]
    return pa.schema([(column, kind) for kind, words in columns for column in words.split()])


FRAMES = _schema("FRAMES")
POSES = _schema("POSES")
KEYPOINTS = _schema("KEYPOINTS")
TRACKS = _schema("TRACKS")
ACTOR = _schema("ACTOR")
TRUTH = _schema("TRUTH")
CAMERA_POSES = _schema("CAMERA_POSES")
PLAN = _schema("PLAN")
SKELETON = _schema("SKELETON")
ANGLES = _schema("ANGLES")
GAIT = _schema("GAIT")
BODY = _schema("BODY")
BODY_SHAPE = _schema("BODY_SHAPE")
JOINT_ERRORS = _schema("JOINT_ERRORS")
BONES = _schema("BONES")
REPLAN = _schema("REPLAN")

COVARIANCE_COLUMNS = tuple(f"c{i}{j}" for i in range(6) for j in range(i, 6))
"""Upper triangle of a pose covariance: position in world, rotation vector in camera."""
BODY_COLUMNS = ("body_qx", "body_qy", "body_qz", "body_qw")
POSES_WITH_COVARIANCE = pa.schema([*POSES, *[(name, pa.float64()) for name in COVARIANCE_COLUMNS]])
BODY_ROTATION_COLUMNS = ("r00", "r01", "r02", "r11", "r12", "r22")
"""Upper triangle of the covariance of a bone's rotation, rad^2, of a rotation vector in the world."""


def write_table(path: Path, frame: pd.DataFrame, schema: pa.Schema) -> None:
    """Write a table with exactly the columns of `schema`; NaN stays NaN."""
    import pyarrow.parquet as pq

    columns = [pa.array(frame[field.name].to_numpy(), type=field.type, from_pandas=False) for field in schema]
    # An open file, because pyarrow takes no path that is not UTF-8.
    with path.open("wb") as file:
        pq.write_table(pa.Table.from_arrays(columns, schema=schema), file, compression="zstd", version="2.6")


def join_tables(path: Path, parts: Iterable[pd.DataFrame], schema: pa.Schema) -> None:
    """Write one table from several, one at a time in memory."""
    import pyarrow.parquet as pq

    with path.open("wb") as file, pq.ParquetWriter(file, schema, compression="zstd", version="2.6") as writer:
        for part in parts:
            columns = [pa.array(part[field.name].to_numpy(), type=field.type) for field in schema]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


@contextmanager
def _opened(path: Path) -> Iterator[pq.ParquetFile]:
    import pyarrow.parquet as pq

    refuse_special(path)
    try:
        with path.open("rb") as file:
            opened = pq.ParquetFile(file)
            yield opened
    except (FileNotFoundError, PermissionError) as error:
        raise as_data_error(error, path) from error
    except MemoryError:  # one of Arrow's own is also an ArrowException
        raise
    except (OSError, pa.ArrowException, IndexError) as error:
        if any(words in str(error) for words in ("launch worker thread", "annot allocate memory")):
            raise MemoryError(str(error)) from error
        raise DataError(path, "cannot be read as Parquet", _AGAIN, code="damaged") from error


def table_parts(path: Path, schema: pa.Schema) -> list[tuple[int, Callable[[], pd.DataFrame]]]:
    """List the parts of a table of `join_tables`: least value of the first column, and a reader of each."""

    def read(number: int) -> pd.DataFrame:
        with _opened(path) as opened:
            frame: pd.DataFrame = opened.read_row_group(number, columns=schema.names).to_pandas()
        return frame

    with _opened(path) as opened:
        metadata = opened.metadata
    filled = [k for k in range(metadata.num_row_groups) if metadata.row_group(k).num_rows]
    return [(metadata.row_group(k).column(0).statistics.min, partial(read, k)) for k in filled]


def read_table(path: Path, schema: pa.Schema) -> pd.DataFrame:
    """Read a table with the columns of `schema` (more are kept); DataError: missing, or damaged."""
    with _opened(path) as opened:
        return _frame_of(path, opened.read(), schema)


def figures_by_joint(table: pd.DataFrame) -> dict[str, dict[str, float | None]]:
    """Return the values of a table of `JOINT_ERRORS` by joint and figure; None where nothing was measured."""
    return {
        str(joint): {name: None if math.isnan(value) else value for name, value in rows}
        for joint, own in table.groupby("joint", sort=False)
        for rows in [zip(own["figure"], own["value"], strict=True)]
    }


def distinct(path: Path, name: str) -> Int64:
    """Return the different integers in a column of a table, sorted; memory grows with their number alone."""
    with _opened(path) as opened:
        batches = _batches(opened, [name])
        parts = [np.unique(batch.column(0).to_numpy(zero_copy_only=False)) for batch in batches]
    return np.unique(np.concatenate(parts)) if parts else np.empty(0, np.int64)


def count_rows(path: Path) -> int:
    """Return the number of rows of a table; DataError if it cannot be read."""
    with _opened(path) as opened:
        return int(opened.metadata.num_rows)


def read_rows(path: Path, schema: pa.Schema, name: str, chosen: Int64) -> pd.DataFrame:
    """Read the rows of a table that have one of these sorted integers in a column; others take no memory."""
    kept = []
    with _opened(path) as opened:
        for batch in _batches(opened):
            values = batch.column(batch.schema.get_field_index(name)).to_numpy(zero_copy_only=False)
            place = np.searchsorted(chosen, values).clip(0, max(len(chosen) - 1, 0))
            kept.append(batch.filter(pa.array(chosen[place] == values)) if len(chosen) else batch[:0])
        table = pa.Table.from_batches(kept, opened.schema_arrow)
    return _frame_of(path, table, schema)


def _batches(opened: Any, columns: Sequence[str] | None = None) -> Iterator[Any]:
    """Yield a Parquet file's rows group by group: one iterator over all held 1.5 GB for 14.6 million rows."""
    for group in range(opened.metadata.num_row_groups):
        yield from opened.iter_batches(ROWS_PER_BATCH, row_groups=[group], columns=columns)


def read_parts(path: Path, schema: pa.Schema) -> Iterator[pd.DataFrame]:
    """Yield what `read_table` returns in parts; the first has the columns and no rows."""
    with _opened(path) as opened:
        yield _frame_of(path, opened.schema_arrow.empty_table(), schema)
        for batch in _batches(opened):
            yield _frame_of(path, pa.Table.from_batches([batch], opened.schema_arrow), schema)


def _frame_of(path: Path, table: pa.Table, schema: pa.Schema) -> pd.DataFrame:
    missing = [name for name in schema.names if name not in table.column_names]
    if missing:
        problem = f"lacks the columns {', '.join(missing)}"
        raise DataError(path, problem, "run the stage again with --force", code="missing-column")
    frame: pd.DataFrame = table.to_pandas()
    return frame


_AGAIN = "run the stage that wrote it again with --force"
# A batch of so many rows of the widest table has 20 MB.
ROWS_PER_BATCH = 1 << 16
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


def actor_table(trajectories: Sequence[Trajectory]) -> pd.DataFrame:
    """Make rows of `tables.ACTOR` from the trajectories of person 0, 1, ..., one after the other."""
    import pandas as pd

    tables = [
        pd.DataFrame({"t_ns": trajectory.t_ns, "person": person})
        for person, trajectory in enumerate(trajectories)
    ]
    table = pd.concat(tables, ignore_index=True)
    table[_POSITION] = np.concatenate([trajectory.position for trajectory in trajectories])
    return table


def pose_table(trajectory: Trajectory) -> pd.DataFrame:
    """Make rows of `pose_schema` from a trajectory."""
    import pandas as pd

    table = pd.DataFrame({"t_ns": trajectory.t_ns})
    table[_POSITION] = trajectory.position
    table[_QUATERNION] = trajectory.quaternion_xyzw
    if trajectory.covariance is not None:
        table[list(COVARIANCE_COLUMNS)] = trajectory.covariance[:, *np.triu_indices(6)]
    if trajectory.body_xyzw is not None:
        table[list(BODY_COLUMNS)] = trajectory.body_xyzw
    return table


def pose_schema(trajectory: Trajectory) -> pa.Schema:
    """Return the columns of a trajectory: `POSES`, with covariances and the attitude of a body if known."""
    known = POSES if trajectory.covariance is None else POSES_WITH_COVARIANCE
    body = () if trajectory.body_xyzw is None else BODY_COLUMNS
    return pa.schema([*known, *((name, pa.float64()) for name in body)])


def pose_covariances(upper: Float) -> Float:
    """Build symmetric matrices [N, 6, 6] from their upper triangles [N, 21], `COVARIANCE_COLUMNS`."""
    rows, columns = np.triu_indices(6)
    covariance = np.zeros((len(upper), 6, 6))
    covariance[:, rows, columns] = covariance[:, columns, rows] = upper
    return covariance


def trajectory_from(table: pd.DataFrame) -> Trajectory:
    """Rebuild the trajectory that `pose_table` stored."""
    covariance = None
    if set(COVARIANCE_COLUMNS) <= set(table.columns):
        covariance = pose_covariances(table[list(COVARIANCE_COLUMNS)].to_numpy())
    return Trajectory(
        t_ns=table["t_ns"].to_numpy(np.int64),
        position=table[_POSITION].to_numpy(np.float64),
        quaternion_xyzw=table[_QUATERNION].to_numpy(np.float64),
        covariance=covariance,
        body_xyzw=table[list(BODY_COLUMNS)].to_numpy(np.float64)
        if set(BODY_COLUMNS) <= set(table.columns)
        else None,
    )


def read_poses(path: Path) -> Trajectory:
    """Read the trajectory that `pose_table` stored part by part; DataError: missing, or damaged."""
    parts = [trajectory_from(part) for part in read_parts(path, POSES)]
    known = {name for name, value in vars(parts[0]).items() if isinstance(value, np.ndarray)}
    joined: dict[str, Any] = {n: np.concatenate([getattr(part, n) for part in parts]) for n in sorted(known)}
    return replace(parts[0], **joined)


def keypoints_table(detections: Detections, known_frame: Int64, t_ns: Int64) -> pd.DataFrame:
    """Make rows of `tables.KEYPOINTS` from the joints that were found, in known frames [F] with times [F]."""
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


def join_detections(parts: Sequence[Detections]) -> Detections:
    """Join detections of the same joints; one person of a frame may be in several parts."""
    keys = np.concatenate([np.stack([part.frame, part.person], axis=1) for part in parts])
    people, row = np.unique(keys, axis=0, return_inverse=True)
    joints = parts[0].joints
    xy = np.full((len(people), len(joints), 2), np.nan)
    confidence = np.zeros((len(people), len(joints)))
    begin = 0
    for part in parts:
        own, joint = np.nonzero(~np.isnan(part.xy[..., 0]))
        at = row[begin + own]
        xy[at, joint], confidence[at, joint] = part.xy[own, joint], part.confidence[own, joint]
        begin += len(part.frame)
    return Detections(joints, people[:, 0], people[:, 1], xy, confidence, np.unique(people[:, 0]))


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
        {"t_ns": motion.t_ns[t], "person": person, "joint": np.array(motion.joints, dtype=object)[joint]}
    )
    table[_POSITION] = motion.position[t, person, joint]
    return table


def motion_from(table: pd.DataFrame, joints: tuple[str, ...]) -> JointMotion:
    """Rebuild the motion of these joints from a table of `tables.TRUTH` or `tables.SKELETON`."""
    # Times without any of these joints are kept.
    t_ns = np.unique(table["t_ns"].to_numpy(np.int64))
    motion = _unknown_motion(t_ns, joints, _people_of(table), table)
    _fill_motion(motion, table)
    return motion


def read_motion(path: Path, schema: pa.Schema, joints: tuple[str, ...] | None = None) -> JointMotion:
    """Read the motion of these joints (None: of all) as `motion_from` does, with parts of the table."""
    times, people, names = [np.empty(0, np.int64)], 1, dict[str, None]()
    for part in read_parts(path, schema):
        times.append(np.unique(part["t_ns"].to_numpy(np.int64)))
        people = max(people, _people_of(part))
        names |= dict.fromkeys(part["joint"].unique())
    motion = _unknown_motion(np.unique(np.concatenate(times)), joints or tuple(names), people, part)
    for part in read_parts(path, schema):
        _fill_motion(motion, part)
    return motion


def load_bodies(bodies_path: Path, shapes_path: Path, around_ns: Int64 | None = None) -> list[MovingBody]:
    """Load the bodies of two files, see `moving_bodies`.

    With `around_ns`, only the table's times next to these are loaded; all people must share their times.
    """
    shapes = read_table(shapes_path, BODY_SHAPE)
    if around_ns is None:
        return moving_bodies(read_table(bodies_path, BODY), shapes)
    times = distinct(bodies_path, "t_ns")
    after = np.searchsorted(times, around_ns)
    near = np.intersect1d(np.concatenate([after - 1, after]), np.arange(len(times)))
    return moving_bodies(read_rows(bodies_path, BODY, "t_ns", times[near]), shapes)


def moving_bodies(table: pd.DataFrame, shapes: pd.DataFrame) -> list[MovingBody]:
    """Return the bodies of tables of `tables.BODY` and `tables.BODY_SHAPE`, one of each person with rows."""
    bodies = []
    for person in np.unique(table["person"].to_numpy(np.int64)).tolist():
        rows = table[table["person"] == person].sort_values("t_ns", kind="stable")
        numbers = shapes.loc[shapes["person"] == person, "value"].to_numpy(np.float64)
        t_ns = np.unique(rows["t_ns"].to_numpy(np.int64))
        centre = rows[["x", "y", "z"]].to_numpy(np.float64).reshape(len(t_ns), -1, 3)
        turn = rows[["qx", "qy", "qz", "qw"]].to_numpy(np.float64).reshape(len(t_ns), -1, 4)
        sigma = np.sqrt(rows[["cxx", "cyy", "czz"]].to_numpy(np.float64).sum(axis=1)).reshape(len(t_ns), -1)
        bodies.append(MovingBody(person, t_ns, numbers, centre, turn, sigma))
    return bodies


def _people_of(table: pd.DataFrame) -> int:
    return int(table["person"].max()) + 1 if len(table) else 1


def _unknown_motion(t_ns: Int64, joints: tuple[str, ...], people: int, table: pd.DataFrame) -> JointMotion:
    """Return a motion of which nothing is known, with the quantities that a table has."""
    shape = (len(t_ns), people, len(joints))
    position = np.full((*shape, 3), np.nan)
    if "status" not in table:
        return JointMotion(t_ns, joints, position)
    status = np.full(shape, "not_detected", dtype="U16")
    views = np.zeros(shape, np.int64)
    return JointMotion(
        t_ns, joints, position, status, np.full(shape, np.nan), views, np.full((*shape, 6), np.nan)
    )


def _fill_motion(motion: JointMotion, table: pd.DataFrame) -> None:
    joint = _index_of(table["joint"], motion.joints)
    row = np.searchsorted(motion.t_ns, table["t_ns"].to_numpy(np.int64))
    table, row, joint = table[joint >= 0], row[joint >= 0], joint[joint >= 0]
    cell = row, table["person"].to_numpy(np.int64), joint
    motion.position[cell] = table[_POSITION].to_numpy(np.float64)
    if motion.status is not None:
        motion.status[cell] = table["status"].to_numpy(str)
    if motion.reprojection_px is not None:
        motion.reprojection_px[cell] = table["reprojection_px"].to_numpy(np.float64)
    if motion.views is not None:
        motion.views[cell] = table["views"].to_numpy(np.int64)
    if motion.covariance is not None:
        motion.covariance[cell] = table[list(POINT_COVARIANCE_COLUMNS)].to_numpy(np.float64)


def _index_of(names: pd.Series[str], wanted: Sequence[str]) -> NDArray[np.intp]:
    """Find the index of every name among the wanted ones, -1 for names that are not wanted."""
    import pandas as pd

    return pd.Index(wanted).get_indexer(pd.Index(names))
