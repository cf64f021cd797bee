"""Method `refined` for a flight: from cameras and who is who to a skeleton, poses and clocks.

The refinement starts from `robust` and ends with it: which views are good, and which joints may be called
reconstructed, is what `robust` says with the corrected poses. Positions and covariances are the estimate's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.geometry.triangulation import (
    STATUS,
    Triangulation,
    Views,
    estimate_noise,
    reprojection_px,
    triangulate,
)
from pipelines.reconstruction.clock_search import begun_offsets_s
from pipelines.reconstruction.observations import (
    Camera,
    Candidates,
    Observations,
    observe,
    on_sides,
    sightings_of,
)
from pipelines.reconstruction.refinement.building import Sighting
from pipelines.reconstruction.refinement.problem import NEW_SHARE, PoseErrors
from pipelines.reconstruction.refinement.refine import SETTLED_S, Refined, corrected, refine
from pipelines.session.description import Interpolation
from pipelines.session.records import Float, Int64
from pipelines.session.skeletons import bones_of

if TYPE_CHECKING:
    import pandas as pd

_SEARCHED = 300  # times of the skeleton at which the search for clocks looks
_MOST_SHIFTS = 6  # of the clocks; offsets of 0.2 s took one to five
_UNTOLD = 0.5  # share of its prior that a clock's standard deviation may keep; above, pictures do not tell it
_HEAD = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")  # as rigid as a bone


@dataclass(frozen=True)
class RefinedFlight:
    """What the refinement made of a flight; what went in, where it must not be believed."""

    observations: Observations
    views: Views
    result: Triangulation
    cameras: pd.DataFrame | None  # t_ns, camera and pose of every picture; None after a fallback
    metrics: dict[str, Any]
    warnings: list[str]


def refine_flight(
    cameras: Sequence[Camera],
    found: Candidates,
    choice: Int64,
    observations: Observations,
    sides: Int64,
    views: Views,
    result: Triangulation,
    *,
    prior: Sequence[PoseErrors] | None,
    clock_sigma_s: Float,
    pixel_sigma: float,
    between: Interpolation,
    threads: int,
) -> RefinedFlight:
    """Refine what `robust` made of a flight.

    Args:
        cameras: all of them.
        found: every detection, at the times where people were told apart.
        choice: [T', C, P] each person's detection, see `observe`.
        observations: at the skeleton's times, on those sides.
        sides: [T, P, J, C] which joint's view is the one of each joint, -1 for none, see `on_sides`.
        views: the same, one row for each joint-frame.
        result: `robust` of the views.
        prior: what is known of each camera's pose errors, None when nobody stated anything.
        clock_sigma_s: [C] how far each clock may be off, 0 for one that is known.
        pixel_sigma: px, of a good keypoint.
        between: how far logged poses are trusted.
        threads: see `triangulate`.
    """
    times, people, joints, _ = observations.confidence.shape
    begin_ns = int(observations.t_ns[0])
    t_s = (observations.t_ns - begin_ns) / 1e9
    bones = rigid_pairs(observations.joints, people)

    def seen_from(shifted: list[Camera], every: int = 1) -> tuple[Observations, Views]:
        observed = observe(shifted, found, choice, observations.t_ns[::every], between)
        xy, confidence = on_sides(observed.xy, observed.confidence, sides[::every])
        observed = replace(observed, xy=xy, confidence=confidence)
        rows = len(observed.t_ns) * people * joints
        return observed, replace(
            views,
            xy=xy.reshape(rows, len(cameras), 2),
            weight=confidence.reshape(rows, len(cameras)),
            pose_index=views.pose_index[:rows],
            position=observed.position,
            rotation=observed.rotation,
            pose_sigma=views.pose_sigma[::every],
        )

    def robustly(shifted: list[Camera]) -> Triangulation:
        _, again = seen_from(shifted)
        again = replace(again, pixel_sigma=estimate_noise(again, threads=threads))
        return triangulate(again, method="robust", threads=threads)

    every = -(-times // _SEARCHED)
    offset_s = begun_offsets_s(
        lambda shift_s: seen_from(_shifted(cameras, np.where(clock_sigma_s > 0, shift_s, 0.0)), every)[1],
        len(observations.t_ns[::every]),
        clock_sigma_s,
    )

    # A picture is joined to the three times nearest to its stamp, from which motion cannot be told far away,
    # and levels of pose noise that are found beside a large offset hold part of it. So the stamps follow the
    # clocks until little is left to correct.
    shifted = _shifted(cameras, offset_s)
    started = robustly(shifted) if offset_s.any() else result
    for _ in range(1 + _MOST_SHIFTS):
        sightings = [
            replace(
                _sighting(camera, found, c, choice, observations.t_ns, sides[..., c], pixel_sigma, between),
                pose_covariance=None if prior is None else white_covariance(camera, prior[c]),
            )
            for c, camera in enumerate(shifted)
        ]
        start = started.points.reshape(times, people * joints, 3)
        refined = refine(t_s, sightings, start, bones, prior, clock_sigma_s)
        offset_s = offset_s + refined.clock_offset_s
        shifted = _shifted(cameras, offset_s)
        if np.abs(refined.clock_offset_s).max() <= SETTLED_S:
            break
        started = robustly(shifted)
    warnings = [*refined.warnings, *_untold_clocks(refined, cameras, clock_sigma_s)]
    metrics = _metrics(refined, cameras, offset_s)
    if refined.fallback is not None:
        warnings.append(f"refined: fell back to robust, because {refined.fallback}")
        return RefinedFlight(observations, views, result, None, metrics, warnings)

    observed, _ = seen_from(shifted) if offset_s.any() else (observations, views)
    position, rotation = observed.position.copy(), observed.rotation.copy()
    for c in range(len(cameras)):
        numbers = _numbers_at(refined.corrections[c], t_s - refined.clock_offset_s[c])
        position[:, c], rotation[:, c] = corrected(position[:, c], rotation[:, c], numbers)
    observed = replace(observed, position=position, rotation=rotation)
    moved = replace(
        views,
        xy=observed.xy.reshape(views.xy.shape),
        weight=observed.confidence.reshape(views.weight.shape),
        position=position,
        rotation=rotation,
        pixel_sigma=np.full(len(cameras), pixel_sigma),
        pose_sigma=np.zeros_like(views.pose_sigma),
    )
    moved = replace(moved, pixel_sigma=estimate_noise(moved, threads=threads))
    gated = triangulate(moved, method="robust", threads=threads)
    ok = (gated.status == STATUS.index("ok")) & ~np.isnan(refined.position.reshape(-1, 3)[:, 0])
    final = replace(
        gated,
        points=np.where(ok[:, None], refined.position.reshape(-1, 3), gated.points),
        covariance=np.where(ok[:, None, None], refined.covariance.reshape(-1, 3, 3), gated.covariance),
    )
    residual = reprojection_px(moved, final.points)
    return RefinedFlight(
        observed,
        moved,
        replace(final, residual_px=residual),
        _camera_table(shifted, refined, begin_ns, between),
        metrics,
        warnings,
    )


def _shifted(cameras: Sequence[Camera], offset_s: Float) -> list[Camera]:
    """The cameras, their clocks put forward."""
    return [
        replace(camera, frame_t_ns=camera.frame_t_ns + round(1e9 * offset))
        for camera, offset in zip(cameras, offset_s, strict=True)
    ]


def _sighting(
    camera: Camera,
    found: Candidates,
    c: int,
    choice: Int64,
    t_ns: Int64,
    sides: Int64,
    pixel_sigma: float,
    between: Interpolation,
) -> Sighting:
    """What a camera saw in its own pictures, all people side by side.

    Left and right are on the sides [T, P, J] of the nearest of the skeleton's times.
    """
    nearest = np.searchsorted((t_ns[:-1] + t_ns[1:]) // 2, camera.frame_t_ns)
    xy, confidence = on_sides(*sightings_of(camera, found, c, choice[:, c]), sides[nearest])
    frames = len(camera.frame_t_ns)
    position, rotation = camera.poses_at(camera.frame_t_ns, between)
    return Sighting(
        t_s=(camera.frame_t_ns - t_ns[0]) / 1e9,
        xy=xy.reshape(frames, -1, 2),
        confidence=np.nan_to_num(confidence.reshape(frames, -1)),
        position=position,
        rotation=rotation,
        focal_px=camera.focal_px,
        pixel_sigma=pixel_sigma,
    )


def white_covariance(camera: Camera, prior: PoseErrors) -> Float | None:
    """Covariances [F, 6, 6] of what is new in each picture's pose, where the log states them pose by pose."""
    logged = camera.covariance_at(camera.frame_t_ns) if prior.logged else None
    return None if logged is None else NEW_SHARE * logged


def rigid_pairs(joints: tuple[str, ...], people: int) -> Int64:
    """Pairs of joints [B, 2] whose distance hardly changes: bones, and the points of the head."""
    number = {name: index for index, name in enumerate(joints)}
    head = [number[name] for name in _HEAD if name in number]
    pairs = {(number[a], number[b]) for a, b in bones_of(joints)} | {(i, j) for i in head for j in head}
    own = np.array(sorted({(min(p), max(p)) for p in pairs if p[0] != p[1]}), dtype=np.int64).reshape(-1, 2)
    return np.concatenate([own + person * len(joints) for person in range(people)])


def _numbers_at(correction: tuple[Float, Float], t_s: Float) -> Float:
    """The ten numbers [N, 10] of a camera at other times: linear between its pictures, held outside them."""
    when, numbers = correction
    if not len(when):
        return np.zeros((len(t_s), 10))
    return np.stack([np.interp(t_s, when, column) for column in numbers.T], axis=1)


def _untold_clocks(refined: Refined, cameras: Sequence[Camera], prior_s: Float) -> list[str]:
    """Clocks that pictures hardly tell: nothing moved, or cameras that fly straight make up for it."""
    return [
        f"refined: the pictures do not tell the clock of {camera.name}: its offset is known to {sigma:.2g} s "
        f"where {prior:.2g} s were stated"
        for camera, sigma, prior in zip(cameras, refined.clock_sigma_s, prior_s, strict=True)
        if refined.fallback is None and prior > 0 and sigma > _UNTOLD * prior
    ]


def _metrics(refined: Refined, cameras: Sequence[Camera], offset_s: Float) -> dict[str, Any]:
    used = refined.fallback is None
    offsets, sigmas = (
        {camera.name: float(value) if used else 0.0 for camera, value in zip(cameras, values, strict=True)}
        for values in (offset_s, refined.clock_sigma_s)
    )
    return {
        "clock_offsets_s": offsets,
        "clock_offset_sigmas_s": sigmas,
        "refinement": {
            "fallback": refined.fallback,
            "pose_noise": "estimated" if refined.learned else "stated",
            "levels": refined.levels,
            "bone_lengths_m": refined.bone_lengths_m.tolist() if used else [],
        },
    }


def _camera_table(
    cameras: Sequence[Camera], refined: Refined, begin_ns: int, between: Interpolation
) -> pd.DataFrame:
    """The corrected pose of every picture that has one."""
    import pandas as pd

    parts = []
    for c, camera in enumerate(cameras):
        position, rotation = camera.poses_at(camera.frame_t_ns, between)
        (posed,) = np.nonzero(~np.isnan(position[:, 0]))
        stamped_s = (camera.frame_t_ns[posed] - begin_ns) / 1e9 - refined.clock_offset_s[c]
        numbers = _numbers_at(refined.corrections[c], stamped_s)
        true_position, true_rotation = corrected(position[posed], rotation[posed], numbers)
        table = pd.DataFrame({"t_ns": camera.frame_t_ns[posed], "camera": camera.name})
        table[["x", "y", "z"]] = true_position
        table[["qx", "qy", "qz", "qw"]] = quaternion_from_matrix(true_rotation)
        parts.append(table)
    return pd.concat(parts, ignore_index=True)
