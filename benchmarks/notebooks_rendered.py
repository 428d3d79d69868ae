"""The notebooks of `experiments/`, executed, as pages of the documentation: text, code, output and
pictures.

    python benchmarks/notebooks_rendered.py

runs all five from top to bottom with the paper's configuration, shares one results folder among
them, and writes `docs/notebooks/*.md` with the pictures beside them. The site shows these pages and
executes nothing, so it builds in seconds; a test compares their code with the notebooks.
"""

import argparse
import base64
import io
import itertools
import os
import re
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jupytext
from common import ROOT
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

TARGET = ROOT / "docs" / "notebooks"
NAMES = (
    "your_own_data",
    "strange_log",
    "the_paper",
    "reading_a_sweep",
    "how_far_can_a_certificate_go",
)
WIDTH = 1200  # pixels: sharp at the width of a page, a sixth of the bytes of print resolution


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=NAMES, help="only these")
    parser.add_argument("--ipynb", action="store_true", help="write experiments/*.ipynb alone")
    asked = parser.parse_args()
    names = asked.names
    for name in names:
        write_jupyter_file(name)
    if asked.ipynb:
        return
    TARGET.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["SSM_STUDY_RESULTS"] = (
            "results"  # in the folder: no path of this machine on the page
        )
        for name in names:
            start = time.perf_counter()
            write(name, Path(folder))
            print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)


def write_jupyter_file(name: str) -> None:
    """Write `experiments/NAME.ipynb`: the notebook without outputs, the same bytes each time."""
    notebook = jupytext.read(ROOT / "experiments" / f"{name}.py")
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
    notebook.metadata.pop("jupytext", None)
    jupytext.write(notebook, ROOT / "experiments" / f"{name}.ipynb")


def write(name: str, folder: Path) -> None:
    """Execute one notebook in the folder and write its page; a raised error ends the program."""
    notebook = jupytext.read(ROOT / "experiments" / f"{name}.py")
    NotebookClient(notebook, timeout=600, kernel_name="python3").execute(cwd=str(folder))
    pictures = (f"{name}_{number}.png" for number in itertools.count(1))
    title, first = notebook.cells[0].source.split("\n", 1)
    page = [title, origin(name), first.strip()]
    for cell in notebook.cells[1:]:
        page.append(
            cell.source if cell.cell_type == "markdown" else f"```python\n{cell.source}\n```"
        )
        outputs = (shown(output, pictures) for output in cell.get("outputs", []))
        page.append(
            "\n\n".join(filter(None, outputs)).replace("\n```\n\n```text\n", "\n")
        )  # printed in one go
    (TARGET / f"{name}.md").write_text("\n\n".join(part for part in page if part) + "\n")


def shown(output: NotebookNode, pictures: Iterator[str]) -> str:
    """One output as Markdown: printed text, a table, a text with markup, or a picture, which is
    written."""
    data = output.get("data", {})
    if (
        output.output_type == "stream"
    ):  # warnings name paths of this machine: the page shows what was printed
        return fenced(output.text) if output.name == "stdout" else ""
    if "image/png" in data:
        picture = next(pictures)
        (TARGET / picture).write_bytes(smaller(base64.b64decode(data["image/png"])))
        image = f"![{picture.removesuffix('.png').replace('_', ' ')}]({picture})"
        return "\n\n".join(filter(None, (image, data.get("text/markdown", ""))))
    if "text/html" in data:
        table = re.sub(
            r"<style scoped>.*?</style>|<div>|</div>|<pre[^>]*></pre>",
            "",
            data["text/html"],
            flags=re.S,
        )
        return "\n".join(line.strip() for line in table.splitlines() if line.strip())
    return data["text/markdown"] if "text/markdown" in data else fenced(data.get("text/plain", ""))


def fenced(text: str) -> str:
    lines = [line.rstrip() for line in re.sub(r"\x1b\[[0-9;]*m", "", text).strip("\n").splitlines()]
    return "```text\n" + "\n".join(lines) + "\n```"


def origin(name: str) -> str:
    return (
        f"*For readers who learn by example: the notebook `experiments/{name}.py` as it ran, "
        "with its output.*"
    )


def smaller(png: bytes) -> bytes:
    """The same picture in at most `WIDTH` pixels and 128 colours."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.thumbnail((WIDTH, 4 * WIDTH), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.quantize(128).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


if __name__ == "__main__":
    main()
