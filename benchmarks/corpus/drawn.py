"""Sessions of the corpus: a flight's logs with errors drawn anew, and the keypoints that are kept.

The flight, its map and its truth come from the scenario. A session is ingested from the same files as any
other. The stages `detect` and the background's following find what is kept in the place of pictures: the
videos are grey.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal
from unittest.mock import patch

import numpy as np

from benchmarks.corpus.stored import RECORDED, Flight, read_backgrounds, read_keypoints
from pipelines.detect import Block as DetectorBlock
from pipelines.detect import FollowedBlock
from pipelines.formats.calibrations.camera_matrices import write_camera_info
from pipelines.formats.scenes.mcap_writing import Ros2Recording
from pipelines.formats.skeletons.bvh import read_motion
from pipelines.formats.videos.video_writing import write_h264
from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import EXACT, GaussMarkov
from pipelines.geometry.poses import (
    conjugate,
    cross_matrix,
    multiply,
    quaternion_from_rotation_vector,
    rotate,
    rotation_vector_from_quaternion,
)
from pipelines.ingest import ingest
from pipelines.reconstruction.background_tracks import still_name
from pipelines.session.camera_poses import noise_models
from pipelines.session.maps import write_grid
from pipelines.session.parallel import contents_of
from pipelines.session.records import Trajectory
from pipelines.session.storage import write_json
from pipelines.session.tables import FRAMES, KEYPOINTS, TRACKS, read_table, write_table
from pipelines.simulate import _planner
from pipelines.simulation.flight import SimulatedDrone, SimulatedFlight, fly_scenario
from pipelines.simulation.flight_files import (
    TrackedKeypoints,
    logged_messages,
    manifest_text,
    write_alphapose,
    write_keypoints,
    write_truth,
    write_tum,
)
from pipelines.simulation.flying import ACTOR_CORRELATION_S, DronePoses, estimate

Poses = Literal["logged", "true", "shared"]
Given = Literal["model", "nothing"]
"""Knowledge of the poses' errors: their model in flight.yaml, or nothing there and no covariances in logs."""

FAULTS = (
    "log 0.2 s late",
    "pictures 0.2 s late",
    "log frozen for 2 s",
    "poses repeated at 5 Hz",
    "poses at 10 Hz",
    "compass 5 deg off",
    "step of 1 m",
)
"""Faults of the last drone that nobody states."""
_DRAWS = 100  # first of the numbers that name a draw's random numbers; the flight has those below
_GREY = 128


@dataclass(frozen=True)
class SharedError:
    """Rigid motion of all cameras together, about a point."""

    about: Float  # [3] m
    shift: Float  # [3] m
    turn: Float  # [3] rad, rotation vector in the world

    def moved(self, poses: DronePoses) -> tuple[Float, Float]:
        """Move true camera poses [M] by the error: position [M, 3] and world_from_camera [M, 4]."""
        turned = quaternion_from_rotation_vector(self.turn)
        position = rotate(turned, poses.camera_position - self.about) + self.about + self.shift
        return position, multiply(turned, poses.camera_quaternion_xyzw)


def shared_error(flight: SimulatedFlight) -> SharedError:
    """Find the rigid motion that brings the true cameras nearest to the logged ones, weighted by their noise.

    Only poses at the film count. No picture tells of the motion: it moves cameras, people and ground alike.
    """
    about = flight.people[0].joints.mean(axis=(0, 1))
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for drone in flight.drones:
        logged, true, filmed_ns = drone.log.camera, drone.at_log, drone.at_frames.t_ns
        away = true.camera_position - about
        back = multiply(logged.quaternion_xyzw, conjugate(true.camera_quaternion_xyzw))
        error = np.hstack([logged.position - true.camera_position, rotation_vector_from_quaternion(back)])
        design = np.tile(np.eye(6), (len(away), 1, 1))
        design[:, :3, 3:] = -cross_matrix(away)
        assert logged.covariance is not None, "every flight of the corpus has noise"
        weight = 1 / np.maximum(np.diagonal(logged.covariance, axis1=1, axis2=2), EXACT**2)
        weight[(true.t_ns < filmed_ns[0]) | (true.t_ns > filmed_ns[-1])] = 0
        normal += np.einsum("tki,tk,tkj->ij", design, weight, design)
        right += np.einsum("tki,tk,tk->i", design, weight, error)
    found = np.linalg.solve(normal, right)
    return SharedError(about, np.asarray(found[:3]), np.asarray(found[3:]))


def with_fault(fault: str, drone: SimulatedDrone) -> SimulatedDrone:
    """Put one of `FAULTS` into a log, or into the stamps of pictures."""
    body, frames, late_ns = drone.log.body, drone.at_frames, 200_000_000
    if fault == "pictures 0.2 s late":
        return replace(drone, at_frames=replace(frames, t_ns=frames.t_ns + late_ns))
    t_ns, rows, shift, yaw_deg = body.t_ns, np.arange(len(body.t_ns)), np.zeros(3), 0.0
    time_s = (t_ns - t_ns[0]) / 1e9
    after_s = time_s - time_s[-1] / 2
    match fault:
        case "log 0.2 s late":
            t_ns = t_ns + late_ns
        case "log frozen for 2 s":
            rows[np.abs(after_s) < 1] = np.searchsorted(after_s, -1)
        case "poses repeated at 5 Hz":
            rows = np.searchsorted(time_s, np.floor(5 * time_s) / 5)
        case "poses at 10 Hz":
            rows = np.searchsorted(time_s, np.arange(0, time_s[-1], 0.1))
            t_ns = t_ns[rows]
        case "compass 5 deg off":
            yaw_deg = 5.0
        case "step of 1 m":
            shift = np.outer(after_s > 0, [1.0, 0.0, 0.0])
    turn = quaternion_from_rotation_vector(np.radians([0.0, 0.0, yaw_deg]))
    covariance = None if body.covariance is None else body.covariance[rows]
    attitude, gimbal = multiply(turn, body.quaternion_xyzw[rows]), drone.log.gimbal_xyzw[rows]
    body = Trajectory(t_ns, body.position[rows] + shift, attitude, covariance)
    return replace(drone, log=replace(drone.log, body=body, gimbal_xyzw=multiply(turn, gimbal)))


@dataclass(frozen=True)
class DrawnFlight:
    """A flight of the corpus whose logs are drawn as often as wanted.

    `folder` receives the files that all draws share.
    """

    flight: Flight
    folder: Path

    @cached_property
    def simulated(self) -> SimulatedFlight:
        """The flight with its first logs."""
        scenario, path = self.flight.scenario, self.flight.scenario_path
        motions = {
            name: read_motion(file, unit=motion.unit, axes=motion.axes)
            for name, (file, motion) in scenario.motion_files(RECORDED).items()
        }
        models = noise_models(str(path), scenario.drones.pose_noise)
        return fly_scenario(scenario, models, bvh=motions, planner=_planner(scenario, path))

    def write_shared(self) -> None:
        """Write what all draws share: truth, map, calibration, and grey videos."""
        if (self.folder / "truth").is_dir():
            return
        self.folder.mkdir(parents=True)
        flight = self.simulated
        spec = flight.scenario.world.map
        write_grid(self.folder / "site.npz", flight.world.occupancy(spec.resolution_m, spec.height_m))
        for drone in flight.drones:
            lens = drone.intrinsics
            write_camera_info(self.folder / f"{drone.name}_camera.yaml", drone.name, lens)
            grey = np.full((lens.height, lens.width, 3), _GREY, np.uint8)
            stamps = drone.at_frames.t_ns
            pictures = (grey for _ in stamps)
            video = self.folder / f"{drone.name}.mp4"
            write_h264(video, pictures, stamps - stamps[0], width=lens.width, height=lens.height)
        write_truth(self.folder, flight)

    def session(
        self, place: Path, draw: int, given: Given, detector: str, *, poses: Poses = "logged", fault: str = ""
    ) -> Path:
        """Write the files of one draw into a new folder, ingest them, and return the session.

        Poses that are `shared` are the true ones, moved and turned together by the error that all cameras of
        this draw share. The detector's keypoints are those of a flight without pictures.
        """
        place.mkdir(parents=True)
        for path in self.folder.iterdir():
            (place / path.name).symlink_to(path.resolve())
        flight = self._with_logs(draw, given)
        if fault:
            flight.drones[-1] = with_fault(fault, flight.drones[-1])
        for drone in flight.drones:
            with Ros2Recording(place / f"{drone.name}.mcap") as log:
                for message in logged_messages(flight, drone):
                    log.write(message.topic, message.type, message.received_ns, message.fields)
        if not self.flight.with_pictures:
            self._write_keypoint_files(flight, place, detector)
        text = manifest_text(flight, video=self.flight.with_pictures, true_poses=poses != "logged")
        if poses == "true" and given == "model":
            exact = "\n    pose_noise: {white: {position_m: 0, rotation_deg: 0}}"
            for drone in flight.drones:
                pose = f"    pose: {{file: truth/{drone.name}.tum}}"
                text = text.replace(pose, pose + exact)
        if poses == "shared":
            error = shared_error(flight)
            for drone in flight.drones:
                moved = error.moved(drone.at_log)
                write_tum(
                    place / f"{drone.name}_shared.tum", drone.at_log.t_ns + flight.scenario.start_ns, *moved
                )
                text = text.replace(
                    f"pose: {{file: truth/{drone.name}.tum}}", f"pose: {{file: {drone.name}_shared.tum}}"
                )
        (place / "flight.yaml").write_text(text, encoding="utf-8")
        return ingest(place / "flight.yaml", place / "session").folder

    def _with_logs(self, draw: int, given: Given) -> SimulatedFlight:
        """Draw the errors of poses and of the actors' estimates."""
        first = self.simulated
        scenario = first.scenario
        models = noise_models("pose_noise", scenario.drones.pose_noise)
        drones = []
        for index, drone in enumerate(first.drones):
            rng = np.random.default_rng([scenario.seed, _DRAWS + draw, index])
            log = estimate(drone.at_log, models, rng)
            if given == "nothing":
                log = replace(log, body=replace(log.body, covariance=None))
            drones.append(replace(drone, log=log))
        people = []
        for index, person in enumerate(first.people):
            rng = np.random.default_rng([scenario.seed, _DRAWS + draw, len(drones) + index])
            hip = person.moving(person.estimate_ns / 1e9).root
            error = GaussMarkov(position_m=person.look.estimate_sigma_m, correlation_s=ACTOR_CORRELATION_S)
            level = np.tile([0.0, 0.0, 0.0, 1.0], (len(hip), 1))
            drawn = hip + error.errors(person.estimate_ns, hip, level, rng)[:, :3]
            people.append(replace(person, estimate=drawn))
        stating = scenario.drones.model_copy(update={"state_pose_noise": given == "model"})
        scenario = scenario.model_copy(update={"drones": stating})
        return replace(first, scenario=scenario, drones=drones, people=people)

    def _write_keypoint_files(self, flight: SimulatedFlight, place: Path, detector: str) -> None:
        """Write the detector's keypoints as AlphaPose does, with the joints of the truth (COCO's)."""
        kept = read_keypoints(self.flight.keypoints_path(detector))
        joints = flight.people[0].person.joints
        for drone in flight.drones:
            write_keypoints(place, flight, drone)  # for the times of the pictures
            table, frames = kept.tables[drone.name], len(drone.at_frames.t_ns)
            table = table[table["joint"].isin(joints)]
            people = []
            for track, (_, rows) in enumerate(table.groupby("person"), 1):
                xy, confidence = np.full((frames, len(joints), 2), np.nan), np.zeros((frames, len(joints)))
                where = rows["frame"].to_numpy(), [joints.index(name) for name in rows["joint"]]
                xy[where], confidence[where] = rows[["x", "y"]], rows["confidence"]
                xy[np.isnan(xy).all(axis=-1).any(axis=-1)] = np.nan
                people.append(TrackedKeypoints(track, xy, confidence))
            write_alphapose(place / f"{drone.name}_keypoints.json", people)


@contextmanager
def kept_in_place_of_pictures(flight: Flight, detector: str) -> Iterator[None]:
    """Let `reconstruct` find the keypoints and the background that are kept, in the place of its pictures."""
    kept = read_keypoints(flight.keypoints_path(detector))
    backgrounds = read_backgrounds(flight) if flight.with_pictures else {}

    def detect(order: Any) -> dict[str, bytes]:
        block: DetectorBlock = order.block
        listed = read_table(order.session.opened() / f"cameras/{block.camera}/frames.parquet", FRAMES)
        listed = listed.iloc[block.first : block.stop]
        seen = listed[listed.index % order.every == 0]
        table = kept.tables[block.camera].merge(seen[["frame", "t_ns"]], on="frame")
        counts = kept.counts[block.camera] if not block.first else dict.fromkeys(kept.counts[block.camera], 0)
        with TemporaryDirectory() as place:
            write_table(Path(place) / "keypoints.parquet", table, KEYPOINTS)
            write_json(Path(place) / "counts.json", {"joints": list(kept.joints), "counts": counts})
            return contents_of(Path(place))

    def follow(order: tuple[Any, FollowedBlock]) -> dict[str, bytes]:
        _, block = order
        background = backgrounds[block.camera]
        table = background.tracks[background.tracks["frame"].isin(block.numbers)]
        numbers = [number for number in background.stills if number in block.numbers]
        # The numbers of points are the flight's already, so a block adds none to those of the next.
        counts = {"pictures": len(block.numbers), "undecoded": 0, "stills": len(numbers), "points": 0}
        with TemporaryDirectory() as place:
            write_table(Path(place) / "tracks.parquet", table, TRACKS)
            write_json(Path(place) / "counts.json", counts)
            stills = {still_name(number): background.stills[number] for number in numbers}
            return contents_of(Path(place)) | stills

    with (
        patch("pipelines.detect.detect_block", detect),
        patch("pipelines.detect.hashes_of_models", lambda _: {}),
        patch("pipelines.detect.follow_block", follow),
    ):
        yield
