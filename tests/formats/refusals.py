"""Expectation of refusals: their source, and the numbers, keys and names in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipelines.session.errors import DataError


@contextmanager
def refuses(source: Path | str, *named: object) -> Iterator[None]:
    """Expect a DataError of this source that holds each of these numbers, keys and names as whole words."""
    with pytest.raises(DataError) as caught:
        yield
    error = caught.value
    assert str(error.source) == str(source)
    told = f"{error.problem}; {error.remedy}"
    missing = [name for name in named if not re.search(rf"(?<!\w){re.escape(str(name))}(?!\w)", told)]
    assert not missing, f"{told!r} holds no {missing}"
