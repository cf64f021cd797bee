"""A figure with its words and its numbers, and helpers that all figures share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reporting.svg import GRID, inline_svg
from pipelines.reporting.wording import fixed

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    """A figure with its words, and the numbers that it draws."""

    key: str
    title: str
    caption: str
    description: str  # the picture in words, with its numbers, for readers who cannot see it
    figure: Figure
    numbers: Mapping[str, pd.DataFrame]  # by name; "" for those that need none

    @cached_property
    def svg(self) -> str:
        """Figure as an `<svg>` element for the inside of a page."""
        return inline_svg(self.figure, f"figure-{self.key}", self.title, self.description)


def table(**columns: object) -> pd.DataFrame:
    """Return numbers of a figure by columns of the same length; a single value holds for all rows."""
    import pandas as pd

    return pd.DataFrame(columns)


def tabled(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> pd.DataFrame:
    """Return numbers of a figure by rows."""
    import pandas as pd

    return pd.DataFrame(rows, columns=list(columns))


def stacked(tables: list[pd.DataFrame]) -> pd.DataFrame:
    """Stack tables of the same columns, one below the other."""
    import pandas as pd

    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def every(count: int, most: int) -> int:
    """Return the stride that leaves at most `most` of `count`."""
    return max(1, -(-count // most))


def near_zero(low: Float) -> Float:
    """Return the offset to subtract from coordinates whose least is `low`: 0, or a round number if far."""
    return np.where(np.abs(low) > _FAR_M, np.floor(low / 1000) * 1000, 0.0)


def axis_label(direction: str, origin_m: float) -> str:
    """Return `east (m)`, or with the subtracted number far from zero."""
    return f"{direction} (m)" if origin_m == 0 else f"{direction} of {fixed(origin_m, 0)} m (m)"


def quiet(axes: Axes, *, grid: bool = True) -> None:
    """Make axes light: no frame on the left, a thin line below."""
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    if grid:
        axes.grid(visible=True, axis="x", color=GRID)
