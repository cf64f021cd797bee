"""A closed-form walking person: every joint is a formula of time, so the truth of a flight is exact.

Joint angles over a stride are short Fourier series of the normal ranges of level walking: the thigh
from the vertical and the arm after Perry & Burnfield, "Gait Analysis" (2nd ed. 2010), the knee after
Winter, "Biomechanics and Motor Control of Human Movement" (4th ed. 2009, natural cadence); fitted
within 3 degrees of those curves so that the speed over the stance foot is even. Segment lengths are
fractions of the body's height after Drillis & Contini (in Winter 2009, chapter 4).
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.session.people import get_skeleton

SIDES = ("left", "right")
COCO17 = get_skeleton("coco17").joints

# Degrees: mean, then cosine and sine of each harmonic of the stride; the left heel strikes at phase 0.
_THIGH_DEG = (5.8, 21.0, -2.3, -4.0, -2.8, -0.7, 0.9)  # from the vertical: 19 behind to 25 in front
_KNEE_DEG = (23.1, -3.4, -19.3, -15.2, 7.0, 0.3, 5.0, 0.9, 0.2)  # 5 to 65 flexed
_SHOULDER_DEG = (-8.0, -16.0, 0.0)  # 24 extended at the heel strike of its side, then 8 flexed
_ELBOW_DEG = (32.0, -12.0, 0.0)  # 20 to 44 flexed
_PELVIS_YAW_DEG = (0.0, -4.0, 0.0)  # the hip goes forward with its leg
_CHEST_YAW_DEG = (0.0, 5.0, 0.0)  # and the shoulder with its arm
_HIP_ADDUCTION_DEG = 6.0  # brings the ankles under the body: hips as wide as the pelvis stand too far apart
_CHEST_LEAN_DEG = 3.0

# Fractions of the body's height (Drillis & Contini), but for the face, which that table does not hold.
_HIP_HALF, _SHOULDER_HALF = 0.191 / 2, 0.259 / 2
_THIGH, _SHANK, _ANKLE_HEIGHT = 0.245, 0.246, 0.039
_ROLL_RADIUS = 0.3 * (_THIGH + _SHANK + _ANKLE_HEIGHT)  # of the sole, with the shank: McGeer 1990
_TRUNK, _UPPER_ARM, _FOREARM = 0.288, 0.186, 0.146
_FACE = {  # forward, left, up from the middle of the shoulders; eyes 0.936 H above the ground
    "nose": (0.065, 0.0, 0.100),
    "eye": (0.050, 0.018, 0.118),
    "ear": (0.0, 0.043, 0.112),
}

# The pelvis hands over from one stance foot to the other where their heights differ by about this
# fraction of the body's height (1 cm): less would jerk, more would float (by log 2 of it, 7 mm).
_HANDOVER = 0.006


def walk(
    t_s: Float,
    *,
    speed_mps: float = 1.2,
    start: tuple[float, float] = (0.0, 0.0),
    heading_deg: float = 0.0,
    radius_m: float | None = None,
    height_m: float = 1.75,
) -> Float:
    """Compute the joints of a person who walks straight on, or round a circle.

    Limb, hip, shoulder and head lengths are constant to rounding (the trunk twists), left and right are
    mirror images half a stride apart, and the mean speed is exactly `speed_mps`. The stride (1.32 m at
    1.75 m height: 109 steps a minute at 1.2 m/s) does not depend on the speed, the cadence does.

    The pelvis rides on the sole, an arc fixed to the shank that rolls without slipping (McGeer, "Passive
    dynamic walking", 1990): one sole is always between 0 and 8 mm above the ground, none ever below. The
    stance ankle moves forward 5.5 cm and up 2.5 cm as the heel rises, and is otherwise still; the pelvis
    speed stays within 15 % of its mean.

    Args:
        t_s: [T] times, in any order.
        start: east and north of the pelvis at time 0, metres, up to its forward sway of 7 mm.
        heading_deg: direction of the walk at time 0, counterclockwise from east.
        radius_m: radius of a circle that begins at `start` and turns left; straight without it. The
            whole body turns with the path, which twists the feet on the ground.

    Returns:
        [T, 17, 3] metres, ENU, the ground at z = 0, joints in the order of `COCO17`.
    """
    _, sway = _pelvis_travel()
    phase = 2 * np.pi / stride_m(height_m) * speed_mps * t_s
    along = speed_mps * t_s + height_m * _periodic(sway, phase)
    joints = height_m * _standing_joints(phase)

    ground, heading = route(along, start=start, heading_deg=heading_deg, radius_m=radius_m)
    joints = _about_up(joints, heading)
    joints[..., :2] += ground[:, None]
    return joints


def stride_m(height_m: float = 1.75) -> float:
    """Return the length of a stride, until the same foot lands again, of a person of that height."""
    radians_per_height, _ = _pelvis_travel()
    return 2 * np.pi / radians_per_height * height_m


def route(
    along_m: Float,
    *,
    start: tuple[float, float] = (0.0, 0.0),
    heading_deg: float = 0.0,
    radius_m: float | None = None,
) -> tuple[Float, Float]:
    """Compute the place on a straight line or a left-turning circle after some way; arguments as in `walk`.

    Returns:
        [T, 2] east and north in metres, and [T] the heading in radians, counterclockwise from east.
    """
    heading = np.radians(heading_deg)
    turned = np.zeros_like(along_m) if radius_m is None else along_m / radius_m
    ahead = along_m if radius_m is None else radius_m * np.sin(turned)
    left = turned if radius_m is None else radius_m * (1.0 - np.cos(turned))
    east = start[0] + np.cos(heading) * ahead - np.sin(heading) * left
    north = start[1] + np.sin(heading) * ahead + np.cos(heading) * left
    return np.stack([east, north], axis=-1), heading + turned


def _standing_joints(phase: Float) -> Float:
    """Compute joints [T, 17, 3] in body heights: forward, left, up from the ground below the pelvis."""
    joints = _legs(phase)
    left, right = (-_sole_centre(joints, side)[:, 2] for side in SIDES)
    pelvis_up = _ROLL_RADIUS + _HANDOVER * np.logaddexp(left / _HANDOVER, right / _HANDOVER)
    joints |= _upper_body(phase)
    body = np.stack([joints[name] for name in COCO17], axis=1)
    body[..., 2] += pelvis_up[:, None]
    return body


def _legs(phase: Float) -> dict[str, Float]:
    """Compute hips, knees and ankles from the middle of the hips."""
    pelvis_yaw = _series(_PELVIS_YAW_DEG, phase)
    adduction = np.radians(_HIP_ADDUCTION_DEG)
    joints: dict[str, Float] = {}
    for side, sign, own_phase in zip(SIDES, (1.0, -1.0), (phase, phase + np.pi), strict=True):
        thigh_angle = _series(_THIGH_DEG, own_phase)
        shank_angle = thigh_angle - _series(_KNEE_DEG, own_phase)
        hip = _about_up(np.broadcast_to([0.0, sign * _HIP_HALF, 0.0], (phase.size, 3)), pelvis_yaw)
        knee = hip + _inward(_THIGH * _hanging(thigh_angle), sign * adduction)
        ankle = knee + _inward(_SHANK * _hanging(shank_angle), sign * adduction)
        joints |= {f"{side}_hip": hip, f"{side}_knee": knee, f"{side}_ankle": ankle}
    return joints


def _upper_body(phase: Float) -> dict[str, Float]:
    """Compute shoulders, arms and face from the middle of the hips; the head looks ahead."""
    lean = np.radians(_CHEST_LEAN_DEG)
    chest = _TRUNK * np.array([np.sin(lean), 0.0, np.cos(lean)])
    chest_yaw = _series(_CHEST_YAW_DEG, phase)
    joints = {"nose": np.broadcast_to(chest + _FACE["nose"], (phase.size, 3))}
    for side, sign, own_phase in zip(SIDES, (1.0, -1.0), (phase, phase + np.pi), strict=True):
        arm_angle = _series(_SHOULDER_DEG, own_phase)
        forearm_angle = arm_angle + _series(_ELBOW_DEG, own_phase)
        across = np.broadcast_to([0.0, sign * _SHOULDER_HALF, 0.0], (phase.size, 3))
        shoulder = chest + _about_up(across, chest_yaw)
        elbow = shoulder + _UPPER_ARM * _hanging(arm_angle)
        wrist = elbow + _FOREARM * _hanging(forearm_angle)
        joints |= {f"{side}_shoulder": shoulder, f"{side}_elbow": elbow, f"{side}_wrist": wrist}
        for part in ("eye", "ear"):
            in_face = np.array(_FACE[part]) * [1.0, sign, 1.0]
            joints[f"{side}_{part}"] = np.broadcast_to(chest + in_face, (phase.size, 3))
    return joints


def _sole_centre(joints: dict[str, Float], side: str) -> Float:
    """Compute the centre of the sole's arc: up the shank from the ankle."""
    knee, ankle = joints[f"{side}_knee"], joints[f"{side}_ankle"]
    return ankle + (knee - ankle) * ((_ROLL_RADIUS - _ANKLE_HEIGHT) / _SHANK)


@cache
def _pelvis_travel() -> tuple[float, NDArray[np.complex128]]:
    """Compute the phase per body height that the pelvis travels, and its sway about that (Fourier series).

    The pelvis goes forward as fast as the soles roll, each weighed by how much it carries (the
    derivative of the pelvis height by its drop). Integrated as a Fourier series: exact for a period.
    """
    n = 512
    joints = _legs(2 * np.pi * np.arange(n) / n)
    left, right = (_sole_centre(joints, side) for side in SIDES)
    left_carries = 1.0 / (1.0 + np.exp((left[:, 2] - right[:, 2]) / _HANDOVER))
    rolled = []
    for side, centre in zip(SIDES, (left, right), strict=True):
        shank_angle = np.arcsin((joints[f"{side}_ankle"] - joints[f"{side}_knee"])[:, 0] / _SHANK)
        rolled.append(-_derivative(centre[:, 0] + _ROLL_RADIUS * shank_angle))
    rate = np.fft.rfft(left_carries * rolled[0] + (1.0 - left_carries) * rolled[1])[:25] / n
    sway = np.zeros_like(rate)
    sway[1:] = rate[1:] / (1j * np.arange(1, rate.size))
    return 1.0 / float(rate[0].real), sway


def _derivative(samples: Float) -> Float:
    """Compute the derivative by phase of one evenly sampled period."""
    spectrum = np.fft.rfft(samples)
    derivative: Float = np.fft.irfft(1j * np.arange(spectrum.size) * spectrum, samples.size)
    return derivative


def _periodic(coefficients: NDArray[np.complex128], phase: Float) -> Float:
    """Evaluate a real Fourier series from its coefficients of non-negative order, without its mean."""
    orders = np.arange(1, coefficients.size)
    waves = np.exp(1j * phase[:, None] * orders)
    # Not `@`: the sums of BLAS depend on its version, and the sample flight is compared byte by byte.
    total: Float = 2.0 * np.sum(waves * coefficients[1:], axis=1).real
    return total


def _series(coefficients_deg: tuple[float, ...], phase: Float) -> Float:
    """Evaluate a series in radians that is given in degrees: mean, then cosine and sine of each harmonic."""
    angle = np.full_like(phase, coefficients_deg[0])
    pairs = zip(coefficients_deg[1::2], coefficients_deg[2::2], strict=True)
    for order, (cosine, sine) in enumerate(pairs, start=1):
        angle += cosine * np.cos(order * phase) + sine * np.sin(order * phase)
    return np.radians(angle)


def _hanging(angle: Float) -> Float:
    """Return unit vectors [T, 3] that hang down, swung forward by `angle`."""
    return np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=1)


def _inward(vectors: Float, angle: float) -> Float:
    """Tilt vectors in the sagittal plane about the forward axis: down goes right for positive angles."""
    forward, _, up = vectors.T
    return np.stack([forward, np.sin(angle) * up, np.cos(angle) * up], axis=1)


def _about_up(vectors: Float, angle: Float) -> Float:
    """Turn vectors [T, ..., 3] counterclockwise about the upward axis by [T] angles."""
    shaped = angle.reshape(angle.shape + (1,) * (vectors.ndim - 2))
    x, y, z = np.moveaxis(vectors, -1, 0)
    cosine, sine = np.cos(shaped), np.sin(shaped)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, np.broadcast_to(z, x.shape)], axis=-1)
