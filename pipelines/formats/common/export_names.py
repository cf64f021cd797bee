"""Names of exported files, and the choice of files that a recording gives."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, Recording, Trajectory


def safe_file_name(name: str) -> str:
    """Turn a free-text name into part of a file name: letters, digits, dot, dash, underscore."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._")[:80] or "recording"


def people_of(recording: Recording, folder: Path, suffix: str) -> tuple[JointMotion, dict[int, Path]]:
    """Return a recording's motion, and a file for each person with at least one known joint.

    The file is `<name>.trc`, or `<name>_person<k>.trc` if there are several people (for the suffix `.trc`).

    Raises:
        DataError: no joint of any person is known.
    """
    motion = recording.motion
    if motion is None or np.isnan(motion.position).all():
        raise DataError(recording.name, "holds no joints to export", "run `mocap reconstruct` first")
    people = motion.position.shape[1]
    known = [person for person in range(people) if not np.isnan(motion.position[:, person]).all()]
    which = {person: f"_person{person}" if people > 1 else "" for person in known}
    name = safe_file_name(recording.name)
    return motion, {person: folder / f"{name}{which[person]}{suffix}" for person in known}


def tracks_of(recording: Recording) -> dict[str, Trajectory]:
    """Return the cameras' poses by file name: `<camera>` as logged, `<camera>_refined` as corrected."""
    tracks = dict(recording.cameras)
    tracks |= {f"{camera}_refined": track for camera, track in recording.refined.items()}
    return {name: track for name, track in tracks.items() if len(track.t_ns)}


def write_tables(
    recording: Recording,
    folder: Path,
    suffix: str,
    write_joints: Callable[[Path, JointMotion], None],
    write_poses: Callable[[Path, Trajectory], None],
) -> list[Path]:
    """Write a recording's tables: `<name>` with the joints, `<name>_<camera>` with a camera's poses.

    Raises:
        DataError: it has neither joints nor camera poses.
    """
    name = safe_file_name(recording.name)
    paths: list[Path] = []
    if recording.motion is not None and recording.motion.position.size:
        paths.append(folder / f"{name}{suffix}")
        write_joints(paths[-1], recording.motion)
    for camera, trajectory in tracks_of(recording).items():
        paths.append(folder / f"{name}_{safe_file_name(camera)}{suffix}")
        write_poses(paths[-1], trajectory)
    if not paths:
        raise DataError(recording.name, "holds neither joints nor camera poses", "reconstruct it first")
    return sorted(paths)
