"""Codes of errors: every one that the source gives is in the list, and travels between processes."""

import ast
import pickle
from pathlib import Path

import mocap_cli
import pipelines
from pipelines.session.errors import CODES, DataError


def test_every_code_is_listed() -> None:
    folders = [Path(str(package.__file__)).parent for package in (pipelines, mocap_cli)]
    given = {
        keyword.value.value
        for folder in folders
        for path in folder.rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call) and ast.unparse(call.func).endswith("Error")
        for keyword in call.keywords
        if keyword.arg == "code" and isinstance(keyword.value, ast.Constant)
    }
    assert given <= set(CODES)


def test_a_pickled_error_keeps_its_code() -> None:
    error = pickle.loads(pickle.dumps(DataError("a.bag", "is empty", code="empty")))  # noqa: S301
    assert (error.code, str(error)) == ("empty", "a.bag: is empty")
