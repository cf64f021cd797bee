"""Numbers that change over time, given at a few moments; actions write them and bodies read them."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float

_SAME_MOMENT_S = 1e-6


class Keys:
    """Named curves through key values; a curve without keys is 0.

    Between keys a curve is the monotone cubic of Fritsch & Carlson 1980: its slope is continuous, it never
    leaves the span of two neighbouring keys, and it stays exactly constant between equal ones. This keeps a
    planted foot in its place. Before the first and after the last key the curve is constant.
    """

    def __init__(self) -> None:
        self._keys: dict[str, list[tuple[float, float]]] = {}

    def add(self, name: str, *keys: tuple[float, float]) -> None:
        """Append (time in s, value) pairs; a pair at or before the time of the last key replaces that key."""
        curve = self._keys.setdefault(name, [])
        for t_s, value in keys:
            while curve and curve[-1][0] >= t_s - _SAME_MOMENT_S:
                curve.pop()
            curve.append((t_s, value))

    def last(self, name: str) -> float:
        """Return the last value of a curve."""
        curve = self._keys.get(name)
        return curve[-1][1] if curve else 0.0

    def pulse(self, name: str, *keys: tuple[float, float]) -> None:
        """Append keys of something that departs from 0 and returns to it: the first and last value are 0."""
        self.add(name, (keys[0][0], 0.0), *keys[1:-1], (keys[-1][0], 0.0))

    def at(self, name: str, t_s: Float) -> Float:
        """Return the values [T] of a curve."""
        from scipy.interpolate import PchipInterpolator

        curve = self._keys.get(name)
        if not curve:
            return np.zeros(len(t_s))
        times, values = np.array(curve).T
        # Held ends are keys as well, so that the slope is 0 where they begin.
        times = np.concatenate([[times[0] - 1.0], times, [times[-1] + 1.0]])
        values = np.concatenate([values[:1], values, values[-1:]])
        held = np.clip(t_s, times[0], times[-1])
        return np.asarray(PchipInterpolator(times, values)(held), dtype=np.float64)
