"""Recognition of files by the registered formats, and what other files seem to be."""

import json
import re
import stat
import tomllib
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pipelines.session.errors import DataError
from pipelines.session.registries import FORMATS, Format
from pipelines.session.storage import (
    files_in,
    is_folder,
    own_table,
    plain_text,
    refuse_special,
    text_encoding,
)

F = TypeVar("F")

# Every kind is known by less than its first 64 kB.
HEAD_BYTES = 64 * 1024
# Of an ending that more kinds of files have, the first bytes say more.
_MOST_KINDS = 2
# Larger text takes seconds to parse, and is described by its first line.
MAX_PARSED_BYTES = 8 << 20
# A line with more names of keys, columns or endings is not read to its end.
MAX_NAMES_IN_MESSAGE = 8


EXPECTED = (
    "expected is a log, a video, keypoints, a calibration, a trajectory, joints or a map; "
    "docs/formats.md lists the formats"
)
"""Remedy for a file of which nothing better is known."""


def recognise(path: Path, protocol: type[F], noun: str, *, name: str | None = None) -> F:
    """Find the one registered format of a kind that recognises a file; arguments as `recognise_any` has."""
    found: Any = recognise_any(path, (protocol,), noun, name=name)
    read: F = found
    return read


def recognise_any(path: Path, protocols: tuple[type, ...], noun: str, *, name: str | None = None) -> Format:
    """Find the one registered format of some kinds that recognises a file, or has the stated name."""
    if name is not None:
        stated = FORMATS.get(name)
        if isinstance(stated, protocols):
            if path.is_file() and not stated.recognises(path):
                others = [f.title for f in FORMATS.all(protocols) if f.recognises(path)]
                if others:
                    problem = f"is no {stated.title} but {' or '.join(others)}"
                    raise DataError(path, problem, "leave `format:` out", code="wrong-kind")
            return stated
        raise DataError(path, f"{name} is no format of a {noun}", "leave `format:` out", code="wrong-kind")
    if not (path.exists() or is_folder(path)):
        remedy = "check the path; paths are relative to the file that names them"
        raise DataError(path, "does not exist", remedy, code="no-such-file")
    refuse_special(path)
    refuse_pointers(path)
    candidates = FORMATS.all(protocols)
    matches = [f for f in candidates if f.recognises(path)]
    if len(matches) == 1:
        return matches[0]
    if not matches:
        likely = [f for f in candidates if path.suffix and path.suffix.lower() in f.suffixes]
        if len(likely) == 1 and path.is_file() and not any(f.recognises(path) for f in FORMATS.all()):
            return likely[0]  # its reader says exactly what is wrong
        raise _unrecognised(path, noun, sorted(f.name for f in candidates))
    problem = f"could be {' or '.join(sorted(f.name for f in matches))}"
    raise DataError(path, problem, "say which with `format:`", code="ambiguous")


def _unrecognised(path: Path, noun: str, known: list[str]) -> DataError:
    """Report a file that is of another kind than expected, or of none."""
    others = [f.title for f in FORMATS.all() if f.recognises(path)]
    remedy = f"a {noun} is expected here: {', '.join(known)}"
    if others:
        return DataError(path, f"is no {noun} but {' or '.join(others)}", remedy, code="wrong-kind")
    like = describe_unknown(path)
    return DataError(
        path,
        f"{like.problem} and no {noun}",
        "; ".join(filter(None, [like.remedy, remedy])),
        code="wrong-kind",
    )


class Likeness(NamedTuple):
    """Description of an unrecognised file: `problem` completes "FILE: ..."; `remedy` is empty if unknown."""

    problem: str
    remedy: str = ""


_AS_RECORD = (
    "give the drone's own log; or, if its angles are degrees to the east, up and to the right, name the"
    " columns as a flight record does: time(seconds), latitude, longitude, altitude(meters), yaw, pitch, roll"
)
_COPY = "it is damaged or of another kind: copy it again from where it was recorded"


@cache
def _unread_kinds() -> list[tuple[re.Pattern[bytes], str, str]]:
    """Return the kinds that are known by their first bytes but not read, and what makes them usable."""
    kinds = own_table(__file__, "unread")["kind"]
    return [(re.compile(each["begins"].encode()), each["is"], each.get("remedy", "")) for each in kinds]


# DJI's binary records, by the drone's signatures (DatCon), by the app's prefix (dji-log-parser: place and
# length of its details, version), or by their names, which count for binary content alone.
_DJI_BINARY = re.compile(rb"(?s).{16}BUILD|.{242}DJI_LOG_V3|LOGH|.{3}\0{5}..[\x01-\x1e]")
_DJI_NAME = re.compile(r"DJIFlightRecord_|FLY\d{3}\.dat$", re.IGNORECASE)

_LFS_POINTER = re.compile(rb"version https://git-lfs\.github\.com/spec/v\d+\r?\n[^\0]{0,400}?size (\d{1,18})")


def describe_lfs_pointer(head: bytes) -> Likeness | None:
    """Describe a pointer of Git LFS, which stands for a file that was not fetched; None for other files."""
    match = _LFS_POINTER.match(head)
    if match is None:
        return None
    return Likeness(f"is a pointer of Git LFS ({int(match[1])} bytes are elsewhere)", "run `git lfs pull`")


def refuse_pointers(path: Path) -> None:
    """Refuse, with a DataError, a pointer of Git LFS, or a folder that begins with one; pass all else."""
    with suppress(OSError):
        files = sorted(files_in(path)) if is_folder(path) else [path]
        for file in islice(filter(Path.is_file, files), MAX_NAMES_IN_MESSAGE):
            with file.open("rb") as content:
                if pointer := describe_lfs_pointer(content.read(1024)):
                    raise DataError(file, *pointer, code="wrong-kind")


def describe_unknown(path: Path) -> Likeness:
    """Describe an existing file or folder that is not recognised. Never raise."""
    if path.is_dir():
        return _of_folder(path)
    try:
        of_path = path.stat()
        if not stat.S_ISREG(of_path.st_mode):
            return Likeness("is a pipe, a socket or a device", "write what comes out of it to a file")
        size = of_path.st_size
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        return Likeness(f"cannot be read ({reason})", "check its permissions")
    if not size:
        return Likeness("is empty", "copy it again")
    return describe_lfs_pointer(head) or _of_bytes(path, head) or _of_text(path, head, size)


def _of_folder(path: Path) -> Likeness:
    try:
        endings = Counter(each.suffix.lower() or "no ending" for each in path.iterdir())
    except OSError as error:
        return Likeness(f"cannot be read ({error.strerror})", "check its permissions")
    if not endings:
        return Likeness("is an empty folder", "")
    held = _listed(f"{count} x {ending}" for ending, count in endings.most_common())
    return Likeness(f"is a folder of no known kind ({held})", "name a file in it, or draft a flight of it")


def _of_bytes(path: Path, head: bytes) -> Likeness | None:
    """Describe a file by its first bytes and its name; None if it may be text."""
    if len(head) >= 16 and (_is_wide(head[:64:2], head[1:64:2]) or _is_wide(head[1:64:2], head[:64:2])):
        return Likeness("is text in UTF-16 without a byte order mark", "save it as UTF-8")
    is_dji = path.suffix.lower() in {".txt", ".dat"} and _DJI_BINARY.match(head)
    if is_dji or (_DJI_NAME.match(path.name) and _undecodable(head)):
        ways = "Airdata, PhantomHelp, Flight Reader or dji-log-parser"
        remedy = f"convert it to CSV ({ways}) and give that: pose: {{file: RECORD.csv}}"
        return Likeness("is DJI's binary flight record, which mocap does not decode", remedy)
    for pattern, kind, remedy in _unread_kinds():
        if pattern.match(head):
            return Likeness(f"is {kind}", remedy)
    is_control = any(c < 32 and c not in b"\t\n\f\r" for c in head)
    if not (is_control or _undecodable(head)) or text_encoding(head) == "utf-16":
        return None
    if not is_control:
        return Likeness("is text, but not UTF-8", "save it as UTF-8")
    return _misnamed(path) or Likeness(f"is binary data that begins with {_quoted(head[:8])}", "")


def _misnamed(path: Path) -> Likeness | None:
    kinds = [f.title for f in FORMATS.all() if path.suffix and path.suffix.lower() in f.suffixes]
    if not 0 < len(kinds) <= _MOST_KINDS:
        return None
    return Likeness(f"is called {path.suffix} but is no {' or '.join(kinds)} that can be read", _COPY)


def _is_wide(low: bytes, high: bytes) -> bool:
    """Test if characters of two bytes are those of English text, by their lower and higher bytes."""
    return not any(high) and all(32 <= byte < 127 or byte in b"\r\n\t" for byte in low)


def _undecodable(head: bytes) -> bool:
    try:
        head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        return error.start < len(head) - 4  # a character that the end of the head cuts is no damage
    return False


def _of_text(path: Path, head: bytes, size: int) -> Likeness:
    text = plain_text(head)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        return Likeness("holds blank lines only", "")
    ending = path.suffix.lower()
    if ending in _PARSERS and size <= MAX_PARSED_BYTES:
        return _of_data(path, ending)
    if ending in {".yaml", ".yml"}:
        keys = re.findall(r"(?m)^(\w[\w.-]*)\s*:", re.sub(r"\A%YAML:", "#", text))
        return Likeness(
            f"is YAML with the keys {_listed(keys)}" if keys else "is YAML without names at its top"
        )
    if ending == ".srt":
        remedy = "turn on subtitles (captions) on the drone, or name its flight record or its video"
        return Likeness("holds subtitles without the positions and times of a drone", remedy)
    for mark in ",;\t":
        cells = [cell.strip(' "#') for cell in lines[0].split(mark)]
        if len(cells) > 2 and len(lines) > 1 and lines[1].count(mark) > len(cells) // 2:
            return _of_table(cells)
    return _misnamed(path) or Likeness("is text of no known kind")  # what it says may be a secret


def _of_table(cells: list[str]) -> Likeness:
    named = sum(bool(re.match(r"[A-Za-z_]", cell)) for cell in cells) > len(cells) / 2
    columns = f"the columns {_listed(cells)}" if named else f"{len(cells)} columns without names"
    names = {cell.lower() for cell in cells}
    if names & {"latitude", "lat"} and names & {"longitude", "lon", "lng", "long"}:
        turned = any(angle in name for name in names for angle in ("yaw", "heading", "pitch"))
        remedy = _AS_RECORD if turned else "places need a time and an altitude, too"
        return Likeness(f"is a table of places on Earth whose writer is not known, with {columns}", remedy)
    if {"roll", "pitch", "yaw"} <= names:
        remedy = "convert them to quaternions qx, qy, qz, qw: their order and axes are not stated"
        return Likeness(f"is a table of angles, with {columns}", remedy)
    remedy = "poses need a time, x, y, z, qx, qy, qz, qw; joints person, joint, x, y, z"
    return Likeness(f"is a table with {columns}", f"{remedy}, by name in the first line")


_PARSERS = {".json": json.loads, ".toml": tomllib.loads}


def _of_data(path: Path, ending: str) -> Likeness:
    kind = ending[1:].upper()
    try:
        content: Any = _PARSERS[ending](plain_text(path.read_bytes(), errors="strict"))
    except (OSError, ValueError, RecursionError) as error:
        return Likeness(f"is no valid {kind} ({str(error)[:100]})", "it may be cut off: copy it again")
    count = f", a list of {len(content)}" if isinstance(content, list) else ""
    first = content[0] if content and isinstance(content, list) else content
    keys = f" with the keys {_listed(str(key)[:40] for key in first)}" if isinstance(first, dict) else ""
    return Likeness(f"is {kind}{count}{keys}")


def _listed(names: Iterable[str]) -> str:
    named = [" ".join(name.split()) for name in names]
    return ", ".join(named[:MAX_NAMES_IN_MESSAGE]) + (
        f", ... ({len(named)})" if len(named) > MAX_NAMES_IN_MESSAGE else ""
    )


def _quoted(first: bytes) -> str:
    """Write bytes as text if they are printable, else in hexadecimal."""
    shown = first.rstrip(b"\0\r\n")
    plain = bool(shown) and all(32 <= byte < 127 for byte in shown)
    return repr(shown.decode("ascii")) if plain else first.hex(" ")
