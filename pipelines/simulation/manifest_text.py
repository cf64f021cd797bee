"""The flight.yaml of a simulated flight."""

from __future__ import annotations

from pipelines.simulation.flight import SimulatedDrone, SimulatedFlight, picture_stamps
from pipelines.simulation.flying import LEVER_ARM

_UNKNOWN_CLOCK_SIGMA_S = 0.3


def manifest_text(flight: SimulatedFlight, *, video: bool, true_poses: bool = False) -> str:
    """Write the manifest, which ties the files together.

    Args:
        flight: the flight.
        video: True for videos; False for keypoints in their place.
        true_poses: take the true poses for logged ones. Otherwise the manifest states only what a user would
            know; the truth is only under `truth`.
    """
    scenario = flight.scenario
    lines = [
        "# Simulated by `mocap simulate` from scenario.yaml; simulation.json says how.",
        *([] if video else [f"# The keypoints have the measured errors of {scenario.keypoints.detector}."]),
        *_shot(flight),
        "schema: 1",
        f"name: {_quoted(scenario.name)}",
        "simulated: true",
        "world: {frame: enu}",
        "logs:",
        *(f"  {drone.name}: {{path: {drone.name}.mcap}}" for drone in flight.drones),
        "cameras:",
    ]
    for drone in flight.drones:
        lines += [*_pictures(flight, drone, video), *_poses(flight, drone, true_poses)]
    poses = ", ".join(f"{drone.name}: truth/{drone.name}.tum" for drone in flight.drones)
    lines += [
        f"actor: {{log: drone1, topic: {flight.people[0].topic}, point: hip}}",
        "map: site.bt",
        "truth:",
        "  joints: truth/joints.csv",
        f"  poses: {{{poses}}}",
        "",
    ]
    return "\n".join(lines)


def _shot(flight: SimulatedFlight) -> list[str]:
    """Write a comment on exposure, readout and bit rate; none where all are off."""
    lens = flight.scenario.lens
    said = [
        f"exposure {lens.exposure_ms:g} ms" if lens.exposure_ms else "",
        f"readout {lens.readout_ms:g} ms" if lens.readout_ms else "",
        f"{lens.bitrate_mbps:g} Mbit/s" if lens.bitrate_mbps else "",
    ]
    if not any(said):
        return []
    stamps = "a picture's time is the middle of the exposure of its middle row"
    return [f"# Pictures: {', '.join(part for part in said if part)}; {stamps}."]


def _quoted(text: str) -> str:
    """Return any text as a scalar of YAML on one line."""
    plain = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in plain) + '"'


def _pictures(flight: SimulatedFlight, drone: SimulatedDrone, video: bool) -> list[str]:
    name = drone.name
    known = not any(other.clock_offset_s for other in flight.drones)
    start_ns = int(picture_stamps(flight, drone)[0])
    whole, fraction = divmod(start_ns, 10**9)
    if video:
        pictures = [f"    video: {name}.mp4", f"    frame_times: {{start: {whole}.{fraction:09d}}}"]
    else:
        pictures = [
            f"    frame_times: {{csv: {name}_frames.csv}}",
            f"    keypoints: {{path: {name}_keypoints.json, format: alphapose, skeleton: coco17}}",
        ]
    sigma_s = 0 if known else _UNKNOWN_CLOCK_SIGMA_S
    intrinsics, readout_s = f"{name}_camera.yaml", drone.intrinsics.readout_s
    if readout_s:
        intrinsics = f"{{path: {intrinsics}, readout_s: {readout_s:g}}}"
    return [
        f"  {name}:",
        *pictures,
        f"    clock: {{offset_s: 0, sigma_s: {sigma_s}}}",
        f"    intrinsics: {intrinsics}",
    ]


def _poses(flight: SimulatedFlight, drone: SimulatedDrone, true_poses: bool) -> list[str]:
    name, drones = drone.name, flight.scenario.drones
    if true_poses:
        return [f"    pose: {{tum: truth/{name}.tum}}"]
    arm = ", ".join(f"{v:g}" for v in LEVER_ARM)
    lines = [
        f"    pose: {{log: {name}, topic: /{name}/odometry, of: body}}",
        f"    mount: {{looks: forward, translation: [{arm}]}}",
        f"    gimbal: {{log: {name}, topic: /{name}/gimbal, relative_to: world}}",
    ]
    if drones.pose_noise and drones.state_pose_noise:
        lines.append("    pose_noise:")
        for model, parameters in drones.pose_noise.items():
            stated = ", ".join(f"{key}: {value}" for key, value in parameters.items())
            lines.append(f"      {model}: {{{stated}}}")
    return lines
