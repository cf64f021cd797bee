"""`mocap export`: a session in the formats of other programs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from mocap_cli.options import FiniteRange, Shown, any_path, output_options, overwrite_option
from mocap_cli.several import each
from mocap_cli.terminal import say, say_next, watching

# Of more files than this only the first ones are printed.
_LONGEST_LIST = 4


class _ListsFormats(click.Command):
    """Command whose help ends with a list of all formats, also of those from other packages."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write one line for each format: its name, its title, and its units and axes."""
        from pipelines.session.registries import EXPORTS, ExportWithChoices

        rows = []
        for format_ in EXPORTS.all():
            line = format_.title
            if isinstance(format_, ExportWithChoices):
                line += f"; {'|'.join(format_.choices['unit'])}, {'|'.join(format_.choices['axes'])}"
            rows.append((format_.name, line))
        with formatter.section("Formats (the first unit and axes are the usual ones, else metres with z up)"):
            formatter.write_dl(rows)


@click.command("export", cls=_ListsFormats, short_help="Write TRC, C3D, BVH, CSV, MCAP, missions.")
@each("session", "SESSION", suffix=".export")
@click.option(
    "--to", "formats", required=True, metavar="FORMAT[,FORMAT...]", help="Formats to write, as listed below."
)
@click.option(
    "-o",
    "--output",
    type=any_path,
    help="Folder, or of several sessions the folder around them [default: the session's name with .export].",
)
@click.option("--unit", metavar="m|cm|mm|inch", help="Unit of lengths, for formats that have a choice.")
@click.option("--axes", metavar="z-up|y-up", help="Direction that is up, for formats that have a choice.")
@click.option(
    "--time",
    metavar="zero|epoch",
    help="Second 0 of formats with a choice (trc): the flight's first picture or the epoch. [default: zero]",
)
@click.option(
    "--pictures-hz",
    type=FiniteRange(0, 1000),
    help="Pictures per camera and second in mcap and rerun; 0 is none. [default: 2]",
)
@overwrite_option
@output_options
def export_command(
    session: Path,
    formats: str,
    output: Path | None,
    unit: str | None,
    axes: str | None,
    time: str | None,
    pictures_hz: float | None,
    overwrite: bool,
    shown: Shown,
) -> dict[str, Any] | None:
    """Write the skeleton and the cameras in the formats of other programs.

    export.json states for each file its format, unit and axes, and what was left out or held. Files of an
    earlier export are replaced; other files only with --overwrite.
    """
    from pipelines.export import PICTURES_HZ, export
    from pipelines.session.registries import FORMATS

    names = [name.strip() for name in formats.split(",") if name.strip()]
    if not names:
        raise click.BadParameter("names no format", param_hint="--to")
    with watching(shown.level) as progress:
        result = export(
            session,
            names,
            output,
            unit=unit,
            axes=axes,
            time=time,
            pictures_hz=PICTURES_HZ if pictures_hz is None else pictures_hz,
            overwrite=overwrite,
            progress=progress,
        )
    if shown.as_json:
        return {
            "written": [str(path) for path in result.written],
            "unchanged": [str(path) for path in result.unchanged],
        }
    _print("written", result.written)
    _print("unchanged", result.unchanged)
    every = (*result.written, *result.unchanged)
    readable = (path for path in every if any(kind.recognises(path) for kind in FORMATS.all()))
    say_next("mocap info {}", next(readable, session), shown.quiet)
    return None


def _print(what: str, paths: Sequence[Path]) -> None:
    shown = paths if len(paths) <= _LONGEST_LIST else paths[: _LONGEST_LIST - 1]
    for path in shown:
        say(f"{what}: {path}")
    if rest := len(paths) - len(shown):
        say(f"{what}: {rest} more in {paths[0].parent} (export.json lists them all)")
