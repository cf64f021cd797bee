"""The pages' templates, with the words of `wording` as their filters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipelines.reporting import wording

if TYPE_CHECKING:
    from jinja2 import Environment


def environment() -> Environment:
    """Make the templates' environment: all inputs are escaped, and a missing one is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("pipelines.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters.update(
        fixed=wording.fixed,
        whole=wording.whole,
        percent=wording.percent,
        joint=wording.joint_label,
    )
    return made
