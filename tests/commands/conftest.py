"""Two parts of commands that take half of these tests' time are left out, but for the modules that show them.

The diagnosis of mistakes is tested by tests/reconstruction/test_doubts.py, the figures of pages by
tests/reporting. A module with `WHOLE = True` runs both.
"""

from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def _without_diagnosis_and_figures(request: pytest.FixtureRequest) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if not getattr(request.module, "WHOLE", False):
            patch.setattr("pipelines.reconstruct.doubts_of", lambda *_, **__: [])
            patch.setattr("pipelines.reporting.chart._inline_svg", lambda *_: "<svg></svg>")
        yield
