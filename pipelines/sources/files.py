"""Readers of the files that a manifest names for one flight, in the axes and at the times of the files."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.session.errors import DataError
from pipelines.session.manifest import Camera, Flight, KeypointSource, TruthJoints
from pipelines.session.records import CalibratedCamera, Detections, JointMotion, VideoIndex
from pipelines.session.registries import (
    FORMATS,
    CalibrationFormat,
    JointFormat,
    KeypointFormat,
    VideoFormat,
    recognise,
)
from pipelines.session.urls import located
from pipelines.sources.world import losses

_FARTHEST_M = 10_000  # in any flight a person's joints are closer to their median than this
_LARGEST_M = 1e8  # metric grids have coordinates up to 1e7


class FlightFiles:
    """Reader of the files of one flight; each calibration is read once."""

    def __init__(self, flight: Flight, base: Path) -> None:
        self._flight = flight
        self._base = base
        self._calibrations: dict[str, dict[str, CalibratedCamera]] = {}

    def keypoints(self, source: KeypointSource) -> tuple[Detections, str]:
        """Read the keypoints that the manifest gives for a camera; return them with their format's name."""
        path = located(self._base, source.path)
        if source.format:
            reader = FORMATS.get(source.format)
            if not isinstance(reader, KeypointFormat):
                raise DataError(
                    path, f"{source.format} is no keypoint format", "leave `format:` out", code="wrong-kind"
                )
        else:
            reader = recognise(path, KeypointFormat, "keypoint file")
        detections = reader.read_keypoints(path, skeleton=source.skeleton, first_frame=source.first_frame)
        if not len(detections.frame):
            raise DataError(path, "holds no keypoints", "run the detector again, or leave the camera out")
        if source.image_size:
            detections = replace(detections, image_size=(source.image_size[0], source.image_size[1]))
        return detections, reader.name

    def video(self, camera: Camera) -> VideoIndex | None:
        """Return the index of a camera's video file; None if it has none."""
        if camera.video is None or camera.video.path is None:
            return None
        path = located(self._base, camera.video.path)
        return recognise(path, VideoFormat, "video").index(path)

    def camera(self, name: str, path: str, camera: str | None) -> CalibratedCamera:
        """Return the camera that is asked for, or the one of this name, or the only one of the file."""
        if path not in self._calibrations:
            file = located(self._base, path)
            self._calibrations[path] = recognise(file, CalibrationFormat, "calibration").read_calibration(
                file
            )
        cameras = self._calibrations[path]
        if camera is None and name not in cameras and len(cameras) == 1:
            return next(iter(cameras.values()))
        if (camera or name) not in cameras:
            listed = ", ".join(sorted(cameras)[:20])
            raise DataError(
                located(self._base, path),
                f"holds no camera {camera or name!r} (there are {listed})",
                "say which with {path: ..., camera: ...}",
                code="no-such-name",
            )
        return cameras[camera or name]

    def true_joints(self, source: TruthJoints) -> JointMotion:
        """Read the true joints; drop and count positions too far from the others to be true.

        Raises:
            DataError: the file cannot be used, its axes are unknown, or no position is left.
        """
        path = located(self._base, source.path)
        named = FORMATS.get(source.format) if source.format else None
        reader = named or recognise(path, JointFormat, "file of true joints")
        if not isinstance(reader, JointFormat):
            raise DataError(
                path, f"{source.format} holds no joints", "leave `format:` out", code="wrong-kind"
            )
        if source.axes is None and self._flight.world.frame == "ned":
            raise DataError(
                path,
                "has joints of unknown axes in a NED world",
                "say truth: {joints: {axes: ned}} or z-up, y-up",
                code="axes-unknown",
            )
        is_ned = source.axes == "ned"
        motion = reader.read_joints(path, unit=source.unit, axes="z-up" if is_ned else source.axes)
        if is_ned:
            motion = replace(motion, position=motion.position[..., [1, 0, 2]] * [1, 1, -1])
        motion = _without_far_joints(motion)
        if not np.isfinite(motion.position).any():
            lost = f" ({losses(motion.dropped)})" if motion.dropped else ""
            raise DataError(
                path, f"holds no position of a joint{lost}", "check what wrote it", code="no-positions"
            )
        return replace(motion, t_ns=motion.t_ns + round(source.offset_s * 1e9))


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
