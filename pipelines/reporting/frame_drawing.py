"""A view drawn into its picture, for videos: bones, joints, keypoints and a caption as pixels."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Picture
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.motion import side_of
from pipelines.reporting.overlays import View
from pipelines.session.people import bones_of

Colour = tuple[int, int, int]

# Blue, green, red; the page's colours on pictures.
SIDES: dict[str, Colour] = {"left": (245, 183, 89), "right": (92, 157, 255), "": (229, 226, 223)}
FOUND: Colour = (224, 142, 255)
REJECTED: Colour = (69, 90, 255)
UNMEASURED: Colour = (209, 205, 201)
GREY = 96
_DARK: Colour = (0, 0, 0)
_PAPER: Colour = (255, 255, 255)

_BONE = 1 / 700  # of the picture's diagonal: 2 px at 1280 x 720
_TEXT = 1 / 2000  # of it, too: OpenCV's scale, 22 px high at 1
_LEAST_TEXT = 0.3  # OpenCV's scale below which no letter can be read
_SPARE, _CORNER = 0.1, 0.15  # of a person's box: spare room at each side, and length of its corners' arms
_WITH_ELLIPSE = {"nose", "head", "shoulder", "elbow", "wrist", "hip", "knee", "ankle"}  # others lie too close
_INLET_SHARE = 0.42  # of the picture's height
CHI2_95 = 5.991
"""Of a Gaussian in two dimensions 95 % lie within {x : x' S^-1 x = 5.991} (chi-square)."""
_SHIFT = 4  # OpenCV takes coordinates in sixteenths of a pixel
_FURTHEST_PX = 1e6  # of a point just before the camera's plane; OpenCV counts in 32 bits


Label = tuple[int, str, str]
"""Person, joint (K of a view), and what is written beside it."""


def draw_frame(picture: Picture, view: View, caption: Sequence[str], labels: Sequence[Label] = ()) -> Picture:
    """Draw a view's skeleton and keypoints, and lines of text at the upper left, on a copy of a picture.

    Bones and joints are coloured by the side of the body; NaN is not drawn. Thin ellipses are the 95 %
    regions of the body's joints, by their own uncertainty alone. Rings are keypoints that were found, crosses
    those of joints that were rejected (red) or not reconstructed (grey), small dots the keypoints of other
    people. Four corners mark the box of a person's found keypoints, with a tenth to spare.

    Args:
        picture: [height, width, 3]; if its size differs from the camera's, it is the same view at another
            scale.
        view: the view to draw; its own picture is not used.
        caption: lines of ASCII, or none; left out where the picture is too small to read them.
        labels: in ASCII, each written beside its joint. A label is left out in small pictures, without its
            joint, and where no room is left below the others.
    """
    drawn = picture.copy()
    height, width = drawn.shape[:2]
    scale = np.array([width / view.intrinsics.width, height / view.intrinsics.height])
    bone = max(1, round(_BONE * float(np.hypot(width, height))))
    reprojected, found, others = (
        (points + 0.5) * scale - 0.5 for points in (view.reprojected, view.found, view.others)
    )
    _dots(drawn, others.reshape(-1, 2), bone, UNMEASURED)
    if view.spread is not None:
        _ellipses(drawn, view.joints, reprojected, view.spread * np.outer(scale, scale), max(1, bone // 2))
    for person in found:
        _corners(drawn, person, max(1, bone // 2))
    _bones(drawn, view.joints, reprojected, bone)
    for k, joint in enumerate(view.joints):
        _dots(drawn, reprojected[:, k], 1.5 * bone, SIDES[side_of(joint)])
    _rings(drawn, found[~view.rejected & ~view.unmeasured], 2.5 * bone, max(1, round(0.7 * bone)), FOUND)
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


def caption_of(view: View, status: NDArray[np.int8], method: str) -> tuple[str, str]:
    """Write the caption of a frame: camera, frame, time, and the number of joints by status.

    Args:
        status: [P, J] index into triangulation.STATUS, -1 where the skeleton has no row.
    """
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
        cv2.line(picture, _fixed(start), _fixed(end), colour, thickness, cv2.LINE_AA, _SHIFT)


def _dots(picture: Picture, points: Float, radius: float, colour: Colour) -> None:
    import cv2

    for point in points[_drawable(points)]:
        cv2.circle(picture, _fixed(point), round(radius * 2**_SHIFT), colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)


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
                cv2.ellipse(picture, centre, size, angle, 0, 360, colour, thickness, cv2.LINE_AA, _SHIFT)


def _corners(picture: Picture, found: Float, thickness: int) -> None:
    """Draw the corners of a box about the points [J, 2] that are known; nothing for fewer than two."""
    known = found[_drawable(found)]
    if len(known) < 2:
        return
    low, high = known.min(axis=0), known.max(axis=0)
    spare = _SPARE * float((high - low).max())
    low, high = low - spare, high + spare
    arm = _CORNER * float((high - low).min())
    for x, inward in ((low[0], 1), (high[0], -1)):
        for y, downward in ((low[1], 1), (high[1], -1)):
            corner = np.array([x, y])
            for across in (np.array([inward * arm, 0.0]), np.array([0.0, downward * arm])):
                _line(picture, corner, corner + across, thickness, FOUND)


def _rings(picture: Picture, points: Float, radius: float, thickness: int, colour: Colour) -> None:
    import cv2

    for point in points[_drawable(points)]:
        cv2.circle(picture, _fixed(point), round(radius * 2**_SHIFT), colour, thickness, cv2.LINE_AA, _SHIFT)


def _crosses(picture: Picture, points: Float, arm: float, thickness: int, colour: Colour) -> None:
    arms = arm / np.sqrt(2) * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]])
    for point in points:
        for start, end in point + arms:
            _line(picture, start, end, thickness, colour)


def _drawable(points: Float) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points) < _FURTHEST_PX).all(axis=-1), np.bool_)  # NaN is not


def _fixed(point: Float) -> tuple[int, int]:
    x, y = np.round(point * 2**_SHIFT).astype(int).tolist()
    return x, y


def with_inlet(picture: Picture, middle_px: Float, side_px: float) -> Picture:
    """Draw the square about the middle, enlarged, at the lower right; do nothing without a middle."""
    import cv2

    height, width = picture.shape[:2]
    side = int(min(side_px, height, width))
    if side < 2 or not np.isfinite(middle_px).all():
        return picture
    left, upper = (
        int(np.clip(round(float(centre)) - side // 2, 0, most - side))
        for centre, most in zip(middle_px, (width, height), strict=True)
    )
    edge = round(_INLET_SHARE * min(height, width))
    part = cv2.resize(
        picture[upper : upper + side, left : left + side], (edge, edge), interpolation=cv2.INTER_CUBIC
    )
    picture[-edge:, -edge:] = part
    cv2.rectangle(picture, (width - edge, height - edge), (width - 1, height - 1), (255, 255, 255), 1)
    return picture


def _write(picture: Picture, lines: Sequence[str], *, top: bool) -> None:
    """Write lines of text, white on darkened ground: at the upper left, or in the middle."""
    import cv2

    height, width = picture.shape[:2]
    font = cv2.FONT_HERSHEY_SIMPLEX
    wanted = max(float(np.hypot(width, height)) * _TEXT, _LEAST_TEXT)

    def widest(scale: float) -> int:  # letters do not grow evenly
        return max(int(cv2.getTextSize(line, font, scale, _pen(scale))[0][0]) for line in lines)

    scale = min(wanted, wanted * 0.9 * width / widest(wanted))
    step = round(36 * scale)
    if scale < _LEAST_TEXT or step * (len(lines) + 1) > height:
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
    scale = float(np.hypot(width, height)) * _TEXT
    step = round(36 * scale)
    taken: list[tuple[int, int, int]] = []
    for person, joint, text in labels:
        point = people[person, joints.index(joint)] if joint in joints else np.full(2, np.nan)
        if (
            scale < _LEAST_TEXT
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
