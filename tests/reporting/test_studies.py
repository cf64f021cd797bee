"""The page's words about a study, against summaries with chosen numbers."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.reporting.content import StudyContent
from pipelines.reporting.studies import METRICS, draw_studies, summarise_studies, what_it_shows
from pipelines.simulation.study.settings import command_of, settings_for

from .reading import numbers


def estimate(mean: float, *, half: float = 0.0) -> dict[str, Any]:
    return {"mean": mean, "interval": [mean - half, mean + half] if half else None, "trials": 4}


def summary_of(study: str, cells: list[dict[str, Any]]) -> dict[str, Any]:
    settings = {
        "study": study,
        "tilts_deg": list(dict.fromkeys(cell["tilt_deg"] for cell in cells)),
        "drones": list(dict.fromkeys(cell["drones"] for cell in cells)),
        "noise": {cell["noise"]: cell["noise_model"] for cell in cells},
        "methods": list(dict.fromkeys(cell["method"] for cell in cells)),
        "keypoints": "model",
        "detector": None,
        "seconds": 75.0,
        "rate_hz": 30.0,
        "trials": 4,
        "seed": 0,
    }
    return {"study": study, "keypoints": "modelled after blazepose", "settings": settings, "cells": cells}


def cell(mean_mm: float | None, **of: Any) -> dict[str, Any]:
    metrics = dict.fromkeys(METRICS, None) | {"reconstructed_share": estimate(0.9)}
    if mean_mm is not None:
        metrics["mpjpe_mm"] = metrics["root_mpjpe_mm"] = estimate(mean_mm, half=2.0)
    plain = {"tilt_deg": 15.0, "drones": 2, "noise": "none", "noise_model": "", "method": "dlt"}
    return {**plain, "ratio": None, "metrics": metrics, "per_joint": {}, **of}


def test_a_study_of_tilt_tells_its_ends_under_the_strongest_noise() -> None:
    cells = [
        cell(k * times, tilt_deg=tilt, noise=noise, method=method, ratio=estimate(times, half=half))
        for noise, k in (("none", 30.0), ("high", 800.0))
        for tilt, times, half in ((0.0, 1.0, 0.0), (60.0, 2.0, 0.1))
        for method in ("dlt", "robust")
    ]
    summary = summary_of("tilt", cells)
    said = what_it_shows(summary)
    assert numbers(said) == [800, 0, 1600, 60, 2.0, 1.9, 2.1]
    assert "high" in said
    assert "robust" in said
    (study,) = summarise_studies([StudyContent(summary, "mocap ablate tilt", "abc")])
    errors, shares = study.tables
    assert (errors.names, errors.header) == (2, ["noise", "method", "0 deg", "60 deg"])
    assert errors.rows[-1] == ["high", "robust", "800.0 [798.0, 802.0]", "1600.0 [1598.0, 1602.0]"]
    assert shares.rows[0] == ["none", "dlt", "90.0", "90.0"]
    (plate,) = draw_studies([StudyContent(summary, "", "")]).values()
    table = plate.numbers[""]
    assert table[(table.noise == "high") & (table.tilt_deg == 60)].mpjpe_mm.tolist() == [1600, 1600]
    assert table.mpjpe_mm_low[0] == 28
    assert "var(--level-3)" in plate.svg
    assert "simulated" in plate.caption.lower()


def test_a_study_of_one_condition_or_of_kinds_of_noise() -> None:
    alone = summary_of("robots", [cell(32.06, drones=5)])
    assert numbers(what_it_shows(alone)) == [32.1, 5]
    kinds = [cell(k, noise=noise, noise_model=noise) for noise, k in (("drift", 410), ("bias", 380))]
    said = what_it_shows(summary_of("noise", kinds))
    assert numbers(said) == [380, 378, 382, 410, 408, 412]
    assert said.index("bias") < said.index("380") < said.index("drift")


def test_a_method_that_measured_nothing_is_not_spoken_of() -> None:
    cells = [cell(None, method="robust"), cell(40.0, method="dlt")]
    said = what_it_shows(summary_of("robots", cells))
    assert "dlt" in said
    assert "robust" not in said
    with pytest.raises(ValueError, match="empty"):
        what_it_shows(summary_of("robots", cells[:1]))


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"study": "tilt"}, "mocap ablate tilt -o out"),
        (
            {"study": "tilt", "tilts_deg": [0, 30], "drones": [3], "levels": ["low", "high"], "seed": 4},
            "mocap ablate tilt --tilts 0,30 --drones 3 --levels low,high --seed 4 -o out",
        ),
        (
            {"study": "robots", "tilts_deg": [30], "drones": [2, 5], "methods": ["dlt"], "seconds": 20.0},
            "mocap ablate robots --tilt 30 --robots 2,5 --methods dlt --seconds 20 -o out",
        ),
        (
            {"study": "robots", "noise": ["bias:position_m=0.3", "white:rotation_deg=1"], "rate_hz": 5.0},
            "mocap ablate robots --noise bias:position_m=0.3 --noise white:rotation_deg=1 --rate 5 -o out",
        ),
        ({"study": "noise", "drones": [3], "trials": 40}, "mocap ablate noise --drones 3 --trials 40 -o out"),
        (
            {"study": "noise", "levels": ["none", "low", "high"], "keypoints": "exact"},
            "mocap ablate noise --levels none,low,high --keypoints exact -o out",
        ),
        ({"study": "noise", "levels": ["high"]}, "mocap ablate noise --levels high -o out"),
        (
            {"study": "tilt", "tilts_deg": [12.3456789, 30], "seed": 20240101},
            "mocap ablate tilt --tilts 12.3456789,30 --seed 20240101 -o out",
        ),
    ],
)
def test_the_command_of_a_study_is_the_one_that_was_given(asked: dict[str, Any], said: str) -> None:
    made = settings_for(**asked)
    stated = {
        **{name: getattr(made, name) for name in ("study", "keypoints", "detector", "seconds", "rate_hz")},
        **{name: getattr(made, name) for name in ("trials", "seed")},
        **{name: list(getattr(made, name)) for name in ("tilts_deg", "drones", "methods")},
        "noise": {each.label: each.model for each in made.noise},
    }
    assert command_of(stated, "out") == said
