"""Choice of the reader of a drone's own log."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.formats.drone_logs.dji_subtitles import DJI_SRT as SUBTITLES
from pipelines.session.errors import DataError
from pipelines.sources.poses import _reader
from tests.formats.drone_logs.test_dji_srt import subtitles


def test_subtitles_of_dji_may_have_any_name(tmp_path: Path) -> None:
    path = subtitles(tmp_path / "a.srt", "[latitude: 47.25] [longitude: -8.125] [rel_alt: 3.5 abs_alt: 400]")
    assert _reader("dji", path) is SUBTITLES
    assert _reader("dji", path.rename(tmp_path / "a.txt")) is SUBTITLES


def test_what_is_none_of_dji_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("1,2,3\n")
    with pytest.raises(DataError) as refused:
        _reader("dji", path)
    assert refused.value.source == path
