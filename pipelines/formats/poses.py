"""Trajectories as text: TUM, and CSV with a heading.

TUM: `t x y z qx qy qz qw`, t in seconds; a line above the numbers may name another order, as `# timestamp tx
ty tz qw qx qy qz`.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from pipelines.formats.common.exporting import file_names_of_people, safe_file_name, tracks_of
from pipelines.formats.common.files import TextFormat
from pipelines.formats.common.rows import (
    NANOSECONDS,
    NORM_TOLERANCE,
    SECONDS,
    Heading,
    bounding_box,
    cell_name,
    describe_times,
    find_heading,
    format_seconds,
    kept_rows,
    parse_stamps,
    parse_table,
    rows_below,
    stamp_column,
)
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import Recording, Trajectory
from pipelines.session.storage import read_text
from pipelines.session.tables import COVARIANCE_COLUMNS, pose_covariances

POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_POSITION_PREFIX = (
    r"t|p_|pos_|position_|p_rs_r_|(?:transform_)?translation_|pose_position_|pose_pose_position_"
)
_QUATERNION_PREFIX = (
    r"q|q_|quat_|quaternion_|orientation_|q_rs_|transform_rotation_|pose_orientation_|pose_pose_orientation_"
)

FARTHEST_M = 1e9
"""Largest coordinate: beyond the Moon, so no pose of a flight; squares of much larger ones overflow."""


def find_poses(text: str) -> tuple[Heading, dict[str, int]] | None:
    """Find the heading of a table of poses, maybe a comment, and the columns x to qw and c00..c55."""
    for index, line in enumerate(text.split("\n", 100)[:100]):
        stripped = line.strip()
        if not stripped:
            continue
        heading = find_heading(stripped, index)
        columns: dict[str, int] = {}
        for name, place in heading.names.items() if heading else ():
            if (column := pose_column(name)) is not None:
                columns.setdefault(column, place)
        if heading is not None and all(name in columns for name in (*POSITION, *QUATERNION)):
            return heading, columns
        if not stripped.startswith("#"):
            return None
    return None


def pose_column(name: str) -> str | None:
    """Return the table column of a heading; None if it is none of a pose."""
    covariance = re.fullmatch(r"c([0-5])([0-5])", name)
    if name in POSITION or (covariance and covariance[1] <= covariance[2]):
        return name
    if match := re.fullmatch(rf"(?:{_POSITION_PREFIX})([xyz])", name):
        return match[1]
    if match := re.fullmatch(rf"(?:{_QUATERNION_PREFIX})([xyzw])", name):
        return "q" + match[1]
    return None


def clean_poses(
    source: Path | str,
    t_ns: Int64,
    readable: Bool,
    position: Float,
    quaternion_xyzw: Float,
    covariance: Float | None = None,
    truncated: int = 0,
) -> Trajectory:
    """Drop the rows of [N] poses that cannot be used, each counted under the first cause that applies.

    "truncated last line" (`truncated` rows that the reader left out); "not finite" (a covariance [6, 6] that
    is blank as a whole is unknown, all zero, and keeps its row); "zero quaternion"; "quaternion not unit"
    (off by more than NORM_TOLERANCE; others are normalised); "absurd position" (beyond FARTHEST_M); as in
    `kept_rows`.
    """
    if covariance is not None:
        blank: Bool = np.asarray(np.isnan(covariance).all(axis=(1, 2)))
        if blank.any():
            covariance = np.where(blank[:, None, None], 0.0, covariance)
    with np.errstate(over="ignore"):  # an overflow gives infinity, which is dropped
        norm = np.linalg.norm(quaternion_xyzw, axis=1)
    causes = {
        "not finite": ~(readable & np.isfinite(position).all(axis=1) & np.isfinite(norm)),
        "zero quaternion": norm < 1e-9,
        "quaternion not unit": np.abs(norm - 1) > NORM_TOLERANCE,
    }
    with np.errstate(invalid="ignore"):
        causes["absurd position"] = np.abs(position).max(axis=1, initial=0.0) > FARTHEST_M
    if covariance is not None:
        causes["not finite"] |= ~np.isfinite(covariance).all(axis=(1, 2))

    dropped = {"truncated last line": truncated} if truncated else {}
    keep = kept_rows(t_ns, causes, dropped)
    if not keep.any():
        counts = ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it has no rows"
        problem = f"holds no usable pose ({counts})"
        raise DataError(source, problem, "check how it was written", code="no-poses")
    return Trajectory(
        t_ns=t_ns[keep],
        position=position[keep],
        quaternion_xyzw=quaternion_xyzw[keep] / norm[keep, None],
        # The largest part of a long log, so it is not copied if all rows are kept.
        covariance=covariance if covariance is None or keep.all() else covariance[keep],
        dropped=dropped,
    )


def describe_trajectory(trajectory: Trajectory) -> dict[str, object]:
    """Return rows, times, bounding box of the positions, and the rows dropped, by cause."""
    return {
        "rows": len(trajectory.t_ns),
        **describe_times(trajectory.t_ns),
        **bounding_box(trajectory.position),
        "covariance": "yes" if trajectory.covariance is not None else "no",
        **{f"dropped: {cause}": count for cause, count in trajectory.dropped.items()},
    }


@dataclass(frozen=True)
class TrajectoryFile(TextFormat):
    """Reader of the poses of a text file: `is_known` recognises its beginning, `read` returns its poses."""

    read: Callable[[Path], Trajectory]

    def describe(self, path: Path) -> dict[str, object]:
        """Describe rows, times, gaps, bounding box and losses."""
        return describe_trajectory(self.read(path))

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read every pose."""
        return self.read(path)


def _numbers_of(line: str) -> list[float]:
    """Return the numbers of a line of them; empty for any other line."""
    try:
        return [float(cell) for cell in line.split()]
    except ValueError:
        return []


# --- TUM: eight numbers a line, separated by spaces, tabs or commas; # begins a comment line -----------

_TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
# VINS-Mono and vio_loop of VINS-Fusion have w first; vio.csv is TUM.
_VINS = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
_HEADING = re.compile(r"[^\s,;\[(]+(?:\s*(?:\[[^\]]*\]|\([^)]*\)))?")  # a name, perhaps with its unit


def _is_tum(head: str) -> bool:
    """Return True if the first line of numbers has eight, without a CSV header above."""
    body, _, _ = _take_header(_spaced(head))
    first = next((line for line in body.split("\n") if line and not line.startswith("#")), "")
    return find_poses(head) is None and (len(_numbers_of(first)) == len(_TUM) or _is_vins_mono(first))


def _layout(path: Path, text: str) -> tuple[str, tuple[str, ...], int, int]:
    """Return the rows, the order, unit and number of their columns, by the header, else as TUM has them."""
    body, columns, unit = _take_header(_spaced(text))
    first = body.partition("\n")[0]
    if _is_vins_mono(first, text.partition("\n")[0]):
        return body, _VINS, NANOSECONDS, len(_numbers_of(first))
    return body, _VINS if path.stem == "vio_loop" and columns == _TUM else columns, unit, len(_TUM)


def _read_tum(path: Path) -> Trajectory:
    """Read every pose."""
    body, columns, unit, width = _layout(path, read_text(path))
    numbers = {name: index for index, name in enumerate(columns) if index}
    table = parse_table(
        path, body, delimiter=" ", columns=width, text={"t": 0}, numbers=numbers, first_line=1
    )
    stamps = parse_stamps(path, table.text["t"], unit)
    return clean_poses(
        path, *stamps, table.stack(POSITION), table.stack(QUATERNION), truncated=table.truncated
    )


def _spaced(text: str) -> str:
    """Return the text with single spaces between cells and none around lines."""
    text = re.sub(" {2,}", " ", text.replace("\t", " ").replace(",", " "))
    return text.replace("\n ", "\n").replace(" \n", "\n").strip(" ")


def _take_header(text: str) -> tuple[str, tuple[str, ...], int]:
    """Read the order of the quaternion and the unit of time from the lines above the first numbers."""
    start, unit = 0, SECONDS
    order: tuple[str, ...] = _TUM
    for line in text.split("\n", 100)[:100]:
        headings = _HEADING.findall(line.removeprefix("#"))
        if turned := _quaternion_in(headings):
            order = (*_TUM[:4], *turned)
            stamps = (stamp_column([heading]) for heading in headings)
            unit = next((stamp[1] for stamp in stamps if stamp is not None), SECONDS)
            if not line.startswith("#"):
                return f"{text[:start]}# {text[start:]}", order, unit
        if line and not line.startswith("#"):
            break
        start += len(line) + 1
    return text, order, unit


def _quaternion_in(headings: list[str]) -> tuple[str, ...] | None:
    """Find qx qy qz qw side by side, in any order, or w x y z behind x y z; other names are free."""
    names = [cell_name(heading)[0] for heading in headings]
    called = [f"q{name}" if name in {"w", "x", "y", "z"} else pose_column(name) or "" for name in names]
    windows = (tuple(called[k : k + 4]) for k in range(len(called) - 4, -1, -1))
    return next((window for window in windows if sorted(window) == sorted(QUATERNION)), None)


def _is_vins_mono(line: str, written: str = "") -> bool:
    """Test for VINS-Mono: ns, position, quaternion with w first, velocity or (in `written`) a last comma."""
    numbers = _numbers_of(line)
    length = 8 if written.rstrip().endswith(",") and len(numbers) == 8 else 11
    return len(numbers) == length and numbers[0] > 1e17 and abs(math.hypot(*numbers[4:8]) - 1) < 1e-2


class _TumFile(TrajectoryFile):
    def describe(self, path: Path) -> dict[str, object]:
        """Describe the order of the quaternions, too; no content says that of one alone."""
        order = _layout(path, read_text(path))[1][4:]
        told = " ".join(order) + (" (else pose.quaternion: wxyz)" if order[-1] == "qw" else "")
        return super().describe(path) | {"quaternion": told}


TUM = _TumFile("tum", "TUM trajectory", (".tum", ".txt", ".csv", ".log"), _is_tum, _read_tum)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write poses so that reading them gives the same stamps and bit-identical numbers."""
    columns: dict[str, object] = {"t": format_seconds(trajectory.t_ns)}
    columns |= dict(zip(POSITION, trajectory.position.T, strict=True))
    columns |= dict(zip(QUATERNION, trajectory.quaternion_xyzw.T, strict=True))
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"# {' '.join(_TUM)}\n")
        pd.DataFrame(columns).to_csv(file, sep=" ", header=False, index=False, lineterminator="\n")


class TumExport:
    """Writer of one file for each camera and for each joint, in metres, z up, stamps with nine decimals.

    `<name>_<camera>.tum` is world_from_camera as logged, `<name>_<camera>_refined.tum` as corrected,
    `<name>_<joint>.tum` (with several people `<name>_<person>_<joint>.tum`) a joint with the identity as
    rotation. A time at which a joint is missing has no row.
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
            write_tum(path, trajectory)
            paths.append(path)
        if not paths:
            problem = "holds neither camera poses nor joints"
            raise DataError(recording.name, problem, "ingest or reconstruct it first")
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


TUM_EXPORT = TumExport()


# --- CSV with a heading --------------------------------------------------------------------------------


def _is_csv(head: str) -> bool:
    return find_poses(head) is not None and not is_airsim(head)


def is_airsim(head: str) -> bool:
    """Test for a recording of AirSim, a drone's own log with axes of its own."""
    return {"TimeStamp", "POS_X", "Q_W", "ImageFile"} <= set(head.partition("\n")[0].split())


def _read_csv(path: Path) -> Trajectory:
    """Read poses below a heading of any order: a time, x y z, qx qy qz qw, perhaps a covariance c00..c55."""
    text = read_text(path)
    found = find_poses(text)
    if found is None:
        problem = "has no header that names the time, x y z and qx qy qz qw"
        remedy = "name the columns t_ns,x,y,z,qx,qy,qz,qw (or t in seconds)"
        raise DataError(path, problem, remedy, code="missing-column")
    heading, columns = found
    missing = [name for name in COVARIANCE_COLUMNS if name not in columns]
    if 0 < len(missing) < len(COVARIANCE_COLUMNS):
        problem = f"lacks the covariance columns {', '.join(missing)}"
        raise DataError(path, problem, "give all 21 of them or none", code="missing-column")
    table = rows_below(path, heading, text, {}, columns)
    stamps = parse_stamps(path, table.text["stamp"], heading.unit, unit_stated=heading.unit_stated)
    covariance = None if missing else pose_covariances(table.stack(COVARIANCE_COLUMNS))
    return clean_poses(
        path, *stamps, table.stack(POSITION), table.stack(QUATERNION), covariance, table.truncated
    )


def write_pose_csv(path: Path, trajectory: Trajectory) -> None:
    """Write `t_ns,x,y,z,qx,qy,qz,qw` and any covariance, so that reading gives the same numbers."""
    columns: dict[str, object] = {"t_ns": trajectory.t_ns}
    columns |= dict(zip(POSITION, trajectory.position.T, strict=True))
    columns |= dict(zip(QUATERNION, trajectory.quaternion_xyzw.T, strict=True))
    if trajectory.covariance is not None:
        upper = trajectory.covariance[:, *np.triu_indices(6)]
        columns |= dict(zip(COVARIANCE_COLUMNS, upper.T, strict=True))
    pd.DataFrame(columns).to_csv(path, index=False, lineterminator="\n")


POSE_CSV = TrajectoryFile("csv", "poses as CSV", (".csv", ".txt", ".tsv"), _is_csv, _read_csv)
