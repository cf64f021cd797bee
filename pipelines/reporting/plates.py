"""A figure with its words, and what all figures share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipelines.reporting.svg import GRID
from pipelines.reporting.wording import fixed
from pipelines.session.records import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_POINTS = 600
LINE_STYLES: tuple[Literal["-"] | tuple[int, tuple[float, ...]], ...] = (
    "-",
    (0, (4.0, 1.5)),
    (0, (1.0, 1.2)),
)
# World coordinates beyond this are shown relative to a round number near them.
_FAR_M = 10_000.0


@dataclass(frozen=True)
class Plate:
    """A figure with its words."""

    key: str
    title: str
    caption: str
    svg: str


def every(count: int, most: int) -> int:
    """The stride that leaves at most `most` of `count`."""
    return max(1, -(-count // most))


def near_zero(low: Float) -> Float:
    """What to subtract from coordinates whose least is `low`: 0, or a round number where they are far."""
    return np.where(np.abs(low) > _FAR_M, np.floor(low / 1000) * 1000, 0.0)


def axis_label(direction: str, origin_m: float) -> str:
    """`east (m)`, or of which number far from zero."""
    return f"{direction} (m)" if origin_m == 0 else f"{direction} of {fixed(origin_m, 0)} m (m)"


def quiet(axes: Axes, *, grid: bool = True) -> None:
    """Light axes: no frame on the left, a thin line below."""
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    if grid:
        axes.grid(visible=True, axis="x", color=GRID)
