"""Gait by speed: cadence, shares of stance, the roll of the foot, the swing of the arms.

Sources: step length and cadence of walking by the constant walk ratio of Sekiya & Nagasaki, "Reproducibility
of the walking patterns of normal young adults" (Gait & Posture 1998); shares of stance and foot, pelvis and
arm angles of walking from Perry & Burnfield, "Gait Analysis" (2nd ed. 2010) and Winter, "Biomechanics and
Motor Control of Human Movement" (4th ed. 2009); jogging from Novacheck, "The biomechanics of running" (Gait &
Posture 1998). The keys of walking feet and knees were fitted: with them hip, knee and ankle come nearest to
the mean curves of Perry & Burnfield and of Winter at 1.3 m/s (least squares).
"""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float

# People walk at this speed if no other one is stated; the curves of feet and knees were fitted at it.
WALK_SPEED_MPS = 1.3
# People jog at this speed if no other one is stated.
JOG_SPEED_MPS = 2.7
# People who go faster than this run (Novacheck 1998).
FASTEST_WALK_MPS = 2.1
_RUNNING_FROM_MPS, _RUNNING_FULLY_MPS = 1.0, 1.9

# Step length over cadence is the same at all speeds of walking (Sekiya & Nagasaki 1998).
_WALK_RATIO_M_S = 0.0064 * 60
# The walk ratio holds for people with legs of this length.
_LEG_OF_WALK_RATIO_M = 0.93
# A first or last step takes no longer than at this cadence.
_SLOWEST_CADENCE = 1.1

# Foot against the ground in stance: share of stance and degrees, toes up; the strike and the lift are added.
_STANCE_WALK = ((0.13, 0.0), (0.34, 0.0), (0.66, -11.5), (0.78, -16.5))
_STANCE_RUN = ((0.20, 0.0), (0.47, 0.0), (0.60, -8.0), (0.82, -33.0))
# In walking strides longer than that at 1.3 m/s the heel rises farther, by a share of the extra length.
_USUAL_STRIDE, _LONG_STRIDE_LIFTS = 1.09, 0.8
# And in swing.
_SWING_WALK = ((0.08, -71.5), (0.19, -65.0), (0.55, -16.5), (0.80, 16.0), (0.90, 20.0))
_SWING_RUN = ((0.15, -80.0), (0.38, -84.0), (0.60, -48.0), (0.80, -6.0), (0.93, 10.0))
_STRIKE_DEG, _LIFT_DEG = (17.5, 8.0), (-61.0, -66.0)  # walking, running
# Height of the lowest point of the foot in swing, m.
_CLEARANCE_WALK = ((0.05, 0.006), (0.20, 0.026), (0.40, 0.014), (0.60, 0.023), (0.80, 0.027), (0.95, 0.009))
_CLEARANCE_RUN = ((0.05, 0.0078), (0.18, 0.05), (0.40, 0.12), (0.60, 0.10), (0.80, 0.05), (0.94, 0.0070))
# Share of its way that the foot has come in swing.
_ONWARD_WALK = ((0.2, 0.14), (0.4, 0.42), (0.6, 0.68), (0.8, 0.93))
_ONWARD_RUN = ((0.2, 0.074), (0.4, 0.336), (0.6, 0.664), (0.8, 0.926))
# Share of the swing from which a leg reaches the ground; share of the bend at lift that the toes keep.
_CARRIES, _TOES = (0.97, 0.90), (1.0, 0.0)  # walking, running
# The least flexion of the knee in stance, degrees.
_KNEE_WALK = ((0.0, 1.5), (0.22, 17.5), (0.42, 9.0), (0.62, 5.0), (0.76, 8.5), (1.0, 18.0))


def running(speed_mps: float) -> float:
    """Return the share of running in the gait at a speed, for a person in a jog: 0 walks, 1 runs."""
    share = (speed_mps - _RUNNING_FROM_MPS) / (_RUNNING_FULLY_MPS - _RUNNING_FROM_MPS)
    share = min(max(share, 0.0), 1.0)
    return share * share * (3 - 2 * share)


def cadence(speed_mps: float, run: float, leg_m: float) -> float:
    """Return steps per second; the cadence of runners depends little on their speed."""
    size = _LEG_OF_WALK_RATIO_M / leg_m
    walk = np.sqrt(max(speed_mps, 0.0) * size / _WALK_RATIO_M_S)
    slowest = _SLOWEST_CADENCE * np.sqrt(size)
    jog = (2.3 + 0.13 * speed_mps) * np.sqrt(size)
    return float((1 - run) * max(walk, slowest) + run * jog)


def swing_steps(speed_mps: float, run: float) -> float:
    """Return the time of a foot off the ground, in steps (halves of a stride): above 1 both feet fly."""
    walk = 2 * min(max(0.295 + 0.077 * speed_mps, 0.28), 0.43)  # 0.39 of a stride at 1.3 m/s
    jog = 2 * (1 - min(max(0.47 - 0.035 * speed_mps, 0.27), 0.44))  # 0.61 to 0.66 of a stride
    return (1 - run) * walk + run * jog


def above_foot(run: float) -> float:
    """Return the share of a stance at which the pelvis passes above the ankle."""
    return 0.36 - 0.05 * run


@dataclass(frozen=True)
class Roll:
    """Strike, roll and swing of a foot, as (share of stance or swing, value) keys."""

    strike_deg: float
    lift_deg: float
    stance_deg: tuple[tuple[float, float], ...]
    swing_deg: tuple[tuple[float, float], ...]
    clearance_m: tuple[tuple[float, float], ...]
    onward: tuple[tuple[float, float], ...]
    carries: float  # from this share of a swing on
    toes: float  # bend that they keep in swing: 0 straight, 1 level
    knee_deg: tuple[tuple[float, float], ...]


def roll(run: float, before: float, after: float) -> Roll:
    """Compute the roll of a foot.

    Args:
        run: 0 for walking, 1 for running.
        before: length of the swing that ends with the strike, as a share of a full stride's.
        after: the same of the swing that follows.
    """

    def mix(walk: tuple[tuple[float, float], ...], jog: tuple[tuple[float, float], ...]) -> list[list[float]]:
        mixed: list[list[float]] = ((1 - run) * np.array(walk) + run * np.array(jog)).tolist()
        return mixed

    came, goes = (float(np.sin(np.pi / 2 * min(share, 1.0))) for share in (before, after))
    toes_up = (1 - run) * min(before, 1.0) + run * came
    heel_up = goes * (1 + (1 - run) * _LONG_STRIDE_LIFTS * max(after - _USUAL_STRIDE, 0.0))
    return Roll(
        strike_deg=toes_up * ((1 - run) * _STRIKE_DEG[0] + run * _STRIKE_DEG[1]),
        lift_deg=heel_up * ((1 - run) * _LIFT_DEG[0] + run * _LIFT_DEG[1]),
        stance_deg=tuple((share, heel_up * angle) for share, angle in mix(_STANCE_WALK, _STANCE_RUN)),
        swing_deg=tuple(
            (share, angle * (toes_up if angle > 0 else goes)) for share, angle in mix(_SWING_WALK, _SWING_RUN)
        ),
        clearance_m=tuple(
            (share, high * (goes if run > 0.5 else 0.6 + 0.4 * goes))
            for share, high in mix(_CLEARANCE_WALK, _CLEARANCE_RUN)
        ),
        onward=tuple((share, there) for share, there in mix(_ONWARD_WALK, _ONWARD_RUN)),
        carries=(1 - run) * _CARRIES[0] + run * _CARRIES[1],
        toes=(1 - run) * _TOES[0] + run * _TOES[1],
        knee_deg=tuple((share, 4.0 + (angle - 4.0) * (1 - run) * came) for share, angle in _KNEE_WALK),
    )


@dataclass(frozen=True)
class Swing:
    """Motion of the body above the legs over a stride, [T] each; angles to the left are positive."""

    pelvis_yaw: Float  # rad: the hip of the leg in front goes with it
    pelvis_list: Float  # rad: the hip of the leg in the air is lower
    sway_m: Float  # towards the foot that carries
    chest_yaw: Float  # rad, of the heading: against the pelvis
    lean: Float  # rad forward
    shoulder: Float  # [T, 2] rad flexed, left then right
    elbow: Float  # [T, 2] rad
    abduction: Float  # [T, 2] rad


def swing(stride: Float, speed_mps: Float, run: Float, arm_share: float) -> Swing:
    """Compute pelvis, trunk and arms. The left heel strikes at stride angle 0, the right at pi.

    Args:
        stride: [T] rad.
        speed_mps: [T]; all but the arms' rest swells with it and is gone at 0.
        run: [T] 0 for walking, 1 for running.
        arm_share: amplitude of the arms' swing, as a share of the usual one.
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
    """Compute the height of a runner's pelvis above its height at the strikes, [T] m.

    Free fall while both feet are off, a half sine on the springy leg; the speeds are equal where they meet
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
