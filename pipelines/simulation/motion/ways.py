"""Ways over the ground: lines, arcs and corners that a body can follow, and the speed along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipelines.geometry.arrays import Float

_SPACING_M = 0.02
_ROUNDED_M = 0.4  # a corner is cut over this far on either side


@dataclass(frozen=True)
class Part:
    """A straight line or an arc."""

    length_m: float
    heading: float  # rad at its beginning, counterclockwise from east
    turn: float  # rad to the left over its length
    speed_mps: float  # as requested
    run: float  # 0 if walked, 1 if run

    @property
    def end_heading(self) -> float:
        """Heading at the end, rad."""
        return self.heading + self.turn

    def end(self, start: Float) -> Float:
        """Return the end point [2], m."""
        return np.asarray(self._points(start, np.array([self.length_m]))[0])

    def _points(self, start: Float, along_m: Float) -> Float:
        """Return points [N, 2] m of the way; straight on beyond its ends."""
        if abs(self.turn) < 1e-9:
            ahead, left = along_m, np.zeros_like(along_m)
        else:
            angle = np.clip(along_m, 0.0, self.length_m) * self.turn / self.length_m
            radius = self.length_m / self.turn
            over = along_m - np.clip(along_m, 0.0, self.length_m)
            ahead = radius * np.sin(angle) + over * np.cos(angle)
            left = radius * (1 - np.cos(angle)) + over * np.sin(angle)
        cosine, sine = np.cos(self.heading), np.sin(self.heading)
        moved = np.stack([cosine * ahead - sine * left, sine * ahead + cosine * left], axis=1)
        return np.asarray(start + moved, dtype=np.float64)


class Way:
    """Parts one after the other, smoothed so that position and heading bend without a jerk.

    Every point is the mean, weighed by a raised cosine, of the points within 0.4 m of it on the way: lines
    stay straight, an arc of radius r shrinks by 1 cm^2 / r, corners are cut, and both ends are kept.
    """

    def __init__(self, start: Float, parts: Sequence[Part]) -> None:
        from scipy.interpolate import CubicSpline

        self.length_m = sum(part.length_m for part in parts)
        margin = 2 * _ROUNDED_M
        count = int(np.ceil((self.length_m + 2 * margin) / _SPACING_M)) + 1
        along = np.linspace(-margin, self.length_m + margin, count)
        points = np.empty((count, 2))
        begin, place = 0.0, np.asarray(start, dtype=np.float64)
        for index, part in enumerate(parts):
            inside = along >= begin if index else np.ones(count, dtype=bool)
            points[inside] = part._points(place, along[inside] - begin)
            begin, place = begin + part.length_m, part.end(place)
        half = int(_ROUNDED_M / (along[1] - along[0]))
        weight = 1 + np.cos(np.pi * np.arange(-half, half + 1) / (half + 1))
        weight /= weight.sum()
        smooth = np.stack([np.convolve(points[:, axis], weight, mode="valid") for axis in (0, 1)], axis=1)
        inner = along[half : len(along) - half]
        self._spline = CubicSpline(inner, smooth)
        tangent = self._spline(inner, 1)
        heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        # Before and after an arc the way goes straight on, so that the mean bends less at its ends.
        ends = np.interp([0.0, self.length_m], inner, heading)
        missing = [parts[0].heading - ends[0], parts[-1].end_heading - ends[1]]
        heading += np.interp(inner, [0.0, self.length_m], missing)
        self._heading = CubicSpline(inner, heading)

    def place(self, along_m: Float) -> tuple[Float, Float]:
        """Compute the place [N, 2] m after some way, and the heading [N] in rad."""
        return (
            np.asarray(self._spline(along_m), dtype=np.float64),
            np.asarray(self._heading(along_m), dtype=np.float64),
        )


@dataclass(frozen=True)
class Pace:
    """Speeds over time, as knots: time in s from the start, speed in m/s, share of running."""

    knots: tuple[tuple[float, float, float], ...]


def pace(parts: Sequence[Part], *, walk_mps2: float = 0.9, run_mps2: float = 1.9) -> Pace:
    """Compute speeds over time from a stand to a stand.

    Each part has its own speed where it is long enough for that.

    Speed goes from one knot to the next as a smooth step, at `walk_mps2` or `run_mps2` on average; where a
    part is slower than the next, it is slower to its end.
    """
    gains = [run_mps2 if part.run else walk_mps2 for part in parts]
    between = [0.0, *(min(a.speed_mps, b.speed_mps) for a, b in pairwise(parts)), 0.0]
    for i, (part, gain) in enumerate(zip(parts, gains, strict=True)):
        between[i + 1] = min(between[i + 1], (between[i] ** 2 + 2 * gain * part.length_m) ** 0.5)
    for i in reversed(range(len(parts))):
        between[i] = min(between[i], (between[i + 1] ** 2 + 2 * gains[i] * parts[i].length_m) ** 0.5)
    knots = [(0.0, 0.0, parts[0].run)]
    for i, (part, gain) in enumerate(zip(parts, gains, strict=True)):
        enter, leave = between[i], between[i + 1]
        peak = min(part.speed_mps, ((enter**2 + leave**2) / 2 + gain * part.length_m) ** 0.5)
        ramps_m = (2 * peak**2 - enter**2 - leave**2) / (2 * gain)
        for lasting, speed in (
            ((peak - enter) / gain, peak),
            ((part.length_m - ramps_m) / peak, peak),
            ((peak - leave) / gain, leave),
        ):
            if lasting > 1e-6:
                knots.append((knots[-1][0] + lasting, speed, part.run))
    return Pace(tuple(knots))
