"""Cloud that the tests of PCD and PLY write in every encoding of these formats."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.session.registries import MapFormat

POINTS: Float = np.array(
    [
        [0.05, 0.05, 0.05],
        [0.15, 0.01, 0.19],  # the same voxel of 0.2 m
        [-0.05, 0.25, 1.01],
        [np.nan, 0.0, 0.0],
        [0.41, -0.41, np.inf],
    ]
)
"""Three finite points, two voxels of 0.2 m: (0, 0, 0) and (-1, 1, 5) from the world's origin."""


def assert_holds_the_points(reader: MapFormat, path: Path) -> None:
    """A file of `POINTS` is read as its two voxels."""
    assert reader.recognises(path)
    occupancy = reader.read_map(path)
    assert occupancy.probability.shape == (2, 2, 6)
    assert occupancy.origin == pytest.approx((-0.2, 0.0, 0.0))
    assert occupancy.resolution_m == 0.2
    assert list(occupancy.dropped.values()) == [2]
    assert np.argwhere(occupancy.probability == 1).tolist() == [[0, 1, 5], [1, 0, 0]]
    assert np.isnan(occupancy.probability).sum() == occupancy.probability.size - 2
    said = reader.describe(path)
    assert (said["occupied_voxels"], said["free_voxels"]) == (2, 0)


def finite_as_told(points: Float, told: dict[str, Any]) -> Float:
    """Return the finite points, which are those of other readers to the 0.1 mm of their facts."""
    finite = points[np.isfinite(points).all(axis=1)]
    assert (len(points), len(finite)) == (told["points"], told["finite_points"])
    for found, its in ((finite.min(0), told["bbox"]["min"]), (finite.max(0), told["bbox"]["max"])):
        assert found == pytest.approx(its, abs=1.01e-4)
    assert finite.mean(axis=0) == pytest.approx(told["centroid"], abs=1.01e-4)
    return finite
