"""Errors of a detector that depend on the side from which it sees a body, and their removal.

A network that learned from people at eye level puts the near shoulder higher than the far one, and hips that
are seen from above too low. Such errors last for as long as a camera keeps its side of a person: neither
other cameras nor motion average them. They are alike for all people. The table (`data/view_errors.csv`, made
by `tools/view_errors.py`) has for each joint how far from COCO's place, or from its own mean one, a picture
shows it: in the frame of a bone, as a sum of spherical harmonics of degrees 0 to 2 of the direction in which
the camera looks. The direction is needed to some degrees, so what was triangulated first gives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Float, Float32, Index, Int64, nearest_rows
from pipelines.geometry.body_model import MEAN_SHAPE
from pipelines.geometry.rig import BONE
from pipelines.geometry.triangulation import STATUS, Triangulation
from pipelines.reconstruction.body_fit import landmarks_of, turns_of_bones
from pipelines.reconstruction.observations import Camera, Candidates, Observations, frames_of
from pipelines.session.people import mirrored

TABLE = Path(__file__).parent / "data" / "view_errors.csv"
# Spherical harmonics of degrees 0 to 2.
HARMONICS = 9
# Harmonics that change their sign in a mirror: they hold an odd power of y.
_ODD = [2, 6, 8]
# A joint that is nearer to the camera was triangulated wrongly.
_LEAST_DEPTH_M = 0.3
# Rotations of so many pictures take 7 MB.
_BLOCK = 4096


def harmonics(direction: Float) -> Float:
    """Return the spherical harmonics [..., 9] of degrees 0 to 2, not normalised, of directions [..., 3]."""
    x, y, z = np.moveaxis(direction, -1, 0)
    found = [np.ones_like(x), x, y, z, x * x - z * z, y * y - z * z, x * y, x * z, y * z]
    return np.stack(found, axis=-1)


@dataclass(frozen=True)
class ViewErrors:
    """BlazePose's errors of K joints: the bones that are their frames [K], and coefficients [K, 3, 9]."""

    bone: Index
    coefficient: Float  # relative to the stature

    @classmethod
    def of(cls, joints: Sequence[str]) -> ViewErrors:
        """Read the table; joints that it does not have are without errors."""
        rows = pd.read_csv(TABLE, comment="#").to_dict("split")["data"]
        table = {joint: (name, np.reshape(numbers, (3, HARMONICS))) for joint, name, *numbers in rows}
        bone, coefficient = np.zeros(len(joints), dtype=np.intp), np.zeros((len(joints), 3, HARMONICS))
        for k, joint in enumerate(joints):
            if joint in table:
                name, coefficient[k] = table[joint]
                bone[k] = BONE[name]
            elif mirrored(joint) in table:
                name, coefficient[k] = table[mirrored(joint)]
                bone[k] = BONE[mirrored(name)]
                coefficient[k, 1] *= -1
                coefficient[k][:, _ODD] *= -1
        return cls(bone, coefficient)

    def at(self, turn: Float, direction: Float) -> Float:
        """Compute shifts [N, K, 3] in the world, per stature, of rotations [N, 22, 3, 3] and directions."""
        frame = turn[:, self.bone]
        own = harmonics(np.einsum("nkji,nkj->nki", frame, direction))
        shift = np.einsum("kif,nkf->nki", self.coefficient, own)
        return np.asarray(np.einsum("nkij,nkj->nki", frame, shift))


def without_view_errors(
    cameras: Sequence[Camera],
    found: Candidates,
    choice: Int64,
    observations: Observations,
    sides: Int64,
    result: Triangulation,
    stature_m: float | None,
) -> list[Camera]:
    """Return cameras whose detections of people [T', C, P] by BlazePose are rid of these errors.

    `sides` are those of `observations` (`on_sides`), and `result` what was triangulated from these. Missing
    joints are where the line between their neighbours in time has them. A joint that is never known, or not
    before the camera, keeps its rays. Without `stature_m` the person has the mean stature.
    """
    known = landmarks_of(observations.joints)
    if known is None or not any(camera.blazepose for camera in cameras):
        return list(cameras)
    landmarks, columns = known
    errors = ViewErrors.of(landmarks.joints)
    times, people, joints, _ = observations.confidence.shape
    ok = result.status == STATUS.index("ok")
    place = np.where(ok[:, None], result.points, np.nan).reshape(times, people, joints, 3)[:, :, columns]
    flat = pd.DataFrame(place.reshape(times, -1), index=observations.t_ns)
    place = flat.interpolate("index", limit_direction="both").to_numpy().reshape(place.shape)
    corrected = []
    for c, camera in enumerate(cameras):
        if not camera.blazepose:
            corrected.append(camera)
            continue
        aside: Float32 = np.zeros((len(camera.detections.frame), joints, 2), np.float32)
        for person in range(people):
            frames, rows, detection = frames_of(camera, found, c, choice[:, c, person])
            at = nearest_rows(observations.t_ns, camera.frame_t_ns[frames])
            for k in range(0, len(frames), _BLOCK):
                block = slice(k, k + _BLOCK)
                row, seen_at = at[block], rows[block]
                away = place[row, person] - found.position[seen_at, c, None]
                direction = away / np.linalg.norm(away, axis=-1, keepdims=True)
                shift = errors.at(turns_of_bones(landmarks, place[row, person]), direction)
                shift *= stature_m or MEAN_SHAPE[0]
                seen, moved = (each @ found.rotation[seen_at, c] for each in (away, shift))
                by = (moved[..., :2] - seen[..., :2] / seen[..., 2:] * moved[..., 2:]) / seen[..., 2:]
                side = sides[row, person][:, columns, c]
                n, j = np.nonzero((side >= 0) & np.isfinite(by[..., 0]) & (seen[..., 2] > _LEAST_DEPTH_M))
                aside[detection[block][n], side[n, j]] = by[n, j]
        corrected.append(replace(camera, aside=aside))
    return corrected
