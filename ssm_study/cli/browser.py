"""A page shown in the browser."""

import sys
from pathlib import Path


def open_page(path: Path) -> None:
    """Show a page in the browser."""
    import webbrowser

    webbrowser.open(path.absolute().as_uri())


def page_link(path: Path) -> str:
    """The path of a page; on a terminal a link that a click opens."""
    if not sys.stdout.isatty():
        return str(path)
    return f"\x1b]8;;{path.absolute().as_uri()}\x1b\\{path}\x1b]8;;\x1b\\"
