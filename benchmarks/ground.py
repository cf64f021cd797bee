"""Position errors between cameras before and after `ground.bind_positions`.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.ground [--noise NOISE] [--draws N] SESSION ...

SESSION is a simulated and rendered flight, ingested with its true poses (`mocap ingest true_poses.yaml`). For
each draw, errors are added to the poses, the background corrects them, and patches of ground bind the
cameras. The error of a camera is its mean position error less the mean of all cameras; the table has the root
mean square length over the cameras. NEES is that of these errors by the standard deviations stated
afterwards, divided by the degrees of freedom.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import pose_errors
from pipelines.keypoints.calibration import measured_for, read_calibration
from pipelines.reconstruct import Settings, reconstruct
from pipelines.reconstruction.background import refine_cameras
from pipelines.reconstruction.background_tracks import load_stills, load_tracks
from pipelines.reconstruction.ground import bind_positions
from pipelines.reconstruction.loading import load_cameras
from pipelines.reconstruction.observations import Camera
from pipelines.reconstruction.trials import disturbances, disturbed
from pipelines.session.description import Interpolation, read_description
from pipelines.session.stages import locked

NOISE = "white:position_m=0.02,rotation_deg=0.2+bias:position_m=0.05,rotation_deg=0.3"


def main() -> None:
    """Print a row for each flight and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sessions", nargs="+", type=Path, metavar="SESSION")
    parser.add_argument("--noise", default=NOISE)
    parser.add_argument("--draws", type=int, default=2)
    arguments = parser.parse_args()
    print("| flight | draw | patches that agree | between cameras, log mm | bound mm | NEES | processor s |")
    print("|" + " --- |" * 7)
    for session in arguments.sessions:
        for draw in range(arguments.draws):
            print(row_of(session, arguments.noise, draw), flush=True)


def row_of(folder: Path, noise: str, draw: int) -> str:
    """Measure one draw of a flight; return its row of the table."""
    reconstruct(folder, Settings(method="robust", refine_cameras="background", pose_noise=noise))
    description = read_description(folder)
    with locked(folder) as session:
        detected = session.intact_record("detect")
    assert detected is not None
    measured = measured_for(detected.settings["detector"])
    true, _ = load_cameras(
        folder,
        description,
        detected,
        min_confidence=Settings.min_confidence,
        pose_noise=noise,
        calibrated=read_calibration(measured).probabilities if measured else None,
    )
    models = disturbances(noise, 1)
    assert models is not None
    followed = {camera.name: load_tracks(folder, camera) or "it was not followed" for camera in true}
    stills = {camera.name: each for camera in true if (each := load_stills(folder, camera)) is not None}
    between = description.pose_interpolation
    logged = disturbed(true, models, 0, draw)
    refined, _, _ = refine_cameras(logged, followed, [pose_errors(models)] * len(true), between=between)
    began = time.process_time()
    binding = bind_positions(refined, followed, stills, between=between)
    spent = time.process_time() - began
    before, after = (_apart(cameras, true, between) for cameras in (refined, binding.cameras))
    sigma = [each["against_the_others"] for each in binding.entry["position_sigma_m"].values()]
    patches = sum(each["agree"] for each in binding.entry["patches"])
    nees = "-"
    if None not in sigma:
        nees = f"{(after**2).sum() / np.mean(np.square(sigma)) / (3 * (len(true) - 1)):.1f}"
    return (
        f"| {folder.name} | {draw} | {patches} | {_length_mm(before):.0f} | {_length_mm(after):.1f} | {nees} "
        f"| {spent:.1f} |"
    )


def _apart(cameras: Sequence[Camera], true: Sequence[Camera], between: Interpolation) -> Float:
    """Compute each camera's mean position error [C, 3] m, without the mean of all cameras."""
    offsets = []
    for camera, exact in zip(cameras, true, strict=True):
        t_ns = camera.trajectory.t_ns
        apart = camera.poses_at(t_ns, between)[0] - exact.poses_at(t_ns, between)[0]
        offsets.append(np.nanmean(apart, axis=0))
    return np.asarray(offsets - np.mean(offsets, axis=0), dtype=np.float64)


def _length_mm(vectors: Float) -> float:
    return float(1e3 * np.sqrt((vectors**2).sum(axis=1).mean()))


if __name__ == "__main__":
    main()
