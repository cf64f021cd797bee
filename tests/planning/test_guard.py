"""The invariant that keeps replayed drones safe, for any plan."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.planning.arms import FIXED
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, distance_field, open_space
from pipelines.planning.forecast import ActorFilter
from pipelines.planning.guard import FlownMotion, Guard, least_distances, wanted_clearance_m
from pipelines.planning.local import DronePlan
from pipelines.planning.replay import Start, replay
from pipelines.session.records import Occupancy
from tests.synthetic.worlds import fly, world_of

CONFIG = PlannerConfig()
TICKS = round(CONFIG.tuning.tracking_hz / CONFIG.tuning.local_hz)


def boulders(seed: int, side_m: float = 0.5) -> DistanceField:
    """Make a box of 20 x 20 x 10 m with random boulders of one voxel to three."""
    rng = np.random.default_rng(seed)
    occupied = np.zeros([round(length / side_m) for length in (20, 20, 10)], dtype=np.float32)
    for corner in rng.integers(0, occupied.shape, (25, 3)):
        size = rng.integers(1, 4, 3)
        occupied[tuple(slice(c, c + s) for c, s in zip(corner, size, strict=True))] = 1
    return distance_field(Occupancy(occupied, np.array([-10.0, -10.0, 0.0]), side_m))


def slab(thick_m: float, side_m: float) -> DistanceField:
    """Make a wall across y = 0, 40 m wide and 8 m high."""
    across, along, high = (round(length / side_m) for length in (40.0, 20.0, 12.0))
    y = side_m * (np.arange(along) + 0.5) - 10.0
    z = side_m * (np.arange(high) + 0.5)
    occupied = np.broadcast_to(((y >= 0) & (y < thick_m))[:, None] & (z < 8.0), (across, along, high))
    return distance_field(Occupancy(occupied.astype(np.float32), np.array([-20.0, -10.0, 0.0]), side_m))


def someone_at(*places: tuple[float, Float]) -> ActorFilter:
    actor = ActorFilter(q=CONFIG.actor_q, sigma_m=CONFIG.tuning.actor_sigma_m)
    for t_s, place in places:
        actor.measure(t_s, place)
    return actor


FAR_AWAY = someone_at((0.0, np.array([500.0, 0.0, 0.0])))
NOBODY = np.empty((0, 1, 3))


def free_places(field: DistanceField, count: int, rng: np.random.Generator) -> Float:
    """Draw random places [count, 3] that keep all distances."""
    found: list[Float] = []
    while len(found) < count:
        place = rng.uniform([-10, -10, 1], [10, 10, 9])
        clear = field.sample(place)[0] >= wanted_clearance_m(CONFIG, field.grid)
        if clear and all(np.linalg.norm(place - other) >= CONFIG.separation_m for other in found):
            found.append(place)
    return np.array(found)


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**31), side_m=st.sampled_from([0.25, 0.5]), drones=st.integers(1, 4))
def test_drones_can_always_stop_in_free_space_whatever_plans_ask_for(
    seed: int, side_m: float, drones: int
) -> None:
    """Random plans through boulders: flown motions keep the distances, and so does every committed stop."""
    rng = np.random.default_rng(seed)
    field = boulders(seed, side_m)
    guard = Guard(free_places(field, drones, rng), CONFIG)
    wanted_m = wanted_clearance_m(CONFIG, field.grid) - 1e-5
    flown, motion = [guard.position], []
    for turn in range(25):
        for drone in range(drones):
            steps = rng.normal(0, rng.uniform(0.2, 3.0), (21, 3))
            path = guard.position[drone] + np.cumsum(steps, axis=0) - steps[0]
            guard.admit(
                drone, 0.2 * turn, DronePlan(0.2 * turn, path, guard.velocity[drone], 0.5), FAR_AWAY, field
            )
        for drone, states in enumerate(guard.committed()):
            assert (states[-1, 1:3] == 0).all()
            distances = least_distances(field.grid, states, len(states) - 1, NOBODY, states[:1], NOBODY, 0.02)
            assert distances[0] >= wanted_m
            motion.append((drone, states[0, 0]))
        ways = np.stack([states[:, 0] for states in guard.committed()])
        apart = np.linalg.norm(ways[:, None] - ways[None], axis=-1)
        assert apart[~np.eye(drones, dtype=bool)].min(initial=np.inf) >= CONFIG.separation_m - 1e-5
        for _ in range(TICKS):
            guard.fly(1)
            flown.append(guard.position)
    path = np.stack(flown, axis=1)  # [N, T, 3]
    finely = np.concatenate(
        [path[:, :-1] + u * np.diff(path, axis=1) for u in (0.0, 0.25, 0.5, 0.75)], axis=1
    )
    assert field.sample(finely)[0].min() >= wanted_m
    assert guard.counts[FlownMotion.UNSAFE] == 0
    assert guard.counts.total() == 25 * drones


@pytest.mark.parametrize("depth_m", [0.3, -0.2])  # in the wall, and within the radius of it
def test_who_starts_too_near_leaves_by_the_shortest_way(depth_m: float) -> None:
    """The wall is 4 m thick; its near face is at y = 0. The way out is straight back, never deeper."""
    field = slab(4.0, 0.25)
    start = np.array([[0.1, depth_m, 3.0]])
    guard = Guard(start, CONFIG)
    wanted_m = wanted_clearance_m(CONFIG, field.grid)
    ahead = start[0] + np.array([0.0, 1.0, 0.0]) * np.linspace(0, 20, 21)[:, None]
    path = [guard.position[0]]
    for turn in range(15):
        guard.admit(0, 0.2 * turn, DronePlan(0.2 * turn, ahead, guard.velocity[0], 0.5), FAR_AWAY, field)
        for _ in range(TICKS):
            guard.fly(1)
            path.append(guard.position[0])
    flown = np.array(path)
    assert guard.counts[FlownMotion.LEFT] > 0
    clearance = field.sample(flown)[0]
    out = int(np.flatnonzero(clearance >= wanted_m)[0])
    assert (np.diff(clearance[: out + 1]) > -1e-3).all()
    assert clearance[out:].min() >= wanted_m - 1e-3
    assert np.linalg.norm(flown[: out + 1, [0, 2]] - start[0, [0, 2]], axis=1).max() < 0.25  # one voxel aside


def test_a_drone_in_the_way_of_somebody_who_walks_gives_way() -> None:
    """They walk at 1.5 m/s straight through where the drone wants to hover, at hip height."""
    place = np.array([0.0, 0.0, 1.5])
    guard = Guard(place[None], CONFIG)
    actor = ActorFilter(q=CONFIG.actor_q, sigma_m=CONFIG.tuning.actor_sigma_m)
    nearest = np.inf
    for turn in range(80):
        t_s = 0.2 * turn
        hips = np.array([-12.0 + 1.5 * t_s, 0.0, 1.0])
        actor.measure(t_s, hips)
        hover = DronePlan(t_s, np.tile(place, (21, 1)), guard.velocity[0], 0.5)
        guard.admit(0, t_s, hover, actor, open_space())
        for k in range(TICKS):
            away = guard.position[0] - (hips + np.array([1.5 * 0.02 * k, 0.0, 0.0]))
            nearest = min(nearest, float(np.linalg.norm(away)))
            guard.fly(1)
    assert nearest >= CONFIG.actor_distance_m
    assert guard.counts[FlownMotion.GAVE_WAY] + guard.counts[FlownMotion.CLIMBED] > 0


@pytest.mark.parametrize("yaw_deg", [180.0, 90.0])
def test_somebody_who_turns_back_at_a_run_is_kept_away_from(yaw_deg: float) -> None:
    """They run at 5 m/s towards east, and after 6 s towards the drones of the arm that follows them."""
    t_s = np.arange(0.0, 12.0, 0.1)
    east = 5.0 * (t_s - 2.0 * np.maximum(t_s - 6.0, 0.0))
    hips = np.stack([east, 0 * t_s, 0 * t_s + 1.0], axis=1)
    config = PlannerConfig(radius_m=8.0, actor_q=1.5)
    start = Start(2, np.radians(yaw_deg))
    done = replay(FIXED, (t_s * 1e9).astype(np.int64), hips, [open_space()], start, config=config)
    assert np.linalg.norm(done.position - done.actor, axis=-1).min() >= config.actor_distance_m


@pytest.mark.slow
@pytest.mark.parametrize("seed", [17, 32])
def test_random_worlds_are_flown_without_touching_anything(seed: int) -> None:
    """A slice of the worlds of `benchmarks.planner`: forest, hills, walls, and starts beside obstacles."""
    for row in fly(seed, arms=("adaptive", "joint")):
        assert row["clearance_m"] > 0, row
        assert row["ground_m"] >= CONFIG.drone_radius_m, row
        assert row["limits"] == 0, row
        voxel_m = world_of(seed).resolution_m  # surfaces lie within half a voxel of those of the map
        assert row["clearance_m"] >= min(CONFIG.drone_radius_m, row["first_m"] - voxel_m / 2), row
        assert row["actor_m"] >= CONFIG.actor_distance_m, row
