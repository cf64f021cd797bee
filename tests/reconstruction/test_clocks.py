"""Clock offsets: found if the person moves, and reported as unknown if nothing moves."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.noise import Bias, NoiseModel, White, pose_errors
from pipelines.geometry.triangulation import Views
from pipelines.reconstruction.clocks import meeting_best, searched_offsets_s
from pipelines.reconstruction.refinement.refine import Refined, refine
from pipelines.reconstruction.refinement.system import Sighting
from tests.reconstruction.formations import BONES, FOCAL_PX, Formation, formation

PRIOR_S = 0.2


def refined(sightings: list[Sighting], t_s: NDArray[np.float64], start: NDArray[np.float64]) -> Refined:
    return refine(t_s, sightings, start, BONES, [pose_errors([])] * 2, np.array([0.0, PRIOR_S]))


def test_a_clock_is_known_where_the_person_moves_and_unknown_where_nothing_does() -> None:
    flight = formation(45, 2, [], 0, still=True, late_s=(0.0, 0.02))
    walking = refined(flight.sightings, flight.t_s, flight.start)
    assert walking.clock_offset_s[0] == walking.clock_sigma_s[0] == 0.0
    # Half the pictures of a flight whose clock was known to 0.8 ms; then three estimated sigmas.
    assert walking.clock_sigma_s[1] < 0.003
    assert abs(walking.clock_offset_s[1] - 0.02) < 3 * walking.clock_sigma_s[1]

    rng = np.random.default_rng(0)
    frozen = [
        replace(s, rays=s.rays[:1] + rng.normal(0, 2 / FOCAL_PX, s.rays.shape)) for s in flight.sightings
    ]
    standing = refined(frozen, flight.t_s, np.repeat(flight.start[:1], 45, axis=0))
    # What is left is the noise, which passes for motion: it leaves a third of the prior at least.
    assert standing.clock_sigma_s[1] > PRIOR_S / 3


TIMES, LATE_S, SIGMA_S = 150, 0.45, 0.5
STEP_S = 1 / 15
ROUGH = [Bias(position_m=0.3, rotation_deg=1.0), White(position_m=0.1, rotation_deg=0.5)]


def seen(flight: Formation, shift_s: float, unknown: NDArray[np.bool_]) -> Views:
    """Build the flight's joint-frames with the stamps of unknown clocks moved forward."""
    views: list[Float] = []
    for camera, sighting in enumerate(flight.sightings):
        at_s = flight.t_s - (shift_s if unknown[camera] else 0.0)
        xy = sighting.rays.reshape(len(flight.t_s), -1)
        moved = [np.interp(at_s, flight.t_s, column, left=np.nan, right=np.nan) for column in xy.T]
        views.append(np.stack(moved, axis=1).reshape(-1, 2))
    times, joints = flight.sightings[0].confidence.shape
    cameras = len(views)
    rays = np.stack(views, axis=1)
    return Views(
        rays=rays,
        weight=np.isfinite(rays[..., 0]).astype(np.float64),
        pose_index=np.repeat(np.arange(times), joints),
        position=np.stack([s.position for s in flight.sightings], axis=1),
        rotation=np.stack([s.rotation for s in flight.sightings], axis=1),
        focal=np.full(cameras, FOCAL_PX),
        pixel_sigma=np.full(cameras, 2.0),
        pose_sigma=np.zeros((times, cameras, 2)),
    )


def searched_offsets(flight: Formation, sigma_s: Float) -> Float:
    return searched_offsets_s(lambda shift_s: seen(flight, shift_s, sigma_s > 0), flight.t_s, sigma_s)[0]


@pytest.mark.parametrize("models", [[], ROUGH], ids=["exact", "rough"])
@pytest.mark.parametrize("late_s", [LATE_S, -LATE_S])
def test_half_a_second_is_found_to_a_step(models: list[NoiseModel], late_s: float) -> None:
    flight = formation(TIMES, 3, models, 0, late_s=(0.0, late_s, 0.0))
    found = searched_offsets(flight, np.array([0.0, SIGMA_S, SIGMA_S]))
    assert found[0] == 0.0
    np.testing.assert_allclose(found[1:], [late_s, 0.0], atol=STEP_S)


@pytest.mark.parametrize("of_log", [[1], [2], [1, 2], []])
def test_rays_say_of_two_cameras_whether_pictures_or_their_log_are_late(of_log: list[int]) -> None:
    """Pictures are 0.2 s off where they were moved and the log is late, or the other way about."""
    truth, suspects = np.isin(np.arange(4), of_log), np.array([False, True, True, False])
    walking = formation(TIMES, 4, ROUGH, 1)
    found = meeting_best(lambda late: seen(walking, 0.2, late ^ truth), suspects, walking.t_s)
    assert found.tolist() == truth.tolist()


def test_chance_says_nothing_of_late_logs() -> None:
    walking, rng = formation(TIMES, 3, ROUGH, 1), np.random.default_rng(0)
    right = seen(walking, 0.0, np.zeros(3, dtype=np.bool_))

    def with_errors(_: Bool) -> Views:
        return replace(right, rays=right.rays + rng.normal(0, 2 / FOCAL_PX, right.rays.shape))

    assert not meeting_best(with_errors, np.array([False, True, True]), walking.t_s).any()


def test_a_camera_that_sees_nothing_for_a_while_is_left_out_then() -> None:
    flight = formation(TIMES, 3, [], 0, late_s=(0.0, 0.0, LATE_S))
    flight.sightings[1].rays[40:80] = np.nan
    found = searched_offsets(flight, np.array([0.0, 0.0, SIGMA_S]))
    np.testing.assert_allclose(found, [0.0, 0.0, LATE_S], atol=STEP_S)


def test_no_offset_is_searched_where_all_clocks_are_known_or_none() -> None:
    flight = formation(TIMES, 2, [], 0, late_s=(0.0, LATE_S))
    assert not searched_offsets(flight, np.zeros(2)).any()
    assert not searched_offsets(flight, np.full(2, SIGMA_S)).any()


def test_who_stands_still_leaves_clocks_where_they_are() -> None:
    flight = formation(TIMES, 2, [], 0, still=True)
    rng = np.random.default_rng(0)
    for sighting in flight.sightings:
        sighting.rays[:] = sighting.rays[:1] + rng.normal(0, 2 / FOCAL_PX, sighting.rays.shape)
    assert not searched_offsets(flight, np.array([0.0, SIGMA_S])).any()
