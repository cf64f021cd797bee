"""Time per frame to associate five people in five cameras and to triangulate them.

python -m benchmarks.association [--frames 900]

Five people walk on circles among each other, five drones circle them; 17 joints, 3 px, detections in a random
order in every picture. The goal is 1 ms a frame for both together (the claim of RapidPoseTriangulation for
association and triangulation of known cameras).
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.cameras import Intrinsics, undistort
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.geometry.triangulation import Views, triangulate
from pipelines.keypoints.association import associate
from pipelines.simulation.detector_errors import see
from pipelines.simulation.flying import orbit
from tests.synthetic.keypoints import KeypointNoise, detect
from tests.synthetic.walk import walk

CAMERAS = PEOPLE = 5
FOCAL, PIXEL_PX, RATE_HZ = 1000.0, 3.0, 30
LENS = Intrinsics(1920, 1080, FOCAL, FOCAL, 959.5, 539.5)


def main() -> None:
    """Make the scene, associate and triangulate it, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=900)
    frames = parser.parse_args().frames
    t_s = np.arange(frames) / RATE_HZ
    truth = people_at(t_s)
    xy, confidence, position, rotation = filmed(truth, t_s)
    sigma = np.full((frames, CAMERAS), PIXEL_PX / FOCAL)

    print("| run | association, ms a frame | triangulation, ms a frame | both |")
    print("| --- | --- | --- | --- |")
    for run in ("first, with compiling or loading", "second", "third"):
        started = time.perf_counter()
        found = associate(t_s, xy, confidence, position, rotation, sigma, people=PEOPLE)
        associated = time.perf_counter()
        views = views_of(found.choice, xy, confidence, position, rotation)
        result = triangulate(views, method="robust", threads=1)
        ended = time.perf_counter()
        first, second = 1e3 * (associated - started) / frames, 1e3 * (ended - associated) / frames
        print(f"| {run} | {first:.3f} | {second:.3f} | {first + second:.3f} |")
    points = result.points.reshape(frames, PEOPLE, 17, 3)
    apart = np.linalg.norm(points[:, :, None] - truth[:, None], axis=-1)
    nearest = np.nanmean(apart, axis=-1).min(axis=2)
    print(f"\nmean distance to the nearest true person {1e3 * np.nanmean(nearest):.1f} mm")


def people_at(t_s: Float) -> Float:
    """Simulate joints [T, P, J, 3] (m) of people who walk on circles."""
    starts = [(2.5 * np.cos(k), 2.5 * np.sin(k)) for k in range(PEOPLE)]
    people = [
        walk(t_s, start=start, heading_deg=70.0 * k, radius_m=2.0 + 0.4 * k) for k, start in enumerate(starts)
    ]
    return np.stack(people, axis=1)


def filmed(people: Float, t_s: Float) -> tuple[Float, Float, Float, Float]:
    """Simulate detections in a random order, and the poses of the cameras, as `associate` takes them."""
    rng = np.random.default_rng(0)
    frames = len(t_s)
    middle = np.tile([0.0, 0.0, 1.0], (frames, 1))
    position, quaternion = orbit(t_s, middle, cameras=CAMERAS, range_m=14, variation=1)
    xy = np.full((frames, CAMERAS, PEOPLE, 17, 2), np.nan)
    confidence = np.zeros(xy.shape[:-1])
    for c in range(CAMERAS):
        order = rng.permuted(np.tile(np.arange(PEOPLE), (frames, 1)), axis=1)
        for k in range(PEOPLE):
            pixels, sure = detect(
                see(people[:, k], position[c], quaternion[c], LENS), KeypointNoise(pixel_px=PIXEL_PX), rng
            )
            rows, places = np.nonzero(order == k)
            xy[rows, c, places], confidence[rows, c, places] = undistort(pixels, LENS), sure
    rotation = matrix_from_quaternion(quaternion)
    return xy, confidence, position.swapaxes(0, 1).copy(), rotation.swapaxes(0, 1).copy()


def views_of(choice: Int64, xy: Float, confidence: Float, position: Float, rotation: Float) -> Views:
    """Collect the chosen views of each person, one row for each joint-frame."""
    frames = len(choice)
    chosen = np.clip(choice, 0, None)[:, :, :, None]
    absent = (choice < 0)[:, :, :, None]
    taken = np.where(absent[..., None], np.nan, np.take_along_axis(xy, chosen[..., None], axis=2))
    weight = np.where(absent, 0.0, np.take_along_axis(confidence, chosen, axis=2))
    return Views(
        rays=np.moveaxis(taken, 1, 3).reshape(-1, CAMERAS, 2),
        weight=np.moveaxis(weight, 1, 3).reshape(-1, CAMERAS),
        pose_index=np.repeat(np.arange(frames), PEOPLE * 17),
        position=position,
        rotation=rotation,
        focal=np.full(CAMERAS, FOCAL),
        pixel_sigma=np.full(CAMERAS, PIXEL_PX),
        pose_sigma=np.zeros((frames, CAMERAS, 2)),
    )


if __name__ == "__main__":
    main()
