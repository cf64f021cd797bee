"""What walking adults do at their usual speed: when hip, knee and ankle are bent how far.

From the mean curves of two books: Perry & Burnfield, "Gait Analysis" (2nd ed. 2010), by its eight phases,
and Winter, "Biomechanics and Motor Control of Human Gait" (2nd ed. 1991; natural cadence, also in his
"Biomechanics and Motor Control of Human Movement", 4th ed. 2009). A band reaches from the lesser to the
greater of the two means, widened to at most 5 deg and 5 % of a stride beyond one of them: people differ
from each other by 4 to 7 deg (one standard deviation). The hip is the thigh's angle from upright, as in
Perry; with a pelvis tilted by 10 deg, as Kadaba et al. 1990 measure it, it reads so much more. It hardly
changes after its peak in swing.
"""

from __future__ import annotations

from typing import NamedTuple

Band = tuple[float, float]


class Event(NamedTuple):
    """An extreme of a curve, or its value where `searched` is a single share."""

    name: str
    joint: str
    extreme: str  # min or max
    searched: Band  # share of the stride from the heel's strike
    deg: Band  # flexed and dorsiflexed are positive
    share: Band  # where the extreme lies
    means: str  # Perry; Winter


STANCE_SHARE = (0.59, 0.63)  # Perry 0.62, Winter 0.60
AT_TOE_OFF = (-1.0, -1.0)  # stands for the share where the foot leaves the ground
ANYWHERE = (0.0, 1.0)

EVENTS = (
    Event("strike", "hip", "max", (0.0, 0.0), (15, 25), ANYWHERE, "20; 19"),
    Event("stance", "hip", "min", (0.3, 0.75), (-20, -10), (0.48, 0.56), "-20 at 0.50; -11 at 0.52"),
    Event("swing", "hip", "max", (0.65, 0.99), (20, 30), (0.82, 0.98), "25 at 0.87; 22 at 0.86"),
    Event("strike", "knee", "max", (0.0, 0.0), (0, 10), ANYWHERE, "5; 4"),
    Event("loading", "knee", "max", (0.02, 0.3), (15, 21), (0.10, 0.18), "20 at 0.12; 21 at 0.14"),
    Event("stance", "knee", "min", (0.2, 0.55), (0, 10), (0.35, 0.45), "5 at 0.40; 6 at 0.40"),
    Event("toe off", "knee", "max", AT_TOE_OFF, (35, 45), ANYWHERE, "40; 38"),
    Event("swing", "knee", "max", (0.55, 0.95), (55, 65), (0.70, 0.75), "60 at 0.73; 65 at 0.72"),
    Event("strike", "ankle", "max", (0.0, 0.0), (-5, 5), ANYWHERE, "0; 0"),
    Event("loading", "ankle", "min", (0.0, 0.2), (-10, -5), (0.04, 0.10), "-5 to -10 at 0.06; -5 at 0.06"),
    Event("stance", "ankle", "max", (0.2, 0.6), (5, 15), (0.42, 0.50), "10 at 0.46; 10 at 0.44"),
    Event(
        "push-off", "ankle", "min", (0.5, 0.8), (-25, -15), (0.60, 0.66), "-15 to -20 at 0.62; -20 at 0.64"
    ),
    Event("mid swing", "ankle", "max", (0.78, 0.95), (-5, 5), ANYWHERE, "0; 1"),
)
