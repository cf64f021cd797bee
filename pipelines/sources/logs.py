"""Readers of the parts that a manifest takes from logs: the recording, the topic, and its content.

If no topic is stated, the only candidate of its kind is taken, and a note names it.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.formats.logs.maps import (
    MAP_TYPES,
    OCCUPANCY_GRID,
    LoggedMaps,
    Losses,
    MapTopic,
    frame_of,
    read_maps,
)
from pipelines.formats.logs.messages import Kind, all_samples, kind_of
from pipelines.formats.logs.pictures import decode, later_times, picture_stamps
from pipelines.formats.logs.positions import FIXES, axes_of_topic, pairs_of
from pipelines.formats.logs.recordings import OpenLog
from pipelines.formats.logs.trajectories import (
    PATH,
    Gathered,
    attitudes_of,
    chained,
    frames_of_poses,
    place_of_frame,
    poses_of,
    read_commands,
    transforms_in,
)
from pipelines.geometry.arrays import Int64, Intrinsics
from pipelines.geometry.clocks import ClockStep, find_steps, without_steps
from pipelines.session.errors import DataError
from pipelines.session.manifest import Axes, LoggedMap, LogSource, Manifest, MapSource
from pipelines.session.recognition import recognise
from pipelines.session.records import IntrinsicsSample, Message, PictureSample, PoseSample, Trajectory
from pipelines.session.registries import Log, LogFormat
from pipelines.session.urls import located
from pipelines.sources.parts import CameraFrames
from pipelines.sources.world import in_enu, in_world, world_times

# The tables of so many messages, of all logs that stay open, take 160 MB.
MAX_KEPT_MESSAGES = 4_000_000

# A process may hold some hundred files open, and a split log has many.
MAX_KEPT_FILES = 64

# Foxglove's and ffmpeg_image_transport's packets need those before them.
_CODED_VIDEO = ("CompressedVideo", "FFMPEGPacket")

_NOUNS: dict[Kind, str] = {
    "poses": "poses",
    "transforms": "transforms",
    "angles": "gimbal angles",
    "intrinsics": "camera info",
    "pictures": "pictures",
}


@dataclass(frozen=True)
class FlightLog:
    """One log of a flight, open for one reading."""

    recording: Log
    source: str  # its name, for messages
    settings: LogSource
    note: Callable[[str], None]

    @property
    def lost(self) -> Counter[str]:
        """Messages that could not be read so far, by cause."""
        return Counter(self.recording.dropped)

    def type_of(self, topic: str | None) -> str | None:
        """Return the type of a topic's messages; None if the log does not have it."""
        return next((known.type for known in self.recording.topics if known.name == topic), None)

    def choose(self, kind: Kind, topic: str | None) -> str:
        """Return the topic that is named, or the only one of its kind; DataError: none, or several."""
        there = [known.name for known in self.recording.topics if kind_of(known) == kind]
        return self.choose_among(there, _NOUNS[kind], topic)

    def choose_among(self, there: list[str], noun: str, topic: str | None) -> str:
        """Return the topic that is named, or the only candidate; errors as in `choose`."""
        there = sorted(set(there))
        listed = ", ".join(there) or "none"
        if topic is None and not there and noun == _NOUNS["pictures"]:
            topic = next((t.name for t in self.recording.topics if t.type.endswith(_CODED_VIDEO)), None)
        if topic is not None:
            if topic in there:
                return topic
            type_ = self.type_of(topic)
            problem = f"topic {topic} holds {type_}, no {noun}" if type_ else f"has no topic {topic}"
            remedy = f"topics with {noun}: {listed}"
            if type_ and type_.endswith(_CODED_VIDEO) and noun == _NOUNS["pictures"]:
                problem = f"topic {topic} holds coded video ({type_}), which is not read from logs"
                remedy = "write its stream to a .h264 file, and its stamps to a CSV for frame_times"
            if type_ in FIXES and noun == _NOUNS["poses"]:
                turned = next((b for a, b in pairs_of(self.recording.topics) if a == topic), "TOPIC")
                problem += ", but positions alone"
                remedy = f"name the attitudes beside it, attitude: {turned}; {remedy}"
            raise DataError(self.source, problem, remedy, code="no-such-topic")
        if len(there) != 1:
            problem = (
                f"has {len(there)} topics with {noun} ({listed})" if there else f"has no topic with {noun}"
            )
            remedy = "say which with `topic:`" if there else "name another log"
            raise DataError(self.source, problem, remedy, code="ambiguous")
        self.note(f"{self.source}: took {noun} from {there[0]}, the only candidate")
        return there[0]

    @property
    def started_ns(self) -> int:
        """Time of receipt of its first message, from which the drift of its clock counts."""
        firsts = (topic.first_ns for topic in self.recording.topics if topic.first_ns is not None)
        return min(firsts, default=0)

    def world_times(self, t_ns: Int64) -> Int64:
        """Convert the log's times to world times."""
        return world_times(self.settings.clock, t_ns, self.started_ns)

    def note_steps(self, topic: str, steps: Iterable[ClockStep]) -> None:
        """Note the steps of the header's clock, if its stamps are used."""
        for step in steps if self.settings.stamps == "header" else ():
            self.note(f"{self.source} {topic}: {step}")

    def at_world_times(self, gathered: Gathered) -> Trajectory:
        """Return a trajectory at world times, with all losses and notes."""
        for line in gathered.notes:
            self.note(line)
        trajectory = gathered.trajectory
        return replace(
            trajectory,
            t_ns=self.world_times(trajectory.t_ns),
            dropped=dict(Counter(trajectory.dropped) + self.lost),
        )


class FlightLogs(AbstractContextManager["FlightLogs"]):
    """Logs of one flight; a context manager that closes those that it keeps open, within bounds."""

    def __init__(self, flight: Manifest, base: Path, note: Callable[[str], None]) -> None:
        self._flight = flight
        self._base = base
        self._note = note
        self._kept: dict[tuple[Path, ...], OpenLog] = {}  # the most recently used one is last

    def __exit__(self, *exception: object) -> None:
        for paths in list(self._kept):
            self._close(paths)

    def settings(self, log: str) -> LogSource:
        """Return the manifest's settings of a log, given by its name or by a path."""
        return self._flight.logs.get(log) or LogSource(file=[log])

    def paths(self, log: str) -> list[Path]:
        """Return the files of a log."""
        return [located(self._base, path) for path in self.settings(log).file]

    @contextmanager
    def open(self, log: str) -> Iterator[FlightLog]:
        """Open a recording for one reading; DataError: a file is missing, damaged, or no log."""
        paths = tuple(self.paths(log))
        recording: Log | None = self._kept.pop(paths, None)
        if recording is None:
            recording = recognise(paths[0], LogFormat, "log").open_log(paths)
            for line in recording.notes if isinstance(recording, OpenLog) else ():
                self._note(f"{paths[0]}: {line}")
        opened = FlightLog(recording, str(paths[0]), self.settings(log), self._note)
        if not isinstance(recording, OpenLog):
            with recording:
                yield opened
            return
        self._kept[paths] = recording
        while len(self._kept) > 1 and (
            sum(topic.count for log in self._kept.values() for topic in log.topics) > MAX_KEPT_MESSAGES
            or sum(len(log.parts) for log in self._kept.values()) > MAX_KEPT_FILES
        ):
            self._close(next(iter(self._kept)))
        recording.forget()  # losses counted while another topic was read
        yield opened

    def _close(self, paths: tuple[Path, ...]) -> None:
        with self._kept.pop(paths):
            pass

    def trajectory(
        self, log: str, topic: str | None, parent: str | None, child: str | None, *, max_gap_ns: int
    ) -> Trajectory:
        """Read poses in the log's own axes, at world times; DataError: several or nothing usable."""
        with self.open(log) as opened:
            recording, source, stamps = opened.recording, opened.source, opened.settings.stamps
            if parent is not None and child is not None:
                named = None if topic is None else opened.choose("transforms", topic)
                name = named or f"transforms to {child}"
                transforms = transforms_in(recording, source, named)
                gathered = chained(
                    transforms, source, parent=parent, child=child, stamps=stamps, max_gap_ns=max_gap_ns
                )
            else:
                name = opened.choose("poses", topic)
                gathered = poses_of(recording, name, source, stamps)
            return opened.at_world_times(gathered)

    def axes(self, log: str, topic: str | None, parent: str | None) -> Axes | None:
        """Return the axes that the manifest states for a log, else those that its program is known to use."""
        if (stated := self.settings(log).axes) is not None:
            return stated
        with self.open(log) as opened:
            there = [known.name for known in opened.recording.topics if kind_of(known) == "poses"]
            name = topic or (there[0] if len(there) == 1 and parent is None else None)
            axes = axes_of_topic(name, parent)
            if axes is None and name and name.endswith("/odom_local_ned"):  # of a node of another name
                places = all_samples(opened.recording.messages([name]), opened.source)
                heights_m = [sample.position[2] for sample in places if isinstance(sample, PoseSample)]
                axes = "ned" if heights_m and np.median(heights_m) < 0 else None
            if axes is not None:
                self._note(f"{opened.source}: {name or parent} is AirSim's, in {axes.upper()}")
            return axes

    def commands(self, log: str, topic: str | None) -> Trajectory | None:
        """Read commanded positions of a drone, at world times; None if the topic holds no command type."""
        with self.open(log) as opened:
            if topic is None or opened.type_of(topic) != PATH:
                return None
            found = read_commands(opened.recording, opened.source, topic, opened.settings.stamps)
            dropped = dict(Counter(found.dropped) + opened.lost)
            return replace(found, t_ns=opened.world_times(found.t_ns), dropped=dropped)

    def attitudes(
        self, log: str, topic: str, *, order: Literal["ypr", "rpy", "pry"], units: Literal["deg", "rad"]
    ) -> Trajectory:
        """Read a gimbal's attitude in the log's axes, at world times; its positions have no meaning."""
        with self.open(log) as opened:
            name, source = opened.choose("angles", topic), opened.source
            samples = all_samples(opened.recording.messages([name]), source)
            stamps = opened.settings.stamps
            gathered = attitudes_of(samples, f"{source} {name}", stamps=stamps, order=order, units=units)
            return opened.at_world_times(gathered)

    def intrinsics(self, log: str, topic: str | None) -> Intrinsics:
        """Return a topic's calibrated intrinsics; DataError: none is, or it changes in flight."""
        found: dict[Intrinsics, str] = {}
        count = 0
        with self.open(log) as opened:
            name, source = opened.choose("intrinsics", topic), opened.source
            for sample in all_samples(opened.recording.messages([name]), source):
                if not isinstance(sample, IntrinsicsSample):
                    problem = f"{name} holds no camera info"
                    raise DataError(source, problem, "name another topic", code="no-intrinsics")
                count += 1
                if sample.intrinsics is not None:
                    found.setdefault(sample.intrinsics, sample.note)
                if len(found) > 1:
                    problem = f"{name} changes during the flight (zoom?)"
                    remedy = "give one calibration in a file or inline"
                    raise DataError(source, problem, remedy, code="no-intrinsics")
            for note in filter(None, found.values()):
                opened.note(f"{source}: {note}")
        if not found:
            problem = f"{name}: the camera is not calibrated (K is 0 in {count} messages)"
            problem = problem if count else f"{name} is empty"
            remedy = "calibrate it, name another topic, or give a calibration file under `intrinsics`"
            raise DataError(source, problem, remedy, code="no-intrinsics" if count else "empty")
        return next(iter(found))

    def frames(self, log: str, topic: str | None) -> CameraFrames:
        """Read the times at which a topic's pictures were taken, at world times; DataError: none."""
        with self.open(log) as opened:
            name = opened.choose("pictures", topic)
            taken_ns, received_ns = picture_stamps(opened.recording, name, opened.source)
            t_ns = later_times(taken_ns, received_ns, opened.settings.stamps)
            if not len(t_ns):
                problem = f"{name} holds no picture"
                raise DataError(opened.source, problem, "name another topic", code="no-pictures")
            lost = opened.lost + Counter({"picture without a later stamp": len(taken_ns) - len(t_ns)})
            if opened.settings.stamps == "header" and (steps := find_steps(taken_ns, received_ns)):
                opened.note_steps(name, steps)
                stamps_ns, first = np.unique(taken_ns, return_index=True)
                place = first[np.searchsorted(stamps_ns, t_ns).clip(max=len(first) - 1)]
                mended = without_steps(taken_ns, steps)[place]
                t_ns = np.maximum.accumulate(np.where(taken_ns[place] == t_ns, mended, t_ns))
            t_ns = opened.world_times(t_ns)
            return CameraFrames(np.arange(len(t_ns)), t_ns, t_ns - t_ns[0], name, dict(lost))

    def picture_size(self, log: str, topic: str | None) -> tuple[int, int] | None:
        """Return width and height of a topic's pictures, from the first readable one; None without any."""
        with self.open(log) as opened:
            name = opened.choose("pictures", topic)
            for sample in all_samples(opened.recording.messages([name]), opened.source):
                if not isinstance(sample, PictureSample):
                    continue  # `frames` refuses it
                if sample.width and sample.height:
                    return sample.width, sample.height
                if (picture := decode(sample)) is not None:
                    return picture.shape[1], picture.shape[0]
        return None


DEFAULT_HEIGHT_M = 2.5
"""Height of the cells of a floor plan: an ordinary storey."""


def maps_of_log(
    flight: Manifest, stated: MapSource, logs: FlightLogs, *, max_gap_ns: int, note: Callable[[str], None]
) -> LoggedMaps:
    """Read the maps of a topic, in ENU axes at world times; DataError: none can be read or placed."""
    log, options = stated.file, LoggedMap.model_validate(stated.options)
    with logs.open(log) as opened:
        recording, source, settings = opened.recording, opened.source, opened.settings
        there = [known.name for known in recording.topics if known.type in MAP_TYPES]
        topic = opened.choose_among(there, "maps", stated.topic)
        type_ = opened.type_of(topic) or ""
        place = f"{source} {topic}"
        first = next(recording.messages([topic]), None)
        if first is None:
            raise Losses(place, recording.dropped).nothing_usable()
        if options.height_m is not None and type_ != OCCUPANCY_GRID:
            problem = f"{topic} holds {type_}, which has heights of its own"
            raise DataError(source, problem, "leave `height_m` out", code="wrong-option")
        frame = frame_of(first, place)
        log_from_frame = place_of_frame(
            recording,
            source,
            place,
            frame,
            parent=options.parent,
            poses_in=frames_of_poses(recording, source, _poses_taken(flight, logs, log)),
            stamps=settings.stamps,
            max_gap_ns=max_gap_ns,
            note=note,
        )
        started_ns = opened.started_ns
    lost: dict[str, int] = {}

    def read() -> Iterator[Message]:
        with logs.open(log) as opened:
            yield from opened.recording.messages([topic])
            lost.update(opened.recording.dropped)

    about = MapTopic(
        source=place,
        frame=frame,
        stamps=settings.stamps,
        world_from_frame=in_world(
            in_enu(log_from_frame, settings.axes or flight.world.frame), settings.world_from_source
        ),
        max_gap_ns=max_gap_ns,
        resolution_m=stated.resolution_m,
        height_m=DEFAULT_HEIGHT_M if options.height_m is None else options.height_m,
    )
    found = read_maps(read, type_, about)
    for line in found.notes:
        note(line)
    from_ns = world_times(settings.clock, found.from_ns, started_ns)
    return replace(
        found,
        maps=(replace(each, from_ns=since) for each, since in zip(found.maps, from_ns.tolist(), strict=True)),
        from_ns=from_ns,
        dropped=dict(Counter(found.dropped) + Counter(lost)),
    )


def _poses_taken(flight: Manifest, logs: FlightLogs, log: str) -> list[tuple[str | None, str | None]]:
    """Return topic and parent of all poses that the flight takes from a log."""
    poses = [camera.pose for camera in flight.cameras.values()]
    taken = [(pose.file, pose.topic, pose.options.get("parent")) for pose in poses]
    taken += [(actor.file, actor.topic, None) for actor in flight.logged_people.values()]
    paths = logs.paths(log)
    return [(topic, parent) for name, topic, parent in taken if logs.paths(name) == paths]
