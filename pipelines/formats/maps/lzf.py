"""Decompression of LZF, as in point clouds of PCL, compiled."""

from pipelines.geometry.arrays import Bytes
from pipelines.geometry.compilation import cached


@cached
def decompress(packed: Bytes, target: Bytes) -> int:
    """Fill `target` from an LZF stream.

    The stream (liblzf by Marc Lehmann, lzf_d.c) is a sequence of instructions, each with a byte c first:

    - c < 32: copy the c + 1 bytes that follow;
    - else: repeat (c >> 5) + 2 bytes of the output (if c >> 5 is 7, a byte to add to the length follows) from
      ((c & 31) << 8) + next byte + 1 bytes back; the two may overlap.

    Returns:
        The bytes written, or -1 if the stream is cut off, too long or points outside.
    """
    read, written = 0, 0
    while read < len(packed):
        control = int(packed[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > len(packed) or written + length > len(target):
                return -1
            target[written : written + length] = packed[read : read + length]
            read += length
        else:
            length = (control >> 5) + 2
            if length == 9 and read < len(packed):
                length += int(packed[read])
                read += 1
            if read >= len(packed):
                return -1
            source = written - ((control & 31) << 8) - int(packed[read]) - 1
            read += 1
            if source < 0 or written + length > len(target):
                return -1
            for k in range(length):  # one by one, because the two ranges may overlap
                target[written + k] = target[source + k]
        written += length
    return written
