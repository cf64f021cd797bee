"""Safe YAML as plain mappings, lists and numbers; what is none is told in one line."""

from __future__ import annotations

from pathlib import Path

from pipelines.session.errors import DataError


def plain_yaml(path: Path, text: str) -> object:
    """What a text says, built of plain types only.

    Args:
        path: where the text is from.
        text: of the whole file.

    Raises:
        DataError: no valid YAML; the message names the line where there is one.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    remedy = "mend it, or copy the file again if it was cut off"
    try:
        value: object = YAML(typ="safe", pure=True).load(text)
    except MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = " ".join(str(error.problem or error.context).split())
        raise DataError(path, f"is no valid YAML{line} ({problem})", remedy) from None
    except (YAMLError, ValueError, RecursionError) as error:
        problem = " ".join(str(error).split())[:200]
        raise DataError(path, f"is no valid YAML ({problem})", remedy) from None
    return value
