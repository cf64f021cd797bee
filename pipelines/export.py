"""Stage `export`: a session's skeleton and cameras in the formats of other programs."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.records import Recording
from pipelines.session.registries import EXPORTS
from pipelines.session.stages import open_session, session_name
from pipelines.session.storage import as_data_error, sha256_of
from pipelines.session.tables import POSES, SKELETON, read_table
from pipelines.session.tabular import motion_from, trajectory_from


@dataclass(frozen=True)
class Exported:
    """Where everything went."""

    folder: Path
    written: list[Path]
    unchanged: list[Path]  # the same bytes were there already


def export(
    folder: Path, formats: Sequence[str], output: Path | None = None, *, overwrite: bool = False
) -> Exported:
    """Write a session in other formats.

    Args:
        folder: the session.
        formats: registered names.
        output: where to; by default beside the session, `.export` in the place of `.session`.
        overwrite: replace files that are there and differ.

    Raises:
        DataError: no such format, nothing to export, or a file would be overwritten.
    """
    exports = [EXPORTS.get(name) for name in dict.fromkeys(name.lower() for name in formats)]
    recording = load_recording(folder)
    target = output or folder.resolve().with_name(f"{session_name(folder)}.export")
    is_new = not target.exists()
    try:
        target.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target, prefix=".writing-") as temporary:
            made = []
            for format_ in exports:
                own = Path(temporary) / format_.name
                own.mkdir()
                made += format_.write(recording, own)
            return _move(made, target, overwrite)
    except OSError as error:
        raise as_data_error(error, target) from error
    finally:
        if is_new and target.is_dir() and not any(target.iterdir()):
            target.rmdir()


def load_recording(folder: Path) -> Recording:
    """The skeleton and the cameras of a session.

    Raises:
        DataError: not a session, or damaged.
    """
    session = open_session(folder)
    description = read_description(folder)
    motion = None
    if session.record("reconstruct"):
        table = read_table(folder / "reconstruct" / "skeleton.parquet", SKELETON)
        motion = motion_from(table, tuple(dict.fromkeys(table["joint"])))
    cameras = {
        name: trajectory_from(read_table(folder / "cameras" / name / "poses.parquet", POSES))
        for name in description.cameras
    }
    return Recording(description.flight, motion, cameras)


def _move(made: Sequence[Path], target: Path, overwrite: bool) -> Exported:
    """Move finished files to their place: all of them, or none where one may not be replaced."""
    unchanged: list[tuple[Path, Path]] = []
    written: list[tuple[Path, Path]] = []
    for path in made:
        place = target / path.name
        same = place.is_file() and sha256_of(place) == sha256_of(path)
        if place.exists() and not same and not overwrite:
            raise DataError(place, "exists and differs", "choose another --output, or add --overwrite")
        (unchanged if same else written).append((path, place))
    for path, place in written:
        path.replace(place)
    return Exported(target, [place for _, place in written], [place for _, place in unchanged])
