"""Construction of the refinement problem over the skeleton's times from the cameras' pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.reconstruction.refinement.problem import Pictures, Problem

Int64 = NDArray[np.int64]

KNOT_S = 0.5
"""Distance of the knots between which slow pose errors are linear; deviations from that count as white."""

_NEAR = 0.75  # steps of the skeleton: a picture further from its nearest time is not used
_RATE_S = 0.25  # to both sides
_GAP = 3.5  # usual steps: no interpolation if three consecutive times span more than this


@dataclass(frozen=True)
class Sighting:
    """Keypoints of one camera in its F pictures, with its logged poses."""

    t_s: Float  # [F] strictly increasing, on the skeleton's clock
    xy: Float  # [F, J, 2] normalised, undistorted; NaN where nothing was seen
    confidence: Float  # [F, J]
    position: Float  # [F, 3] m, logged world_from_camera; NaN without a pose
    rotation: Float  # [F, 3, 3]
    focal_px: float
    pixel_sigma: float  # px per axis of a view of confidence 1
    pose_covariance: Float | None = None  # [F, 6, 6] of white pose errors, see `Problem`

    @property
    def range_of(self) -> Bool:
        """True for pictures [F] with a pose and a keypoint."""
        return ~np.isnan(self.position[:, 0]) & ~np.isnan(self.xy[..., 0]).all(axis=1)


def build(t_s: Float, sightings: Sequence[Sighting], bones: Int64, *, threads: int = 1) -> Problem:
    """Build the problem: sort pictures by the skeleton's times around them; leave out those near none.

    Args:
        t_s: [T] strictly increasing times of the skeleton, at least three.
        sightings: keypoints and poses of each camera.
        bones: [B, 2] joints with a nearly constant distance.
        threads: see `Problem`.
    """
    parts, covariances, logged = [], [np.empty((0, 6, 6))], 0
    for camera, sighting in enumerate(sightings):
        parts.append(_pictures(t_s, sighting, camera, logged))
        if sighting.pose_covariance is not None:
            covariances.append(sighting.pose_covariance)
            logged += len(sighting.t_s)
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((columns[2], columns[1], columns[0]))
    pictures = Pictures(*(np.ascontiguousarray(column[order]) for column in columns))
    knots = max(int(np.ceil((t_s[-1] - t_s[0]) / KNOT_S)) + 1, 2)
    knot_t_s = np.linspace(t_s[0], t_s[-1], knots)
    return Problem(t_s, pictures, bones, knot_t_s, np.concatenate(covariances), threads)


def _pictures(t_s: Float, sighting: Sighting, camera: int, logged: int) -> tuple[NDArray[np.generic], ...]:
    step = float(np.median(np.diff(t_s)))
    first, near = _first_of_three(t_s, sighting.t_s, step)
    (kept,) = np.nonzero(near & sighting.range_of)
    speed, turn = _rates(sighting)
    seen = ~np.isnan(sighting.xy[kept, :, 0]) & (sighting.confidence[kept] > 0)
    sharpness = np.where(seen, sighting.confidence[kept], 0.0) * sighting.focal_px / sighting.pixel_sigma
    xy = np.where(seen[..., None], sighting.xy[kept], np.nan)
    return (
        first[kept],
        np.full(len(kept), camera, dtype=np.int64),
        np.full(len(kept), -1) if sighting.pose_covariance is None else logged + kept,
        sighting.t_s[kept],
        xy,
        sharpness,
        seen.astype(np.float64),
        sighting.position[kept],
        sighting.rotation[kept],
        speed[kept],
        turn[kept],
    )


def _first_of_three(t_s: Float, at_s: Float, step: float) -> tuple[Int64, Bool]:
    """Find the first of three consecutive times of the skeleton around each time; mark if they exist."""
    after = np.clip(np.searchsorted(t_s, at_s), 1, len(t_s) - 1)
    nearest = np.where(at_s - t_s[after - 1] <= t_s[after] - at_s, after - 1, after)
    span = np.full(len(t_s) + 2, np.inf)  # of the three times that begin at index - 2
    span[2:-2] = t_s[2:] - t_s[:-2]
    choices = np.stack([nearest - 1, nearest - 2, nearest], axis=1)
    fits = span[np.clip(choices, -2, len(t_s) - 1) + 2] < _GAP * step
    first = np.take_along_axis(choices, fits.argmax(axis=1)[:, None], axis=1)[:, 0]
    near = fits.any(axis=1) & (np.abs(t_s[nearest] - at_s) <= _NEAR * step)
    return first.astype(np.int64), near


def _rates(sighting: Sighting) -> tuple[Float, Float]:
    """Compute speed [F, 3] (m/s) in the world and turn rate [F, 3] (rad/s) in the camera; 0 where unknown.

    Rates are taken over half a second. From picture to picture, noisy poses would give rates larger than
    people's motion, and estimated clock offsets would be too small.
    """
    count = len(sighting.t_s)
    if count < 3:
        return np.zeros((count, 3)), np.zeros((count, 3))
    reach = max(round(_RATE_S / float(np.median(np.diff(sighting.t_s)))), 1)
    before, after = np.arange(count) - reach, np.arange(count) + reach
    before, after = np.maximum(before, 0), np.minimum(after, count - 1)
    elapsed_s = (sighting.t_s[after] - sighting.t_s[before])[:, None]
    speed = (sighting.position[after] - sighting.position[before]) / elapsed_s
    turned = np.einsum("tji,tjk->tik", sighting.rotation[before], sighting.rotation[after])
    antisymmetric = (turned - np.swapaxes(turned, 1, 2)) / 2
    axes = [antisymmetric[:, 2, 1], antisymmetric[:, 0, 2], antisymmetric[:, 1, 0]]
    return np.nan_to_num(speed), np.nan_to_num(np.stack(axes, axis=1) / elapsed_s)
