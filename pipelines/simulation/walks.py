"""A walking person as the cameras of a formation see them, and the measures of what was seen.

No drone flies in a study: the cameras are exactly in their slots about the person at every moment, as in the
simulated experiments of Ho et al., "3D Human Reconstruction in the Wild with Collaborative Aerial Cameras".
Only the keypoints and the logged poses have errors, of known size. Trial k of camera i has the same random
numbers in every formation and for every size of the errors, so that differences are not due to chance. Stage
`film` measures the arms of a comparison in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

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
from pipelines.session.yaml_models import YamlModel
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
        "tilt_deg": {"mean": float(tilt_deg.mean()), "max": float(tilt_deg.max())},
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

LEVELS = {
    "none": "",
    "low": "white:position_m=0.1,rotation_deg=0.5",
    "medium": "white:position_m=0.3,rotation_deg=1",
    "high": "white:position_m=0.5,rotation_deg=2",
}
"""Pose noise per axis, by name; empty for exact poses."""

# The refinement falls back to `robust` with fewer pictures, so that its row would be that of `robust`.
_MIN_TIMES_FOR_AUTO = 20


class Variables(YamlModel):
    """Variables of a study; each has a tuple of texts, of which only one where one value is expected."""

    @field_validator("*", mode="before")
    @classmethod
    def _one_or_several(cls, texts: object, info: ValidationInfo) -> object:
        one = get_origin(cls.model_fields[info.field_name or ""].annotation) is not tuple
        if one and isinstance(texts, Sequence) and len(texts) != 1:
            raise ValueError("takes one value")
        return texts[0] if one and isinstance(texts, Sequence) else texts

    @field_validator("*")
    @classmethod
    def _each_once(cls, values: object) -> object:
        if isinstance(values, tuple) and len(set(values)) < len(values):
            raise PydanticCustomError("twice", "states a value twice")
        return values


class WalkStudy(Variables):
    """Settings of a study of a walk; what is not stated is as in the experiments of Ho et al.

    `noise` has names of `LEVELS` (white noise), or models as `--pose-noise` has them.
    """

    tilts_deg: tuple[Annotated[float, Field(ge=-10, le=85)], ...] = Field((15.0,), alias="tilt_deg")
    robots: tuple[Annotated[int, Field(ge=2, le=8)], ...] = (2,)
    noise: tuple[str, ...] = tuple(LEVELS)
    methods: tuple[StudyMethod, ...] = Field(METHODS, alias="method")
    keypoints: Literal["model", "exact"] = "model"
    seconds: float = Field(75.0, ge=0.1, le=600)
    rate_hz: float = Field(30.0, ge=0.1, le=240)
    trials: int = Field(10, ge=1, le=10_000)
    seed: int = Field(0, ge=0, lt=2**32)

    @model_validator(mode="after")
    def _enough_pictures(self) -> WalkStudy:
        for noise in self.noise:
            self.models(noise)
        needed = _MIN_TIMES_FOR_AUTO if "auto" in self.methods else 2
        if self.seconds * self.rate_hz < needed:
            raise ValueError(
                f"seconds: {self.seconds:g} s at {self.rate_hz:g} Hz are less than {needed} pictures: film"
                " longer, or leave auto out of method"
            )
        return self

    def models(self, noise: str) -> list[NoiseModel]:
        """Build the models of one of the kinds of noise; DataError: it is neither a name nor a model."""
        text = LEVELS.get(noise, noise)
        return parsed_noise_models("noise", text) if text else []


def varied_most(stated: Mapping[str, Sequence[str]]) -> Axis:
    """Choose the first number that varies; without one the noise if it was stated, else the tilt."""
    axes: tuple[Axis, ...] = ("tilt_deg", "robots")
    for name in (name for text in stated for name in axes if name == text):
        if len(stated[name]) > 1:
            return name
    if "noise" in stated:
        return "noise"
    return "robots" if "robots" in stated and "tilt_deg" not in stated else "tilt_deg"
