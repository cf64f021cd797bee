"""Parts of a page, which is one self-contained file.

A page is a list of sections, and a section is a list of blocks: texts, tables, figures, lists and what is
folded away. One template shows them all.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files

from markupsafe import Markup

from pipelines.reporting.chart import Figure
from pipelines.reporting.wording import Table, environment


@dataclass(frozen=True)
class Fold:
    """Blocks that a click unfolds."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Bullets:
    """A list: sentences, by how much they matter: `wrong`, `doubt` or `note`."""

    sentences: Sequence[tuple[str, str]]


Block = str | Table | Figure | Fold | Bullets
"""Part of a section; a `Markup` is shown as it is, another text as a paragraph."""


@dataclass(frozen=True)
class Section:
    """Part of a page; sections of another `tab` than the first one are shown when it is chosen."""

    key: str
    title: str
    blocks: Sequence[Block]
    lead: str = ""
    tab: str = ""


@dataclass(frozen=True)
class Page:
    """All that a page shows."""

    generator: str  # of the page; it marks pages of ours, which may be overwritten
    kicker: str
    title: str
    sections: Sequence[Section]
    facts: Sequence[str] = ()
    footer: str = ""
    scene: object | None = None  # of the 3D viewer, for its template
    pictures: bool = field(default=False)  # whether the page holds any

    def render(self) -> str:
        """Return the complete HTML.

        The same page gives the same bytes. All text is escaped. The page loads nothing; it runs the one
        script of its 3D viewer if it has one, which its policy names by hash, and nothing else.
        """
        script = (files("pipelines.reporting") / "templates" / "viewer.js").read_text(encoding="utf-8")
        rules = ["default-src 'none'", "style-src 'unsafe-inline'"]
        if self.scene is not None:
            digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
            rules.append(f"script-src 'sha256-{digest}'")
        rules += ["img-src data:"] * self.pictures
        sections = [section for section in self.sections if section.blocks or section.lead]
        return (
            environment()
            .get_template("page.html.j2")
            .render(
                page=self,
                sections=sections,
                tabs=list(dict.fromkeys(section.tab for section in sections)),
                policy="; ".join(rules),
                script=Markup(script),  # noqa: S704 - our own file
            )
        )
