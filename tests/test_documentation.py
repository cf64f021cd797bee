"""The documentation: reference pages name all keys, columns and models, the diagram shows the imports."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
from pydantic import BaseModel

from pipelines.geometry.triangulation import STATUS
from pipelines.session import tables
from pipelines.session.manifest import Flight
from pipelines.session.registries import NOISE_MODELS

_DOCS = Path(__file__).parents[1] / "docs"


def _words(page: str) -> set[str]:
    return set(re.findall(r"[\w-]+", (_DOCS / page).read_text(encoding="utf-8")))


def _keys(model: type[BaseModel]) -> set[str]:
    """Collect every key of a manifest, also those of its parts."""
    keys: set[str] = set()
    for name, field in model.model_fields.items():
        keys.add(field.alias or name)
        for part in _parts(field.annotation):
            keys |= _keys(part)
    return keys


def _parts(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [part for argument in getattr(annotation, "__args__", ()) for part in _parts(argument)]


def test_every_key_of_a_manifest_is_explained() -> None:
    assert _keys(Flight) - _words("flight.md") == set()


def test_every_noise_model_and_its_parameters_are_explained() -> None:
    words = _words("flight.md")
    for name, model in zip(NOISE_MODELS.names(), NOISE_MODELS.all(), strict=True):
        assert {name, *model.__dataclass_fields__} <= words, name


@pytest.mark.parametrize(
    "table", ["FRAMES", "POSES", "KEYPOINTS", "ACTOR", "TRUTH", "SKELETON", "REPLAN", "COST_MAP"]
)
def test_every_column_and_status_is_explained(table: str) -> None:
    assert set(getattr(tables, table).names) | set(STATUS) <= _words("session.md")


def test_the_diagram_shows_the_imports() -> None:
    drawn = runpy.run_path(str(_DOCS / "diagram.py"))["draw"]()
    assert (_DOCS / "architecture.svg").read_text(encoding="utf-8") == drawn, "run python docs/diagram.py"


def test_every_page_is_in_the_navigation_and_every_link_leads_somewhere() -> None:
    navigation = (_DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    for page in sorted(_DOCS.rglob("*.md")):
        assert page.relative_to(_DOCS).as_posix() in navigation
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).exists(), (page, target)
