"""Figures: panels of marks, drawn in the page's style as inline SVG and as files for a publication.

A `Figure` is data. Its drawing, its description in words and its numbers as CSV all follow from its marks.
Each colour of the SVG is a CSS variable of the page, so that one drawing serves light and dark mode and
paper, and text stays text. The same figure gives the same bytes, and its ids carry a prefix of their own, so
that the figures of one page do not clash.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from xml.sax.saxutils import escape

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Float, Picture
from pipelines.reporting.content import SessionContent
from pipelines.reporting.wording import cell_text, fixed, listing, shortened, significant
from pipelines.session.storage import read_json, refuse_others, refuse_sessions, write_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing
    from matplotlib.typing import RcKeyType


INK, MUTED, GRID, PAPER = "#22262a", "#666d74", "#dddcd6", "#fefdfb"
SIDES = {"left": "#1f78b5", "right": "#c8561b", "": "#4a4f55"}
"""Colours of the sides of the body, by the words of `people.side_of`."""
CAMERAS = ("#00785a", "#7d4fb5", "#8f7a00", "#9c2f4f", "#00808f", "#8c5a3c")
"""Colours of cameras, arms and sessions: neighbours differ in hue, none is the blue or orange of a side."""
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

# CSS scales a figure as wide as the page to the window; the fonts are chosen for this width.
WIDTH_IN = 9.0
# A phone is as wide as this many inches of letters that can be read.
NARROW_IN = 4.2
# Letters of the page's fonts are about as wide, with the key before a name.
LETTER_IN, KEY_IN = 0.055, 0.45
# A path of more points shows no more on a page 9 inches wide.
MOST_POINTS = 600
# A time axis shows no more stretches on a page 9 inches wide.
MOST_BINS = 300
# Coordinates beyond this are shown relative to a round number near them, or labels would be too long.
FAR_FROM_ZERO_M = 10_000.0
# One shade on the other still shows the lines below.
SHADE_OPACITY = 0.17
# More series are not told one by one in the description of a figure.
MOST_SERIES_DESCRIBED = 12

TIME_LABEL = "time (s)"
"""Label of an axis on which the page's viewer shows and takes moments."""

Stroke = Literal["-"] | tuple[int, tuple[float, ...]]
LINE_STYLES: tuple[Stroke, ...] = ("-", (0, (4.0, 1.5)), (0, (1.0, 1.2)))

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
    "axes.spines.left": False,
    "axes.formatter.useoffset": False,
    "axes.axisbelow": True,
    "axes.labelsize": 7.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 0.0,
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


# --- marks ---


@dataclass(frozen=True)
class Line:
    """A series [N], with the band around it where there is one; `legend` False leaves its name to the CSV."""

    x: Float
    y: Float
    colour: str = INK
    name: str = ""
    low: Float | None = None
    high: Float | None = None
    style: Stroke = "-"
    width: float = 1.1
    legend: bool = True


@dataclass(frozen=True)
class Points:
    """Points [N], with the interval of each `along` an axis where there is one, and a line through them."""

    x: Sequence[float] | Float
    y: Sequence[float] | Float
    colour: str = INK
    name: str = ""
    ends: Sequence[tuple[float, float] | None] = ()
    along: Literal["x", "y"] = "x"
    marker: str = "o"  # empty: the intervals alone
    filled: bool = True
    size: float = 4.0
    joined: bool = False
    legend: bool = True


@dataclass(frozen=True)
class Bars:
    """Horizontal bars [N]: rows from above, where they begin, and how long they are."""

    rows: Sequence[float]
    start: Sequence[float]
    length: Sequence[float]
    colour: str
    name: str = ""
    thickness: float = 0.72
    legend: bool = True


@dataclass(frozen=True)
class Area:
    """A stretch [bins] between two values, each of which holds for the whole of its bin."""

    edges: Float  # [bins + 1]
    low: Float
    high: Float
    colour: str
    name: str = ""
    legend: bool = True


@dataclass(frozen=True)
class Shades:
    """Values [X, Y], shaded where they exceed each level, one shade on the other."""

    x: Float
    y: Float
    values: Float
    levels: Sequence[float]
    name: str = ""
    legend: bool = True


@dataclass(frozen=True)
class Note:
    """Words at a place."""

    x: float
    y: float
    words: str


@dataclass(frozen=True)
class Image:
    """A picture that fills its panel."""

    picture: Picture


Mark = Line | Points | Bars | Area | Shades | Note | Image


@dataclass(frozen=True)
class Panel:
    """One drawing of a figure: its marks, labels and spans."""

    marks: Sequence[Mark]
    x_label: str = ""
    y_label: str = ""
    rows: Mapping[float, str] | None = None  # labels of rows from above, by place
    x_span: tuple[float | None, float | None] | None = None
    y_span: tuple[float | None, float | None] | None = None
    x_ticks: Mapping[float, str] | None = None
    title: str = ""
    grid: Literal["x", "y", "both"] | None = "y"
    equal: bool = False  # a metre is as long in both directions

    @property
    def what(self) -> str:
        """Name of the panel in words and in the CSV."""
        label = self.x_label if self.rows is not None else self.y_label
        return ", ".join(part for part in (self.title, label.replace("\n", " ")) if part)


@dataclass(frozen=True)
class Figure:
    """A figure: panels, row by row, with its title and caption."""

    key: str
    title: str
    caption: str
    panels: Sequence[Sequence[Panel]]
    height_in: float
    heights: Sequence[float] | None = None
    widths: Sequence[float] | None = None
    share_x: bool = True
    share_y: bool = False
    columns: int = 6  # of the legend
    label: str = ""  # of the vertical axes of all
    about: str = field(default="", repr=False)  # the description, where the marks say nothing

    @property
    def description(self) -> str:
        """Picture in words, with its numbers, for readers who cannot see it."""
        parts = [_in_words(panel) for row in self.panels for panel in row]
        return self.about or " ".join(part for part in parts if part)

    @cached_property
    def csv(self) -> str:
        """Numbers of all marks, nine digits, empty where missing; no text is a formula."""
        return as_csv([row for panels in self.panels for panel in panels for row in _rows_of(panel)])

    @cached_property
    def drawing(self) -> Drawing:
        """Drawing by matplotlib."""
        return _draw(self, WIDTH_IN)

    @cached_property
    def svg(self) -> str:
        """Figure as an `<svg>` element for the inside of a page."""
        return _inline_svg(self, self.drawing, f"figure-{self.key}")

    @cached_property
    def narrow_svg(self) -> str:
        """The same for a phone."""
        return _inline_svg(self, _draw(self, NARROW_IN), f"figure-{self.key}-narrow")


# --- numbers and words of the marks ---


def as_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Write rows by column; columns in which no row has anything are left out."""
    numbers = pd.DataFrame(rows).dropna(axis="columns", how="all")
    texts = numbers.select_dtypes(exclude="number").map(cell_text)
    return numbers.assign(**texts).to_csv(index=False, float_format="%.9g", lineterminator="\n")


def _rows_of(panel: Panel) -> Iterator[dict[str, object]]:
    """Yield the numbers of a panel: panel, series, row, x, y, low, high, value."""
    for mark in panel.marks:
        if isinstance(mark, Note | Image) or not mark.name:
            continue
        start: dict[str, object] = {"panel": panel.what, "series": mark.name}
        if isinstance(mark, Bars):
            for row, low, length in zip(mark.rows, mark.start, mark.length, strict=True):
                in_row = (panel.rows or {}).get(round(row), "")
                yield start | {"row": in_row, "x": length, "low": low, "high": low + length}
        elif isinstance(mark, Area):
            for low_x, high_x, low, high in zip(
                mark.edges, mark.edges[1:], mark.low, mark.high, strict=False
            ):
                yield start | {"x": (low_x + high_x) / 2, "y": high - low}
        elif isinstance(mark, Shades):
            for (i, j), value in np.ndenumerate(mark.values):
                yield start | {"x": mark.x[i], "y": mark.y[j], "value": value}
        else:
            ends: Any = mark.ends if isinstance(mark, Points) else ()
            if isinstance(mark, Line) and mark.low is not None and mark.high is not None:
                ends = zip(mark.low, mark.high, strict=True)
            pairs = list(ends) or [None] * len(mark.x)
            for x, y, pair in zip(mark.x, mark.y, pairs, strict=True):
                label = None if panel.rows is None else panel.rows.get(round(y), "")
                low, high = pair or (np.nan, np.nan)
                place = {"x": x, "y": y} if label is None else {"row": label, "x": x}
                yield start | place | {"low": low, "high": high}


def _in_words(panel: Panel) -> str:
    """Describe a panel: of each series the range and the median; of rows the value of each."""
    described = []
    for mark in panel.marks:
        if panel.rows is not None and isinstance(mark, Bars | Points):
            own = (
                zip(mark.rows, mark.length, strict=True)
                if isinstance(mark, Bars)
                else zip(mark.y, mark.x, strict=True)
            )
            values = listing(
                f"{panel.rows.get(round(row), '')} {significant(float(value))}" for row, value in own
            )
            described.append(f"{mark.name}: {values}" if mark.name else values)
        elif isinstance(mark, Line | Points) and mark.name:
            known = np.asarray(mark.y)[np.isfinite(mark.y)]
            if known.size:
                low, middle, high = (
                    significant(float(v)) for v in (known.min(), np.median(known), known.max())
                )
                described.append(f"{mark.name} {low} to {high}, median {middle}")
    left = (
        f"; and {len(described) - MOST_SERIES_DESCRIBED} more"
        if len(described) > MOST_SERIES_DESCRIBED
        else ""
    )
    return f"{panel.what}: {'; '.join(described[:MOST_SERIES_DESCRIBED])}{left}." if described else ""


# --- drawing ---


@contextmanager
def page_style() -> Iterator[None]:
    """Make figures in the page's style, independent of matplotlibrc; names in any script raise no warning."""
    import matplotlib as mpl

    with mpl.rc_context(), warnings.catch_warnings():
        # The page's own fonts show the text; matplotlib's are used for measuring it alone.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        mpl.rcdefaults()
        mpl.rcParams.update(_PAGE_STYLE)
        yield


def _draw(figure: Figure, width_in: float) -> Drawing:
    from matplotlib.figure import Figure as Drawing

    rows, across = len(figure.panels), max(len(row) for row in figure.panels)
    with page_style():
        shaped = any(panel.equal and panel.x_span for row in figure.panels for panel in row)
        # Panels whose shape is given become lower with their width; the rest of the height is their labels'.
        height_in = figure.height_in * (0.3 + 0.7 * width_in / WIDTH_IN if shaped else 1.0)
        drawing = Drawing((width_in, height_in), layout="constrained")
        grid = drawing.subplots(
            rows,
            across,
            squeeze=False,
            sharex=figure.share_x,
            sharey=figure.share_y,
            height_ratios=figure.heights,
            width_ratios=figure.widths,
        )
        for own, panel_row in zip(grid, figure.panels, strict=True):
            for axes, panel in zip(own, panel_row, strict=False):
                _draw_panel(axes, panel)
            for axes in own[len(panel_row) :]:
                axes.set_axis_off()
        if across == 1:
            drawing.align_ylabels(list(grid[:, 0]))
        entries: dict[str, Any] = {}
        for axes in grid.flat:
            for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
                entries.setdefault(name, handle)
        if entries:
            widest_in = KEY_IN + LETTER_IN * max(map(len, entries))
            count = min(len(entries), figure.columns, max(1, int(width_in / widest_in)))
            drawing.legend(list(entries.values()), list(entries), loc="outside upper left", ncols=count)
        if figure.label:
            drawing.supylabel(figure.label, fontsize=7.6, color=MUTED)
    return drawing


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for mark in panel.marks:
        _draw_mark(axes, mark)
    axes.set_xlabel(panel.x_label)
    if panel.x_label:
        axes.tick_params(labelbottom=True)  # also above another row
    axes.set_ylabel(panel.y_label)
    if panel.rows is not None:
        axes.set_yticks(list(panel.rows), list(panel.rows.values()))
        axes.set_ylim(max(panel.rows, default=0) + 0.5, -0.5)
    if panel.x_ticks is not None:
        axes.set_xticks(list(panel.x_ticks), list(panel.x_ticks.values()))
    if panel.x_span is not None:
        axes.set_xlim(*panel.x_span)
    if panel.y_span is not None:
        axes.set_ylim(*panel.y_span)
    if panel.equal:
        axes.set_aspect("equal", adjustable="box" if panel.x_span else "datalim")
    if panel.title:
        axes.set_title(panel.title, fontsize=7.2, color=MUTED, loc="left")
    if panel.grid is not None:
        axes.grid(visible=True, axis=panel.grid)


def _draw_mark(axes: Axes, mark: Mark) -> None:
    if isinstance(mark, Note):
        axes.text(mark.x, mark.y, mark.words, fontsize=6.4, color=MUTED, ha="center", va="center", zorder=7)
        return
    if isinstance(mark, Image):
        axes.imshow(mark.picture[..., ::-1], interpolation="antialiased")
        axes.set(xticks=[], yticks=[])
        axes.spines["bottom"].set_visible(False)
        return
    label = shortened(mark.name) if mark.name and mark.legend else None
    if isinstance(mark, Line):
        if mark.low is not None and mark.high is not None:
            axes.fill_between(
                mark.x, mark.low, mark.high, color=mark.colour, alpha=SHADE_OPACITY, linewidth=0
            )
        style: dict[str, Any] = {"color": mark.colour, "linestyle": mark.style, "linewidth": mark.width}
        axes.plot(mark.x, mark.y, label=label, zorder=3, **style)
    elif isinstance(mark, Points):
        for x, y, ends in zip(mark.x, mark.y, mark.ends, strict=True) if len(mark.ends) else ():
            if ends is not None:
                place = (ends, (y, y)) if mark.along == "x" else ((x, x), ends)
                axes.plot(*place, color=mark.colour if mark.marker else MUTED, linewidth=1.1, zorder=4)
        if mark.marker:
            face = mark.colour if mark.filled else PAPER
            style = {
                "color": mark.colour,
                "markersize": mark.size,
                "markerfacecolor": face,
                "marker": mark.marker,
            }
            axes.plot(
                mark.x, mark.y, linestyle="-" if mark.joined else "none", label=label, zorder=5, **style
            )
    elif isinstance(mark, Bars):
        axes.barh(mark.rows, mark.length, mark.thickness, mark.start, color=mark.colour, label=label)
    elif isinstance(mark, Area):
        corners = np.repeat(mark.edges, 2)[1:-1]
        low, high = np.repeat(mark.low, 2), np.repeat(mark.high, 2)
        axes.fill_between(corners, low, high, color=mark.colour, linewidth=0, label=label)
    else:
        for k, level in enumerate(mark.levels):
            opacity = 1 - (1 - SHADE_OPACITY) ** (k + 1)
            axes.contourf(
                mark.x,
                mark.y,
                mark.values.T,
                levels=[level, np.inf],
                colors=[MUTED],
                alpha=SHADE_OPACITY,
                zorder=1,
            )
            axes.fill(
                [],
                [],
                color=MUTED,
                alpha=opacity,
                linewidth=0,
                label=f"{mark.name} {level:g} m" if label else None,
            )


@contextmanager
def _settled(drawing: Drawing, scale: float = 1.0) -> Iterator[None]:
    """Lay a drawing out at a scale of its size and hold that layout; call it within `page_style`."""
    size_in = drawing.get_size_inches()
    drawing.set_size_inches(*(scale * size_in))
    for axes in drawing.axes:  # undo the positions of an earlier layout
        if (place := axes.get_subplotspec()) is not None:
            axes.set_position(place.get_position(drawing))
        axes.set_in_layout(True)
    drawing.set_layout_engine("constrained")
    drawing.draw_without_rendering()
    drawing.set_layout_engine(None)  # not "none", a placeholder for which every savefig draws twice
    for axes in drawing.axes:
        left, bottom, width, height = (round(float(edge), 5) for edge in axes.get_position(True).bounds)
        axes.set_position((left, bottom, width, height))
    try:
        yield
    finally:
        drawing.set_size_inches(*size_in)


def _inline_svg(figure: Figure, drawing: Drawing, key: str) -> str:
    buffer = io.StringIO()
    with page_style(), _settled(drawing):
        drawing.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        times = _time_axes(drawing)
    written = buffer.getvalue()
    view = re.search(r'viewBox="([^"]+)"', written)
    if view is None:
        raise ValueError("matplotlib wrote an SVG without a viewBox")
    body = written[written.index("</metadata>") + len("</metadata>") :]
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
        f'aria-describedby="{key}-desc"><title id="{key}-title">{escape(figure.title)}</title>'
        f'<desc id="{key}-desc">{escape(figure.description)}</desc>{body.strip()}'
    )


def _time_axes(drawing: Drawing) -> str:
    """Describe the panels over time for the viewer: left and right edge in the drawing, times, height."""
    width, height = 72 * drawing.get_size_inches()  # the unit of matplotlib's SVG is a point
    parts = []
    for axes in drawing.axes:
        if axes.get_xlabel() == TIME_LABEL:
            place, (start, end) = axes.get_position(), axes.get_xlim()
            edges = (width * place.x0, width * place.x1, start, end)
            for above in (each.get_position() for each in drawing.axes):
                if above.x0 == place.x0:
                    rows = (height * (1 - above.y1), height * (1 - above.y0))
                    parts.append(" ".join(f"{value:.4f}" for value in (*edges, *rows)))
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
    tag = re.sub(
        r"#[0-9a-f]{6}\b", lambda m: f"var({PALETTE[m.group()]})" if m.group() in PALETTE else m.group(), tag
    )
    return re.sub(r"\s*\n\s*", " ", tag)


# --- series ---


def colour_and_style(k: int) -> tuple[str, Stroke]:
    """Return the colour and the line style of camera, arm or session k."""
    return CAMERAS[k % len(CAMERAS)], LINE_STYLES[k // len(CAMERAS) % len(LINE_STYLES)]


def line_through(path: Float, colour: str, name: str = "", **style: Any) -> Line:
    """Return the line through points [N, 2]."""
    return Line(path[:, 0], path[:, 1], colour, name, **style)


def points_at(path: Float, colour: str, name: str = "", **style: Any) -> Points:
    """Return points [N, 2] as a mark."""
    return Points(path[:, 0], path[:, 1], colour, name, **style)


def stride_for(count: int) -> int:
    """Return the stride that leaves at most `MOST_POINTS` of `count`."""
    return max(1, -(-count // MOST_POINTS))


def bounds(paths: Sequence[Float]) -> tuple[Float, Float]:
    """Return the corners [2] of the box that holds all paths [N, 2]; zero where there is none."""
    points = np.concatenate([np.zeros((0, 2)), *paths])
    points = points[np.isfinite(points).all(axis=1)]
    return (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))


def near_zero(low: Float) -> Float:
    """Return the offset to subtract from coordinates whose least is `low`: 0, or a round number if far."""
    return np.where(np.abs(low) > FAR_FROM_ZERO_M, np.floor(low / 1000) * 1000, 0.0)


def axis_label(direction: str, origin_m: float) -> str:
    """Return `east (m)`, or with the subtracted number far from zero."""
    return f"{direction} (m)" if origin_m == 0 else f"{direction} of {fixed(origin_m, 0)} m (m)"


def time_bins(seconds: Float, most: int = MOST_BINS) -> Float:
    """Return the edges of at most so many bins; one per stamp if there are fewer stamps."""
    count = min(len(seconds), most)
    step = (seconds[-1] - seconds[0]) / max(len(seconds) - 1, 1) or 1.0
    return np.linspace(seconds[0] - step / 2, seconds[-1] + step / 2, count + 1)


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


# --- files for a publication ---


MARK = "figures.json"
"""Mark of a folder of figures: their flights, titles, captions, and the names of all files."""

# A figure as wide as the page fills the two columns of a journal.
FILE_WIDTH_MM = 180.0
# Journals ask for 300 dots per inch.
FILE_DPI = 300
# Text stays text, and fonts are embedded as TrueType: journals refuse Type 3.
_FILE_STYLE: dict[RcKeyType, Any] = {"svg.fonttype": "none", "pdf.fonttype": 42, "savefig.facecolor": "white"}
# Neither dates nor versions: the same figure gives the same files.
_FILE_METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


def write_figures(
    folder: Path, figures: Sequence[Figure], contents: Mapping[str, SessionContent], key: str
) -> None:
    """Write each figure as .png, .svg, .pdf, .csv, and the mark with `key` and the flights of `contents`."""
    listed = []
    for figure in figures:
        names = [*write_drawing(folder, figure.key, figure), f"{figure.key}.csv"]
        (folder / names[-1]).write_text(figure.csv, encoding="utf-8", newline="\n")
        words = {"title": figure.title, "caption": figure.caption, "description": figure.description}
        listed.append({"figure": figure.key, **words, "files": names})
    sessions = {
        label: {"flight": content.session.flight, "simulated": content.session.simulated}
        for label, content in contents.items()
    }
    write_json(folder / MARK, {"schema": 1, "key": key, "sessions": sessions, "figures": listed})


def write_drawing(folder: Path, name: str, figure: Figure) -> list[str]:
    """Write a figure as PNG, SVG and PDF; equal figures give equal bytes. Return the names of the files."""
    import matplotlib as mpl

    names = []
    with page_style():
        mpl.rcParams.update(_FILE_STYLE)
        with _settled(figure.drawing, FILE_WIDTH_MM / 25.4 / WIDTH_IN):
            for kind, metadata in _FILE_METADATA.items():
                names.append(f"{name}.{kind}")
                figure.drawing.savefig(folder / names[-1], dpi=FILE_DPI, metadata=metadata)
    return names


def refuse_foreign(folder: Path, *, overwrite: bool) -> None:
    """Refuse to write figures over sessions and, without `overwrite`, over anything that is not ours."""
    refuse_sessions(folder, mark=MARK, option="--figures")
    if overwrite:
        return
    ours = {MARK}
    if (folder / MARK).is_file():
        stated = read_json(folder / MARK, "remove it, or name another folder with --figures").get("figures")
        ours |= {name for each in stated or () for name in each.get("files", ())}
    refuse_others(folder, ours.__contains__, "other files than figures", option="--figures")
