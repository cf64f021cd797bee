"""Tests of the memory that long flights take."""

import tracemalloc

import numpy as np
import pytest

from pipelines.geometry.noise import GaussMarkov, pose_errors
from pipelines.reconstruction.refinement import elimination
from pipelines.reconstruction.refinement.elimination import covariances
from pipelines.reconstruction.refinement.estimate import initial_state, solve
from pipelines.reconstruction.refinement.system import Knowledge, build
from tests.reconstruction.formations import BONES, formation

CAMERAS, JOINTS = 3, 17
MODELS = (GaussMarkov(position_m=0.3, rotation_deg=1.0, correlation_s=20.0),)


def peak_bytes(times: int) -> tuple[int, int]:
    """Return the most memory that an estimate's arrays take at once, and the unknowns of a front."""
    flight = formation(times, CAMERAS, MODELS, 0)
    tracemalloc.start()
    problem = build(flight.t_s, flight.sightings, BONES)
    known = Knowledge(
        (pose_errors(MODELS),) * CAMERAS,
        np.zeros(CAMERAS),
        np.eye(JOINTS) * 100.0,
        np.full(len(BONES), 0.02),
        0.3,
        1.0,
    )
    state = initial_state(problem, known, np.nan_to_num(flight.start))
    system, _, at = solve(problem, known, state, rounds=3)
    covariances(system, at)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak, system.size


def test_an_hour_of_three_cameras_is_estimated_in_a_gigabyte(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure what a time of the skeleton adds; an hour has 108,000 times.

    Numbers of 8 bytes for each: 17 joints have 51 coordinates in the start, the state, a step and a state
    that is tried, and 153 of covariances. Each of 51 image points has 3, and one more divided by its noise.
    Each of three pictures has 38, and 6 of its white error in every state. That is some 800 numbers, 6.5 kB;
    fronts add 0.7 kB. The rest of 1.5 GB is for the program, 0.25 GB, and for its other arrays, which wait in
    files meanwhile.
    """
    usual, shorter = elimination._SEGMENT, 64
    monkeypatch.setattr(elimination, "_SEGMENT", shorter)  # the factors of a segment are a constant
    monkeypatch.setattr(elimination, "_KEPT_BYTES", 0)  # another one
    few, many = 8 * shorter + 2, 16 * shorter + 2
    (least, size), (most, _) = peak_bytes(few), peak_bytes(many)
    more_fronts = 8 * size * (size + 1) / 2 * (1 / shorter - 1 / usual)
    each = (most - least) / (many - few) - more_fronts
    assert 108_000 * each < 1e9
