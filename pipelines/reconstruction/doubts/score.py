"""Score of a scene: how well it fits itself, and how much its people are people.

Lower is better. A score adds three things:

- the distances of rays from the joints that they make, over what keypoints and poses are stated to err by;
- how odd the body, its place and its motion are, each against what is published of people;
- the scatter of two cameras' rays within one picture, after a constant error of each pose was fitted with
  its stated standard deviation as prior. Clocks and wrong conventions leave it, constant errors do not.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.reconstruction.doubts.body import Body, Oddity, quantile
from pipelines.reconstruction.doubts.fit import SolvedJoints, pixel_variance, solve
from pipelines.reconstruction.doubts.scene import Sampled, SceneOfMoments, median

IMPOSSIBLE = 99.0
"""Score of a scene in which next to nothing is seen by two cameras."""

_CHI2_MEDIAN = {1: 0.455, 3: 0.789, 5: 0.870}  # median of chi^2 over its degrees of freedom, by those
# With more degrees of freedom, the median of chi-square over them is about this.
_CHI2_MEDIAN_MORE = 0.9
# A joint that is farther away does not tell how far stated errors move it.
_FARTHEST_M = 30.0
# With fewer joints that two cameras see in all moments nothing can be said.
_FEWEST = 60
# Rays that cross by less than this sine tell no distance.
_PARALLEL = 0.15
# Ankles of somebody who stands are this high above the ground.
_ANKLE_ABOVE_GROUND_M = 0.08
# Rays that miss each other by more standard deviations cannot be used.
_UNUSED_SIGMAS = 4.0
# Right flights have less than 0.01 of joints that cannot be used.
_USUALLY_UNUSED = 0.2
# Ground that no map shows is no steeper than this.
_SLOPE = 0.3
# Half of a body is this long: turning it moves its ends by the angle times that.
_HALF_BODY_M = 0.5
# The scatter of rays counts this much beside what is odd about a person.
SCATTER_WEIGHT = 12.0
SCATTER_RANGE = (0.4, 30.0)  # what is less is no better: keypoints scatter by themselves


class Score(NamedTuple):
    """The score of a scene, and what it is made of."""

    total: float
    misfit: float  # of rays, standard deviations
    scatter: float  # of rays within pictures, over the pixel noise
    odd: dict[str, Oddity]
    stature_m: float


class Base(NamedTuple):
    """The described scene, against which others are scored."""

    total: float
    scatter: float
    covered: float  # share of joints and moments that two cameras see


@np.errstate(invalid="ignore", divide="ignore")
def score(
    flight: Sampled,
    scene: SceneOfMoments,
    base: Base | None = None,
    *,
    same_scatter: bool = False,
    limit: float = np.inf,
) -> Score:
    """Score a scene.

    Args:
        flight: its flight.
        scene: the scene.
        base: the scene as described; None if it is that.
        same_scatter: True where an alternative can only seem to change the scatter, as a unit does.
        limit: a score above it need not be exact: what takes time is left out once that is certain.
    """
    solved = solve(scene)
    good = solved.views >= 2
    if good.sum() < _FEWEST or (base is not None and good.mean() < 0.4 * base.covered):
        return Score(IMPOSSIBLE, np.inf, np.inf, {}, np.nan)
    misfit = _misfit(solved, good)
    # Two cameras have one draw of constant errors between them: chi^2 of few.
    soft = 2.0 if len(scene.focal_px) == 2 else 1.5
    share_behind = 1 - float(solved.in_front[good].mean())
    behind = Oddity(share_behind / 0.05, {"behind_share": share_behind})
    total = float(2 * np.log1p((misfit / soft) ** 2) + np.log1p(behind.sigmas**2))
    reference = None if base is None or same_scatter else base.scatter
    gain = 0.0 if reference is None else SCATTER_WEIGHT * np.log(reference / SCATTER_RANGE[0])
    if total - gain > limit:
        return Score(total, misfit, np.inf, {"behind": behind}, np.nan)
    scatter = _scatter(scene, solved)
    if reference is not None:
        total += SCATTER_WEIGHT * float(np.log(np.clip(scatter, *SCATTER_RANGE) / reference))
        if total > limit:
            return Score(total, misfit, scatter, {"behind": behind}, np.nan)
    body = Body(solved.joints)
    statures = body.statures
    stature = median(statures)
    if np.isfinite(statures).sum() < 5 or not stature > 0:
        return Score(IMPOSSIBLE, misfit, np.inf, {}, np.nan)
    odd = _rays(scene, solved, good, misfit) | body.proportions(stature) | body.posture()
    odd |= _place(flight, scene, body, solved, stature)
    odd = {name: each for name, each in odd.items() if np.isfinite(each.sigmas)}
    total += sum(float(np.log1p(min(each.sigmas, 50.0) ** 2)) for each in odd.values())
    return Score(total, misfit, scatter, odd | {"behind": behind}, stature)


def base_of(flight: Sampled, scene: SceneOfMoments) -> tuple[Base, Score]:
    """Score the scene as described; other scenes are scored against it."""
    described = score(flight, scene)
    scatter = float(np.clip(described.scatter, *SCATTER_RANGE))
    covered = float((solve(scene).views >= 2).mean())
    return Base(described.total, scatter, covered), described


def _misfit(solved: SolvedJoints, good: Bool) -> float:
    """Return the root of the median chi^2 over its freedom: 1 where all is as stated."""
    freedom = 2 * solved.views - 3
    total = 0.0
    for value in np.unique(freedom[good]):
        among = good & (freedom == value)
        usual = _CHI2_MEDIAN.get(int(value), _CHI2_MEDIAN_MORE)
        total += among.sum() * median(solved.chi2[among]) / value / usual
    return float(np.sqrt(total / good.sum()))


def _rays(scene: SceneOfMoments, solved: SolvedJoints, good: Bool, misfit: float) -> dict[str, Oddity]:
    """Measure joints that gates reject, the best pair's angle, and pictures of people without a pose."""
    freedom = 2 * solved.views[good] - 3
    gate = (_UNUSED_SIGMAS * max(misfit, 1.0)) ** 2
    unused = float((solved.chi2[good] > gate * freedom).mean())
    sine = 0.0
    for one, other in combinations(range(len(solved.seen)), 2):
        both = solved.seen[one] & solved.seen[other]
        if both.any():
            cosine = (solved.direction[one][both] * solved.direction[other][both]).sum(axis=-1)
            sine = max(sine, median(np.sqrt(np.maximum(0.0, 1.0 - cosine**2))))
    found = np.isfinite(scene.rays[..., 0]).any(axis=-1)
    unposed = float((found & ~np.isfinite(scene.position).all(axis=-1)).mean(axis=1).max())
    return {
        "parallax": Oddity(
            max(0.0, 0.1 / max(sine, 1e-4) - 1), {"parallax_deg": float(np.degrees(np.arcsin(sine)))}
        ),
        "unused": Oddity(max(0.0, unused - _USUALLY_UNUSED) / 0.05, {"unused_share": unused}),
        "unposed": Oddity(min(0.2, unposed) / 0.05, {"unposed_share": unposed}),
    }


def _scatter(scene: SceneOfMoments, solved: SolvedJoints) -> float:
    """Return the scatter of two cameras' rays within pictures over their noise, mean over the pairs."""
    found = [_scatter_of_pair(scene, solved, pair) for pair in combinations(range(len(scene.focal_px)), 2)]
    known = [value for value in found if value is not None]
    return float(np.mean(known)) if known else 9.0


def _scatter_of_pair(scene: SceneOfMoments, solved: SolvedJoints, pair: tuple[int, int]) -> float | None:
    """Fit constant errors of both poses to the rays' distances, and measure what they leave.

    The distance along the common normal changes by the normal with a shift of a camera, and by the lever
    (distance times ray) across the normal with a turn.
    """
    one, other = pair
    normal = np.cross(solved.direction[one], solved.direction[other])
    length = np.linalg.norm(normal, axis=-1)
    used = solved.seen[one] & solved.seen[other] & (length > _PARALLEL)
    if used.sum() < _FEWEST:
        return None
    normal = normal[used] / length[used][:, None]
    time = np.nonzero(used)[0]
    apart = (normal * (scene.position[other] - scene.position[one])[time]).sum(axis=-1)
    parts, noise2 = [], np.zeros(len(time))
    for camera, sign in ((one, -1.0), (other, 1.0)):
        away = np.clip(np.abs(solved.depth[camera][used]), 1e-4, 1e5)
        place_m, turn_rad, white_m, white_rad = scene.sigma[camera, :4]
        lever = np.cross(solved.direction[camera][used], normal) * (sign * turn_rad * away)[:, None]
        parts += [
            sign * place_m * normal,
            (lever[:, None] @ scene.rotation[camera][time])[:, 0],
        ]
        noise2 += away**2 * pixel_variance(scene)[camera] / scene.focal_px[camera] ** 2
        # What is new in every pose turns the person in the picture, besides moving them.
        noise2 += _HALF_BODY_M**2 * white_rad**2 + (_HALF_BODY_M * white_m / np.maximum(away, 1.0)) ** 2
    design, noise = np.column_stack(parts), np.sqrt(median(noise2))
    share = used.shape[0] / len(apart)  # a picture is one observation of a constant error
    weight = np.ones(len(apart))
    for _ in range(3):
        weighted = design * (weight * share / noise**2)[:, None]
        constant = np.linalg.solve(weighted.T @ design + np.eye(design.shape[1]), weighted.T @ apart)
        left = apart - design @ constant
        weight = 1 / np.maximum(np.abs(left) / (1.5 * noise), 1.0)
    residual = np.full(used.shape, np.nan)
    residual[used] = left
    return float(1.48 * median(np.abs(residual - _median_of_rows(residual)[:, None])) / noise)


def _median_of_rows(values: Float) -> Float:
    """Return the median of each row [T], NaN where nothing is finite; nanmedian is slow on small arrays."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.isfinite(values).sum(axis=1)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, values.shape[1] - 1)
    row = np.arange(len(values))
    middle: Float = np.where(count > 0, (ordered[row, low] + ordered[row, high]) / 2, np.nan)
    return middle


def _place(
    flight: Sampled, scene: SceneOfMoments, body: Body, solved: SolvedJoints, stature: float
) -> dict[str, Oddity]:
    """Measure how the person moves, and how far they are from where people are.

    They are under drones, on the ground, and at the logged actor.
    """
    known = solved.seen & (solved.views >= 2)
    far = [median(np.abs(depth[used])) for depth, used in zip(solved.depth, known, strict=True)]
    far_m = np.minimum(np.nan_to_num(np.array(far), nan=10.0), _FARTHEST_M)
    stated_m, white_m = _moved_by(scene.sigma[:, :2], far_m), _moved_by(scene.sigma[:, 2:4], far_m)
    keypoint_m = float(np.sqrt(np.mean(pixel_variance(scene)) * np.mean((far_m / scene.focal_px) ** 2)))
    # The cameras that see a joint change, and with them the errors that they have in common.
    limp = float(np.nanmedian([_spread(length) for length, _ in body.lengths]))
    odd = {"limp": Oddity(limp / (0.10 + 0.5 * stated_m), {"limb_spread": limp})}
    odd |= body.motion(flight, stature, white_m, keypoint_m)
    if not all(camera.static for camera in flight.cameras):
        above_m = median(body.hips[:, 2]) - median(scene.position[..., 2])
        odd["above"] = Oddity(max(0.0, above_m) / 2.0, {"above_m": above_m})
    if flight.ground is not None:
        foot = np.fmin(body["left_ankle"][:, 2], body["right_ankle"][:, 2])
        under = flight.ground.under(body.hips)
        on_map = np.isfinite(under)
        share = float(on_map.sum() / max(np.isfinite(body.hips[:, 0]).sum(), 1))
        if share < 0.5:
            odd["beside"] = Oddity(6.0, {"on_map_share": share})
        else:
            height_m = median((foot - under)[on_map]) - _ANKLE_ABOVE_GROUND_M
            above = max(0.0, abs(height_m) - 0.25 - 2 * stated_m) / 0.25
            odd["ground"] = Oddity(above, {"feet_above_ground_m": height_m})
    else:
        lowest = np.fmin.reduce(body.joints[..., 2], axis=1)
        rise_m = quantile(lowest, 0.9) - quantile(lowest, 0.1)
        walked_m = math.hypot(*(quantile(xy, 0.95) - quantile(xy, 0.05) for xy in body.hips[:, :2].T))
        excused_m = 0.5 + _SLOPE * walked_m + 3 * white_m
        odd["level"] = Oddity(max(0.0, rise_m - excused_m) / 0.3, {"rise_m": rise_m, "walked_m": walked_m})
    if flight.hips is not None and np.isfinite(flight.hips[:, 0]).any():
        apart = body.hips - flight.hips
        constant = np.array([median(apart[:, axis]) for axis in range(3)])
        apart_m = float(np.linalg.norm(constant))
        path_m = median(np.linalg.norm(apart - constant, axis=-1))
        odd["actor"] = Oddity(max(0.0, apart_m - 0.25 - 2 * stated_m) / 0.4, {"from_actor_m": apart_m})
        odd["actor_path"] = Oddity(max(0.0, path_m - 0.45 - 2 * white_m) / 0.3, {"path_apart_m": path_m})
    return odd


def _moved_by(sigma: Float, far_m: Float) -> float:
    """Return by how much errors of poses, position m and rotation rad [C, 2], move a person at a distance."""
    return float(np.sqrt(np.mean(sigma[:, 0] ** 2 + (far_m * sigma[:, 1]) ** 2)))


def _spread(values: Float) -> float:
    """Return the standard deviation of a length over its median, from its quartiles."""
    return 0.74 * (quantile(values, 0.75) - quantile(values, 0.25)) / max(median(values), 1e-9)


def residuals_px(scene: SceneOfMoments) -> list[float]:
    """Return the median distances (px) of keypoints from their joints: of all, then by camera."""
    solved = solve(scene)
    toward = solved.joints[None] - np.nan_to_num(scene.position)[:, :, None, :]
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.linalg.norm(np.cross(solved.direction, toward), axis=-1) / np.abs(solved.depth)
    pixels = np.where(solved.seen, across * scene.focal_px[:, None, None], np.nan)
    return [round(median(each), 2) for each in (pixels, *pixels)]
