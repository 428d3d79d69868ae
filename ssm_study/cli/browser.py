"""A page shown in the browser."""

from pathlib import Path


def open_page(path: Path) -> None:
    """Show a page in the browser."""
    import webbrowser

    webbrowser.open(path.absolute().as_uri())
