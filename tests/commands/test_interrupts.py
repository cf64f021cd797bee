"""Two writers: the second one reports the first. Kills are tested in tests/kills."""

from pathlib import Path

from pipelines.session.stages import locked
from tests.commands.runner import ingested, refused, succeeds
from tests.synthetic.flights import write_flight


def test_second_writer_says_so(tmp_path: Path) -> None:
    flight = write_flight(tmp_path)
    session = ingested(flight)
    with locked(session):
        holder = (session / ".lock.pid").read_text().strip()
        for arguments in (
            ("ingest", flight.manifest, "--force"),
            ("reconstruct", session),
            ("report", session),
        ):
            assert f"process {holder};" in refused(*arguments)
    succeeds("reconstruct", session, "--method", "robust")
