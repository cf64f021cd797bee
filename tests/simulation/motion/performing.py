"""Simulated performances of scripts, and measures of them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import conjugate, multiply
from pipelines.geometry.rig import BONE, BONES, SIDES, BodyMotion, Rig, joint_centres, sole_points
from pipelines.simulation.motion_script import perform
from pipelines.simulation.scenario import Step


def average_rig(height_m: float = 1.75) -> Rig:
    """Return the rig of a person of average proportions.

    Segment lengths are fractions of the height after Drillis & Contini (in Winter, "Biomechanics and
    Motor Control of Human Movement", 4th ed. 2009, chapter 4), the trunk in three equal parts.
    """
    h = height_m
    offset = np.zeros((len(BONES), 3))
    offset[BONE["pelvis"]] = (0.0, 0.0, 0.53 * h)
    trunk = 0.288 * h / 3
    for name, up in (
        ("spine", trunk),
        ("back", trunk),
        ("chest", trunk),
        ("neck", 0.03 * h),
        ("head", 0.052 * h),
    ):
        offset[BONE[name]] = (0.0, 0.0, up)
    for sign, side in zip((1.0, -1.0), SIDES, strict=True):
        hanging = {
            "clavicle": (0.0, sign * 0.02 * h, 0.0),
            "upper_arm": (0.0, sign * 0.1095 * h, 0.0),
            "forearm": (0.0, 0.0, -0.186 * h),
            "hand": (0.0, 0.0, -0.146 * h),
            "thigh": (0.0, sign * 0.0525 * h, 0.0),
            "shank": (0.0, 0.0, -0.245 * h),
            "foot": (0.0, 0.0, -0.246 * h),
            "toes": (0.09 * h, 0.0, -0.026 * h),
        }
        for bone, place in hanging.items():
            offset[BONE[f"{side}_{bone}"]] = place
    ankle = 0.039 * h
    sole = np.array([[-0.033 * h, 0.0, -ankle], [0.085 * h, 0.0, -ankle], [0.119 * h, 0.0, -ankle]])
    return Rig(offset, np.stack([sole, sole]))


RIG = average_rig()


def flat(places: Float) -> Float:
    return np.zeros(len(places))


def slope(places: Float) -> Float:
    rise: Float = 0.2 * places[:, 0] - 0.1 * places[:, 1]
    return rise


def mound(places: Float) -> Float:
    """Return the height of a mound 1.2 m high: at most 0.6 x 1.2 / 2 m = 20 deg steep."""
    x, y = places.T
    height: Float = 1.2 * np.exp(-((x - 6.0) ** 2 / 8.0 + y**2 / 12.5))
    return height


def performed(
    *steps: dict[str, Any],
    seconds: float,
    step_s: float = 0.01,
    ground: Callable[[Float], Float] = flat,
    heading_deg: float = 0.0,
    start: Sequence[float] = (0.0, 0.0),
    repeat: bool = False,
    seed: int = 1,
    rig: Rig = RIG,
) -> BodyMotion:
    return perform(
        [Step.model_validate(step) for step in steps],
        rig,
        np.arange(0.0, seconds, step_s),
        ground=ground,
        start=np.array(start, dtype=np.float64),
        heading_deg=heading_deg,
        repeat=repeat,
        seed=seed,
    )


def bent_deg(motion: BodyMotion, above: str, below: str) -> Float:
    """Measure the turn [T] of a bone forward about the axis to the left, relative to its parent."""
    relative = multiply(conjugate(motion.rotation[:, BONE[above]]), motion.rotation[:, BONE[below]])
    angle = np.degrees(2 * np.arctan2(relative[:, 1], relative[:, 3]))
    wrapped: Float = (angle + 180.0) % 360.0 - 180.0
    return wrapped


def leg_angles_deg(motion: BodyMotion, side: int, rig: Rig = RIG) -> dict[str, Float]:
    """Measure flexion of hip and knee, and dorsiflexion of the ankle, [T], of a person who walks east.

    They follow from the places of joints, heel and ball in the vertical plane of the way; the hip is relative
    to upright.
    """
    centres, soles = joint_centres(rig, motion), sole_points(rig, motion)[:, side]
    hip, knee, ankle = (centres[:, BONE[f"{SIDES[side]}_{bone}"]] for bone in ("thigh", "shank", "foot"))
    sole = soles[:, 1] - soles[:, 0]
    return angles_of_leg_deg(hip, knee, ankle) | {
        "ankle": np.degrees(np.arctan2(sole[:, 2], sole[:, 0])) - _forward_deg(ankle - knee)
    }


def angles_of_leg_deg(hip: Float, knee: Float, ankle: Float) -> dict[str, Float]:
    """Compute flexion [T] of hip and knee from joints [T, 3] m of a person who walks east."""
    thigh = _forward_deg(knee - hip)
    return {"hip": thigh, "knee": thigh - _forward_deg(ankle - knee)}


def _forward_deg(down: Float) -> Float:
    """Compute the angle [T] by which vectors [T, 3] that point down are turned forward."""
    turned: Float = np.degrees(np.arctan2(down[:, 0], -down[:, 2]))
    return turned


def clearance_m(motion: BodyMotion, ground: Callable[[Float], Float] = flat, rig: Rig = RIG) -> Float:
    """Measure the heights [T, 2, 3] of heel, ball and tip of both feet above the ground."""
    points = sole_points(rig, motion)
    under = ground(points[..., :2].reshape(-1, 2)).reshape(points.shape[:-1])
    height: Float = points[..., 2] - under
    return height


def slid_m(motion: BodyMotion, touching_m: float, rig: Rig = RIG) -> list[float]:
    """Measure the slip of each contact over the ground: in every frame that of the slowest contact point."""
    points = sole_points(rig, motion)
    touches = clearance_m(motion, rig=rig) < touching_m
    slid = []
    for foot in (0, 1):
        both = touches[1:, foot] & touches[:-1, foot]
        moved = np.sqrt(np.sum(np.diff(points[:, foot, :, :2], axis=0) ** 2, axis=2))
        least = np.where(both, moved, np.inf).min(axis=1)
        on = np.isfinite(least)
        runs = np.split(np.where(on, least, 0.0), np.flatnonzero(np.diff(on.astype(int))) + 1)
        slid += [float(run.sum()) for run in runs]
    return slid
