"""Decompression that trusts no size in the file: bounded output, also of data that is cut off."""

from __future__ import annotations

from typing import Protocol

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class _Decompressor(Protocol):
    def decompress(self, data: memoryview | bytes, max_length: int) -> bytes: ...


def inflate(data: memoryview | bytes, compression: str, size: int) -> tuple[memoryview | bytes, bool]:
    """Decompress at most `size` bytes; also return True if that was all, neither cut off nor longer.

    Args:
        data: one compressed frame, perhaps cut off.
        compression: none (or empty), bz2, lz4 or zstd.
        size: largest length of the result.

    Raises:
        ValueError: an unknown compression, or bytes that are not in this compression.
    """
    if compression in {"", "none"}:
        return data[:size], len(data) <= size
    if compression == "bz2":
        from bz2 import BZ2Decompressor

        return _bounded(BZ2Decompressor(), data, size, OSError)
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return _bounded(LZ4FrameDecompressor(), data, size, RuntimeError)
    if compression == "zstd":
        from backports.zstd import ZstdDecompressor, ZstdError

        return _bounded(ZstdDecompressor(), data, size, ZstdError)
    raise ValueError(f"compression {compression!r} is not read")


def _bounded(
    decompressor: _Decompressor, data: memoryview | bytes, size: int, failure: type[Exception]
) -> tuple[bytes, bool]:
    try:
        # One byte more than allowed shows if the data goes on.
        content = decompressor.decompress(data, max_length=size + 1)
    except (failure, EOFError) as error:
        raise ValueError(str(error)) from error
    return content[:size], len(content) <= size and bool(getattr(decompressor, "eof", True))
