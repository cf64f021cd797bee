"""Drones that fly: within their limits, as control theory predicts, leaning and looking as they should."""

import math

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.simulation.flying import (
    ATTITUDE_LAG_S,
    GIMBAL_LAG_S,
    POSITION_GAIN_PER_S,
    STEP_S,
    VELOCITY_GAIN_PER_S,
    DronePaths,
    Known,
    fly,
    fly_with,
    moments,
    orbit,
    ring_slots,
)
from pipelines.simulation.scenario import FormationSettings, Limits

T_S = moments(0.0, 20.0)
MIDDLE = np.tile([0.0, 0.0, 1.0], (len(T_S), 1))
RING = FormationSettings(radius_m=10.0, tilt_deg=15.0, yaw_rate_deg_per_s=20.0)
TURN_RADPS, RADIUS_M = math.radians(20.0), 10.0 * math.cos(math.radians(15.0))
SETTLED = T_S > 10.0  # the slowest mode of the loops decays within a second


def circling() -> DronePaths:
    """Fly three drones on a ring around a standing actor."""
    return fly(ring_slots(RING, 3, MIDDLE, T_S), MIDDLE, T_S, Limits())


def norm(vectors: Float) -> Float:
    length: Float = np.linalg.norm(vectors, axis=-1)
    return length


def angle_deg(one: Float, other: Float) -> Float:
    sine, cosine = norm(np.cross(one, other)), np.sum(one * other, axis=-1)
    angle: Float = np.degrees(np.arctan2(sine, cosine))
    return angle


# --- tracking ------------------------------------------------------------------------------------------
def test_behind_a_circling_slot_a_drone_lags_as_its_loops_say() -> None:
    """The slot's path s and the error e obey lag e''' + e'' + kv e' + kv kp e = lag s''' + s''.

    The integration holds each push for a step, which delays the velocity loop by at most one: kv STEP_S
    = 2 % of it.
    """
    turning = 1j * TURN_RADPS
    inertia = ATTITUDE_LAG_S * turning**3 + turning**2
    loops = VELOCITY_GAIN_PER_S * (turning + POSITION_GAIN_PER_S)
    expected_m = RADIUS_M * abs(inertia / (inertia + loops))
    lag_m = norm(circling().position - ring_slots(RING, 3, MIDDLE, T_S))[:, SETTLED]
    assert lag_m == pytest.approx(expected_m, rel=VELOCITY_GAIN_PER_S * STEP_S)
    # The rule of thumb of the docstring: the slot's acceleration over both gains.
    rule_m = RADIUS_M * TURN_RADPS**2 / (POSITION_GAIN_PER_S * VELOCITY_GAIN_PER_S)
    assert expected_m == pytest.approx(rule_m, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_limits_are_never_exceeded(seed: int) -> None:
    """Slots that jump by tens of metres and race between jumps; both limits hold to rounding."""
    rng = np.random.default_rng(seed)
    limits = Limits(speed_mps=rng.uniform(1, 15), acceleration_mps2=rng.uniform(1, 12))
    jumps = np.repeat(rng.uniform(-40, 40, (3, 10, 3)), len(T_S) // 10 + 1, axis=1)[:, : len(T_S)]
    slots: Float = jumps + rng.uniform(-20, 20, (3, 1, 3)) * T_S[:, None]
    paths = fly(slots, MIDDLE, T_S, limits)
    speed = norm(paths.velocity)
    acceleration = norm(np.diff(paths.velocity, axis=1)) / np.diff(T_S)
    assert speed.max() <= limits.speed_mps * (1 + 1e-12)
    assert acceleration.max() <= limits.acceleration_mps2 * (1 + 1e-9)
    # It does use what it has, at least the half that brakes.
    assert speed.max() > 0.99 * limits.speed_mps
    assert acceleration.max() > 0.5 * limits.acceleration_mps2
    moved = np.diff(paths.position, axis=1)
    assert norm(moved).max() <= limits.speed_mps * np.diff(T_S).max() * (1 + 1e-9)


# --- a planner on the way ------------------------------------------------------------------------------
def test_a_planner_knows_the_past_alone() -> None:
    actor_t_s = np.arange(0.05, 2.0, 0.1)
    actor = np.random.default_rng(2).normal(size=(len(actor_t_s), 3))
    heard: list[Known] = []

    def listen(known: Known) -> tuple[Float, Float]:
        heard.append(known)
        return known.position + np.array([1.0, 0.0, 0.0]), np.zeros_like(known.position)

    t_s = moments(0.0, 2.0)
    start = np.array([[5.0, 0.0, 3.0], [0.0, 5.0, 3.0]])
    paths = fly_with(
        listen, start, MIDDLE[: len(t_s)], t_s, Limits(), actor_t_s=actor_t_s, actor=actor, rate_hz=20
    )
    assert [known.t_s for known in heard] == pytest.approx(np.arange(41) / 20)
    for known in heard:
        assert len(known.actor) == (actor_t_s <= known.t_s).sum()
        assert (known.actor == actor[: len(known.actor)]).all()
        row = round(known.t_s * 100)
        assert (known.position == paths.position[:, row]).all()
        assert (known.velocity == paths.velocity[:, row]).all()
    # The slot always lies 1 m ahead: kp m/s, less what the accelerating takes.
    assert paths.velocity[:, -1, 0] == pytest.approx([POSITION_GAIN_PER_S] * 2, rel=0.1)


# --- attitudes -----------------------------------------------------------------------------------------
def test_cameras_look_at_their_aim_and_stand_upright() -> None:
    """Seen from the camera the aim turns with the ring; the gimbal lags by that rate times its lag."""
    paths = circling()
    right, down, forward = np.moveaxis(matrix_from_quaternion(paths.camera_xyzw), -1, 0)
    sight = MIDDLE - paths.camera_position
    off_deg = angle_deg(forward, sight)
    # A turn about the vertical moves the axis by cos(tilt) of it.
    expected_deg = 20.0 * GIMBAL_LAG_S * math.cos(math.radians(15.0))
    assert off_deg[:, 0] == pytest.approx(0.0, abs=1e-9)
    assert off_deg[:, SETTLED] == pytest.approx(expected_deg, rel=0.05)
    assert right[..., 2] == pytest.approx(0.0, abs=1e-12)
    assert (down[..., 2] < -0.9).all()


LOG_T_S = np.linspace(0, 20, 41)
TARGET = np.stack([1.2 * LOG_T_S, 3.0 + 0 * LOG_T_S, 1.0 + 0 * LOG_T_S], axis=1)


@pytest.mark.parametrize(("cameras", "apart_deg"), [(1, None), (2, 90.0), (3, 120.0), (5, 72.0)])
def test_slots_of_the_formation(cameras: int, apart_deg: float | None) -> None:
    position, _ = orbit(LOG_T_S, TARGET, cameras=cameras, range_m=8.0, tilt_deg=20.0, yaw_deg=10.0)
    from_target = position - TARGET
    assert position.shape == (cameras, len(LOG_T_S), 3)
    assert np.linalg.norm(from_target, axis=-1) == pytest.approx(8.0)
    assert from_target[..., 2] == pytest.approx(8.0 * np.sin(np.radians(20.0)))
    yaw = np.unwrap(np.arctan2(from_target[..., 1], from_target[..., 0]))
    assert np.degrees(yaw[0]) == pytest.approx(10.0 + 4.0 * LOG_T_S)
    if apart_deg is not None:
        assert np.degrees(yaw[1] - yaw[0]) % 360 == pytest.approx(apart_deg)


def test_cameras_look_at_the_target_and_stand_upright() -> None:
    position, quaternion = orbit(LOG_T_S, TARGET, cameras=3, variation=1.0)
    right, down, forward = np.moveaxis(matrix_from_quaternion(quaternion), -1, 0)
    towards = (TARGET - position) / np.linalg.norm(TARGET - position, axis=-1, keepdims=True)
    assert forward == pytest.approx(towards, abs=1e-12)
    assert right[..., 2] == pytest.approx(0.0, abs=1e-12)
    assert (down[..., 2] < 0).all()
    assert np.linalg.norm(quaternion, axis=-1) == pytest.approx(1.0)
