"""Calibration of a detector's confidence: from the raw number to the probability that a joint is good.

Fitted on keypoints whose error is known (rendered flights): for each group of joints the monotone map that
is nearest to the outcomes in least squares (isotonic regression; Zadrozny and Elkan, "Transforming
Classifier Scores into Accurate Multiclass Probability Estimates", 2002). It is kept as a small table of
knots with the command that measured it.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError

_MEASURED = Path(__file__).parent / "data"
COLUMNS = ("joints", "confidence", "probability", "count")
ANY_JOINT = "*"
# The probability of a knot is known to about 0.1 with this many keypoints behind it.
_MIN_KEYPOINTS = 20


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


def fit(
    confidence: Float,
    is_good: NDArray[np.bool_],
    joints: Sequence[str],
    *,
    groups: Sequence[str],
    origin: str,
    good: str,
) -> Calibration:
    """Fit a calibration to keypoints with known outcome.

    Args:
        confidence: [N, J] raw; 0 and NaN are left out.
        is_good: [N, J] True if the keypoint was near enough to the truth.
        joints: the names of the J joints.
        groups: parts of joints' names; each group with enough keypoints gets its own map.
        origin: the command and the data.
        good: definition of a good joint, in words.

    Raises:
        ValueError: fewer than 20 keypoints.
    """
    sets = {ANY_JOINT: list(range(len(joints)))}
    sets |= {group: [j for j, joint in enumerate(joints) if group in joint] for group in groups}
    knots = {}
    for group, columns in sets.items():
        raw, outcome = confidence[:, columns].ravel(), is_good[:, columns].ravel()
        found = np.isfinite(raw) & (raw > 0)
        if found.sum() >= _MIN_KEYPOINTS:
            knots[group] = _isotonic_knots(raw[found], outcome[found].astype(np.float64))
    if ANY_JOINT not in knots:
        raise ValueError(f"fewer than {_MIN_KEYPOINTS} keypoints to calibrate with")
    return Calibration(origin, good, knots)


def group_of(joint: str, groups: Mapping[str, object]) -> str:
    """Return the group of a joint: the longest group name that its name contains, else `*`."""
    return max((group for group in groups if group in joint), key=len, default=ANY_JOINT)


def isotonic(values: Float, weight: Float) -> tuple[NDArray[np.intp], Float]:
    """Fit the non-decreasing sequence nearest to values [N], by pool adjacent violators (Ayer et al., 1955).

    Args:
        values: [N] in the order in which they must not fall.
        weight: [N] above 0.

    Returns:
        The first index [B] of each block of equal values, and its value [B], rising.
    """
    firsts: list[int] = []
    sums: list[float] = []
    weights: list[float] = []
    for index, (value, share) in enumerate(zip(values.tolist(), weight.tolist(), strict=True)):
        firsts.append(index)
        sums.append(value * share)
        weights.append(share)
        while len(sums) > 1 and sums[-2] * weights[-1] >= sums[-1] * weights[-2]:
            firsts.pop()
            sums[-2:] = [sums[-2] + sums[-1]]
            weights[-2:] = [weights[-2] + weights[-1]]
    return np.array(firsts, dtype=np.intp), np.array(sums) / np.array(weights)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write the table, with its origin in comments above it."""
    text = io.StringIO()
    text.write(f"# made by: {calibration.origin}\n# probability that a joint is {calibration.good}\n")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for group, knots in sorted(calibration.knots.items()):
        for confidence, probability, count in knots.tolist():
            rows.writerow([group, f"{confidence:.6g}", f"{probability:.6g}", int(count)])
    path.write_text(text.getvalue(), encoding="utf-8", newline="\n")


def read_calibration(path: Path) -> Calibration:
    """Read a table again.

    Raises:
        DataError: it is missing or holds no calibration.
    """
    remedy = "measure it again with the command that its first line names"
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, f"cannot be read ({error})", remedy, code="damaged") from None
    comments = [line.removeprefix("# ") for line in lines if line.startswith("#")]
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    try:
        made_by, good = (comments[0].removeprefix("made by: "), comments[1].partition("a joint is ")[2])
        if tuple(rows[0]) != COLUMNS:
            raise ValueError(f"its columns are {', '.join(rows[0])}")
        table: dict[str, list[list[float]]] = {}
        for group, *numbers in rows[1:]:
            table.setdefault(group, []).append([float(number) for number in numbers])
        knots = {group: np.array(own).reshape(-1, 3) for group, own in table.items()}
        if ANY_JOINT not in knots or any(not _is_usable(own) for own in knots.values()):
            raise ValueError(f"its numbers do not rise, or there is no group {ANY_JOINT}")
    except (IndexError, ValueError) as error:
        raise DataError(path, f"is no calibration ({error})", remedy, code="wrong-kind") from None
    return Calibration(made_by, good, knots)


def _is_usable(knots: Float) -> bool:
    rises = (np.diff(knots[:, 0]) > 0).all() and (np.diff(knots[:, 1]) >= 0).all()
    return bool(rises and np.isfinite(knots).all() and (knots[:, 1] >= 0).all() and (knots[:, 1] <= 1).all())


def _isotonic_knots(confidence: Float, outcome: Float) -> Float:
    """Compute knots [K, 3]: mean confidence, probability and count of each block of at least 20 keypoints.

    Equal confidences are pooled first. Consecutive ones are pooled to at least 20, because small blocks at
    either end would otherwise have probabilities of 0 and 1.
    """
    level, inverse = np.unique(confidence, return_inverse=True)
    count = np.bincount(inverse).astype(np.float64)
    good = np.bincount(inverse, weights=outcome)
    bins = np.minimum(
        (np.cumsum(count) - count) // _MIN_KEYPOINTS, max(count.sum() // _MIN_KEYPOINTS - 1, 0)
    ).astype(int)
    _, bins = np.unique(bins, return_inverse=True)
    total, middle, share = (
        np.bincount(bins, weights=w).astype(np.float64) for w in (count, count * level, good)
    )
    firsts, probability = isotonic(share / total, total)
    pooled = np.add.reduceat(total, firsts)
    return np.column_stack([np.add.reduceat(middle, firsts) / pooled, probability, pooled])
