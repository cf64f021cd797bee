"""Poses in the tags of pictures: places by EXIF, and drones' angles, heights and RTK by XMP."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipelines.formats.common.exif import NAMES, Tags, picture_files, picture_times, read_tags
from pipelines.formats.drone_logs.dji_rows import DjiRows, any_finite, telemetry_of_rows
from pipelines.geometry.arrays import Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.telemetry import Telemetry, TelemetryChoice

_RTK_FIXED = 50
SHARED = "several of its pictures share a second: they are spread evenly over it: let clock.sigma_s be 1"


class PictureTags:
    """Reader of the poses of drones in the pictures of a folder, one for each picture."""

    name = "picture_tags"
    title = "tags of pictures (EXIF, XMP)"
    suffixes: tuple[str, ...] = ("",)

    def recognises(self, path: Path) -> bool:
        """Return True for a folder of pictures whose first says where it was taken."""
        files = picture_files(path) if path.is_dir() else []
        return "latitude" in (read_tags(files[0]) if files else Tags(None)).values

    def describe(self, path: Path) -> dict[str, object]:
        """Describe places, heights, angles and RTK."""
        t_ns, _, columns = _columns(path)
        ranged = [name for name in columns if any_finite(columns[name])]
        return {
            "times": int(np.count_nonzero(t_ns)),
            "positions": int(np.count_nonzero(np.isfinite(columns["latitude"]))),
            "rtk_fixed": int(np.count_nonzero(columns["rtk_flag"] == _RTK_FIXED)),
            **{
                name: [round(float(np.nanmin(columns[name])), 7), round(float(np.nanmax(columns[name])), 7)]
                for name in ranged
            },
        }

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read position, and the angles of body and gimbal, of each picture."""
        t_ns, shared, columns = _columns(path)
        if not t_ns.any():
            raise DataError(
                path,
                "has pictures that say where they were taken but not when (no DateTimeOriginal in EXIF)",
                "name another log of poses, or restore the pictures as the drone wrote them",
                code="clock-unknown",
            )
        notes = ["its clock is the drone's local time, taken as UTC"]
        notes += [SHARED] if shared else []
        fixed = columns["rtk_flag"] == _RTK_FIXED
        if fixed.any():
            across = np.nanmax(np.hypot(columns["rtk_std_latitude"], columns["rtk_std_longitude"]))
            notes.append(
                f"{np.count_nonzero(fixed)} of {len(fixed)} positions are by RTK with a fix, by their own"
                f" account within {across:.3f} m across"
            )
        rows = DjiRows(
            t_ns,
            t_ns != 0,
            columns,
            "the drone's clock",
            body=_angles(columns, "drone"),
            gimbal=_angles(columns, "gb"),
            names=("flight angles", "gimbal angles"),
            rows="pictures",
            repeats=False,
        )
        return telemetry_of_rows(path, rows, choice, notes)


def _columns(path: Path) -> tuple[Int64, bool, dict[str, Float]]:
    """Return times and columns of all pictures, and True if some share a second (`picture_times`)."""
    files = picture_files(path)
    if not files:
        raise DataError(
            path, "is no folder of pictures", "name the folder that holds them", code="wrong-kind"
        )
    tags = [read_tags(file) for file in files]
    t_ns, shared = picture_times(tags)
    columns = {name: np.array([each.values.get(name, np.nan) for each in tags]) for name in NAMES}
    return t_ns, shared, columns | {"altitude": np.full(len(tags), np.nan)}


def _angles(columns: Mapping[str, Float], part: str) -> Float:
    return np.stack([columns[f"{part}_{angle}"] for angle in ("yaw", "pitch", "roll")], axis=1)


FORMAT = PictureTags()
