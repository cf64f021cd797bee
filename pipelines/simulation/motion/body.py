"""Bones at every moment of a plan: pelvis, trunk, legs and arms."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import multiply, rotate
from pipelines.simulation.motion import gait
from pipelines.simulation.motion.legs import (
    Foot,
    foot_over_time,
    leg_rotations,
    pelvis_height,
    sole_of,
    two_bones,
)
from pipelines.simulation.motion.plan import Keys, Plan
from pipelines.simulation.rig import BONE, BONES, SIDES, BodyMotion, Rig, about, partly

Heights = Callable[[Float], Float]

_WALKING_SOFTNESS_M, _RUNNING_SOFTNESS_M = 0.006, 0.026
_SCRAPES_M = 0.02  # a kicking foot that comes as near to the ground is lifted
# The wanted height of an upright pelvis is more than the legs allow, by this much.
_STANDING_HEADROOM_M, _WALKING_HEADROOM_M = 0.015, 0.004


@dataclass(frozen=True)
class Style:
    """Movement habits that differ from one person to the next."""

    sway_m: float
    sway_phase: tuple[float, float, float]  # rad
    arm_share: float
    breath_hz: float


def bodies(
    rig: Rig, plan: Plan, style: Style, t_s: Float, start: Float, heading: float, ground: Heights
) -> BodyMotion:
    """Pose all bones.

    Args:
        t_s: [T]
        start: [2] m, the place where the plan began.
        heading: rad, at the start of the plan.
        ground: heights of places [N, 2].
    """
    keys = plan.keys
    place, yaw = plan.body_at(t_s, start, heading)
    run = keys.at("running", t_s)
    speed = np.maximum(keys.at("speed", t_s), 0.0)
    stride = keys.at("stride", t_s)
    swing = gait.swing(stride, speed, run, style.arm_share)

    pelvis_yaw = yaw + swing.pelvis_yaw + _deg(keys, "pelvis_yaw_deg", t_s)
    tilt = _deg(keys, "tilt_deg", t_s) + 0.4 * swing.lean
    pelvis = multiply(
        multiply(about(2, pelvis_yaw), about(1, tilt)),
        about(0, swing.pelvis_list + 0.3 * _deg(keys, "side_deg", t_s)),
    )
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    sway = swing.sway_m + _idle(style, t_s, 0.31, 0) * style.sway_m + keys.at("aside", t_s)
    along = _idle(style, t_s, 0.23, 1) * style.sway_m - keys.at("back", t_s)
    floor = ground(place)
    place = place + sway[:, None] * left + along[:, None] * ahead

    feet = [foot_over_time(rig, side, t_s, plan.feet[side], keys, ground) for side in (0, 1)]
    wanted = floor + _wanted_height(rig, plan, speed, run, stride) - keys.at("drop", t_s)
    softness = _WALKING_SOFTNESS_M + run * (_RUNNING_SOFTNESS_M - _WALKING_SOFTNESS_M)
    height = pelvis_height(rig, place, pelvis, feet, wanted, softness)
    root = np.concatenate([place, height[:, None]], axis=1)
    feet = [
        _kicking(rig, plan, side, foot, t_s, root, pelvis, ground)
        for side, foot in zip(SIDES, feet, strict=True)
    ]
    bones = {"pelvis": pelvis} | leg_rotations(rig, root, pelvis, feet)
    for foot, side in zip(feet, SIDES, strict=True):
        bones |= {f"{side}_foot": foot.rotation, f"{side}_toes": foot.toes}
    bones |= _trunk(plan, style, swing, t_s, yaw, pelvis)
    _arms(rig, plan, swing, t_s, root, bones, floor)
    rotation = np.stack([bones[name] for name in BONES], axis=1)
    return BodyMotion(t_s, root, rotation)


def _kicking(
    rig: Rig, plan: Plan, side: str, foot: Foot, t_s: Float, root: Float, pelvis: Float, ground: Heights
) -> Foot:
    """Move a foot, as far as it kicks, to the place given by the angles of hip, knee and ankle."""
    share = foot.kicks
    if not share.any():
        return foot
    out = _deg(plan.keys, "kick_out_deg", t_s) * (1 if side == SIDES[0] else -1)
    thigh = multiply(multiply(pelvis, about(0, out)), about(1, -_deg(plan.keys, "kick_thigh_deg", t_s)))
    shank = multiply(thigh, about(1, _deg(plan.keys, "kick_knee_deg", t_s)))
    kicked = multiply(shank, about(1, -_deg(plan.keys, "kick_ankle_deg", t_s)))
    ankle = root
    for above, bone in ((pelvis, "thigh"), (thigh, "shank"), (shank, "foot")):
        ankle = ankle + rotate(above, rig.offset[BONE[f"{side}_{bone}"]])
    moved = replace(
        foot,
        ankle=foot.ankle + share[:, None] * (ankle - foot.ankle),
        rotation=partly(foot.rotation, kicked, share),
        toes=partly(foot.toes, kicked, share),
    )
    # A bent knee lifts a foot that would scrape the ground.
    heel, tip = (point[:, 2] - ground(point[:, :2]) for point in sole_of(rig, SIDES.index(side), moved))
    lowest = -_SCRAPES_M / 4 * np.logaddexp(-4 * heel / _SCRAPES_M, -4 * tip / _SCRAPES_M)
    spare = (lowest - _SCRAPES_M) / _SCRAPES_M
    lifted = _SCRAPES_M * np.logaddexp(0.0, -2.0 * spare) / 2.0
    return replace(moved, ankle=moved.ankle + (share * lifted)[:, None] * np.array([0.0, 0.0, 1.0]))


def _deg(keys: Keys, name: str, t_s: Float) -> Float:
    return np.asarray(np.radians(keys.at(name, t_s)), dtype=np.float64)


def _idle(style: Style, t_s: Float, rate_hz: float, which: int) -> Float:
    """Compute a slow, never quite repeating movement, at most 1."""
    phase = style.sway_phase[which]
    return 0.6 * np.sin(2 * np.pi * rate_hz * t_s + phase) + 0.4 * np.sin(
        2 * np.pi * rate_hz * 0.43 * t_s + 2 * phase
    )


def _wanted_height(rig: Rig, plan: Plan, speed: Float, run: Float, stride: Float) -> Float:
    """Compute the wanted height of the pelvis above the ground."""
    moving = np.tanh(speed / 0.5)
    headroom = _STANDING_HEADROOM_M + moving * (_WALKING_HEADROOM_M - _STANDING_HEADROOM_M)
    upright = rig.height_of_pelvis + headroom
    step_s = 1 / np.array([gait.cadence(v, 1.0, plan.leg_m) for v in speed])
    flight = np.array([gait.swing_steps(v, 1.0) for v in speed]) - 1
    runner = 0.962 * rig.height_of_pelvis + gait.bounce_m(stride, step_s, flight)
    return (1 - run) * upright + run * runner


def _trunk(
    plan: Plan, style: Style, swing: gait.Swing, t_s: Float, yaw: Float, pelvis: Float
) -> dict[str, Float]:
    keys = plan.keys
    breath = np.radians(0.6) * np.sin(2 * np.pi * style.breath_hz * t_s + style.sway_phase[2])
    chest_yaw = yaw + swing.chest_yaw + _deg(keys, "chest_yaw_deg", t_s)
    lean = swing.lean + _deg(keys, "lean_deg", t_s) + breath
    side = _deg(keys, "side_deg", t_s)
    chest = multiply(multiply(about(2, chest_yaw), about(1, lean)), about(0, side))
    look = _deg(keys, "look_deg", t_s)
    head = multiply(about(2, yaw + 0.3 * (chest_yaw - yaw)), about(1, 0.45 * lean + look))
    third = np.full(len(t_s), 1 / 3)
    return {
        "spine": partly(pelvis, chest, third),
        "back": partly(pelvis, chest, 2 * third),
        "chest": chest,
        "neck": partly(chest, head, 1.5 * third),
        "head": head,
    }


def _arms(
    rig: Rig,
    plan: Plan,
    swing: gait.Swing,
    t_s: Float,
    root: Float,
    bones: dict[str, Float],
    floor: Float,
) -> None:
    """Add clavicles, arms and hands to `bones`: hanging, swinging, or reaching for a height."""
    keys = plan.keys
    chest = bones["chest"]
    shoulders = root
    for below, bone in (("pelvis", "spine"), ("spine", "back"), ("back", "chest")):
        shoulders = shoulders + rotate(bones[below], rig.offset[BONE[bone]])
    for index, (sign, side) in enumerate(zip((1.0, -1.0), SIDES, strict=True)):
        flexed = swing.shoulder[:, index] + _deg(keys, f"{side}_shoulder_deg", t_s)
        raised = swing.abduction[:, index] + _deg(keys, f"{side}_abduct_deg", t_s)
        elbow = swing.elbow[:, index] + _deg(keys, f"{side}_elbow_deg", t_s)
        reaching = keys.at(f"{side}_reach", t_s)
        height = keys.at(f"{side}_reach_m", t_s)
        upper_arm, forearm = (rig.offset[BONE[f"{side}_{bone}"]] for bone in ("forearm", "hand"))
        joint = rig.offset[BONE[f"{side}_clavicle"]]
        out = rig.offset[BONE[f"{side}_upper_arm"]]

        level = shoulders[:, 2] + rotate(chest, joint + out)[:, 2] - floor
        lift = np.radians(22.0) * reaching * (0.5 + 0.5 * np.tanh((height - level) / 0.2))
        clavicle = multiply(chest, about(0, sign * lift))
        shoulder = shoulders + rotate(chest, joint) + rotate(clavicle, out)

        arm = multiply(multiply(chest, about(0, sign * raised)), about(1, -flexed))
        # Hanging arms are turned in, so that bent elbows bring the hands ahead of the body.
        arm = multiply(arm, about(2, np.full(len(t_s), -sign * np.radians(18.0))))
        lower = multiply(arm, about(1, -elbow))
        if reaching.any():
            up = height + floor - shoulder[:, 2]
            far = 0.96 * (np.sqrt(np.sum(upper_arm**2)) + np.sqrt(np.sum(forearm**2)))
            # Up to the arm's length, and ahead by the rest, no farther than is comfortable.
            up = far * up / (far**12 + up**12) ** (1 / 12)
            ahead = np.sqrt(far**2 - up**2 + 0.01 * far**2)
            ahead = ahead * 0.75 * far / (ahead**4 + (0.75 * far) ** 4) ** 0.25
            towards = rotate(about(2, _yaw(chest)), np.stack([ahead, 0 * ahead, up], axis=1))
            hinge = rotate(chest, np.array([0.0, -1.0, sign * 0.6]))
            there = two_bones(upper_arm, forearm, towards, hinge)
            arm, lower = (partly(a, b, reaching) for a, b in zip((arm, lower), there, strict=True))
        bones |= {
            f"{side}_clavicle": clavicle,
            f"{side}_upper_arm": arm,
            f"{side}_forearm": lower,
            f"{side}_hand": multiply(lower, about(1, np.full(len(t_s), np.radians(-8.0)))),
        }


def _yaw(rotation: Float) -> Float:
    """Compute the direction of x over the ground, [T] rad."""
    ahead = rotate(rotation, np.array([1.0, 0.0, 0.0]))
    return np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
