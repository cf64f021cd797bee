"""Steps of a script, performed one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.simulation.motion import gait
from pipelines.simulation.motion.actions import crouch, kick, reach
from pipelines.simulation.motion.body import Style, bodies
from pipelines.simulation.motion.plan import Plan
from pipelines.simulation.motion.ways import Part
from pipelines.simulation.rig import BONE, BodyMotion, Rig
from pipelines.simulation.scenario import Step, Travel

_STOPS_AT_CORNER = np.radians(50.0)
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


def _ways_on(waiting: list[Step], plan: Plan) -> list[Part]:
    """Take the ways off the script that lead on without a stop."""
    place, heading = plan.place, plan.heading
    parts: list[Part] = []
    while waiting and (travel := waiting[0].walk or waiting[0].jog):
        part = _part(travel, place, heading, jogs=waiting[0].jog is not None)
        if part.length_m > 0.05:
            if parts and abs(_nearest(part.heading - heading)) > _STOPS_AT_CORNER:
                break
            # As an angle that goes on from the last one, so that the heading does not jump by a turn.
            part = Part(
                part.length_m, heading + _nearest(part.heading - heading), part.turn, part.speed_mps, part.run
            )
            parts.append(part)
            place, heading = part.end(place), part.end_heading
        waiting.pop(0)
    return parts


def _part(travel: Travel, place: Float, heading: float, *, jogs: bool) -> Part:
    speed = travel.speed_mps or (gait.JOG_SPEED_MPS if jogs else gait.WALK_SPEED_MPS)
    run = 1.0 if jogs or speed > gait.FASTEST_WALK_MPS else 0.0
    if travel.to is None:
        return Part(float(travel.distance_m or 0.0), heading, float(np.radians(travel.turn_deg)), speed, run)
    way = np.asarray(travel.to) - place
    return Part(float(np.hypot(*way)), float(np.arctan2(way[1], way[0])), 0.0, speed, run)


def _nearest(angle: float) -> float:
    """Return the same angle between -pi and pi."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
