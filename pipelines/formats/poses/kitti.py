"""KITTI odometry: twelve numbers a line, world_from_camera as 3 x 4 by rows; the times are in another file.

Writers of 4 x 4 matrices add 0 0 0 1: sixteen numbers a line are read, too.

KITTI's world is the first camera's: x right, y down, z forward. It is turned to x right, y forward, z up.
The times are seconds, one a line, in a file beside the poses (`times.txt`, or `NAME_times.txt` for
`NAME.txt`), or where the data set has them: `sequences/NAME/times.txt` for `poses/NAME.txt`.
"""

from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head, read_text
from pipelines.formats.common.rows import parse_stamps, parse_table
from pipelines.formats.poses.pose_rows import clean_poses, describe_trajectory
from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.session.errors import DataError
from pipelines.session.records import Trajectory

_LAST_ROW = (0.0, 0.0, 0.0, 1.0)  # of a 4 x 4 matrix
_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # from x right, y down, z forward
_ORTHOGONAL = 1e-2  # largest deviation of R R' from the identity that rounding of the numbers explains


class KittiFormat:
    """Reader of poses of a camera; row k has the time of line k."""

    name = "kitti"
    title = "KITTI trajectory"
    suffixes: tuple[str, ...] = (".txt", ".kitti")

    def recognises(self, path: Path) -> bool:
        """Return True if the first line is twelve or sixteen numbers whose upper left part is a rotation."""
        line = read_head(path, self.suffixes).lstrip().split("\n", 1)[0]
        try:
            numbers = [float(cell) for cell in line.split()]
        except ValueError:
            return False
        if len(numbers) == 16 and tuple(numbers[12:]) == _LAST_ROW:
            numbers = numbers[:12]
        return len(numbers) == 12 and bool(_is_rotation(np.array(numbers).reshape(1, 3, 4)[:, :, :3])[0])

    def describe(self, path: Path) -> dict[str, object]:
        """Describe rows, times, gaps, bounding box and losses."""
        return describe_trajectory(self.read_trajectory(path))

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read every pose, and its time from the file of times."""
        text = " ".join(read_text(path).split(" ")).strip()
        columns = 16 if len(text.split("\n", 1)[0].split()) == 16 else 12
        table = parse_table(
            path,
            text,
            delimiter=" ",
            columns=columns,
            text={},
            numbers={str(column): column for column in range(12)},
            first_line=1,
        )
        rows = table.stack([str(column) for column in range(12)]).reshape(-1, 3, 4)
        times = times_of(path)
        t_ns, readable = parse_stamps(times, read_text(times).split())
        if len(t_ns) < len(rows):
            raise DataError(
                times, f"has {len(t_ns)} times for {len(rows)} poses", "give the times of this trajectory"
            )
        turned = _is_rotation(rows[:, :, :3])
        upright = np.where(turned[:, None, None], rows[:, :, :3], np.eye(3))
        quaternion = quaternion_from_matrix(_WORLD @ upright)
        quaternion[~turned] = np.nan
        with np.errstate(invalid="ignore"):  # an infinite number is dropped with its row
            position = rows[:, :, 3] @ _WORLD.T
        return clean_poses(
            path,
            t_ns[: len(rows)],
            readable[: len(rows)],
            position,
            quaternion,
            truncated=table.truncated,
        )


def _is_rotation(matrices: Float) -> Bool:
    with np.errstate(over="ignore", invalid="ignore"):
        products = matrices @ matrices.transpose(0, 2, 1)
        near = np.abs(products - np.eye(3)).max(axis=(1, 2)) < _ORTHOGONAL
        return np.asarray(near & (np.linalg.det(np.nan_to_num(matrices)) > 0), dtype=np.bool_)


def times_of(path: Path) -> Path:
    """Return the file with the times of a trajectory; raise DataError without one."""
    places = (
        path.with_name("times.txt"),
        path.with_name(f"{path.stem}_times.txt"),
        path.parent.parent / "sequences" / path.stem / "times.txt",
    )
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise DataError(
            path,
            "is a KITTI trajectory without times",
            "put KITTI's times.txt beside it, or save it as TUM",
            code="clock-unknown",
        )
    return found


FORMAT = KittiFormat()
