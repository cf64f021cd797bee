"""Cloud that the tests of PCD and PLY write in every encoding of these formats."""

import numpy as np

from pipelines.geometry.arrays import Float

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

SHAPE = (2, 2, 6)
ORIGIN = (-0.2, 0.0, 0.0)
OCCUPIED = [[0, 1, 5], [1, 0, 0]]
