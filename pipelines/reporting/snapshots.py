"""The figure of the body at a few moments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reporting.bones import side_of
from pipelines.reporting.motion import Motion
from pipelines.reporting.plates import (
    Plate,
    quiet,
    table,
)
from pipelines.reporting.summary import Summary
from pipelines.reporting.svg import (
    LEFT,
    MIDDLE,
    MUTED,
    RIGHT,
    WIDTH_IN,
    page_style,
)
from pipelines.reporting.wording import (
    fixed,
    listing,
    plural,
)
from pipelines.session.skeletons import bones_of, with_derived

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SNAPSHOTS = 7
_STRIDE_M = 1.3  # between two snapshots of the body
# Above a raised hand, and below the ground by more than errors explain: points beyond are cut off.
_TALLEST_M, _DEEPEST_M = 2.6, 0.5


def draw_snapshots(summary: Summary, motion: Motion) -> Plate:
    """Draw the first person's fullest skeletons, side by side.

    At least one joint must have been measured.
    """
    from matplotlib.figure import Figure

    chosen = _fullest_times(motion)
    joints, position = with_derived(motion.joints, motion.measured_position[chosen, 0])
    # The median over the snapshots: a joint far below the ground must not lift every body.
    ground = float(np.median(np.nanmin(position[..., 2], axis=1)))
    top = float(np.clip(np.nanmax(position[..., 2]) - ground + 0.1, 1.0, _TALLEST_M))
    bottom = float(np.clip(np.nanmin(position[..., 2]) - ground, -_DEEPEST_M, 0.0)) - 0.05
    width = _STRIDE_M * SNAPSHOTS
    with page_style():
        figure = Figure((WIDTH_IN, 0.5 + (WIDTH_IN - 0.6) * (top - bottom) / width), layout="constrained")
        axes = figure.subplots()
        seconds = [(int(motion.t_ns[k]) - summary.origin_ns) / 1e9 for k in chosen]
        labels = [f"{fixed(t_s)} s" for t_s in seconds]
        drawn = []
        for k, body in enumerate(position):
            aside, up = _three_quarter_view(body, joints)
            _draw_body(axes, aside + _STRIDE_M * k, up - ground, joints)
            drawn.append(np.stack([aside, up - ground], axis=-1))
        axes.set_xlim(-_STRIDE_M / 2, width - _STRIDE_M / 2)
        axes.set_ylim(bottom, top)
        axes.set_yticks(np.arange(0.0, top, 0.5))
        axes.set_aspect("equal")
        axes.set_xticks(_STRIDE_M * np.arange(len(chosen)), labels)
        axes.set_ylabel("height (m)")
        axes.grid(visible=True, axis="y")
        quiet(axes, grid=False)
        axes.spines["bottom"].set_visible(False)
        axes.tick_params(axis="x", length=0)
        title = "The body at a few moments"
        told = f"{plural(len(chosen), 'snapshot')} at {listing(labels)}."
    whose = "" if motion.position.shape[1] == 1 else " of the first person"
    caption = (
        f"The fullest skeleton{whose} in each stretch of time, facing right and seen from its right, "
        "half from the front; left limbs in blue, right limbs in orange. "
        "Heights count from where the feet stand."
    )
    places = np.concatenate(drawn)
    numbers = table(
        t_s=np.repeat(seconds, len(joints)),
        joint=list(joints) * len(chosen),
        right_m=places[:, 0],
        above_ground_m=places[:, 1],
    )
    return Plate("body", title, caption, told, figure, {"": numbers})


def _fullest_times(motion: Motion) -> list[int]:
    """Choose in each of `SNAPSHOTS` equal stretches the time with most joints, nearest its middle."""
    count = motion.measured[:, 0].sum(axis=1)
    chosen = []
    for rows in np.array_split(np.arange(len(count)), min(SNAPSHOTS, len(count))):
        best = rows[count[rows] == count[rows].max()]
        middle = best[np.argmin(np.abs(best - rows.mean()))]
        if count[middle] >= 2:
            chosen.append(int(middle))
    return chosen or [int(np.argmax(count))]


def _three_quarter_view(body: Float, joints: tuple[str, ...]) -> tuple[Float, Float]:
    """Compute horizontal and vertical picture coordinates in metres of one body [J, 3].

    The picture's right is where the body faces, turned 35 degrees towards its left, so that both sides show.
    """
    facing = np.array([1.0, 0.0])
    for left, right in (("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")):
        if left in joints and right in joints:
            across = (body[joints.index(left)] - body[joints.index(right)])[:2]
            if np.isfinite(across).all() and np.linalg.norm(across) > 0:
                facing = np.array([across[1], -across[0]]) / np.linalg.norm(across)
                break
    leftward = np.array([-facing[1], facing[0]])
    right_of_picture = np.cos(np.radians(35)) * facing + np.sin(np.radians(35)) * leftward
    ground = body[:, :2] - np.nanmedian(body[:, :2], axis=0)
    return ground @ right_of_picture, body[:, 2]


def _draw_body(axes: Axes, aside: Float, up: Float, joints: tuple[str, ...]) -> None:
    place = {name: (aside[j], up[j]) for j, name in enumerate(joints)}
    for start, end in bones_of(joints):
        colour, order = {"left": (LEFT, 2), "right": (RIGHT, 4), "": (MIDDLE, 3)}[side_of(start, end)]
        axes.plot(*zip(place[start], place[end], strict=True), color=colour, linewidth=1.7, zorder=order)
    axes.plot(aside, up, "o", color=MUTED, markersize=1.6, zorder=5)
