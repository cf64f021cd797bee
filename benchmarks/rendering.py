"""Time of a rendered picture: the figures of docs/decisions/0003-renderer.md.

python -m benchmarks.rendering [--pictures 20] [--threads 2] [--save FOLDER]

The scene is a site of 60 m with a mound, 15 trees of some 2,700 triangles each, and a person of 20,000
triangles made of capsules, seen from 10 m at five tilts. Times are processor times of one thread, without
the load of other programs: the best and the mean of the pictures, after a first one that compiles or loads
the code. "Wall" is the wall time for each picture while several threads share the renderer.
"""

from __future__ import annotations

import argparse
import resource
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.simulation.rendering.renderer import Renderer
from pipelines.simulation.surfaces import Surface, joined
from tests.synthetic.walk import COCO17, walk

UP = np.array([0.0, 0.0, 1.0])
SUN = np.array([0.45, -0.35, 0.82])
SIZES = {"1280x720": (1280, 720), "1920x1080": (1920, 1080), "3840x2160": (3840, 2160)}
TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
RADII_M = {  # of the capsules between joints
    ("hip", "knee"): 0.085,
    ("knee", "ankle"): 0.055,
    ("shoulder", "elbow"): 0.047,
    ("elbow", "wrist"): 0.038,
    ("shoulder", "hip"): 0.105,
}
CLOTHES = {"knee": (0.10, 0.12, 0.20), "ankle": (0.10, 0.12, 0.20), "wrist": (0.55, 0.33, 0.24)}
SHIRT = (0.45, 0.08, 0.07)


def main() -> None:
    """Build the scene, render the pictures, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=int, default=20)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--save", type=Path, help="keep a picture of each tilt and size here")
    options = parser.parse_args()
    static, people = [site(), *trees(15)], [person(0.13 * k) for k in range(5)]
    print(f"static triangles {sum(len(s.faces) for s in static)}, person {len(people[0].faces)}")
    print("| picture | best ms | mean ms | silhouette ms | wall ms in threads | set up s | peak MB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, (width, height) in SIZES.items():
        start = time.perf_counter()
        renderer = Renderer(static, camera(width, height), sun=SUN, seed=1)
        setup_s = time.perf_counter() - start
        renderer.picture(*look(0.0, 0), people[:1], 0)
        renderer.silhouette(*look(0.0, 0), people[0])

        def take(k: int, renderer: Renderer = renderer) -> NDArray[np.uint8]:
            return renderer.picture(*look(TILTS_DEG[k % 5], k), [people[k % 5]], k)

        times = []
        for k in range(options.pictures):
            start = time.thread_time()
            picture = take(k)
            times.append(time.thread_time() - start)
            if options.save and k < len(TILTS_DEG):
                save(picture, options.save / f"{name}-{TILTS_DEG[k]:.0f}.png")
        start = time.thread_time()
        for k in range(5):
            renderer.silhouette(*look(TILTS_DEG[k], k), people[k])
        silhouette_s = (time.thread_time() - start) / 5
        start = time.perf_counter()
        with ThreadPoolExecutor(options.threads) as pool:
            list(pool.map(take, range(options.pictures)))
        shared_s = (time.perf_counter() - start) / options.pictures
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"| {name} | {1e3 * min(times):.0f} | {1e3 * float(np.mean(times)):.0f} | "
            f"{1e3 * silhouette_s:.0f} | {1e3 * shared_s:.0f} | {setup_s:.1f} | {peak_mb:.0f} |"
        )


def camera(width: int, height: int) -> Intrinsics:
    """Return a pinhole camera with a field of view of 65 degrees."""
    focal = width / 2 / np.tan(np.radians(65) / 2)
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def look(tilt_deg: float, k: int, distance_m: float = 10.0) -> tuple[Float, Float]:
    """Return a camera pose that looks at the person from above at the tilt, each k from another side."""
    around, tilt = np.radians(40 + 45 * k), np.radians(tilt_deg)
    target = np.array([0.0, 0.0, 1.0])
    back = np.array([np.cos(tilt) * np.cos(around), np.cos(tilt) * np.sin(around), np.sin(tilt)])
    right = np.array([-np.sin(around), np.cos(around), 0.0])
    rotation = np.stack([right, np.cross(-back, right), -back], axis=1)
    return target + distance_m * back, quaternion_from_matrix(rotation)


def site(size_m: float = 60.0, cell_m: float = 0.4) -> Surface:
    """Build grassland with a mound."""
    axis = np.linspace(-size_m / 2, size_m / 2, round(size_m / cell_m) + 1)
    x, y = np.meshgrid(axis, axis)
    z = 1.2 * np.exp(-((x - 9) ** 2 + (y + 8) ** 2) / (2 * 2.6**2))
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    colour = np.tile(np.array([0.115, 0.15, 0.055], np.float32), (len(vertices), 1))
    return Surface(vertices, _grid_faces(*x.shape), colour, ground=True)


def trees(count: int) -> list[Surface]:
    """Build trees 13 to 27 m away, each with a trunk and six rough balls of leaves."""
    rng = np.random.default_rng(5)
    surfaces = []
    for _ in range(count):
        around, away, height = rng.uniform(0, 2 * np.pi), rng.uniform(13, 27), rng.uniform(3.5, 7)
        foot = np.array([away * np.cos(around), away * np.sin(around), 0.0])
        trunk = capsule(foot, foot + 0.6 * height * UP, 0.16, 12, 8, (0.10, 0.075, 0.05))
        crowns = []
        for _ in range(6):
            centre = foot + height * (0.6 + 0.35 * rng.uniform()) * UP
            centre[:2] += rng.normal(0, 0.6, 2)
            crown = capsule(centre, centre + 0.1 * UP, rng.uniform(0.7, 1.3), 16, 13, (0.06, 0.11, 0.03))
            ruffled = crown.vertices + rng.normal(0, 0.06, crown.vertices.shape)
            speckled = crown.colour * rng.uniform(0.6, 1.4, (len(ruffled), 1)).astype(np.float32)
            crowns.append(Surface(ruffled, crown.faces, speckled))
        surfaces.append(joined(trunk, *crowns))
    return surfaces


def person(t_s: float) -> Surface:
    """Build capsules along the limbs of the walking person, 20,000 triangles."""
    joints = dict(zip(COCO17, walk(np.array([t_s]), speed_mps=1.0, start=(-t_s, 0.0))[0], strict=True))
    parts = []
    for (upper, lower), radius in RADII_M.items():
        for side in ("left", "right"):
            ends = joints[f"{side}_{upper}"], joints[f"{side}_{lower}"]
            parts.append(capsule(*ends, radius, 40, 23, CLOTHES.get(lower, SHIRT)))
    ear = (joints["left_ear"] + joints["right_ear"]) / 2
    parts.append(capsule(ear - 0.04 * UP, ear + 0.06 * UP, 0.095, 40, 23, (0.55, 0.33, 0.24)))
    return joined(*parts)


def capsule(
    start: Float, end: Float, radius: float, sectors: int, rings: int, colour: tuple[float, float, float]
) -> Surface:
    """Build a cylinder with round ends: 2 * sectors * rings triangles."""
    along = (end - start) / np.sqrt(np.sum((end - start) ** 2))
    across = np.cross(along, [0.3, 0.9, 0.1] if abs(along[0]) < 0.5 else [0.0, 0.9, 0.4])
    across /= np.sqrt(np.sum(across**2))
    other = np.cross(along, across)
    polar, turn = np.linspace(np.pi, 0, rings + 1), np.linspace(0, 2 * np.pi, sectors + 1)
    ring = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * other
    middle = np.where(polar[:, None] > np.pi / 2, start, end)
    outward = np.sin(polar)[:, None, None] * ring + np.cos(polar)[:, None, None] * along
    vertices = (middle[:, None] + radius * outward).reshape(-1, 3)
    return Surface(
        vertices,
        _grid_faces(rings + 1, sectors + 1),
        np.tile(np.array(colour, np.float32), (len(vertices), 1)),
    )


def save(picture: NDArray[np.uint8], path: Path) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture)


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """List two triangles for each cell of a grid of corners."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns], axis=1)
    upper = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([lower, upper]).astype(np.int32)


if __name__ == "__main__":
    main()
