"""Steps of a script, performed one after the other: walks, actions on one spot, and the kick."""

from collections.abc import Callable, Sequence

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.simulation import gait
from pipelines.simulation.motion_body import Style, bodies
from pipelines.simulation.motion_plan import LEFT, RIGHT, Pace, Plan, WayPart
from pipelines.simulation.rig import BONE, BodyMotion, Rig
from pipelines.simulation.scenario import Step, Travel

_GO_DOWN_S, _REACH_S = 0.9, 0.7


def crouch(plan: Plan, seconds: float, depth: float) -> None:
    """Go down, stay, come up again.

    The thighs are level at two thirds of the depth. Deeper, the heels are off the ground.
    """
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
    """Move a hand (or both) up to a height above the ground, hold it there, and move it back.

    Trunk and knees bend to reach heights below the waist. `shoulder_m` is the height of the shoulders of
    the person standing, `arm_m` the length from shoulder to wrist.
    """
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


# Of a right-footed instep kick: seconds from the plant of the support foot, degrees. The thigh is measured
# from straight down in a plane that leans out from the turned pelvis, forward is positive.
_KICK_LEG = {
    "kick_thigh_deg": (
        *((-0.14, -16.0), (-0.01, -32.0), (0.06, -26.0), (0.12, 5.0), (0.17, 25.0)),
        *((0.22, 37.0), (0.36, 62.0), (0.50, 42.0), (0.66, 14.0)),
    ),
    "kick_knee_deg": (
        *((-0.14, 45.0), (-0.01, 86.0), (0.065, 104.0), (0.125, 92.0), (0.195, 32.0)),
        *((0.23, 10.0), (0.31, 6.0), (0.40, 16.0), (0.52, 34.0), (0.66, 20.0)),
    ),
    "kick_out_deg": ((-0.14, 0.0), (0.05, 20.0), (0.20, 20.0), (0.36, 6.0), (0.66, 0.0)),
    "kick_ankle_deg": ((-0.14, -14.0), (0.0, -20.0), (0.24, -20.0), (0.42, -12.0), (0.66, 0.0)),
}
_KICK_TRUNK = {  # angles to the left are positive
    "pelvis_yaw_deg": ((-0.3, 0.0), (0.01, -28.0), (0.19, 10.0), (0.34, 24.0), (0.65, 6.0), (1.0, 0.0)),
    "chest_yaw_deg": ((-0.3, 0.0), (0.02, 20.0), (0.20, -8.0), (0.36, -20.0), (0.65, -6.0), (1.0, 0.0)),
    "side_deg": ((-0.3, 0.0), (0.02, -12.0), (0.18, -17.0), (0.35, -8.0), (0.9, 0.0)),
}
_KICK_BEND = {  # the same for either foot
    "lean_deg": ((-0.3, 0.0), (0.0, -13.0), (0.12, -15.0), (0.25, 2.0), (0.38, 14.0), (0.7, 5.0), (1.0, 0.0)),
    "tilt_deg": ((-0.3, 0.0), (0.0, 6.0), (0.19, -10.0), (0.34, -12.0), (0.7, 0.0)),
    "look_deg": ((-0.3, 0.0), (0.0, 24.0), (0.16, 24.0), (0.5, 0.0)),
}
_KICK_ARMS = {  # of the support side, of the kicking side
    "shoulder_deg": (
        ((-0.3, 0.0), (0.0, -42.0), (0.18, 5.0), (0.35, 48.0), (0.6, 15.0), (1.0, 0.0)),
        ((-0.3, 0.0), (0.0, 32.0), (0.20, -22.0), (0.36, -40.0), (0.6, -15.0), (1.0, 0.0)),
    ),
    "abduct_deg": (
        ((-0.3, 0.0), (0.0, 68.0), (0.18, 58.0), (0.36, 22.0), (0.6, 8.0), (1.0, 0.0)),
        ((-0.3, 0.0), (0.0, 12.0), (0.17, 38.0), (0.35, 30.0), (0.6, 10.0), (1.0, 0.0)),
    ),
}
_FASTEST_RUN_UP_MPS, _RUN_UP_MPS2 = 3.3, 2.6
_AFTER_PLANT_S = (0.22, 0.75)
# By the impact a kicker has slowed down to this share of the run-up.
_SLOWED_TO = 0.30
_LIFT_S, _LAND_S, _CLOSE_S, _STAND_S = -0.15, 0.68, 0.78, 1.22


def kick(plan: Plan, side: str, run_up_m: float) -> None:
    """Plan an instep kick at a ball: run up, plant the other foot, swing back, kick, follow through, stand.

    The angles are read off Lees, Asai, Andersen, Nunome & Sterzing, "The biomechanics of kicking in
    soccer" (J. Sports Sci. 2010) and Nunome, Asai, Ikegami & Sakurai, "Three-dimensional kinetic analysis
    of side-foot and instep soccer kicks" (Med. Sci. Sports Exerc. 2002): the approach at 3 to 4 m/s slows
    down over the plant foot; the hip is extended by some 30 deg and the knee flexed beyond 100 deg after
    the plant; the pelvis turns through some 40 deg; the knee extends at more than 1,000 deg/s and is still
    bent at the impact, 0.19 s after the plant; the trunk leans back and to the side of the support foot,
    whose arm is spread behind and comes across.
    """
    foot, support = (LEFT, RIGHT) if side == "left" else (RIGHT, LEFT)
    speed = min((2 * _RUN_UP_MPS2 * run_up_m) ** 0.5, _FASTEST_RUN_UP_MPS)
    plant_s = 2 * run_up_m / speed
    slow_s, stop_s = (plant_s + after for after in _AFTER_PLANT_S)
    knots = ((0.0, 0.0), (plant_s, speed), (slow_s, _SLOWED_TO * speed), (stop_s, 0.0))
    beyond_m = speed * ((1 + _SLOWED_TO) * (slow_s - plant_s) + _SLOWED_TO * (stop_s - slow_s)) / 2
    way = WayPart(run_up_m + beyond_m, plan.heading, 0.0, speed, 1.0)
    plant = plan.t_s + plant_s
    plan.run_up([way], Pace(tuple((t, v, 1.0) for t, v in knots)), plant_s, support)
    end = (plan.place, plan.heading)
    plan.step(foot, plant + _LIFT_S, plant + _LAND_S, end, 0.0)
    plan.step(support, plant + _CLOSE_S, plant + _STAND_S, end, 0.0)

    def write(name: str, curve: tuple[tuple[float, float], ...], sign: float = 1.0) -> None:
        plan.keys.add(name, *((plant + after, sign * value) for after, value in curve))

    names = ("left", "right")
    mirror = 1.0 if foot == RIGHT else -1.0
    write(f"{names[foot]}_kick", ((_LIFT_S, 0.0), (-0.02, 1.0), (0.36, 1.0), (0.62, 0.0)))
    write("drop", ((-0.25, 0.0), (0.05, 0.025), (0.35, 0.025), (0.70, 0.0)))
    write("aside", ((-0.3, 0.0), (0.05, 0.05), (0.35, 0.05), (0.9, 0.0)), mirror)
    for name, curve in (_KICK_LEG | _KICK_BEND).items():
        write(name, curve)
    for name, curve in _KICK_TRUNK.items():
        write(name, curve, mirror)
    for name, (of_support, of_foot) in _KICK_ARMS.items():
        write(f"{names[support]}_{name}", of_support)
        write(f"{names[foot]}_{name}", of_foot)
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
    speed = travel.speed_mps or (gait.JOG_SPEED_MPS if jogs else gait.WALK_SPEED_MPS)
    run = 1.0 if jogs or speed > gait.FASTEST_WALK_MPS else 0.0
    if travel.to is None:
        return WayPart(
            float(travel.distance_m or 0.0), heading, float(np.radians(travel.turn_deg)), speed, run
        )
    way = np.asarray(travel.to) - place
    return WayPart(float(np.hypot(*way)), float(np.arctan2(way[1], way[0])), 0.0, speed, run)


def _nearest(angle: float) -> float:
    """Return the same angle between -pi and pi."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
