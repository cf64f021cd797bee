"""The page of one session and the table of many flights, each as one self-contained file."""

import base64
import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting import wording
from pipelines.reporting.arms import Replan, draw_arms, summarise_replan
from pipelines.reporting.chart import MOST_BINS, Plate
from pipelines.reporting.content import SessionContent, as_reconstructed, number, section, text
from pipelines.reporting.figures import draw_all
from pipelines.reporting.overlays import ReadFrame, collect_moments, residuals_over_time
from pipelines.reporting.pictures import Video, draw_overlays, make_strips, panel_source, panel_width
from pipelines.reporting.studies import draw_studies, summarise_studies
from pipelines.reporting.summary import (
    Summary,
    summarise,
    table_of_cameras,
    table_of_joints,
    table_of_quality,
    tables_of_errors,
)
from pipelines.reporting.verdict import at_a_glance, give_verdict
from pipelines.reporting.viewer import make_scene
from pipelines.reporting.wording import environment


def render_page(content: SessionContent, read_frame: ReadFrame | None = None, video: Video = "none") -> str:
    """Render the complete HTML of a session's report.

    The same content gives the same bytes: no dates of making, no paths of this machine.
    All text from the session's files is escaped. The page loads nothing; it runs the one script of
    its 3D viewer, which its policy names by hash, and nothing else. Without `read_frame`, which reads the
    pictures behind the overlays, they are drawn on plain ground. `video` chooses how many pictures stand
    beside the 3D view.
    """
    summary = summarise(content)
    replan = _replan(summary, content)
    plates = _draw(summary, content, replan)
    script = (files("pipelines.reporting") / "templates" / "viewer.js").read_text(encoding="utf-8")
    overlays = _overlays(as_reconstructed(content), summary, read_frame)
    strips = make_strips(as_reconstructed(content), summary, read_frame, video)
    started = wording.moment(summary.origin_ns)
    return (
        environment()
        .get_template("page.html.j2")
        .render(
            name=content.name,
            title=summary.description.flight or content.name,
            summary=summary,
            description=summary.description,
            started=started,
            method=text(summary.metrics, "method"),
            verdict=give_verdict(content, summary),
            glances=at_a_glance(summary),
            key_figures=_key_figures(summary),
            ingested=[table_of_cameras(content, summary, started), table_of_quality(content, summary)],
            errors=tables_of_errors(summary),
            joints=table_of_joints(summary),
            plates=plates,
            replan=replan,
            studies=summarise_studies(content.studies),
            scene=make_scene(summary, content.poses | content.refined, replan, strips),
            refined=bool(content.refined),
            made_by=_made_by(content),
            every=content.every,
            viewer_script=Markup(script),  # noqa: S704 - our own file
            policy=_policy(script, pictures=bool(strips) or overlays is not None),
            overlays=overlays,
            # Our own drawing, in which every name was escaped when it was written.
            drawings={key: Markup(plate.svg) for key, plate in plates.items()},  # noqa: S704
            statuses=[word for word in STATUS if summary.counts.get(word)],
            status_labels=wording.STATUS_LABELS,
            status_reasons=wording.STATUS_REASONS,
            stages=[_stage_note(stage, record) for stage, record in content.stages.items()],
        )
    )


def draw_session(content: SessionContent, read_frame: ReadFrame | None = None) -> dict[str, Plate]:
    """Draw every figure of the page but the 3D viewer, by its key; the overlays have one for each moment."""
    summary = summarise(content)
    moments = collect_moments(as_reconstructed(content), summary, read_frame)
    return _draw(summary, content, _replan(summary, content)) | draw_overlays(moments)


def _draw(summary: Summary, content: SessionContent, replan: Replan | None) -> dict[str, Plate]:
    of_arms = draw_arms(replan) if replan is not None else {}
    residuals = residuals_over_time(as_reconstructed(content), summary, MOST_BINS)
    return (
        draw_all(summary, content.poses, residuals, content.angles) | of_arms | draw_studies(content.studies)
    )


def _replan(summary: Summary, content: SessionContent) -> Replan | None:
    if content.replan is None:
        return None
    return summarise_replan(content.replan, summary.origin_ns, len(summary.cameras))


def _policy(script: str, *, pictures: bool) -> str:
    """Return the page's policy: its own styles, its own script, and pictures that it holds itself."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    rules = ["default-src 'none'", "style-src 'unsafe-inline'", f"script-src 'sha256-{digest}'"]
    return "; ".join(rules + ["img-src data:"] * pictures)


def _overlays(
    content: SessionContent, summary: Summary, read_frame: ReadFrame | None
) -> dict[str, Any] | None:
    """Collect the moments, a drawing of every view, and facts about all of them; None without a view."""
    moments = collect_moments(content, summary, read_frame)
    views = {(m, view.camera): view for m, moment in enumerate(moments) for view in moment.views}
    if not views:
        return None
    width_px = panel_width(len(views))
    return {
        "moments": moments,
        "drawings": {key: panel_source(view, width_px) for key, view in views.items()},
        "pictures": sum(view.picture is not None for view in views.values()),
        "rejected": any(view.rejected.any() for view in views.values()),
        "unmeasured": any(view.unmeasured.any() for view in views.values()),
        "others": any(len(view.others) for view in views.values()),  # people beside the skeleton's
        "refined": bool(content.refined),
    }


def _key_figures(summary: Summary) -> list[tuple[str, str, str]]:
    """Return at most five numbers that say how good a recording is: value, unit and label."""
    if summary.share is None:
        frames = sum(camera.entry.frames.count for camera in summary.cameras)
        return [
            (wording.whole(len(summary.cameras)), "", "cameras"),
            (wording.whole(frames), "", "frames"),
        ]
    share, _, unit = wording.percent(summary.share).rpartition(wording.THIN)
    figures = [(share, unit, "of joint-frames measured")]
    for key, label in (
        ("mpjpe_mm", "mean error (MPJPE)"),
        ("root_mpjpe_mm", "relative to the hips"),
        ("pa_mpjpe_mm", "after alignment (PA)"),
    ):
        value = number(summary.metrics, key)
        if value is not None:
            figures.append((wording.fixed(value), "mm", label))
    reprojection = number(section(summary.metrics, "reprojection_px"), "median")
    if reprojection is not None:
        figures.append((wording.fixed(reprojection), "px", "median reprojection"))
    return figures


def _made_by(content: SessionContent) -> list[tuple[str, str]]:
    """Group the stages by the versions that made them: stages and versions."""
    made: dict[str, list[str]] = {}
    for stage in content.stages:
        if made_by := content.made_by.get(stage):
            versions = ", ".join(f"{name} {number}" for name, number in made_by.items())
            made.setdefault(versions, []).append(stage)
    return [(wording.listing(stages), versions) for versions, stages in made.items()]


def _stage_note(stage: str, record: Mapping[str, object]) -> dict[str, object]:
    """Return the settings and counts of one stage as rows."""
    settings = section(record, "settings")
    flight = section(settings, "flight")
    settings.pop("flight", None)
    return {
        "name": stage,
        "key": text(record, "key"),
        "settings": wording.flattened(settings),
        "flight": [row for row in wording.flattened(flight) if row[1] != "none"],
        "counts": wording.flattened(section(record, "counts")),
    }


# --- many flights ---


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
        wording.environment()
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
