"""`mocap run`: one command from a folder to the verdict."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.draft import draft, must_be_drafted
from pipelines.drafting.matching import Answer, Question
from pipelines.session.manifest import read_flight
from tests.commands.runner import content, mocap, refused, result_of, succeeds
from tests.commands.test_init import write_lenses
from tests.commands.test_init_pairs import drone_of_sample
from tests.synthetic.drone_logs import write_srt
from tests.synthetic.flights import write_flight
from tests.synthetic.videos import even_ticks, write_video

WHOLE = True


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the files of a flight that `init` drafts completely, without a flight.yaml."""
    flight = write_flight(tmp_path_factory.mktemp("files"), cameras=3, seconds=1.0)
    write_lenses(flight)
    flight.manifest.unlink()
    return flight.manifest.parent


def test_a_folder_goes_to_a_verdict_and_the_same_command_changes_nothing(folder: Path) -> None:
    result = result_of("run", folder)
    assert result["flight"] == str(folder / "flight.yaml")
    assert result["assumed"]
    assert result["verdict"]["grade"] in {"good", "usable", "poor"}
    low, median, high = result["verdict"]["expected_error_mm"]
    assert 0 < low < median < high
    page = Path(result["page"])
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
    before = content(Path(result["session"]))
    last = succeeds("run", folder).splitlines()[-1]
    assert last.startswith("next: mocap ")
    assert content(Path(result["session"])) == before


def test_what_only_the_user_knows_stops_it_with_the_draft_beside_the_data(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.5)
    flight.manifest.unlink()
    done = mocap("run", tmp_path)
    assert (done.returncode, done.code) == (1, "incomplete")
    assert "--yes" not in done.stderr  # nothing is likely
    assert "missing: " in flight.manifest.read_text(encoding="utf-8")
    assert not flight.manifest.with_suffix(".session").exists()


def test_an_incomplete_draft_is_made_again_when_its_folder_has_more_unless_somebody_edited_it(
    tmp_path: Path,
) -> None:
    flight = write_flight(tmp_path / "flight", cameras=2, seconds=0.5)
    flight.manifest.unlink()
    assert mocap("run", flight.manifest.parent).code == "incomplete"
    drafted = flight.manifest.read_text(encoding="utf-8")
    edited = tmp_path / "edited" / "flight.yaml"
    shutil.copytree(flight.manifest.parent, edited.parent)
    edited.write_text(drafted.replace("name: ", "name: my "), encoding="utf-8")
    for manifest in (flight.manifest, edited):
        write_lenses(replace(flight, manifest=manifest))
    assert not must_be_drafted(edited)
    assert mocap("run", edited.parent).code != "incomplete"
    assert must_be_drafted(flight.manifest)
    draft([flight.manifest.parent], flight.manifest, overwrite=True)
    assert "missing: " not in flight.manifest.read_text(encoding="utf-8")
    assert not must_be_drafted(flight.manifest)
    (flight.manifest.parent / "site.xyz").write_text("0 0 0\n", encoding="utf-8")
    assert must_be_drafted(flight.manifest)


def test_films_without_a_calibration_get_one_question_for_the_lens_of_all(tmp_path: Path) -> None:
    for name in ("DJI_0001", "DJI_0031"):
        write_video(tmp_path / f"{name}.MP4", even_ticks(30))
        write_srt(tmp_path / f"{name}.SRT", drone_of_sample("drone1"), gimbal=False)
    asked: list[Question] = []

    def second(question: Question) -> Answer:
        asked.append(question)
        return Answer(1, stated=True)

    done = mocap("run", tmp_path)
    assert (done.code, "--yes" in done.stderr) == ("incomplete", True)
    result = draft([tmp_path], overwrite=True, ask=second)
    assert not result.missing
    assert [(each.cameras, each.key) for each in asked] == [(("DJI_0001", "DJI_0031"), "intrinsics")]
    for camera in read_flight(result.path).cameras.values():
        lens = camera.intrinsics
        assert (lens.fx, lens.width, lens.assumed) == (round(28 / 36 * 320, 1), 320, True)


def test_a_folder_without_a_flight_is_refused(tmp_path: Path) -> None:
    refused("run", tmp_path, code="wrong-kind")
    assert mocap("run").returncode == 2
