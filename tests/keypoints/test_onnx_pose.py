"""Detector with the user's own model: crop, network and decoding give joints at known places."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Picture
from pipelines.keypoints.onnx_network import OnnxNetwork
from pipelines.keypoints.onnx_pose import DETECTOR, OnnxPose
from pipelines.session.errors import DataError
from pipelines.session.people import get_skeleton
from pipelines.session.registries import Region
from tests.keypoints.onnx_graphs import constant_model, heatmap_model, simcc_model, spots

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


@pytest.mark.parametrize(("batch", "runs"), [("n", 1), (1, 3), (2, 2), (8, 1)])
def test_the_people_of_a_picture_are_one_batch_where_the_graph_takes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: int | str, runs: int
) -> None:
    networks = load(heatmap_model(tmp_path / "m.onnx", batch=batch))
    lengths: list[int] = []
    outputs = OnnxNetwork._outputs

    def counted(network: OnnxNetwork, rgb: Picture, names: Sequence[str] | None) -> dict[str, NDArray[Any]]:
        lengths.append(len(rgb))
        return outputs(network, rgb, names)

    monkeypatch.setattr(OnnxNetwork, "_outputs", counted)
    regions = [Region((300.0 + i, 200.0), 160.0 + i) for i in range(3)]
    assert len(networks.locate(spots(640, 400, [UPPER, LOWER], SPOT_PX), regions)) == 3
    assert lengths == [3 if batch == "n" else batch] * runs


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


def test_outputs_that_are_not_understood_are_listed(tmp_path: Path) -> None:
    path = constant_model(tmp_path / "m.onnx", (96, 128), {"coordinates": np.zeros((1, 17, 3), np.float32)})
    with pytest.raises(DataError, match=r"coordinates \[1,17,3\] for an input of 96x128"):
        load(path)


def test_files_that_are_no_models_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not exist"):
        DETECTOR.configured(str(tmp_path / "none.onnx"))
    text = tmp_path / "text.onnx"
    text.write_text("no model")
    with pytest.raises(DataError, match="is no model that ONNX Runtime can run"):
        load(text)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("size=192", "is no size"),
        ("mean=1/2", "is not three numbers"),
        ("std=1/0/1", "must be above 0"),
        ("mean=nan/0/0", "is not finite"),
        ("std=1/inf/1", "is not finite"),
        ("heatmap=other", "there are udp, msra"),
        ("magic=1", "no option 'magic'"),
        ("layout=nchw,layout=nhwc", "states layout twice"),
        ("skeleton=ape", "there are coco17"),
        ("provider=", "names no execution provider"),
        ("provider=cpu,provider=cuda", "states provider twice"),
    ],
)
def test_bad_options_are_refused_with_what_there_is(tmp_path: Path, options: str, said: str) -> None:
    path = simcc_model(tmp_path / "m.onnx")
    with pytest.raises(DataError, match=said):
        DETECTOR.configured(f"{path},{options}")
