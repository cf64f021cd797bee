"""Expectation of errors by their codes, never by their words."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipelines.session.errors import DataError, read_codes


@contextmanager
def refused(
    code: str, source: Path | str | None = None, *names: object
) -> Iterator[pytest.ExceptionInfo[DataError]]:
    """Expect a DataError of a known code about a file, folder or setting (any, if None).

    `names` are numbers, keys, files and codes that its line must hold, each as text.
    """
    assert code in read_codes("errors"), f"{code} is no known code"
    with pytest.raises(DataError) as caught:
        yield caught
    error = caught.value
    assert error.code == code, f"{error.code}: {error}"
    assert source is None or str(error.source) == str(source), error
    missing = [str(name) for name in names if str(name) not in str(error)]
    assert not missing, f"{error} holds no {missing}"
