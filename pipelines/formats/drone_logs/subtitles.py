"""Subtitles that DJI's drones write beside a video: display times, clock times and texts."""

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Bool, Int64
from pipelines.session.errors import DataError
from pipelines.session.storage import code_of, plain_text

_TIMECODE = r"(\d+):([0-5]\d):([0-6]\d)[,.](\d{3})"  # a Matrice 300 ends its 60th second at :60
_BLOCK = re.compile(rf"(?m)^{_TIMECODE} --> {_TIMECODE}[ \t]*$")
_CLOCK = re.compile(
    r"(\d{4})[-./](\d{1,2})[-./](\d{1,2}) +(\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d{3}))?(?:,(\d{3}))?(?!\d)"
)
# Some Mavic 2 write no display times: a number, then the clock time on a line of its own.
_UNTIMED = re.compile(r"(?m)^\d+[ \t]*\n(?=\d{4}[-./]\d{1,2}[-./]\d{1,2} +\d)")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_LARGEST_NS = 2**63  # in the year 2262
_SLOW_NS = 500_000_000  # subtitles further apart than this come once a second, with whole seconds


@dataclass(frozen=True)
class Subtitles:
    """Subtitles of a video, with their display times and the clock times in their text."""

    media_ns: Int64  # [B] since the video's start
    clock_ns: Int64  # [B] since the epoch, local time taken as UTC; 0 where none is shown
    texts: list[str]  # [B]

    @property
    def has_clock(self) -> Bool:
        """[B] True if a clock time is shown."""
        shown: Bool = self.clock_ns != 0
        return shown

    @property
    def are_slow(self) -> bool:
        """True if subtitles come about once a second, and not with each frame."""
        return len(self.media_ns) > 1 and float(np.median(np.diff(self.media_ns))) >= _SLOW_NS

    def start_ns(self) -> int | None:
        """Return the clock time at the video's start, by the first subtitle with a clock; None without."""
        shown = np.flatnonzero(self.has_clock)
        return int(self.clock_ns[shown[0]] - self.media_ns[shown[0]]) if len(shown) else None

    def times(self) -> tuple[Int64, Bool]:
        """Return the time at which each subtitle was written [B], and True if that is known [B].

        Subtitles of each frame: the time on their clock. Slow ones show whole seconds, so the video's own
        time is added to the clock time of its start. Without any clock it is the video's own time.
        """
        start_ns = self.start_ns()
        if start_ns is None:
            return self.media_ns, np.ones(len(self.media_ns), dtype=np.bool_)
        if self.are_slow:
            return self.media_ns + start_ns, np.ones(len(self.media_ns), dtype=np.bool_)
        return self.clock_ns, self.has_clock


def read_subtitles(path: Path) -> Subtitles:
    """Read all subtitles of a file; bytes that are not UTF-8 become a sign that no number contains."""
    try:
        text = plain_text(path.read_bytes())
    except OSError as error:
        raise DataError(
            path, f"cannot be read ({error.strerror})", "check the path", code=code_of(error)
        ) from error
    subtitles = parse_subtitles(text)
    if not subtitles.texts:
        raise DataError(
            path,
            "holds no subtitles" if text.strip() else "is empty",
            "copy it from the drone again",
            code="empty",
        )
    return subtitles


def parse_subtitles(text: str) -> Subtitles:
    """Parse the subtitles of a text; the result is empty if it has none.

    Subtitles without display times are taken to be shown from their clock times on, the first at 0.
    """
    blocks = list(_BLOCK.finditer(text))
    timed = bool(blocks)
    blocks = blocks or list(_UNTIMED.finditer(text))
    ends = [block.start() for block in blocks[1:]] + [len(text)]
    texts = [text[block.end() : end] for block, end in zip(blocks, ends, strict=False)]
    clock_ns = np.array([_clock_ns(each) or 0 for each in texts], dtype=np.int64)
    if timed:
        media_ns = np.array([_timecode_ns(block) for block in blocks], dtype=np.int64)
    else:  # since the first clock time; a subtitle without one has the time of the one before
        shown = np.maximum.accumulate(clock_ns)
        media_ns = shown - clock_ns[:1]
    return Subtitles(media_ns=media_ns, clock_ns=clock_ns, texts=texts)


def _clock_ns(text: str) -> int | None:
    """Parse the clock time of a subtitle: 2022-08-07 13:40:40,774,808 and its variants."""
    match = _CLOCK.search(text)
    if match is None:
        return None
    *whole, milliseconds, microseconds = (int(part or 0) for part in match.groups())
    try:
        elapsed = datetime(*whole, tzinfo=UTC) - _EPOCH  # type: ignore[misc,arg-type]  # six integers
    except ValueError:
        return None
    t_ns = elapsed // timedelta(microseconds=1) * 1000 + milliseconds * 1_000_000 + microseconds * 1000
    return t_ns if abs(t_ns) < _LARGEST_NS else None


def _timecode_ns(block: re.Match[str]) -> int:
    hours, minutes, seconds, milliseconds = (int(part[-6:]) for part in block.groups()[:4])
    return (((hours * 60 + minutes) * 60 + seconds) * 1000 + milliseconds) * 1_000_000
