"""A walking person as the cameras of a formation see them, and the measures of what was seen.

No drone flies in a study: the cameras are exactly in their slots about the person at every moment, as in the
simulated experiments of Ho et al., "3D Human Reconstruction in the Wild with Collaborative Aerial Cameras".
Only the keypoints and the logged poses have errors, of known size. Trial k of camera i has the same random
numbers in every formation and for every size of the errors, so that differences are not due to chance. Stage
`film` measures the arms of a comparison in the same way.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from pipelines.geometry.arrays import Float, Int64, Intrinsics
from pipelines.geometry.cameras import undistort
from pipelines.geometry.metrics import measure
from pipelines.geometry.noise import NoiseModel, disturb, sum_sigma
from pipelines.geometry.poses import matrix_from_quaternion, rates
from pipelines.geometry.rig import BodyMotion
from pipelines.geometry.triangulation import (
    PIXEL_SIGMA_PX,
    Method,
    Views,
    estimate_noise,
    triangulate_pictures,
)
from pipelines.session.camera_poses import parsed_noise_models
from pipelines.session.errors import DataError
from pipelines.simulation.body import PosablePerson, make_body
from pipelines.simulation.detector_errors import detect_keypoints, see, view_of
from pipelines.simulation.flight import Performer
from pipelines.simulation.flying import orbit
from pipelines.simulation.motion_script import perform
from pipelines.simulation.scenario import Body, DetectorErrors, Lens, Scenario, Step, Travel

RANGE_M = 10.0
"""Distance from the person to every camera, m."""

CIRCLE_M = 15.0
"""Radius of the way: the person is seen from all sides."""

MIN_CONFIDENCE = 0.3
"""Least confidence of keypoints that are used: the default of `mocap reconstruct`."""

IMITATED = DetectorErrors().detector
"""Detector whose measured errors the modelled keypoints have."""

# The person of a study walks at an even, usual pace.
_SPEED_MPS = 1.2
# The person starts from a stand, and filming begins when it has become a walk.
_UNDER_WAY_S = 2.0
_AIM_S, _AIM_STEP_S = 1.0, 0.05  # cameras follow the mean over a stride, not every bob of the hip
T = TypeVar("T", int, float)
# One random stream for each.
_POSES, _KEYPOINTS = range(2)


@dataclass(frozen=True)
class Walk:
    """A person under way at the moments T of the pictures."""

    t_ns: Int64  # [T]
    person: PosablePerson
    height_m: float
    motion: BodyMotion  # at those moments
    joints: Float  # [T, J, 3] m, world, of `person.joints`
    aim: Float  # [T, 3] m, world: the hip, smoothed
    lens: Intrinsics = field(default_factory=lambda: Lens().intrinsics())
    errors: DetectorErrors = field(default_factory=DetectorErrors)  # of modelled keypoints


@dataclass(frozen=True)
class CameraFormation:
    """Cameras N in their slots at the moments T."""

    position: Float  # [N, T, 3] m, world
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera
    lens: Intrinsics  # of all of them


@dataclass(frozen=True)
class SimulatedKeypoints:
    """Keypoints of the person in every camera."""

    xy: Float  # [N, T, J, 2] px, NaN for joints that were not found
    confidence: Float  # [N, T, J], 0 for that


def walk(seconds: float, rate_hz: float, seed: int) -> Walk:
    """Return a person who walks on a circle at an even pace."""
    look = Body()
    person = make_body(look)
    distance_m = _SPEED_MPS * (seconds + 2 * _UNDER_WAY_S + _AIM_S)
    way = Travel(
        distance_m=distance_m, turn_deg=float(np.degrees(distance_m / CIRCLE_M)), speed_mps=_SPEED_MPS
    )

    def at(t_s: Float) -> BodyMotion:
        return perform(
            [Step(walk=way)],
            person.rig,
            t_s + _UNDER_WAY_S,
            ground=lambda xy: np.zeros(np.shape(xy)[:-1]),
            start=np.array([0.0, -CIRCLE_M]),
            heading_deg=0.0,
            repeat=False,
            seed=seed,
        )

    return _filmed(person, look.height_m, at, _times_ns(seconds, rate_hz))


def walk_of(performer: Performer, scenario: Scenario, seconds: float, rate_hz: float) -> Walk:
    """Return the way of a scenario's person, whom cameras without obstacles film with the scenario's lens."""
    t_ns = _times_ns(min(seconds, scenario.duration_s), rate_hz)
    way = _filmed(performer.person, performer.look.body.height_m, performer.moving, t_ns)
    lens = replace(scenario.drones.camera.intrinsics(), readout_s=0.0)
    return replace(way, lens=lens, errors=scenario.keypoints)


def _filmed(person: PosablePerson, height_m: float, at: Callable[[Float], BodyMotion], t_ns: Int64) -> Walk:
    motion = at(t_ns / 1e9)
    return Walk(t_ns, person, height_m, motion, person.keypoints(motion), _smoothed(at, t_ns / 1e9))


def _times_ns(seconds: float, rate_hz: float) -> Int64:
    return np.round(np.arange(max(round(seconds * rate_hz), 2)) * (1e9 / rate_hz)).astype(np.int64)


def _smoothed(at: Callable[[Float], BodyMotion], t_s: Float) -> Float:
    """Compute the pelvis [T, 3], each moment the mean over `_AIM_S`."""
    samples = round(_AIM_S / _AIM_STEP_S) + 1
    middle_s = np.arange(t_s[0] - _AIM_STEP_S, t_s[-1] + 2 * _AIM_STEP_S, _AIM_STEP_S)
    grid_s = middle_s[0] + _AIM_STEP_S * (np.arange(len(middle_s) + samples - 1) - samples // 2)
    root = at(grid_s).root
    total = np.cumsum(np.concatenate([np.zeros((1, 3)), root]), axis=0)
    mean = (total[samples:] - total[:-samples]) / samples
    return np.stack([np.interp(t_s, middle_s, mean[:, k]) for k in range(3)], axis=-1)


def formation(of: Walk, *, cameras: int, tilt_deg: float) -> CameraFormation:
    """Place cameras in their slots: 360/n degrees apart, 90 for two, `RANGE_M` from the person."""
    position, quaternion = orbit(
        of.t_ns / 1e9, of.aim, cameras=cameras, range_m=RANGE_M, tilt_deg=tilt_deg, yaw_rate_deg_per_s=0.0
    )
    return CameraFormation(position, quaternion, of.lens)


def exact_keypoints(of: Walk, seen_by: CameraFormation) -> SimulatedKeypoints:
    """Compute the true keypoints in every picture."""
    xy = np.stack(
        [
            see(of.joints, *pose, seen_by.lens)
            for pose in zip(seen_by.position, seen_by.quaternion_xyzw, strict=True)
        ]
    )
    return SimulatedKeypoints(xy, np.isfinite(xy[..., 0]).astype(np.float64))


def model_keypoints(
    of: Walk, seen_by: CameraFormation, exact: SimulatedKeypoints, *, seed: int, trial: int
) -> SimulatedKeypoints:
    """Simulate a detector's keypoints with measured errors, which grow with tilt (`detector_errors`)."""
    found = []
    for camera, pixels in enumerate(exact.xy):
        tilt_deg, height_px = view_of(
            seen_by.position[camera], of.motion.root, height_m=of.height_m, focal_px=seen_by.lens.fx
        )
        found.append(
            detect_keypoints(
                pixels,
                np.ones(pixels.shape[:-1], dtype=np.bool_),
                tilt_deg,
                height_px,
                of.errors,
                np.random.default_rng([seed, _KEYPOINTS, trial, camera]),
                joints=of.person.joints,
            )
        )
    xy, confidence = (np.stack(part) for part in zip(*found, strict=True))
    return SimulatedKeypoints(xy, confidence)


def views_of(
    of: Walk,
    seen_by: CameraFormation,
    sightings: SimulatedKeypoints,
    noise: Sequence[NoiseModel],
    *,
    seed: int,
    trial: int,
) -> Views:
    """Return the input of triangulation, T * J rows, joints fastest, with the noise's own sigma of poses."""
    cameras, times, joints = sightings.confidence.shape
    position, rotation = np.empty((times, cameras, 3)), np.empty((times, cameras, 3, 3))
    sigma = np.empty((times, cameras, 2))
    elapsed_s = (of.t_ns - of.t_ns[0]) / 1e9
    for camera, true in enumerate(zip(seen_by.position, seen_by.quaternion_xyzw, strict=True)):
        rng = np.random.default_rng([seed, _POSES, trial, camera])
        position[:, camera], turned = disturb(noise, of.t_ns, *true, rng)
        rotation[:, camera] = matrix_from_quaternion(turned)
        sigma[:, camera] = sum_sigma(noise, elapsed_s, *rates(of.t_ns, *true))
    rays = undistort(sightings.xy, seen_by.lens)
    trusted = np.where(sightings.confidence >= MIN_CONFIDENCE, sightings.confidence, 0.0)
    return Views(
        rays=np.moveaxis(rays, 0, 2).reshape(times * joints, cameras, 2),
        weight=np.moveaxis(trusted, 0, 2).reshape(times * joints, cameras),
        pose_index=np.repeat(np.arange(times), joints),
        position=position,
        rotation=rotation,
        focal=np.full(cameras, (seen_by.lens.fx + seen_by.lens.fy) / 2),
        pixel_sigma=np.full(cameras, PIXEL_SIGMA_PX),
        pose_sigma=sigma,
    )


NEAR_SHARE = 0.1
"""Largest error of a right keypoint, as a share of the height in pixels of a person at that place."""

_ERRORS = ("reconstructed_share", "mpjpe_mm", "root_mpjpe_mm", "pa_mpjpe_mm", "pck150")


def triangulate_robustly(views: Views) -> tuple[Views, Float]:
    """Triangulate as `robust` does: the views with the estimated noise of keypoints, and points [N, 3] m."""
    weighed = replace(views, pixel_sigma=estimate_noise(views))
    found = triangulate_pictures(weighed, picture=views.pose_index, pixel_sigma=views.pixel_sigma)
    return weighed, found.points


def measure_arm(
    of: Walk,
    seen_by: CameraFormation,
    sightings: SimulatedKeypoints,
    points: Float,
    *,
    tilt_deg: Float,
    range_m: Float,
) -> dict[str, Any]:
    """Measure an arm from its points [T, J, 3] m: figures by their names in film/metrics.json."""
    exact = exact_keypoints(of, seen_by).xy
    inside = np.isfinite(exact[..., 0])
    off_px = np.linalg.norm(sightings.xy - exact, axis=-1)
    near = off_px <= NEAR_SHARE * (seen_by.lens.fx * of.height_m / range_m)[..., None]
    measured = off_px[np.isfinite(off_px)]
    errors = measure(points[:, None], of.joints[:, None], of.person.joints, of.t_ns)
    return {
        "pictures": int(np.prod(inside.shape[:2])),
        "in_view_share": float(inside.all(axis=-1).mean()),
        "tilt_deg": {
            "mean": float(tilt_deg.mean()),
            "max": float(tilt_deg.max()),
        },
        "detected_share": float((sightings.confidence > 0).any(axis=-1).mean()),
        "keypoint_pck": float(near[inside].mean()) if inside.any() else None,
        "keypoint_median_px": float(np.median(measured)) if measured.size else None,
        **{name: errors[name] for name in _ERRORS},
    }


# --- settings of a study -------------------------------------------------------------------------------

Axis = Literal["tilt_deg", "robots", "noise"]
StudyMethod = Method | Literal["auto"]

METHODS: tuple[StudyMethod, ...] = (*get_args(Method), "auto")
"""Methods that a study compares, in the order of its tables."""

LEVELS = {"none": (0.0, 0.0), "low": (0.1, 0.5), "medium": (0.3, 1.0), "high": (0.5, 2.0)}
"""Pose noise per axis, m and degrees."""

# Levels of the noise in Ho et al., Sim E1 and E2, in which `auto` may be left out for speed.
_USUAL = {"method": METHODS, "keypoints": ("model",), "seconds": ("75",), "trials": ("10",), "seed": ("0",)}
KNOWN = ("tilt_deg", "robots", "noise", "method", "keypoints", "seconds", "rate_hz", "trials", "seed")
"""Variables of a study of a walk."""

# The refinement falls back to `robust` with fewer pictures, so that its row would be that of `robust`.
_MIN_TIMES_FOR_AUTO = 20


@dataclass(frozen=True)
class StudiedNoise:
    """Errors of the logged poses."""

    label: str
    model: str  # as users write it; empty for exact poses

    def models(self) -> list[NoiseModel]:
        """Parse the noise models; DataError: the text is not a noise model, or a name is unknown."""
        return parsed_noise_models("noise", self.model) if self.model else []


@dataclass(frozen=True)
class WalkStudy:
    """Settings of a study of a walk, checked by `walk_study`."""

    axis: Axis  # that a figure has along its horizontal axis, and that the ratio compares
    tilts_deg: tuple[float, ...]
    robots: tuple[int, ...]
    noise: tuple[StudiedNoise, ...]
    methods: tuple[StudyMethod, ...]
    keypoints: Literal["model", "exact"]
    seconds: float
    rate_hz: float
    trials: int
    seed: int


def walk_study(stated: Mapping[str, Sequence[str]]) -> WalkStudy:
    """Return the settings of a study; what is not stated is as in the experiments of Ho et al.

    `noise` has names of `LEVELS` (white noise), or models as `--pose-noise` has them. DataError: an unknown
    name of a variable (`KNOWN`), a value given twice, or a number out of range.
    """
    values = {**_USUAL, "rate_hz": (), **stated}
    unknown = [name for name in values if name not in KNOWN]
    if unknown:
        raise DataError(unknown[0], "is no variable of a study of a walk", f"there are {', '.join(KNOWN)}",
                        code="no-such-name")  # fmt: skip
    (keypoints,) = _choices(values, "keypoints", ("model", "exact"))
    seconds, rate_hz = (
        single(values, name, float, 0.1, most, default)
        for name, most, default in (("seconds", 600, 75), ("rate_hz", 240, 30.0))
    )
    methods = _choices(values, "method", METHODS)
    needed = _MIN_TIMES_FOR_AUTO if "auto" in methods else 2
    if seconds * rate_hz < needed:
        raise DataError(
            "seconds",
            f"{seconds:g} s at {rate_hz:g} Hz are less than {needed} pictures"
            + (", too few for auto" if needed > 2 else ""),
            "film longer" + (", or leave auto out of method" if needed > 2 else ""),
            code="bad-value",
        )
    axis = _axis(stated)
    noise = [
        StudiedNoise(text, _white(text) if text in LEVELS else text) for text in values.get("noise", LEVELS)
    ]
    _refuse_twice("noise", [each.label for each in noise])
    for each in noise:
        each.models()
    return WalkStudy(
        axis,
        tuple(map(float, numbers(values, "tilt_deg", float, -10, 85, ("15",)))),
        tuple(numbers(values, "robots", int, 2, 8, ("2",))),
        tuple(noise),
        tuple(name for name in METHODS if name in methods),
        "exact" if keypoints == "exact" else "model",
        seconds,
        rate_hz,
        single(values, "trials", int, 1, 10_000, 10),
        single(values, "seed", int, 0, 2**32 - 1, 0),
    )


def _axis(stated: Mapping[str, Sequence[str]]) -> Axis:
    """Choose the first number that varies; without one the noise if it was stated, else the tilt."""
    order: tuple[Axis, ...] = ("tilt_deg", "robots")
    varied = [name for name in stated if name in order and len(stated[name]) > 1]
    if varied:
        return "tilt_deg" if varied[0] == "tilt_deg" else "robots"
    if "noise" in stated:
        return "noise"
    return "robots" if "robots" in stated and "tilt_deg" not in stated else "tilt_deg"


def _white(level: str) -> str:
    position_m, rotation_deg = LEVELS[level]
    return f"white:position_m={position_m:g},rotation_deg={rotation_deg:g}" if position_m else ""


# --- values --------------------------------------------------------------------------------------------


def numbers(
    values: Mapping[str, Sequence[str]],
    name: str,
    number: Callable[[str], Any],
    least: float,
    most: float,
    default: Sequence[str] = (),
) -> list[Any]:
    """Read the numbers of a variable; DataError: one is no number, out of range (NaN, too), or twice."""
    texts = values.get(name) or default
    try:
        found = [number(text) for text in texts]
    except ValueError:
        raise DataError(
            f"{name}={','.join(texts)}", "is no list of numbers", "write 2,3,4 or 0:60:15", code="bad-value"
        ) from None
    for value in found:
        if not least <= value <= most:
            raise DataError(
                f"{name}={value:g}", f"is not between {least:g} and {most:g}", "change it", code="bad-value"
            )
    _refuse_twice(name, found)
    return found


def single(
    values: Mapping[str, Sequence[str]],
    name: str,
    number: Callable[[str], T],
    least: float,
    most: float,
    default: float,
) -> T:
    """Read the number of a variable that takes one value; DataError as for `numbers`."""
    found: list[T] = numbers(values, name, number, least, most, (f"{default:g}",))
    if len(found) > 1:
        raise DataError(name, "takes one value", "leave the others out", code="bad-value")
    return found[0]


def _choices(values: Mapping[str, Sequence[str]], name: str, known: Sequence[str]) -> Sequence[str]:
    given = values[name]
    unknown = [text for text in given if text not in known]
    if unknown or not given or (name == "keypoints" and len(given) > 1):
        problem = f"no such name: {', '.join(unknown)}" if unknown else "takes one value"
        raise DataError(name, problem, f"there are {', '.join(known)}", code="no-such-name")
    _refuse_twice(name, given)
    return given


def _refuse_twice(name: str, given: Sequence[object]) -> None:
    if len(set(given)) < len(given):
        raise DataError(name, "states a value twice", "name each once", code="stated-twice")
