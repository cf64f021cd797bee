"""Detector with the user's own model: crop, network and decoding give joints at known places."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.keypoints.onnx_pose import DETECTOR, OnnxPose, heatmap_peaks, simcc_peaks
from pipelines.session.people import get_skeleton
from pipelines.session.registries import Region
from tests.keypoints.onnx_graphs import constant_model, heatmap_model, simcc_model, spots
from tests.raising import refused

GREY = "mean=0/0/0,std=255/255/255"  # brightness as it is: 0..1
UPPER, LOWER = (301.37, 160.81), (307.62, 243.18)
REGION = Region((304.0, 200.0), 160.0)  # scale 160 / 128 = 1.25 picture pixels for one of the input
SPOT_PX = 7.5  # 6 pixels of the input, 1.5 cells: the size that pose networks are trained on

# How far off joints may be, in picture pixels, 1.25 for one of the input. Where pixels are sampled is
# rounded to 1/32 px: 1/64. Heatmaps: the slope of the smoothed logarithm is wrong by at most half a grey
# level at half the height of a spot, 1/255, and its bend is 1 / (2^2 + 1.5^2) cells^2, so a step is wrong by
# 6.25 / 255 cells of 4 pixels.
HEATMAP_PX = 1 / 64 + 6.25 / 255 * 4 * 1.25
# SimCC: the spot has a sigma of 12 bins. The parabola leaves out the fourth order, 1.7 / 12^2 of at most
# half a bin. Rounded grey levels, 0.3 / 255 at random, are summed over the 24 pixels of a column that are
# bright and smoothed over about 3.5 columns, beside a height of 6 sqrt(2 pi): that is divided by the bend,
# 1 / 12^2, and by the square root of the 10 of the slope's least squares; three of its sigmas.
NOISE_BINS = 3 * 0.3 / 255 * np.sqrt(24 / 3.5) / (6 * np.sqrt(2 * np.pi)) * 144 / np.sqrt(10)
SIMCC_PX = 1 / 64 + (0.5 * 1.7 / 144 + NOISE_BINS) * 0.5 * 1.25


def load(path: Path, options: str = GREY) -> OnnxPose:
    return DETECTOR.configured(f"{path},{options}" if options else str(path)).load(threads=1)


def assert_spots(networks: OnnxPose, tolerance_px: float) -> None:
    (person,) = networks.locate(spots(640, 400, [UPPER, LOWER], SPOT_PX), [REGION])
    truth = np.array([UPPER, LOWER])[np.arange(17) % 2]
    np.testing.assert_allclose(person.xy, truth, atol=tolerance_px)
    assert person.presence == 1.0


@pytest.mark.parametrize("cells", ["udp", "msra"])
def test_heatmap_peaks_are_where_the_spots_are(tmp_path: Path, cells: str) -> None:
    networks = load(heatmap_model(tmp_path / "m.onnx", cells=cells), f"{GREY},heatmap={cells}")
    assert_spots(networks, HEATMAP_PX)


def test_simcc_peaks_are_where_the_spots_are(tmp_path: Path) -> None:
    assert_spots(load(simcc_model(tmp_path / "m.onnx")), SIMCC_PX)


@pytest.mark.parametrize("batch", ["n", 1, 2])
@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
def test_any_batch_and_layout_gives_the_same(tmp_path: Path, batch: int | str, layout: str) -> None:
    networks = load(heatmap_model(tmp_path / "m.onnx", batch=batch, layout=layout))
    picture = spots(640, 400, [UPPER, LOWER], SPOT_PX)
    regions = [Region((300.0 + i, 200.0), 160.0 + i) for i in range(3)]
    together = networks.locate(picture, regions)
    for region, person in zip(regions, together, strict=True):
        (alone,) = networks.locate(picture, [region])
        np.testing.assert_allclose(person.xy, alone.xy, atol=1e-4)  # float32 sums in another order
        np.testing.assert_allclose(person.xy[:2], [UPPER, LOWER], atol=1.05 * HEATMAP_PX)
    assert networks.locate(picture, []) == []


@pytest.mark.parametrize(("order", "bgr"), [("rgb", 2), ("bgr", 0)])
def test_colours_come_in_the_order_stated(tmp_path: Path, order: str, bgr: int) -> None:
    """Use a network that reads its first channel only: red as RGB, blue as BGR."""
    path = heatmap_model(tmp_path / "m.onnx", channel=(1.0, 0.0, 0.0))
    picture = spots(640, 400, [UPPER, LOWER], SPOT_PX, colour=bgr)
    (person,) = load(path, f"{GREY},colours={order}").locate(picture, [REGION])
    np.testing.assert_allclose(person.xy[:2], [UPPER, LOWER], atol=HEATMAP_PX)
    other = load(path, f"{GREY},colours={'bgr' if order == 'rgb' else 'rgb'}").locate(picture, [REGION])
    assert other[0].presence == 0.0
    assert np.isnan(other[0].xy).all()


def test_the_next_region_is_the_body_around_the_joints(tmp_path: Path) -> None:
    (person,) = load(heatmap_model(tmp_path / "m.onnx")).locate(
        spots(640, 400, [UPPER, LOWER], SPOT_PX), [REGION]
    )
    np.testing.assert_allclose(person.region.centre, np.mean([UPPER, LOWER], axis=0), atol=HEATMAP_PX)
    # Eyes and ankles are 0.897 of the body apart.
    expected = 1.25 * (LOWER[1] - UPPER[1]) / 0.897
    assert person.region.side == pytest.approx(expected, abs=1.25 * 2 * HEATMAP_PX / 0.897)


@pytest.mark.parametrize(("joints", "skeleton"), [(17, "coco17"), (26, "halpe26"), (25, "body25")])
def test_the_skeleton_is_that_of_the_number(tmp_path: Path, joints: int, skeleton: str) -> None:
    path = simcc_model(tmp_path / "m.onnx", joints=joints)
    assert load(path).joints == get_skeleton(skeleton).joints


def test_what_is_no_model_of_these_kinds_is_refused(tmp_path: Path) -> None:
    path = constant_model(tmp_path / "m.onnx", (96, 128), {"coordinates": np.zeros((1, 17, 3), np.float32)})
    with refused("wrong-model"):
        load(path)
    with refused("no-such-file"):
        DETECTOR.configured(str(tmp_path / "none.onnx"))
    text = tmp_path / "text.onnx"
    text.write_text("no model")
    with refused("wrong-kind"):
        load(text)


@pytest.mark.parametrize(
    ("options", "code"),
    [
        *((bad, "bad-value") for bad in ("size=192", "mean=1/2", "std=1/0/1", "mean=nan/0/0", "std=1/inf/1")),
        *((bad, "no-such-name") for bad in ("heatmap=other", "magic=1", "skeleton=ape")),
        ("size=96x128,size=96x128", "stated-twice"),
    ],
)
def test_bad_options_are_refused(tmp_path: Path, options: str, code: str) -> None:
    path = simcc_model(tmp_path / "m.onnx")
    with refused(code):
        DETECTOR.configured(f"{path},{options}")


def test_boxes_become_regions_with_the_aspect_of_the_pose_model(tmp_path: Path) -> None:
    """Edges of the input's pixels are counted from 0, and a picture's pixels from their centres."""
    box, beside, car = (40, 30, 80, 130), (200, 30, 240, 130), (100, 100, 200, 150)
    pose, picture = heatmap_model(tmp_path / "pose.onnx", size=(96, 128)), np.zeros((720, 1280, 3), np.uint8)
    boxes = np.array([[(*beside, 0.6), (*box, 0.9), (*car, 0.95), (0, 0, 9, 9, 0.1)]], np.float32)
    labels = np.array([[0, 0, 2, 0]], np.int64)
    finder = constant_model(tmp_path / "p.onnx", (320, 320), {"dets": boxes, "labels": labels})
    (first, score), (second, _) = load(pose, f"people={finder}").find_people(picture)
    assert score == pytest.approx(0.9)
    np.testing.assert_allclose(first.centre, (4 * 60 - 0.5, 4 * 80 - 0.5), atol=1e-3)
    np.testing.assert_allclose(second.centre, (4 * 220 - 0.5, 4 * 80 - 0.5), atol=1e-3)
    assert first.side == pytest.approx(1.25 * 4 * 100)  # 160 wide would do for 40: the height decides
    boxes = np.array([[(*car, 0.9)]], np.float32)
    wide = constant_model(tmp_path / "w.onnx", (320, 320), {"dets": boxes})
    ((region, _),) = load(pose, f"people={wide}").find_people(picture)
    assert region.side == pytest.approx(1.25 * 4 * 100 * 128 / 96)


inner = st.floats(9.0, 38.0)


@given(x=inner, y=st.floats(9.0, 54.0), sigma=st.floats(1.5, 3.0), height=st.floats(0.05, 1.0))
def test_a_gaussian_in_a_heatmap_is_read_exactly(x: float, y: float, sigma: float, height: float) -> None:
    row, column = np.mgrid[:64, :48]
    heatmap = height * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))
    place, score = heatmap_peaks(heatmap[None, None])
    # Smoothing stops 5 cells away. For a sigma of 3, at 1.5 cells from the top, the weights of the full sum
    # are normal about 1.5 * 4 / 13 with the variance 1 / (1/4 + 1/9): 0.32 % lies beyond. The slope is then
    # wrong by at most half of that, and the step by 13 times as much.
    np.testing.assert_allclose(place[0, 0], (x, y), atol=13 * 0.0032 / 2)
    assert score[0, 0] == heatmap.max()


@given(x=inner, y=inner, sigma=st.floats(4.0, 8.0))
def test_scores_that_are_a_logarithm_are_read_exactly(x: float, y: float, sigma: float) -> None:
    bins = np.arange(48, dtype=np.float64)
    lines: list[Float] = [10 - (bins - at) ** 2 / (2 * sigma**2) for at in (x, y)]
    place, score = simcc_peaks(lines[0][None, None], lines[1][None, None])
    np.testing.assert_allclose(place[0, 0], (x, y), atol=1e-9)
    assert score[0, 0] == min(line.max() for line in lines)
