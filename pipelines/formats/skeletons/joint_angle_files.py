"""Export of joint angles with standard deviations, as CSV and as OpenSim's storage (STO)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.formats.common.exporting import file_names_of_people, safe_file_name
from pipelines.formats.common.rows import format_seconds
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.joint_angles import ANGLES
from pipelines.session.errors import DataError
from pipelines.session.records import Recording

if TYPE_CHECKING:
    import pandas as pd

# Six decimals of a degree are below any measurement error.
_DECIMALS = 6


class AnglesExport:
    """Writer of `<name>_angles.csv` (the session's table) and `<name>_angles.sto` (`_<person>` of several).

    A STO has the angles in degrees and after them their standard deviations (`<angle>_sigma`). Its seconds
    count from `recording.zero_ns`; the CSV keeps `t_ns`. OpenSim stops reading at a NaN: times at which an
    angle is not known are left out of the STO, and before that angles that are rarely known.
    """

    name = "angles"
    title = "joint angles with standard deviations, as CSV and for OpenSim (STO)"
    choices: Mapping[str, tuple[str, ...]] = {"unit": ("deg",), "axes": ("none",), "time": ("zero", "epoch")}

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
            left_out = write_sto(paths[-1], t_ns - recording.zero_ns, value[:, person], sigma[:, person])
            if left_out:
                recording.progress.note(f"angles: {paths[-1].name} leaves out {left_out}, not known")
        return sorted(paths)


def _dense(table: pd.DataFrame) -> tuple[Int64, Float, Float]:
    """Return times [T], and values and standard deviations [T, P, A], of rows in the order of the session."""
    people = int(table["person"].max()) + 1
    shape = (-1, people, len(ANGLES))
    t_ns = table["t_ns"].to_numpy(np.int64).reshape(shape)[:, 0, 0]
    value, sigma = (table[name].to_numpy(np.float64).reshape(shape) for name in ("value_deg", "sigma_deg"))
    return t_ns, value, sigma


def write_sto(path: Path, t_ns: Int64, value_deg: Float, sigma_deg: Float) -> str:
    """Write angles and standard deviations [T, A] deg in the order of `ANGLES`; say what is left out."""
    kept = np.flatnonzero(np.isfinite(value_deg).any(axis=0))
    whole: Bool = np.asarray(np.isfinite(value_deg[:, kept]).all(axis=1))
    while len(kept) > 1 and 2 * np.count_nonzero(whole) < len(t_ns):
        kept = np.delete(kept, np.isfinite(value_deg[:, kept]).sum(axis=0).argmin())
        whole = np.asarray(np.isfinite(value_deg[:, kept]).all(axis=1))
    value, sigma = value_deg[np.ix_(whole, kept)], sigma_deg[np.ix_(whole, kept)]
    known = np.flatnonzero(np.isfinite(sigma).all(axis=0))
    names = [list(ANGLES)[k] for k in kept]
    columns = ["time", *names, *(f"{names[k]}_sigma" for k in known)]
    lines = [path.stem, "version=1", f"nRows={len(value)}", f"nColumns={len(columns)}", "inDegrees=yes"]
    lines += ["endheader", "\t".join(columns)]
    for stamp, row in zip(format_seconds(t_ns[whole]), np.hstack([value, sigma[:, known]]), strict=True):
        lines.append("\t".join([stamp, *(f"{number:.{_DECIMALS}f}" for number in row.tolist())]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    lost = {"times": int(np.count_nonzero(~whole)), "angles": len(ANGLES) - len(kept)}
    return ", ".join(f"{count} {what}" for what, count in lost.items() if count)


ANGLES_EXPORT = AnglesExport()
