"""A study from a stranger cannot make a command write, or tell, anything elsewhere."""

import http.client
from pathlib import Path
from threading import Thread

import pytest
import report_tables
from report_runs import random_run

from ssm_study import style
from ssm_study.export.targets import write_controller
from ssm_study.refusal import BadRequest
from ssm_study.report.page.live import is_local_host_name, start_server
from ssm_study.report.page.writing import write_page

pytest.importorskip("altair", reason="the extra `report` is not installed")
INTACT = "what must stay as it is"


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    file = tmp_path / "victim"
    file.write_text(INTACT)
    return file


@pytest.fixture
def study(tmp_path: Path) -> Path:
    frame = report_tables.table(3)
    return report_tables.write_study(tmp_path / "a<!--data-->b", frame)


def test_the_page_replaces_a_link_and_does_not_follow_it(study: Path, victim: Path) -> None:
    (study / "report.html").symlink_to(victim)
    page = write_page(study)
    assert victim.read_text() == INTACT
    assert not page.is_symlink()


def test_the_figures_replace_links_and_a_linked_folder_is_refused(
    study: Path, victim: Path, tmp_path: Path
) -> None:
    folder = study / "figures"
    folder.mkdir(exist_ok=True)
    (folder / "a.png").symlink_to(victim)
    style.save_figure(style.new_figure(), folder, "a")
    assert victim.read_text() == INTACT
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    linked = study / "linked"
    linked.symlink_to(elsewhere)
    with pytest.raises(BadRequest, match="link"):
        style.save_figure(style.new_figure(), linked, "a")
    paths = list(elsewhere.iterdir())
    assert paths == []


def test_the_export_replaces_links(tmp_path: Path, victim: Path) -> None:
    run_path = tmp_path / "study" / "run"
    run = random_run(run_path, kind="linear", channels=1, seed=0)
    folder = tmp_path / "to"
    folder.mkdir()
    for name in ("controller.h", "controller.json", "controller.py"):
        (folder / name).symlink_to(victim)
    written = write_controller(run, folder)
    assert victim.read_text() == INTACT
    assert not any(path.is_symlink() for path in written)


def test_a_study_that_is_named_like_a_place_in_the_page_does_not_spoil_it(study: Path) -> None:
    """The data went into the title, and the page was dead."""
    html = write_page(study).read_text(encoding="utf-8")
    title = html.split("<title>")[1].split("</title>")[0]
    assert "a&lt;!--data--&gt;b" in title or len(title) < 200
    assert "<!--data-->" not in html
    assert len(html.split("<title>")[0]) < 2000


HOSTS = {
    "localhost:8420": True,
    "127.0.0.1": True,
    "[::1]:80": True,
    "LOCALHOST": True,
    "attacker.example:8420": False,
    "localhost.attacker.example": False,
    "127.0.0.1.attacker.example": False,
    "": False,
}


@pytest.mark.parametrize("host", HOSTS)
def test_the_live_page_answers_to_the_names_of_this_machine_alone(study: Path, host: str) -> None:
    """A page elsewhere can give its own name our address, and then read what we answer."""
    assert is_local_host_name(host) is HOSTS[host]
    with start_server(study, 0, lambda _: None) as server:
        thread = Thread(target=server.serve_forever, daemon=True)
        thread.start()
        connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1])
        headers = {"Host": host}
        connection.request("GET", "/state", headers=headers)
        status = connection.getresponse().status
        expected = 200 if HOSTS[host] else 403
        assert status == expected
        server.shutdown()
