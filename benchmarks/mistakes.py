"""Mistakes in a flight's description: are they doubted, named, and does the remedy mend them?

    python -m benchmarks.mistakes [--folder FOLDER] [--kept] [FLIGHT ...]
    python -m benchmarks.mistakes --bound 10    # what the standard deviations of remedies make of the error
    python -m benchmarks.mistakes --less-usual  # other mistakes, on the flights tuned on
    python -m benchmarks.mistakes --right 40    # random right flights: none should be doubted
    python -m benchmarks.mistakes --acrobats 40    # the same of people who lie or turn cartwheels
    python -m benchmarks.mistakes --right 200 --any --seed 2000    # of both kinds
    python -m benchmarks.mistakes --corpus tuning|kept [--draws 1] [--mistake none] [FLIGHT ...]  # film
    python -m benchmarks.mistakes --time    # of doubts in `reconstruct`, of `check` on ten minutes, on film
    python -m benchmarks.mistakes --untold 60    # what untold mistakes change, and what chance does

Right flights (simulated, modelled keypoints) are described anew with one mistake each. A mistake counts if
the error of the skeleton grows by more than 20 %, or nothing can be reconstructed. `named`: the first doubt
has the right code. `mended`: the lines of its remedy, put into the manifest, bring the error back to within
10 % of the right one. The flights of `KEPT_ASIDE` are measured with --kept only; no constant was tuned on
them. With --bound, a remedy that mends less is compared with its standard deviations: the right flight is
reconstructed so many times, each time with errors drawn from them in the poses that the remedy changes.

With --corpus, the flights are those of `benchmarks.corpus`: rendered pictures, keypoints of the real
detector, backgrounds, and logs drawn anew. They are checked as they are, with and without a stated model of
the poses' errors, and with mistakes in the times of all pictures, which backgrounds alone can tell.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import permutations, product
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, get_args
from unittest.mock import patch

import av
import numpy as np
from ruamel.yaml import YAML

from benchmarks.corpus.drawn import DrawnFlight, Given, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS, HALVES, Half, flights
from benchmarks.corpus.stored import Flight as CorpusFlight
from pipelines.check import check
from pipelines.detect import detect
from pipelines.follow import Following
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.mounting import body_from_camera
from pipelines.geometry.poses import (
    compose,
    enu_from_ned,
    invert,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
)
from pipelines.ingest import ingest
from pipelines.reconstruct import Settings, reconstruct
from pipelines.reconstruction.doubts.diagnosis import Diagnosis, doubts_of
from pipelines.reconstruction.doubts.faults import Fault, fit
from pipelines.reconstruction.doubts.hypotheses import RATES, Trial
from pipelines.reconstruction.doubts.scene import Sampled, Scene, scene_of
from pipelines.reconstruction.doubts.score import base_of, score
from pipelines.session.description import Doubt
from pipelines.session.errors import MocapError
from pipelines.session.skeletons import SKELETONS
from pipelines.session.stages import locked
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
                    "path": f"made/{name}_keypoints.json",
                    "format": "alphapose",
                    "skeleton": "coco17",
                },
                "intrinsics": f"made/{name}_camera.yaml",
                "pose": {"tum": f"{name}.tum", "of": "body" if self.flight.carried else "camera"},
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
            manifest["logs"] = {"drone1": {"path": "made/drone1.mcap"}}
            manifest["actor"] = made["actor"]
        if self.flight.map:
            manifest["map"] = "made/site.bt"
        manifest["truth"] = {"joints": "made/truth/joints.csv"}
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
                self.manifest["cameras"][name]["keypoints"]["path"] = f"{name}_changed.json"
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
                mistaken.manifest["cameras"][name]["mount"] = {"body_from_camera": mount}
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
    mistaken.manifest["cameras"][first]["pose"]["tum"] = f"{second}.tum"


def without_first(mistaken: Mistaken) -> None:
    """Leave the first drone out: no mistake, but what a mistake in its poses can cost at most."""
    del mistaken.manifest["cameras"][mistaken.names[0]]


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
    position, quaternion = enu_from_ned(*pose)  # the same exchange of axes both ways
    return position, multiply(quaternion, turned("x", 180))


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
            camera["gimbal"] = {"fixed": {"yaw_deg": 0, "pitch_deg": pitch_deg}, "relative_to": relative_to}

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
        metrics = reconstruct(session, Settings(method="robust")).metrics
    except MocapError as stop:
        doubts = check(session).doubts if (session / "session.json").exists() else []
        return None, [doubt.as_json() for doubt in doubts], str(stop)
    return metrics[error], metrics["doubts"], ""


def with_remedy(manifest: Path, remedy: str) -> bool:
    """Put the lines of a remedy into a manifest; False if it is no line."""
    yaml = YAML(typ="safe")
    document = yaml.load(manifest.read_text())
    for line in remedy.split("; "):
        path, _, value = line.partition(": ")
        keys = path.split(".")
        if not value or keys[0] not in document or "..." in value:
            return False
        place = document
        for key in keys[:-1]:
            if not isinstance(place.get(key), dict):
                place[key] = {}
            place = place[key]
        place[keys[-1]] = deepcopy(yaml.load(value))
    written(document, manifest)
    return True


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


def doubted_right_flights(folder: Path, flights: Iterable[Flight]) -> None:
    """Check right flights, and print those that are doubted."""
    doubted = count = 0
    for flight in flights:
        count += 1
        manifest = mistaken(Described(flight, folder / flight.name), None)
        doubts = check(manifest).doubts
        doubted += bool(doubts)
        if doubts:
            print(f"{flight}\n  {doubts[0].code}: {doubts[0].what} {doubts[0].evidence}", flush=True)
    print(f"{doubted} of {count} right flights doubted")


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


def any_right_flight(seed: int, folder: Path) -> Flight:
    """Draw a right flight: every third is of somebody who lies, lies down, or turns cartwheels."""
    return acrobatic_flight(seed, folder) if seed % 3 == 0 else right_flight(seed)


def _print_check(what: str, path: Path) -> None:
    start, clock_s = process_time(), perf_counter()
    doubts = check(path).doubts
    took, took_s = process_time() - start, perf_counter() - clock_s
    said = f"{doubts[0].code}: {doubts[0].what}" if doubts else "none"
    print(f"| `check` of {what} | {took:.1f} | {took_s:.1f} | {said} |", flush=True)


_LONG = Flight(
    "long3",
    3,
    "{steps: [walk: {distance_m: 6, turn_deg: 90}, turn: {deg: 90}], repeat: true}",
    "{radius_m: 10, tilt_deg: 15, yaw_deg: 20, yaw_rate_deg_per_s: 2}",
    1,
    carried=False,
    actor=True,
    map=True,
    seconds=600,
)


def ten_minutes_of_film(sample: Path, session: Path, folder: Path) -> Path:
    """Repeat the sample's film and poses until they last ten minutes; return the manifest.

    Poses jump where the repetitions meet. The middle, which `check` looks at, lies between two of these.
    """
    folder.mkdir(exist_ok=True)
    document = YAML(typ="safe").load((sample / "flight.yaml").read_text(encoding="utf-8"))
    for name, camera in document["cameras"].items():
        length_s = _repeat_film(sample / f"{name}.mp4", folder / f"{name}.mp4", _REPETITIONS)
        track = trajectory_from(read_table(session / "cameras" / name / "poses.parquet", POSES))
        start_ns, length_ns = round(float(camera["frame_times"]["start"]) * 1e9), round(length_s * 1e9)
        used = (track.t_ns >= start_ns) & (track.t_ns < start_ns + length_ns)
        rows = [
            f"{(stamp + turn * length_ns) / 1e9:.6f} " + " ".join(f"{value:.6f}" for value in [*p, *q])
            for turn in range(_REPETITIONS)
            for stamp, p, q in zip(
                track.t_ns[used].tolist(), track.position[used], track.quaternion_xyzw[used], strict=True
            )
        ]
        (folder / f"{name}.tum").write_text("\n".join(rows) + "\n", encoding="utf-8")
        camera["pose"] = {"tum": f"{name}.tum", "of": "camera"}
        camera["intrinsics"] = str(sample / camera["intrinsics"])
        del camera["mount"], camera["gimbal"]
    document["map"] = str(sample / document["map"])
    for key in ("logs", "actor", "truth"):
        del document[key]
    return written(document, folder / "flight.yaml")


_REPETITIONS = 51  # of 12 s


def _repeat_film(film: Path, repeated: Path, times: int) -> float:
    """Write a film so many times one after the other, without coding it anew; return its length in s."""
    with av.open(str(film)) as source, av.open(str(repeated), "w") as target:
        stream = source.streams.video[0]
        base = stream.time_base or Fraction(1, 1000)
        packets = [packet for packet in source.demux(stream) if packet.dts is not None]
        copy = target.add_stream_from_template(stream)
        stamps = sorted(packet.pts or 0 for packet in packets)
        length = stamps[-1] - stamps[0] + (stamps[-1] - stamps[0]) // (len(stamps) - 1)
        for turn, packet in product(range(times), packets):
            again = av.Packet(bytes(packet))
            again.pts, again.dts = (packet.pts or 0) + turn * length, (packet.dts or 0) + turn * length
            again.is_keyframe, again.time_base = packet.is_keyframe, base
            again.duration, again.stream = packet.duration, copy
            target.mux(again)
        return float(length * base)


def print_times(folder: Path) -> None:
    """Print processor seconds: of the doubts in `reconstruct` of the sample, and of `check`.

    What is checked is the sample's film, right, ten minutes long, and with clocks that are off, and a flight
    of ten minutes with keypoints.
    """
    sample = folder / "sample"
    shutil.copytree(Path(__file__).parents[1] / "sample_data" / "mound_walk", sample, dirs_exist_ok=True)
    session = folder / "sample.session"
    shutil.rmtree(session, ignore_errors=True)
    ingest(sample / "flight.yaml", session)
    detect_s = process_time()
    with locked(session) as writable:
        detect(writable, detector=DETECTORS[0])
    detect_s = process_time() - detect_s
    seconds: list[float] = []

    def timed(*arguments: Any, **named: Any) -> list[Doubt]:
        start = process_time()
        found = doubts_of(*arguments, **named)
        seconds.append(process_time() - start)
        return found

    with patch("pipelines.attempt.doubts_of", timed):
        start = process_time()
        reconstruct(session, Settings())
        whole = process_time() - start
    print("| | processor s | s | doubt |\n| --- | --- | --- | --- |")
    print(f"| detection of the sample | {detect_s:.1f} | | |")
    print(f"| `reconstruct` of the sample, with doubts | {whole:.1f} | | |")
    print(f"| of that, doubts | {seconds[0]:.2f} | | |")
    _print_check("600 s", mistaken(Described(_LONG, folder / _LONG.name), None))
    _print_check("600 s, ingested", folder / _LONG.name / "first.session")
    _print_check("the sample's film", sample / "flight.yaml")
    _print_check("ten minutes of film", ten_minutes_of_film(sample, session, folder / "ten"))
    for late_s, names in ((0.5, ["drone1", "drone2"]), (-0.5, ["drone1", "drone2"]), (0.3, ["drone1"])):
        document = YAML(typ="safe").load((sample / "flight.yaml").read_text(encoding="utf-8"))
        _later(document["cameras"], names, late_s)
        what = f"the same, clocks of {' and '.join(names)} {late_s:+.1f} s"
        _print_check(what, written(document, sample / "late.yaml"))
    print(f"doubts take {seconds[0] / (whole - seconds[0]):.1%} on top of the rest of `reconstruct`")


def sampled_of(manifest: Path) -> Sampled:
    """Return what `check` diagnoses of a flight."""
    seen: list[Sampled] = []

    def kept(sampled: Sampled | None, *_: object) -> Diagnosis:
        seen.extend([] if sampled is None else [sampled])
        return Diagnosis([], float("nan"), 0)

    with patch("pipelines.reconstruction.doubts.diagnosis.diagnose", kept):
        check(manifest)
    return seen[0]


def _times_of_all(trial: Trial) -> list[Scene]:
    late_s = [seconds for seconds in np.linspace(-1, 1, 21) if abs(seconds) > 0.01]
    slower = [np.full(len(trial.names), factor) for factor in RATES]
    scenes = [trial.late(float(seconds), trial.every) for seconds in late_s]
    return scenes + [scene_of(trial.flight, trial.described, slower=each) for each in slower]


def _orders(trial: Trial) -> list[Scene]:
    orders = [each for each in permutations(trial.every) if each != tuple(trial.every)]
    return [scene_of(trial.flight, trial.described, order=each) for each in orders]


def _headings(trial: Trial) -> list[Scene]:
    return [fit(trial.flight, trial.described, "heading", index).scene for index in trial.every]


# Mistakes that are not told everywhere, and the scenes among which the one without the mistake is.
UNTOLD: dict[str, Callable[[Trial], list[Scene]]] = {
    "clock 0.5 s, all": _times_of_all,
    "25 for 30 Hz, all": _times_of_all,
    "videos cycled": _orders,
    "heading 8 deg, one": _headings,
}


def _gains(sampled: Sampled, kinds: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return by how much the best scene of each kind lowers the chi^2 of the rays, and the score.

    Other times show other pictures: the chi^2 is that of a picture, times the pictures of the description.
    """

    def chi2(scene: Scene) -> float:
        pictures = np.isfinite([each.rays[..., 0] for each in (scene, trial.described)]).any(axis=-1)
        seen, described = pictures.sum(axis=(1, 2))
        return fit(sampled, scene, "none", 0).cost * described / seen if seen else np.inf

    base, stated = base_of(sampled, scene_of(sampled))
    trial = Trial(sampled, scene_of(sampled), base)
    gains: dict[Callable[[Trial], list[Scene]], tuple[float, float]] = {}
    for undone in dict.fromkeys(UNTOLD[kind] for kind in kinds):
        scenes = undone(trial)
        least = min(score(sampled, scene, base).total for scene in scenes)
        gains[undone] = chi2(trial.described) - min(map(chi2, scenes)), stated.total - least
    return {kind: gains[UNTOLD[kind]] for kind in kinds}


def print_untold(folder: Path, seeds: Iterable[int], names: list[str]) -> None:
    """Print by how much undoing a mistake lowers chi^2 and score, of mistaken and of right flights."""
    untold = [each for each in MISTAKES if each.name in UNTOLD and (not names or each.name in names)]
    print("| mistake | flight | chi^2 less | score less |\n| --- | --- | --- | --- |")
    for mistake, flight in product(untold, [*FLIGHTS, *KEPT_ASIDE]):
        if mistake.fits(flight):
            wrong = sampled_of(mistaken(Described(flight, folder / flight.name), mistake.change))
            chi2, less = _gains(wrong, [mistake.name])[mistake.name]
            print(f"| {mistake.name} | {flight.name} | {chi2:.1f} | {less:.1f} |", flush=True)
    right: dict[str, list[tuple[float, float]]] = {}
    for flight in map(right_flight, seeds):
        sampled = sampled_of(mistaken(Described(flight, folder / flight.name), None))
        for name, gains in _gains(sampled, [each.name for each in untold if each.fits(flight)]).items():
            right.setdefault(name, []).append(gains)
    for name, found in right.items():
        quantiles = np.percentile(found, [50, 95, 100], axis=0).T
        said = " | ".join(f"{a:.1f}, 95 % at most {b:.1f}, all {c:.1f}" for a, b, c in quantiles)
        print(f"| {name} | {len(found)} right ones | {said} |", flush=True)


def _later(cameras: dict[str, Any], names: list[str], seconds: float) -> None:
    for name in names:
        cameras[name]["clock"]["offset_s"] += seconds


def _slower(cameras: dict[str, Any], fps: float) -> None:
    for camera in cameras.values():
        camera["frame_times"]["fps"] = fps


# Changes of the cameras of flight.yaml, whose pictures come at a rate.
CORPUS_MISTAKES: dict[str, tuple[str, Callable[[dict[str, Any], float], None]]] = {
    "none": ("", lambda _, __: None),
    "clock 0.5 s, all": ("clock", lambda cameras, _: _later(cameras, list(cameras), 0.5)),
    "clock 0.3 s, one": ("clock", lambda cameras, _: _later(cameras, list(cameras)[:1], 0.3)),
    "30 for 24 Hz, all": ("frame_rate", lambda cameras, rate_hz: _slower(cameras, 1.25 * rate_hz)),
}


def doubted_corpus(folder: Path, half: Half, draws: int, names: list[str], only: list[str]) -> None:
    """Check the flights of the corpus, right and with mistakes in their times, and print what is said."""
    counts: dict[tuple[str, bool], list[bool]] = {}
    print("| flight | draw | errors | mistake | first doubt | gain |\n| --- | --- | --- | --- | --- | --- |")
    for flight in flights([half]):
        if flight.missing_motions or (names and flight.name not in names):
            continue
        drawn = DrawnFlight(flight, folder / flight.name)
        drawn.write_shared()
        off = any(flight.scenario.drones.clock_offsets_s)
        for draw, given in product(range(draws), get_args(Given)):
            with tempfile.TemporaryDirectory() as place:
                drawn.session(Path(place) / "flight", draw, given, DETECTORS[0])
                for mistake, (code, change) in CORPUS_MISTAKES.items():
                    if only and mistake not in only:
                        continue
                    if not code or (flight.with_pictures and given == "model"):
                        doubts = _doubted(flight, Path(place) / "flight", mistake, change)
                        first = doubts[0] if doubts else None
                        named = bool(first and first.code == code) if code else bool(doubts)
                        counts.setdefault((mistake, off), []).append(named)
                        said = f"{first.code}: {first.what}" if first else "nothing"
                        gain = first.evidence.get("turning_gain", "") if first else ""
                        print(
                            f"| {flight.name} | {draw} | {given} | {mistake} | {said} | {gain} |", flush=True
                        )
    for (mistake, off), found in counts.items():
        whose = "with clocks that are off" if off else "whose clocks are right"
        what = "named first" if CORPUS_MISTAKES[mistake][0] else "doubted"
        print(f"{mistake}, {whose}: {sum(found)} of {len(found)} {what}")


def _doubted(
    flight: CorpusFlight, place: Path, mistake: str, change: Callable[[dict[str, Any], float], None]
) -> list[Doubt]:
    yaml = YAML(typ="safe")
    document = yaml.load((place / "flight.yaml").read_text(encoding="utf-8"))
    change(document["cameras"], flight.scenario.drones.camera.rate_hz)
    session = place / f"{mistake}.session"
    ingest(written(document, place / f"{mistake}.yaml"), session)
    with kept_in_place_of_pictures(flight, DETECTORS[0]), locked(session) as writable:
        detect(writable, detector=DETECTORS[0])
        if flight.with_pictures:
            Following(writable).finish()
    return check(session).doubts


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure how mistakes in descriptions are named.")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "mocap_mistakes")
    parser.add_argument("--kept", action="store_true", help="The flights that were kept aside.")
    parser.add_argument("--mistake", action="append", default=[], help="Only these; repeat it for several.")
    parser.add_argument("--bound", type=int, default=0, metavar="N", help="Draws of a remedy's sigmas.")
    parser.add_argument("--right", type=int, metavar="N", help="Check random right flights instead.")
    parser.add_argument("--seed", type=int, help="The first of the right flights or acrobats.")
    parser.add_argument("--any", action="store_true", help="Let every third of --right be an acrobat.")
    parser.add_argument(
        "--acrobats", type=int, metavar="N", help="The same of people who lie or turn wheels."
    )
    parser.add_argument("--less-usual", action="store_true", help="Make less usual mistakes instead.")
    parser.add_argument("--time", action="store_true", help="Measure what the doubts cost.")
    parser.add_argument(
        "--untold", type=int, metavar="N", help="Undo mistakes that are not told, also on N right flights."
    )
    parser.add_argument("--corpus", choices=HALVES, help="Check the flights of the corpus instead.")
    parser.add_argument("--draws", type=int, default=1, help="Draws of the corpus's pose errors.")
    parser.add_argument("flights", nargs="*")
    options = parser.parse_args()

    def seeds(count: int, first: int) -> range:
        first = first if options.seed is None else options.seed
        return range(first, first + count)

    if options.right:
        draw: Callable[[int], Flight] = right_flight
        if options.any:
            draw = partial(any_right_flight, folder=options.folder)
        doubted_right_flights(options.folder, map(draw, seeds(options.right, 100)))
        return
    if options.acrobats:
        flights_of = (acrobatic_flight(seed, options.folder) for seed in seeds(options.acrobats, 1000))
        doubted_right_flights(options.folder, flights_of)
        return
    if options.time:
        print_times(options.folder)
        return
    if options.untold:
        print_untold(options.folder, seeds(options.untold, 100), options.mistake)
        return
    if options.corpus:
        doubted_corpus(
            options.folder / "corpus", options.corpus, options.draws, options.flights, options.mistake
        )
        return
    print("| flight | mistake | error mm | first doubt | named | after the remedy mm |")
    print("| --- | --- | --- | --- | --- | --- |")
    mistakes = LESS_USUAL if options.less_usual else MISTAKES
    tallies: dict[int, list[tuple[bool, bool, bool]]] = {2: [], 3: []}
    by_mistake: dict[str, list[tuple[bool, bool, bool]]] = {}
    for flight in KEPT_ASIDE if options.kept else FLIGHTS:
        if options.flights and flight.name not in options.flights:
            continue
        described = Described(flight, options.folder / flight.name)
        right, doubts, stopped = measured(mistaken(described, None))
        row(flight.name, "none", right, doubts[0]["code"] if doubts else stopped or "-", "", "")
        if flight.drones > 2:  # what is lost where nothing is known of where a drone was
            alone, *_ = measured(mistaken(described, without_first))
            row(flight.name, "drone1 left out", alone, "", "", "")
        for mistake in mistakes:
            if mistake.fits(flight) and (not options.mistake or mistake.name in options.mistake):
                tally = tried(described, mistake, right or float("nan"), options.bound)
                if tally is not None:
                    tallies[flight.drones].append(tally)
                    by_mistake.setdefault(mistake.name, []).append(tally)
    for drones, found in tallies.items():
        if found:
            doubted, named, mended = (sum(column) for column in zip(*found, strict=True))
            print(f"{drones} drones: {len(found)} mistakes that cost more than 20 %: {doubted} doubted,")
            print(f"{named} named first ({named / len(found):.0%}), {mended} of those mended by the remedy")
    print("\n| mistake | named | mended |\n| --- | --- | --- |")
    for mistake in mistakes:
        if made := by_mistake.get(mistake.name):
            _, named, mended = (sum(column) for column in zip(*made, strict=True))
            print(f"| {mistake.name} | {named} of {len(made)} | {mended} |")


def tried(
    described: Described, mistake: Mistake, right: float, draws: int = 0
) -> tuple[bool, bool, bool] | None:
    """Make a mistake; return if it was doubted, named and mended, None if it costs no more than 20 %.

    Of a remedy that does not mend, so many draws show what errors its standard deviations allow.
    """
    compared = mistake.compared(described.flight)
    if compared != "mpjpe_mm":
        right = measured(mistaken(described, None), compared)[0] or float("nan")
    manifest = mistaken(described, mistake.change)
    error, doubts, stopped = measured(manifest, compared)
    first = doubts[0] if doubts else None
    named = first is not None and first["code"] in mistake.codes
    after, why = None, ""
    if first is not None and named and with_remedy(manifest, first["remedy"]):
        with patch("pipelines.attempt.doubts_of", lambda *_, **__: []):  # only the error is looked at
            after, _, why = measured(manifest, compared)
    mended = after is not None and after <= 1.1 * right
    said = f"{first['code']}: {first['what']}" if first else (stopped or "nothing")
    counts = error is None or error > 1.2 * right
    verdict = ("yes" if named else "NO") if counts else f"({'yes' if named else 'no'})"
    mending = f"{after or 0:.0f}" + (f", {compared}; right: {right:.0f}" if compared != "mpjpe_mm" else "")
    if draws and first is not None and after and not mended:
        mending += f"; {_bound(described, mistake, first, draws)}"
    row(described.flight.name, mistake.name, error, said, verdict, mending if after else why)
    return (first is not None, named, mended) if counts else None


def _bound(described: Described, mistake: Mistake, doubt: dict[str, Any], draws: int) -> str:
    """Return the errors of the right flight whose poses have those that a remedy's sigmas allow.

    Own origins err together: their shifts are drawn from the covariance of the fit.
    """
    shift_m, turn_deg = (doubt["evidence"].get(key, 0.0) for key in ("shift_sigma_m", "turn_sigma_deg"))
    if not shift_m and not turn_deg:
        return "no sigma"
    names = [name for name in described.names if f"cameras.{name}." in doubt["remedy"]]
    covariance = _covariance_of_origins(described, mistake) if mistake.name == "own origins" else None
    draw = np.random.default_rng(0)
    compared = mistake.compared(described.flight)
    errors: list[float] = []
    for _ in range(draws):
        if covariance is None:
            shifts = {name: draw.normal(0, shift_m / np.sqrt(3), 3) for name in names}
        else:
            drawn = draw.multivariate_normal(np.zeros(len(covariance)), covariance).reshape(-1, 6)
            shifts = {name: drawn[described.names.index(name), :3] for name in names}
        changes = [moved(shifts[name], name) for name in names if shift_m]
        turn = draw.normal(0, turn_deg)  # tilts of several cameras have one
        for name in names if turn_deg else ():
            if doubt["code"] == "mount":
                changes.append(of_mounts(turned("x", turn), name))
            elif doubt["code"] == "pose":
                changes.append(of_poses(heading(turn), name))
            else:
                changes.append(of_poses(partial(compose, (np.zeros(3), turned("z", turn))), name))
        with patch("pipelines.attempt.doubts_of", lambda *_, **__: []):
            found = measured(mistaken(described, partial(_each_of, changes)), compared)[0]
        errors.append(float("nan") if found is None else found)
    low, middle, high = np.nanpercentile(errors, [5, 50, 95])
    stated = " and ".join([f"{shift_m:g} m"] * bool(shift_m) + [f"{turn_deg:g} deg"] * bool(turn_deg))
    return f"sigma {stated}: {middle:.0f} ({low:.0f} to {high:.0f})"


def _each_of(changes: list[Change], description: Mistaken) -> None:
    for change in changes:
        change(description)


def _covariance_of_origins(described: Described, mistake: Mistake) -> Float:
    """Return the covariance [6 C, 6 C] of all constant errors, shifts in m first, of fitted own origins."""
    found: list[Fault] = []

    def kept(*arguments: Any, **named: Any) -> Fault:
        found.append(fit(*arguments, **named))
        return found[-1]

    with patch("pipelines.reconstruction.doubts.faults.fit", kept):
        check(mistaken(described, mistake.change))
    return next(each.covariance for each in found if each.name == "origins")


def row(flight: str, mistake: str, error: float | None, said: str, named: str, after: str) -> None:
    shown = "nothing" if error is None else f"{error:.0f}"
    print(f"| {flight} | {mistake} | {shown} | {said} | {named} | {after} |", flush=True)


if __name__ == "__main__":
    main()
