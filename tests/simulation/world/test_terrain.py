"""The ground against its closed form, and its bounds against dense sampling."""

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.simulation import scenario
from tests.simulation.world.sites import MOUNDS, everything, site


def closed_form(xy: Float) -> Float:
    """Compute h exp(-d' S^-1 d / 2) with S = R diag(sigma^2) R', mound by mound."""
    total = np.zeros(xy.shape[:-1])
    for mound in map(scenario.Mound.model_validate, MOUNDS):
        yaw = np.radians(mound.yaw_deg)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        spread = np.linalg.inv(turn @ np.diag(np.square(mound.sigma_m)) @ turn.T)
        away = xy - np.array(mound.centre)
        total += mound.height_m * np.exp(-np.einsum("...i,ij,...j->...", away, spread, away) / 2)
    return total


def scattered(count: int) -> Float:
    return np.random.default_rng(5).uniform(-12, 12, (count, 2))


def test_heights_are_those_of_the_formula() -> None:
    world, xy = everything(), scattered(400).reshape(20, 20, 2)
    assert world.height(xy).shape == (20, 20)
    np.testing.assert_allclose(
        world.height(xy), closed_form(xy), rtol=0, atol=1e-13
    )  # sums of two numbers < 3
    assert world.height(np.array([1e6, -1e6])) == 0.0, "defined everywhere"
    assert np.array_equal(site().height(xy), np.zeros((20, 20)))


def test_no_place_is_steeper_or_more_curved_than_stated() -> None:
    terrain, step = everything().terrain, 1e-3
    axis = np.linspace(-12, 12, 121)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    east, north = step * np.eye(2)

    def height(*by: Float) -> Float:
        return terrain.height(xy + sum(by, np.zeros(2)))

    slopes = [(height(way) - height(-way)) / (2 * step) for way in (east, north)]
    steepest = np.hypot(*slopes).max()
    # The bounds add up what the mounds reach at different places, so they are not met, but of their size.
    assert 0.6 * terrain.slope < steepest <= terrain.slope
    (ee, nn) = ((height(way) + height(-way) - 2 * height()) / step**2 for way in (east, north))
    en = (height(east, north) + height(-east, -north) - height(east, -north) - height(-east, north)) / (
        4 * step**2
    )
    hessian = np.stack([np.stack([ee, en], axis=-1), np.stack([en, nn], axis=-1)], axis=-1)
    curved = np.linalg.norm(hessian, ord=2, axis=(-2, -1))
    assert 0.6 * terrain.curvature < curved.max() <= terrain.curvature
    for radius in (0.3, 2.0):
        centre = np.random.default_rng(2).uniform(-10, 10, (40, 2))
        bound = terrain.curvature_within(centre, radius)
        within = np.linalg.norm(xy - centre[:, None], axis=-1) <= radius
        assert all(curved[near].max() <= limit + 1e-5 for near, limit in zip(within, bound, strict=True))
