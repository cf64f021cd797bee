"""Pose of one frame in another, along a log's tree of transforms.

Every link is target_from_source over time; it can be used in both directions.
"""

import difflib
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import compose, interpolate_poses, invert


class Link(NamedTuple):
    """One edge of the tree: target_from_source, at least one row."""

    t_ns: Int64  # [N] strictly increasing
    position: Float  # [N, 3] m
    quaternion_xyzw: Float  # [N, 4] unit
    static: bool = False  # if True, the last row is valid at all times


class FrameChain(NamedTuple):
    """parent_from_child at some times; NaN where a link on the way has no pose."""

    t_ns: Int64  # [M]
    position: Float  # [M, 3] m
    quaternion_xyzw: Float  # [M, 4] unit


class Route(NamedTuple):
    """A path through the tree."""

    frames: tuple[str, ...]  # parent first, child last
    edges: tuple[tuple[str, str], ...]  # (target, source) as in the tree, one for each step of the path


def chain(
    links: Mapping[tuple[str, str], Link],
    parent: str,
    child: str,
    at_ns: Int64 | None = None,
    *,
    max_gap_ns: int,
    max_extrapolation_ns: int = 0,
) -> FrameChain:
    """Compute the pose of `child` in `parent`: interpolate every link on the shortest path and compose them.

    Args:
        links: (target, source) to target_from_source.
        parent: the frame in which the pose is wanted.
        child: the frame whose pose is wanted.
        at_ns: [M] times. The default is the stamps of the link on the path that has the most (the one
            nearest to the child among equals), so that no detail of the fastest motion is lost. A path of
            static links only has one row, at its latest stamp.
        max_gap_ns: a link has no pose between stamps that are further apart than this.
        max_extrapolation_ns: the longest time before its first and after its last stamp for which a link is
            held.

    Raises:
        ValueError: an unknown frame (the message gives the nearest known names), no path between the two,
            or the same frame twice.
    """
    route = find_route(links, parent, child)
    on_the_way = [links[edge] for edge in route.edges]
    t_ns = _default_stamps(on_the_way) if at_ns is None else at_ns
    position, quaternion = np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(t_ns), 1))
    for step, edge, link in zip(pairwise(route.frames), route.edges, on_the_way, strict=True):
        stated = _at(link, t_ns, max_gap_ns, max_extrapolation_ns)
        position, quaternion = compose((position, quaternion), stated if step == edge else invert(*stated))
    return FrameChain(t_ns, position, quaternion)


def find_route(edges: Collection[tuple[str, str]], parent: str, child: str) -> Route:
    """Find the shortest path from one frame to another, breadth first; alphabetical among equal lengths.

    Raises:
        ValueError: as in `chain`.
    """
    neighbours: dict[str, set[str]] = {}
    for target, source in edges:
        neighbours.setdefault(target, set()).add(source)
        neighbours.setdefault(source, set()).add(target)
    for frame in (parent, child):
        if frame not in neighbours:
            raise ValueError(f"there is no frame {frame!r} ({_nearest(frame, neighbours)})")
    if parent == child:
        raise ValueError(f"parent and child are both {parent!r}")
    came_from: dict[str, str] = {parent: ""}
    waiting = deque([parent])
    while waiting and child not in came_from:
        frame = waiting.popleft()
        for neighbour in sorted(neighbours[frame] - came_from.keys()):
            came_from[neighbour] = frame
            waiting.append(neighbour)
    if child not in came_from:
        connected = ", ".join(sorted(came_from.keys() - {parent})[:10])
        raise ValueError(f"no transforms connect {parent!r} with {child!r} ({parent!r} has {connected})")
    frames = [child]
    while frames[-1] != parent:
        frames.append(came_from[frames[-1]])
    frames.reverse()
    return Route(tuple(frames), tuple((a, b) if (a, b) in edges else (b, a) for a, b in pairwise(frames)))


def _at(link: Link, t_ns: Int64, max_gap_ns: int, max_extrapolation_ns: int) -> tuple[Float, Float]:
    if link.static:
        return link.position[-1:], link.quaternion_xyzw[-1:]
    return interpolate_poses(
        link.t_ns,
        link.position,
        link.quaternion_xyzw,
        t_ns,
        max_gap_ns=max_gap_ns,
        max_extrapolation_ns=max_extrapolation_ns,
    )


def _default_stamps(links: Iterable[Link]) -> Int64:
    links = list(links)
    moving = [link for link in reversed(links) if not link.static]
    if not moving:
        return np.array([max(int(link.t_ns[-1]) for link in links)], dtype=np.int64)
    return max(moving, key=lambda link: len(link.t_ns)).t_ns


def _nearest(frame: str, known: Collection[str]) -> str:
    close = difflib.get_close_matches(frame, known, n=3, cutoff=0.5)
    if close:
        return f"nearest: {', '.join(close)}"
    return f"there are {', '.join(sorted(known)[:10])}" if known else "there are no transforms"
