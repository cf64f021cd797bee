"""`mocap batch`: all stages over many flights."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import (
    Shown,
    any_place,
    force_option,
    grouped,
    output_options,
    overwrite_option,
    pictures_option,
    scheduler_option,
)
from mocap_cli.several import expanded
from mocap_cli.terminal import one_line, print_json, say, say_next, watching

if TYPE_CHECKING:
    from mocap_cli.options import ChosenPictures
    from pipelines.batch import BatchSettings


def _settings(stages: str, pictures: ChosenPictures, **others: Any) -> BatchSettings:
    from pipelines.batch import BatchSettings
    from pipelines.reconstruct import ReconstructSettings

    names = tuple(name.strip() for name in stages.split(",") if name.strip())
    return BatchSettings(names, ReconstructSettings(**vars(pictures), **others))


_settings_options = grouped(
    "settings",
    _settings,
    click.option(
        "--stages",
        default="ingest,reconstruct,replan-compare,report",
        show_default=True,
        metavar="NAME,...",
        help="Stages to run.",
    ),
    click.option(
        "--method",
        type=click.Choice(["auto", "refined", "robust", "midpoint", "dlt"]),
        default="auto",
        show_default=True,
        help="Method of `mocap reconstruct`; the next two options are that command's, too.",
    ),
    click.option(
        "--detector", default="blazepose", show_default=True, help="Detector for cameras without keypoints."
    ),
    pictures_option,
)


@click.command("batch", short_help="Run all stages over many flights, on Dask.")
@click.argument("flights", nargs=-1, required=True, metavar="FLIGHT.yaml...")
@click.option(
    "-o",
    "--output",
    type=any_place,
    metavar="FOLDER",
    help="Where sessions and summary go [default: sessions beside their flights, the summary in ./batch].",
)
@click.option(
    "--workers",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Number of workers on this machine: one for each flight; several for a long video where flights are"
    " fewer [default: all cores].",
)
@scheduler_option("Use the Dask cluster there.")
@_settings_options
@force_option
@overwrite_option
@output_options
@click.pass_context
def batch_command(
    context: click.Context,
    flights: tuple[str, ...],
    output: Path | None,
    workers: int | None,
    scheduler: str | None,
    settings: BatchSettings,
    force: bool,
    overwrite: bool,
    shown: Shown,
) -> None:
    """Ingest, reconstruct, replan and report many flights, and sum them up in a table.

    A flight that fails does not stop the others; in the end the exit status is 1. The same command again
    continues: what is finished is skipped. Results are those of single runs, byte for byte.
    """
    if workers is not None and scheduler is not None:
        raise click.UsageError("--workers are those of this machine: leave them out with --scheduler.")
    from pipelines.batch import batch
    from pipelines.session.storage import url_of

    with watching(shown.level) as progress:
        result = batch(
            expanded(flights),
            output,
            settings,
            workers=workers,
            scheduler=scheduler,
            force=force,
            overwrite=overwrite,
            progress=progress,
        )
    failures = [row for row in result.rows if row.error is not None]
    if shown.quiet:  # else they were printed when they happened
        for row in failures:
            say(f"failed: {one_line(str(row.error))}", err=True)
    if shown.as_json:
        print_json(
            {
                "flights": len(result.rows),
                "failed": len(failures),
                "unchanged": result.unchanged,
                "table": str(result.table),
                "page": str(result.page),
            }
        )
    else:
        done = len(result.rows) - len(failures)
        if not shown.quiet:
            say(f"{done} of {len(result.rows)} flights done, {result.unchanged} of them unchanged")
        for written in (result.table, result.page):
            say(f"written: {url_of(written) or written}")
    if failures:
        say(f"mocap: {len(failures)} of {len(result.rows)} flights failed", err=True)
    if not shown.as_json:
        odd = next((k for k, row in enumerate(result.rows) if row.error is not None or row.doubt), None)
        is_reconstructed = "reconstruct" in settings.stages
        follows = "mocap export {} --to trc,angles" if is_reconstructed else "mocap reconstruct {}"
        follows, place = (
            (follows, result.sessions[0]) if odd is None else ("mocap check {}", result.flights[odd])
        )
        say_next(follows, url_of(place) or place, shown.quiet)
    if failures:
        context.exit(1)
