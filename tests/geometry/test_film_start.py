"""The start of a video from points of known scenes, seen by cameras whose motion is known by formula."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float
from pipelines.geometry.clocks import StartFit, TrackedPoints, fit_start

Motion = Callable[[Float], tuple[Float, Rotation]]
"""Positions m [N, 3] and attitudes [N] of a camera at times s [N]."""

EPOCH_NS = 1_700_000_000_000_000_000
START_S = 17.3456
POINTS, STRETCH_S = 40, 0.2
SCATTER = 5e-4  # rad: a tenth of a pixel of pictures 320 px wide


def turning(t_s: Float) -> tuple[Float, Rotation]:
    """Rotate a camera in one place; the frequencies have no common period, so the motion never repeats."""
    yaw = 0.5 * np.sin(0.7 * t_s) + 0.2 * np.sin(2.3 * t_s)
    pitch = 0.1 * np.sin(1.1 * t_s + 1)
    return np.zeros((len(t_s), 3)), Rotation.from_euler("YX", np.stack([yaw, pitch], axis=1))


def flying(t_s: Float) -> tuple[Float, Rotation]:
    """Fly a swaying camera beside a walking person and aim at them, so that points move by parallax."""
    x = 1.3 * t_s + 0.5 * np.sin(0.9 * t_s)
    z = 0.8 * np.sin(0.55 * t_s)
    yaw = np.arctan2(1.3 * t_s - x, 10 - z)
    return np.stack([x, 0.3 * np.sin(1.7 * t_s), z], axis=1), Rotation.from_euler("Y", yaw[:, None])


def swinging(amplitude_rad: float, period_s: float) -> Motion:
    return lambda t_s: (
        np.zeros((len(t_s), 3)),
        Rotation.from_euler("Y", amplitude_rad * np.sin(2 * np.pi * t_s / period_s)[:, None]),
    )


def seen(motion: Motion, start_s: float, seconds: float, scatter: float = SCATTER) -> TrackedPoints:
    """Make points 5 to 50 m away, new ones in every stretch, with some scatter in the picture."""
    rng = np.random.default_rng(8)
    begin_s = np.arange(0.0, seconds - STRETCH_S, STRETCH_S)
    end_s = begin_s + STRETCH_S
    (from_place, from_attitude), (to_place, to_attitude) = motion(begin_s + start_s), motion(end_s + start_s)
    stretch = np.repeat(np.arange(len(begin_s)), POINTS)
    begin = rng.uniform(-0.5, 0.5, (len(stretch), 2))
    depth = rng.uniform(5, 50, (len(stretch), 1))
    in_world = from_attitude[stretch].apply(depth * np.column_stack([begin, np.ones(len(begin))]))
    there = to_attitude[stretch].inv().apply(in_world + from_place[stretch] - to_place[stretch])
    return TrackedPoints(
        np.round(begin_s * 1e9).astype(np.int64),
        np.round(end_s * 1e9).astype(np.int64),
        stretch,
        begin,
        there[:, :2] / there[:, 2:] + scatter * rng.standard_normal((len(stretch), 2)),
    )


def fitted(motion: Motion, log_s: Float, followed: TrackedPoints, near_s: float | None = None) -> StartFit:
    place, attitude = motion(log_s)
    return fit_start(
        EPOCH_NS + np.round(log_s * 1e9).astype(np.int64),
        place,
        attitude.as_quat(),
        followed,
        max_gap_ns=500_000_000,
        near_ns=None if near_s is None else EPOCH_NS + round(near_s * 1e9),
    )


LOG_S = np.arange(0.0, 40.0, 0.01)


@pytest.mark.parametrize("motion", [turning, flying])
def test_the_start_is_found_to_a_fraction_of_a_picture(motion: Motion) -> None:
    found = fitted(motion, LOG_S, seen(motion, START_S, 10.0))
    # 2000 points whose scatter, 0.5 mrad, stands against motion that changes by some 0.1 rad/s^2 in a fifth
    # of a second, 20 mrad/s: 25 ms each, 0.6 ms together. As much again for the poses' window of 0.1 s,
    # which lowers what changes fast but delays nothing.
    assert (found.start_ns - EPOCH_NS) / 1e9 == pytest.approx(START_S, abs=4 * found.sigma_s + 1e-3)
    assert found.sigma_s < 5e-3
    assert found.beside < 5 * SCATTER < found.moved


def test_the_sigma_is_that_of_the_errors() -> None:
    """Check errors against four sigma, with scatter of a fifth of a pixel and a gap in the log."""
    log_s = LOG_S[(LOG_S < 25) | (LOG_S > 26)]
    errors = []
    for start_s in (6.0, 11.3, 16.1, 21.7):
        found = fitted(flying, log_s, seen(flying, start_s, 12.0, 2 * SCATTER), near_s=start_s + 0.4)
        errors.append(((found.start_ns - EPOCH_NS) / 1e9 - start_s) / found.sigma_s)
        assert 1e-4 < found.sigma_s < 0.03
    assert np.abs(errors).max() < 4
    assert np.abs(errors).max() > 0.2  # nor is it far too large


def even(t_s: Float) -> tuple[Float, Rotation]:
    return np.zeros((len(t_s), 3)), Rotation.from_euler("Y", 0.3 * t_s[:, None])


@pytest.mark.parametrize(
    ("motion", "problem"),
    [
        (even, "at several times"),  # every time is as good
        (swinging(0.3, 4.0), r"(4|8|12|16|20)\.\d\d s apart"),  # the same every four seconds
        (swinging(0.0, 4.0), "do not move as the poses do"),
    ],
)
def test_motion_that_says_nothing_of_time_is_refused(motion: Motion, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        fitted(motion, LOG_S, seen(motion, START_S, 10.0))


def test_motion_that_repeats_is_enough_near_a_start_that_is_known() -> None:
    motion = swinging(0.3, 4.0)
    found = fitted(motion, LOG_S, seen(motion, START_S, 10.0), near_s=START_S - 0.5)
    assert (found.start_ns - EPOCH_NS) / 1e9 == pytest.approx(START_S, abs=4 * found.sigma_s + 1e-3)
    with pytest.raises(ValueError, match=r" \+(2\.9|3\.0)\d s\b"):
        fitted(flying, LOG_S, seen(flying, START_S, 10.0), near_s=START_S - 3)


def test_pictures_of_another_flight_are_refused() -> None:
    with pytest.raises(ValueError, match="do not move as the poses do"):
        fitted(turning, LOG_S, seen(swinging(0.4, 3.7), START_S, 10.0))
    followed = seen(turning, START_S, 10.0)
    nothing = TrackedPoints(
        followed.begin_ns, followed.end_ns, followed.stretch[:0], followed.begin[:0], followed.end[:0]
    )
    with pytest.raises(ValueError, match="nothing in them can be followed"):
        fitted(turning, LOG_S, nothing)
    with pytest.raises(ValueError, match="cover less than half"):
        fitted(turning, LOG_S[:200], followed)


def shaking(t_s: Float) -> tuple[Float, Rotation]:
    """Rotate about both axes by up to 8 deg, all the time but never in the same way."""
    yaw = 0.113 * np.sin(2.116 * t_s) + 0.034 * np.sin(4.866 * t_s)
    pitch = 0.049 * np.sin(2.521 * t_s + 1)
    return np.zeros((len(t_s), 3)), Rotation.from_euler("YX", np.stack([yaw, pitch], axis=1))


@pytest.mark.parametrize("start_s", [6.0, 8.7, 11.3, 16.1, 19.6, 21.7])
def test_points_that_hardly_scatter_say_the_start_no_worse(start_s: float) -> None:
    """Use a likelihood so sharp that full steps of Newton's method jump from side to side of its peak."""
    found = fitted(shaking, LOG_S, seen(shaking, start_s, 8.0, 1.4e-4), near_s=start_s + 0.3)
    assert (found.start_ns - EPOCH_NS) / 1e9 == pytest.approx(start_s, abs=4 * found.sigma_s + 1e-3)
    assert found.sigma_s < 0.01
