"""The modelled detector: errors as large as the table says, and connected as the module says."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.people import mirrored
from pipelines.session.registries import find_detector
from pipelines.simulation.detector_errors import (
    COLUMNS,
    HIDDEN_CONFIDENCE,
    HIDDEN_ERROR,
    HIDDEN_MISSED_SHARE,
    KEPT_PER_FRAME,
    MODELLED,
    OUTLIER_SHARES,
    SWAP_FRAMES,
    ErrorTable,
    detect_keypoints,
    errors_of,
    read_errors,
    view_of,
)
from pipelines.simulation.scenario import DetectorErrors
from tests.synthetic.walk import COCO17

# Of a prototype's measurement, the same for all joints; what comes along is measured again now and then.
EXAMPLE = read_errors(Path(__file__).parent / "example_detector_errors.csv")
# As many as the example has at 15 degrees.
USUAL = DetectorErrors(missed_share=0.02, outlier_share=0.01)
WITHOUT_SWAPS = USUAL.model_copy(update={"swap_share": 0.0})
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


# --- the table -----------------------------------------------------------------------------------------


def write(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(["# from a test", ",".join(COLUMNS), *rows, ""]), encoding="utf-8")
    return path


@pytest.mark.parametrize("detector", MODELLED)
def test_the_tables_that_come_along_say_where_they_are_from(detector: str) -> None:
    lines = errors_of(detector).read_text(encoding="utf-8").splitlines()
    assert "# Made by: python tools/detector_errors.py --write" in lines
    assert f"# The detector: {find_detector(detector).title}" in lines
    assert {"*", *COCO17} == set(read_errors(errors_of(detector)).rows)


@pytest.mark.parametrize("detector", MODELLED)
def test_a_joint_is_found_worse_the_steeper_the_camera_looks(detector: str) -> None:
    """As in the seed: alike up to 30 degrees, worse above; of all joints together."""
    error, missed, confidence = read_errors(errors_of(detector)).at(
        np.array([0.0, 15.0, 30.0, 45.0, 60.0]), ("*",)
    )
    assert (np.diff(error[1:, 0]) > 0).all()
    assert (np.diff(missed[1:, 0]) > 0).all()
    assert (np.diff(confidence[1:, 0]) < 0).all()
    assert error[1, 0] == pytest.approx(error[0, 0], rel=0.1)


def test_between_tilts_it_goes_straight_and_beyond_them_it_holds() -> None:
    error, missed, confidence = EXAMPLE.at(np.array([-20.0, 15.0, 22.5, 60.0, 90.0]), ("nose",))
    assert error[:, 0] == pytest.approx([0.0206, 0.0192, (0.0192 + 0.0239) / 2, 0.0407, 0.0407])
    assert missed[:, 0] == pytest.approx([0.036, 0.028, 0.05, 0.14, 0.14])
    assert confidence[:, 0] == pytest.approx([0.89, 0.89, 0.88, 0.74, 0.74])


def test_a_table_may_have_rows_of_its_own_for_a_joint(tmp_path: Path) -> None:
    table = read_errors(
        write(tmp_path / "t.csv", "30,nose,0.01,0,0.9", "0,nose,0.03,0.5,0.7", "0,*,0.02,0.1,0.8")
    )
    error, missed, _ = table.at(np.array([15.0]), ("left_hip", "nose"))
    assert error[0] == pytest.approx([0.02, 0.02])
    assert missed[0] == pytest.approx([0.1, 0.25])
    # 6,000 errors of one joint count as 1,060: 1 / (2 ln 2 sqrt(1,060)) = 2 % of the median.
    xy, _ = detect(CLEAN, tilt_deg=30.0, table=table)
    away = np.median(lengths(xy), axis=0) / HEIGHT_PX
    assert away[COCO17.index("nose")] == pytest.approx(0.01, rel=0.08)
    assert away[COCO17.index("left_hip")] == pytest.approx(0.02, rel=0.08)


def test_a_joint_without_measurement_is_named(tmp_path: Path) -> None:
    table = read_errors(write(tmp_path / "t.csv", "0,nose,0.03,0.5,0.7"))
    with pytest.raises(ValueError, match="left_eye, right_eye"):
        table.at(np.zeros(1), COCO17[:3])


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("0,nose,0.03,0.5", "has a row 0,nose,0.03,0.5:"),
        ("0,nose,much,0.5,0.7", "has a row 0,nose,much"),
        ("0,nose,0.03,1.5,0.7", "has a row 0,nose,0.03,1.5"),
        ("0,nose,-0.03,0.5,0.7", "has a row 0,nose,-0.03"),
        ("0,nose,nan,0.5,0.7", "has a row 0,nose,nan"),
        ("0,*,0.01,0.5,0.7\n0,*,0.02,0.5,0.7", "a tilt twice"),
        ("", "has no rows"),
    ],
)
def test_a_bad_table_is_refused(tmp_path: Path, row: str, complaint: str) -> None:
    with pytest.raises(DataError, match=complaint.replace("*", r"\*").rstrip(":")):
        read_errors(write(tmp_path / "t.csv", row))


def test_a_table_that_is_not_there_or_another_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError) as error:
        read_errors(tmp_path / "none.csv")
    assert error.value.source == tmp_path / "none.csv"
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="tilt_deg") as error:
        read_errors(tmp_path / "other.csv")
    assert error.value.source == tmp_path / "other.csv"


# --- the view ------------------------------------------------------------------------------------------


def test_tilt_and_apparent_height() -> None:
    camera = np.array([[10.0, 0.0, 1.0], [0.0, 3.0, 5.0], [0.0, 0.0, 11.0], [3.0, 0.0, -3.0]])
    tilt_deg, height_px = view_of(camera, np.array([0.0, 0.0, 1.0]), height_m=1.75, focal_px=800.0)
    assert tilt_deg == pytest.approx(
        [0.0, math.degrees(math.atan2(4, 3)), 90.0, math.degrees(math.atan2(-4, 3))]
    )
    assert height_px == pytest.approx([140.0, 280.0, 140.0, 280.0])


# --- errors --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("detector", MODELLED)
def test_errors_are_those_of_the_detector_that_is_named(detector: str) -> None:
    """A table of its own for each, with the tolerance of the test below."""
    xy, _ = detect(CLEAN.model_copy(update={"detector": detector}), tilt_deg=45.0, table=None)
    share, _, _ = read_errors(errors_of(detector)).at(np.array([45.0]), COCO17)
    for joint in ("nose", "left_knee", "right_wrist"):
        column = COCO17.index(joint)
        assert np.median(lengths(xy)[:, column]) == pytest.approx(share[0, column] * HEIGHT_PX, rel=0.08)


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


def test_without_shares_nothing_is_missed_or_confused() -> None:
    """The longest of 102,000 errors stays below sigma sqrt(2 ln(102,000 * 10^4)) with 0.9999."""
    length = lengths(detect(CLEAN, tilt_deg=60.0)[0])
    sigma_px = 0.0407 * HEIGHT_PX / math.sqrt(2 * math.log(2))
    assert np.isfinite(length).all()
    assert length.max() < sigma_px * math.sqrt(2 * math.log(length.size * 1e4))


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
    """Of 102,000 about 30,600 are found, whose errors count as 5,500: their median is known to 1 %."""
    xy, confidence = detect(CLEAN, hidden=True)
    length = lengths(xy)
    assert np.isnan(length).mean() == pytest.approx(HIDDEN_MISSED_SHARE, abs=0.006)
    assert np.nanmedian(length) == pytest.approx(HIDDEN_ERROR * 0.0192 * HEIGHT_PX, rel=0.04)
    seen = confidence[~np.isnan(length)]
    assert seen.mean() == pytest.approx(HIDDEN_CONFIDENCE * 0.89, abs=0.01)


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


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_as_many_frames_are_swapped_as_asked_for(share: float) -> None:
    """Runs of 4 frames: 60,000 frames have 60,000 share / 4 of them, whose count scatters by its root."""
    swaps = CLEAN.model_copy(update={"swap_share": share})
    frames = 60_000
    swapped = (detect(swaps, frames=frames)[0] != detect(CLEAN, frames=frames)[0]).any(axis=(1, 2))
    assert swapped.mean() == pytest.approx(share, rel=4 / math.sqrt(frames * share / 4))


def test_a_skeleton_without_limbs_has_nothing_to_swap() -> None:
    errors = DetectorErrors(swap_share=0.9, missed_share=0, outlier_share=0)
    arguments = np.zeros((50, 2, 2)), np.ones((50, 2), dtype=np.bool_), np.zeros(50), np.ones(50)
    names = ("nose", "left_wrist")
    xy, _ = detect_keypoints(*arguments, errors, np.random.default_rng(0), joints=names)
    without = errors.model_copy(update={"swap_share": 0.0})
    assert (xy == detect_keypoints(*arguments, without, np.random.default_rng(0), joints=names)[0]).all()


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


@pytest.mark.parametrize("tilt_deg", [15.0, 30.0, 45.0, 60.0])
def test_confidence_tells_bad_joints_as_well_as_the_measured_one(tilt_deg: float) -> None:
    """The measured area under the ROC curve, for errors above 5 % of the height, is 0.88 over all tilts."""
    xy, confidence = detect(WITHOUT_SWAPS, tilt_deg=tilt_deg)
    found = np.isfinite(xy).all(axis=-1)
    bad = lengths(xy)[found] > 0.05 * HEIGHT_PX
    rank = np.argsort(np.argsort(-confidence[found], kind="stable"), kind="stable") + 1.0
    pairs = float(bad.sum()) * float((~bad).sum())
    area = (rank[bad].sum() - bad.sum() * (bad.sum() + 1) / 2) / pairs
    assert area == pytest.approx(0.88, abs=0.05)


@pytest.mark.parametrize(
    ("tilt_deg", "pck"), [(0.0, 0.96), (15.0, 0.97), (30.0, 0.91), (45.0, 0.81), (60.0, 0.61)]
)
def test_the_measured_share_of_correct_keypoints_comes_out(tilt_deg: float, pck: float) -> None:
    """With the default shares, which add up to 0.03 beside the measured 0.028: 0.0576 H is 0.2 torso.

    Missed joints and outliers are drawn apart, so that their shares overlap: at 60 degrees, where they
    grow fivefold to 0.10 and 0.05 and a quarter of the rest errs as far by chance, that is 0.03.
    """
    xy, _ = detect(WITHOUT_SWAPS, tilt_deg=tilt_deg)
    assert (lengths(xy) < 0.0576 * HEIGHT_PX).mean() == pytest.approx(pck, abs=0.04)


def test_confidence_tells_most_outliers_but_not_all() -> None:
    errors = DetectorErrors(missed_share=0.0, outlier_share=0.05, swap_share=0.0)
    xy, confidence = detect(errors)
    outlier = lengths(xy) > OUTLIER_SHARES[0] * HEIGHT_PX * 0.999
    good, bad = confidence[~outlier], confidence[outlier]
    assert good.mean() - bad.mean() > 0.2
    assert 0.03 < (bad > np.quantile(good, 0.1)).mean() < 0.5


# --- edges ---------------------------------------------------------------------------------------------


def test_what_is_not_in_the_picture_is_never_found() -> None:
    pixels = np.full((30, 17, 2), np.nan)
    arguments = np.ones((30, 17), dtype=np.bool_), np.zeros(30), np.full(30, 200.0)
    xy, confidence = detect_keypoints(
        pixels, *arguments, DetectorErrors(outlier_share=0.5), np.random.default_rng(0), joints=COCO17
    )
    assert np.isnan(xy).all()
    assert (confidence == 0).all()
    assert np.isnan(pixels).all()


def test_what_is_seen_does_not_depend_on_what_is_not() -> None:
    errors = WITHOUT_SWAPS
    pixels = np.tile(PLACES, (40, 1, 1))
    rest = np.full(40, 15.0), np.full(40, HEIGHT_PX), errors
    everything = detect_keypoints(
        pixels, np.ones((40, 17), dtype=np.bool_), *rest, np.random.default_rng(0), joints=COCO17
    )
    pixels[:, 5:] = np.nan
    visible = np.ones((40, 17), dtype=np.bool_)
    visible[:, 9:] = False
    some = detect_keypoints(pixels, visible, *rest, np.random.default_rng(0), joints=COCO17)
    assert np.array_equal(everything[0][:, :5], some[0][:, :5], equal_nan=True)
    assert (everything[1][:, :5] == some[1][:, :5]).all()


def test_no_frames_give_no_keypoints() -> None:
    xy, confidence = detect(USUAL, frames=0)
    assert xy.shape == (0, 17, 2)
    assert confidence.shape == (0, 17)


def test_the_same_seed_gives_the_same_keypoints() -> None:
    first, second, other = (detect(USUAL, seed=seed, frames=50) for seed in (4, 4, 5))
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1].tobytes() == second[1].tobytes()
    assert not np.array_equal(first[0], other[0], equal_nan=True)
