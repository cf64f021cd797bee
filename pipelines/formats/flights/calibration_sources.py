"""Calibration of a camera from the source in its manifest, fitted to the size of its pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.formats.flights.flight_logs import FlightLogs
from pipelines.geometry.cameras import Intrinsics, fit_to_size
from pipelines.session.errors import DataError
from pipelines.session.manifest import Camera, IntrinsicsSource
from pipelines.session.records import CalibratedCamera, Detections, VideoIndex
from pipelines.session.registries import CalibrationFormat, recognise

# Shares of keypoints. Detectors extrapolate people whom the border cuts, to all sides alike. But if the
# pictures have another size, keypoints lie beyond the right and the lower border only: all begin at 0.
_LARGEST_SHARE_BEYOND = 0.2
_LARGEST_SHARE_OUTSIDE = 0.5


class CalibrationSources:
    """Reader of the calibrations of one flight; each file is read once.

    Args:
        manifest: the path of the manifest.
        logs: of the flight.
        note: receives each doubt, one line each.
    """

    def __init__(self, manifest: Path, logs: FlightLogs, note: Callable[[str], None]) -> None:
        self._manifest = manifest
        self._base = manifest.parent
        self._logs = logs
        self._note = note
        self._read: dict[str, dict[str, CalibratedCamera]] = {}

    def intrinsics(
        self, name: str, camera: Camera, video: VideoIndex | None, detections: Detections | None
    ) -> Intrinsics:
        """Return the intrinsics of a camera, fitted to the size of its pictures.

        Raises:
            DataError: missing, for pictures of another shape, or too small for the keypoints.
        """
        source = camera.intrinsics
        place = f"{self._manifest}: cameras.{name}.intrinsics"
        if source.path:
            calibrated = self.camera(name, source.path, source.camera)
            if calibrated.intrinsics is None:
                raise DataError(
                    self._base / source.path, "holds poses but no intrinsics", "name one with both"
                )
            intrinsics = calibrated.intrinsics
        elif source.log:
            intrinsics = self._logs.intrinsics(source.log, source.topic).intrinsics
        else:
            intrinsics = _inline_intrinsics(source, place)
        if source.readout_s:
            intrinsics = replace(intrinsics, readout_s=source.readout_s)
        if size := self._picture_size(camera, video, detections):
            try:
                intrinsics, note = fit_to_size(intrinsics, *size)
            except ValueError as error:
                remedy = "give the calibration that belongs to these pictures"
                raise DataError(place, str(error), remedy) from None
            if note:
                self._note(f"{name}: {note}")
        if detections is not None:
            _refuse_keypoints_outside(place, intrinsics, detections)
        return intrinsics

    def _picture_size(
        self, camera: Camera, video: VideoIndex | None, detections: Detections | None
    ) -> tuple[int, int] | None:
        """Return the size of the pictures themselves, or the size that the keypoints file gives."""
        if video is not None:
            return video.width, video.height
        logged = camera.video.log if camera.video else None
        if camera.video and logged and (size := self._logs.picture_size(logged, camera.video.topic)):
            return size
        return detections.image_size if detections else None

    def camera(self, name: str, path: str, camera: str | None) -> CalibratedCamera:
        """Return the camera that is asked for, or the one of this name, or the only one of the file."""
        if path not in self._read:
            file = self._base / path
            self._read[path] = recognise(file, CalibrationFormat, "calibration").read_calibration(file)
        cameras = self._read[path]
        if camera is None and name not in cameras and len(cameras) == 1:
            return next(iter(cameras.values()))
        if (camera or name) not in cameras:
            listed = ", ".join(sorted(cameras)[:20])
            raise DataError(
                self._base / path,
                f"holds no camera {camera or name!r} (there are {listed})",
                "say which with {path: ..., camera: ...}",
            )
        return cameras[camera or name]


def _inline_intrinsics(source: IntrinsicsSource, place: str) -> Intrinsics:
    # A fisheye without coefficients is the equidistant projection, as in calibration files, not a pinhole.
    coefficients = tuple(source.distortion) or ((0.0,) * 4 if source.model == "fisheye" else ())
    try:
        return Intrinsics(
            width=source.width or 0,
            height=source.height or 0,
            fx=source.fx or 0.0,
            fy=source.fy or 0.0,
            cx=source.cx or 0.0,
            cy=source.cy or 0.0,
            model=source.model if coefficients else "none",
            distortion=coefficients,
        )
    except ValueError as error:
        raise DataError(place, str(error), "mend the numbers") from None


def _refuse_keypoints_outside(place: str, intrinsics: Intrinsics, detections: Detections) -> None:
    """Refuse a calibration for pictures of another size, if too many keypoints lie outside its picture.

    Keypoints are weighted by confidence: those that a detector extrapolates beyond the border have little.
    """
    found = ~np.isnan(detections.xy[..., 0])
    xy, weight = detections.xy[found], np.maximum(detections.confidence[found], 0.0)
    if not len(xy):
        return
    weight = weight if weight.any() else np.ones(len(weight))
    beyond = (xy > [intrinsics.width - 0.5, intrinsics.height - 0.5]).any(axis=-1)
    outside = beyond | (xy < -0.5).any(axis=-1)
    share_beyond, share_outside = (float(np.average(which, weights=weight)) for which in (beyond, outside))
    if share_beyond > _LARGEST_SHARE_BEYOND or share_outside > _LARGEST_SHARE_OUTSIDE:
        (left, top), (right, bottom) = np.percentile(xy[outside], [1, 99], axis=0)
        raise DataError(
            place,
            f"is for {intrinsics.width}x{intrinsics.height} pictures, but {share_outside:.0%} of the"
            f" keypoints lie outside (those from x = {left:.0f}, y = {top:.0f} to x = {right:.0f},"
            f" y = {bottom:.0f})",
            "give the calibration of these pictures, or their size with keypoints: {image_size: [W, H]}",
        )
