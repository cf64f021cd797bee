"""The skeleton as seen by the cameras of each arm: hidden joints, and joints outside the picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.reporting.plates import (
    CAMERAS,
    GRID,
    LINE_STYLES,
    MUTED,
    PAPER,
    STATUS_COLOURS,
    WIDTH_IN,
    Plate,
    new_figure,
    page_style,
    stacked,
    table,
)
from pipelines.reporting.replanned import Arm, Replan, Seen
from pipelines.reporting.wording import listing, plural, quantity, shortened
from pipelines.session.people import bones_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
MOMENTS = 4
_CAMERAS = 2  # of each arm: more make the people too small to see
_HIDDEN = STATUS_COLOURS["rejected"]
_ROOM = 1.3  # sides of a panel, in lengths of the largest person


def draw_as_seen(replan: Replan) -> Plate | None:
    """Draw a panel for every arm and camera at a few moments; None where no skeleton was known."""
    looks = [(arm, arm.seen) for arm in replan.arms if arm.seen is not None and len(arm.seen.t_s)]
    if not looks:
        return None
    chosen = moments(looks)
    side_px = _ROOM * max(_largest_px(seen) for _, seen in looks)
    columns = min(_CAMERAS, max(len(seen.cameras) for _, seen in looks))
    panel_in = (WIDTH_IN - 0.3) / (len(chosen) * columns)
    with page_style():
        figure = new_figure(0.5 + len(looks) * (panel_in + 0.2))
        panels = figure.subplots(len(looks), len(chosen) * columns, squeeze=False)
        for row, (arm, seen) in zip(panels, looks, strict=True):
            for k, at_s in enumerate(chosen.tolist()):
                at = int(_nearest(seen.t_s, np.array([at_s]))[0])
                for c in range(columns):
                    axes = row[k * columns + c]
                    _draw(axes, arm, seen, c, at, side_px)
                    if arm is looks[-1][0] and c == 0:
                        axes.set_xlabel(f"at {quantity(at_s, 's', 0)}", loc="left")
            row[0].set_ylabel(shortened(arm.name), color=CAMERAS[arm.colour], fontsize=8.2)
        _legend(figure)
        title = "The actor as each arm would have seen it"
        description = " ".join(_describe(arm, seen) for arm, seen in looks)
    skipped = max(len(seen.cameras) for _, seen in looks) > columns
    caption = (
        "The skeleton in the pictures of each arm's cameras, all enlarged alike"
        + (f" (the first {columns} cameras)" if skipped else "")
        + ", with its tilt over the actor and how many joints it sees. Each quarter of the flight is shown "
        "at the moment when the arms differ most in the joints that they do not see; of several such "
        "moments, in their largest tilts. Open and dotted: hidden by an obstacle; joints outside the picture "
        "are left out. Computed from map and field of view, without a detector's errors."
    )
    numbers = {"": stacked([_numbers(arm, seen) for arm, seen in looks])}
    return Plate("arms-seen", title, caption, description, figure, numbers)


def moments(looks: list[tuple[Arm, Seen]]) -> Float:
    """Choose the moment of each equal part of the flight at which the arms differ most.

    They differ by the joints that their drawn cameras lose; of several such moments, by their largest tilts;
    then the moment with most lost joints is taken. A single arm is shown where it loses most.
    """
    t_s = looks[0][1].t_s
    lost, tilt_deg = np.zeros((len(looks), len(t_s))), np.zeros((len(looks), len(t_s)))
    for a, (arm, seen) in enumerate(looks):
        missing = (seen.status[:_CAMERAS] != "") & (seen.status[:_CAMERAS] != "seen")
        flown_deg = np.nan_to_num(arm.tilt_deg[:_CAMERAS, _nearest(arm.t_s, seen.t_s)]).max(axis=0)
        at = _nearest(seen.t_s, t_s)
        lost[a], tilt_deg[a] = missing.sum(axis=(0, 2))[at], flown_deg[at]
    spread = np.ptp(tilt_deg, axis=0) if len(looks) > 1 else tilt_deg[0]
    order = (lost.sum(axis=0), spread, np.ptp(lost, axis=0) if len(looks) > 1 else lost[0])
    parts = [part for part in np.array_split(np.arange(len(t_s)), MOMENTS) if len(part)]
    return np.array([t_s[part[np.lexsort([each[part] for each in order])[-1]]] for part in parts])


def _nearest(t_s: Float, wanted_s: Float) -> Int64:
    """Find the rows of ascending times that are nearest to others."""
    places: Int64 = np.abs(t_s[:, None] - wanted_s).argmin(axis=0)
    return places


def _largest_px(seen: Seen) -> float:
    """Return the longest side of any person's box, px."""
    flat = seen.pixels.reshape(-1, len(seen.joints), 2)
    flat = flat[np.isfinite(flat).any(axis=(1, 2))]
    if not len(flat):
        return 1.0
    return max(float((np.nanmax(flat, axis=1) - np.nanmin(flat, axis=1)).max()), 1.0)


def _draw(axes: Axes, arm: Arm, seen: Seen, camera: int, at: int, side_px: float) -> None:
    _frame(axes)
    if camera >= len(seen.cameras):
        axes.set_visible(False)
        return
    pixels, status = seen.pixels[camera, at], seen.status[camera, at]
    _enlarge(axes, pixels, side_px)
    _draw_skeleton(axes, seen.joints, pixels, status, CAMERAS[arm.colour])
    found, known = int((status == "seen").sum()), int((status != "").sum())
    tilt_deg = float(arm.tilt_deg[camera, _nearest(arm.t_s, seen.t_s[at : at + 1])[0]])
    words = f"{shortened(seen.cameras[camera])}, {quantity(tilt_deg, 'deg', 0)}"
    axes.set_title(words, fontsize=6.4, loc="left", pad=2, color=MUTED)
    axes.text(
        0.97,
        0.03,
        f"{found} of {known}",
        transform=axes.transAxes,
        fontsize=6.4,
        ha="right",
        color=_HIDDEN if found < known else MUTED,
    )


def _frame(axes: Axes) -> None:
    """Draw a picture's edge in place of axes."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(GRID)
    axes.set_aspect("equal")


def _enlarge(axes: Axes, pixels: Float, side_px: float) -> None:
    """Show the part of the picture, so many pixels wide and high, around the joints [J, 2] inside it."""
    inside = pixels[np.isfinite(pixels[:, 0])]
    middle = (np.nanmax(inside, axis=0) + np.nanmin(inside, axis=0)) / 2 if len(inside) else np.zeros(2)
    axes.set_xlim(middle[0] - side_px / 2, middle[0] + side_px / 2)
    axes.set_ylim(middle[1] + side_px / 2, middle[1] - side_px / 2)  # rows count downwards


def _draw_skeleton(
    axes: Axes, joints: tuple[str, ...], pixels: Float, status: NDArray[np.str_], colour: str
) -> None:
    """Draw the joints, and bones with both joints inside the picture; open and dotted where hidden."""
    inside = np.isfinite(pixels[:, 0])
    place = {joint: k for k, joint in enumerate(joints)}
    for a, b in bones_of(joints):
        ends = [place[a], place[b]]
        if inside[ends].all():
            free = (status[ends] == "seen").all()
            axes.plot(
                *pixels[ends].T,
                color=colour if free else _HIDDEN,
                linestyle="-" if free else LINE_STYLES[2],
                linewidth=1.2 if free else 0.8,
                zorder=2,
            )
    axes.plot(*pixels[status == "seen"].T, "o", color=colour, markersize=2.2, zorder=3)
    hidden = pixels[status == "hidden"]
    axes.plot(
        *hidden.T, "o", color=_HIDDEN, markersize=2.2, markerfacecolor=PAPER, markeredgewidth=0.7, zorder=3
    )


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    entries = [
        Line2D([], [], color=MUTED, marker="o", markersize=2.6, label="seen, in the arm's colour"),
        Line2D(
            [],
            [],
            color=_HIDDEN,
            marker="o",
            markersize=2.6,
            markerfacecolor=PAPER,
            linestyle=LINE_STYLES[2],
            label="hidden",
        ),
    ]
    figure.legend(handles=entries, loc="outside upper left", ncols=2)


def _describe(arm: Arm, seen: Seen) -> str:
    known = seen.status != ""
    shares = [
        f"{plural(int((seen.status == word).sum()), 'joint')} {word}"
        for word in ("seen", "hidden", "outside")
    ]
    return f"{arm.name}: of {int(known.sum())} in {plural(len(seen.t_s), 'look')}, {listing(shares)}."


def _numbers(arm: Arm, seen: Seen) -> pd.DataFrame:
    camera, time, joint = np.nonzero(seen.status != "")
    return table(
        arm=arm.name,
        camera=np.array(seen.cameras)[camera],
        t_s=seen.t_s[time],
        joint=np.array(seen.joints)[joint],
        x_px=seen.pixels[camera, time, joint, 0],
        y_px=seen.pixels[camera, time, joint, 1],
        status=seen.status[camera, time, joint],
    )
