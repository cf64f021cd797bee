"""Poses of a camera whose log has places alone: its film says how it turned (`pose.attitude: pictures`)."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from pipelines.geometry.arrays import Index, Intrinsics
from pipelines.geometry.noise import PoseErrors, pose_errors
from pipelines.geometry.poses import (
    conjugate,
    interpolate_poses,
    multiply,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction.background_tracks import Follower
from pipelines.reconstruction.picture_map import (
    REVISION,
    KeyFeatures,
    LaidMap,
    NoAttitudesError,
    PictureMap,
    features_of,
    followed_features,
    key_rows,
    lay_on_places,
    map_pictures,
    poses_of_pictures,
    rows_of_film,
    shrunk,
)
from pipelines.session.camera_poses import noise_models
from pipelines.session.description import PictureMapEntry
from pipelines.session.errors import DataError
from pipelines.session.progress import Progress
from pipelines.session.records import Trajectory
from pipelines.session.storage import hash_of
from pipelines.session.tables import read_table, write_table
from pipelines.sources.parts import CameraFrames
from pipelines.sources.pictures import CameraPictures

PICTURE_MAP = pa.schema(
    [("key", pa.int64()), *((name, pa.float64()) for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))]
)
"""cameras/<camera>/picture_map.parquet: map_from_camera of the mapped key pictures."""

PICTURE_MAP_SIGHTINGS = pa.schema(
    [("key", pa.int64()), ("point", pa.int64()), ("x", pa.float64()), ("y", pa.float64())]
)
"""cameras/<camera>/picture_map_sightings.parquet: the map's points in these pictures, x/z and y/z."""

MAP_FILES = ("picture_map.parquet", "picture_map_sightings.parquet")
"""Files of a map in a camera's folder."""

# A satellite receiver's error decorrelates in minutes (docs/flight.md, Poses).
SATELLITE_CORRELATION_S = 100.0

# A log's attitude that is further from the pictures' one is said: gimbals and compasses err by less.
MAX_UNLIKE_DEG = 15.0

# Logged attitudes further apart are not compared between: a drone takes photographs some seconds apart.
MAX_COMPARED_GAP_S = 20.0

# Positions of a log on board that state no errors are taken to have the constant ones of `UNKNOWN_SIGMA`.
UNSTATED_BIAS_M = 0.3


@dataclass(frozen=True)
class TurnedByPictures:
    """Poses with attitudes by pictures, and what comes with them."""

    trajectory: Trajectory
    intrinsics: Intrinsics  # with the focal length of the map, if that was refined
    pose_noise: dict[str, dict[str, float | str]]  # of places as stated, of attitudes as found
    map: PictureMap
    entry: PictureMapEntry


@dataclass(frozen=True)
class FilmOfCamera:
    """Pictures from which the attitudes are found."""

    digest: str
    opened: Callable[[], AbstractContextManager[CameraPictures]]


def turned_by_pictures(
    place: str,
    name: str,
    film: FilmOfCamera,
    frames: CameraFrames,
    intrinsics: Intrinsics,
    places: Trajectory,
    *,
    refine_focal: bool,
    pose_noise: Mapping[str, Mapping[str, float | str]] | None,
    satellite_sigma_m: float | None,
    kept: Callable[[str], PictureMap | None],
    note: Callable[[str], None],
    progress: Progress,
) -> TurnedByPictures:
    """Find the attitudes of a camera by its film; DataError: the film and the places do not determine them.

    Logged rotations of `places` are only compared, NaN for none. A guessed focal length is refined where the
    pictures determine it. `satellite_sigma_m` is None for positions of another kind; `kept` returns the map
    of an earlier ingest by its key; `note` receives one line on the result.
    """
    rows = key_rows(frames.pts_ns)
    numbers = frames.frame[rows].tolist()
    key = hash_of([REVISION, film.digest, numbers, asdict(intrinsics), refine_focal])
    stated = None if not pose_noise else {model: dict(values) for model, values in pose_noise.items()}
    if stated is None and satellite_sigma_m is not None:
        stated = {"gauss-markov": {"position_m": satellite_sigma_m, "correlation_s": SATELLITE_CORRELATION_S}}
        note(f"{name}: its places are taken to be off by {satellite_sigma_m:g} m: say pose_noise if not")
    try:
        found = kept(key)
        if found is None:
            features = _features(film, frames, rows, intrinsics, progress)
            found = map_pictures(features, intrinsics, refine_focal=refine_focal)
        laid = lay_on_places(
            found, intrinsics, frames.t_ns[rows], places.t_ns, places.position, _errors(place, stated)
        )
    except NoAttitudesError as error:
        problem = f"its film does not say how it turned: {error}"
        remedy = "name a log with attitudes, or gimbal: {yaw_deg: 90, pitch_deg: -30} if it never turned"
        raise DataError(f"{place}.pose.attitude", problem, remedy, code="no-attitude") from None
    position, turned = poses_of_pictures(laid, places.t_ns, places.position, frames.t_ns)
    known = np.isfinite(turned[:, 0])
    common_deg, picture_deg = np.degrees([laid.common_sigma_rad, laid.picture_sigma_rad]).tolist()
    unlike = _unlike_log(name, laid, places, note)
    entry = PictureMapEntry(
        key=key,
        unlike_log=unlike,
        key_pictures=len(numbers),
        mapped=len(found.key),
        points=int(found.seen_point.max()) + 1,
        error_px=laid.error_px,
        residual_m=laid.residual_m,
        common_sigma_deg=common_deg,
        picture_sigma_deg=picture_deg,
        focal_ratio=found.focal_ratio,
    )
    note(
        f"{name}: attitudes by its pictures, {len(found.key)} of {len(numbers)} mapped,"
        f" {laid.residual_m:.2g} m from its places; standard deviation {common_deg:.2g} deg of all,"
        f" {picture_deg:.2g} deg of each"
    )
    if refine_focal:
        held = found.focal_ratio == 1.0
        note(
            f"{name}: its focal length of {intrinsics.fx:.0f} px is assumed, and"
            + (
                " its pictures do not determine it: it is held"
                if held
                else f" {found.focal_ratio * intrinsics.fx:.0f} px by its pictures"
            )
        )
    ratio = found.focal_ratio
    return TurnedByPictures(
        replace(places, t_ns=frames.t_ns[known], position=position[known], quaternion_xyzw=turned[known]),
        replace(intrinsics, fx=ratio * intrinsics.fx, fy=ratio * intrinsics.fy),
        _with_rotation(stated, laid),
        found,
        entry,
    )


def _unlike_log(name: str, laid: LaidMap, logged: Trajectory, note: Callable[[str], None]) -> int:
    """Count the key pictures whose attitude the log has otherwise, and say when and by how much."""
    rows = np.isfinite(logged.quaternion_xyzw).all(axis=1)
    if not rows.any():
        return 0
    there = interpolate_poses(
        logged.t_ns[rows],
        logged.position[rows],
        logged.quaternion_xyzw[rows],
        laid.t_ns,
        max_gap_ns=round(MAX_COMPARED_GAP_S * 1e9),
        max_extrapolation_ns=0,
    )[1]
    away = rotation_vector_from_quaternion(multiply(conjugate(laid.quaternion_xyzw), there))
    away_deg = np.degrees(np.linalg.norm(away, axis=1))
    unlike = np.flatnonzero(away_deg > MAX_UNLIKE_DEG)
    if len(unlike):
        first_s, last_s = ((laid.t_ns[unlike[[0, -1]]] - laid.t_ns[0]) / 1e9).tolist()
        note(
            f"{name}: in {len(unlike)} of {len(away_deg)} key pictures, {first_s:.0f} to {last_s:.0f} s after"
            f" the first, its log turns the camera otherwise than its pictures, by"
            f" {float(np.median(away_deg[unlike])):.0f} deg: its pictures are used"
        )
    return len(unlike)


def _features(
    film: FilmOfCamera, frames: CameraFrames, keys: Index, intrinsics: Intrinsics, progress: Progress
) -> list[KeyFeatures]:
    followed = rows_of_film(frames.pts_ns, keys)
    rows = keys if followed is None else followed
    follower, features = Follower(), []
    progress.start("Mapping by pictures", len(rows))
    with film.opened() as pictures:
        for k, number in enumerate(frames.frame[rows].tolist()):
            picture = pictures.read(number)
            if followed is not None:
                follower.step(k, None if picture is None else shrunk(picture))
            else:
                blank = np.zeros((intrinsics.height, intrinsics.width), np.uint8)
                features.append(features_of(blank if picture is None else picture, intrinsics))
            progress.advance()
    if followed is None:
        return features
    return followed_features(follower.tracks(), followed, keys, intrinsics, frames.pts_ns)


def _errors(place: str, stated: Mapping[str, Mapping[str, float | str]] | None) -> PoseErrors | None:
    """Return the prior of stated errors of places; None without, or if models of plug-ins give none."""
    if stated is None:
        return None
    try:
        errors = pose_errors(noise_models(f"{place}.pose_noise", stated))
    except ValueError:
        return None
    placed = errors.white[0] > 0 or any(process.number != 3 for process in errors.processes)
    return errors if placed else None


def _with_rotation(
    stated: Mapping[str, Mapping[str, float | str]] | None, laid: LaidMap
) -> dict[str, dict[str, float | str]]:
    """Return stated noise models of places with the found noise of attitudes."""
    if stated is None:
        stated = {"white": {"position_m": round(laid.residual_m, 4)}, "bias": {"position_m": UNSTATED_BIAS_M}}
    merged: dict[str, dict[str, float | str]] = {
        model: {key: value for key, value in values.items() if not key.startswith("rotation_deg")}
        for model, values in stated.items()
    }
    for model, sigma_rad in (("bias", laid.common_sigma_rad), ("white", laid.picture_sigma_rad)):
        merged.setdefault(model, {})["rotation_deg"] = round(float(np.degrees(sigma_rad)), 4)
    return merged


def store_map(found: PictureMap, folder: Path) -> None:
    """Write a picture map."""
    columns = {"key": found.key}
    columns |= dict(zip(PICTURE_MAP.names[1:4], found.position.T, strict=True))
    columns |= dict(zip(PICTURE_MAP.names[4:], found.quaternion_xyzw.T, strict=True))
    write_table(folder / MAP_FILES[0], pd.DataFrame(columns), PICTURE_MAP)
    x, y = found.seen_xy.T
    sightings = {"key": found.seen_in, "point": found.seen_point, "x": x, "y": y}
    write_table(folder / MAP_FILES[1], pd.DataFrame(sightings), PICTURE_MAP_SIGHTINGS)


def load_map(folder: Path, entry: PictureMapEntry) -> PictureMap:
    """Read a picture map; DataError if it is damaged."""
    poses = read_table(folder / MAP_FILES[0], PICTURE_MAP)
    seen = read_table(folder / MAP_FILES[1], PICTURE_MAP_SIGHTINGS)
    numbers = poses[PICTURE_MAP.names[1:]].to_numpy(np.float64)
    key, seen_in, seen_point = (
        column.to_numpy(np.int64) for column in (poses["key"], seen["key"], seen["point"])
    )
    seen_xy = seen[["x", "y"]].to_numpy(np.float64)
    return PictureMap(key, numbers[:, :3], numbers[:, 3:], seen_in, seen_point, seen_xy, entry.focal_ratio)
