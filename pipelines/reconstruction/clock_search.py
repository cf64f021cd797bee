"""Where the search for clocks begins: by how much stamps have to be shifted for views to agree.

The refinement finds offsets of a few pictures from where it starts. Half a second is as much as half a
stride, and limbs that are seen at the wrong end of their swing lead it astray.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.triangulation import Views, locate
from pipelines.session.records import Float

Bool = NDArray[np.bool_]

_STEP_S = 1 / 15  # limbs swing for longer than that
_REACH = 2.0  # standard deviations of what is stated of a clock
_CLEARER = 0.8  # of the disagreement without a shift: what nothing moves for is left where it is
_LIMBS = 75.0  # percentile: half of the joints hardly swing, and some views are wrong


def begun_offsets_s(views_at: Callable[[float], Views], instants: int, clock_sigma_s: Float) -> Float:
    """Offset [C] s of every clock from which to go on, of the order of two pictures; 0 for those known.

    Views agree at the right offset. Pose errors move all joints of a view together and are left out: how
    joints disagree beside the median of their view is what counts.

    Args:
        views_at: what was seen with all unknown clocks put forward by so many seconds; joint-frames stand
            together by their time, as many of each.
        instants: how many times these are of.
        clock_sigma_s: [C] how far each clock may be off, 0 for one that is known. One has to be.
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
    """How far joints miss what a camera and those of known clocks saw, beside the others of their view."""
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
