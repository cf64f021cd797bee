"""Information of cameras before they have seen anything: the ray model."""

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.planning.config import ErrorModel


def ray_information(offset: Float, errors: ErrorModel) -> Float:
    """Compute one camera's expected information on a point: I = p (1 - d d')/s^2, none along the ray d.

    s^2 = sigma_key(tilt)^2 + (rho sigma_rot)^2 + sigma_pos^2, rho the distance. sigma_key is the detector's
    error in metres at the person and p the share of joints that it finds, both by tilt: by geometry alone,
    steep views would be as good. A detector's errors in pixels are shares of the person's height in the
    picture, so that distance and focal length cancel. Offsets [..., 3] m go from the point to the camera and
    are not zero; the result is [..., 3, 3] 1/m^2.
    """
    square = np.sum(offset**2, axis=-1)[..., None, None]
    across = np.eye(3) - offset[..., :, None] * offset[..., None, :] / square
    tilt_deg = np.degrees(np.arcsin(np.abs(offset[..., 2]) / np.sqrt(square[..., 0, 0])))
    placed = np.interp(tilt_deg, errors.tilts_deg, errors.placed_share)[..., None, None]
    keypoint = np.interp(tilt_deg, errors.tilts_deg, errors.keypoint_sigma_m)[..., None, None]
    turned = np.radians(errors.rotation_sigma_deg) ** 2
    information: Float = placed * across / (keypoint**2 + square * turned + errors.position_sigma_m**2)
    return information


def predicted_error(information: Float) -> Float:
    """Compute sqrt(tr S), S = I^-1: the expected error in metres of [..., 3, 3].

    It is inf where a direction is unseen.
    """
    minors, determinant = _minors(information)
    with np.errstate(divide="ignore", invalid="ignore"):
        trace = np.sum(minors, axis=-1) / determinant
    # Singular up to rounding: the determinant is far below the cube of the trace.
    scale = np.trace(information, axis1=-2, axis2=-1) ** 3
    return np.sqrt(np.where(determinant > 1e-12 * scale, trace, np.inf))


def log_determinant(information: Float) -> Float:
    """Compute the logarithm of the determinant of positive definite [..., 3, 3]."""
    logarithm: Float = np.log(_minors(information)[1])
    return logarithm


def _minors(matrix: Float) -> tuple[Float, Float]:
    """Compute the three principal 2x2 minors [..., 3] and the determinant of symmetric matrices."""
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2]
    d, e, f = matrix[..., 1, 1], matrix[..., 1, 2], matrix[..., 2, 2]
    first = d * f - e * e
    determinant = a * first - b * (b * f - c * e) + c * (b * e - c * d)
    return np.stack([first, a * f - c * c, a * d - b * b], axis=-1), determinant
