"""Pictures beside the 3D view: their number follows from a budget, and the joints lie in them."""

import numpy as np
import pytest

from pipelines.reporting.content import SessionContent, as_reconstructed
from pipelines.reporting.pictures import make_strips
from pipelines.reporting.summary import summarise
from pipelines.reporting.viewer import make_scene

from .reading import numbers


def test_pictures_keep_to_their_budget_and_show_the_person(content: SessionContent) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (1080, 1920, 3), dtype=np.uint8)  # nothing is larger
    summary = summarise(content)
    strips = make_strips(as_reconstructed(content), summary, lambda _camera, _frame: noise, "small")
    assert [strip.camera for strip in strips] == list(content.keypoints)
    assert sum(len(picture) for strip in strips for picture in strip.pictures) <= 3_000_000
    for strip in strips:
        assert len(strip.pictures) == len(strip.t_ns) == len(strip.joints) > 1
        assert (np.diff(strip.t_ns) > 0).all()
        known = strip.joints[np.isfinite(strip.joints)]
        assert np.percentile(known, 5) > 0
        assert np.percentile(known, 95) < 1
    scene = make_scene(summary, content.poses, strips=strips)
    assert scene is not None
    apart_s = max(float(np.median(np.diff(strip.t_ns))) / 1e9 for strip in strips)
    assert apart_s > 0.2  # which the page says
    assert numbers(scene.notes[-1]) == [pytest.approx(apart_s, abs=0.05)]


def test_without_pictures_there_are_none(content: SessionContent) -> None:
    summary = summarise(content)
    assert make_strips(as_reconstructed(content), summary, lambda _camera, _frame: None, "full") == []
    assert make_strips(as_reconstructed(content), summary, None, "full") == []
