"""Settings and fixtures of all tests.

Hypothesis has no deadlines here, and uses the same few examples every time, but for the profile `explore`:

HYPOTHESIS_PROFILE=explore make test
"""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

import pipelines  # noqa: F401  # before numpy, as commands do: linear algebra on one thread

# A shared machine is sometimes slow, so only the tests about time check times.
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=30)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

# A shell that starts the tests in the background lets children ignore Ctrl-C; commands under test must not.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


_HERE = Path(__file__).parent

# Test files that compile most code, slowest first. Two workers that begin with these compile little code
# twice, and the other files find it in the cache. The last is the longest file of all: begun late, it would
# keep one worker busy alone.
_FIRST = (
    "reconstruction/test_refinement.py",
    "keypoints/test_association.py",
    "planning/test_costs.py",
    "planning/test_local.py",
    "simulation/rendering/test_renderer.py",
    "planning/test_search.py",
    "simulation/test_flying.py",
    "reconstruction/test_doubts.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort those of `_FIRST` first, then those with slow tests, so that workers end at the same time."""
    first = {_HERE / name: place for place, name in enumerate(_FIRST)}
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (first.get(item.path, len(first)), item.path not in slow))


@pytest.fixture(autouse=True, scope="session")
def _no_waiting_for_the_disk() -> Iterator[None]:
    """Replace fsync, because no test cuts the power; tests/session/test_stages.py checks the syncs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield
