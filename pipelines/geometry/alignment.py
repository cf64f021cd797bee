"""The rigid motion or similarity that best maps one point set onto another.

S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
IEEE PAMI 13(4), 1991; equation numbers below are his.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float

# Ratio of the second to the first singular value of the covariance below which the points count as
# collinear: a bend of 0.02 mm over 0.6 m in both sets. Rounding 1 km from the origin stays below it.
_COLLINEAR = 1e-9


@dataclass(frozen=True)
class Alignment:
    """target_from_source: x -> scale * rotation @ x + translation, one or a batch [...]."""

    scale: Float  # [...]
    rotation: Float  # [..., 3, 3], proper
    translation: Float  # [..., 3]

    def apply(self, points: Float) -> Float:
        """Move points [..., J, 3] of the source onto the target."""
        turned = points @ np.swapaxes(self.rotation, -1, -2)
        moved: Float = self.scale[..., None, None] * turned + self.translation[..., None, :]
        return moved


def align(source: Float, target: Float, *, with_scale: bool) -> Alignment:
    """Align two point sets.

    Args:
        source: [J, 3].
        target: [J, 3], the same points in the same order; rows with NaN on either side are left out.
        with_scale: find a similarity instead of a rigid motion.

    Raises:
        ValueError: fewer than 3 common points, or points on a line: the rotation is not determined.
    """
    common = int((np.isfinite(source) & np.isfinite(target)).all(axis=-1).sum())
    if common < 3:
        raise ValueError(f"{common} common points: an alignment needs 3")
    alignment = align_each(source, target, with_scale=with_scale)
    if not np.isfinite(alignment.rotation).all():
        raise ValueError(f"the {common} common points lie on a line: their rotation is not determined")
    return alignment


def align_each(source: Float, target: Float, *, with_scale: bool) -> Alignment:
    """Align many pairs of point sets, each pair separately.

    Args:
        source: [..., J, 3].
        target: [..., J, 3]; a point with NaN on either side is left out of its pair.
        with_scale: find similarities instead of rigid motions.

    Returns:
        A batch [...]; NaN where fewer than 3 points are common or they lie on a line.
    """
    present = (np.isfinite(source) & np.isfinite(target)).all(axis=-1, keepdims=True)
    count = present.sum(axis=-2)
    divisor = np.maximum(count, 1)
    mean_source = np.where(present, source, 0.0).sum(axis=-2) / divisor  # Eq. 34
    mean_target = np.where(present, target, 0.0).sum(axis=-2) / divisor  # Eq. 35
    from_mean = np.where(present, source - mean_source[..., None, :], 0.0)
    to_mean = np.where(present, target - mean_target[..., None, :], 0.0)
    variance = (from_mean**2).sum(axis=(-2, -1)) / divisor[..., 0]  # Eq. 36
    covariance = np.swapaxes(to_mean, -1, -2) @ from_mean / divisor[..., None]  # Eq. 38
    u, d, vt = np.linalg.svd(covariance)
    # Eqs. 39 and 43 in one: the sign that makes U S V' a rotation, also when the points lie in a plane.
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    s = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    rotation = (u * s[..., None, :]) @ vt  # Eq. 40
    determined = (count[..., 0] >= 3) & (d[..., 1] > _COLLINEAR * d[..., 0])
    if with_scale:
        scale = (d * s).sum(axis=-1) / np.where(variance > 0, variance, 1.0)  # Eq. 42
    else:
        scale = np.ones_like(variance)
    translation = mean_target - scale[..., None] * (rotation @ mean_source[..., None])[..., 0]  # Eq. 41
    return Alignment(
        scale=np.where(determined, scale, np.nan),
        rotation=np.where(determined[..., None, None], rotation, np.nan),
        translation=np.where(determined[..., None], translation, np.nan),
    )
