"""Files of a simulated flight's truth, and of a simulated detector's keypoints."""

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
    write_people,
    write_tum,
)


def write_truth(folder: Path, flight: SimulatedFlight) -> None:
    """Write the truth at the times of pictures and logs."""
    start_ns = flight.scenario.start_ns
    truth = folder / "truth"
    truth.mkdir()
    stamps, joint_names = flight.t_ns + start_ns, flight.people[0].person.joints
    if flight.scenario.actors is None:
        write_joints(truth / "joints.csv", stamps, joint_names, flight.people[0].joints)
    else:
        write_people(truth / "joints.csv", stamps, joint_names, [each.joints for each in flight.people])
        write_json(truth / "people.json", {"people": [each.name for each in flight.people]})
    for drone in flight.drones:
        poses = drone.at_log
        write_tum(
            truth / f"{drone.name}.tum",
            poses.t_ns + start_ns,
            poses.camera_position,
            poses.camera_quaternion_xyzw,
        )
        write_lines(truth / f"{drone.name}_visible.csv", _visible_lines(flight, drone))
    offsets = {drone.name: drone.clock_offset_s for drone in flight.drones}
    write_json(truth / "clocks.json", {"clock_offsets_s": offsets})


def _visible_lines(flight: SimulatedFlight, drone: SimulatedDrone) -> list[str]:
    """Lines of CSV: frame, person where the scenario has `actors`, and 1 or 0 for each joint."""
    visible = [visible_joints(flight, drone, person)[1].astype(int).astype(str) for person in flight.people]
    numbered = flight.scenario.actors is not None
    lines = [",".join(["frame", *(["person"] if numbered else []), *flight.people[0].person.joints])]
    for frame in range(len(drone.at_frames.t_ns)):
        for number, rows in enumerate(visible):
            lines.append(",".join([str(frame), *([str(number)] if numbered else []), *rows[frame]]))
    return lines


def write_keypoints(folder: Path, flight: SimulatedFlight, drone: SimulatedDrone) -> None:
    """What a detector would have found, as AlphaPose writes it, and when the pictures were taken."""
    people = [Sighting(1 + k, *keypoints_of(flight, drone, person)) for k, person in enumerate(flight.people)]
    write_alphapose(folder / f"{drone.name}_keypoints.json", people)
    stamps = picture_stamps(flight, drone)
    lines = ["frame,t_ns", *(f"{frame},{stamp}" for frame, stamp in enumerate(stamps.tolist()))]
    write_lines(folder / f"{drone.name}_frames.csv", lines)
