"""Errors of a keypoint detector that sees people from above, by tilt, on rendered flights.

python -m benchmarks.detector_by_tilt [--detectors NAME ...] [--folder FOLDER] [--write] [--film]

For every tilt four people walk on level ground while a drone circles each of them once at 10 m, filming
1280x720 with a field of view of 80 degrees. The flights go through `mocap simulate`, `ingest` and the
detection of `reconstruct`, like a user's. The pictures are rendered; the detector is real. `--write` writes
two data files for each detector: its errors for the simulation, and the calibration of its confidences to
probabilities.

`--film` measures something else: the cost of blur, readout, distortion and bit rate of a drone's film, in
errors of the default detector and of the skeleton with true poses. One flight of three drones is filmed in
each of these ways.
"""

from __future__ import annotations

import argparse
import csv
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import rankdata

from pipelines.detect import detect
from pipelines.geometry.arrays import Float, Int64
from pipelines.ingest import ingest
from pipelines.keypoints import calibration
from pipelines.keypoints.calibration import (
    Calibration,
    fit,
    measured_for,
    read_calibration,
    write_calibration,
)
from pipelines.keypoints.swaps import undo_swaps_of_tracks
from pipelines.reconstruct import reconstruct
from pipelines.session.registries import find_detector
from pipelines.session.skeletons import get_skeleton
from pipelines.session.stages import locked
from pipelines.session.tables import detections_from, keypoints_table
from pipelines.simulate import simulate
from pipelines.simulation.detector_errors import ANY_JOINT, COLUMNS, MODELLED, errors_of, see, view_of
from pipelines.simulation.flight import fly_scenario, visible_joints
from pipelines.simulation.scenario import BITS_PER_PIXEL, DISTORTION, read_scenario

TILTS_DEG = (0, 15, 30, 45, 60)
LOOKS = (
    "{sex: male, height_m: 1.78, build: average, outfit: casual}",
    "{sex: female, height_m: 1.66, build: slim, outfit: sport}",
    "{sex: male, height_m: 1.84, build: heavy, outfit: dark}",
    "{sex: female, height_m: 1.72, build: average, outfit: bright}",
)
SECONDS, RATE_HZ = 12, 10
COMMAND = "python -m benchmarks.detector_by_tilt --write"
JOINTS = get_skeleton("coco17").joints
TORSO = (JOINTS.index("left_shoulder"), JOINTS.index("right_hip"))
PCK = 0.2  # of the torso's length in the picture
FILMS: Mapping[str, Mapping[str, object] | None] = {
    "none of it": {},
    "exposure 2 ms (1/500 s)": {"exposure_ms": 2},
    "exposure 4 ms (1/250 s)": {"exposure_ms": 4},
    "readout 20 ms": {"readout_ms": 20},
    "distortion": {"distortion": DISTORTION},
    "bit rate of schema 2": {"bitrate_mbps": BITS_PER_PIXEL * 1280 * 720 * 30 / 1e6},
    "1 Mbit/s": {"bitrate_mbps": 1},
    "all of schema 2": None,
}
"""Keys of `drones.camera` by way of filming; None takes schema 2 as it is."""
USED = 0.3  # least probability of a keypoint that `reconstruct` uses
GOOD = 0.05  # of the person's height
GROSS = 0.1  # of the person's height: beyond that a joint counts as missed
SOMEBODY_ELSE = 0.5  # of the person's height: a detection further away is not the actor's


@dataclass(frozen=True)
class Sightings:
    """Errors of all joints of one flight, frame by frame."""

    error_px: Float  # [F, J], NaN where not found
    height_px: Float  # [F] f H / d
    torso_px: Float  # [F]
    confidence: Float  # [F, J]
    tilt_deg: Float  # [F]
    with_swaps_px: Float  # [F, J] errors of the joints that `reconstruct` would use
    without_swaps_px: Float  # [F, J] the same after swaps of left and right are undone


def main() -> None:
    """Simulate, detect, compare, print; write the data on request."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--detectors", nargs="+", choices=MODELLED, default=MODELLED)
    parser.add_argument("--folder", type=Path, help="keep the flights there")
    parser.add_argument("--write", action="store_true", help="write the data of these detectors")
    parser.add_argument("--film", action="store_true", help="compare ways of filming instead")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if options.film:
            print_film({name: film(folder, name, camera) for name, camera in FILMS.items()})
            return
        for name in options.detectors:
            detector = find_detector(name)
            print(f"\n{name}: {detector.title}")
            if None in detector.models().values():
                print(f"not measured: run `mocap models fetch {name}`")
                continue
            by_tilt = {t: [measure(folder, name, t, k) for k in range(len(LOOKS))] for t in TILTS_DEG}
            print_table(by_tilt)
            print_separation(by_tilt)
            print_swaps([flight for flights in by_tilt.values() for flight in flights])
            if options.write:
                write_table(name, by_tilt)
                write_calibration(calibration.file_of(name), calibrated(by_tilt))


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
    used = found[probability(found, detector) >= USED]
    with_swaps, _ = compare(used, pixels, height_px)
    without, _ = compare(without_swaps(used, truth.t_ns), pixels, height_px)
    torso = np.sqrt(((pixels[:, TORSO[0]] - pixels[:, TORSO[1]]) ** 2).sum(axis=-1))
    return Sightings(error, height_px, torso, confidence, tilt, with_swaps, without)


def probability(found: pd.DataFrame, detector: str) -> Float:
    """Convert confidences to probabilities by the previous calibration; keep them raw without one."""
    confidence = found["confidence"].to_numpy(np.float64)
    measured = measured_for(detector)
    if measured is None:
        return confidence
    return read_calibration(measured).probabilities(confidence, found["joint"].to_numpy(str))


def without_swaps(found: pd.DataFrame, frame_t_ns: Int64) -> pd.DataFrame:
    """Undo exchanges of left and right in detections, as `reconstruct` does."""
    detections = detections_from(found, tuple(dict.fromkeys(found["joint"])))
    undone, _ = undo_swaps_of_tracks(detections, frame_t_ns)
    return keypoints_table(undone, np.arange(len(frame_t_ns)), frame_t_ns)


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


# --- ways of filming -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Film:
    """Errors of the detector and of `reconstruct` with one way of filming."""

    error_px: Float  # [F, J] of all drones, NaN where not found
    height_px: Float  # [F]
    torso_px: Float  # [F]
    mbps: float  # of the video files, mean
    mpjpe_mm: float
    measured_share: float
    unstated_mm: float | None  # where flight.yaml does not state the readout


def film_text(camera: Mapping[str, object] | None) -> str:
    """Write a scenario in which a person jogs and three drones circle at 8 m."""
    switched = "" if camera is None else ", ".join(f"{name}: {value}" for name, value in camera.items())
    return f"""\
schema: {2 if camera is None else 1}
name: Film
seed: 7
duration_s: 3
actor:
  motion: [jog: {{distance_m: 12, speed_mps: 2.8, turn_deg: 150}}]
  estimate_sigma_m: 0.1
drones:
  count: 3
  formation: {{radius_m: 8, tilt_deg: 20, yaw_rate_deg_per_s: 30}}
  limits: {{speed_mps: 20, acceleration_mps2: 20}}
  camera: {{{switched}}}
"""


def film(folder: Path, name: str, camera: Mapping[str, object] | None) -> Film:
    """Film the flight, run the detector, reconstruct with the true poses."""
    path = folder / f"{re.sub('[^a-z0-9]+', '-', name.lower())}.yaml"
    path.write_text(film_text(camera), encoding="utf-8")
    made = path.with_suffix("")
    simulate(path, made, workers=2)
    manifest = made / "true_poses.yaml"
    session = ingest(manifest).folder
    metrics = reconstruct(session, workers=2).metrics
    unstated_mm = None
    if "readout_s" in manifest.read_text(encoding="utf-8"):
        other = made / "readout_not_stated.yaml"
        text = re.sub("readout_s: [0-9.]+", "readout_s: 0", manifest.read_text(encoding="utf-8"))
        other.write_text(text, encoding="utf-8")
        unstated_mm = reconstruct(ingest(other).folder, workers=2).metrics["mpjpe_mm"]

    flight = fly_scenario(read_scenario(path), [])
    person = flight.people[0]
    errors, heights, torsos, mbps = [], [], [], []
    for drone in flight.drones:
        pixels, _ = visible_joints(flight, drone, person)
        found = pd.read_parquet(session / "detect" / drone.name / "keypoints.parquet")
        _, height_px = view_of(
            drone.at_frames.camera_position,
            person.motion.root[flight.moments_of(drone)],
            height_m=person.look.body.height_m,
            focal_px=drone.intrinsics.fx,
        )
        errors.append(compare(found, pixels, height_px)[0])
        heights.append(height_px)
        torsos.append(np.sqrt(((pixels[:, TORSO[0]] - pixels[:, TORSO[1]]) ** 2).sum(axis=-1)))
        mbps.append(8e-6 * (made / f"{drone.name}.mp4").stat().st_size / flight.scenario.duration_s)
    return Film(
        np.concatenate(errors),
        np.concatenate(heights),
        np.concatenate(torsos),
        float(np.mean(mbps)),
        metrics["mpjpe_mm"],
        metrics["reconstructed_share"],
        unstated_mm,
    )


def print_film(films: Mapping[str, Film]) -> None:
    """Print the table of ways of filming for docs/detector.md."""
    print("| film | Mbit/s | found | px mean | px median | %H median | PCK@0.2 torso | MPJPE mm | measured |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, own in films.items():
        error, seen = own.error_px, np.isfinite(own.error_px).any(axis=1)
        right = np.nan_to_num(error, nan=np.inf) <= PCK * own.torso_px[:, None]
        unstated = "" if own.unstated_mm is None else f" ({own.unstated_mm:.1f} with the readout not stated)"
        print(
            f"| {name} | {own.mbps:.1f} | {100 * seen.mean():.1f} % | {np.nanmean(error):.2f} | "
            f"{np.nanmedian(error):.2f} | {100 * np.nanmedian(error / own.height_px[:, None]):.2f} | "
            f"{100 * right.mean():.1f} % | {own.mpjpe_mm:.1f}{unstated} | {100 * own.measured_share:.1f} % |"
        )


# --- tables --------------------------------------------------------------------------------------------


def print_table(by_tilt: dict[int, list[Sightings]]) -> None:
    """Print the table of docs/detector.md."""
    print("| tilt deg | pictures | found | px mean | px median | %H median | PCK@0.2 torso | confidence |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for flights in by_tilt.values():
        error = np.concatenate([flight.error_px for flight in flights])
        height = np.concatenate([flight.height_px for flight in flights])[:, None]
        torso = np.concatenate([flight.torso_px for flight in flights])[:, None]
        confidence = np.concatenate([flight.confidence for flight in flights])
        tilt = np.concatenate([flight.tilt_deg for flight in flights])
        seen = np.isfinite(error).any(axis=1)
        right = np.nan_to_num(error, nan=np.inf) <= PCK * torso
        print(
            f"| {round(tilt.mean())} | {len(error)} | {100 * seen.mean():.1f} % | {np.nanmean(error):.1f} | "
            f"{np.nanmedian(error):.1f} | {100 * np.nanmedian(error / height):.2f} | "
            f"{100 * right.mean():.1f} % | {np.nanmean(confidence):.2f} |"
        )


def print_separation(by_tilt: dict[int, list[Sightings]]) -> None:
    """Print how well the confidence separates bad keypoints from good ones: the area under the ROC curve."""
    flights = [flight for own in by_tilt.values() for flight in own]
    share = np.concatenate([flight.error_px / flight.height_px[:, None] for flight in flights]).ravel()
    confidence = np.concatenate([flight.confidence for flight in flights]).ravel()
    found = np.isfinite(share) & (confidence > 0)
    bad = share[found] > GOOD
    rank = rankdata(-confidence[found])
    pairs = float(bad.sum()) * float((~bad).sum())
    area = (rank[bad].sum() - bad.sum() * (bad.sum() + 1) / 2) / pairs
    print(f"errors above {100 * GOOD:g} % of the height by confidence: area under the ROC curve {area:.2f}")


def print_swaps(flights: list[Sightings]) -> None:
    """Print the effect of undoing swaps: joints that move by more than half a pixel, and the mean error."""
    before = np.concatenate([flight.with_swaps_px for flight in flights])
    after = np.concatenate([flight.without_swaps_px for flight in flights])
    gain = before - after
    print(
        f"swaps undone: {(gain > 0.5).sum()} joints nearer to the truth, {(gain < -0.5).sum()} further away;"
        f" mean error {np.nanmean(before):.2f} -> {np.nanmean(after):.2f} px"
    )


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


def calibrated(by_tilt: dict[int, list[Sightings]]) -> Calibration:
    """Fit the calibration of confidences over all tilts together."""
    flights = [flight for own in by_tilt.values() for flight in own]
    share = np.concatenate([flight.error_px / flight.height_px[:, None] for flight in flights])
    return fit(
        np.concatenate([flight.confidence for flight in flights]),
        share <= GOOD,
        JOINTS,
        groups=("eye", "ear", "wrist", "hip", "knee", "ankle"),
        origin=COMMAND,
        good=f"within {100 * GOOD:g} % of the person's height in the picture",
    )


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
