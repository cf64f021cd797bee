"""Files of the corpus: one folder for each flight, with what took hours to make.

`tuning/` and `kept/` hold a folder for each flight: its scenario, the keypoints of both detectors, and the
background's tracks and some stills, in rounded pixels. Everything else is made again from the scenario in
seconds (`benchmarks.corpus.drawn`).
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.simulation.scenario import Scenario, read_scenario

Half = Literal["tuning", "kept"]
HALVES: tuple[Half, ...] = ("tuning", "kept")
DETECTORS = ("blazepose", "blazepose-heavy")

CORPUS = Path(__file__).parent
SAMPLE = CORPUS.parents[1] / "sample_data" / "mound_walk"
RECORDED = Path(os.environ.get("MOCAP_REAL_DATA", CORPUS.parents[2] / "shared" / "data")) / "motion"
"""Folder of the recorded motions, which are no part of the repository."""

WITHOUT_PICTURES = ("09-crouch", "11-turn", "12-kick", "22-jog")
"""Flights that come with keypoint files in place of pictures: 17 joints and no background."""

_KEYPOINT_STEP_PX, _TRACK_STEP_PX, _CONFIDENCE_STEP = 0.1, 0.05, 1e-3
_CAMERA = pa.dictionary(pa.int8(), pa.string())
_INT16, _INT32 = pa.int16(), pa.int32()


@dataclass(frozen=True)
class Flight:
    """One flight of the corpus; the sample flight is one of them, for tuning."""

    half: Half
    folder: Path  # of what is kept

    @property
    def name(self) -> str:
        """The folder's name, which begins with the flight's number."""
        return self.folder.name

    @property
    def scenario_path(self) -> Path:
        """The scenario; the sample's lies with its other files."""
        return (SAMPLE if self.name == SAMPLE.name else self.folder) / "scenario.yaml"

    @property
    def scenario(self) -> Scenario:
        """The scenario."""
        return read_scenario(self.scenario_path)

    @property
    def with_pictures(self) -> bool:
        """True if the flight is reconstructed as one with videos."""
        return self.name not in WITHOUT_PICTURES

    @property
    def missing_motions(self) -> list[Path]:
        """Recorded motions that the scenario names and that are not on this machine."""
        files = self.scenario.motion_files(RECORDED).values()
        return [path for path, _ in files if not path.is_file()]

    def keypoints_path(self, detector: str) -> Path:
        """The file of a detector's keypoints."""
        return self.folder / f"{detector}.parquet"

    @property
    def background_paths(self) -> tuple[Path, Path]:
        """The files of the background's tracks and of its stills."""
        return self.folder / "background.parquet", self.folder / "stills.parquet"


def flights(halves: Sequence[Half] = HALVES) -> list[Flight]:
    """List the flights of these halves in the order of their numbers, the sample flight last."""
    found = [Flight(half, path.parent) for half in halves for path in CORPUS.glob(f"{half}/*/scenario.yaml")]
    if "tuning" in halves:
        found.append(Flight("tuning", CORPUS / "tuning" / SAMPLE.name))
    return sorted(found, key=lambda flight: flight.name)


# --- keypoints -----------------------------------------------------------------------------------------

_KEYPOINTS = pa.schema(
    [
        ("camera", _CAMERA),
        ("person", _INT16),
        ("joint", pa.int8()),
        *((name, _INT16) for name in ("frame", "x", "y", "confidence")),
    ]
)


@dataclass(frozen=True)
class Keypoints:
    """Result of the detection in the pictures of all cameras."""

    joints: tuple[str, ...]
    counts: dict[str, Any]  # of the stage `detect`, by camera
    tables: dict[str, pd.DataFrame]  # rows of `tables.KEYPOINTS` without times, by camera


def write_keypoints(path: Path, keypoints: Keypoints) -> None:
    """Write keypoints, rounded."""
    parts = []
    for camera, table in keypoints.tables.items():
        joint = table["joint"].map({name: number for number, name in enumerate(keypoints.joints)})
        rounded = {
            "camera": camera,
            "person": table["person"],
            "joint": joint,
            "frame": table["frame"],
            "x": _steps(table["x"], _KEYPOINT_STEP_PX),
            "y": _steps(table["y"], _KEYPOINT_STEP_PX),
            "confidence": _steps(table["confidence"], _CONFIDENCE_STEP),
        }
        parts.append(pd.DataFrame(rounded).sort_values(["person", "joint", "frame"]))
    said = {"joints": json.dumps(keypoints.joints), "counts": json.dumps(keypoints.counts)}
    _write(path, pd.concat(parts), _KEYPOINTS, said)


def read_keypoints(path: Path) -> Keypoints:
    """Read keypoints in the order in which the detector writes them."""
    stored = pq.read_table(path)
    said = {key.decode(): json.loads(value) for key, value in (stored.schema.metadata or {}).items()}
    joints = tuple(said["joints"])
    tables = {}
    ordered = stored.to_pandas().sort_values(["frame", "person", "joint"])
    for camera, rows in ordered.groupby("camera", observed=True):
        tables[str(camera)] = pd.DataFrame(
            {
                "frame": rows["frame"].to_numpy(np.int64),
                "person": rows["person"].to_numpy(np.int64),
                "joint": np.array(joints, dtype=object)[rows["joint"].to_numpy(np.int64)],
                "x": rows["x"].to_numpy(np.float64) * _KEYPOINT_STEP_PX,
                "y": rows["y"].to_numpy(np.float64) * _KEYPOINT_STEP_PX,
                "confidence": rows["confidence"].to_numpy(np.float64) * _CONFIDENCE_STEP,
            }
        )
    return Keypoints(joints, said["counts"], tables)


# --- background ----------------------------------------------------------------------------------------

_SIGHTINGS = pa.schema(
    [("camera", _CAMERA), ("point", _INT32), ("frame", _INT32), ("x", _INT16), ("y", _INT16)]
)
_STILLS = pa.schema([("camera", _CAMERA), ("frame", _INT32), ("jpeg", pa.binary())])


@dataclass(frozen=True)
class Background:
    """Background of one camera."""

    tracks: pd.DataFrame  # rows of `tables.TRACKS`
    stills: dict[int, bytes]  # JPEG files by the number of the frame


def write_backgrounds(flight: Flight, backgrounds: Mapping[str, Background]) -> None:
    """Write the tracks of all cameras, rounded, and their stills."""
    tracks, stills = [], []
    for camera, background in backgrounds.items():
        seen = background.tracks
        rounded = {
            "camera": camera,
            "point": seen["point"],
            "frame": seen["frame"],
            "x": _steps(seen["x"], _TRACK_STEP_PX),
            "y": _steps(seen["y"], _TRACK_STEP_PX),
        }
        tracks.append(pd.DataFrame(rounded).sort_values(["point", "frame"]))
        kept = background.stills
        stills.append(pd.DataFrame({"camera": camera, "frame": list(kept), "jpeg": list(kept.values())}))
    for path, parts, schema in zip(
        flight.background_paths, (tracks, stills), (_SIGHTINGS, _STILLS), strict=True
    ):
        _write(path, pd.concat(parts), schema, {})


def read_backgrounds(flight: Flight) -> dict[str, Background]:
    """Read the tracks in the order in which the follower writes them, and the stills."""
    tracks, stills = (pq.read_table(path).to_pandas() for path in flight.background_paths)
    tracks = tracks.sort_values(["frame", "point"])
    backgrounds = {}
    for camera, rows in tracks.groupby("camera", observed=True):
        table = pd.DataFrame({name: rows[name].to_numpy(np.int64) for name in ("frame", "point")})
        table[["x", "y"]] = rows[["x", "y"]].to_numpy(np.float64) * _TRACK_STEP_PX
        own = stills[stills["camera"] == camera]
        backgrounds[str(camera)] = Background(table, dict(zip(own["frame"], own["jpeg"], strict=True)))
    return backgrounds


def _steps(values: Any, step: float) -> Any:
    return np.rint(np.asarray(values, dtype=np.float64) / step).astype(np.int64)


def _write(path: Path, rows: pd.DataFrame, schema: pa.Schema, said: dict[str, str]) -> None:
    table = pa.Table.from_pandas(rows, schema=schema.with_metadata(said), preserve_index=False)
    table = table.replace_schema_metadata(said)  # without the note of pandas
    numbers = [field.name for field in schema if pa.types.is_integer(field.type)]
    partial = path.with_suffix(".part")
    pq.write_table(
        table,
        partial,
        compression="zstd",
        compression_level=19,
        use_dictionary=["camera"],
        column_encoding=dict.fromkeys(numbers, "DELTA_BINARY_PACKED"),
    )
    partial.replace(path)
