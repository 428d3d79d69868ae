"""What MkDocs does not do by itself: the reference, formulas without a network, findings."""

import re
from pathlib import Path
from typing import Any

import pandas as pd
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from ssm_study.report.answers import question_answers
from ssm_study.report.words import verdict_counts
from ssm_study.table.columns import describe_columns

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "results" / "reference"
ROOMS = sorted(path.parent.name for path in (ROOT / "ssm_study").glob("*/__init__.py"))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The reference below Python; a page nobody sorted yet below Start rather than nowhere."""
    present = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert config.nav is not None, "mkdocs.yml has the navigation"
    tabs: dict[str, Any] = {title: pages for tab in config.nav for title, pages in tab.items()}
    unsorted = sorted(present - set(re.findall(r"[\w/]+\.md", str(config.nav))))
    tabs["Start"] += unsorted
    rooms = [{room: f"reference/{room}.md"} for room in ("shared", *ROOMS)]
    tabs["Python"].append({"Reference": rooms})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """One reference page per room, with every module in it: a new file is in the reference without
    being listed."""
    nouns = sorted((ROOT / "ssm_study").glob("[!_]*.py"))
    pages = {"shared": nouns}
    for room in ROOMS:
        pages[room] = sorted(
            path for path in (ROOT / "ssm_study" / room).rglob("*.py") if path.name != "__init__.py"
        )
    for room, modules in pages.items():
        files.append(
            File.generated(config, f"reference/{room}.md", content=_reference(room, modules))
        )
    for picture in sorted(PICTURES.rglob("*.png")):
        place = f"measured/{picture.relative_to(PICTURES).as_posix()}"
        files.append(File.generated(config, place, abs_src_path=str(picture)))
    return files


def _reference(room: str, modules: list[Path]) -> str:
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in modules]
    return f"# {room}\n\n" + "\n".join(
        f"## `{name}`\n\n::: {name}\n    options: {{show_root_heading: false}}\n" for name in names
    )


def on_page_markdown(markdown: str, **_: Any) -> str:
    """`<!-- answers STUDY -->` becomes what the committed table of that study says; pictures come
    from their folder.

    `<!-- columns -->` becomes the table of the declared columns.
    """
    markdown = markdown.replace("](../results/reference/", "](measured/")
    markdown = re.sub(
        r"\]\(\.\./ssm_study/(\w+)/\w+\.py\)", r"](reference/\1.md)", markdown
    )  # in a clone, the file
    markdown = markdown.replace("<!-- columns -->", _columns())
    return re.sub(r"<!-- answers (\w+) -->", lambda match: _answers(match[1]), markdown)


def _columns() -> str:
    """The declared columns as a table: nobody writes it by hand."""
    rows = ["| column | meaning (unit) | better | `verify` |", "| --- | --- | --- | --- |"]
    for name, word, better, checked in describe_columns():
        rows.append(f"| `{name}` | {word} | {better} | {checked or 'compared'} |")
    return "\n".join(rows)


def _answers(study: str) -> str:
    """A study named on a page and not committed is an error of the page."""
    table = pd.read_csv(ROOT / "results" / "reference" / study / "runs.csv")
    lines = [f"*{verdict_counts(table)}.*", ""]
    for answer in question_answers(table):
        one, *more = answer.sentences
        said = [f"**{answer.question}** {one}"] if not more else [f"**{answer.question}**", ""]
        lines += [*said, *(f"- {sentence}" for sentence in answer.sentences if more), ""]
    return "\n".join(lines)


def on_page_content(html: str, **_: Any) -> str:
    """LaTeX to MathML, which browsers draw themselves: no script, no font, no network."""
    html = re.sub(
        r'<span class="arithmatex">\\\((.*?)\\\)</span>',
        lambda m: _mathml(m[1], "inline"),
        html,
        flags=re.S,
    )
    return re.sub(
        r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>',
        lambda m: _mathml(m[1], "block"),
        html,
        flags=re.S,
    )


def _mathml(latex: str, display: str) -> str:
    plain = latex.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    formula = str(convert(plain, display=display))
    return f'<div class="formula">{formula}</div>' if display == "block" else formula
