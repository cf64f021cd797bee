"""Simulated flights that are described rightly or with one mistake, and random right flights.

A mistake changes the poses that are written, the keypoints, or the manifest; its codes are those of the
doubts that name it. `KEPT_ASIDE` holds flights on which no constant was tuned.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
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


_NOISY = "{white: {position_m: 0.1, rotation_deg: 0.5}, bias: {position_m: 0.2, rotation_deg: 0.7}}"
FLIGHTS = [
    Flight(
        "kick3",
        3,
        "[walk: {distance_m: 3}, kick: {foot: right, run_up_m: 2}]",
        "{radius_m: 10, tilt_deg: 15, yaw_deg: 20}",
        1,
        True,
        True,
        True,
    ),
    Flight(
        "walk2",
        2,
        "[walk: {distance_m: 7, turn_deg: 60}]",
        "{radius_m: 9, tilt_deg: 20, yaw_deg: 70, yaw_rate_deg_per_s: 6}",
        2,
        False,
        True,
        True,
        body="{sex: female, height_m: 1.66}",
    ),
    Flight(
        "jog2",
        2,
        "[jog: {distance_m: 14, turn_deg: -40, speed_mps: 2.6}]",
        "{radius_m: 10, tilt_deg: 12, yaw_deg: 150}",
        3,
        True,
        False,
        False,
        start="[-7, 0]",
    ),
    Flight(
        "crouch3",
        3,
        "[crouch: {seconds: 2, depth: 0.7}, turn: {deg: 90}, walk: {distance_m: 3}]",
        "{radius_m: 8, tilt_deg: 25, yaw_deg: 210, yaw_rate_deg_per_s: -8}",
        4,
        False,
        False,
        True,
        noise=_NOISY,
    ),
    Flight(
        "reach3",
        3,
        "[walk: {distance_m: 4, turn_deg: -50}, reach: {side: right, height_m: 1.9}]",
        "{radius_m: 9, tilt_deg: 18, yaw_deg: 300, yaw_rate_deg_per_s: 5}",
        11,
        True,
        False,
        True,
        body="{sex: female, height_m: 1.72}",
    ),
]
KEPT_ASIDE = [
    Flight(
        "turn3",
        3,
        "[walk: {distance_m: 3, turn_deg: 40}, turn: {deg: -90}, walk: {distance_m: 3}]",
        "{radius_m: 9, tilt_deg: 20, yaw_deg: 170, yaw_rate_deg_per_s: -6}",
        15,
        True,
        False,
        True,
        body="{sex: female, height_m: 1.72}",
    ),
    Flight(
        "kick2",
        2,
        "[kick: {foot: left, run_up_m: 3}, walk: {distance_m: 2}]",
        "{radius_m: 8, tilt_deg: 14, yaw_deg: 40}",
        12,
        True,
        True,
        False,
        heading=120,
    ),
    Flight(
        "walk2b",
        2,
        "[walk: {distance_m: 4}, turn: {deg: 120}, walk: {distance_m: 3}]",
        "{radius_m: 11, tilt_deg: 22, yaw_deg: 260, yaw_rate_deg_per_s: 7}",
        13,
        False,
        False,
        True,
        noise=_NOISY,
    ),
    Flight(
        "jog3",
        3,
        "[jog: {distance_m: 15, turn_deg: 70, speed_mps: 2.8}]",
        "{radius_m: 10, tilt_deg: 10, yaw_deg: 95}",
        14,
        False,
        True,
        False,
        start="[-6, -4]",
    ),
]
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
        fields = {
            name: getattr(self.flight, name)
            for name in (
                "seconds",
                "seed",
                "body",
                "start",
                "heading",
                "motion",
                "drones",
                "formation",
                "noise",
            )
        }
        scenario.write_text(_SCENARIO.format(**fields), encoding="utf-8")
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
    half = np.radians(degrees) / 2
    return np.array(
        [
            np.sin(half) * (axis == "x"),
            np.sin(half) * (axis == "y"),
            np.sin(half) * (axis == "z"),
            np.cos(half),
        ]
    )


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
    name: str
    codes: tuple[str, ...]
    change: Change
    fits: Callable[[Flight], bool] = lambda _: True
    compared: Callable[[Flight], str] = lambda _: "mpjpe_mm"  # another error where the world's place is lost


def _mistakes() -> list[Mistake]:
    one = "drone1"
    still = np.zeros(3)

    def carried(flight: Flight) -> bool:
        return flight.carried

    def own(flight: Flight) -> bool:
        return not flight.carried

    def unplaced_pair(flight: Flight) -> bool:
        """Test if nothing says which of two drones is where its log says."""
        return flight.drones == 2 and not flight.actor and not flight.map

    return [
        Mistake("videos swapped", ("videos_swapped",), swapped),
        Mistake("videos cycled", ("videos_swapped",), cycled, lambda flight: flight.drones > 2),
        Mistake("focal x2, all", ("intrinsics",), of_cameras(focal(2.0))),
        Mistake("focal x1/2, all", ("intrinsics",), of_cameras(focal(0.5))),
        Mistake("focal x1.4, one", ("intrinsics",), of_cameras(focal(1.4), one)),
        Mistake("upside down, all", ("mount",), of_mounts(turned("z", 180))),
        Mistake("rolled by 90, one", ("mount",), of_mounts(turned("z", 90), one)),
        Mistake("tilt's sign, all", ("mount",), of_mounts(turned("x", 2 * DOWN_DEG))),
        Mistake("looks left, all", ("mount", "pose"), looks_left),
        Mistake("pictures mirrored", ("mirrored",), with_keypoints(_both)),
        Mistake("x mirrored", ("mirrored",), with_keypoints(mirrored)),
        Mistake("names mirrored", ("mirrored",), with_keypoints(lambda pixels, _: pixels[COCO_SWAPPED])),
        Mistake("clock 0.3 s, one", ("clock",), of_cameras(clock(0.3), one)),
        Mistake("clock 0.5 s, all", ("clock",), of_cameras(clock(0.5))),
        Mistake("25 for 30 Hz, all", ("frame_rate",), of_cameras(rate(25))),
        Mistake("25 for 30 Hz, one", ("frame_rate",), of_cameras(rate(25), one)),
        Mistake(
            "origin 3 m, one",
            ("origin",),
            moved(np.array([2.4, -1.8, 0]), one),
            compared=lambda flight: "root_mpjpe_mm" if unplaced_pair(flight) else "mpjpe_mm",
        ),
        Mistake(
            "north 20 deg, one",
            ("origin",),
            of_poses(lambda pose: compose((still, turned("z", 20)), pose), one),
            compared=lambda flight: "pa_mpjpe_mm" if unplaced_pair(flight) else "mpjpe_mm",
        ),
        Mistake("heading 8 deg, one", ("pose",), of_poses(heading(8), one)),
        Mistake(
            "own origins",
            ("origin",),
            own_origins,
            compared=lambda flight: "mpjpe_mm" if flight.actor else "root_mpjpe_mm",
        ),
        Mistake("another's topic", ("pose",), same_topic),
        Mistake("camera_from_world", ("convention",), of_poses(lambda pose: invert(*pose))),
        Mistake("w x y z", ("convention",), of_poses(lambda pose: (pose[0], np.roll(pose[1], 1, axis=-1)))),
        Mistake("camera as body", ("convention",), camera_as_body, carried),
        Mistake("body as camera", ("convention",), body_as_camera, own),
        Mistake("NED as ENU, body", ("axes",), of_poses(as_ned), carried),
        Mistake("NED as ENU", ("axes",), of_poses(ned_of_camera), own),
        Mistake("z alone", ("axes",), of_poses(lambda pose: (pose[0] * [1, 1, -1], pose[1]))),
        Mistake("feet", ("unit",), of_poses(lambda pose: (pose[0] / 0.3048, pose[1]))),
        Mistake("millimetres", ("unit",), of_poses(lambda pose: (pose[0] * 1000, pose[1]))),
        Mistake("centimetres", ("unit",), of_poses(lambda pose: (pose[0] * 100, pose[1]))),
        Mistake("half-size keypoints", ("keypoints_size",), with_keypoints(lambda px, _: px * [0.5, 0.5, 1])),
    ]


def moved(shift: Float, only: str) -> Change:
    return of_poses(lambda pose: (pose[0] + shift, pose[1]), only)


def heading(degrees: float) -> Callable[[Pose], Pose]:
    return lambda pose: (pose[0], multiply(turned("z", degrees), pose[1]))


MISTAKES = _mistakes()


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


def renamed(pixels: Float, *parts: str) -> Float:
    """Exchange left and right in the names of some joints of COCO."""
    order = [
        COCO_SWAPPED[index] if name.partition("_")[2] in parts else index
        for index, name in enumerate(SKELETONS["coco17"].joints)
    ]
    return pixels[order]


def _less_usual() -> list[Mistake]:
    one = "drone1"

    def carried(flight: Flight) -> bool:
        return flight.carried

    def x_and_y(pose: Pose) -> Pose:
        return pose[0][:, [1, 0, 2]], pose[1]

    def of_all(degrees: float) -> Change:
        return of_poses(heading(degrees))

    return [
        Mistake("y from below", ("mirrored",), with_keypoints(from_below)),
        Mistake("pictures mirrored, one", ("mirrored",), with_keypoints(_both, one)),
        Mistake("x mirrored, one", ("mirrored",), with_keypoints(mirrored, one)),
        Mistake(
            "half-size keypoints, one",
            ("keypoints_size",),
            with_keypoints(lambda px, _: px * [0.5, 0.5, 1], one),
        ),
        Mistake(
            "names: knees, ankles",
            ("mirrored", "body"),
            with_keypoints(lambda px, _: renamed(px, "knee", "ankle")),
        ),
        Mistake(
            "names: elbows, wrists",
            ("mirrored", "body"),
            with_keypoints(lambda px, _: renamed(px, "elbow", "wrist")),
        ),
        Mistake(
            "names: legs",
            ("mirrored", "body"),
            with_keypoints(lambda px, _: renamed(px, "hip", "knee", "ankle")),
        ),
        Mistake("gimbal: of world", ("gimbal",), fixed_gimbal(-DOWN_DEG, "world"), carried),
        Mistake("gimbal: pitch's sign", ("gimbal", "mount"), fixed_gimbal(DOWN_DEG, "body"), carried),
        Mistake("errors 0.3 m, 2 deg, not stated", ("noise",), of_poses(with_white_errors)),
        Mistake(
            "poses backwards, one", ("pose",), of_poses(lambda pose: (pose[0][::-1], pose[1][::-1]), one)
        ),
        Mistake("x and y exchanged", ("axes",), of_poses(x_and_y)),
        Mistake("all headings 90 deg", ("pose", "axes", "mount"), of_all(90)),
        Mistake("all headings -30 deg", ("pose",), of_all(-30)),
        Mistake("feet, one", ("unit", "origin"), of_poses(lambda pose: (pose[0] / 0.3048, pose[1]), one)),
        Mistake(
            "w x y z, one",
            ("convention", "pose"),
            of_poses(lambda pose: (pose[0], np.roll(pose[1], 1, axis=-1)), one),
        ),
        Mistake(
            "height 5 m off, all",
            ("origin", "actor", "ground"),
            of_poses(lambda pose: (pose[0] + [0, 0, 5], pose[1])),
        ),
        Mistake("clock -1.2 s, one", ("clock",), of_cameras(clock(-1.2), one)),
        Mistake("60 for 30 Hz, all", ("frame_rate",), of_cameras(rate(60))),
    ]


LESS_USUAL = _less_usual()


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


# Angles (deg) by which bones turn about z, y and x; y is up, z ahead, and at rest the arms point aside.
_ARMS_DOWN: dict[str, tuple[float, ...]] = {"LeftArm": (-75, 0, 0), "RightArm": (75, 0, 0)}
_STAR: dict[str, tuple[float, ...]] = {
    "LeftArm": (60, 0, 0),
    "RightArm": (-60, 0, 0),
    "LeftUpLeg": (35, 0, 0),
    "RightUpLeg": (-35, 0, 0),
}
_BONES = (  # name, the bone it hangs on, offset from it in cm
    ("Hips", None, (0, 0, 0)),
    ("Spine", "Hips", (0, 12, 0)),
    ("Chest", "Spine", (0, 22, 0)),
    ("Neck", "Chest", (0, 20, 0)),
    ("Head", "Neck", (0, 10, 2)),
    *(
        bone
        for side, sign in (("Left", 1), ("Right", -1))
        for bone in (
            (f"{side}Arm", "Chest", (18 * sign, 16, 0)),
            (f"{side}ForeArm", f"{side}Arm", (28 * sign, 0, 0)),
            (f"{side}Hand", f"{side}ForeArm", (25 * sign, 0, 0)),
            (f"{side}UpLeg", "Hips", (9 * sign, -6, 0)),
            (f"{side}Leg", f"{side}UpLeg", (0, -42, 0)),
            (f"{side}Foot", f"{side}Leg", (0, -42, 0)),
            (f"{side}ToeBase", f"{side}Foot", (0, -6, 14)),
        )
    ),
)
_Key = tuple[float, tuple[float, float, float], tuple[float, float, float], dict[str, tuple[float, ...]]]
# Time (s), place (cm) and turn (deg, about z, y, x) of the hips, and of bones.
ACROBATICS: dict[str, tuple[_Key, ...]] = {
    "lies down and gets up": (
        (0, (0, 96, 0), (0, 0, 0), _ARMS_DOWN),
        (1.5, (0, 14, 60), (0, 0, -90), _ARMS_DOWN),
        (4.0, (0, 14, 60), (0, 0, -90), _STAR),
        (6, (0, 96, 0), (0, 0, 0), _ARMS_DOWN),
    ),
    "lies on the back": (
        (0, (0, 14, 0), (0, 0, -90), _ARMS_DOWN),
        (2, (0, 14, 0), (0, 0, -90), _STAR),
        (4, (0, 14, 0), (0, 0, -90), _ARMS_DOWN),
        (6, (0, 14, 0), (0, 0, -90), _STAR),
    ),
    "lies on the face": (
        (0, (0, 14, 0), (0, 0, 90), _ARMS_DOWN),
        (3, (0, 14, 0), (0, 0, 90), _STAR),
        (6, (0, 14, 0), (0, 0, 90), _ARMS_DOWN),
    ),
    "lies on the side": (
        (0, (0, 20, 0), (90, 0, 0), _ARMS_DOWN),
        (3, (0, 20, 0), (90, 0, 0), _STAR),
        (6, (0, 20, 0), (90, 0, 0), _ARMS_DOWN),
    ),
    "turns cartwheels": (
        (0, (0, 96, 0), (0, 0, 0), _ARMS_DOWN),
        (0.8, (0, 90, 0), (0, 0, 0), _STAR),
        (2.3, (-220, 90, 0), (360, 0, 0), _STAR),
        (3.2, (-230, 90, 0), (360, 0, 0), _STAR),
        (4.7, (-450, 90, 0), (720, 0, 0), _STAR),
        (6, (-450, 96, 0), (720, 0, 0), _ARMS_DOWN),
    ),
}


def write_bvh(keys: tuple[_Key, ...], path: Path, rate_hz: int = 60) -> None:
    """Write a motion as BVH, cm and y up, with angles that are linear between its keys."""
    lines: list[str] = ["HIERARCHY"]

    def bone(name: str, offset: tuple[int, int, int], depth: int) -> None:
        indent = "  " * depth
        channels = "6 Xposition Yposition Zposition" if depth == 0 else "3"
        lines.extend([f"{indent}{'JOINT' if depth else 'ROOT'} {name}", indent + "{"])
        lines.append(f"{indent}  OFFSET {offset[0]} {offset[1]} {offset[2]}")
        lines.append(f"{indent}  CHANNELS {channels} Zrotation Yrotation Xrotation")
        order.append(name)
        children = [each for each in _BONES if each[1] == name]
        for child, _, its_offset in children:
            bone(child, its_offset, depth + 1)
        if not children:
            lines.extend([f"{indent}  End Site", indent + "  {", f"{indent}    OFFSET 0 5 0", indent + "  }"])
        lines.append(indent + "}")

    order: list[str] = []
    bone("Hips", (0, 0, 0), 0)
    times = [key[0] for key in keys]
    rows = [
        [*key[1], *key[2], *(v for name in order[1:] for v in key[3].get(name, (0, 0, 0)))] for key in keys
    ]
    at = np.arange(0, times[-1] + 0.5 / rate_hz, 1 / rate_hz)
    columns = [np.interp(at, times, column) for column in zip(*rows, strict=True)]
    lines += ["MOTION", f"Frames: {len(at)}", f"Frame Time: {1 / rate_hz:.6f}"]
    lines += [" ".join(f"{value:.4f}" for value in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def acrobatic_flight(seed: int, folder: Path) -> Flight:
    """Draw a right flight as `right_flight` does, of somebody who lies or turns cartwheels."""
    names = list(ACROBATICS)
    motion = names[seed % len(names)]
    path = (folder / f"{motion.replace(' ', '_')}.bvh").resolve()
    folder.mkdir(parents=True, exist_ok=True)
    write_bvh(ACROBATICS[motion], path)
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
