"""Calibration of a detector's confidence: from the raw number to the probability that a joint is good.

Fitted on keypoints whose error is known (rendered flights): for each group of joints the monotone map that
is nearest to the outcomes in least squares (isotonic regression; Zadrozny and Elkan, "Transforming
Classifier Scores into Accurate Multiclass Probability Estimates", 2002). It is kept as a small table of
knots with the command that measured it (`tools/detector_errors.py`).
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float

_MEASURED = Path(__file__).parent / "data"
COLUMNS = ("joints", "confidence", "probability", "count")
ANY_JOINT = "*"


@dataclass(frozen=True)
class Calibration:
    """Maps from confidence to probability, by group of joints.

    Attributes:
        origin: the command and the data that it was measured with.
        good: definition of a good joint, in words.
        knots: for each group [K, 3] confidence (rising), probability (not falling) and count of keypoints.
            A group is a part of joints' names (`wrist`); `*` is for those of no group.
    """

    origin: str
    good: str
    knots: Mapping[str, Float]

    def probability(self, confidence: Float, joints: Sequence[str]) -> Float:
        """Map confidences [..., J] to probabilities; linear between knots, constant beyond them, NaN stays.

        A confidence of 0 means that nothing was found, and stays 0.
        """
        calibrated = np.empty(confidence.shape)
        for column, joint in enumerate(joints):
            knots = self.knots[group_of(joint, self.knots)]
            values = np.interp(confidence[..., column], knots[:, 0], knots[:, 1])
            calibrated[..., column] = np.where(confidence[..., column] == 0, 0.0, values)
        return np.where(np.isnan(confidence), np.nan, calibrated)

    def probabilities(self, confidence: Float, joint: NDArray[np.str_]) -> Float:
        """Map confidences of keypoints [N] in any order, each with the name of its joint."""
        calibrated = np.empty(len(confidence))
        for name in np.unique(joint):
            rows = joint == name
            calibrated[rows] = self.probability(confidence[rows, None], [str(name)])[:, 0]
        return calibrated


def measured_for(detector: str) -> Path | None:
    """Return the path of a detector's calibration, None if its confidences were not measured."""
    path = file_of(detector)
    return path if path.is_file() else None


def file_of(detector: str) -> Path:
    """Return the path at which a detector's calibration is stored."""
    return _MEASURED / f"{detector}_confidence.csv"


def group_of(joint: str, groups: Mapping[str, object]) -> str:
    """Return the group of a joint: the longest group name that its name contains, else `*`."""
    return max((group for group in groups if group in joint), key=len, default=ANY_JOINT)


def read_calibration(path: Path) -> Calibration:
    """Read a table of this package."""
    made_by, good, *lines = path.read_text(encoding="utf-8").splitlines()
    table: dict[str, list[list[float]]] = {}
    for group, *numbers in csv.reader(lines[1:]):
        table.setdefault(group, []).append([float(number) for number in numbers])
    knots = {group: np.array(own) for group, own in table.items()}
    return Calibration(made_by.removeprefix("# made by: "), good.partition("a joint is ")[2], knots)
