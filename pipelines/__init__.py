"""Measured 3D motion of a person, from the logs and videos of the drone team that filmed it.

The modules directly in this package are the stages: each loads tables from a session, calls rooms, and stores
what comes back. Everything here can be called from a notebook; nothing here prints.
"""

# pycolmap's wheel exports its own zlib symbols. If it is loaded before the system's libz, later PNG
# encoding and zlib calls abort or hang; loaded first, the system's library wins. Every module of
# this program runs after these lines (tests/test_import_order.py watches it).
import os as _os
import zlib as _zlib  # noqa: F401

# Sums over several threads differ in their last bits with the number of threads, and the same settings must
# give the same bytes. So linear algebra has one thread, whatever the user has set. Callers share out work.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    _os.environ[_name] = "1"

# numba colours the message of every type that it tries in vain, which takes 6 % of the time to compile.
_os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
