"""Conversion of a log's messages to trajectories: of poses, of a chain of transforms, of a gimbal.

Numbers are gathered into flat arrays, so a log of any length streams through.
"""

from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.formats.logs.messages import (
    Edge,
    LoggedRows,
    Samples,
    Source,
    Stamps,
    all_samples,
    kind_of,
    samples,
)
from pipelines.formats.logs.recordings import LogPart, OpenLog, begins_like, open_parts
from pipelines.formats.poses import clean_poses
from pipelines.geometry.arrays import Int64
from pipelines.geometry.clocks import (
    MAX_STEP_S,
    StampGap,
    find_gaps,
    find_receipt_steps,
    may_step,
    steps_alike,
    time_passed,
)
from pipelines.geometry.mounting import attitude_from_angles
from pipelines.geometry.poses import Link, chain, continuous_signs, find_route, pose_covariance_in_body
from pipelines.session.errors import DataError
from pipelines.session.records import AngleSample, PoseSample, Sample, Trajectory
from pipelines.session.registries import Log

# Rounding to single precision changes positions and quaternions by less than this.
_SAME_VALUE = 1e-6
_FIXED_FRAMES = ("world", "map", "odom", "earth")  # names of fixed frames in REP 105

_THE_WORLD = Trajectory(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))
"""Identity pose, for a frame that is the log's world."""


@dataclass(frozen=True)
class Gathered:
    """Trajectory from a log, with notes on its stamps and values."""

    trajectory: Trajectory
    frames: Edge  # as the log names them; empty if it names none
    notes: tuple[str, ...] = ()


def trajectory_of(rows: LoggedRows, source: Source, stamps: Stamps) -> Trajectory:
    """Return the poses, cleaned, with covariances whose rotation is in the body's axes."""
    covariance = rows.covariance
    if covariance is not None and not covariance.any():
        covariance = None  # zero throughout means unknown
    poses = clean_poses(
        source,
        rows.times(stamps),
        np.ones(len(rows.header_ns), dtype=np.bool_),
        rows.values[:, :3],
        rows.values[:, 3:],
        None if covariance is None else covariance.reshape(-1, 6, 6),
    )
    if poses.covariance is None:
        return poses
    return replace(poses, covariance=pose_covariance_in_body(poses.covariance, poses.quaternion_xyzw))


@dataclass(frozen=True)
class TransformLog:
    """All transforms of a log, by target and source."""

    moving: Mapping[Edge, LoggedRows]
    static: Mapping[Edge, LoggedRows]


# --- poses -----------------------------------------------------------------------------------------------


def poses_of(recording: Log, topic: str, source: Source, stamps: Stamps) -> Gathered:
    """Read the trajectory of one body, in the axes of the log; covariances in ours (rotation in the body).

    Rows are cleaned by `clean_poses`. A pose without a header stamp (0) takes that of receipt. A covariance
    that is zero throughout is unknown and left out.
    """
    place = f"{source} {topic}"
    rows = logged_poses(all_samples(recording.messages([topic]), source), place)
    return Gathered(trajectory_of(rows, place, stamps), rows.frames, tuple(rows.notes(place, stamps)))


def logged_poses(samples: Iterable[Sample], source: Source) -> LoggedRows:
    """Gather the poses of one body."""
    gathered = Samples()
    frames: Edge | None = None
    for sample in samples:
        if not isinstance(sample, PoseSample):
            raise DataError(source, "holds no poses", "name a topic of poses", code="no-poses")
        edge = (sample.target, sample.source)
        if frames is not None and edge != frames:
            problem = f"holds poses of several frames ({_named(frames)}, {_named(edge)})"
            raise DataError(source, problem, "say which with `parent` and `child`")
        frames = edge
        gathered.add_pose(sample)
    return replace(gathered.rows(7), frames=frames or ("", ""))


def attitudes_of(
    samples: Iterable[Sample],
    source: Source,
    *,
    stamps: Stamps,
    order: Literal["ypr", "rpy", "pry"] = "ypr",
    units: Literal["deg", "rad"] = "deg",
) -> Gathered:
    """Build a gimbal's attitude over time, in the axes of the log, about its own pivot (positions are 0).

    `order` and `units` are those of angles (`attitude_from_angles`), ignored for quaternions.
    """
    gathered, of_angles = Samples(), False
    for sample in samples:
        if not isinstance(sample, AngleSample):
            problem = "holds no gimbal angles"
            raise DataError(source, problem, "name a topic of angles or quaternions", code="no-attitude")
        of_angles = sample.angles is not None
        gathered.add(sample.stamp_ns, sample.receive_ns, sample.angles or sample.quaternion_xyzw or ())
    rows = gathered.rows(3 if of_angles else 4)
    quaternion = rows.values
    if of_angles:
        with np.errstate(invalid="ignore"):  # an infinite angle becomes NaN and is dropped
            quaternion = attitude_from_angles(rows.values, order=order, units=units)
    count = len(rows.header_ns)
    trajectory = clean_poses(
        source, rows.times(stamps), np.ones(count, dtype=np.bool_), np.zeros((count, 3)), quaternion
    )
    return Gathered(trajectory, ("", ""), tuple(rows.notes(source, stamps)))


# --- transforms ------------------------------------------------------------------------------------------


def transforms_in(recording: Log, source: str, topic: str | None = None) -> TransformLog:
    """Read every transform of a log, or of one topic; those of topics named `...static` always hold."""
    every = [candidate.name for candidate in recording.topics if kind_of(candidate) == "transforms"]
    names = every if topic is None else [topic]
    static = [name for name in names if name.endswith("static")]
    moving = [name for name in names if name not in static]
    return transforms_of(
        all_samples(recording.messages(moving), source),
        source,
        static=all_samples(recording.messages(static), source),
    )


def transforms_of(
    samples: Iterable[Sample], source: Source, *, static: Iterable[Sample] = ()
) -> TransformLog:
    """Collect every transform of a log, cleaned when used; those of `static` always hold."""
    return TransformLog(_by_edge(samples, source), _by_edge(static, source))


def chained(
    transforms: TransformLog, source: Source, *, parent: str, child: str, stamps: Stamps, max_gap_ns: int
) -> Gathered:
    """Compute the pose of one frame in another over time, through the log's tree of transforms.

    The stamps are those of the transform with the highest rate on the route. A transform is static if it was
    given as such, or is logged only once, as in Foxglove's logs; of several values each holds from its
    publication on. A moving one is unknown between stamps further apart than `max_gap_ns`. Losses are counted
    by cause and transform; stamps at which another transform on the route is unknown under "no transform".
    """
    parent, child = parent.lstrip("/"), child.lstrip("/")
    every = {**transforms.static, **transforms.moving}
    try:
        route = find_route(every, parent, child)
    except ValueError as error:
        raise DataError(source, str(error), "name `parent` and `child` as the log does") from None
    links: dict[Edge, Link] = {}
    dropped: dict[str, int] = {}
    notes: list[str] = []
    delays_ns = [np.median(rows.receive_ns - rows.header_ns) for rows in transforms.moving.values()]
    delay_ns = int(np.median(delays_ns)) if delays_ns else 0
    for edge in route.edges:
        rows = every[edge]
        if is_static := edge not in transforms.moving or len(rows.header_ns) == 1:
            rows = _published_values(
                [log[edge] for log in (transforms.static, transforms.moving) if edge in log], delay_ns
            )
        poses = trajectory_of(rows, f"{source}: {_named(edge)}", stamps)
        links[edge] = Link(poses.t_ns, poses.position, poses.quaternion_xyzw, is_static)
        if is_static and len(poses.t_ns) > 1:
            apart_m = float(np.linalg.norm(np.diff(poses.position, axis=0), axis=1).max())
            notes.append(
                f"{source}: the static transform of {_named(edge)} has {len(poses.t_ns)} values, up to"
                f" {apart_m:.3g} m apart; each is used from its publication on"
            )
        if not is_static:
            notes += rows.notes(f"{source}: {_named(edge)}", stamps)
            dropped |= {f"{cause} ({_named(edge)})": count for cause, count in poses.dropped.items()}
    found = chain(links, parent, child, max_gap_ns=max_gap_ns)
    known = ~np.isnan(found.position[:, 0])
    if not known.any():
        problem = f"never states all the transforms from {parent!r} to {child!r} at one time"
        raise DataError(source, problem, "raise --max-pose-gap, or choose other frames")
    if not known.all():
        dropped["no transform"] = int(np.count_nonzero(~known))
    trajectory = Trajectory(
        found.t_ns[known], found.position[known], found.quaternion_xyzw[known], dropped=dropped
    )
    return Gathered(trajectory, (parent, child), tuple(notes))


def _published_values(logged: Sequence[LoggedRows], delay_ns: int) -> LoggedRows:
    """Join the rows of a static transform without repeats, by receipt, or by headers if these always rise.

    A header from before the log began says nothing of a later publication: receipt less `delay_ns`, by which
    receipts are later than headers, counts.
    """
    receive_ns = np.concatenate([rows.receive_ns for rows in logged])
    order = np.argsort(receive_ns, kind="stable")
    receive_ns = receive_ns[order]
    header_ns = np.concatenate([rows.header_ns for rows in logged])[order]
    is_old = (header_ns != 0) & (header_ns < receive_ns[0] - delay_ns)
    header_ns = np.where(is_old, receive_ns - delay_ns, header_ns)
    values = np.concatenate([rows.values for rows in logged])[order]
    kept = [0]
    for row in range(1, len(values)):
        alike = values[kept[-1]] * np.array([[1] * 7, [1] * 3 + [-1] * 4])  # both signs are one rotation
        if np.abs(values[row] - alike).max(axis=1).min() >= _SAME_VALUE:
            kept.append(row)
    if not header_ns[kept].all() or (np.diff(header_ns[kept]) <= 0).any():
        header_ns = receive_ns
    return LoggedRows(header_ns[kept], receive_ns[kept], values[kept])


def frames_of_poses(recording: Log, source: str, taken: Iterable[tuple[str | None, str | None]]) -> list[str]:
    """Return the frames of a log's poses, each once, by the topic and parent of each in `taken`."""
    topics = [topic.name for topic in recording.topics if kind_of(topic) == "poses"]
    frames: list[str] = []
    for stated, parent in taken:
        topic = topics[0] if stated is None and len(topics) == 1 else stated
        if parent is not None:
            frames.append(parent.lstrip("/"))
        elif topic in topics:
            first = next(all_samples(recording.messages([topic]), source), None)
            if isinstance(first, PoseSample):
                frames.append(first.target.lstrip("/"))
    return [frame for frame in dict.fromkeys(frames) if frame]


def place_of_frame(
    recording: Log,
    source: str,
    place: str,
    frame: str,
    *,
    parent: str | None,
    poses_in: Sequence[str],
    stamps: Stamps,
    max_gap_ns: int,
    note: Callable[[str], None],
) -> Trajectory:
    """Return the pose of a frame in the log's world; one row if it is that world or never moves in it.

    The log's world is the stated frame `parent`, else the frame of the poses that are taken from this log,
    else one with the name of a fixed frame. If the frame (empty: the world) is such a fixed frame and no
    transforms connect it with that of the poses, both are taken for one, and `note` receives that.
    """
    known = [parent.lstrip("/")] if parent is not None else [*poses_in] or list(_FIXED_FRAMES)
    if not frame or frame in known:
        return _THE_WORLD
    transforms = transforms_in(recording, source)
    for world in known:
        if _are_connected(transforms, world, frame):
            note(f"{place}: lies in {frame!r}, which the log's transforms place in {world!r}")
            return chained(
                transforms, source, parent=world, child=frame, stamps=stamps, max_gap_ns=max_gap_ns
            ).trajectory
    if parent is None and frame in _FIXED_FRAMES:
        note(
            f"{place}: lies in {frame!r}, poses in {', '.join(map(repr, poses_in))};"
            " nothing in the log connects them, they are taken for one"
        )
        return _THE_WORLD
    raise DataError(
        place,
        f"lies in {frame!r}, which no transforms of the log connect with {' or '.join(map(repr, known))}",
        f"say which frame is the log's world with `parent:` ({frame!r} itself if it does not move)",
    )


def _are_connected(transforms: TransformLog, parent: str, child: str) -> bool:
    try:
        find_route({**transforms.static, **transforms.moving}, parent, child)
    except ValueError:
        return False
    return True


def _by_edge(samples: Iterable[Sample], source: Source) -> dict[Edge, LoggedRows]:
    by_edge: dict[Edge, Samples] = {}
    for sample in samples:
        if not isinstance(sample, PoseSample):
            raise DataError(source, "holds no transforms", "name a topic of transforms")
        # ROS 1 wrote frames with and without a leading slash.
        edge = (sample.target.lstrip("/"), sample.source.lstrip("/"))
        by_edge.setdefault(edge, Samples()).add_pose(sample)
    return {edge: gathered.rows(7) for edge, gathered in by_edge.items()}


def _named(edge: Edge) -> str:
    target, source = edge
    return f"{source!r} in {target!r}"


# --- the recorder's clock ----------------------------------------------------------------------------------

# A shorter gap that motion does not explain is usual loss, and not worth a line. Where stamps scatter, a step
# of 0.1 s is found to a fifth.
_NOTED_GAP_S = 0.08
# The receipt of a message waits for less, so its clock was set among so many messages before the header's.
_IN_FLIGHT = 10


def open_recording(paths: Sequence[Path], open_part: Callable[[Path], LogPart]) -> OpenLog:
    """Open the files of a log, without steps of the recorder's clock, which `notes` of the log describe.

    All stamps of receipt step with the clock, and with them those of the headers that the same clock makes.
    Stamps that go back in the order of writing show it. A gap shows it if bodies moved on as if no time had
    passed. Headers show it to the ms, because receipt is delayed and headers are not.
    """
    log = OpenLog(*open_parts(paths, open_part))
    for recording in _recordings(log):
        if len(recording.densest) and may_step(recording.received_ns[recording.densest]):
            _take_out_gaps(recording)
    return log


class _Recording:
    """Files of a log that follow each other; rows are numbered through, in the order of writing."""

    def __init__(self, log: OpenLog, parts: Sequence[LogPart]) -> None:
        self.log = log
        self.parts = parts
        self.starts = np.cumsum([0, *(len(part.received_ns) for part in parts)])
        counts: Counter[tuple[str, str, str]] = Counter()
        for part in parts:
            numbers, found = np.unique(part.table.channel, return_counts=True)
            for number, count in zip(numbers.tolist(), found.tolist(), strict=True):
                counts[part.channels[number].key] += count
        rows = [np.zeros(0, np.int64)]
        if counts:
            key = max(counts, key=counts.__getitem__)
            for part, start in zip(parts, self.starts.tolist(), strict=False):
                own = [number for number, channel in part.channels.items() if channel.key == key]
                rows.append(part.rows_of(own) + start)
        self.densest: Int64 = np.sort(np.concatenate(rows))

    @property
    def received_ns(self) -> Int64:
        """Stamps of receipt, as far as they are mended."""
        return np.concatenate([part.received_ns for part in self.parts])

    def take_out(self, row: int, step_ns: int) -> None:
        """Take a step of the clock out, from a row on."""
        place = int(np.searchsorted(self.starts, row, side="right")) - 1
        self.log.take_out(self.parts[place], row - int(self.starts[place]), step_ns)


def _recordings(log: OpenLog) -> list[_Recording]:
    """Join the files that begin where the file before them ends, as far as a clock steps."""
    joined: list[list[LogPart]] = []
    for part in log.parts:
        if not len(part.received_ns):
            continue
        last = joined[-1][-1] if joined else part
        pause_s = abs(int(part.received_ns[0] - last.received_ns[-1])) / 1e9
        if joined and pause_s < MAX_STEP_S + _NOTED_GAP_S:
            joined[-1].append(part)
        else:
            joined.append([part])
    return [_Recording(log, parts) for parts in joined]


@dataclass(frozen=True)
class LogFile:
    """Reader of logs in files of one kind: `magic` are their first bytes, `open_part` opens one of them."""

    name: str
    title: str
    suffixes: tuple[str, ...]
    magic: bytes
    open_part: Callable[[Path], LogPart]

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with the magic bytes, or is empty and named like such a file."""
        return begins_like(path, self.magic, self.suffixes)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe messages, times, storage, topics, and losses."""
        with self.open_log([path]) as log:
            return log.describe()

    def open_log(self, paths: Sequence[Path]) -> OpenLog:
        """Open one file, or the parts of a split one."""
        return open_recording(paths, self.open_part)


def _take_out_gaps(recording: _Recording) -> None:
    """Take steps of the clock out of a recording."""
    bodies = _written_bodies(recording)
    received_ns, header_gaps = recording.received_ns, []
    if bodies and (header_ns := bodies[0].header_ns).all():
        rows = bodies[0].receive_ns
        lead_ns = header_ns - received_ns[rows]
        header_gaps = [(rows, gap) for gap in find_gaps(header_ns) if steps_alike(lead_ns, gap)]
    densest = recording.densest
    for rows, gap in header_gaps or [(densest, gap) for gap in find_gaps(received_ns[densest])]:
        _take_out_gap(recording, rows, gap, bodies)
    if bodies and bodies[0].header_ns.all():
        rows = bodies[0].receive_ns
        for index, step_s in find_receipt_steps(bodies[0].header_ns, recording.received_ns[rows]):
            recording.take_out(int(rows[index]), round(step_s * 1e9))
            after_s = float(received_ns[rows[index - 1]] - received_ns[0]) / 1e9
            recording.log.notes.append(
                f"the stamps of receipt step by {step_s:+.3f} s at {after_s:.2f} s against those of headers;"
                " taken out"
            )


def _written_bodies(recording: _Recording) -> list[LoggedRows]:
    """Return a topic's bodies with most poses, densest first, as written; rows' numbers stand for stamps."""
    log = recording.log
    topics = [topic for topic in log.topics if kind_of(topic) in {"poses", "transforms"} and topic.count]
    if not topics:
        return []
    name = max(topics, key=lambda topic: topic.count).name
    bodies: dict[Edge, Samples] = {}
    for part, start in zip(recording.parts, recording.starts.tolist(), strict=False):
        received_ns, part.received_ns = part.received_ns, start + np.arange(len(part.received_ns))
        try:
            for sample in all_samples(log.messages_of(part, [name]), "log"):
                if isinstance(sample, PoseSample):
                    bodies.setdefault((sample.target, sample.source), Samples()).add_pose(sample)
        finally:
            part.received_ns = received_ns
            log.forget()
    return sorted((body.rows(7) for body in bodies.values()), key=lambda body: -len(body.values))


def _take_out_gap(recording: _Recording, rows: Int64, gap: StampGap, bodies: list[LoggedRows]) -> None:
    """Take out a step of the clock that is the gap between two rows; note it."""
    log, received_ns = recording.log, recording.received_ns
    before, last = rows[[max(gap.index - _IN_FLIGHT, 0), gap.index]].tolist()
    leaps_s = np.diff(received_ns[before : last + 1]) / 1e9
    row = last - int(np.argmax(leaps_s[::-1] * np.sign(gap.excess_s)))  # the last one of equal leaps
    uneven_s = float(np.quantile(np.abs(np.diff(received_ns[rows]) / 1e9 - gap.usual_s), 0.9))
    between_s = float(np.median(np.diff(received_ns[recording.densest]))) / 1e9
    off_s = abs(leaps_s[row - before - 1] - gap.excess_s)
    if not gap.goes_back and off_s > max(1.5 * min(between_s, gap.usual_s), abs(gap.excess_s) / 4) + uneven_s:
        return  # other messages were received in the gap
    started_ns = min(int(each.received_ns.min()) for each in log.parts if len(each.received_ns))
    after_s = (int(received_ns[rows[gap.index - 1]]) - started_ns) / 1e9
    told = f"all stamps step by {gap.excess_s:+.3f} s at {after_s:.2f} s"
    stepped = True if gap.goes_back else _clock_stepped(received_ns, bodies, gap, last)
    if stepped and abs(gap.excess_s) <= MAX_STEP_S:
        recording.take_out(row, round(gap.excess_s * 1e9))
        log.notes.append(f"{told}: the recorder's clock was set; taken out")
    elif stepped or (stepped is None and abs(gap.excess_s) >= _NOTED_GAP_S):
        log.notes.append(
            f"{told}: the log does not tell if its clock was set or messages were lost; not taken out"
        )


def _clock_stepped(received_ns: Int64, bodies: list[LoggedRows], gap: StampGap, row: int) -> bool | None:
    """Test by all bodies if a clock was set in a gap that ends at a row; None if none tells."""
    found: set[bool] = set()
    for body in bodies:
        at = int(np.searchsorted(body.receive_ns, row))
        if not 0 < at < len(body.receive_ns):
            continue
        t_ns = body.header_ns if body.header_ns.all() else received_ns[body.receive_ns]
        own = replace(gap, usual_s=float(np.median(np.diff(t_ns))) / 1e9)  # another topic may show the gap
        if abs(int(t_ns[at] - t_ns[at - 1]) / 1e9 - own.usual_s - gap.excess_s) > abs(gap.excess_s) / 4:
            return False  # the headers have a clock of their own
        for values in (body.values[:, :3], continuous_signs(body.values[:, 3:])):
            passed = time_passed(t_ns, values, own, at)
            found |= set() if passed is None else {not passed}
    return found.pop() if len(found) == 1 else None


# --- commanded positions ---------------------------------------------------------------------------------
# A plan looks ahead and is replaced by the next one: each is valid up to the first point of the next.

PATH = "nav_msgs/msg/Path"
"""Message type that is read here; setpoints that are poses (PoseStamped, Odometry) are read as poses."""


def read_commands(recording: Log, source: str, topic: str, stamps: Stamps) -> Trajectory:
    """Read the positions that a topic of `PATH` commanded, in the axes of the log; rotations have no meaning.

    By the stamps of receipt, a plan begins at the time of its receipt. Empty plans are counted.
    """
    t_ns, position, empty = array("q"), array("d"), 0
    for message in recording.messages([topic]):
        points = [point for point in samples(message, source) if isinstance(point, PoseSample)]
        empty += not points
        if any(later.stamp_ns <= earlier.stamp_ns for earlier, later in pairwise(points)):
            problem = f"topic {topic}: the points of a plan have no times of their own"
            raise DataError(source, problem, "name a topic of setpoints instead")
        for number, point in enumerate(points):
            late_ns = message.receive_ns - points[0].stamp_ns if stamps == "receive" else 0
            if not number:  # a later plan replaces all earlier points from its first time on
                kept = bisect_left(t_ns, point.stamp_ns + late_ns)
                del t_ns[kept:], position[3 * kept :]
            t_ns.append(point.stamp_ns + late_ns)
            position.extend(point.position)
    count = len(t_ns)
    found = clean_poses(
        f"{source} {topic}",
        np.frombuffer(t_ns, dtype=np.int64),
        np.ones(count, dtype=np.bool_),
        np.frombuffer(position, dtype=np.float64).reshape(-1, 3),
        np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
    )
    found.dropped.update(+Counter({"empty plan": empty}))
    return found
