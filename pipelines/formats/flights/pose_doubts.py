"""Doubts about the poses of a log, although each of them can be used."""

from __future__ import annotations

import numpy as np

from pipelines.session.records import Trajectory

_FASTEST_MPS = 100.0  # no camera that films a person flies faster
_FROZEN_S, _FROZEN_POSES = 1.0, 10  # a frozen pose stays the same for longer, and for as many messages


def doubts_of_speed(trajectory: Trajectory) -> list[str]:
    """Report poses that jump further than anything flies, in one line or none."""
    step_s = np.diff(trajectory.t_ns) / 1e9
    speed = np.linalg.norm(np.diff(trajectory.position, axis=0), axis=1) / step_s
    too_fast = speed > _FASTEST_MPS
    if not too_fast.any():
        return []
    first_s = int(trajectory.t_ns[np.argmax(too_fast)] - trajectory.t_ns[0]) / 1e9
    return [
        f"its poses jump {int(too_fast.sum())} times, by up to {speed.max():.3g} m/s"
        f" (first after {first_s:.2f} s)"
    ]


def doubts_of_stillness(trajectory: Trajectory) -> list[str]:
    """Report poses that otherwise change but are bit-identical for over a second, in one line or none.

    No drone is so still, so its estimator may have frozen. The poses stay in use, because identical poses
    are no proof: a camera on the ground is as still in a log without noise.
    """
    pose = np.concatenate([trajectory.position, trajectory.quaternion_xyzw], axis=1)
    changes = np.flatnonzero((np.diff(pose, axis=0) != 0).any(axis=1))
    first, last = np.append(0, changes + 1), np.append(changes, len(pose) - 1)
    lasts_s = (trajectory.t_ns[last] - trajectory.t_ns[first]) / 1e9
    count = last - first + 1
    frozen = (lasts_s > _FROZEN_S) & (count >= _FROZEN_POSES)
    if not frozen.any() or len(first) == 1:
        return []
    after_s = int(trajectory.t_ns[first[np.argmax(frozen)]] - trajectory.t_ns[0]) / 1e9
    return [
        f"its poses stand still {frozen.sum()} times, for up to {lasts_s.max():.3g} s ({count[frozen].sum()}"
        f" poses in all, first after {after_s:.2f} s): was its estimator frozen?"
    ]
