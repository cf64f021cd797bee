"""Export of videos that show the skeleton over every picture of a camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from pipelines.formats.videos.video_writing import TICK_S, write_h264
from pipelines.geometry.arrays import Int64, Picture
from pipelines.geometry.joint_angles import ANGLES
from pipelines.session.errors import DataError
from pipelines.session.records import Recording

_TICK_NS = int(TICK_S * 10**9) + 1


@dataclass(frozen=True)
class OverlayExport:
    """Videos CAMERA.overlay.mp4, with the chosen joint angles beside their joints."""

    angles: tuple[str, ...] = ()
    name: str = "overlay"
    title: str = "the skeleton over every picture (MP4); overlay:left_knee+right_elbow adds joint angles"

    def configured(self, argument: str) -> OverlayExport:
        """Return the export that writes angles, which are named with `+` between them.

        Raises:
            DataError: there is no such angle.
        """
        return replace(self, angles=tuple(dict.fromkeys(map(_angle_named, argument.split("+")))))

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the video of every camera that has pictures.

        Raises:
            DataError: there is no skeleton, or no camera has pictures.
        """
        if recording.motion is None:
            raise DataError(
                recording.name,
                "holds no skeleton to draw",
                "run `mocap reconstruct` first",
                code="nothing-reconstructed",
            )
        written = []
        for camera in recording.cameras:
            film = recording.film(camera, self.angles, recording.progress)
            if film is not None:
                written.append(folder / f"{camera}.overlay.mp4")
                _write_video(written[-1], *film)
        if not written:
            raise DataError(
                recording.name,
                "has no pictures to draw on",
                "state the cameras' `video` in flight.yaml, and ingest it",
                code="no-pictures",
            )
        return sorted(written)


def _angle_named(words: str) -> str:
    """Return the angle of that name, or the main one of a joint: left_knee is left_knee_flexion."""
    endings = ("", "_flexion", "_dorsiflexion", "_elevation", "_pronation")
    name = next((words + end for end in endings if words + end in ANGLES), None)
    if name is None:
        raise DataError(
            "overlay", f"there is no angle {words!r}", f"there are {', '.join(ANGLES)}", code="no-such-name"
        )
    return name


def _write_video(path: Path, t_ns: Int64, pictures: Iterator[Picture]) -> None:
    """Write pictures of any size in the even size of the first, with their times since the first."""
    import cv2

    first = next(pictures)
    height, width = (side + side % 2 for side in first.shape[:2])

    def even() -> Iterator[Picture]:
        for picture in chain([first], pictures):
            down, right = height - picture.shape[0], width - picture.shape[1]
            if down in (0, 1) and right in (0, 1):
                yield np.pad(picture, ((0, down), (0, right), (0, 0)), mode="edge")
            else:  # the pictures of a log may change their size
                yield np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    # Two stamps must not share a tick of the video: the later one moves by as little as possible.
    least = np.arange(len(t_ns)) * _TICK_NS
    pts_ns = np.maximum.accumulate(t_ns - t_ns[0] - least) + least
    write_h264(path, even(), pts_ns, width=width, height=height)


EXPORT = OverlayExport()
