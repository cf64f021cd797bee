"""Stage `simulate`: a flight with known truth, in the same files as those of a real flight."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.calibrations.camera_matrices import write_camera_info
from pipelines.formats.scenes.mcap_writing import Ros2Recording
from pipelines.formats.skeletons.bvh import read_motion
from pipelines.formats.videos.video_writing import join_videos, write_h264
from pipelines.geometry.arrays import Float, Picture
from pipelines.planning.arms import PLANNER_ARMS
from pipelines.planning.config import planner_config
from pipelines.planning.distance_field import distance_field
from pipelines.planning.replay import Pilot, Start
from pipelines.session.camera_poses import noise_models
from pipelines.session.errors import DataError
from pipelines.session.progress import Halt, Progress, Silent, side_by_side
from pipelines.session.records import SkeletalMotion
from pipelines.session.storage import (
    SIMULATION_MARK,
    hash_of,
    is_made,
    read_json,
    refuse_others,
    sha256_of,
    whole_folder,
    write_json,
)
from pipelines.simulation.detector_errors import errors_of
from pipelines.simulation.flight import SimulatedDrone, SimulatedFlight, fly_scenario
from pipelines.simulation.flight_files import logged_messages, manifest_text, write_keypoints, write_truth
from pipelines.simulation.flying import Known, Planner
from pipelines.simulation.renderer import ExposedMoment, Renderer, exposed_moments
from pipelines.simulation.scenario import Scenario, read_scenario
from pipelines.simulation.world import World

# It is raised whenever the same scenario gives other files than before.
_REVISION = 8
_OWN = ("drone*", "flight.yaml", "true_poses.yaml", "scenario.yaml", "site.*", "truth", SIMULATION_MARK)
# An interrupt costs at most so many pictures, and a block still encodes well.
_BLOCK = 60
_RING = "ring"
# A filter of the actor cannot work with a standard deviation of 0.
_LEAST_SIGMA_M = 0.01


@dataclass(frozen=True)
class Simulated:
    """Result of a simulation."""

    folder: Path
    summary: dict[str, Any]
    skipped: bool  # True if the simulation existed already


def simulate(
    scenario_path: Path,
    folder: Path,
    *,
    video: bool = True,
    workers: int = 1,
    overwrite: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> Simulated:
    """Simulate a flight into a folder; an earlier simulation there is replaced if it holds no other files.

    Without `video`, keypoints with the errors of a detector are written instead. Logs, truth and pictures do
    not depend on `workers`. `overwrite` replaces a folder that is no simulation, or holds other files as
    well. DataError: the scenario cannot be used, or the folder cannot be written. BusyError: another process
    makes it.
    """
    progress = progress or Silent()
    scenario = read_scenario(scenario_path)
    key = _key(scenario, scenario_path, video)
    if not force and is_made(folder, key, mark=SIMULATION_MARK):
        return Simulated(folder, read_json(folder / SIMULATION_MARK), skipped=True)
    if not overwrite and (folder / SIMULATION_MARK).is_file():  # such as a session of the earlier flight
        refuse_others(folder, lambda name: any(fnmatch(name, own) for own in _OWN), "more than a flight")
    noise = noise_models(f"{scenario_path}: drones.pose_noise", scenario.drones.pose_noise)
    motions = recorded_motions(scenario, scenario_path)
    planner = _planner(scenario, scenario_path)

    with whole_folder(folder, key, mark=SIMULATION_MARK, overwrite=overwrite) as making:
        progress.start("Flying", 3 + scenario.drones.count)
        flight = fly_scenario(scenario, noise, bvh=motions, planner=planner)
        progress.advance()
        write_truth(making.folder, flight)
        progress.advance()
        occupancy = flight.world.occupancy(scenario.world.map.resolution_m, scenario.world.map.height_m)
        np.savez_compressed(
            making.folder / "site.npz",
            probability=occupancy.probability,
            origin=occupancy.origin,
            resolution_m=np.float64(occupancy.resolution_m),
        )
        progress.advance()
        for drone in flight.drones:
            with Ros2Recording(making.folder / f"{drone.name}.mcap") as log:
                for message in logged_messages(flight, drone):
                    log.write(message.topic, message.type, message.received_ns, message.fields)
            write_camera_info(making.folder / f"{drone.name}_camera.yaml", drone.name, drone.intrinsics)
            progress.advance()
        if video:
            _film(flight, making.folder, making.part, workers, progress)
        else:
            for drone in flight.drones:
                write_keypoints(making.folder, flight, drone)
        shutil.copyfile(scenario_path, making.folder / "scenario.yaml")
        for name, true_poses in (("flight.yaml", False), ("true_poses.yaml", True)):
            text = manifest_text(flight, video=video, true_poses=true_poses)
            (making.folder / name).write_text(text, encoding="utf-8", newline="\n")
        summary = _summary(flight, key, video)
        write_json(making.folder / SIMULATION_MARK, summary)
        making.publish()
    return Simulated(folder, summary, skipped=False)


def example_scenario(name: str) -> Path:
    """Return the scenario of an example that is installed with the program."""
    return Path(str(files("pipelines.simulation") / "data" / f"{name}.yaml"))


def _key(scenario: Scenario, path: Path, video: bool) -> str:
    """Compute the key of a simulation; it is equal for equal flights."""
    ingredients: dict[str, object] = {"revision": _REVISION, "scenario": scenario.identity(), "video": video}
    if not video:
        ingredients["errors"] = sha256_of(errors_of(scenario.keypoints.detector))
    if hashes := {name: sha256_of(file) for name, (file, _) in scenario.motion_files(path.parent).items()}:
        ingredients["bvh"] = hashes if scenario.actors else hashes["actor"]
    return hash_of(ingredients)


def recorded_motions(scenario: Scenario, path: Path) -> dict[str, SkeletalMotion]:
    """Read the recorded motions that a scenario names, by actor."""
    return {
        name: read_motion(file, unit=motion.unit, axes=motion.axes)
        for name, (file, motion) in scenario.motion_files(path.parent).items()
    }


def _planner(scenario: Scenario, path: Path) -> Callable[[World], Planner] | None:
    """Make the formation planner that the scenario names; None for the ring."""
    formation, count = scenario.drones.formation, scenario.drones.count
    if formation.planner == _RING:
        return None
    if formation.planner not in PLANNER_ARMS.names():
        known = ", ".join([_RING, *PLANNER_ARMS.names()])
        place = f"{path}: drones.formation.planner"
        problem = f"no such planner {formation.planner!r}"
        raise DataError(place, problem, f"there are {known}", code="no-such-name")
    if formation.yaw_rate_deg_per_s or formation.variation:
        problem = f"yaw_rate_deg_per_s and variation are the ring's, {formation.planner} turns as it decides"
        raise DataError(f"{path}: drones.formation", problem, "leave them out, or take planner: ring")
    arm = PLANNER_ARMS.get(formation.planner)
    followed = next(iter(scenario.people.values()))
    stated = {
        "radius_m": formation.radius_m,
        "tilt_deg": formation.tilt_deg,
        "speed_mps": scenario.drones.limits.speed_mps,
        "acceleration_mps2": scenario.drones.limits.acceleration_mps2,
    }
    config = planner_config(stated, f"{path}: drones")
    sigma_m = max(followed.estimate_sigma_m, _LEAST_SIGMA_M)
    config = replace(config, tuning=replace(config.tuning, actor_sigma_m=sigma_m))

    def start(world: World) -> Planner:
        spec = scenario.world.map
        field = distance_field(world.occupancy(spec.resolution_m, spec.height_m))
        pilot = Pilot(arm, config, Start(count, float(np.radians(formation.yaw_deg))))
        measured = 0

        def slots(known: Known) -> tuple[Float, Float]:
            nonlocal measured
            for t_s, place in zip(known.actor_t_s[measured:], known.actor[measured:], strict=True):
                pilot.measure(float(t_s), place)
            measured = len(known.actor_t_s)
            if not measured:  # the actor's position is not known yet: hover
                return known.position, np.zeros_like(known.position)
            pilot.replan(known.t_s, known.position, known.velocity, field)
            return pilot.reference(known.t_s)

        return slots

    return start


def _film(
    flight: SimulatedFlight,
    folder: Path,
    part: Callable[[str, Callable[[Path], None]], Path],
    workers: int,
    progress: Progress,
) -> None:
    surfaces, world = flight.world.surfaces(), flight.scenario.world
    halt = Halt()
    # All drones have the same lens, so they share what was prepared for it.
    renderer = Renderer(
        surfaces, flight.drones[0].intrinsics, sun=np.array(world.sun), seed=flight.scenario.seed
    )
    blocks = [
        (drone, first) for drone in flight.drones for first in range(0, len(drone.at_frames.t_ns), _BLOCK)
    ]
    progress.start("Rendering", sum(len(drone.at_frames.t_ns) for drone in flight.drones))

    def film(block: tuple[SimulatedDrone, int]) -> Path:
        drone, first = block
        made = part(
            f"{drone.name}-{first}", partial(_film_block, flight, renderer, drone, first, halt, progress)
        )
        return made / "part.mp4"

    parts = side_by_side(film, blocks, workers=workers, halt=halt)
    for drone in flight.drones:
        own = [made for (of, _), made in zip(blocks, parts, strict=True) if of is drone]
        join_videos(folder / f"{drone.name}.mp4", own)


def _film_block(
    flight: SimulatedFlight,
    renderer: Renderer,
    drone: SimulatedDrone,
    first: int,
    halt: Halt,
    progress: Progress,
    folder: Path,
) -> None:
    stamps, lens, shot = drone.at_frames.t_ns, drone.intrinsics, flight.scenario.drones.camera
    frames = range(first, min(first + _BLOCK, len(stamps)))
    offsets_s, weights = exposed_moments(
        lens.height, exposure_s=shot.exposure_ms / 1e3, readout_s=lens.readout_s
    )
    t_ns = (stamps[frames.start : frames.stop, None] + np.rint(1e9 * offsets_s).astype(np.int64)).ravel()
    camera, motions = drone.at(t_ns), [each.moving(t_ns / 1e9) for each in flight.people]

    def pictures() -> Iterator[Picture]:
        for number, frame in enumerate(frames):
            halt.check()
            of_frame = range(number * len(offsets_s), (number + 1) * len(offsets_s))
            moments = [
                ExposedMoment(
                    camera.camera_position[k],
                    camera.camera_quaternion_xyzw[k],
                    [
                        each.person.surface(motion.root[k], motion.rotation[k])
                        for each, motion in zip(flight.people, motions, strict=True)
                    ],
                )
                for k in of_frame
            ]
            yield renderer.exposed(moments, weights, frame)
            progress.advance()

    since_first = stamps - stamps[0]
    write_h264(
        folder / "part.mp4",
        pictures(),
        since_first[frames.start : frames.stop],
        width=lens.width,
        height=lens.height,
        bits_per_s=round(1e6 * shot.bitrate_mbps) or None,
    )


def _summary(flight: SimulatedFlight, key: str, video: bool) -> dict[str, Any]:
    scenario = flight.scenario
    return {
        "schema": 1,
        "key": key,
        "name": scenario.name,
        "simulated": True,
        "seed": scenario.seed,
        "duration_s": scenario.duration_s,
        "pictures": "rendered video" if video else f"keypoints modelled after {scenario.keypoints.detector}",
        "frames": {drone.name: len(drone.at_frames.t_ns) for drone in flight.drones},
        "poses": {drone.name: len(drone.log.body.t_ns) for drone in flight.drones},
    }
