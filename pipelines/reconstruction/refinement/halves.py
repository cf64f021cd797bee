"""Halves of a flight, eliminated in parallel from both ends until they meet in the middle.

The equations are symmetric in time. With times, pictures and knots in the opposite order, the second half is
a flight like the first and uses the same kernels. The same unknowns are alive at the end of both halves: the
joints at two times, the knots around them, and the unknowns shared by all times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.refinement.problem import State
from pipelines.reconstruction.refinement.system import System

Int64 = NDArray[np.int64]
Value = TypeVar("Value", bound=np.generic)


@dataclass(frozen=True)
class Half:
    """One half, in the order of its elimination; T times, the last two shared with the other half."""

    system: System
    turned: bool
    meeting: int  # the first of the flight's two times at which the halves meet
    pictures: int  # of the flight, that belong to the first half
    t_s: Float  # [T] decreasing in the turned half
    of_time: Int64  # [T - 1] the knot before each eliminated time, and before the meeting
    starts: Int64  # [T - 1] index of the first picture of each time
    of_pictures: tuple[Any, ...]  # camera, time, fraction, `System.picture_arguments`, row of the white error
    curvature: Float  # [T - 2, 3] weights of three positions for their acceleration
    spread: Float  # [T - 2] its variance relative to the usual
    tie_before: Float  # [K - 1, c] prior of a tie: tie_before * knot - tie_after * next knot has mean 0
    tie_after: Float  # [K - 1, c] factor of the next knot
    tie_variance: Float  # [K - 1, c] variance of that difference; inf if the tie belongs to the other half

    @property
    def knot_t_s(self) -> Float:
        """Times of the knots [K]."""
        knot_t_s = self.system.layout.knot_t_s
        return _turned(knot_t_s) if self.turned else knot_t_s

    @property
    def count(self) -> int:
        """Number of eliminated times."""
        return len(self.t_s) - 2

    @property
    def own_times(self) -> int:
        """Number of the last three times that belong to this half; those of the meeting are the first's."""
        return 1 if self.turned else 3

    def of_times(self, values: NDArray[Value]) -> NDArray[Value]:
        """Return this half's part of values [T', ...] at the flight's times."""
        return _turned(values[self.meeting :]) if self.turned else values[: self.meeting + 2]

    def state(self, state: State) -> State:
        """Return this half's part of a state, with all knots."""
        return State(
            self.of_times(state.position),
            _turned(state.knots) if self.turned else state.knots,
            state.shared,
            _turned(state.white[self.pictures :]) if self.turned else state.white[: self.pictures],
        )

    def met(self) -> Int64:
        """Return the place of each unknown alive at the meeting, in the order of the first half."""
        n, c = 3 * self.system.problem.joints, self.system.layout.knot_count
        place = np.arange(2 * n + 2 * c + self.system.layout.shared_count)
        if self.turned:
            joints, knots = place[: 2 * n].reshape(2, n), place[2 * n : 2 * n + 2 * c].reshape(2, c)
            joints[:], knots[:] = joints[::-1].copy(), knots[::-1].copy()
        return place

    def arguments(self, part: State) -> tuple[Any, ...]:
        """Collect the arguments of the sweeps: the half and its linearisation point."""
        system = self.system
        camera, when_s, fraction, *seen, white_row = self.of_pictures
        return (
            self.t_s,
            part.position,
            part.knots,
            part.shared,
            part.white,
            self.starts,
            camera,
            when_s,
            fraction,
            self.of_time,
            *seen,
            system.bound2,
            white_row,
            system.white_precision,
            *system.entries(),
            system.layout.knot_count,
            self.curvature,
            self.spread,
        )


def halved(system: System) -> tuple[Half, Half]:
    """Split a flight of at least three times in the middle."""
    return parted(system, (len(system.problem.t_s) - 1) // 2)


def parted(system: System, meeting: int) -> tuple[Half, Half]:
    """Split a flight of T times at any meeting time from 1 to T - 2."""
    pictures = int(np.searchsorted(system.problem.pictures.first, meeting))
    return _half(system, meeting, pictures, turned=False), _half(system, meeting, pictures, turned=True)


def _half(system: System, meeting: int, pictures: int, *, turned: bool) -> Half:
    problem, seen = system.problem, system.problem.pictures
    last_interval = max(len(problem.knot_t_s) - 2, 0)
    met_at = int(system.of_time[min(meeting, len(system.of_time) - 1)])
    variance = system.tie_variance
    if turned:
        mine, t_s = slice(pictures, None), _turned(problem.t_s[meeting:])
        first = len(problem.t_s) - 3 - seen.first[mine]
        of_time = last_interval - np.append(system.of_time[meeting:][::-1], met_at)
        variance = variance.copy()
        variance[met_at] = np.inf
    else:
        mine, t_s = slice(0, pictures), problem.t_s[: meeting + 2]
        first = seen.first[mine]
        of_time = np.append(system.of_time[:meeting], met_at)
    order: Callable[[NDArray[Any]], NDArray[Any]] = _turned if turned else np.ascontiguousarray
    ties = system.tie_kept, np.ones_like(system.tie_kept)
    tie_before, tie_after = ties[::-1] if turned else ties
    before, after = np.diff(t_s)[:-1], np.diff(t_s)[1:]
    return Half(
        system=system,
        turned=turned,
        meeting=meeting,
        pictures=pictures,
        t_s=t_s,
        of_time=of_time,
        starts=np.searchsorted(order(first), np.arange(len(t_s) - 1)),
        of_pictures=tuple(
            order(values[mine])
            for values in (
                seen.camera,
                seen.when_s,
                1 - system.fraction if turned else system.fraction,
                *system.picture_arguments(),
                system.white_row,
            )
        ),
        curvature=np.stack(
            [2 / (before * (before + after)), -2 / (before * after), 2 / (after * (before + after))], axis=1
        ),
        spread=system.usual_step_s / np.abs(0.5 * (before + after)),
        tie_before=order(tie_before),
        tie_after=order(tie_after),
        tie_variance=order(variance),
    )


def _turned(values: NDArray[Value]) -> NDArray[Value]:
    """Reverse values into a contiguous array, the layout that everything is compiled for."""
    return np.ascontiguousarray(values[::-1])
