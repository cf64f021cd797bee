"""Speed and error of triangulation, and of numpy, OpenCV and pycolmap: `python -m benchmarks.triangulation`.

The walk of tests/geometry/rings.py: 17 joints, 10 m ring, f = 1500 px, 2 px noise. Speeds are whole
calls, the best of several, after a first call that compiles. Peers compute points alone, so `locate` is
the one to compare; `triangulate` adds the covariance and every view's residual.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import pycolmap

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import (
    Method,
    Views,
    estimate_noise,
    locate,
    triangulate,
    triangulate_pictures,
)
from tests.geometry.rings import FOCAL, LEVELS, ring, with_outliers, with_pixel_noise, with_pose_noise

GATE_PX = 15.0  # usual choice of users of pycolmap and Pose2Sim


def main() -> None:
    """Print the tables of docs/benchmarks.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=22_500, help="frames of 17 joints (default 22500)")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--draws", type=int, default=400, help="pose draws of the error table, 0 for none")
    arguments = parser.parse_args()
    print_speeds(arguments.frames, arguments.repeats)
    if arguments.draws:
        print_pose_errors(arguments.draws)


def print_speeds(frames: int, repeats: int) -> None:
    """Print joint-frames per second and mean error, with and without outliers."""
    rng = np.random.default_rng(1)
    truth, exact = ring(frames, 5)
    noisy = with_pixel_noise(exact, rng)
    outliers, good = with_outliers(noisy, rng, uniform=False)

    started = time.perf_counter()
    triangulate(noisy, method="robust")
    print(f"first call, compiled or from the cache: {time.perf_counter() - started:.2f} s")
    oracle = locate(replace(noisy, weight=good.astype(float)), method="midpoint").points
    print(f"{len(truth)} joint-frames; dropping exactly the bad views: {error_mm(oracle, truth):.2f} mm\n")
    print("| method | data | threads | locate, M/s | triangulate, M/s | mean mm | reconstructed |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for label, views in (("2 px", noisy), ("outliers", outliers)):
        seen = replace(views, pixel_sigma=estimate_noise(views))
        for method in get_args(Method):
            for threads in sorted({1, os.cpu_count() or 1}):
                alone = best_s(lambda: locate(seen, method=method, threads=threads), repeats)  # noqa: B023
                whole = best_s(lambda: triangulate(seen, method=method, threads=threads), repeats)  # noqa: B023
                points = locate(seen, method=method).points
                figures = [
                    f"{len(truth) / alone / 1e6:.1f}",
                    f"{len(truth) / whole / 1e6:.1f}",
                    f"{error_mm(points, truth):.2f}",
                    f"{reconstructed(points):.4f}",
                ]
                print(f"| {method} | {label} | {threads} | {' | '.join(figures)} |")
        for threads in sorted({1, os.cpu_count() or 1}):
            print(pictures_row(label, views, truth, threads, repeats))

    print_peers(truth, noisy, outliers, repeats)


def pictures_row(label: str, views: Views, truth: Float, threads: int, repeats: int) -> str:
    """Format the row of `robust` with the gate of pictures, as used for moving cameras."""
    seen = replace(views, pixel_sigma=estimate_noise(views))
    whole = best_s(
        lambda: triangulate_pictures(
            seen, picture=views.pose_index, pixel_sigma=views.pixel_sigma, threads=threads
        ),
        repeats,
    )
    points = triangulate_pictures(seen, picture=views.pose_index, pixel_sigma=views.pixel_sigma).points
    speed = f"{len(truth) / whole / 1e6:.1f}"
    return (
        f"| robust, pictures | {label} | {threads} | | {speed} | "
        f"{error_mm(points, truth):.2f} | {reconstructed(points):.4f} |"
    )


def print_peers(truth: Float, noisy: Views, outliers: Views, repeats: int) -> None:
    """Print the same figures of other tools."""
    two_views = Views(
        noisy.rays[:, :2],
        noisy.weight[:, :2],
        noisy.pose_index,
        noisy.position[:, :2],
        noisy.rotation[:, :2],
        noisy.focal[:2],
        noisy.pixel_sigma[:2],
        noisy.pose_sigma[:, :2],
    )
    print("\n| peer, one thread | M/s | 2 px, mean mm | outliers, mean mm |")
    print("| --- | --- | --- | --- |")
    few = slice(0, 17 * 450)  # 7650 joint-frames are enough for the slow ones
    print(peer_row("numpy batched SVD", numpy_svd, [part(noisy, few)], truth[few], 3))
    print(
        peer_row(
            "pycolmap LO-RANSAC 15 px",
            pycolmap_ransac,
            [part(v, few) for v in (noisy, outliers)],
            truth[few],
            1,
        )
    )
    print(peer_row("cv2.triangulatePoints, 2 views", opencv, [part(two_views, few)], truth[few], 3))
    two = best_s(lambda: locate(two_views, method="midpoint"), repeats)
    print(f"| (midpoint, 2 views) | {len(truth) / two / 1e6:.1f} | | |")


def print_pose_errors(draws: int) -> None:
    """Print the mean error under constant pose errors over `draws` independent draws."""
    print(f"\nMean mm over {draws} draws of a constant pose error, 2 px; stated: in pose_sigma")
    print("joints alone: stated, without the gate of pictures")
    print(
        "only good: `robust`, stated, of only the good views of the outliers; and what each reconstructed\n"
    )
    print(
        "| cameras | level | midpoint | robust, stated | not stated | outliers: midpoint | joints alone"
        " | stated | not stated | only good | joints alone, % there | stated, % there | only good, % there |"
    )
    print("|" + " --- |" * 13)
    for cameras in (2, 3, 4, 5):
        truth, exact = ring(20, cameras)
        for level in LEVELS:
            rows = np.array([errors_of(exact, truth, level, draw) for draw in range(draws)])
            errors, shares = np.split(rows.mean(axis=0), [8])
            print(
                f"| {cameras} | {level} | "
                + " | ".join(f"{value:.0f}" for value in errors)
                + " | "
                + " | ".join(f"{100 * share:.1f}" for share in shares)
                + " |"
            )


def errors_of(exact: Views, truth: Float, level: str, draw: int) -> list[float]:
    """Compute one draw: errors without and with outliers and of good views only; reconstructed shares."""
    rng = np.random.default_rng(draw)
    known = with_pose_noise(with_pixel_noise(exact, rng), rng, level, constant=True, stated=True)
    outliers, good = with_outliers(known, rng, uniform=False)
    alone = locate(replace(outliers, pixel_sigma=estimate_noise(outliers)), method="robust").points
    despite = robustly(outliers)
    only_good = robustly(replace(outliers, weight=outliers.weight * good))
    return [
        error_mm(locate(known, method="midpoint").points, truth),
        error_mm(robustly(known), truth),
        error_mm(robustly(silent(known)), truth),
        error_mm(locate(outliers, method="midpoint").points, truth),
        error_mm(alone, truth),
        error_mm(despite, truth),
        error_mm(robustly(silent(outliers)), truth),
        error_mm(only_good, truth),
        reconstructed(alone),
        reconstructed(despite),
        reconstructed(only_good),
    ]


def robustly(views: Views) -> Float:
    """Triangulate with `robust` as used for moving cameras."""
    noisy = replace(views, pixel_sigma=estimate_noise(views))
    return triangulate_pictures(noisy, picture=views.pose_index, pixel_sigma=views.pixel_sigma).points


def silent(views: Views) -> Views:
    """Return the views without pose noise."""
    return replace(views, pose_sigma=np.zeros_like(views.pose_sigma))


def reconstructed(points: Float) -> float:
    """Compute the share of finite points."""
    return float(np.isfinite(points[:, 0]).mean())


def peer_row(name: str, run: Callable[[Views], Float], data: list[Views], truth: Float, repeats: int) -> str:
    """Format one row of the peers' table."""
    speed = len(truth) / best_s(lambda: run(data[0]), repeats) / 1e6
    errors = [f"{error_mm(run(views), truth):.2f}" for views in data]
    return f"| {name} | {speed:.3f} | {' | '.join([*errors, ''][:2])} |"


def numpy_svd(views: Views) -> Float:
    """Triangulate by the homogeneous linear method with numpy's batched SVD."""
    P = projections(views)[views.pose_index]
    rows = views.rays[..., None] * P[:, :, 2:] - P[:, :, :2]
    X = np.linalg.svd(rows.reshape(len(rows), -1, 4))[2][:, -1]
    points: Float = X[:, :3] / X[:, 3:]
    return points


def opencv(views: Views) -> Float:
    """Triangulate with cv2.triangulatePoints, which takes two cameras and one pose of them per call."""
    P = projections(views)
    joints = len(views.rays) // len(P)
    pairs = views.rays.reshape(len(P), joints, 2, 2)
    found = [
        cv2.triangulatePoints(p[0], p[1], xy[:, 0].T, xy[:, 1].T) for p, xy in zip(P, pairs, strict=True)
    ]
    X = np.swapaxes(np.array(found), 1, 2).reshape(-1, 4)
    points: Float = X[:, :3] / X[:, 3:]
    return points


def pycolmap_ransac(views: Views) -> Float:
    """Triangulate with pycolmap's robust method, one call per joint-frame."""
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1920, height=1080, params=[FOCAL, 960, 540])
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = GATE_PX
    poses = [[pycolmap.Rigid3d(p) for p in row] for row in projections(views)]
    pixels = views.rays * FOCAL + [960, 540]
    points = np.full((len(pixels), 3), np.nan)
    for n, seen in enumerate(np.isfinite(pixels.sum(axis=2))):
        row = [pose for pose, there in zip(poses[views.pose_index[n]], seen, strict=True) if there]
        if len(row) > 1:
            result = pycolmap.estimate_triangulation(pixels[n, seen], row, [camera] * len(row), options)
            if result is not None:
                points[n] = result["xyz"]
    return points


def projections(views: Views) -> Float:
    """Compute projection matrices camera_from_world [F, C, 3, 4]."""
    camera_from_world = np.swapaxes(views.rotation, -1, -2)
    return np.concatenate([camera_from_world, -camera_from_world @ views.position[..., None]], axis=-1)


def part(views: Views, rows: slice) -> Views:
    """Select some joint-frames and their poses."""
    instants = slice(0, int(views.pose_index[rows].max()) + 1)
    return replace(
        views,
        rays=views.rays[rows],
        weight=views.weight[rows],
        pose_index=views.pose_index[rows],
        position=views.position[instants],
        rotation=views.rotation[instants],
        pose_sigma=views.pose_sigma[instants],
    )


def error_mm(points: Float, truth: Float) -> float:
    """Compute the mean distance (mm) over finite points."""
    return 1e3 * float(np.nanmean(np.linalg.norm(points - truth, axis=1)))


def best_s(run: Callable[[], object], repeats: int) -> float:
    """Measure the shortest time (s) of several runs."""
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return min(times)


if __name__ == "__main__":
    main()
