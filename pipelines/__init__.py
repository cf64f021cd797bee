"""From the logs and videos of a drone team to the measured 3D motion of the person it filmed.

The modules directly in this package are the stages (ingest, reconstruct, report, ...): each loads
tables from a session, makes one call into a room (`geometry`, `formats`, `reconstruction`, ...) and
stores what comes back. Everything here can be called from a notebook; nothing here prints.
"""

# pycolmap's wheel exports its own zlib symbols. If it is loaded before the system's libz, later PNG
# encoding and zlib calls abort or hang; loaded first, the system's library wins. Every module of
# this program runs after these lines (tests/test_import_order.py watches it).
import os as _os
import zlib as _zlib  # noqa: F401

# Sums over several threads depend on their number, and small matrices are faster on one: the work is spread
# by its callers. Whoever set these before knows better.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    _os.environ.setdefault(_name, "1")
