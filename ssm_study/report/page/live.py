"""Local web server that keeps a study's page up to date. `ssm-study watch`: the report page
while its sweep runs, from a local port; it reloads itself when records change."""

import json
import re
from collections import Counter
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock

from ssm_study.engine.records import RECORD, read_record
from ssm_study.refusal import BadRequest, require
from ssm_study.report.page.writing import write_page
from ssm_study.table.gather import gather, record_file_states

LOCALHOST = "127.0.0.1"  # nobody else on the network sees the study
POLICY = (
    "default-src 'none'"  # what the page on disk says; the live one may ask its own server as well
)
WAITING = "<!doctype html><title>waiting</title><h1>No run has left a record yet.</h1>"
SCRIPT = """<script>
(() => { let seen = null; const line = document.createElement("p");
line.id = "live"; line.setAttribute("role", "status"); document.body.prepend(line);
setInterval(async () => { try { const now = await (await fetch("/state")).json();
  line.textContent = now.line; if (seen !== null && now.mark !== seen) location.reload();
  seen = now.mark;
} catch {
  line.textContent = "The server has ended; this is the study as it was last seen.";
} }, 2000); })();
</script>"""


class LivePage:
    """Report page of a study that is written again whenever a run's record changes. Several threads
    may ask for it."""

    def __init__(self, study: Path) -> None:
        require(
            study.is_dir(),
            "study",
            study,
            "no such study folder",
            "start the sweep first, or correct the name",
        )
        self.study = study
        self.lock = Lock()
        self.mark = ""
        self.html = WAITING

    def page_html(self) -> str:
        """HTML of the live report page, with a script that asks for changes every two seconds."""
        with self.lock:
            mark = self.study_state_digest()
            if mark != self.mark and record_file_states(self.study):
                gather(self.study)
                self.html = write_page(self.study).read_text(encoding="utf-8")
                self.mark = mark
            allowed = self.html.replace(POLICY, f"{POLICY}; connect-src 'self'", 1)
            return allowed + SCRIPT

    def study_state_digest(self) -> str:
        """Text that changes whenever the record of a run in the study changes."""
        marks = sorted((name, *mark) for name, mark in record_file_states(self.study).items())
        return str(hash(tuple(marks)))

    def page_state(self) -> dict[str, str]:
        """State of a study for the script of its live page: the number of runs of each status.

        The entry `mark` changes when the records change."""
        records = (read_record(path.parent) for path in self.study.glob(f"*/{RECORD}"))
        counts = Counter(str(record["status"]) for record in records if record is not None)
        progress_text = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
        return {
            "mark": self.study_state_digest(),
            "line": f"Live: {counts.total()} runs: {progress_text or 'none yet'}",
        }


def start_server(study: Path, port: int, announce: Callable[[str], object]) -> ThreadingHTTPServer:
    """Start a web server on a local port that shows the report page of a study. Port 0 stands for
    any free one; raises `BadRequest` if the port is taken."""
    try:
        server = ThreadingHTTPServer(
            (LOCALHOST, port), _create_handler(LivePage(study))
        )  # a page may take seconds to write
    except OSError as error:
        remedy = "give another with --port, or 0 for any free one"
        raise BadRequest("port", port, error.strerror or "cannot be opened", remedy) from error
    announce(f"http://{LOCALHOST}:{server.server_address[1]}/")
    return server


def is_local_host_name(host: str) -> bool:
    """Whether the host name in an HTTP request stands for this machine, such as `localhost:8420`
    and `127.0.0.1`."""
    return re.fullmatch(r"(localhost|127\.0\.0\.1|\[::1\])(:\d{1,5})?", host.lower()) is not None


def _create_handler(live: LivePage) -> type[BaseHTTPRequestHandler]:
    """Create the class that answers the HTTP requests for one live report page."""
    answers: dict[str, tuple[str, Callable[[], str]]] = {
        "/": ("text/html; charset=utf-8", live.page_html),
        "/state": ("application/json", lambda: json.dumps(live.page_state())),
    }

    class Handler(BaseHTTPRequestHandler):
        """Handler of HTTP requests for a live report page."""

        def do_GET(self) -> None:  # the name that http.server looks for
            """Answer an HTTP request for the report page or its state, and refuse every other
            request."""
            # A page of a stranger may give its own name our address, and read what we answer.
            if not is_local_host_name(self.headers.get("Host", "")):
                self.send_error(403, "ask for localhost")
                return
            if self.path not in answers:
                self.send_error(404)
                return
            kind, answer = answers[self.path]
            body = answer().encode()
            self.send_response(200)
            for name, value in {
                "Content-Type": kind,
                "Content-Length": len(body),
                "Cache-Control": "no-store",
            }.items():
                self.send_header(name, str(value))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Write no log line for an HTTP request."""

    return Handler
