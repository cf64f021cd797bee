"""Stage `background`: follow the background through the pictures of every moving camera, and keep stills.

Tracks depend on the pictures alone, so they are kept while poses, clocks, keypoints and methods change. The
detector hands over the pictures that it decodes anyway. A camera with imported keypoints is decoded here.

Pictures are followed in blocks, like those of the detector, so that blocks can be worked on side by side and
an interrupted run continues. Every block begins with the last picture of the one before: its points are
others, but that picture binds them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bytes, Int64, Picture
from pipelines.reconstruction.background_tracks import Follower, rows_to_follow, still_name, tracks_path
from pipelines.session.description import Description, read_description
from pipelines.session.errors import DataError
from pipelines.session.parallel import SharedSession, contents_of, each_part, write_contents
from pipelines.session.progress import Progress, Silent
from pipelines.session.stages import Stage, StageRecord, WritableSession
from pipelines.session.storage import hash_of, read_json, write_json
from pipelines.session.tables import FRAMES, TRACKS, join_tables, read_table, rows_between, write_table
from pipelines.sources.pictures import open_pictures, refuse_changed_pictures

BACKGROUND = Stage("background", revision=1)

BLOCK = 300
"""Rows of a camera's frames in a block: ten seconds of work are a small loss."""

# A process takes 2 s to start, in which this one looks at 150 pictures. Fewer than these are not worth it.
MIN_PICTURES_FOR_PROCESSES = 600

# A drone moves on by some metres in this time, so that stills differ enough to compare the ground.
TIME_BETWEEN_STILLS_S = 0.9
# More stills of a long flight fill the session and bind the cameras no better.
MAX_STILLS = 200
# A lower quality blurs the patches of ground that are compared.
JPEG_QUALITY = 85


def cameras_to_follow(description: Description) -> list[str]:
    """List the moving cameras with pictures."""
    return [
        name
        for name, entry in description.cameras.items()
        if entry.media is not None and not entry.poses.static
    ]


@dataclass(frozen=True)
class FollowedBlock:
    """Pictures of a camera that are followed together, by their numbers."""

    camera: str
    first: int  # row of the camera's frames with which it begins
    before: int | None  # last picture of the block before, to be shown first
    numbers: Int64
    stills: Int64  # those that are kept

    @property
    def name(self) -> str:
        """A name by which blocks sort in time."""
        return f"{self.camera}-{self.first:09d}"


class FollowedPart:
    """Background of one block, whose pictures are shown to it in their order.

    Args:
        block: the pictures; others that are shown are left out.
    """

    def __init__(self, block: FollowedBlock) -> None:
        self.block = block
        self._numbers = frozenset(
            [*block.numbers.tolist(), *([] if block.before is None else [block.before])]
        )
        self._follower = Follower()
        self._stills: dict[int, Bytes] = {}
        self._undecoded = 0

    def see(self, number: int, picture: Picture | None) -> None:
        """Follow the points into the next picture; None if it cannot be decoded."""
        import cv2

        if number not in self._numbers:
            return
        grey = None if picture is None else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
        self._follower.step(number, grey)
        if number == self.block.before:
            return
        if grey is None:
            self._undecoded += 1
        elif number in self.block.stills:
            _, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            self._stills[number] = np.asarray(encoded, np.uint8)

    def write(self, folder: Path) -> None:
        """Write tracks and stills."""
        import pandas as pd

        tracks = self._follower.tracks()
        columns = {"frame": tracks.picture, "point": tracks.point, "x": tracks.xy[:, 0], "y": tracks.xy[:, 1]}
        write_table(folder / "tracks.parquet", pd.DataFrame(columns), TRACKS)
        for number, encoded in self._stills.items():
            (folder / still_name(number)).write_bytes(encoded.tobytes())
        points = int(tracks.point.max(initial=-1)) + 1
        counts = {"pictures": len(self.block.numbers), "undecoded": self._undecoded}
        write_json(folder / "counts.json", counts | {"points": points, "stills": len(self._stills)})


def follow_block(order: tuple[SharedSession, FollowedBlock]) -> dict[str, bytes]:
    """Follow through the pictures of a block on a worker; return its files.

    Raises:
        DataError: the worker has no such session or pictures, or others.
    """
    session, block = order
    folder = session.opened()
    part = FollowedPart(block)
    before = [] if block.before is None else [block.before]
    with open_pictures(folder, read_description(folder), block.camera) as pictures:
        for number in before + block.numbers.tolist():
            part.see(number, pictures.read(number))
    with TemporaryDirectory() as place:
        part.write(Path(place))
        return contents_of(Path(place))


class Following:
    """One run of the stage.

    Args:
        session: locked by the caller.
        every: the detector uses only every k-th picture.
        span_s: times between which the detector looks at pictures, None for no bound.
        force: run it again even if nothing changed.

    Raises:
        DataError: no moving camera has pictures, or these are not those that were ingested.
    """

    def __init__(
        self,
        session: WritableSession,
        *,
        every: int = 1,
        span_s: tuple[float | None, float | None] = (None, None),
        force: bool = False,
    ) -> None:
        self._folder = session.folder
        self._description = read_description(session.folder)
        names = cameras_to_follow(self._description)
        if not names:
            raise DataError(
                "the backgrounds",
                "no moving camera has pictures to look at",
                "state their `video`, or leave it out",
                code="no-pictures",
            )
        refuse_changed_pictures(session.folder, self._description, names)
        self._seen = {name: self._looked_at(name, every, span_s) for name in names}
        recorded = self._description.recorded
        inputs = {f"pictures of {name}": recorded[f"pictures of {name}"] for name in names} | {
            f"frames of {name}": hash_of([[block.first, *block.numbers.tolist()] for block in seen])
            for name, seen in self._seen.items()
        }
        self._at = {(name, block.first): block for name, seen in self._seen.items() for block in seen}
        self._kept: set[str] = set()
        self._run = session.begin(BACKGROUND, settings={"cameras": names}, inputs=inputs, force=force)

    def block(self, camera: str, first: int) -> FollowedBlock | None:
        """Return the block of a camera that begins with row `first`; None if it is not followed any more."""
        return None if self._run.finished else self._at.get((camera, first))

    def keep(self, block: FollowedBlock, write: Callable[[Path], None]) -> None:
        """Store a block whose pictures were all seen; `write` puts its files into a folder."""
        self._run.chunk(block.name, write)
        self._kept.add(block.name)

    def finish(
        self, *, workers: int = 1, executor: Executor | None = None, progress: Progress | None = None
    ) -> StageRecord:
        """Follow through the pictures that nobody showed, and publish the stage.

        Args:
            workers: the number of processes of this machine; the result does not depend on it.
            executor: works on the blocks instead of these processes.
            progress: receives the progress.

        Raises:
            DataError: pictures are gone or not those that were ingested.
        """
        progress = progress or Silent()
        if self._run.finished:
            return self._run.record
        blocks = [block for seen in self._seen.values() for block in seen]
        left = sum(len(block.numbers) for block in blocks if block.name not in self._kept)
        if left:
            progress.start("Following backgrounds", left)
        missing = [block for block in blocks if not self._run.has_chunk(block.name)]
        workers = 1 if left < MIN_PICTURES_FOR_PROCESSES else workers
        session = SharedSession.at(self._folder)
        orders = [(session, block) for block in missing]
        with closing(each_part(follow_block, orders, workers=workers, executor=executor)) as found:
            for number, contents in found:
                self.keep(missing[number], partial(write_contents, contents))
                progress.advance(len(missing[number].numbers))
        made = {block.name: self._run.chunk(block.name, _never) for block in blocks}
        counts = {
            name: self._assemble(name, [made[block.name] for block in seen])
            for name, seen in self._seen.items()
        }
        return self._run.publish(counts={"cameras": counts})

    def _looked_at(
        self, camera: str, every: int, span_s: tuple[float | None, float | None]
    ) -> list[FollowedBlock]:
        """List the blocks of a camera's pictures that are followed."""
        frames = read_table(self._folder / "cameras" / camera / "frames.parquet", FRAMES)
        numbers, t_ns = (frames[name].to_numpy(np.int64) for name in ("frame", "t_ns"))
        span, step = range(len(numbers)), 1
        if self._description.cameras[camera].keypoints is None:  # as the detector looks at them
            span, step = rows_between(t_ns - self._description.start_ns, *span_s), every
        rows = np.arange(span.start, span.stop)
        rows = rows[rows % step == 0]
        rows = rows[rows_to_follow(t_ns[rows])]
        stills = np.empty(0, np.int64)
        if len(rows):
            evenly = round((t_ns[rows[-1]] - t_ns[rows[0]]) / 1e9 / TIME_BETWEEN_STILLS_S) + 1
            chosen = np.linspace(0, len(rows) - 1, min(evenly, MAX_STILLS, len(rows)))
            stills = rows[np.round(chosen).astype(np.int64)]
        blocks = []
        for first in span[::BLOCK]:
            begin, end = np.searchsorted(rows, (first, min(first + BLOCK, span.stop))).tolist()
            own = rows[begin:end]
            before = int(numbers[rows[begin - 1]]) if begin and len(own) else None
            blocks.append(
                FollowedBlock(camera, first, before, numbers[own], numbers[np.intersect1d(own, stills)])
            )
        return blocks

    def _assemble(self, camera: str, parts: Iterable[Path]) -> dict[str, int]:
        """Join the parts of a camera; return their counts."""
        total = {"pictures": 0, "undecoded": 0, "points": 0, "stills": 0}
        folder = self._run.folder / camera
        (folder / "stills").mkdir(parents=True)

        def tables() -> Iterable[Any]:
            for part in parts:
                table = read_table(part / "tracks.parquet", TRACKS)
                yield table.assign(point=table["point"] + total["points"])
                for still in sorted(part.glob("*.jpg")):
                    (folder / "stills" / still.name).write_bytes(still.read_bytes())
                counts: Mapping[str, int] = read_json(part / "counts.json")
                for name in total:
                    total[name] += counts[name]

        join_tables(tracks_path(folder), tables(), TRACKS)
        return total


def _never(place: Path) -> None:
    raise RuntimeError(f"{place} was finished before")
