"""Inputs of a reconstruction from a session: its cameras, the priors of their errors, the truth."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.noise import (
    ROTATION,
    SHIFT_IN_WORLD,
    UNKNOWN_SIGMA,
    NoiseModel,
    PoseErrors,
    Process,
    disturb,
    errors_of_level,
    pose_errors,
    sum_sigma,
)
from pipelines.reconstruction.body_fit import is_blazepose
from pipelines.reconstruction.log_stretches import Mended, mend, warnings_of_stretches
from pipelines.reconstruction.observations import Camera
from pipelines.session.camera_poses import parsed_noise_models, stated_models, stated_noise
from pipelines.session.description import Description
from pipelines.session.errors import DataError, NoViewsError
from pipelines.session.records import JointMotion
from pipelines.session.stages import StageRecord
from pipelines.session.tables import (
    FRAMES,
    KEYPOINTS,
    TRUTH,
    detections_from,
    join_detections,
    most_confident,
    read_motion,
    read_parts,
    read_poses,
    read_table,
)

# More people in one picture are errors of the detector, and memory grows with their number.
_MOST_PEOPLE = 12
# Satellite positions decorrelate in minutes, those of odometry and of other logs are stated with seconds.
MIN_SATELLITE_CORRELATION_S = 60.0
# Receivers side by side share the errors of orbits, clocks and the air, not those of reflections and noise.
# How much that is differs with receivers; half of the variance is assumed.
SHARED_BY_RECEIVERS = 0.5

Calibrated = Callable[[Float, NDArray[np.str_]], Float]


@dataclass(frozen=True)
class _Keypoints:
    """Source of a camera's keypoints: imported with the flight, or detected."""

    table: Path
    joints: tuple[str, ...]
    looked_at: slice  # of the camera's frames


def _keypoints(folder: Path, description: Description, detected: StageRecord | None) -> dict[str, _Keypoints]:
    """Find the source of keypoints for every camera that has one."""
    sources = {}
    for name, entry in description.cameras.items():
        if entry.keypoints is not None:
            table = folder / "cameras" / name / "keypoints.parquet"
            sources[name] = _Keypoints(table, tuple(entry.keypoints.joints), slice(None))
        elif detected is not None and name in detected.counts["cameras"]:
            table = folder / "detect" / name / "keypoints.parquet"
            first, stop = detected.counts["rows"][name]
            if first < stop:  # else none of its pictures lies in the requested span
                looked_at = slice(first, stop, int(detected.settings["every"]))
                sources[name] = _Keypoints(table, tuple(detected.counts["joints"]), looked_at)
    return sources


def load_cameras(
    folder: Path,
    description: Description,
    detected: StageRecord | None,
    *,
    min_confidence: float,
    pose_noise: str | None,
    calibrated: Calibrated | None = None,
) -> tuple[list[Camera], list[str]]:
    """Load every camera with keypoints; also return warnings. DataError: none has, or they share no joint.

    Keypoints below `min_confidence` (raw) are not used; `pose_noise` replaces the flight's own. `calibrated`
    maps the detector's raw confidences [N] of joints [N] to probabilities; those of imported keypoints stay.
    """
    sources = _keypoints(folder, description, detected)
    if not sources:
        raise NoViewsError(description.flight, "has no camera with pictures or keypoints", "add one")
    # List the joints that two cameras know, or the only one, in the order of the camera that knows most.
    known, least = [source.joints for source in sources.values()], min(2, len(sources))
    shared = [name for name in max(known, key=len) if sum(name in joints for joints in known) >= least]
    if not shared:
        raise DataError(
            folder, "has no joint that two cameras' detectors both know", "use one skeleton for all"
        )
    joints = tuple(shared)
    warnings: list[str] = []
    cameras = []
    for name, source in sources.items():
        entry = description.cameras[name]
        camera = _load_camera(folder, name, description, source, joints, min_confidence, calibrated, warnings)
        noise = stated_noise(name, entry, camera.trajectory, pose_noise, camera.stepped_m)
        cameras.append(replace(camera, sigma=noise.sigma, covariance=noise.covariance))
    return cameras, warnings


def _load_camera(
    folder: Path,
    name: str,
    description: Description,
    source: _Keypoints,
    joints: tuple[str, ...],
    min_confidence: float,
    calibrated: Calibrated | None,
    warnings: list[str],
) -> Camera:
    entry = description.cameras[name]
    frames = read_table(folder / "cameras" / name / "frames.parquet", FRAMES).iloc[source.looked_at]
    trajectory = read_poses(folder / "cameras" / name / "poses.parquet")
    mended = Mended(trajectory, None, 0, 0, 0, 0.0) if entry.poses.static else mend(trajectory)
    warnings += warnings_of_stretches(name, mended)
    parts = []
    for keypoints in read_parts(source.table, KEYPOINTS):
        if (keypoints["frame"] > frames["frame"].max()).any():
            raise DataError(
                source.table, "holds keypoints of frames that are not there", "run it again with --force"
            )
        used = keypoints[keypoints["confidence"] >= min_confidence]
        if calibrated is not None and entry.keypoints is None:
            raw, joint = used["confidence"].to_numpy(np.float64), used["joint"].to_numpy(str)
            used = used.assign(confidence=calibrated(raw, joint))
        parts.append(detections_from(used, joints))
    detections, crowd = most_confident(join_detections(parts), _MOST_PEOPLE)
    if crowd:
        warnings.append(f"{name}: {crowd} detections left out, more than {_MOST_PEOPLE} in a picture")
    frame, every = frames["frame"].to_numpy(np.int64), source.looked_at.step or 1
    return Camera(
        name=name,
        intrinsics=entry.intrinsics,
        frame_number=frame,
        frame_t_ns=frames["t_ns"].to_numpy(np.int64),
        follows=np.diff(frame, prepend=frame[0] - every) == every,
        trajectory=mended.trajectory,
        static=entry.poses.static,
        sigma=None,
        blazepose=is_blazepose(source.joints),
        loosened=mended.loosened,
        stepped_m=mended.stepped_m,
        # From here on frames count the rows of the table: pictures without a time are not in it.
        detections=replace(detections, frame=np.searchsorted(frame, detections.frame)),
    )


def load_pose_errors(
    description: Description, cameras: Sequence[Camera], pose_noise: str | None
) -> list[PoseErrors] | None:
    """Load the prior of each camera's pose errors over time; None if not known for all moving cameras.

    Cameras without any statement beside those corrected by a background have errors of usual size
    (`UNKNOWN_SIGMA`). Of a logged covariance the white part uses that of each pose, the constant part the
    median (`errors_of_level`). A static camera without stated noise counts as exact beside others with.
    """
    stated: list[PoseErrors | None] = []
    for camera in cameras:
        entry = description.cameras[camera.name]
        models = stated_models(camera.name, entry, pose_noise, camera.stepped_m)
        if camera.errors is not None:
            stated.append(camera.errors)
        elif models is not None:
            stated.append(_prior_of(models, camera))
        elif camera.covariance is not None and camera.sigma is not None:
            level = errors_of_level(np.median(camera.sigma, axis=0))
            stepped = (Process(SHIFT_IN_WORLD, camera.stepped_m),) if camera.stepped_m else ()
            stated.append(replace(level, processes=(*level.processes, *stepped), logged=True))
        else:
            stated.append(PoseErrors((0.0, 0.0), ()) if camera.static else None)
    if any(camera.errors is not None for camera in cameras):
        usual = replace(errors_of_level(np.array(UNKNOWN_SIGMA)), assumed=True)
        stated = [usual if errors is None else errors for errors in stated]
    known = [errors for errors in stated if errors is not None]
    return known if len(known) == len(stated) else None


def _prior_of(models: Sequence[NoiseModel], camera: Camera) -> PoseErrors:
    """Build the prior from stated models; for models of plug-ins, from the size of their errors alone."""
    try:
        elapsed_s = max(float(camera.frame_t_ns[0] - camera.trajectory.t_ns[0]) / 1e9, 0.0)
        return pose_errors(models).later(elapsed_s)
    except ValueError:
        level = np.array(UNKNOWN_SIGMA) if camera.sigma is None else np.median(camera.sigma, axis=0)
        return errors_of_level(level)


def shared_position_variance(errors: Sequence[PoseErrors | None]) -> float:
    """Compute the variance, m^2 per axis, that all cameras' positions share beside the mean of their errors.

    Estimates take errors of cameras for independent, and no picture shows a shift of all of them.
    """
    lasting = [
        sum(
            each.sigma0**2
            for each in (of.processes if of else ())
            if each.number != ROTATION and MIN_SATELLITE_CORRELATION_S <= each.correlation_s < np.inf
        )
        for of in errors
    ]
    return SHARED_BY_RECEIVERS * min(lasting) * (1 - 1 / len(lasting))


def source_of_pose_noise(
    description: Description, cameras: Sequence[Camera], pose_noise: str | None
) -> Literal["stated", "logged"] | None:
    """Say where the noise of the moving cameras' poses is known from; None if not known of all of them."""
    moving = [camera for camera in cameras if not camera.static]
    stated = [stated_models(camera.name, description.cameras[camera.name], pose_noise) for camera in moving]
    if moving and all(models is not None for models in stated):
        return "stated"
    logged = [camera.sigma is not None for camera in moving]
    return "logged" if moving and all(logged) else None


def load_clock_sigma(description: Description, cameras: Sequence[Camera]) -> tuple[Float, Bool]:
    """Load the prior deviation [C] s of each clock offset, 0 if known, and whether somebody stated it."""
    clocks = [description.cameras[camera.name].clock for camera in cameras]
    sigma_s = np.array([clock.prior_sigma_s for clock in clocks])
    return sigma_s, np.array([clock.sigma_s > 0 or clock.start == "stated" for clock in clocks])


def with_reference(description: Description, cameras: Sequence[Camera], clock_sigma_s: Float) -> Float:
    """Hold the reference camera's clock (0 s of [C]) where none is known: rays show differences only."""
    sigma_s = clock_sigma_s.copy()
    if (sigma_s > 0).all():
        names, held = [camera.name for camera in cameras], description.clock_reference
        sigma_s[names.index(held) if held in names else 0] = 0.0
    return sigma_s


def is_time_unknown(description: Description, cameras: Sequence[Camera]) -> bool:
    """Test if no camera's start is stated (assumed, or absent): all may have the same clock offset."""
    clocks = [description.cameras[camera.name].clock for camera in cameras]
    return all(clock.prior_sigma_s > 0 and clock.sigma_s == 0 and clock.start != "stated" for clock in clocks)


def load_truth(folder: Path, description: Description, joints: tuple[str, ...]) -> JointMotion | None:
    """Load the true joints, NaN for joints without truth; None if the session has no truth."""
    return read_motion(folder / "truth.parquet", TRUTH, joints) if description.has_true_joints else None


# --- errors that are added -----------------------------------------------------------------------------

# More trials would take days and change no interval.
MAX_TRIALS = 1000

_DRAWS = re.compile(r"(?P<text>.*?)(\s+x(?P<trials>[0-9]+))?(\s+seed=(?P<seed>[0-9]+))?\s*", re.DOTALL)


@dataclass(frozen=True)
class PoseDisturbance:
    """Errors that are added to the logged poses in several trials."""

    text: str  # the noise models, as users write them
    models: list[NoiseModel]
    trials: int
    seed: int

    @classmethod
    def parse(cls, text: str) -> PoseDisturbance:
        """Parse `MODELS [xTRIALS] [seed=SEED]`; without them there is one trial, and the seed is 0."""
        place = "--disturb-poses"
        found = _DRAWS.fullmatch(text)
        words = {} if found is None else found.groupdict()
        models = parsed_noise_models(place, words["text"])
        one = np.ones(1)  # any elapsed time, speed and turn rate
        if not sum_sigma(models, one, one, one).any():
            raise DataError(
                place, f"{text!r} disturbs nothing", "state at least one size above 0", code="bad-value"
            )
        trials, seed = int(words["trials"] or 1), int(words["seed"] or 0)
        if not 1 <= trials <= MAX_TRIALS or seed >= 2**32:
            problem = f"x{trials} seed={seed} is out of range"
            raise DataError(
                place, problem, f"state x1 to x{MAX_TRIALS}, and a seed below 2^32", code="bad-value"
            )
        return cls(words["text"], models, trials, seed)


def disturbed(cameras: Sequence[Camera], models: Sequence[NoiseModel], seed: int, trial: int) -> list[Camera]:
    """Add errors to every logged pose of the cameras; the stated noise of the logs stays the same."""
    moved = []
    for c, camera in enumerate(cameras):
        log = camera.trajectory
        rng = np.random.default_rng([seed, trial, c])
        position, quaternion = disturb(models, log.t_ns, log.position, log.quaternion_xyzw, rng)
        moved.append(replace(camera, trajectory=replace(log, position=position, quaternion_xyzw=quaternion)))
    return moved
