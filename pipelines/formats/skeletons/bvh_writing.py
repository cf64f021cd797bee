"""Writer of BVH, and the bvh export: a rig that follows the skeleton, for Blender and MotionBuilder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.formats.common.export_names import people_of
from pipelines.formats.skeletons.bvh import METRES
from pipelines.formats.skeletons.bvh_rig import Rigged, fit_rig
from pipelines.formats.skeletons.even_frames import at_even_times
from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.session.errors import DataError
from pipelines.session.records import Recording, SkeletalMotion

_IN_FILE = {"y-up": [1, 2, 0], "z-up": [0, 1, 2]}  # indices of the world's axes that are the file's x, y, z
_DECIMALS = 6  # of a degree and of the unit
_LOCKED = 1e-7  # gimbal lock: cosine of the middle angle below which the outer two share one axis


class BvhExport:
    """Writer of `<name>.bvh`, or `<name>_person<k>.bvh` for each of several people; default cm and y up.

    `bvh_rig` documents the fit of the rig and the handling of missing joints.
    """

    name = "bvh"
    title = "a rig of constant bones that follows the skeleton, for Blender"
    units = ("cm", "m", "mm", "inch")
    axes = ("y-up", "z-up")

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write every person to whom a rig can be fitted; a note gives the reason for each other one.

        Raises:
            DataError: no rig can be fitted, or the times are too scattered for a rate.
        """
        motion, files = people_of(recording, folder, ".bvh")
        even = at_even_times("bvh", motion, recording.progress)
        written, refused = [], None
        for person, path in files.items():
            try:
                rigged = fit_rig(path.name, even.motion, person)
            except DataError as error:
                refused = error
                recording.progress.note(str(error))
                continue
            write_motion(path, rigged.motion, unit=recording.unit or "cm", axes=recording.axes or "y-up")
            recording.progress.note(_made_up(path.name, rigged, len(even.motion.t_ns)))
            written.append(path)
        if refused is not None and not written:
            raise refused
        return sorted(written)


def _made_up(name: str, rigged: Rigged, frames: int) -> str:
    """Report the parts of the file that were not measured."""
    kept = len(rigged.motion.t_s)
    parts = [f"{name}: BVH has no word for missing"]
    if frames > kept:
        parts.append(f"{frames - kept} of {frames} frames before and after the hips are seen were left out")
    parts.append(f"the hips stay where they were in {rigged.without_hips} of {kept} frames")
    parts.append(f"{rigged.turns_held} of {rigged.turns} turns of bones are held")
    return "; ".join(parts)


def write_motion(path: Path, motion: SkeletalMotion, *, unit: str, axes: str) -> None:
    """Write a motion at the constant rate of its first and last time; `bvh.read_motion` reads it back.

    The hierarchy of bones comes first, then one line of channels per frame; see module `bvh` for the layout.

    The root has position and rotation channels, every other bone rotations in the order Z, X, Y (Rz Rx Ry).
    Angles are unwrapped (no jumps of 360 degrees). A bone without children ends in a site of length 0.
    """
    order = _IN_FILE[axes]
    scale = 1 / METRES[unit]
    frames = len(motion.t_s)
    step_s = float(motion.t_s[-1] - motion.t_s[0]) / (frames - 1) if frames > 1 else 1.0
    children: dict[int, list[int]] = {k: [] for k in range(-1, len(motion.bones))}
    for bone, parent in enumerate(motion.parent):
        children[parent].append(bone)
    lines, written = ["HIERARCHY"], []

    def write_bone(bone: int, depth: int) -> None:
        pad = "\t" * depth
        is_root = motion.parent[bone] < 0
        offset = np.zeros(3) if is_root else motion.offset[bone]
        position = "Xposition Yposition Zposition " if is_root else ""
        lines.extend(
            [
                f"{pad}{'ROOT' if is_root else 'JOINT'} {motion.bones[bone]}",
                f"{pad}{{",
                f"{pad}\tOFFSET {_numbers(offset[order] * scale)}",
                f"{pad}\tCHANNELS {6 if is_root else 3} {position}Zrotation Xrotation Yrotation",
            ]
        )
        written.append(bone)
        for child in children[bone]:
            write_bone(child, depth + 1)
        if not children[bone]:
            end = motion.end.get(bone, np.zeros(3))
            lines.extend(
                [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {_numbers(end[order] * scale)}"]
            )
            lines.append(f"{pad}\t}}")
        lines.append(f"{pad}}}")

    (root,) = children[-1]
    write_bone(root, 0)
    angles = euler_zxy_deg(motion.rotation[:, written][..., [*order, 3]])
    channels = np.concatenate([motion.root[:, order] * scale, angles.reshape(frames, -1)], axis=1)
    lines.extend(["MOTION", f"Frames: {frames}", f"Frame Time: {step_s:.9f}"])
    lines.extend(_numbers(row) for row in channels)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def euler_zxy_deg(quaternion_xyzw: Float) -> Float:
    """Compute angles (z, x, y) in degrees of the rotation Rz Rx Ry, [T, B, 3]; continuous over time.

    From the product's entries: m21 = sin x, m01 = -sin z cos x, m11 = cos z cos x, m20 = -cos x sin y,
    m22 = cos x cos y. If x is +-90 degrees, z and y turn about the same axis, and y is set to 0.
    """
    m = matrix_from_quaternion(quaternion_xyzw)
    x = np.arctan2(m[..., 2, 1], np.hypot(m[..., 2, 0], m[..., 2, 2]))
    locked = np.hypot(m[..., 2, 0], m[..., 2, 2]) < _LOCKED
    z = np.where(locked, np.arctan2(m[..., 1, 0], m[..., 0, 0]), np.arctan2(-m[..., 0, 1], m[..., 1, 1]))
    y = np.where(locked, 0.0, np.arctan2(-m[..., 2, 0], m[..., 2, 2]))
    return np.degrees(np.unwrap(np.stack([z, x, y], axis=-1), axis=0))


def _numbers(values: Float) -> str:
    # Adding 0 turns -0 into 0.
    return " ".join(f"{value:.{_DECIMALS}f}" for value in (np.round(values, _DECIMALS) + 0.0).tolist())


EXPORT = BvhExport()
