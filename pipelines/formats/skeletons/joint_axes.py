"""Conversion of joint positions of any unit and axes to metres with z up."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
AXES = ("z-up", "y-up")


def to_metres_z_up(source: Path, position: Float, unit: str, axes: str) -> Float:
    """Convert positions [..., 3]; a point with a coordinate that is not finite is missing (all NaN).

    y-up files (OpenSim, TRC) turn into world = (z, x, y), a rotation: x forward becomes y, y up becomes z.

    Raises:
        DataError: an unknown unit or unknown axes.
    """
    if unit not in METRES:
        raise DataError(
            source, f"the unit {unit!r} is none of {', '.join(METRES)}", "state `unit: mm` or alike"
        )
    if axes not in AXES:
        raise DataError(
            source, f"the axes {axes!r} are none of {', '.join(AXES)}", "state `axes: y-up` or z-up"
        )
    seen = np.isfinite(position).all(axis=-1, keepdims=True)
    turned = position[..., [2, 0, 1]] if axes == "y-up" else position
    return np.where(seen, turned * METRES[unit], np.nan)


def to_y_up(position: Float) -> Float:
    """Convert world positions [..., 3] to OpenSim's axes, y up: (y, z, x) of the world."""
    return position[..., [1, 2, 0]]
