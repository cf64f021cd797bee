"""Readers of numbers in text files: whole files, strict about columns, exact to the last digit."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.storage import is_special, refuse_special

if TYPE_CHECKING:
    import pyarrow as pa

HEAD_BYTES = 64 * 1024
"""Bytes that `recognises` reads: enough for any header, few enough to be instant."""


def read_text(path: Path) -> str:
    r"""Read the whole file as UTF-8 without a byte order mark, lines ending in "\n".

    Raises:
        DataError: missing, unreadable, or not text.
    """
    refuse_special(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataError(
            path, f"cannot be read ({error.strerror})", "check the path and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise DataError(path, f"is not UTF-8 text (byte {error.start})", "save it as plain text") from error


def read_head(path: Path) -> str:
    """Read the first lines of a file, to recognise it; empty if the file cannot be read. Never raises."""
    if is_special(path):
        return ""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return ""
    text = head.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    return text if len(head) < HEAD_BYTES else text.rpartition("\n")[0]


@dataclass(frozen=True)
class TextTable:
    """Columns of a text file: numbers as float64 with NaN for blank cells, the rest as text."""

    text: dict[str, pa.ChunkedArray]
    numbers: dict[str, Float]
    truncated: int  # 1 if the last line was incomplete and was left out

    def stack(self, names: Sequence[str]) -> Float:
        """Return some number columns side by side, [N, len(names)]."""
        return np.stack([self.numbers[name] for name in names], axis=-1)


def parse_table(
    path: Path,
    body: str,
    *,
    delimiter: str,
    columns: int,
    text: dict[str, int],
    numbers: dict[str, int],
    first_line: int,
) -> TextTable:
    """Read delimited rows.

    If the last line does not parse, its writing was probably interrupted: it is left out and counted in
    `truncated`. Blank lines and lines that begin with # are skipped.

    Args:
        path: the file, for messages.
        body: its text below the header.
        delimiter: one character.
        columns: number of cells in every row.
        text: columns to keep as text, name to index.
        numbers: columns to read as numbers, name to index. Blank, "nan" and the like become NaN.
        first_line: the number of the body's first line in the file, for messages.

    Raises:
        DataError: another line has the wrong number of cells, or a cell that is not a number.
    """
    import pyarrow as pa

    body = re.sub(r"\n[ \t]*#[^\n]*", "\n", "\n" + body)[1:]
    wanted = {**text, **numbers}
    for truncated in (0, 1):
        try:
            table = _parse_csv(body, delimiter, columns, text, numbers)
        except pa.ArrowInvalid as error:
            lines = body.rstrip().split("\n")
            bad = _first_bad_line(lines, delimiter, columns, numbers)
            if truncated or bad is None or bad[0] < len(lines) - 1:
                where, what = bad or (0, str(error).splitlines()[0])
                raise DataError(
                    path, f"line {first_line + where}: {what}", "correct or delete that line"
                ) from error
            body = "\n".join(lines[:-1])
        else:
            return TextTable(
                text={name: table.column(str(wanted[name])) for name in text},
                numbers={
                    name: np.asarray(table.column(str(wanted[name])).to_numpy(), dtype=np.float64)
                    for name in numbers
                },
                truncated=truncated,
            )
    raise AssertionError("both attempts either return or raise")


def _parse_csv(
    body: str, delimiter: str, columns: int, text: dict[str, int], numbers: dict[str, int]
) -> pa.Table:
    """Parse rows into an Arrow table whose columns are named by their index."""
    import pyarrow as pa
    import pyarrow.csv

    types = {str(index): pa.string() for index in text.values()}
    types |= {str(index): pa.float64() for index in numbers.values()}
    if not body.strip():
        return pa.table({name: pa.array([], type=kind) for name, kind in types.items()})
    return pyarrow.csv.read_csv(
        pa.BufferReader(body.encode()),
        read_options=pyarrow.csv.ReadOptions(column_names=[str(i) for i in range(columns)]),
        parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter),
        convert_options=pyarrow.csv.ConvertOptions(column_types=types, include_columns=list(types)),
    )


def _first_bad_line(
    lines: Sequence[str], delimiter: str, columns: int, numbers: dict[str, int]
) -> tuple[int, str] | None:
    """Return the index of the first line that is no valid row, and its problem; None if all are valid."""
    for index, line in enumerate(lines):
        if not line.strip():
            continue
        try:
            cells = next(csv.reader([line], delimiter=delimiter), [])
        except csv.Error as error:  # most often a cell of more than 131072 characters
            return index, str(error)
        if len(cells) != columns:
            return index, f"{len(cells)} columns instead of {columns}"
        for name, column in numbers.items():
            if not _is_number(cells[column]):
                return index, f"{cells[column][:40]!r} is not a number ({name})"
    return None


def _is_number(cell: str) -> bool:
    try:
        float(cell or "nan")
    except ValueError:
        return False
    return True
