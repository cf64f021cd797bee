"""Pictures of a folder as a video: JPEG or PNG, numbered by their names, with the times of their EXIF."""

import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.rows import since_epoch_ns
from pipelines.formats.drone_logs.dji_subtitles import NAMES, DjiRows, telemetry_of_rows
from pipelines.formats.drone_logs.telemetry_rows import DroneLog
from pipelines.geometry.arrays import Float, Int64, Picture
from pipelines.session.errors import DataError
from pipelines.session.records import SHARED_SECONDS, UNTIMED, Telemetry, VideoIndex
from pipelines.session.registries import TelemetryChoice
from pipelines.session.storage import files_in, is_folder

SUFFIXES = (".jpg", ".jpeg", ".png")
# Vehicle and camera, kind of picture (0: scene), and the time.
_OF_AIRSIM = re.compile(r"img_(.+_(\d+))_\d{12,}")
# Cameras write XMP into the first part of a file of this size.
_HEAD = 512 * 1024
# EXIF counts whole seconds.
_SECOND_NS = 1_000_000_000
_TAG = re.compile(rb"(?<![\w/-])drone(?:-dji)?:(\w+)(?:=\"|>)\s*([^\"<]{1,60})")
_EXIF, _GPS = 0x8769, 0x8825
_TAKEN, _OFFSET, _SUBSECOND, _FOCAL_35_MM = 36867, 36881, 37521, 41989


@dataclass(frozen=True)
class Tags:
    """Tags of one picture; `values` has the columns of `NAMES["tags"]` that it states."""

    t_ns: int | None
    values: Mapping[str, float] = field(default_factory=dict)
    focal_35_mm: float | None = None  # focal length as on film 36 mm wide


def picture_files(folder: Path) -> list[Path]:
    """Return the pictures of a folder or pattern, by the numbers in their names; empty for other folders.

    Pictures must be at least half of its files, so that one picture among logs makes no sequence. Depth and
    the like beside the scene of one camera of AirSim are left out.
    """
    try:
        files = [path for path in files_in(folder) if not path.name.startswith(".")]
    except OSError:
        return []
    found = [path for path in files if path.suffix.lower() in SUFFIXES]
    if len(found) < 2 or 2 * len(found) < len(files):
        return []
    scenes = {name for name, kind in cameras_of_airsim(found) if kind == "0"}
    if len(scenes) == 1:
        found = [path for path in found if path.name.startswith(f"img_{min(scenes)}_")]
    return sorted(found, key=lambda path: [(int(part), "") if part.isdecimal() else (-1, part)
                                           for part in re.split(r"(\d+)", path.name)])  # fmt: skip


def cameras_of_airsim(files: Sequence[Path]) -> set[tuple[str, str]]:
    """Return vehicle, camera and kind as AirSim names its pictures, and the kind, of all in these files."""
    return {(match[1], match[2]) for file in files if (match := _OF_AIRSIM.fullmatch(file.stem))}


def patterns_of_airsim(folder: Path) -> list[Path]:
    """Return a pattern for the scene of each camera of AirSim in a folder; empty with less than two."""
    scenes = sorted(name for name, kind in cameras_of_airsim(files_in(folder)) if kind == "0")
    return [folder / f"img_{name}_*" for name in scenes] if len(scenes) > 1 else []


def read_tags(path: Path) -> Tags:
    """Read a picture's tags; one without them, or a damaged one, has none."""
    from PIL import Image

    try:
        with path.open("rb") as file:
            xmp = {name.decode(): text.decode("latin-1") for name, text in _TAG.findall(file.read(_HEAD))}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of damaged tags; the others are taken
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # no picture is decoded here
            with Image.open(path) as picture:
                exif = picture.getexif()
                taken, gps = dict(exif.get_ifd(_EXIF)), dict(exif.get_ifd(_GPS))
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, Image.DecompressionBombError):
        return Tags(None)
    values = _from_gps(gps)
    for column, names in NAMES["tags"].items():
        for name in names:
            number = _number(xmp.get(name))
            if number is not None:
                values[column] = number
    return Tags(_taken_ns(taken), values, _number(taken.get(_FOCAL_35_MM)) or None)


def picture_times(tags: Sequence[Tags]) -> tuple[Int64, bool]:
    """Return the time of each picture, ns [N], 0 where it states none; True if some share a whole second.

    These are spread evenly over it, as many in the first and the last second as usual.
    """
    t_ns = np.array([each.t_ns or 0 for each in tags], dtype=np.int64)
    steps = np.diff(t_ns)
    if not t_ns.all() or (steps > 0).all() or (steps < 0).any() or (t_ns % _SECOND_NS).any():
        return t_ns, False
    _, second, counts = np.unique(t_ns, return_inverse=True, return_counts=True)
    usual = round(float(np.median(counts[1:-1]))) if len(counts) > 2 else int(counts.max())
    room = counts.copy()
    room[[0, -1]] = np.maximum(counts[[0, -1]], usual)
    before = np.arange(len(t_ns)) - (np.cumsum(counts) - counts)[second]  # pictures of the same second
    before += np.where(second == 0, room[0] - counts[0], 0)  # the first second is full at its end
    spread: Int64 = t_ns + (before * _SECOND_NS // room[second]).astype(np.int64)
    return spread, True


def _number(text: object) -> float | None:
    try:
        value = float(str(text))
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _taken_ns(exif: Mapping[int, Any]) -> int | None:
    try:
        taken = datetime.strptime(str(exif[_TAKEN])[:19], "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return None
    digits = re.sub(r"\D", "", str(exif.get(_SUBSECOND, "")))[:9]
    offset = re.fullmatch(r"([+-])(\d\d):(\d\d)", str(exif.get(_OFFSET, "")).strip("\0 "))
    if offset:
        ahead = timedelta(hours=int(offset[2]), minutes=int(offset[3]))
        taken -= ahead if offset[1] == "+" else -ahead
    return since_epoch_ns(taken) + int(digits.ljust(9, "0") or 0)


def _from_gps(gps: Mapping[int, Any]) -> dict[str, float]:
    """Return latitude, longitude and height of EXIF's own GPS tags."""
    values: dict[str, float] = {}
    for column, sign, tag in (("latitude", "S", 1), ("longitude", "W", 3)):
        try:
            degrees, minutes, seconds = (float(part) for part in gps[tag + 1])
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            continue
        angle = degrees + minutes / 60 + seconds / 3600
        if np.isfinite(angle):
            values[column] = -angle if str(gps.get(tag, "")).startswith(sign) else angle
    height = _number(gps.get(6))
    if height is not None:
        below = gps.get(5) in (1, b"\x01")
        values["absolute"] = -height if below else height
    return values


# A larger size in a header is damage and would exhaust the memory, as in videos.
_MOST_PIXELS = 1 << 27
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
        return is_folder(path) and bool(picture_files(path))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe pictures, times and size."""
        index = self.index(path)
        return {
            "frames": index.count,
            "times": _SAID.get(index.codec, "EXIF"),
            "span_s": None if index.codec == UNTIMED else index.span_s,
            "picture": f"{index.width} x {index.height} px",
            **({"notes": list(index.notes)} if index.notes else {}),
        }

    def index(self, path: Path) -> VideoIndex:
        """Read the time of every picture; without rising times, the stamps count pictures as seconds."""
        with FolderPictures(path) as pictures:
            first = pictures.read(0)
            times, shared = taken_ns(path)
        if first is None:
            problem = "has a first picture that cannot be decoded"
            raise DataError(path, problem, "take it out of the folder", code="damaged")
        kept = cameras_of_airsim(pictures.files)
        others = sorted(name for name, _ in cameras_of_airsim(files_in(path)) - kept) if kept else []
        left_out = (f"pictures of AirSim's {', '.join(others)} are left out",) if others else ()
        stamps = times if times is not None else np.arange(len(pictures.files), dtype=np.int64) * 10**9
        return VideoIndex(
            pts_ns=stamps - stamps[0],
            start_ns=int(stamps[0]),
            width=first.shape[1],
            height=first.shape[0],
            rotation_deg=0,
            codec=UNTIMED if times is None else SHARED_SECONDS if shared else "pictures",
            notes=left_out,
        )


def taken_ns(path: Path) -> tuple[Int64 | None, bool]:
    """Return when pictures were taken, ns (None: some lack it or fall), and if some share a second."""
    t_ns, shared = picture_times([read_tags(file) for file in picture_files(path)])
    return (t_ns if t_ns.all() and (np.diff(t_ns) > 0).all() else None), shared


class FolderPictures(AbstractContextManager["FolderPictures"]):
    """Pictures of a folder, by number."""

    def __init__(self, path: Path) -> None:
        self.files = picture_files(path)
        if not self.files:
            problem = "is no folder of pictures"
            raise DataError(path, problem, "name the folder that holds them", code="wrong-kind")
        if len(cameras := sorted(name for name, _ in cameras_of_airsim(self.files))) > 1:
            problem = f"holds pictures of {len(cameras)} cameras of AirSim ({', '.join(cameras)})"
            remedy = f"name those of one: video: {path.name}/img_{cameras[0]}_*"
            raise DataError(path, problem, remedy, code="ambiguous")
        self._size: tuple[int, ...] | None = None

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
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of damaged tags and of large pictures
                with Image.open(self.files[number]) as header:
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


PICTURES = PictureFolder()


# DJI marks a position by RTK with a fix by this number.
_RTK_FIXED = 50
SHARED = "several of its pictures share a second: they are spread evenly over it: let clock.sigma_s be 1"


class PictureTags(DroneLog):
    """Reader of the poses of drones in the pictures of a folder, one for each picture."""

    name = "picture_tags"
    title = "tags of pictures (EXIF, XMP)"
    suffixes: tuple[str, ...] = ("",)
    choices: tuple[str, ...] = ("altitude",)

    def recognises(self, path: Path) -> bool:
        """Return True for a folder of pictures whose first says where it was taken."""
        files = picture_files(path) if is_folder(path) else []
        return "latitude" in (read_tags(files[0]) if files else Tags(None)).values

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read position, and the angles of body and gimbal, of each picture."""
        t_ns, shared, columns = _columns(path)
        if not t_ns.any():
            problem = "has pictures that say where they were taken but not when (no DateTimeOriginal in EXIF)"
            remedy = "name another log of poses, or restore the pictures as the drone wrote them"
            raise DataError(path, problem, remedy, code="clock-unknown")
        notes = ["its clock is the drone's local time, taken as UTC"]
        notes += [SHARED] if shared else []
        fixed = columns["rtk_flag"] == _RTK_FIXED
        if fixed.any():
            across = np.nanmax(np.hypot(columns["rtk_std_latitude"], columns["rtk_std_longitude"]))
            notes.append(
                f"{np.count_nonzero(fixed)} of {len(fixed)} positions are by RTK with a fix, by their own"
                f" account within {across:.3f} m across"
            )
        rows = DjiRows(
            t_ns,
            t_ns != 0,
            columns,
            "the drone's clock",
            names=("flight angles", "gimbal angles"),
            rows="pictures",
            repeats=False,
            level=False,
            notes=notes,
        )
        return telemetry_of_rows(path, rows, choice)


def _columns(path: Path) -> tuple[Int64, bool, dict[str, Float]]:
    """Return times and columns of all pictures, and True if some share a second (`picture_times`)."""
    tags = [read_tags(file) for file in FolderPictures(path).files]
    t_ns, shared = picture_times(tags)
    columns = {name: np.array([each.values.get(name, np.nan) for each in tags]) for name in NAMES["tags"]}
    return t_ns, shared, columns | {"altitude": np.full(len(tags), np.nan)}


PICTURE_TAGS = PictureTags()
