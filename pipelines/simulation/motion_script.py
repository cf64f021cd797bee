"""Steps of a script, performed one after the other: walks, actions on one spot, and the kick."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.geometry.rig import BONE, BONES, SIDES, BodyMotion, Rig, about, from_axes, partly, unit
from pipelines.session.storage import own_table
from pipelines.simulation.motion_plan import (
    FASTEST_WALK_MPS,
    JOG_SPEED_MPS,
    LEFT,
    RIGHT,
    WALK_SPEED_MPS,
    Footstep,
    Keys,
    Plan,
    Roll,
    Swing,
    WayPart,
    body_swing,
    bounce_m,
    roll,
    steps_per_s,
    swing_steps,
)
from pipelines.simulation.scenario import Step, Travel

Heights = Callable[[Float], Float]

# A foot swings this far in a full stride of walking, with a leg of 0.93 m.
_FULL_SWING_M = 1.3
# Toes bend by no more than this before the foot tips over their end.
_TOES_BEND = np.radians(42.0)
_SOFTNESS_M = (0.0003, 0.02)  # range over which the point changes that a foot turns about: planted, swung
# In a longer stance the foot is flat for the rest of the time.
_LONGEST_ROLL_S = 0.8
# At either end of its swing the foot goes only up or down for this share.
_STILL_SHARE = 0.05
# The first part of a stance belongs to the strike, and the rest to the lift.
_SET_DOWN = 0.65
# The tilt of the ground is measured over the width of a foot.
_HALF_WIDTH_M = 0.04


@dataclass(frozen=True)
class Foot:
    """One foot over time."""

    ankle: Float  # [T, 3] m
    rotation: Float  # [T, 4] world_from_foot
    toes: Float  # [T, 4]
    carries: Float  # [T] 1 while it is planted, 0 in the middle of a swing
    kicks: Float  # [T] 1 while it swings as a kick, not as a step
    least_knee: Float  # [T] rad, least flexion of its knee


def foot_over_time(
    rig: Rig, side: int, t_s: Float, steps: Sequence[Footstep], extra: Keys, ground: Heights
) -> Foot:
    """Compute place and attitude of a foot (0: left) over time [T], with the curves `extra` beside steps."""
    keys = _keys_of_steps(steps, leg_m=rig.length_of_leg)
    curve = {name: keys.at(name, t_s) for name in ("x", "y", "yaw", "clear", "soft", "bent", "carries")}
    joint, heel, tip = _sole(rig, side)
    place = np.stack([curve["x"], curve["y"]], axis=1)
    base, tilt, rise = _on_ground(place, curve["yaw"], heel[0], tip[0], ground)
    pitch = np.radians(keys.at("pitch_deg", t_s) - extra.at("heel_deg", t_s))
    # Uphill the heel behind rises as much more as the ground is steep.
    pitch -= keys.at("leaves", t_s) * np.arctan((rise + np.hypot(rise, 0.02)) / 2)

    raised = np.maximum(-pitch, 0.0)
    # x / (1 + x^8)^(1/8): as good as x below three quarters of the limit.
    part = raised / _TOES_BEND
    bend = curve["bent"] * raised / (1 + part**8) ** 0.125
    ankle_xz = _rolled(joint, heel, tip, pitch, bend, curve["soft"])
    ankle_xz[:, 1] += curve["clear"]

    frame = multiply(about(2, curve["yaw"]), tilt)
    flat = np.array([0.0, 0.0, -heel[1]])
    moved = np.stack([ankle_xz[:, 0], np.zeros(len(t_s)), ankle_xz[:, 1]], axis=1)
    rotation = multiply(frame, about(1, -pitch))
    return Foot(
        ankle=base + rotate(frame, flat + moved),
        rotation=rotation,
        toes=multiply(rotation, about(1, -bend)),
        carries=curve["carries"],
        kicks=extra.at(f"{SIDES[side]}_kick", t_s),
        least_knee=np.radians(keys.at("knee_deg", t_s)),
    )


def sole_of(rig: Rig, side: int, foot: Foot) -> tuple[Float, Float]:
    """Compute heel and tip of a foot, [T, 3] m, world."""
    joint = rig.offset[BONE[f"{SIDES[side]}_toes"]]
    heel, _, tip = rig.sole[side]
    at_tip = rotate(foot.rotation, joint) + rotate(foot.toes, tip - joint)
    return foot.ankle + rotate(foot.rotation, heel), foot.ankle + at_tip


def _sole(rig: Rig, side: int) -> tuple[Float, Float, Float]:
    """Return the joint of the toes, heel and tip from the ankle, forward and up, [2] m each."""
    joint = rig.offset[BONE[f"{SIDES[side]}_toes"]]
    heel, _, tip = rig.sole[side]
    return joint[[0, 2]], heel[[0, 2]], np.array([tip[0], heel[2]])


def _keys_of_steps(steps: Sequence[Footstep], leg_m: float) -> Keys:
    """Write the curves of one foot: the place of its flat sole, its pitch, its height in swing."""
    keys = Keys()
    extents = [_extent(a, b, leg_m) for a, b in pairwise(steps)]
    runs = [(a.run + b.run) / 2 for a, b in pairwise(steps)]
    for i, step in enumerate(steps):
        came, goes = (extents[i - 1] if i else 0.0), (extents[i] if i < len(extents) else 0.0)
        lift_s = steps[i + 1].lift_s if i < len(extents) else None
        rolled = roll(step.run, came, goes)
        for name, value in (("x", float(step.place[0])), ("y", float(step.place[1])), ("yaw", step.yaw)):
            early_s = _STILL_SHARE * (step.strike_s - step.lift_s)
            keys.add(name, (step.strike_s - early_s, value), (step.strike_s, value))
            if lift_s is not None:
                late_s = _STILL_SHARE * (steps[i + 1].strike_s - lift_s)
                keys.add(name, (lift_s, value), (lift_s + late_s, value))
        _stance(keys, step.strike_s, lift_s, rolled)
        if lift_s is not None:
            swung = roll(runs[i], goes, goes)
            _onward(keys, lift_s, step, steps[i + 1], swung)
            _swing(keys, lift_s, steps[i + 1].strike_s, swung)
    return keys


def _extent(before: Footstep, after: Footstep, leg_m: float) -> float:
    """Compute the length of a swing, as a share of a full stride of walking."""
    moved = float(np.hypot(*(after.place - before.place))) + 0.15 * abs(after.yaw - before.yaw)
    return moved * 0.93 / (leg_m * _FULL_SWING_M)


def _stance(keys: Keys, strike_s: float, lift_s: float | None, rolled: Roll) -> None:
    """Write the keys from the strike until the foot is flat, and, if it lifts, from heel rise to lift."""
    duration_s = _LONGEST_ROLL_S if lift_s is None else min(lift_s - strike_s, _LONGEST_ROLL_S)
    for name, value in (("pitch_deg", rolled.strike_deg), ("clear", 0.0), ("soft", _SOFTNESS_M[0])):
        keys.add(name, (strike_s, value))
    keys.add("bent", (strike_s, 1.0))
    keys.add("carries", (strike_s, 1.0))
    for name, curve in (("pitch_deg", rolled.stance_deg), ("knee_deg", rolled.knee_deg)):
        down = [(share, value) for share, value in curve if share <= _SET_DOWN]
        keys.add(name, *((strike_s + share * duration_s, value) for share, value in down))
        if lift_s is not None:
            up = [down[-1], *curve[len(down) :]]
            keys.add(name, *((lift_s - (1 - share) * duration_s, value) for share, value in up))
    if lift_s is None:
        return
    keys.add("pitch_deg", (lift_s, rolled.lift_deg))
    for name, value in (("clear", 0.0), ("soft", _SOFTNESS_M[0]), ("bent", 1.0), ("carries", 1.0)):
        keys.add(name, (lift_s, value))
    keys.add("leaves", (lift_s - 0.5 * duration_s, 0.0), (lift_s - 0.18 * duration_s, 0.9), (lift_s, 1.0))


def _onward(keys: Keys, lift_s: float, before: Footstep, after: Footstep, rolled: Roll) -> None:
    """Write the keys from one place on the ground to the next, without these two."""
    for name, start, end in (
        ("x", before.place[0], after.place[0]),
        ("y", before.place[1], after.place[1]),
        ("yaw", before.yaw, after.yaw),
    ):
        for share, there in rolled.onward:
            keys.add(name, (lift_s + share * (after.strike_s - lift_s), float(start + there * (end - start))))


def _swing(keys: Keys, lift_s: float, strike_s: float, rolled: Roll) -> None:
    """Write the keys from the lift to the strike, without these two."""
    for name, curve in (
        ("pitch_deg", rolled.swing_deg),
        ("clear", rolled.clearance_m),
        ("soft", ((0.25, _SOFTNESS_M[1]), (0.75, _SOFTNESS_M[1]))),
        ("bent", ((0.35, rolled.toes), (0.9, rolled.toes))),
        ("leaves", ((0.5, 0.0),)),
        ("carries", ((0.2, 0.0), (0.6, 0.0), (rolled.carries, 1.0))),
    ):
        keys.add(name, *((lift_s + share * (strike_s - lift_s), value) for share, value in curve))


def _turned(point: Float, pitch: Float) -> Float:
    """Turn a point of the foot, pitched toes up by [T] rad: [T, 2] forward and up."""
    cosine, sine = np.cos(pitch), np.sin(pitch)
    return np.stack([cosine * point[0] - sine * point[1], sine * point[0] + cosine * point[1]], axis=1)


def _rolled(joint: Float, heel: Float, tip: Float, pitch: Float, bend: Float, softness_m: Float) -> Float:
    """Compute the ankle's shift from its place with a flat sole, [T, 2] m, if one point stays put."""
    heel_now = _turned(heel, pitch)
    tip_now = _turned(joint, pitch) + _turned(tip - joint, pitch + bend)
    lower = np.clip((tip_now[:, 1] - heel_now[:, 1]) / softness_m, -500.0, 500.0)
    on_heel = (1 / (1 + np.exp(-lower)))[:, None]
    return on_heel * (heel - heel_now) + (1 - on_heel) * (tip - tip_now)


def _on_ground(
    place: Float, yaw: Float, heel_m: float, tip_m: float, ground: Heights
) -> tuple[Float, Float, Float]:
    """Find the place of a flat sole: [T, 3] m below the ankle, the ground's tilt [T, 4], its slope [T]."""
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    at_heel, at_tip = ground(place + heel_m * ahead), ground(place + tip_m * ahead)
    rise = (at_tip - at_heel) / (tip_m - heel_m)
    middle = place + 0.5 * (heel_m + tip_m) * ahead
    across = (ground(middle + _HALF_WIDTH_M * left) - ground(middle - _HALF_WIDTH_M * left)) / (
        2 * _HALF_WIDTH_M
    )
    base = np.concatenate([place, (at_heel - heel_m * rise)[:, None]], axis=1)
    tilt = multiply(about(1, -np.arctan(rise)), about(0, np.arctan(across * np.cos(np.arctan(rise)))))
    return base, tilt, rise


# The pelvis may be this far above the reach of a leg that carries nothing.
_HANGS_FREE_M = 0.02
# Near a straight limb the reach is softened over this length, so that the knee does not snap.
_STRETCHED_M = 0.002


def two_bones(upper: Float, lower: Float, towards: Float, hinge: Float) -> tuple[Float, Float]:
    """Return the rotations [T, 4] of two bones whose end is at `towards` [T, 3], or points there.

    `upper` and `lower` [3] m are neutral; all is relative to the first joint, by the law of cosines. The limb
    bends about the part of `hinge` [T, 3] across it: a knee with the hinge to the left goes ahead, an elbow
    whose hinge points right goes back.
    """
    first, second = (float(np.sqrt(np.sum(bone**2))) for bone in (upper, lower))
    wanted = np.sqrt(np.sum(towards**2, axis=1))
    # Softly up to straight, so that the knee's speed stays bounded.
    spare = (first + second - wanted) / _STRETCHED_M
    reached = first + second - _STRETCHED_M * np.logaddexp(0.0, spare)
    reached = np.maximum(reached, abs(first - second) + 0.02)
    cosine = (first**2 + reached**2 - second**2) / (2 * first * reached)
    bent_up = np.arccos(np.clip(cosine, -1.0, 1.0))
    cosine = (first**2 + second**2 - reached**2) / (2 * first * second)
    bent = np.pi - np.arccos(np.clip(cosine, -1.0, 1.0))

    down = unit(towards)
    axis = unit(hinge - np.sum(hinge * down, axis=1, keepdims=True) * down)
    whole = from_axes(np.cross(axis, -down), axis, -down)
    one, other = (_from_neutral(bone) for bone in (upper, lower))
    above = multiply(whole, about(1, -bent_up))
    below = multiply(above, about(1, bent))
    return multiply(above, one), multiply(below, other)


def _from_neutral(bone: Float) -> Float:
    """Return the rotation [1, 4] of a bone's neutral direction straight down."""
    down = bone / np.sqrt(np.sum(bone**2))
    left = np.array([0.0, 1.0, 0.0]) - down[1] * down
    left /= np.sqrt(np.sum(left**2))
    neutral = from_axes(np.cross(left, -down)[None], left[None], -down[None])
    return conjugate(neutral)


def pelvis_height(
    rig: Rig, place: Float, pelvis: Float, feet: Sequence[Foot], wanted_m: Float, softness_m: Float
) -> Float:
    """Return the wanted height [T] m, or what the carrying legs allow with their least knee flexion.

    Bounds nearer to each other than `softness_m` [T] blend. The pelvis's joint is at `place` [T, 2] m.
    """
    height = wanted_m
    for foot, side in zip(feet, SIDES, strict=True):
        offsets = (rig.offset[BONE[f"{side}_{bone}"]] for bone in ("shank", "foot"))
        first, second = (float(np.sqrt(np.sum(offset**2))) for offset in offsets)
        hip = rotate(pelvis, rig.offset[BONE[f"{side}_thigh"]])
        aside = np.sum((foot.ankle[:, :2] - place - hip[:, :2]) ** 2, axis=1)
        reach = first**2 + second**2 + 2 * first * second * np.cos(foot.least_knee)
        above = np.sqrt(np.maximum(reach - aside, 0.09 * reach))
        bound = (
            foot.ankle[:, 2] + above - hip[:, 2] + _HANGS_FREE_M * (1 - foot.carries) + 2 * foot.kicks * first
        )
        # The smaller one, a parabola where they are within `softness_m`: never above either.
        near = np.maximum(softness_m - np.abs(height - bound), 0.0) / softness_m
        height = np.minimum(height, bound) - near**2 * softness_m / 4
    return height


def leg_rotations(rig: Rig, root: Float, pelvis: Float, feet: Sequence[Foot]) -> dict[str, Float]:
    """Compute rotations of thighs and shanks that end at the ankles; knees point as pelvis and foot do."""
    bones: dict[str, Float] = {}
    left = np.array([0.0, 1.0, 0.0])
    for foot, side in zip(feet, SIDES, strict=True):
        hip = root + rotate(pelvis, rig.offset[BONE[f"{side}_thigh"]])
        hinge = (1 - foot.kicks[:, None]) * rotate(pelvis, left) + rotate(foot.rotation, left)
        bones[f"{side}_thigh"], bones[f"{side}_shank"] = two_bones(
            rig.offset[BONE[f"{side}_shank"]], rig.offset[BONE[f"{side}_foot"]], foot.ankle - hip, hinge
        )
    return bones


# --- bones ---------------------------------------------------------------------------------------------

_WALKING_SOFTNESS_M, _RUNNING_SOFTNESS_M = 0.006, 0.026
# A kicking foot that comes as near as this to the ground is lifted.
_SCRAPES_M = 0.02
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
    """Pose all bones from the plan's start [2] m and heading (rad), over the ground's heights."""
    keys = plan.keys
    place, yaw = plan.body_at(t_s, start, heading)
    run = keys.at("running", t_s)
    speed = np.maximum(keys.at("speed", t_s), 0.0)
    stride = keys.at("stride", t_s)
    swing = body_swing(stride, speed, run, style.arm_share)

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
    step_s = 1 / np.array([steps_per_s(v, 1.0, plan.leg_m) for v in speed])
    flight = np.array([swing_steps(v, 1.0) for v in speed]) - 1
    runner = 0.962 * rig.height_of_pelvis + bounce_m(stride, step_s, flight)
    return (1 - run) * upright + run * runner


def _trunk(plan: Plan, style: Style, swing: Swing, t_s: Float, yaw: Float, pelvis: Float) -> dict[str, Float]:
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
    rig: Rig, plan: Plan, swing: Swing, t_s: Float, root: Float, bones: dict[str, Float], floor: Float
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


_GO_DOWN_S, _REACH_S = 0.9, 0.7


def crouch(plan: Plan, seconds: float, depth: float) -> None:
    """Go down, stay, come up; thighs are level at two thirds of the depth, heels off beyond."""
    down = plan.t_s + _GO_DOWN_S * (0.6 + 0.4 * depth)
    up = down + seconds
    end = up + down - plan.t_s
    leg_m = plan.leg_m
    heel_deg = 32.0 * max(depth - 0.6, 0.0) / 0.4
    for name, value in (
        ("drop", depth * 0.60 * leg_m),
        ("back", 0.20 * leg_m * depth * (1.5 - depth)),
        ("lean_deg", 42.0 * depth),
        ("tilt_deg", 28.0 * depth),
        ("look_deg", -25.0 * depth),
        ("heel_deg", heel_deg),
        *((f"{side}_shoulder_deg", 68.0 * depth) for side in ("left", "right")),
        *((f"{side}_elbow_deg", 25.0 * depth) for side in ("left", "right")),
    ):
        plan.keys.pulse(name, (plan.t_s, 0), (down, value), (up, value), (end, 0))
    plan.stay(end - plan.t_s)


def reach(plan: Plan, side: str, height_m: float, seconds: float, shoulder_m: float, arm_m: float) -> None:
    """Move a hand (or both) up to a height, hold it, and move it back; low ones bend trunk and knees."""
    there = plan.t_s + _REACH_S
    back = there + seconds
    end = back + _REACH_S
    # Without bending, the hand comes down as far as an arm that hangs ahead by a third.
    missing = max(shoulder_m - 0.85 * arm_m - height_m, 0.0) / plan.leg_m
    bends = min(missing / 0.62, 1.0)
    for name, value in (
        ("drop", 0.52 * plan.leg_m * bends),
        ("back", 0.14 * plan.leg_m * bends),
        ("lean_deg", 70.0 * bends),
        ("tilt_deg", 32.0 * bends),
    ):
        plan.keys.pulse(name, (plan.t_s, 0), (there, value), (back, value), (end, 0))
    for one in ("left", "right") if side == "both" else (side,):
        plan.keys.pulse(f"{one}_reach", (plan.t_s, 0), (there, 1), (back, 1), (end, 0))
        plan.keys.add(f"{one}_reach_m", (there, height_m), (back, height_m))
    plan.stay(end - plan.t_s)


_FASTEST_RUN_UP_MPS, _RUN_UP_MPS2 = 3.3, 2.6
_AFTER_PLANT_S = (0.22, 0.75)
# By the impact a kicker has slowed down to this share of the run-up.
_SLOWED_TO = 0.30
_LIFT_S, _LAND_S, _CLOSE_S, _STAND_S = -0.15, 0.68, 0.78, 1.22


def kick(plan: Plan, side: str, run_up_m: float) -> None:
    """Plan an instep kick at a ball: run up, plant the other foot, swing back, kick, follow through, stand.

    By the sources in data/kick.toml, the approach at 3 to 4 m/s slows down over the plant foot; the hip is
    extended by some 30 deg and the knee flexed beyond 100 deg after the plant; the pelvis turns through some
    40 deg; the knee extends at more than 1,000 deg/s and is still bent at the impact, 0.19 s after the plant;
    the trunk leans back and to the support foot's side, whose arm is spread behind and comes across.
    """
    foot, support = (LEFT, RIGHT) if side == "left" else (RIGHT, LEFT)
    speed = min((2 * _RUN_UP_MPS2 * run_up_m) ** 0.5, _FASTEST_RUN_UP_MPS)
    plant_s = 2 * run_up_m / speed
    slow_s, stop_s = (plant_s + after for after in _AFTER_PLANT_S)
    knots = ((0.0, 0.0), (plant_s, speed), (slow_s, _SLOWED_TO * speed), (stop_s, 0.0))
    beyond_m = speed * ((1 + _SLOWED_TO) * (slow_s - plant_s) + _SLOWED_TO * (stop_s - slow_s)) / 2
    way = WayPart(run_up_m + beyond_m, plan.heading, 0.0, speed, 1.0)
    plant = plan.t_s + plant_s
    plan.run_up([way], [(t, v, 1.0) for t, v in knots], plant_s, support)
    end = (plan.place, plan.heading)
    plan.step(foot, plant + _LIFT_S, plant + _LAND_S, end, 0.0)
    plan.step(support, plant + _CLOSE_S, plant + _STAND_S, end, 0.0)

    def write(name: str, curve: Sequence[Sequence[float]], sign: float = 1.0) -> None:
        plan.keys.add(name, *((plant + after, sign * value) for after, value in curve))

    names = ("left", "right")
    mirror = 1.0 if foot == RIGHT else -1.0
    write(f"{names[foot]}_kick", ((_LIFT_S, 0.0), (-0.02, 1.0), (0.36, 1.0), (0.62, 0.0)))
    write("drop", ((-0.25, 0.0), (0.05, 0.025), (0.35, 0.025), (0.70, 0.0)))
    write("aside", ((-0.3, 0.0), (0.05, 0.05), (0.35, 0.05), (0.9, 0.0)), mirror)
    angles = own_table(__file__, "kick")
    for name, curve in angles["leg"].items():
        write(name, curve)
    for name, curve in angles["trunk"].items():
        write(name, curve, mirror)
    for side_of, arm in ((support, "support_arm"), (foot, "kicking_arm")):
        for name, curve in angles[arm].items():
            write(f"{names[side_of]}_{name}", curve)
    plan.t_s = plant + _STAND_S


# Ways that meet at a sharper angle are walked with a stop and a turn.
_STOPS_AT_CORNER = np.radians(50.0)
# A person pauses for this time after a way.
_PAUSE_S = 0.25


def perform(
    steps: Sequence[Step],
    rig: Rig,
    t_s: Float,
    *,
    ground: Callable[[Float], Float],
    start: Float,
    heading_deg: float,
    repeat: bool,
    seed: int,
) -> BodyMotion:
    """Perform the steps one after the other from a stand; at the end stand still, or begin again."""
    random = np.random.default_rng(seed)
    style = Style(
        sway_m=float(random.uniform(0.003, 0.006)),
        sway_phase=tuple(random.uniform(0, 2 * np.pi, 3)),
        arm_share=float(random.uniform(0.88, 1.12)),
        breath_hz=float(random.uniform(0.22, 0.3)),
    )
    start = np.asarray(start, dtype=np.float64)
    heading = float(np.radians(heading_deg))
    plan = Plan(start, heading, rig.length_of_leg, ground, step_width=float(random.uniform(0.85, 1.15)))
    end_s = float(t_s[-1])
    while plan.t_s <= end_s:
        before = plan.t_s
        _once(steps, rig, plan, end_s)
        if not repeat or plan.t_s == before:
            break
    return bodies(rig, plan, style, t_s, start, heading, ground)


def _once(steps: Sequence[Step], rig: Rig, plan: Plan, end_s: float) -> None:
    """Plan one pass over the script, up to the last step that begins before `end_s`."""
    waiting = list(steps)
    while waiting and plan.t_s <= end_s:
        parts = _ways_on(waiting, plan)
        if parts:
            plan.turn(_nearest(parts[0].heading - plan.heading))
            plan.travel(parts)
            plan.stay(_PAUSE_S)
            continue
        if not waiting:  # only ways to the actor's own place were left
            break
        step = waiting.pop(0)
        if step.stand:
            plan.stay(step.stand.seconds)
        elif step.turn:
            plan.turn(float(np.radians(step.turn.deg)))
        elif step.crouch:
            crouch(plan, step.crouch.seconds, step.crouch.depth)
        elif step.kick:
            kick(plan, step.kick.foot, step.kick.run_up_m)
            plan.stay(_PAUSE_S)
        elif step.reach:
            shoulder_m = float(
                sum(
                    rig.offset[BONE[bone], 2]
                    for bone in ("pelvis", "spine", "back", "chest", "left_clavicle", "left_upper_arm")
                )
            )
            arm_m = sum(
                float(np.linalg.norm(rig.offset[BONE[f"left_{bone}"]])) for bone in ("forearm", "hand")
            )
            reach(plan, step.reach.side, step.reach.height_m, step.reach.seconds, shoulder_m, arm_m)


def _ways_on(waiting: list[Step], plan: Plan) -> list[WayPart]:
    """Take the ways off the script that lead on without a stop."""
    place, heading = plan.place, plan.heading
    parts: list[WayPart] = []
    while waiting and (travel := waiting[0].walk or waiting[0].jog):
        part = _part(travel, place, heading, jogs=waiting[0].jog is not None)
        if part.length_m > 0.05:
            if parts and abs(_nearest(part.heading - heading)) > _STOPS_AT_CORNER:
                break
            # As an angle that goes on from the last one, so that the heading does not jump by a turn.
            part = WayPart(
                part.length_m, heading + _nearest(part.heading - heading), part.turn, part.speed_mps, part.run
            )
            parts.append(part)
            place, heading = part.end(place), part.end_heading
        waiting.pop(0)
    return parts


def _part(travel: Travel, place: Float, heading: float, *, jogs: bool) -> WayPart:
    speed = travel.speed_mps or (JOG_SPEED_MPS if jogs else WALK_SPEED_MPS)
    run = 1.0 if jogs or speed > FASTEST_WALK_MPS else 0.0
    if travel.to is None:
        return WayPart(
            float(travel.distance_m or 0.0), heading, float(np.radians(travel.turn_deg)), speed, run
        )
    way = np.asarray(travel.to) - place
    return WayPart(float(np.hypot(*way)), float(np.arctan2(way[1], way[0])), 0.0, speed, run)


def _nearest(angle: float) -> float:
    """Return the same angle between -pi and pi."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
