"""TUM trajectories: `t x y z qx qy qz qw`, one pose per line, t in seconds (TUM RGB-D benchmark).

Some writers keep the layout but change the order. They name it in a line above the numbers, such as
`# timestamp tx ty tz qw qx qy qz`. Such a line is followed.
"""

import re
from pathlib import Path

import numpy as np

from pipelines.formats.common.exporting import file_names_of_people, safe_file_name, tracks_of
from pipelines.formats.common.files import read_head, read_text
from pipelines.formats.common.rows import (
    SECONDS,
    cell_name,
    format_seconds,
    parse_stamps,
    parse_table,
    stamp_column,
)
from pipelines.formats.poses.pose_rows import clean_poses, describe_trajectory, find_poses, pose_column
from pipelines.session.errors import DataError
from pipelines.session.records import Recording, Trajectory

_COLUMNS: tuple[str, ...] = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_POSES_AT_ONCE = 10_000  # of a file that is written
_HEADING = re.compile(r"[^\s,;\[(]+(?:\s*(?:\[[^\]]*\]|\([^)]*\)))?")  # a name, perhaps with its unit


class TumFormat:
    """Reader of eight numbers a line, separated by spaces, tabs or commas; # begins a comment line.

    Stamps are read exactly to the nanosecond; positions are metres in the axes of the file's writer.
    """

    name = "tum"
    title = "TUM trajectory"
    suffixes: tuple[str, ...] = (".tum", ".txt", ".csv", ".log")

    def recognises(self, path: Path) -> bool:
        """Return True if the first line of numbers has eight, without a CSV header above."""
        head, _, _ = _take_header(_spaced(read_head(path, self.suffixes)))
        first = next((line for line in head.split("\n") if line and not line.startswith("#")), "")
        return find_poses(read_head(path, self.suffixes)) is None and _is_eight_numbers(first)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe rows, times, gaps, bounding box and losses."""
        return describe_trajectory(self.read_trajectory(path))

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read every pose in the order of columns that the header states, else in TUM's.

        `clean_poses` documents which rows are dropped.
        """
        body, columns, unit = _take_header(_spaced(read_text(path)))
        table = parse_table(
            path,
            body,
            delimiter=" ",
            columns=len(_COLUMNS),
            text={"t": 0},
            numbers={name: index for index, name in enumerate(columns) if index},
            first_line=1,
        )
        t_ns, readable = parse_stamps(path, table.text["t"], unit)
        return clean_poses(
            path,
            t_ns,
            readable,
            table.stack(("x", "y", "z")),
            table.stack(("qx", "qy", "qz", "qw")),
            truncated=table.truncated,
        )


class TumExport:
    """Writer of one file for each camera and for each joint, in metres, z up, stamps with nine decimals.

    `<name>_<camera>.tum` is world_from_camera as logged, `<name>_<camera>_refined.tum` as corrected by the
    reconstruction. `<name>_<joint>.tum` (with several people `<name>_<person>_<joint>.tum`) is a joint with
    the identity as rotation (0 0 0 1). A time at which a joint is missing has no row.
    """

    name = "tum"
    title = "trajectories of the cameras and of every joint, for evo"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the cameras that have poses and the joints that are known at any time."""
        paths: list[Path] = []
        for what, trajectory in {**tracks_of(recording), **_joint_tracks(recording)}.items():
            path = folder / f"{safe_file_name(recording.name)}_{safe_file_name(what)}.tum"
            while path in paths:  # different names may give the same safe file name
                path = path.with_stem(f"{path.stem}_")
            write_trajectory(path, trajectory)
            paths.append(path)
        if not paths:
            raise DataError(
                recording.name, "holds neither camera poses nor joints", "ingest or reconstruct it first"
            )
        return sorted(paths)


def _joint_tracks(recording: Recording) -> dict[str, Trajectory]:
    """Return each joint of each person as a trajectory of its known times, without rotation."""
    tracks: dict[str, Trajectory] = {}
    motion = recording.motion
    if motion is None:
        return tracks
    people = motion.position.shape[1]
    named = file_names_of_people(recording, people)
    for person in range(people):
        for k, joint in enumerate(motion.joints):
            position = motion.position[:, person, k]
            known = np.isfinite(position).all(axis=1)
            if known.any():
                which = f"{named[person]}_{joint}" if people > 1 else joint
                unturned = np.tile([0.0, 0.0, 0.0, 1.0], (int(known.sum()), 1))
                tracks[which] = Trajectory(motion.t_ns[known], position[known], unturned)
    return tracks


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write poses so that reading them gives the same stamps and bit-identical numbers."""
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("# " + " ".join(_COLUMNS) + "\n")
        for first in range(0, len(trajectory.t_ns), _POSES_AT_ONCE):
            some = slice(first, first + _POSES_AT_ONCE)
            for stamp, position, quaternion in zip(
                format_seconds(trajectory.t_ns[some]),
                trajectory.position[some].tolist(),
                trajectory.quaternion_xyzw[some].tolist(),
                strict=True,
            ):
                file.write(" ".join([stamp, *map(repr, position), *map(repr, quaternion)]) + "\n")


def _spaced(text: str) -> str:
    """Return the text with single spaces between cells and none around lines."""
    text = text.replace("\t", " ").replace(",", " ")
    if "  " in text:
        text = re.sub(" {2,}", " ", text)
    return text.replace("\n ", "\n").replace(" \n", "\n").strip(" ")


def _take_header(text: str) -> tuple[str, tuple[str, ...], int]:
    """Read the order of the columns from the lines above the first numbers."""
    start, order = 0, _COLUMNS
    for line in text.split("\n", 100)[:100]:
        headings = _HEADING.findall(line.removeprefix("#"))
        if found := _find_columns(headings):
            marked = text if line.startswith("#") else f"{text[:start]}# {text[start:]}"
            return marked, *found
        order = _find_quaternion(headings) or order
        if line and not line.startswith("#"):
            break
        start += len(line) + 1
    return text, order, SECONDS


def _find_columns(headings: list[str]) -> tuple[tuple[str, ...], int] | None:
    """Find a time, three coordinates and a quaternion side by side; its parts may be called w x y z only."""
    names = [cell_name(heading)[0] for heading in headings]
    for k in range(len(headings) - len(_COLUMNS) + 1):
        stamp = stamp_column(headings[k : k + 1])
        position = tuple(pose_column(name) or "" for name in names[k + 1 : k + 4])
        turned = names[k + 4 : k + 8]
        quaternion = tuple(f"q{name}" if name in "xyzw" else pose_column(name) or "" for name in turned)
        if stamp and sorted([*position, *quaternion]) == sorted(_COLUMNS[1:]) and "x" in position:
            return ("t", *position, *quaternion), stamp[1]
    return None


def _find_quaternion(headings: list[str]) -> tuple[str, ...] | None:
    """Find qx qy qz qw side by side, in any order; the names of the other columns are free."""
    names = [pose_column(cell_name(heading)[0]) or "" for heading in headings]
    for k in range(len(names) - 3):
        if sorted(names[k : k + 4]) == sorted(_COLUMNS[4:]):
            return (*_COLUMNS[:4], *names[k : k + 4])
    return None


def _is_eight_numbers(line: str) -> bool:
    cells = line.split(" ")
    try:
        return len([float(cell) for cell in cells]) == len(_COLUMNS)
    except ValueError:
        return False


FORMAT = TumFormat()
EXPORT = TumExport()
