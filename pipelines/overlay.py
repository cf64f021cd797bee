"""Stage `overlay`: videos of the skeleton over every picture of a camera, for a visual check.

Read the skeleton, the cameras' poses and the keypoints of a session; draw them into every picture, block by
block; join the blocks to one video for each camera, with the stamps of its pictures. No other stage reads
the videos. They are removed when the skeleton that they show is replaced.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.formats.videos.video_writing import TICK_S, join_videos, write_h264
from pipelines.geometry.arrays import Int64, Picture
from pipelines.geometry.joint_angles import ANGLES
from pipelines.reporting.frame_drawing import Label, blank_frame, caption_of, draw_frame, padded_to_even
from pipelines.reporting.motion import Motion, motion_from_skeleton
from pipelines.reporting.overlays import FilmedCamera, angles_at, read_filmed, status_at, views_of
from pipelines.session.description import Description, read_description
from pipelines.session.errors import DataError
from pipelines.session.progress import Halt, Progress, Silent, side_by_side
from pipelines.session.stage_records import Stage, StageRecord
from pipelines.session.stages import Run, locked, open_session
from pipelines.session.storage import read_json, write_json
from pipelines.session.stores import is_there
from pipelines.session.tables import ANGLES as ANGLES_TABLE
from pipelines.session.tables import FRAMES, SKELETON, read_table, rows_between
from pipelines.sources.pictures import open_pictures, refuse_changed_pictures

if TYPE_CHECKING:
    import pandas as pd

OVERLAY = Stage("overlay", revision=5)

_BLOCK = 300  # pictures that are drawn and encoded together, and kept after an interrupt
_TICK_NS = int(TICK_S * 10**9) + 1


def write_overlays(
    folder: Path,
    *,
    cameras: Sequence[str] | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    angles: Sequence[str] = (),
    workers: int = 1,
    force: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Write overlay/<camera>.mp4 of a reconstructed session.

    Pictures that cannot be decoded are grey, with a text. Without `cameras`, cameras whose pictures do not
    exist any more are left out, with a note.

    Args:
        cameras: names of cameras; by default all that have pictures.
        start_s: use only pictures at or after this time, in seconds since the flight's first frame.
        end_s: use only pictures before this time.
        angles: names of `geometry.joint_angles.ANGLES`, written beside their joints with their standard
            deviations.
        workers: the number of blocks in parallel; the pictures do not depend on it.
        force: run it again even if nothing changed, and replace a folder that is no overlay.

    Returns:
        The videos, in the order of the session's cameras.

    Raises:
        DataError: the session holds no skeleton or no pictures, or tables that were changed; a named camera
            has no pictures, or they are gone, damaged or not those that were ingested; or something else
            has the name of the folder.
        BusyError: another process writes the session.
    """
    progress = progress or Silent()
    with locked(folder) as session:
        for stage in ("ingest", "detect"):
            session.intact_record(stage)
        record = session.intact_record("reconstruct")
        if record is None:
            raise DataError(
                folder,
                "holds no skeleton to draw",
                "run `mocap reconstruct` first",
                code="nothing-reconstructed",
            )
        description = read_description(folder)
        wanted = _with_pictures(folder, description, cameras)
        _refuse_foreign(folder, force)
        refuse_changed_pictures(folder, description, wanted)

        def begin(names: Sequence[str]) -> Run:
            settings = {"cameras": list(names), "start_s": start_s, "end_s": end_s, "angles": list(angles)}
            inputs = {"reconstruct": record.key}  # which covers all tables that it was made of
            inputs |= {f"pictures of {name}": description.recorded[f"pictures of {name}"] for name in names}
            return session.begin(OVERLAY, settings=settings, inputs=inputs, force=force)

        run = begin(wanted)
        if not run.finished:  # else pictures that are gone by now are not needed
            wanted = _still_there(folder, description, wanted, progress, all_of_them=cameras is not None)
            run = begin(wanted)
        if run.finished:
            return _videos(folder, run.record)
        films = _films(folder, description, record, wanted, (start_s, end_s), progress)
        motion = motion_from_skeleton(read_table(folder / "reconstruct" / "skeleton.parquet", SKELETON))
        method = record.settings["method"]
        table = read_table(folder / "reconstruct" / "angles.parquet", ANGLES_TABLE) if angles else None
        show = _Show(description, motion, method, tuple(angles), table)
        counts = _draw(folder, films, show, run, workers, progress)
        return _videos(folder, run.publish(counts={"method": method, "cameras": counts}))


def angle_named(words: str) -> str:
    """Return the angle of `ANGLES` by its name, or the main one of a joint: left_knee is left_knee_flexion.

    Raises:
        ValueError: there is no such angle.
    """
    main = ("", "_flexion", "_dorsiflexion", "_elevation", "_pronation")
    name = next((words + end for end in main if words + end in ANGLES), None)
    if name is None:
        raise ValueError(f"{words!r} is none of {', '.join(ANGLES)}")
    return name


def refuse_overlays(folder: Path, *, force: bool = False) -> None:
    """Refuse, before hours of work, a session for which `write_overlays` would fail.

    Raises:
        DataError: as in `write_overlays`, except for the skeleton.
    """
    session = open_session(folder)
    description = read_description(folder)
    wanted = _with_pictures(folder, description, None)
    _refuse_foreign(folder, force)
    refuse_changed_pictures(folder, description, wanted)
    if session.record("overlay") is None:
        _still_there(folder, description, wanted, Silent(), all_of_them=False)


def _videos(folder: Path, record: StageRecord) -> list[Path]:
    return [folder / "overlay" / f"{name}.mp4" for name in record.counts["cameras"]]


def _refuse_foreign(folder: Path, force: bool) -> None:
    target = folder / "overlay"
    if target.exists() and not (target / "stage.json").is_file() and not force:
        raise DataError(
            target, "is in the way, and no overlay of mocap's", "move it away, or use --force", code="exists"
        )


# --- which cameras, and which of their pictures --------------------------------------------------------


def _with_pictures(folder: Path, description: Description, cameras: Sequence[str] | None) -> list[str]:
    """List the cameras to draw on, in the session's order."""
    filmed = [name for name, entry in description.cameras.items() if entry.media is not None]
    for name in cameras or ():
        if name not in description.cameras:
            raise DataError(
                name, "no such camera", f"there are {', '.join(description.cameras)}", code="no-such-name"
            )
        if name not in filmed:
            raise DataError(
                name,
                "has no pictures to draw on",
                "state its `video` in flight.yaml, or leave it out",
                code="no-pictures",
            )
    if not filmed:
        raise DataError(
            folder,
            "has no pictures to draw on",
            "state the cameras' `video` in flight.yaml, and ingest it",
            code="no-pictures",
        )
    return [name for name in filmed if cameras is None or name in cameras]


def _still_there(
    folder: Path, description: Description, cameras: Sequence[str], progress: Progress, *, all_of_them: bool
) -> list[str]:
    """List the cameras whose pictures are still where they were at ingest."""
    there, gone = [], []
    for name in cameras:
        media = description.cameras[name].media
        missing = [path for path in media.paths if not is_there(folder, path)] if media else []
        if missing:
            gone.append((name, folder / missing[0]))
        else:
            there.append(name)
    if gone and (all_of_them or not there):
        raise DataError(
            gone[0][1].resolve(),
            f"the pictures of {gone[0][0]} are not there any more",
            "put them back, or ingest them from where they are now",
            code="no-such-file",
        )
    for name, path in gone:
        progress.note(f"{name}: no overlay, its pictures are not there any more ({path.resolve()})")
    return there


@dataclass(frozen=True)
class _Film:
    """The N pictures of a camera that are drawn on."""

    camera: FilmedCamera
    rows: range  # N of the camera's frames
    pts_ns: Int64  # [N] since the first of them
    size: tuple[int, int]  # width, height

    @property
    def blocks(self) -> list[range]:
        """The ranges of the N pictures that are drawn together."""
        count = len(self.rows)
        return [range(first, min(first + _BLOCK, count)) for first in range(0, count, _BLOCK)]


def _films(
    folder: Path,
    description: Description,
    record: StageRecord,
    cameras: Sequence[str],
    span_s: tuple[float | None, float | None],
    progress: Progress,
) -> list[_Film]:
    tables = {name: read_table(folder / "cameras" / name / "frames.parquet", FRAMES) for name in cameras}
    films = []
    for name, camera in read_filmed(folder, description, record, tables).items():
        frames = tables[name]
        rows = rows_between(frames["t_ns"].to_numpy(np.int64) - description.start_ns, *span_s)
        if not rows:
            progress.note(f"{name}: no overlay, none of its pictures lies in the span")
            continue
        pts_ns = frames["pts_ns"].to_numpy(np.int64)[rows.start : rows.stop]
        size = _picture_size(folder, description, camera, rows)
        films.append(_Film(camera, rows, _apart(pts_ns - pts_ns[0]), size))
    if not films:
        raise DataError(
            folder,
            "has no picture in that span",
            "look at `mocap info`, or leave the span out",
            code="no-overlap",
        )
    return films


def _apart(pts_ns: Int64) -> Int64:
    """Move stamps later where two would share a tick of the video, by as little as possible."""
    least = np.arange(len(pts_ns)) * _TICK_NS
    spread: Int64 = np.maximum.accumulate(pts_ns - least) + least
    return spread


def _picture_size(
    folder: Path, description: Description, camera: FilmedCamera, rows: range
) -> tuple[int, int]:
    """Read width and height of the first picture that can be decoded, else those of the calibration."""
    with open_pictures(folder, description, camera.name) as pictures:
        for frame in camera.frame[rows.start : rows.stop].tolist():
            picture = pictures.read(frame)
            if picture is not None:
                return picture.shape[1], picture.shape[0]
    return camera.intrinsics.width, camera.intrinsics.height


def _joint_of(name: str) -> str:
    """Return the joint beside which an angle of `ANGLES` is written; of the trunk it is `hip`."""
    joint = name.rpartition("_")[0]
    return {"trunk": "hip", "left_forearm": "left_wrist", "right_forearm": "right_wrist"}.get(joint, joint)


def _angle_text(name: str, value_deg: float, sigma_deg: float) -> str:
    """Write an angle in ASCII, which is all that OpenCV's letters have."""
    words = name.replace("_", " ")
    if not np.isfinite(value_deg):
        return f"{words}: undetermined"
    spread = f" +/- {sigma_deg:.0f}" if np.isfinite(sigma_deg) else ""
    return f"{words} {round(value_deg)}{spread} deg"  # round: no minus before 0


# --- drawing -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Show:
    """Data that all videos share."""

    description: Description
    motion: Motion
    method: str
    angles: tuple[str, ...] = ()
    table: pd.DataFrame | None = None  # tables.ANGLES; None without angles

    def labels_at(self, t_ns: Int64) -> list[list[Label]]:
        """Write every angle of every person at [N] times."""
        table = self.table
        if table is None:
            return [[] for _ in t_ns]
        values = [angles_at(self.motion, table, name, t_ns) for name in self.angles]
        people = range(self.motion.position.shape[1])
        return [
            [
                (person, _joint_of(name), _angle_text(name, *value[k, person].tolist()))
                for name, value in zip(self.angles, values, strict=True)
                for person in people
            ]
            for k in range(len(t_ns))
        ]


def _draw(
    folder: Path, films: Sequence[_Film], show: _Show, run: Run, workers: int, progress: Progress
) -> dict[str, dict[str, int]]:
    """Draw all blocks and join them to a video for each camera; return the counts of pictures."""
    halt = Halt()
    progress.start("Drawing overlays", sum(len(film.rows) for film in films))

    def draw(item: tuple[_Film, range]) -> Path:
        film, block = item
        produce = partial(_draw_block, folder, film, block, show, halt, progress)
        return run.chunk(f"{film.camera.name}-{block.start}", produce)

    items = [(film, block) for film in films for block in film.blocks]
    parts = side_by_side(draw, items, workers=workers, halt=halt)
    counts = {}
    for film in films:
        name = film.camera.name
        own = [part for (of, _), part in zip(items, parts, strict=True) if of is film]
        join_videos(run.folder / f"{name}.mp4", [part / "part.mp4" for part in own])
        total: Counter[str] = Counter()
        for part in own:
            total.update(read_json(part / "counts.json"))
        counts[name] = dict(total)
        if total["undecoded"]:
            progress.note(
                f"{name}: {total['undecoded']} of {total['frames']} pictures cannot be decoded and are grey"
            )
    return counts


def _draw_block(
    folder: Path,
    film: _Film,
    block: range,
    show: _Show,
    halt: Halt,
    progress: Progress,
    part: Path,
) -> None:
    at = np.array(film.rows[block.start : block.stop])
    status = status_at(show.motion, film.camera.frame_t_ns[at])
    views = views_of(film.camera, at, show.motion, status, show.description.start_ns)
    labels = show.labels_at(film.camera.frame_t_ns[at])
    width, height = film.size
    counts = {
        "frames": len(views),
        "undecoded": 0,
        "without_pose": sum(not view.has_pose for view in views),
    }

    def pictures() -> Iterator[Picture]:
        with open_pictures(folder, show.description, film.camera.name) as source:
            for view, of_joints, own in zip(views, status, labels, strict=True):
                halt.check()
                picture = source.read(view.frame)
                if picture is None:
                    counts["undecoded"] += 1
                    picture = blank_frame(width, height, f"frame {view.frame} cannot be decoded")
                picture = _of_size(picture, width, height)
                caption = caption_of(view, of_joints, show.method)
                yield padded_to_even(draw_frame(picture, view, caption, own))
                progress.advance()

    write_h264(
        part / "part.mp4",
        pictures(),
        film.pts_ns[block.start : block.stop],
        width=width + width % 2,
        height=height + height % 2,
    )
    write_json(part / "counts.json", counts)


def _of_size(picture: Picture, width: int, height: int) -> Picture:
    """Resize a picture: those of a log may change their size, those of a video may not."""
    import cv2

    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
