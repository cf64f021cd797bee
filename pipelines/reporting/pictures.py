"""Pictures with the skeleton in them: frames of videos, cut-outs for the page, and strips for the viewer.

A square is cut out around the people, so that a distance of a few pixels can be seen; a small map in the
corner of the page's panels shows where it lies. The viewer's small pictures of every camera are cut out the
same way. Their number follows from a budget of bytes, and their times are spread evenly over the flight.
"""

import base64
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64, Picture
from pipelines.geometry.cameras import project, undistort
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.chart import INK, WIDTH_IN, Figure, Image, Mark, Panel, points_at
from pipelines.reporting.content import MeasuredMotion, SessionContent, Strip
from pipelines.reporting.overlays import (
    FilmedCamera,
    OverlayMoment,
    OverlayView,
    ReadFrame,
    filmed_cameras,
    status_at,
    views_of,
)
from pipelines.reporting.summary import Summary
from pipelines.reporting.wording import listing, quantity, shortened
from pipelines.session.people import bones_of, side_of

Colour = tuple[int, int, int]

# Blue, green, red; the page's colours on pictures.
SIDES: dict[str, Colour] = {"left": (245, 183, 89), "right": (92, 157, 255), "": (229, 226, 223)}
FOUND: Colour = (224, 142, 255)
REJECTED: Colour = (69, 90, 255)
UNMEASURED: Colour = (209, 205, 201)
# Light and dark marks are both seen on this grey.
GREY = 96
_DARK: Colour = (0, 0, 0)
_PAPER: Colour = (255, 255, 255)
# OpenCV fills circles of this thickness.
_FILLED = -1

# A bone is 2 px wide in a picture of 1280 x 720, and other marks follow it.
BONE_OF_DIAGONAL = 1 / 700
# Letters are 22 px high at OpenCV's scale of 1.
TEXT_OF_DIAGONAL = 1 / 2000
# No letter can be read below this scale of OpenCV.
MIN_TEXT_SCALE = 0.3
# Of a Gaussian in two dimensions 95 % lie within {x : x' S^-1 x = 5.991} (chi-square).
CHI2_95 = 5.991
# OpenCV counts in 32 bits: a point just before the camera's plane lies farther out.
MAX_COORDINATE_PX = 1e6
# A panel shows the people with a third of their size around them.
PANEL_MARGIN = 1.3
# Fewer pixels would show single pixels as squares.
MIN_PANEL_PX = 96.0
# Wider panels show no more on the page.
MAX_PANEL_PX = 640
# All panels of a page together have at most so many pixels, about 1.5 MB.
MAX_PIXELS_OF_PAGE = 6_000_000
# Marks stay sharp at this quality of WebP.
PANEL_QUALITY = 80
# The pictures of a strip show the body with half of its size around it.
STRIP_MARGIN = 1.5
# More pictures a second are not seen as smoother.
MAX_STRIP_HZ = 15.0
# The sizes of three pictures tell how many fit into the budget.
TRIED_PICTURES = 3
# More panels in a row are too small to see.
MAX_PANELS_IN_ROW = 4

# OpenCV takes coordinates in sixteenths of a pixel.
COORDINATE_BITS = 4

_WITH_ELLIPSE = {"nose", "head", "shoulder", "elbow", "wrist", "hip", "knee", "ankle"}  # others lie too close

Label = tuple[int, str, str]
"""Person, joint (K of a view), and what is written beside it."""

Video = Literal["none", "small", "full"]
"""Choice of the pictures in the page: none, at most 3 MB, or at most 10 MB before base64."""

_BUDGET = {"small": (3_000_000, 320, 55), "full": (10_000_000, 640, 70)}  # bytes, px, quality of WebP


class Window(NamedTuple):
    """A square of the picture, in pixels; the centre of the top left pixel is (0, 0)."""

    left: float
    top: float
    width: float


def draw_frame(
    picture: Picture,
    view: OverlayView,
    caption: Sequence[str],
    labels: Sequence[Label] = (),
    *,
    residuals: bool = False,
) -> Picture:
    """Draw a view's skeleton and keypoints on a copy of a picture of any size, with text at the upper left.

    Bones and joints are coloured by the side of the body; NaN is not drawn. Thin ellipses are the 95 %
    regions of the joints, by their own uncertainty alone. Rings are keypoints that were found, crosses those
    of joints that were rejected (red) or not reconstructed (grey), small dots those of other people. With
    `residuals` a thin line leads from each keypoint to its joint. ASCII caption and labels are left out where
    there is no room for them.
    """
    drawn = picture.copy()
    height, width = drawn.shape[:2]
    scale = np.array([width / view.intrinsics.width, height / view.intrinsics.height])
    bone = max(2 if residuals else 1, round(BONE_OF_DIAGONAL * float(np.hypot(width, height))))
    reprojected, found, others = (
        (points + 0.5) * scale - 0.5 for points in (view.reprojected, view.found, view.others)
    )
    _circles(drawn, others.reshape(-1, 2), bone, _FILLED, UNMEASURED)
    if view.spread is not None:
        _ellipses(drawn, view.joints, reprojected, view.spread * np.outer(scale, scale), max(1, bone // 2))
    _bones(drawn, view.joints, reprojected, bone)
    for joint, keypoint in zip(reprojected, found, strict=True) if residuals else ():
        for start, end in zip(joint, keypoint, strict=False):
            _line(drawn, start, end, max(1, bone // 2), FOUND)
    for k, joint in enumerate(view.joints):
        _circles(drawn, reprojected[:, k], 1.5 * bone, _FILLED, SIDES[side_of(joint)])
    _circles(drawn, found[~view.rejected & ~view.unmeasured], 2.5 * bone, max(1, round(0.7 * bone)), FOUND)
    _crosses(drawn, found[view.rejected], 2.5 * bone, bone, REJECTED)
    _crosses(drawn, found[view.unmeasured], 2.5 * bone, bone, UNMEASURED)
    _label(drawn, view.joints, reprojected, labels)
    if caption:
        _write(drawn, caption, top=True)
    return drawn


def blank_frame(width: int, height: int, words: str) -> Picture:
    """Return a grey picture with words in its middle that say why there is no picture."""
    blank = np.full((height, width, 3), GREY, dtype=np.uint8)
    _write(blank, [words], top=False)
    return blank


def caption_of(view: OverlayView, status: NDArray[np.int8], method: str) -> tuple[str, str]:
    """Write the caption of a frame: camera, frame, time, and the number of joints by `status` [P, J]."""
    counts = np.bincount(status[status >= 0].ravel(), minlength=len(STATUS))
    words = [f"{count} {word}" for word, count in zip(STATUS, counts, strict=True) if count]
    if not words:
        words = ["no skeleton at this time"]
    if not view.has_pose:
        words.append("no camera pose at this time")
    return f"{view.camera}   frame {view.frame}   {view.t_s:.3f} s", f"{method}: {', '.join(words)}"


# --- marks ---------------------------------------------------------------------------------------------


def _bones(picture: Picture, joints: tuple[str, ...], people: Float, bone: int) -> None:
    """Draw the bones of people [P, K, 2]: all dark casings first, so that they cover no bone."""
    place = {name: k for k, name in enumerate(joints)}
    bones = [
        (body[place[a]], body[place[b]], SIDES[side_of(a, b)]) for body in people for a, b in bones_of(joints)
    ]
    for start, end, _ in bones:
        _line(picture, start, end, bone + 2, _DARK)
    for start, end, colour in bones:
        _line(picture, start, end, bone, colour)


def _line(picture: Picture, start: Float, end: Float, thickness: int, colour: Colour) -> None:
    import cv2

    if _drawable(np.stack([start, end])).all():
        cv2.line(picture, _fixed(start), _fixed(end), colour, thickness, cv2.LINE_AA, COORDINATE_BITS)


def _circles(picture: Picture, points: Float, radius: float, thickness: int, colour: Colour) -> None:
    import cv2

    wide = round(radius * 2**COORDINATE_BITS)
    for point in points[_drawable(points)]:
        cv2.circle(picture, _fixed(point), wide, colour, thickness, cv2.LINE_AA, COORDINATE_BITS)


def _ellipses(
    picture: Picture, joints: tuple[str, ...], people: Float, spread: Float, thickness: int
) -> None:
    """Draw 95 % ellipses of the joints [P, K, 2], with covariances [P, J, 2, 2], NaN if not known."""
    import cv2

    most = float(np.hypot(*picture.shape[:2]))
    for body, own in zip(people, spread, strict=True):
        for k in np.flatnonzero(np.isfinite(own).all(axis=(1, 2)) & _drawable(body[: len(own)])):
            if joints[k].removeprefix("left_").removeprefix("right_") not in _WITH_ELLIPSE:
                continue
            squared, axes = np.linalg.eigh(own[k])
            half = np.sqrt(CHI2_95 * np.maximum(squared, 0.0))
            if half[1] < most:
                angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
                size = _fixed(half[::-1])
                colour = SIDES[side_of(joints[k])]
                centre = _fixed(body[k])
                cv2.ellipse(
                    picture, centre, size, angle, 0, 360, colour, thickness, cv2.LINE_AA, COORDINATE_BITS
                )


def _crosses(picture: Picture, points: Float, arm: float, thickness: int, colour: Colour) -> None:
    arms = arm / np.sqrt(2) * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]])
    for point in points:
        for start, end in point + arms:
            _line(picture, start, end, thickness, colour)


def _drawable(points: Float) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points) < MAX_COORDINATE_PX).all(axis=-1), np.bool_)  # NaN is not


def _fixed(point: Float) -> tuple[int, int]:
    x, y = np.round(point * 2**COORDINATE_BITS).astype(int).tolist()
    return x, y


def _write(picture: Picture, lines: Sequence[str], *, top: bool) -> None:
    """Write lines of text, white on darkened ground: at the upper left, or in the middle."""
    import cv2

    height, width = picture.shape[:2]
    font = cv2.FONT_HERSHEY_SIMPLEX
    wanted = max(float(np.hypot(width, height)) * TEXT_OF_DIAGONAL, MIN_TEXT_SCALE)

    def widest(scale: float) -> int:  # letters do not grow evenly
        return max(int(cv2.getTextSize(line, font, scale, _pen(scale))[0][0]) for line in lines)

    scale = min(wanted, wanted * 0.9 * width / widest(wanted))
    step = round(36 * scale)
    if scale < MIN_TEXT_SCALE or step * (len(lines) + 1) > height:
        return
    ground = (widest(scale) + step, step * len(lines) + step // 2)
    left, upper = (0, 0) if top else ((width - ground[0]) // 2, (height - ground[1]) // 2)
    part = picture[max(upper, 0) : upper + ground[1], max(left, 0) : left + ground[0]]
    part[:] = part // 3
    for k, line in enumerate(lines):
        at = (left + step // 2, upper + (k + 1) * step)
        cv2.putText(picture, line, at, font, scale, _PAPER, _pen(scale), cv2.LINE_AA)


def _label(picture: Picture, joints: tuple[str, ...], people: Float, labels: Sequence[Label]) -> None:
    """Write labels beside their joints [P, K, 2], on the outer side; none covers another."""
    import cv2

    height, width = picture.shape[:2]
    font = cv2.FONT_HERSHEY_SIMPLEX
    scale = float(np.hypot(width, height)) * TEXT_OF_DIAGONAL
    step = round(36 * scale)
    taken: list[tuple[int, int, int]] = []
    for person, joint, text in labels:
        point = people[person, joints.index(joint)] if joint in joints else np.full(2, np.nan)
        if (
            scale < MIN_TEXT_SCALE
            or not _drawable(point)
            or (point < 0).any()
            or (point >= [width, height]).any()
        ):
            continue
        long = int(cv2.getTextSize(text, font, scale, _pen(scale))[0][0]) + step // 2
        body = people[person][_drawable(people[person])]
        beside = step if point[0] >= np.median(body[:, 0]) else -step - long
        left = int(np.clip(round(float(point[0])) + beside, 0, max(width - long, 0)))
        upper = int(np.clip(round(float(point[1])) - step // 2, 0, height - step))
        while any(abs(upper - y) < step and left < x + wide and x < left + long for x, y, wide in taken):
            upper += step
        if upper + step > height:
            continue
        taken.append((left, upper, long))
        part = picture[upper : upper + step, left : left + long]
        part[:] = part // 3
        edge = np.array([left if left > point[0] else left + long, upper + step // 2], dtype=np.float64)
        _line(picture, point, edge, 1, _PAPER)
        at = (left + step // 4, upper + round(0.72 * step))
        cv2.putText(picture, text, at, font, scale, _PAPER, _pen(scale), cv2.LINE_AA)


def _pen(scale: float) -> int:
    return max(1, round(1.5 * scale))


# --- cut-outs ---


def _square_about(middle: Float, width: float, size: tuple[int, int]) -> Window:
    """Return a square around a point, on whole pixels, moved into the picture as far as it fits."""
    extent = np.ceil([width, width])
    room = np.array(size) - extent
    corner = np.where(room >= 0, np.clip(np.round(middle - extent / 2), 0, np.maximum(room, 0)), room / 2)
    return Window(float(corner[0]) - 0.5, float(corner[1]) - 0.5, float(extent[0]))


def window_of(view: OverlayView) -> Window:
    """Return the part that a panel shows: the people with a margin; without any, the whole picture."""
    size = (view.intrinsics.width, view.intrinsics.height)
    inside = _within(np.concatenate([view.found.reshape(-1, 2), view.reprojected.reshape(-1, 2)]), size)
    whole = float(max(size))
    if not len(inside):
        return _square_about(np.array(size) / 2 - 0.5, whole, size)
    low, high = inside.min(axis=0), inside.max(axis=0)
    wanted = PANEL_MARGIN * float((high - low).max())
    return _square_about((low + high) / 2, min(max(wanted, MIN_PANEL_PX), whole), size)


def _within(points: Float, size: tuple[int, int]) -> Float:
    """Return the known points [N, 2] that lie in the picture."""
    flat = points.reshape(-1, 2)
    return flat[(flat >= 0).all(axis=1) & (flat < size).all(axis=1)]  # False for NaN


def cut_out(picture: Picture, size: tuple[int, int], window: Window, px: int, ground: int = 0) -> Picture:
    """Cut out a square of `px` pixels, scaled from `size`; beyond the picture it has the grey of `ground`."""
    import cv2

    square = np.full((px, px, 3), ground, np.uint8)
    scale = np.array([picture.shape[1] / size[0], picture.shape[0] / size[1]])
    corners = np.array([window[:2], [window.left + window.width, window.top + window.width]]) + 0.5
    low, high = np.clip(np.round(corners * scale), 0, picture.shape[1::-1]).astype(int)
    places = (np.stack([low, high]) / scale - 0.5 - window[:2]) / window.width * px
    (x0, y0), (x1, y1) = np.clip(np.round(places), 0, px).astype(int)
    if (high > low).all() and x1 > x0 and y1 > y0:
        part = picture[low[1] : high[1], low[0] : high[0]]
        square[y0:y1, x0:x1] = cv2.resize(part, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    return square


def _as_webp(picture: Picture, quality: int) -> bytes:
    import cv2

    _, webp = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])
    return webp.tobytes()


# --- panels ---


def panel_width(panels: int) -> int:
    """Return the width in pixels of each of so many panels."""
    return min(MAX_PANEL_PX, int(np.sqrt(MAX_PIXELS_OF_PAGE / max(panels, 1))))


def draw_panel(view: OverlayView, px: int) -> Picture:
    """Draw the people of a view in a square of `px` pixels, on plain ground where there is no picture."""
    lens, window = view.intrinsics, window_of(view)
    size = (lens.width, lens.height)
    whole = view.picture if view.picture is not None else np.full((*size[::-1], 3), GREY, np.uint8)
    corner = np.array([window.left, window.top]) + 0.5
    side = int(window.width)
    moved = replace(
        view,
        intrinsics=replace(lens, width=side, height=side),
        found=view.found - corner,
        reprojected=view.reprojected - corner,
        others=view.others - corner,
        spread=None,
    )
    return draw_frame(cut_out(whole, size, window, px, GREY), moved, (), residuals=True)


def panel_source(view: OverlayView, px: int) -> str:
    """Return a panel as the source of an `<img>`; the same view gives the same bytes with the same OpenCV."""
    data = base64.b64encode(_as_webp(draw_panel(view, px), PANEL_QUALITY)).decode("ascii")
    return f"data:image/webp;base64,{data}"


def draw_overlays(moments: Sequence[OverlayMoment]) -> list[Figure]:
    """Draw a figure for every moment at which any camera has a frame."""
    return [_moment(k, moment) for k, moment in enumerate(moments, start=1) if moment.views]


def _moment(k: int, moment: OverlayMoment) -> Figure:
    columns = min(len(moment.views), MAX_PANELS_IN_ROW)
    panels = []
    for view in moment.views:
        words = f"{shortened(view.camera)}, frame {view.frame}, {quantity(view.median_px, 'px')}"
        marks: list[Mark] = [Image(draw_panel(view, MAX_PANEL_PX))]
        for name, points in (("found", view.found), ("reprojected", view.reprojected)):
            places = points[:, : view.found.shape[1]].reshape(-1, 2)
            marks.append(points_at(places, INK, name, marker="", legend=False))
        panels.append(Panel(marks, title=words, grid=None))
    rows = [panels[first : first + columns] for first in range(0, len(panels), columns)]
    caption = (
        "Lines: the skeleton reprojected, left limbs in blue, right limbs in orange. Rings: what the "
        "detector found; crosses: found, but not reconstructed, in red where the views disagreed."
    )
    caption += " The worst of these moments." if moment.worst else ""
    title = f"The skeleton in the pictures at {quantity(moment.t_s, 's', 2)}"
    height = len(rows) * (WIDTH_IN / columns + 0.2)
    errors = listing(f"{view.camera} {quantity(view.median_px, 'px')}" for view in moment.views)
    about = f"Median reprojection error: {errors}."
    return Figure(f"overlay-{k}", title, caption, rows, height, share_x=False, about=about)


# --- strips for the viewer ---


def make_strips(
    content: SessionContent, summary: Summary, read_frame: ReadFrame | None, video: Video
) -> list[Strip]:
    """Make the pictures of every camera that has any, within the budget; nothing without a skeleton."""
    motion = summary.motion
    if video == "none" or read_frame is None or motion is None or not motion.measured.any():
        return []
    cameras = filmed_cameras(content)
    budget = _BUDGET[video][0] / max(len(cameras), 1)
    strips = [_strip(camera, motion, summary.origin_ns, read_frame, video, budget) for camera in cameras]
    return [strip for strip in strips if strip is not None]


def _strip(
    camera: FilmedCamera,
    motion: MeasuredMotion,
    origin_ns: int,
    read_frame: ReadFrame,
    video: Video,
    budget: float,
) -> Strip | None:
    inside = (camera.frame_t_ns >= motion.t_ns[0]) & (camera.frame_t_ns <= motion.t_ns[-1])
    rows = np.flatnonzero(inside)
    if not len(rows):
        return None
    tried = rows[np.linspace(0, len(rows) - 1, TRIED_PICTURES + 2).astype(np.int64)[1:-1]]
    sizes = [len(each) for _, each, *_ in _cut(camera, tried, motion, origin_ns, read_frame, video)]
    if not sizes:
        return None
    seconds = (camera.frame_t_ns[rows[-1]] - camera.frame_t_ns[rows[0]]) / 1e9
    most = int(min(0.75 * budget / max(sizes), MAX_STRIP_HZ * seconds + 1, len(rows)))
    chosen = rows[np.unique(np.linspace(0, len(rows) - 1, max(most, 1)).round().astype(np.int64))]
    cut = _cut(camera, chosen, motion, origin_ns, read_frame, video)
    while sum(len(each) for _, each, *_ in cut) > 0.75 * budget and len(cut) > 1:  # base64 adds a third
        cut = cut[::2]
    return Strip(
        camera=camera.name,
        t_ns=np.array([camera.frame_t_ns[row] for row, *_ in cut], dtype=np.int64),
        pictures=tuple(base64.b64encode(each).decode("ascii") for _, each, *_ in cut),
        joints=np.stack([joints for _, _, joints, _ in cut]),
        projection=np.stack([projection for *_, projection in cut]),
    )


def _cut(
    camera: FilmedCamera,
    rows: Int64,
    motion: MeasuredMotion,
    origin_ns: int,
    read_frame: ReadFrame,
    video: Video,
) -> list[tuple[int, bytes, Float, Float]]:
    """Cut out and encode the pictures of frames that have any: row, WebP, joints, projection."""
    _, px, quality = _BUDGET[video]
    size = (camera.intrinsics.width, camera.intrinsics.height)
    views = views_of(camera, rows, motion, status_at(motion, camera.frame_t_ns[rows]), origin_ns)
    bodies = [_within(view.reprojected, size) for view in views]
    extents = [float(np.ptp(points, axis=0).max()) for points in bodies if len(points)]
    side = min(
        max(STRIP_MARGIN * float(np.percentile(extents, 90)) if extents else 0.0, MIN_PANEL_PX), max(size)
    )
    middle = np.array(size) / 2
    found = []
    for row, view, points in zip(rows.tolist(), views, bodies, strict=True):
        middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else middle
        picture = read_frame(camera.name, view.frame)
        if picture is None:
            continue
        window = _square_about(middle, side, size)
        encoded = _as_webp(cut_out(picture, size, window, px), quality)
        joints = (view.reprojected - [window.left, window.top]) / window.width
        projection = _projection_near(camera, row, (window.left, window.top, window.width))
        found.append((row, encoded, joints, projection))
    return found


def _projection_near(camera: FilmedCamera, row: int, window: tuple[float, float, float]) -> Float:
    """Return the projection [3, 4] from the world into a window, linear about the middle of it; else NaN."""
    left, top, side = window
    position, rotation = (part[0] for part in camera.poses_at(camera.frame_t_ns[[row]]))
    middle = np.append(undistort(np.array([[left + side / 2, top + side / 2]]), camera.intrinsics)[0], 1.0)
    step = 1e-3
    pixel = project(middle + np.vstack([np.zeros(3), step * np.eye(3)[:2]]), camera.intrinsics)
    slope = (pixel[1:] - pixel[0]).T / step
    linear = np.vstack([np.column_stack([slope, pixel[0] - slope @ middle[:2]]), [0.0, 0.0, 1.0]])
    into = np.array([[1 / side, 0.0, -left / side], [0.0, 1 / side, -top / side], [0.0, 0.0, 1.0]])
    found: Float = into @ linear @ np.column_stack([rotation.T, -rotation.T @ position])
    return found
