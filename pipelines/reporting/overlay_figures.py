"""The skeleton over the pictures as figures for a publication: one figure per moment, cameras in columns.

The page draws the same moments in its own way (`panels`), for light and dark, with less of each picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipelines.reporting.bones import side_of
from pipelines.reporting.overlays import Moment, View
from pipelines.reporting.panels import cut_out, window_of
from pipelines.reporting.plates import Plate, quiet, stacked, table
from pipelines.reporting.svg import (
    GRID,
    INK,
    LEFT,
    MIDDLE,
    MUTED,
    RIGHT,
    STATUS_COLOURS,
    WIDTH_IN,
    page_style,
)
from pipelines.reporting.wording import listing, quantity, shortened
from pipelines.session.skeletons import bones_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_MOST_COLUMNS = 4
_RING = "#ff8ee0"  # seen on grass, clothes and sky alike
_CASING = "#ffffff"


def draw_overlays(moments: Sequence[Moment]) -> dict[str, Plate]:
    """Draw a figure for every moment at which any camera has a frame, by its key."""
    plates = [_moment(k, moment) for k, moment in enumerate(moments, start=1) if moment.views]
    return {plate.key: plate for plate in plates}


def _moment(k: int, moment: Moment) -> Plate:
    from matplotlib.figure import Figure

    columns = min(len(moment.views), _MOST_COLUMNS)
    rows = -(-len(moment.views) // columns)
    with page_style():
        figure = Figure((WIDTH_IN, rows * (WIDTH_IN / columns + 0.2)), layout="constrained")
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes in panels:
            axes.set_visible(False)
        for axes, view in zip(panels, moment.views, strict=False):
            _draw(axes, view)
    title = f"The skeleton in the pictures at {quantity(moment.t_s, 's', 2)}"
    caption = (
        "Lines: the skeleton reprojected, left limbs in blue, right limbs in orange. Rings: what the "
        "detector found; crosses: found, but not reconstructed, in red where the views disagreed."
    )
    if moment.worst and moment.error_mm is not None:
        caption += (
            f" The moment of the largest error of a joint: {quantity(moment.error_mm, 'mm', 0)} from truth."
        )
    elif moment.worst:
        caption += " The moment with the largest reprojection error."
    told = listing(f"{view.camera} {quantity(view.median_px, 'px')}" for view in moment.views)
    numbers = {"": stacked([_numbers(view) for view in moment.views])}
    return Plate(f"overlay-{k}", title, caption, f"Median reprojection error: {told}.", figure, numbers)


def _draw(axes: Axes, view: View) -> None:
    size = (view.intrinsics.width, view.intrinsics.height)
    window = window_of(view, size)
    axes.set_visible(True)
    if view.picture is not None:
        import cv2

        part, edges = cut_out(view.picture, size, window)
        axes.imshow(cv2.cvtColor(part, cv2.COLOR_BGR2RGB), extent=edges, interpolation="antialiased")
    axes.set_xlim(window.left, window.left + window.width)
    axes.set_ylim(window.top + window.height, window.top)
    axes.set_aspect("equal")
    axes.set_facecolor(GRID)
    axes.set_xticks([])
    axes.set_yticks([])
    quiet(axes, grid=False)
    axes.spines["bottom"].set_visible(False)
    place = {name: j for j, name in enumerate(view.joints)}
    for body in view.reprojected:
        for a, b in bones_of(view.joints):
            colour = {"left": LEFT, "right": RIGHT, "": MIDDLE}[side_of(a, b)]
            ends = body[[place[a], place[b]]].T
            axes.plot(*ends, color=_CASING, linewidth=2.6, alpha=0.75, zorder=2)
            axes.plot(*ends, color=colour, linewidth=1.3, zorder=3)
    lost = view.rejected | view.unmeasured
    axes.plot(*view.found[~lost].T, "o", mec=_RING, mfc="none", mew=0.7, markersize=4.5, zorder=4)
    axes.plot(*view.found[view.rejected].T, "x", color=STATUS_COLOURS["rejected"], markersize=5, zorder=5)
    axes.plot(*view.found[view.unmeasured].T, "x", color=MUTED, markersize=4, zorder=5)
    words = f"{shortened(view.camera)}, frame {view.frame}, {quantity(view.median_px, 'px')}"
    axes.set_title(words, fontsize=7.2, color=INK, loc="left")


def _numbers(view: View) -> pd.DataFrame:
    """Tabulate every joint in the picture; empty where it was not found or not reconstructed."""
    people, joints = view.found.shape[:2]
    reprojected = view.reprojected[:, :joints].reshape(-1, 2)
    found = view.found.reshape(-1, 2)
    return table(
        camera=view.camera,
        frame=view.frame,
        t_s=view.t_s,
        person=np.repeat(np.arange(people), joints),
        joint=list(view.joints[:joints]) * people,
        found_x_px=found[:, 0],
        found_y_px=found[:, 1],
        reprojected_x_px=reprojected[:, 0],
        reprojected_y_px=reprojected[:, 1],
        rejected=view.rejected.ravel().astype(int),
    )
