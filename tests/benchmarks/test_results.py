"""Results page: equal to the text that its command writes from the stored numbers, with all its figures."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from benchmarks.results import DOCS, ROOT, figures_of
from benchmarks.results_page import ARM_FIGURES, FILMED, POSES, SCENARIOS, STILL, STUDIES, render
from mocap_cli.main import COMMANDS

PAGE = (DOCS / "results.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def numbers() -> dict[str, Any]:
    told: dict[str, Any] = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))
    return told


def test_the_page_is_what_the_command_writes_of_its_numbers(numbers: dict[str, Any]) -> None:
    assert render(numbers) == PAGE, "run python -m benchmarks.results --page"


def test_every_table_is_whole(numbers: dict[str, Any]) -> None:
    """Count the cells: each line has as many as the header, and each row at least one number."""
    tables = re.findall(r"(?:^\|.*\n)+", PAGE, flags=re.MULTILINE)
    of_flights = [line for own in numbers["accuracy"].values() for line in own if line.startswith("| flight")]
    assert len(tables) == 1 + 4 * len(STUDIES) + 1 + 1 + len(numbers.get("gimbals", {})) + len(of_flights)
    for table in tables:
        header, rule, *rows = table.splitlines()
        assert set(rule) <= set("|- ")
        assert rows
        for row in rows:
            assert row.count("|") == header.count("|") == rule.count("|")
            assert re.search(r"\| \d+(\.\d| /)", row), row


def test_tables_hold_what_the_numbers_say(numbers: dict[str, Any]) -> None:
    for name, told in numbers["poses"].items():
        assert f"| {POSES.names[name]} | {told['mpjpe_mm']:.1f} | {told['root_mpjpe_mm']:.1f} |" in PAGE
    for flight, told in numbers["arms"].items():
        for arm, scores in told["arms"].items():
            assert f"| {flight} | {arm} | {scores['tilt_deg']['mean']:.1f} |" in PAGE


def test_figures_are_those_that_the_page_shows() -> None:
    shown = list(figures_of(PAGE))
    assert len(shown) == len(set(shown))
    assert set(shown) == {path.name for path in (DOCS / "figures").iterdir()}
    for name in set(shown) - {STILL}:
        drawing = (DOCS / "figures" / name).read_text(encoding="utf-8")
        assert "<svg" in drawing
        assert "<dc:date>" not in drawing


def test_every_command_that_the_page_names_is_one(numbers: dict[str, Any]) -> None:
    commands = re.findall(r"^    (mocap .*)$", PAGE, flags=re.MULTILINE)
    groups = (POSES.commands, SCENARIOS, FILMED)
    named = [command for of in groups for own in of.values() for command in own]
    named += [POSES.compare, *STUDIES.values(), *(command for command, _ in ARM_FIGURES.values())]
    assert sorted(commands) == sorted([*named, "mocap models fetch blazepose"])
    for command in commands:
        _, name, *words = command.split()
        assert name in COMMANDS
        inputs = [word for word in words if word.startswith("sample_data/")]
        assert all((ROOT / path).exists() for path in inputs), command
    assert set(numbers["arms"]) == set(SCENARIOS)
    assert set(numbers["studies"]) == set(STUDIES)
    assert set(numbers["filmed"]) == set(FILMED)


def test_the_real_e2_is_the_one_that_the_paper_flew(numbers: dict[str, Any]) -> None:
    """Expect the fixed formation above 45 deg, worse keypoints there, and larger reconstruction errors."""
    adaptive, fixed = (numbers["filmed"]["e2"][arm] for arm in ("adaptive", "fixed"))
    assert fixed["tilt_deg"]["mean"] > 45 > adaptive["tilt_deg"]["max"]
    # Whether a person is missed in one of 50 pictures changes with the drones' last millimetres.
    assert fixed["detected_share"] <= adaptive["detected_share"]
    assert fixed["keypoint_pck"] < adaptive["keypoint_pck"]
    assert fixed["mpjpe_mm"] > 1.5 * adaptive["mpjpe_mm"]
    for name in ("jog", "soccer"):
        assert numbers["filmed"][name]["adaptive"]["in_view_share"] >= 0.95
        assert numbers["filmed"][name]["adaptive"]["tilt_deg"]["within_5_share"] > 0.9
