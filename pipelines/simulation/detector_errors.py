"""Model of a keypoint detector's errors, applied to true pixels where no video is rendered.

The size of a detector's errors was measured by tilt (`data/<detector>_errors.csv` says how). Their
correlation in time, behind obstacles and between left and right is modelled here, by the constants below.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import get_args

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Intrinsics
from pipelines.geometry.cameras import project
from pipelines.geometry.poses import invert, transform
from pipelines.session.people import mirrored
from pipelines.simulation.scenario import DetectorErrors, ModelledDetector

MODELLED: tuple[str, ...] = get_args(ModelledDetector)
"""The detectors whose errors were measured, by the names that `--detector` takes; the usual one first."""
COLUMNS = ("tilt_deg", "joint", "median_error_share", "missed_share", "confidence")
ANY_JOINT = "*"

REFERENCE_TILT_DEG = 15.0
"""Tilt at which a scenario's shares of missed joints and outliers hold; they grow with the measured ones."""
# A few hundred measured pictures do not resolve smaller shares.
_LEAST_MISSED = 0.01

KEPT_PER_FRAME = 0.7
"""Autocorrelation of a joint's error from one frame to the next: 0.1 s at 30 frames a second."""

MODELLED_HZ = 30.0
"""Rate of the frames of `KEPT_PER_FRAME`."""

HIDDEN_SHARES = (0.5, 0.8, 1.0)
"""Shares of a person's joints that obstacles hide, for which the next three lines hold."""
HIDDEN_MISSED, HIDDEN_ERROR, HIDDEN_CONFIDENCE = (0.01, 0.53, 0.98), (1.3, 4.5, 4.5), (0.87, 0.7, 0.5)
"""Share of hidden joints that are missed; factors of the others' errors and confidences to visible ones'.

BlazePose fills in the joints of people of whom it sees half. Measured on 20,000 joints of rendered pictures,
1,280 of them behind walls, mounds and trees, in eleven worlds.
"""

SIDES_DEG = (0.0, 30.0, 60.0, 90.0, 120.0, 150.0, 180.0)
SIDE_FACTOR = (0.6, 0.72, 0.95, 1.12, 1.03, 0.97, 0.85)
"""Angle between the direction that a person faces and the camera, and the factor of errors seen from there.

Medians of the same pictures: BlazePose is best from the front, and worst from the side.
"""

TAIL_TILTS_DEG, TAIL_FREEDOMS = (20.0, 37.0), (2.0, 1.3)
"""Tilts, and the degrees of freedom of Student's distribution, of which errors of arms and legs are there.

Wrists, elbows, knees and ankles are far off more often than a normal distribution says: 8 % of them by more
than four standard deviations, 13 % where the camera looks down steeply. Heads and trunks are not.
"""
# Errors were measured at the first height (px) of a person. Below the second one they are no shares of it:
# people of 67 px err by 1.35 times the share of people of 133 px, in 54 pictures.
MEASURED_HEIGHT_PX, SMALL_HEIGHT_PX = 133.0, 61.0
# No error of an arm or leg is more than so many times a usual one, or a few would decide every mean.
MOST_TAIL = 20.0

LASTING_SHARE = 0.5
"""Share of the variance of a joint's error in those pictures that stays the same over a flight."""

OUTLIER_SHARES = (0.2, 1.0)
"""Distance of an outlier from the truth, in heights of the person: least and most."""

SWAP_FRAMES = (2, 6)
"""Number of frames for which left and right stay swapped: least and most."""

# Ordinary errors raise or lower the confidence by up to half the range, outliers lower it by half of it
# and some more. Chosen so that it separates errors above 5 % of the height as well as the measured detector's
# does: the area under the ROC curve is 0.84 to 0.90 over tilts of 60 to 15 degrees, measured was 0.88.
_CONFIDENCE_RANGE, _CONFIDENCE_NOISE, _OUTLIER_DOUBT = 0.14, 0.05, 0.3

# The size of a detector's errors is that of a person of this height in the picture.
PERSON_HEIGHT_M = 1.75

FILMED_MISSED, FILMED_OUTLIERS = 0.003, 0.0005
"""Shares of visible joints that are missed and outliers at `REFERENCE_TILT_DEG`, in those pictures."""

MEDIAN_PER_SIGMA = float(np.sqrt(2 * np.log(2)))
"""Median length of a keypoint's error over the standard deviation of a coordinate (Rayleigh)."""

_LIMBS = (("elbow", "wrist", "pinky", "index", "thumb"), ("knee", "ankle", "heel", "big_toe", "small_toe"))


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """Measured errors by joint (`ANY_JOINT` for all others) and tilt."""

    rows: Mapping[str, Float]
    """Rows [K, 4]: tilt in degrees, rising and the same for all; median error, missed share, confidence."""

    def at(self, tilt_deg: Float, joints: tuple[str, ...]) -> tuple[Float, Float, Float]:
        """Return median error share, missed share, confidence [T, J]; linear between measured tilts."""
        tables = np.stack([self.rows.get(name, self.rows[ANY_JOINT]) for name in joints], axis=1)  # [K, J, 4]
        near = [np.interp(tilt_deg, tables[:, 0, 0], hat) for hat in np.eye(len(tables))]
        values = np.einsum("kt,kjc->ctj", near, tables[..., 1:])
        return values[0], values[1], values[2]


@lru_cache(maxsize=4)
def _usual_missed(table: ErrorTable, joints: tuple[str, ...]) -> float:
    usual = table.at(np.array([REFERENCE_TILT_DEG]), joints)[1]
    return max(float(usual.mean()) if usual.size else 0.0, _LEAST_MISSED)


def errors_of(detector: str) -> Path:
    """Return the path of the measured errors of one of the `MODELLED` detectors."""
    return Path(__file__).parent / "data" / f"{detector}_errors.csv"


@lru_cache(maxsize=4)
def read_errors(path: Path) -> ErrorTable:
    """Read the measured errors: a CSV with `COLUMNS`; lines that begin with # give their source."""
    lines = path.read_text(encoding="utf-8").splitlines()
    by_joint: dict[str, list[list[float]]] = {}
    for tilt, joint, *numbers in list(csv.reader(line for line in lines if not line.startswith("#")))[1:]:
        by_joint.setdefault(joint, []).append([float(number) for number in (tilt, *numbers)])
    return ErrorTable({joint: np.array(sorted(values)) for joint, values in by_joint.items()})


def see(joints: Float, position: Float, quaternion_xyzw: Float, intrinsics: Intrinsics) -> Float:
    """Compute pixels [T, J, 2] of joints [T, J, 3] m, NaN behind the camera and outside the picture."""
    if position.ndim == 2:
        position, quaternion_xyzw = position[:, None], quaternion_xyzw[:, None]
    camera_from_world = invert(position, quaternion_xyzw)
    pixels = project(transform(camera_from_world, joints), intrinsics)
    inside = (pixels >= -0.5) & (pixels <= np.array([intrinsics.width, intrinsics.height]) - 0.5)
    return np.where(inside.all(axis=-1, keepdims=True), pixels, np.nan)


def view_of(camera: Float, target: Float, *, height_m: float, focal_px: float) -> tuple[Float, Float]:
    """Compute a camera's tilt down at a person's middle [T] in degrees, and the apparent height [T] px.

    The height is f H/d, that of the standing person as seen from the side, for any tilt. Measured errors are
    shares of it. The camera is never at the person's middle.
    """
    away = camera - target
    distance = np.linalg.norm(away, axis=-1)
    return np.degrees(np.arcsin(away[..., 2] / distance)), focal_px * height_m / distance


def side_of(away: Float, skeleton: Float, joints: tuple[str, ...]) -> Float:
    """Compute from which side [T] a camera sees a person, in degrees from the front; NaN where unknown.

    `away` [T, 3] points from the person to the camera, the `skeleton` is [T, J, 3] m, world.
    """
    if not {"left_hip", "right_hip"} <= set(joints):
        return np.full(len(away), np.nan)
    across = skeleton[:, joints.index("left_hip")] - skeleton[:, joints.index("right_hip")]
    front = np.stack([across[:, 1], -across[:, 0]], axis=-1)
    along, beside = (front * away[:, :2]).sum(-1), front[:, 0] * away[:, 1] - front[:, 1] * away[:, 0]
    side_deg: Float = np.degrees(np.abs(np.arctan2(beside, along)))
    return side_deg


def filmed_errors(detector: str | None) -> DetectorErrors:
    """Return the errors of a detector on rendered pictures, or of the usual one if it was not measured."""
    usual = DetectorErrors(missed_share=FILMED_MISSED, outlier_share=FILMED_OUTLIERS)
    return usual.model_copy(update={"detector": detector}) if detector in MODELLED else usual


def detect_by_model(
    pixels: Float,
    free: Bool,
    camera: Float,
    target: Float,
    skeleton: Float,
    focal_px: float,
    rng: np.random.Generator,
    *,
    joints: tuple[str, ...],
    errors: DetectorErrors,
    rate_hz: float,
) -> tuple[Float, Float]:
    """Simulate the detector by a model with tilt, distance and side (`replay.Detect`)."""
    tilt_deg, height_px = view_of(camera, target, height_m=PERSON_HEIGHT_M, focal_px=focal_px)
    return detect_keypoints(
        *(pixels, free, tilt_deg, height_px, errors, rng),
        joints=joints,
        rate_hz=rate_hz,
        side_deg=side_of(camera - target, skeleton, joints),
    )


def detect_keypoints(
    pixels: Float,
    visible: Bool,
    tilt_deg: Float,
    apparent_height_px: Float,
    errors: DetectorErrors,
    rng: np.random.Generator,
    *,
    joints: tuple[str, ...],
    table: ErrorTable | None = None,
    rate_hz: float = MODELLED_HZ,
    side_deg: Float | None = None,
) -> tuple[Float, Float]:
    """Simulate the keypoints [T, J, 2] px of one person, NaN where missed, and confidences [T, J], then 0.

    Errors have the measured median length and no preferred direction; from frame to frame they follow a
    first-order autoregression (`KEPT_PER_FRAME`). Misses and outliers come one by one, more of them the
    steeper the camera looks. Hidden joints are missed the more, the more of the person is hidden
    (`HIDDEN_SHARES`). Swapped limbs (elbow to hand, knee to foot) stay so for `SWAP_FRAMES`. The mean
    confidence of visible joints is the measured one; a joint's own falls with the rank of its error among
    errors of its kind, and outliers lose up to `_OUTLIER_DOUBT` more, so that some of them look good. With
    `errors.scale` 0 all found keypoints are exact.

    The exact pixels are NaN for joints outside the picture; `visible` [T, J] is False where something hides
    one, and takes no part in the random numbers. Frames are `rate_hz` a second. `table` is that of
    `errors.detector` by default. With sides [T] in degrees errors depend on them, too (`SIDE_FACTOR`), and a
    part of each joint's error lasts (`LASTING_SHARE`).
    """
    table = read_errors(errors_of(errors.detector)) if table is None else table
    median_share, measured_missed, mean_confidence = table.at(tilt_deg, joints)
    growth = measured_missed / _usual_missed(table, joints)

    shape = pixels.shape[:2]
    unit_error = _correlated(shape, KEPT_PER_FRAME ** (MODELLED_HZ / rate_hz), rng)
    angle, far = rng.uniform(0, 2 * np.pi, shape), rng.uniform(*OUTLIER_SHARES, shape)
    hidden_share = 1.0 - visible.mean(axis=1, keepdims=True)
    hidden = [
        np.interp(hidden_share, HIDDEN_SHARES, of) for of in (HIDDEN_MISSED, HIDDEN_ERROR, HIDDEN_CONFIDENCE)
    ]
    missed = rng.random(shape) < np.where(visible, 0.0, hidden[0]) + errors.missed_share * growth
    outlier = rng.random(shape) < errors.outlier_share * growth
    doubt, noise = rng.random(shape), rng.standard_normal(shape)
    swapped = _swapped(shape[0], joints, errors.swap_share, rng)
    if errors.scale == 0:
        outlier, swapped = np.zeros_like(outlier), np.zeros_like(swapped)

    sigma_px = errors.scale * apparent_height_px[:, None] * median_share / MEDIAN_PER_SIGMA
    if side_deg is not None:
        lasting = rng.standard_normal((1, *unit_error.shape[1:]))
        unit_error = np.sqrt(1.0 - LASTING_SHARE) * unit_error + np.sqrt(LASTING_SHARE) * lasting
        unit_error = unit_error * _tails(tilt_deg, joints, rng)[..., None]
        factor = np.interp(side_deg, SIDES_DEG, SIDE_FACTOR)
        small = np.hypot(1.0, SMALL_HEIGHT_PX / apparent_height_px) / np.hypot(
            1.0, SMALL_HEIGHT_PX / MEASURED_HEIGHT_PX
        )
        sigma_px = sigma_px * (small * np.where(np.isnan(factor), 1.0, factor))[:, None]
    ordinary = unit_error * (sigma_px * np.where(visible, 1.0, hidden[1]))[..., None]
    gross = (far * apparent_height_px[:, None])[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    found = pixels + np.where(outlier[..., None], gross, ordinary)

    # The Rayleigh distribution function: uniform, so that the mean confidence is not changed by it.
    rank = np.where(outlier, 1.0, -np.expm1(-np.sum(unit_error**2, axis=-1) / 2))
    confidence = mean_confidence + _CONFIDENCE_RANGE * (0.5 - rank) - _OUTLIER_DOUBT * doubt * outlier
    confidence = confidence * np.where(visible, 1.0, hidden[2]) + _CONFIDENCE_NOISE * noise
    confidence = np.clip(confidence, 0.01, 1.0)

    found[missed] = np.nan
    confidence[np.isnan(found).any(axis=-1)] = 0.0
    return _exchanged(found, swapped, joints), _exchanged(confidence, swapped, joints)


def _correlated(shape: tuple[int, ...], kept: float, rng: np.random.Generator) -> Float:
    """Draw unit normal errors [T, J, 2], each joint's correlated with those of the frame before."""
    from scipy.signal import lfilter

    error = rng.standard_normal((*shape, 2))
    error[1:] *= np.sqrt(1 - kept**2)
    return np.asarray(lfilter([1.0], [1.0, -kept], error, axis=0))


def _tails(tilt_deg: Float, joints: tuple[str, ...], rng: np.random.Generator) -> Float:
    """Draw factors [T, J] that give errors of limbs Student's distribution with the same median."""
    freedom = np.interp(tilt_deg, TAIL_TILTS_DEG, TAIL_FREEDOMS)[:, None]
    median = np.sqrt(freedom * (2.0 ** (2.0 / freedom) - 1.0))
    drawn = np.sqrt(freedom / rng.chisquare(np.broadcast_to(freedom, (len(tilt_deg), len(joints)))))
    limbs = np.any([_limb(joints, parts) for parts in _LIMBS], axis=0)
    return np.where(limbs, np.minimum(drawn * MEDIAN_PER_SIGMA / median, MOST_TAIL), 1.0)


def _swapped(frames: int, joints: tuple[str, ...], share: float, rng: np.random.Generator) -> Bool:
    """Draw which joints [T, J] have their mirror's place: one limb of a pair at a time, for a few frames."""
    limbs = [_limb(joints, parts) for parts in _LIMBS]
    shortest, longest = SWAP_FRAMES
    length = (shortest + longest) / 2
    begins = rng.random(frames) < share / (share + length * (1 - share))
    counts, which = rng.integers(shortest, longest + 1, frames), rng.integers(len(limbs), size=frames)
    swapped = np.zeros((frames, len(joints)), dtype=np.bool_)
    free_from = 0
    for frame in np.flatnonzero(begins).tolist():
        if frame >= free_from:
            free_from = frame + int(counts[frame])
            swapped[frame:free_from] = limbs[which[frame]]
    return swapped


@lru_cache(maxsize=32)
def _limb(joints: tuple[str, ...], parts: tuple[str, ...]) -> Bool:
    """Return a mask [J] of the joints of a pair of limbs whose mirror is there, too."""
    names = {f"{side}_{part}" for side in ("left", "right") for part in parts}
    return np.array([name in names and mirrored(name) in joints for name in joints], dtype=np.bool_)


@lru_cache(maxsize=4)
def _mirrors(joints: tuple[str, ...]) -> tuple[int, ...]:
    """Return the number of each joint's mirror, its own where there is none."""
    return tuple(joints.index(mirrored(j)) if mirrored(j) in joints else k for k, j in enumerate(joints))


def _exchanged(values: Float, swapped: Bool, joints: tuple[str, ...]) -> Float:
    """Return values [T, J, ...] with every swapped joint's taken from its mirror."""
    if not swapped.any():
        return values
    mirror = list(_mirrors(joints))
    return np.where(swapped.reshape(*swapped.shape, *(1,) * (values.ndim - 2)), values[:, mirror], values)
