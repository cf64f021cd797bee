"""The skeleton over a camera's picture: as inline SVG for the page, and as a figure for a publication.

A square is cut out around the people, so that a distance of a few pixels can be seen. The page's panels
have a small map in their corner that shows where in the picture the square lies. Lengths in a panel are
pixels of the picture; sizes of marks are in the panel's own unit, 1/320 of its width.

The viewer has small pictures of every camera, cut out the same way, with the joints in them. Their number
follows from a budget of bytes, and their times are spread evenly over the flight.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64, Picture
from pipelines.reporting.content import SessionContent, Strip
from pipelines.reporting.motion import Motion, side_of
from pipelines.reporting.overlays import (
    FilmedCamera,
    Moment,
    ReadFrame,
    View,
    filmed_cameras,
    status_at,
    views_of,
)
from pipelines.reporting.plates import (
    GRID,
    INK,
    MUTED,
    SIDES,
    STATUS_COLOURS,
    WIDTH_IN,
    Plate,
    new_figure,
    page_style,
    quiet,
    stacked,
    table,
)
from pipelines.reporting.summary import Summary
from pipelines.reporting.wording import listing, quantity, shortened
from pipelines.session.people import bones_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


_MARGIN = 1.3  # size of a panel, relative to its contents
_LEAST_PX = 96.0
_WHOLE = 0.8  # a panel this wide, by the picture's width, needs no map
_MAP = 0.27  # width of the map, by the panel's
_UNITS = 320.0
_WIDEST_PX, _MAP_WIDTH_PX = 640, 192
_MOST_PIXELS = 6_000_000
"""Largest number of pixels of all pictures of a page together: 18 panels of 577 x 577."""
_JPEG_QUALITY = 80


class Window(NamedTuple):
    """A rectangle of the picture, in pixels; the centre of the top left pixel is (0, 0)."""

    left: float
    top: float
    width: float
    height: float


def picture_width(panels: int) -> int:
    """Return the largest width in pixels of a panel's picture, for so many panels."""
    return min(_WIDEST_PX, int(np.sqrt(_MOST_PIXELS / max(panels, 1))))


def draw_panel(view: View, width_px: int) -> str:
    """Draw one view as an `<svg>`, its picture at most `width_px` wide, without a word of the session.

    The same view gives the same bytes, with the same build of OpenCV where there is a picture.
    """
    size = (view.intrinsics.width, view.intrinsics.height)
    window = window_of(view, size)
    unit = window.width / _UNITS
    joints = view.found.shape[1]
    compared = np.isfinite(view.residual_px)
    kept = np.isfinite(view.found[..., 0]) & ~view.rejected & ~view.unmeasured
    marks = [
        *_bones(view, unit),
        _segments(
            "residual", unit, zip(view.found[compared], view.reprojected[:, :joints][compared], strict=True)
        ),
        *_circles("joint", 1.7 * unit, view.reprojected[:, :joints].reshape(-1, 2)),
        *_circles("found", 3.2 * unit, view.found[kept]),
        _crosses("rejected", unit, view.found[view.rejected]),
        _crosses("unmeasured", unit, view.found[view.unmeasured]),
    ]
    background = [
        _rectangle("ground", Window(-0.5, -0.5, *size), unit),
        _picture(view.picture, size, window, width_px) if view.picture is not None else "",
        *_circles("other", 1.7 * unit, view.others.reshape(-1, 2)),
    ]
    kind = "overlay on-picture" if view.picture is not None else "overlay"
    return (
        f'<svg class="{kind}" viewBox="{_joined(*window)}" aria-hidden="true">'
        + "".join(background + marks)
        + (_overview(view, size, window) if window.width < _WHOLE * size[0] else "")
        + "</svg>"
    )


# --- windows -------------------------------------------------------------------------------------------


def window_of(view: View, size: tuple[int, int]) -> Window:
    """Return the part that a panel shows: the people with a margin; without any, the whole picture."""
    width, height = size
    points = np.concatenate([view.found.reshape(-1, 2), view.reprojected.reshape(-1, 2)])
    inside = points[(points >= 0).all(axis=1) & (points < [width, height]).all(axis=1)]
    whole = float(max(size))
    if not len(inside):
        return centred(np.array([width, height]) / 2 - 0.5, whole, size)
    low, high = inside.min(axis=0), inside.max(axis=0)
    wanted = _MARGIN * float((high - low).max())
    return centred((low + high) / 2, min(max(wanted, _LEAST_PX), whole), size)


def centred(middle: Float, width: float, size: tuple[int, int]) -> Window:
    """Return a square around a point, on whole pixels, moved into the picture as far as it fits."""
    extent = np.ceil([width, width])
    room = np.array(size) - extent
    corner = np.where(room >= 0, np.clip(np.round(middle - extent / 2), 0, np.maximum(room, 0)), room / 2)
    return Window(float(corner[0]) - 0.5, float(corner[1]) - 0.5, float(extent[0]), float(extent[1]))


# --- marks ---------------------------------------------------------------------------------------------


def _bones(view: View, unit: float) -> list[str]:
    place = {name: k for k, name in enumerate(view.joints)}
    bones = [
        (body[place[a]], body[place[b]], side_of(a, b))
        for body in view.reprojected
        for a, b in bones_of(view.joints)
    ]
    casing = _segments("casing", unit, ((a, b) for a, b, _ in bones))
    return [casing] + [
        _segments(f"bone {side or 'middle'}", unit, ((a, b) for a, b, of in bones if of == side))
        for side in ("", "left", "right")
    ]


def _segments(kind: str, unit: float, segments: Iterable[tuple[Float, Float]]) -> str:
    """Draw all segments as one path; those with a missing end are left out."""
    steps = [f"M{_joined(*a)}L{_joined(*b)}" for a, b in segments if np.isfinite([a, b]).all()]
    if not steps:
        return ""
    width = _WIDTHS[kind.partition(" ")[0]] * unit
    return f'<path class="{kind}" stroke-width="{width:.2f}" d="{"".join(steps)}"/>'


_WIDTHS = {"casing": 3.6, "bone": 1.7, "residual": 1.0, "rejected": 2.2, "unmeasured": 1.3}


def _circles(kind: str, radius: float, points: Float) -> list[str]:
    rest = f'r="{radius:.2f}" stroke-width="{radius / 3.2:.2f}"/>'
    return [
        f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" {rest}'
        for x, y in points[np.isfinite(points).all(axis=1)]
    ]


def _crosses(kind: str, unit: float, points: Float) -> str:
    arms = 3.6 * unit * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]])
    strokes = [(point + start, point + end) for point in points for start, end in arms]
    return _segments("casing", unit, strokes) + _segments(kind, unit, strokes)


def _rectangle(kind: str, window: Window, unit: float) -> str:
    left, top, width, height = (f"{value:g}" for value in window)
    return (
        f'<rect class="{kind}" x="{left}" y="{top}" width="{width}" height="{height}" '
        f'stroke-width="{unit:.2f}"/>'
    )


def _joined(*values: float) -> str:
    return " ".join(f"{value:.1f}" for value in values)


# --- pictures ------------------------------------------------------------------------------------------


def _overview(view: View, size: tuple[int, int], window: Window) -> str:
    """Draw the whole picture in the upper left corner, with the panel's frame, and other people."""
    everything = Window(-0.5, -0.5, *size)
    width = _MAP * window.width
    unit = size[0] / (_MAP * _UNITS)
    gap = 0.02 * window.width
    return (
        f'<svg class="map" x="{window.left + gap:.1f}" y="{window.top + gap:.1f}" width="{width:.1f}" '
        f'height="{width * size[1] / size[0]:.1f}" viewBox="{_joined(*everything)}">'
        + _rectangle("ground", everything, unit)
        + (_picture(view.picture, size, everything, _MAP_WIDTH_PX) if view.picture is not None else "")
        + "".join(_circles("other", 2 * unit, np.nanmedian(view.others, axis=1)))
        + _rectangle("where", window, 1.4 * unit)
        + _rectangle("edge", everything, 2 * unit)
        + "</svg>"
    )


def _picture(picture: Picture, size: tuple[int, int], window: Window, width_px: int) -> str:
    """Draw a picture's part in a window, as an `<image>` of at most `width_px` for the whole window.

    If its size differs from the calibration's, it is the same view at another scale.
    """
    import cv2

    part, (left, right, bottom, top) = cut_out(picture, size, window)
    if not part.size:
        return ""
    shrink = min(1.0, width_px / (window.width * picture.shape[1] / size[0]))
    if shrink < 1:
        part = cv2.resize(part, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    data = base64.b64encode(jpeg.tobytes()).decode("ascii")
    return (
        f'<image x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" height="{bottom - top:.2f}" '
        f'preserveAspectRatio="none" href="data:image/jpeg;base64,{data}"/>'
    )


def cut_out(
    picture: Picture, size: tuple[int, int], window: Window
) -> tuple[Picture, tuple[float, float, float, float]]:
    """Cut out the whole pixels of a picture in a window; return them and the edges.

    The edges are left, right, bottom and top.

    If the picture's size differs from the calibration's, it is the same view at another scale; edges are in
    pixels of the calibration.
    """
    scale = np.array([picture.shape[1] / size[0], picture.shape[0] / size[1]])
    corners = (
        np.array([[window.left, window.top], [window.left + window.width, window.top + window.height]]) + 0.5
    )
    low, high = np.clip(np.round(corners * scale), 0, picture.shape[1::-1]).astype(int)
    (left, top), (right, bottom) = low / scale - 0.5, high / scale - 0.5
    return picture[low[1] : high[1], low[0] : high[0]], (float(left), float(right), float(bottom), float(top))


# --- figures -------------------------------------------------------------------------------------------


_MOST_COLUMNS = 4
_RING = "#ff8ee0"  # seen on grass, clothes and sky alike
_CASING = "#ffffff"


def draw_overlays(moments: Sequence[Moment]) -> dict[str, Plate]:
    """Draw a figure for every moment at which any camera has a frame, by its key."""
    plates = [_moment(k, moment) for k, moment in enumerate(moments, start=1) if moment.views]
    return {plate.key: plate for plate in plates}


def _moment(k: int, moment: Moment) -> Plate:
    columns = min(len(moment.views), _MOST_COLUMNS)
    rows = -(-len(moment.views) // columns)
    with page_style():
        figure = new_figure(rows * (WIDTH_IN / columns + 0.2))
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes in panels:
            axes.set_visible(False)
        for axes, view in zip(panels, moment.views, strict=False):
            _draw_view(axes, view)
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
    errors = listing(f"{view.camera} {quantity(view.median_px, 'px')}" for view in moment.views)
    numbers = {"": stacked([_numbers_of_view(view) for view in moment.views])}
    return Plate(f"overlay-{k}", title, caption, f"Median reprojection error: {errors}.", figure, numbers)


def _draw_view(axes: Axes, view: View) -> None:
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
    quiet(axes)
    axes.spines["bottom"].set_visible(False)
    place = {name: j for j, name in enumerate(view.joints)}
    for body in view.reprojected:
        for a, b in bones_of(view.joints):
            colour = SIDES[side_of(a, b)]
            ends = body[[place[a], place[b]]].T
            axes.plot(*ends, color=_CASING, linewidth=2.6, alpha=0.75, zorder=2)
            axes.plot(*ends, color=colour, linewidth=1.3, zorder=3)
    lost = view.rejected | view.unmeasured
    axes.plot(*view.found[~lost].T, "o", mec=_RING, mfc="none", mew=0.7, markersize=4.5, zorder=4)
    axes.plot(*view.found[view.rejected].T, "x", color=STATUS_COLOURS["rejected"], markersize=5, zorder=5)
    axes.plot(*view.found[view.unmeasured].T, "x", color=MUTED, markersize=4, zorder=5)
    words = f"{shortened(view.camera)}, frame {view.frame}, {quantity(view.median_px, 'px')}"
    axes.set_title(words, fontsize=7.2, color=INK, loc="left")


def _numbers_of_view(view: View) -> pd.DataFrame:
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


# --- pictures for the viewer ------------------------------------------------------------------------------

Video = Literal["none", "small", "full"]
"""Choice of the pictures in the page: none, at most 3 MB, or at most 15 MB before base64."""

_BUDGET = {"small": (3_000_000, 320, 55), "full": (15_000_000, 640, 70)}  # bytes, px, quality of WebP
_MOST_HZ = 15.0
_STRIP_MARGIN = 1.5  # side of a picture, relative to the body
_TRIED = 3  # pictures that are encoded to learn their size


def make_strips(
    content: SessionContent, summary: Summary, read_frame: ReadFrame | None, video: Video
) -> list[Strip]:
    """Make the pictures of every camera that has any; nothing without a skeleton.

    Args:
        content: as for `collect_moments`.
        read_frame: reads the pictures.
        video: the budget for all cameras together.
    """
    motion = summary.motion
    if video == "none" or read_frame is None or motion is None or not motion.measured.any():
        return []
    cameras = filmed_cameras(content)
    budget = _BUDGET[video][0] / max(len(cameras), 1)
    strips = [_strip(camera, motion, summary.origin_ns, read_frame, video, budget) for camera in cameras]
    return [strip for strip in strips if strip is not None]


def _strip(
    camera: FilmedCamera, motion: Motion, origin_ns: int, read_frame: ReadFrame, video: Video, budget: float
) -> Strip | None:
    inside = (camera.frame_t_ns >= motion.t_ns[0]) & (camera.frame_t_ns <= motion.t_ns[-1])
    rows = np.flatnonzero(inside)
    if not len(rows):
        return None
    tried = rows[np.linspace(0, len(rows) - 1, _TRIED + 2).astype(np.int64)[1:-1]]
    sizes = [len(each) for _, each, _ in _cut(camera, tried, motion, origin_ns, read_frame, video)]
    if not sizes:
        return None
    seconds = (camera.frame_t_ns[rows[-1]] - camera.frame_t_ns[rows[0]]) / 1e9
    most = int(min(0.75 * budget / max(sizes), _MOST_HZ * seconds + 1, len(rows)))
    chosen = rows[np.unique(np.linspace(0, len(rows) - 1, max(most, 1)).round().astype(np.int64))]
    cut = _cut(camera, chosen, motion, origin_ns, read_frame, video)
    while sum(len(each) for _, each, _ in cut) > 0.75 * budget and len(cut) > 1:  # base64 adds a third
        cut = cut[::2]
    return Strip(
        camera=camera.name,
        t_ns=np.array([camera.frame_t_ns[row] for row, _, _ in cut], dtype=np.int64),
        pictures=tuple(base64.b64encode(each).decode("ascii") for _, each, _ in cut),
        joints=np.stack([joints for *_, joints in cut]),
    )


def _cut(
    camera: FilmedCamera, rows: Int64, motion: Motion, origin_ns: int, read_frame: ReadFrame, video: Video
) -> list[tuple[int, bytes, Float]]:
    """Cut out and encode the pictures of frames that have any: row, WebP, joints."""
    size = (camera.intrinsics.width, camera.intrinsics.height)
    views = views_of(camera, rows, motion, status_at(motion, camera.frame_t_ns[rows]), origin_ns)
    bodies = [_within(view.reprojected, size) for view in views]
    extents = [float(np.ptp(points, axis=0).max()) for points in bodies if len(points)]
    side = min(
        max(_STRIP_MARGIN * float(np.percentile(extents, 90)) if extents else 0.0, _LEAST_PX), max(size)
    )
    middle = np.array(size) / 2
    found = []
    for row, view, points in zip(rows.tolist(), views, bodies, strict=True):
        middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else middle
        picture = read_frame(camera.name, view.frame)
        if picture is None:
            continue
        window = centred(middle, side, size)
        encoded = _as_webp(picture, size, window, video)
        joints = (view.reprojected - [window.left, window.top]) / window.width
        found.append((row, encoded, joints))
    return found


def _within(points: Float, size: tuple[int, int]) -> Float:
    """Return the known points [N, 2] that lie in the picture."""
    flat = points.reshape(-1, 2)
    kept: Float = flat[(flat >= 0).all(axis=1) & (flat < size).all(axis=1)]  # False for NaN
    return kept


def _as_webp(picture: Picture, size: tuple[int, int], window: Window, video: Video) -> bytes:
    """Encode the window as a square WebP; beyond the picture it is black."""
    import cv2

    _, px, quality = _BUDGET[video]
    part, (left, right, bottom, top) = cut_out(picture, size, window)
    square = np.zeros((px, px, 3), np.uint8)
    edges = np.array([left - window.left, right - window.left, top - window.top, bottom - window.top])
    x0, x1, y0, y1 = np.clip(np.round(edges / window.width * px), 0, px).astype(int).tolist()
    if part.size and x1 > x0 and y1 > y0:
        square[y0:y1, x0:x1] = cv2.resize(part, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    _, webp = cv2.imencode(".webp", square, [cv2.IMWRITE_WEBP_QUALITY, quality])
    return webp.tobytes()
