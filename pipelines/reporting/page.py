"""The pages: of one session, and the table of many flights, each as one self-contained file."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from urllib.parse import quote

from markupsafe import Markup

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting import wording
from pipelines.reporting.arms import Replan, draw_arms_over_time, draw_from_above, summarise_replan
from pipelines.reporting.chart import MOST_BINS, Figure
from pipelines.reporting.content import SessionContent, as_reconstructed, items, number, section, text
from pipelines.reporting.figures import draw_all
from pipelines.reporting.layout import Block, Bullets, Fold, Page, Section
from pipelines.reporting.overlays import ReadFrame, collect_moments, residuals_over_time
from pipelines.reporting.pictures import Video, draw_overlays, make_strips, panel_source, panel_width
from pipelines.reporting.studies import draw_study, study_blocks
from pipelines.reporting.summary import (
    Summary,
    at_a_glance,
    give_verdict,
    summarise,
    table_of_cameras,
    table_of_joints,
    table_of_quality,
    tables_of_errors,
)
from pipelines.reporting.viewer import make_scene
from pipelines.reporting.wording import Column, Table, environment
from pipelines.session.tables import moving_bodies


def _template(name: str, **context: object) -> Markup:
    return Markup(environment().get_template(name).render(**context))  # noqa: S704 - escaped by the template


def draw_page(content: SessionContent, read_frame: ReadFrame | None = None, video: Video = "none") -> Page:
    """Draw a session's report, without its tables in it; the overlays are on pictures of `read_frame`."""
    summary = summarise(content)
    replan = _replan(summary, content)
    figures = {figure.key: figure for figure in _draw(summary, content, replan)}
    measured = as_reconstructed(content)
    strips = make_strips(measured, summary, read_frame, video)
    fitted = content.bodies, content.shapes
    bodies = [] if fitted[0] is None or fitted[1] is None else moving_bodies(fitted[0], fitted[1])
    scene = make_scene(summary, content.poses | content.refined, replan, strips, bodies)
    overlays = _overlays(measured, summary, read_frame)
    started = wording.moment(summary.origin_ns)

    def drawn(*keys: str) -> list[Block]:
        return [figures[key] for key in keys if key in figures]

    verdict = give_verdict(content, summary)
    shown = [] if scene is None else [_template("viewer.html.j2", scene=scene, refined=bool(content.refined))]
    statuses = [
        ("note", f"{wording.STATUS_LABELS[word].capitalize()}: {wording.STATUS_REASONS[word]}.")
        for word in STATUS
        if summary.counts.get(word)
    ]
    joints: list[Block] = [table_of_joints(summary), Bullets(statuses)] if summary.motion is not None else []
    errors = tables_of_errors(summary)
    tables: list[Block] = [
        *([Fold("All measures", errors)] if errors else []),
        *([Fold("Every joint", [*joints, *drawn("joints", "sigmas")])] if joints else []),
        Fold("What was ingested", [table_of_cameras(content, summary, started), *drawn("timeline")]),
        Fold("How good the data of each camera is", [table_of_quality(content, summary)]),
        Fold("Settings, versions and hashes", _how_made(content, summary)),
    ]
    sections = [
        Section("verdict", "Verdict", [_template("verdict.html.j2", verdict=verdict)]),
        Section("motion", "The motion", shown),
        Section("doubts", "What is doubtful", [Bullets(verdict.doubts)] if verdict.doubts else []),
        Section(
            "evidence",
            "Evidence",
            [
                _template("glances.html.j2", figures=_key_figures(summary), glances=at_a_glance(summary)),
                *([_template("overlays.html.j2", overlays=overlays)] if overlays is not None else []),
                *drawn("time", "residuals", "top", "angles"),
            ],
        ),
        Section("tables", "Tables and methods", tables),
        *(_replan_sections(replan, content, drawn("arms-top", "arms-time")) if replan is not None else []),
        *(
            Section(f"study-{k}", "Study", study_blocks(study, figures[f"study-{k}"]), tab="Studies")
            for k, study in enumerate(content.studies, start=1)
        ),
    ]
    simulated = ": a simulated flight" if summary.description.simulated else ""
    return Page(
        generator="mocap: a session",
        kicker=f"Session report{simulated}",
        title=summary.description.flight or content.name,
        facts=_facts(content, summary, started),
        sections=sections,
        footer="World axes east, north, up in metres; pixels count from the centre of the top left one.",
        scene=scene,
        pictures=bool(strips) or overlays is not None,
    )


def draw_session(content: SessionContent, read_frame: ReadFrame | None = None) -> list[Figure]:
    """Draw every figure of the page but the 3D viewer; the overlays have one for each moment."""
    summary = summarise(content)
    moments = collect_moments(as_reconstructed(content), summary, read_frame)
    return [*_draw(summary, content, _replan(summary, content)), *draw_overlays(moments)]


def _draw(summary: Summary, content: SessionContent, replan: Replan | None) -> list[Figure]:
    residuals = residuals_over_time(as_reconstructed(content), summary, MOST_BINS)
    return [
        *draw_all(summary, content.poses, residuals, content.angles),
        *([draw_from_above(replan), draw_arms_over_time(replan.arms)] if replan and replan.arms else []),
        *(draw_study(f"study-{k}", study.metrics) for k, study in enumerate(content.studies, start=1)),
    ]


def _replan(summary: Summary, content: SessionContent) -> Replan | None:
    if content.replan is None:
        return None
    return summarise_replan(content.replan, summary.origin_ns, len(summary.cameras))


def _replan_sections(replan: Replan, content: SessionContent, figures: Sequence[Block]) -> list[Section]:
    warnings = items(content.stages.get("replan", {}), "warnings")
    notes = [*(("doubt", str(each)) for each in warnings), *(("note", note) for note in replan.notes)]
    lead = f"{replan.verdict[:1].upper()}{replan.verdict[1:]}"
    blocks = [replan.setting, *_beside_the_flight(content), *figures, *replan.tables, Bullets(notes)]
    return [Section("replan", "Planners compared", blocks, lead, tab="Planners")]


def _beside_the_flight(content: SessionContent) -> list[str]:
    """Say why the flown arm has another error than the reconstruction of the flight."""
    compared = content.replan.metrics if content.replan is not None else {}
    modelled = number(section(section(compared, "arms"), "flown"), "mpjpe_mm")
    metrics = content.metrics or {}
    error, has = number(metrics, "mpjpe_mm"), "has"
    if error is None:  # nothing is known of the truth
        median = dict(enumerate(items(section(metrics, "verdict"), "expected_error_mm"))).get(1)
        error, has = number({"median": median}, "median"), "is expected to have"
    if modelled is None or error is None:
        return []
    return [
        "Errors of arms are modelled, a mean over errors of poses that are drawn anew. The flown arm has"
        f" {wording.fixed(modelled, 0)} mm so; this flight, with errors of its own,"
        f" {has} {wording.fixed(error, 0)} mm."
    ]


def _facts(content: SessionContent, summary: Summary, started: str) -> list[str]:
    title = summary.description.flight or content.name
    facts = [content.name] if content.name != title else []
    facts += [
        started,
        f"{wording.fixed(summary.duration_s)} s",
        wording.plural(len(summary.cameras), "camera"),
    ]
    if summary.motion is not None:
        times = summary.total / max(len(summary.joints) * len(summary.people), 1)  # also those not drawn
        facts.append(f"{len(summary.joints)} joints at {wording.whole(times)} times")
        if len(summary.people) > 1:
            facts.append(f"{len(summary.people)} people")
    method = text(summary.metrics, "method")
    return [*facts, f"method {method}"] if method else facts


def _overlays(
    content: SessionContent, summary: Summary, read_frame: ReadFrame | None
) -> dict[str, object] | None:
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
        "media": any(camera.entry.media for camera in summary.cameras),
        "refined": bool(content.refined),
    }


def _key_figures(summary: Summary) -> list[tuple[str, str, str]]:
    if summary.share is None:
        frames = sum(camera.entry.frames.count for camera in summary.cameras)
        return [(wording.whole(frames), "", "frames")]
    share, _, unit = wording.percent(summary.share).rpartition(wording.THIN)
    figures = [(share, unit, "of the joints measured")]
    for key, label in (
        ("mpjpe_mm", "mean error against truth (MPJPE)"),
        ("root_mpjpe_mm", "relative to the hips"),
        ("pa_mpjpe_mm", "after alignment (PA)"),
    ):
        value = number(summary.metrics, key)
        if value is not None:
            figures.append((wording.fixed(value), "mm", label))
    reprojection = number(section(summary.metrics, "reprojection_px"), "median")
    if reprojection is not None:
        figures.append((wording.fixed(reprojection), "px", "median reprojection error"))
    if summary.sigma_mm is not None:
        figures.append((wording.fixed(summary.sigma_mm), "mm", "stated σ per axis (median)"))
    if summary.inside_95 is not None:
        inside, _, unit = wording.percent(summary.inside_95).rpartition(wording.THIN)
        figures.append((inside, unit, "of true positions inside the 95 % ellipsoids"))
    return figures


def _how_made(content: SessionContent, summary: Summary) -> list[Block]:
    blocks: list[Block] = [
        "The same inputs and settings give the same bytes. A key is the SHA-256 of all that decides a result."
    ]
    if content.every > 1:
        blocks.append(
            f"The flight is long: figures, pictures and the 3D view are drawn from one in {content.every} of"
            " its times. Numbers of all its joint-frames are those of metrics.json."
        )
    used = text(section(summary.metrics, "method_used"), "summary")
    blocks += [f"The method {text(summary.metrics, 'method')} {used}."] if used else []
    for stage, record in content.stages.items():
        versions = [f"{name} {of}" for name, of in content.made_by.get(stage, {}).items()]
        rows = [("key", text(record, "key")), ("made by", ", ".join(versions))]
        rows += wording.flattened(section(record, "settings")) + wording.flattened(section(record, "counts"))
        kept = [row for row in rows if row[1] not in {"none", ""}]
        columns = (Column(stage, text=True), Column("value", text=True))
        blocks.append(Table(f"made-{stage}", "", columns, kept, "settings"))
    columns = (Column("file", text=True), Column("SHA-256", text=True))
    return [*blocks, Table("inputs", "", columns, list(summary.description.sources.items()), "settings")]


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

    flight: str = ""  # its manifest, as seen from the summary
    name: str | None = None  # its own name; None if it was not ingested
    failed_stage: str | None = None
    error: str | None = None  # one line; None if all went well
    figures: dict[str, float] = field(default_factory=dict)  # by column, without those not measured
    warnings: tuple[str, ...] = ()
    report: str | None = None  # path of its page, as seen from the summary
    doubt: str | None = None  # code of the doubt that explains the most

    @property
    def status(self) -> str:
        """`done` or `failed`."""
        return "done" if self.error is None else "failed"

    @property
    def arms(self) -> list[str]:
        """Columns of the planner arms that the flight has."""
        return [name for name in self.figures if name.startswith(_TILT)]

    def cells(self) -> list[object]:
        """Return the values of COLUMNS."""
        figures = [self.figures.get(name) for name in _FIGURES]
        return [self.flight, self.name, self.status, self.failed_stage, self.error, self.doubt, *figures]

    def shown(self, arms: Sequence[str]) -> list[object]:
        """Return the cells of its row on the page, with the tilt of some arms."""
        name: str | Markup = self.name or self.flight
        if self.report is not None:
            name = Markup('<a href="{}">{}</a>').format(quote(os.fsencode(self.report)), name)
        status = self.status + (f" in {self.failed_stage}" if self.failed_stage else "")
        share, *errors, reprojection = (self.figures.get(figure) for figure in _FIGURES)
        return [
            (name, self.flight if self.name else ""),
            status + (f", doubted ({self.doubt})" if self.doubt else ""),
            wording.percent(share),
            *(wording.fixed(error) for error in errors),
            wording.fixed(reprojection, 2),
            *(wording.fixed(self.figures.get(arm)) for arm in arms),
            str(len(self.warnings)),
        ]


def render_flights(rows: Sequence[FlightRow]) -> str:
    """Render the complete HTML of the summary of many flights."""
    arms = list(dict.fromkeys(name for row in rows for name in row.arms))
    columns = [
        Column("Flight", text=True),
        Column("Status", text=True),
        Column("Measured", "of joint-frames"),
    ]
    columns += [Column("MPJPE", "mm"), Column("PA-MPJPE", "mm"), Column("Reprojection", "median, px")]
    columns += [Column("Tilt", f"deg, {arm.removeprefix(_TILT)}") for arm in arms]
    table = Table(
        "flights",
        "Errors are against the truth where a flight has one. Tilt is the mean of each planner arm, simulated"
        " but for that of flown.",
        [*columns, Column("Warnings")],
        [row.shown(arms) for row in rows],
    )
    failed = [("wrong", f"{row.flight}: {row.error}") for row in rows if row.error]
    doubts = [("doubt", f"{row.name or row.flight}: {warning}") for row in rows for warning in row.warnings]
    count = f"of {wording.plural(len(rows), 'flight')}"
    doubted = sum(row.doubt is not None for row in rows)
    lead = f"{doubted} {count} {'is' if doubted == 1 else 'are'} doubted. " if doubted else ""
    lead += (
        f"{len(failed)} {count} failed; the others went through."
        if failed
        else f"{wording.plural(len(rows), 'flight')} went through all stages that were asked for."
    )
    sections = [
        Section("verdict", "Flights", [table], lead),
        Section("failed", "What failed", [Bullets(failed)] if failed else []),
        Section("doubts", "What is doubtful", [Bullets(doubts)] if doubts else []),
    ]
    title = wording.plural(len(rows), "flight")
    return Page("mocap: many flights", "Many flights", title, sections).render()
