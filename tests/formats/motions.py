"""Joint motions drawn by hypothesis for round trips."""

import numpy as np
from hypothesis import strategies as st

from pipelines.geometry.triangulation import STATUS
from pipelines.session.people import SKELETONS
from pipelines.session.records import JointMotion

NAMES = sorted({joint for skeleton in SKELETONS.values() for joint in skeleton.joints} | {"C7", "RASI"})


@st.composite
def motions(draw: st.DrawFn, *, people: int | None = None) -> JointMotion:
    """Draw a few times, people and joints, some 30 % of them missing, with status and reprojection errors."""
    stamps = draw(st.lists(st.integers(-(10**15), 2 * 10**18), min_size=1, max_size=8, unique=True))
    joints = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=5, unique=True))
    count = people or draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = (len(stamps), count, len(joints))
    position = rng.uniform(-1000, 1000, size=(*shape, 3))
    position[rng.random(shape) < 0.3] = np.nan
    return JointMotion(
        t_ns=np.array(sorted(stamps), dtype=np.int64),
        joints=tuple(joints),
        position=position,
        status=rng.choice(np.array(STATUS), size=shape),
        reprojection_px=rng.uniform(0, 20, size=shape),
    )
