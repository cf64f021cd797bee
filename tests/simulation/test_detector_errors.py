"""The modelled detector: errors as large as the table says, and connected as the module says."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.session.people import mirrored
from pipelines.simulation.detector_errors import (
    HIDDEN_CONFIDENCE,
    HIDDEN_ERROR,
    HIDDEN_MISSED,
    KEPT_PER_FRAME,
    OUTLIER_SHARES,
    SWAP_FRAMES,
    ErrorTable,
    detect_keypoints,
    read_errors,
)
from pipelines.simulation.scenario import DetectorErrors
from tests.synthetic.walk import COCO17

# Of a prototype's measurement, the same for all joints; what comes along is measured again now and then.
EXAMPLE = read_errors(Path(__file__).parent / "example_detector_errors.csv")
CLEAN = DetectorErrors(missed_share=0.0, outlier_share=0.0, swap_share=0.0)
FRAMES = 6000
PLACES = np.random.default_rng(9).uniform(100, 600, (17, 2))
HEIGHT_PX = 200.0
LIMBS = ({"elbow", "wrist"}, {"knee", "ankle"})


def detect(
    errors: DetectorErrors,
    *,
    frames: int = FRAMES,
    tilt_deg: float = 15.0,
    hidden: bool = False,
    seed: int = 0,
    table: ErrorTable | None = EXAMPLE,
) -> tuple[Float, Float]:
    """Detect keypoints of a person who stands still, 200 px tall."""
    return detect_keypoints(
        np.tile(PLACES, (frames, 1, 1)),
        np.full((frames, 17), not hidden),
        np.full(frames, tilt_deg),
        np.full(frames, HEIGHT_PX),
        errors,
        np.random.default_rng(seed),
        joints=COCO17,
        table=table,
    )


def lengths(xy: Float) -> Float:
    """Compute the distance of every found joint from the truth, NaN where missed."""
    length: Float = np.sqrt(np.sum((xy - PLACES) ** 2, axis=-1))
    return length


# --- errors --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("tilt_deg", "median_share"), [(15.0, 0.0192), (60.0, 0.0407), (52.5, 0.03545)])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_errors_have_the_measured_median(tilt_deg: float, median_share: float, scale: float) -> None:
    """102,000 errors, correlated over frames as if there were (1 - k) / (1 + k) = 0.18 of them: 18,000.

    A median is then known to 1 / (2 f m sqrt(n)) with the density f m = ln 2 there: 0.5 %.
    """
    xy, _ = detect(CLEAN.model_copy(update={"scale": scale}), tilt_deg=tilt_deg)
    assert np.median(lengths(xy)) == pytest.approx(scale * median_share * HEIGHT_PX, rel=0.02)
    offset = xy - PLACES
    assert np.abs(offset.mean()) < 4 * scale * median_share * HEIGHT_PX / math.sqrt(18_000)
    assert offset[..., 0].std() == pytest.approx(offset[..., 1].std(), rel=0.03)


def test_errors_go_on_from_frame_to_frame() -> None:
    """The standard error of an autocorrelation k of n frames is sqrt((1 - k^2) / n): here 0.2 %."""
    offset = detect(CLEAN)[0] - PLACES
    of_one = (offset[1:] * offset[:-1]).mean() / offset.var()
    assert of_one == pytest.approx(KEPT_PER_FRAME, abs=0.01)
    of_five = (offset[5:] * offset[:-5]).mean() / offset.var()
    assert of_five == pytest.approx(KEPT_PER_FRAME**5, abs=0.015)
    assert abs((offset[:, 3] * offset[:, 4]).mean() / offset.var()) < 0.06  # each joint errs by itself


def test_a_detector_without_errors_is_exact() -> None:
    xy, confidence = detect(DetectorErrors(scale=0.0, missed_share=0.1, outlier_share=0.3, swap_share=0.3))
    found = np.isfinite(xy).all(axis=-1)
    assert (lengths(xy)[found] == 0).all()
    assert (confidence[found] > 0).all()
    assert 0.08 < 1 - found.mean() < 0.12


@pytest.mark.parametrize(("tilt_deg", "growth"), [(15.0, 1.0), (60.0, 0.140 / 0.028)])
def test_misses_and_outliers_grow_with_the_tilt(tilt_deg: float, growth: float) -> None:
    """102,000 joints: the standard error of a share of 2 % is 0.04 %, of 10 % 0.1 %."""
    errors = DetectorErrors(missed_share=0.02, outlier_share=0.02, swap_share=0.0)
    xy, _ = detect(errors, tilt_deg=tilt_deg)
    length = lengths(xy)
    missed = np.isnan(length)
    # Ordinary errors reach the outliers' nearest place with 0.5^((0.2 / 0.0407)^2) = 10^-7.
    outlier = length[~missed] >= OUTLIER_SHARES[0] * HEIGHT_PX
    assert missed.mean() == pytest.approx(0.02 * growth, abs=0.004)
    assert outlier.mean() == pytest.approx(0.02 * growth, abs=0.004)
    assert np.nanmax(length) <= OUTLIER_SHARES[1] * HEIGHT_PX


def test_hidden_joints_are_mostly_missed_and_else_bad() -> None:
    """Of 102,000 about 2,000 are found, whose errors count as 370: their median is known to 5 %."""
    xy, confidence = detect(CLEAN, hidden=True)
    length = lengths(xy)
    assert np.isnan(length).mean() == pytest.approx(HIDDEN_MISSED[-1], abs=0.006)
    assert np.nanmedian(length) == pytest.approx(HIDDEN_ERROR[-1] * 0.0192 * HEIGHT_PX, rel=0.15)
    seen = confidence[~np.isnan(length)]
    assert seen.mean() == pytest.approx(HIDDEN_CONFIDENCE[-1] * 0.89, abs=0.01)


# --- swaps ---------------------------------------------------------------------------------------------
def test_a_swap_exchanges_one_pair_of_limbs_for_a_few_frames() -> None:
    """The same draws with and without swaps differ by exactly that."""
    swaps = DetectorErrors(missed_share=0.05, outlier_share=0.02, swap_share=0.1)
    plain, sure = detect(swaps.model_copy(update={"swap_share": 0.0}))
    xy, confidence = detect(swaps)
    mirror = [COCO17.index(mirrored(name)) for name in COCO17]
    moved = ~((xy == plain) | (np.isnan(xy) & np.isnan(plain))).all(axis=-1) | (confidence != sure)
    assert np.array_equal(xy, np.where(moved[..., None], plain[:, mirror], plain), equal_nan=True)
    assert (confidence == np.where(moved, sure[:, mirror], sure)).all()
    kinds = [{COCO17[j].split("_")[1] for j in np.flatnonzero(row)} for row in moved]
    assert all(any(kind <= limb for limb in LIMBS) for kind in kinds)
    assert {frozenset(kind) for kind in kinds} >= {frozenset(limb) for limb in LIMBS}
    swapped = moved.any(axis=1)
    edges = np.flatnonzero(np.diff(swapped.astype(int), prepend=0, append=0))
    runs = [b - a for a, b in pairwise(edges)][::2]
    assert min(runs[:-1]) >= SWAP_FRAMES[0]
    # A run may follow another at once, so longer ones are seen, but few: 1 in 36 begins so.
    assert np.mean(np.array(runs) > SWAP_FRAMES[1]) < 0.1


# --- confidence ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(("tilt_deg", "mean"), [(15.0, 0.89), (60.0, 0.74)])
def test_confidence_has_the_measured_mean_and_falls_with_the_error(tilt_deg: float, mean: float) -> None:
    """Confidences are capped at 1, which takes E[max(N(0, .05) - .04, 0)] = 0.006 of the surest at most."""
    xy, confidence = detect(CLEAN, tilt_deg=tilt_deg)
    assert confidence.mean() == pytest.approx(mean, abs=0.005)
    assert confidence.max() <= 1
    order = np.argsort(lengths(xy).ravel())
    tenths = confidence.ravel()[order].reshape(10, -1).mean(axis=1)
    assert (np.diff(tenths) < 0).all()
    assert tenths[0] - tenths[-1] > 0.9 * 0.14 - 0.01  # from the middle of the first to that of the last
