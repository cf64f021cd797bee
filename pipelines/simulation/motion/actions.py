"""What a person does on one spot, and the kick: the keys of trunk, arms and legs over time."""

from __future__ import annotations

from pipelines.simulation.motion.plan import Plan

_GO_DOWN_S, _REACH_S = 0.9, 0.7


def crouch(plan: Plan, seconds: float, depth: float) -> None:
    """Down, stay, up again: thighs level at two thirds, heels off the ground below that."""
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
    """A hand (or both) up and ahead to a height above the ground, held there, and back.

    What lies below the waist is reached for by bending trunk and knees.

    Args:
        plan: is added to.
        side: left, right or both.
        height_m: of the hand's joint.
        seconds: that it is held.
        shoulder_m: height of the shoulders of the person standing.
        arm_m: from shoulder to wrist.
    """
    there = plan.t_s + _REACH_S
    back = there + seconds
    end = back + _REACH_S
    # Without bending the hand comes down to where the arm, ahead by a third, hangs.
    missing = max(shoulder_m - 0.85 * arm_m - height_m, 0.0) / plan.leg_m
    bends = min(missing / 0.75, 1.0)
    for name, value in (
        ("drop", 0.52 * plan.leg_m * bends),
        ("back", 0.14 * plan.leg_m * bends),
        ("lean_deg", 58.0 * bends),
        ("tilt_deg", 32.0 * bends),
    ):
        plan.keys.pulse(name, (plan.t_s, 0), (there, value), (back, value), (end, 0))
    for one in ("left", "right") if side == "both" else (side,):
        plan.keys.pulse(f"{one}_reach", (plan.t_s, 0), (there, 1), (back, 1), (end, 0))
        plan.keys.add(f"{one}_reach_m", (plan.t_s, height_m), (end, height_m))
    plan.stay(end - plan.t_s)
