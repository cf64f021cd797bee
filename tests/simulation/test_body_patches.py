from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.simulation.body import Patch, cut, together, triangles


def sheet(n: int = 6) -> Patch:
    """Make the unit square at z = 0, of n x n squares, seen from above, with values linear on it."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    corner = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1)
    place = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return Patch({"place": place, "slope": 3 * place[:, 0] - place[:, 1]}, triangles(quads.reshape(-1, 4)))


def area_upward(patch: Patch) -> Float:
    a, b, c = np.moveaxis(patch.values["place"][patch.faces], 1, 0)
    return np.asarray(np.cross(b - a, c - a)[:, 2] / 2)


@given(st.floats(0.01, 0.99), st.sampled_from([0, 1]))
def test_a_cut_along_a_line_leaves_its_part(where: float, axis: int) -> None:
    whole = sheet()
    kept = cut(whole, where - whole.values["place"][:, axis])
    area = area_upward(kept)
    np.testing.assert_allclose(area.sum(), where, atol=1e-12)
    assert area.min() > -1e-15  # nothing is turned over
    place = kept.values["place"]
    assert place[:, axis].max() <= where + 1e-12
    np.testing.assert_allclose(kept.values["slope"], 3 * place[:, 0] - place[:, 1], atol=1e-12)


@given(st.floats(-2.0, 2.0), st.floats(0.0, 6.28))
def test_both_sides_of_a_cut_make_the_whole(offset: float, angle: float) -> None:
    whole = sheet()
    along = whole.values["place"][:, :2] @ [np.cos(angle), np.sin(angle)] + offset
    sides = [cut(whole, side * along) for side in (1.0, -1.0)]
    parts = together(sides, ("place",))
    np.testing.assert_allclose(area_upward(parts).sum(), 1.0, atol=1e-12)
