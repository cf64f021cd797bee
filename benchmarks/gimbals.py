"""Accuracy on real pictures that move, by virtual gimbals: `python -m benchmarks.accuracy gimbals FOLDER`.

The real recording of Pose2Sim's demo has four still cameras (`MOCAP_REAL_DATA` names the folder that holds
`pose2sim_single`; 100 pictures at 60 Hz). Each picture is undistorted and turned by a homography, as a gimbal
would have turned the camera: it follows the person loosely, pans, tilts, rolls and shakes along a known path.
Film, person, texture and detector are real. The path and the attitude errors in the log are not: they are
drawn, about each axis with the same standard deviation for the part that is constant and for the part that is
new in every picture. Positions are exact.

A path is known exactly. The constant part of attitude errors and all distances are as good as the calibration
(`Calib_refit.toml`, refitted to keypoints of the same recording). There is no truth of the person: the
reference is `robust` from the still cameras, with the same detector, and `NEES` takes it as exact. The rows
without attitude errors are the floor. Jitter is the length of the second difference of a joint's path, over
sqrt(3): that of white noise has the size of its frame-to-frame difference; the person's accelerations are in
it. There is no parallax, and no blur beyond the recording's own.

Paths a and b are for tuning; c and d are kept aside, and are measured with --kept only. Films, detections
and sessions stay in FOLDER and are used again; methods are always measured anew.
"""

import argparse
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from benchmarks.flights import CAMERAS, PEER, REAL, holds, real_flight, write_anew
from benchmarks.results import fixed, markdown_table
from pipelines.formats.skeletons.trc import FORMAT as TRC
from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.session.description import read_description
from pipelines.session.records import POINT_COVARIANCE_COLUMNS

TUNED, KEPT = ("a", "b"), ("c", "d")
LEVELS_DEG = (0.5, 1.0)
_FPS, _SIZE = 60, (720, 960)
_ZOOM = 0.8  # focal length of the virtual camera over the real one's
_FOLLOWED_S = 0.3  # the person's centre is followed as slowly as that
_AXES_SHARE = np.array([0.6, 1.0, 1.2])  # of the sway about x (tilt), y (pan) and z (roll)
_SWAY_HZ_DEG = ((0.31, 2.2), (0.77, 0.9), (1.27, 0.35))
_SHAKE_HZ_DEG = ((6.3, 0.06), (8.9, 0.05), (11.2, 0.04))


@dataclass(frozen=True)
class Shot:
    """Real camera of the recording: its intrinsics and its pose."""

    intrinsics: Intrinsics
    position: Float  # [3] m
    world_from_camera: Float  # [3, 3]


@dataclass(frozen=True)
class Log:
    """Errors of one logged flight."""

    level_deg: float  # standard deviation per axis of the constant part, and of the changing part
    draw: int = 0

    @property
    def name(self) -> str:
        """The flight's name, as its manifest without suffix."""
        return f"{self.level_deg:g}deg-{self.draw}" if self.level_deg else "true"


@dataclass(frozen=True)
class Figures:
    """Measured values of one reconstruction; NaN where the method has none."""

    distance_mm: float
    jitter_mm: float
    changing_deg: float
    constant_deg: float
    nees: float
    share_percent: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("folder", type=Path, help="for films and sessions, outside the repository")
    parser.add_argument("--kept", action="store_true", help="measure on the paths that are kept aside")
    parser.add_argument("--methods", nargs="+", default=["robust", "auto"])
    parser.add_argument("--detector", default="blazepose")
    parser.add_argument("--draws", type=int, default=6, help="of the log's errors (default 6)")


def run(options: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Film, reconstruct, and compare with the still cameras."""
    if not REAL.is_dir():
        raise SystemExit(f"{REAL} is not here: MOCAP_REAL_DATA names the folder of pose2sim_single")
    paths, folder, detector = KEPT if options.kept else TUNED, options.folder.resolve(), options.detector
    logs = [Log(level, draw) for level in LEVELS_DEG for draw in range(options.draws)]
    with get_context("spawn").Pool(2) as pool:
        prepare(folder, detector)
        pool.map(partial(prepare_path, folder, detector, logs), paths, chunksize=1)
        cases = [(path, Log(0.0), False) for path in paths]
        cases += list(product(paths, logs, (True, False)))
        one = partial(measured, folder, detector, options.methods)
        found = dict(zip(cases, pool.map(one, cases, chunksize=1), strict=True))
    yield "gimbals-kept" if options.kept else "gimbals-tuned", table_of(found)


# --- films and flights -----------------------------------------------------------------------------------


def prepare(folder: Path, detector: str) -> None:
    """Reconstruct from the still cameras: the reference."""
    place = folder / "still"
    place.mkdir(parents=True, exist_ok=True)
    real_flight(place, "Calib_refit.toml", f"{{start: 0.0, fps: {_FPS}}}")
    session = place / f"{detector}.session"
    ingest(place / "flight.yaml", session)
    reconstruct(session, ReconstructSettings(method="robust", detector=detector), workers=2)


def prepare_path(folder: Path, detector: str, logs: Sequence[Log], path: str) -> None:
    """Film along a path, write its flights, and detect the person once."""
    place = folder / path
    place.mkdir(exist_ok=True)
    shots = _shots(folder / "still" / f"{detector}.session")
    for log in (Log(0.0), *logs):
        write_flight(place, log, path, shots)
    for name, shot in shots.items():
        if not holds(place / f"{name}.shot", repr(shot)):
            _film(name, shot, attitudes(path, name, shot), place / f"{name}.mp4")
            for sessions in place.glob("*/"):  # they hold keypoints of the film before
                shutil.rmtree(sessions)
            write_anew(place / f"{name}.shot", repr(shot))
    session = _session(place, detector, Log(0.0))
    ingest(place / "true.yaml", session)
    reconstruct(session, ReconstructSettings(method="robust", detector=detector))
    for log, given in product(logs, (True, False)):
        copied = _session(place, detector, log, given=given)
        if not copied.exists():  # with the keypoints
            shutil.copytree(session, copied, ignore=shutil.ignore_patterns("reconstruct"))
        ingest(place / copied.with_suffix(".yaml").name, copied)


def _shots(still: Path) -> dict[str, Shot]:
    """Return the real cameras as ingest understood them."""
    cameras = read_description(still).cameras
    shots = {}
    for name, camera in cameras.items():
        pose = pd.read_parquet(still / "cameras" / name / "poses.parquet").iloc[0]
        turned = Rotation.from_quat(pose[["qx", "qy", "qz", "qw"]].to_numpy(float)).as_matrix()
        shots[name] = Shot(camera.intrinsics, pose[["x", "y", "z"]].to_numpy(float), turned)
    return shots


def attitudes(path: str, name: str, shot: Shot) -> Float:
    """Compute the true attitudes world_from_camera [T, 3, 3] of one camera along a path."""
    rng = np.random.default_rng([1, ord(path), CAMERAS.index(name)])
    joints = TRC.read_joints(PEER, unit=None, axes=None).position[:, 0]
    centre = (np.nanmin(joints, axis=1) + np.nanmax(joints, axis=1)) / 2
    centre = gaussian_filter1d(centre, _FOLLOWED_S * _FPS, axis=0, mode="nearest")
    x, y, z = ((centre - shot.position) @ shot.world_from_camera).T
    followed = Rotation.from_euler("yx", np.stack([np.arctan2(x, z), -np.arctan2(y, np.hypot(x, z))], axis=1))
    t_s = np.arange(len(centre))[:, None] / _FPS
    angle_deg = np.zeros((len(centre), 3))
    for table, share in ((_SWAY_HZ_DEG, _AXES_SHARE), (_SHAKE_HZ_DEG, np.ones(3))):
        for hz, deg in table:
            angle_deg += deg * share * np.sin(2 * np.pi * (hz * t_s + rng.uniform(0, 1, 3)))
    swayed = followed * Rotation.from_rotvec(np.radians(angle_deg))
    turned: Float = shot.world_from_camera @ swayed.as_matrix()
    return turned


def write_flight(place: Path, log: Log, path: str, shots: dict[str, Shot]) -> None:
    """Write the manifests of a flight, with and without its pose noise, and its poses."""
    lines: dict[bool, list[str]] = {
        given: ["schema: 1", f"name: Path {path}", "cameras:"] for given in (True, False)
    }
    for number, (name, shot) in enumerate(shots.items()):
        true = attitudes(path, name, shot)
        rng = np.random.default_rng([2, ord(path), log.draw, number])
        drawn = rng.normal(size=3) + rng.normal(size=(len(true), 3))
        error = Rotation.from_rotvec(np.radians(log.level_deg) * drawn)
        rows = np.column_stack(
            [
                np.arange(len(true)) / _FPS,
                np.broadcast_to(shot.position, (len(true), 3)),
                (Rotation.from_matrix(true) * error).as_quat(),
            ]
        )
        file = f"{name}.{log.name}.tum"
        write_anew(place / file, "\n".join(" ".join(f"{value:.9f}" for value in row) for row in rows))
        fx, fy, cx, cy = _virtual_lens(shot)
        noise = f"rotation_deg: {log.level_deg:g}"
        for given, own in lines.items():
            own += [
                f"  {name}:",
                f"    video: {name}.mp4",
                f"    frame_times: {{start: 0.0, fps: {_FPS}}}",
                f"    pose: {{file: {file}, of: camera}}",
                f"    intrinsics: {{width: {_SIZE[0]}, height: {_SIZE[1]},"
                f" fx: {fx:.6f}, fy: {fy:.6f}, cx: {cx}, cy: {cy}}}",
            ]
            if given and log.level_deg:
                own.append(f"    pose_noise: {{white: {{{noise}}}, bias: {{{noise}}}}}")
    write_anew(place / f"{log.name}.yaml", "\n".join(lines[False]))
    if log.level_deg:
        write_anew(place / f"{log.name}-given.yaml", "\n".join(lines[True]))


def _virtual_lens(shot: Shot) -> tuple[float, float, float, float]:
    focal = _ZOOM * shot.intrinsics.fx
    return focal, focal, _SIZE[0] / 2 - 0.5, _SIZE[1] / 2 - 0.5


def _film(name: str, shot: Shot, world_from_virtual: Float, out: Path) -> None:
    """Film again what a camera saw, turned along a path; black where it saw nothing."""
    lens = shot.intrinsics
    k = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    fx, fy, cx, cy = _virtual_lens(shot)
    k_virtual = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    unfinished = out.with_suffix(".part.mp4")
    options = {"crf": "16", "threads": "1", "x264-params": "cpu-independent=1"}
    with av.open(str(REAL / "videos" / f"{name}.mp4")) as source, av.open(str(unfinished), "w") as film:
        stream = film.add_stream("libx264", rate=_FPS, options=options)
        stream.width, stream.height, stream.pix_fmt = *_SIZE, "yuv420p"
        for turned, frame in zip(world_from_virtual, source.decode(video=0), strict=True):
            virtual_from_camera = turned.T @ shot.world_from_camera
            maps = cv2.initUndistortRectifyMap(
                k, np.array(lens.distortion), virtual_from_camera, k_virtual, _SIZE, cv2.CV_32FC1
            )
            picture = cv2.remap(frame.to_ndarray(format="bgr24"), *maps, cv2.INTER_CUBIC)
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        film.mux(stream.encode(None))
    unfinished.replace(out)


def _session(place: Path, detector: str, log: Log, *, given: bool = False) -> Path:
    return place / detector / f"{log.name}{'-given' if given else ''}.session"


# --- measuring -------------------------------------------------------------------------------------------


def measured(
    folder: Path, detector: str, methods: Sequence[str], case: tuple[str, Log, bool]
) -> dict[str, Figures]:
    """Reconstruct one flight by each method, and compare it with the still cameras."""
    cv2.setNumThreads(1)
    path, log, given = case
    place = folder / path
    session = _session(place, detector, log, given=given)
    reference = pd.read_parquet(folder / "still" / f"{detector}.session" / "reconstruct" / "skeleton.parquet")
    shots = _shots(folder / "still" / f"{detector}.session")
    true = {name: attitudes(path, name, shot) for name, shot in shots.items()}
    found = {}
    for method in methods:
        # The code may have changed since: nothing of an earlier run is taken for a result.
        shutil.rmtree(session / "reconstruct", ignore_errors=True)
        reconstruct(session, ReconstructSettings(method=method, detector=detector))  # type: ignore[arg-type]
        found[method] = _figures(session, reference, true)
    return found


def _figures(session: Path, reference: pd.DataFrame, true: dict[str, Float]) -> Figures:
    table = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    (ours, covariance), (theirs, _) = (_of_person(skeleton) for skeleton in (table, reference))
    apart = ours - theirs
    both = np.isfinite(apart).all(axis=-1)
    second = np.diff(ours, 2, axis=0)
    changing, constant = _attitude_errors_deg(session, true)
    return Figures(
        distance_mm=1e3 * float(np.median(np.linalg.norm(apart[both], axis=-1))),
        jitter_mm=1e3 * float(np.nanmedian(np.linalg.norm(second, axis=-1))) / np.sqrt(3),
        changing_deg=changing,
        constant_deg=constant,
        nees=_nees(apart[both], covariance[both]),
        share_percent=100 * float(both.sum() / np.isfinite(theirs).all(axis=-1).sum()),
    )


def _of_person(skeleton: pd.DataFrame) -> tuple[Float, Float]:
    """Shape a dense table: positions [T, J, 3] m of the only person, and covariances [T, J, 3, 3] m^2."""
    own = skeleton[skeleton["person"] == 0]
    shape = (own["t_ns"].nunique(), -1)
    c = own[list(POINT_COVARIANCE_COLUMNS)].to_numpy(float)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    return own[["x", "y", "z"]].to_numpy(float).reshape(*shape, 3), c.reshape(*shape, 3, 3)


def _nees(apart: Float, covariance: Float) -> float:
    return float(np.mean(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(covariance), apart)))


def _attitude_errors_deg(session: Path, true: dict[str, Float]) -> tuple[float, float]:
    """Compute the changing and the constant part of the attitude errors: RMS per axis over the cameras."""
    changing, constant = [], []
    own = session / "reconstruct" / "cameras.parquet"
    estimated = pd.read_parquet(own) if own.exists() else pd.DataFrame({"camera": []})
    for name, attitude in true.items():
        poses = estimated[estimated["camera"] == name]
        if not len(poses):  # this camera stayed with its log
            poses = pd.read_parquet(session / "cameras" / name / "poses.parquet")
        quaternion = poses.sort_values("t_ns")[["qx", "qy", "qz", "qw"]].to_numpy()
        true_inverse, found = Rotation.from_matrix(attitude).inv(), Rotation.from_quat(quaternion)
        errors = [each.as_rotvec(degrees=True) for each in (true_inverse * found, found * true_inverse)]
        error = min(errors, key=lambda each: float(each.var(axis=0).sum()))
        changing.append(error - error.mean(axis=0))
        constant.append(error.mean(axis=0))
    return _rms(changing), _rms(constant)


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# --- the table -------------------------------------------------------------------------------------------

_COLUMNS = {
    "distance_mm": ("distance mm", 1),
    "jitter_mm": ("jitter mm", 1),
    "changing_deg": ("attitudes, changing deg", 3),
    "constant_deg": ("constant deg", 2),
    "nees": ("NEES", 1),
    "share_percent": ("measured %", 1),
}


def table_of(found: dict[tuple[str, Log, bool], dict[str, Figures]]) -> list[str]:
    """Write the mean of each figure over paths and draws, by level, whether noise is stated, and method."""
    groups: dict[tuple[float, bool, str], list[Figures]] = {}
    for (_, log, given), by_method in found.items():
        for method, figures in by_method.items():
            groups.setdefault((log.level_deg, not given, method), []).append(figures)
    rows = [
        [
            f"{level:g} deg" if level else "none",
            ("no" if without else "yes") if level else "",
            method,
            *(
                fixed(float(np.mean([getattr(of, key) for of in own])), digits)
                for key, (_, digits) in _COLUMNS.items()
            ),
        ]
        for (level, without, method), own in sorted(groups.items(), key=lambda group: group[0][:2])
    ]
    header = ["attitude errors", "stated", "method", *(name for name, _ in _COLUMNS.values())]
    return markdown_table(header, rows)
