"""A figure with its words and its numbers, in the page's style, and as inline SVG.

The SVG takes its colours and fonts from the page: each colour of the palette is replaced by a CSS variable,
so that one drawing serves light and dark mode and paper, and text stays text. The same figure gives the same
bytes, and its ids carry a prefix of their own, so that the figures of one page do not clash.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal
from xml.sax.saxutils import escape

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reporting.wording import cell_text, fixed

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.typing import RcKeyType


INK, MUTED, GRID, PAPER = "#22262a", "#666d74", "#dddcd6", "#fefdfb"
SIDES = {"left": "#1f78b5", "right": "#c8561b", "": "#4a4f55"}
"""Colours of the sides of the body, by the words of `motion.side_of`."""
CAMERAS = ("#00785a", "#7d4fb5", "#8f7a00", "#5d7d1c", "#00808f", "#8c5a3c")
"""Colours of cameras: none is near the blue and the orange of left and right."""
PEOPLE = ("#b0267a", "#3f48b8", "#a36f00", "#2a7d33", "#a8322b", "#4f6272")
"""Colours of people, where there are several."""
LEVELS = ("#9db8c9", "#5f97bd", "#1f6da5", "#123f66")
"""Colours of ordered values, from the least to the most: light to dark, on dark paper dark to light."""
STATUS_COLOURS = {
    "ok": "#2f6f92",
    "filled": "#9fc6d8",
    "few_views": "#edca6e",
    "low_parallax": "#e08f43",
    "rejected": "#b3422a",
    "not_detected": "#cbcbc6",
    "no_pose": "#74777b",
}
PALETTE = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--grid",
    PAPER: "--paper",
    **{colour: f"--{side or 'middle'}" for side, colour in SIDES.items()},
    **{colour: f"--camera-{k}" for k, colour in enumerate(CAMERAS)},
    **{colour: f"--person-{k}" for k, colour in enumerate(PEOPLE)},
    **{colour: f"--level-{k}" for k, colour in enumerate(LEVELS)},
    **{colour: f"--status-{word.replace('_', '-')}" for word, colour in STATUS_COLOURS.items()},
}

WIDTH_IN = 9.0
"""Width of a figure as wide as the page; CSS scales it to the window."""

_PAGE_STYLE: dict[RcKeyType, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "mocap",
    "text.parse_math": False,  # a name may hold a dollar sign
    "font.size": 7.6,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "axes.axisbelow": True,
    "axes.labelsize": 7.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.labelsize": 7.2,
    "ytick.labelsize": 7.2,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 7.2,
    "legend.handlelength": 1.4,
    "legend.borderpad": 0.0,
    "lines.linewidth": 1.1,
    "lines.solid_capstyle": "round",
}


@contextmanager
def page_style() -> Iterator[None]:
    """Make figures in the page's style, independent of matplotlibrc.

    Names in any script raise no warning.
    """
    import matplotlib as mpl

    with mpl.rc_context(), warnings.catch_warnings():
        # The page's own fonts show the text; matplotlib's are used for measuring it alone.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        mpl.rcdefaults()
        mpl.rcParams.update(_PAGE_STYLE)
        yield


@contextmanager
def settled(figure: Figure, scale: float = 1.0) -> Iterator[None]:
    """Lay a figure out at a scale of its size and hold that layout; call it within `page_style`.

    The layout's solver leaves the last bits of coordinates open; rounded, the same figure gives the same
    bytes.
    """
    size_in = figure.get_size_inches()
    figure.set_size_inches(*(scale * size_in))
    for axes in figure.axes:  # undo the positions of an earlier layout
        if (place := axes.get_subplotspec()) is not None:
            axes.set_position(place.get_position(figure))
        axes.set_in_layout(True)
    figure.set_layout_engine("constrained")
    figure.draw_without_rendering()
    figure.set_layout_engine(None)  # not "none", a placeholder for which every savefig draws twice
    for axes in figure.axes:
        left, bottom, width, height = (round(float(edge), 5) for edge in axes.get_position(True).bounds)
        axes.set_position((left, bottom, width, height))
    try:
        yield
    finally:
        figure.set_size_inches(*size_in)


def inline_svg(figure: Figure, key: str, title: str, description: str) -> str:
    """Return the figure as an `<svg>` element for the inside of a page.

    The key is the prefix of its ids; title and description are for readers who cannot see it.
    """
    buffer = io.StringIO()
    with page_style(), settled(figure):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        times = _time_axes(figure)
    drawing = buffer.getvalue()
    view = re.search(r'viewBox="([^"]+)"', drawing)
    if view is None:
        raise ValueError("matplotlib wrote an SVG without a viewBox")
    body = drawing[drawing.index("</metadata>") + len("</metadata>") :]
    body = re.sub(r"<defs>\s*<style[^>]*>[^<]*</style>\s*</defs>", "", body, count=1)
    # Matplotlib's own ids are hashes of coordinates whose last bits the layout's solver leaves open.
    tags = "".join(re.findall(r"<[^<>]+>", body))
    found = dict.fromkeys(re.findall(r'(?:url\(#|href="#)([^")]+)', tags))
    referenced = {name: f"{key}-{k}" for k, name in enumerate(found)}
    # Names stand between tags and are escaped there, so that a tag is whatever lies between < and >.
    body = re.sub(r"<[^<>]+>", lambda tag: _page_tag(tag.group(), referenced), body)
    body = re.sub(r">\s+<", "><", body)
    return (
        f'<svg viewBox="{view.group(1)}"{times} role="img" aria-labelledby="{key}-title" '
        f'aria-describedby="{key}-desc"><title id="{key}-title">{escape(title)}</title>'
        f'<desc id="{key}-desc">{escape(description)}</desc>{body.strip()}'
    )


TIME_LABEL = "time (s)"
"""Label of an axis on which the page's viewer shows and takes moments."""


def _time_axes(figure: Figure) -> str:
    """Describe the time axes for the viewer: left and right edge in the drawing, and the times there."""
    width = 72 * figure.get_size_inches()[0]  # the unit of matplotlib's SVG is a point
    found = [axes for axes in figure.axes if axes.get_xlabel() == TIME_LABEL]
    parts = [
        f"{width * axes.get_position().x0:.2f} {width * axes.get_position().x1:.2f} "
        f"{axes.get_xlim()[0]:.4f} {axes.get_xlim()[1]:.4f}"
        for axes in found
    ]
    return f' data-time="{";".join(parts)}"' if parts else ""


def _page_tag(tag: str, referenced: Mapping[str, str]) -> str:
    tag = re.sub(
        r' id="([^"]+)"', lambda m: f' id="{referenced[m.group(1)]}"' if m.group(1) in referenced else "", tag
    )
    tag = re.sub(r'(url\(#|href="#)([^")]+)', lambda m: m.group(1) + referenced[m.group(2)], tag)
    tag = tag.replace("xlink:href=", "href=")
    tag = re.sub(r" font-family: [^;\"]+;?", "", tag)
    tag = re.sub(r' transform="rotate\(-0 [^"]*"', "", tag)
    tag = re.sub(r"\d+\.\d{3,}", lambda m: f"{float(m.group()):.2f}".rstrip("0").rstrip("."), tag)
    tag = re.sub(r"#[0-9a-f]{6}\b", lambda m: _page_colour(m.group()), tag)
    return re.sub(r"\s*\n\s*", " ", tag)


def _page_colour(colour: str) -> str:
    return f"var({PALETTE[colour]})" if colour in PALETTE else colour


MOST_POINTS, MOST_BINS = 600, 300
LINE_STYLES: tuple[Literal["-"] | tuple[int, tuple[float, ...]], ...] = (
    "-",
    (0, (4.0, 1.5)),
    (0, (1.0, 1.2)),
)
_SHADE = 0.17  # opacity of one level on those below
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

    @cached_property
    def csv(self) -> Mapping[str, str]:
        """Numbers as CSV, by name, with nine significant digits; empty cells are missing numbers.

        No spreadsheet takes a text of it for a formula.
        """
        return {name: _written(numbers) for name, numbers in self.numbers.items()}


def as_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Write rows by column, of the same columns, as `Plate.csv` does."""
    import pandas as pd

    return _written(pd.DataFrame(rows))


def _written(numbers: pd.DataFrame) -> str:
    texts = numbers.select_dtypes(exclude="number").map(cell_text)
    written: str = numbers.assign(**texts).to_csv(index=False, float_format="%.9g", lineterminator="\n")
    return written


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


def stride_for(count: int, most: int = MOST_POINTS) -> int:
    """Return the stride that leaves at most `most` of `count`."""
    return max(1, -(-count // most))


def bounds(paths: Sequence[Float]) -> tuple[Float, Float]:
    """Return the corners [2] of the box that holds all paths [N, 2]; zero where there is none."""
    points = np.concatenate([np.zeros((0, 2)), *paths])
    points = points[np.isfinite(points).all(axis=1)]
    return (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))


def near_zero(low: Float) -> Float:
    """Return the offset to subtract from coordinates whose least is `low`: 0, or a round number if far."""
    return np.where(np.abs(low) > _FAR_M, np.floor(low / 1000) * 1000, 0.0)


def axis_label(direction: str, origin_m: float) -> str:
    """Return `east (m)`, or with the subtracted number far from zero."""
    return f"{direction} (m)" if origin_m == 0 else f"{direction} of {fixed(origin_m, 0)} m (m)"


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Make an empty figure whose layout is solved when it is drawn; call it within `page_style`."""
    from matplotlib.figure import Figure

    return Figure((width_in, height_in), layout="constrained")


def quiet(axes: Axes, grid: Literal["x", "y", "both"] | None = None) -> None:
    """Make axes light: no frame on the left, a thin line below, and grid lines across the axes named."""
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    if grid is not None:
        axes.grid(visible=True, axis=grid)


def shade(axes: Axes, x: Float, y: Float, values: Float, levels: Sequence[float]) -> None:
    """Shade where values [X, Y] exceed each level, one shade on the other."""
    for level in levels:
        axes.contourf(x, y, values.T, levels=[level, np.inf], colors=[MUTED], alpha=_SHADE, zorder=1)


def shade_keys(labels: Sequence[str]) -> list[Patch]:
    """Make the entries of a legend for the shades of as many levels."""
    from matplotlib.patches import Patch

    return [
        Patch(color=MUTED, alpha=1 - (1 - _SHADE) ** (k + 1), linewidth=0, label=label)
        for k, label in enumerate(labels)
    ]


def time_bins(seconds: Float, most: int = MOST_BINS) -> Float:
    """Return the edges of at most so many bins; one per stamp if there are fewer stamps."""
    count = min(len(seconds), most)
    step = (seconds[-1] - seconds[0]) / max(len(seconds) - 1, 1) or 1.0
    edges: Float = np.linspace(seconds[0] - step / 2, seconds[-1] + step / 2, count + 1)
    return edges


def percentiles(values: Float, seconds: Float, bins: Float) -> tuple[Float, Float, Float]:
    """Compute median, 10th and 90th percentile of the finite values in each bin; NaN in an empty one."""
    result = [
        np.percentile(finite, [50, 10, 90]) if finite.size else np.full(3, np.nan)
        for finite in _by_bin(values, seconds, bins)
    ]
    middle, low, high = np.array(result).T
    return middle, low, high


def means(values: Float, seconds: Float, bins: Float) -> Float:
    """Compute the mean of the finite values in each bin; NaN in an empty one."""
    return np.array([f.mean() if f.size else np.nan for f in _by_bin(values, seconds, bins)])


def _by_bin(values: Float, seconds: Float, bins: Float) -> list[Float]:
    """Return the finite values [T, ...] of the times in each bin."""
    inside = np.split(values, np.searchsorted(seconds, bins))[1:-1]
    return [part[np.isfinite(part)] for part in inside]
