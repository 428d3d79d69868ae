"""A recording in Foxglove Studio itself: the open application (1.48, MPL-2.0) in headless Chromium.

    npm install --prefix /tmp/foxglove --no-save @foxglove/studio-base@1.48.0 react@17.0.2
    react-dom@17.0.2
    python benchmarks/plants_foxglove_studio.py FILE.mcap --modules /tmp/foxglove/node_modules
    [--picture FILE.png]
        [--above TOPIC.FIELD ...] [--below TOPIC.FIELD ...] [--beside TOPIC]

Two plots and one table of raw messages, where Studio stops at first. Prints one JSON object: what
the page says, and what failed in it. `tests/oracles/test_data_foxglove.py` compares it with what
was written. Needs chromium and chromedriver.
"""

import argparse
import http.server
import json
import re
import sys
import tempfile
import threading
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from common import ROOT

READY_S = 120  # of a loaded machine; a minute's worth of script is parsed first
SEEN = (
    "document.body.innerText.includes('END TIME') && / @ [0-9.]+ sec/.test(document.body.innerText)"
)


class Studio(http.server.SimpleHTTPRequestHandler):
    """The page, the packages and the recording, the latter in ranges of bytes, as Studio asks for
    it."""

    protocol_version = "HTTP/1.1"

    def __init__(self, *words: Any, recording: Path, **named: Any) -> None:
        self.recording = recording
        super().__init__(*words, **named)

    def log_message(self, *_: Any) -> None:
        """Says nothing."""

    def do_GET(self) -> None:
        match self.path.split("?")[0]:
            case "/":
                self.answer(Path(__file__).with_suffix(".html").read_bytes(), "text/html")
            case "/recording.mcap":
                self.answer(self.recording.read_bytes(), "application/octet-stream")
            case _:
                super().do_GET()

    def answer(self, content: bytes, kind: str) -> None:
        asked = re.match(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        first, last = (
            (int(asked[1]), int(asked[2] or len(content) - 1)) if asked else (0, len(content) - 1)
        )
        self.send_response(206 if asked else 200)
        self.send_header("Content-Type", kind)
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Length", str(last - first + 1))
        if asked:
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
        self.end_headers()
        self.wfile.write(content[first : last + 1])


def shown(address: str, panels: dict[str, Any], picture: Path | None) -> dict[str, Any]:
    """What the application shows once the recording is open and the raw message has arrived."""
    sys.path.insert(0, str(ROOT / "tests"))
    from report_browser import chromium
    from selenium.webdriver.support.ui import WebDriverWait

    with tempfile.TemporaryDirectory() as profile, chromium(Path(profile)) as driver:
        driver.set_page_load_timeout(READY_S)
        driver.get(f"{address}/?panels={quote(json.dumps(panels))}")
        WebDriverWait(driver, READY_S).until(lambda d: d.execute_script(f"return {SEEN}"))
        if picture is not None:
            driver.save_screenshot(str(picture))
        text, failures = driver.execute_script("return [document.body.innerText, failures]")
    return {"text": text, "failures": failures}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--modules", type=Path, required=True, help="the folder node_modules")
    parser.add_argument("--above", nargs="*", default=[])
    parser.add_argument("--below", nargs="*", default=[])
    parser.add_argument("--beside", default="")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    handler = partial(Studio, directory=str(options.modules), recording=options.recording)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        panels = {"above": options.above, "below": options.below, "beside": options.beside}
        print(json.dumps(shown(f"http://127.0.0.1:{server.server_port}", panels, options.picture)))
        server.shutdown()


if __name__ == "__main__":
    main()
