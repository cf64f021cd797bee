"""Simulated flights that are described rightly or with one mistake, and random right flights.

A mistake changes the poses that are written, the keypoints, or the manifest; its codes are those of the
doubts that name it. `KEPT_ASIDE` holds flights on which no constant was tuned.
"""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from ruamel.yaml import YAML

from pipelines.check import check
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.mounting import body_from_camera
from pipelines.geometry.poses import (
    ENU_FROM_NED,
    compose,
    invert,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
)
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.reconstruction.doubts.remedies import mended
from pipelines.reconstruction.doubts.scene import Sampled
from pipelines.session.description import Doubt
from pipelines.session.errors import MocapError
from pipelines.session.people import SKELETONS
from pipelines.session.tables import POSES, read_table, trajectory_from
from pipelines.simulate import simulate

Pose = tuple[Float, Float]  # [N, 3], [N, 4]
RATE_HZ = 30
HEIGHT_PX = 720

_SCENARIO = """\
schema: 1
duration_s: {seconds}
seed: {seed}
actor:
  body: {body}
  start: {start}
  heading_deg: {heading}
  motion: {motion}
world:
  ground: {{size_m: 50}}
  mounds: [{{centre: [7, 6], sigma_m: [4, 3], height_m: 1.5}}]
  map: {{resolution_m: 0.25, height_m: 6}}
drones:
  count: {drones}
  formation: {formation}
  camera: {{width: 1280, height: 720, hfov_deg: 80, rate_hz: 30}}
  pose_noise: {noise}
keypoints: {{detector: blazepose}}
"""


@dataclass(frozen=True)
class Flight:
    """A right flight."""

    name: str
    drones: int
    motion: str
    formation: str
    seed: int
    carried: bool  # poses of the body with a mount, else of the camera
    actor: bool
    map: bool
    seconds: int = 6
    body: str = "{sex: male, height_m: 1.78}"
    start: str = "[-3, -2]"
    heading: int = 20
    noise: str = "{white: {position_m: 0.02, rotation_deg: 0.2}, bias: {position_m: 0.05, rotation_deg: 0.3}}"


_TABLES: dict[str, Any] = YAML(typ="safe").load(Path(__file__).with_suffix(".yaml"))
FLIGHTS, KEPT_ASIDE = ([Flight(**stated) for stated in _TABLES[half]] for half in ("tuned", "kept_aside"))
DOWN_DEG = 15.0
LEVER = [0.1, 0.0, -0.05]


class Described:
    """A flight's folder with its poses in TUM files, and its manifest."""

    def __init__(self, flight: Flight, folder: Path) -> None:
        self.flight = flight
        self.folder = folder
        self.names = [f"drone{number + 1}" for number in range(flight.drones)]
        self._made()
        self.cameras: dict[str, tuple[Int64, Pose]] = {}  # stamps and world_from_camera
        for name in self.names:
            track = trajectory_from(
                read_table(folder / "first.session" / "cameras" / name / "poses.parquet", POSES)
            )
            self.cameras[name] = (track.t_ns, (track.position, track.quaternion_xyzw))

    def _made(self) -> None:
        if (self.folder / "first.session" / "session.json").exists():
            return
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        scenario = self.folder / "scenario_in.yaml"
        scenario.write_text(_SCENARIO.format(**asdict(self.flight)), encoding="utf-8")
        simulate(scenario, self.folder / "made", video=False)
        ingest(self.folder / "made" / "flight.yaml", self.folder / "first.session")

    def mount(self) -> Pose:
        """Return body_from_camera."""
        return np.array(LEVER), body_from_camera("forward", DOWN_DEG)

    def logged(self, name: str) -> tuple[Int64, Pose]:
        """Return stamps and poses as the drone logs them."""
        stamps, pose = self.cameras[name]
        if self.flight.carried:
            camera_from_body = invert(*self.mount())
            pose = compose(pose, camera_from_body)
        return stamps, pose

    def manifest(self) -> dict[str, Any]:
        """Return the right manifest."""
        made = YAML(typ="safe").load((self.folder / "made" / "flight.yaml").read_text())
        cameras: dict[str, Any] = {}
        for name in self.names:
            right = made["cameras"][name]
            with (self.folder / "made" / f"{name}_frames.csv").open(encoding="utf-8") as file:
                start = float(next(csv.DictReader(file))["t_ns"]) / 1e9
            cameras[name] = {
                "frame_times": {"start": repr(start), "fps": RATE_HZ},
                "keypoints": {
                    "file": f"made/{name}_keypoints.json",
                    "format": "alphapose",
                    "skeleton": "coco17",
                },
                "intrinsics": f"made/{name}_camera.yaml",
                "pose": {"file": f"{name}.tum", "of": "body" if self.flight.carried else "camera"},
                "pose_noise": right["pose_noise"],
            }
            if self.flight.carried:
                cameras[name]["mount"] = {"looks": "forward", "down_deg": DOWN_DEG, "translation": LEVER}
        manifest: dict[str, Any] = {
            "schema": 1,
            "name": self.flight.name,
            "simulated": True,
            "world": {"frame": "enu"},
            "cameras": cameras,
        }
        if self.flight.actor:
            manifest["logs"] = {"drone1": {"file": "made/drone1.mcap"}}
            manifest["actor"] = made["actor"]
        if self.flight.map:
            manifest["map"] = "made/site.npz"
        manifest["truth"] = "made/truth/joints.csv"
        return manifest

    def intrinsics(self, name: str) -> dict[str, float]:
        """Return the right intrinsics as numbers."""
        session = json.loads((self.folder / "first.session" / "session.json").read_text())
        return dict(session["cameras"][name]["intrinsics"])


# --- mistakes: each changes the poses that are written, the keypoints, or the manifest --------------------
@dataclass
class Mistaken:
    """A description that a mistake changes in place."""

    of: Described
    manifest: dict[str, Any]
    poses: dict[str, tuple[Int64, Pose]]
    keypoints: Callable[[Float, int], Float] | None = None  # pixels [K, 3] of 17 joints and the width
    only: str | None = None  # the camera whose keypoints change; None: all

    @property
    def names(self) -> list[str]:
        return self.of.names

    def write(self, folder: Path) -> Path:
        for name, (stamps, (position, quaternion)) in self.poses.items():
            lines = [
                f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(f"{value:.9f}" for value in [*p, *q])
                for stamp, p, q in zip(stamps.tolist(), position, quaternion, strict=True)
            ]
            (folder / f"{name}.tum").write_text("\n".join(lines) + "\n", encoding="utf-8")
        if self.keypoints is not None:
            for name in self.names:
                if self.only not in (None, name):
                    continue
                found = json.loads((folder / "made" / f"{name}_keypoints.json").read_text())
                for person in found:
                    pixels = np.array(person["keypoints"]).reshape(-1, 3)
                    person["keypoints"] = self.keypoints(pixels, 1280).ravel().tolist()
                (folder / f"{name}_changed.json").write_text(json.dumps(found), encoding="utf-8")
                self.manifest["cameras"][name]["keypoints"]["file"] = f"{name}_changed.json"
        return written(self.manifest, folder / "flight.yaml")


def written(manifest: dict[str, Any], path: Path) -> Path:
    with path.open("w", encoding="utf-8") as file:
        YAML().dump(manifest, file)
    return path


Change = Callable[[Mistaken], None]


def of_poses(change: Callable[[Pose], Pose], only: str | None = None) -> Change:
    def apply(mistaken: Mistaken) -> None:
        for name in mistaken.names:
            if only in (None, name):
                stamps, pose = mistaken.poses[name]
                mistaken.poses[name] = (stamps, change(pose))

    return apply


def turned(axis: str, degrees: float) -> Float:
    return quaternion_from_rotation_vector(np.radians(degrees) * np.eye(3)["xyz".index(axis)])


def of_mounts(turn: Float, only: str | None = None) -> Change:
    """Turn what the manifest says of a camera on its body by `turn` in the camera's axes; else its poses."""

    def apply(mistaken: Mistaken) -> None:
        for name in mistaken.names:
            if only not in (None, name):
                continue
            if mistaken.of.flight.carried:
                _, rotation = mistaken.of.mount()
                mount = {"translation": LEVER, "rotation_xyzw": multiply(rotation, turn).tolist()}
                mistaken.manifest["cameras"][name]["mount"] = {**mount}
            else:
                stamps, (position, quaternion) = mistaken.poses[name]
                mistaken.poses[name] = (stamps, (position, multiply(quaternion, turn)))

    return apply


def looks_left(mistaken: Mistaken) -> None:
    """State that every camera looks to the left of the body, or write its attitude so."""
    for name in mistaken.names:
        if mistaken.of.flight.carried:
            mistaken.manifest["cameras"][name]["mount"]["looks"] = "left"
        else:
            stamps, (position, quaternion) = mistaken.poses[name]
            mistaken.poses[name] = (stamps, (position, multiply(quaternion, turned("y", -90))))


def of_cameras(change: Callable[[Mistaken, str, dict[str, Any]], None], only: str | None = None) -> Change:
    def apply(mistaken: Mistaken) -> None:
        for name in mistaken.names:
            if only in (None, name):
                change(mistaken, name, mistaken.manifest["cameras"][name])

    return apply


def focal(factor: float) -> Callable[[Mistaken, str, dict[str, Any]], None]:
    def change(mistaken: Mistaken, name: str, camera: dict[str, Any]) -> None:
        right = mistaken.of.intrinsics(name)
        sizes = {key: right[key] for key in ("width", "height", "cx", "cy")}
        camera["intrinsics"] = sizes | {"fx": right["fx"] * factor, "fy": right["fy"] * factor}

    return change


def clock(seconds: float) -> Callable[[Mistaken, str, dict[str, Any]], None]:
    def change(_: Mistaken, __: str, camera: dict[str, Any]) -> None:
        camera["frame_times"]["start"] = repr(float(camera["frame_times"]["start"]) + seconds)

    return change


def rate(fps: float) -> Callable[[Mistaken, str, dict[str, Any]], None]:
    def change(_: Mistaken, __: str, camera: dict[str, Any]) -> None:
        camera["frame_times"]["fps"] = fps

    return change


def swapped(mistaken: Mistaken) -> None:
    cameras, names = mistaken.manifest["cameras"], mistaken.names
    first, second = cameras[names[0]], cameras[names[1]]
    first["keypoints"], second["keypoints"] = second["keypoints"], first["keypoints"]


def cycled(mistaken: Mistaken) -> None:
    cameras, names = mistaken.manifest["cameras"], mistaken.names
    files = [cameras[name]["keypoints"] for name in names]
    for name, file in zip(names, files[1:] + files[:1], strict=True):
        cameras[name]["keypoints"] = file


def same_topic(mistaken: Mistaken) -> None:
    first, second = mistaken.names[:2]
    mistaken.manifest["cameras"][first]["pose"]["file"] = f"{second}.tum"


def own_origins(mistaken: Mistaken) -> None:
    for name in mistaken.names:
        stamps, (position, quaternion) = mistaken.poses[name]
        mistaken.poses[name] = (stamps, (position - position[0] + [0, 0, position[0, 2]], quaternion))


def with_keypoints(change: Callable[[Float, int], Float], only: str | None = None) -> Change:
    def apply(mistaken: Mistaken) -> None:
        mistaken.keypoints, mistaken.only = change, only

    return apply


COCO_SWAPPED = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]


def mirrored(pixels: Float, width: int) -> Float:
    return np.column_stack([width - 1 - pixels[:, 0], pixels[:, 1:]])


def from_below(pixels: Float, _: int) -> Float:
    return np.column_stack([pixels[:, 0], HEIGHT_PX - 1 - pixels[:, 1], pixels[:, 2]])


def _both(pixels: Float, width: int) -> Float:
    return mirrored(pixels, width)[COCO_SWAPPED]


def as_ned(pose: Pose) -> Pose:
    """Write the pose of a FLU body as an autopilot does: of its FRD axes, in NED."""
    position, quaternion = pose  # the same exchange of axes both ways
    turn = multiply(ENU_FROM_NED, quaternion)
    return rotate(ENU_FROM_NED, position), multiply(turn, turned("x", 180))


def ned_of_camera(pose: Pose) -> Pose:
    position, quaternion = pose
    world = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return position @ world.T, quaternion_from_matrix(world @ matrix_from_quaternion(quaternion))


def camera_as_body(mistaken: Mistaken) -> None:
    """Log the pose of the camera where the manifest says it is the body's."""
    for name in mistaken.names:
        mistaken.poses[name] = mistaken.of.cameras[name]


def body_as_camera(mistaken: Mistaken) -> None:
    """Log the pose of a body that looks forwards where the manifest says it is the camera's."""
    for name in mistaken.names:
        stamps, pose = mistaken.of.cameras[name]
        mistaken.poses[name] = (stamps, compose(pose, invert(np.zeros(3), body_from_camera("forward"))))


@dataclass(frozen=True)
class Mistake:
    """A mistake, the codes of doubts that name it, and the error that it grows.

    Attributes:
        of_a_pair: the error of two drones of which nothing says which one is where its log says.
        without_actor: the error where nothing logs the person, and the world's place is lost.
    """

    name: str
    codes: tuple[str, ...]
    change: Change
    fits: Callable[[Flight], bool] = lambda _: True
    of_a_pair: str = "mpjpe_mm"
    without_actor: str = "mpjpe_mm"

    def compared(self, flight: Flight) -> str:
        if flight.actor:
            return "mpjpe_mm"
        return self.of_a_pair if flight.drones == 2 and not flight.map else self.without_actor


def scaled(factor: float | list[int], only: str | None = None) -> Change:
    return of_poses(lambda pose: (pose[0] * factor, pose[1]), only)


def moved(shift: list[float], only: str | None = None) -> Change:
    return of_poses(lambda pose: (pose[0] + shift, pose[1]), only)


def heading(degrees: float) -> Callable[[Pose], Pose]:
    return lambda pose: (pose[0], multiply(turned("z", degrees), pose[1]))


def real_part_first(pose: Pose) -> Pose:
    return pose[0], np.roll(pose[1], 1, axis=-1)


def half_size(pixels: Float, _: int) -> Float:
    return pixels * [0.5, 0.5, 1]


def fixed_gimbal(pitch_deg: float, relative_to: str) -> Change:
    """State the mount as fixed angles of a gimbal; right: -DOWN_DEG, relative to the body."""

    def apply(mistaken: Mistaken) -> None:
        for name in mistaken.names:
            camera = mistaken.manifest["cameras"][name]
            camera["mount"] = {"looks": "forward", "translation": LEVER}
            camera["gimbal"] = {"yaw_deg": 0, "pitch_deg": pitch_deg, "relative_to": relative_to}

    return apply


def with_white_errors(pose: Pose) -> Pose:
    """Add errors of 0.3 m and 2 deg to every pose, anew in each; what is stated of them stays."""
    position, quaternion = pose
    draw = np.random.default_rng(round(1e6 * float(np.abs(position[0]).sum())))  # another one for each camera
    turn = draw.normal(0, np.radians(2), (len(position), 3))
    erring = multiply(quaternion, quaternion_from_rotation_vector(turn))
    return position + draw.normal(0, 0.3, position.shape), erring


def renamed(*parts: str) -> Callable[[Float, int], Float]:
    """Exchange left and right in the names of some joints of COCO."""
    order = [
        COCO_SWAPPED[index] if name.partition("_")[2] in parts else index
        for index, name in enumerate(SKELETONS["coco17"].joints)
    ]
    return lambda pixels, _: pixels[order]


_CARRIED = attrgetter("carried")
_ONE, _ROOT = "drone1", "root_mpjpe_mm"
_NORTH = of_poses(lambda pose: compose((np.zeros(3), turned("z", 20)), pose), _ONE)
_NAMES = with_keypoints(lambda pixels, _: pixels[COCO_SWAPPED])
MISTAKES = [
    Mistake("videos swapped", ("videos_swapped",), swapped),
    Mistake("videos cycled", ("videos_swapped",), cycled, lambda flight: flight.drones > 2),
    Mistake("focal x2, all", ("intrinsics",), of_cameras(focal(2.0))),
    Mistake("focal x1/2, all", ("intrinsics",), of_cameras(focal(0.5))),
    Mistake("focal x1.4, one", ("intrinsics",), of_cameras(focal(1.4), _ONE)),
    Mistake("upside down, all", ("mount",), of_mounts(turned("z", 180))),
    Mistake("rolled by 90, one", ("mount",), of_mounts(turned("z", 90), _ONE)),
    Mistake("tilt's sign, all", ("mount",), of_mounts(turned("x", 2 * DOWN_DEG))),
    Mistake("looks left, all", ("mount", "pose"), looks_left),
    Mistake("pictures mirrored", ("mirrored",), with_keypoints(_both)),
    Mistake("x mirrored", ("mirrored",), with_keypoints(mirrored)),
    Mistake("names mirrored", ("mirrored",), _NAMES),
    Mistake("clock 0.3 s, one", ("clock",), of_cameras(clock(0.3), _ONE)),
    Mistake("clock 0.5 s, all", ("clock",), of_cameras(clock(0.5))),
    Mistake("25 for 30 Hz, all", ("frame_rate",), of_cameras(rate(25))),
    Mistake("25 for 30 Hz, one", ("frame_rate",), of_cameras(rate(25), _ONE)),
    Mistake("origin 3 m, one", ("origin",), moved([2.4, -1.8, 0], _ONE), of_a_pair=_ROOT),
    Mistake("north 20 deg, one", ("origin",), _NORTH, of_a_pair="pa_mpjpe_mm"),
    Mistake("heading 8 deg, one", ("pose",), of_poses(heading(8), _ONE)),
    Mistake("own origins", ("origin",), own_origins, of_a_pair=_ROOT, without_actor=_ROOT),
    Mistake("another's topic", ("pose",), same_topic),
    Mistake("camera_from_world", ("convention",), of_poses(lambda pose: invert(*pose))),
    Mistake("w x y z", ("convention",), of_poses(real_part_first)),
    Mistake("camera as body", ("convention",), camera_as_body, _CARRIED),
    Mistake("body as camera", ("convention",), body_as_camera, lambda flight: not flight.carried),
    Mistake("NED as ENU, body", ("axes",), of_poses(as_ned), _CARRIED),
    Mistake("NED as ENU", ("axes",), of_poses(ned_of_camera), lambda flight: not flight.carried),
    Mistake("z alone", ("axes",), scaled([1, 1, -1])),
    Mistake("feet", ("unit",), scaled(1 / 0.3048)),
    Mistake("millimetres", ("unit",), scaled(1000)),
    Mistake("centimetres", ("unit",), scaled(100)),
    Mistake("half-size keypoints", ("keypoints_size",), with_keypoints(half_size)),
]
_X_AND_Y = of_poses(lambda pose: (pose[0][:, [1, 0, 2]], pose[1]))
_BACKWARDS = of_poses(lambda pose: (pose[0][::-1], pose[1][::-1]), _ONE)
LESS_USUAL = [
    Mistake("y from below", ("mirrored",), with_keypoints(from_below)),
    Mistake("pictures mirrored, one", ("mirrored",), with_keypoints(_both, _ONE)),
    Mistake("x mirrored, one", ("mirrored",), with_keypoints(mirrored, _ONE)),
    Mistake("half-size keypoints, one", ("keypoints_size",), with_keypoints(half_size, _ONE)),
    Mistake("names: knees, ankles", ("mirrored", "body"), with_keypoints(renamed("knee", "ankle"))),
    Mistake("names: elbows, wrists", ("mirrored", "body"), with_keypoints(renamed("elbow", "wrist"))),
    Mistake("names: legs", ("mirrored", "body"), with_keypoints(renamed("hip", "knee", "ankle"))),
    Mistake("gimbal: of world", ("gimbal",), fixed_gimbal(-DOWN_DEG, "world"), _CARRIED),
    Mistake("gimbal: pitch's sign", ("gimbal", "mount"), fixed_gimbal(DOWN_DEG, "body"), _CARRIED),
    Mistake("errors 0.3 m, 2 deg, not stated", ("noise",), of_poses(with_white_errors)),
    Mistake("poses backwards, one", ("pose",), _BACKWARDS),
    Mistake("x and y exchanged", ("axes",), _X_AND_Y),
    Mistake("all headings 90 deg", ("pose", "axes", "mount"), of_poses(heading(90))),
    Mistake("all headings -30 deg", ("pose",), of_poses(heading(-30))),
    Mistake("feet, one", ("unit",), scaled(1 / 0.3048, _ONE)),
    Mistake("w x y z, one", ("convention", "pose"), of_poses(real_part_first, _ONE)),
    Mistake("height 5 m off, all", ("origin", "actor", "ground"), moved([0, 0, 5])),
    Mistake("clock -1.2 s, one", ("clock",), of_cameras(clock(-1.2), _ONE)),
    Mistake("60 for 30 Hz, all", ("frame_rate",), of_cameras(rate(60))),
]


# --- measuring ---------------------------------------------------------------------------------------------
def mistaken(described: Described, change: Change | None) -> Path:
    """Write the flight with a mistake, or right."""
    description = Mistaken(
        described, described.manifest(), {name: described.logged(name) for name in described.names}
    )
    if change is not None:
        change(description)
    return description.write(described.folder)


def measured(manifest: Path, error: str = "mpjpe_mm") -> tuple[float | None, list[dict[str, Any]], str]:
    """Ingest and reconstruct; return an error (MPJPE, None without), doubts, and what stopped it."""
    session = manifest.with_suffix(".session")
    shutil.rmtree(session, ignore_errors=True)
    try:
        ingest(manifest, session)
        metrics = reconstruct(session, ReconstructSettings(method="robust")).metrics
    except MocapError as stop:
        doubts = check(session).doubts if (session / "session.json").exists() else []
        return None, [doubt.as_json() for doubt in doubts], str(stop)
    return metrics[error], metrics["doubts"], ""


def with_remedy(manifest: Path, remedy: str) -> bool:
    """Put the lines of a remedy into a manifest; False if it is no line."""
    text = mended(manifest.read_text(encoding="utf-8"), remedy)
    if text is not None:
        manifest.write_text(text, encoding="utf-8")
    return text is not None


_MOTIONS = (
    "[walk: {distance_m: 7, turn_deg: 60}]",
    "[jog: {distance_m: 14, turn_deg: -30}]",
    "[stand: {seconds: 6}]",
    "[crouch: {seconds: 3, depth: 0.9}, walk: {distance_m: 3}]",
    "[kick: {foot: right, run_up_m: 3}, turn: {deg: 180}]",
    "[turn: {deg: 270}, reach: {side: left, height_m: 2.0}, walk: {distance_m: 2}]",
)
_NOISES = (
    "{white: {position_m: 0.02, rotation_deg: 0.2}, bias: {position_m: 0.05, rotation_deg: 0.3}}",
    "{white: {position_m: 0.3, rotation_deg: 1}}",
    "{bias: {position_m: 0.5, rotation_deg: 2}}",
    "{white: {position_m: 0.5, rotation_deg: 2}}",
    "{gauss-markov: {position_m: 0.3, rotation_deg: 0.5, correlation_s: 10}}",
)


def right_flight(seed: int) -> Flight:
    """Draw a right flight: motion, people, drones, formation, stated noise, what was logged."""
    draw = np.random.default_rng(seed)
    moving = f", yaw_rate_deg_per_s: {draw.uniform(-10, 10):.1f}" if draw.random() < 0.5 else ""
    formation = (
        f"{{radius_m: {draw.uniform(6, 14):.1f}, tilt_deg: {draw.uniform(5, 40):.0f},"
        f" yaw_deg: {draw.uniform(0, 360):.0f}{moving}}}"
    )
    sex = ("male", "female")[int(draw.integers(2))]
    return Flight(
        f"right{seed}",
        int(draw.integers(2, 5)),
        _MOTIONS[int(draw.integers(len(_MOTIONS)))],
        formation,
        seed,
        carried=bool(draw.random() < 0.5),
        actor=bool(draw.random() < 0.5),
        map=bool(draw.random() < 0.5),
        body=f"{{sex: {sex}, height_m: {draw.normal(1.78 if sex == 'male' else 1.65, 0.07):.2f}}}",
        heading=int(draw.integers(360)),
        noise=_NOISES[int(draw.integers(len(_NOISES)))],
    )


def write_bvh(motion: str, path: Path, rate_hz: int = 60) -> None:
    """Write a motion of the table as BVH, cm and y up, with angles that are linear between its keys."""
    lines: list[str] = ["HIERARCHY"]
    order: list[str] = []

    def write_bone(name: str, depth: int) -> None:
        x, y, z = _TABLES["bones"][name][1]
        channels = "3" if depth else "6 Xposition Yposition Zposition"
        lines.extend([f"{'JOINT' if depth else 'ROOT'} {name}", "{", f"OFFSET {x} {y} {z}"])
        lines.append(f"CHANNELS {channels} Zrotation Yrotation Xrotation")
        order.append(name)
        children = [child for child, (parent, _) in _TABLES["bones"].items() if parent == name]
        for child in children:
            write_bone(child, depth + 1)
        if not children:
            lines.extend(["End Site", "{", "OFFSET 0 5 0", "}"])
        lines.append("}")

    write_bone("Hips", 0)
    times, rows = [], []
    for time_s, place, turn, held in _TABLES["acrobatics"][motion]:
        times.append(time_s)
        limbs = [_TABLES["holds"][held].get(name, (0, 0, 0)) for name in order[1:]]
        rows.append(np.concatenate([place, turn, *limbs]))
    at = np.arange(0, times[-1] + 0.5 / rate_hz, 1 / rate_hz)
    columns = [np.interp(at, times, column) for column in np.transpose(rows)]
    lines += ["MOTION", f"Frames: {len(at)}", f"Frame Time: {1 / rate_hz:.6f}"]
    lines += [" ".join(f"{value:.4f}" for value in row) for row in np.transpose(columns)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def acrobatic_flight(seed: int, folder: Path) -> Flight:
    """Draw a right flight as `right_flight` does, of somebody who lies or turns cartwheels."""
    motions = list(_TABLES["acrobatics"])
    motion = motions[seed % len(motions)]
    path = (folder / f"{motion.replace(' ', '_')}.bvh").resolve()
    folder.mkdir(parents=True, exist_ok=True)
    write_bvh(motion, path)
    return replace(right_flight(seed), name=f"acrobat{seed}", motion=f"{{bvh: {path}}}")


def sampled_of(manifest: Path) -> Sampled:
    """Return what `check` diagnoses of a flight."""
    seen: list[Sampled] = []

    def kept(sampled: Sampled | None, *_: object) -> list[Doubt]:
        seen.extend([] if sampled is None else [sampled])
        return []

    with patch("pipelines.reconstruction.doubts.diagnosis.diagnose", kept):
        check(manifest)
    return seen[0]
