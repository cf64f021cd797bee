"""Bodies: detections of all cameras that show one person, over all times together.

In each camera detections are joined to pieces of at most a second, where the next picture leaves no doubt.
Evidence between two pieces is the sum over time of

3^2 - s^2

where s is the distance, in standard deviations, at which the viewing rays of their common joints pass each
other. It is bounded: a gross error weighs, and does not decide. A piece that goes on in its own picture is
evidence, too, and so is the log of a person, as one more camera. Pieces of one camera at one time are two
bodies. The bodies are the partition whose sum of evidence is greatest: pieces are joined, best first, then
stretches of them are exchanged while the sum rises. So two people who stood behind each other for one camera
are told apart by all that was seen before and after it. If the rays of the bodies pass each other farther
than their standard deviations say, these are enlarged, and the bodies made again.
"""

from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64, best_pairs, known_median

# A pair of detections is one person within 3 sigma.
_AGREE_CHI2 = 9.0
# Beyond 6 sigma the penalty does not grow: a fifth of all times may have gross errors.
_MAX_CHI2 = 36.0
# A pair with this many common joints has half the weight of a complete one.
_FEW_JOINTS = 3.0
SAME_BODY_M = 0.05
"""Distance within which rays of one body pass each other: joint definitions, left for right, blur."""

_SIZE_M = (0.03, 1.5)  # median distance of joints from their middle: 0.4 m for an adult, 0.06 for a face
# Sizes of bodies with fewer joints say nothing.
_MIN_SIZED_JOINTS = 5
# Evidence of times that are nearer to each other is hardly independent.
_STEP_S = 0.1
# A wrong step from picture to picture spoils no more than this.
_PIECE_S = 1.0
# A picture is compared with later ones for this long.
_HOLD_S = 0.5
# The speed of a body in its picture is taken over this time.
_TREND_S = 0.2
# A body may shift by this share of its height at once (jitter, a gimbal's jerk), and a height per second.
_SHIFT_HEIGHTS = 0.15
# Shifts to the best and the second best detection differ by this share of the allowed one, or it is doubtful.
_CLEAR_SHIFT = 0.5
# Evidence of a picture that goes on: as much as two or three times at which all cameras agree.
_CONTINUITY = 20.0
# The mean of the better three quarters of squares of one right pair has about this median.
_USUAL_CHI2 = 0.4
# The noise that is learned, by the stated one, squared: more of it hides people who stand beside each other.
_NOISE_FACTORS2 = (0.25, 9.0)
# A change of the squared noise by this share changes no body.
_SAME_NOISE = 0.2
# The log's point (a tag, a phone, the hip) lies this far from the joints of a body.
_LOGGED_POINT_M = 0.5
# Logs with a larger standard deviation do not tell apart people who stand together.
_EXACT_LOG_M = 0.5
# As _LOGGED_POINT_M: the noise of such a log is estimated from bodies, and contains some of it.
_EXACT_POINT_M = 0.3
# A stretch ends at one of so many next places where a piece does not go on, or never.
_STRETCHES = 15
# Only the places where most evidence is lost are tried.
_BORDERS = 40
# The second round of exchanges changes little.
_ROUNDS = 4
# Bodies are found in stretches of so much time, and known again in the next one by the time in common.
_STRETCH_S, _OVERLAP_S = 20.0, 1.0
# Arrays of this many pairs of detections take 30 MB of memory.
_BLOCK = 20_000
# Rays of this many times take 10 MB.
_ROWS = 2_000


class SightLines(NamedTuple):
    """All detections of a flight."""

    xy: Float  # [T, C, D, J, 2] undistorted normalised picture coordinates, NaN where nothing is
    confidence: Float  # [T, C, D, J]; joints at 0 or NaN are not used
    position: Float  # [T, C, 3] m, world_from_camera, NaN without a pose
    rotation: Float  # [T, C, 3, 3] world_from_camera
    sigma: Float  # [T, C] rad, standard deviation of a viewing ray on each axis


class Bodies(NamedTuple):
    """Bodies of the detections: T times, C cameras, D detections."""

    track: Int64  # [T, C, D] number of the body, -1 where the detection was not usable
    views: Int64  # [T, C, D] cameras that see the body at that time; 0 where not usable
    middle: Float  # [T, C, D, 3] m, middle of the body's joints, NaN without two views
    spread: Float  # [T, C, D] m, its standard deviation on each axis
    noise: float = 1.0  # standard deviation of rays by the stated one, as learned


def find_bodies(
    time_s: Float, views: SightLines, logs: Float | None = None, before: Bodies | None = None
) -> Bodies:
    """Find the bodies of all detections at increasing times [T], with `logs` [T, A, 4] (m, deviation)."""
    # From left to right in each picture, so that the order of the input does not matter.
    given = np.where((views.confidence > 0)[..., None], views.xy, np.nan)
    x, y = np.moveaxis(known_median(given, axis=3), -1, 0)
    order = np.lexsort((y, x), axis=-1)
    views = views._replace(
        xy=np.take_along_axis(views.xy, order[..., None, None], 2),
        confidence=np.take_along_axis(views.confidence, order[..., None], 2),
    )
    seen = (views.confidence > 0) & np.isfinite(views.xy).all(axis=-1)
    posed = (
        np.isfinite(views.position).all(-1) & np.isfinite(views.rotation).all((-1, -2)) & (views.sigma > 0)
    )
    seen &= posed[..., None, None]
    seen &= (seen.sum(axis=-1) >= min(3, seen.shape[-1]))[..., None]
    track, noises2 = np.full(order.shape, -1), []
    old = None if before is None else np.take_along_axis(before.track, order, 2)
    logs = np.full((len(time_s), 0, 4), np.nan) if logs is None else logs
    for start_s in np.arange(time_s[0], time_s[-1] + 1e-9, _STRETCH_S).tolist():
        rows = slice(*np.searchsorted(time_s, [start_s - _OVERLAP_S, start_s + _STRETCH_S]).tolist())
        part = SightLines(*(each[rows] for each in views))
        before_it = None if old is None else old[rows]
        found, noise2 = _bodies_of(time_s[rows], part, seen[rows], logs[rows], before_it)
        noises2.append(noise2)
        both = (found >= 0) & (track[rows] >= 0)
        new, known = int(found.max(initial=-1)) + 1, int(track.max(initial=-1)) + 1
        shared = np.bincount(found[both] * known + track[rows][both], minlength=new * known)
        number = known + np.arange(new)
        if both.any():
            own, other = best_pairs(shared.reshape(new, known))
            same = shared.reshape(new, known)[own, other] > 0
            number[own[same]] = other[same]
        fresh = (found >= 0) & (track[rows] < 0)
        track[rows][fresh] = number[found[fresh]]
    placed = _placed(views, seen, track, np.argsort(order, axis=-1))
    return placed._replace(noise=float(np.sqrt(np.median(noises2))))


def _bodies_of(
    time_s: Float, views: SightLines, seen: Bool, logs: Float, before: Int64 | None
) -> tuple[Int64, float]:
    """Number the bodies [T, C, D] of a stretch of time, -1 for what is not usable, and learn its noise."""
    points = np.where(seen[..., None], views.xy, np.nan)
    with np.errstate(invalid="ignore"):
        away = points - known_median(points, axis=3)[..., None, :]
        size = known_median(np.linalg.norm(away, axis=-1), axis=3)
    piece, count = _pieces(time_s, points, size)
    if not count:
        return piece, 1.0
    t, c, d = np.nonzero(piece >= 0)
    number = piece[t, c, d]
    _, first = np.unique(number, return_index=True)
    nodes = count + logs.shape[1]
    start, camera, middle = np.full(nodes, -1), np.full(nodes, -1), np.full(nodes, -1.0)
    start[:count], camera[:count] = t[first], c[first]
    middle[:count] = np.bincount(number, t) / np.bincount(number)
    rows = np.flatnonzero(np.diff(np.floor((time_s - time_s[0]) / _STEP_S + 1e-9), prepend=-1.0) > 0)
    fixed, apart = _continuity(time_s, points, size, piece, nodes), _apart(piece, nodes)
    for k in range(logs.shape[1]):
        fixed[count + k, :count] = _near_log(views, seen, piece, rows, logs[:, k], count)
        fixed[:count, count + k] = fixed[count + k, :count]
    apart[count:, count:] = ~np.eye(logs.shape[1], dtype=np.bool_)
    # A piece between the times that are compared is compared where it begins.
    told = np.isin(np.arange(count), piece[rows])
    pairs = _pairs(views, seen, size, piece, np.union1d(rows, t[first][~told]))
    body: Int64 | None = None
    if before is not None:
        body = np.append(before[t[first], c[first], d[first]], np.full(logs.shape[1], -1))
        body = np.where(body < 0, body.max() + 1 + np.arange(nodes), body)
    noise2 = 1.0
    for _ in range(_ROUNDS):
        weight = (_AGREE_CHI2 - np.minimum(pairs.square / noise2, _MAX_CHI2)) * pairs.trust
        total = np.bincount(pairs.one * nodes + pairs.other, weight, nodes * nodes).reshape(nodes, nodes)
        body = _partition(fixed + total + total.T, apart, _Nodes(camera, start, middle), body)
        same = pairs.square[body[pairs.one] == body[pairs.other]]
        learned = float(np.clip(np.median(same) / _USUAL_CHI2, *_NOISE_FACTORS2)) if len(same) else noise2
        if abs(np.log(learned / noise2)) < _SAME_NOISE:
            break
        noise2 = learned
    return np.where(piece >= 0, np.asarray(body)[piece], -1), noise2


# --- pieces --------------------------------------------------------------------------------------------


def _shifts(now: Float, before: Float, size: Float, wait_s: Float) -> Float:
    """Compute shifts of bodies [..., J, 2] against earlier ones, by what is allowed; inf without a joint."""
    moved = known_median(np.linalg.norm(now - before, axis=-1), axis=-1)
    shift = moved / np.maximum(4.0 * size, 1e-12) / (_SHIFT_HEIGHTS + wait_s)
    return np.where(np.isfinite(shift), shift, np.inf)


def _pieces(time_s: Float, points: Float, size: Float) -> tuple[Int64, int]:
    """Join the detections of each camera over time; return their numbers [T, C, D] and their count."""
    usable = np.isfinite(size)
    piece = np.full(size.shape, -1, np.int64)
    second = np.floor((time_s - time_s[:1]) / _PIECE_S + 1e-9).astype(np.int64)
    step, count = max(1, _BLOCK // max(size[0].size * size.shape[2], 1)), 0
    for start in range(0, len(size), step):
        t = np.arange(max(start, 1), min(start + step, len(size)))
        shift = _shifts(
            points[t, :, :, None],
            points[t - 1, :, None],
            size[t, :, :, None],
            (time_s[t] - time_s[t - 1])[:, None, None, None],
        )
        rival = np.minimum(_rivals(shift, 2), _rivals(shift, 3))
        clear = (shift < 1.0) & (shift + _CLEAR_SHIFT <= rival)
        clear &= (second[t] == second[t - 1])[:, None, None, None]
        before = np.where(clear.any(axis=3), clear.argmax(axis=3), -1)
        for now in range(start, min(start + step, len(size))):
            old = before[now - t[0]] if now else np.full(size.shape[1:], -1)
            goes_on = old >= 0
            new = usable[now] & ~goes_on
            piece[now][goes_on] = np.take_along_axis(piece[now - 1], np.maximum(old, 0), axis=1)[goes_on]
            piece[now][new] = count + np.arange(new.sum())
            count += int(new.sum())
    return piece, count


def _rivals(shift: Float, axis: int) -> Float:
    """Return the smallest other value along an axis, for each of the values; inf without another one."""
    if shift.shape[axis] == 1:
        return np.full_like(shift, np.inf)
    least, second = np.split(np.sort(shift, axis=axis).take([0, 1], axis=axis), 2, axis=axis)
    return np.where(shift == least, second, least)


def _continuity(time_s: Float, points: Float, size: Float, piece: Int64, nodes: int) -> Float:
    """Compute the evidence [N, N] that a piece goes on in another one of its camera, at an even speed."""
    found = np.zeros((nodes, nodes))
    trend = max(1, round(_TREND_S / float(np.median(np.diff(time_s))))) if len(time_s) > 1 else 1
    for c in range(piece.shape[1]):
        t, d = np.nonzero(piece[:, c] >= 0)
        order = np.lexsort((t, piece[t, c, d]))
        t, d = t[order], d[order]
        names, first, counts = np.unique(piece[t, c, d], return_index=True, return_counts=True)
        last = first + counts - 1
        if not len(t):
            continue
        middle = known_median(points[t, c, d], axis=1)
        rates, known = [], []
        for begin, end in ((np.maximum(first, last - trend), last), (first, np.minimum(last, first + trend))):
            span_s = time_s[t[end]] - time_s[t[begin]]
            known.append(span_s > 0)
            rates.append((middle[end] - middle[begin]) / np.where(span_s > 0, span_s, 1.0)[:, None])
        wait_s = time_s[t[first]] - time_s[t[last]][:, None]
        old, new = np.nonzero((wait_s > 0) & (wait_s <= _HOLD_S))
        both = np.maximum(known[0][old].astype(int) + known[1][new], 1)[:, None]
        moved = (rates[0][old] + rates[1][new]) / both * wait_s[old, new, None]
        (t0, d0), (t1, d1) = (t[last[old]], d[last[old]]), (t[first[new]], d[first[new]])
        shift = np.full(wait_s.shape, np.inf)
        expected = points[t0, c, d0] + moved[:, None]
        shift[old, new] = _shifts(points[t1, c, d1], expected, size[t1, c, d1], wait_s[old, new])
        worth = _CONTINUITY * (shift < 1.0) / (1.0 + (shift / 0.3) ** 2)
        worth *= (_SHIFT_HEIGHTS / (_SHIFT_HEIGHTS + np.maximum(wait_s, 0.0))) ** 2
        old, new = np.nonzero(worth)
        found[names[old], names[new]] = found[names[new], names[old]] = worth[old, new]
    return found


def _apart(piece: Int64, nodes: int) -> Bool:
    """Find the pieces [N, N] that are seen side by side in one picture."""
    apart = np.zeros((nodes, nodes), np.bool_)
    for one in range(piece.shape[2]):
        for other in range(one):
            both = (piece[..., one] >= 0) & (piece[..., other] >= 0)
            apart[piece[..., one][both], piece[..., other][both]] = True
    return np.asarray(apart | apart.T)


# --- evidence ------------------------------------------------------------------------------------------


class _Pairs(NamedTuple):
    """Pairs of detections of two cameras at one time."""

    one: Int64  # [M] pieces
    other: Int64  # [M]
    square: Float  # [M] squared distance in sigma
    trust: Float  # [M] 0..1, by the common joints


def _pairs(views: SightLines, seen: Bool, size: Float, piece: Int64, rows: Int64) -> _Pairs:
    """Compare all detections of different cameras at some times."""
    cameras, detections = piece.shape[1:]
    camera = np.repeat(np.arange(cameras), detections)
    one, other = np.nonzero(camera[:, None] < camera)
    flat = piece[rows].reshape(len(rows), -1)
    row, pair = np.nonzero((flat[:, one] >= 0) & (flat[:, other] >= 0))
    parts = []
    for start in range(0, len(row), _BLOCK):
        t, k = rows[row[start : start + _BLOCK]], pair[start : start + _BLOCK]
        ends = [(t, camera[of[k]], of[k] % detections) for of in (one, other)]
        parts.append(_squares(views, seen, size, *ends))
    if not parts:
        return _Pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    square, joints = (np.concatenate(part) for part in zip(*parts, strict=True))
    enough = joints >= min(3, seen.shape[-1])
    row, pair, joints = row[enough], pair[enough], joints[enough]
    return _Pairs(
        flat[row, one[pair]], flat[row, other[pair]], square[enough], joints / (joints + _FEW_JOINTS)
    )


def _squares(
    views: SightLines, seen: Bool, size: Float, one: tuple[Int64, ...], other: tuple[Int64, ...]
) -> tuple[Float, Int64]:
    """Return the squares [M] of pairs of detections, and their numbers of joints that count."""
    (p, o, sigma_p, size_p), (q, r, sigma_q, size_q) = (
        (
            rays_of(views.xy[of], views.rotation[of[:2]]),
            views.position[of[:2]],
            views.sigma[of[:2]][:, None],
            np.where(seen[of].sum(axis=-1) >= _MIN_SIZED_JOINTS, size[of], np.nan)[:, None],
        )
        for of in (one, other)
    )
    across, base = np.cross(p, q), np.broadcast_to((r - o)[:, None], p.shape)
    sine2 = (across**2).sum(axis=-1)
    usable = seen[one] & seen[other] & (sine2 > np.maximum(4.0 * (sigma_p**2 + sigma_q**2), 1e-12))
    sine2 = np.where(usable, sine2, 1.0)
    at_p, at_q = ((np.cross(base, ray) * across).sum(axis=-1) / sine2 for ray in (q, p))
    possible = (at_p > 0) & (at_q > 0)
    lengths = np.stack([at_p * size_p, at_q * size_q])
    possible &= ~(lengths.min(axis=0) <= _SIZE_M[0]) & ~(lengths.max(axis=0) >= _SIZE_M[1])
    variance = (sigma_p * at_p) ** 2 + (sigma_q * at_q) ** 2 + SAME_BODY_M**2
    square = (base * across).sum(axis=-1) ** 2 / sine2 / variance
    most = _NOISE_FACTORS2[1] * _MAX_CHI2
    square = np.where(possible, np.minimum(square, most), most)
    count = usable.sum(axis=-1)
    ordered = np.sort(np.where(usable, square, np.inf), axis=-1)
    kept = np.maximum(1, 3 * count // 4)
    total = np.take_along_axis(np.cumsum(ordered, axis=-1), kept[:, None] - 1, axis=-1)[:, 0]
    return total / kept, count


def _near_log(views: SightLines, seen: Bool, piece: Int64, rows: Int64, log: Float, count: int) -> Float:
    """Compute the evidence [N] that each piece is a logged person [T, 4]: the median over joints."""
    row, c, d = np.nonzero((piece[rows] >= 0) & np.isfinite(log[rows, :1, None]))
    t = rows[row]
    rays = rays_of(views.xy[t, c, d], views.rotation[t, c])
    sight = log[t, :3] - views.position[t, c]
    depth = np.einsum("mjk,mk->mj", rays, sight)
    off2 = (sight**2).sum(axis=-1)[:, None] - depth**2
    point_m = np.where(log[t, 3] <= _EXACT_LOG_M, _EXACT_POINT_M, _LOGGED_POINT_M)
    variance = (views.sigma[t, c, None] * depth) ** 2 + (log[t, 3] ** 2 + point_m**2)[:, None]
    square = np.where(depth > 0, np.minimum(off2 / variance, _MAX_CHI2), _MAX_CHI2)
    median = known_median(np.where(seen[t, c, d], square, np.nan), axis=-1)
    return np.asarray(np.bincount(piece[t, c, d], _AGREE_CHI2 - median, count), np.float64)


# --- the partition -------------------------------------------------------------------------------------


class _Nodes(NamedTuple):
    """Pieces, then logs."""

    camera: Int64  # [N], -1 for a log
    start: Int64  # [N] index of the time, -1 for a log
    middle: Float  # [N] the same of its middle


def _partition(evidence: Float, apart: Bool, nodes: _Nodes, before: Int64 | None) -> Int64:
    """Divide N nodes into bodies, the sum of evidence [N, N] inside of them as large as is found."""
    tried: list[tuple[float, Int64]] = []
    for first in [_joined(evidence, apart), *([] if before is None else [before])]:
        _, body = np.unique(first, return_inverse=True)
        for _ in range(_ROUNDS):
            old = body
            body = _exchanged(evidence, apart, nodes, body)
            if np.array_equal(body, old):
                break
        tried.append((float(evidence[body[:, None] == body].sum()), body))
    return max(tried, key=lambda each: each[0])[1]


def _joined(evidence: Float, apart: Bool) -> Int64:
    """Join nodes to bodies, the pair with the most evidence first."""
    count = len(evidence)
    total, forbidden = evidence.copy(), apart.copy()
    np.fill_diagonal(forbidden, val=True)
    body = np.arange(count)
    total[forbidden] = -np.inf
    best, to = (total.max(axis=1), total.argmax(axis=1)) if count else (np.zeros(0), body)
    while count:
        k = int(best.argmax())
        if not best[k] > 0:
            break
        stay, leave = sorted((k, int(to[k])))
        body[body == leave] = stay
        total[stay] += total[leave]
        total[:, stay] = total[stay]
        total[leave] = total[:, leave] = -np.inf
        total[stay, stay] = -np.inf
        # Rows whose best was one of the two, or that like the joined one better.
        stale = np.flatnonzero((to == stay) | (to == leave) | (total[:, stay] > best))
        stale = np.append(stale, [stay, leave])
        best[stale], to[stale] = total[stale].max(axis=1), total[stale].argmax(axis=1)
    return body


def _exchanged(evidence: Float, apart: Bool, nodes: _Nodes, body: Int64) -> Int64:
    """Let stretches of one camera, or of all, change their bodies together, while the sum rises."""
    count = int(body.max(initial=-1)) + 1
    one, other = np.nonzero(evidence)
    worth = evidence[one, other]
    goes_on = (
        (nodes.camera[one] == nodes.camera[other]) & (nodes.start[one] < nodes.start[other]) & (worth > 0)
    )
    beside = np.nonzero(np.triu(apart, 1))
    for own in (nodes.camera >= 0, *(nodes.camera == c for c in range(nodes.camera.max(initial=-1) + 1))):
        mine = own[other]
        near, far, value = one[mine], other[mine], worth[mine]
        broken = goes_on[mine] & own[near] & (body[near] != body[far])
        loss = np.bincount(nodes.start[far[broken]], value[broken])
        last = int(nodes.middle.max(initial=0)) + 1
        borders = [*np.union1d(0, np.argsort(-loss, kind="stable")[: min(_BORDERS, (loss > 0).sum())]), last]
        for k, begin in enumerate(borders[:-1]):
            for end in {*borders[k + 1 : k + _STRETCHES], last}:
                moved = own & (nodes.middle >= begin) & (nodes.middle < end)
                over = moved[far] & ~moved[near]
                ends = body[near[over]] * count + body[far[over]]
                links = np.bincount(ends, value[over], count**2).reshape(count, count)
                stays, leaves = best_pairs(links)
                if links[stays, leaves].sum() <= np.trace(links) + 1e-6:
                    continue
                to = np.empty(count, np.int64)
                to[leaves] = stays
                tried = np.where(moved, to[body], body)
                if (tried[beside[0]] != tried[beside[1]]).all():
                    body = tried
    return body


# --- places --------------------------------------------------------------------------------------------


def rays_of(xy: Float, rotation: Float) -> Float:
    """Compute unit viewing rays [..., J, 3] in the world of places [..., J, 2] in a picture [..., 3, 3]."""
    ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    ray = np.einsum("...jk,...ik->...ji", ray, rotation)
    return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))


def meeting_points(rays: Float, origin: Float, weight: Float) -> tuple[Float, Float]:
    """Find points [..., 3] nearest to unit rays [..., C, 3], NaN if open, and the normal matrices."""
    rays, origin = (np.where(weight[..., None] > 0, of, 0.0) for of in (rays, origin))
    across = weight[..., None, None] * (np.eye(3) - rays[..., :, None] * rays[..., None, :])
    normal = across.sum(axis=-3)
    target = np.einsum("...cij,...cj->...i", across, origin)
    scale = np.maximum(np.trace(normal, axis1=-2, axis2=-1) / 3, np.finfo(float).tiny)
    good = ((weight > 0).sum(axis=-1) > 1) & (np.linalg.det(normal / scale[..., None, None]) > 1e-9)
    solvable = np.where(good[..., None, None], normal, np.eye(3))
    points = np.linalg.solve(solvable, target[..., None])[..., 0]
    return np.where(good[..., None], points, np.nan), solvable


def _placed(views: SightLines, seen: Bool, track: Int64, order: Int64) -> Bodies:
    """Place bodies at the median of their joints, axis by axis, so that outliers do not move it."""
    shape = track.shape
    count, spread = np.zeros(shape, np.int64), np.full(shape, np.nan)
    middle = np.full((*shape, 3), np.nan)
    for body in range(int(track.max(initial=-1)) + 1):
        mine = track == body
        with_camera = mine.any(axis=2)
        rows = np.flatnonzero(with_camera.any(axis=1))
        cameras = with_camera[rows].sum(axis=1)
        count[rows] = np.where(mine[rows], cameras[:, None, None], count[rows])
        several = rows[cameras > 1]
        for rows in (several[k : k + _ROWS] for k in range(0, len(several), _ROWS)):
            detection = mine[rows].argmax(axis=2)
            at = (rows[:, None], np.arange(shape[1]), detection)
            position = np.nan_to_num(views.position[rows])
            rays = np.moveaxis(rays_of(views.xy[at], views.rotation[rows]), 2, 1)  # [R, J, C, 3]
            sigma = np.where(with_camera[rows], views.sigma[rows], np.inf)
            weight = np.where(np.moveaxis(seen[at], 2, 1), 1.0 / sigma[:, None] ** 2, 0.0)
            points, _ = meeting_points(rays, np.broadcast_to(position[:, None], rays.shape), weight)
            place = known_median(points, axis=1)
            sight = place[:, None] - position
            reach = np.maximum(np.linalg.norm(sight, axis=-1), 1e-6)
            weight = 1.0 / (sigma * reach) ** 2
            known, normal = meeting_points(sight / reach[..., None], position, np.nan_to_num(weight))
            error = np.sqrt(np.trace(np.linalg.inv(normal), axis1=-2, axis2=-1) / 3.0)
            error = np.where(np.isfinite(known).all(axis=-1), error, np.nan)
            place = np.where(np.isfinite(error)[:, None], place, np.nan)
            spread[rows] = np.where(mine[rows], error[:, None, None], spread[rows])
            middle[rows] = np.where(mine[rows][..., None], place[:, None, None], middle[rows])
    parts = (np.take_along_axis(part, order, 2) for part in (track, count, spread))
    track, count, spread = parts
    return Bodies(track, count, np.take_along_axis(middle, order[..., None], 2), spread)
