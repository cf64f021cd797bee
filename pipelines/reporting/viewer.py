"""Data of the page's 3D viewer: skeleton, truth and cameras, packed into a few hundred kB.

Numbers travel as base64 of little-endian integers. A joint is stored relative to the middle of its body, in
millimetres and 16 bits; the middle and the cameras in millimetres and 32 bits relative to the scene's
origin. A missing value is the smallest integer of either kind, never 0.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.body_model import ABOVE, BELOW, body_model
from pipelines.geometry.poses import multiply
from pipelines.geometry.rig import BONES
from pipelines.reporting.arms import ArmTrack, Replan, raised_surface
from pipelines.reporting.content import FULL_SCALE, MeasuredMotion, Strip, middles, standing_heights
from pipelines.reporting.summary import CameraRow, Summary
from pipelines.reporting.wording import joint_label, plural, quantity, whole
from pipelines.session.camera_poses import poses_at
from pipelines.session.maps import MapSurface
from pipelines.session.people import DERIVED, bones_of, side_of
from pipelines.session.records import MovingBody, Trajectory, full_covariance
from pipelines.session.tables import trajectory_from

# Longer flights are thinned out, so that a page with 10 MB of pictures stays below 25 MB in base64.
MAX_BYTES = 6_000_000
# Cameras alone need no more times to move smoothly.
MAX_TIMES_WITHOUT_SKELETON = 3000
# Millimetres in 16 bits reach no farther from the middle of the body.
FARTHEST_JOINT_M = 32.767
# Square roots are computed a part at a time, so that the others take no memory meanwhile.
MATRICES_AT_ONCE = 1 << 15
# Vertices of the drawn surface are this far apart, of a stature of 1: more triangles make the page slow.
SKIN_CELL = 0.027
# Of more bones a vertex takes a share that nobody sees.
SKIN_BONES = 4
# Pictures farther apart are no film any more, and are noted.
FILM_STEP_S = 0.2

_SIDES = ("", "left", "right")


@dataclass(frozen=True)
class ViewerScene:
    """Data of the viewer, and what the page says about it."""

    data: dict[str, object]  # JSON
    people: tuple[str, ...]
    truth: bool
    ellipsoids: bool
    notes: tuple[str, ...]  # differences from the tables, in whole sentences
    arms: tuple[str, ...] = ()  # of a comparison of planners; their cameras can be shown as well
    surface: bool = False  # True if the map's surface is there
    film: tuple[str, ...] = ()  # cameras with pictures
    skin: bool = False  # True if the surfaces of people are there


def make_scene(
    summary: Summary,
    poses: Mapping[str, pd.DataFrame],
    replan: Replan | None = None,
    strips: Sequence[Strip] = (),
    bodies: Sequence[MovingBody] = (),
) -> ViewerScene | None:
    """Pack a session for the viewer; None where there is nothing to be seen.

    Every camera's pose (tables.POSES) is interpolated to the skeleton's times, never across a gap as the
    session defines it. Without a skeleton the cameras alone are shown. Cameras of simulated arms are packed
    beside them, with the map around them, and pictures where there are any.
    """
    motion = summary.motion if summary.motion is not None and summary.motion.measured.any() else None
    cameras = [camera for camera in summary.cameras if camera.name in poses]
    if motion is None and not cameras:
        return None
    all_t_ns = motion.t_ns if motion is not None else _times_without_skeleton(summary)
    body = _PackedBody.of(motion, summary.truth) if motion is not None else None
    arms = [arm for arm in replan.arms if arm.simulated] if replan is not None else []
    all_cameras = len(cameras) + sum(len(arm.cameras) for arm in arms)
    per_time = all_cameras * (3 * 4 + 4 * 2) + (0 if body is None else body.bytes_per_time)
    per_time += len(bodies) * len(BONES) * 8 * 2
    every = max(math.ceil(len(all_t_ns) * per_time / MAX_BYTES), 1)
    kept = slice(None, None, every)
    t_ns = all_t_ns[kept]
    placed = [_placed(camera, poses[camera.name], t_ns, summary) for camera in cameras]
    for a, arm in enumerate(arms):
        placed += [_placed_again(arm, a, k, t_ns, summary) for k in range(len(arm.cameras))]
    paths = [camera.position for camera in placed]
    low, high = _bounds(np.concatenate(paths + ([body.middle[kept].reshape(-1, 3)] if body else [])))
    origin = np.round((low + high) / 2)
    ground = float(np.median(body.feet_m)) if body is not None else float(low[2])
    data: dict[str, object] = {
        "t": _packed(np.round((t_ns - summary.origin_ns) / 1e5), np.int32),
        "low": _rounded(low - origin),
        "high": _rounded(high - origin),
        "ground": round(ground - float(origin[2]), 3),
        "cameras": [camera.packed(origin) for camera in placed],
    }
    if body is not None:
        data["body"] = body.packed(kept, origin) | {"names": list(summary.people)}
        if bodies:
            data["skin"] = _packed_skin(bodies, t_ns, body.middle[kept])
    around = raised_surface(replan.around) if replan is not None and replan.around is not None else None
    if around is not None and around.voxels:
        points = _packed(1000 * (around.middle - origin), np.int32)
        data["surface"] = {"cube": around.cube_m, "points": points}
    if body is not None and strips:
        data["film"] = [_packed_strip(strip, summary.origin_ns, origin) for strip in strips]
    return ViewerScene(
        data=data,
        people=summary.people if body is not None else (),
        truth=body is not None and body.truth is not None,
        ellipsoids=body is not None and body.root is not None,
        notes=tuple(_notes(every, len(all_t_ns), body, around, strips)),
        arms=tuple(arm.name for arm in arms),
        surface="surface" in data,
        film=tuple(strip.camera for strip in strips) if body is not None else (),
        skin="skin" in data,
    )


def _notes(
    every: int, times: int, body: _PackedBody | None, around: MapSurface | None, strips: Sequence[Strip]
) -> list[str]:
    notes = []
    if every > 1:
        notes.append(
            f"The page holds one time in {every} of {whole(times)}, and draws straight lines between them."
        )
    if body is not None:
        notes += body.notes()
        steps_s = [float(np.median(np.diff(strip.t_ns))) / 1e9 for strip in strips if len(strip.t_ns) > 1]
        if steps_s and max(steps_s) > FILM_STEP_S:
            notes.append(f"Pictures are {quantity(max(steps_s), 's')} apart.")
    if around is not None and around.voxels:
        notes.append(
            f"The map: {plural(around.voxels, 'voxel')} of the surface above the ground, drawn as "
            f"{plural(len(around.middle), 'cube')} of {quantity(around.cube_m, 'm', 2)}."
        )
    return notes


def _packed_strip(strip: Strip, origin_ns: int, origin: Float) -> dict[str, object]:
    moved = strip.projection.copy()
    moved[..., 3] += strip.projection[..., :3] @ origin
    return {
        "name": strip.camera,
        "t": _packed(np.round((strip.t_ns - origin_ns) / 1e5), np.int32),
        "pictures": list(strip.pictures),
        "joints": _packed(FULL_SCALE * strip.joints, np.int16),
        "projection": base64.b64encode(moved.astype("<f4").tobytes()).decode("ascii"),
    }


@dataclass(frozen=True)
class _PackedBody:
    """The measured people, each joint relative to the middle of its body."""

    joints: tuple[str, ...]
    middle: Float  # [T, P, 3] m, world; NaN where neither the skeleton nor the truth has a joint
    joint: Float  # [T, P, J, 3] m from the middle
    truth: Float | None  # [T, P, J, 3] m from the middle
    root: Float | None  # [T, P, J, 6] m, lower triangle of the covariance's Cholesky factor, row by row
    feet_m: Float  # [T, P] height on which each person stands

    @classmethod
    def of(cls, motion: MeasuredMotion, truth: Float | None) -> _PackedBody:
        position = motion.measured_position
        middle = middles(position)
        if truth is not None:
            middle = np.where(np.isnan(middle), middles(truth), middle)
            truth = truth - middle[:, :, None]
        return cls(
            joints=motion.joints,
            middle=middle,
            joint=position - middle[:, :, None],
            truth=truth if truth is not None and np.isfinite(truth).any() else None,
            root=_square_root(np.where(motion.measured[..., None], motion.covariance, np.nan)),
            feet_m=standing_heights(motion),
        )

    @property
    def people(self) -> int:
        """Number of people."""
        return int(self.middle.shape[1])

    @property
    def bytes_per_time(self) -> int:
        """Size at one time."""
        channels = 3 + 3 * (self.truth is not None) + 6 * (self.root is not None)
        return self.people * (4 * 4 + len(self.joints) * channels * 2)

    def packed(self, kept: slice, origin: Float) -> dict[str, object]:
        """Return the body as JSON, at the kept times."""
        joints = self.joints
        derived = [
            (name, parents) for name, parents in DERIVED if name not in joints and set(parents) <= set(joints)
        ]
        known = (*joints, *(name for name, _ in derived))
        place = {name: j for j, name in enumerate(known)}
        counts = np.isfinite(self.joint[kept, ..., 0]).sum(axis=(1, 2))
        first = len(counts) // 20  # people are found, and films begin, some pictures after the start
        return {
            "people": self.people,
            "joints": [joint_label(name) for name in joints],
            "sides": [_SIDES.index(side_of(name)) for name in joints],
            "derived": [[place[parent] for parent in parents] for _, parents in derived],
            "bones": [[place[a], place[b], _SIDES.index(side_of(a, b))] for a, b in bones_of(known)],
            # The first time with nearly the most joints: the page opens with it, and prints it.
            "start": first + int(np.argmax(counts[first:] >= 0.9 * counts[first:].max())),
            "feet": _packed(1000 * (self.feet_m[kept] - origin[2]), np.int32),
            "middle": _packed(1000 * (self.middle[kept] - origin), np.int32),
            "joint": _packed(1000 * self.joint[kept], np.int16),
            "truth": None if self.truth is None else _packed(1000 * self.truth[kept], np.int16),
            # A tenth of a millimetre: the least that anybody states.
            "root": None if self.root is None else _packed(10_000 * self.root[kept], np.int16),
        }

    def notes(self) -> list[str]:
        """Count the joints that are too far from their body for 16 bits."""
        far = [
            (int((np.abs(values) > FARTHEST_JOINT_M).any(axis=-1).sum()), noun)
            for values, noun in ((self.joint, "joint-frame"), (self.truth, "true joint-frame"))
            if values is not None
        ]
        return [
            f"{plural(count, noun).capitalize()} more than {FARTHEST_JOINT_M:.0f} m from the middle of the "
            f"body {'is' if count == 1 else 'are'} not drawn."
            for count, noun in far
            if count
        ]


def _packed_skin(bodies: Sequence[MovingBody], t_ns: Int64, middle: Float) -> dict[str, object]:
    """Return surfaces of people at times [T] as JSON; bones count from `middle` [T, P, 3] m."""
    vertices, triangles = body_model().simplified(SKIN_CELL)
    packed = []
    for body in bodies:
        row = np.searchsorted(body.t_ns, t_ns).clip(0, len(body.t_ns) - 1)
        known = (body.t_ns[row] == t_ns)[:, None]
        sigma_mm = np.where(known, np.minimum(1000 * body.sigma_m[row], np.iinfo(np.int16).max), np.nan)
        skin = body_model().skin(body.shape)
        turn = multiply(body.rotation[row], body_model().neutral_from_rest)
        centre = np.where(known[..., None], body.centre[row] - middle[:, body.person, None], np.nan)
        packed.append(
            {
                "person": body.person,
                "rest": _packed(1000 * skin.rest[vertices], np.int16),
                "joints": _packed(1000 * body_model().hinges(body.shape)[: len(BONES)], np.int16),
                "centre": _packed(1000 * centre, np.int16),
                "turn": _packed(32767 * turn, np.int16),
                "sigma": _packed(sigma_mm, np.int16),
            }
        )
    return {
        "triangles": _packed(triangles.astype(np.float64), np.int16),
        "bone": _packed(skin.bone[vertices, :SKIN_BONES].astype(np.float64), np.int16),
        "weight": _packed(32767 * skin.weight[vertices, :SKIN_BONES], np.int16),
        "between": np.stack([ABOVE, BELOW], axis=1).tolist(),
        "bodies": packed,
    }


def _square_root(covariance: Float) -> Float | None:
    """Compute Cholesky factors [..., 6] of covariances [..., 6] (upper triangles); None without any."""
    rows, columns = np.tril_indices(3)
    upper = covariance.reshape(-1, 6)
    root = np.full(upper.shape, np.nan)
    for first in range(0, len(upper), MATRICES_AT_ONCE):
        part = slice(first, first + MATRICES_AT_ONCE)
        full = full_covariance(upper[part])
        known = np.isfinite(full).all(axis=(1, 2))
        positive = np.zeros(len(full), dtype=np.bool_)
        positive[known] = np.linalg.eigvalsh(full[known])[:, 0] > 0
        root[part][positive] = np.linalg.cholesky(full[positive])[:, rows, columns]
    return root.reshape(covariance.shape) if np.isfinite(root).any() else None


@dataclass(frozen=True)
class _Placed:
    """A camera at the viewer's times: of the session, or of an arm of a comparison."""

    name: str
    lens: CameraRow
    position: Float  # [T, 3] m, world; NaN without a pose
    quaternion_xyzw: Float  # [T, 4] world_from_camera
    of_arm: Mapping[str, object]  # which arm, and its colour; nothing of the session's own

    def packed(self, origin: Float) -> dict[str, object]:
        """Return the camera as JSON."""
        return {
            "name": self.name,
            "corners": _picture_corners(self.lens),
            "position": _packed(1000 * (self.position - origin), np.int32),
            "rotation": _packed(32767 * self.quaternion_xyzw, np.int16),
            **self.of_arm,
        }


def _placed(camera: CameraRow, table: pd.DataFrame, t_ns: Int64, summary: Summary) -> _Placed:
    between = summary.description.pose_interpolation
    poses = poses_at(trajectory_from(table), t_ns, between, static=camera.entry.poses.static)
    return _Placed(camera.name, camera, *poses, {})


def _placed_again(arm: ArmTrack, a: int, k: int, t_ns: Int64, summary: Summary) -> _Placed:
    """Place camera `k` of arm `a`, with the lenses of the session's cameras, in turn."""
    track = Trajectory(arm.t_ns, arm.position[k], arm.quaternion_xyzw[k])
    poses = poses_at(track, t_ns, summary.description.pose_interpolation)
    lens = summary.cameras[k % len(summary.cameras)]
    return _Placed(arm.cameras[k], lens, *poses, {"arm": a, "colour": arm.colour})


def _picture_corners(camera: CameraRow) -> list[float]:
    """Return the picture's left, right, top and bottom edge as x/z and y/z, without distortion."""
    lens = camera.entry.intrinsics
    edges = [
        (-0.5 - lens.cx) / lens.fx,
        (lens.width - 0.5 - lens.cx) / lens.fx,
        (-0.5 - lens.cy) / lens.fy,
        (lens.height - 0.5 - lens.cy) / lens.fy,
    ]
    return _rounded(np.array(edges))


def _times_without_skeleton(summary: Summary) -> Int64:
    count = min(max(camera.entry.frames.count for camera in summary.cameras), MAX_TIMES_WITHOUT_SKELETON)
    steps = np.round(np.linspace(0, 1e9 * summary.duration_s, count)).astype(np.int64)
    return summary.origin_ns + np.unique(steps)


def _bounds(points: Float) -> tuple[Float, Float]:
    """Return the corners of the box that holds all but the farthest 1 % of the points [N, 3] on each side."""
    there = points[np.isfinite(points).all(axis=1)]
    if not len(there):
        return np.zeros(3), np.zeros(3)
    low, high = np.percentile(there, [1, 99], axis=0)
    return low, high


def _packed(values: Float, kind: type[np.int16 | np.int32]) -> str:
    """Encode rounded values in base64."""
    limits = np.iinfo(kind)
    fits = np.abs(values) <= limits.max
    if values.ndim > 1:
        fits = np.broadcast_to(fits.all(axis=-1, keepdims=True), values.shape)
    whole_numbers = np.where(fits, np.round(np.where(fits, values, 0)), limits.min)
    little_endian = np.dtype(kind).newbyteorder("<")
    return base64.b64encode(whole_numbers.astype(little_endian).tobytes()).decode("ascii")


def _rounded(values: Float) -> list[float]:
    return [round(float(value), 4) for value in values]
