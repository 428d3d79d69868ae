"""Display of a page in the web browser."""

import sys
from pathlib import Path


def open_page(path: Path) -> None:
    """Show a page in the browser."""
    import webbrowser

    webbrowser.open(path.absolute().as_uri())


def page_link(path: Path) -> str:
    """Path of a page as text; on a terminal a link that can be clicked."""
    if not sys.stdout.isatty():
        return str(path)
    return f"\x1b]8;;{path.absolute().as_uri()}\x1b\\{path}\x1b]8;;\x1b\\"
