"""Poses of a camera whose log has places alone: its film says how it turned (`pose.attitude: pictures`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from pipelines.geometry.arrays import Float, Index, Int64, Intrinsics
from pipelines.geometry.cameras import undistort
from pipelines.geometry.noise import PoseErrors, pose_errors
from pipelines.geometry.poses import (
    conjugate,
    interpolate_poses,
    multiply,
    rotation_vector_from_quaternion,
)
from pipelines.keypoints.tracking import PeopleTracker
from pipelines.reconstruction.background_tracks import Follower
from pipelines.reconstruction.one_camera import STATED_STATURE_SIGMA_M, STATURE_M
from pipelines.reconstruction.picture_map import (
    FAR_SHARE_TO_MAP_AGAIN,
    JOINED,
    LEVEL_SIGMA_DEG,
    LIMB_SIGMA_SHARE,
    MOST_TRACKS,
    REVISION,
    KeyFeatures,
    LaidMap,
    NoAttitudesError,
    PeopleSeen,
    PictureMap,
    far_share,
    features_of,
    followed_features,
    join_maps,
    key_rows,
    lay_on_places,
    map_pictures,
    poses_of_pictures,
    rows_of_film,
    shrunk,
    sighting_errors_px,
)
from pipelines.session.camera_poses import noise_models
from pipelines.session.description import PictureMapEntry
from pipelines.session.errors import DataError
from pipelines.session.progress import Progress
from pipelines.session.records import Detections, Trajectory
from pipelines.session.registries import find_detector
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

# The mean attitude is free by so many of its standard deviations: places and pictures, which the estimate
# uses as well, hardly count twice.
FREE_SIGMAS = 3.0
# Maps of films bend by this random walk, deg per root second; chosen on three rendered flights.
BENT_DEG_PER_SQRT_S = 0.1

# A log's attitude that is further from the pictures' one is said: gimbals and compasses err by less.
MAX_UNLIKE_DEG = 15.0

# Logged attitudes further apart are not compared between: a drone takes photographs some seconds apart.
MAX_COMPARED_GAP_S = 20.0

# Positions of a log on board that state no errors are taken to have the constant ones of `UNKNOWN_SIGMA`.
UNSTATED_BIAS_M = 0.3

# People are looked for so often, which the tracker can follow, in so much of the middle of a flight.
JOINED_STEP_NS, JOINED_S = 166_666_667, 40.0
# In less time people do not move, and their errors are one.
MIN_JOINED_S = 2.0
# A joint of less confidence is a guess.
MIN_JOINED_CONFIDENCE = 0.5
# Places of a right map err by this against each other (13 rendered cameras: 3 to 32 mm).
MAPPED_SIGMA_M = 0.02
JOINING_DETECTOR = "blazepose"


@dataclass(frozen=True)
class TurnedByPictures:
    """Poses with attitudes by pictures, and what comes with them."""

    trajectory: Trajectory
    intrinsics: Intrinsics  # with the focal length of the map, if that was refined
    pose_noise: dict[str, dict[str, float | str]]  # of places as stated, of attitudes for the estimate
    map: PictureMap
    entry: PictureMapEntry


@dataclass(frozen=True)
class FilmOfCamera:
    """Pictures from which the attitudes are found."""

    digest: str
    opened: Callable[[], AbstractContextManager[CameraPictures]]


@dataclass(frozen=True)
class UnposedCamera:
    """A camera with its film, and what is known of it beside poses."""

    film: FilmOfCamera
    frames: CameraFrames
    intrinsics: Intrinsics
    detections: Detections | None  # keypoints that are stated
    refine_focal: bool
    kept: Callable[[str], PictureMap | None]  # the map of an earlier ingest by its key

    @property
    def key_t_ns(self) -> Int64:
        """Times of the key pictures."""
        return self.frames.t_ns[key_rows(self.frames.pts_ns)]

    def mapped(self, progress: Progress) -> tuple[str, PictureMap]:
        """Map the key pictures, or return the kept map, with its key; errors as in `map_pictures`."""
        rows = key_rows(self.frames.pts_ns)
        numbers = self.frames.frame[rows].tolist()
        key = hash_of([REVISION, self.film.digest, numbers, asdict(self.intrinsics), self.refine_focal])
        found = self.kept(key)
        if found is None:
            features = _features(self.film, self.frames, rows, self.intrinsics, progress)
            found = map_pictures(features, self.intrinsics, refine_focal=self.refine_focal)
        return key, found

    def people(self, t_ns: Int64, found: PictureMap, progress: Progress) -> Float:
        """Return x/z and y/z [T, P, J, 2] of people's `JOINED` in the pictures next to some times [T].

        They are NaN where a joint is not seen, and where no picture is near.
        """
        after = np.searchsorted(self.frames.t_ns, t_ns).clip(1, len(self.frames.t_ns) - 1)
        late = self.frames.t_ns[after] - t_ns > t_ns - self.frames.t_ns[after - 1]
        numbers, apart_ns = self.frames.frame[after - late].tolist(), self.frames.t_ns[after - late] - t_ns
        rows: list[tuple[int, int, Float, Float]] = []
        if self.detections is not None:
            joints, these = self.detections.joints, self.detections
            for k, number in enumerate(numbers):
                own = np.flatnonzero(these.frame == number).tolist()
                rows += [(k, int(these.person[row]), these.xy[row], these.confidence[row]) for row in own]
        else:
            networks = find_detector(JOINING_DETECTOR).load(threads=1)
            joints, tracker = networks.joints, PeopleTracker(networks)
            progress.start("Finding people to join cameras by", len(numbers))
            with self.film.opened() as pictures:
                for k, number in enumerate(numbers):
                    picture = pictures.read(number)
                    found_here = [] if picture is None else tracker.step(picture)
                    rows += [(k, who.track, who.person.xy, who.person.confidence) for who in found_here]
                    progress.advance()
        if lacking := [name for name in JOINED if name not in joints]:
            raise NoAttitudesError(f"keypoints have no {lacking[0]}")
        columns, ratio = [joints.index(name) for name in JOINED], found.focal_ratio
        lens = replace(self.intrinsics, fx=ratio * self.intrinsics.fx, fy=ratio * self.intrinsics.fy)
        often = Counter(person for _, person, _, _ in rows).most_common(MOST_TRACKS)
        seen = np.full((len(t_ns), max(len(often), 1), len(JOINED), 2), np.nan)
        order = {person: number for number, (person, _) in enumerate(often)}
        for k, person, xy, confidence in rows:
            if person in order:
                sure = confidence[columns] > MIN_JOINED_CONFIDENCE
                seen[k, order[person]] = np.where(sure[:, None], xy[columns], np.nan)
        seen[np.abs(apart_ns) > JOINED_STEP_NS // 2] = np.nan
        return undistort(seen.reshape(-1, 2), lens).reshape(seen.shape)


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
    stated = None if not pose_noise else {model: dict(values) for model, values in pose_noise.items()}
    if stated is None and satellite_sigma_m is not None:
        stated = {"gauss-markov": {"position_m": satellite_sigma_m, "correlation_s": SATELLITE_CORRELATION_S}}
        note(f"{name}: its places are taken to be off by {satellite_sigma_m:g} m: say pose_noise if not")
    try:
        camera = UnposedCamera(film, frames, intrinsics, None, refine_focal, kept)
        key, found = camera.mapped(progress)
        laid = lay_on_places(
            found, intrinsics, frames.t_ns[rows], places.t_ns, places.position, _errors(place, stated)
        )
    except NoAttitudesError as error:
        problem = f"its film does not say how it turned: {error}"
        remedy = "name a log with attitudes, or gimbal: {yaw_deg: 90, pitch_deg: -30} if it never turned"
        raise DataError(f"{place}.pose.attitude", problem, remedy, code="no-attitude") from None
    common_deg, picture_deg = np.degrees([laid.common_sigma_rad, laid.picture_sigma_rad]).tolist()
    unlike = _unlike_log(name, laid, places, note)
    note(
        f"{name}: attitudes by its pictures, {len(found.key)} of {len(rows)} mapped,"
        f" {laid.residual_m:.2g} m from its places; standard deviation {common_deg:.2g} deg of all,"
        f" {picture_deg:.2g} deg of each"
    )
    noise = _with_rotation(stated, laid, followed=rows_of_film(frames.pts_ns, rows) is not None)
    turned = _of_laid(camera, name, key, found, laid, places, noise, note)
    return replace(turned, entry=turned.entry.model_copy(update={"unlike_log": unlike}))


def _of_laid(
    camera: UnposedCamera,
    name: str,
    key: str,
    found: PictureMap,
    laid: LaidMap,
    places: Trajectory,
    pose_noise: dict[str, dict[str, float | str]],
    note: Callable[[str], None],
) -> TurnedByPictures:
    """Return the poses of all pictures of a laid map beside some places, and what is said of it."""
    intrinsics, ratio = camera.intrinsics, found.focal_ratio
    if camera.refine_focal:
        note(
            f"{name}: its focal length of {intrinsics.fx:.0f} px is assumed, and"
            + (
                " its pictures do not determine it: it is held"
                if ratio == 1.0
                else f" {ratio * intrinsics.fx:.0f} px by its pictures"
            )
        )
    t_ns = camera.frames.t_ns
    position, turned = poses_of_pictures(laid, places.t_ns, places.position, t_ns)
    known = np.isfinite(turned[:, 0])
    common_deg, picture_deg = np.degrees([laid.common_sigma_rad, laid.picture_sigma_rad]).tolist()
    entry = PictureMapEntry(
        key=key,
        key_pictures=len(key_rows(camera.frames.pts_ns)),
        mapped=len(found.key),
        points=int(found.seen_point.max()) + 1,
        error_px=laid.error_px,
        residual_m=laid.residual_m if np.isfinite(laid.residual_m) else None,
        common_sigma_deg=common_deg,
        picture_sigma_deg=picture_deg,
        focal_ratio=ratio,
    )
    return TurnedByPictures(
        replace(places, t_ns=t_ns[known], position=position[known], quaternion_xyzw=turned[known]),
        replace(intrinsics, fx=ratio * intrinsics.fx, fy=ratio * intrinsics.fy),
        pose_noise,
        found,
        entry,
    )


def posed_by_people(
    place: str,
    cameras: Mapping[str, UnposedCamera],
    stature_m: float | None,
    note: Callable[[str], None],
    progress: Progress,
) -> dict[str, TurnedByPictures]:
    """Find the poses of cameras by their films and the people in them; DataError: they do not say them.

    Each camera is mapped by itself. Six times a second of at most `JOINED_S`, people are looked for where no
    keypoints are stated. The frame is upright and begins at the people; one line says how far it is known.
    """
    maps: dict[str, tuple[str, PictureMap]] = {}
    for name, camera in cameras.items():
        try:
            maps[name] = camera.mapped(progress)
            if (far := far_share(maps[name][1], camera.intrinsics)) > FAR_SHARE_TO_MAP_AGAIN:
                raise NoAttitudesError(f"its map contradicts {100 * far:.0f} % of the points that are seen")
        except NoAttitudesError as error:
            problem = f"its film does not say how it moved: {error}"
            remedy = "leave it out, name a log of its poses or places, or film while it flies about"
            raise DataError(f"{place}.{name}.pose", problem, remedy, code="no-poses") from None
    keys = {name: cameras[name].key_t_ns[found.key] for name, (_, found) in maps.items()}
    first, last = max(int(t_ns[0]) for t_ns in keys.values()), min(int(t_ns[-1]) for t_ns in keys.values())
    spare = max(last - first - round(JOINED_S * 1e9), 0) // 2
    t_ns = np.arange(first + spare, last - spare + 1, JOINED_STEP_NS, dtype=np.int64)
    stature, sigma_m = STATURE_M if stature_m is None else (stature_m, STATED_STATURE_SIGMA_M)
    try:
        if len(t_ns) * JOINED_STEP_NS < MIN_JOINED_S * 1e9:
            raise NoAttitudesError(f"their films share {max(last - first, 0) / 1e9:.1f} s")
        seen = [
            PeopleSeen(name, maps[name][1], keys[name], camera.people(t_ns, maps[name][1], progress))
            for name, camera in cameras.items()
        ]
        joined = join_maps(seen, t_ns, stature)
    except NoAttitudesError as error:
        problem = f"pose: pictures: people do not join the cameras: {error}"
        remedy = "check frame_times.start, film the same people for longer, or name logs of places"
        raise DataError(place, problem, remedy, code="no-poses") from None
    scale = float(np.hypot(LIMB_SIGMA_SHARE, sigma_m / stature))
    note(
        f"poses by pictures and people: place and heading on Earth are arbitrary, lengths are those of people"
        f" of {stature:.2f} m, to {100 * scale:.0f} %, and the vertical is off by"
        f" {np.degrees(joined.tilt_sigma_rad):.1f} deg (standard deviations)"
    )
    turned = {}
    for (name, camera), laid, sigma in zip(
        cameras.items(), joined.laid, joined.position_sigma_m.tolist(), strict=True
    ):
        common_deg, picture_deg = np.degrees([laid.common_sigma_rad, laid.picture_sigma_rad]).tolist()
        note(f"{name}: beside the other cameras to {sigma:.2g} m and {common_deg:.2g} deg")
        noise: dict[str, dict[str, float | str]] = {
            "bias": {"position_m": round(sigma, 4), "rotation_deg": round(common_deg, 4)},
            "white": {"position_m": MAPPED_SIGMA_M, "rotation_deg": round(picture_deg, 4)},
        }
        error_px = float(np.median(sighting_errors_px(maps[name][1], camera.intrinsics)))
        places = Trajectory(laid.t_ns, laid.position, laid.quaternion_xyzw)
        whole = replace(laid, error_px=error_px)
        turned[name] = _of_laid(camera, name, *maps[name], whole, places, noise, note)
    return turned


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
    stated: Mapping[str, Mapping[str, float | str]] | None, laid: LaidMap, *, followed: bool
) -> dict[str, dict[str, float | str]]:
    """Return stated noise models of places with that of attitudes: as found from photographs.

    Of a film, whose points are `followed`, the constant part says next to nothing: the estimate weighs the
    same points and places, from which it follows, and it would count twice. And maps bend, slowly.
    """
    if stated is None:
        stated = {"white": {"position_m": round(laid.residual_m, 4)}, "bias": {"position_m": UNSTATED_BIAS_M}}
    merged: dict[str, dict[str, float | str]] = {
        model: {key: value for key, value in values.items() if not key.startswith("rotation_deg")}
        for model, values in stated.items()
    }
    common_deg, picture_deg = np.degrees([laid.common_sigma_rad, laid.picture_sigma_rad]).tolist()
    if followed:
        common_deg = float(np.hypot(FREE_SIGMAS * common_deg, LEVEL_SIGMA_DEG))
        bent = merged.setdefault("gauss-markov", {"correlation_s": SATELLITE_CORRELATION_S})
        bent["rotation_deg"] = round(BENT_DEG_PER_SQRT_S * (float(bent["correlation_s"]) / 2) ** 0.5, 4)
    for model, sigma_deg in (("bias", common_deg), ("white", picture_deg)):
        merged.setdefault(model, {})["rotation_deg"] = round(sigma_deg, 4)
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
