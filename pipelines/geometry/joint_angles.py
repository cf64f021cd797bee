"""Joint angles of a person from the centres of joints, with standard deviations.

Names and axes follow the International Society of Biomechanics: hip, ankle and spine Wu et al. 2002 (Journal
of Biomechanics 35:543), shoulder and elbow Wu et al. 2005 (38:981), the knee and the order of flexion,
adduction and rotation Grood and Suntay 1983 (Journal of Biomechanical Engineering 105:136). In every body
frame x is forward, y up and z to the person's right; left limbs are mirrored. Signs are those of `ANGLES`.

Centres of joints show less than the bony landmarks of these papers. Two hips do not show how the pelvis
tilts: flexion of the hip is against the line from the middle of the hips to that of the shoulders. The axis
of a hinge is the normal of the plane of its two segments, unknown while the limb is straight; next to
straight, the knee's is drawn towards the line of the hips, so that noise does not bend it. The elbow's
flexion cannot be negative. Pronation of the forearm is never shown.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS

_SIDES = ("left", "right")

_OF_A_SIDE = {
    "hip_flexion": "thigh forward of the trunk's line",
    "hip_adduction": "thigh towards the other leg",
    "hip_rotation": "front of the thigh towards the other leg (internal)",
    "knee_flexion": "shank backwards; 0 is straight",
    "ankle_dorsiflexion": "toes towards the shin; 0 is heel to toe at right angles to the shank",
    "shoulder_plane": "plane of elevation: 0 to the side (abduction), 90 forward (flexion)",
    "shoulder_elevation": "upper arm away from the trunk's line; 0 hangs (ISB states it negative)",
    "shoulder_rotation": "upper arm about its axis, internal",
    "elbow_flexion": "forearm towards the upper arm; 0 is straight, never negative",
    "forearm_pronation": "never determined by centres of joints",
}
_OF_THE_TRUNK = {
    "trunk_flexion": "shoulders forward of the hips, against the vertical (ISB states it negative)",
    "trunk_bending": "shoulders to the right of the hips",
    "trunk_rotation": "shoulders turned to the left against the hips",
}
ANGLES: dict[str, str] = {
    **_OF_THE_TRUNK,
    **{f"{side}_{name}": text for name, text in _OF_A_SIDE.items() for side in _SIDES},
}
"""Every angle and what its positive sign means."""

UNDETERMINED = "undetermined"
"""Status of an angle that its joints do not determine in this pose."""
ABSENT = "no_such_joint"
"""Status of an angle that rests on a joint which the skeleton does not have."""

ANGLE_STATUS = (*STATUS, UNDETERMINED, ABSENT)
"""The words of a status: those of joints, and two of angles."""

_OK, _FILLED = STATUS.index("ok"), STATUS.index("filled")
# A hinge bent by less does not show its axis: 1 cm of 0.4 m sin(20 deg) is already 4 deg.
_MIN_BEND_RAD = np.radians(20.0)
# An arm raised by less does not show its plane.
_MIN_ELEVATION_RAD = np.radians(20.0)
# At this bend a knee's own plane and the line of the hips weigh the same.
_EQUAL_WEIGHT_SINE = np.sin(np.radians(15.0))
# The line of the hips has no heading if less of its length is level.
_MIN_LEVEL_SHARE = 0.3
# Finite differences have a relative error of about this step over a segment's length.
_STEP_M = 1e-6
# A place on Earth that nobody knows has this variance.
_UNKNOWN_M2 = 1e12
# A processor's cache holds this many person-times.
_BLOCK = 2048


@dataclass(frozen=True)
class JointAngles:
    """Angles of P people at T times, in the order of `ANGLES`."""

    value_deg: Float  # [T, P, A], NaN unless `status` is ok or filled
    sigma_deg: Float  # [T, P, A] standard deviation, NaN without covariances or with infinite ones
    status: NDArray[np.int8]  # [T, P, A] index of `ANGLE_STATUS`: that of the worst joint it rests on


def joint_angles(
    joints: Sequence[str],
    position: Float,
    covariance: Float | None = None,
    status: NDArray[np.int8] | None = None,
) -> JointAngles:
    """Compute every angle of `position` [T, P, J, 3] m, z up, with its standard deviation and its status.

    The standard deviation is of first order in `covariance` [T, P, J, 6] m^2 (upper triangles; None if
    unknown), independent between joints; derivatives are differences over a micrometre. `status` are indices
    of `triangulation.STATUS`; by default ok where there is a position, else not_detected.
    """
    times, people = position.shape[:2]
    if status is None:
        status = np.where(np.isfinite(position).all(axis=-1), _OK, STATUS.index("not_detected"))
    count, shape = times * people, (times, people, len(ANGLES))
    value, sigma = np.full((count, len(ANGLES)), np.nan), np.full((count, len(ANGLES)), np.nan)
    words = np.full((count, len(ANGLES)), ANGLE_STATUS.index(ABSENT), np.int8)
    column = {name: index for index, name in enumerate(ANGLES)}
    flat = position.reshape(count, len(joints), 3)
    spread = None if covariance is None else covariance.reshape(count, len(joints), 6)
    statuses = status.reshape(count, len(joints))
    groups = [group for group in _groups() if set(group.joints).issubset(joints)]
    for start in range(0, count, _BLOCK):
        part = slice(start, start + _BLOCK)
        points = np.ascontiguousarray(flat[part].transpose(1, 2, 0))
        spreads = None
        if spread is not None:  # NaN in place of those that say nothing, which may be infinite
            known = np.where(np.abs(spread[part]) < _UNKNOWN_M2, spread[part], np.nan)
            spreads = np.ascontiguousarray(known.transpose(1, 2, 0))
        for group in groups:
            of = [joints.index(name) for name in group.joints]
            to = [column[name] for name in group.angles]
            own = points[of]
            found = group.compute(own)
            value[part, to] = np.degrees(found.T)
            if spreads is not None:
                sigma[part, to] = np.degrees(_sigma(group, own, found, spreads[of]).T)
            worst = _worst(statuses[part][:, of])
            unknown = np.isnan(found.T) & ((worst == _OK) | (worst == _FILLED))
            words[part, to] = np.where(unknown, ANGLE_STATUS.index(UNDETERMINED), worst)
    return JointAngles(value.reshape(shape), sigma.reshape(shape), words.reshape(shape))


def _worst(status: NDArray[np.int8]) -> NDArray[np.int8]:
    """Return [N, 1] for [N, K]: the first status that is not measured, else filled if any is, else ok."""
    lost = (status != _OK) & (status != _FILLED)
    first = np.where(lost.any(axis=1), lost.argmax(axis=1), (status == _FILLED).argmax(axis=1))
    return np.take_along_axis(status, first[:, None], axis=1)


@dataclass(frozen=True)
class _Group:
    angles: tuple[str, ...]  # A of them
    joints: tuple[str, ...]  # K of them
    compute: Callable[[Float], Float]  # from points [K, 3, N] m to angles [A, N] rad


def _sigma(group: _Group, points: Float, found: Float, covariance: Float) -> Float:
    """Propagate covariances [K, 6, N] of points [K, 3, N] to standard deviations [A, N] rad of angles."""
    variance = np.zeros_like(found)
    for joint in range(len(points)):
        slope = []
        for axis in range(3):
            before = points[joint, axis].copy()
            points[joint, axis] += _STEP_M
            change = group.compute(points) - found
            points[joint, axis] = before
            # An angle may step over the end of its range.
            slope.append((change - 2 * np.pi * np.rint(change / (2 * np.pi))) / _STEP_M)
        x, y, z = slope
        xx, xy, xz, yy, yz, zz = covariance[joint]
        variance += x * (xx * x + 2 * xy * y + 2 * xz * z) + y * (yy * y + 2 * yz * z) + zz * z * z
    return np.sqrt(np.maximum(variance, 0.0))


_TRUNK = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")


def _groups() -> list[_Group]:
    groups = [_Group(tuple(_OF_THE_TRUNK), _TRUNK, _trunk)]
    for side, sign in zip(_SIDES, (-1.0, 1.0), strict=True):
        knee, ankle, heel, toe, shoulder, elbow, wrist = (
            f"{side}_{joint}" for joint in ("knee", "ankle", "heel", "big_toe", "shoulder", "elbow", "wrist")
        )

        def names(*angles: str, side: str = side) -> tuple[str, ...]:
            return tuple(f"{side}_{angle}" for angle in angles)

        def mirrored(
            function: Callable[[Float, float], Float], sign: float = sign
        ) -> Callable[[Float], Float]:
            return lambda points: function(points, sign)

        groups += [
            _Group(names("hip_flexion", "hip_adduction"), (*_TRUNK, knee), mirrored(_hip)),
            _Group(names("hip_rotation"), (*_TRUNK, knee, ankle), mirrored(_hip_rotation)),
            _Group(names("knee_flexion"), ("left_hip", "right_hip", knee, ankle), mirrored(_knee)),
            _Group(names("ankle_dorsiflexion"), (knee, ankle, heel, toe), _ankle),
            _Group(names("shoulder_plane", "shoulder_elevation"), (*_TRUNK, elbow), mirrored(_shoulder)),
            _Group(names("shoulder_rotation"), (*_TRUNK, elbow, wrist), mirrored(_shoulder_rotation)),
            _Group(names("elbow_flexion"), (shoulder, elbow, wrist), _elbow),
            _Group(
                names("forearm_pronation"), (elbow, wrist), lambda points: np.full_like(points[0, :1], np.nan)
            ),
        ]
    return groups


def _trunk(points: Float) -> Float:
    """Compute flexion, bending and rotation of the trunk from hips and shoulders."""
    hips, shoulders = points[1] - points[0], points[3] - points[2]
    up = _unit(points[2] + points[3] - points[0] - points[1])
    level = np.hypot(hips[0], hips[1])
    with np.errstate(invalid="ignore"):
        known = level > _MIN_LEVEL_SHARE * np.sqrt(_dot(hips, hips))
    right = np.stack([hips[0] / level, hips[1] / level, np.zeros_like(level)])
    forward = np.stack([-right[1], right[0], right[2]])  # the vertical times the right
    t_x, t_y, t_z = _dot(up, forward), up[2], _dot(up, right)
    z = _unit(_across(shoulders, up))
    x = _cross(up, z)
    rotation = np.arctan2(-_dot(x, right), _dot(z, right))
    found = np.stack([np.arctan2(t_x, t_y), np.arctan2(t_z, np.hypot(t_x, t_y)), rotation])
    return np.where(known, found, np.nan)


def _pelvis(points: Float) -> tuple[Float, Float, Float]:
    """Return forward, up and right of the pelvis: right along the hips, up along the trunk's line."""
    right = _unit(points[1] - points[0])
    up = _unit(_across(points[2] + points[3] - points[0] - points[1], right))
    return _cross(up, right), up, right


def _thorax(points: Float) -> tuple[Float, Float, Float]:
    """Return forward, up and right of the thorax: up along the trunk's line, right along the shoulders."""
    up = _unit(points[2] + points[3] - points[0] - points[1])
    right = _unit(_across(points[3] - points[2], up))
    return _cross(up, right), up, right


def _in(frame: tuple[Float, Float, Float], vector: Float, side: float) -> Float:
    """Express a vector [3, N] in a frame, mirrored for the left side."""
    forward, up, right = frame
    return np.stack([_dot(vector, forward), _dot(vector, up), side * _dot(vector, right)])


def _hip(points: Float, side: float) -> Float:
    """Compute flexion and adduction from hips, shoulders and the knee."""
    x, y, z = _in(_pelvis(points), points[4] - points[0 if side < 0 else 1], side)
    return np.stack([np.arctan2(x, -y), np.arctan2(-z, np.hypot(x, y))])


def _hip_rotation(points: Float, side: float) -> Float:
    """Compute the internal rotation from hips, shoulders, knee and ankle."""
    frame = _pelvis(points)
    thigh = _in(frame, points[4] - points[0 if side < 0 else 1], side)
    shank = _in(frame, points[5] - points[4], side)
    up = -_unit(thigh)
    x = -_unit(_across(shank, up))
    z = _cross(x, up)
    found = np.arctan2(-x[2], z[2])
    return np.where(_bend(thigh, shank) > _MIN_BEND_RAD, found, np.nan)[None]


def _knee(points: Float, side: float) -> Float:
    """Compute the flexion about the normal of the leg's plane; next to straight, about the hips' line."""
    thigh, shank = _unit(points[2] - points[0 if side < 0 else 1]), _unit(points[3] - points[2])
    normal = _cross(shank, thigh)  # to the right, as long as the sine of the bend
    lateral = _unit(_across(points[1] - points[0], thigh))
    backwards = _dot(thigh, shank) < 0  # beyond a right angle the plane is sure
    bend = np.where(backwards, 1.0, np.sqrt(_dot(normal, normal)))
    axis = _unit(bend * normal + _EQUAL_WEIGHT_SINE**2 * np.where(backwards, 0.0, 1.0) * lateral)
    return np.arctan2(_dot(normal, axis), _dot(thigh, shank))[None]


def _ankle(points: Float) -> Float:
    """Compute the dorsiflexion from knee, ankle, heel and toe."""
    shank, foot = points[0] - points[1], points[3] - points[2]
    return (np.pi / 2 - _bend(shank, foot))[None]


def _shoulder(points: Float, side: float) -> Float:
    """Compute plane of elevation and elevation from hips, shoulders and the elbow."""
    x, y, z = _in(_thorax(points), points[4] - points[2 if side < 0 else 3], side)
    elevation = np.arctan2(np.hypot(x, z), -y)
    return np.stack([np.where(_is_raised(elevation), np.arctan2(x, z), np.nan), elevation])


def _shoulder_rotation(points: Float, side: float) -> Float:
    """Compute the internal rotation, the last of the angles about y, x and y."""
    frame = _thorax(points)
    arm = _in(frame, points[4] - points[2 if side < 0 else 3], side)
    forearm = _in(frame, points[5] - points[4], side)
    up = -_unit(arm)
    x = _unit(_across(forearm, up))
    z = _cross(x, up)
    elevation = np.arctan2(np.hypot(arm[0], arm[2]), -arm[1])
    known = _is_raised(elevation) & (_bend(arm, forearm) > _MIN_BEND_RAD)
    return np.where(known, np.arctan2(-x[1], z[1]), np.nan)[None]


def _is_raised(elevation: Float) -> NDArray[np.bool_]:
    """Test if the upper arm is away from both poles, where it has no plane."""
    return np.asarray((elevation > _MIN_ELEVATION_RAD) & (elevation < np.pi - _MIN_ELEVATION_RAD))


def _elbow(points: Float) -> Float:
    """Compute the flexion from shoulder, elbow and wrist."""
    return _bend(points[1] - points[0], points[2] - points[1])[None]


def _dot(one: Float, other: Float) -> Float:
    product: Float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product


def _cross(one: Float, other: Float) -> Float:
    return np.cross(one, other, axis=0)


def _unit(vector: Float) -> Float:
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled: Float = vector / np.sqrt(_dot(vector, vector))
    return scaled


def _across(vector: Float, axis: Float) -> Float:
    """Return the part of a vector that is perpendicular to a unit axis."""
    return vector - _dot(vector, axis) * axis


def _bend(one: Float, other: Float) -> Float:
    """Return the angle between two vectors, 0 to pi."""
    across = _cross(one, other)
    return np.arctan2(np.sqrt(_dot(across, across)), _dot(one, other))
