"""Whole folders: they appear complete or not at all, and finished parts survive an interrupt."""

from pathlib import Path

import pytest

from pipelines.session.errors import BusyError, DataError
from pipelines.session.storage import Making, is_made, whole_folder, write_json

MARK = "mark.json"


def make(target: Path, key: str = "k", *, overwrite: bool = False, made: list[str] | None = None) -> None:
    def produce(folder: Path) -> None:
        (folder / "content").write_text("part")
        if made is not None:
            made.append(key)

    with whole_folder(target, key, mark=MARK, overwrite=overwrite) as making:
        part = making.part("one", produce)
        (making.folder / "copy").write_text((part / "content").read_text())
        write_json(making.folder / MARK, {"key": key})
        making.publish()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_finished_parts_outlive_an_interrupt_but_not_other_settings(tmp_path: Path) -> None:
    target, made = tmp_path / "flight", list[str]()

    def interrupted(key: str) -> None:
        with whole_folder(target, key, mark=MARK, overwrite=False) as making:
            making.part("one", lambda folder: made.append(str(folder)))
            making.part("two", _interrupt)

    with pytest.raises(KeyboardInterrupt):
        interrupted("k")
    assert not target.exists()
    with pytest.raises(KeyboardInterrupt):
        interrupted("k")
    assert len(made) == 1
    with pytest.raises(KeyboardInterrupt):
        interrupted("other")
    assert len(made) == 2


def _interrupt(_: Path) -> None:
    raise KeyboardInterrupt


def test_a_failure_leaves_the_old_one_and_no_trace(tmp_path: Path) -> None:
    target = tmp_path / "flight"
    make(target)

    def failing() -> None:
        with whole_folder(target, "new", mark=MARK, overwrite=False) as making:
            (making.folder / "half").write_text("")
            raise DataError(target, "failed")

    with pytest.raises(DataError, match="failed"):
        failing()
    assert names(tmp_path) == ["flight"]
    assert names(target) == ["copy", MARK]


def test_one_of_its_own_is_replaced_and_somebody_elses_is_not(tmp_path: Path) -> None:
    target = tmp_path / "flight"
    make(target)
    make(target, "new")
    assert is_made(target, "new", mark=MARK)
    (target / MARK).unlink()
    with pytest.raises(DataError, match=r"\b1\b.*\bcopy\b.*--overwrite"):
        make(target)
    make(target, overwrite=True)
    assert is_made(target, "k", mark=MARK)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"--output$") as caught:
        make(tmp_path / "file")
    assert caught.value.source == tmp_path / "file"


def test_a_kill_between_the_two_renames_is_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "flight"
    make(target)

    def killed(making: Making) -> None:
        target.rename(tmp_path / ".flight.making" / "old")
        raise SystemExit

    with monkeypatch.context() as patched:
        patched.setattr(Making, "publish", killed)
        patched.setattr("pipelines.session.storage._put_back", lambda *_: None)
        with pytest.raises(SystemExit):
            make(target, "new")
    assert not target.exists()
    with whole_folder(target, "new", mark=MARK, overwrite=False):
        assert is_made(target, "k", mark=MARK)


def test_two_do_not_make_one_folder(tmp_path: Path) -> None:
    target = tmp_path / "flight"
    with whole_folder(target, "k", mark=MARK, overwrite=False), pytest.raises(BusyError):
        make(target)
