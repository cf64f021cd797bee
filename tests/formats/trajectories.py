"""Trajectories drawn by hypothesis for round trips."""

import numpy as np
from hypothesis import strategies as st

from pipelines.session.records import Trajectory


@st.composite
def trajectories(draw: st.DrawFn, *, with_covariance: bool = False) -> Trajectory:
    """Draw rows with increasing stamps, positions over a wide range and unit quaternions."""
    stamps = draw(st.lists(st.integers(-(10**17), 2 * 10**18), min_size=1, max_size=20, unique=True))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = len(stamps)
    quaternion = rng.normal(size=(count, 4))
    root = rng.normal(size=(count, 6, 6))
    scale = 10.0 ** draw(st.integers(-6, 7))
    return Trajectory(
        t_ns=np.array(sorted(stamps), dtype=np.int64),
        position=rng.normal(size=(count, 3)) * scale,
        quaternion_xyzw=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        covariance=root @ root.transpose(0, 2, 1) if with_covariance else None,
    )
