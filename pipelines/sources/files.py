"""Files that a manifest names for one flight: their formats, and readers in the files' axes and times."""

from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from pipelines.formats.skeletons.joint_files import joint_names
from pipelines.formats.videos.frame_times import FrameTimesFormat
from pipelines.session.errors import DataError
from pipelines.session.manifest import CameraSources, KeypointSource, Manifest, Source, TruthSource
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
    recognise,
    recognise_any,
)
from pipelines.session.source_options import CameraOfCalibration, DetectorOutput, options_of
from pipelines.session.urls import located
from pipelines.session.yaml_files import Part
from pipelines.sources.world import losses

_FARTHEST_M = 10_000  # in any flight a person's joints are closer to their median than this
_LARGEST_M = 1e8  # metric grids have coordinates up to 1e7


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

O = TypeVar("O", bound=Part)


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
        return located(self._base, self._flight.paths_of(file)[0])

    def format_of(self, part: str, source: Source) -> Format:
        """Recognise the file of a part of the manifest; errors as in `recognise`."""
        key = (part, source.file or "", source.format)
        if key not in self._formats:
            noun, kinds = _KINDS[part]
            self._formats[key] = recognise_any(self.path(key[1]), kinds, noun, name=source.format)
        return self._formats[key]

    def is_log(self, part: str, source: Source) -> bool:
        """Return True if a source is a log of topics."""
        return source.file is not None and isinstance(self.format_of(part, source), LogFormat)

    def options(self, part: str, source: Source, wanted: type[O], place: str = "") -> O:
        """Validate the options beside the file of a part of the manifest, and return them."""
        where = f"{self._manifest}: {place or part}"
        return options_of(where, part, self.format_of(part, source), source.options, wanted)

    def refuse_other_options(self) -> None:
        """Recognise every file.

        Raises:
            DataError: a file does not exist, is of no kind that belongs where it stands, or has options or
                a topic that such a file does not take.
        """
        parts: list[tuple[str, str, Source | None]] = []
        for name, camera in self._flight.cameras.items():
            named = ("video", "frame_times", "pose", "gimbal", "intrinsics", "keypoints")
            parts += [(f"cameras.{name}.{part}", part, getattr(camera, part)) for part in named]
        parts += [("map", "map", self._flight.map), ("truth", "truth", self._flight.truth)]
        parts += [(f"plan.{name}", "plan", source) for name, source in self._flight.plan.items()]
        for place, part, source in parts:
            if source is None or source.file is None:
                continue
            self.options(part, source, Part, place)
            if source.topic is not None and not self.is_log(part, source):
                raise DataError(
                    f"{self._manifest}: {place}",
                    f"has a topic, and {source.file} is no log ({self.format_of(part, source).title})",
                    "leave the topic out, or name the log",
                    code="wrong-option",
                )

    def keypoints(self, source: KeypointSource) -> tuple[Detections, str]:
        """Read the keypoints that the manifest gives for a camera; return them with their format's name."""
        path, reader = self.path(source.file), self.format_of("keypoints", source)
        if not isinstance(reader, KeypointFormat):
            raise DataError(
                path, f"{reader.name} is no keypoint format", "leave `format:` out", code="wrong-kind"
            )
        skeleton = self.options("keypoints", source, DetectorOutput).skeleton
        detections = reader.read_keypoints(path, skeleton=skeleton, first_frame=source.first_frame)
        if not len(detections.frame):
            raise DataError(
                path,
                "holds no keypoints",
                "run the detector again, or leave the camera out",
                code="no-keypoints",
            )
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

    def camera(self, name: str, part: str, source: Source) -> CalibratedCamera:
        """Return the camera that is asked for, or the one of this name, or the only one of the file."""
        path, camera = source.file or "", self.options(part, source, CameraOfCalibration).camera
        if path not in self._calibrations:
            reader = self.format_of(part, source)
            if not isinstance(reader, CalibrationFormat):
                raise TypeError(f"{reader.name} reads no calibrations")
            self._calibrations[path] = reader.read_calibration(self.path(path))
        cameras = self._calibrations[path]
        if camera is None and name not in cameras and len(cameras) == 1:
            return next(iter(cameras.values()))
        if (camera or name) not in cameras:
            listed = ", ".join(sorted(cameras)[:20])
            raise DataError(
                self.path(path),
                f"holds no camera {camera or name!r} (there are {listed})",
                "say which with {file: ..., camera: ...}",
                code="no-such-name",
            )
        return cameras[camera or name]

    def has_world_axes(self, source: TruthSource) -> bool:
        """Return True if joints are in axes of the world that are not z up."""
        return source.axes is None and self._flight.world.up != "z"

    def true_joints(self, source: TruthSource) -> JointMotion:
        """Read the true joints; drop and count positions too far from the others to be true.

        Raises:
            DataError: the file cannot be used, its axes are unknown, or no position is left.
        """
        path = self.path(source.file or "")
        reader = recognise(path, JointFormat, "file of true joints", name=source.format)
        if source.axes is None and self._flight.world.frame == "ned":
            raise DataError(
                path,
                "has joints of unknown axes in a NED world",
                "say truth: {axes: ned} or z-up, y-up",
                code="axes-unknown",
            )
        is_ned = source.axes == "ned"
        axes = "z-up" if is_ned or self.has_world_axes(source) else source.axes
        motion = reader.read_joints(path, unit=source.unit, axes=axes)
        motion = _of_subject(path, motion, source.subject)
        if is_ned:
            motion = replace(motion, position=motion.position[..., [1, 0, 2]] * [1, 1, -1])
        motion = _without_far_joints(motion)
        if not np.isfinite(motion.position).any():
            lost = f" ({losses(motion.dropped)})" if motion.dropped else ""
            raise DataError(
                path, f"holds no position of a joint{lost}", "check what wrote it", code="no-positions"
            )
        return replace(motion, t_ns=motion.t_ns + round(source.offset_s * 1e9))


def _of_subject(path: Path, motion: JointMotion, subject: str | None) -> JointMotion:
    """Keep the joints of one subject, whose name stands before a colon in the names of its joints.

    Raises:
        DataError: several subjects and none is stated, or no joint is of the stated one.
    """
    parted = [joint.rpartition(":") for joint in motion.joints]
    subjects = list(dict.fromkeys(name for name, colon, _ in parted if colon))
    if subject is None and len(subjects) < 2:
        subject = subjects[0] if subjects and all(colon for _, colon, _ in parted) else None
        if subject is None:
            return motion
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


def _without_far_joints(motion: JointMotion) -> JointMotion:
    """Set positions to NaN that are incomplete, or too far from the median of all to be true."""
    position = np.where(np.isfinite(motion.position).all(axis=-1, keepdims=True), motion.position, np.nan)
    known = position[~np.isnan(position[..., 0])]
    if not len(known):
        return replace(motion, position=position)
    with np.errstate(over="ignore", invalid="ignore"):  # 1e308 is infinitely far from its negative
        far = (np.abs(position - np.median(known, axis=0)) > _FARTHEST_M).any(axis=-1)
        far |= (np.abs(position) > _LARGEST_M).any(axis=-1)
    if not far.any():
        return replace(motion, position=position)
    cause = f"position more than {_FARTHEST_M // 1000} km from the others"
    return replace(
        motion,
        position=np.where(far[..., None], np.nan, position),
        dropped=motion.dropped | {cause: int(far.sum())},
    )
