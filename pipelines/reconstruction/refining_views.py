"""Method `refined` for cameras that share their times, used by studies.

As in `refining`, the estimate starts from `robust` and ends with it: `robust` with the corrected poses
decides which joint-frames are reconstructed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import NoiseModel
from pipelines.geometry.picture_gate import triangulate_pictures
from pipelines.geometry.triangulation import STATUS, Views, estimate_noise, triangulate
from pipelines.reconstruction.refinement.building import Sighting
from pipelines.reconstruction.refinement.problem import pose_errors
from pipelines.reconstruction.refinement.refine import corrected, refine
from pipelines.reconstruction.refining import rigid_pairs


def refined_points(
    views: Views, t_s: Float, joints: tuple[str, ...], models: Sequence[NoiseModel]
) -> tuple[Float, str | None]:
    """Compute the points of one person by `refined`, and the reason of a fallback to `robust`, if any.

    Args:
        views: N = T * J joint-frames, joints fastest; one row of poses for each of the T times. The pose
            noise in them is for `robust`.
        t_s: [T] strictly increasing.
        joints: the J names.
        models: pose noise, the same for every camera; an empty list for exact poses.

    Returns:
        Points [N, 3] m, NaN for none, and the reason of the fallback, None without one.
    """
    times, cameras = views.position.shape[:2]
    told = replace(views, pixel_sigma=estimate_noise(views))
    start = triangulate_pictures(told, picture=views.pose_index, pixel_sigma=views.pixel_sigma).points
    sightings = [
        Sighting(
            t_s=t_s,
            xy=views.xy[:, c].reshape(times, -1, 2),
            confidence=views.weight[:, c].reshape(times, -1),
            position=views.position[:, c],
            rotation=views.rotation[:, c],
            focal_px=float(views.focal[c]),
            pixel_sigma=float(views.pixel_sigma[c]),
        )
        for c in range(cameras)
    ]
    prior = [pose_errors(models)] * cameras
    shape = (times, len(joints), 3)
    found = refine(t_s, sightings, start.reshape(shape), rigid_pairs(joints, 1), prior, np.zeros(cameras))
    if found.fallback is not None:
        return start, found.fallback
    position, rotation = views.position.copy(), views.rotation.copy()
    for c, (when_s, numbers) in enumerate(found.corrections):
        if len(when_s):
            there = np.stack([np.interp(t_s, when_s, column) for column in numbers.T], axis=1)
            position[:, c], rotation[:, c] = corrected(position[:, c], rotation[:, c], there)
    moved = replace(views, position=position, rotation=rotation, pose_sigma=np.zeros_like(views.pose_sigma))
    gated = triangulate(replace(moved, pixel_sigma=estimate_noise(moved)), method="robust")
    refined = found.position.reshape(-1, 3)
    ok = (gated.status == STATUS.index("ok")) & np.isfinite(refined[:, 0])
    return np.where(ok[:, None], refined, gated.points), None
