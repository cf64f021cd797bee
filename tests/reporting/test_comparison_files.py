"""The comparison as a file: its place, and no overwriting of foreign files."""

from pathlib import Path

import pytest

import pipelines.report
from pipelines.report import compare_sessions
from pipelines.reporting.content import SessionContent
from pipelines.session.errors import DataError

GENERATOR = '<meta name="generator" content="mocap'


@pytest.fixture
def sessions(tmp_path: Path, content: SessionContent, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Make two folders whose contents and page are stand-ins: these tests are about files alone."""
    folders = [tmp_path / f"{name}.session" for name in ("a", "b")]
    for folder in folders:
        folder.mkdir()
    monkeypatch.setattr(pipelines.report, "content_of", lambda _: content)
    monkeypatch.setattr(
        pipelines.report, "render_comparison", lambda contents: f"{GENERATOR} {' '.join(contents)}"
    )
    return folders


def test_page_lies_beside_the_first_session(sessions: list[Path], tmp_path: Path) -> None:
    done = compare_sessions(sessions)
    page = tmp_path / "comparison" / "index.html"
    assert (done.place, done.skipped) == (page, False)
    assert done.place.read_text() == f"{GENERATOR} a b"
    assert compare_sessions(sessions).skipped
    # A page of ours is written anew.
    assert not compare_sessions(sessions[::-1]).skipped
    assert done.place.read_text() == f"{GENERATOR} b a"
    assert list(page.parent.iterdir()) == [page]


def test_nothing_foreign_is_written_over(sessions: list[Path], tmp_path: Path) -> None:
    mine = tmp_path / "thesis.html"
    mine.write_text("mine")
    with pytest.raises(DataError, match="--overwrite") as error:
        compare_sessions(sessions, mine)
    assert error.value.source == mine
    assert mine.read_text() == "mine"
    compare_sessions(sessions, mine, overwrite=True)
    assert mine.read_text().startswith(GENERATOR)
    with pytest.raises(DataError, match="--output") as error:
        compare_sessions(sessions, tmp_path, overwrite=False)
    assert error.value.source == tmp_path


def test_a_session_is_not_compared_with_itself(sessions: list[Path]) -> None:
    with pytest.raises(DataError, match="twice") as error:
        compare_sessions([sessions[0], sessions[1], sessions[0] / ".." / "a.session"])
    assert error.value.source == sessions[0]
