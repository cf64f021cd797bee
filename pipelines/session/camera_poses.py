"""Poses of a session's cameras at given times, as far as the logs are trusted, and their uncertainty.

The uncertainty is that of the command line, else of flight.yaml, else of the log; all may be silent.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.noise import Bias, NoiseModel, build, parse, sum_sigma
from pipelines.geometry.poses import interpolate_poses, rates
from pipelines.session.description import CameraEntry, Interpolation
from pipelines.session.errors import DataError
from pipelines.session.records import Trajectory
from pipelines.session.registries import Registry


def poses_at(
    track: Trajectory, t_ns: Int64, between: Interpolation, *, static: bool = False
) -> tuple[Float, Float]:
    """Interpolate world_from_camera at times [T], NaN without one; a static camera's always holds."""
    if static:
        still = np.zeros(len(t_ns), dtype=np.intp)
        return track.position[still], track.quaternion_xyzw[still]
    return interpolate_poses(
        track.t_ns,
        track.position,
        track.quaternion_xyzw,
        t_ns,
        max_gap_ns=between.max_gap_ns,
        max_extrapolation_ns=between.max_extrapolation_ns,
    )


COMMAND_LINE = "--pose-noise"
# Logs write variances like 1e6 for "unknown". No log of a drone is off by 10 m or half a turn.
MAX_KNOWN_VARIANCE_M2_RAD2 = (100.0, np.pi**2)
# Logs round their covariances, which moves the eigenvalues of correlations by about this much.
MAX_ROUNDING_OF_EIGENVALUE = 1e-6


NOISE_MODELS: Registry[type[NoiseModel]] = Registry("mocap.noise_models", "pose noise model")


class StatedNoise(NamedTuple):
    """The standard deviations of N logged poses; None where no source states them."""

    sigma: Float | None  # [N, 2] standard deviation per axis of position (m) and rotation (rad)
    covariance: Float | None  # [N, 6, 6] the log's own, where `sigma` is computed from it


def stated_models(
    name: str, entry: CameraEntry, pose_noise: str | None, stepped_m: float = 0.0
) -> list[NoiseModel] | None:
    """Return the models of a camera's pose errors; None if neither command line nor flight.yaml names any.

    Positions that jumped and stayed leave a constant error `stepped_m` besides.
    """
    besides = [Bias(position_m=stepped_m, rotation_deg=0.0)] if stepped_m else []
    if pose_noise:
        return [*parsed_noise_models(COMMAND_LINE, pose_noise), *besides]
    if entry.pose_noise:
        return [*noise_models(f"pose_noise of {name}", entry.pose_noise), *besides]
    return None


def noise_models(place: str, parts: Mapping[str, Mapping[str, object]]) -> list[NoiseModel]:
    """Build the pose noise models that a manifest names; DataError about `place` for unknown or bad ones."""
    return _built(place, parts.items())


def parsed_noise_models(place: str, text: str) -> list[NoiseModel]:
    """Build the noise models of a text (`geometry.noise.parse`); DataError about `place`."""
    try:
        parts = parse(text)
    except ValueError as error:
        remedy = "write white:position_m=0.3,rotation_deg=1"
        raise DataError(place, str(error), remedy, code="bad-value") from None
    return _built(place, parts)


def _built(place: str, parts: Iterable[tuple[str, Mapping[str, object]]]) -> list[NoiseModel]:
    try:
        return build(parts, dict(zip(NOISE_MODELS.names(), NOISE_MODELS.all(), strict=True)))
    except ValueError as error:
        raise DataError(place, str(error), code="bad-value") from None


def stated_noise(
    name: str,
    entry: CameraEntry,
    trajectory: Trajectory,
    pose_noise: str | None = None,
    stepped_m: float = 0.0,
) -> StatedNoise:
    """Compute the uncertainty of each pose by models, else its covariances; DataError: an unknown one."""
    models = stated_models(name, entry, pose_noise, stepped_m)
    if models is None:
        covariance = logged_covariance(trajectory)
        return StatedNoise(None if covariance is None else _level(covariance), covariance)
    elapsed_s = (trajectory.t_ns - trajectory.t_ns[0]) / 1e9
    moved = rates(trajectory.t_ns, trajectory.position, trajectory.quaternion_xyzw)
    return StatedNoise(sum_sigma(models, elapsed_s, *moved), None)


def logged_covariance(trajectory: Trajectory) -> Float | None:
    """Return the logged covariances [N, 6, 6] with unknown variances filled in; None if no pose has one.

    An unknown variance (`known_variances`) becomes the mean of the pose's known ones of its kind (position or
    rotation), else the median of the other poses, without correlation. A matrix that is not a valid
    covariance keeps its variances only.
    """
    if trajectory.covariance is None:
        return None
    logged = trajectory.covariance
    variances, known = known_variances(logged)
    count = known.sum(axis=2)
    mean = np.where(known, variances, 0.0).sum(axis=2) / np.maximum(count, 1)
    if not (count > 0).any(axis=0).all():
        return None
    for block in range(2):
        unknown = count[:, block] == 0
        mean[unknown, block] = np.median(mean[~unknown, block])
    axes = np.where(known, variances, mean[..., None]).reshape(-1, 6)
    both = known.reshape(-1, 6)[:, :, None] & known.reshape(-1, 6)[:, None, :]
    covariance = np.where(both & np.isfinite(logged), logged, 0.0)
    covariance[:, np.arange(6), np.arange(6)] = axes
    scale = np.sqrt(axes)
    correlation = covariance / (scale[:, :, None] * scale[:, None, :])
    contradictory = np.linalg.eigvalsh(correlation)[:, 0] < -MAX_ROUNDING_OF_EIGENVALUE
    covariance[contradictory] = axes[contradictory, :, None] * np.eye(6)
    return covariance


def known_variances(covariance: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Extract variances [N, 2, 3] of position (m^2) and rotation (rad^2), and a mask of those that are known.

    `covariance` is [N, 6, 6]. Logs write zero, negative, NaN and absurdly large variances for "unknown".
    """
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    return variances, (variances > 0) & (variances < np.array(MAX_KNOWN_VARIANCE_M2_RAD2)[:, None])


def _level(covariance: Float) -> Float:
    """Compute the standard deviation per axis [N, 2] of position and rotation: root of the mean variance."""
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    sigma: Float = np.sqrt(variances.mean(axis=2))
    return sigma
