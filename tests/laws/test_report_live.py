"""The live page: it shows what the records say now, only to this machine, and refuses what it
cannot serve."""

import json
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
import report_tables

from ssm_study.engine.records import write_record
from ssm_study.refusal import BadRequest
from ssm_study.report.page.live import LOCALHOST, start_server

pytest.importorskip("altair", reason="the extra `report` is not installed")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    folder = tmp_path / "sweep"
    for k, row in enumerate(report_tables.table(3).to_dict("records")):
        known = {
            name: value
            for name, value in row.items()
            if isinstance(value, (bool, int, float, str)) and value == value
        }
        (folder / f"run{k}").mkdir(parents=True)
        record = known | {"study": "sweep", "run": f"run{k}", "status": "ok"}
        write_record(folder / f"run{k}", record)
    return folder


@pytest.fixture
def address(study: Path) -> Iterator[str]:
    said: list[str] = []
    with start_server(study, 0, said.append) as server:
        thread = Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield said[0]
        server.shutdown()


def test_it_follows_the_records(study: Path, address: str) -> None:
    assert address.startswith(f"http://{LOCALHOST}:")
    before = json.load(urlopen(f"{address}state"))
    assert before["line"] == "Live: 3 runs: 3 ok"
    page = urlopen(address).read().decode()
    assert "run2" in page
    assert "connect-src 'self'" in page, "without it the page may not ask for the state"
    (study / "run3").mkdir()
    record = {"study": "sweep", "run": "run3", "status": "failed", "error_message": "no memory"}
    write_record(study / "run3", record)
    after = json.load(urlopen(f"{address}state"))
    assert after["line"] == "Live: 4 runs: 1 failed, 3 ok"
    assert after["mark"] != before["mark"], "the page reloads itself by this"
    assert "run3" in urlopen(address).read().decode()


def test_nothing_else_is_served(address: str) -> None:
    with pytest.raises(HTTPError, match="404"):
        urlopen(f"{address}runs.csv")


def test_a_taken_port_and_a_missing_study_are_refused(
    study: Path, address: str, tmp_path: Path
) -> None:
    port = int(address.rsplit(":", 1)[1].strip("/"))
    with pytest.raises(BadRequest, match="port"):
        start_server(study, port, print)
    with pytest.raises(BadRequest, match="no such study folder"):
        start_server(tmp_path / "none", 0, print)
