"""Parts that exports share: names of files, tables, chosen times, maps and covariances for viewers."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.session.errors import DataError
from pipelines.session.maps import MapSurface, surface_of
from pipelines.session.records import (
    JointMotion,
    MovingBody,
    Occupancy,
    Recording,
    Trajectory,
    full_covariance,
)

CHI2_95 = 7.815
"""An ellipsoid {x : x' S^-1 x = 7.815} holds 95 % of a Gaussian in three dimensions (chi-square)."""

# Viewers stay fluent up to this number of cubes.
MOST_CUBES = 1_000_000


def safe_file_name(name: str) -> str:
    """Turn a free-text name into part of a file name: letters, digits, dot, dash, underscore."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._")[:80] or "recording"


def people_of(recording: Recording, folder: Path, suffix: str) -> tuple[JointMotion, dict[int, Path]]:
    """Return the motion, and `<name>.trc` or, of several people with joints, `<name>_<person>.trc`."""
    motion = recording.motion
    if motion is None or np.isnan(motion.position).all():
        raise DataError(recording.name, "holds no joints to export", "run `mocap reconstruct` first")
    people = motion.position.shape[1]
    known = [person for person in range(people) if not np.isnan(motion.position[:, person]).all()]
    name = safe_file_name(recording.name)
    named = file_names_of_people(recording, people)
    return motion, {
        person: folder / f"{name}_{named[person]}{suffix}" if people > 1 else folder / f"{name}{suffix}"
        for person in known
    }


def file_names_of_people(recording: Recording, people: int) -> list[str]:
    """Return a part of a file name for each person: their name, and a number where two would be equal."""
    names: list[str] = []
    for person in range(people):
        name = safe_file_name(recording.name_of(person))
        while name.casefold() in {one.casefold() for one in names}:
            name = f"{name}_{person}"
        names.append(name)
    return names


def bodies_of(recording: Recording, export: str) -> tuple[JointMotion, Sequence[MovingBody]]:
    """Return motion and bodies, and note who has joints but no body; DataError: nobody has one."""
    bodies, motion = recording.bodies(), recording.motion
    if motion is None or not bodies:
        remedy = "run `mocap reconstruct`; a body needs hips, shoulders and ten landmarks of a person"
        raise DataError(recording.name, "holds no body to export", remedy, code="no-body")
    seen = np.flatnonzero(np.isfinite(motion.position).any(axis=(0, 2, 3))).tolist()
    without = [recording.name_of(person) for person in sorted({*seen} - {body.person for body in bodies})]
    if without:
        recording.progress.note(f"{export}: no body is known of {', '.join(without)}, left out")
    return motion, bodies


def tracks_of(recording: Recording) -> dict[str, Trajectory]:
    """Return the cameras' poses by file name: `<camera>` as logged, `<camera>_refined` as corrected."""
    tracks = dict(recording.cameras)
    tracks |= {f"{camera}_refined": track for camera, track in recording.refined.items()}
    return {name: track for name, track in tracks.items() if len(track.t_ns)}


def note_no_skeleton(recording: Recording, export: str) -> None:
    """Note that an export holds the cameras alone, if the session has no skeleton yet."""
    if recording.motion is None or not recording.motion.position.size:
        recording.progress.note(
            f"{export}: no skeleton yet, the cameras alone are written: run `mocap reconstruct` first"
        )


def ellipsoids_95(covariance: Float) -> tuple[Float, Float]:
    """Compute half axes [..., 3] m and world_from_axes [..., 4] of 95 % ellipsoids of [..., 6] m^2."""
    full = full_covariance(covariance)
    known = np.isfinite(full).all(axis=(-2, -1))
    half = np.full((*known.shape, 3), np.nan)
    turn = np.full((*known.shape, 4), np.nan)
    values, vectors = np.linalg.eigh(full[known])
    vectors[..., 0] *= np.sign(np.linalg.det(vectors))[..., None]  # a rotation, not a reflection
    half[known] = np.sqrt(CHI2_95 * np.maximum(values, 0.0))
    turn[known] = quaternion_from_matrix(vectors)
    return half, turn


def shown_surface(recording: Recording, occupancy: Occupancy, export: str) -> MapSurface:
    """Find the surface of a map of the recording; note if its voxels are gathered in larger cubes."""
    surface = surface_of(occupancy, MOST_CUBES)
    if surface.cube_m > occupancy.resolution_m * 1.001:
        recording.progress.note(
            f"{export}: the map's {surface.voxels} surface voxels are gathered in cubes of "
            f"{surface.cube_m:g} m, {len(surface.middle)} of them"
        )
    return surface


def thinned(t_ns: Int64, rate_hz: float) -> Int64:
    """Choose rows of sorted times: the first of every 1 / rate_hz seconds; none for a rate of 0."""
    if not rate_hz or not len(t_ns):
        return np.zeros(0, np.int64)
    period = np.floor((t_ns - t_ns[0]) * (rate_hz / 1e9) + 1e-6)
    return np.flatnonzero(np.diff(period, prepend=-1.0)).astype(np.int64)
