"""The page of one session: numbers and figures set into the template, in one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipelines.reporting import wording
from pipelines.reporting.content import SessionContent, number, section, text
from pipelines.reporting.figures import draw_all
from pipelines.reporting.summary import Summary, errors_per_camera, give_verdict, measures, summarise
from pipelines.session.tables import STATUS


@dataclass(frozen=True)
class KeyFigure:
    """One of the large numbers under the title."""

    value: str
    unit: str
    label: str


@dataclass(frozen=True)
class StageNote:
    """How one stage made what it made."""

    name: str
    key: str
    settings: list[tuple[str, str]]
    flight: list[tuple[str, str]]
    counts: list[tuple[str, str]]


def render_page(content: SessionContent) -> str:
    """The complete HTML of a session's report.

    The same content gives the same bytes: no dates of making, no versions, no paths of this machine.
    Whatever stands in the session's files is escaped; the page loads nothing and runs nothing.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    summary = summarise(content)
    environment = Environment(
        loader=PackageLoader("pipelines.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(
        fixed=wording.fixed,
        whole=wording.whole,
        percent=wording.percent,
        joint=wording.joint_label,
    )
    plates = draw_all(summary, content.poses)
    return environment.get_template("page.html.j2").render(
        name=content.name,
        title=summary.description.flight or content.name,
        summary=summary,
        description=summary.description,
        started=wording.moment(summary.origin_ns),
        method=text(summary.metrics, "method"),
        verdict=give_verdict(content, summary),
        key_figures=_key_figures(summary),
        measures=measures(summary),
        errors_per_camera=errors_per_camera(summary),
        plates=plates,
        # Our own drawing, in which every name was escaped when it was written.
        drawings={key: Markup(plate.svg) for key, plate in plates.items()},  # noqa: S704
        statuses=[word for word in STATUS if summary.counts.get(word)],
        status_labels=wording.STATUS_LABELS,
        status_reasons=wording.STATUS_REASONS,
        stages=[_stage_note(stage, record) for stage, record in content.stages.items()],
    )


def _key_figures(summary: Summary) -> list[KeyFigure]:
    """At most five numbers that say how good a recording is."""
    if summary.share is None:
        frames = sum(camera.entry.frames.count for camera in summary.cameras)
        return [
            KeyFigure(wording.whole(len(summary.cameras)), "", "cameras"),
            KeyFigure(wording.whole(frames), "", "frames"),
        ]
    share, _, unit = wording.percent(summary.share).rpartition(wording.THIN)
    figures = [KeyFigure(share, unit, "of joint-frames measured")]
    for key, label in (
        ("mpjpe_mm", "mean error (MPJPE)"),
        ("root_mpjpe_mm", "relative to the hips"),
        ("pa_mpjpe_mm", "after alignment (PA)"),
    ):
        value = number(summary.metrics, key)
        if value is not None:
            figures.append(KeyFigure(wording.fixed(value), "mm", label))
    reprojection = number(section(summary.metrics, "reprojection_px"), "median")
    if reprojection is not None:
        figures.append(KeyFigure(wording.fixed(reprojection), "px", "median reprojection"))
    return figures


def _stage_note(stage: str, record: Mapping[str, object]) -> StageNote:
    settings = section(record, "settings")
    flight = section(settings, "flight")
    settings.pop("flight", None)
    return StageNote(
        name=stage,
        key=text(record, "key"),
        settings=wording.flattened(settings),
        flight=[row for row in wording.flattened(flight) if row[1] != "none"],
        counts=wording.flattened(section(record, "counts")),
    )
