"""OpenSim's TRC: marker positions over time, tab-separated, below five header lines.

Layout (OpenSim documentation, "Marker (.trc) Files"): 1 file type and name, 2 keys, 3 values (rates, counts,
unit), 4 `Frame#`, `Time` and marker names, 5 X1 Y1 Z1 ..., then a row per frame, y up. A marker that was not
seen has blank cells or NaN. We write NaN, because OpenSim 4.6 refuses a file whose last marker is blank.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.formats.common.exporting import people_of
from pipelines.formats.common.rows import METRES, format_seconds, median_step_ns, parse_stamps
from pipelines.formats.skeletons.joint_files import (
    JointFile,
    joint_names,
    marker_name,
    metric_unit,
    to_metres_z_up,
    to_y_up,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, Recording
from pipelines.session.storage import bad_value, damaged, empty, read_text

# Seven decimals of a metre are below any measurement error, and rows stay readable.
_DECIMALS = 7
# Programs write the heading of the column of numbers in these ways.
_FRAME = re.compile(r"\s*frame\s*#", re.IGNORECASE)
# Fields of fixed length end with zero bytes, and tables save quotes.
_PADDING = " \t\r\"'\0"
# So many frames are text at a time, which bounds the memory.
_FRAMES_AT_ONCE = 1000


def _read(path: Path, unit: str | None, axes: str | None) -> JointMotion:
    """Read every row of one person; a stated `unit` overrides the header: files in mm often claim m."""
    keys, markers, rows = _split(path, read_text(path))
    times, values = _numbers(path, rows, len(markers))
    t_ns, readable = parse_stamps(path, times)
    if not readable.all() or (np.diff(t_ns) <= 0).any():
        bad = np.flatnonzero(~readable | (np.diff(t_ns, prepend=t_ns[0] - 1) <= 0))
        raise damaged(path, f"the time of row {bad[0] + 1} ({times[bad[0]]!r}) does not increase")
    position = to_metres_z_up(path, values, unit or metric_unit(keys.get("units", "")), axes or "y-up")
    return JointMotion(t_ns=t_ns, joints=joint_names(markers), position=position[:, None])


def _split(path: Path, text: str) -> tuple[dict[str, str], tuple[str, ...], list[str]]:
    """Return the header's keys and markers, and the lines below its five."""
    lines = text.split("\n")
    if len(lines) < 5 or not lines[0].startswith("PathFileType") or not re.match(_FRAME, lines[3]):
        problem = "has no TRC header (five lines from PathFileType to X1 Y1 Z1)"
        raise DataError(path, problem, "export it again", code="missing-column")
    markers = tuple(cell.strip() for cell in lines[3].split("\t")[2:] if cell.strip())
    columns = len(lines[4].split())
    if not markers or columns != 3 * len(markers):
        raise damaged(path, f"names {len(markers)} markers above {columns} columns of coordinates")
    twice = sorted(marker for marker, count in Counter(markers).items() if count > 1)
    if twice:
        problem = f"names the marker {twice[0]} more than once"
        raise DataError(path, problem, "rename one", code="stated-twice")
    keys = zip(lines[1].split("\t"), lines[2].split("\t"), strict=False)
    return {key.strip().lower(): value.strip(_PADDING) for key, value in keys}, markers, lines[5:]


def _numbers(path: Path, lines: list[str], markers: int) -> tuple[list[str], Float]:
    times: list[str] = []
    values: list[list[float]] = []
    decimal_commas = not any("." in line for line in lines[:10])
    for number, line in enumerate(lines, start=6):  # behind the header
        if not line.strip():
            continue
        cells = (line.replace(",", ".") if decimal_commas else line).split("\t")
        last = number == 5 + len(lines)  # without its end of line: perhaps broken off
        while len(cells) % 3 != 2 and not cells[-1].strip():
            cells.pop()  # many writers end their lines with a tab
        if 2 < len(cells) < 3 * markers + 2 and len(cells) % 3 == 2 and not last:
            cells += [""] * (3 * markers + 2 - len(cells))  # some programs cut blanks at the end of a line
        if len(cells) != 3 * markers + 2:
            raise bad_value(path, f"line {number} has {len(cells)} cells instead of {3 * markers + 2}")
        try:
            values.append([float(cell) if cell.strip() else np.nan for cell in cells[2:]])
        except ValueError as error:
            raise damaged(path, f"line {number}: {error}") from error
        times.append(cells[1])
    if not times:
        raise empty(path, "holds no frames")
    return times, np.array(values).reshape(len(times), markers, 3)


class TrcExport:
    """Writer of `<name>.trc`, or `<name>_<person>.trc`; OpenSim's (x, y, z) is our world's (y, z, x)."""

    name = "trc"
    title = "markers for OpenSim and Pose2Sim"
    choices: Mapping[str, tuple[str, ...]] = {
        "unit": ("m", "cm", "mm"),
        "axes": ("y-up", "z-up"),
        "time": ("zero", "epoch"),
    }

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write every person with at least one known joint."""
        motion, files = people_of(recording, folder, ".trc")
        motion = replace(motion, t_ns=motion.t_ns - recording.zero_ns)
        for person, path in files.items():
            write_joints(path, motion, person, unit=recording.unit or "m", axes=recording.axes or "y-up")
        return sorted(files.values())


def write_joints(
    path: Path, motion: JointMotion, person: int, *, unit: str = "m", axes: str = "y-up"
) -> None:
    """Write one person's joints; a missing joint has NaN in its three cells."""
    step = median_step_ns(motion.t_ns)
    rate = f"{1e9 / step:.6g}" if step else "1"
    markers = [re.sub(r"\s+", " ", marker_name(joint)) for joint in motion.joints]
    frames, count = len(motion.t_ns), len(markers)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{count}\t{unit}\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(markers) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k}" for k in range(1, count + 1) for axis in "XYZ"),
        "",
    ]
    decimals = _DECIMALS + round(math.log10(METRES[unit]))
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)
        for first in range(0, frames, _FRAMES_AT_ONCE):
            some = slice(first, first + _FRAMES_AT_ONCE)
            position = motion.position[some, person] / METRES[unit]
            rows = (to_y_up(position) if axes == "y-up" else position).reshape(-1, 3 * count)
            stamps = format_seconds(motion.t_ns[some])
            for frame, (stamp, row) in enumerate(zip(stamps, rows.tolist(), strict=True), start=first + 1):
                cells = ["NaN" if math.isnan(value) else f"{value:.{decimals}f}" for value in row]
                file.write("\t".join([str(frame), stamp, *cells]) + "\n")


FORMAT = JointFile(
    "trc", "OpenSim markers (TRC)", (".trc",), lambda head: head.startswith("PathFileType"), _read
)
EXPORT = TrcExport()
