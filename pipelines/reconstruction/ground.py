"""Errors between cameras, found in patches of ground that two of them see.

The background binds a moving camera's path to its attitudes and leaves its whole path free to shift
(`reconstruction.background`). Its followed points are a cloud that moves with it. A patch of ground about
a point of one camera's cloud is cut out of both cameras' stills as an orthophoto, and the second one is
searched for the first. The displacement across the second camera's ray is what both cameras' errors make
there: their shifts, a turn, and the modes of what the background leaves. The ground does not move, so the
two stills may be of different times: those are taken that see the patch from the most similar directions.

Only differences are found. The mean error of all bound cameras keeps its prior; it moves cameras and people
together and is given apart as a covariance that all joints share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations
from typing import Any

import cv2
import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64, Picture
from pipelines.geometry.cameras import project, row_delay_s, undistort
from pipelines.geometry.noise import EXACT, ROTATION, SHIFT_IN_WORLD, USUAL_CONSTANT, USUAL_COUNT, Process
from pipelines.geometry.poses import cross_matrix, multiply, quaternion_from_rotation_vector
from pipelines.reconstruction.background_tracks import Followed, Stills, Tracks, people_boxes
from pipelines.reconstruction.observations import Camera
from pipelines.session.description import Interpolation

# Points of the cloud that were seen in fewer pictures are placed too badly.
_FEWEST_SIGHTINGS = 5
# Followed points err by this much over a track, with their drift.
_PIXEL_SIGMA = 0.5
# Points that are placed worse than this, all axes together, tell nothing of an offset of 0.1 m.
_POINT_SIGMA_M = 0.15
# A point with a larger mean residual moved, or was lost.
_WORST_PX = 1.5
# A prior of this standard deviation about the origin keeps the equations of points regular.
_ANYWHERE_M = 300.0
_NEAREST_M, _FARTHEST_M = 1.5, 40.0

# At most one patch is cut out in a cube of this size: patches that overlap say the same.
_GRID_M = 0.8
# This bounds the time that the patches of all pairs take.
_MOST_PATCHES = 3000
# More patches of a pair of cameras do not make its offset surer.
_MOST_OF_PAIR = 120
# The ground plane of a point is fitted to its neighbours within this distance.
_AROUND_M = 1.5
# Fewer neighbours leave the plane's normal worse than 5 deg.
_NEIGHBOURS = 6
# Ground that is rougher than this about its plane looks different from two sides.
_ROUGH_M = 0.05
# Planes at a smaller cosine of the slope are walls.
_STEEPEST = 0.6
# Ground at a smaller sine of the angle to the ray is too blurred to compare.
_GRAZING = 0.12

_PASSES = (2, 2, 1)  # of the comparison, each about what the one before found: one in so many patches
# A patch is compared in so many pairs of stills; errors of more of them are alike.
_PAIRS_OF_STILLS = 3
# Patches reach this many cells to each side of their centre, which holds enough texture.
_HALF_CELLS = 20
# Cells are as large as a pixel shows of the ground at usual distances.
_CELL_M = 0.03
# Patches that may lie farther off than this are found by chance.
_FARTHEST_REACH_CELLS = 100
# Both pictures are blurred by this much, so that their sharpness is alike.
_BLUR_CELLS = 3.0
# A patch whose grey levels have a smaller standard deviation shows nothing.
_FLAT = 2.5
_ALIKE, _CLEARER = 0.75, 0.08  # correlation, and by how much it must exceed that of any other place
# Places within this distance of the best one belong to the same peak.
_PEAK_CELLS = 4
# Lenses are calibrated badly nearer to the edge of the picture.
_EDGE_PX = 40

# So many stills of a camera show its ground from all its directions.
_MOST_STILLS = 40
# Larger stills are halved, which bounds their memory.
_MOST_PIXELS = 2_500_000
# Stills are halved so often at most: the ground is never seen from nearer than that asks for.
_LEVELS = 3
# Patches are searched within this many standard deviations of where they should be.
_SIGMAS = 3.0
# More sightings of a cloud are thinned out, which bounds its memory.
_MOST_SIGHTINGS = 500_000
# Derivatives of so many sightings at a time take some 20 MB.
_AT_ONCE = 20_000
# This is the median of the chi-square distribution with two degrees of freedom.
_MEDIAN_OF_TWO = 2 * np.log(2)
# Of the chi-square distribution with two degrees of freedom, 99 % are below this.
_AGREEING = 9.2
# Clouds and paths are bent by more than their modes: all patches of a pair share an error of this size.
_PAIR_SIGMA_M = 0.012

# One comparison errs by one cell.
_MATCH_SIGMA_M = 0.03
# Attitudes from the background err by this much at least: followed points drift alike.
_TURN_SIGMA = np.radians(0.1)
# Unknowns of a camera: shift and turn of the whole path, then its modes.
_SHIFT, _TURN, _MODES = slice(0, 3), slice(3, 6), 6
# Comparisons of one patch have errors with this correlation.
_REPEATED = 0.5
# A patch that is this many standard deviations off counts half.
_LOSS = 2.0
# Weights settle in fewer rounds than this.
_ROUNDS = 8
# Positions by satellites err by so many times the level that is assumed where nobody stated one.
_GPS_LIKE = 4.0
# The level of constant position errors settles in fewer rounds.
_LEVEL_ROUNDS = 6
# Fewer distinct patches of a pair of cameras agree by chance.
_FEWEST_PATCHES = 10
# If no more than this share of a pair's patches agrees, the match is one by chance.
_AGREE = 0.5


@dataclass(frozen=True)
class GroundBinding:
    """Cameras after their position errors were bound to each other."""

    cameras: list[Camera]  # all of them; moved, and with narrower errors, where bound
    bound: tuple[str, ...]  # their names
    reasons: dict[str, str]  # why each of the others is not, in one line
    common: Float  # [3, 3] m^2, covariance of the position error that all bound cameras share
    entry: dict[str, Any]  # for metrics.json


@dataclass(frozen=True)
class _View:
    """Camera with its cloud and its stills."""

    camera: Camera
    between: Interpolation
    points: Float  # [N, 3] in the world of the camera's own poses
    covariance: Float  # [N, 3, 3]
    by_error: Float  # [N, 3, U] derivative of a point by the camera's unknowns
    normal: Float  # [N, 3] of the ground about each point
    still_t_ns: Int64  # [S]
    stills: list[dict[int, Picture]]  # [S] pyramids
    boxes: Float  # [S, D, 4] px of people

    def seen(self, points: Float, normal: Float) -> tuple[Bool, Float, Float, Float]:
        """Find where stills show points [N, 3] of ground: usable [S, N], poses at their rows, unit rays."""
        position, rotation = self._poses(np.zeros((len(self.still_t_ns), len(points))))
        pixels, depth = _pixels(points, position, rotation, self.camera)
        if self.camera.intrinsics.readout_s:
            delay_s = np.nan_to_num(row_delay_s(pixels[..., 1], self.camera.intrinsics))
            position, rotation = self._poses(np.clip(delay_s, *_readout(self.camera)))
            pixels, depth = _pixels(points, position, rotation, self.camera)
        ray = points - position
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        size = np.array([self.camera.intrinsics.width, self.camera.intrinsics.height])
        with np.errstate(invalid="ignore"):
            usable = (depth > _NEAREST_M) & (depth < _FARTHEST_M)
            usable &= ((pixels > _EDGE_PX) & (pixels < size - _EDGE_PX)).all(axis=-1)
            usable &= np.abs((ray * normal).sum(axis=-1)) > _GRAZING
            for box in np.moveaxis(self.boxes, 1, 0):
                low, high = box[:, None, :2] - _EDGE_PX / 2, box[:, None, 2:] + _EDGE_PX / 2
                usable &= ~((pixels > low) & (pixels < high)).all(axis=-1)
        return usable, position, rotation, ray

    def _poses(self, delay_s: Float) -> tuple[Float, Float]:
        t_ns = self.still_t_ns[:, None] + np.round(1e9 * delay_s).astype(np.int64)
        if not delay_s.any():
            position, rotation = self.camera.poses_at(self.still_t_ns, self.between)
            return np.repeat(position[:, None], t_ns.shape[1], 1), np.repeat(
                rotation[:, None], t_ns.shape[1], 1
            )
        position, rotation = self.camera.poses_at(t_ns.ravel(), self.between)
        return position.reshape(*t_ns.shape, 3), rotation.reshape(*t_ns.shape, 3, 3)


@dataclass(frozen=True)
class _Matches:
    """Comparisons: K of them, of P patches."""

    patch: Int64  # [K] number of the patch
    pair: Int64  # [P] number of the pair of cameras of each patch
    covariance: Float  # [P, 3, 3] of each patch's place
    across: Float  # [K, 2, 3] two directions across the second camera's ray
    shift: Float  # [K, 3] m, where the second camera sees the patch, against where it should be
    design: Float  # [K, 3, C U] derivative of this shift by the unknowns of all cameras


@dataclass(frozen=True)
class _Solution:
    """Unknowns of all cameras, U of each."""

    errors: Float  # [C U]
    covariance: Float  # [C U, C U]


def bind_positions(
    cameras: Sequence[Camera],
    followed: Mapping[str, Followed | str],
    stills: Mapping[str, Stills],
    *,
    between: Interpolation,
) -> GroundBinding:
    """Bind the constant position errors of cameras to each other by the ground that they see.

    Moving cameras take part whose poses were refined by their backgrounds; still ones are exact unless
    `sigma` says otherwise. `followed` has backgrounds by name, or the reason why there is none, `stills` some
    pictures of each camera that takes part.
    """
    views = [_view(camera, followed.get(camera.name), stills.get(camera.name), between) for camera in cameras]
    prior = _prior_sigma(cameras)
    pairs = [
        (a, b)
        for a, b in permutations(range(len(cameras)), 2)
        if len(views[a].points) and len(views[a].stills) and len(views[b].stills)
    ]
    counts, used = np.zeros((len(pairs), 2), dtype=np.int64), np.zeros(len(pairs), dtype=np.bool_)
    most = min(_MOST_OF_PAIR, _MOST_PATCHES // max(len(pairs), 1))
    assumed = _assumed(cameras)
    for wider in (1.0, _GPS_LIKE) if assumed.any() else (1.0,):
        prior = np.where(assumed, wider * prior, prior)
        solution = _Solution(np.zeros(len(prior)), np.diag(prior**2))
        for share in _PASSES if pairs else ():
            # Where nothing is known the search goes far, and few patches are found; they narrow the next one.
            matches = _compare(views, pairs, solution, most // share)
            if not len(matches.pair):
                used = np.zeros_like(used)
                break
            _, agree = _solve(matches, prior)
            both = (matches.pair, matches.pair[agree])
            counts = np.stack([np.bincount(pair, minlength=len(pairs)) for pair in both], axis=1)
            used = (counts[:, 1] >= _FEWEST_PATCHES / share) & (counts[:, 1] > _AGREE * counts[:, 0])
            if not used.any():
                break
            solution, _ = _solve(_of_pairs(matches, used), prior)
        if used.any():
            break
    if used.any():
        found = _of_pairs(matches, used)
        for _ in range(_LEVEL_ROUNDS):
            prior = _with_position_level(cameras, prior, solution)
            solution, _ = _solve(found, prior)
    return _bound(cameras, pairs, counts, used, solution, _prior_sigma(cameras))


# --- clouds ----------------------------------------------------------------------------------------------


def _view(
    camera: Camera, followed: Followed | str | None, stills: Stills | None, between: Interpolation
) -> _View:
    rows, pyramids = np.empty(0, np.int64), []
    if stills is not None and (camera.static or camera.errors is not None):
        used = np.unique(
            np.linspace(0, len(stills.rows) - 1, min(_MOST_STILLS, len(stills.rows))).astype(int)
        )
        rows = stills.rows[used]
        pyramids = [_pyramid(stills.picture(k)) for k in used.tolist()]
    points, covariance, by_error = np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3, 0))
    if isinstance(followed, Followed) and len(rows):
        points, covariance, by_error = _cloud(camera, followed, rows, between)
    chosen, normal = _ground(points, covariance)
    return _View(
        camera,
        between,
        points[chosen],
        covariance[chosen],
        by_error[chosen],
        normal,
        camera.frame_t_ns[rows],
        pyramids,
        people_boxes(camera)[rows],
    )


def _pyramid(picture: Picture) -> dict[int, Picture]:
    """Halve a picture several times: levels by how often. A large picture's own level is left out."""
    levels = {0: picture}
    for level in range(_LEVELS):
        levels[level + 1] = np.asarray(cv2.pyrDown(levels[level]), dtype=np.uint8)
    return {level: each for level, each in levels.items() if each.size <= _MOST_PIXELS or level == _LEVELS}


def _readout(camera: Camera) -> tuple[float, float]:
    return -camera.intrinsics.readout_s / 2, camera.intrinsics.readout_s / 2


def _cloud(
    camera: Camera, followed: Followed, rows: Int64, between: Interpolation
) -> tuple[Float, Float, Float]:
    """Triangulate the points that stills show: places, covariances, derivatives by the unknowns."""
    tracks = _shown(followed, np.clip(np.searchsorted(followed.rows, rows), 0, len(followed.rows) - 1))
    xy, t_ns = tracks.xy, camera.frame_t_ns[followed.rows[tracks.picture]]
    delay_s = np.clip(row_delay_s(xy[:, 1], camera.intrinsics), *_readout(camera))
    when, place = np.unique(t_ns + np.round(1e9 * delay_s).astype(np.int64), return_inverse=True)
    position, rotation = (each[place] for each in camera.poses_at(when, between))
    ray = np.append(undistort(xy, camera.intrinsics), np.ones((len(xy), 1)), axis=1)
    ray = np.einsum("kij,kj->ki", rotation, ray / np.linalg.norm(ray, axis=1, keepdims=True))
    known = np.isfinite(ray).all(axis=1)
    ray, position, rotation, when = ray[known], position[known], rotation[known], when[place[known]]
    names, number = np.unique(tracks.point[known], return_inverse=True)
    if not len(names):
        return np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3, 0))
    points = len(names)
    count = np.bincount(number, minlength=points)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    new_m, new_turn = (0.0, 0.0) if camera.errors is None else camera.errors.white
    turn = np.hypot(new_turn, _PIXEL_SIGMA / camera.focal_px)
    weight = np.ones(len(ray))
    for _ in range(_ROUNDS // 2):
        normal = _sums(across * weight[:, None, None], number, points) + _ANYWHERE_M**-2.0 * np.eye(3)
        right = _sums(np.einsum("kij,kj->ki", across, position) * weight[:, None], number, points)
        place3 = np.linalg.solve(normal, right[..., None])[..., 0]
        arm = place3[number] - position
        distance = np.linalg.norm(arm, axis=1)
        missed = np.linalg.norm(np.einsum("kij,kj->ki", across, arm), axis=1) / distance * camera.focal_px
        weight = 1 / ((turn * np.maximum(distance, 0.5)) ** 2 + new_m**2) / (1 + missed**2)
    covariance = np.linalg.inv(
        _sums(across * weight[:, None, None], number, points) + _ANYWHERE_M**-2.0 * np.eye(3)
    )
    by_error = np.zeros((points, 3, 1))
    for part in np.array_split(np.arange(len(ray)), -(-len(ray) // _AT_ONCE)):
        moved = across[part] @ _moved(camera, when[part], arm[part], rotation[part])
        by_error = by_error + _sums(moved * weight[part, None, None], number[part], points)
    by_error = covariance @ by_error
    far, off = (np.bincount(number, each, points) / np.maximum(count, 1) for each in (distance, missed))
    kept = (count >= _FEWEST_SIGHTINGS) & (np.trace(covariance, axis1=1, axis2=2) < _POINT_SIGMA_M**2)
    kept &= (off < _WORST_PX) & (far > _NEAREST_M) & (far < _FARTHEST_M)
    kept &= np.bincount(number, (ray * arm).sum(axis=1) > 0, points) == count
    return place3[kept], covariance[kept], by_error[kept]


def _moved(camera: Camera, t_ns: Int64, arm: Float, rotation: Float) -> Float:
    """Compute derivatives [K, 3, U] of points by a camera's unknowns; `arm` [K, 3] m leads to them."""
    turned = -cross_matrix(arm) @ rotation
    moved = [np.broadcast_to(np.eye(3), turned.shape), turned]
    if camera.modes is not None:
        response = camera.modes.at(t_ns)
        moved.append(response[:, :3] + turned @ response[:, 3:])
    return np.concatenate(moved, axis=2)


def _shown(followed: Followed, pictures: Int64) -> Tracks:
    """Collect the tracks of the points that some pictures show; of many sightings, every k-th."""
    found = [Tracks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))]
    for part in followed.between(0, len(followed.rows)):
        shown = np.isin(part.picture, pictures)
        mine = np.isin(part.point, np.unique(part.point[shown]))
        found.append(Tracks(part.picture[mine], part.point[mine], part.xy[mine]))
    picture, point, xy = (
        np.concatenate([getattr(part, name) for part in found]) for name in ("picture", "point", "xy")
    )
    every = max(1, -(-len(point) // _MOST_SIGHTINGS))
    return Tracks(picture[::every], point[::every], xy[::every])


def _ground(points: Float, covariance: Float) -> tuple[Int64, Float]:
    """Choose points on level ground, the best one of each cube: their numbers [N] and normals [N, 3]."""
    from scipy.spatial import cKDTree

    if not len(points):
        return np.empty(0, np.int64), np.empty((0, 3))
    best = np.argsort(np.trace(covariance, axis1=1, axis2=2), kind="stable")
    _, first = np.unique(np.floor(points[best] / _GRID_M).astype(np.int64), axis=0, return_index=True)
    chosen, normals = [], []
    tree = cKDTree(points)
    for number in np.sort(best[first]).tolist():
        near = points[tree.query_ball_point(points[number], _AROUND_M)]
        if len(near) < _NEIGHBOURS:
            continue
        middle = np.median(near, axis=0)
        _, size, axes = np.linalg.svd(near - middle, full_matrices=False)
        normal = axes[2] * np.sign(axes[2, 2])
        rough, wide = size[2] / np.sqrt(len(near)), size[1] / np.sqrt(len(near))
        on_it = abs(float(normal @ (points[number] - middle))) < _ROUGH_M
        if rough < _ROUGH_M and wide > 4 * _ROUGH_M and normal[2] > _STEEPEST and on_it:
            chosen.append(number)
            normals.append(normal)
    return np.array(chosen, dtype=np.int64), np.array(normals).reshape(-1, 3)


def _sums(values: Float, number: Int64, count: int) -> Float:
    """Sum values [K, ...] of the same number: [count, ...]."""
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(number, weights=column, minlength=count) for column in flat.T], axis=-1)
    return np.asarray(sums, dtype=np.float64).reshape(count, *values.shape[1:])


# --- patches -----------------------------------------------------------------------------------------------


def _pixels(points: Float, position: Float, rotation: Float, camera: Camera) -> tuple[Float, Float]:
    own = np.einsum("...ji,...j->...i", rotation, points - position)
    return project(own, camera.intrinsics), own[..., 2]


def _compare(
    views: Sequence[_View], pairs: Sequence[tuple[int, int]], known: _Solution, most: int
) -> _Matches:
    """Look for at most so many patches of the first camera of each pair in stills of the second."""
    of_camera, pair = _unknowns([view.camera for view in views]), np.empty(0, dtype=np.int64)
    patch, covariance = [np.empty(0, dtype=np.int64)], [np.empty((0, 3, 3))]
    across, shift, design = [np.empty((0, 2, 3))], [np.empty((0, 3))], [np.empty((0, 3, len(known.errors)))]
    for number, (a, b) in enumerate(pairs):
        first, second = views[a], views[b]
        seen_a, position_a, rotation_a, ray_a = first.seen(first.points, first.normal)
        seen_b, position_b, rotation_b, ray_b = second.seen(first.points, first.normal)
        shown = np.flatnonzero(seen_a.any(axis=0) & seen_b.any(axis=0))
        chosen = shown[np.unique(np.linspace(0, len(shown) - 1, min(most, len(shown))).astype(int))]
        alike = [
            (i, *stills)
            for i in chosen.tolist()
            for stills in _alike(seen_a[:, i], seen_b[:, i], ray_a[:, i], ray_b[:, i])
        ]
        if not alike:
            continue
        i, s, t = np.array(alike).T
        point, normal, ray = first.points[i], first.normal[i], ray_b[t, i]
        row = np.zeros((len(i), 3, len(known.errors)))
        arm = point - position_b[t, i]
        row[:, :, of_camera[b]] = _moved(second.camera, second.still_t_ns[t], arm, rotation_b[t, i])
        row[:, :, of_camera[a]] = -first.by_error[i]
        spread = row @ known.covariance @ np.swapaxes(row, 1, 2) + first.covariance[i]
        along = ray - (ray * normal).sum(axis=1, keepdims=True) * normal
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        axes = np.stack([along, np.cross(normal, along)], axis=1)
        # A height is seen beside its place on the plane, along the second camera's ray.
        onto = ray[:, :, None] * normal[:, None] / (ray * normal).sum(axis=1)[:, None, None]
        fallen = axes @ (np.eye(3) - onto)
        moved = _displacements(
            _Cuts(first, s, position_a[s, i], rotation_a[s, i]),
            _Cuts(second, t, position_b[t, i], rotation_b[t, i]),
            _Places(point, axes),
            row @ known.errors,
            _SIGMAS * np.sqrt(np.diagonal(fallen @ spread @ np.swapaxes(fallen, 1, 2), axis1=1, axis2=2)),
        )
        clear = np.isfinite(moved[:, 0])
        found, own = np.unique(i[clear], return_inverse=True)
        patch.append(len(pair) + own)
        pair = np.append(pair, np.full(len(found), number))
        covariance.append(first.covariance[found])
        across.append(np.linalg.svd(ray[clear][:, None])[2][:, 1:])
        shift.append(moved[clear])
        design.append(row[clear])
    return _Matches(
        np.concatenate(patch),
        pair,
        np.concatenate(covariance),
        np.concatenate(across),
        np.concatenate(shift),
        np.concatenate(design),
    )


def _of_pairs(matches: _Matches, used: Bool) -> _Matches:
    """Return the comparisons of the pairs that are used."""
    kept = used[matches.pair]
    number = np.cumsum(kept) - 1
    mine = kept[matches.patch]
    return _Matches(
        number[matches.patch[mine]],
        matches.pair[kept],
        matches.covariance[kept],
        matches.across[mine],
        matches.shift[mine],
        matches.design[mine],
    )


def _alike(seen_a: Bool, seen_b: Bool, ray_a: Float, ray_b: Float) -> list[tuple[int, int]]:
    """Choose pairs of stills that see a patch from similar directions, each still at most once."""
    cosine = ray_a @ ray_b.T
    cosine[~seen_a] = cosine[:, ~seen_b] = -np.inf
    chosen: list[tuple[int, int]] = []
    for _ in range(_PAIRS_OF_STILLS):
        s, t = divmod(int(np.argmax(cosine)), cosine.shape[1])
        if cosine[s, t] == -np.inf:
            break
        chosen.append((s, t))
        cosine[s], cosine[:, t] = -np.inf, -np.inf
    return chosen


@dataclass(frozen=True)
class _Places:
    """Rectangles of cells in planes: K of them."""

    centre: Float  # [K, 3]
    axes: Float  # [K, 2, 3] of the cells, unit vectors

    def points(self, cells: Float) -> Float:
        """Compute the points [K, N, 3] of cells [K, N, 2]."""
        return np.asarray(self.centre[:, None] + _CELL_M * cells @ self.axes)


@dataclass(frozen=True)
class _Cuts:
    """Stills that orthophotos are cut out of: K of them."""

    view: _View
    still: Int64  # [K]
    position: Float  # [K, 3]
    rotation: Float  # [K, 3, 3]

    def pixels(self, points: Float) -> tuple[Float, Bool]:
        """Find the pixels [K, N, 2] of points [K, N, 3], and which of them lie inside the stills [K, N]."""
        position, rotation = self.position[:, None], self.rotation[:, None]
        xy, _ = _pixels(points, position, rotation, self.view.camera)
        size = np.array([self.view.camera.intrinsics.width, self.view.camera.intrinsics.height])
        with np.errstate(invalid="ignore"):
            return xy, np.asarray(((xy > 0) & (xy < size - 1)).all(axis=-1))

    def shown(self, places: _Places, half: Int64) -> tuple[Int64, Int64]:
        """Find how much of rectangles about points the stills show: first and last cells [K, 2].

        The rectangles have `half` cells [K, 2] on each side. They keep their width across the second axis,
        unless a still is too narrow for it even at the point itself.
        """
        across, along = (np.arange(-most, most + 1) for most in half.max(axis=0)[::-1])
        wide = np.zeros((len(half), len(across), 2))
        wide[:, :, 1] = across
        first, last = _run(self.pixels(places.points(wide))[1] & (abs(across) <= half[:, 1:]))
        high = np.zeros((len(half), len(along), 2, 2))
        high[..., 0] = along[:, None]
        high[..., 1] = np.stack([first, last], axis=1)[:, None]
        inside = self.pixels(places.points(high.reshape(len(half), -1, 2)))[1].reshape(high.shape[:3])
        low, top = _run(inside.all(axis=2) & (abs(along) <= half[:, :1]))
        return np.stack([low, first], axis=1), np.stack([top, last], axis=1)

    def orthophoto(self, k: int, xy: Float, cells: Int64) -> Picture:
        """Cut `cells` [2] out of the k-th still, whose corners are at pixels [4, 2] inside it."""
        pyramid = self.view.stills[self.still[k]]
        sides_px = np.abs(xy - np.roll(xy, 1, axis=0)).max(axis=1)
        span_px = float((sides_px / cells[[1, 0, 1, 0]]).max())
        level = int(np.clip(np.log2(max(span_px, 1.0)), min(pyramid), _LEVELS))
        corners = (cells * _CORNERS).astype(np.float32)
        to_still = cv2.getPerspectiveTransform(corners, (xy / 2**level).astype(np.float32))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cut = cv2.warpPerspective(pyramid[level], to_still, (cells + 1).tolist(), flags=flags)
        return np.asarray(cv2.GaussianBlur(cut.astype(np.float32), (0, 0), _BLUR_CELLS))


_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Corners of a rectangle, in turn: 0 where it begins, 1 where it ends."""


def _run(inside: Bool) -> tuple[Int64, Int64]:
    """Find the first and the last [K] of the true values about the middle of [K, 2 N + 1], which is 0."""
    most = inside.shape[1] // 2
    place = np.arange(-most, most + 1)
    before = np.where(~inside & (place <= 0), place, -most - 1).max(axis=1)
    after = np.where(~inside & (place >= 0), place, most + 1).min(axis=1)
    return before + 1, after - 1


def _displacements(a: _Cuts, b: _Cuts, places: _Places, expected: Float, reach_m: Float) -> Float:
    """Find patches of stills `a` in stills `b`, about expected shifts [K, 3]; NaN where nothing is clear."""
    half = np.full(reach_m.shape, _HALF_CELLS)
    reach = np.clip(np.ceil(reach_m / _CELL_M).astype(np.int64), _PEAK_CELLS + 2, _FARTHEST_REACH_CELLS)
    around = replace(places, centre=places.centre + expected)
    begins, ends = b.shown(around, half + reach)
    least = half + _PEAK_CELLS + 2
    wanted_px, whole = a.pixels(places.points(half[:, None] * (2 * _CORNERS - 1)))
    searched_px, there = b.pixels(around.points(begins[:, None] + (ends - begins)[:, None] * _CORNERS))
    usable = whole.all(axis=1) & there.all(axis=1) & (-begins >= least).all(axis=1)
    usable &= (ends >= least).all(axis=1)
    moved = np.full(expected.shape, np.nan)
    for k in np.flatnonzero(usable).tolist():
        wanted = a.orthophoto(k, wanted_px[k], 2 * half[k])
        if wanted.std() < _FLAT:
            continue
        peak = _peak(b.orthophoto(k, searched_px[k], ends[k] - begins[k]), wanted)
        if peak is not None:
            moved[k] = expected[k] + _CELL_M * (peak + begins[k] + half[k]) @ places.axes[k]
    return moved


def _peak(searched: Picture, wanted: Picture) -> Float | None:
    """Find where a picture shows another one: first cell [2], right and down; None if not clear."""
    alike = cv2.matchTemplate(searched, wanted, cv2.TM_CCOEFF_NORMED)
    y, x = np.unravel_index(int(alike.argmax()), alike.shape)
    if not (0 < x < alike.shape[1] - 1 and 0 < y < alike.shape[0] - 1) or alike[y, x] < _ALIKE:
        return None
    other = alike.copy()
    other[max(0, y - _PEAK_CELLS) : y + _PEAK_CELLS + 1, max(0, x - _PEAK_CELLS) : x + _PEAK_CELLS + 1] = -1
    if alike[y, x] - other.max() < _CLEARER:
        return None
    return np.array([_vertex(*alike[y, x - 1 : x + 2]) + x, _vertex(*alike[y - 1 : y + 2, x]) + y])


def _vertex(before: float, top: float, after: float) -> float:
    """Find the highest point of the parabola through values at -1, 0 and 1."""
    return float((after - before) / (2 * (2 * top - after - before)))


# --- the errors --------------------------------------------------------------------------------------------


def _unknowns(cameras: Sequence[Camera]) -> list[slice]:
    """List the places of each camera's unknowns among those of all cameras."""
    ends = np.cumsum([_MODES + (0 if c.modes is None else c.modes.response.shape[2]) for c in cameras])
    return [slice(begin, end) for begin, end in pairwise([0, *ends.tolist()])]


def _prior_sigma(cameras: Sequence[Camera]) -> Float:
    """Build the prior standard deviations [C U] of all unknowns."""
    unknowns = _unknowns(cameras)
    sigma = np.ones(unknowns[-1].stop)
    for camera, of in zip(cameras, unknowns, strict=True):
        shift = turn = EXACT
        if camera.modes is not None:
            shift = camera.modes.shift_m
        elif camera.errors is not None:
            shift, turn = (
                sum(p.sigma0**2 for p in camera.errors.processes if p.number == number and p.constant) ** 0.5
                for number in (SHIFT_IN_WORLD, ROTATION)
            )
        elif camera.sigma is not None:
            shift, turn = np.median(camera.sigma, axis=0)
        sigma[of][_SHIFT] = max(shift, EXACT)
        sigma[of][_TURN] = max(turn, EXACT if camera.static else _TURN_SIGMA)
    return sigma


def _means(cameras: Sequence[Camera]) -> Float:
    """Compute the mean errors of all cameras [6 C], position and rotation of each, by all unknowns."""
    unknowns = _unknowns(cameras)
    means = np.zeros((6 * len(cameras), unknowns[-1].stop))
    for c, (camera, of) in enumerate(zip(cameras, unknowns, strict=True)):
        own = means[6 * c : 6 * c + 6, of]
        own[:, :_MODES] = np.eye(6)
        if camera.modes is not None:
            own[:, _MODES:] = camera.modes.response.mean(axis=0)
    return means


def _assumed(cameras: Sequence[Camera]) -> Bool:
    """Mark the unknowns [C U] whose level nobody stated: constant shifts."""
    unknowns = _unknowns(cameras)
    assumed = np.zeros(unknowns[-1].stop, dtype=np.bool_)
    for camera, of in zip(cameras, unknowns, strict=True):
        assumed[of][_SHIFT] = camera.errors is not None and camera.errors.assumed
    return assumed


def _solve(matches: _Matches, prior: Float) -> tuple[_Solution, Bool]:
    """Solve for all unknowns with prior standard deviations and errors of pairs; patches [P] that agree."""
    size = len(prior)
    parts = [_PairEquations.of(matches, number, size) for number in np.unique(matches.pair).tolist()]
    every = np.diag(np.full(size + 3 * (int(matches.pair.max()) + 1), _PAIR_SIGMA_M**-2.0))
    every[:size, :size] = np.diag(prior**-2.0)
    errors = np.zeros(len(every))
    for k in range(_ROUNDS):
        normal, right = every.copy(), np.zeros(len(every))
        for part in parts:
            part.add(normal, right, errors, max(_LOSS, 16.0 / 2**k))
        covariance = np.linalg.inv(normal)
        errors = covariance @ right
    agree = np.concatenate([part.agree(errors) for part in parts])
    return _Solution(errors[:size], covariance[:size, :size]), agree


@dataclass(frozen=True)
class _PairEquations:
    """Equations of K comparisons of one pair of cameras, which have few of the unknowns."""

    columns: Int64  # [N] of the unknowns: those of both cameras, and the pair's own three
    design: Float  # [K, 2, N]
    seen: Float  # [K, 2] m
    cut: Float  # [K, 2, 3] directions across the ray
    information: Float  # [K, 2, 2] 1/m^2, of one comparison
    patch: Int64  # [K]
    place: Float  # [P, 3, 3] 1/m^2, information on each patch's place

    @classmethod
    def of(cls, matches: _Matches, pair: int, size: int) -> _PairEquations:
        """Take those of a pair; the pairs' own unknowns come after so many."""
        rows = np.flatnonzero(matches.pair[matches.patch] == pair)
        design, cut = matches.design[rows], matches.across[rows]
        used = np.flatnonzero(design.any(axis=(0, 1)))
        own = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
        names, patch = np.unique(matches.patch[rows], return_inverse=True)
        covariance = matches.covariance[names]
        spread = cut @ (covariance[patch] + _MATCH_SIGMA_M**2 * np.eye(3)) @ np.swapaxes(cut, 1, 2)
        return cls(
            np.append(used, size + 3 * pair + np.arange(3)),
            cut @ np.concatenate([design[..., used], own], axis=2),
            np.einsum("kij,kj->ki", cut, matches.shift[rows]),
            cut,
            np.asarray(np.linalg.inv(spread), np.float64),
            patch,
            np.asarray(np.linalg.inv(covariance), np.float64),
        )

    def squares(self, errors: Float) -> Float:
        """Compute the squares of residuals [K] in standard deviations."""
        residual = self.seen - self.design @ errors[self.columns]
        return np.asarray(np.einsum("ki,kij,kj->k", residual, self.information, residual))

    def agree(self, errors: Float) -> Bool:
        """Find the patches [P] of which most comparisons agree."""
        agreeing = np.bincount(self.patch, self.squares(errors) < _AGREEING)
        return np.asarray(agreeing > np.bincount(self.patch) / 2)

    def add(self, normal: Float, right: Float, errors: Float, loss: float) -> None:
        """Add them to the normal equations of all unknowns, weighed by the residuals of these `errors`."""
        square, patches = self.squares(errors), len(self.place)
        scale = 1 / max(1.0, float(np.median(square)) / _MEDIAN_OF_TWO)
        share = 1 / (1 + (np.bincount(self.patch) - 1) * _REPEATED)
        weight = scale * share[self.patch] / (1 + square / loss**2) / _MATCH_SIGMA_M**2
        back_cut, back_design = (np.swapaxes(each, 1, 2) for each in (self.cut, self.design))
        # The error of a patch's place is common to its comparisons: it is eliminated.
        by_place = _sums(back_cut @ self.cut * weight[:, None, None], self.patch, patches)
        mixed = _sums(back_design @ self.cut * weight[:, None, None], self.patch, patches)
        pull = _sums((back_cut @ self.seen[..., None])[..., 0] * weight[:, None], self.patch, patches)
        back = mixed @ np.linalg.inv(by_place + scale * self.place)
        weighed = self.design * weight[:, None, None]
        own = np.tensordot(weighed, self.design, ([0, 1], [0, 1]))
        normal[np.ix_(self.columns, self.columns)] += own - np.tensordot(back, mixed, ([0, 2], [0, 2]))
        right[self.columns] += np.tensordot(weighed, self.seen, ([0, 1], [0, 1]))
        right[self.columns] -= np.tensordot(back, pull, ([0, 2], [0, 1]))


# --- cameras -----------------------------------------------------------------------------------------------


def _bound(
    cameras: Sequence[Camera],
    pairs: Sequence[tuple[int, int]],
    counts: Int64,
    used: Bool,
    solution: _Solution,
    stated: Float,
) -> GroundBinding:
    """Move the largest group of cameras that are bound to each other, and narrow their `stated` errors."""
    group = _largest_group(len(cameras), [pair for pair, use in zip(pairs, used, strict=True) if use])
    means, unknowns = _means(cameras), _unknowns(cameras)
    before = means @ np.diag(stated**2) @ means.T
    after = means @ solution.covariance @ means.T
    columns = np.array([6 * c + k for c in group for k in range(3)], dtype=np.int64)
    joint = after[np.ix_(columns, columns)]
    every = np.tile(np.eye(3), (len(group), 1))
    common = np.zeros((3, 3))
    if group:
        common = np.asarray(np.linalg.inv(every.T @ np.linalg.inv(joint) @ every), dtype=np.float64)
    moved, left_m, reasons = list(cameras), {}, {}
    stated_m = [_rms_sigma(before[6 * c : 6 * c + 3, 6 * c : 6 * c + 3]) for c in range(len(cameras))]
    for c, camera in enumerate(cameras):
        place, turned = slice(6 * c, 6 * c + 3), slice(6 * c + 3, 6 * c + 6)
        if c not in group:
            reasons[camera.name] = _reason(c, cameras, pairs, counts)
            # Against the group's common error it is as uncertain as both together.
            if group:
                wider = float(np.hypot(_rms_sigma(after[place, place]), _rms_sigma(common)))
                moved[c] = _narrowed(camera, wider, None, stated_m[c])
            continue
        own = float(np.trace(after[place, place] - common)) / 3
        relative = own * len(group) / (len(group) - 1)
        sigma = float(np.sqrt(max(relative, 0.0) + EXACT**2))
        left_m[camera.name] = sigma
        log, found = camera.trajectory, solution.errors[unknowns[c]]
        error = np.tile(found[:_MODES], (len(log.t_ns), 1))
        if camera.modes is not None:
            error += camera.modes.at(log.t_ns) @ found[_MODES:]
        trajectory = replace(
            log,
            position=log.position - error[:, :3],
            quaternion_xyzw=multiply(log.quaternion_xyzw, quaternion_from_rotation_vector(-error[:, 3:])),
        )
        turn_sigma = _rms_sigma(after[turned, turned])
        moved[c] = _narrowed(replace(camera, trajectory=trajectory), sigma, turn_sigma, stated_m[c])
    entry = {
        "patches": [
            {
                "from": cameras[a].name,
                "in": cameras[b].name,
                "compared": int(n),
                "agree": int(good),
                "used": bool(use),
            }
            for (a, b), (n, good), use in zip(pairs, counts, used, strict=True)
        ],
        "position_sigma_m": {
            camera.name: {"before": stated_m[c], "against_the_others": left_m.get(camera.name)}
            for c, camera in enumerate(cameras)
        },
        "moved_m": {cameras[c].name: (-means[6 * c : 6 * c + 3] @ solution.errors).tolist() for c in group},
        "reasons": reasons,
    }
    return GroundBinding(moved, tuple(cameras[c].name for c in group), reasons, common, entry)


def _rms_sigma(covariance: Float) -> float:
    """Compute the standard deviation of a mean axis."""
    return float(np.sqrt(np.trace(covariance) / 3))


def _with_position_level(cameras: Sequence[Camera], prior: Float, solution: _Solution) -> Float:
    """Estimate the level of constant position errors that are only assumed, by MacKay's rule.

    A wide level would let the ground turn all cameras together: it binds their attitudes to each other better
    than to the world, and their places follow. A usual level counts as `USUAL_COUNT` more numbers. The
    standard deviations [C U] are no larger than before.
    """
    assumed = _assumed(cameras)
    if not assumed.any():
        return prior
    determined = float(np.sum(1 - np.diagonal(solution.covariance)[assumed] / prior[assumed] ** 2))
    squares = float(np.sum(solution.errors[assumed] ** 2))
    level2 = (squares + USUAL_COUNT * USUAL_CONSTANT[0] ** 2) / (max(determined, 0.0) + USUAL_COUNT)
    return np.where(assumed, np.minimum(prior, np.sqrt(level2)), prior)


def _largest_group(total: int, edges: Sequence[tuple[int, int]]) -> list[int]:
    """List the largest group of cameras that edges connect; empty without any."""
    from scipy.sparse.csgraph import connected_components

    bound = np.zeros((total, total))
    for a, b in edges:
        bound[a, b] = 1.0
    _, group = connected_components(bound, directed=False)
    members = np.flatnonzero(group == np.bincount(group).argmax()).tolist()
    return members if len(members) > 1 else []


def _reason(c: int, cameras: Sequence[Camera], pairs: Sequence[tuple[int, int]], counts: Int64) -> str:
    """Say in one line why a camera is not bound."""
    mine = [n for n, pair in enumerate(pairs) if c in pair]
    if not mine:
        return "no camera's ground compares with its own: both need pictures, and one some metres of flight"
    best = max(mine, key=lambda n: (counts[n, 1], counts[n, 0]))
    a, b = pairs[best]
    other = cameras[b if a == c else a].name
    return (
        f"{counts[best, 1]} of {counts[best, 0]} patches of ground agree with {other}; "
        f"{_FEWEST_PATCHES} and more than {_AGREE:.0%} are needed"
    )


def _narrowed(camera: Camera, position_m: float, turn: float | None, prior_m: float) -> Camera:
    """State other constant errors of a camera: m, and rad where known, instead of the prior's."""
    change = position_m**2 - prior_m**2
    covariance, sigma, errors = camera.covariance, camera.sigma, camera.errors
    if covariance is not None:
        covariance = covariance.copy()
        variance = np.maximum(np.diagonal(covariance, axis1=1, axis2=2)[:, :3] + change, EXACT**2)
        covariance[:, range(3), range(3)] = variance
    if sigma is not None:
        sigma = np.stack([np.sqrt(np.maximum(sigma[:, 0] ** 2 + change, EXACT**2)), sigma[:, 1]], axis=1)
    if errors is not None:
        processes = [p for p in errors.processes if not (p.number == SHIFT_IN_WORLD and p.constant)]
        processes = [Process(SHIFT_IN_WORLD, position_m), *processes]
        if turn is not None:
            processes = [
                replace(p, sigma0=min(p.sigma0, turn)) if p.number == ROTATION and p.constant else p
                for p in processes
            ]
        errors = replace(errors, processes=tuple(processes))
    return replace(camera, covariance=covariance, sigma=sigma, errors=errors)
