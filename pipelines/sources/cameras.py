"""Pictures of a camera: the times at which they were taken, and intrinsics for their size."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.formats.videos.frame_times import read_frame_times, times_of_frames
from pipelines.formats.videos.picture_folder import taken_ns
from pipelines.formats.videos.video import black_bars, created_ns
from pipelines.geometry.arrays import FAR_OFF_CENTRE, Int64, Intrinsics
from pipelines.geometry.cameras import fit_to_size, is_resized
from pipelines.session.description import MediaEntry
from pipelines.session.errors import DataError
from pipelines.session.manifest import CameraSources, FrameTimes, IntrinsicsSource
from pipelines.session.records import SHARED_SECONDS, UNTIMED, Detections, VideoIndex
from pipelines.session.storage import is_folder
from pipelines.session.urls import media_path
from pipelines.sources.files import FlightFiles
from pipelines.sources.logs import FlightLogs
from pipelines.sources.parts import CameraFrames

# So many frames last 18 hours at 30 Hz: a larger number was misread from a date.
MAX_FRAMES = 2_000_000

# Containers round stamps to 1 ms, which at 240 Hz is a quarter of the interval.
_EVEN = 0.25

# Shares of keypoints. Detectors extrapolate people whom the border cuts, to all sides alike. But if the
# pictures have another size, keypoints lie beyond the right and the lower border only: all begin at 0.
MAX_SHARE_BEYOND = 0.2

# A person whom the border cuts has half of the joints outside at most.
MAX_SHARE_OUTSIDE = 0.5


TriggerTimes = Callable[[CameraSources], Int64 | None]
"""Reader of the trigger times of a camera's pictures in a drone's own log, at world times; None without."""


@dataclass(frozen=True)
class FlightCameras:
    """Reader of frame times and intrinsics; `triggers` reads the times of a drone's own log."""

    manifest: Path
    logs: FlightLogs
    files: FlightFiles
    triggers: TriggerTimes
    note: Callable[[str], None]

    def frames(
        self, name: str, camera: CameraSources, video: VideoIndex | None, detections: Detections | None
    ) -> CameraFrames:
        """Read the time at which each picture was taken; DataError: no usable source of times."""
        offset_ns = camera.clock.offset_ns if camera.clock else 0
        unclocked = self._unclocked_frames(name, camera, video, detections)
        return replace(unclocked, t_ns=unclocked.t_ns + offset_ns)

    def _unclocked_frames(
        self, name: str, camera: CameraSources, video: VideoIndex | None, detections: Detections | None
    ) -> CameraFrames:
        times = camera.frame_times or FrameTimes()
        pictures = None
        if video is not None:
            pictures = CameraFrames(np.arange(video.count), video.pts_ns, video.pts_ns, dropped=video.dropped)
        elif camera.video is not None:
            pictures = self.logs.frames(camera.video.file, camera.video.topic)
        for line in video.notes if video is not None else ():
            self.note(f"{name}: {line}")
        if times.fps is not None:
            taken = np.arange(len(pictures.t_ns) if pictures else self._listed_frames(camera, detections))
            if video is not None:
                taken = _numbers_as_taken(video.pts_ns)
            if lost_count := int(taken[-1]) + 1 - len(taken):
                self.note(f"{name}: {lost_count} pictures are missing by its stamps; fps counts them, too")
            # Python's integers never overflow.
            since_start = np.array([round(k * 10**9 / times.fps) for k in taken.tolist()], dtype=np.int64)
            topic, lost = (pictures.topic, pictures.dropped) if pictures else (None, {})
            start_ns = self._start_ns(name, camera, times)
            return CameraFrames(np.arange(len(taken)), start_ns + since_start, since_start, topic, lost)
        if times.file and self.files.is_log("frame_times", times):
            stamped = self.logs.frames(times.file, times.topic)
            return self._frames_by_stamps(stamped.t_ns, stamped.dropped, pictures)
        if times.file:
            triggered = self.triggers(camera)
            if triggered is not None:
                return self._frames_by_stamps(triggered, {}, pictures)
            return self._frames_of_file(self.files.path(times.file), pictures)
        if pictures is None:
            problem = f"cameras.{name}: nothing says when its frames were taken"
            remedy = "write frame_times: {start: SECONDS, fps: 30}"
            raise DataError(self.manifest, problem, remedy, code="clock-unknown")
        if video is not None and video.codec == UNTIMED:
            problem = (
                f"cameras.{name}: its pictures have no times of their own that rise from one to the next"
            )
            remedy = "write frame_times: {start: SECONDS, fps: 30}, or give a csv"
            raise DataError(self.manifest, problem, remedy, code="clock-unknown")
        if video is not None and video.codec == SHARED_SECONDS and camera.clock is None:
            self.note(
                f"{name}: several of its pictures share a second in EXIF and are spread evenly over it: say"
                " clock: {sigma_s: 1}"
            )
        if video is not None:
            return replace(pictures, t_ns=self._start_ns(name, camera, times) + pictures.pts_ns)
        if times.has_start:
            problem = f"cameras.{name}.frame_times: start has no use, the log stamps its pictures"
            remedy = "leave it out, or correct the log's clock with logs: {...: {clock: ...}}"
            raise DataError(self.manifest, problem, remedy, code="stated-twice")
        return pictures

    def _listed_frames(self, camera: CameraSources, detections: Detections | None) -> int:
        if detections is None or camera.keypoints is None:
            problem = "a camera without video and keypoints has no frames"
            raise DataError(self.manifest, problem, "give it one of them", code="no-pictures")
        count = int(detections.frames_listed[-1]) + 1
        if count > MAX_FRAMES:
            problem = f"numbers its frames up to {count - 1}"
            remedy = "say with first_frame which number the first frame bears"
            raise DataError(self.files.path(camera.keypoints.file), problem, remedy, code="bad-value")
        return count

    def _frames_of_file(self, path: Path, pictures: CameraFrames | None) -> CameraFrames:
        stamps = read_frame_times(path)
        if pictures is None:
            since_start = stamps.t_ns - stamps.t_ns[0]
            return CameraFrames(stamps.frame, stamps.t_ns, since_start, dropped=stamps.dropped)
        t_ns, known = times_of_frames(stamps, pictures.pts_ns)
        if not known.any():
            problem = "has a time for none of the pictures"
            raise DataError(path, problem, "check that they belong together", code="clock-unknown")
        lost = Counter(pictures.dropped) + Counter(stamps.dropped)
        lost["without a time"] += int((~known).sum())
        if stamps.media_ns is None:  # a row for each coded picture has more than a decoder gives
            lost["time without a picture"] += int(np.count_nonzero(stamps.frame >= len(known)))
        return pictures.some(known, t_ns[known], lost)

    def _start_ns(self, name: str, camera: CameraSources, times: FrameTimes) -> int:
        """Return the start of a video that has stamps of its own."""
        if isinstance(times.start_ns, int):
            return times.start_ns
        path = self.files.video_file(camera)
        made_ns = _made_ns(path) if path is not None else None
        if made_ns is None:
            problem = "does not say when it was made"
            remedy = f"write frame_times: {{start: SECONDS}} for camera {name}"
            raise DataError(path or self.manifest, problem, remedy, code="clock-unknown")
        if camera.clock is None and path is not None and not is_folder(path):
            self.note(
                f"{name}: its video says that it was made at {made_ns / 1e9:.0f} s, to a second at best:"
                " say clock: {sigma_s: 1}"
            )
        return made_ns

    def _frames_by_stamps(
        self, t_ns: Int64, dropped: dict[str, int], pictures: CameraFrames | None
    ) -> CameraFrames:
        """Assign the frame times of a log to the frames of a video, in the same order."""
        if pictures is None:
            since_start = t_ns - t_ns[0]
            return CameraFrames(np.arange(len(since_start)), t_ns, since_start, dropped=dropped)
        count = min(len(pictures.t_ns), len(t_ns))
        lost = Counter(pictures.dropped) + Counter(dropped)
        lost["without a stamp in the log"] += len(pictures.t_ns) - count
        lost["stamp in the log without a picture"] += len(t_ns) - count
        return pictures.some(slice(count), t_ns[:count], lost)

    def media(self, camera: CameraSources, frames: CameraFrames, session: Path) -> MediaEntry | None:
        """Return the paths of the pictures relative to the session, which moves together with its flight."""
        video = camera.video
        if video is None:
            return None
        is_log = self.files.is_log("video", video)
        stated = self.logs.settings(video.file).file
        return MediaEntry(
            paths=[media_path(self.manifest.parent, path, session) for path in stated],
            sources=stated,
            topic=frames.topic,
            stamps=self.logs.settings(video.file).stamps if is_log else "header",
        )

    def intrinsics(
        self, name: str, camera: CameraSources, video: VideoIndex | None, detections: Detections | None
    ) -> Intrinsics:
        """Return a camera's intrinsics, fitted to its pictures; DataError: missing, or another shape."""
        source = camera.intrinsics
        place = f"{self.manifest}: cameras.{name}.intrinsics"
        if source.file and not self.files.is_log("intrinsics", source):
            path = self.files.path(source.file)
            calibrated = self.files.camera(name, "intrinsics", source)
            if calibrated.intrinsics is None:
                problem = "holds poses but no intrinsics"
                raise DataError(path, problem, "name one with both", code="no-intrinsics")
            intrinsics = calibrated.intrinsics
            if calibrated.note:
                self.note(f"{name}: {calibrated.note}")
            if not calibrated.size_stated:
                size = self._picture_size(camera, video, detections)
                intrinsics = _with_size(intrinsics, size, path)
                self.note(f"{name}: its calibration states no picture size; that of its pictures is taken")
        elif source.file:
            intrinsics = self.logs.intrinsics(source.file, source.topic)
        else:
            intrinsics = _inline_intrinsics(source, place)
        if intrinsics.off_centre > FAR_OFF_CENTRE:
            self.note(
                f"{name}: its principal point {intrinsics.cx:.0f}, {intrinsics.cy:.0f} px is far from the"
                f" middle of {intrinsics.width} x {intrinsics.height} px, as of a part of a sensor, or of the"
                " calibration of another size"
            )
        if source.readout_s:
            intrinsics = replace(intrinsics, readout_s=source.readout_s)
        if size := self._picture_size(camera, video, detections):
            bars = (0, 0, 0, 0)
            file = self.files.video_file(camera)
            if file is not None and not is_folder(file) and not is_resized(intrinsics, *size):
                bars = black_bars(file)
            try:
                intrinsics, note = fit_to_size(intrinsics, *size, bars)
            except ValueError as error:
                remedy = "give the calibration that belongs to these pictures"
                raise DataError(place, str(error), remedy, code="wrong-size") from None
            if note:
                self.note(f"{name}: {note}")
        if detections is not None:
            _refuse_keypoints_outside(place, intrinsics, detections)
        return intrinsics

    def _picture_size(
        self, camera: CameraSources, video: VideoIndex | None, detections: Detections | None
    ) -> tuple[int, int] | None:
        """Return the size of the pictures themselves, or the size that the keypoints file gives."""
        if video is not None:
            return video.width, video.height
        logged = camera.video
        if logged and self.files.is_log("video", logged):
            size = self.logs.picture_size(logged.file, logged.topic)
            if size:
                return size
        return detections.image_size if detections else None


def _numbers_as_taken(pts_ns: Int64) -> Int64:
    """Number pictures [N] as they were taken, from 0, lost ones among them; by even stamps alone."""
    steps_ns = np.diff(pts_ns)
    usual_ns = max(float(np.median(steps_ns)), 1.0) if len(steps_ns) else 1.0
    counts = np.rint(steps_ns / usual_ns).astype(np.int64)
    if (counts < 1).any() or (np.abs(steps_ns - counts * usual_ns) > _EVEN * usual_ns).any():
        return np.arange(len(pts_ns))
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _made_ns(path: Path) -> int | None:
    if not is_folder(path):
        return created_ns(path)
    times, _ = taken_ns(path)
    return None if times is None else int(times[0])


def _with_size(intrinsics: Intrinsics, size: tuple[int, int] | None, source: Path) -> Intrinsics:
    """Give intrinsics of a calibration without a size that of the pictures, if they can belong together."""
    if size is None:
        problem = "states no picture size, and no video does"
        raise DataError(source, problem, "add the size to the calibration", code="wrong-size")
    sized = replace(intrinsics, width=size[0], height=size[1])
    if sized.off_centre > FAR_OFF_CENTRE:
        problem = (
            f"has its principal point at {intrinsics.cx:.0f}, {intrinsics.cy:.0f} px, which is not the middle"
            f" of pictures of {size[0]} x {size[1]} px"
        )
        remedy = "give the calibration of these pictures, or the size of its own"
        raise DataError(source, problem, remedy, code="wrong-size")
    return sized


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
        raise DataError(place, str(error), "mend the numbers", code="bad-value") from None


def _refuse_keypoints_outside(place: str, intrinsics: Intrinsics, detections: Detections) -> None:
    """Refuse a calibration for pictures of another size, if too many keypoints lie outside its picture."""
    found = ~np.isnan(detections.xy[..., 0])
    xy, weight = detections.xy[found], np.maximum(detections.confidence[found], 0.0)
    if not len(xy):
        return
    weight = weight if weight.any() else np.ones(len(weight))
    beyond = (xy > [intrinsics.width - 0.5, intrinsics.height - 0.5]).any(axis=-1)
    outside = beyond | (xy < -0.5).any(axis=-1)
    share_beyond, share_outside = (float(np.average(which, weights=weight)) for which in (beyond, outside))
    if share_beyond > MAX_SHARE_BEYOND or share_outside > MAX_SHARE_OUTSIDE:
        (left, top), (right, bottom) = np.percentile(xy[outside], [1, 99], axis=0)
        problem = (
            f"is for {intrinsics.width}x{intrinsics.height} pictures, but {share_outside:.0%} of the"
            f" keypoints lie outside (those from x = {left:.0f}, y = {top:.0f} to x = {right:.0f},"
            f" y = {bottom:.0f})"
        )
        remedy = "give the calibration of these pictures, or their size with keypoints: {image_size: [W, H]}"
        raise DataError(place, problem, remedy, code="wrong-size")
