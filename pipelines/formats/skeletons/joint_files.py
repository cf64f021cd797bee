"""Files of joints: their unit and axes, the names of their markers, and a constant rate."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.formats.common.rows import bounding_box, describe_times
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import interpolate_points
from pipelines.session.errors import DataError
from pipelines.session.progress import Progress
from pipelines.session.records import JointMotion
from pipelines.session.skeletons import SKELETONS

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
AXES = ("z-up", "y-up")
_KEPT_NS = 500_000  # a sample this near to its frame keeps its position: 1 mm of a hand at 2 m/s
_LONGEST_STEP = 1.5  # in frame steps: nothing is interpolated between times further apart
_MOST_FRAMES = 10_000_000
_MOST_EMPTY = 100  # frames per sample
_UNITS = {
    "m": "m",
    "meters": "m",
    "metres": "m",
    "cm": "cm",
    "centimeters": "cm",
    "mm": "mm",
    "millimeters": "mm",
}


def to_metres_z_up(source: Path, position: Float, unit: str, axes: str) -> Float:
    """Convert positions [..., 3]; a point with a coordinate that is not finite is missing (all NaN).

    y-up files (OpenSim, TRC) turn into world = (z, x, y), a rotation: x forward becomes y, y up becomes z.
    """
    if unit not in METRES:
        raise DataError(
            source,
            f"the unit {unit!r} is none of {', '.join(METRES)}",
            "state `unit: mm` or alike",
            code="unit-unknown",
        )
    if axes not in AXES:
        raise DataError(
            source,
            f"the axes {axes!r} are none of {', '.join(AXES)}",
            "state `axes: y-up` or z-up",
            code="axes-unknown",
        )
    seen = np.isfinite(position).all(axis=-1, keepdims=True)
    turned = position[..., [2, 0, 1]] if axes == "y-up" else position
    return np.where(seen, turned * METRES[unit], np.nan)


def to_y_up(position: Float) -> Float:
    """Convert world positions [..., 3] to OpenSim's axes, y up: (y, z, x) of the world."""
    return position[..., [1, 2, 0]]


def joint_columns(motion: JointMotion) -> dict[str, object]:
    """Return t_ns, person, joint, x, y, z as columns of a long table, with a row for each of [T, P, J]."""
    times, people, joints = motion.position.shape[:3]
    t_ns, person, joint = np.meshgrid(motion.t_ns, np.arange(people), np.arange(joints), indexing="ij")
    return {
        "t_ns": t_ns.ravel(),
        "person": person.ravel(),
        "joint": np.array(motion.joints, dtype=object)[joint.ravel()],
        **dict(zip("xyz", motion.position.reshape(times * people * joints, 3).T, strict=True)),
    }


@dataclass(frozen=True)
class EvenMotion:
    """Motion with a constant time step."""

    motion: JointMotion
    rate_hz: float
    empty: int  # frames between the samples without any measurement


def at_even_times(source: str, motion: JointMotion, progress: Progress) -> EvenMotion:
    """Assign a motion to frames at its usual step, from its first time (there must be one) to its last.

    Every sample gets a frame, and a pause becomes empty frames. Samples within half a millisecond of their
    frames stay as they are. If any is further off, all positions are interpolated linearly between neighbours
    (never across a missing one), and the covariances are those of the nearest sample. Both are noted, unless
    the stamps differ by rounding alone.
    """
    t_ns = motion.t_ns
    if len(t_ns) == 1:
        return EvenMotion(motion, 1.0, 0)
    steps = np.diff(t_ns)
    # Steps are counted, so that neither a long pause nor the rounding of single stamps changes the rate.
    index = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / np.median(steps)), 1))]).astype(
        np.int64
    )
    frames = int(index[-1]) + 1
    if frames > min(_MOST_FRAMES, _MOST_EMPTY * len(t_ns)):
        raise DataError(
            source,
            f"{len(t_ns)} times are scattered over {frames} frames",
            "reconstruct it at a --rate, or export csv",
        )
    step_ns = int(t_ns[-1] - t_ns[0]) / (frames - 1)
    even_ns = t_ns[0] + np.rint(np.arange(frames) * step_ns).astype(np.int64)
    off_ns = int(np.abs(t_ns - even_ns[index]).max())
    if off_ns <= _KEPT_NS:
        if off_ns > 1000:
            progress.note(f"{source}: times are up to {off_ns / 1e6:.3f} ms off a constant rate; kept")
        even = _spread(motion, even_ns, index)
    else:
        progress.note(
            f"{source}: times are up to {off_ns / 1e6:.3f} ms off a constant rate; "
            f"positions were interpolated to {1e9 / step_ns:.6g} Hz"
        )
        even = _interpolated(motion, even_ns, round(_LONGEST_STEP * step_ns))
    return EvenMotion(even, 1e9 / step_ns, frames - len(t_ns))


def _spread(motion: JointMotion, even_ns: Int64, index: Int64) -> JointMotion:
    """Put the samples as they are at their frames; NaN in between."""
    row = np.full(len(even_ns), -1)
    row[index] = np.arange(len(index))
    return _taken(motion, row, replace(motion, t_ns=even_ns, position=_rows(motion.position, row)))


def _interpolated(motion: JointMotion, even_ns: Int64, longest_ns: int) -> JointMotion:
    position = interpolate_points(motion.t_ns, motion.position, even_ns, max_gap_ns=longest_ns)
    after = np.clip(np.searchsorted(motion.t_ns, even_ns), 1, len(motion.t_ns) - 1)
    is_before = even_ns - motion.t_ns[after - 1] <= motion.t_ns[after] - even_ns
    return _taken(motion, after - is_before, replace(motion, t_ns=even_ns, position=position))


def _taken(motion: JointMotion, row: Int64, even: JointMotion) -> JointMotion:
    """Return the new positions with the covariances of these rows, where there is a position."""
    if motion.covariance is None:
        return replace(even, status=None, reprojection_px=None, views=None)
    missing = np.isnan(even.position).any(axis=-1, keepdims=True)
    covariance = np.where(missing, np.nan, _rows(motion.covariance, row))
    return replace(even, covariance=covariance, status=None, reprojection_px=None, views=None)


def _rows(values: Float, row: Int64) -> Float:
    taken = values[np.maximum(row, 0)]
    taken[row < 0] = np.nan
    return taken


def describe_motion(motion: JointMotion) -> dict[str, object]:
    """Return joints, people, times, share of missing joints, bounding box of the positions."""
    return {
        "rows": len(motion.t_ns),
        "people": motion.position.shape[1],
        "joints": list(motion.joints),
        **describe_times(motion.t_ns),
        "missing_share": round(float(np.isnan(motion.position).any(axis=-1).mean()), 4),
        **bounding_box(motion.position.reshape(-1, 3)),
    }


def metric_unit(stated: str) -> str:
    """Return m, cm or mm for a unit's name in files; any other name as it is."""
    return _UNITS.get(stated.lower(), stated)


def marker_name(joint: str) -> str:
    """Return Pose2Sim's and OpenSim's name of our joint: right_big_toe is RBigToe, nose is Nose.

    Names that are in no skeleton of ours stay as they are.
    """
    return _MARKERS.get(joint, joint)


def _camel_case(joint: str) -> str:
    words = joint.split("_")
    if words[0] in {"left", "right"}:
        words[0] = words[0][0]
    return "".join(word[0].upper() + word[1:] for word in words)


_MARKERS = {joint: _camel_case(joint) for skeleton in SKELETONS.values() for joint in skeleton.joints}


_JOINTS = {
    **{marker: joint for joint, marker in _MARKERS.items()},
    **{joint.title().replace("_", ""): joint for joint in _MARKERS},  # RightBigToe
    "CHip": "hip",
    "MidHip": "hip",
    "HipCenter": "hip",
    "LFootIndex": "left_big_toe",
    "RFootIndex": "right_big_toe",
}


def joint_names(markers: tuple[str, ...]) -> tuple[str, ...]:
    """Return our names of known markers; if two markers mean one joint, only the first gets its name."""
    names: dict[str, None] = {}
    given = []
    for marker in markers:
        joint = _JOINTS.get(marker, marker)
        given.append(marker if joint in names else joint)
        names[given[-1]] = None
    return tuple(given)


# Bones that begin at a joint, without side and separators: Biovision's, Acclaim's, Mixamo's, Blender's names.
_BONES = {
    "hip": ("upleg", "upperleg", "thigh", "femur"),
    "knee": ("leg", "lowerleg", "shin", "calf", "tibia"),
    "ankle": ("foot", "ankle"),
    "shoulder": ("arm", "upperarm", "humerus"),
    "elbow": ("forearm", "lowerarm", "radius"),
    "wrist": ("wrist", "hand"),
}
_MIDDLE_BONES = {"hip": ("hips", "pelvis", "root"), "neck": ("neck", "lowerneck")}


def bone_joints(bones: tuple[str, ...]) -> tuple[str, ...]:
    """Name the joints at which bones begin: ours where the bone is known, else the bone's own name.

    Acclaim's bone `head` begins at the base of the skull: it must not pass for our joint `head`, its top.
    """
    plain = {bone: re.sub(r"[^a-z]", "", bone.rsplit(":", 1)[-1].lower()) for bone in bones}
    named: dict[str, str] = {}
    for side in ("left", "right"):
        for joint, variants in _BONES.items():
            for variant in variants:
                ways = {f"{side}{variant}", f"{side[0]}{variant}", f"{variant}{side[0]}", f"{variant}{side}"}
                found = next((bone for bone in bones if plain[bone] in ways and bone not in named), None)
                if found:
                    named[found] = f"{side}_{joint}"
                    break
    for joint, variants in _MIDDLE_BONES.items():
        found = next((bone for variant in variants for bone in bones if plain[bone] == variant), None)
        if found:
            named[found] = joint
    if any(name.endswith("femur") for name in plain.values()):
        named |= {bone: "head_base" for bone in bones if bone == "head"}
    return tuple(named.get(bone, bone) for bone in bones)
