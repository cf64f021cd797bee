"""Poses over time: rotations, chains of transforms, and interpolation between the stamps of a log.

Quaternions are xyzw and unit; NaN in gives NaN out. A pose `target_from_source` is a position [..., 3]
(the source's origin in the target) and a quaternion [..., 4].
"""

import difflib
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int64

ENU_FROM_NED = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
"""A half turn about the diagonal between north and east: (x, y, z) -> (y, x, -z). It is its own inverse."""

# --- rotations -----------------------------------------------------------------------------------------


def matrix_from_quaternion(quaternion_xyzw: Float) -> Float:
    """Convert unit quaternions [..., 4] to rotation matrices [..., 3, 3]."""
    x, y, z, w = np.moveaxis(quaternion_xyzw, -1, 0)
    matrix = np.empty((*x.shape, 9))
    entries = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    for k, entry in enumerate(entries):
        matrix[..., k] = entry
    return matrix.reshape(*x.shape, 3, 3)


def quaternion_from_matrix(matrix: Float) -> Float:
    """Convert [..., 3, 3] to unit quaternions [..., 4], w >= 0 (Shepperd 1978: divide by the largest)."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    xw, yw, zw = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    # Every row is the quaternion times four times one of its components.
    candidates = np.stack(
        [
            np.stack([1 + xx - yy - zz, xy, xz, xw], axis=-1),
            np.stack([xy, 1 - xx + yy - zz, yz, yw], axis=-1),
            np.stack([xz, yz, 1 - xx - yy + zz, zw], axis=-1),
            np.stack([xw, yw, zw, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    unit: Float = quaternion / np.where(quaternion[..., 3:] < 0, -norm, norm)
    return unit


def multiply(left_xyzw: Float, right_xyzw: Float) -> Float:
    """Multiply quaternions: the rotation that applies `right` first, then `left`; [..., 4], broadcast."""
    ax, ay, az, aw = np.moveaxis(left_xyzw, -1, 0)
    bx, by, bz, bw = np.moveaxis(right_xyzw, -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def conjugate(quaternion_xyzw: Float) -> Float:
    """Return the inverse rotation."""
    return quaternion_xyzw * [-1.0, -1.0, -1.0, 1.0]


def rotate(quaternion_xyzw: Float, vectors: Float) -> Float:
    """Rotate vectors [..., 3] by quaternions [..., 4], broadcast."""
    axis, w = quaternion_xyzw[..., :3], quaternion_xyzw[..., 3:]
    twice = 2 * np.cross(axis, vectors)
    return vectors + w * twice + np.cross(axis, twice)


def quaternion_from_rotation_vector(rotation_vector: Float) -> Float:
    """Convert rotation vectors [..., 3] (axis times angle in rad) to unit quaternions [..., 4]."""
    half = np.linalg.norm(rotation_vector, axis=-1, keepdims=True) / 2
    # np.sinc(u) is sin(pi u)/(pi u): sin(half)/half without a division by zero.
    return np.concatenate([rotation_vector / 2 * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def rotation_vector_from_quaternion(quaternion_xyzw: Float) -> Float:
    """Convert unit quaternions [..., 4] to rotation vectors [..., 3] in rad, at most half a turn long."""
    quaternion = quaternion_xyzw * np.where(quaternion_xyzw[..., 3:] < 0, -1.0, 1.0)
    sine = np.linalg.norm(quaternion[..., :3], axis=-1, keepdims=True)
    half = np.arctan2(sine, quaternion[..., 3:])
    vector: Float = 2 * quaternion[..., :3] / np.sinc(half / np.pi)
    return vector


# --- chains of transforms ------------------------------------------------------------------------------


def invert(position: Float, quaternion_xyzw: Float) -> tuple[Float, Float]:
    """Invert a pose: return b_from_a of an a_from_b."""
    inverse = conjugate(quaternion_xyzw)
    return -rotate(inverse, position), inverse


def compose(world_from_a: tuple[Float, Float], a_from_b: tuple[Float, Float]) -> tuple[Float, Float]:
    """Compute world_from_b = world_from_a . a_from_b; poses are ([..., 3], [..., 4]), broadcast."""
    position_a, quaternion_a = world_from_a
    position_b, quaternion_b = a_from_b
    return position_a + rotate(quaternion_a, position_b), multiply(quaternion_a, quaternion_b)


def transform(target_from_source: tuple[Float, Float], points: Float) -> Float:
    """Transform points [..., 3] of the source frame to the target frame, broadcast."""
    position, quaternion = target_from_source
    return position + rotate(quaternion, points)


def look_at(position: Float, target: Float) -> Float:
    """Compute world_from_camera [..., 4] of upright cameras that look at a point; from above north is up."""
    forward = target - position
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.stack([forward[..., 1], -forward[..., 0], np.zeros(forward.shape[:-1])], axis=-1)
    level = np.linalg.norm(right, axis=-1, keepdims=True)
    right = np.where(level > 1e-9, right / np.maximum(level, 1e-9), [1.0, 0.0, 0.0])
    down = np.cross(forward, right)
    return quaternion_from_matrix(np.stack([right, down, forward], axis=-1))


# --- poses and points over time ------------------------------------------------------------------------


def interpolate_poses(
    t_ns: Int64,
    position: Float,
    quaternion_xyzw: Float,
    at_ns: Int64,
    *,
    max_gap_ns: int,
    max_extrapolation_ns: int = 0,
) -> tuple[Float, Float]:
    """Interpolate poses between strictly increasing stamps [N]: linear in position, slerp in rotation.

    At a stamp, the result is that row itself. The nearest pose is held for `max_extrapolation_ns` outside the
    log: a line through the last two rows would amplify their noise. Position [M, 3] and quaternion [M, 4] are
    NaN where the log has no pose, also between stamps further apart than `max_gap_ns`. Signs are made
    continuous from the log's first row on.
    """
    between = _bracket(t_ns, at_ns, max_gap_ns, max_extrapolation_ns)
    if not len(t_ns):
        return np.full((len(at_ns), 3), np.nan), np.full((len(at_ns), 4), np.nan)
    fraction = between.fraction[:, None]
    positions = position[between.before] + fraction * (position[between.after] - position[between.before])
    positions = np.where(between.known[:, None], positions, np.nan)
    return positions, _turned_between(quaternion_xyzw, between)


def interpolate_rotations(
    t_ns: Int64, quaternion_xyzw: Float, at_ns: Int64, *, max_gap_ns: int, max_extrapolation_ns: int = 0
) -> Float:
    """Interpolate rotations [M, 4] between strictly increasing stamps [N], as `interpolate_poses` does."""
    between = _bracket(t_ns, at_ns, max_gap_ns, max_extrapolation_ns)
    return _turned_between(quaternion_xyzw, between) if len(t_ns) else np.full((len(at_ns), 4), np.nan)


def interpolate_points(t_ns: Int64, values: Float, at_ns: Int64, *, max_gap_ns: int) -> Float:
    """Interpolate values [N, ...] linearly; NaN outside, in longer gaps, and where a neighbour is missing."""
    between = _bracket(t_ns, at_ns, max_gap_ns, 0)
    if not len(t_ns):
        return np.full((len(at_ns), *values.shape[1:]), np.nan)
    spread = (-1,) + (1,) * (values.ndim - 1)
    fraction = between.fraction.reshape(spread)
    before, after = values[between.before], values[between.after]
    points = np.where(fraction == 0, before, before + fraction * (after - before))
    return np.where(between.known.reshape(spread), points, np.nan)


def velocities(t_s: Float, values: Float, follows: Bool) -> tuple[Float, Float]:
    """Compute velocities [N, ..., D] from the sample before, and to the one that `follows`; else NaN."""
    step_s = np.diff(t_s, axis=0)
    step_s = np.where(follows & (step_s > 0), step_s, np.nan)
    between = np.diff(values, axis=0) / step_s[..., None]
    nothing = np.full_like(values[:1], np.nan)
    return np.concatenate([nothing, between]), np.concatenate([between, nothing])


def rates(t_ns: Int64, position: Float, quaternion_xyzw: Float) -> tuple[Float, Float]:
    """Compute speed [N] m/s and turn rate [N] rad/s at each stamp, from its neighbours; 0 for one pose."""
    if len(t_ns) < 2:
        return np.zeros(len(t_ns)), np.zeros(len(t_ns))
    step_s = np.diff(t_ns) / 1e9
    turned = rotation_vector_from_quaternion(multiply(conjugate(quaternion_xyzw[:-1]), quaternion_xyzw[1:]))
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / step_s
    turn_rate = np.linalg.norm(turned, axis=1) / step_s
    return _at_stamps(speed), _at_stamps(turn_rate)


def gaps(t_ns: Int64, longer_than_ns: int) -> list[tuple[int, int]]:
    """Find start and end of every gap longer than `longer_than_ns` between neighbouring stamps."""
    (before,) = np.nonzero(np.diff(t_ns) > longer_than_ns)
    return [(int(t_ns[i]), int(t_ns[i + 1])) for i in before]


def _at_stamps(of_steps: Float) -> Float:
    """Convert values between stamps [N - 1] to values at stamps [N]: the mean of both sides."""
    sides = np.concatenate([of_steps[:1], of_steps, of_steps[-1:]])
    mean: Float = (sides[:-1] + sides[1:]) / 2
    return mean


class _Bracket(NamedTuple):
    """The rows before and after every requested time."""

    before: NDArray[np.intp]
    after: NDArray[np.intp]
    fraction: Float  # 0 at `before` (and where a row is held), below 1
    known: Bool


def _bracket(t_ns: Int64, at_ns: Int64, max_gap_ns: int, max_extrapolation_ns: int) -> _Bracket:
    if (np.diff(t_ns) <= 0).any():
        raise ValueError("stamps must increase strictly")
    if not len(t_ns):
        nothing = np.zeros(len(at_ns), dtype=np.intp)
        return _Bracket(nothing, nothing, np.zeros(len(at_ns)), np.zeros(len(at_ns), dtype=np.bool_))
    held = np.clip(at_ns, t_ns[0], t_ns[-1])
    before = np.searchsorted(t_ns, held, side="right") - 1
    after = np.minimum(before + 1, len(t_ns) - 1)
    # Stamps since the epoch do not fit a double: subtract as integers, then divide.
    step, since = t_ns[after] - t_ns[before], held - t_ns[before]
    fraction = since / np.maximum(step, 1)
    known = (np.abs(at_ns - held) <= max_extrapolation_ns) & ((step <= max_gap_ns) | (since == 0))
    return _Bracket(before, after, fraction, known)


def continuous_signs(quaternion_xyzw: Float) -> Float:
    """Choose the signs of quaternions such that every row is on the same side as the row before it."""
    same_side = np.sum(quaternion_xyzw[1:] * quaternion_xyzw[:-1], axis=-1) >= 0
    flips = np.concatenate([[1.0], np.where(same_side, 1.0, -1.0)])
    return quaternion_xyzw * np.cumprod(flips)[:, None]


def _turned_between(quaternion_xyzw: Float, between: _Bracket) -> Float:
    continuous = continuous_signs(quaternion_xyzw)
    turned = _slerp(continuous[between.before], continuous[between.after], between.fraction[:, None])
    return np.where(between.known[:, None], turned, np.nan)


def _slerp(start: Float, end: Float, fraction: Float) -> Float:
    """Interpolate (slerp, Shoemake 1985) quaternions on the same side; exactly `start` at fraction 0."""
    # Half-angle form: accurate for the small angles between neighbours, where arccos is not.
    angle = 2 * np.arctan2(
        np.linalg.norm(end - start, axis=-1, keepdims=True),
        np.linalg.norm(end + start, axis=-1, keepdims=True),
    )
    sine = np.sin(angle)
    still = sine == 0
    safe = np.where(still, 1.0, sine)
    weight_start = np.where(still, 1 - fraction, np.sin((1 - fraction) * angle) / safe)
    weight_end = np.where(still, fraction, np.sin(fraction * angle) / safe)
    return weight_start * start + weight_end * end


# --- covariances ---------------------------------------------------------------------------------------

_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])


def carried_covariance(
    covariance: Float, *, position_xyzw: Float = _NO_TURN, rotation_xyzw: Float = _NO_TURN, scale: float = 1.0
) -> Float:
    """Turn the axes of positions and rotations in covariances [..., 6, 6] of poses; then scale positions."""
    turns = (matrix_from_quaternion(each) for each in (position_xyzw, rotation_xyzw))
    of_position, of_rotation = np.broadcast_arrays(*turns)
    jacobian = _block_diagonal(of_rotation)
    jacobian[..., :3, :3] = scale * of_position
    return _propagated(jacobian, covariance)


def pose_covariance_in_body(covariance: Float, world_from_body_xyzw: Float) -> Float:
    """Convert a covariance about ROS's fixed axes to the body's: R_true = exp(w) R = R exp(R' w)."""
    return carried_covariance(covariance, rotation_xyzw=conjugate(world_from_body_xyzw))


def mounted_covariance(
    covariance: Float, world_from_body_xyzw: Float, lever_arm: Float, world_from_camera_xyzw: Float
) -> Float:
    """Compute the covariance [..., 6, 6] of a camera's pose from that of the body that carries it.

    A rotation error w of the body (about world axes) moves the camera by w x (R lever_arm) and turns it by
    the same w; so it is for a gimbal that holds its attitude in the world, which it has from the body's own
    estimate. Rotation vectors are in the body, then in the camera; the lever arm [3] m is in the body.
    """
    world_from_body = matrix_from_quaternion(world_from_body_xyzw)
    camera_from_world = np.swapaxes(matrix_from_quaternion(world_from_camera_xyzw), -1, -2)
    jacobian = _block_diagonal(camera_from_world @ world_from_body)
    jacobian[..., :3, 3:] = -cross_matrix(rotate(world_from_body_xyzw, lever_arm)) @ world_from_body
    return _propagated(jacobian, covariance)


def _block_diagonal(rotation: Float) -> Float:
    """Build a map with the identity for the position and `rotation` [..., 3, 3] for the rotation vector."""
    jacobian = np.zeros((*rotation.shape[:-2], 6, 6))
    jacobian[..., :3, :3] = np.eye(3)
    jacobian[..., 3:, 3:] = rotation
    return jacobian


def cross_matrix(vector: Float) -> Float:
    """Build the matrix [..., 3, 3] whose product with a vector u is the cross product v x u."""
    matrix = np.zeros((*vector.shape, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[..., c, b], matrix[..., b, c] = vector[..., a], -vector[..., a]
    return matrix


def _propagated(jacobian: Float, covariance: Float) -> Float:
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


# --- a log's tree of transforms --------------------------------------------------------------------------


class Link(NamedTuple):
    """One edge of the tree: target_from_source, at least one row."""

    t_ns: Int64  # [N] strictly increasing
    position: Float  # [N, 3] m
    quaternion_xyzw: Float  # [N, 4] unit
    static: bool = False  # if True, each row is valid until the next, and the first before it, too


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

    The times are by default the stamps of the link on the path that has the most (the one nearest to the
    child among equals); a path of static links only has one row, at its latest stamp. Gaps and extrapolation
    are as in `interpolate_poses`. ValueError: an unknown frame (with the nearest known names), no path, or
    the same frame twice.
    """
    route = find_route(links, parent, child)
    on_the_way = [links[edge] for edge in route.edges]
    t_ns = _default_stamps(on_the_way) if at_ns is None else at_ns
    position, quaternion = np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(t_ns), 1))
    for step, edge, link in zip(pairwise(route.frames), route.edges, on_the_way, strict=True):
        stated = _link_at(link, t_ns, max_gap_ns, max_extrapolation_ns)
        position, quaternion = compose((position, quaternion), stated if step == edge else invert(*stated))
    return FrameChain(t_ns, position, quaternion)


def find_route(edges: Collection[tuple[str, str]], parent: str, child: str) -> Route:
    """Find the shortest path between frames, alphabetical among equal ones; ValueError: as in `chain`."""
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


def _link_at(link: Link, t_ns: Int64, max_gap_ns: int, max_extrapolation_ns: int) -> tuple[Float, Float]:
    if link.static:
        rows = np.searchsorted(link.t_ns[1:], t_ns, side="right")
        return link.position[rows], link.quaternion_xyzw[rows]
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
