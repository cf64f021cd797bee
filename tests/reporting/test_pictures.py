"""Skeletons, keypoints and ellipses, drawn onto pictures."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Intrinsics, Picture
from pipelines.reporting.overlays import OverlayView
from pipelines.reporting.pictures import (
    CHI2_95,
    FOUND,
    GREY,
    REJECTED,
    SIDES,
    UNMEASURED,
    draw_frame,
    draw_panel,
    window_of,
)

JOINTS = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
BODY = np.array([[[620.0, 300.0], [520.0, 300.0], [615.0, 380.0], [525.0, 380.0]]])
WIDTH, HEIGHT = 1280, 720
MISSING = np.full_like(BODY, np.nan)
GROUND = np.full((HEIGHT, WIDTH, 3), GREY, np.uint8)


@pytest.fixture
def view() -> OverlayView:
    nobody = np.zeros((1, 4), dtype=np.bool_)
    return OverlayView(
        camera="drone1",
        intrinsics=Intrinsics(WIDTH, HEIGHT, 900.0, 900.0, 639.5, 359.5),
        joints=JOINTS,
        frame=3,
        t_s=0.1,
        found=MISSING,
        reprojected=BODY,
        rejected=nobody,
        unmeasured=nobody,
        others=np.zeros((0, 4, 2)),
        has_pose=True,
        picture=None,
    )


def changed(picture: Picture) -> NDArray[np.bool_]:
    return np.asarray((picture != GREY).any(axis=-1), np.bool_)


def test_bones_have_the_colour_of_their_side_and_lie_on_pixel_centres(view: OverlayView) -> None:
    drawn = draw_frame(GROUND, view, ())
    for point, side in zip(BODY[0].astype(int), ("left", "right", "left", "right"), strict=True):
        assert drawn[point[1], point[0]].tolist() == list(SIDES[side])
    assert drawn[300, 570].tolist() == list(SIDES[""])  # halfway between the shoulders
    assert drawn[340, 617].tolist() == list(SIDES["left"])
    assert drawn[340, 523].tolist() == list(SIDES["right"])
    # A dot about a pixel's centre is as large on both sides of it.
    rows, columns = np.nonzero(changed(draw_frame(GROUND, replace(view, reprojected=_only(0)), ())))
    assert (rows.min() + rows.max()) / 2 == 300
    assert (columns.min() + columns.max()) / 2 == 620


def _only(joint: int) -> NDArray[np.float64]:
    alone = MISSING.copy()
    alone[0, joint] = BODY[0, joint]
    return alone


def test_keypoints_are_rings_and_lost_ones_crosses(view: OverlayView) -> None:
    flags = np.eye(4, dtype=np.bool_)
    drawn = draw_frame(
        GROUND, replace(view, reprojected=MISSING, found=BODY, rejected=flags[[1]], unmeasured=flags[[2]]), ()
    )
    for joint, colour in ((0, FOUND), (1, REJECTED), (2, UNMEASURED), (3, FOUND)):
        x, y = BODY[0, joint].astype(int)
        around = drawn[y - 8 : y + 9, x - 8 : x + 9]
        strokes = np.linalg.norm(around - np.array(colour, float), axis=-1)
        assert strokes.min() < np.linalg.norm(np.array(colour, float) - GREY) / 3  # thin, and smoothed
        assert (drawn[y, x] == GREY).all() == (colour == FOUND)  # a ring leaves its middle free


def test_ellipses_hold_95_percent(view: OverlayView) -> None:
    covariance = np.array([[400.0, 150.0], [150.0, 100.0]])
    spread = np.full((1, 4, 2, 2), np.nan)
    spread[0, 0] = covariance  # of the left shoulder
    alone = replace(view, reprojected=_only(0))
    drawn = changed(draw_frame(GROUND, replace(alone, spread=spread), ()))
    outline = drawn & ~changed(draw_frame(GROUND, alone, ()))
    rows, columns = np.nonzero(outline)
    offset = np.stack([columns, rows], axis=1) - BODY[0, 0]
    squared = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset)
    # The pen is a pixel wide on either side; along the short axis (6.1 px of sigma) that is 0.16 of 2.45.
    short = np.sqrt(np.linalg.eigvalsh(covariance)[0])
    assert np.abs(np.sqrt(squared) - np.sqrt(CHI2_95)).max() < 1.5 / short
    # It closes: some of it in each eighth of the turn.
    assert set(np.floor(np.arctan2(offset[:, 1], offset[:, 0]) / (np.pi / 4))) >= set(range(-4, 4))
    assert not changed(draw_frame(GROUND, replace(alone, spread=1e8 * spread), ()))[~drawn].any()


@pytest.mark.parametrize("scale", [1, 2])
def test_a_picture_lies_under_its_pixels(view: OverlayView, scale: int) -> None:
    """White from 568 to 572 by 340 to 344 px, in a picture as large as the calibration's or twice."""
    picture = np.zeros((HEIGHT * scale, WIDTH * scale, 3), dtype=np.uint8)
    picture[340 * scale : 345 * scale, 568 * scale : 573 * scale] = 255
    window, px = window_of(view), 520
    rows, columns = np.nonzero((draw_panel(replace(view, picture=picture), px) > 250).all(axis=-1))
    inside = (rows > px // 3) & (columns > px // 3)  # not the map in the corner
    place = np.array([columns[inside].mean(), rows[inside].mean()]) + 0.5
    found = place / px * window.width + [window.left, window.top]
    assert found == pytest.approx([570, 342], abs=0.2)
