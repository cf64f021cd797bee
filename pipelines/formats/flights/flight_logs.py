"""Readers of the parts that a manifest takes from logs: the recording, the topic, and its content.

If no topic is stated, the only candidate of its kind is taken, and a note names it. Every reading
is one pass over the messages of one topic: logs of any size stream.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Self

from pipelines.formats.flights.log_times import doubts_of_stamps, world_times
from pipelines.formats.flights.open_logs import OpenLogs
from pipelines.formats.logs.commands import COMMAND_TYPES, read_commands
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
from pipelines.formats.logs.pictures import (
    TRIGGER_TYPES,
    decode,
    later_times,
    picture_stamps,
    read_triggers,
)
from pipelines.formats.logs.presets import NAV_SAT_FIX, read_pair, read_positions, read_preset
from pipelines.formats.logs.trajectories import (
    Gathered,
    attitudes_of,
    chained,
    frames_of_poses,
    place_of_frame,
    poses_of,
    transforms_in,
)
from pipelines.session.errors import DataError
from pipelines.session.manifest import Flight, PoseSource
from pipelines.session.manifest import Log as LogSource
from pipelines.session.manifest import Map as MapSource
from pipelines.session.records import (
    Int64,
    IntrinsicsSample,
    Message,
    Occupancy,
    PictureSample,
    Topic,
    Trajectory,
)
from pipelines.session.registries import Log
from pipelines.session.telemetry import PositionTrack, Telemetry, TelemetryChoice

_Wanted = Kind | Literal["maps"]

_NOUNS: dict[_Wanted, str] = {
    "poses": "poses",
    "transforms": "transforms",
    "angles": "gimbal angles",
    "intrinsics": "camera info",
    "pictures": "pictures",
    "maps": "maps",
}

DEFAULT_HEIGHT_M = 2.5
"""Height of the cells of a floor plan: an ordinary storey."""


@dataclass(frozen=True)
class Frames:
    """Pictures of a topic, with the time at which each was taken, strictly increasing."""

    topic: str
    t_ns: Int64
    dropped: dict[str, int] = field(default_factory=dict)


class FlightLogs:
    """Logs of one flight; a context manager that closes those that it keeps open.

    Args:
        flight: the manifest.
        base: the folder that its paths are relative to.
        note: receives each choice and each doubt, one line each.
    """

    def __init__(self, flight: Flight, base: Path, note: Callable[[str], None]) -> None:
        self._flight = flight
        self._base = base
        self._note = note
        self._logs = OpenLogs()

    def __enter__(self) -> Self:
        """Return the logs themselves."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the files."""
        self._logs.close()

    def settings(self, log: str) -> LogSource:
        """Return the manifest's settings of a log, given by its name or by a path."""
        return self._flight.logs.get(log) or LogSource(path=[log])

    def paths(self, log: str) -> list[Path]:
        """Return the files of a log."""
        return [self._base / path for path in self.settings(log).path]

    def trajectory(
        self, log: str, topic: str | None, parent: str | None, child: str | None, *, max_gap_ns: int
    ) -> Trajectory:
        """Read poses in the log's own world and axes, at world times.

        Raises:
            DataError: no such topic or frame, several candidates, or nothing usable.
        """
        with self._open(log) as (recording, source):
            if parent is not None and child is not None:
                gathered = self._chained(log, recording, source, topic, parent, child, max_gap_ns)
            else:
                name = self._choose(recording, source, "poses", topic)
                gathered = poses_of(recording, name, source, self.settings(log).stamps)
            lost = dict(recording.dropped)
            started_ns = _start_ns(recording)
        return self._at_world_times(log, source, gathered, lost, started_ns)

    def telemetry(self, pose: PoseSource, choice: TelemetryChoice) -> Telemetry:
        """Read a drone's telemetry from a driver's usual topics, or two named ones, at the log's own times.

        Raises:
            DataError: no such topics, those of several drones, or nothing usable.
        """
        log = pose.log or ""
        settings = self.settings(log)
        with self._open(log) as (recording, source):
            if pose.preset:
                found = read_preset(recording, source, pose.preset, pose.namespace, choice, settings.stamps)
            else:
                axes = pose.axes or settings.axes or self._flight.world.frame
                named = (pose.topic or "", pose.attitude or "")
                found = read_pair(recording, source, *named, axes, settings.stamps)
            lost = Counter(recording.dropped)
        return replace(found, dropped=dict(Counter(found.dropped) + lost))

    def triggers(self, log: str, topic: str | None) -> Frames | None:
        """Read trigger times of pictures from a topic, at world times; None if it is no topic of triggers."""
        with self._open(log) as (recording, source):
            types = {known.name: known.type for known in recording.topics}
            if topic is None or types.get(topic) not in TRIGGER_TYPES:
                return None
            t_ns, repeated = read_triggers(recording, source, topic)
            lost = Counter(recording.dropped)
            started_ns = _start_ns(recording)
        if repeated:
            lost["trigger without a later stamp"] += repeated
        return Frames(topic, self._world_times(log, t_ns, started_ns), dict(lost))

    def positions(self, log: str, topic: str | None) -> tuple[PositionTrack, dict[str, int]] | None:
        """Read positions on Earth from a topic, at world times, and losses; None if it is no NavSatFix."""
        with self._open(log) as (recording, source):
            types = {known.name: known.type for known in recording.topics}
            if topic is None or types.get(topic) != NAV_SAT_FIX:
                return None
            dropped: dict[str, int] = {}
            track = read_positions(recording, source, topic, self.settings(log).stamps, dropped)
            lost = Counter(dropped) + Counter(recording.dropped)
            started_ns = _start_ns(recording)
        return replace(track, t_ns=self._world_times(log, track.t_ns, started_ns)), dict(lost)

    def commands(self, log: str, topic: str) -> Trajectory | None:
        """Read commanded positions of a drone, at world times; None if the topic holds no command type."""
        with self._open(log) as (recording, source):
            types = {known.name: known.type for known in recording.topics}
            if types.get(topic) not in COMMAND_TYPES:
                return None
            found = read_commands(recording, source, topic, self.settings(log).stamps)
            lost = Counter(recording.dropped)
            started_ns = _start_ns(recording)
        t_ns = self._world_times(log, found.t_ns, started_ns)
        return replace(found, t_ns=t_ns, dropped=dict(Counter(found.dropped) + lost))

    def attitudes(
        self,
        log: str,
        topic: str,
        *,
        order: Literal["ypr", "rpy", "pry"],
        units: Literal["deg", "rad"],
    ) -> Trajectory:
        """Read a gimbal's attitude in the log's axes, at world times; its positions have no meaning."""
        with self._open(log) as (recording, source):
            name = self._choose(recording, source, "angles", topic)
            gathered = attitudes_of(
                all_samples(recording.messages([name]), source),
                f"{source} {name}",
                stamps=self.settings(log).stamps,
                order=order,
                units=units,
            )
            lost = dict(recording.dropped)
            started_ns = _start_ns(recording)
        return self._at_world_times(log, source, gathered, lost, started_ns)

    def intrinsics(self, log: str, topic: str | None) -> IntrinsicsSample:
        """Return the first camera info of a topic.

        Raises:
            DataError: no such topic, or it is empty or its calibration changes during the flight.
        """
        with self._open(log) as (recording, source):
            name = self._choose(recording, source, "intrinsics", topic)
            first: IntrinsicsSample | None = None
            for sample in all_samples(recording.messages([name]), source):
                if not isinstance(sample, IntrinsicsSample):
                    raise DataError(source, f"{name} holds no camera info", "name another topic")
                if first is not None and sample.intrinsics != first.intrinsics:
                    raise DataError(
                        source,
                        f"{name} changes during the flight (zoom?)",
                        "give one calibration in a file or inline",
                    )
                first = first or sample
        if first is None:
            raise DataError(source, f"{name} is empty", "name another topic, or give the intrinsics")
        return first

    def frames(self, log: str, topic: str | None) -> Frames:
        """Read the times at which the pictures of a topic were taken, at world times.

        Raises:
            DataError: no such topic, or no picture in it.
        """
        stamps = self.settings(log).stamps
        with self._open(log) as (recording, source):
            name = self._choose(recording, source, "pictures", topic)
            taken_ns, received_ns = picture_stamps(recording, name, source)
            t_ns = later_times(taken_ns, received_ns, stamps)
            lost = Counter(recording.dropped)
            started_ns = _start_ns(recording)
        if not len(t_ns):
            raise DataError(source, f"{name} holds no picture", "name another topic")
        if len(taken_ns) > len(t_ns):
            lost["picture without a later stamp"] += len(taken_ns) - len(t_ns)
        return Frames(name, self._world_times(log, t_ns, started_ns), dict(lost))

    def picture_size(self, log: str, topic: str | None) -> tuple[int, int] | None:
        """Return width and height of a topic's pictures, from the first readable one; None without any.

        Raises:
            DataError: no such topic.
        """
        with self._open(log) as (recording, source):
            name = self._choose(recording, source, "pictures", topic)
            for sample in all_samples(recording.messages([name]), source):
                if not isinstance(sample, PictureSample):
                    continue  # `frames` refuses it
                if sample.width and sample.height:
                    return sample.width, sample.height
                if (picture := decode(sample)) is not None:
                    return picture.shape[1], picture.shape[0]
        return None

    def maps(
        self, stated: MapSource, to_world: Callable[[Trajectory], Trajectory], *, max_gap_ns: int
    ) -> LoggedMaps:
        """Read the maps of a topic, in the world, at world times.

        Args:
            stated: the log and topic.
            to_world: converts poses from the axes and origin of the log to those of the world.
            max_gap_ns: the longest gap between two transforms that is interpolated.

        Raises:
            DataError: no such topic, several candidates, no readable map, or a map in a frame that the
                log does not connect with its world.
        """
        log = stated.log or ""
        with self._open(log) as (recording, source):
            topic = self._choose(recording, source, "maps", stated.topic)
            type_ = next(each.type for each in recording.topics if each.name == topic)
            first = next(recording.messages([topic]), None)
            if first is None:
                raise Losses(f"{source} {topic}", recording.dropped).nothing_usable()
            if stated.height_m is not None and type_ != OCCUPANCY_GRID:
                problem = f"{topic} holds {type_}, which has heights of its own"
                raise DataError(source, problem, "leave `height_m` out")
            place, frame = f"{source} {topic}", frame_of(first, f"{source} {topic}")
            log_from_frame = place_of_frame(
                recording,
                source,
                place,
                frame,
                parent=stated.parent,
                poses_in=frames_of_poses(recording, source, self._poses_taken(log)),
                stamps=self.settings(log).stamps,
                max_gap_ns=max_gap_ns,
                note=self._note,
            )
            started_ns = _start_ns(recording)
        lost: dict[str, int] = {}

        def read() -> Iterator[Message]:
            with self._open(log) as (recording, _):
                yield from recording.messages([topic])
                lost.update(recording.dropped)

        about = MapTopic(
            source=place,
            frame=frame,
            stamps=self.settings(log).stamps,
            world_from_frame=to_world(log_from_frame),
            max_gap_ns=max_gap_ns,
            resolution_m=stated.resolution_m,
            height_m=DEFAULT_HEIGHT_M if stated.height_m is None else stated.height_m,
        )
        found = read_maps(read, type_, about)
        from_ns = self._world_times(log, found.from_ns, started_ns)
        return replace(
            found,
            maps=_at_times(found.maps, from_ns),
            from_ns=from_ns,
            dropped=dict(Counter(found.dropped) + Counter(lost)),
        )

    def _poses_taken(self, log: str) -> list[tuple[str | None, str | None]]:
        """Return topic and parent of all poses that the flight takes from a log."""
        paths = self.paths(log)
        poses = [camera.pose for camera in self._flight.cameras.values()]
        taken = [(pose.log, pose.topic, pose.parent) for pose in poses]
        if actor := self._flight.actor:
            taken.append((actor.log, actor.topic, None))
        return [(topic, parent) for name, topic, parent in taken if name and self.paths(name) == paths]

    @contextmanager
    def _open(self, log: str) -> Iterator[tuple[Log, str]]:
        """Open a recording for one reading; yield it with its name for messages."""
        paths = self.paths(log)
        with self._logs.reading(paths) as recording:
            yield recording, str(paths[0])

    def _choose(self, recording: Log, source: str, kind: _Wanted, topic: str | None) -> str:
        """Return the topic that is named, or the only one of its kind."""
        there = {candidate.name: candidate for candidate in recording.topics if _kind_of(candidate) == kind}
        listed = ", ".join(sorted(there)) or "none"
        if topic is not None:
            every = {candidate.name: candidate for candidate in recording.topics}
            if topic in there:
                return topic
            if topic in every:
                problem = f"topic {topic} holds {every[topic].type}, no {_NOUNS[kind]}"
            else:
                problem = f"has no topic {topic}"
            raise DataError(source, problem, f"topics with {_NOUNS[kind]}: {listed}")
        if len(there) != 1:
            problem = f"has {len(there)} topics with {_NOUNS[kind]} ({listed})"
            raise DataError(source, problem, "say which with `topic:`" if there else "name another log")
        (only,) = there
        self._note(f"{source}: took {_NOUNS[kind]} from {only}, the only candidate")
        return only

    def _chained(
        self,
        log: str,
        recording: Log,
        source: str,
        topic: str | None,
        parent: str,
        child: str,
        max_gap_ns: int,
    ) -> Gathered:
        named = None if topic is None else self._choose(recording, source, "transforms", topic)
        return chained(
            transforms_in(recording, source, named),
            source,
            parent=parent,
            child=child,
            stamps=self.settings(log).stamps,
            max_gap_ns=max_gap_ns,
        )

    def _at_world_times(
        self, log: str, source: str, gathered: Gathered, lost: dict[str, int], started_ns: int
    ) -> Trajectory:
        for doubt in doubts_of_stamps(gathered.stamps, self.settings(log).stamps):
            self._note(f"{source}: {doubt}")
        trajectory = gathered.trajectory
        return replace(
            trajectory,
            t_ns=self._world_times(log, trajectory.t_ns, started_ns),
            dropped=dict(Counter(trajectory.dropped) + Counter(lost)),
        )

    def _world_times(self, log: str, t_ns: Int64, started_ns: int) -> Int64:
        return world_times(self.settings(log).clock, t_ns, started_ns)


def _kind_of(topic: Topic) -> _Wanted | None:
    return "maps" if topic.type in MAP_TYPES else kind_of(topic)


def _start_ns(recording: Log) -> int:
    """Return the receipt time of a recording's first message, from which the drift of its clock counts."""
    return min((topic.first_ns for topic in recording.topics if topic.first_ns is not None), default=0)


def _at_times(maps: Iterator[Occupancy], from_ns: Int64) -> Iterator[Occupancy]:
    for occupancy, since_ns in zip(maps, from_ns.tolist(), strict=True):
        yield replace(occupancy, from_ns=since_ns)
