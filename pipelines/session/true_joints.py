"""The true joints of a session, at the times at which others are compared with them."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.poses import interpolate_points
from pipelines.session.records import Float, Int64, JointMotion

LONGEST_STEP = 1.5
"""Median steps of the truth: it is never bridged across a missing sample."""


def true_joints_at(truth: JointMotion, t_ns: Int64) -> Float:
    """True positions [T, P, J, 3] at given times, interpolated linearly.

    NaN outside the stamps of the truth, beside a sample that misses the joint, and across a hole of more
    than `LONGEST_STEP` steps.
    """
    step_ns = int(np.median(np.diff(truth.t_ns))) if len(truth.t_ns) > 1 else 0
    return interpolate_points(truth.t_ns, truth.position, t_ns, max_gap_ns=int(LONGEST_STEP * step_ns))
