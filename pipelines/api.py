"""The public functions of mocap for notebooks and programs: every stage of a flight, and its tables.

Each takes paths and settings, and raises `DataError` with one line where its input cannot be used. A
`progress` is told what is done (nobody by default), `force` makes anew what is finished, and `workers` are
processes: results do not depend on them. Only what this module names is promised between versions; the rest
of `pipelines` is the inside.
"""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pyarrow as pa

from pipelines.check import check
from pipelines.draft import draft
from pipelines.export import export
from pipelines.ingest import ingest
from pipelines.planning.config import PlannerConfig
from pipelines.planning.scene import ReplanSettings
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.replan import replan as replan_compare
from pipelines.report import report
from pipelines.run import run
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from pipelines.session.stages import open_session
from pipelines.session.tables import ANGLES, SKELETON, read_table
from pipelines.simulate import simulate

__all__ = [
    "DataError",
    "PlannerConfig",
    "ReconstructSettings",
    "ReplanSettings",
    "angles",
    "check",
    "draft",
    "export",
    "ingest",
    "read_flight",
    "reconstruct",
    "replan_compare",
    "report",
    "run",
    "simulate",
    "skeleton",
]


def __dir__() -> Sequence[str]:
    return __all__


def skeleton(session: Path) -> pd.DataFrame:
    """Read the measured joints of a session, a row for each person, joint and time.

    The columns are those of `reconstruct/skeleton.parquet` (docs/session.md): positions in metres in the
    world, their covariance, and NaN where a joint is not known.

    Raises:
        DataError: it is no session, was not reconstructed, or the table was changed.
    """
    return _reconstructed(session, "skeleton", SKELETON)


def angles(session: Path) -> pd.DataFrame:
    """Read the joint angles of a session in degrees, a row for each person, angle and time.

    NaN where an angle is not known; DataError as of `skeleton`.
    """
    return _reconstructed(session, "angles", ANGLES)


def _reconstructed(session: Path, name: str, schema: pa.Schema) -> pd.DataFrame:
    if open_session(session).intact_record("reconstruct") is None:
        problem = "was not reconstructed"
        raise DataError(session, problem, f"run `mocap reconstruct {session}`", code="nothing-reconstructed")
    return read_table(session / "reconstruct" / f"{name}.parquet", schema)
