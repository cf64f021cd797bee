"""Things among the detections that are dropped, and people that are lost: `python -m benchmarks.no_people`.

Detections are made twice: as the stage makes them, and as with a model whose confidences do not separate
people from things (`any`): all tiles of a picture are searched in every second picture, and nothing is
dropped by score. Then things are dropped by the ground and the other cameras (`keypoints/no_people.py`).

- the sample flight (`sample_data/mound_walk`), rendered, two drones, one person, trees on a mound and a map;
- a wood, rendered, three drones, two people who are 4 m from trees or more, and a map;
- the same flights without their maps;
- Pose2Sim's demo, real, four still cameras, a person and a bystander: see `benchmarks.detectors`.

A detection is a person's where the median distance of its joints from the true ones is below 0.4 of the
diagonal of the true joints' box. The real recording has no truth; its detections are counted as unknown.
"""

import argparse
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.detectors import DETECTORS, REAL, SAMPLE, real_flight
from pipelines import detect as stage
from pipelines.attempt import find_people, ground_of
from pipelines.geometry.arrays import Bool
from pipelines.ingest import ingest
from pipelines.keypoints import association, tracking
from pipelines.keypoints.blazepose import BlazePose
from pipelines.keypoints.calibration import measured_for, read_calibration
from pipelines.keypoints.no_people import Scene, tell_no_people
from pipelines.reconstruction.loading import load_cameras, load_truth
from pipelines.reconstruction.observations import Candidates
from pipelines.session.description import Description, read_description
from pipelines.session.people import logged_people, true_joints_at
from pipelines.session.stages import locked
from pipelines.simulate import simulate

PERSON = 0.4  # of the diagonal of the true joints' box
WOOD = """\
schema: 1
name: Wood
seed: 3
duration_s: 10
actors:
  ann:
    body: {sex: female, height_m: 1.66, build: slim, outfit: sport}
    start: [-4, -1]
    motion: [walk: {to: [4, 0], speed_mps: 1.0}]
    estimate_sigma_m: 0.15
  bob:
    body: {sex: male, height_m: 1.84, build: heavy, outfit: dark}
    start: [3, 3]
    motion: [walk: {to: [-3, 2], speed_mps: 0.9}]
    estimate_sigma_m: 0.15
world:
  ground: {size_m: 80}
  wood: {count: 30, radius_m: 26, clear_m: 4}
  map: {resolution_m: 0.25, height_m: 12}
drones:
  count: 3
  formation: {radius_m: 10, tilt_deg: 15, yaw_rate_deg_per_s: 8}
  camera: {rate_hz: 10}
  pose_noise: {white: {position_m: 0.02, rotation_deg: 0.2}, bias: {position_m: 0.05, rotation_deg: 0.3}}
"""


def main() -> None:
    """Print the table of docs/detector.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detectors", nargs="+", default=DETECTORS, help="as `--detector` takes them")
    parser.add_argument("--folder", type=Path, help="keep the flights and sessions there")
    arguments = parser.parse_args()
    print("| detector | recording | search | ground | people | things | by the ground | alone | kept |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory(prefix="mocap-") as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for detector in arguments.detectors:
            for name, manifest, every in flights(folder):
                for search in ("usual", "any"):
                    session = folder / f"{name}-{detector}-{search}.session"
                    ingest(manifest, session)
                    with locked(session) as writable, searching(search):
                        stage.detect(writable, detector=detector, people=3, every=every)
                    print_rows(session, detector, name, search)


def flights(folder: Path) -> Iterator[tuple[str, Path, int]]:
    """Yield each recording's name, manifest, and which pictures of it are looked at: every k-th."""
    yield "sample", SAMPLE / "flight.yaml", 6
    scenario = folder / "wood.yaml"
    scenario.write_text(WOOD, encoding="utf-8")
    simulate(scenario, folder / "wood", workers=2)
    yield "wood", folder / "wood" / "flight.yaml", 2
    if REAL.is_dir():
        yield "real", real_flight(folder), 5


@contextmanager
def searching(search: str) -> Iterator[None]:
    """Let the stage search everywhere, and drop nothing by score, if that is asked for."""
    if search == "usual":
        yield
        return
    everywhere = partial(tracking.PeopleTracker, search_every=2)
    with (
        patch.object(stage, "PeopleTracker", everywhere),
        patch.object(BlazePose, "person_confidence", 0.0),
        patch.multiple(tracking, _TILES_BESIDE=1000, _SURE=0.0),
    ):
        yield


def print_rows(session: Path, detector: str, name: str, search: str) -> None:
    """Print the rows of one session: with its map, if it has one, and without."""
    description = read_description(session)
    with locked(session) as held:
        detected = held.intact_record("detect")
    measured = measured_for(detector)
    cameras, _ = load_cameras(
        session,
        description,
        detected,
        min_confidence=0.3,
        pose_noise=None,
        calibrated=read_calibration(measured).probabilities if measured else None,
    )
    actors = logged_people(session, description)
    fields = np.array([camera.field for camera in cameras])
    for known in [description, replace_map(description)] if description.map else [description]:
        ground = ground_of(session, known, actors[0] if actors else None)
        kind = "map" if known.map else "log" if actors else "people"
        with patch.object(association, "tell_no_people", wraps=tell_no_people) as telling:
            found, _, _ = find_people(
                cameras, description.pose_interpolation, actors, people=3, scene=Scene(ground, fields)
            )
        arguments = telling.call_args.args
        seen, things = arguments[0], tell_no_people(*arguments)
        there = seen.track >= 0
        person = people_in(session, description, found, cameras[0].detections.joints)
        cells = [
            f"{(which & there).sum()}"
            if person is None
            else f"{(which & person & there).sum()} / {(which & there & ~person).sum()}"
            for which in things
        ]
        counts = (
            f"{there.sum()} unknown |"
            if person is None
            else f"{(there & person).sum()} | {(there & ~person).sum()}"
        )
        print(f"| {detector} | {name} | {search} | {kind} | {counts} | {' | '.join(cells)} |", flush=True)


def replace_map(description: Description) -> Description:
    """Return the description of the same flight without a map."""
    return description.model_copy(update={"map": None})


def people_in(
    session: Path, description: Description, found: Candidates, joints: tuple[str, ...]
) -> Bool | None:
    """Mark the detections [T, C, D] that are of people; None without truth."""
    truth = load_truth(session, description, joints)
    if truth is None:
        return None
    position = true_joints_at(truth, found.t_ns)
    person = np.zeros(found.confidence.shape[:3], np.bool_)
    for c in range(found.confidence.shape[1]):
        inside = np.einsum(
            "tji,tpkj->tpki", found.rotation[:, c], position - found.position[:, c, None, None]
        )
        with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
            warnings.simplefilter("ignore", RuntimeWarning)  # nobody there, or behind the camera
            pixels = np.where(inside[..., 2:] > 0, inside[..., :2] / inside[..., 2:], np.nan)
            size = np.linalg.norm(np.nanmax(pixels, axis=2) - np.nanmin(pixels, axis=2), axis=-1)  # [T, P]
            apart = np.linalg.norm(found.rays[:, c, :, None] - pixels[:, None], axis=-1)  # [T, D, P, J]
            near = np.nanmedian(apart, axis=-1) < PERSON * size[:, None]
        person[:, c] = near.any(axis=-1)
    return person


if __name__ == "__main__":
    main()
