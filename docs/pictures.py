"""Make docs/flight.webp, which moves, and docs/report.png from a session of the sample flight.

    make demo
    python docs/pictures.py demo/mound_walk.session

A headless Chromium photographs the report (`apt-get install chromium`). Without one its picture stays.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import project
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.session.people import bones_of

DOCS = Path(__file__).parent
HEIGHT, PANEL, SCENE = 330, 250, 400  # px: of the picture, and widths of a camera's panel and of the scene
EVERY, LAST = 4, 360  # pictures of the video
ZOOM = 1.9  # of the pictures: the person is some 120 px tall in the sample
EYE, AIM, FOCAL = np.array([8.0, -31.0, 15.0]), np.array([-5.0, -5.0, 0.5]), 440.0
LOW, HIGH = np.array([-20.0, -20.0]), np.array([10.0, 9.0])  # m: the part of the map that is drawn
BLUE, ORANGE, GREY, RED, DARK = (
    (214, 120, 40),
    (40, 130, 245),
    (130, 130, 130),
    (60, 60, 220),
    (40, 30, 25),
)  # BGR

Picture = NDArray[np.uint8]


def draw_bones(picture: Picture, joints: tuple[str, ...], pixels: Float, width: int) -> None:
    """Draw a skeleton with its left in blue and its right in orange."""
    place = {name: k for k, name in enumerate(joints)}
    for casing in (True, False):
        for a, b in bones_of(joints):
            ends = pixels[[place[a], place[b]]]
            if np.isfinite(ends).all():
                side = {name.partition("_")[0] for name in (a, b)}
                colour = BLUE if side == {"left"} else ORANGE if side == {"right"} else (230, 230, 230)
                line(picture, ends, DARK if casing else colour, width + 2 * casing)


def line(picture: Picture, ends: Float, colour: tuple[int, int, int], width: int = 1) -> None:
    """Draw a line between two points (px)."""
    start, end = np.round(ends * 16).astype(int)
    cv2.line(picture, tuple(map(int, start)), tuple(map(int, end)), colour, width, cv2.LINE_AA, 4)


def scene_camera(points: Float) -> Float:
    """Project world points [..., 3] into the scene's panel, px."""
    forward = (AIM - EYE) / np.linalg.norm(AIM - EYE)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    seen = (points - EYE) @ np.stack([right, np.cross(forward, right), forward]).T
    pixels: Float = FOCAL * seen[..., :2] / seen[..., 2:] + [SCENE / 2, HEIGHT / 2]
    return pixels


def empty_scene(session: Path) -> Picture:
    """Draw the map as dots, dark to bright with height."""
    picture = np.full((HEIGHT, SCENE, 3), 255, np.uint8)
    with np.load(session / "map" / "0.npz") as grid:
        cells = np.argwhere(np.nan_to_num(grid["probability"]) > 0.5)
        points = grid["origin"] + (cells + 0.5) * grid["resolution_m"]
    points = points[((points[:, :2] > LOW) & (points[:, :2] < HIGH)).all(axis=1)]
    for point in points[np.argsort(-np.linalg.norm(points - EYE, axis=1))]:
        shade = np.clip(point[2] / 9, 0, 1)
        colour = (200 - 110 * shade, 215 - 60 * shade, 200 - 110 * shade)
        x, y = np.round(scene_camera(point)).astype(int)
        radius = max(2, round(0.15 * FOCAL / float(np.linalg.norm(point - EYE))))
        cv2.circle(picture, (int(x), int(y)), radius, colour, cv2.FILLED)
    return picture


def frames(session: Path) -> Iterator[Picture]:
    """Yield the pictures of the film: what each camera sees, and the scene."""
    description: dict[str, Any] = json.loads((session / "session.json").read_text())
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    skeleton = skeleton[skeleton["person"] == 0]
    joints = tuple(skeleton["joint"].unique())
    t_ns = skeleton["t_ns"].unique()
    motion = skeleton[["x", "y", "z"]].to_numpy().reshape(len(t_ns), len(joints), 3)
    poses = pd.read_parquet(session / "reconstruct" / "cameras.parquet")
    stamps = {c: pd.read_parquet(session / "cameras" / c / "frames.parquet") for c in description["cameras"]}
    films = {
        name: cv2.VideoCapture(str(session / camera["media"]["paths"][0]))
        for name, camera in description["cameras"].items()
    }
    background, trail = empty_scene(session), []
    for number in range(LAST):
        pictures = {name: film.read()[1] for name, film in films.items()}
        if number % EVERY:
            continue
        panels, scene, row = [], background.copy(), min(number, len(t_ns) - 1)
        trail.append(np.nanmean(motion[row], axis=0) * [1, 1, 0])
        for name, picture in pictures.items():
            own = poses[poses["camera"] == name]
            pose = own.iloc[int(np.argmin(np.abs(own["t_ns"] - stamps[name]["t_ns"].iloc[number])))]
            place = pose[["x", "y", "z"]].to_numpy(float)
            turn = matrix_from_quaternion(pose[["qx", "qy", "qz", "qw"]].to_numpy(float))
            intrinsics = Intrinsics(**description["cameras"][name]["intrinsics"])
            panels.append(panel(picture, joints, project((motion[row] - place) @ turn, intrinsics), name))
            corners = (
                place + np.array([[-1, -0.6, 1.4], [1, -0.6, 1.4], [1, 0.6, 1.4], [-1, 0.6, 1.4]]) @ turn.T
            )
            for k in range(4):
                line(scene, scene_camera(np.stack([corners[k], corners[(k + 1) % 4]])), RED)
                line(scene, scene_camera(np.stack([place, corners[k]])), RED)
        for ends in pairwise(trail):
            line(scene, scene_camera(np.stack(ends)), GREY, 2)
        draw_bones(scene, joints, scene_camera(motion[row]), 2)
        yield np.hstack([*panels, scene])


def panel(picture: Picture, joints: tuple[str, ...], pixels: Float, name: str) -> Picture:
    """Cut the person out of a picture, draw the skeleton over them, and write the camera's name."""
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    corner = (low + high) / 2 - np.array([PANEL, HEIGHT]) / 2 / ZOOM
    move = np.array([[ZOOM, 0, -ZOOM * corner[0]], [0, ZOOM, -ZOOM * corner[1]]])
    cut: Picture = cv2.warpAffine(picture, move, (PANEL, HEIGHT), flags=cv2.INTER_CUBIC)
    draw_bones(cut, joints, (pixels - corner) * ZOOM, 3)
    for colour, width in ((DARK, 3), ((255, 255, 255), 1)):
        cv2.putText(cut, name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, width, cv2.LINE_AA)
    cut[:, -2:] = 255
    return cut


def make_film(session: Path, path: Path) -> None:
    """Write the film as an animated WebP that repeats."""
    made = [Image.fromarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)) for frame in frames(session)]
    made[0].save(
        path, save_all=True, append_images=made[1:], duration=EVERY * 1000 // 30, loop=0, quality=45, method=4
    )


def photograph(page: Path, path: Path) -> None:
    """Write a picture of the report's first screens, by a headless Chromium."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        sys.stderr.write(f"no chromium here: {path} stays as it is\n")
        return
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "report.png"
        options = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--window-size=1100,1450",
        ]
        options += [f"--user-data-dir={folder}", f"--screenshot={shot}", "--virtual-time-budget=8000"]
        subprocess.run(  # noqa: S603  # a program that this machine has
            [chromium, *options, page.resolve().as_uri()], check=True, capture_output=True, timeout=120
        )
        Image.open(shot).convert("RGB").quantize(128).save(path, optimize=True)


if __name__ == "__main__":
    (given,) = map(Path, sys.argv[1:])
    make_film(given, DOCS / "flight.webp")
    photograph(given / "report" / "index.html", DOCS / "report.png")
