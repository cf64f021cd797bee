"""Stages `detect` and `background`: people and background in the pictures.

Pictures are taken in blocks of fixed length, so that blocks can be worked on side by side and an interrupted
run continues with those that are missing; the result depends on neither. People are followed from the start
of each block. The background of a block begins with the last picture of the one before, which binds them.

Keypoints are kept as long as the pictures, the detector and the actor's log are the same. Other clocks change
their times only. Other poses, clocks and calibrations also change where the actor is looked for, a little;
`hints_from` in `stage.json` says with which of them the keypoints were found.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import local
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.geometry.arrays import Float, Int64, Picture
from pipelines.keypoints.search import Hint, actor_hints
from pipelines.keypoints.tracking import PeopleTracker
from pipelines.reconstruction.background_tracks import Follower, rows_to_follow, still_name, tracks_path
from pipelines.session.description import Description, MediaEntry, read_description
from pipelines.session.errors import DataError
from pipelines.session.parallel import SharedSession, contents_of, each_part, write_contents
from pipelines.session.people import logged_people
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import Detections
from pipelines.session.registries import Detector, KeypointNetworks, find_detector, hashes_of_models
from pipelines.session.stages import Run, Stage, StageRecord, WritableSession
from pipelines.session.storage import hash_of, read_json, write_json
from pipelines.session.tables import (
    FRAMES,
    KEYPOINTS,
    TRACKS,
    join_tables,
    keypoints_table,
    read_poses,
    read_table,
    rows_between,
    write_table,
)
from pipelines.sources.pictures import CameraPictures, open_pictures, refuse_changed_pictures

if TYPE_CHECKING:
    import pandas as pd

DETECT = Stage("detect", revision=7)
DEFAULT_DETECTOR = "blazepose"

BACKGROUND = Stage("background", revision=1)

BLOCK = 300
"""Rows of a camera's frames in a block: ten seconds of work are a small loss."""

# A process takes 2 s to start, in which this one looks at 40 pictures. Fewer than these are not worth it.
MIN_PICTURES_FOR_PROCESSES = 150
# Following alone is faster: 150 pictures in these 2 s.
MIN_FOLLOWED_FOR_PROCESSES = 600

# A drone moves on by some metres in this time, so that stills differ enough to compare the ground.
TIME_BETWEEN_STILLS_S = 0.9
# More stills of a long flight fill the session and bind the cameras no better.
MAX_STILLS = 200
# A lower quality blurs the patches of ground that are compared.
JPEG_QUALITY = 85


@dataclass(frozen=True)
class Block:
    """Rows of a camera's frames that are processed together."""

    camera: str
    first: int
    stop: int

    @property
    def name(self) -> str:
        """A name by which blocks sort in time."""
        return f"{self.camera}-{self.first:09d}"


def cameras_to_detect(description: Description) -> dict[str, MediaEntry]:
    """Find the cameras with pictures and without imported keypoints."""
    return {
        name: entry.media
        for name, entry in description.cameras.items()
        if entry.media is not None and entry.keypoints is None
    }


def detect(
    session: WritableSession,
    *,
    detector: str = DEFAULT_DETECTOR,
    people: int = 1,
    every: int = 1,
    start_s: float | None = None,
    end_s: float | None = None,
    workers: int = 1,
    force: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> StageRecord | None:
    """Detect keypoints for cameras without imported ones, in a session that the caller has locked.

    `people` is the number that is wanted; of one who was logged, the actor alone is followed. Pictures from
    `start_s` to before `end_s` (s since the flight's first frame) are used. An `executor` replaces `workers`
    processes; the result depends on neither. None if every camera has imported keypoints. DataError: the
    detector's files are missing, pictures are gone or not those that were ingested, a table was changed, or
    nobody was found in any picture.
    """
    progress = progress or Silent()
    description = read_description(session.folder)
    media = cameras_to_detect(description)
    chosen = find_detector(detector)
    if not media:
        return None
    refuse_changed_pictures(session.folder, description, media)
    settings = {
        "detector": chosen.name,
        "people": "one" if people == 1 else "several",
        "every": every,
        "cameras": sorted(media),
        "start_s": start_s,
        "end_s": end_s,
    }
    ingested = session.ingested()
    work = _Work(session.folder, description, every, (start_s, end_s))
    looked_at = _looked_at(work, chosen, media)
    kept = None if force else _kept(session, settings, looked_at)
    hints = hints_of(description, ingested, media) if kept is None else hints_from(kept)
    tables = [f"cameras/{name}/frames.parquet" for name in media]
    times = {name: ingested.outputs[name] for name in tables}
    run = session.begin(DETECT, settings=settings, inputs=looked_at | times | hints, force=force)
    if run.finished:
        return run.record
    if kept is not None:
        progress.note(
            "keypoints kept: the pictures and the detector are the same; their times were written anew"
        )
        _store_with_new_times(work, media, run.folder)
        rows = {name: list(work.span(name)) for name in media}
        return run.publish(counts=kept.counts | {"rows": rows}, warnings=kept.warnings)

    blocks = [block for name in media for block in work.blocks(name)]
    pictures = sum(work.pictures(block) for block in blocks)
    if not pictures:
        start = "" if start_s is None else f" from {start_s:g} s on"
        problem = f"no picture lies in the flight{start}" + ("" if end_s is None else f" before {end_s:g} s")
        raise DataError(session.folder, problem, "look at `mocap info`, or leave it out", code="no-overlap")
    progress.start("Detecting keypoints", pictures)
    workers = 1 if pictures < MIN_PICTURES_FOR_PROCESSES else workers
    folders = _detected(run, work, blocks, chosen, people == 1, workers, executor, progress)
    counts = _assemble(run.folder, media, blocks, folders)
    lost = {name: camera["undecoded"] for name, camera in counts.items()}
    if not any(camera["detections"] for camera in counts.values()):
        undecoded = f" ({sum(lost.values())} cannot be decoded)" if any(lost.values()) else ""
        films = ", ".join(Path(source).name for each in media.values() for source in each.sources)
        problem = f"nobody was found in {pictures} pictures of {films}{undecoded}"
        remedy = "look if these are films of the flight, try a detector of `mocap models`, or give keypoints"
        raise DataError(session.folder, problem, remedy, code="nobody-found")
    joints = list(read_json(folders[0] / "counts.json")["joints"])
    rows = {name: list(work.span(name)) for name in media}
    warnings = [
        f"{name}: {gone} of {gone + counts[name].get('frames', 0)} pictures cannot be decoded"
        for name, gone in lost.items()
        if gone
    ]
    for note in (f"keypoints detected by {chosen.title}", *warnings):
        progress.note(note)
    return run.publish(
        counts={"detector": chosen.title, "joints": joints, "cameras": counts, "rows": rows},
        warnings=warnings,
    )


# --- what keypoints depend on --------------------------------------------------------------------------

_HINTS_FROM = "hints_from"


def hints_of(description: Description, ingested: StageRecord, cameras: Iterable[str]) -> dict[str, str]:
    """Return the hash of all that says where logged people should be in the pictures; empty without any."""
    logged = description.logged_people
    if not logged:
        return {}
    entries = {name: description.cameras[name] for name in sorted(cameras)}
    made_of = [
        [
            *(person.point for person in logged),
            description.pose_interpolation.model_dump(),
            ingested.outputs["actor.parquet"],
        ],
        *(
            [
                name,
                [asdict(entry.intrinsics), entry.poses.static, entry.pose_noise],
                [ingested.outputs[f"cameras/{name}/{table}.parquet"] for table in ("frames", "poses")],
            ]
            for name, entry in entries.items()
        ),
    ]
    return {_HINTS_FROM: hash_of(made_of)}


def hints_from(detected: StageRecord) -> dict[str, str]:
    """Return the hash, as `hints_of` has it, of the hints that keypoints were found with."""
    return {name: digest for name, digest in detected.inputs.items() if name == _HINTS_FROM}


def _looked_at(work: _Work, detector: Detector, media: Mapping[str, MediaEntry]) -> dict[str, str]:
    """Hash what must be the same for keypoints to be kept: models, pictures and the actor's log."""
    models = {f"model {name}": digest for name, digest in hashes_of_models(detector).items()}
    frames = {f"frames of {name}": work.digest_of_frames(name) for name in media}
    others = {f"pictures of {name}" for name in work.description.cameras if name not in media}
    recorded = {name: it for name, it in work.description.recorded.items() if name not in others}
    return models | frames | recorded


def _kept(
    session: WritableSession, settings: Mapping[str, object], looked_at: Mapping[str, str]
) -> StageRecord | None:
    """Return the record of the detection that holds the keypoints of these pictures already, if one does."""
    before = session.reusable(DETECT)
    if before is None or before.settings != settings:
        return None
    may_change = {name for name in before.inputs if name.startswith("cameras/")} | {_HINTS_FROM}
    same = {name: digest for name, digest in before.inputs.items() if name not in may_change} == looked_at
    return before if same else None


def _store_with_new_times(work: _Work, media: Mapping[str, MediaEntry], folder: Path) -> None:
    """Write the keypoints that the session holds, at the times that its frames have now."""
    for name in media:
        keypoints = read_table(work.folder / DETECT.name / name / "keypoints.parquet", KEYPOINTS)
        frame, t_ns = work.times(name)
        row = np.searchsorted(frame, keypoints["frame"].to_numpy(np.int64))
        (folder / name).mkdir()
        write_table(folder / name / "keypoints.parquet", keypoints.assign(t_ns=t_ns[row]), KEYPOINTS)


# --- the work ------------------------------------------------------------------------------------------


def _hints_at(
    folder: Path, description: Description, camera: str, t_ns: Int64, *, only_one: bool
) -> list[tuple[Hint | None, ...]]:
    """Return where logged people are in each of a camera's pictures of these times [T]."""
    people = logged_people(folder, description)[: 1 if only_one else None]
    if not people:
        return [()] * len(t_ns)
    track = read_poses(folder / "cameras" / camera / "poses.parquet")
    entry, between = description.cameras[camera], description.pose_interpolation
    of_each = [actor_hints(each, camera, entry, track, between, t_ns) for each in people]
    return list(zip(*of_each, strict=True))


class _Work:
    """Data that all blocks of a session share."""

    def __init__(
        self, folder: Path, description: Description, every: int, span_s: tuple[float | None, float | None]
    ) -> None:
        self.folder = folder
        self.every = every
        self.description = description
        self._frames = {
            name: read_table(folder / "cameras" / name / "frames.parquet", FRAMES)
            for name in cameras_to_detect(description)
        }
        self._spans = {
            name: rows_between(frames["t_ns"].to_numpy(np.int64) - description.start_ns, *span_s)
            for name, frames in self._frames.items()
        }

    def blocks(self, camera: str) -> list[Block]:
        """List the blocks of a camera; a single empty one if no picture is in the span."""
        rows = self._spans[camera]
        firsts = rows[::BLOCK] or [rows.start]
        return [Block(camera, first, min(first + BLOCK, rows.stop)) for first in firsts]

    def span(self, camera: str) -> tuple[int, int]:
        """Return the first row of a camera's frame table that is used, and the row after the last."""
        rows = self._spans[camera]
        return -(-rows.start // self.every) * self.every, rows.stop

    def pictures(self, block: Block) -> int:
        """Count the pictures of a block that are used."""
        return len(self.rows(block))

    def rows(self, block: Block) -> range:
        """Return the rows of the frame table that are used: multiples of `every` within the block."""
        first = -(-block.first // self.every) * self.every
        return range(first, block.stop, self.every)

    def frames(self, block: Block) -> tuple[Int64, Int64]:
        """Return the numbers and times of the frames that are looked at."""
        frame, t_ns = self.times(block.camera)
        rows = list(self.rows(block))
        return frame[rows], t_ns[rows]

    def times(self, camera: str) -> tuple[Int64, Int64]:
        """Return numbers and times of all frames of a camera."""
        frames = self._frames[camera]
        return frames["frame"].to_numpy(np.int64), frames["t_ns"].to_numpy(np.int64)

    def digest_of_frames(self, camera: str) -> str:
        """Hash the numbers of the frames that are looked at, block by block."""
        return hash_of([sha256(self.frames(block)[0].tobytes()).hexdigest() for block in self.blocks(camera)])


_NETWORKS = local()
"""Networks of each thread: only one thread may use them at a time, and threads of a cluster keep theirs."""


@dataclass(frozen=True)
class _DetectionOrder:
    """A block for a worker."""

    session: SharedSession
    detector: Detector
    models: Mapping[str, str]  # SHA-256 by name
    only_one: bool
    every: int
    block: Block


def detect_block(order: _DetectionOrder) -> dict[str, bytes]:
    """Detect on a worker; return a block's files. DataError: its session, pictures or models differ."""
    folder = order.session.opened()
    if hashes_of_models(order.detector) != order.models:
        problem = "has other model files on a machine of the Dask cluster, or none"
        remedy = "every machine needs the same ones (see `mocap models`)"
        raise DataError(order.detector.name, problem, remedy, code="wrong-worker")
    description, camera = read_description(folder), order.block.camera
    frame, t_ns = _Work(folder, description, order.every, (None, None)).frames(order.block)
    which = order.detector.name, hashes_of_models(order.detector)
    if getattr(_NETWORKS, "which", None) != which:
        _NETWORKS.loaded, _NETWORKS.which = order.detector.load(threads=1), which
    networks: KeypointNetworks = _NETWORKS.loaded
    tracker = PeopleTracker(networks, only_one=order.only_one)
    hints = _hints_at(folder, description, camera, t_ns, only_one=order.only_one)
    found: list[tuple[int, int, Float, Float]] = []
    undecoded = 0
    numbers = frame.tolist()
    # Left early, the pictures must not be closed while the next one is being decoded.
    with (
        open_pictures(folder, description, camera) as pictures,
        closing(_decoded_ahead(pictures, numbers)) as decoded,
    ):
        for number, picture, hints_here in zip(numbers, decoded, hints, strict=True):
            if picture is None:
                undecoded += 1
                continue
            found += [
                (number, seen.track, seen.person.xy, seen.person.confidence)
                for seen in tracker.step(picture, hints=hints_here)
            ]
    counts = {**tracker.counts, "detections": len(found), "undecoded": undecoded}
    with TemporaryDirectory() as name:
        place = Path(name)
        write_table(place / "keypoints.parquet", _table(found, networks, frame, t_ns), KEYPOINTS)
        write_json(place / "counts.json", {"joints": list(networks.joints), "counts": counts})
        return contents_of(place)


def _detected(
    run: Run,
    work: _Work,
    blocks: Sequence[Block],
    detector: Detector,
    only_one: bool,
    workers: int,
    executor: Executor | None,
    progress: Progress,
) -> list[Path]:
    """Return the folders of all blocks; those that no earlier run finished are worked on now."""
    session, models = SharedSession.at(work.folder), hashes_of_models(detector)
    missing = [block for block in blocks if not run.has_chunk(block.name)]
    orders = [_DetectionOrder(session, detector, models, only_one, work.every, block) for block in missing]
    progress.advance(sum(work.pictures(block) for block in blocks if block not in missing))
    with closing(each_part(detect_block, orders, workers=workers, executor=executor)) as found:
        for number, contents in found:
            run.chunk(missing[number].name, partial(write_contents, contents))
            progress.advance(work.pictures(missing[number]))
    return [run.chunk(block.name, _never) for block in blocks]


def _never(place: Path) -> None:
    raise RuntimeError(f"{place} was finished before")


def _decoded_ahead(pictures: CameraPictures, numbers: list[int]) -> Generator[Picture | None]:
    """Yield the pictures of these numbers; the next one is decoded while the networks process this one."""
    with ThreadPoolExecutor(1) as decoder:
        coming = deque(decoder.submit(pictures.read, number) for number in numbers[:1])
        for number in numbers[1:]:
            picture = coming.popleft().result()
            coming.append(decoder.submit(pictures.read, number))
            yield picture
        for last in coming:
            yield last.result()


def _table(
    found: list[tuple[int, int, Float, Float]], networks: KeypointNetworks, frame: Int64, t_ns: Int64
) -> pd.DataFrame:
    joints = networks.joints
    detections = Detections(
        joints=joints,
        frame=np.array([row[0] for row in found], dtype=np.int64),
        person=np.array([row[1] for row in found], dtype=np.int64),
        xy=np.array([row[2] for row in found], dtype=np.float64).reshape(-1, len(joints), 2),
        confidence=np.array([row[3] for row in found], dtype=np.float64).reshape(-1, len(joints)),
        frames_listed=frame,
    )
    return keypoints_table(detections, frame, t_ns)


def _assemble(
    folder: Path, media: Mapping[str, MediaEntry], blocks: list[Block], folders: list[Path]
) -> dict[str, dict[str, int]]:
    import pandas as pd

    counts: dict[str, dict[str, int]] = {}
    for name in media:
        own = [made for block, made in zip(blocks, folders, strict=True) if block.camera == name]
        tables = [read_table(made / "keypoints.parquet", KEYPOINTS) for made in own]
        (folder / name).mkdir()
        write_table(folder / name / "keypoints.parquet", pd.concat(tables, ignore_index=True), KEYPOINTS)
        total: Counter[str] = Counter()
        for made in own:
            total.update(read_json(made / "counts.json")["counts"])
        counts[name] = dict(sorted(total.items()))
    return counts


# --- the background ------------------------------------------------------------------------------------


def cameras_to_follow(description: Description) -> list[str]:
    """List the moving cameras with pictures."""
    return [
        name
        for name, entry in description.cameras.items()
        if entry.media is not None and not entry.poses.static
    ]


@dataclass(frozen=True)
class FollowedBlock(Block):
    """Pictures of a camera that are followed together, by their numbers."""

    before: int | None  # last picture of the block before, to be shown first
    numbers: Int64
    stills: Int64  # those that are kept


def follow_block(order: tuple[SharedSession, FollowedBlock]) -> dict[str, bytes]:
    """Follow the points of a block's pictures on a worker; DataError: its pictures differ."""
    import cv2
    import pandas as pd

    session, block = order
    folder = session.opened()
    follower, stills, undecoded = Follower(), dict[int, bytes](), 0
    before = [] if block.before is None else [block.before]
    with open_pictures(folder, read_description(folder), block.camera) as pictures:
        for number in before + block.numbers.tolist():
            picture = pictures.read(number)
            grey = (
                None if picture is None else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
            )
            follower.step(number, grey)
            if grey is None:
                undecoded += number != block.before
            elif number in block.stills:
                _, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
                stills[number] = encoded.tobytes()
    tracks = follower.tracks()
    columns = {"frame": tracks.picture, "point": tracks.point, "x": tracks.xy[:, 0], "y": tracks.xy[:, 1]}
    counts = {"pictures": len(block.numbers), "undecoded": undecoded}
    counts |= {"points": int(tracks.point.max(initial=-1)) + 1, "stills": len(stills)}
    with TemporaryDirectory() as name:
        place = Path(name)
        write_table(place / "tracks.parquet", pd.DataFrame(columns), TRACKS)
        write_json(place / "counts.json", counts)
        return contents_of(place) | {still_name(number): still for number, still in stills.items()}


def follow(
    session: WritableSession,
    *,
    every: int = 1,
    span_s: tuple[float | None, float | None] = (None, None),
    workers: int = 1,
    force: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> StageRecord:
    """Follow the backgrounds of all moving cameras with pictures, in a session that the caller has locked.

    `every` and `span_s` (None for no bound) are those of the detector; backgrounds of cameras that it looks
    at use the same pictures. The rest as for `detect`.

    DataError: no moving camera has pictures, or these are gone or not those that were ingested.
    """
    progress = progress or Silent()
    folder = session.folder
    description = read_description(folder)
    names = cameras_to_follow(description)
    if not names:
        problem, remedy = "no moving camera has pictures to look at", "state their `video`, or leave it out"
        raise DataError("the backgrounds", problem, remedy, code="no-pictures")
    refuse_changed_pictures(folder, description, names)
    seen = {name: _blocks_to_follow(folder, description, name, every, span_s) for name in names}
    recorded = description.recorded
    inputs = {f"pictures of {name}": recorded[f"pictures of {name}"] for name in names} | {
        f"frames of {name}": hash_of([[block.first, *block.numbers.tolist()] for block in blocks])
        for name, blocks in seen.items()
    }
    run = session.begin(BACKGROUND, settings={"cameras": names}, inputs=inputs, force=force)
    if run.finished:
        return run.record
    missing = [block for blocks in seen.values() for block in blocks if not run.has_chunk(block.name)]
    left = sum(len(block.numbers) for block in missing)
    if left:
        progress.start("Following backgrounds", left)
    workers = 1 if left < MIN_FOLLOWED_FOR_PROCESSES else workers
    shared = SharedSession.at(folder)
    orders = [(shared, block) for block in missing]
    with closing(each_part(follow_block, orders, workers=workers, executor=executor)) as found:
        for number, contents in found:
            run.chunk(missing[number].name, partial(write_contents, contents))
            progress.advance(len(missing[number].numbers))
    counts = {}
    for name, blocks in seen.items():
        parts = [run.chunk(block.name, _never) for block in blocks]
        counts[name] = _assemble_background(run.folder / name, parts)
    return run.publish(counts={"cameras": counts})


def _blocks_to_follow(
    folder: Path, description: Description, camera: str, every: int, span_s: tuple[float | None, float | None]
) -> list[FollowedBlock]:
    frames = read_table(folder / "cameras" / camera / "frames.parquet", FRAMES)
    numbers, t_ns = (frames[name].to_numpy(np.int64) for name in ("frame", "t_ns"))
    span, step = range(len(numbers)), 1
    if description.cameras[camera].keypoints is None:  # as the detector looks at them
        span, step = rows_between(t_ns - description.start_ns, *span_s), every
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
        stop = min(first + BLOCK, span.stop)
        begin, end = np.searchsorted(rows, (first, stop)).tolist()
        own = rows[begin:end]
        before = int(numbers[rows[begin - 1]]) if begin and len(own) else None
        kept = numbers[np.intersect1d(own, stills)]
        blocks.append(FollowedBlock(camera, first, stop, before, numbers[own], kept))
    return blocks


def _assemble_background(folder: Path, parts: Iterable[Path]) -> dict[str, int]:
    total = {"pictures": 0, "undecoded": 0, "points": 0, "stills": 0}
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
