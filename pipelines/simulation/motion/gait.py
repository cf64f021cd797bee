"""How people step at which speed: cadence, shares of stance, the roll of the foot, the swing of the arms.

Sources: step length and cadence of walking by the constant walk ratio of Sekiya & Nagasaki,
"Reproducibility of the walking patterns of normal young adults" (Gait & Posture 1998); shares of stance
and foot, pelvis and arm angles of walking from Perry & Burnfield, "Gait Analysis" (2nd ed. 2010) and
Winter, "Biomechanics and Motor Control of Human Movement" (4th ed. 2009); jogging from Novacheck,
"The biomechanics of running" (Gait & Posture 1998).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

WALK_SPEED_MPS = 1.3
JOG_SPEED_MPS = 2.7
FASTEST_WALK_MPS = 2.1  # people who want to be faster run (Novacheck 1998)
_RUNNING_FROM_MPS, _RUNNING_FULLY_MPS = 1.0, 1.9

_WALK_RATIO_M_S = 0.0064 * 60  # step length by cadence
_LEG_OF_WALK_RATIO_M = 0.93
_SLOWEST_CADENCE = 1.1  # steps per s, of a first or last step

# Foot against the ground in stance: share of stance and degrees, toes up; the strike and the lift are added.
_STANCE_WALK = ((0.13, 0.0), (0.47, 0.0), (0.66, -8.0), (0.82, -23.0))
_STANCE_RUN = ((0.20, 0.0), (0.47, 0.0), (0.60, -8.0), (0.82, -33.0))
# And in swing.
_SWING_WALK = ((0.12, -72.0), (0.27, -58.0), (0.50, -20.0), (0.72, 6.0), (0.92, 21.0))
_SWING_RUN = ((0.15, -80.0), (0.38, -84.0), (0.60, -48.0), (0.80, -6.0), (0.93, 10.0))
_STRIKE_DEG, _LIFT_DEG = (20.0, 8.0), (-58.0, -66.0)  # walking, running
# How high the lowest point of the foot is in swing, m.
_CLEARANCE_WALK = ((0.20, 0.032), (0.40, 0.026), (0.60, 0.022), (0.80, 0.018))
_CLEARANCE_RUN = ((0.18, 0.05), (0.40, 0.12), (0.60, 0.10), (0.80, 0.05))
# The least flexion of the knee in stance, degrees.
_KNEE_WALK = ((0.0, 5.0), (0.22, 15.0), (0.42, 11.0), (0.62, 5.0), (1.0, 5.0))


def running(speed_mps: float) -> float:
    """How much of a run it is for someone who means to run: 0 walks, 1 runs."""
    share = (speed_mps - _RUNNING_FROM_MPS) / (_RUNNING_FULLY_MPS - _RUNNING_FROM_MPS)
    share = min(max(share, 0.0), 1.0)
    return share * share * (3 - 2 * share)


def cadence(speed_mps: float, run: float, leg_m: float) -> float:
    """Steps per second; those of runners hardly depend on their speed."""
    size = _LEG_OF_WALK_RATIO_M / leg_m
    walk = np.sqrt(max(speed_mps, 0.0) * size / _WALK_RATIO_M_S)
    slowest = _SLOWEST_CADENCE * np.sqrt(size)
    jog = (2.3 + 0.13 * speed_mps) * np.sqrt(size)
    return float((1 - run) * max(walk, slowest) + run * jog)


def swing_steps(speed_mps: float, run: float) -> float:
    """How long a foot is off the ground, in steps (halves of a stride): above 1 both feet fly."""
    walk = 2 * min(max(0.28 + 0.077 * speed_mps, 0.28), 0.42)  # 0.38 of a stride at 1.3 m/s
    jog = 2 * (1 - min(max(0.47 - 0.035 * speed_mps, 0.27), 0.44))  # 0.61 to 0.66 of a stride
    return (1 - run) * walk + run * jog


def above_foot(run: float) -> float:
    """At which share of a stance the pelvis passes above the ankle."""
    return 0.36 - 0.05 * run


@dataclass(frozen=True)
class Roll:
    """How a foot is set down, rolls and swings on, as (share of stance or swing, value) keys."""

    strike_deg: float
    lift_deg: float
    stance_deg: tuple[tuple[float, float], ...]
    swing_deg: tuple[tuple[float, float], ...]
    clearance_m: tuple[tuple[float, float], ...]
    knee_deg: tuple[tuple[float, float], ...]


def roll(run: float, before: float, after: float) -> Roll:
    """The roll of a foot.

    Args:
        run: 0 for walking, 1 for running.
        before: how long the swing was that ends with the strike, by that of a full stride: 0 to 1.
        after: the same of the swing that follows.
    """

    def mix(walk: tuple[tuple[float, float], ...], jog: tuple[tuple[float, float], ...]) -> list[list[float]]:
        mixed: list[list[float]] = ((1 - run) * np.array(walk) + run * np.array(jog)).tolist()
        return mixed

    def scaled(angle_deg: float) -> float:
        return angle_deg * (before if angle_deg > 0 else after)

    return Roll(
        strike_deg=before * ((1 - run) * _STRIKE_DEG[0] + run * _STRIKE_DEG[1]),
        lift_deg=after * ((1 - run) * _LIFT_DEG[0] + run * _LIFT_DEG[1]),
        stance_deg=tuple((share, scaled(angle)) for share, angle in mix(_STANCE_WALK, _STANCE_RUN)),
        swing_deg=tuple((share, after * angle) for share, angle in mix(_SWING_WALK, _SWING_RUN)),
        clearance_m=tuple(
            (share, high * (after if run > 0.5 else 0.6 + 0.4 * after))
            for share, high in mix(_CLEARANCE_WALK, _CLEARANCE_RUN)
        ),
        knee_deg=tuple((share, 4.0 + (angle - 4.0) * (1 - run) * before) for share, angle in _KNEE_WALK),
    )


@dataclass(frozen=True)
class Swing:
    """What the body above the legs does over a stride, [T] each; angles to the left are positive."""

    pelvis_yaw: Float  # rad: the hip of the leg in front goes with it
    pelvis_list: Float  # rad: the hip of the leg in the air is lower
    sway_m: Float  # towards the foot that carries
    chest_yaw: Float  # rad, of the heading: against the pelvis
    lean: Float  # rad forward
    shoulder: Float  # [T, 2] rad flexed, left then right
    elbow: Float  # [T, 2] rad
    abduction: Float  # [T, 2] rad


def swing(stride: Float, speed_mps: Float, run: Float, arm_share: float) -> Swing:
    """Pelvis, trunk and arms of someone whose left heel strikes at stride angle 0, the right at pi.

    Args:
        stride: [T] rad.
        speed_mps: [T]; all but the arms' rest swells with it and is gone at 0.
        run: [T] 0 for walking, 1 for running.
        arm_share: how far the arms swing, by the usual.
    """
    walk = 1 - run
    size = 1.3 * np.tanh(speed_mps * np.arctanh(1 / 1.3) / WALK_SPEED_MPS)  # 1 at the usual speed
    in_front = np.cos(stride)  # 1 at the left strike
    carried = np.sin(stride)  # 1 where the left foot stands alone
    shoulders, elbows = [], []
    for sign in (1.0, -1.0):
        # Perry: 24 deg extended at the heel strike of its side, then 8 flexed; elbow 20 to 44.
        shoulder = walk * (-4.0 - 18.0 * sign * in_front) + run * (-8.0 - 19.0 * sign * in_front)
        elbow = walk * (16.0 - 11.0 * sign * in_front) + run * (58.0 - 9.0 * sign * in_front)
        shoulders.append(np.radians(size * arm_share * shoulder))
        elbows.append(np.radians(14.0 + size * elbow))
    abducted = np.radians(7.0 + 8.0 * run)
    return Swing(
        pelvis_yaw=np.radians(-size * (4.0 * walk + 5.0 * run) * in_front),
        pelvis_list=np.radians(size * (3.5 * walk + 4.0 * run) * np.sin(stride + 0.3)),
        sway_m=size * (0.020 * walk + 0.010 * run) * carried,
        chest_yaw=np.radians(size * (4.0 * walk + 6.0 * run) * in_front),
        lean=np.radians(size * (2.0 * walk + 6.0 * run)),
        shoulder=np.stack(shoulders, axis=1),
        elbow=np.stack(elbows, axis=1),
        abduction=np.stack([abducted, abducted], axis=1),
    )


def bounce_m(stride: Float, step_s: Float, swing_share: Float) -> Float:
    """How high a runner's pelvis is above its height at the strikes, [T] m.

    Free fall while both feet are off, a half sine on the springy leg, of equal speed where they meet
    (the spring-mass runner of Blickhan 1989).

    Args:
        stride: [T] rad, a strike at every multiple of pi.
        step_s: [T] duration of a step.
        swing_share: [T] of a step for which both feet are off the ground.
    """
    since = np.mod(stride / np.pi, 1.0)  # of a step, from the strike
    flight = np.clip(swing_share, 0.0, 0.9)
    contact = 1.0 - flight
    up_mps = 9.81 * flight * step_s / 2
    on_leg = -up_mps * contact * step_s / np.pi * np.sin(np.pi * np.minimum(since / contact, 1.0))
    t = np.maximum(since - contact, 0.0) * step_s
    return np.asarray(on_leg + up_mps * t - 9.81 * t * t / 2, dtype=np.float64)
