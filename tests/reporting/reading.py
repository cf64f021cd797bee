"""Readers of pages and sentences: their numbers, rows and elements, whatever the words between them."""

import re
from collections.abc import Iterable
from html.parser import HTMLParser

from pipelines.reporting.wording import THIN


def plain(text: str) -> str:
    """Return a text on one line, with plain spaces."""
    return " ".join(text.split()).replace(THIN, " ")


def numbers(text: str) -> list[float]:
    """Return the numbers of a text in their order; `10 200` is one where the space groups thousands."""
    grouped = re.sub(rf"(?<=\d){THIN}(?=\d{{3}})", "", text).replace("−", "-")
    return [float(found) for found in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w])", grouped)]


def one(texts: Iterable[str], *words: str) -> str:
    """Return the only text that holds all words."""
    (found,) = [text for text in texts if all(word in text for word in words)]
    return found


_VOID = {"meta", "br", "hr", "img", "input", "link"}


class Outline(HTMLParser):
    """Every element with the names of its attributes, ids, references, table rows and text.

    It checks the nesting.
    """

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, tuple[str, ...]]] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.links: list[str] = []
        self.words: list[str] = []
        self.cells: list[list[str]] = []
        self.described: list[str] = []
        self.data: list[str] = []
        self.scripts: list[str] = []
        self._open: list[str] = []
        self._is_data = False
        self.feed(page)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, tuple(name for name, _ in attrs)))
        self._is_data = ("type", "application/json") in attrs
        if tag not in _VOID:
            self._open.append(tag)
        if tag == "tr":
            self.cells.append([])
        elif tag in {"th", "td"}:
            self.cells[-1].append("")
        elif tag == "desc":
            self.described.append("")
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in {"aria-labelledby", "aria-describedby"}:
                self.references.append(value or "")
            elif name in {"href", "src", "xlink:href"}:
                self.links.append(value or "")
            self.references += re.findall(r"url\(#([^)]+)\)", value or "")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "script":
            (self.data if self._is_data else self.scripts).append(data)
        elif not self._open or self._open[-1] != "style":
            self.words.append(data)
            if self._open and self._open[-1] == "desc":
                self.described[-1] += data
            if {"th", "td"} & set(self._open):
                self.cells[-1][-1] += f" {data}"

    def rows(self, first: str) -> list[list[str]]:
        """Return the cells of every table row that begins with a cell."""
        rows = [[plain(cell) for cell in row] for row in self.cells]
        return [row for row in rows if row and row[0] == first]

    @property
    def text(self) -> str:
        return plain(" ".join(self.words))

    @property
    def outside_drawings(self) -> list[tuple[str, tuple[str, ...]]]:
        kept, drawing = [], False
        for element in self.elements:
            drawing = drawing or element[0] == "svg"
            drawing = drawing and element[0] != "figcaption"
            if not drawing:
                kept.append(element)
        return kept

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.elements)
