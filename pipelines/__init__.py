"""From the logs and videos of a drone team to the measured 3D motion of the person it filmed.

The modules directly in this package are the stages (ingest, reconstruct, report, ...): each loads
tables from a session, makes one call into a room (`geometry`, `formats`, `reconstruction`, ...) and
stores what comes back. Everything here can be called from a notebook; nothing here prints.
"""

# pycolmap's wheel exports its own zlib symbols. If it is loaded before the system's libz, later PNG
# encoding and zlib calls abort or hang; loaded first, the system's library wins. Every module of
# this program runs after this line (tests/test_import_order.py watches it).
import zlib as _zlib  # noqa: F401
