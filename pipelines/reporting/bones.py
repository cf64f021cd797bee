"""Bones whose lengths are reported: they are rigid in truth, so their spread shows errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.metrics import bone_lengths
from pipelines.reporting.motion import Motion

_LIMBS = {
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "trunk side": ("shoulder", "hip"),
    "thigh": ("hip", "knee"),
    "shank": ("knee", "ankle"),
}
_WATCHED = (
    *(
        (name, side, f"{side}_{start}", f"{side}_{end}")
        for name, (start, end) in _LIMBS.items()
        for side in ("left", "right")
    ),
    ("shoulders", "", "left_shoulder", "right_shoulder"),
    ("hips", "", "left_hip", "right_hip"),
)


def side_of(*joints: str) -> str:
    """Return `left` or `right` if all joints lie on that side of the body, else an empty word."""
    sides = {joint.partition("_")[0] for joint in joints}
    return side if len(sides) == 1 and (side := sides.pop()) in {"left", "right"} else ""


@dataclass(frozen=True)
class Bone:
    """The length of one bone over a recording, in metres."""

    name: str
    side: str  # left, right, or empty for a bone across
    median_m: float
    low_m: float  # 10th percentile
    high_m: float  # 90th percentile
    spread: float  # half the central 68 % of the lengths, relative to the median: 0 for a rigid bone


def watched_bones(motion: Motion) -> list[Bone]:
    """Measure the bones with both ends measured at some time, limb by limb, left before right."""
    there = [bone for bone in _WATCHED if set(bone[2:]) <= set(motion.joints)]
    lengths = bone_lengths(
        motion.measured_position, motion.joints, [(start, end) for *_, start, end in there]
    )
    bones = []
    for b, (name, side, *_) in enumerate(there):
        measured = lengths[..., b][np.isfinite(lengths[..., b])]
        if measured.size:
            low, p16, median, p84, high = (float(p) for p in np.percentile(measured, [10, 16, 50, 84, 90]))
            spread = (p84 - p16) / 2 / median if median > 0 else 0.0
            bones.append(Bone(name, side, median, low, high, spread))
    return bones
