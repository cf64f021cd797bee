"""Planning for several people, where the answer is known, and the arm `group` in flight."""

import numpy as np
import pytest

from pipelines.planning.arms import ADAPTIVE, GROUP
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import open_space
from pipelines.planning.forecast import Forecast
from pipelines.planning.formation import formation_slots, slot_offsets
from pipelines.planning.replay import Start, replay
from pipelines.planning.scores import blind_s, hidden_by_people, sights

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
