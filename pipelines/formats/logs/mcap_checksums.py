"""Checksum of an MCAP file's data section, computed while the whole file is hashed anyway.

Record DataEnd has the CRC-32 of everything before it, or 0 (mcap.dev/spec, "Data End"). A check needs the
whole file. Reading a topic or two does not read it all, but hashing a source does.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

OTHER_CHECKSUM = "data section that differs from its checksum"

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<BQQQI8s")  # kind, length; start of summary and of its offsets, checksum; magic
_DATA_END = struct.Struct("<BQI")  # kind, length; checksum
_BLOCK = 1 << 20  # bytes
_FOOTER_KIND, _FOOTER_LENGTH, _DATA_END_KIND, _DATA_END_LENGTH = 2, 20, 15, 4


@dataclass(frozen=True)
class StatedChecksum:
    """Checksum that a file states of its own data section."""

    crc: int
    size: int  # of the data section: bytes from the beginning of the file


class CheckedHash:
    """Hash for `hashlib.file_digest` that also computes the checksum of the first bytes."""

    def __init__(self, stated: StatedChecksum | None) -> None:
        self._sha256 = hashlib.sha256()
        self._stated = stated
        self._left = stated.size if stated else 0
        self._crc = 0

    @property
    def differs(self) -> bool:
        """True if the file states a checksum and its bytes have another one."""
        return self._stated is not None and self._crc != self._stated.crc

    def update(self, data: memoryview) -> None:
        """Add some more bytes."""
        self._sha256.update(data)
        if self._left:
            begin = data[: self._left]
            self._crc = zlib.crc32(begin, self._crc)
            self._left -= len(begin)

    def digest(self) -> bytes:
        """Return the SHA-256 of all bytes."""
        return self._sha256.digest()


def checksum_is_right(path: Path) -> bool | None:
    """Return True if the data section has the stated checksum; reads it all. None if none is stated.

    Raises:
        OSError: the file cannot be read.
    """
    stated = stated_checksum(path)
    if stated is None:
        return None
    crc, left = 0, stated.size
    with path.open("rb") as file:
        while left and (data := file.read(min(left, _BLOCK))):
            crc = zlib.crc32(data, crc)
            left -= len(data)
    return crc == stated.crc


def stated_checksum(path: Path) -> StatedChecksum | None:
    """Return the checksum that a file states; None if it has none, is no MCAP, or has lost its end.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            return None
        size = file.seek(0, 2)
        if size < len(_MAGIC) + _DATA_END.size + _FOOTER.size:
            return None
        footer_at = file.seek(size - _FOOTER.size)
        kind, length, summary_at, _, _, magic = _FOOTER.unpack(file.read(_FOOTER.size))
        if (kind, length, magic) != (_FOOTER_KIND, _FOOTER_LENGTH, _MAGIC):
            return None
        # The summary follows the end of the data. Without a summary the footer does.
        end = (summary_at or footer_at) - _DATA_END.size
        if not len(_MAGIC) <= end <= footer_at - _DATA_END.size:
            return None
        file.seek(end)
        kind, length, crc = _DATA_END.unpack(file.read(_DATA_END.size))
    if (kind, length) != (_DATA_END_KIND, _DATA_END_LENGTH) or not crc:
        return None
    return StatedChecksum(crc, end)
