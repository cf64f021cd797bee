"""Attitudes of one camera from its pictures: a map of key pictures, laid on the places that a log has.

Key pictures are chosen by time. pycolmap maps them: SIFT features, matches of pictures at several
distances in time, incremental mapping (Schönberger and Frahm 2016). The map depends on the pictures and the
lens alone, so it is kept while places, clocks and noise change. A similarity lays it on the logged places by
generalised least squares: position errors of a log are correlated in time, and a level horizon binds the roll
about a straight path. Its covariance is that of the attitudes' common error.

Each camera is mapped by itself: views of two drones that are 90 degrees apart share too little, and a joint
map of the sample flight was wrong by 6 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Float32, Index, Int64, Intrinsics, Picture
from pipelines.geometry.cameras import undistort
from pipelines.geometry.noise import ROTATION, PoseErrors, Process
from pipelines.geometry.poses import (
    continuous_signs,
    interpolate_points,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
)

# Another number of features, pairs or key pictures gives other maps: kept maps of an older one are not used.
REVISION = 1

# --- which pictures, and what is matched -----------------------------------------------------------------

# Sixty key pictures in twelve seconds gave 0.1 deg on the sample; with fifteen the map fell apart.
KEY_PICTURES_OF_SHORT_FILM = 60
# Closer pictures have no parallax, and cost as much.
MIN_KEY_STEP_S = 0.2
# Two pictures a second keep a minute of film below 60 s of processor time, and overlap while a gimbal pans.
MAX_KEY_STEP_S = 0.5
# Features of smaller pictures are as accurate in the map as those of whole ones, at a quarter of the time.
LONGER_SIDE_PX = 800
# More features cost more matching (quadratic) and bind a picture no better.
MAX_FEATURES = 1000
# Key pictures are matched with those this many steps later; the far ones have the parallax.
PAIR_STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
# Of so few key pictures all pairs are matched: a survey's legs overlap, and it takes seconds.
MAX_PICTURES_FOR_ALL_PAIRS = 30
# Lowe (2004): nearest neighbours at more than 0.8 of the second distance are mostly wrong.
MAX_RATIO = 0.8
# Descriptors of one point seen twice are closer (COLMAP's default).
MAX_DESCRIPTOR_ANGLE_RAD = 0.7
# Fewer matches of two pictures are chance (COLMAP's default).
MIN_MATCHES = 15
# A map starts from two pictures whose rays meet at this angle: below, depth is noise. COLMAP's 16 deg asks
# for more than a drone that looks ahead flies in some seconds.
MIN_START_ANGLE_DEG = 4.0
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
# 9) the map is wrong. Rendered flights with blurred pictures gave such maps, with attitudes off by 10 to 80
# deg.
MAX_MISFIT = 9.0
# Above this mean square the map is bent, slowly: over a quarter of the film. Far fewer numbers then speak of
# the rotation; taken for white, such residuals gave attitudes off by three to four standard deviations.
BENT_MISFIT = 2.0
# Where nobody states the places' errors, a map that misses them by more of its size is taken for a wrong one.
MAX_UNSTATED_SHARE = 0.03
# Gimbals hold their horizon to this, and so does the mean of a camera on a drone that banks both ways.
LEVEL_SIGMA_DEG = 2.0
# The least squares converge from half of this.
TRIED_TURN_DEG = 15.0
# Cameras that look between 73 deg up and 17 deg beyond straight down are upright: atan(1 / 0.3) is 73 deg.
LOOKING_DOWN_WEIGHT = 0.3
# Attitudes in a map wander by this between neighbours (sample and rendered flights, 60 key pictures).
MAP_SIGMA_DEG = 0.05
# A map bends: with exact places the common error is this (0.13 and 0.15 deg on the sample's two films).
BENT_MAP_SIGMA_DEG = 0.12
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


class NoAttitudesError(ValueError):
    """Pictures do not determine the attitudes, with the reason."""


@dataclass(frozen=True)
class KeyFeatures:
    """Features of a key picture."""

    xy: Float  # [F, 2] x/z and y/z, without distortion
    descriptors: Picture  # [F, 128]


@dataclass(frozen=True)
class PictureMap:
    """Poses of K mapped key pictures in a frame of their own, of any scale and rotation."""

    key: Int64  # [K] index of each among the key pictures, increasing
    position: Float  # [K, 3]
    quaternion_xyzw: Float  # [K, 4] map_from_camera
    points: int
    error_px: float  # mean reprojection error, in pixels of the whole picture
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
    residual_m: float  # root mean square distance of the log's places from the map
    common_sigma_rad: float  # per axis, of the error that all attitudes share
    picture_sigma_rad: float  # per axis, of the error of each picture, interpolated ones included


def key_rows(t_ns: Int64) -> Index:
    """Choose the rows of the key pictures among those of a film, by their times [T]."""
    span_s = float(t_ns[-1] - t_ns[0]) / 1e9
    step_s = np.clip(span_s / KEY_PICTURES_OF_SHORT_FILM, MIN_KEY_STEP_S, MAX_KEY_STEP_S)
    wanted = np.linspace(t_ns[0], t_ns[-1], max(round(span_s / step_s), 1) + 1)
    return np.unique(np.searchsorted(t_ns, wanted).clip(max=len(t_ns) - 1))


def features_of(picture: Picture, intrinsics: Intrinsics) -> KeyFeatures:
    """Find SIFT features in a picture, [H, W, 3] BGR or grey."""
    import cv2

    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    share = min(LONGER_SIDE_PX / max(height, width), 1.0)
    if share < 1:
        grey = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, contrastThreshold=0.02)
    points, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return KeyFeatures(np.empty((0, 2)), np.empty((0, 128), np.uint8))
    pixels = (np.array([point.pt for point in points], np.float64) + 0.5) / share - 0.5
    xy = undistort(pixels, intrinsics)
    known = np.isfinite(xy).all(axis=1)
    return KeyFeatures(xy[known], np.asarray(descriptors[known], np.uint8))


def map_pictures(
    features: Sequence[KeyFeatures], intrinsics: Intrinsics, *, refine_focal: bool = False
) -> PictureMap:
    """Map key pictures by their features.

    Args:
        features: [P] of all key pictures.
        intrinsics: the lens.
        refine_focal: its focal length is a guess; it is refined if the pictures determine it, else held.

    Raises:
        NoAttitudesError: too few pictures are in one map.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    focal_px = (intrinsics.fx * intrinsics.fy) ** 0.5
    with TemporaryDirectory() as folder:
        place = Path(folder)
        matched = _write_features(place / "features.db", features, intrinsics, focal_px)
        if matched < MIN_MAPPED_PICTURES:
            raise NoAttitudesError(
                f"only {matched} pairs of its {len(features)} key pictures have {MIN_MATCHES} matches:"
                " they are dark, blurred or without texture"
            )
        verifying = pycolmap.TwoViewGeometryOptions(detect_watermark=False)
        verifying.ransac.random_seed = SEED
        one = pycolmap.GeometricVerifierOptions(num_threads=1)
        pycolmap.geometric_verification(
            place / "features.db", verifier_options=one, two_view_geometry_options=verifying
        )
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=SEED, extract_colors=False)
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = refine_focal
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
        options.mapper.init_min_tri_angle = MIN_START_ANGLE_DEG
        options.max_num_models, options.min_model_size = 3, MIN_MAPPED_PICTURES
        (place / "maps").mkdir()
        found = pycolmap.incremental_mapping(place / "features.db", place, place / "maps", options=options)
    model = max(found.values(), key=lambda each: each.num_reg_images(), default=None)
    mapped = 0 if model is None else model.num_reg_images()
    if model is None or mapped < max(MIN_MAPPED_PICTURES, MIN_MAPPED_SHARE * len(features)):
        raise NoAttitudesError(
            f"{mapped} of its {len(features)} key pictures are in one map: a camera that stands or only turns"
            " has no parallax, and one that turns fast has pictures that share nothing"
        )
    if refine_focal and not _determines_focal(model):
        return map_pictures(features, intrinsics)
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda i: i.name)
    poses = [image.cam_from_world().inverse() for image in images]
    refined = next(iter(model.cameras.values())).params[0]
    return PictureMap(
        key=np.array([int(image.name) for image in images], np.int64),
        position=np.array([pose.translation for pose in poses]),
        quaternion_xyzw=continuous_signs(np.array([pose.rotation.quat for pose in poses])),
        points=model.num_points3D(),
        error_px=float(model.compute_mean_reprojection_error()),
        focal_ratio=float(refined / focal_px),
    )


def _determines_focal(model: Any) -> bool:
    """Test if a bundle adjustment that starts with another focal length comes back to the map's.

    Straight down over flat ground it does not: there focal length and height are one unknown.
    """
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


def _write_features(
    path: Path, features: Sequence[KeyFeatures], intrinsics: Intrinsics, focal_px: float
) -> int:
    """Write features and matches as a database of pycolmap; return the number of pairs that match."""
    import pycolmap

    width, height = intrinsics.width, intrinsics.height
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=width, height=height, params=[focal_px, width / 2, height / 2]
    )
    camera.has_prior_focal_length = True
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    rig_id = database.write_rig(rig)
    ids = []
    for number, found in enumerate(features):
        image = pycolmap.Image(name=f"{number:06d}", camera_id=camera.camera_id)
        image.image_id = database.write_image(image)
        frame = pycolmap.Frame()
        frame.rig_id = rig_id
        frame.add_data_id(image.data_id)
        frame.frame_id = image.image_id
        database.write_frame(frame)
        pixels = found.xy * focal_px + [width / 2, height / 2]
        database.write_keypoints(image.image_id, pixels.astype(np.float32))
        ids.append(image.image_id)
    units = [_unit(found.descriptors) for found in features]
    matched, count = 0, len(features)
    steps = PAIR_STEPS if count > MAX_PICTURES_FOR_ALL_PAIRS else range(1, count)
    for first in range(count):
        for second in (first + step for step in steps if first + step < count):
            matches = match_features(units[first], units[second])
            if len(matches) >= MIN_MATCHES:
                database.write_matches(ids[first], ids[second], matches)
                matched += 1
    database.close()
    return matched


def _unit(descriptors: Picture) -> Float32:
    """Return the square roots of descriptors of sum 1 (RootSIFT, Arandjelović and Zisserman 2012)."""
    sums = descriptors.sum(axis=1, keepdims=True, dtype=np.float32)
    root: Float32 = np.sqrt(descriptors / np.maximum(sums, 1), dtype=np.float32)
    return root


def match_features(ones: Float32, others: Float32) -> Index:
    """Match unit descriptors [F, 128] and [G, 128]: nearest both ways, and clearly nearer than the second.

    Returns rows [M, 2] of uint32.
    """
    if len(ones) < 2 or len(others) < 2:
        return np.empty((0, 2), np.uint32)
    alike = ones @ others.T
    rows = np.arange(len(ones))
    best = alike.argmax(axis=1)
    back = alike.argmax(axis=0)
    nearest = alike[rows, best].copy()
    alike[rows, best] = -1
    angle, second = (np.arccos(np.clip(each, -1, 1)) for each in (nearest, alike.max(axis=1)))
    kept = (back[best] == rows) & (angle < MAX_RATIO * second) & (angle < MAX_DESCRIPTOR_ANGLE_RAD)
    return np.stack([rows[kept], best[kept]], axis=1).astype(np.uint32)


# --- laying a map on places ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Similarity:
    """World from map: scale, rotation and shift."""

    scale: float
    quaternion_xyzw: Float  # [4]
    shift: Float  # [3] m

    def places(self, position: Float) -> Float:
        return self.scale * rotate(self.quaternion_xyzw, position) + self.shift


def lay_on_places(
    found: PictureMap, key_t_ns: Int64, t_ns: Int64, places: Float, errors: PoseErrors | None
) -> LaidMap:
    """Lay a map on the logged places of its camera.

    Args:
        found: the map.
        key_t_ns: [P] times of all key pictures.
        t_ns: [N] times of the places.
        places: [N, 3] m in the world, z up.
        errors: the prior of the places' errors; None to take the residuals of the fit for them.

    Raises:
        NoAttitudesError: the places do not determine the attitudes, or do not fit the map.
    """
    from scipy.interpolate import CubicSpline
    from scipy.linalg import cholesky

    at_ns = key_t_ns[found.key]
    inside = np.flatnonzero((t_ns >= at_ns[0]) & (t_ns <= at_ns[-1]) & _bridged(at_ns, t_ns))
    chosen = np.unique(np.linspace(0, len(inside) - 1, min(len(inside), MAX_PLACES)).round().astype(int))
    rows = inside[chosen] if len(inside) else inside
    if len(rows) < 4:
        raise NoAttitudesError(f"its log has {len(rows)} places while its pictures are mapped")
    seconds = (t_ns[rows] - at_ns[0]) / 1e9
    mapped = CubicSpline((at_ns - at_ns[0]) / 1e9, found.position)(seconds)
    logged = places[rows]
    start, fits = _first_similarity(mapped, logged)
    mapped, logged, seconds = mapped[fits], logged[fits], seconds[fits]
    unstated = errors is None
    if errors is None:
        level = max(float(np.sqrt(np.square(start.places(mapped) - logged).mean())), 1e-3)
        errors = PoseErrors((level, 0.0), ())
    factor = cholesky(position_covariance(errors, seconds), lower=True)
    start = _upright(start, mapped, logged, factor, found.quaternion_xyzw)
    fit, spread, misfit = _fitted(start, mapped, logged, factor, found.quaternion_xyzw)
    if BENT_MISFIT < misfit <= MAX_MISFIT:  # what the places do not explain is a bend of the map, and slow
        bend = PoseErrors((0.0, 0.0), (Process(0, 1.0, correlation_s=float(np.ptp(seconds)) / 4),))
        apart = fit.places(mapped) - logged
        covariance = position_covariance(errors, seconds)
        excess = max(float(np.square(apart).mean() - np.diagonal(covariance).mean()), 0.0)
        factor = cholesky(covariance + excess * position_covariance(bend, seconds), lower=True)
        fit, spread, _ = _fitted(fit, mapped, logged, factor, found.quaternion_xyzw)
    residual_m = float(np.sqrt(np.square(fit.places(mapped) - logged).sum(axis=1).mean()))
    largest_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(spread)[-1])))
    share = residual_m / (fit.scale * found.size)
    if misfit > MAX_MISFIT or (unstated and share > MAX_UNSTATED_SHARE):
        stated = "" if unstated else f" ({np.sqrt(misfit):.1f} times the errors of pose_noise)"
        raise NoAttitudesError(
            f"its map misses its places by {residual_m:.2g} m{stated}, {100 * share:.0f} % of its size: the"
            " map is wrong (blurred pictures, little texture, another clock), or state larger errors of the"
            " places in pose_noise"
        )
    if largest_deg > MAX_ATTITUDE_SIGMA_DEG:
        length_m = fit.scale * found.size
        raise NoAttitudesError(
            f"its places do not say how its map of {length_m:.2g} m lies in the world (standard deviation"
            f" {largest_deg:.0f} deg, residual {residual_m:.2g} m): fly further, in curves, or state smaller"
            " errors of the places in pose_noise"
        )
    turned = multiply(fit.quaternion_xyzw, found.quaternion_xyzw)
    return LaidMap(
        at_ns,
        fit.places(found.position),
        continuous_signs(turned),
        residual_m,
        common_sigma_rad=float(np.hypot(np.sqrt(np.trace(spread) / 3), np.radians(BENT_MAP_SIGMA_DEG))),
        picture_sigma_rad=float(np.hypot(np.radians(MAP_SIGMA_DEG), _bridge_sigma(at_ns, turned))),
    )


def _bridged(at_ns: Int64, t_ns: Int64) -> Bool:
    """Test which times [N] lie between mapped pictures that are near enough to interpolate between."""
    after = np.searchsorted(at_ns, t_ns).clip(1, len(at_ns) - 1)
    near: Bool = (at_ns[after] - at_ns[after - 1] <= MAX_BRIDGE_S * 1e9) | np.isin(t_ns, at_ns)
    return near


def _first_similarity(mapped: Float, logged: Float) -> tuple[_Similarity, Bool]:
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
        fit = _Similarity(scale, quaternion, shift)
        apart = np.linalg.norm(fit.places(mapped) - logged, axis=1)
        fits = apart <= max(MAX_MEDIAN_DISTANCES * float(np.median(apart)), 1e-9)
    return fit, fits


def _upright(start: _Similarity, mapped: Float, logged: Float, factor: Float, turned: Float) -> _Similarity:
    """Turn a similarity about the main direction of the path to where the horizon is level.

    A straight path leaves this turn open, and a nearly straight one leaves it to noise. Cameras are taken to
    stand upright, or to look down.
    """
    from scipy.linalg import solve_triangular

    axis = np.linalg.svd(logged - logged.mean(axis=0))[2][0]
    middle = start.places(mapped.mean(axis=0))
    best, lowest = start, np.inf
    for angle in np.radians(np.arange(0, 360, TRIED_TURN_DEG)):
        turn = quaternion_from_rotation_vector(angle * axis)
        shift = rotate(turn, start.shift - middle) + middle
        tried = _Similarity(start.scale, multiply(turn, start.quaternion_xyzw), shift)
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


def _fitted(
    start: _Similarity, mapped: Float, logged: Float, factor: Float, quaternion_xyzw: Float
) -> tuple[_Similarity, Float, float]:
    """Refine a similarity by generalised least squares with a level horizon.

    `factor` is the lower Cholesky factor of the places' covariance along each axis [N, N].

    Returns the similarity, the covariance [3, 3] of its rotation about the world's axes, rad^2, and the mean
    square of the residuals in standard deviations, with which the covariance grows.
    """
    from scipy.linalg import solve_triangular

    across = rotate(quaternion_xyzw, np.array([1.0, 0.0, 0.0]))  # right in each picture, level without roll
    level_sigma = np.radians(LEVEL_SIGMA_DEG) * np.sqrt(len(across))
    fit = start
    for _ in range(20):
        turned = fit.scale * rotate(fit.quaternion_xyzw, mapped)
        apart = logged - (turned + fit.shift)
        columns = np.zeros((len(mapped), 3, 7))
        columns[:, :, :3] = np.eye(3)
        columns[:, :, 3] = turned
        columns[:, :, 4:] = -_cross(turned)
        whole = np.concatenate([columns, apart[:, :, None]], axis=2)
        white = solve_triangular(factor, whole.reshape(len(mapped), -1), lower=True).reshape(-1, 8)
        right = rotate(fit.quaternion_xyzw, across)
        level = np.zeros((len(right), 8))
        level[:, 4], level[:, 5] = right[:, 1], -right[:, 0]  # of the height of (turn x right)
        level[:, 7] = -right[:, 2]
        rows = np.concatenate([white, level / level_sigma])
        information = rows[:, :7].T @ rows[:, :7]
        step = np.linalg.solve(information, rows[:, :7].T @ rows[:, 7])
        turn = quaternion_from_rotation_vector(step[4:])
        fit = _Similarity(
            fit.scale * float(np.exp(np.clip(step[3], -0.5, 0.5))),
            multiply(turn, fit.quaternion_xyzw),
            fit.shift + step[:3],
        )
        if np.abs(step[3:]).max() < 1e-9:
            break
    misfit = float(np.square(white[:, 7]).sum()) / max(len(white) - 7, 1)
    spread = np.linalg.inv(information)[4:, 4:] * max(misfit, 1.0)
    return fit, spread, misfit


def _cross(vectors: Float) -> Float:
    """Return the matrices [N, 3, 3] of cross products with vectors [N, 3]."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)


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


# --- poses of all pictures -------------------------------------------------------------------------------


def poses_of_pictures(laid: LaidMap, t_ns: Int64, places: Float, at_ns: Int64) -> tuple[Float, Float]:
    """Return the camera's places [T, 3] and attitudes [T, 4] at the times of its pictures; NaN without.

    Attitudes are a spline through those of key pictures. Places are the log's; between its rows they move as
    the map does.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    key_s, asked_s, logged_s = ((each - laid.t_ns[0]) / 1e9 for each in (laid.t_ns, at_ns, t_ns))
    path = CubicSpline(key_s, laid.position)
    beside = places - path(np.clip(logged_s, 0, key_s[-1]))
    near = (logged_s >= 0) & (logged_s <= key_s[-1])
    gap_ns = round(MAX_PLACE_GAP_S * 1e9)
    shift = interpolate_points(t_ns[near], beside[near], at_ns, max_gap_ns=gap_ns)
    inside = np.clip(asked_s, 0, key_s[-1])
    position = path(inside) + shift
    quaternion = RotationSpline(key_s, Rotation.from_quat(laid.quaternion_xyzw))(inside).as_quat()
    known = (asked_s >= 0) & (asked_s <= key_s[-1]) & _bridged(laid.t_ns, at_ns)
    known &= np.isfinite(position).all(axis=1)
    return np.where(known[:, None], position, np.nan), np.where(known[:, None], quaternion, np.nan)


def with_focal(intrinsics: Intrinsics, ratio: float) -> Intrinsics:
    """Return intrinsics with a refined focal length."""
    return replace(intrinsics, fx=intrinsics.fx * ratio, fy=intrinsics.fy * ratio)
