"""Joint estimate of a long flight: windows of it are estimated apart, because memory grows with their length.

Neighbours overlap. About the middle of the overlap the result goes over from one window to the other by a
polynomial whose first two derivatives are continuous, so that speeds and accelerations are. The covariance of
such a mean a X + (1 - a) Y is taken as a Cov X + (1 - a) Cov Y, which is its upper bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.noise import PoseErrors
from pipelines.reconstruction.refinement.refine import Refined, refine
from pipelines.reconstruction.refinement.system import Sighting
from pipelines.session.memory import available_bytes
from pipelines.session.parallel import each_part

# A window of this length and so many keypoints takes less than 1 GB.
MAX_WINDOW_S = 180.0
MAX_KEYPOINTS = 280_000
# The levels of errors cannot be learned from a shorter window, however many keypoints it has.
MIN_WINDOW_S = 30.0
# Neighbours share this time, so that the ends of both are not used.
OVERLAP_S = 10.0
# The result goes over from one window to the next within this time.
BLENDED_S = 6.0
# Pictures of other cameras are needed this long before and after the times of a window.
AROUND_S = 2.0
# Unknown clocks are those of the whole flight: so many windows determine them.
CLOCK_WINDOWS = 3
# A process that estimates a window takes so much memory.
WINDOW_BYTES = 1 << 30


@dataclass(frozen=True)
class Window:
    """A stretch of a flight."""

    first: int  # of the skeleton's times
    stop: int
    begin_s: float  # where it takes over from the window before; -inf for the first
    end_s: float

    def shares(self, t_s: Float) -> Float:
        """Compute its weight [T] in the result at given times: 1 in the middle, 0 outside."""
        return _risen(t_s - self.begin_s) * (1.0 - _risen(t_s - self.end_s))


def windows_of(t_s: Float, keypoints: int) -> list[Window]:
    """Divide the skeleton's times [T] into windows of equal length; a short flight is one.

    Args:
        t_s: the times.
        keypoints: at one time, of all joints in all cameras.
    """
    lasts_s = float(t_s[-1] - t_s[0])
    by_memory = min(len(t_s) * keypoints / MAX_KEYPOINTS, lasts_s / MIN_WINDOW_S)
    count = int(np.ceil(max(lasts_s / MAX_WINDOW_S, by_memory, 1.0)))
    edges = t_s[0] + np.linspace(0.0, lasts_s, count + 1)
    edges[0], edges[-1] = -np.inf, np.inf
    reach_s = OVERLAP_S / 2
    found = []
    for begin_s, end_s in pairwise(edges.tolist()):
        first, stop = np.searchsorted(t_s, (begin_s - reach_s, end_s + reach_s)).tolist()
        found.append(Window(first, stop, begin_s, end_s))
    return found


def spread(windows: Sequence[Window]) -> list[Window]:
    """Choose the windows that determine the clocks."""
    rows = np.linspace(0, len(windows) - 1, min(CLOCK_WINDOWS, len(windows))).round().astype(int)
    return [windows[row] for row in rows.tolist()]


@dataclass(frozen=True)
class _Order:
    """Arguments of `refine`."""

    t_s: Float
    sightings: tuple[Sighting, ...]
    start: Float
    bones: Int64
    prior: list[PoseErrors] | None
    clock_sigma_s: Float
    measured: bool

    def within(self, window: Window) -> _Order:
        """Take the data of a window."""
        own = slice(window.first, window.stop)
        t_s = self.t_s[own]
        around = t_s[0] - AROUND_S, t_s[-1] + AROUND_S
        later_s = float(t_s[0] - self.t_s[0])
        return replace(
            self,
            t_s=t_s,
            sightings=tuple(_within(sighting, *around) for sighting in self.sightings),
            start=self.start[own],
            prior=None if self.prior is None else [errors.later(later_s) for errors in self.prior],
        )


def refine_in_windows(
    t_s: Float,
    sightings: Sequence[Sighting],
    start: Float,
    bones: Int64,
    prior: Sequence[PoseErrors] | None,
    clock_sigma_s: Float,
    *,
    windows: Sequence[Window],
    measured: bool = False,
    workers: int = 1,
    executor: Executor | None = None,
) -> Refined:
    """Run `refine`, whose arguments these are, on some windows, and join the results.

    Joints outside the windows, and in a window that was refused, are NaN. The clocks are medians of the
    windows. The result is refused if all windows are.

    Args:
        windows: those of `windows_of`, or some of them.
        workers: the number of processes, as far as memory allows.
        executor: works on the windows instead.
    """
    levels = None if prior is None else list(prior)
    whole = _Order(t_s, tuple(sightings), start, bones, levels, clock_sigma_s, measured)
    if len(windows) == 1 and windows[0].stop - windows[0].first == len(t_s):
        return _refine(whole)
    if executor is None:
        memory = available_bytes()
        workers = workers if memory is None else min(workers, max(memory // WINDOW_BYTES, 1))
    orders = [whole.within(window) for window in windows]
    joined = _Joined(whole)
    parts: list[Refined | None] = [None] * len(windows)
    for number, found in each_part(_refine, orders, workers=workers, executor=executor):
        joined.add(windows[number], found)
        parts[number] = replace(found, position=start[:0], covariance=start[:0], corrections=())
    return joined.refined([part for part in parts if part is not None])


def _refine(order: _Order) -> Refined:
    return refine(
        order.t_s,
        order.sightings,
        order.start,
        order.bones,
        order.prior,
        order.clock_sigma_s,
        measured=order.measured,
    )


class _Joined:
    """Weighted sums over windows; at most two contribute to a time, so that their order does not count."""

    def __init__(self, whole: _Order) -> None:
        self._t_s, shape = whole.t_s, whole.start.shape
        self._weight = np.zeros(shape[:2])
        self._position, self._covariance = np.zeros(shape), np.zeros((*shape, 3))
        self._frames = [sighting.t_s for sighting in whole.sightings]
        self._numbers = [np.zeros((len(frames), 11)) for frames in self._frames]  # and their weight

    def add(self, window: Window, found: Refined) -> None:
        """Add the result of a window, unless it was refused."""
        if found.fallback is not None:
            return
        own = slice(window.first, window.stop)
        there = np.isfinite(found.position[..., 0])
        weight = window.shares(self._t_s[own])[:, None] * there
        self._weight[own] += weight
        self._position[own] += weight[..., None] * np.nan_to_num(found.position)
        self._covariance[own] += weight[..., None, None] * np.nan_to_num(found.covariance)
        for frames, sums, (when, numbers) in zip(self._frames, self._numbers, found.corrections, strict=True):
            shares = window.shares(frames)
            (used,) = np.nonzero(shares)
            for column in range(10 if len(when) else 0):
                sums[used, column] += shares[used] * np.interp(frames[used], when, numbers[:, column])
            sums[used, 10] += shares[used]

    def refined(self, parts: Sequence[Refined]) -> Refined:
        """Return the result of the flight; `parts` have what is no function of time."""
        used = [part for part in parts if part.fallback is None]
        if not used:
            return replace(parts[0], position=np.full_like(self._position, np.nan))
        with np.errstate(invalid="ignore", divide="ignore"):
            position = self._position / self._weight[..., None]
            covariance = self._covariance / self._weight[..., None, None]
        numbers = [sums[:, :10] / np.maximum(sums[:, 10:], 1e-12) for sums in self._numbers]
        warnings = dict.fromkeys(line for part in used for line in part.warnings)
        if len(used) < len(parts):
            reason = next(part.fallback for part in parts if part.fallback is not None)
            count = f"{len(parts) - len(used)} of {len(parts)} windows"
            warnings[f"refined: {count} fell back to robust, the first because {reason}"] = None
        names = dict.fromkeys(name for part in used for name in part.levels)
        return replace(
            used[0],
            position=position,
            covariance=covariance,
            corrections=tuple(zip(self._frames, numbers, strict=True)),
            clock_offset_s=np.median([part.clock_offset_s for part in used], axis=0),
            clock_sigma_s=np.median([part.clock_sigma_s for part in used], axis=0),
            levels={
                name: float(np.mean([part.levels[name] for part in used if name in part.levels]))
                for name in names
            },
            learned=any(part.learned for part in used),
            warnings=tuple(warnings),
        )


def _within(sighting: Sighting, first_s: float, last_s: float) -> Sighting:
    """Take a camera's pictures of a span of time."""
    rows = slice(*np.searchsorted(sighting.t_s, (first_s, last_s)).tolist())
    of_pictures = ("t_s", "rays", "confidence", "position", "rotation", "pose_covariance", "loosened")
    values = {name: getattr(sighting, name) for name in of_pictures}
    return replace(sighting, **{name: value[rows] for name, value in values.items() if value is not None})


def _risen(late_s: Float) -> Float:
    u = np.clip(late_s / BLENDED_S + 0.5, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2), dtype=np.float64)
