"""What all tests live in.

Hypothesis has no deadlines here, and the same examples every time unless asked to explore:

HYPOTHESIS_PROFILE=explore make test
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings

import pipelines  # noqa: F401  # before numpy, as commands do: linear algebra on one thread

# A shared machine is sometimes slow: time is watched by the tests that are about time.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

# A shell that starts the tests in the background has children ignore Ctrl-C; commands under test must not.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def _no_waiting_for_the_disk() -> Iterator[None]:
    """No test pulls the plug; tests/session/test_stages.py sees that what is published was synced."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield
