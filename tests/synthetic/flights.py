"""Small simulated flights as files, for tests that drive the commands: with known truth, in any format."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import camera_matrix
from pipelines.geometry.noise import disturb
from pipelines.geometry.poses import invert, look_at, rotation_vector_from_quaternion
from pipelines.session.camera_poses import noise_models
from pipelines.simulation.detector_errors import see
from pipelines.simulation.flight_files import TrackedKeypoints, write_alphapose, write_joints, write_tum
from pipelines.simulation.flying import orbit
from tests.synthetic.keypoints import KeypointNoise, detect
from tests.synthetic.walk import COCO17, route, walk

Int64 = NDArray[np.int64]

START_NS = 1_700_000_000_000_000_000
LOG_HZ = 200  # a camera accelerates at most by 1 m/s^2: interpolation errs by 1/8 / 200^2 = 3 micrometres
LENS = Intrinsics(1280, 720, 762.0, 763.0, 641.0, 358.0, "radtan", (-0.031, 0.012, 0.0004, -0.0003))
CLEAN_KEYPOINTS = KeypointNoise(pixel_px=0.0)
USUAL_KEYPOINTS = KeypointNoise(pixel_px=2.0, missed_share=0.02, outlier_share=0.02)
USUAL_POSES: dict[str, dict[str, float | str]] = {
    "white": {"position_m": 0.02, "rotation_deg": 0.2},
    "bias": {"frame": "world", "position_m": 0.05, "rotation_deg": 0.3},
}
_CIRCLE_M, _SPEED_MPS = 4.0, 1.2


@dataclass(frozen=True)
class SyntheticFlight:
    """Flight on disk, with its truth. Every camera has its frames at `t_ns`."""

    manifest: Path
    settings: dict[str, Any]  # content of the manifest; change it, then `save`
    t_ns: Int64  # [T]
    joints: tuple[str, ...]
    position: Float  # [T, 17, 3] m
    camera_position: Float  # [N, T, 3] m
    camera_quaternion: Float  # [N, T, 4] xyzw, world_from_camera
    pixels: Float  # [N, T, 17, 2] px without noise, NaN outside the picture

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras, in the order of the arrays."""
        return list(self.settings["cameras"])

    def save(self) -> None:
        """Write the manifest again, after a change of `settings`."""
        yaml = YAML(typ="safe", pure=True)
        yaml.default_flow_style = None
        yaml.width = 200
        with self.manifest.open("w", encoding="utf-8", newline="\n") as file:
            yaml.dump(self.settings, file)


def write_flight(
    folder: Path,
    *,
    cameras: int = 2,
    seconds: float = 1.0,
    fps: int = 30,
    clean: bool = False,
    static: bool = False,
    bystander: bool = False,
    pose_noise: Mapping[str, Mapping[str, float | str]] = USUAL_POSES,
    keypoint_format: str = "alphapose",
    pose_format: str = "tum",
    seed: int = 0,
) -> SyntheticFlight:
    """Write a flight around a person who walks in a circle of 4 m.

    Files: flight.yaml, truth.csv, <camera>.json (openpose: a folder <camera>), <camera>.tum or .csv and
    <camera>_true.tum, or calibration.toml for static cameras. Cameras are called drone1, drone2, ...

    Args:
        clean: no noise at all. Two errors remain: the rounding of pixels to 0.001, 0.01 mm at 10 m, and
            the interpolation of poses, 3 micrometres.
        static: the cameras stand still, and their poses come from a calibration in Pose2Sim's format.
        bystander: a second person walks through the pictures, and is listed first in every frame.
        pose_noise: noise of the logs as stated in flight.yaml, unless clean; static cameras: a bias alone.
        keypoint_format: alphapose, coco or openpose (with COCO's joints).
        pose_format: tum or csv.
    """
    folder.mkdir(parents=True, exist_ok=True)
    detector = CLEAN_KEYPOINTS if clean else USUAL_KEYPOINTS
    noise = [] if clean else noise_models("the tests", pose_noise)
    names = [f"drone{k + 1}" for k in range(cameras)]
    t_ns = _stamps(round(seconds * fps), fps, START_NS)
    joints = _actor(_seconds(t_ns))
    position, quaternion = _camera_poses(_seconds(t_ns), cameras, static)
    log_ns = _stamps(round((seconds + 0.2) * LOG_HZ), LOG_HZ, START_NS - 100_000_000)
    true_position, true_quaternion = _camera_poses(_seconds(log_ns), cameras, static)

    sources: dict[str, dict[str, Any]] = {}
    pixels, calibrations = [], []
    for k, name in enumerate(names):
        rng = np.random.default_rng([seed, k])
        logged = disturb(noise, log_ns, true_position[k], true_quaternion[k], rng)
        if static:
            calibrations.append(pose2sim_table(name, *(rows[0] for rows in logged)))
            pose: dict[str, str] = {"file": "calibration.toml"}
        else:
            file = f"{name}.{pose_format}"
            POSE_WRITERS[pose_format](folder / file, log_ns, *logged)
            pose = {"file": file}
        write_tum(folder / f"{name}_true.tum", log_ns, true_position[k], true_quaternion[k])

        pixels.append(see(joints, position[k], quaternion[k], LENS))
        people = [TrackedKeypoints(1, *detect(pixels[-1], detector, rng))]
        if bystander:
            passing = see(_bystander(_seconds(t_ns)), position[k], quaternion[k], LENS)
            people.insert(0, TrackedKeypoints(2, *detect(passing, detector, rng)))
        keypoints = name if keypoint_format == "openpose" else f"{name}.json"
        KEYPOINT_WRITERS[keypoint_format](folder / keypoints, people)
        sources[name] = {
            "frame_times": {"start": START_NS // 10**9, "fps": fps},
            "clock": {"offset_s": 0, "sigma_s": 0},
            "pose": pose,
            "intrinsics": "calibration.toml" if static else _inline(LENS),
            "keypoints": {"file": keypoints, "format": keypoint_format, "skeleton": "coco17"},
        }
        if not clean:
            sources[name]["pose_noise"] = {name: dict(model) for name, model in pose_noise.items()}

    if static:
        (folder / "calibration.toml").write_text("\n".join(calibrations), encoding="utf-8")
    write_joints(folder / "truth.csv", t_ns, COCO17, [joints], numbered=False)
    truth = {"file": "truth.csv", "poses": {name: f"{name}_true.tum" for name in names}}
    settings = {
        "schema": 1,
        "name": "Test flight",
        "world": {"frame": "enu"},
        "cameras": sources,
        "truth": truth,
    }
    flight = SyntheticFlight(
        folder / "flight.yaml", settings, t_ns, COCO17, joints, position, quaternion, np.stack(pixels)
    )
    flight.save()
    return flight


def film_at(flight: SyntheticFlight, name: str, t_ns: Int64) -> None:
    """Film with one camera of a clean flight at other times; write its frame times to a CSV."""
    k = flight.cameras.index(name)
    position, quaternion = _camera_poses(_seconds(t_ns), len(flight.cameras), static=False)
    pixels = see(_actor(_seconds(t_ns)), position[k], quaternion[k], LENS)
    folder = flight.manifest.parent
    write_alphapose(folder / f"{name}.json", [TrackedKeypoints(1, pixels, np.ones(pixels.shape[:2]))])
    rows = [f"{frame},{stamp_ns}" for frame, stamp_ns in enumerate(t_ns.tolist())]
    (folder / f"{name}_times.csv").write_text("\n".join(["frame,t_ns", *rows]) + "\n", encoding="utf-8")
    flight.settings["cameras"][name]["frame_times"] = {"file": f"{name}_times.csv"}


def _stamps(count: int, rate_hz: int, start_ns: int) -> Int64:
    return start_ns + (np.arange(count, dtype=np.int64) * 10**9 + rate_hz // 2) // rate_hz


def _seconds(t_ns: Int64) -> Float:
    return (t_ns - START_NS) / 1e9


def _actor(t_s: Float) -> Float:
    return walk(t_s, speed_mps=_SPEED_MPS, start=(_CIRCLE_M, 0.0), heading_deg=90.0, radius_m=_CIRCLE_M)


def bystander_at(t_ns: Int64) -> Float:
    """Return the true joints [T, J, 3] of the bystander."""
    return _bystander(_seconds(t_ns))


def _bystander(t_s: Float) -> Float:
    return walk(t_s, speed_mps=0.9, start=(-3.0, -2.0), heading_deg=20.0, height_m=1.62)


def _camera_poses(t_s: Float, cameras: int, static: bool) -> tuple[Float, Float]:
    """Compute poses [N, T, 3], [N, T, 4]: on a turning ring around the walk, or still around its circle."""
    if static:
        centre = np.tile([0.0, 0.0, 1.0], (t_s.size, 1))
        position, _ = orbit(t_s, centre, cameras=cameras, yaw_rate_deg_per_s=0.0)
        return position, look_at(position, centre)
    ground, _ = route(_SPEED_MPS * t_s, start=(_CIRCLE_M, 0.0), heading_deg=90.0, radius_m=_CIRCLE_M)
    target = np.concatenate([ground, np.ones((t_s.size, 1))], axis=1)
    return orbit(t_s, target, cameras=cameras, variation=1.0)


def _inline(lens: Intrinsics) -> dict[str, Any]:
    numbers = {name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**numbers, "distortion": list(lens.distortion)}


def pose2sim_table(name: str, position: Float, quaternion: Float) -> str:
    """Format a camera of a Pose2Sim calibration: rotation vector and translation are camera_from_world."""
    translation, rotation = invert(position, quaternion)
    return "\n".join(
        [
            f"[{name}]",
            f'name = "{name}"',
            f"size = [ {LENS.width}.0, {LENS.height}.0]",
            f"matrix = {camera_matrix(LENS).tolist()}",
            f"distortions = {list(LENS.distortion)}",
            f"rotation = {rotation_vector_from_quaternion(rotation).tolist()}",
            f"translation = {translation.tolist()}",
            "fisheye = false",
            "",
        ]
    )


def _write_pose_csv(path: Path, t_ns: Int64, position: Float, quaternion: Float) -> None:
    rows = zip(t_ns.tolist(), position.tolist(), quaternion.tolist(), strict=True)
    lines = [",".join([str(stamp), *(f"{v:.9f}" for v in (*xyz, *xyzw))]) for stamp, xyz, xyzw in rows]
    path.write_text("\n".join(["t_ns,x,y,z,qx,qy,qz,qw", *lines, ""]), encoding="utf-8")


def _triples(person: TrackedKeypoints, frame: int) -> list[float]:
    rows = np.concatenate([person.xy[frame], person.confidence[frame, :, None]], axis=1)
    return [round(value, 4) for value in np.nan_to_num(rows).ravel().tolist()]


def _write_coco(path: Path, people: list[TrackedKeypoints]) -> None:
    results = [
        {"image_id": frame, "category_id": 1, "keypoints": _triples(person, frame), "score": 1.0}
        for frame in range(len(people[0].xy))
        for person in people
        if np.isfinite(person.xy[frame]).any()
    ]
    path.write_text(json.dumps(results), encoding="utf-8")


def _write_openpose(folder: Path, people: list[TrackedKeypoints]) -> None:
    folder.mkdir(exist_ok=True)
    for frame in range(len(people[0].xy)):
        content = {
            "version": 1.3,
            "people": [
                {"person_id": [-1], "pose_keypoints_2d": _triples(person, frame)}
                for person in people
                if np.isfinite(person.xy[frame]).any()
            ],
        }
        (folder / f"picture_{frame:012d}_keypoints.json").write_text(json.dumps(content), encoding="utf-8")


KEYPOINT_WRITERS: dict[str, Callable[[Path, list[TrackedKeypoints]], None]] = {
    "alphapose": write_alphapose,
    "coco": _write_coco,
    "openpose": _write_openpose,
}
POSE_WRITERS: dict[str, Callable[[Path, Int64, Float, Float], None]] = {
    "tum": write_tum,
    "csv": _write_pose_csv,
}
