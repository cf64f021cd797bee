"""The table of many flights: the status of each, and its figures."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

from pipelines.reporting import wording
from pipelines.reporting.wording import environment

COLUMNS = (
    "flight",
    "name",
    "status",
    "failed_stage",
    "error",
    "doubt",
    "reconstructed_share",
    "mpjpe_mm",
    "pa_mpjpe_mm",
    "reprojection_px",
)
"""Columns of the table as CSV; then the mean tilt of every planner arm, `warnings` and `report`."""

_FIGURES = COLUMNS[6:]
_TILT = "tilt_deg_"


@dataclass(frozen=True)
class FlightRow:
    """One flight."""

    flight: str  # its manifest, as seen from the summary
    name: str | None  # its own name; None if it was not ingested
    failed_stage: str | None
    error: str | None  # one line; None if all went well
    figures: dict[str, float]  # by column, without figures that were not measured
    warnings: tuple[str, ...]
    report: str | None  # path of its page, as seen from the summary
    doubt: str | None = None  # code of the doubt that explains the most

    @property
    def status(self) -> str:
        """`done` or `failed`."""
        return "done" if self.error is None else "failed"

    @property
    def arms(self) -> list[str]:
        """Columns of the planner arms that the flight has."""
        return [name for name in self.figures if name.startswith(_TILT)]

    @property
    def link(self) -> str | None:
        """Address of its page."""
        return None if self.report is None else quote(os.fsencode(self.report))

    def cells(self) -> list[object]:
        """Return the values of COLUMNS."""
        figures = [self.figures.get(name) for name in _FIGURES]
        return [self.flight, self.name, self.status, self.failed_stage, self.error, self.doubt, *figures]


def render_flights(rows: Sequence[FlightRow]) -> str:
    """Render the complete HTML of the summary; it loads nothing, and text from files is escaped."""
    arms = list(dict.fromkeys(name for row in rows for name in row.arms))
    failed = sum(row.error is not None for row in rows)
    return (
        environment()
        .get_template("flights.html.j2")
        .render(
            rows=rows,
            arms={name: name.removeprefix(_TILT) for name in arms},
            failed=failed,
            lead=_lead(len(rows), failed, sum(row.doubt is not None for row in rows)),
            plural=wording.plural,
        )
    )


def _lead(flights: int, failed: int, doubted: int) -> str:
    of = f"of {wording.plural(flights, 'flight')}"
    first = f"{doubted} {of} {'is' if doubted == 1 else 'are'} doubted. " if doubted else ""
    if failed == 0:
        return f"{first}{wording.plural(flights, 'flight')} went through all stages that were asked for."
    return f"{first}{failed} {of} failed; the others went through."
