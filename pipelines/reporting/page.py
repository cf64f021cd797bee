"""The page of one session: numbers and figures in the template, as one self-contained file."""

import base64
import hashlib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from markupsafe import Markup

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting import wording
from pipelines.reporting.arm_figures import draw_arms
from pipelines.reporting.content import SessionContent, as_reconstructed, number, section, text
from pipelines.reporting.figures import draw_all
from pipelines.reporting.overlays import ReadFrame, collect_moments, residuals_over_time
from pipelines.reporting.panels import Video, draw_overlays, draw_panel, make_strips, picture_width
from pipelines.reporting.plates import MOST_BINS, Plate
from pipelines.reporting.replanned import Replan, summarise_replan
from pipelines.reporting.studies import draw_studies, summarise_studies
from pipelines.reporting.summary import (
    Summary,
    errors_by_person,
    errors_per_camera,
    measures,
    quality,
    summarise,
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
    return (
        environment()
        .get_template("page.html.j2")
        .render(
            name=content.name,
            title=summary.description.flight or content.name,
            summary=summary,
            detected=set(content.keypoints),
            detector=text(section(content.stages.get("detect", {}), "settings"), "detector"),
            description=summary.description,
            started=wording.moment(summary.origin_ns),
            method=text(summary.metrics, "method"),
            verdict=give_verdict(content, summary),
            glances=at_a_glance(summary),
            key_figures=_key_figures(summary),
            measures=measures(summary),
            errors_per_camera=errors_per_camera(summary),
            errors_by_person=errors_by_person(summary),
            tracking=section(summary.metrics, "tracking"),
            plates=plates,
            replan=replan,
            studies=summarise_studies(content.studies),
            scene=make_scene(summary, content.poses | content.refined, replan, strips),
            refined=bool(content.refined),
            quality=quality(content, summary),
            hidden=bool(content.hidden),
            made_by=_made_by(content),
            every=content.every,
            viewer_script=Markup(script),  # noqa: S704 - our own file
            policy=_policy(
                script, pictures=bool(strips) or (overlays is not None and overlays["pictures"] > 0)
            ),
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
    width_px = picture_width(len(views))
    return {
        "moments": moments,
        # Our own drawing, without a word from the session's files.
        "drawings": {key: Markup(draw_panel(view, width_px)) for key, view in views.items()},  # noqa: S704
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
