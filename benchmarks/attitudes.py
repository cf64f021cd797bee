"""Attitudes from pictures on rendered flights: `python -m benchmarks.attitudes`.

The points that were followed through the films of the corpus are mapped once for each moving camera, by the
same calls as `mocap ingest` with `pose.attitude: pictures`. The camera's true places are then disturbed many
times, as two kinds of logs (`LOGS`) would.

`off` is the root mean square angle, over draws and key pictures, from the truth. `bound` is that of an
unbiased estimate that knows the path's shape and how attitudes differ (Cramér and Rao, of a similarity on
places and a horizon level to 2 deg; satellite places tell less than the true horizon, which is level).
`NEES` is the mean squared common error over its mean variance by axis, 3 where right.

`--used` reconstructs flights in turn with attitudes by pictures, and with logged ones (`TURNED`) on the same
places. Ratios are of root-relative errors: of the means, and by draw. NEES is of joints. `off` is the root
mean square angle of the estimated attitudes from the true ones, over cameras and draws.

`--joined` takes the places away, too (`pose: pictures`, stature stated). `off` is then that of the cameras'
mean attitudes after one similarity; joints are compared in true axes, with their own scale.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.corpus.drawn import DrawnFlight, kept_in_place_of_pictures
from benchmarks.corpus.stored import Flight, flights, read_backgrounds, read_keypoints
from benchmarks.results import markdown_table, parser_of, show
from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import disturb, pose_errors
from pipelines.geometry.poses import (
    conjugate,
    cross_matrix,
    interpolate_poses,
    matrix_from_quaternion,
    multiply,
    rotation_vector_from_quaternion,
)
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.reconstruction.background_tracks import Tracks
from pipelines.reconstruction.picture_map import (
    JOINED,
    LEVEL_SIGMA_DEG,
    NoAttitudesError,
    PictureMap,
    first_similarity,
    followed_features,
    key_rows,
    lay_on_places,
    map_pictures,
    position_covariance,
)
from pipelines.session.camera_poses import noise_models
from pipelines.session.errors import DataError
from pipelines.session.progress import Silent
from pipelines.session.records import Trajectory
from pipelines.session.tables import CAMERA_POSES, detections_from, read_table
from pipelines.simulation.flight import SimulatedDrone
from pipelines.simulation.flight_files import write_tum
from pipelines.sources.attitudes import FilmOfCamera, UnposedCamera, posed_by_people, turned_by_pictures
from pipelines.sources.parts import CameraFrames

TUNED = ("01-walk", "02-jog", "06-turn", "07-jog", "15-two-people", "16-two-people", "05-dance")
KEPT = ("08-walk", "14-dance", "24-two-people-dance", "18-stand")
"""Flights that no constant was chosen on. The last of each half hovers."""
Noise = dict[str, dict[str, float | str]]
LOGS: dict[str, tuple[Noise, float]] = {
    "rtk": ({"white": {"position_m": 0.02}, "bias": {"position_m": 0.05}}, 0.1),
    "gps": ({"gauss-markov": {"position_m": 1.5, "correlation_s": 100}}, 1.0),
}
"""Errors of places, and the time between two of them, s."""
TURNED: Noise = {"white": {"rotation_deg": 0.2}, "bias": {"rotation_deg": 0.5}}
FAR: Noise = {"white": {"rotation_deg": 0.2}, "bias": {"rotation_deg": 20.0}}
"""Errors of logged attitudes, stated: usual ones, and those of a mount that nobody knows."""
USED = {"rtk": ("rtk", None), "gps": ("gps", None), "rtk, 20 deg off": ("rtk", FAR)}
"""Logs of `--used`, and errors of their attitudes, None where pictures show these."""
NO_FILM = FilmOfCamera("", nullcontext)  # type: ignore[arg-type]  # the maps are kept: nobody opens it
JOINED_FLIGHTS = "07-jog", "23-jog-and-crouch", "02-jog", "08-walk", "16-two-people"
"""Flights of three drones that move; the first two were tuned on."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--kept", action="store_true", help="measure on the flights that are kept aside")
    parser.add_argument("--flights", nargs="+", help="names, instead of all of that half")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--used", nargs="*", choices=USED, help="reconstruct with them (all logs by default)")
    parser.add_argument("--joined", action="store_true", help="take the places away, too")


def run(options: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Map, and compare with the truth."""
    if options.joined:
        columns = ["flight", "off deg", "NEES", "lengths %", "root-relative mm: logged, not"]
        yield "joined", markdown_table(columns, [joined(name) for name in options.flights or JOINED_FLIGHTS])
        return
    names = options.flights or (KEPT if options.kept else TUNED)
    if options.used is not None:
        columns = [
            "log",
            "reconstructed",
            "logged, other mm",
            "ratio",
            "by draw: median, largest",
            "NEES",
            "off",
        ]
        # Of two people without logs, either may be the only one.
        alone = [e.name for e in flights() if e.name in names[:-1] and len(e.scenario.people) == 1]
        rows = [used(options.flights or alone, log, options.draws) for log in options.used or USED]
        yield f"attitudes-used-{'kept' if options.kept else 'tuned'}", markdown_table(columns, rows)
        return
    heading = ["flight", "camera", "moves m", "refused", "rtk: off (bound)", "NEES", "gps: off deg", "NEES"]
    rows = [row for name in names for row in measured(name, options.draws)]
    yield "attitudes-kept" if options.kept else "attitudes-tuned", markdown_table(heading, rows)


def measured(name: str, draws: int) -> Iterator[list[str]]:
    """Measure every camera of a flight."""
    (flight,) = [each for each in flights() if each.name == name]
    backgrounds = read_backgrounds(flight)
    with TemporaryDirectory() as folder:
        drones = DrawnFlight(flight, Path(folder)).simulated.drones
    for drone in drones:
        path = drone.at_frames.camera_position
        row = [name, drone.name, f"{np.linalg.norm(path[-1] - path[0]):.1f}"]
        try:
            found = _map_of(drone, backgrounds[drone.name].tracks)
        except NoAttitudesError:
            yield [*row, "not mapped", *4 * ["-"]]
            continue
        figures = [_figures(found, drone, *log, draws) for log in LOGS.values()]
        row.append(f"{sum(refused for refused, *_ in figures)}/{len(figures) * draws}")
        yield row + [text for _, *texts in figures for text in texts]


def _figures(
    found: PictureMap, drone: SimulatedDrone, noise: Noise, step_s: float, draws: int
) -> tuple[int, str, str]:
    """Lay a map on places with errors drawn anew; return refusals, errors with their bound, and NEES."""
    t_ns, position = drone.at_frames.t_ns, drone.at_frames.camera_position
    own = t_ns, position, drone.at_frames.camera_quaternion_xyzw
    key_t_ns = t_ns[key_rows(t_ns)]
    at_ns, models = key_t_ns[found.key], noise_models("LOGS", noise)
    errors = pose_errors(models)
    true = interpolate_poses(*own, at_ns, max_gap_ns=10**9, max_extrapolation_ns=10**9)[1]
    step = max(round(step_s * 1e9 / float(np.median(np.diff(t_ns)))), 1)
    off, nees = [], []
    for draw in range(draws):
        places = disturb(models, *own, np.random.default_rng([3, draw]))[0]
        with suppress(NoAttitudesError):
            laid = lay_on_places(found, drone.intrinsics, key_t_ns, t_ns[::step], places[::step], errors)
            apart = rotation_vector_from_quaternion(multiply(laid.quaternion_xyzw, conjugate(true)))
            off.append(np.square(apart).sum(axis=1).mean())
            nees.append(np.square(apart.mean(axis=0)).sum() / laid.common_sigma_rad**2)
    rows = np.flatnonzero((t_ns >= at_ns[0]) & (t_ns <= at_ns[-1]) & (np.arange(len(t_ns)) % step == 0))
    covariance = position_covariance(errors, t_ns[rows] / 1e9)
    bound = np.degrees(_bound_rad(position[rows], matrix_from_quaternion(true), covariance))
    shown = f"{np.degrees(np.sqrt(np.mean(off))):.2f}" + f" ({bound:.2f})" * (step_s < 1.0) if off else "-"
    return draws - len(off), shown, f"{np.mean(nees):.1f}" if off else "-"


def _bound_rad(places: Float, turn: Float, covariance: Float) -> float:
    """Compute the least root mean square angle by which a similarity on places [N, 3] turns wrongly."""
    arms = places - places.mean(axis=0)
    shift = np.tile(np.eye(3), (len(arms), 1, 1))
    slope = np.concatenate([-cross_matrix(arms), shift, arms[:, :, None]], axis=2)
    normal = np.einsum("nki,nm,mkj->ij", slope, np.linalg.inv(covariance), slope, optimize=True)
    tilt = np.stack([turn[:, 1, 0], -turn[:, 0, 0]], axis=1)
    normal[:2, :2] += tilt.T @ tilt / (np.radians(LEVEL_SIGMA_DEG) ** 2 * len(tilt))
    return float(np.sqrt(np.trace(np.linalg.inv(normal)[:3, :3])))


def used(names: Sequence[str], log: str, draws: int) -> list[str]:
    """Measure joints with attitudes by pictures (or far off), and with logged ones on the same places."""
    found = []
    for draw in range(draws):
        name = names[draw % len(names)]
        try:
            found.append(_used_once(name, log, draw))
        except DataError as error:
            print(f"{name}, draw {draw}: refused: {error}")
    if not found:
        return [log, f"0/{draws}", *5 * ["-"]]
    (first, nees, _), (second, others, _) = np.mean(found, axis=0)
    off = ", ".join(f"{each:.2f}" for each in np.sqrt(np.mean(found, axis=0)[:, 2]))
    ratio = [each[1][0] / each[0][0] for each in found]
    row = [f"{first:.0f}, {second:.0f}", f"{second / first:.2f}", f"{np.median(ratio):.2f}, {max(ratio):.2f}"]
    return [log, f"{len(found)}/{draws}", *row, f"{nees:.1f}, {others:.1f}", off]


def _used_once(name: str, log: str, draw: int) -> list[tuple[float, float, float]]:
    logged: dict[str, tuple[Trajectory, Noise]] = {}
    (place_log, far), other = USED[log], logged.copy()
    noise, step_s = LOGS[place_log]
    models = noise_models("LOGS", noise)
    turn = partial(turned_by_pictures, log, pose_noise=noise, note=lambda _: None, progress=Silent())
    (flight,) = [each for each in flights() if each.name == name]
    backgrounds = read_backgrounds(flight)
    with TemporaryDirectory() as folder:
        drawn = DrawnFlight(flight, Path(folder) / "shared")
        drawn.write_shared()
        for number, drone in enumerate(drawn.simulated.drones):
            t_ns, true, camera = drone.at_frames.t_ns, drone.at_frames.camera_position, drone.name
            poses = t_ns, true, drone.at_frames.camera_quaternion_xyzw
            # Satellite receivers share half of the variance. To a seed, a 0 at its end is nothing.
            seeds = [5, draw, 1 + number], [5, draw] if place_log == "gps" else [5, draw, 101 + number]
            errors = [disturb(models, *poses, np.random.default_rng(seed))[0] - true for seed in seeds]
            step = max(round(step_s * 1e9 / float(np.median(np.diff(t_ns)))), 1)
            rows = np.append(np.arange(0, len(t_ns) - 1, step), len(t_ns) - 1)
            places = (true + np.sqrt(0.5) * (errors[0] + errors[1]))[rows]
            between = np.stack([np.interp(t_ns, t_ns[rows], axis) for axis in places.T], axis=1)
            for of, turned in ((logged, TURNED), (other, far or TURNED)):
                both = {model: noise.get(model, {}) | turned.get(model, {}) for model in noise | turned}
                seeded = np.random.default_rng([6, draw, number])
                away = disturb(noise_models("LOGS", turned), *poses, seeded)[1]
                of[camera] = Trajectory(t_ns, between, away), both
            if far is None:
                track = Trajectory(t_ns[rows], places, np.full((len(rows), 4), np.nan))
                film = NO_FILM, CameraFrames(np.arange(len(t_ns)), t_ns, t_ns), drone.intrinsics
                kept = partial(_map_of, drone, backgrounds[camera].tracks)
                by = turn(camera, *film, track, refine_focal=False, satellite_sigma_m=None, kept=kept)
                other[camera] = by.trajectory, by.pose_noise
        sessions = [_session_of(drawn, Path(folder) / str(k), of) for k, of in enumerate((logged, other))]
        return [_outcome(flight, session) for session in sessions]


def _session_of(drawn: DrawnFlight, place: Path, tracks: Mapping[str, tuple[Trajectory, Noise]]) -> Path:
    """Ingest a flight whose cameras have these poses; what was logged of people and places is left out."""
    manifest = drawn.session(place, 0, "model", "blazepose", poses="true").with_name("flight.yaml")
    text = re.sub(r"^(actors?|map):.*\n(  .*\n)*", "", manifest.read_text("utf-8"), flags=re.MULTILINE)
    for camera, (track, noise) in tracks.items():
        t_ns = track.t_ns + drawn.flight.scenario.start_ns
        write_tum(manifest.with_name(f"{camera}.tum"), t_ns, track.position, track.quaternion_xyzw)
        stated = rf"pose: {{file: truth/{camera}\.tum}}(\n    pose_noise: .*)?"
        text = re.sub(stated, f"pose: {camera}.tum\n    pose_noise: {json.dumps(noise)}", text)
    manifest.write_text(text, encoding="utf-8")
    return ingest(manifest, manifest.with_name("posed")).folder


def _outcome(flight: Flight, session: Path) -> tuple[float, float, float]:
    """Reconstruct with what is kept of the films; return root-relative mm, NEES, and squared degrees off."""
    from benchmarks.accuracy import outcome_of  # which imports this module

    with kept_in_place_of_pictures(flight, "blazepose"):
        reconstruct(session, ReconstructSettings(people=1))
    found, squared = outcome_of(session), []
    true, estimated = (
        read_table(session / name, CAMERA_POSES)
        for name in ("truth_poses.parquet", "reconstruct/cameras.parquet")
    )
    for camera, own in estimated.groupby("camera"):
        logged = true[true["camera"] == camera]
        turn, of_log = (each[["qx", "qy", "qz", "qw"]].to_numpy(np.float64) for each in (own, logged))
        t_ns = own["t_ns"].clip(logged["t_ns"].min(), logged["t_ns"].max())
        there = Slerp(logged["t_ns"], Rotation.from_quat(of_log))(t_ns)
        squared.append((Rotation.from_quat(turn) * there.inv()).magnitude() ** 2)
    off = float(np.degrees(1) ** 2 * np.concatenate(squared).mean())
    return found.root_mpjpe_mm or np.nan, found.nees or np.nan, off


def joined(name: str) -> list[str]:
    """Measure a flight without any pose, and its joints beside those with logged poses."""
    (flight,) = [each for each in flights() if each.name == name]
    kept, backgrounds = read_keypoints(flight.keypoints_path("blazepose")), read_backgrounds(flight)
    stature_m = np.mean([person.body.height_m for person in flight.scenario.people.values()])
    with TemporaryDirectory() as folder:
        drawn = DrawnFlight(flight, Path(folder) / "shared")
        cameras = {}
        for drone in drawn.simulated.drones:
            t_ns, people = drone.at_frames.t_ns, detections_from(kept.tables[drone.name], JOINED)
            film = NO_FILM, CameraFrames(np.arange(len(t_ns)), t_ns, t_ns), drone.intrinsics
            map_of = partial(_map_of, drone, backgrounds[drone.name].tracks)
            cameras[drone.name] = UnposedCamera(*film, people, False, map_of)
        try:
            posed = posed_by_people(name, cameras, float(stature_m), lambda _: None, Silent())
        except DataError as error:
            return [name, f"refused: {error.code}", *3 * ["-"]]
        tracks, true = {drone: each.trajectory for drone, each in posed.items()}, {}
        for drone in drawn.simulated.drones:
            at, rows = drone.at_frames, np.searchsorted(drone.at_frames.t_ns, tracks[drone.name].t_ns)
            true[drone.name] = at.camera_position[rows], at.camera_quaternion_xyzw[rows]
        places = [(tracks[drone].position, true[drone][0]) for drone in tracks]
        to_true = first_similarity(*(np.concatenate(each) for each in zip(*places, strict=True)))[0]
        drawn.write_shared()
        off, nees, moved = [], [], {}
        for camera, track in tracks.items():
            noise = posed[camera].pose_noise
            now = multiply(to_true.quaternion_xyzw, track.quaternion_xyzw)
            apart = rotation_vector_from_quaternion(multiply(now, conjugate(true[camera][1]))).mean(axis=0)
            off.append(np.degrees(np.linalg.norm(apart)))
            nees.append(off[-1] ** 2 / float(noise["bias"]["rotation_deg"]) ** 2)
            place = to_true.places(track.position) / to_true.scale
            moved[camera] = Trajectory(track.t_ns, place, now), noise
        sessions = [drawn.session(Path(folder) / "logged", 0, "model", "blazepose")]
        sessions.append(_session_of(drawn, Path(folder) / "true", moved))
        errors = ", ".join(f"{_outcome(flight, each)[0]:.0f}" for each in sessions)
        row = [name, f"{np.sqrt(np.square(off).mean()):.2f}", f"{np.mean(nees):.1f}"]
        return [*row, f"{100 / to_true.scale - 100:+.1f}", errors]


def _map_of(drone: SimulatedDrone, seen: pd.DataFrame, _: str = "") -> PictureMap:
    """Map a camera by its kept tracks; errors as in `map_pictures`."""
    t_ns, lens = drone.at_frames.t_ns, drone.intrinsics
    picture, point = (seen[column].to_numpy(np.int64) for column in ("frame", "point"))
    tracks = Tracks(picture, point, seen[["x", "y"]].to_numpy(np.float64))
    return map_pictures(followed_features(tracks, np.arange(len(t_ns)), key_rows(t_ns), lens, t_ns), lens)


if __name__ == "__main__":
    parser = parser_of(__doc__)
    add_arguments(parser)
    for key, lines in run(asked := parser.parse_args()):
        show(key, lines, write=asked.write)
