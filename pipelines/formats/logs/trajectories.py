"""Conversion of a log's samples to trajectories: of poses, of a chain of transforms, of a gimbal.

Samples are read one at a time into flat arrays (72 bytes a pose, 288 more with a covariance), so a log
of any length streams through.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.formats.logs.fixed_layouts import PoseArrays
from pipelines.formats.poses.pose_rows import clean_poses
from pipelines.geometry.arrays import Float
from pipelines.geometry.clocks import ClockFit, fit_clock
from pipelines.geometry.mounting import attitude_from_angles
from pipelines.geometry.poses import pose_covariance_in_body
from pipelines.geometry.transform_tree import Link, chain, find_route
from pipelines.session.errors import DataError
from pipelines.session.records import AngleSample, Int64, PoseSample, Sample, Trajectory

Stamps = Literal["header", "receive"]
Source = Path | str
Edge = tuple[str, str]
"""Target and source of a transform."""


@dataclass(frozen=True)
class ClockJump:
    """Jump of header stamps relative to the stamps of receipt."""

    index: int  # of the first sample after the jump, in the order of receipt
    header_ns: int  # its header stamp
    jump_s: float  # negative is backward


@dataclass(frozen=True)
class StampCheck:
    """Comparison of header stamps and stamps of receipt."""

    count: int  # samples
    without_header: int  # samples without a header stamp: that of receipt replaces it
    disagreeing: int  # others whose header and receipt stamps are further apart than allowed
    largest_disagreement_s: float  # header - receipt, where that is largest in size
    jumps: tuple[ClockJump, ...]
    drift: ClockFit | None = None  # from receipt to header, for samples with both


@dataclass(frozen=True)
class Gathered:
    """Trajectory from a log, with the check of its stamps."""

    trajectory: Trajectory
    stamps: StampCheck
    frames: Edge  # as the log names them; empty if it names none


@dataclass(frozen=True)
class TransformLog:
    """All transforms of a log, by target and source."""

    moving: Mapping[Edge, SampleRows]
    static: Mapping[Edge, SampleRows]


class SampleRows:
    """Samples of one body, gathered into flat arrays."""

    def __init__(self) -> None:
        self._header_ns = array("q")
        self._receive_ns = array("q")
        self._values = array("d")
        self._covariances = array("d")

    def __len__(self) -> int:
        return len(self._header_ns)

    def add(self, sample: PoseSample | AngleSample, values: Iterable[float]) -> None:
        """Add one sample; the number of values must always be the same."""
        self._header_ns.append(sample.stamp_ns)
        self._receive_ns.append(sample.receive_ns)
        self._values.extend(values)

    def add_pose(self, pose: PoseSample) -> None:
        """Add one pose; either all poses have a covariance or none."""
        self.add(pose, pose.position + pose.quaternion_xyzw)
        if pose.covariance is not None:
            self._covariances.frombytes(pose.covariance.tobytes())

    def values(self, width: int) -> Float:
        """Return the values [N, width]."""
        return np.frombuffer(self._values, dtype=np.float64).reshape(-1, width)

    def times(self, stamps: Stamps) -> Int64:
        """Return the stamps asked for [N]; without a header stamp, that of receipt."""
        return _times(*self._stamps(), stamps)

    def trajectory(self, source: Source, stamps: Stamps) -> Trajectory:
        """Return the poses, cleaned.

        Raises:
            DataError: none is usable.
        """
        covariance = np.frombuffer(self._covariances, dtype=np.float64).reshape(-1, 36)
        return _cleaned(source, self.times(stamps), self.values(7), covariance)

    def check(self, may_disagree_s: float, may_jump_s: float) -> StampCheck:
        """Compare the stamps of header and receipt."""
        return _compared(*self._stamps(), may_disagree_s, may_jump_s)

    def _stamps(self) -> tuple[Int64, Int64]:
        return np.frombuffer(self._header_ns, dtype=np.int64), np.frombuffer(self._receive_ns, dtype=np.int64)


def trajectory_of(
    samples: Iterable[Sample],
    source: Source,
    *,
    stamps: Stamps,
    may_disagree_s: float = 0.5,
    may_jump_s: float = 1.0,
) -> Gathered:
    """Build the trajectory of one body, in the axes of the log; covariances in ours (rotation in the body).

    Rows are cleaned by `clean_poses`, every loss counted. A covariance that is zero throughout is unknown
    and left out.

    Args:
        samples: poses in the order of receipt.
        source: the log and topic, for messages.
        stamps: which stamp is the time of a pose. A pose without a header stamp (0) takes that of receipt.
        may_disagree_s: largest allowed difference of header and receipt, for delayed transmission.
        may_jump_s: largest allowed change of that difference from one sample to the next.

    Raises:
        DataError: no usable pose, samples that are no poses, or poses of several bodies.
    """
    rows = SampleRows()
    frames: Edge | None = None
    for sample in samples:
        if not isinstance(sample, PoseSample):
            raise DataError(source, "holds no poses", "name a topic of poses")
        edge = (sample.target, sample.source)
        if frames is not None and edge != frames:
            raise DataError(
                source,
                f"holds poses of several frames ({_said(frames)}, {_said(edge)})",
                "say which with `parent` and `child`",
            )
        frames = edge
        rows.add_pose(sample)
    trajectory = rows.trajectory(source, stamps)
    return Gathered(trajectory, rows.check(may_disagree_s, may_jump_s), frames or ("", ""))


def trajectory_of_arrays(
    poses: PoseArrays,
    source: Source,
    *,
    stamps: Stamps,
    may_disagree_s: float = 0.5,
    may_jump_s: float = 1.0,
) -> Gathered:
    """Build the trajectory of poses that were read at once; arguments like those of `trajectory_of`."""
    t_ns = _times(poses.header_ns, poses.receive_ns, stamps)
    trajectory = _cleaned(source, t_ns, poses.pose, poses.covariance)
    check = _compared(poses.header_ns, poses.receive_ns, may_disagree_s, may_jump_s)
    return Gathered(trajectory, check, poses.frames)


def attitudes_of(
    samples: Iterable[Sample],
    source: Source,
    *,
    stamps: Stamps,
    order: Literal["ypr", "rpy", "pry"] = "ypr",
    units: Literal["deg", "rad"] = "deg",
    may_disagree_s: float = 0.5,
    may_jump_s: float = 1.0,
) -> Gathered:
    """Build a gimbal's attitude over time, in the axes of the log, about its own pivot (positions are 0).

    Args:
        samples: angles or quaternions in the order of receipt.
        source: the log and topic, for messages.
        stamps: as in `trajectory_of`, like the last two.
        order: order of the angles in the log (`attitude_from_angles`); ignored for quaternions.
        units: of the angles.
        may_disagree_s: see there.
        may_jump_s: see there.

    Raises:
        DataError: no usable attitude, or samples that are no angles.
    """
    rows, of_angles = SampleRows(), False
    for sample in samples:
        if not isinstance(sample, AngleSample):
            raise DataError(source, "holds no gimbal angles", "name a topic of angles or quaternions")
        of_angles = sample.angles is not None
        rows.add(sample, sample.angles or sample.quaternion_xyzw or ())
    if of_angles:
        with np.errstate(invalid="ignore"):  # an infinite angle becomes NaN and is dropped
            quaternion = attitude_from_angles(rows.values(3), order=order, units=units)
    else:
        quaternion = rows.values(4)
    trajectory = clean_poses(
        source,
        rows.times(stamps),
        np.ones(len(rows), dtype=np.bool_),
        np.zeros((len(rows), 3)),
        quaternion,
    )
    return Gathered(trajectory, rows.check(may_disagree_s, may_jump_s), ("", ""))


def transforms_of(
    samples: Iterable[Sample], source: Source, *, static: Iterable[Sample] = ()
) -> TransformLog:
    """Collect every transform of a log, between any frames; they are cleaned when used.

    Args:
        samples: of /tf and similar topics, in the order of receipt.
        source: the log, for messages.
        static: of /tf_static: these always hold.

    Raises:
        DataError: samples that are no transforms.
    """
    return TransformLog(_by_edge(samples, source), _by_edge(static, source))


def chained(
    transforms: TransformLog,
    source: Source,
    *,
    parent: str,
    child: str,
    stamps: Stamps,
    max_gap_ns: int,
    may_disagree_s: float = 0.5,
    may_jump_s: float = 1.0,
) -> Gathered:
    """Compute the pose of one frame in another over time, through the log's tree of transforms.

    The stamps are those of the transform with the highest rate on the route. A transform is static if it was
    given as such, or is logged only once, as in Foxglove's logs. Losses are counted by cause and transform.
    Stamps at which another transform on the route is unknown are counted under "no transform".

    Args:
        transforms: the transforms of the log.
        source: the log, for messages.
        parent: the frame in which the poses are wanted; a leading slash is ignored.
        child: the frame whose poses are wanted.
        stamps: as in `trajectory_of`, like the last two.
        max_gap_ns: a moving transform is unknown between stamps further apart than this.
        may_disagree_s: see there.
        may_jump_s: see there.

    Raises:
        DataError: an unknown frame, frames that nothing connects, or no time at which all the
            transforms on the route are known.
    """
    parent, child = parent.lstrip("/"), child.lstrip("/")
    every = {**transforms.static, **transforms.moving}
    try:
        route = find_route(every, parent, child)
    except ValueError as error:
        raise DataError(source, str(error), "name `parent` and `child` as the log does") from None
    links: dict[Edge, Link] = {}
    dropped: dict[str, int] = {}
    checks = []
    for edge in route.edges:
        rows = every[edge]
        poses = rows.trajectory(f"{source}: {_said(edge)}", stamps)
        is_static = edge not in transforms.moving or len(rows) == 1
        links[edge] = Link(poses.t_ns, poses.position, poses.quaternion_xyzw, is_static)
        if not is_static:
            checks.append(rows.check(may_disagree_s, may_jump_s))
            dropped |= {f"{cause} ({_said(edge)})": count for cause, count in poses.dropped.items()}
    found = chain(links, parent, child, max_gap_ns=max_gap_ns)
    known = ~np.isnan(found.position[:, 0])
    if not known.any():
        raise DataError(
            source,
            f"never states all the transforms from {parent!r} to {child!r} at one time",
            "raise --max-pose-gap, or choose other frames",
        )
    if not known.all():
        dropped["no transform"] = int(np.count_nonzero(~known))
    trajectory = Trajectory(
        found.t_ns[known], found.position[known], found.quaternion_xyzw[known], dropped=dropped
    )
    return Gathered(trajectory, _together(checks), (parent, child))


def _times(header_ns: Int64, receive_ns: Int64, stamps: Stamps) -> Int64:
    """Return the stamps asked for [N]; without a header stamp, that of receipt."""
    return receive_ns if stamps == "receive" else np.where(header_ns == 0, receive_ns, header_ns)


def _cleaned(source: Source, t_ns: Int64, pose: Float, covariance: Float | None) -> Trajectory:
    """Clean logged poses [N, 7] and covariances [N, 36]; turn rotation errors to the body's axes."""
    if covariance is not None and not covariance.any():
        covariance = None  # zero throughout means unknown
    poses = clean_poses(
        source,
        t_ns,
        np.ones(len(t_ns), dtype=np.bool_),
        pose[:, :3],
        pose[:, 3:],
        None if covariance is None else covariance.reshape(-1, 6, 6),
    )
    if poses.covariance is None:
        return poses
    return replace(poses, covariance=pose_covariance_in_body(poses.covariance, poses.quaternion_xyzw))


def _compared(header_ns: Int64, receive_ns: Int64, may_disagree_s: float, may_jump_s: float) -> StampCheck:
    (stamped,) = np.nonzero(header_ns)
    lead_ns = (header_ns - receive_ns)[stamped]
    drift = fit_clock(receive_ns[stamped], header_ns[stamped]) if lead_ns.any() else None
    jump_ns = np.diff(lead_ns)
    return StampCheck(
        count=len(header_ns),
        without_header=len(header_ns) - len(stamped),
        disagreeing=int(np.count_nonzero(np.abs(lead_ns) > may_disagree_s * 1e9)),
        largest_disagreement_s=float(lead_ns[np.argmax(np.abs(lead_ns))]) / 1e9 if len(stamped) else 0.0,
        jumps=tuple(
            ClockJump(int(stamped[k + 1]), int(header_ns[stamped[k + 1]]), float(jump_ns[k]) / 1e9)
            for k in np.flatnonzero(np.abs(jump_ns) > may_jump_s * 1e9)
        ),
        drift=drift,
    )


def _by_edge(samples: Iterable[Sample], source: Source) -> dict[Edge, SampleRows]:
    by_edge: dict[Edge, SampleRows] = {}
    for sample in samples:
        if not isinstance(sample, PoseSample):
            raise DataError(source, "holds no transforms", "name a topic of transforms")
        # ROS 1 wrote frames with and without a leading slash.
        edge = (sample.target.lstrip("/"), sample.source.lstrip("/"))
        by_edge.setdefault(edge, SampleRows()).add_pose(sample)
    return by_edge


def _together(checks: Sequence[StampCheck]) -> StampCheck:
    return StampCheck(
        count=sum(check.count for check in checks),
        without_header=sum(check.without_header for check in checks),
        disagreeing=sum(check.disagreeing for check in checks),
        largest_disagreement_s=max((c.largest_disagreement_s for c in checks), key=abs, default=0.0),
        jumps=tuple(jump for check in checks for jump in check.jumps),
        drift=next((check.drift for check in checks if check.drift), None),
    )


def _said(edge: Edge) -> str:
    target, source = edge
    return f"{source!r} in {target!r}"
