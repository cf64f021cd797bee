"""Figures: their marks, words and numbers, in the page's style, as inline SVG and as files for a publication.

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
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from xml.sax.saxutils import escape

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reporting.content import SessionContent
from pipelines.reporting.wording import cell_text, fixed
from pipelines.session.errors import DataError
from pipelines.session.storage import read_json, refuse_sessions, write_json

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.typing import RcKeyType


INK, MUTED, GRID, PAPER = "#22262a", "#666d74", "#dddcd6", "#fefdfb"
SIDES = {"left": "#1f78b5", "right": "#c8561b", "": "#4a4f55"}
"""Colours of the sides of the body, by the words of `motion.side_of`."""
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


# A path of more points shows no more on a page 9 inches wide.
MOST_POINTS = 600
# A time axis shows no more stretches on a page 9 inches wide.
MOST_BINS = 300
# Coordinates beyond this are shown relative to a round number near them, or labels would be too long.
FAR_FROM_ZERO_M = 10_000.0
# One shade on the other still shows the lines below.
SHADE_OPACITY = 0.17

LINE_STYLES: tuple[Literal["-"] | tuple[int, tuple[float, ...]], ...] = (
    "-",
    (0, (4.0, 1.5)),
    (0, (1.0, 1.2)),
)


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


def colour_and_style(k: int) -> tuple[str, Any]:
    """Return the colour and the line style of camera, arm or session k."""
    return CAMERAS[k % len(CAMERAS)], LINE_STYLES[k // len(CAMERAS) % len(LINE_STYLES)]


def way_m(path: Float) -> float:
    """Compute the length of a path [T, 2 or 3] over ground, without its gaps."""
    steps = np.sqrt((np.diff(path[:, :2], axis=0) ** 2).sum(axis=1))
    return float(steps[np.isfinite(steps)].sum())


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
    return np.where(np.abs(low) > FAR_FROM_ZERO_M, np.floor(low / 1000) * 1000, 0.0)


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
        axes.contourf(x, y, values.T, levels=[level, np.inf], colors=[MUTED], alpha=SHADE_OPACITY, zorder=1)


def shade_keys(labels: Sequence[str]) -> list[Patch]:
    """Make the entries of a legend for the shades of as many levels."""
    from matplotlib.patches import Patch

    return [
        Patch(color=MUTED, alpha=1 - (1 - SHADE_OPACITY) ** (k + 1), linewidth=0, label=label)
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


# --- figures of lines, bars and points -----------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A series [N] with the band around it, where there is one."""

    x: Float
    y: Float
    colour: str
    name: str = ""  # for the legend; none without one
    low: Float | None = None
    high: Float | None = None
    style: Literal["-"] | tuple[int, tuple[float, ...]] = "-"
    width: float = 1.1
    shade: float = 0.16  # opacity of the band


@dataclass(frozen=True)
class Bars:
    """Horizontal bars [N]: rows from above, where they begin, and how long they are."""

    rows: Sequence[float]
    start: Sequence[float] | float
    length: Sequence[float]
    colour: str
    name: str = ""
    thickness: float = 0.72


@dataclass(frozen=True)
class RowPoints:
    """Points [N] in rows from above, with the interval of each, where there is one; 0 rows are a legend."""

    rows: Sequence[float]
    x: Sequence[float]
    ends: Sequence[tuple[float, float] | None]
    colour: str
    name: str = ""
    width: float = 1.4
    opacity: float = 1.0
    marked: bool = True  # else the intervals alone


@dataclass(frozen=True)
class Stack:
    """Shares [K, bins] over time, one on top of the other; each holds for the whole of its bin."""

    edges: Float  # [bins + 1]
    shares: Mapping[str, Float]  # by name
    colours: Mapping[str, str]


@dataclass(frozen=True)
class Panel:
    """One drawing of a figure: its marks, labels and spans."""

    marks: Sequence[Line | Bars | RowPoints | Stack]
    x_label: str = ""
    y_label: str = ""
    rows: Mapping[float, str] | None = None  # labels of rows from above, by place
    row_span: tuple[float, float] | None = None  # else half a row beyond the first and the last
    x_span: tuple[float | None, float | None] | None = None
    y_span: tuple[float | None, float | None] | None = None
    title: str = ""
    title_inside: bool = False
    grid: Literal["x", "y", "both"] | None = "y"
    zero: bool = False  # draw a line at x = 0


def chart(
    panels: Sequence[Sequence[Panel]],
    height_in: float,
    *,
    width_in: float = WIDTH_IN,
    heights: Sequence[float] | None = None,
    widths: Sequence[float] | None = None,
    share_x: bool = True,
    share_y: bool = False,
    legend: Literal["above", "inside", ""] = "above",
    columns: int = 4,
    label: str = "",
) -> Figure:
    """Draw panels, row by row; `label` is that of the vertical axes of all, `columns` are the legend's."""
    rows, across = len(panels), max(len(row) for row in panels)
    with page_style():
        figure = new_figure(height_in, width_in)
        grid = figure.subplots(
            rows,
            across,
            squeeze=False,
            sharex=share_x,
            sharey=share_y,
            height_ratios=heights,
            width_ratios=widths,
        )
        for own, panel_row in zip(grid, panels, strict=True):
            for axes, panel in zip(own, panel_row, strict=False):
                _draw_panel(axes, panel)
            for axes in own[len(panel_row) :]:
                axes.set_axis_off()
        if across == 1:
            figure.align_ylabels(list(grid[:, 0]))
        entries: dict[str, Any] = {}
        for axes in grid.flat:
            for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
                entries.setdefault(name, handle)
        if entries and legend == "above":
            count = min(len(entries), columns)
            figure.legend(list(entries.values()), list(entries), loc="outside upper left", ncols=count)
        elif entries and legend == "inside":
            grid[0, 0].legend(loc="upper left", ncols=columns)
        if label:
            figure.supylabel(label, fontsize=7.6, color=MUTED)
    return figure


def _draw_panel(axes: Axes, panel: Panel) -> None:
    if panel.zero:
        axes.axvline(0, color=MUTED, linewidth=0.8)
    for mark in panel.marks:
        _draw_mark(axes, mark)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if panel.rows is not None:
        axes.set_yticks(list(panel.rows), list(panel.rows.values()))
        axes.set_ylim(*(panel.row_span or (max(panel.rows, default=0) + 0.5, -0.5)))
    if panel.x_span is not None:
        axes.set_xlim(*panel.x_span)
    if panel.y_span is not None:
        axes.set_ylim(*panel.y_span)
    if panel.title and panel.title_inside:
        words = axes.text(0.01, 0.97, panel.title, transform=axes.transAxes, va="top", fontsize=7)
        words.set_in_layout(False)  # a long name takes no room from the curves
    elif panel.title:
        axes.set_title(panel.title, fontsize=7.2, color=MUTED, loc="left")
    quiet(axes, panel.grid)


def _draw_mark(axes: Axes, mark: Line | Bars | RowPoints | Stack) -> None:
    if isinstance(mark, Line):
        if mark.low is not None and mark.high is not None:
            axes.fill_between(mark.x, mark.low, mark.high, color=mark.colour, alpha=mark.shade, linewidth=0)
        style: dict[str, Any] = {"color": mark.colour, "linestyle": mark.style, "linewidth": mark.width}
        axes.plot(mark.x, mark.y, label=mark.name or None, **style)
    elif isinstance(mark, Bars):
        label = mark.name or None
        axes.barh(mark.rows, mark.length, mark.thickness, mark.start, color=mark.colour, label=label)
    elif isinstance(mark, RowPoints):
        for row, x, ends in zip(mark.rows, mark.x, mark.ends, strict=True):
            if ends is not None:
                axes.plot(ends, [row, row], color=mark.colour, linewidth=mark.width, alpha=mark.opacity)
            if mark.marked:
                axes.plot(x, row, "o", color=mark.colour, markersize=4)
        if mark.name:
            axes.plot([], [], "o-", color=mark.colour, markersize=4, label=mark.name)
    else:
        corners, base = np.repeat(mark.edges, 2)[1:-1], np.zeros(len(mark.edges) - 1)
        for name, share in mark.shares.items():
            low, high = np.repeat(base, 2), np.repeat(base + share, 2)
            axes.fill_between(corners, low, high, color=mark.colours[name], linewidth=0, label=name)
            base = base + share


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
    folder: Path, plates: Mapping[str, Plate], contents: Mapping[str, SessionContent], key: str
) -> None:
    """Write `<figure>.png`, `.svg`, `.pdf` and `.csv` for every figure, and the mark.

    The same plates give the same bytes. Numbers that have a name of their own go to `<figure>-<name>.csv`;
    empty cells are missing numbers.

    Args:
        folder: an existing, empty folder.
        contents: the sessions that they are of, by label; the mark names their flights.
        key: equal for equal figures; it is stored in the mark.
    """
    listed = []
    for plate in plates.values():
        names = _write_drawing(folder, plate.key, plate.figure)
        for what, numbers in plate.csv.items():
            name = f"{plate.key}-{what}.csv" if what else f"{plate.key}.csv"
            (folder / name).write_text(numbers, encoding="utf-8", newline="\n")
            names.append(name)
        words = {"title": plate.title, "caption": plate.caption, "description": plate.description}
        listed.append({"figure": plate.key, **words, "files": names})
    sessions = {
        label: {"flight": content.session.flight, "simulated": content.session.simulated}
        for label, content in contents.items()
    }
    write_json(folder / MARK, {"schema": 1, "key": key, "sessions": sessions, "figures": listed})


def _write_drawing(folder: Path, key: str, figure: Figure) -> list[str]:
    import matplotlib as mpl

    names = []
    with page_style():
        mpl.rcParams.update(_FILE_STYLE)
        with settled(figure, FILE_WIDTH_MM / 25.4 / WIDTH_IN):
            for kind, metadata in _FILE_METADATA.items():
                names.append(f"{key}.{kind}")
                figure.savefig(folder / names[-1], dpi=FILE_DPI, metadata=metadata)
    return names


def refuse_foreign(folder: Path, *, overwrite: bool) -> None:
    """Refuse to overwrite files that are not ours.

    Args:
        folder: the folder for figures; its old contents are removed.
        overwrite: replace other people's files; sessions and their parts are never replaced.

    Raises:
        DataError: a session, a part of one, or a folder that contains one; a file, or a folder that contains
            more than figures that were written before.
    """
    refuse_sessions(folder, mark=MARK, option="--figures")
    if overwrite or not folder.exists():
        return
    if not folder.is_dir():
        raise DataError(
            folder, "is a file, not a folder", "name another place with --figures", code="not-a-folder"
        )
    foreign = sorted({path.name for path in folder.iterdir()} - _ours(folder))
    if foreign:
        raise DataError(
            folder,
            f"holds other files than figures ({len(foreign)}, the first {foreign[0]})",
            "name another folder with --figures, or replace it with --overwrite",
            code="exists",
        )


def _ours(folder: Path) -> set[str]:
    """Return the names of the files that the mark in a folder lists."""
    if not (folder / MARK).is_file():
        return set()
    stated = read_json(folder / MARK, "remove it, or name another folder with --figures").get("figures")
    figures = stated if isinstance(stated, list) else []
    return {MARK, *(name for each in figures if isinstance(each, dict) for name in each.get("files", ()))}
