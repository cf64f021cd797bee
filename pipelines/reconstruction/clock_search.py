"""Initial clock offsets for the refinement: the shift of the stamps at which views agree best.

The refinement converges from a start within a few pictures of the true offset. Half a second is about half
a stride: limbs are then seen at the wrong end of their swing and lead it to a wrong offset.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.triangulation import Views, locate

_STEP_S = 1 / 15  # limbs swing for longer than that
_REACH = 2.0  # standard deviations of the stated clock offset
_CLEARER = 0.8  # share of the disagreement without a shift that the best shift must go below
_LIMBS = 75.0  # percentile: half of the joints swing too little, and some views are wrong


def begun_offsets_s(views_at: Callable[[float], Views], instants: int, clock_sigma_s: Float) -> Float:
    """Find an initial offset [C] s of every clock, to about two pictures; 0 for known clocks.

    Views agree at the right offset. Pose errors move all joints of a view together and must not count: the
    disagreement is measured after subtracting the median of each view.

    Args:
        views_at: function that returns the views with all unknown clocks moved forward by a number of
            seconds; joint-frames are grouped by time, the same number at each time.
        instants: number of these times.
        clock_sigma_s: [C] prior standard deviation of each offset, 0 for a known clock. Without a known
            clock all offsets are 0.
    """
    begun = np.zeros(len(clock_sigma_s))
    unknown = np.flatnonzero(clock_sigma_s > 0)
    if not len(unknown) or len(unknown) == len(begun):
        return begun
    steps = int(_REACH * clock_sigma_s.max() / _STEP_S)
    shifts_s = _STEP_S * np.arange(-steps, steps + 1)
    disagreement = np.full((len(shifts_s), len(begun)), np.inf)
    for row, shift_s in enumerate(shifts_s):
        views = views_at(float(shift_s))
        for camera in unknown[np.abs(shift_s) <= _REACH * clock_sigma_s[unknown]]:
            disagreement[row, camera] = _disagreement(views, instants, clock_sigma_s == 0, camera)
    for camera in unknown:
        best = int(np.argmin(disagreement[:, camera]))
        if disagreement[best, camera] < _CLEARER * disagreement[steps, camera]:
            begun[camera] = shifts_s[best]
    return begun


def _disagreement(views: Views, instants: int, known: Bool, camera: int) -> float:
    """Compute the disagreement of a camera with those of known clocks, beside the median of each view."""
    chosen = np.append(np.flatnonzero(known), camera)
    views = replace(
        views,
        xy=views.xy[:, chosen],
        weight=views.weight[:, chosen],
        position=views.position[:, chosen],
        rotation=views.rotation[:, chosen],
        focal=views.focal[chosen],
        pixel_sigma=views.pixel_sigma[chosen],
        pose_sigma=views.pose_sigma[:, chosen],
    )
    points = locate(views, method="dlt").points
    away = points[:, None] - views.position[views.pose_index]
    seen = np.einsum("ncij,nci->ncj", views.rotation[views.pose_index], away)
    depth = np.where(seen[..., 2] > 0, seen[..., 2], np.nan)
    missed = seen[..., :2] / depth[..., None] - views.xy
    missed[views.weight == 0] = np.nan
    missed = missed.reshape(instants, -1, len(chosen), 2)
    there = np.isfinite(missed[..., -1, 0])
    if not there.any():
        return np.inf
    missed = missed[there.any(axis=1)]
    unseen = np.isnan(missed).all(axis=1, keepdims=True)  # by one of the others
    of_view = np.nanmedian(np.where(unseen, 0.0, missed), axis=1, keepdims=True)
    own = np.linalg.norm(missed - of_view, axis=-1)
    return float(np.nanpercentile(own, _LIMBS))
