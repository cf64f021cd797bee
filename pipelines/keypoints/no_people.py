"""Things that are no people among the detections of all cameras, by the ground and by the other cameras.

A body has a size, so its extent in a picture says how far away it can be, and people stand on the ground:
somewhere within that distance the line of sight must be near the ground. A tree's crown is too high there,
or too large. What several cameras see has a place, which is near the ground or not.

What one camera follows alone, although another one looks wherever somebody of usual size could stand, is
nobody who can be reconstructed. Nothing is lost with it, so this test allows less than the first.

Tracks are judged whole, camera by camera. Poses may be wrong: a camera whose surest person fails a test
loses nobody by that test.
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

_EXTENT_M = (0.4, 2.6)  # diagonal of the box about a body's joints: curled up, and arms stretched upwards
_HEIGHT_M = (-1.0, 2.0)  # of the middle of a body above the ground: lying in a hollow, and jumping
_USUAL_EXTENT_M = (0.8, 2.2)  # crouching, and a tall person
_USUAL_HEIGHT_M = (-0.3, 1.6)
# A detection is left out only if it contradicts the ground beyond this many standard deviations.
_MARGIN_SIGMAS = 3.0
# A track is judged after this many pictures, as in `tracking`.
_JUDGED_PICTURES = 5
# More than this share of the pictures that can be judged must be refused.
_MIN_REFUSED_SHARE = 0.5
# A camera that sees a track in a smaller share of the pictures does not see it.
_MIN_COMPANY_SHARE = 0.05
# A group's place counts if its standard deviation is smaller.
_MAX_PLACE_SIGMA_M = 1.0
# Along a line of sight of 60 m, 45 deg from above, a place lies in each 1.7 m of height.
_SIGHT_STEPS = 48
# A body this near the edge of a picture (a share of it) may not be found.
_EDGE_SHARE = 0.1
# The way from another camera to a place is tested at this many points.
_BETWEEN_POINTS = 8
# The ground may rise this much from where somebody went.
_MAX_SLOPE = 0.3
# The hip of a standing actor is this high above the ground.
_HIP_HEIGHT_M = 0.95
# The ground under a person is this uncertain, by posture and log.
_GROUND_SIGMA_M = 1.0
# The places of this many detections take 100 MB of memory.
_BLOCK = 1_000


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
        height, doubt = _heights(scene.ground, body.middle[rows])
        known = np.isfinite(height)
        slack = _DOUBTED_SHARE * doubt[known]
        off = (height[known] - slack > _USUAL_HEIGHT_M[1]) | (height[known] + slack < _HEIGHT_M[0])
        if known.any() and off.mean() > _MIN_REFUSED_SHARE:
            return "ground"
    extent_m, misfit = _body_of(body.choice, rows[:: -(-len(rows) // _SAMPLES)], views)
    if not _USUAL_EXTENT_M[0] <= extent_m <= _EXTENT_M[1]:
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
        shown = _in_picture(body.middle[rows, None], position[:, c], rotation[:, c], field)[:, 0]
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


class NoPeople(NamedTuple):
    """Detections [T, C, D] that are no people, by cause."""

    ground: Bool  # too large, too small or too high for somebody on the ground
    alone: Bool  # another camera looks there and sees nobody
    kept: Bool  # refused by the ground, and kept because the camera's surest person is refused, too


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


def tell_no_people(
    seen: Bodies,
    xy: Float,
    confidence: Float,
    position: Float,
    rotation: Float,
    sigma: Float,
    scene: Surroundings,
) -> NoPeople:
    """Tell which detections are no people.

    Args:
        seen: the tracks and groups of these detections.
        xy: [T, C, D, J, 2] undistorted normalised picture coordinates, NaN where nothing is.
        confidence: [T, C, D, J]; joints at 0 or NaN are not used.
        position: [T, C, 3] m, world_from_camera, NaN without a pose.
        rotation: [T, C, 3, 3] world_from_camera.
        sigma: [T, C] rad, standard deviation of a viewing ray on each axis.
        scene: the surroundings.
    """
    found = NoPeople(*(np.zeros(seen.track.shape, np.bool_) for _ in NoPeople._fields))
    if scene.ground is None:
        scene = scene._replace(ground=level_of_most_seen(seen))
    for c in range(seen.track.shape[1]):
        at = np.nonzero(seen.track[:, c] >= 0)
        if not len(at[0]):
            continue
        parts = [
            _verdicts(seen, (at[0][rows], c, at[1][rows]), (xy, confidence, position, rotation, sigma), scene)
            for rows in (slice(k, k + _BLOCK) for k in range(0, len(at[0]), _BLOCK))
        ]
        refused, judged, looked = (np.concatenate(each) for each in zip(*parts, strict=True))
        weight = np.nan_to_num(confidence[:, c][at]).sum(axis=-1)
        _, track = np.unique(seen.track[:, c][at], return_inverse=True)
        surest = np.bincount(track, weight).argmax()

        off = _shares(track, refused, judged) > _MIN_REFUSED_SHARE
        company = seen.views[:, c][at] > 1
        share = _shares(track, company, looked | company)
        alone = (share < _MIN_COMPANY_SHARE) & bool(share[surest] > _MIN_REFUSED_SHARE)
        ground = off & (not off[surest])
        found.ground[at[0], c, at[1]] = ground[track]
        found.alone[at[0], c, at[1]] = (alone & ~ground)[track]
        found.kept[at[0], c, at[1]] = (off & ~ground & ~alone)[track]
    return found


def level_of_most_seen(seen: Bodies) -> Ground | None:
    """Return the level of the person whom several cameras see most; None without one."""
    placed = seen.spread < _MAX_PLACE_SIGMA_M
    people, views = np.unique(seen.track[placed], return_counts=True)
    if not len(people):
        return None
    return level_of(seen.middle[placed & (seen.track == people[views.argmax()])])


def _shares(track: NDArray[np.intp], said: Bool, judged: Bool) -> Float:
    """Return the share of each track's judged pictures that say so, NaN for fewer than five of them."""
    count = np.bincount(track, judged).astype(np.float64)
    return np.bincount(track, said & judged) / np.where(count >= _JUDGED_PICTURES, count, np.nan)


def _verdicts(
    seen: Bodies,
    at: tuple[Int64, int, Int64],
    seen_by: tuple[Float, Float, Float, Float, Float],
    scene: Surroundings,
) -> tuple[Bool, Bool, Bool]:
    """Judge detections of one camera.

    Args:
        seen: their groups.
        at: their indices.
        seen_by: the arrays of `tell_no_people`.
        scene: the surroundings.

    Returns:
        Three arrays [N]. The ground refuses it; the ground is known; if another camera has every place in its
        picture, and in sight, where somebody of usual size could be.
    """
    xy, confidence, position, rotation, sigma = seen_by
    time, camera, _ = at
    points = np.where((confidence[at] > 0)[..., None], xy[at], np.nan)
    reach, places = _line_of_sight(points, position[time, camera], rotation[time, camera])
    error = _MARGIN_SIGMAS * sigma[time, camera, None] * reach
    extent = np.geomspace(*_EXTENT_M, _SIGHT_STEPS)
    usual = np.tile((extent >= _USUAL_EXTENT_M[0]) & (extent <= _USUAL_EXTENT_M[1]), (len(places), 1))
    if scene.ground is None:
        nothing = np.zeros(len(places), np.bool_)
        return nothing, nothing, _others_look(places, usual, time, camera, position, rotation, scene)
    height, doubt = _heights(scene.ground, places)
    above, off_by = _heights(scene.ground, seen.middle[at])
    off_by = off_by + _MARGIN_SIGMAS * seen.spread[at]
    with np.errstate(invalid="ignore"):
        placed = (seen.spread[at] < _MAX_PLACE_SIGMA_M) & np.isfinite(above)
        known = np.isfinite(height).all(axis=1)
        low, high = height - error - doubt, height + error + doubt
        nowhere = (low.min(axis=1) > _HEIGHT_M[1]) | (high.max(axis=1) < _HEIGHT_M[0])
        elsewhere = (above - off_by > _HEIGHT_M[1]) | (above + off_by < _HEIGHT_M[0])
        usual &= ~((height - error > _USUAL_HEIGHT_M[1]) | (height + error < _USUAL_HEIGHT_M[0]))
    looked = _others_look(places, usual, time, camera, position, rotation, scene)
    return np.where(placed, elsewhere, nowhere & known), placed | known, looked


def _line_of_sight(points: Float, position: Float, rotation: Float) -> tuple[Float, Float]:
    """Return the distances [N, K] m at which a body may be, by its extent, and the places [N, K, 3] there."""
    low, high = np.nanmin(points, axis=1), np.nanmax(points, axis=1)
    middle = np.column_stack([np.nanmedian(points, axis=1), np.ones(len(points))])
    depth = np.geomspace(*_EXTENT_M, _SIGHT_STEPS) / np.maximum(np.hypot(*(high - low).T), 1e-6)[:, None]
    places = position[:, None] + depth[..., None] * np.einsum("nij,nj->ni", rotation, middle)[:, None]
    return depth * np.linalg.norm(middle, axis=1)[:, None], places


def _heights(ground: Ground, points: Float) -> tuple[Float, Float]:
    """Return the heights [...] of points [..., 3] above the ground, and its errors; NaN if unknown."""
    level, doubt = ground(points.reshape(-1, 3))
    return points[..., 2] - level.reshape(points.shape[:-1]), doubt.reshape(points.shape[:-1])


def _others_look(
    places: Float,
    usual: Bool,
    time: Int64,
    camera: int,
    position: Float,
    rotation: Float,
    scene: Surroundings,
) -> Bool:
    """Test if one other camera has every usual place of [N, K, 3] in its picture, and in sight."""
    looked = np.zeros(len(places), np.bool_)
    for c in range(position.shape[1]):
        if c == camera:
            continue
        origin = position[time, c]
        inside = _in_picture(places, origin, rotation[time, c], scene.fields[c], margin=_EDGE_SHARE)
        whole = (inside | ~usual).all(axis=1) & np.isfinite(origin).all(axis=1)
        rows = np.flatnonzero(whole & ~looked)
        looked[rows] = ~_hidden(origin[rows], places[rows], usual[rows], scene.ground)
    return looked


def _in_picture(
    places: Float, position: Float, rotation: Float, field: Float, *, margin: float = 0.0
) -> Bool:
    """Test which places [N, K, 3] are in the pictures of one camera [N], apart from a margin (a share)."""
    u, v, depth = np.einsum("nij,nki->jnk", rotation, places - position[:, None])
    left, top, right, bottom = field
    with np.errstate(invalid="ignore", divide="ignore"):
        across, along = (u / depth - left) / (right - left), (v / depth - top) / (bottom - top)
        inside = (np.minimum(across, along) > margin) & (np.maximum(across, along) < 1 - margin)
    return np.asarray(inside & (depth > 0), dtype=np.bool_)


def _hidden(origin: Float, places: Float, usual: Bool, ground: Ground | None) -> Bool:
    """Test if the ground may be between a camera [N, 3] and any usual place of [N, K, 3]."""
    hidden = np.zeros(places.shape[:2], np.bool_)
    if ground is not None:
        row, step = np.nonzero(usual)
        for share in np.arange(1, _BETWEEN_POINTS) / _BETWEEN_POINTS:
            height, _ = _heights(ground, origin[row] + share * (places[row, step] - origin[row]))
            hidden[row, step] |= height < 0
    return np.asarray(hidden.any(axis=1))
