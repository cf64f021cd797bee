"""The lines of flight.yaml that undo a mistake, as `cameras.drone1.clock: {offset_s: 0.3}`.

Those of one camera leave out `cameras.NAME.` at the start; `lines` puts it there.
"""

from collections.abc import Callable, Iterable
from io import StringIO
from typing import Any, get_args

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.util import load_yaml_guess_indent

from pipelines.geometry.arrays import Float
from pipelines.geometry.mounting import Looks, body_from_camera
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_matrix
from pipelines.reconstruction.observations import Filmed
from pipelines.session.description import PosesEntry

Options = str | Callable[[PosesEntry], str]
"""Keys of a pose that a remedy writes: a text, or a function of the stored entry that makes it."""

# A mount is turned by nothing unless a mistake says so.
_EYE = np.eye(3)
# Entries of equal rotation matrices differ by less than this.
_SAME = 1e-3


def lines(cameras: Iterable[Filmed], line_of: Callable[..., str], *values: Any, **named: Any) -> str:
    """Write the lines of some cameras: `line_of` makes that of each, from it and the values."""
    return "; ".join(f"cameras.{camera.name}.{line_of(camera, *values, **named)}" for camera in cameras)


def clock(camera: Filmed, seconds: float) -> str:
    """Move the clock of a camera's pictures."""
    return f"clock.offset_s: {camera.entry.clock.offset_s + seconds:.3f}"


def frame_rate(camera: Filmed, factor: float) -> str:
    """State the frame rate of a camera, whose pictures follow each other `factor` times as slowly."""
    rate = rate_hz(camera) / factor
    is_whole = abs(round(rate) - rate) < 0.005 * rate  # but for rounding
    return f"frame_times.fps: {rate:.{0 if is_whole else 3}f}"


def rate_hz(camera: Filmed) -> float:
    """Return the stated rate of all pictures, of which few may have been looked at."""
    return camera.entry.frames.rate_hz or 1e9 / float(np.median(np.diff(camera.t_ns)))


def earlier_or_later(seconds: float) -> str:
    """State by how much pictures were taken at another time than stated."""
    return f"{abs(seconds):.3f} s {'later' if seconds > 0 else 'earlier'} than stated"


def pictures_of(_: Filmed, owner: Filmed) -> str:
    """Give a camera the pictures of their owner, or the keypoints where those came with the flight."""
    if owner.entry.keypoints is not None:
        return f"keypoints.file: {owner.entry.keypoints.source}"
    media = owner.entry.media
    return f"video: {media.sources[0] if media and media.sources else owner.name}"


def mount(camera: Filmed, *, before: Float = _EYE, after: Float = _EYE) -> str:
    """Turn body_from_camera [3, 3] of a camera in either's axes; without a mount what turns the pose."""
    stored = camera.entry.poses.mount or camera.entry.poses.in_gimbal
    if stored is None:
        forwards = matrix_from_quaternion(body_from_camera("forward"))
        rotation = quaternion_from_matrix(forwards.T @ before @ forwards @ after)
        return f"pose.of: body; cameras.{camera.name}.mount: {_rigid([0.0, 0.0, 0.0], rotation)}"
    rotation = before @ matrix_from_quaternion(np.array(stored.rotation_xyzw)) @ after
    for looks in get_args(Looks):
        down_deg = 0.0 if looks in ("down", "up") else _down_deg(rotation)
        if np.abs(matrix_from_quaternion(body_from_camera(looks, down_deg)) - rotation).max() < _SAME:
            down = f", down_deg: {down_deg:.1f}" if abs(down_deg) >= 0.05 else ""
            return f"mount: {{looks: {looks}{down}, translation: {_vector(stored.translation)}}}"
    return f"mount: {_rigid(stored.translation, quaternion_from_matrix(rotation))}"


def by_pictures(camera: Filmed) -> str:
    """Let the film of a camera say how it turned, in place of logs, mounts and gimbals."""
    poses = camera.entry.poses
    stated = ("pose.of", "mount", "gimbal") if poses.mount or poses.in_gimbal or poses.gimbal else ()
    return "pose.attitude: pictures" + "".join(f"; cameras.{camera.name}.{key}: null" for key in stated)


def down_deg(camera: Filmed) -> float:
    """Return by how much a camera's mount tilts it down; 0 without a mount, or where that is no tilt."""
    mount = camera.mount
    is_level = mount is not None and abs(mount[2, 0]) < _SAME  # the picture's right
    return _down_deg(mount) if mount is not None and is_level else 0.0


def _down_deg(mount: Float) -> float:
    return float(np.degrees(np.arcsin(np.clip(-mount[2, 2], -1, 1))))


def _rigid(translation: Iterable[float], rotation_xyzw: Float) -> str:
    numbers = ", ".join(f"{value:.6f}" for value in rotation_xyzw)
    return f"{{translation: {_vector(translation)}, rotation_xyzw: [{numbers}]}}"


def _vector(values: Iterable[float]) -> str:
    return "[" + ", ".join(f"{round(value, 3) + 0.0:.10g}" for value in values) + "]"


def placed(camera: Filmed, shift: Float, turn: Float = _EYE, factor: float = 1.0) -> str:
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


def inverse(poses: PosesEntry) -> str:
    """State that poses are the inverses of what they are read as."""
    return f"inverse: {str(not poses.inverse).lower()}"


def upside_down(poses: PosesEntry) -> str:
    """State that positions count z the other way."""
    return f"z: {'up' if poses.z == 'down' else 'down'}"


OF_BODY = "of: body; cameras.{}.mount: {{looks: forward}}"
"""The poses are of bodies, on which the cameras look forwards."""

OF_CAMERA = "of: camera; cameras.{}.mount: null"
"""The poses are those of the cameras, without a mount."""


def pose(camera: Filmed, options: Options) -> str:
    """State how the poses of a camera are written, beside how they are read."""
    stated = options if isinstance(options, str) else options(camera.entry.poses)
    return "pose." + stated.format(camera.name)


def keypoints_size(camera: Filmed, factor: float) -> str:
    """State the size of the pictures that keypoints are of; of film, calibrate the lens for its pictures."""
    if camera.entry.keypoints is None:
        return lens(camera, factor, factor)
    width, height = camera.intrinsics.width * factor, camera.intrinsics.height * factor
    return f"keypoints.image_size: [{width:.0f}, {height:.0f}]"


MIRRORS = {"false": set[str](), "true": {"x", "names"}, "x": {"x"}, "y": {"y"}, "names": {"names"}}
"""Parts of keypoints that each value of `keypoints.mirrored` turns over: coordinates, or left and right."""


def mirrored(cameras: Iterable[Filmed], value: str) -> str:
    """State that keypoints are mirrored, besides what is stated of that: twice is not at all.

    No line does that for film, in which the keypoints are still to be found: it is turned over itself.
    """
    found = []
    for camera in cameras:
        known, name = camera.entry.keypoints, camera.name
        line = f"find the keypoints of {name} again, in its pictures as they are"
        if known is not None:
            parts = MIRRORS[value] ^ MIRRORS[str(known.mirrored).lower()]
            needed = [key for key, each in MIRRORS.items() if each == parts]
            line = f"cameras.{name}.keypoints.mirrored: {needed[0]}" if needed else line
        elif value != "names":
            flip = "vflip" if value == "y" else "hflip"
            line = f"mirror the film of {name} back, as with `ffmpeg -i FILM -vf {flip} NEW`"
        found.append(line)
    return "; ".join(found)


def lens(camera: Filmed, focal: float, centre: float = 1.0) -> str:
    """State the intrinsics of a camera, with factors on the focal length and the principal point."""
    own = camera.intrinsics
    model = "" if own.model == "none" else f", model: {own.model}, distortion: {list(own.distortion)}"
    return (
        f"intrinsics: {{width: {own.width}, height: {own.height}, fx: {own.fx * focal:.1f},"
        f" fy: {own.fy * focal:.1f}, cx: {own.cx * centre:.1f}, cy: {own.cy * centre:.1f}{model}}}"
    )


def pose_noise(camera: Filmed, factor: float) -> str:
    """State errors of poses that are larger by a factor: constant ones, and those that change."""
    sigma = factor * np.array(camera.sigma)
    position, rotation = np.sqrt(np.maximum(sigma[:2] ** 2 - sigma[4:] ** 2, 0.0))
    return (
        f"pose_noise: {{bias: {{position_m: {position:.3g}, rotation_deg: {np.degrees(rotation):.3g}}},"
        f" white: {{position_m: {sigma[4]:.3g}, rotation_deg: {np.degrees(sigma[5]):.3g}}}}}"
    )


def mended(text: str, remedy: str) -> str | None:
    """Put the lines of a remedy into the text of a manifest, with its comments; None if they are no lines."""
    _, mapping, offset = load_yaml_guess_indent(text)
    yaml, written = YAML(), StringIO()
    yaml.preserve_quotes, yaml.width = True, 10_000
    yaml.indent(mapping=mapping, sequence=mapping, offset=offset)
    document = yaml.load(text)
    for line in remedy.split("; "):
        path, _, value = line.partition(": ")
        keys, place = path.split("."), document
        # It is no key, or asks for what only the user knows.
        if not value or keys[0] not in {"world", *document} or "..." in value:
            return None
        for key in keys[:-1]:
            if isinstance(place.get(key), str):
                place[key] = {"file": place[key]}
            elif not isinstance(place.get(key), dict):
                place[key] = {}
            place = place[key]
        place[keys[-1]] = YAML().load(value)
    yaml.dump(document, written)
    return written.getvalue()
