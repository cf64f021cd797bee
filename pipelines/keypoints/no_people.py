"""Bodies that are no further people to reconstruct, by the ground, their size, and the place of the cameras.

A body has a size, and people stand on the ground: what several cameras see has a place, which is near the
ground or not.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.keypoints.bodies import SAME_BODY_M, Bodies, SightLines, meeting_points, rays_of

Int64 = NDArray[np.int64]
Ground = Callable[[Float], tuple[Float, Float]]
"""Function from points [N, 3] to the heights (m) [N] of the ground there and their errors; NaN if unknown."""

# The diagonal of the box about a body's joints: crouching, and arms stretched upwards.
_EXTENT_M = (0.8, 2.6)
# The middle of a body above the ground: lying in a hollow, and standing.
_HEIGHT_M = (-1.0, 1.6)
# More than this share of the times must speak against a person.
_MIN_REFUSED_SHARE = 0.5
# The place of a body counts if its standard deviation is smaller.
_MAX_PLACE_SIGMA_M = 1.0
# Who is in one picture with a person in a smaller share of the times is never beside them.
_MIN_COMPANY_SHARE = 0.05
# The ground may rise this much from where somebody went.
_MAX_SLOPE = 0.3
# The hip of a standing actor is this high above the ground.
_HIP_HEIGHT_M = 0.95
# The ground under a person is this uncertain, by posture and log.
_GROUND_SIGMA_M = 1.0


class Surroundings(NamedTuple):
    """Surroundings of the people, as far as they are known."""

    ground: Ground | None  # of a map or a log; without either it is that under who is seen most
    fields: Float  # [C, 4] left, top, right, bottom of each camera's picture, normalised


# Two cameras must see somebody for this long before they count as a person.
_MIN_SIGHT_S = 1.0
# A second body nearer to a person than this, never beside them in a picture, is theirs.
_SAME_PERSON_M = 0.5
# The median of chi-square per degree of freedom has an expectation of 1.
_MAX_MISFIT = 4.0
# A body is triangulated at this many times, which suffices for medians.
_SAMPLES = 200
# Where a level is all that is known, a crown at 3 m is not on the ground.
_DOUBTED_SHARE = 0.5


class PossiblePerson(NamedTuple):
    """Detections that may be one person over time."""

    choice: Int64  # [T, C] index of the detection in each camera, -1 none
    middle: Float  # [T, 3] m, NaN where fewer than two cameras see the body


def why_no_person(
    body: PossiblePerson,
    people: list[PossiblePerson],
    time_s: Float,
    views: SightLines,
    scene: Surroundings | None,
) -> str:
    """Say why a body that two cameras see is no further person to reconstruct; empty if it is one.

    Args:
        body: the detections in question.
        people: those already taken for people.
        time_s: [T] s, increasing.
        views: all detections.
        scene: the surroundings, if known.

    Returns:
        "short": seen by two cameras for less than a second, or never together with anybody, as the pieces
        of one lost person; "same": alongside a person, and never with them in one picture; "ground": too
        high or too low; "size": not of a person's extent; "misfit": the views do not fit each other;
        "bystander": beyond the ring of the cameras, and never in all of their pictures.
    """
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    there: Bool = np.isfinite(body.middle[:, 0])
    together = np.zeros(len(there), np.bool_)
    for other in people:
        both = there & np.isfinite(other.middle[:, 0])
        together |= both
        side_by_side: Bool = np.asarray(((body.choice >= 0) & (other.choice >= 0)).any(axis=1))
        apart = np.linalg.norm(body.middle - other.middle, axis=1)
        if (
            both.any()
            and np.median(apart[both]) < _SAME_PERSON_M
            and np.mean(side_by_side[both]) < _MIN_COMPANY_SHARE
        ):
            return "same"
    if (there if not people else together).sum() * step_s < _MIN_SIGHT_S:
        return "short"
    if cause := why_no_body(body, views, scene):
        return cause
    return "bystander" if scene is not None and _is_bystander(body, people, views, scene.fields) else ""


def why_no_body(body: PossiblePerson, views: SightLines, scene: Surroundings | None) -> str:
    """Say why detections are not one person's body; empty if they are, or if two cameras never see it.

    Returns:
        "ground", "size" or "misfit", as for `why_no_person`.
    """
    rows = np.flatnonzero(np.isfinite(body.middle[:, 0]))
    if not len(rows):
        return ""
    if scene is not None and scene.ground is not None:
        level, doubt = scene.ground(body.middle[rows])
        height = body.middle[rows, 2] - level
        known = np.isfinite(height)
        slack = _DOUBTED_SHARE * doubt[known]
        off = (height[known] - slack > _HEIGHT_M[1]) | (height[known] + slack < _HEIGHT_M[0])
        if known.any() and off.mean() > _MIN_REFUSED_SHARE:
            return "ground"
    extent_m, misfit = _body_of(body.choice, rows[:: -(-len(rows) // _SAMPLES)], views)
    if not _EXTENT_M[0] <= extent_m <= _EXTENT_M[1]:
        return "size"
    return "misfit" if misfit > _MAX_MISFIT else ""


def _is_bystander(
    body: PossiblePerson, people: list[PossiblePerson], views: SightLines, fields: Float
) -> bool:
    """Test if a body stands beyond the cameras that film the people, and never in all of their pictures.

    Cameras about a person look inwards. Whoever is further from everybody taken for a person than half of the
    cameras are is behind one of them. Two cameras on one side do not look inwards, and see them both.
    """
    rows = np.flatnonzero(np.isfinite(body.middle[:, 0]))
    off = np.array([np.hypot(*(body.middle[rows] - one.middle[rows]).T[:2]) for one in people])
    if not np.isfinite(off).any():
        return False
    off = np.where(np.isfinite(off), off, np.inf)
    nearest = np.array([one.middle[rows] for one in people])[off.argmin(axis=0), np.arange(len(rows))]
    met = np.isfinite(nearest[:, 0])
    rows, nearest, apart = rows[met], nearest[met], off.min(axis=0)[met]
    position, rotation = views.position[rows], views.rotation[rows]
    posed = np.isfinite(position).all(axis=-1) & np.isfinite(rotation).all(axis=(-2, -1))
    ring = np.where(posed, np.hypot(*np.moveaxis(position - nearest[:, None], -1, 0)[:2]), np.nan)
    whole = np.ones(len(rows), np.bool_)
    for c, field in enumerate(fields):
        shown = _in_picture(body.middle[rows], position[:, c], rotation[:, c], field)
        whole &= shown | ~posed[:, c]
    beyond = apart > np.nanmedian(ring, axis=1)
    return bool(beyond.mean() > _MIN_REFUSED_SHARE and whole.mean() < _MIN_COMPANY_SHARE)


def _body_of(choice: Int64, rows: NDArray[np.intp], views: SightLines) -> tuple[float, float]:
    """Triangulate a body at some times [N] by least squares on its viewing rays.

    Returns:
        The median over the times of the diagonal of the box about its joints (m), and the median of the
        whitened squares per degree of freedom (2 per view, less 3) of its joints; NaN without any.
    """
    time, camera = rows[:, None], np.arange(choice.shape[1])
    taken = np.maximum(choice[rows], 0)
    xy = views.xy[time, camera, taken]
    confidence = np.where((choice[rows] >= 0)[..., None], views.confidence[time, camera, taken], 0.0)
    seen = (confidence > 0) & np.isfinite(xy).all(axis=-1) & np.isfinite(views.position[rows])[..., :1]
    rays = np.moveaxis(rays_of(xy, np.nan_to_num(views.rotation[rows])), 1, 2)  # [N, J, C, 3]
    origin = np.nan_to_num(views.position[rows])[:, None]
    weight = np.moveaxis(seen, 1, 2).astype(np.float64)
    points, _ = meeting_points(rays, np.broadcast_to(origin, rays.shape), weight)
    several = np.isfinite(points[..., 0])
    box = np.nanmax(points, axis=1, initial=-np.inf) - np.nanmin(points, axis=1, initial=np.inf)
    extent = np.linalg.norm(box[several.sum(axis=1) > 1], axis=-1)
    sight = points[:, :, None] - origin
    off2 = (np.cross(rays, sight) ** 2).sum(axis=-1)
    variance = (views.sigma[rows][:, None] * np.linalg.norm(sight, axis=-1)) ** 2 + SAME_BODY_M**2
    used = (weight > 0) & several[..., None]
    square = np.where(used, off2 / variance, 0.0).sum(axis=2)
    misfit = (square / np.maximum(2 * used.sum(axis=2) - 3, 1))[several]
    if not len(extent):
        return np.nan, np.nan
    return float(np.median(extent)), float(np.median(misfit))


def level_of(hips: Float) -> Ground:
    """Return the ground at the level of somebody who walks there, less certain the further away.

    Args:
        hips: [A, 3] m, where the person was; at least one is finite.
    """
    way = hips[np.isfinite(hips).all(axis=1)]
    way = way[:: max(1, len(way) // 100)]

    def ground(points: Float) -> tuple[Float, Float]:
        away = np.stack([np.hypot(*(points[:, :2] - place[:2]).T) for place in way])
        nearest = away.argmin(axis=0)
        return way[nearest, 2] - _HIP_HEIGHT_M, _GROUND_SIGMA_M + _MAX_SLOPE * away.min(axis=0)

    return ground


def level_of_most_seen(seen: Bodies) -> Ground | None:
    """Return the level of the person whom several cameras see most; None without one."""
    placed = seen.spread < _MAX_PLACE_SIGMA_M
    people, views = np.unique(seen.track[placed], return_counts=True)
    if not len(people):
        return None
    return level_of(seen.middle[placed & (seen.track == people[views.argmax()])])


def _in_picture(places: Float, position: Float, rotation: Float, field: Float) -> Bool:
    """Test which places [N, 3] are in the pictures of one camera [N]."""
    u, v, depth = np.einsum("nij,ni->jn", rotation, places - position)
    left, top, right, bottom = field
    with np.errstate(invalid="ignore", divide="ignore"):
        across, along = u / depth, v / depth
        inside = (across > left) & (across < right) & (along > top) & (along < bottom)
    return np.asarray(inside & (depth > 0), dtype=np.bool_)
