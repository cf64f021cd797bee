"""Numbers that change over time, given at a few moments: what actions write and bodies read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

_SAME_MOMENT_S = 1e-6


class Keys:
    """Named curves through key values, 0 where nobody wrote any.

    Between keys a curve is the monotone cubic of Fritsch & Carlson 1980: its slope is continuous, it never
    leaves the span of two neighbouring keys, and it stays exactly constant between equal ones - which is
    what keeps a planted foot where it is. Before the first and after the last key it is held.
    """

    def __init__(self) -> None:
        self._keys: dict[str, list[tuple[float, float]]] = {}

    def add(self, name: str, *keys: tuple[float, float]) -> None:
        """Append (time in s, value) pairs; one at the time of the key before it, or earlier, replaces it."""
        curve = self._keys.setdefault(name, [])
        for t_s, value in keys:
            while curve and curve[-1][0] >= t_s - _SAME_MOMENT_S:
                curve.pop()
            curve.append((t_s, value))

    def last(self, name: str) -> float:
        """The value that a curve ends with."""
        curve = self._keys.get(name)
        return curve[-1][1] if curve else 0.0

    def pulse(self, name: str, *keys: tuple[float, float]) -> None:
        """Keys of something that departs from 0 and comes back to it: the first and last value are 0."""
        self.add(name, (keys[0][0], 0.0), *keys[1:-1], (keys[-1][0], 0.0))

    def at(self, name: str, t_s: Float) -> Float:
        """[T] values of a curve."""
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
