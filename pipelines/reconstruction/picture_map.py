"""Attitudes of one camera from its pictures: a map of key pictures, adjusted on the places that a log has.

Key pictures are chosen by time. Points are followed from each to the next ones through all pictures of a
film; pictures that are too far apart in time for that are matched by SIFT features. COLMAP's global mapper
(Pan et al. 2024) maps photographs. Of a film it maps 24 pictures, which are mapped from the plane of the
ground as well. COLMAP's incremental mapper (Schönberger and Frahm 2016) continues the better map, picture
by picture. The map depends on the pictures and the lens alone, so it is kept while places, clocks and noise
change. A similarity lays it on the logged places, roughly. One bundle adjustment then has the sightings,
the places with errors that are correlated in time, and a level horizon as evidence. Its covariance is that
of the attitudes.

Each camera is mapped by itself: views of two drones that are 90 degrees apart share too little, and a joint
map of the sample flight was wrong by 6 m. Where no log has places, people whom several cameras see join
their maps (`join_maps`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from pipelines.geometry.arrays import Bool, Float, Index, Int64, Intrinsics, Picture
from pipelines.geometry.cameras import undistort
from pipelines.geometry.noise import ROTATION, PoseErrors
from pipelines.geometry.poses import (
    continuous_signs,
    cross_matrix,
    interpolate_points,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
)
from pipelines.reconstruction.background_tracks import Tracks, rays_at_stamps
from pipelines.reconstruction.body_fit import landmarks_of
from pipelines.reconstruction.solving import MIN_MOMENTS, away_by_size

# Another number of features, pairs or key pictures gives other maps: kept maps of an older one are not used.
REVISION = 7

# --- which pictures, and what is matched -----------------------------------------------------------------

# Thirty key pictures in twelve seconds give attitudes as good as sixty do (15 parts of rendered films).
KEY_PICTURES_OF_SHORT_FILM = 30
# Closer pictures have no parallax, and cost as much.
MIN_KEY_STEP_S = 0.2
# Two pictures a second keep a minute of film below 60 s of processor time, and overlap while a gimbal pans.
MAX_KEY_STEP_S = 0.5
# The adjustment of so many poses takes half a gigabyte; a longer film has fewer of them in a minute.
MOST_KEY_PICTURES = 400
# Points in smaller pictures are as accurate in the map as those in whole ones, in less time.
LONGER_SIDE_PX = 1280
# Points are followed through this many pictures a second: with fewer they move too far.
FOLLOWED_HZ = 30.0
# Points drift while they are followed: of those seen for longer than 8 s in a minute of rendered film, 15 to
# 50 % were 2 px off, of others 2 %. After that they count as new points.
MAX_FOLLOWED_S = 8.0
# Pictures further apart are photographs, whose points cannot be followed.
MAX_FOLLOWED_STEP_S = 0.2
# Pairs of key pictures nearer than this have so little parallax that their geometry is ambiguous: with them,
# two of twenty cameras of rendered flights were mapped as a mirrored scene.
MIN_PAIR_STEPS = 3
# More features cost more matching (quadratic) and bind a picture no better.
MAX_FEATURES = 1000
# A photograph is matched with so many later ones, and some at 32, 64, ... steps: a survey's legs overlap.
MATCHED_STEPS = 30
# Fewer matches of two pictures are chance (COLMAP's default).
MIN_MATCHES = 15
# Two sightings of a point test nothing.
MIN_SIGHTINGS = 3
# Any seed serves: the same one gives the same map.
SEED = 1

# --- what a map must fulfil ------------------------------------------------------------------------------

# A map of fewer pictures has too few places to lay it on.
MIN_MAPPED_PICTURES = 8
# If fewer key pictures are in one map, it fell apart, and its largest piece may be a misfit.
MIN_MAPPED_SHARE = 0.5
# A focal length is determined if a start that is off by this share leads to the same one.
OTHER_FOCAL = 1.1
# Less than this moves attitudes by less than a degree at the border of a picture.
MAX_FOCAL_DISAGREEMENT = 0.02
# Attitudes with a larger common error start the estimate outside of its convergence (20 deg: 1 of 2 failed).
MAX_ATTITUDE_SIGMA_DEG = 10.0
# Residuals of a right map are those of the places: beyond three times their stated errors (a mean square of
# 9) the map is wrong.
MAX_MISFIT = 9.0
# A sighting this far from its point does not fit: followed points err by 0.4 px.
FAR_PX = 2.0
# Of right maps at most 10 % of the sightings are far, of wrong ones 26 % and more (20 rendered cameras).
MAX_FAR_SHARE = 0.16
# The same share before places adjust a map, which they never do where no log has any: 0.08 at most in 24
# right maps of parts of three rendered films of a minute.
FAR_SHARE_TO_MAP_AGAIN = 0.1
# A map of a film begins with so many key pictures around these places in it, until one is right.
BEGUN_WITH, BEGINS = 24, (0.5, 0.2, 0.8)
# Pictures this many steps from the middle one say how the plane lies below it.
PLANE_STEPS = (-12, -8, -5, -3, 3, 5, 8, 12)
# Points on a plane that are further away, in heights of the camera above it, are seen too flatly to place.
MAX_PLANE_DISTANCE = 30.0
# Larger errors above a plane are those of points beside it, and a chain with this mean error shows no plane.
MAX_PLANE_ERROR_PX = 30.0
# Loss of sightings in the rounds of the adjustment, px: the map's bend first, the points' errors last.
LOSS_ROUNDS_PX = (30.0, 6.0, 2.0)
# Followed points drift together with their neighbours, and keep their error for a second. So many sightings
# count as one: with it attitudes of rendered flights err by their standard deviations.
SIGHTINGS_ALIKE = 64.0
# Sightings err by this where residuals are smaller (features of photographs).
MIN_SIGHTING_PX = 0.2
# Places by satellites leave a map so loose that its adjustment takes a hundred steps; with RTK it takes ten.
MAX_STEPS = 300
# A tenth of the smallest standard deviation of an attitude.
CONVERGED_RAD = 1e-4
# A cost, in squares of standard deviations, that falls by less moves nothing by a tenth of one.
CONVERGED_COST = 0.01
# A round is a start for the next one: it ends where the cost falls by a smaller share.
SETTLED_SHARE = 1e-3
# Nothing that pictures show is nearer.
MIN_DEPTH_M = 0.1
# Rays that are nearer to parallel start their point by it where the camera is.
MIN_SQUARED_ANGLE = 1e-6
# Points are known to 300 m at worst, which is far enough for any.
MIN_POINT_PRECISION = 1e-5
# Where nobody states the places' errors, a map that misses them by more of its size is taken for a wrong one.
MAX_UNSTATED_SHARE = 0.03
# Gimbals hold their horizon to this, and so does the mean of a camera on a drone that banks both ways.
LEVEL_SIGMA_DEG = 2.0
# The least squares converge from half of this.
TRIED_TURN_DEG = 15.0
# Cameras that look between 73 deg up and 17 deg beyond straight down are upright: atan(1 / 0.3) is 73 deg.
LOOKING_DOWN_WEIGHT = 0.3
# An interpolated picture is between key pictures at half the distance that `_bridge_sigma` measures: a smooth
# motion errs by a quarter, a rough one by half.
SHARE_OF_DOUBLE_STEP = 1 / 3
# Attitudes are not interpolated across a longer gap between mapped pictures.
MAX_BRIDGE_S = 1.5
# Places of a log further apart than this are not compared with the map between them (GPX: one a second).
MAX_PLACE_GAP_S = 3.0
# So many places determine a similarity; the least squares grow with their cube.
MAX_PLACES = 300
# Places further from the first fit than this many median distances jumped away, and are left out.
MAX_MEDIAN_DISTANCES = 6.0

# --- maps of several cameras, joined by the people whom they see ------------------------------------------

JOINED = (
    "nose",
    *(
        f"{side}_{part}"
        for part in ("ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in ("left", "right")
    ),
)
"""Joints by which maps are joined: those that most detectors have."""
MIDDLES = ("nose", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
"""Points of people in which a detector that takes left for right does not err: middles of both sides."""
SHOULDERS, ANKLES = MIDDLES.index("shoulder"), MIDDLES.index("ankle")
# Before anything is known a camera is taken to look down by this, and a person to stand upright.
FIRST_DOWN_DEG = 20.0
# Headings between two cameras that are tried: the least squares converge from 45 deg.
FIRST_HEADINGS = 8
# A detector's joint is off by this in a person, m: two joints of two views are one within three times that.
JOINT_SIGMA_M = 0.035
# Errors of joints last while a camera looks from one side: so many are independent in a flight.
INDEPENDENT_MOMENTS = 10.0
# Shoulders stand above ankles to this in the mean of a flight: people who run lean forward.
UPRIGHT_SIGMA_DEG = 6.0
# Limbs of people of one stature differ by this in their sum, as detectors see them.
LIMB_SIGMA_SHARE = 0.03
# A path is from half a metre to a hundred metres long where anybody is filmed from it.
SCALES_M = (0.3, 30.0)
# Two cameras are placed by so many moments of a person, from each heading and then from the best one.
PAIRED_MOMENTS = (8, 24)
# More numbers of people in one camera are pieces of those who are followed longest.
MOST_TRACKS = 3
# Fewer common sightings of joints fit any similarity.
MIN_COMMON_JOINTS = 50
# Another person places two cameras as well if so many of the joints agree, and another heading if its cost is
# so little higher; both are other places if cameras are turned by more beside each other, or if another
# person moves them by more: people who walk together are so far apart.
MAX_RIVAL_SHARE, MAX_RIVAL_COST, RIVAL_DEG, RIVAL_M = 0.8, 1.5, 15.0, 0.8
# Of joints of one person in right maps at most 3 % pass each other by more than three standard deviations.
MIN_JOINED_SHARE = 0.8


class NoAttitudesError(ValueError):
    """Pictures do not determine the attitudes, with the reason."""


@dataclass(frozen=True)
class KeyFeatures:
    """Points in a key picture."""

    xy: Float  # [F, 2] x/z and y/z, without distortion
    descriptors: Picture  # [F, 128] of photographs; [F, 0] of films
    point: Int64  # [F] numbers of followed points, increasing; [0] of photographs


@dataclass(frozen=True)
class PictureMap:
    """Poses of K mapped key pictures in a frame of their own, of any scale and rotation."""

    key: Int64  # [K] index of each among the key pictures, increasing
    position: Float  # [K, 3]
    quaternion_xyzw: Float  # [K, 4] map_from_camera
    seen_in: Int64  # [N] of each sighting its picture, among the K
    seen_point: Int64  # [N] its point, from 0
    seen_xy: Float  # [N, 2] x/z and y/z, with the refined focal length
    focal_ratio: float = 1.0  # refined focal length over the one that was given

    @property
    def size(self) -> float:
        """Root mean square distance of the places from their mean."""
        return float(np.sqrt(np.square(self.position - self.position.mean(axis=0)).sum(axis=1).mean()))


@dataclass(frozen=True)
class LaidMap:
    """A picture map in the world, and how surely it lies there."""

    t_ns: Int64  # [K]
    position: Float  # [K, 3] m
    quaternion_xyzw: Float  # [K, 4] world_from_camera
    residual_m: float  # root mean square distance of the log's places from the map; NaN without a log
    error_px: float  # median reprojection error; NaN of joined maps
    common_sigma_rad: float  # per axis, of the error that all attitudes share
    picture_sigma_rad: float  # per axis, of the error of each picture, interpolated ones included


def key_rows(t_ns: Int64) -> Index:
    """Choose the rows of the key pictures among those of a film, by their times [T]."""
    span_s = float(t_ns[-1] - t_ns[0]) / 1e9
    step_s = np.clip(span_s / KEY_PICTURES_OF_SHORT_FILM, MIN_KEY_STEP_S, MAX_KEY_STEP_S)
    step_s = max(step_s, span_s / MOST_KEY_PICTURES)
    wanted = np.linspace(t_ns[0], t_ns[-1], max(round(span_s / step_s), 1) + 1)
    return np.unique(np.searchsorted(t_ns, wanted).clip(max=len(t_ns) - 1))


def rows_of_film(t_ns: Int64, keys: Index) -> Index | None:
    """Choose the rows of a film, of times [T], through which points are followed; None for photographs."""
    step_s = float(np.median(np.diff(t_ns))) / 1e9
    if step_s > MAX_FOLLOWED_STEP_S:
        return None
    return np.union1d(np.arange(0, len(t_ns), max(1, round(1 / FOLLOWED_HZ / step_s))), keys)


def shrinkage(width: int, height: int) -> float:
    """Return the scale of pictures in which points are found."""
    return min(LONGER_SIDE_PX / max(width, height), 1.0)


def shrunk(picture: Picture) -> Picture:
    """Return a picture, [H, W, 3] BGR or grey, in grey and at most `LONGER_SIDE_PX` long."""
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    share = shrinkage(*grey.shape)
    if share < 1:
        grey = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8)


def followed_features(
    tracks: Tracks, rows: Index, keys: Index, intrinsics: Intrinsics, t_ns: Int64
) -> list[KeyFeatures]:
    """Return the points of the key pictures among the followed rows [P]; tracks are in shrunk pictures."""
    whole = replace(tracks, xy=(tracks.xy + 0.5) / shrinkage(intrinsics.width, intrinsics.height) - 0.5)
    rays = rays_at_stamps(whole, intrinsics, t_ns[rows])
    first = np.full(int(tracks.point.max(initial=-1)) + 1, len(rows))
    np.minimum.at(first, tracks.point, tracks.picture)
    followed_s = (t_ns[rows[tracks.picture]] - t_ns[rows[first[tracks.point]]]) / 1e9
    # Points of one age are not cut at one time, which would part the film there: golden section spreads them.
    spread = tracks.point * 0.618034 % 1
    piece = (followed_s / MAX_FOLLOWED_S + spread).astype(np.int64)
    number = np.unique(tracks.point + len(first) * piece, return_inverse=True)[1]
    features = []
    for picture in np.searchsorted(rows, keys).tolist():
        mine = np.flatnonzero((tracks.picture == picture) & np.isfinite(rays).all(axis=1))
        mine = mine[np.argsort(number[mine])]
        features.append(KeyFeatures(rays[mine], np.empty((len(mine), 0), np.uint8), number[mine]))
    return features


def features_of(picture: Picture, intrinsics: Intrinsics) -> KeyFeatures:
    """Find SIFT features in a photograph, [H, W, 3] BGR or grey."""
    grey = shrunk(picture)
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, contrastThreshold=0.02)
    points, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return KeyFeatures(np.empty((0, 2)), np.empty((0, 128), np.uint8), np.empty(0, np.int64))
    share = shrinkage(*picture.shape[:2])
    pixels = (np.array([point.pt for point in points], np.float64) + 0.5) / share - 0.5
    xy = undistort(pixels, intrinsics)
    known = np.isfinite(xy).all(axis=1)
    return KeyFeatures(xy[known], np.asarray(descriptors[known], np.uint8), np.empty(0, np.int64))


def map_pictures(
    features: Sequence[KeyFeatures], intrinsics: Intrinsics, *, refine_focal: bool = False
) -> PictureMap:
    """Map key pictures by their features, refining a guessed focal length; NoAttitudesError: too few.

    A film's map begins with a part of it. Two pictures of a plane allow two motions (Longuet-Higgins 1986),
    and one wrong choice breaks a map of many. Where sightings contradict the map, another part begins it.
    """
    if not any(len(each.point) for each in features):
        return _mapped(features, intrinsics, refine_focal=refine_focal)
    last = max(len(features) - BEGUN_WITH, 0)
    begins = [round(min(max(each * len(features) - BEGUN_WITH / 2, 0), last)) for each in BEGINS]
    maps: list[PictureMap] = []
    problems: list[NoAttitudesError] = []
    for first in dict.fromkeys(begins):
        try:
            maps.append(_mapped_from(first, features, intrinsics, refine_focal=refine_focal))
        except NoAttitudesError as error:
            problems.append(error)
        if maps and far_share(maps[-1], intrinsics) <= FAR_SHARE_TO_MAP_AGAIN:
            break
    if not maps:
        raise problems[0]
    return min(maps, key=partial(far_share, intrinsics=intrinsics))


def _begun(features: Sequence[KeyFeatures], intrinsics: Intrinsics, *, refine_focal: bool) -> PictureMap:
    """Map some key pictures of a film by COLMAP and above a plane; the one that fits its sightings counts."""
    if not any(len(each.point) for each in features):
        raise NoAttitudesError(f"nothing is followed in {len(features)} of its pictures")
    maps: list[PictureMap] = []
    problems: list[NoAttitudesError] = []
    for mapped in (partial(_mapped, refine_focal=refine_focal), _mapped_above_plane):
        try:
            maps.append(mapped(features, intrinsics))
        except NoAttitudesError as error:
            problems.append(error)
    if not maps:
        raise problems[0]
    return min(maps, key=partial(far_share, intrinsics=intrinsics))


def far_share(found: PictureMap, intrinsics: Intrinsics) -> float:
    """Return the share of a map's sightings that are `FAR_PX` or more from their points."""
    return float((sighting_errors_px(found, intrinsics) > FAR_PX).mean())


def sighting_errors_px(found: PictureMap, intrinsics: Intrinsics) -> Float:
    """Return the distances of a map's sightings from their points [N], px of shrunk pictures."""
    turn, nowhere = matrix_from_quaternion(found.quaternion_xyzw), np.empty((0, 0))
    bundle = _Bundle(found, _shrunk_focal_px(found, intrinsics), nowhere, nowhere, nowhere)
    # A map of unit size has points nearer than `MIN_DEPTH_M`.
    at = 100 * found.position / found.size
    off = bundle.residuals(at, turn, _triangulated(found, at, turn))[0]
    return np.asarray(np.linalg.norm(off, axis=1))


def _shrunk_focal_px(found: PictureMap, intrinsics: Intrinsics) -> float:
    focal_px = found.focal_ratio * float(intrinsics.fx * intrinsics.fy) ** 0.5
    return float(focal_px) * shrinkage(intrinsics.width, intrinsics.height)


def _mapped(features: Sequence[KeyFeatures], intrinsics: Intrinsics, *, refine_focal: bool) -> PictureMap:
    """Map by COLMAP, all pictures at once."""
    import pycolmap

    focal_px = (intrinsics.fx * intrinsics.fy) ** 0.5
    with TemporaryDirectory() as folder:
        place = Path(folder)
        matched = _matched_pairs(place / "features.db", features, intrinsics, focal_px)
        if matched < MIN_MAPPED_PICTURES:
            raise NoAttitudesError(
                f"only {matched} pairs of {len(features)} key pictures have {MIN_MATCHES} matches:"
                " they are dark, blurred or without texture"
            )
        (place / "maps").mkdir()
        options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=SEED)
        options.mapper.num_threads = 1
        adjusting = options.mapper.bundle_adjustment
        adjusting.ceres.solver_options.num_threads = 1
        adjusting.refine_focal_length, adjusting.refine_extra_params = refine_focal, False
        found = pycolmap.global_mapping(place / "features.db", place, place / "maps", options=options)
    model = _largest(found, len(features))
    if refine_focal and not _determines_focal(model):
        return _mapped(features, intrinsics, refine_focal=False)
    return _read_model(model, features, focal_px)


def _largest(found: Mapping[int, Any], count: int) -> Any:
    """Return the largest of COLMAP's models of so many pictures; NoAttitudesError: it has too few of them."""
    model = max(found.values(), key=lambda each: each.num_reg_images(), default=None)
    mapped = 0 if model is None else model.num_reg_images()
    if model is None or mapped < max(MIN_MAPPED_PICTURES, MIN_MAPPED_SHARE * count):
        raise NoAttitudesError(
            f"{mapped} of {count} key pictures are in one map: a camera that stands or only turns"
            " has no parallax, and one that turns fast has pictures that share nothing"
        )
    return model


def _mapped_from(
    first: int, features: Sequence[KeyFeatures], intrinsics: Intrinsics, *, refine_focal: bool
) -> PictureMap:
    """Map some key pictures of a film from one on, and place the others beside them by COLMAP, one by one."""
    import pycolmap

    begun = _begun(features[first : first + BEGUN_WITH], intrinsics, refine_focal=refine_focal)
    focal_px = (intrinsics.fx * intrinsics.fy) ** 0.5
    with TemporaryDirectory() as folder:
        place = Path(folder)
        _matched_pairs(place / "features.db", features, intrinsics, focal_px, verified=False)
        with pycolmap.Database.open(place / "features.db") as database:
            (camera,) = database.read_all_cameras()
            images = sorted(database.read_all_images(), key=lambda image: image.name)
        camera.params = [focal_px * begun.focal_ratio, *camera.params[1:]]
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(camera)
        for number, at, turned in zip(
            (first + begun.key).tolist(), begun.position / begun.size, begun.quaternion_xyzw, strict=True
        ):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turned), at)
            model.add_image_with_trivial_frame(images[number], pose.inverse())
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=SEED, multiple_models=False)
        options.ba_refine_focal_length, options.ba_refine_extra_params = refine_focal, False
        options.extract_colors = False
        options.mapper.abs_pose_min_num_inliers = MIN_MATCHES
        options.mapper.abs_pose_refine_focal_length = False
        for name in ("begun", "maps"):
            (place / name).mkdir()
        files = place / "features.db", place, place / "begun"
        pycolmap.triangulate_points(model, *files, options=options).write(place / "begun")
        found = pycolmap.incremental_mapping(
            *files[:2], place / "maps", options=options, input_path=place / "begun"
        )
    model = _largest(found, len(features))
    if refine_focal and not _determines_focal(model):
        return _mapped_from(first, features, intrinsics, refine_focal=False)
    return _read_model(model, features, focal_px)


def _read_model(model: Any, features: Sequence[KeyFeatures], focal_px: float) -> PictureMap:
    """Read a model of COLMAP, with all sightings of its points in a film."""
    camera = next(iter(model.cameras.values()))
    images = {int(image.name): image for image in model.images.values() if image.has_pose}
    names = [np.full(len(each.xy), -1, np.int64) for each in features]
    for number, image in images.items():
        for feature, point in enumerate(image.points2D):
            if point.has_point3D():
                names[number][feature] = point.point3D_id
    if any(len(each.point) for each in features):
        known = {
            int(point): name
            for number in images
            for point, name in zip(features[number].point, names[number].tolist(), strict=True)
            if name >= 0
        }
        names = [np.array([known.get(int(point), -1) for point in each.point]) for each in features]
    key = sorted(images)
    placed = [images[number].cam_from_world().inverse() for number in key]
    at = np.array([pose.translation for pose in placed])
    turned = np.array([pose.rotation.quat for pose in placed])
    return _with_sightings(key, at, turned, names, features, float(camera.params[0] / focal_px))


def _with_sightings(
    key: Sequence[int], at: Float, turned: Float, names: Any, features: Sequence[KeyFeatures], ratio: float
) -> PictureMap:
    """Return a map of pictures with their points that are seen often; `names` has one for each, or -1."""
    counts = np.bincount(np.concatenate([names[number][names[number] >= 0] for number in key]), minlength=1)
    if counts.max() < MIN_SIGHTINGS:
        raise NoAttitudesError("none of its points is seen often enough")
    seen = [(names[number] >= 0) & (counts[names[number]] >= MIN_SIGHTINGS) for number in key]
    points = np.concatenate([names[number][each] for number, each in zip(key, seen, strict=True)])
    return PictureMap(
        np.array(key, np.int64),
        at,
        continuous_signs(turned),
        np.repeat(np.arange(len(key)), [int(each.sum()) for each in seen]),
        np.unique(points, return_inverse=True)[1],
        np.concatenate([features[number].xy[each] for number, each in zip(key, seen, strict=True)]) / ratio,
        ratio,
    )


def _mapped_above_plane(features: Sequence[KeyFeatures], intrinsics: Intrinsics) -> PictureMap:
    """Map a film by homographies from one plane, then adjust; NoAttitudesError: there is no such plane.

    Two views of a plane leave two normals (Longuet-Higgins 1986); all others decide between them.
    """
    focal_px = float(intrinsics.fx * intrinsics.fy) ** 0.5 * shrinkage(intrinsics.width, intrinsics.height)
    middle, normals = len(features) // 2, []
    for other in middle + np.array(PLANE_STEPS):
        if 0 <= other < len(features):
            shared = features[middle].point, features[other].point
            _, mine, its = np.intersect1d(*shared, return_indices=True)
            rays = np.insert(features[middle].xy[mine], 2, 1.0, axis=1)
            moved = _homography(rays[:, :2], features[other].xy[its], focal_px)
            if moved is not None:
                both = np.array(cv2.decomposeHomographyMat(moved, np.eye(3))[3])[..., 0]
                normals += [normal for normal in both if np.median(rays @ normal) > 0]
    chains = [_chain_above_plane(features, normal, focal_px) for normal in normals]
    at, turn, error_px = min(chains, key=lambda chain: chain[2], default=(None, None, np.inf))
    if at is None or turn is None or error_px >= MAX_PLANE_ERROR_PX:
        raise NoAttitudesError("its pictures show no plane")
    key = np.flatnonzero(turn.any(axis=(1, 2)))
    at, turn, names = at[key], turn[key], [each.point for each in features]
    found = _with_sightings(key.tolist(), at, quaternion_from_matrix(turn), names, features, 1.0)
    # The poses of the chain hold scale and place, loosely.
    bundle = _Bundle(found, focal_px, np.eye(len(at)), at, np.eye(len(at)) / found.size**2)
    fit = _adjusted(Similarity(1.0, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)), bundle)
    return replace(found, position=fit.position, quaternion_xyzw=continuous_signs(fit.quaternion_xyzw))


def _homography(source: Float, target: Float, focal_px: float) -> Float | None:
    """Fit a homography from points [N, 2] to image points x/z, y/z [N, 2]; None: it is not determined."""
    if len(source) < MIN_MATCHES:
        return None
    found = cv2.findHomography(source, target, cv2.USAC_FAST, FAR_PX / focal_px)[0]
    return None if found is None or not np.isfinite(found).all() else np.asarray(found, np.float64)


def _chain_above_plane(
    features: Sequence[KeyFeatures], normal: Float, focal_px: float
) -> tuple[Float, Float, float]:
    """Place pictures one by one, from the middle one at (0, 0, 1), above the plane z = 0.

    `normal` [3] points from it to the plane, in its camera. Return places [K, 3], world_from_camera
    [K, 3, 3], 0 of a picture that shares too little, and the mean error of points as if all were on the
    plane, px; infinite if too few pictures are placed.
    """
    count, middle = len(features), len(features) // 2
    right = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    right /= np.linalg.norm(right)
    at, turn, errors = np.tile([0.0, 0.0, 1.0], (count, 1)), np.zeros((count, 3, 3)), [np.zeros(0)]
    turn[middle] = right, np.cross(-normal, right), -normal
    placed = np.full((1 + max(int(each.point.max(initial=0)) for each in features), 2), np.nan)
    for k in (middle, *range(middle + 1, count), *range(middle - 1, -1, -1)):
        own = features[k]
        known = np.isfinite(placed[own.point, 0])
        if k != middle:
            there = placed[own.point[known]]
            # From above, y of a picture goes against y of the plane: USAC takes no mirrored points.
            view = _homography(there * [1, -1], own.xy[known], focal_px)
            if view is None:
                continue
            view[:, 1] *= -1
            view *= np.sign(np.median(there @ view[2, :2] + view[2, 2]))
            view /= np.sqrt(np.linalg.norm(view[:, 0]) * np.linalg.norm(view[:, 1]))
            u, _, vt = np.linalg.svd(np.column_stack([view[:, :2], np.cross(view[:, 0], view[:, 1])]))
            place = -(u @ vt).T @ view[:, 2]
            if not place[2] > 0:
                continue
            at[k], turn[k] = place, (u @ vt).T
            seen = (np.insert(there, 2, 0.0, axis=1) - at[k]) @ turn[k]
            errors.append(focal_px * np.linalg.norm(seen[:, :2] / seen[:, 2:] - own.xy[known], axis=1))
        ray = np.insert(own.xy, 2, 1.0, axis=1) @ turn[k].T
        away = np.linalg.norm(ray, axis=1) / np.maximum(-ray[:, 2], 0.5 / MAX_PLANE_DISTANCE)
        new = ~known & (away < MAX_PLANE_DISTANCE)
        placed[own.point[new]] = (at[k] - at[k, 2] * ray[new] / ray[new, 2:])[:, :2]
    if turn.any(axis=(1, 2)).mean() < MIN_MAPPED_SHARE or not sum(map(len, errors)):
        return at, turn, np.inf
    return at, turn, float(np.minimum(np.concatenate(errors), MAX_PLANE_ERROR_PX).mean())


def _determines_focal(model: Any) -> bool:
    """Test if a bundle adjustment with another focal length comes back; straight down on flat ground: no."""
    import pycolmap

    other = pycolmap.Reconstruction(model)
    camera = next(iter(other.cameras.values()))
    focal_px = float(camera.params[0])
    camera.params = [focal_px * OTHER_FOCAL, *camera.params[1:]]
    options = pycolmap.BundleAdjustmentOptions(refine_extra_params=False, print_summary=False)
    options.ceres.solver_options.num_threads = 1
    adjusted = pycolmap.BundleAdjustmentConfig()
    for number in other.images:
        adjusted.add_image(number)
    adjusted.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # `pycolmap.bundle_adjustment` prints to stderr whatever its logging is set to.
    pycolmap.create_default_bundle_adjuster(options, adjusted, other).solve()
    found_px = float(next(iter(other.cameras.values())).params[0])
    return abs(found_px / focal_px - 1) < MAX_FOCAL_DISAGREEMENT


def _matched_pairs(
    path: Path,
    features: Sequence[KeyFeatures],
    intrinsics: Intrinsics,
    focal_px: float,
    *,
    verified: bool = True,
) -> int:
    """Write features and matches as a database of pycolmap; return the number of pairs that match.

    Pictures of a film whose geometry is not `verified` are all paired, and what they share counts as it is.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    middle = [intrinsics.width / 2, intrinsics.height / 2]
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=intrinsics.width,
        height=intrinsics.height,
        params=[focal_px, *middle],
        has_prior_focal_length=True,
    )
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    rig_id = database.write_rig(rig)
    film, sift = any(len(each.point) for each in features), pycolmap.FeatureExtractorType.SIFT
    ids = []
    for number, found in enumerate(features):
        image = pycolmap.Image(name=f"{number:06d}", camera_id=camera.camera_id)
        image.image_id = database.write_image(image)
        frame = pycolmap.Frame(rig_id=rig_id)
        frame.add_data_id(image.data_id)
        frame.frame_id = image.image_id
        database.write_frame(frame)
        database.write_keypoints(image.image_id, (found.xy * focal_px + middle).astype(np.float32))
        if not film:
            # As COLMAP keeps them: square roots (RootSIFT, Arandjelović and Zisserman 2012).
            sums = np.maximum(found.descriptors.sum(axis=1, keepdims=True, dtype=np.float32), 1)
            rooted = (512 * np.sqrt(found.descriptors / sums)).round().clip(max=255).astype(np.uint8)
            described = pycolmap.FeatureDescriptors(type=sift, data=rooted)
            database.write_descriptors(image.image_id, described)
        ids.append(image.image_id)
    for first, second in combinations(range(len(features)) if film else (), 2):
        if not verified or second - first >= MIN_PAIR_STEPS:
            points = features[first].point, features[second].point
            matches = np.stack(np.intersect1d(*points, return_indices=True)[1:], axis=1)
            if len(matches) >= MIN_MATCHES:
                pair = ids[first], ids[second]
                database.write_matches(*pair, matches.astype(np.uint32))
                if not verified:
                    shared = {
                        "config": pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
                        "inlier_matches": matches.astype(np.uint32),
                    }
                    database.write_two_view_geometry(*pair, pycolmap.TwoViewGeometry(shared))
    database.close()
    verifying = pycolmap.TwoViewGeometryOptions(detect_watermark=False)
    verifying.ransac.random_seed = SEED
    if film and verified:
        one = pycolmap.GeometricVerifierOptions(num_threads=1)
        pycolmap.geometric_verification(path, verifier_options=one, two_view_geometry_options=verifying)
    elif not film:
        matching = pycolmap.FeatureMatchingOptions(num_threads=1)
        pairing = pycolmap.SequentialPairingOptions(overlap=MATCHED_STEPS, num_threads=1)
        pycolmap.match_sequential(path, matching, pairing, verifying)
    with pycolmap.Database.open(path) as written:
        return int(written.num_verified_image_pairs())


# --- laying a map on places ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Similarity:
    """World from map: scale, rotation and shift."""

    scale: float
    quaternion_xyzw: Float  # [4]
    shift: Float  # [3] m

    def places(self, position: Float) -> Float:
        """Move places [..., 3] of the map into the world."""
        return self.scale * rotate(self.quaternion_xyzw, position) + self.shift


def lay_on_places(
    found: PictureMap,
    intrinsics: Intrinsics,
    key_t_ns: Int64,
    t_ns: Int64,
    places: Float,
    errors: PoseErrors | None,
) -> LaidMap:
    """Lay a map on its camera's logged places [N, 3] m (z up) at times [N]; key pictures have times [P]."""
    from scipy.interpolate import CubicSpline
    from scipy.linalg import cholesky

    at_ns = key_t_ns[found.key]
    inside = np.flatnonzero((t_ns >= at_ns[0]) & (t_ns <= at_ns[-1]) & _bridged(at_ns, t_ns))
    chosen = np.unique(np.linspace(0, len(inside) - 1, min(len(inside), MAX_PLACES)).round().astype(int))
    rows = inside[chosen] if len(inside) else inside
    if len(rows) < 4:
        raise NoAttitudesError(f"its log has {len(rows)} places while its pictures are mapped")
    seconds = (t_ns[rows] - at_ns[0]) / 1e9
    between = CubicSpline((at_ns - at_ns[0]) / 1e9, np.eye(len(at_ns)))(seconds)
    start, fits = first_similarity(between @ found.position, places[rows])
    between, logged, seconds = between[fits], places[rows][fits], seconds[fits]
    unstated = errors is None
    if errors is None:
        level = max(float(np.sqrt(np.square(start.places(between @ found.position) - logged).mean())), 1e-3)
        errors = PoseErrors((level, 0.0), ())
    covariance = position_covariance(errors, seconds)
    # A map that is bent misses the places by more than their errors, whichever way up it lies.
    bend = float(np.square(start.places(between @ found.position) - logged).mean())
    factor = cholesky(covariance + bend * np.eye(len(covariance)), lower=True)
    start = _upright(start, between @ found.position, logged, factor, found.quaternion_xyzw)
    precision = np.asarray(np.linalg.inv(covariance), np.float64)
    bundle = _Bundle(found, _shrunk_focal_px(found, intrinsics), between, logged, precision)
    fit = _adjusted(start, bundle)
    residual_m = float(np.sqrt(np.square(fit.apart).sum(axis=1).mean()))
    misfit = float(np.einsum("ik,ij,jk->", fit.apart, precision, fit.apart)) / fit.apart.size
    length_m = start.scale * found.size
    share = residual_m / length_m
    if fit.far_share > MAX_FAR_SHARE:
        raise NoAttitudesError(
            f"its map is wrong: with its places, {100 * fit.far_share:.0f} % of the points are"
            f" {FAR_PX:g} px or more from where pictures show them (blurred pictures, or much that moves)"
        )
    if misfit > MAX_MISFIT or (unstated and share > MAX_UNSTATED_SHARE):
        stated = "" if unstated else f" ({np.sqrt(misfit):.1f} times the errors of pose_noise)"
        raise NoAttitudesError(
            f"its map misses its places by {residual_m:.2g} m{stated}, {100 * share:.0f} % of its size: the"
            " map is wrong (blurred pictures, little texture, another clock), or state larger errors of the"
            " places in pose_noise"
        )
    # Each picture's error, and the mean over all pictures: what is left of the first is each picture's own.
    turns = fit.covariance.reshape(len(at_ns), 6, len(at_ns), 6)[:, 3:, :, 3:] * max(misfit, 1.0)
    common, each = turns.mean(axis=(0, 2)), np.einsum("kikj->ij", turns) / len(at_ns)
    largest_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(each)[-1])))
    if largest_deg > MAX_ATTITUDE_SIGMA_DEG:
        raise NoAttitudesError(
            f"its places do not say how its map of {length_m:.2g} m lies in the world (standard deviation"
            f" {largest_deg:.0f} deg, residual {residual_m:.2g} m): fly further, in curves, or state smaller"
            " errors of the places in pose_noise"
        )
    own = max(float(np.trace(each - common)) / 3, 0.0) ** 0.5
    return LaidMap(
        at_ns,
        fit.position,
        continuous_signs(fit.quaternion_xyzw),
        residual_m,
        fit.error_px,
        common_sigma_rad=float(np.sqrt(np.trace(common) / 3)),
        picture_sigma_rad=float(np.hypot(own, _bridge_sigma(at_ns, fit.quaternion_xyzw))),
    )


def _bridged(at_ns: Int64, t_ns: Int64) -> Bool:
    """Test which times [N] lie between mapped pictures that are near enough to interpolate between."""
    after = np.searchsorted(at_ns, t_ns).clip(1, len(at_ns) - 1)
    near: Bool = (at_ns[after] - at_ns[after - 1] <= MAX_BRIDGE_S * 1e9) | np.isin(t_ns, at_ns)
    return near


def first_similarity(mapped: Float, logged: Float) -> tuple[Similarity, Bool]:
    """Compute a similarity by least squares (Umeyama 1991) of the places that fit it, and which these are."""
    fits = np.ones(len(mapped), dtype=np.bool_)
    for _ in range(4):
        source, target = mapped[fits], logged[fits]
        left, right = source - source.mean(axis=0), target - target.mean(axis=0)
        if min(np.ptp(left, axis=0).max(), np.ptp(right, axis=0).max()) < 1e-9:
            raise NoAttitudesError("its places, or those of its map, are all the same")
        u, sizes, vt = np.linalg.svd(right.T @ left)
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        quaternion = quaternion_from_matrix(u * signs @ vt)
        scale = float((sizes * signs).sum() / np.square(left).sum())
        shift = target.mean(axis=0) - scale * rotate(quaternion, source.mean(axis=0))
        fit = Similarity(scale, quaternion, shift)
        apart = np.linalg.norm(fit.places(mapped) - logged, axis=1)
        fits = apart <= max(MAX_MEDIAN_DISTANCES * float(np.median(apart)), 1e-9)
    return fit, fits


def _upright(start: Similarity, mapped: Float, logged: Float, factor: Float, turned: Float) -> Similarity:
    """Turn a similarity about the path's main direction, which hardly determines it, to a level horizon."""
    from scipy.linalg import solve_triangular

    axis = np.linalg.svd(logged - logged.mean(axis=0))[2][0]
    middle = start.places(mapped.mean(axis=0))
    best, lowest = start, np.inf
    for angle in np.radians(np.arange(0, 360, TRIED_TURN_DEG)):
        turn = quaternion_from_rotation_vector(angle * axis)
        shift = rotate(turn, start.shift - middle) + middle
        tried = Similarity(start.scale, multiply(turn, start.quaternion_xyzw), shift)
        of_axes = [rotate(multiply(tried.quaternion_xyzw, turned), each)[:, 2] for each in np.eye(3)]
        if (of_axes[1] + LOOKING_DOWN_WEIGHT * of_axes[2]).mean() > 0:
            continue  # upside down
        apart = solve_triangular(factor, logged - tried.places(mapped), lower=True)
        level = np.square(of_axes[0]).mean() / np.radians(LEVEL_SIGMA_DEG) ** 2
        if (cost := float(np.square(apart).sum() + level)) < lowest:
            best, lowest = tried, cost
    return best


def position_covariance(errors: PoseErrors, seconds: Float) -> Float:
    """Compute the covariance [N, N] m^2 of a prior's position errors along one axis at some times [N]."""
    apart = np.abs(seconds[:, None] - seconds)
    covariance = max(errors.white[0], 1e-4) ** 2 * np.eye(len(seconds))
    for process in errors.processes:
        if process.number == ROTATION or process.constant:
            continue  # a constant error shifts the map, and turns nothing
        if np.isfinite(process.correlation_s):
            covariance += process.sigma0**2 * np.exp(-apart / process.correlation_s)
        else:
            earlier = np.minimum(seconds[:, None], seconds)
            covariance += process.sigma0**2 + process.rate**2 * earlier
    return covariance


@dataclass(frozen=True)
class _AdjustedMap:
    """Result of the bundle adjustment."""

    position: Float  # [K, 3] m
    quaternion_xyzw: Float  # [K, 4] world_from_camera
    covariance: Float  # [6 K, 6 K] of each picture's position (m) and turn about the world's axes (rad)
    apart: Float  # [N, 3] m: places of the log from the map
    error_px: float  # median
    far_share: float  # of the sightings


@dataclass(frozen=True)
class _Bundle:
    """Evidence on the poses of K pictures and on P points: sightings, logged places and a level horizon."""

    found: PictureMap
    focal_px: float  # of shrunk pictures
    between: Float  # [N, K] weights by which the pictures' places give those at the log's times
    logged: Float  # [N, 3] m, places of the log
    precision: Float  # [N, N] inverse of the covariance of their errors along each axis
    loss_px: float = LOSS_ROUNDS_PX[0]
    sigma_px: float = MIN_SIGHTING_PX

    def residuals(self, at: Float, turn: Float, points: Float) -> tuple[Float, Float]:
        """Return the residuals [N, 2] px of all sightings, and their points in the camera [N, 3]."""
        picture, point = self.found.seen_in, self.found.seen_point
        seen = np.einsum("nji,nj->ni", turn[picture], points[point] - at[picture])
        seen[:, 2] = np.maximum(seen[:, 2], MIN_DEPTH_M)
        return (self.found.seen_xy - seen[:, :2] / seen[:, 2:]) * self.focal_px, seen

    def cost(self, at: Float, turn: Float, points: Float) -> float:
        """Compute the sum of squares in standard deviations; of sightings by a bounded loss.

        What moves is far off wherever its point is put (Geman and McClure 1985). A loss that grows with it
        bent the map of a level flight over flat ground by 5 deg, to please the 3 % of its points on a person.
        """
        squares = np.square(self.residuals(at, turn, points)[0] / self.loss_px).sum(axis=1)
        apart = self.logged - self.between @ at
        whole = (squares / (1 + squares)).sum() * self.loss_px**2 / (SIGHTINGS_ALIKE * self.sigma_px**2)
        whole += np.einsum("ik,ij,jk->", apart, self.precision, apart)
        return float(whole + np.square(turn[:, 2, 0]).sum() / (np.radians(LEVEL_SIGMA_DEG) ** 2 * len(at)))

    def equations(self, at: Float, turn: Float, points: Float) -> tuple[Any, ...]:
        """Return the normal equations of poses [6 K, 6 K], [6 K], points [P, 3, 3], [P, 3], and both."""
        from scipy.sparse import bsr_matrix

        picture, point, count = self.found.seen_in, self.found.seen_point, len(at)
        off, seen = self.residuals(at, turn, points)
        weight = (
            1
            / np.square(1 + np.square(off / self.loss_px).sum(axis=1))
            / (SIGHTINGS_ALIKE * self.sigma_px**2)
        )
        project = np.zeros((len(off), 2, 3))
        project[:, 0, 0] = project[:, 1, 1] = self.focal_px / seen[:, 2]
        project[:, :, 2] = -self.focal_px * seen[:, :2] / np.square(seen[:, 2:])
        of_point = project @ np.swapaxes(turn[picture], 1, 2)
        of_turn = of_point @ cross_matrix(points[point] - at[picture])
        of_pose = np.concatenate([-of_point, of_turn], axis=2)
        weighed, weighed_point = (
            np.swapaxes(weight[:, None, None] * each, 1, 2) for each in (of_pose, of_point)
        )
        of_each, pull = np.zeros((count, 6, 6)), np.zeros((count, 6))
        np.add.at(of_each, picture, weighed @ of_pose)
        np.add.at(pull, picture, (weighed @ off[:, :, None])[:, :, 0])
        own, push = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        np.add.at(own, point, weighed_point @ of_point)
        np.add.at(push, point, (weighed_point @ off[:, :, None])[:, :, 0])
        order = np.lexsort((point, picture))
        begins = np.append(0, np.cumsum(np.bincount(picture, minlength=count)))
        shape = (6 * count, 3 * len(points))
        mixed = bsr_matrix(((weighed @ of_point)[order], point[order], begins), shape=shape)
        rows, along = np.arange(count), self.between.T @ self.precision
        poses = np.zeros((count, 6, count, 6))
        poses[rows, :, rows] = of_each
        for axis in range(3):
            poses[:, axis, :, axis] += along @ self.between
        pull[:, :3] += along @ (self.logged - self.between @ at)
        # The height of a picture's right-hand axis changes with turns about the world's x and y.
        tilt = np.stack([turn[:, 1, 0], -turn[:, 0, 0]], axis=1)
        level = 1 / (np.radians(LEVEL_SIGMA_DEG) ** 2 * count)
        poses[rows, 3:5, rows, 3:5] += level * tilt[:, :, None] * tilt[:, None]
        pull[:, 3:5] -= level * tilt * turn[:, 2, 0, None]
        return poses.reshape(6 * count, -1), pull.ravel(), own, push.ravel(), mixed


def _adjusted(start: Similarity, bundle: _Bundle) -> _AdjustedMap:
    """Adjust poses and points (Levenberg-Marquardt, points eliminated), with a bounded loss that narrows.

    NoAttitudesError: the adjustment does not converge, or its equations have no unique solution.
    """
    from scipy.linalg import cho_factor, cho_solve

    found = bundle.found
    count = len(found.key)
    at = start.places(found.position)
    turn = matrix_from_quaternion(multiply(start.quaternion_xyzw, found.quaternion_xyzw))
    points = _triangulated(found, at, turn)
    for loss_px in LOSS_ROUNDS_PX:
        error = np.linalg.norm(bundle.residuals(at, turn, points)[0], axis=1)
        bundle = replace(bundle, loss_px=loss_px, sigma_px=max(float(np.median(error)), MIN_SIGHTING_PX))
        damping, now = 1e-4, bundle.cost(at, turn, points)
        for _ in range(MAX_STEPS):
            poses, pull, own, push, mixed = bundle.equations(at, turn, points)
            while damping < 1:
                inverse = _inverse_blocks(own * (1 + damping * np.eye(3)))
                reduced = poses + damping * np.diag(np.diag(poses)) - (mixed @ inverse @ mixed.T).toarray()
                try:
                    step = np.linalg.solve(reduced, pull - mixed @ (inverse @ push))
                except np.linalg.LinAlgError:
                    damping *= 10
                    continue
                moved = inverse @ (push - mixed.T @ step)
                step = step.reshape(count, 6)
                turned = matrix_from_quaternion(quaternion_from_rotation_vector(step[:, 3:])) @ turn
                tried = at + step[:, :3], turned, points + moved.reshape(-1, 3)
                if (cost := bundle.cost(*tried)) < now:
                    break
                damping *= 10
            else:
                break
            fell = now - cost
            (at, turn, points), now, damping = tried, cost, max(damping / 10, 1e-9)
            least = CONVERGED_COST if loss_px == LOSS_ROUNDS_PX[-1] else SETTLED_SHARE * now
            if np.abs(step[:, 3:]).max() < CONVERGED_RAD or fell < least:
                break
        else:
            raise NoAttitudesError("no attitudes fit its map and its places: the adjustment did not converge")
    poses, _, own, _, mixed = bundle.equations(at, turn, points)
    information = poses - (mixed @ _inverse_blocks(own) @ mixed.T).toarray()
    try:
        covariance = cho_solve(cho_factor(information), np.eye(len(information)))
    except (np.linalg.LinAlgError, ValueError):
        raise NoAttitudesError("its sightings and its places determine no attitudes") from None
    error = np.linalg.norm(bundle.residuals(at, turn, points)[0], axis=1)
    apart = bundle.logged - bundle.between @ at
    far_share = float((error > FAR_PX).mean())
    return _AdjustedMap(
        at, quaternion_from_matrix(turn), covariance, apart, float(np.median(error)), far_share
    )


def _triangulated(found: PictureMap, at: Float, turn: Float) -> Float:
    """Return the points [P, 3] nearest to the rays that see them."""
    ray = np.einsum("nij,nj->ni", turn[found.seen_in], np.insert(found.seen_xy, 2, 1.0, axis=1))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    points = int(found.seen_point.max()) + 1
    normal, right = np.tile(MIN_SQUARED_ANGLE * np.eye(3), (points, 1, 1)), np.zeros((points, 3))
    middle = at.mean(axis=0)
    np.add.at(normal, found.seen_point, across)
    np.add.at(right, found.seen_point, np.einsum("nij,nj->ni", across, at[found.seen_in] - middle))
    return np.asarray(middle + np.linalg.solve(normal, right[:, :, None])[:, :, 0])


def _inverse_blocks(blocks: Float) -> Any:
    """Return the sparse block-diagonal matrix of the inverses of blocks [P, 3, 3]."""
    from scipy.sparse import bsr_matrix

    count = len(blocks)
    regular = blocks + MIN_POINT_PRECISION * np.eye(3)
    return bsr_matrix(
        (np.linalg.inv(regular), np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
    )


def _bridge_sigma(at_ns: Int64, quaternion_xyzw: Float) -> float:
    """Estimate the error of interpolated attitudes, rad per axis, by leaving out every other key picture."""
    if len(at_ns) < 5:
        return 0.0
    from scipy.spatial.transform import Rotation, RotationSpline

    seconds, turned = (at_ns - at_ns[0]) / 1e9, Rotation.from_quat(quaternion_xyzw)
    errors = []
    for first in (0, 1):
        known, asked = slice(first, None, 2), slice(first + 1, len(at_ns) - 1, 2)
        if len(seconds[known]) > 2:
            there = RotationSpline(seconds[known], turned[known])(seconds[asked])
            errors.append((turned[asked].inv() * there).as_rotvec())
    square = np.square(np.concatenate(errors)).mean()
    return SHARE_OF_DOUBLE_STEP * float(np.sqrt(square))


# --- joining maps ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PeopleSeen:
    """A camera's map, and the joints of people whom it sees at T times that all cameras share."""

    name: str
    found: PictureMap
    key_t_ns: Int64  # [K] of the mapped pictures
    xy: Float  # [T, P, J, 2] x/z and y/z of `JOINED`, NaN where not seen

    def rays(self, t_ns: Int64) -> tuple[Float, Float, Float]:
        """Return centres [T, 3] about their mean in the map's size, attitudes and unit rays [T, P, J, 3].

        Rays are NaN between mapped pictures that are too far apart to interpolate. A camera that follows
        people turns with them, so its attitude at a time serves people in the nearest picture better than
        the picture's own (rendered flights: errors of 0.5 to 1.5 deg instead of 1.1 to 2.3).
        """
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        first = self.key_t_ns[0]
        key_s, seconds = (self.key_t_ns - first) / 1e9, (t_ns - first) / 1e9
        about = (self.found.position - self.found.position.mean(axis=0)) / self.found.size
        turn = RotationSpline(key_s, Rotation.from_quat(self.found.quaternion_xyzw))(seconds).as_matrix()
        ray = np.insert(self.xy, 2, 1.0, axis=-1)
        ray = np.einsum("tij,tpkj->tpki", turn, ray / np.linalg.norm(ray, axis=-1, keepdims=True))
        ray[~_bridged(self.key_t_ns, t_ns)] = np.nan
        return CubicSpline(key_s, about)(seconds), turn, ray


@dataclass(frozen=True)
class JoinedMaps:
    """Maps of C cameras in one upright frame whose place and heading are arbitrary."""

    laid: list[LaidMap]
    position_sigma_m: Float  # [C] per axis, of each camera's constant error
    tilt_sigma_rad: float  # that all cameras share


@dataclass(frozen=True)
class _Placed:
    """Similarities of C maps into one frame."""

    turn: Float  # [C, 3, 3]
    at: Float  # [C, 3] m
    scale: Float  # [C] m

    def moved(self, step: Float) -> _Placed:
        """Move the last by steps [7 each]: turns (rad), shifts (ten metres) and logarithms of scales."""
        each = np.concatenate([np.zeros(7 * len(self.at) - len(step)), step]).reshape(-1, 7)
        turned = matrix_from_quaternion(quaternion_from_rotation_vector(each[:, :3]))
        return _Placed(turned @ self.turn, self.at + 10 * each[:, 3:6], self.scale * np.exp(each[:, 6]))

    def is_turned_from(self, other: _Placed) -> bool:
        """Test if the second of two cameras is turned otherwise beside the first, by `RIVAL_DEG` or more."""
        apart = self.turn[0].T @ self.turn[1] @ other.turn[1].T @ other.turn[0]
        return bool(np.trace(apart) < 1 + 2 * np.cos(np.radians(RIVAL_DEG)))

    def is_moved_from(self, other: _Placed) -> bool:
        """Test if the second of two cameras is elsewhere beside the first, by `RIVAL_M` or more."""
        beside, there = ((each.at[1] - each.at[0]) @ each.turn[0] / each.scale[0] for each in (self, other))
        return bool(self.scale[0] * np.linalg.norm(beside - there) > RIVAL_M)

    def misses(self, centre: Float, ray: Float, sigma_rad: Float) -> tuple[Float, Float, Bool]:
        """Return rays' misses [C, T, J, 3] of their points in standard deviations, points, and where any.

        Centres are [C, T, 3], rays [C, T, J, 3]. A joint that one camera alone sees tells nothing.
        """
        ray = np.einsum("cij,ctnj->ctni", self.turn, ray)
        centre = np.einsum("cij,ctj->cti", self.turn * self.scale[:, None, None], centre) + self.at[:, None]
        seen = np.isfinite(ray).all(axis=-1)
        seen = seen & (seen.sum(axis=0) > 1)
        ray = np.where(seen[..., None], ray, 0.0)
        across = (np.eye(3) - ray[..., :, None] * ray[..., None, :]) * seen[..., None, None]
        right = np.einsum("ctnij,ctj->tni", across, centre)
        point = np.linalg.solve(across.sum(axis=0) + MIN_SQUARED_ANGLE * np.eye(3), right[..., None])[..., 0]
        away = point - centre[:, :, None]
        away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), MIN_DEPTH_M)
        miss = np.where(seen[..., None], away - ray, 0.0) / sigma_rad[:, None, None, None]
        return np.asarray(miss), np.asarray(point), np.asarray(seen)


def _fitted(
    start: _Placed, centre: Float, ray: Float, sigma_rad: Float, steps: int, turn: Float | None = None
) -> tuple[_Placed, float, Float]:
    """Fit similarities to rays of middles by Cauchy's loss; return the cost, and the normal matrix, too.

    With attitudes `turn` [C, T, 3, 3] horizons are level and the person upright in the mean; without, the
    first camera is held.
    """
    from scipy.optimize import least_squares

    def residuals(step: Float) -> Float:
        placed = start.moved(step)
        miss, point, seen = placed.misses(centre, ray, sigma_rad)
        size = np.linalg.norm(miss, axis=-1, keepdims=True) / 3
        miss = miss * np.sqrt(np.log1p(np.square(size))) / np.maximum(size, 1e-9)
        if turn is None:
            return np.asarray(miss.ravel())
        alike = np.sqrt(INDEPENDENT_MOMENTS / centre.shape[1])
        level = np.einsum("ci,cti->c", placed.turn[:, 2], turn[..., 0]) / turn.shape[1]
        person = point.reshape(-1, len(MIDDLES), 3)
        some: Bool = (seen.sum(axis=0) > 1).reshape(-1, len(MIDDLES))
        axis, whole = person[:, SHOULDERS] - person[:, ANKLES], some[:, SHOULDERS] & some[:, ANKLES]
        axis = whole[:, None] * axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
        lean = (axis.sum(axis=0) / max(whole.sum(), 1) - [0, 0, 1]) / np.radians(UPRIGHT_SIGMA_DEG)
        return np.concatenate([alike * miss.ravel(), level / np.radians(LEVEL_SIGMA_DEG), lean])

    done = least_squares(residuals, np.zeros(7 * (len(centre) - (turn is None))), max_nfev=steps)
    slope = np.asarray(done.jac)
    return start.moved(done.x), float(done.cost), slope.T @ slope


def _paired(centre: Float, turn: Float, ray: Float, stature_m: float) -> tuple[_Placed, Float] | None:
    """Place two cameras by one person, rays [2, T, 8, 3], from several headings; and the sigmas."""
    from scipy.spatial.transform import Rotation

    both = np.isfinite(ray[..., 0]).all(axis=0)
    if both.sum() < MIN_COMMON_JOINTS:
        return None
    down = np.radians(FIRST_DOWN_DEG)
    ahead = np.array([0.0, np.cos(down), -np.sin(down)])
    looking = np.stack([[1.0, 0.0, 0.0], np.cross(ahead, [1.0, 0.0, 0.0]), ahead], axis=1)
    upright = looking @ np.stack([Rotation.from_matrix(each).mean().as_matrix().T for each in turn])
    seen = np.einsum("cij,ctkj->ctki", upright, ray)
    away = away_by_size(seen[:, :, ANKLES], seen[:, :, 0], stature_m)
    rows = np.isfinite(away).all(axis=(0, 2))
    if rows.sum() < MIN_MOMENTS:
        return None
    away, sigma = away[:, rows], JOINT_SIGMA_M / np.median(np.linalg.norm(away[:, rows], axis=2), axis=1)
    (useful,) = np.nonzero(both.sum(axis=1) >= MIN_MOMENTS)
    few, some = (useful[:: max(1, len(useful) // count)] for count in PAIRED_MOMENTS)
    tried = []
    for angle in np.arange(FIRST_HEADINGS) * 2 * np.pi / FIRST_HEADINGS:
        headed = matrix_from_quaternion(quaternion_from_rotation_vector(np.array([0.0, 0.0, angle])))
        turned, there = np.stack([upright[0], headed @ upright[1]]), np.stack([away[0], away[1] @ headed.T])
        path = np.einsum("cij,ctj->cti", turned, centre[:, rows])
        # Scales and shift that bring the person's places together, by least squares.
        shift = np.broadcast_to(np.eye(3), (rows.sum(), 3, 3))
        lines = np.concatenate([path[0][..., None], -path[1][..., None], -shift], axis=-1).reshape(-1, 5)
        scale = np.linalg.lstsq(lines, (there[1] - there[0]).ravel(), rcond=None)[0][:2].clip(*SCALES_M)
        at = np.median(scale[0] * path[0] + there[0] - scale[1] * path[1] - there[1], axis=0)
        start = _Placed(turned, np.stack([np.zeros(3), at]), scale)
        tried.append(_fitted(start, centre[:, few], ray[:, few], sigma, 10)[:2])
    tried.sort(key=lambda each: each[1])
    placed, cost, _ = _fitted(tried[0][0], centre[:, some], ray[:, some], sigma, 30)
    others = (other for other, _ in tried if placed.is_turned_from(other))
    if (rival := next(others, None)) is not None:
        rival, higher, _ = _fitted(rival, centre[:, some], ray[:, some], sigma, 30)
        if higher < MAX_RIVAL_COST * cost and placed.is_turned_from(rival):
            return None
    return placed, sigma


def _best_pair(
    centre: Float, turn: Float, rays: Sequence[Float], stature_m: float
) -> tuple[float, _Placed, Float, dict[int, int]] | None:
    """Place two cameras by the person, of tracks [T, P, 8, 3] each, with whom most joints agree.

    Return that number, the similarities, sigmas, and tracks of the same people. None for nobody, and where
    another person would do as well and place the cameras otherwise.
    """
    from scipy.optimize import linear_sum_assignment

    tried: list[tuple[float, _Placed, Float, dict[int, int]]] = []
    tracks = list(product(*(range(each.shape[1]) for each in rays)))
    views = {each: np.stack([rays[c][:, track] for c, track in enumerate(each)]) for each in tracks}
    for each in tracks:
        if (found := _paired(centre, turn, views[each], stature_m)) is None:
            continue
        gains, common = np.zeros((2, *(own.shape[1] for own in rays)))
        for other, ray in views.items():
            miss, _, seen = found[0].misses(centre, ray, found[1])
            near = np.clip(1 - np.square(miss).sum(axis=-1).max(axis=0) / 9, 0, None)
            common[other], gains[other] = seen[0].sum(), near[seen[0]].sum()
        matched = zip(*linear_sum_assignment(-gains), strict=True)
        same = {int(p): int(q) for p, q in matched if gains[p, q] > MIN_JOINED_SHARE * common[p, q] / 2}
        tried.append((float(sum(gains[p, q] for p, q in same.items())), *found, same))
    if not tried:
        return None
    best = max(tried, key=lambda each: each[0])
    rivals = [placed for gain, placed, *_ in tried if gain > MAX_RIVAL_SHARE * best[0]]
    rivaled = any(best[1].is_turned_from(other) or best[1].is_moved_from(other) for other in rivals)
    return None if rivaled else best


def join_maps(cameras: Sequence[PeopleSeen], t_ns: Int64, stature_m: float) -> JoinedMaps:
    """Join maps by the people whom their cameras see at times [T]; NoAttitudesError: they do not.

    Two cameras are placed by a person of the one and a person of the other, from several headings and the
    person's distances by size. The camera whose joints agree best with the others' holds all together. All
    similarities are then refined together, and limbs give the scale.
    """
    seen = [camera.rays(t_ns) for camera in cameras]
    centre, turn = (np.stack([each[k] for each in seen]) for k in (0, 1))
    sides = [[k for k, name in enumerate(JOINED) if name.endswith(part)] for part in MIDDLES]
    middles = [np.stack([ray[..., own, :].mean(axis=-2) for own in sides], axis=-2) for _, _, ray, *_ in seen]
    middles = [middle / np.linalg.norm(middle, axis=-1, keepdims=True) for middle in middles]
    count = len(cameras)
    pairs: dict[int, dict[int, tuple[Any, ...]]] = {c: {} for c in range(count)}
    for a, b in combinations(range(count), 2):
        found = _best_pair(centre[[a, b]], turn[[a, b]], [middles[a], middles[b]], stature_m)
        if found is not None:
            gain, pair, its, same = found
            pairs[a][b] = gain, pair, its, [0, 1], same
            pairs[b][a] = gain, pair, its, [1, 0], {q: p for p, q in same.items()}
    hub = max(pairs, key=lambda c: (len(pairs[c]), sum(pair[0] for pair in pairs[c].values())))
    if lone := [camera.name for c, camera in enumerate(cameras) if c != hub and c not in pairs[hub]]:
        raise NoAttitudesError(
            f"{', '.join(lone)} and {cameras[hub].name} see nobody at equal times, nobody who walks about, or"
            " people of whom any places them as well as another"
        )
    sigma, people = np.full(count, np.nan), range(middles[hub].shape[1])
    chosen = [{p: p for p in people} if c == hub else pairs[hub][c][4] for c in range(count)]
    start = _Placed(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.ones(count))
    for c, (_, pair, its, (near, far), _) in pairs[hub].items():
        # Similarities of the pair, in the frame of the hub's map.
        start.turn[c] = pair.turn[near].T @ pair.turn[far]
        start.at[c] = (pair.at[far] - pair.at[near]) @ pair.turn[near] / pair.scale[near]
        start.scale[c] = pair.scale[far] / pair.scale[near]
        sigma[[hub, c]], first = its[[near, far]], (pair.turn[near], pair.scale[near])
    start = _Placed(first[0] @ start.turn, first[1] * start.at @ first[0].T, first[1] * start.scale)

    def of_people(rays: Sequence[Float]) -> Float:
        """Put the people of all cameras, [T, P, J, 3] each, in the hub's order, [C, T, P J, 3]."""
        nobody = np.full_like(rays[0][:, 0], np.nan)
        ordered = [
            np.concatenate([own[:, same[p]] if p in same else nobody for p in people], axis=1)
            for own, same in zip(rays, chosen, strict=True)
        ]
        return np.stack(ordered)

    ray = of_people(middles)
    placed, _, normal = _fitted(start, centre, ray, sigma, 60, turn)
    miss, point, known = placed.misses(centre, ray, sigma)
    near = known & (np.square(miss).sum(axis=-1) < 9)
    for camera, mine, all_of in zip(cameras, near, known, strict=True):
        if all_of.sum() < MIN_COMMON_JOINTS or mine.sum() < MIN_JOINED_SHARE * all_of.sum():
            raise NoAttitudesError(
                f"{mine.sum()} of the {all_of.sum()} joints that {camera.name} and others see at equal times"
                " are at one place: clocks are off, or they film different people"
            )
    middle = np.median(point[near.any(axis=0)], axis=0)
    miss, point, known = placed.misses(centre, of_people([each[2] for each in seen]), sigma)
    point = np.where((known & (np.square(miss).sum(axis=-1) < 9)).sum(axis=0)[..., None] > 1, point, np.nan)
    return _laid_together(cameras, placed, normal, middle, _larger_by_limbs(point, stature_m))


def _larger_by_limbs(point: Float, stature_m: float) -> float:
    """Return by how much joints [T, P J, 3] must grow until limbs are those of people of a stature."""
    known = landmarks_of(["left_mouth", *JOINED])
    if known is None:
        raise AssertionError("the joints are landmarks")
    body = dict(zip(known[0].joints, stature_m * known[0].at_rest, strict=True))
    # Shanks, thighs and the sides of the trunk bend least with pose and detector.
    ends = [
        [JOINED.index(f"{side}_{part}") for part in limb]
        for limb in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "hip"))
        for side in ("left", "right")
    ]
    wanted = np.array([np.linalg.norm(np.subtract(*(body[JOINED[k]] for k in pair))) for pair in ends])
    point = point.reshape(-1, len(JOINED), 3)
    lengths = np.linalg.norm(point[:, ends][:, :, 1] - point[:, ends][:, :, 0], axis=-1)
    measured = np.isfinite(lengths).any(axis=0)
    if not measured.any():
        raise NoAttitudesError("nobody's legs and trunk are seen, which give the scale")
    return float(wanted[measured].sum() / np.nanmedian(lengths[:, measured], axis=0).sum())


def _laid_together(
    cameras: Sequence[PeopleSeen], placed: _Placed, normal: Float, middle: Float, larger: float
) -> JoinedMaps:
    """Return the maps in a frame with people at its origin; errors without what all cameras share."""
    count, laid = len(cameras), []
    # Turns, shifts and growth of everything: no picture shows them, and no camera's error holds them.
    arms = placed.at - placed.at.mean(axis=0)
    common = np.zeros((count, 7, 7))
    common[:, :3, :3] = common[:, 3:6, 3:6] = np.eye(3)
    common[:, 3:6, :3], common[:, 3:6, 6], common[:, 6, 6] = -cross_matrix(arms) / 10, arms / 10, 1.0
    free = common.reshape(-1, 7)
    covariance = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    tilt = covariance.reshape(count, 7, count, 7)[:, :2, :, :2].mean(axis=(0, 2))
    own = np.eye(7 * count) - free @ np.linalg.pinv(free)
    variance = np.diagonal(own @ covariance @ own.T).reshape(count, 7)
    sigmas = np.sqrt(variance[:, :3].mean(axis=1)).tolist()
    for camera, turn, at, scale, sigma in zip(
        cameras, placed.turn, placed.at, placed.scale, sigmas, strict=True
    ):
        found = camera.found
        path = scale * (found.position - found.position.mean(axis=0)) / found.size @ turn.T + at - middle
        turned = continuous_signs(multiply(quaternion_from_matrix(turn), found.quaternion_xyzw))
        bridged = _bridge_sigma(camera.key_t_ns, turned)
        laid.append(LaidMap(camera.key_t_ns, larger * path, turned, np.nan, np.nan, sigma, bridged))
        if np.degrees(sigma) > MAX_ATTITUDE_SIGMA_DEG:
            raise NoAttitudesError(
                f"people do not say how {camera.name} lies beside the others (standard deviation"
                f" {np.degrees(sigma):.0f} deg): let it see them for longer, while they walk about"
            )
    position_m = larger * 10 * np.sqrt(variance[:, 3:6].mean(axis=1))
    return JoinedMaps(laid, position_m, float(np.sqrt(np.trace(tilt) / 2)))


# --- poses of all pictures -------------------------------------------------------------------------------


def poses_of_pictures(laid: LaidMap, t_ns: Int64, places: Float, at_ns: Int64) -> tuple[Float, Float]:
    """Return places [T, 3] (as logged, and as mapped in between) and attitudes [T, 4] of pictures; or NaN."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    key_s, asked_s, logged_s = ((each - laid.t_ns[0]) / 1e9 for each in (laid.t_ns, at_ns, t_ns))
    path = CubicSpline(key_s, laid.position)
    beside = places - path(np.clip(logged_s, 0, key_s[-1]))
    near = (logged_s >= 0) & (logged_s <= key_s[-1])
    gap_ns = round(MAX_PLACE_GAP_S * 1e9)
    # Before the first place and after the last, the map goes on for half of such a gap.
    held_ns = np.clip(at_ns, *t_ns[near][[0, -1]])
    shift = interpolate_points(t_ns[near], beside[near], held_ns, max_gap_ns=gap_ns)
    inside = np.clip(asked_s, 0, key_s[-1])
    position = path(inside) + shift
    quaternion = RotationSpline(key_s, Rotation.from_quat(laid.quaternion_xyzw))(inside).as_quat()
    known = (asked_s >= 0) & (asked_s <= key_s[-1]) & _bridged(laid.t_ns, at_ns)
    known &= np.isfinite(position).all(axis=1) & (2 * np.abs(at_ns - held_ns) <= gap_ns)
    return np.where(known[:, None], position, np.nan), np.where(known[:, None], quaternion, np.nan)
