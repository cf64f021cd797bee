"""The lines of flight.yaml that undo a mistake, as `cameras.drone1.clock: {offset_s: 0.3}`."""

from collections.abc import Callable, Sequence
from functools import cache
from io import StringIO
from typing import Any, get_args

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.util import load_yaml_guess_indent

from pipelines.geometry.arrays import Float
from pipelines.geometry.mounting import Looks, body_from_camera
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_matrix
from pipelines.reconstruction.observations import Filmed
from pipelines.session.description import CameraEntry, PosesEntry

# A mount is turned by nothing unless a mistake says so.
_EYE = np.eye(3)
# Entries of equal rotation matrices differ by less than this.
_SAME = 1e-3


def _lines(cameras: Sequence[Filmed], group: Sequence[int], key_of: Callable[[Filmed], str]) -> str:
    return "; ".join(f"cameras.{cameras[index].name}.{key_of(cameras[index])}" for index in group)


def clock(cameras: Sequence[Filmed], group: Sequence[int], seconds: float) -> str:
    """Move the clocks of cameras' pictures."""
    return _lines(cameras, group, lambda camera: offset_of(camera.entry, seconds))


def offset_of(entry: CameraEntry, seconds: float) -> str:
    """State a clock's offset that is larger by some seconds."""
    return f"clock.offset_s: {entry.clock.offset_s + seconds:.3f}"


def frame_rate(cameras: Sequence[Filmed], group: Sequence[int], factor: float) -> str:
    """State the frame rate of cameras, whose pictures follow each other `factor` times as slowly."""
    return _lines(cameras, group, lambda camera: f"frame_times.fps: {_rounded(rate_hz(camera) / factor)}")


def rate_hz(camera: Filmed) -> float:
    """Return the stated rate of all pictures, of which few may have been looked at."""
    return camera.entry.frames.rate_hz or 1e9 / float(np.median(np.diff(camera.t_ns)))


def _rounded(rate: float) -> str:
    """Write a rate, as a whole number where it is that but for rounding."""
    return f"{rate:.0f}" if abs(round(rate) - rate) < 0.005 * rate else f"{rate:.3f}"


def earlier_or_later(seconds: float) -> str:
    """State by how much pictures were taken at another time than stated."""
    return f"{abs(seconds):.3f} s {'later' if seconds > 0 else 'earlier'} than stated"


def videos(cameras: Sequence[Filmed], order: Sequence[int]) -> str:
    """Give cameras each other's pictures, or keypoints where those came with the flight."""

    def key_of(camera: Filmed) -> str:
        if camera.entry.keypoints is not None:
            return f"keypoints.file: {camera.entry.keypoints.source}"
        media = camera.entry.media
        return f"video: {media.sources[0] if media and media.sources else camera.name}"

    return "; ".join(
        f"cameras.{cameras[index].name}.{key_of(cameras[other])}"
        for index, other in enumerate(order)
        if index != other
    )


def mount(
    cameras: Sequence[Filmed], group: Sequence[int], *, before: Float = _EYE, after: Float = _EYE
) -> str:
    """Turn body_from_camera [3, 3] of cameras in either's axes; without a mount what turns the pose."""

    def key_of(camera: Filmed) -> str:
        stored = camera.entry.poses.mount or camera.entry.poses.in_gimbal
        if stored is None:
            forwards = matrix_from_quaternion(body_from_camera("forward"))
            rotation = quaternion_from_matrix(forwards.T @ before @ forwards @ after)
            return f"pose.of: body; cameras.{camera.name}.mount: {_rigid([0.0, 0.0, 0.0], rotation)}"
        rotation = before @ matrix_from_quaternion(np.array(stored.rotation_xyzw)) @ after
        words = _as_words(rotation, stored.translation)
        return f"mount: {words or _rigid(stored.translation, quaternion_from_matrix(rotation))}"

    return _lines(cameras, group, key_of)


def by_pictures(cameras: Sequence[Filmed], group: Sequence[int]) -> str:
    """Let the films of cameras say how they turned, in place of logs, mounts and gimbals."""

    def key_of(camera: Filmed) -> str:
        poses = camera.entry.poses
        if not (poses.mount or poses.in_gimbal or poses.gimbal):
            return "pose.attitude: pictures"
        others = "".join(f"; cameras.{camera.name}.{key}: null" for key in ("pose.of", "mount", "gimbal"))
        return f"pose.attitude: pictures{others}"

    return _lines(cameras, group, key_of)


def down_deg(camera: Filmed) -> float:
    """Return by how much a camera's mount tilts it down; 0 without a mount, or where that is no tilt."""
    mount = camera.mount
    if mount is None:
        return 0.0
    tilt = float(np.degrees(np.arcsin(np.clip(-mount[2, 2], -1, 1))))
    return tilt if abs(mount[2, 0]) < _SAME else 0.0  # the picture's right is level


def _rigid(translation: Sequence[float], rotation_xyzw: Float) -> str:
    numbers = ", ".join(f"{value:.6f}" for value in rotation_xyzw)
    return f"{{translation: {_vector(translation)}, rotation_xyzw: [{numbers}]}}"


def _vector(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{round(value, 3) + 0.0:.10g}" for value in values) + "]"


def _as_words(rotation: Float, translation: Sequence[float]) -> str | None:
    """State a mount as `looks` and `down_deg` where it is one."""
    for looks, level in _levels().items():
        tilt = level.T @ rotation
        if abs(tilt[0, 0] - 1) > _SAME:
            continue
        angle = float(np.degrees(np.arctan2(tilt[2, 1], tilt[1, 1])))
        for down_deg in (0.0,) if looks in ("down", "up") else (angle, -angle):
            if abs(down_deg) > 90:
                continue
            same = matrix_from_quaternion(body_from_camera(looks, down_deg))
            if np.abs(same - rotation).max() < _SAME:
                down = f", down_deg: {down_deg:.1f}" if abs(down_deg) >= 0.05 else ""
                return f"{{looks: {looks}{down}, translation: {_vector(translation)}}}"
    return None


@cache
def _levels() -> dict[Looks, Float]:
    """Return body_from_camera [3, 3] of every way to look, without a tilt."""
    return {looks: matrix_from_quaternion(body_from_camera(looks)) for looks in get_args(Looks)}


def turned_world(cameras: Sequence[Filmed], up: Float) -> str:
    """Turn every source by the shortest rotation that brings a direction [3] upwards."""
    quaternion = np.append(np.cross(up, [0.0, 0.0, 1.0]), 1.0 + up[2])
    turn = matrix_from_quaternion(quaternion / np.linalg.norm(quaternion))
    return _lines(cameras, range(len(cameras)), lambda camera: _placed(camera, np.zeros(3), turn))


def scaled(cameras: Sequence[Filmed], factor: float) -> str:
    """Scale the positions of every source of poses."""
    return _lines(cameras, range(len(cameras)), lambda each: _placed(each, np.zeros(3), _EYE, factor))


def _placed(camera: Filmed, shift: Float, turn: Float, factor: float = 1.0) -> str:
    """State where the world of a log lies, turned [3, 3], moved [3] m and scaled from what is stated."""
    stated = camera.entry.poses.world_from_source
    half_rad = np.radians(stated.yaw_deg) / 2
    quaternion = stated.rotation_xyzw or (0.0, 0.0, np.sin(half_rad), np.cos(half_rad))
    rotation = quaternion_from_matrix(turn @ matrix_from_quaternion(np.array(quaternion)))
    translation = np.round(shift + factor * turn @ np.array(stated.translation), 2) + 0.0
    parts = [f"translation: {_vector(translation.tolist())}"] if translation.any() else []
    yaw_deg = float(np.degrees(2 * np.arctan2(rotation[2], rotation[3])))
    yaw_deg -= 360 * round(yaw_deg / 360)
    if np.abs(rotation[:2]).max() > _SAME:
        parts.append("rotation_xyzw: [" + ", ".join(f"{value:.5g}" for value in rotation) + "]")
    elif abs(yaw_deg) > 0.005:
        parts.append(f"yaw_deg: {yaw_deg:.2f}")
    scale = float(f"{factor:.3g}") * stated.scale
    parts += [f"scale: {scale:.6g}"] if scale != 1 else []
    return f"pose.world_from_source: {{{', '.join(parts or ['translation: [0, 0, 0]'])}}}"


def pose(cameras: Sequence[Filmed], group: Sequence[int], options: str | Callable[[PosesEntry], str]) -> str:
    """State how the poses of moving cameras are written, beside how they are read."""

    def line(camera: Filmed) -> str:
        stated = options if isinstance(options, str) else options(camera.entry.poses)
        return "pose." + stated.format(camera.name)

    return _lines(cameras, group, line)


def upside_down(poses: PosesEntry) -> str:
    """State that positions count z the other way."""
    return f"z: {'up' if poses.z == 'down' else 'down'}"


OF_BODY = "of: body; cameras.{}.mount: {{looks: forward}}"
"""The poses are of bodies, on which the cameras look forwards."""

OF_CAMERA = "of: camera; cameras.{}.mount: null"
"""The poses are those of the cameras, without a mount."""


def keypoints_size(cameras: Sequence[Filmed], group: Sequence[int], factor: float) -> str:
    """State the size of the pictures that keypoints are of; of film, calibrate the lens for its pictures."""

    def key_of(camera: Filmed) -> str:
        if camera.entry.keypoints is None:
            return _lens(camera, factor, factor)
        width, height = camera.intrinsics.width * factor, camera.intrinsics.height * factor
        return f"keypoints.image_size: [{width:.0f}, {height:.0f}]"

    return _lines(cameras, group, key_of)


_MIRRORS = {
    "false": frozenset[str](),
    "true": frozenset({"x", "names"}),
    "x": frozenset({"x"}),
    "y": frozenset({"y"}),
    "names": frozenset({"names"}),
}


def mirrored(cameras: Sequence[Filmed], group: Sequence[int], value: str) -> str:
    """State that keypoints are mirrored, besides what is stated of that: twice is not at all.

    No line does that for film, in which the keypoints are still to be found: it is turned over itself.
    """
    lines = []
    for index in group:
        known, name = cameras[index].entry.keypoints, cameras[index].name
        if known is None and value != "names":
            flip = "vflip" if value == "y" else "hflip"
            lines.append(f"mirror the film of {name} back, as with `ffmpeg -i FILM -vf {flip} NEW`")
            continue
        parts = _MIRRORS[value] ^ _MIRRORS[str(known.mirrored if known else False).lower()]
        needed = next((key for key, each in _MIRRORS.items() if each == parts), None) if known else None
        lines.append(
            f"cameras.{name}.keypoints.mirrored: {needed}"
            if needed
            else f"find the keypoints of {name} again, in its pictures as they are"
        )
    return "; ".join(lines)


def intrinsics(cameras: Sequence[Filmed], group: Sequence[int], factor: float) -> str:
    """Multiply the focal lengths of cameras."""
    return _lines(cameras, group, lambda camera: _lens(camera, factor, 1.0))


def _lens(camera: Filmed, focal: float, centre: float) -> str:
    """State the intrinsics of a camera, with factors on the focal length and the principal point."""
    own = camera.intrinsics
    model = "" if own.model == "none" else f", model: {own.model}, distortion: {list(own.distortion)}"
    return (
        f"intrinsics: {{width: {own.width}, height: {own.height}, fx: {own.fx * focal:.1f},"
        f" fy: {own.fy * focal:.1f}, cx: {own.cx * centre:.1f}, cy: {own.cy * centre:.1f}{model}}}"
    )


def pose_noise(cameras: Sequence[Filmed], group: Sequence[int], factor: float) -> str:
    """State errors of poses that are larger by a factor: constant ones, and those that change."""

    def key_of(camera: Filmed) -> str:
        sigma = factor * np.array(camera.sigma)
        position, rotation = np.sqrt(np.maximum(sigma[:2] ** 2 - sigma[4:] ** 2, 0.0))
        return (
            f"pose_noise: {{bias: {{position_m: {position:.3g}, rotation_deg: {np.degrees(rotation):.3g}}},"
            f" white: {{position_m: {sigma[4]:.3g}, rotation_deg: {np.degrees(sigma[5]):.3g}}}}}"
        )

    return _lines(cameras, [index for index in group if not cameras[index].static], key_of)


def origin(cameras: Sequence[Filmed], index: int, shift: Float, yaw_rad: float = 0.0) -> str:
    """Place the world of a camera's log in the flight's, beside what is stated of that already."""
    turn = matrix_from_quaternion(np.array([0.0, 0.0, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)]))
    return _lines(cameras, [index], lambda camera: _placed(camera, shift, turn))


def own_origins(cameras: Sequence[Filmed], shifts: Float) -> str:
    """Place the worlds of all logs, which are moved by `shifts` [C, 3] m."""
    moved = [index for index in range(len(cameras)) if np.abs(shifts[index]).max() > 0]
    return "; ".join(origin(cameras, index, shifts[index]) for index in moved)


def mended(text: str, remedy: str) -> str | None:
    """Put the lines of a remedy into the text of a manifest, with its comments; None if they are no lines."""
    _, mapping, offset = load_yaml_guess_indent(text)
    yaml, written = YAML(), StringIO()
    yaml.preserve_quotes, yaml.width = True, 10_000
    yaml.indent(mapping=mapping, sequence=mapping, offset=offset)
    document = yaml.load(text)
    if not _are_set(document, remedy):
        return None
    yaml.dump(document, written)
    return written.getvalue()


def _are_set(document: Any, remedy: str) -> bool:
    """Set the keys of a remedy; False if one is no key, or asks for what only the user knows."""
    for line in remedy.split("; "):
        path, _, value = line.partition(": ")
        keys, place = path.split("."), document
        if not value or keys[0] not in {"world", *document} or "..." in value:
            return False
        for key in keys[:-1]:
            if isinstance(place.get(key), str):
                place[key] = {"file": place[key]}
            elif not isinstance(place.get(key), dict):
                place[key] = {}
            place = place[key]
        place[keys[-1]] = YAML().load(value)
    return True
