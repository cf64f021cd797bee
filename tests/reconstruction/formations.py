"""Flights in memory for the refinement: a walk, cameras around it, noisy logs and keypoints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import NoiseModel, disturb
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.geometry.triangulation import Views, estimate_noise, triangulate_pictures
from pipelines.reconstruction.refinement.system import Sighting
from pipelines.session.people import bones_of
from pipelines.simulation.flying import orbit
from tests.synthetic.walk import COCO17, route, walk

FPS = 30.0
FOCAL_PX = 1500.0
STATED_PX = 3.0
SPEED_MPS, RADIUS_M = 1.2, 4.0
_HEAD = range(5)  # nose, eyes and ears are as rigid as a bone
PAIRS = sorted(
    {(COCO17.index(a), COCO17.index(b)) for a, b in bones_of(COCO17)}
    | {(i, j) for i in _HEAD for j in _HEAD if i < j}
)
BONES = np.array(sorted({(min(pair), max(pair)) for pair in PAIRS}), dtype=np.int64)


@dataclass(frozen=True)
class Formation:
    """Sightings of the cameras, with the truth."""

    t_s: Float  # [T]
    truth: Float  # [T, 17, 3] m
    sightings: list[Sighting]
    start: Float  # [T, 17, 3] m, `robust` with the logged poses; NaN where it found nothing
    position: Float  # [C, T, 3] m, true
    rotation: Float  # [C, T, 3, 3]


def formation(
    times: int,
    cameras: int,
    models: Sequence[NoiseModel],
    seed: int,
    *,
    pixel_px: float = 2.0,
    memory: float = 0.0,
    constant_px: float = 0.0,
    bad_share: float = 0.0,
    still: bool = False,
    variation: float = 1.0,
    tilt_deg: float = 15.0,
    late_s: Sequence[float] = (),
) -> Formation:
    """Simulate a person who walks in a circle, filmed from 10 m.

    Args:
        times: frames of every camera, at 30 Hz.
        models: errors of the logs, not stated to `robust`.
        pixel_px: noise of the keypoints, at f = 1500 px.
        memory: autocorrelation of that noise from one frame to the next.
        constant_px: constant error of each joint in each camera.
        bad_share: share of keypoints that are 100 to 300 px off, and share that are missing.
        still: the cameras hover around the walk instead of following it.
        variation: deviation of moving cameras from the rigid ring.
        late_s: delay of each camera's pictures after their stamps (s); logs have the right time.
    """
    rng = np.random.default_rng([seed, cameras])
    t_s = np.arange(times) / FPS
    truth = walk(t_s, speed_mps=SPEED_MPS, radius_m=RADIUS_M)
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    sightings, positions, rotations = [], [], []
    for camera in range(cameras):
        taken_s = t_s + (late_s[camera] if late_s else 0.0)
        joints = walk(taken_s, speed_mps=SPEED_MPS, radius_m=RADIUS_M)
        middle = truth.mean(axis=(0, 1))

        def flown(at_s: Float, camera: int = camera, middle: Float = middle) -> list[Float]:
            target = np.tile(middle, (times, 1))
            if not still:
                # The path, not the gait: cameras that bob with the person would make a larger person without
                # vertical motion more likely.
                target[:, :2] = route(SPEED_MPS * at_s, radius_m=RADIUS_M)[0]
            parts = orbit(
                at_s,
                target,
                cameras=cameras,
                tilt_deg=tilt_deg,
                variation=0.0 if still else variation,
                yaw_rate_deg_per_s=0.0 if still else 4.0,
            )
            return [part[camera] for part in parts]

        # Logs have the right time, so a late picture matches a later time of the log.
        position, quaternion = flown(t_s)
        taken_from, taken_quaternion = flown(taken_s)
        rotation = matrix_from_quaternion(taken_quaternion)
        seen = np.einsum("tij,tki->tkj", rotation, joints - taken_from[:, None])
        xy = seen[..., :2] / seen[..., 2:]
        noise = rng.normal(0, pixel_px / FOCAL_PX, xy.shape)
        for k in range(1, len(noise) if memory else 0):
            noise[k] = memory * noise[k - 1] + np.sqrt(1 - memory**2) * noise[k]
        if constant_px:
            noise += rng.normal(0, constant_px / FOCAL_PX, noise.shape[1:])
        xy = xy + noise
        bad, missing = rng.random(xy.shape[:2]) < bad_share, rng.random(xy.shape[:2]) < bad_share
        off = rng.uniform(100, 300, xy.shape) * rng.choice([-1, 1], xy.shape) / FOCAL_PX
        xy = np.where(bad[..., None], xy + off, xy)
        xy[missing] = np.nan
        logged, logged_quaternion = disturb(models, t_ns, position, quaternion, rng)
        sightings.append(
            Sighting(
                t_s,
                xy,
                (~missing).astype(np.float64),
                logged,
                matrix_from_quaternion(logged_quaternion),
                FOCAL_PX,
                STATED_PX,
            )
        )
        positions.append(taken_from)
        rotations.append(rotation)
    return Formation(t_s, truth, sightings, triangulated(sightings), np.stack(positions), np.stack(rotations))


def triangulated(sightings: Sequence[Sighting]) -> Float:
    """Triangulate [T, J, 3] m by `robust` from cameras that share their times."""
    times, joints = sightings[0].confidence.shape
    count = len(sightings)
    views = Views(
        rays=np.stack([s.rays for s in sightings], axis=2).reshape(-1, count, 2),
        weight=np.stack([s.confidence for s in sightings], axis=2).reshape(-1, count),
        pose_index=np.repeat(np.arange(times), joints),
        position=np.stack([s.position for s in sightings], axis=1),
        rotation=np.stack([s.rotation for s in sightings], axis=1),
        focal=np.array([s.focal_px for s in sightings]),
        pixel_sigma=np.array([s.pixel_sigma for s in sightings]),
        pose_sigma=np.zeros((times, count, 2)),
    )
    noisy = replace(views, pixel_sigma=estimate_noise(views))
    return triangulate_pictures(
        noisy, picture=views.pose_index, pixel_sigma=views.pixel_sigma
    ).points.reshape(times, joints, 3)


def mean_mm(estimate: Float, truth: Float, where: Float | None = None) -> float:
    """Compute the mean distance (mm) over joint-frames that are not NaN in `where`."""
    distance = np.linalg.norm(estimate - truth, axis=-1)
    if where is not None:
        distance = distance[~np.isnan(where[..., 0])]
    return float(1e3 * np.nanmean(distance))
