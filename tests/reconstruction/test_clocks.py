"""Clock offsets: found if the person moves, and reported as unknown if nothing moves."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.noise import pose_errors
from pipelines.reconstruction.refinement.refine import Refined, refine
from pipelines.reconstruction.refinement.system import Sighting
from tests.reconstruction.formations import BONES, FOCAL_PX, formation

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
    assert standing.clock_sigma_s[1] > 0.5 * PRIOR_S
