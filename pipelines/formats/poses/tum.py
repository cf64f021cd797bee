"""TUM trajectories: `t x y z qx qy qz qw`, one pose per line, t in seconds (TUM RGB-D benchmark)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pipelines.formats.common.export_names import safe_file_name, tracks_of
from pipelines.formats.common.stamps import format_seconds, parse_stamps
from pipelines.formats.common.summaries import describe_trajectory
from pipelines.formats.common.text_tables import parse_table, read_head, read_text
from pipelines.formats.poses.pose_csv import find_header
from pipelines.formats.poses.pose_rows import clean_poses
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, Recording, Trajectory

_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


class TumFormat:
    """Eight numbers a line, separated by spaces, tabs or commas; # begins a comment line.

    Stamps are read exactly to the nanosecond; positions are metres in the axes of whoever wrote them.
    """

    name = "tum"
    title = "TUM trajectory"
    suffixes: tuple[str, ...] = (".tum", ".txt", ".csv", ".log")

    def recognises(self, path: Path) -> bool:
        """Whether the first line that is no comment holds eight numbers and no header names the columns."""
        if path.suffix.lower() not in self.suffixes or not path.is_file():
            return False
        head = _spaced(read_head(path))
        first = next((line for line in head.split("\n") if line and not line.startswith("#")), "")
        return find_header(read_head(path)) is None and _is_eight_numbers(first)

    def describe(self, path: Path) -> dict[str, object]:
        """Rows, times, gaps, box and what was dropped."""
        return describe_trajectory(self.read_trajectory(path))

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read every pose; `clean_poses` says which rows are dropped.

        Raises:
            DataError: not text, a line without eight numbers, stamps not in seconds, or no usable row.
        """
        table = parse_table(
            path,
            _spaced(read_text(path)),
            delimiter=" ",
            columns=len(_COLUMNS),
            text={"t": 0},
            numbers={name: index for index, name in enumerate(_COLUMNS) if index},
            first_line=1,
        )
        t_ns, readable = parse_stamps(path, table.text["t"])
        return clean_poses(
            path,
            t_ns,
            readable,
            table.stack(("x", "y", "z")),
            table.stack(("qx", "qy", "qz", "qw")),
            truncated=table.truncated,
        )


class TumExport:
    """One file for each camera and for each joint, in metres, z up, stamps with nine decimals.

    `<name>_<camera>.tum` is world_from_camera as logged, `<name>_<camera>_refined.tum` as the reconstruction
    corrected it; `<name>_<joint>.tum` (with several people `<name>_person<k>_<joint>.tum`) a joint without
    a rotation (0 0 0 1). A time at which a joint is missing has no row.
    """

    name = "tum"
    title = "trajectories of the cameras and of every joint, for evo"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the cameras that have poses and the joints that were ever measured.

        Raises:
            DataError: there is neither.
        """
        paths: list[Path] = []
        for what, trajectory in {**tracks_of(recording), **_joint_tracks(recording.motion)}.items():
            path = folder / f"{safe_file_name(recording.name)}_{safe_file_name(what)}.tum"
            while path in paths:  # names that differ in what no file name has
                path = path.with_stem(f"{path.stem}_")
            write_trajectory(path, trajectory)
            paths.append(path)
        if not paths:
            raise DataError(
                recording.name, "holds neither camera poses nor joints", "ingest or reconstruct it first"
            )
        return sorted(paths)


def _joint_tracks(motion: JointMotion | None) -> dict[str, Trajectory]:
    """The times at which each joint of each person is known, without rotation."""
    tracks: dict[str, Trajectory] = {}
    if motion is None:
        return tracks
    people = motion.position.shape[1]
    for person in range(people):
        for k, joint in enumerate(motion.joints):
            position = motion.position[:, person, k]
            known = np.isfinite(position).all(axis=1)
            if known.any():
                which = f"person{person}_{joint}" if people > 1 else joint
                unturned = np.tile([0.0, 0.0, 0.0, 1.0], (int(known.sum()), 1))
                tracks[which] = Trajectory(motion.t_ns[known], position[known], unturned)
    return tracks


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write poses so that reading them gives the same stamps and, to the last bit, the same numbers."""
    lines = ["# " + " ".join(_COLUMNS)]
    for stamp, position, quaternion in zip(
        format_seconds(trajectory.t_ns),
        trajectory.position.tolist(),
        trajectory.quaternion_xyzw.tolist(),
        strict=True,
    ):
        lines.append(" ".join([stamp, *map(repr, position), *map(repr, quaternion)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _spaced(text: str) -> str:
    """The text with single spaces between cells and none around lines."""
    text = text.replace("\t", " ").replace(",", " ")
    if "  " in text:
        text = re.sub(" {2,}", " ", text)
    return text.replace("\n ", "\n").replace(" \n", "\n").strip(" ")


def _is_eight_numbers(line: str) -> bool:
    cells = line.split(" ")
    try:
        return len([float(cell) for cell in cells]) == len(_COLUMNS)
    except ValueError:
        return False


FORMAT = TumFormat()
EXPORT = TumExport()
