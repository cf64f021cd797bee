"""The start of pictures from how the camera turned, where that is known by formula."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.geometry.turning import StartFit, fit_start

Float = NDArray[np.float64]

EPOCH_NS = 1_700_000_000_000_000_000
START_S = 17.3456


def attitude(t_s: Float) -> Rotation:
    """Looking about, as nobody does twice alike: frequencies without a common measure."""
    yaw = 0.5 * np.sin(0.7 * t_s) + 0.2 * np.sin(2.3 * t_s)
    pitch = 0.1 * np.sin(1.1 * t_s + 1)
    return Rotation.from_euler("ZY", np.stack([yaw, pitch], axis=1))


def fitted(
    of: Rotation, pictures: Rotation, log_s: Float, pts_s: Float, sigma_rad: float = 0.0, gap_s: float = 0.5
) -> StartFit:
    rng = np.random.default_rng(8)
    turned = (pictures[:-1].inv() * pictures[1:]).as_rotvec()
    return fit_start(
        EPOCH_NS + np.round(log_s * 1e9).astype(np.int64),
        of.as_quat(),
        np.round(pts_s * 1e9).astype(np.int64),
        turned + sigma_rad * rng.standard_normal(turned.shape),
        max_gap_ns=round(gap_s * 1e9),
    )


def test_the_start_is_found_to_a_fraction_of_a_picture() -> None:
    log_s, pts_s = np.arange(0.0, 60.0, 0.01), np.arange(300) / 30
    found = fitted(attitude(log_s), attitude(pts_s + START_S), log_s, pts_s)
    # Means over 33 ms in place of 10 are those of the same middle: they lower the rates (by a 24th of the
    # square of 33 ms times their curvature, 0.03 %), but delay nothing. What is left comes of the ends, where
    # smoothing is uneven. A millisecond is a thirtieth of a picture.
    assert (found.start_ns - EPOCH_NS) / 1e9 == pytest.approx(START_S, abs=1e-3)
    assert found.sigma_s < 1e-3
    assert found.explained > 0.999


def test_the_sigma_is_that_of_the_errors() -> None:
    """Pictures that err by 0.1 deg, gaps in both: within four of its standard deviations."""
    log_s, pts_s = np.arange(0.0, 60.0, 0.01), np.arange(600) / 30
    log_s = log_s[(log_s < 25) | (log_s > 26)]
    errors = []
    for start_s in np.arange(10.0, 30.0, 1.7):
        found = fitted(attitude(log_s), attitude(pts_s + start_s), log_s, pts_s, np.radians(0.1))
        errors.append(((found.start_ns - EPOCH_NS) / 1e9 - start_s) / found.sigma_s)
        assert 1e-4 < found.sigma_s < 0.02
    assert np.abs(errors).max() < 4
    assert np.abs(errors).max() > 0.3  # nor is it far too large


def test_pictures_that_begin_before_the_log() -> None:
    log_s, pts_s = np.arange(5.0, 60.0, 0.01), np.arange(300) / 30
    found = fitted(attitude(log_s), attitude(pts_s + 2.0), log_s, pts_s)
    assert (found.start_ns - EPOCH_NS) / 1e9 == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(
    ("yaw_rad", "problem"),
    [
        (lambda t_s: 0.3 * t_s, "at several times"),  # an even turn: every time is as good
        (lambda t_s: 0.3 * np.sin(2 * np.pi * t_s / 4), "4.00 s apart"),  # the same every four seconds
        (lambda t_s: 0.0 * t_s, "do not turn as the poses do|at several times"),
    ],
)
def test_turning_that_says_nothing_of_time_is_refused(yaw_rad: object, problem: str) -> None:
    log_s, pts_s = np.arange(0.0, 60.0, 0.01), np.arange(300) / 30

    def turned(t_s: Float) -> Rotation:
        assert callable(yaw_rad)
        return Rotation.from_euler("Z", np.asarray(yaw_rad(t_s))[:, None])

    with pytest.raises(ValueError, match=problem):
        fitted(turned(log_s), turned(pts_s + START_S), log_s, pts_s, np.radians(0.01))


def test_pictures_of_another_flight_are_refused() -> None:
    log_s, pts_s = np.arange(0.0, 60.0, 0.01), np.arange(300) / 30
    other = Rotation.from_euler("X", 0.4 * np.sin(1.7 * pts_s)[:, None])
    with pytest.raises(ValueError, match="do not turn as the poses do"):
        fitted(attitude(log_s), other, log_s, pts_s)
    nothing = np.full((299, 3), np.nan)
    with pytest.raises(ValueError, match="cannot be measured"):
        fit_start(
            np.arange(100) * 10**7,
            attitude(np.arange(100) / 100).as_quat(),
            np.round(pts_s * 1e9).astype(np.int64),
            nothing,
            max_gap_ns=10**9,
        )
