"""Errors of a keypoint detector that sees people from above, by tilt, on rendered flights.

python tools/detector_errors.py [--detectors NAME ...] [--folder FOLDER] [--write]

For every tilt four people walk on level ground while a drone circles each of them once at 10 m, filming
1280x720 with a field of view of 80 degrees. The flights go through `mocap simulate`, `ingest` and the
detection of `reconstruct`, like a user's. The pictures are rendered; the detector is real. `--write` writes
two data files for each detector: its errors for the simulation, and the calibration of its confidences to
probabilities.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import isotonic_regression

from pipelines.detect import detect
from pipelines.geometry.arrays import Float
from pipelines.ingest import ingest
from pipelines.keypoints.corrections import ANY_JOINT as ANY_GROUP
from pipelines.keypoints.corrections import COLUMNS as CALIBRATED
from pipelines.keypoints.corrections import file_of
from pipelines.session.people import get_skeleton
from pipelines.session.registries import find_detector
from pipelines.session.stages import locked
from pipelines.simulate import simulate
from pipelines.simulation.detector_errors import ANY_JOINT, COLUMNS, MODELLED, errors_of, see, view_of
from pipelines.simulation.flight import fly_scenario
from pipelines.simulation.scenario import read_scenario

TILTS_DEG = (0, 15, 30, 45, 60)
LOOKS = (
    "{sex: male, height_m: 1.78, build: average, outfit: casual}",
    "{sex: female, height_m: 1.66, build: slim, outfit: sport}",
    "{sex: male, height_m: 1.84, build: heavy, outfit: dark}",
    "{sex: female, height_m: 1.72, build: average, outfit: bright}",
)
SECONDS, RATE_HZ = 12, 10
COMMAND = "python tools/detector_errors.py --write"
JOINTS = get_skeleton("coco17").joints
MIN_KEYPOINTS = 20  # a knot of so many is known to about 0.1
GOOD = 0.05  # of the person's height
GROSS = 0.1  # of the person's height: beyond that a joint counts as missed
SOMEBODY_ELSE = 0.5  # of the person's height: a detection further away is not the actor's


@dataclass(frozen=True)
class Sightings:
    """Errors of all joints of one flight, frame by frame."""

    error_px: Float  # [F, J], NaN where not found
    height_px: Float  # [F] f H / d
    confidence: Float  # [F, J]
    tilt_deg: Float  # [F]


def main() -> None:
    """Simulate, detect, compare; print the errors by tilt, and write the data on request."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--detectors", nargs="+", choices=MODELLED, default=MODELLED)
    parser.add_argument("--folder", type=Path, help="keep the flights there")
    parser.add_argument("--write", action="store_true", help="write the data of these detectors")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in options.detectors:
            detector = find_detector(name)
            print(f"\n{name}: {detector.title}")
            if None in detector.models().values():
                print(f"not measured: run `mocap models fetch {name}`")
                continue
            by_tilt = {t: [measure(folder, name, t, k) for k in range(len(LOOKS))] for t in TILTS_DEG}
            for row in table_rows(by_tilt):
                print(*row)
            if options.write:
                write_table(name, by_tilt)
                write_calibration(name, by_tilt)


def scenario_text(tilt_deg: int, look: int) -> str:
    """Write a scenario with one person and one drone."""
    return f"""\
schema: 1
name: Tilt {tilt_deg} look {look}
seed: {100 * tilt_deg + look}
duration_s: {SECONDS}
actor:
  body: {LOOKS[look]}
  motion: {{steps: [walk: {{distance_m: 12.5, turn_deg: {90 - 60 * look}}}], repeat: true}}
  estimate_sigma_m: 0.1
drones:
  count: 1
  formation: {{tilt_deg: {tilt_deg}, yaw_deg: {25 * look}, yaw_rate_deg_per_s: {360 / SECONDS}}}
  limits: {{speed_mps: 20, acceleration_mps2: 20}}
  camera: {{rate_hz: {RATE_HZ}}}
"""


def measure(folder: Path, detector: str, tilt_deg: int, look: int) -> Sightings:
    """Simulate one flight, run a detector on its video, compare with the truth."""
    path = folder / f"tilt{tilt_deg}-{look}.yaml"
    path.write_text(scenario_text(tilt_deg, look), encoding="utf-8")
    flight_folder = path.with_suffix("")
    simulate(path, flight_folder, workers=2)
    session = ingest(flight_folder / "flight.yaml").folder
    with locked(session) as writable:
        detect(writable, detector=detector, workers=2)
    found = pd.read_parquet(session / "detect" / "drone1" / "keypoints.parquet")

    flight = fly_scenario(read_scenario(path), [])
    drone, person = flight.drones[0], flight.people[0]
    truth, rows = drone.at_frames, flight.moments_of(drone)
    pixels = see(person.joints[rows], truth.camera_position, truth.camera_quaternion_xyzw, drone.intrinsics)
    tilt, height_px = view_of(
        truth.camera_position,
        person.motion.root[rows],
        height_m=person.look.body.height_m,
        focal_px=drone.intrinsics.fx,
    )
    error, confidence = compare(found, pixels, height_px)
    return Sightings(error, height_px, confidence, tilt)


def compare(found: pd.DataFrame, pixels: Float, height_px: Float) -> tuple[Float, Float]:
    """Compute errors (px) and confidences [F, J] of the detection nearest to the actor in each frame."""
    error = np.full(pixels.shape[:2], np.nan)
    confidence = np.full(pixels.shape[:2], np.nan)
    for _, person in found.groupby(["frame", "person"], sort=True):
        frame = int(person["frame"].iloc[0])
        by_joint = person.set_index("joint").reindex(JOINTS)
        distance = np.sqrt(((by_joint[["x", "y"]].to_numpy() - pixels[frame]) ** 2).sum(axis=-1))
        middle = np.nanmedian(distance) if np.isfinite(distance).any() else np.inf
        before = np.nanmedian(error[frame]) if np.isfinite(error[frame]).any() else np.inf
        if middle < SOMEBODY_ELSE * height_px[frame] and middle < before:
            error[frame], confidence[frame] = distance, by_joint["confidence"].to_numpy()
    return error, confidence


def write_table(detector: str, by_tilt: dict[int, list[Sightings]]) -> None:
    """Write the data of the simulator: every joint by itself, and all joints together."""
    lines = [line for line in (__doc__ or "").splitlines() if line and not line.startswith("python")]
    with errors_of(detector).open("w", encoding="utf-8", newline="") as file:
        file.writelines(f"# {line}\n" for line in lines)
        file.write(f"# The detector: {find_detector(detector).title}\n")
        file.write(f"# Made by: {COMMAND}\n")
        file.write(
            "# median_error_share: of the person's height f H / d. missed_share: not found, or further\n"
        )
        file.write(f"#   off than {GROSS} of that height. confidence: mean of the joints found.\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(table_rows(by_tilt))


def write_calibration(detector: str, by_tilt: dict[int, list[Sightings]]) -> None:
    """Fit the probabilities of confidences over all tilts together, and write them by group of joints."""
    flights = [flight for own in by_tilt.values() for flight in own]
    share = np.concatenate([flight.error_px / flight.height_px[:, None] for flight in flights])
    confidence = np.concatenate([flight.confidence for flight in flights])
    with file_of(detector).open("w", encoding="utf-8", newline="") as file:
        good = f"within {100 * GOOD:g} % of the person's height in the picture"
        file.write(f"# made by: {COMMAND}\n# probability that a joint is {good}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CALIBRATED)
        for group in (ANY_GROUP, "ankle", "ear", "eye", "hip", "knee", "wrist"):
            of = [j for j, joint in enumerate(JOINTS) if group in (ANY_GROUP, joint.split("_")[-1])]
            raw, near = confidence[:, of].ravel(), (share <= GOOD)[:, of].ravel()
            found = np.isfinite(raw) & (raw > 0)
            for level, probability, count in knots_of(raw[found], near[found].astype(np.float64)):
                writer.writerow([group, f"{level:.6g}", f"{probability:.6g}", int(count)])


def knots_of(confidence: Float, outcome: Float) -> Float:
    """Compute knots [K, 3]: mean confidence, probability and count of each block of at least 20 keypoints.

    Equal confidences are pooled first. Consecutive ones are pooled to at least 20, because small blocks at
    either end would otherwise have probabilities of 0 and 1.
    """
    level, inverse = np.unique(confidence, return_inverse=True)
    count = np.bincount(inverse).astype(np.float64)
    good = np.bincount(inverse, weights=outcome)
    begun = (np.cumsum(count) - count) // MIN_KEYPOINTS
    bins = np.minimum(begun, max(count.sum() // MIN_KEYPOINTS - 1, 0)).astype(int)
    _, bins = np.unique(bins, return_inverse=True)
    total, middle, share = (
        np.bincount(bins, weights=w).astype(np.float64) for w in (count, count * level, good)
    )
    fitted = isotonic_regression(share / total, weights=total)
    firsts, pooled = fitted.blocks[:-1], fitted.weights
    return np.column_stack([np.add.reduceat(middle, firsts) / pooled, fitted.x[firsts], pooled])


def table_rows(by_tilt: dict[int, list[Sightings]]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the data, joint by joint."""
    for j, joint in [(slice(None), ANY_JOINT), *((slice(k, k + 1), name) for k, name in enumerate(JOINTS))]:
        for flights in by_tilt.values():
            tilt = np.concatenate([f.tilt_deg for f in flights]).mean()  # as flown
            share = np.concatenate([(f.error_px / f.height_px[:, None])[:, j].ravel() for f in flights])
            confidence = np.concatenate([f.confidence[:, j].ravel() for f in flights])
            good = share <= GROSS  # not where it is NaN
            yield (
                f"{tilt:.1f}",
                joint,
                f"{np.median(share[good]):.4f}",
                f"{1 - good.mean():.4f}",
                f"{np.mean(confidence[good]):.3f}",
            )


if __name__ == "__main__":
    main()
