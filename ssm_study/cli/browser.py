"""Opening of a page in the web browser."""

import sys
from pathlib import Path


def open_page(path: Path) -> None:
    """Open a page in the web browser."""
    import webbrowser

    webbrowser.open(path.absolute().as_uri())


def page_link(path: Path) -> str:
    """Path of a web page as text that a terminal shows as a link."""
    if not sys.stdout.isatty():
        return str(path)
    return f"\x1b]8;;{path.absolute().as_uri()}\x1b\\{path}\x1b]8;;\x1b\\"
