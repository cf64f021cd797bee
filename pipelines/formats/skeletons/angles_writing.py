"""Export of joint angles: a long CSV, and OpenSim's storage (STO) for each person.

STO: OpenSim documentation, "Storage (.sto) Files": a header that ends with `endheader`, then `time` and a
column for each quantity, tab-separated.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.formats.common.exporting import file_names_of_people, safe_file_name
from pipelines.formats.common.rows import format_seconds
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.joint_angles import ANGLES
from pipelines.session.errors import DataError
from pipelines.session.records import Recording

if TYPE_CHECKING:
    import pandas as pd

_DECIMALS = 6  # of a degree or a metre


class AnglesExport:
    """Writer of `<name>_angles.csv` (the session's table) and `<name>_angles.sto` (`_<person>` of several).

    A STO has the angles in degrees and after them their standard deviations (`<angle>_sigma`), NaN where an
    angle is not known. Its seconds count from `recording.zero_ns`; the CSV keeps `t_ns`.
    """

    name = "angles"
    title = "joint angles with standard deviations, as CSV and for OpenSim (STO)"
    units = ("deg",)
    axes = ("none",)
    times = ("zero", "epoch")

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write both files; a person without any angle gets no STO."""
        table = recording.angles()
        if table is None or not len(table) or table["value_deg"].isna().all():
            raise DataError(
                recording.name, "holds no joint angles to export", "run `mocap reconstruct` first"
            )
        name = safe_file_name(recording.name)
        paths = [folder / f"{name}_angles.csv"]
        table.to_csv(paths[0], index=False, lineterminator="\n")
        t_ns, value, sigma = _dense(table)
        known = np.flatnonzero(np.isfinite(value).any(axis=(0, 2))).tolist()
        named = file_names_of_people(recording, value.shape[1])
        for person in known:
            which = f"_{named[person]}" if value.shape[1] > 1 else ""
            paths.append(folder / f"{name}_angles{which}.sto")
            write_sto(paths[-1], t_ns - recording.zero_ns, value[:, person], sigma[:, person])
        return sorted(paths)


def _dense(table: pd.DataFrame) -> tuple[Int64, Float, Float]:
    """Return times [T], and values and standard deviations [T, P, A], of rows in the order of the session."""
    people = int(table["person"].max()) + 1
    shape = (-1, people, len(ANGLES))
    t_ns = table["t_ns"].to_numpy(np.int64).reshape(shape)[:, 0, 0]
    value, sigma = (table[name].to_numpy(np.float64).reshape(shape) for name in ("value_deg", "sigma_deg"))
    return t_ns, value, sigma


def write_sto(path: Path, t_ns: Int64, value_deg: Float, sigma_deg: Float) -> None:
    """Write angles and standard deviations [T, A] deg in the order of `ANGLES`."""
    columns = [*ANGLES, *(f"{name}_sigma" for name in ANGLES)]
    write_storage(path, t_ns, columns, np.hstack([value_deg, sigma_deg]), degrees=True)


def write_storage(path: Path, t_ns: Int64, columns: Sequence[str], values: Float, *, degrees: bool) -> None:
    """Write OpenSim's storage (STO, MOT): quantities [T, C] by the names of their columns."""
    lines = [
        path.stem,
        "version=1",
        f"nRows={len(t_ns)}",
        f"nColumns={len(columns) + 1}",
        f"inDegrees={'yes' if degrees else 'no'}",
        "endheader",
        "\t".join(["time", *columns]),
    ]
    for stamp, row in zip(format_seconds(t_ns), values, strict=True):
        lines.append("\t".join([stamp, *(f"{number:.{_DECIMALS}f}" for number in row.tolist())]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


EXPORT = AnglesExport()
