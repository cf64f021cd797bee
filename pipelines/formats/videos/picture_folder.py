"""Pictures of a folder as a video: JPEG or PNG, numbered by their names, with the times of their EXIF."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import numpy as np

from pipelines.formats.common.exif import picture_files, picture_times, read_tags
from pipelines.geometry.arrays import Int64, Picture
from pipelines.session.errors import DataError
from pipelines.session.records import VideoIndex

_MOST_PIXELS = 1 << 27  # as of videos
UNTIMED = "pictures without times"
"""Codec of an index whose stamps only count the pictures, because EXIF has no times or they do not rise."""
SHARED_SECONDS = "pictures of whole seconds"
"""Codec of an index with several pictures in each second of EXIF, which are spread evenly over it."""
_SAID = {
    UNTIMED: "none in EXIF",
    SHARED_SECONDS: "EXIF, whole seconds; pictures of one second are spread evenly over it",
}


class PictureFolder:
    """Reader of folders of which at least half of the files are pictures of one size."""

    name = "pictures"
    title = "sequence of pictures"
    suffixes: tuple[str, ...] = ("",)

    def recognises(self, path: Path) -> bool:
        """Return True for a folder with two pictures or more."""
        return path.is_dir() and bool(picture_files(path))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe pictures, times and size."""
        index = self.index(path)
        return {
            "frames": index.count,
            "times": _SAID.get(index.codec, "EXIF"),
            "span_s": None if index.codec == UNTIMED else index.span_s,
            "picture": f"{index.width} x {index.height} px",
        }

    def index(self, path: Path) -> VideoIndex:
        """Read the time of every picture; without rising times, the stamps count pictures as seconds."""
        with FolderPictures(path) as pictures:
            first = pictures.read(0)
            times, shared = taken_ns(path)
        if first is None:
            raise DataError(
                path,
                "has a first picture that cannot be decoded",
                "take it out of the folder",
                code="damaged",
            )
        stamps = times if times is not None else np.arange(len(pictures.files), dtype=np.int64) * 10**9
        return VideoIndex(
            pts_ns=stamps - stamps[0],
            start_ns=int(stamps[0]),
            width=first.shape[1],
            height=first.shape[0],
            rotation_deg=0,
            codec=UNTIMED if times is None else SHARED_SECONDS if shared else "pictures",
            variable=times is not None,
        )


def taken_ns(path: Path) -> tuple[Int64 | None, bool]:
    """Return when each picture of a folder was taken, ns, and True if some share a second (`picture_times`).

    The times are None if a picture has none or they do not rise.
    """
    t_ns, shared = picture_times([read_tags(file) for file in picture_files(path)])
    return (t_ns if t_ns.all() and (np.diff(t_ns) > 0).all() else None), shared


class FolderPictures:
    """Pictures of a folder, by number."""

    def __init__(self, path: Path) -> None:
        self.files = picture_files(path)
        if not self.files:
            raise DataError(
                path, "is no folder of pictures", "name the folder that holds them", code="wrong-kind"
            )
        self._size: tuple[int, ...] | None = None

    def __enter__(self) -> Self:
        """Return the pictures themselves."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close nothing: no file stays open."""

    def read(self, number: int) -> Picture | None:
        """Read one picture, BGR, upright by its EXIF; None if it cannot be decoded or has another size."""
        import cv2
        from PIL import Image

        if not 0 <= number < len(self.files):
            return None
        try:
            content = np.fromfile(self.files[number], dtype=np.uint8)
            # The header tells the size: OpenCV takes gigabytes for a picture of a few bytes.
            with _silence(), Image.open(self.files[number]) as header:
                small = math.prod(header.size) <= _MOST_PIXELS
            picture = cv2.imdecode(content, cv2.IMREAD_COLOR) if small else None
        except (OSError, ValueError, SyntaxError, cv2.error, Image.DecompressionBombError):
            return None
        if picture is None:
            return None
        self._size = self._size or picture.shape
        return np.asarray(picture, np.uint8) if picture.shape == self._size else None

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[tuple[int, Picture]]:
        """Yield number and picture of every `step`-th that can be decoded, from `start` to before `stop`."""
        for number in range(start, len(self.files) if stop is None else min(stop, len(self.files)), step):
            picture = self.read(number)
            if picture is not None:
                yield number, picture


@contextmanager
def _silence() -> Iterator[None]:
    """Keep Pillow's warnings of damaged tags and of large pictures off the terminal."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


FORMAT = PictureFolder()
