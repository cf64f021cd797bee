"""Measure the adjustment by the background on a session with true poses.

    mocap ingest sample_data/mound_walk/flight.yaml -o SESSION
    mocap reconstruct SESSION --refine-cameras background
    python -m benchmarks.background SESSION [--draws N]

For every camera that was followed: attitudes (deg) and the changing part of positions (mm), RMS of the
length of all three axes, in the log and after the adjustment; NEES of both over their number, 1 if
covariances hold. `given` uses the pose noise of flight.yaml, `unknown` estimates its levels. Every draw adds
other errors of the stated models to the true poses. Then CPU time: of the adjustment, and of following a
picture beside its decoding.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import disturb, pose_errors
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction.background import background_of
from pipelines.reconstruction.background_adjustment import Adjusted, PosePrior, adjust
from pipelines.reconstruction.background_tracks import Follower, load_tracks
from pipelines.reconstruction.loading import load_cameras
from pipelines.session.camera_poses import poses_at, stated_models
from pipelines.session.description import read_description
from pipelines.session.stages import open_session
from pipelines.session.tables import CAMERA_POSES, read_table, trajectory_from
from pipelines.sources.pictures import open_pictures

_FOLLOWED = 100  # pictures, to measure the time


def errors_of(position: Float, rotation: Float, truth: tuple[Float, Float]) -> Float:
    """Compute errors [T, 6] of poses: m in the world, rad in the camera."""
    turned = quaternion_from_matrix(np.swapaxes(truth[1], 1, 2) @ rotation)
    return np.concatenate([position - truth[0], rotation_vector_from_quaternion(turned)], axis=1)


def line(name: str, logged: Float, found: Adjusted, truth: tuple[Float, Float], seconds: float) -> str:
    """Format a row of the table."""
    if found.refused is not None:
        return f"| {name} | {found.refused} | | | | | |"
    left = errors_of(found.position, found.rotation, truth)
    whitened = np.linalg.solve(found.covariance, left[..., None])[..., 0]
    nees = float(np.einsum("ti,ti->t", left, whitened).mean()) / 6
    parts = []
    for errors in (logged, left):
        changing = errors - errors.mean(axis=0)
        parts.append(
            [np.degrees(_rms(errors[:, 3:])), np.degrees(_rms(changing[:, 3:])), 1e3 * _rms(changing[:, :3])]
        )
    cells = [f"{before:.3g} -> {after:.3g}" for before, after in zip(*parts, strict=True)]
    return f"| {name} | {' | '.join(cells)} | {nees:.2f} | {found.reprojection_px:.2f} | {seconds:.2f} |"


def _rms(errors: Float) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def main() -> None:
    """Print the table of a session."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("session", type=Path)
    parser.add_argument("--draws", type=int, default=3)
    given = parser.parse_args()
    folder: Path = given.session
    description = read_description(folder)
    detected = open_session(folder).record("detect")
    cameras, _ = load_cameras(folder, description, detected, min_confidence=0.3, pose_noise=None)
    print(
        "| camera, errors, pose noise | attitude deg | its changing part deg | position, changing part mm ",
        end="",
    )
    print("| NEES / 6 | px | CPU s |\n| --- | --- | --- | --- | --- | --- | --- |")
    true_poses = read_table(folder / "truth_poses.parquet", CAMERA_POSES)
    for camera in cameras:
        followed = load_tracks(folder, camera)
        models = stated_models(camera.name, description.cameras[camera.name], None)
        if followed is None or models is None:
            continue
        between, t_ns = description.pose_interpolation, camera.frame_t_ns[followed.rows]
        own = trajectory_from(true_poses[true_poses["camera"] == camera.name])
        at, turned = poses_at(own, t_ns, between)
        truth = at, matrix_from_quaternion(turned)
        logs = {"log": camera.poses_at(t_ns, between)}
        for draw in range(given.draws):
            moved, other = disturb(models, t_ns, at, turned, np.random.default_rng(draw))
            logs[f"draw {draw}"] = moved, matrix_from_quaternion(other)
        points = background_of(camera, followed)
        for name, logged in logs.items():
            for noise, errors in (("given", pose_errors(models)), ("unknown", None)):
                started_s = time.process_time()
                found = adjust(points, *logged, PosePrior.of(errors))
                seconds = time.process_time() - started_s
                before = errors_of(*logged, truth)
                print(line(f"{camera.name}, {name}, {noise}", before, found, truth, seconds), flush=True)
        with open_pictures(folder, description, camera.name) as pictures:
            read = [pictures.read(number) for number in range(_FOLLOWED)]
        greys = [cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in read if picture is not None]
        started_s, follower = time.process_time(), Follower()
        for row, grey in enumerate(greys):
            follower.step(row, np.asarray(grey, np.uint8))
        each_ms = 1e3 * (time.process_time() - started_s) / len(greys)
        print(f"\n{camera.name}: {each_ms:.1f} ms of CPU time to follow a picture, its decoding left out\n")


if __name__ == "__main__":
    main()
