"""The flight.yaml of a simulated flight."""

from __future__ import annotations

from pipelines.simulation.flight import SimulatedDrone, SimulatedFlight
from pipelines.simulation.flying import LEVER_ARM

_UNKNOWN_CLOCK_SIGMA_S = 0.3


def manifest_text(flight: SimulatedFlight, *, video: bool) -> str:
    """What ties the files together; it states what a user would know, the truth only under `truth`."""
    scenario = flight.scenario
    name = scenario.name.replace("\\", "\\\\").replace('"', '\\"')
    lines = [
        "# Simulated by `mocap simulate` from scenario.yaml; simulation.json says how.",
        "schema: 1",
        f'name: "{name}"',
        "world: {frame: enu}",
        "logs:",
        *(f"  {drone.name}: {{path: {drone.name}.mcap}}" for drone in flight.drones),
        "cameras:",
    ]
    for drone in flight.drones:
        lines += _camera(flight, drone, video)
    poses = ", ".join(f"{drone.name}: truth/{drone.name}.tum" for drone in flight.drones)
    lines += [
        "actor: {log: drone1, topic: /actor, point: hip}",
        "map: site.bt",
        "truth:",
        "  joints: truth/joints.csv",
        f"  poses: {{{poses}}}",
        "",
    ]
    return "\n".join(lines)


def _camera(flight: SimulatedFlight, drone: SimulatedDrone, video: bool) -> list[str]:
    scenario, name = flight.scenario, drone.name
    known = not any(other.clock_offset_s for other in flight.drones)
    start_ns = int(drone.at_frames.t_ns[0]) + scenario.start_ns - round(drone.clock_offset_s * 1e9)
    whole, fraction = divmod(start_ns, 10**9)
    pictures = (
        [f"    video: {name}.mp4", f"    frame_times: {{start: {whole}.{fraction:09d}}}"]
        if video
        else [
            f"    frame_times: {{csv: {name}_frames.csv}}",
            f"    keypoints: {{path: {name}_keypoints.json, format: alphapose, skeleton: coco17}}",
        ]
    )
    noise = []
    if scenario.drones.pose_noise and scenario.drones.state_pose_noise:
        noise = ["    pose_noise:"] + [
            f"      {model}: {{{', '.join(f'{k}: {v}' for k, v in parameters.items())}}}"
            for model, parameters in scenario.drones.pose_noise.items()
        ]
    arm = ", ".join(f"{v:g}" for v in LEVER_ARM)
    return [
        f"  {name}:",
        *pictures,
        f"    clock: {{offset_s: 0, sigma_s: {0 if known else _UNKNOWN_CLOCK_SIGMA_S}}}",
        f"    pose: {{log: {name}, topic: /{name}/odometry, of: body}}",
        f"    mount: {{looks: forward, translation: [{arm}]}}",
        f"    gimbal: {{log: {name}, topic: /{name}/gimbal, relative_to: world}}",
        f"    intrinsics: {name}_camera.yaml",
        *noise,
    ]
