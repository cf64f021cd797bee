"""Arms: their search against its parts, groups, forecasts of the actor, and settings."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.planning.arms import ADAPTIVE, FIXED, GROUP, JOINT, Arm, RollingOut
from pipelines.planning.config import SETTINGS, Imperfections, PlannerConfig, planner_config
from pipelines.planning.distance_field import DistanceField, open_space
from pipelines.planning.forecast import ActorFilter, Forecast
from pipelines.planning.formation import FormationPath, costs_of_slots, formation_slots, slot_of, slot_offsets
from pipelines.planning.local import (
    ACCELERATION,
    INTEGRAL,
    POSITION,
    VELOCITY,
    flying_of,
    roll_out,
    stopping_ticks,
)
from pipelines.planning.replay import Replay, Start, aimed, replay
from pipelines.planning.scores import blind_s, hidden_by_people, propulsion_w, score, sights, used_kj
from pipelines.session.errors import DataError
from tests.planning.worlds import bare_ground, mound, trees, walker, wall

WORLD = trees()
WALL = wall(1.0)


@pytest.mark.parametrize("drones", [2, 5])
def test_nobody_of_a_joint_plan_stays_behind_a_wall(drones: int) -> None:
    """Each formation of five drones has somebody behind the wall; free spacing leaves nobody there."""
    config, field = PlannerConfig(), WALL
    actor = np.tile([12.0, 0.0, 1.0], (config.horizon_knots, 1))
    form = {"tilt_rad": config.tilt_rad, "range_m": config.radius_m}
    commanded = formation_slots(np.array([0.4]), drones, **form)[0]
    yaws = np.linspace(-np.pi, np.pi, 180)
    equal = costs_of_slots(field, actor[:1], slot_offsets(formation_slots(yaws, drones, **form)), config)
    fewest = (equal.occluded[0] > 0).sum(axis=-1).min()
    assert (fewest > 0) == (drones == 5)

    path = JOINT.start(config, drones=drones, yaw_rad=0.4).plan(0.0, commanded, Forecast(actor), field)

    offsets = slot_offsets(path.slots[-1])
    costs = costs_of_slots(field, actor[:1], offsets[None], config)
    assert costs.occluded.max() == 0
    assert costs.obstacle.max() < 1
    apart = np.linalg.norm(offsets[:, None] - offsets, axis=-1)[~np.eye(drones, dtype=bool)]
    assert apart.min() >= config.soft_separation_m
    most = np.array(config.slot_rates) * config.tuning.knot_s
    assert (np.abs(np.diff(path.slots, axis=0)) <= most + 1e-9).all()
    assert config.ranges_m[0] <= path.slots[..., 2].min() <= path.slots[..., 2].max() <= config.ranges_m[-1]


@pytest.mark.parametrize("nearest", [2, 5])
def test_a_joint_plan_is_the_one_that_measures_best_as_it_would_be_flown(nearest: int) -> None:
    """Require the path that brings the drones nearest: errors fall with the range. The last is adaptive's."""
    config = PlannerConfig()
    planner = JOINT.start(config, drones=2, yaw_rad=0.0)
    commanded = formation_slots(np.zeros(1), 2, tilt_rad=config.tilt_rad, range_m=config.radius_m)[0]
    actor = Forecast(np.tile([12.0, 0.0, 1.0], (config.horizon_knots, 1)))
    walked = np.tile([100.0, 0.0, 1.0], (config.tuning.waypoints, 1))  # nothing is there
    asked: list[FormationPath] = []

    def roll_out(path: FormationPath) -> tuple[Float, Float]:
        asked.append(path)
        range_m = 7.0 if len(asked) - 1 == nearest else 9.0 + len(asked)
        places = slot_offsets(
            formation_slots(np.zeros(config.tuning.waypoints), 2, tilt_rad=0.3, range_m=range_m)
        )
        return np.swapaxes(places, 0, 1) + walked[0], walked

    assert isinstance(planner, RollingOut)
    planner.roll_out = roll_out
    assert planner.plan(0.0, commanded, actor, WALL) is asked[nearest]
    assert len(asked) == 6
    adaptive = ADAPTIVE.start(config, drones=2, yaw_rad=0.0).plan(0.0, commanded, actor, WALL)
    np.testing.assert_array_equal(asked[5].slots, adaptive.slots)
    later = planner.plan(0.1, commanded, actor, WALL)
    assert later.knot_s[0] == (0.1 if nearest == 5 else 0.0)  # adaptive plans as often as alone


CONFIG = PlannerConfig()
FIELD = open_space()


def parted(away_m: float, *, seconds: float = 12.0, hz: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and the hips of two people who walk apart from each other, each `away_m` far."""
    t_s = np.arange(0.0, seconds + 1e-9, 1.0 / hz)
    east = np.minimum(1.0 + 1.5 * t_s, away_m)
    one = np.stack([east, 0 * t_s, 0 * t_s + 1.0], axis=-1)
    return (t_s * 1e9).round().astype(np.int64), np.stack([one, one * [-1, 1, 1]], axis=1)


def test_a_body_hides_what_is_behind_it_and_nothing_else() -> None:
    camera, target = np.array([0.0, 0.0, 1.0]), np.array([10.0, 0.0, 1.0])
    bodies = {
        "between": ([5.0, 0.2, 1.0], True),
        "aside": ([5.0, 0.3, 1.0], False),
        "behind the target": ([11.0, 0.0, 1.0], False),
        "behind the camera": ([-1.0, 0.0, 1.0], False),
        "far below": ([5.0, 0.0, 0.1], False),
        "below": ([5.0, 0.0, 0.3], True),
        "above": ([5.0, 0.0, 2.0], False),
    }
    for name, (hips, hides) in bodies.items():
        assert hidden_by_people(camera, target, np.array([hips])) == hides, name
    assert not hidden_by_people(camera, target, np.zeros((0, 3)))


@pytest.mark.parametrize(("weights", "filming"), [((1.0, 1.0), [2, 2]), ((1.0, 0.0), [4, 0])])
def test_a_group_is_shared_out_by_weight(weights: tuple[float, float], filming: list[int]) -> None:
    """Two views determine a person: of four drones each of two people who are far apart gets two."""
    people = np.array([[[9.0, 0.0, 1.0]], [[-9.0, 0.0, 1.0]]]).repeat(CONFIG.horizon_knots, axis=1)
    middle = np.average(people, axis=0, weights=weights)
    slots = formation_slots(np.zeros(1), 4, tilt_rad=CONFIG.tilt_rad, range_m=CONFIG.radius_m)[0]
    actor = Forecast(middle, people, np.array(weights))

    path = GROUP.start(CONFIG, drones=4, yaw_rad=0.0).plan(0.0, slots, actor, FIELD)

    assert path.aim is not None
    assert path.aim.sum(axis=0).tolist() == filming
    places = path.aim @ people[:, -1] + slot_offsets(path.slots[-1])
    apart = np.linalg.norm(places[:, None] - places, axis=-1)[~np.eye(4, dtype=bool)]
    assert apart.min() >= CONFIG.soft_separation_m
    assert np.linalg.norm(places[:, None] - people[:, -1], axis=-1).min() >= CONFIG.actor_distance_m


def test_drones_of_a_group_follow_people_who_part() -> None:
    """People 22 m apart do not fit into a view of 60 deg from 10 m: their middle shows neither."""
    stamps, people = parted(11.0)
    looks = {}
    for arm in (ADAPTIVE, GROUP):
        done = replay(arm, stamps, people, [], Start(4, 0.3), config=CONFIG, weights=(1.0, 1.0))
        ways = np.stack(
            [np.interp(done.t_s, stamps / 1e9, axis) for axis in people.reshape(len(people), -1).T]
        )
        hips = ways.reshape(2, 3, -1).swapaxes(1, 2)
        to = done.estimate - done.position
        seen = sights(done.position, np.arctan2(to[..., 1], to[..., 0]), hips, FIELD, CONFIG)
        looks[arm.name] = [blind_s(done.t_s, seen[p : p + 1]) for p in range(2)]
        apart = np.linalg.norm(done.position[:, None] - done.position[None], axis=-1)
        assert apart[~np.eye(4, dtype=bool)].min() >= CONFIG.separation_m
        nearest = np.linalg.norm(done.position[:, None] - hips, axis=-1).min()
        assert nearest >= CONFIG.actor_distance_m
        assert done.aim.sum(axis=2) == pytest.approx(1.0)
    assert max(looks["group"]) < 1.0
    assert min(looks["adaptive"]) > 3.0


def test_the_actor_is_estimated_as_well_as_can_be() -> None:
    """Squared errors of 400 walks x 3 axes are those of the optimal filter (Riccati), to 5 x 0.041."""
    rng, q, sigma_m, dt = np.random.default_rng(3), 0.4, 0.25, 0.2
    moved, noise = np.array([[1.0, dt], [0.0, 1.0]]), q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    walks = ActorFilter(q=q, sigma_m=sigma_m, weight=np.ones(400))
    truth = rng.normal(size=(400, 2, 3)) * [[1.0], [3.0]]
    for k in range(40):
        for person, own in enumerate(truth):
            walks.measure(k * dt, own[0] + sigma_m * rng.normal(size=3), person)
        off = walks.each(np.array([k * dt]))[:, 0] - truth[:, 0]
        truth = moved @ truth + np.linalg.cholesky(noise) @ rng.normal(size=truth.shape)
    before = solve_discrete_are(moved.T, np.array([[1.0], [0.0]]), noise, np.array([[sigma_m**2]]))[0, 0]
    assert (off**2).mean() / before == pytest.approx(sigma_m**2 / (before + sigma_m**2), rel=5 * 0.041)


@pytest.mark.parametrize("arm", [FIXED, JOINT], ids=lambda arm: arm.name)
@pytest.mark.parametrize("field", [WALL, WORLD], ids=["wall", "trees"])
def test_walls_and_trees_are_passed_without_a_touch(arm: Arm, field: DistanceField) -> None:
    flown = fly(arm, field, seconds=12.0, drones=3, yaw_deg=-90.0)
    broken = score(flown.t_s, flown.position, flown.actor, field, CONFIG)["limit_violations"]
    assert isinstance(broken, dict)
    assert not any(broken.values()), broken


def test_what_is_not_mentioned_keeps_its_default() -> None:
    config = planner_config({"imperfections.latency_s": 0.5, "imperfections": {"wind_mps": [5.0, 0.0]}})
    assert config.imperfections == Imperfections(latency_s=0.5, wind_mps=(5.0, 0.0))
    config = planner_config({"radius_m": 8, "ranges_m": [10, 20], "horizon_s": 7})
    assert config == PlannerConfig(radius_m=8.0, ranges_m=(10.0, 20.0), horizon_s=7.0)
    assert config.horizon_knots == 7
    assert planner_config({}) == PlannerConfig()
    assert len(SETTINGS) <= 20


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"radus_m": 8}, "'radius_m'"),
        ({"radius_m": "wide"}, "radius_m"),
        ({"l_obs": True}, "l_obs"),
        ({"l_obs": float("nan")}, "l_obs"),
        ({"horizon_s": 61}, "horizon_s"),
        ({"ranges_m": 8}, "ranges_m"),
        ({"ranges_m": []}, "ranges_m"),
        ({"radius_m": 0}, "radius_m"),
        ({"l_occ": -1}, "l_occ"),
        ({"tilt_deg": 88}, "tilt_deg"),
        ({"tuning": {}}, "tuning"),
        ({"imperfections.wind": 3}, "imperfections.wind"),
        ({"imperfections.wind_mps": [0.0, 9.0]}, "wind_mps"),
    ],
)
def test_what_cannot_be_meant_is_refused_by_name(values: dict[str, object], named: str) -> None:
    with pytest.raises(DataError) as error:
        planner_config({**values, "unheard_of": 1}, "weights.yaml")
    assert error.value.source == "weights.yaml"
    assert named in str(error.value)
    assert "unheard_of" in str(error.value)  # all problems in one message


vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), direction=vectors, push=vectors, spread_m=st.floats(0.1, 60.0))
def test_limits_are_kept_whatever_a_plan_asks_for_and_every_motion_ends_at_rest(
    seed: int, direction: Float, push: Float, spread_m: float
) -> None:
    """From any state within the limits, after a plan of random waypoints."""
    flying = flying_of(CONFIG)
    ticks = 10
    states = np.zeros((ticks + stopping_ticks(flying) + 1, 4, 3))
    states[0, VELOCITY] = direction * 0.95 * flying.speed_mps / np.sqrt(3)
    states[0, ACCELERATION] = push * flying.acceleration_mps2 / np.sqrt(3)
    path = np.random.default_rng(seed).normal(0, spread_m, (21, 3))
    last = roll_out(path, states[0, VELOCITY].copy(), 0.5, 0.0, ticks, flying, states)
    speed, acceleration = (np.linalg.norm(states[:, row], axis=1) for row in (VELOCITY, ACCELERATION))
    jerk = np.linalg.norm(np.diff(states[:, ACCELERATION], axis=0), axis=1) / flying.period_s
    within = 1 + 1e-9
    assert speed.max() <= flying.speed_mps * within
    assert acceleration.max() <= flying.acceleration_mps2 * within
    assert jerk.max() <= flying.jerk_mps3 * within
    assert last < len(states) - 1
    assert (states[last:, [VELOCITY, ACCELERATION]] == 0).all()
    assert (states[last:, POSITION] == states[last, POSITION]).all()
    assert (states[ticks + 1 :, INTEGRAL] == 0).all()


def fly(
    arm: Arm,
    field: DistanceField,
    *,
    seconds: float = 38.0,
    config: PlannerConfig = CONFIG,
    drones: int = 2,
    yaw_deg: float = 45.0,
) -> Replay:
    return replay(arm, *walker(seconds), [field], Start(drones, np.radians(yaw_deg)), config=config)


def tilt_deg(result: Replay) -> Float:
    return np.degrees(slot_of(result.position - result.actor)[..., 1])


def test_the_adaptive_formation_goes_round_the_mound_and_the_fixed_one_over_it() -> None:
    """A prototype had 38/38 deg for fixed and 17/16 for adaptive; asked for: the order, by a margin."""
    field = mound()
    fixed, adaptive = fly(FIXED, field), fly(ADAPTIVE, field)
    assert tilt_deg(fixed).max(axis=1).min() > 30
    assert tilt_deg(adaptive).max() < 20
    assert np.ptp(fixed.slots[0, :, 0]) == 0
    assert np.abs(np.degrees(adaptive.slots[0, -1, 0]) - 45) > 80
    assert tilt_deg(fixed).mean() - tilt_deg(adaptive).mean() > 5
    for result in (fixed, adaptive):
        assert field.sample(result.position)[0].min() > 1
        assert np.linalg.norm(result.position[0] - result.position[1], axis=-1).min() > 3


@pytest.mark.parametrize("arm", [FIXED, ADAPTIVE], ids=lambda arm: arm.name)
@pytest.mark.parametrize(("world", "yaw_deg"), [(bare_ground, 45.0), (bare_ground, 17.3), (open_space, 45.0)])
def test_over_bare_ground_and_in_the_open_nothing_turns_or_climbs(
    arm: Arm, world: Callable[[], DistanceField], yaw_deg: float
) -> None:
    result = fly(arm, world(), seconds=12.0, yaw_deg=yaw_deg)
    assert np.abs(tilt_deg(result) - CONFIG.tilt_deg).max() < 3
    assert np.degrees(result.slots[0, :, 0]) == pytest.approx(np.full(len(result.t_ns), yaw_deg))


def test_nothing_is_seen_before_its_time() -> None:
    """Log and map change at 6 s; until then everything flies as if they did not."""
    stamps, hips = walker(10.0)
    later = hips.copy()
    later[stamps >= 6_000_000_000, 1] += 5.0
    appearing = [replace(mound(), from_ns=6_000_000_000)]
    hips, later = hips + np.array([22.0, 0, 0]), later + np.array([22.0, 0, 0])
    plain, changed = (
        replay(ADAPTIVE, stamps, actor, fields, Start(2, np.radians(45)), config=CONFIG)
        for actor, fields in ((hips, []), (later, appearing))
    )
    before = plain.t_s < 6.0 - 1e-9
    assert np.array_equal(plain.position[:, before], changed.position[:, before])
    assert not np.allclose(plain.position[:, -1], changed.position[:, -1], atol=0.5)
    assert np.ptp(changed.slots[0, before, 0]) == 0
    assert np.ptp(changed.slots[0, :, 0]) > 0


def flown_with(seed: int = 0, **imperfections: Any) -> Replay:
    """Fly the adaptive arm over bare ground beside a walker, with imperfections."""
    config = PlannerConfig(imperfections=Imperfections(**imperfections))
    start = Start(2, np.radians(45))
    return replay(ADAPTIVE, *walker(12.0), [bare_ground()], start, config=config, seed=seed)


def test_imperfections_of_a_flight_can_be_set() -> None:
    """Positions come late or not at all, gusts push, the wind changes the energy, and batteries end."""
    plain = flown_with()
    late = flown_with(latency_s=1.0)
    early = late.t_s <= 1.0
    assert np.ptp(late.estimate[0, early], axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert np.linalg.norm(late.estimate - late.actor, axis=-1)[:, 50:].max() > 0.5
    assert not np.array_equal(flown_with(outage_share=0.5).estimate, plain.estimate)

    gusty = flown_with(gust_mps=3.0)
    off = np.linalg.norm(gusty.position - plain.position, axis=-1)
    assert 0.03 < np.sqrt((off**2).mean()) < 0.5  # 0.3/s of 3 m/s over k_position = 6/s^2 is 0.15 m an axis
    assert not np.array_equal(flown_with(1, gust_mps=3.0).position, gusty.position)
    wind = replace(CONFIG, imperfections=Imperfections(wind_mps=(-8.0, 0.0)))
    against, still = (used_kj(plain.t_s, plain.position, config)[:, -1] for config in (wind, CONFIG))
    level = np.linalg.norm(np.diff(plain.position, axis=1)[..., :2] / 0.02 + [8.0, 0.0], axis=-1)
    expected = (propulsion_w(level, 0 * level) * 0.02).sum(axis=1) / 1e3
    assert against == pytest.approx(expected, rel=0.01)
    assert (against < still).all()  # the published model is least at 10 m/s
    assert np.linalg.norm(flown_with(wind_mps=(0.0, -7.0)).velocity, axis=-1).max() <= 1.0 + 1e-6

    empty = flown_with(battery_kj=float(still.min()) / 2)
    assert 0.4 < empty.known.mean() < 0.6


def test_gimbals_turn_within_their_limits() -> None:
    """A target that moves by 90 deg at once is reached after a second at 90 deg/s; one below 45 deg never."""
    t_s, position = np.arange(0, 2, 0.02), np.zeros((1, 100, 3))
    target = np.where((t_s < 0.5)[:, None], [10.0, 0, -10.0], [0, 10.0, -10.0])[None]
    limits = Imperfections(gimbal_deg_per_s=90.0, gimbal_pitch_deg=(-30.0, 30.0))
    axis = matrix_from_quaternion(aimed(position, target, t_s, limits))[0, :, :, 2]
    yaw = np.degrees(np.arctan2(axis[:, 1], axis[:, 0]))
    assert yaw == pytest.approx(np.clip(90 * (t_s - 0.48), 0, 90), abs=1e-6)
    assert np.degrees(np.arcsin(axis[:, 2])) == pytest.approx(np.full(100, -30.0))


def test_twenty_drones_keep_their_distances() -> None:
    result = replay(FIXED, *walker(4.0), [bare_ground()], Start(20), config=replace(CONFIG, radius_m=12.0))
    apart = np.linalg.norm(result.position[:, None] - result.position[None], axis=-1)
    assert apart[~np.eye(20, dtype=bool)].min() >= CONFIG.separation_m
