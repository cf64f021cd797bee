"""Write the sample flight "Ring walk": three simulated drones around a person who walks in a circle.

    python sample_data/make_sample.py [FOLDER]

The same bytes every time. README.md beside this script says what is in the files and what is wrong with
them on purpose.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.noise import Bias, White, disturb
from pipelines.simulation.drone_paths import orbit
from pipelines.simulation.flight_files import Sighting, write_alphapose, write_joints, write_tum
from pipelines.simulation.observe import KeypointNoise, detect, see
from pipelines.simulation.walk import COCO17, route, walk

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]

SEED = 20240611
DRONES = ("drone1", "drone2", "drone3")
START_NS = 1_700_000_000_000_000_000
SECONDS, FPS, LOG_HZ = 12, 30, 50

# One camera model, three lenses: 80 degrees wide and a little barrel distortion, each its own.
LENSES = tuple(
    Intrinsics(1280, 720, fx, fx + 0.6, cx, cy, "radtan", distortion)
    for fx, cx, cy, distortion in (
        (762.7, 641.2, 358.4, (-0.031, 0.012, 0.0004, -0.0003)),
        (765.1, 637.9, 361.7, (-0.029, 0.010, -0.0002, 0.0005)),
        (760.9, 643.5, 357.1, (-0.034, 0.014, 0.0003, 0.0002)),
    )
)

# The shutters are not synchronised, and no log is stamped at the frames.
FRAMES_START_NS = (START_NS, START_NS + 11_000_000, START_NS + 22_000_000)
LOG_START_NS = tuple(START_NS - 400_000_000 + offset for offset in (3_000_000, 7_300_000, 12_100_000))
DROPOUT = ("drone3", 5.0, 5.6)  # seconds after the start without a row in the pose log
BYSTANDER = ("drone2", 7.0, 8.0)  # seconds in which the detector sees somebody else as well

KEYPOINT_NOISE = KeypointNoise(pixel_px=3.0, missed_share=0.03, outlier_share=0.02)
# Of a drone with an RTK receiver and a calibrated gimbal.
WHITE = White(position_m=0.02, rotation_deg=0.2)
BIAS = Bias(position_m=0.05, rotation_deg=0.3)

WALK_RADIUS_M, WALK_SPEED_MPS = 4.0, 1.2


def actor(t_s: Float) -> Float:
    """Joints [T, 17, 3] of the person who is filmed: a circle of 4 m around the world's origin."""
    return walk(
        t_s, speed_mps=WALK_SPEED_MPS, start=(WALK_RADIUS_M, 0.0), heading_deg=90.0, radius_m=WALK_RADIUS_M
    )


def bystander(t_s: Float) -> Float:
    """Joints [T, 17, 3] of a smaller person who passes by outside the circle."""
    return walk(t_s, speed_mps=1.0, start=(-9.0, 2.0), heading_deg=10.0, height_m=1.62)


def drones(t_s: Float) -> tuple[Float, Float]:
    """True poses of all drones, positions [N, T, 3] and quaternions [N, T, 4]: they follow the walk."""
    ground, _ = route(
        WALK_SPEED_MPS * t_s, start=(WALK_RADIUS_M, 0.0), heading_deg=90.0, radius_m=WALK_RADIUS_M
    )
    target = np.concatenate([ground, np.full((t_s.size, 1), 1.0)], axis=1)
    return orbit(t_s, target, cameras=len(DRONES), yaw_deg=20.0, variation=1.0)


def write_sample(folder: Path) -> None:
    """Write the flight into a folder, which is made if it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(len(DRONES)):
        write_drone(folder, index)
    frames_ns = stamps(FRAMES_START_NS[0], SECONDS, FPS)
    write_joints(folder / "true_joints.csv", frames_ns, COCO17, actor(since_start(frames_ns)))
    (folder / "flight.yaml").write_text(manifest(), encoding="utf-8", newline="\n")


def write_drone(folder: Path, index: int) -> None:
    """Write what one drone brings home, and its true poses."""
    name = DRONES[index]
    rng = np.random.default_rng([SEED, index])
    log_ns = stamps(LOG_START_NS[index], SECONDS + 1, LOG_HZ)
    position, quaternion = (values[index] for values in drones(since_start(log_ns)))
    write_tum(folder / f"{name}_true_poses.tum", log_ns, position, quaternion)
    logged = ~within(DROPOUT, name, log_ns)
    position, quaternion = disturb([BIAS, WHITE], log_ns, position, quaternion, rng)
    write_tum(folder / f"{name}_poses.tum", log_ns[logged], position[logged], quaternion[logged])

    frames_ns = stamps(FRAMES_START_NS[index], SECONDS, FPS)
    t_s = since_start(frames_ns)
    position, quaternion = (values[index] for values in drones(t_s))
    people = []
    for track, person in ((2, bystander), (1, actor)):
        pixels = see(person(t_s), position, quaternion, LENSES[index])
        xy, confidence = detect(pixels, KEYPOINT_NOISE, rng)
        if person is bystander:
            xy[~within(BYSTANDER, name, frames_ns)] = np.nan
        people.append(Sighting(track, xy, confidence))
    write_alphapose(folder / f"{name}_keypoints.json", people)


def manifest() -> str:
    """The flight.yaml."""
    lines = [
        "# Simulated: see ../README.md. Written by ../make_sample.py.",
        "schema: 1",
        "name: Ring walk",
        "world: {frame: enu}",
        "cameras:",
    ]
    for name, start_ns, lens in zip(DRONES, FRAMES_START_NS, LENSES, strict=True):
        size = f"width: {lens.width}, height: {lens.height}"
        numbers = f"fx: {lens.fx:.1f}, fy: {lens.fy:.1f}, cx: {lens.cx}, cy: {lens.cy}"
        lines += [
            f"  {name}:",
            f"    frame_times: {{start: {start_ns // 10**9}.{start_ns % 10**9 // 10**6:03d}, fps: {FPS}}}",
            "    clock: {offset_s: 0, sigma_s: 0}",
            f"    pose: {{tum: {name}_poses.tum}}",
            f"    intrinsics: {{{size}, {numbers}, distortion: {list(lens.distortion)}}}",
            f"    keypoints: {{path: {name}_keypoints.json, format: alphapose, skeleton: coco17}}",
            "    pose_noise:",
            f"      white: {{position_m: {WHITE.position_m}, rotation_deg: {WHITE.rotation_deg}}}",
            f"      bias: {{frame: {BIAS.frame}, position_m: {BIAS.position_m},"
            f" rotation_deg: {BIAS.rotation_deg}}}",
        ]
    poses = ", ".join(f"{name}: {name}_true_poses.tum" for name in DRONES)
    return "\n".join([*lines, "truth:", "  joints: true_joints.csv", f"  poses: {{{poses}}}", ""])


def stamps(start_ns: int, seconds: int, rate_hz: int) -> Int64:
    """Evenly spaced stamps, each rounded to the nanosecond by itself."""
    k = np.arange(seconds * rate_hz, dtype=np.int64)
    return start_ns + (k * 1_000_000_000 + rate_hz // 2) // rate_hz


def since_start(t_ns: Int64) -> Float:
    """Seconds since the flight's start."""
    return (t_ns - START_NS) / 1e9


def within(span: tuple[str, float, float], name: str, t_ns: Int64) -> NDArray[np.bool_]:
    """Which stamps of a drone fall into a span that is stated as drone, first and last second."""
    drone, first_s, last_s = span
    t_s = since_start(t_ns)
    return (t_s >= first_s) & (t_s < last_s) & (name == drone)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "ring_walk"
    write_sample(target)
    print(f"wrote {target}")
