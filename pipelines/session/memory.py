"""Memory of long flights: freed arrays go back to the system, and arrays that wait stand in a file."""

from __future__ import annotations

import ctypes
import gc
import mmap
import pickle
from pathlib import Path
from tempfile import TemporaryFile
from typing import TypeVar
from weakref import WeakSet

T = TypeVar("T")

# This is the number of M_MMAP_THRESHOLD in glibc's <malloc.h>.
M_MMAP_THRESHOLD = -3
# Arrays that fill the heap with holes have 4 MB and more; smaller ones are too many for the kernel.
MIN_RETURNED_BYTES = 1 << 22
# NumPy and its libraries are fastest with arrays that begin at a line of the cache.
ALIGNMENT_BYTES = 64


def return_freed_arrays() -> None:
    """Let freed blocks of 4 MB and more go back to the system at once.

    glibc takes blocks of up to 32 MB from its heap once some of them were freed. The heap gets holes there
    that nothing fills: a refinement of ten minutes held 2.8 GB, a third of it in use. Other C libraries have
    no such setting, and need none.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(M_MMAP_THRESHOLD, MIN_RETURNED_BYTES)


def return_unused() -> None:
    """Give memory back that allocators hold after its use, so that every part of a flight finds as much.

    Without it the most memory of a process grew by 60 MB in sixteen segments of an hour.
    """
    import pyarrow as pa

    gc.collect()
    pa.default_memory_pool().release_unused()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def available_bytes() -> int | None:
    """Return the memory that new processes may take without swapping; None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        sizes = dict(line.split(":", 1) for line in lines)
        return 1024 * int(sizes["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None


class Waiting:
    """Arrays in files of a folder, without a name, which take memory only while they are used."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._maps: WeakSet[mmap.mmap] = WeakSet()  # a file goes with the last array in it

    def put(self, value: T) -> T:
        """Return a copy of a value whose arrays are in a file."""
        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        places, end = [], 0
        for buffer in buffers:
            places.append(slice(end, end + buffer.raw().nbytes))
            end = -(-places[-1].stop // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
        if not end:
            return value
        with TemporaryFile(dir=self._folder) as file:
            for place, buffer in zip(places, buffers, strict=True):
                file.seek(place.start)
                file.write(buffer.raw())
            file.truncate(end)
            file.flush()
            mapped = mmap.mmap(file.fileno(), end)
        self._maps.add(mapped)
        whole = memoryview(mapped)
        copy: T = pickle.loads(head, buffers=[whole[place] for place in places])  # noqa: S301  # our own
        return copy

    def release(self) -> None:
        """Give back the memory of all arrays; who looks at them again reads the file."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for mapped in self._maps:
                mapped.madvise(mmap.MADV_DONTNEED)
