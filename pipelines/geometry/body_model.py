"""The human body: its data, its shape as a few numbers, and its surface in any pose."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.rig import BONE

# Order of the arrays in `data/body.npz` (`python tools/body_asset.py` made it, and describes them).
SEXES = ("female", "male")
BUILDS = ("average", "slim", "heavy")
PARTS = ("skin", "lips", "brow", "white", "iris", "cloth")
# The asset stores places as whole tenths of a millimetre.
UNIT_M = 1e-4

_ASSET = Path(__file__).parent / "data" / "body.npz"


@cache
def body_asset() -> dict[str, NDArray[Any]]:
    """Load the arrays of the asset, by name."""
    with np.load(_ASSET) as stored:
        return {name: stored[name] for name in stored.files}


def height_standing(vertices: Float, joint: Float) -> float:
    """Return the bare body's height with straight legs, m, of vertices [V, 3] and joints [22, 3] at rest."""
    thigh, shank, foot = (joint[BONE[f"left_{name}"]] for name in ("thigh", "shank", "foot"))
    leg = np.linalg.norm(shank - thigh) + np.linalg.norm(foot - shank)
    return float(vertices[:, 2].max() - thigh[2] + leg + foot[2])
