"""What was really the case in a simulated flight, and what a detector would have seen, as files."""

from __future__ import annotations

from pathlib import Path

from pipelines.session.storage import write_json
from pipelines.simulation.flight import (
    SimulatedDrone,
    SimulatedFlight,
    keypoints_of,
    picture_stamps,
    visible_joints,
)
from pipelines.simulation.flight_files import (
    Sighting,
    write_alphapose,
    write_joints,
    write_lines,
    write_tum,
)


def write_truth(folder: Path, flight: SimulatedFlight) -> None:
    """What was really the case, at the times of pictures and logs."""
    start_ns = flight.scenario.start_ns
    truth = folder / "truth"
    truth.mkdir()
    write_joints(truth / "joints.csv", flight.t_ns + start_ns, flight.person.joints, flight.joints)
    for drone in flight.drones:
        poses = drone.at_log
        write_tum(
            truth / f"{drone.name}.tum",
            poses.t_ns + start_ns,
            poses.camera_position,
            poses.camera_quaternion_xyzw,
        )
        _, visible = visible_joints(flight, drone)
        lines = [",".join(["frame", *flight.person.joints])]
        lines += [",".join([str(frame), *row]) for frame, row in enumerate(visible.astype(int).astype(str))]
        write_lines(truth / f"{drone.name}_visible.csv", lines)
    offsets = {drone.name: drone.clock_offset_s for drone in flight.drones}
    write_json(truth / "clocks.json", {"clock_offsets_s": offsets})


def write_keypoints(folder: Path, flight: SimulatedFlight, drone: SimulatedDrone) -> None:
    """What a detector would have found, as AlphaPose writes it, and when the pictures were taken."""
    xy, confidence = keypoints_of(flight, drone)
    write_alphapose(folder / f"{drone.name}_keypoints.json", [Sighting(1, xy, confidence)])
    stamps = picture_stamps(flight, drone)
    lines = ["frame,t_ns", *(f"{frame},{stamp}" for frame, stamp in enumerate(stamps.tolist()))]
    write_lines(folder / f"{drone.name}_frames.csv", lines)
