"""Files that a manifest names for one flight: their formats, and readers in the files' axes and times."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TypeVar

import numpy as np

from pipelines.formats.common.rows import METRES
from pipelines.formats.maps.ros_map import FORMAT as ROS_MAP
from pipelines.formats.skeletons.joint_files import joint_names
from pipelines.formats.videos.frame_times import FrameTimesFormat
from pipelines.session.errors import DataError
from pipelines.session.manifest import (
    CameraOfCalibration,
    CameraSources,
    DetectorOutput,
    FileSource,
    KeypointSource,
    Manifest,
    TruthSource,
    options_of,
)
from pipelines.session.people import joint_called
from pipelines.session.progress import Progress
from pipelines.session.recognition import recognise, recognise_any
from pipelines.session.records import CalibratedCamera, Detections, JointMotion, VideoIndex
from pipelines.session.registries import (
    AttitudeFormat,
    CalibrationFormat,
    Format,
    JointFormat,
    KeypointFormat,
    LogFormat,
    MapFormat,
    TelemetryFormat,
    TrajectoryFormat,
    TriggerFormat,
    VideoFormat,
)
from pipelines.session.storage import file_stamp, hash_of, is_folder, refuse_special, sha256_of
from pipelines.session.urls import fetched, located, named, source_url
from pipelines.session.yaml_models import YamlModel
from pipelines.sources.world import UP_ROWS, losses

# In any flight a person's joints are closer to their median than this.
MAX_JOINT_DISTANCE_M = 10_000

# Metric grids on Earth have coordinates up to 1e7 m.
MAX_COORDINATE_M = 1e8


_KINDS: dict[str, tuple[str, tuple[type, ...]]] = {
    "video": ("video", (VideoFormat, LogFormat)),
    "frame_times": ("file of frame times", (FrameTimesFormat, TriggerFormat, LogFormat)),
    "pose": ("source of poses", (CalibrationFormat, TrajectoryFormat, TelemetryFormat, LogFormat)),
    "gimbal": ("source of angles", (AttitudeFormat, LogFormat)),
    "intrinsics": ("calibration", (CalibrationFormat, LogFormat)),
    "keypoints": ("keypoint file", (KeypointFormat,)),
    "map": ("map", (MapFormat, LogFormat)),
    "truth": ("file of true joints", (JointFormat,)),
    "plan": ("file of commanded poses", (TrajectoryFormat, LogFormat)),
}
"""Name and kinds of formats of the file in each part of a manifest."""

O = TypeVar("O", bound=YamlModel)


class FlightFiles:
    """Reader of the files of one flight; each calibration is read once."""

    def __init__(self, flight: Manifest, manifest: Path) -> None:
        self._flight = flight
        self._manifest = manifest
        self._base = manifest.parent
        self._formats: dict[tuple[str, str, str | None], Format] = {}
        self._calibrations: dict[str, dict[str, CalibratedCamera]] = {}

    def path(self, file: str) -> Path:
        """Return the path of a `file:`, the first one of a split log."""
        path = located(self._base, self._flight.paths_of(file)[0])
        if self._flight.logs and file not in self._flight.logs and not (path.exists() or is_folder(path)):
            remedy = f"check the path, or name one of the logs {', '.join(self._flight.logs)}"
            raise DataError(path, "does not exist", remedy, code="no-such-file")
        return path

    def format_of(self, part: str, source: FileSource) -> Format:
        """Recognise the file of a part of the manifest; errors as in `recognise`."""
        key = (part, source.file, source.format)
        if key not in self._formats:
            noun, kinds = _KINDS[part]
            self._formats[key] = recognise_any(self.path(key[1]), kinds, noun, name=source.format)
        return self._formats[key]

    def is_log(self, part: str, source: FileSource) -> bool:
        """Return True if a source is a log of topics."""
        return bool(source.file) and isinstance(self.format_of(part, source), LogFormat)

    def options(self, part: str, source: FileSource, wanted: type[O], place: str = "") -> O:
        """Validate the options beside the file of a part of the manifest, and return them."""
        where = f"{self._manifest}: {place or part}"
        return options_of(where, part, self.format_of(part, source), source.options, wanted)

    def _parts(self) -> Iterator[tuple[str, str, FileSource]]:
        """Yield the parts of the manifest that have a file: where each stands, and its name."""
        parts: list[tuple[str, str, FileSource | None]] = []
        for name, camera in self._flight.cameras.items():
            named = ("video", "frame_times", "pose", "gimbal", "intrinsics", "keypoints")
            parts += [(f"cameras.{name}.{part}", part, getattr(camera, part)) for part in named]
        parts += [("map", "map", self._flight.map), ("truth", "truth", self._flight.truth)]
        parts += [(f"plan.{name}", "plan", source) for name, source in self._flight.plan.items()]
        for place, part, source in parts:
            if source is not None and source.file:
                yield place, part, source

    def logs(self) -> list[str]:
        """Return the logs of topics that the manifest lists or reads, each once, in that order."""
        read = [source.file for _, part, source in self._parts() if self.is_log(part, source)]
        return list({self._flight.paths_of(log)[0]: log for log in [*read, *self._flight.logs]}.values())

    def refuse_other_options(self) -> None:
        """Recognise every file; DataError for a missing one, a wrong kind, or options not for it."""
        for place, part, source in self._parts():
            self.options(part, source, YamlModel, place)
            if source.topic is not None and not self.is_log(part, source):
                problem = f"has a topic, and {source.file} is no log ({self.format_of(part, source).title})"
                remedy = "leave the topic out, or name the log"
                raise DataError(f"{self._manifest}: {place}", problem, remedy, code="wrong-option")

    def keypoints(self, source: KeypointSource) -> tuple[Detections, str]:
        """Read the keypoints that the manifest gives for a camera; return them with their format's name."""
        path = self.path(source.file)
        reader = recognise(path, KeypointFormat, "keypoint file", name=source.format)
        skeleton = self.options("keypoints", source, DetectorOutput).skeleton
        detections = reader.read_keypoints(path, skeleton=skeleton, first_frame=source.first_frame)
        if not len(detections.frame):
            problem = "holds no keypoints"
            remedy = "run the detector again, or leave the camera out"
            raise DataError(path, problem, remedy, code="no-keypoints")
        if source.image_size:
            detections = replace(detections, image_size=(source.image_size[0], source.image_size[1]))
        return detections, reader.name

    def video_file(self, camera: CameraSources) -> Path | None:
        """Return the path of a camera's video; None if it has none, or pictures in a log."""
        if camera.video is None or self.is_log("video", camera.video):
            return None
        return self.path(camera.video.file)

    def video(self, camera: CameraSources) -> VideoIndex | None:
        """Return the index of a camera's video file; None if it has none."""
        path = self.video_file(camera)
        return None if path is None else recognise(path, VideoFormat, "video").index(path)

    def camera(self, name: str, part: str, source: FileSource) -> CalibratedCamera:
        """Return the camera that is asked for, or the one of this name, or the only one of the file."""
        path, camera = source.file, self.options(part, source, CameraOfCalibration).camera
        if path not in self._calibrations:
            reader = recognise(self.path(path), CalibrationFormat, "calibration", name=source.format)
            self._calibrations[path] = reader.read_calibration(self.path(path))
        cameras = self._calibrations[path]
        if camera is None and name not in cameras and len(cameras) == 1:
            return next(iter(cameras.values()))
        if (camera or name) not in cameras:
            listed = ", ".join(sorted(cameras)[:20])
            problem = f"holds no camera {camera or name!r} (there are {listed})"
            remedy = "say which with {file: ..., camera: ...}"
            raise DataError(self.path(path), problem, remedy, code="no-such-name")
        return cameras[camera or name]

    def true_joints(self, source: TruthSource) -> JointMotion:
        """Read the true joints, without positions far from others; DataError: none left, or unknown axes."""
        path = self.path(source.file)
        reader = recognise(path, JointFormat, "file of true joints", name=source.format)
        own_axes = source.axes is not None or source.up is not None
        if not own_axes and self._flight.world.frame == "ned":
            problem = "has joints of unknown axes in a NED world"
            raise DataError(path, problem, "say truth: {axes: ned}, or up: z", code="axes-unknown")
        as_written = own_axes or self._flight.world.up not in {None, "z"}
        axes = "z-up" if as_written else None
        motion = reader.read_joints(path, unit=source.unit, axes=axes)
        motion = _without_zeros(_of_subject(path, _timed(path, motion, source), source.subject))
        if source.unit is None:
            self._refuse_wrong_unit(path, motion, reader, source, axes)
        if source.axes == "ned":
            motion = replace(motion, position=motion.position[..., [1, 0, 2]] * [1, 1, -1])
        elif source.up is not None:
            motion = replace(motion, position=motion.position @ np.transpose(UP_ROWS[source.up]))
        motion = _without_far_joints(motion)
        if not np.isfinite(motion.position).any():
            lost = f" ({losses(motion.dropped)})" if motion.dropped else ""
            problem = f"holds no position of a joint{lost}"
            raise DataError(path, problem, "check what wrote it", code="no-positions")
        return replace(motion, t_ns=motion.t_ns + source.offset_ns)

    @staticmethod
    def _refuse_wrong_unit(
        path: Path, motion: JointMotion, reader: JointFormat, source: TruthSource, axes: str | None
    ) -> None:
        """Refuse true joints that are no person's in the unit of their file, but are in another one."""
        low_m, high_m = BODY_SIZE_M
        size_m = _body_size_m(motion)
        if np.isnan(size_m) or low_m <= size_m <= high_m:
            return
        for unit in METRES:
            other = _of_subject(path, reader.read_joints(path, unit=unit, axes=axes), source.subject)
            other_m = _body_size_m(_without_zeros(other))
            if low_m <= other_m <= high_m:
                problem = (
                    f"holds people of {size_m:.4g} m by its unit, and of {other_m:.2g} m if it is {unit}"
                )
                raise DataError(path, problem, f"say truth: {{unit: {unit}}}", code="unit-unknown")


def _timed(path: Path, motion: JointMotion, source: TruthSource) -> JointMotion:
    """Turn numbers of frames into times where a file of joints has none."""
    if motion.timed and source.fps is None:
        return motion
    if motion.timed:
        raise DataError(path, "states times of its own", "leave truth.fps out", code="wrong-option")
    if source.fps is None:
        remedy = "say truth: {fps: 30, offset_s: SECONDS}, the frames a second and the time of frame 0"
        raise DataError(path, "states no times", remedy, code="clock-unknown")
    return replace(motion, t_ns=np.rint(motion.t_ns / source.fps).astype(np.int64), timed=True)


def _of_subject(path: Path, motion: JointMotion, subject: str | None) -> JointMotion:
    """Keep the joints of one subject, whose name stands before a separator in the names of its joints."""
    parted = [_parted(joint) for joint in motion.joints]
    count = Counter(name for name, _, _ in parted if name)
    colons = {name for name, separator, _ in parted if separator == ":"}
    subjects = [name for name in count if name in colons or count[name] >= MIN_JOINTS_OF_A_BODY]
    if subject is None and len(subjects) < 2:
        plain = [joint for name, _, joint in parted if not name]
        if not subjects or (subjects[0] in colons and plain) or any(map(joint_called, plain)):
            return motion
        subject = subjects[0]
    if subject not in subjects:
        problem = f"holds joints of {', '.join(subjects) or 'nobody by name'}"
        remedy = f"say which: truth: {{subject: {subjects[0]}}}" if subjects else "leave truth.subject out"
        raise DataError(path, problem, remedy, code="no-such-name" if subject else "ambiguous")
    chosen = [k for k, (name, _, _) in enumerate(parted) if name == subject]
    return replace(
        motion,
        joints=joint_names(tuple(parted[k][2] for k in chosen)),
        position=motion.position[:, :, chosen],
    )


def _parted(joint: str) -> tuple[str, str, str]:
    """Part a name into subject, separator and joint, which is a known one but after a colon."""
    if ":" in joint or joint_called(joint):
        return joint.rpartition(":")
    found = ((joint[: at.start()], at.group(), joint[at.end() :]) for at in re.finditer(r"[_. |/-]", joint))
    return next((parts for parts in found if parts[0] and joint_called(parts[2])), ("", "", joint))


def _without_zeros(motion: JointMotion) -> JointMotion:
    """Take joints at exactly (0, 0, 0) as missing, as many programs write them; count them."""
    zero = (motion.position == 0.0).all(axis=-1)
    if not zero.any():
        return motion
    lost = {"position at exactly 0, 0, 0, taken as missing": int(zero.sum())}
    position = np.where(zero[..., None], np.nan, motion.position)
    return replace(motion, position=position, dropped=motion.dropped | lost)


def _body_size_m(motion: JointMotion) -> float:
    """Measure the median diagonal of the box around a person's joints; NaN of too few joints."""
    known = np.isfinite(motion.position).all(axis=-1).sum(axis=-1) >= MIN_JOINTS_OF_A_BODY
    people = motion.position[known]
    if not len(people):
        return np.nan
    with np.errstate(over="ignore", invalid="ignore"):  # 1e308 is infinitely far from its negative
        sides_m = np.nanmax(people, axis=1) - np.nanmin(people, axis=1)
        return float(np.median(np.linalg.norm(sides_m, axis=-1)))


def _without_far_joints(motion: JointMotion) -> JointMotion:
    """Set positions to NaN that are incomplete, or too far from the median of all to be true."""
    position = np.where(np.isfinite(motion.position).all(axis=-1, keepdims=True), motion.position, np.nan)
    known = position[~np.isnan(position[..., 0])]
    middle = np.median(known, axis=0) if len(known) else np.nan
    with np.errstate(over="ignore", invalid="ignore"):  # 1e308 is infinitely far from its negative
        far = np.asarray((np.abs(position - middle) > MAX_JOINT_DISTANCE_M).any(axis=-1))
        far |= (np.abs(position) > MAX_COORDINATE_M).any(axis=-1)
    cause = f"position more than {MAX_JOINT_DISTANCE_M // 1000} km from the others"
    lost = {cause: int(far.sum())} if far.any() else {}
    position = np.where(far[..., None], np.nan, position)
    return replace(motion, position=position, dropped=motion.dropped | lost)


# A body that few joints stand for may be of any size.
MIN_JOINTS_OF_A_BODY = 8
# The diagonal of the box around a person's joints: a crouching child, and somebody tall with raised arms.
BODY_SIZE_M = (0.65, 3.0)


def hash_sources(flight: Manifest, base: Path, progress: Progress) -> dict[str, str]:
    """Compute the sha256 of every file that is read, by the manifest's path."""
    unique = flight.files
    for path in unique:  # before anything waits for one of them
        refuse_special(located(base, path))
    progress.start("Hashing sources", len(unique))
    hashes = {}
    for path in unique:
        digests = [sha256_of(file) for file in _source_files(located(base, path))]
        hashes[path] = digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()
        progress.advance()
    return hashes


def fetch_sources(flight: Manifest, base: Path, progress: Progress) -> None:
    """Fetch the files stated by URL that changed in the store; DataError: it cannot be read, or lacks one."""
    urls = [url for path in flight.files if (url := source_url(base, path))]
    if urls:
        progress.start("Fetching sources", len(urls))
    for url in urls:
        fetched(url, fresh=True)
        progress.advance()


def source_stamps(flight: Manifest, base: Path) -> dict[str, str]:
    """Return the stamp of every file by the manifest's path; DataError: one is missing or unreadable."""
    stamps = {
        path: [file_stamp(file) for file in _source_files(located(base, path))] for path in flight.files
    }
    return {path: own[0] if len(own) == 1 else hash_of(own) for path, own in stamps.items()}


def refuse_written(flight: Manifest, base: Path, stamps: Mapping[str, str]) -> None:
    """Refuse sources that changed since these stamps, with a DataError: the hash fits what was read."""
    for path, stamp in source_stamps(flight, base).items():
        if stamp != stamps[path]:
            problem = "was written to while it was being read"
            remedy = "run `mocap ingest` again when it is complete"
            raise DataError(named(base, path), problem, remedy, code="changed")


def _source_files(path: Path) -> list[Path]:
    """Return a source and the files that it refers to: a floor plan is a YAML and a picture."""
    if path.suffix.lower() in {".yaml", ".yml"} and ROS_MAP.recognises(path):
        return [path, *ROS_MAP.pictures(path)]
    return [path]
