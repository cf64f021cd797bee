"""Simulated instruments, rolling shutters and several people: exact without noise, and as noisy as stated."""

from typing import Any

import cv2
import numpy as np
import pytest

from pipelines.geometry.arrays import Bool
from pipelines.geometry.cameras import camera_matrix
from pipelines.geometry.poses import invert, look_at, rotation_vector_from_quaternion
from pipelines.session.storage import hash_of
from pipelines.simulation.detector_errors import see
from pipelines.simulation.flight import SimulatedFlight, fly_scenario, keypoints_of, visible_joints
from pipelines.simulation.flying import orbit
from pipelines.simulation.scenario import Scenario
from tests.synthetic.flights import LENS
from tests.synthetic.walk import walk

T_S = np.linspace(0, 5, 7)
TARGET = np.stack([1.2 * T_S, 0 * T_S, 1.0 + 0 * T_S], axis=1)


def test_pixels_agree_with_opencv() -> None:
    joints = walk(T_S)
    position, quaternion = orbit(T_S, TARGET, cameras=2)
    pixels = see(joints, position[1], quaternion[1], LENS)
    for k in range(len(T_S)):
        translation, rotation = invert(position[1, k], quaternion[1, k])
        expected, _ = cv2.projectPoints(
            joints[k],
            rotation_vector_from_quaternion(rotation),
            translation,
            camera_matrix(LENS),
            np.array(LENS.distortion),
        )
        assert pixels[k] == pytest.approx(expected[:, 0], abs=1e-6)


def test_nothing_is_seen_behind_the_camera_or_beside_the_picture() -> None:
    quaternion = look_at(np.zeros((1, 3)), np.array([[5.0, 0.0, 0.0]]))
    # 5 m ahead, 5 m behind, and 80 degrees to the left, where 40 would be the border.
    points = np.array([[[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [5.0, 28.0, 0.0]]])
    pixels = see(points, np.zeros((1, 3)), quaternion, LENS)
    assert pixels[0, 0] == pytest.approx([LENS.cx, LENS.cy])
    assert np.isnan(pixels[0, 1:]).all()


def test_a_moment_alone_is_as_in_the_whole_flight() -> None:
    """A repeated script depends on how far it is planned: always to the flight's last moment.

    Planned only to the moment asked for, the hip is up to 1.4 mm beside the truth.
    """
    steps = {"steps": [{"walk": {"distance_m": 1.5, "turn_deg": 90}}], "repeat": True}
    flight = fly_scenario(
        Scenario.model_validate({"schema": 1, "duration_s": 4, "actor": {"motion": steps}}), []
    )
    (person,) = flight.people
    for row in range(0, len(flight.t_ns), 8):
        alone = person.moving(flight.t_ns[[row]] / 1e9)
        np.testing.assert_array_equal(alone.root[0], person.motion.root[row])
        np.testing.assert_array_equal(alone.rotation[0], person.motion.rotation[row])


STANDING: dict[str, Any] = {"motion": [{"stand": {"seconds": 1}}]}
WALKING: dict[str, Any] = {"motion": [{"walk": {"distance_m": 6}}]}


def test_schema_2_films_as_drones_do() -> None:
    """Expect a readout as long as a picture at 60 Hz, and what is stated."""
    actor = {"motion": [{"stand": {"seconds": 1}}]}
    stated = {"drones": {"camera": {"rate_hz": 60, "distortion": []}}}
    of = [Scenario.model_validate({"schema": k, "duration_s": 1, "actor": actor} | stated) for k in (1, 2)]
    first, second = (each.drones.camera for each in of)
    assert first.readout_ms == 0
    assert second.readout_ms == pytest.approx(1000 / 60)
    assert (second.exposure_ms, second.distortion) == (2, [])


def scenario(actors: dict[str, Any] | None = None, **parts: Any) -> Scenario:
    """Half a second; two drones 10 m east and north of the first actor, level with the hip."""
    drones = {"camera": {"rate_hz": 10}, "formation": {"tilt_deg": 0}} | parts.pop("drones", {})
    people = {"actors": actors} if actors else {}
    return Scenario.model_validate(
        {
            "schema": 1,
            "duration_s": 0.5,
            "world": {"ground": {"size_m": 60}},
            "drones": drones,
            **people,
            **parts,
        }
    )


def seen(flight: SimulatedFlight, drone: int, person: int) -> Bool:
    return visible_joints(flight, flight.drones[drone], flight.people[person])[1]


def test_who_stands_in_the_way_hides_whoever_is_behind() -> None:
    """Ben stands between Anna and the first drone, the same body in the same pose one metre nearer.

    Seen from 10 m he is 10/9 as large about their hips, so that her hips and shoulders lie within his trunk.
    """
    flight = fly_scenario(scenario({"anna": STANDING, "ben": STANDING | {"start": [1.0, 0.0]}}), [])
    trunk = [
        flight.people[0].person.joints.index(f"{side}_{joint}")
        for side in ("left", "right")
        for joint in ("hip", "shoulder")
    ]
    assert not seen(flight, 0, 0)[:, trunk].any()
    assert seen(flight, 0, 1).all()
    assert seen(flight, 1, 0).all()  # from the side nobody stands before anybody
    assert seen(flight, 1, 1).all()
    pixels, confidence = keypoints_of(flight, flight.drones[0], flight.people[0])
    _, nearer = keypoints_of(flight, flight.drones[0], flight.people[1])
    # Seven of ten hidden joints are missed: of 20 draws at least five, but for one case in ten thousand.
    assert np.isnan(pixels[:, trunk, 0]).sum() >= 5
    assert confidence[:, trunk].mean() < 0.5 * nearer[:, trunk].mean()


def test_whoever_comes_along_leaves_the_first_actor_and_the_drones_as_they_were() -> None:
    alone = fly_scenario(scenario(actor=WALKING), [])
    both = fly_scenario(scenario({"anna": WALKING, "ben": WALKING | {"start": [0.0, -5.0]}}), [])
    np.testing.assert_array_equal(alone.people[0].joints, both.people[0].joints)
    np.testing.assert_array_equal(alone.people[0].estimate, both.people[0].estimate)
    for one, other in zip(alone.drones, both.drones, strict=True):
        np.testing.assert_array_equal(one.at_frames.camera_position, other.at_frames.camera_position)
        found = keypoints_of(alone, one, alone.people[0]), keypoints_of(both, other, both.people[0])
        for mine, same in zip(*found, strict=True):
            np.testing.assert_array_equal(mine, same)
    assert [person.topic for person in alone.people] == ["/actor"]
    assert [person.topic for person in both.people] == ["/actor/anna", "/actor/ben"]


def test_the_drones_follow_the_first() -> None:
    """They start in their slots about the first, ten metres away, and look at the first's hip."""
    people = {"anna": STANDING, "ben": STANDING | {"start": [3.0, 4.0]}}
    for order in (("anna", "ben"), ("ben", "anna")):
        plan = scenario({name: people[name] for name in order})
        flight = fly_scenario(plan, [])
        for drone in flight.drones:
            away = drone.at_frames.position[0] - flight.people[0].motion.root[0]
            assert np.linalg.norm(away) == pytest.approx(10, abs=0.02)
        assert flight.people[0].name == order[0]
    swapped = scenario(dict(reversed(people.items())))
    assert hash_of(scenario(people).identity()) != hash_of(swapped.identity())
