"""Times at which a video's frames were taken: a CSV, or DJI drones' subtitles beside the video."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head
from pipelines.formats.common.rows import (
    Heading,
    describe_times,
    drop_rows,
    find_heading,
    format_seconds,
    parse_stamps,
    rows_below,
)
from pipelines.formats.drone_logs.dji_subtitles import parse_subtitles, read_subtitles
from pipelines.geometry.arrays import Bool, Int64, nearest_rows
from pipelines.session.errors import DataError
from pipelines.session.storage import read_text

_FRAME_NAMES = {"frame", "frame_id", "frame_index", "frame_number"}


@dataclass(frozen=True)
class FrameStamps:
    """Times of frames, which strictly increase; frames may be absent, and `media_ns` identifies them best."""

    frame: Int64  # [N] from 0
    t_ns: Int64  # [N] since the epoch, or since the file's own zero
    media_ns: Int64 | None = None  # [N] the time in the video that the file itself gives
    dropped: dict[str, int] = field(default_factory=dict)  # rows left out, by cause


class FrameTimesFormat:
    """Reader of frame times as CSV or as DJI's .srt; `read_frame_times` documents both."""

    name = "frame_times"
    title = "frame times"
    suffixes: tuple[str, ...] = (".csv", ".srt", ".txt", ".tsv")

    def recognises(self, path: Path) -> bool:
        """Return True for a table of times, with or without frame numbers, or subtitles of each frame."""
        head = read_head(path, self.suffixes)
        if path.suffix.lower() == ".srt":
            subtitles = parse_subtitles(head)
            return bool(subtitles.has_clock.any()) and not subtitles.are_slow
        found = _find_heading(head)
        if found is None:
            return False
        heading, column = found
        return heading.columns == 1 + (column is not None) + (heading.nanoseconds is not None)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe rows, frame numbers, times, gaps, and losses."""
        stamps = read_frame_times(path)
        return {
            "rows": len(stamps.frame),
            "first_frame": int(stamps.frame[0]),
            "last_frame": int(stamps.frame[-1]),
            **describe_times(stamps.t_ns),
            **{f"dropped: {cause}": count for cause, count in stamps.dropped.items()},
        }


def read_frame_times(path: Path) -> FrameStamps:
    """Read the time of each frame.

    CSV needs a header with a time (`stamp_column`), and frame, frame_id, frame_index or frame_number, from 0;
    without these row k is frame k. SRT: the clock time in each subtitle, as UTC because DJI writes no zone,
    numbered by the subtitles' own times. Rows are counted under the first cause that applies: "truncated last
    line", "no time", "no frame number", "duplicate frame" (the first stays), "time not increasing".
    """
    return _read_subtitles(path) if path.suffix.lower() == ".srt" else _read_csv(path)


def times_of_frames(stamps: FrameStamps, pts_ns: Int64) -> tuple[Int64, Bool]:
    """Return the times of a video's frames [N], and True where known, by `media_ns`, else by number."""
    keys, wanted = stamps.frame, np.arange(len(pts_ns), dtype=np.int64)
    tolerance = 0
    if stamps.media_ns is not None:
        keys, wanted = stamps.media_ns, pts_ns
        tolerance = int(np.median(np.diff(keys))) // 2 if len(keys) > 1 else 0
    nearest = nearest_rows(keys, wanted)
    known: Bool = np.abs(keys[nearest] - wanted) <= tolerance
    return np.where(known, stamps.t_ns[nearest], 0), known


def _find_heading(text: str) -> tuple[Heading, int | None] | None:
    """Parse the first line that is not blank, and the column of frame numbers; None if it names no time."""
    first = next(((k, line) for k, line in enumerate(text.split("\n", 100)[:100]) if line.strip()), None)
    heading = find_heading(first[1], first[0]) if first else None
    if heading is None:
        return None
    return heading, next((column for name, column in heading.names.items() if name in _FRAME_NAMES), None)


def _read_csv(path: Path) -> FrameStamps:
    text = read_text(path)
    found = _find_heading(text)
    if found is None:
        remedy = "begin it with the line frame,t_ns (or t in seconds)"
        raise DataError(path, "has no header that names the time", remedy, code="missing-column")
    heading, column = found
    if heading.columns == 1:
        # Blank lines count here: row k is frame k.
        lines = text.rstrip().split("\n")[heading.line + 1 :]
        t_ns, readable = parse_stamps(path, lines, heading.unit, unit_stated=heading.unit_stated)
        return _clean(path, np.arange(len(t_ns)), t_ns, None, {"no time": ~readable}, {})
    table = rows_below(path, heading, text, {} if column is None else {"frame": column}, {})
    t_ns, readable = parse_stamps(path, table.text["stamp"], heading.unit, unit_stated=heading.unit_stated)
    frame, numbered = np.arange(len(t_ns)), np.ones(len(t_ns), dtype=np.bool_)
    if column is not None:
        frame, numbered = _frame_numbers(table.text["frame"].to_pylist())
    dropped = {"truncated last line": table.truncated} if table.truncated else {}
    return _clean(path, frame, t_ns, None, {"no time": ~readable, "no frame number": ~numbered}, dropped)


def _frame_numbers(cells: list[str]) -> tuple[Int64, Bool]:
    """Parse whole numbers, also as 12.0; 0 and False for any other cell."""
    matches = [re.fullmatch(r"\s*(\d{1,18})(?:\.0*)?\s*", cell or "") for cell in cells]
    frame = np.array([int(match[1]) if match else 0 for match in matches], dtype=np.int64)
    return frame, np.array([match is not None for match in matches], dtype=np.bool_)


def _read_subtitles(path: Path) -> FrameStamps:
    subtitles = read_subtitles(path)
    known, media_ns = subtitles.has_clock, subtitles.media_ns
    start_ns = subtitles.start_ns()
    if start_ns is None:
        problem = f"its {len(media_ns)} subtitles show no clock time"
        raise DataError(path, problem, "state frame_times: {start: SECONDS}", code="clock-unknown")
    if subtitles.are_slow:  # with whole seconds: not the time of each frame
        problem = f"shows a time every {np.median(np.diff(media_ns)) / 1e9:g} s, not for each frame"
        start = format_seconds(np.array([start_ns]))[0]
        raise DataError(path, problem, f"write frame_times: {{start: {start}}} and let clock.sigma_s be 1")
    return _clean(path, _slots(media_ns), subtitles.clock_ns, media_ns, {"no time": ~known}, {})


def _slots(media_ns: Int64) -> Int64:
    """Compute frame numbers from the subtitles' own times, one or more for each step."""
    steps = np.diff(np.maximum.accumulate(media_ns))  # a subtitle that goes back repeats its frame
    typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    counts = np.where(steps > 0, np.maximum(np.rint(steps / typical), 1), 0)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _clean(
    path: Path,
    frame: Int64,
    t_ns: Int64,
    media_ns: Int64 | None,
    causes: dict[str, Bool],
    dropped: dict[str, int],
) -> FrameStamps:
    """Sort by frame, then drop the rows that `read_frame_times` lists."""
    order = np.argsort(frame, kind="stable")
    keep = np.ones(len(order), dtype=np.bool_)

    for cause, bad in causes.items():
        drop_rows(keep, bad[order], cause, dropped)
    drop_rows(keep, _not_rising(frame[order], keep), "duplicate frame", dropped)
    drop_rows(keep, _not_rising(t_ns[order], keep), "time not increasing", dropped)
    kept = order[keep]
    if not len(kept):
        counts = ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it has no rows"
        problem = f"holds no usable frame time ({counts})"
        raise DataError(path, problem, "check how it was written", code="clock-unknown")
    return FrameStamps(frame[kept], t_ns[kept], None if media_ns is None else media_ns[kept], dropped)


def _not_rising(values: Int64, among: Bool) -> Bool:
    """Mark the rows among `among` that are not above the largest before them."""
    rows = np.flatnonzero(among)
    bad = np.zeros(len(values), dtype=np.bool_)
    if len(rows) > 1:
        bad[rows[1:]] = values[rows][1:] <= np.maximum.accumulate(values[rows])[:-1]
    return bad


FORMAT = FrameTimesFormat()
