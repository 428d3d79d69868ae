"""The command `new`, which writes the folder of a new study from a template."""

import re
from importlib.util import find_spec
from pathlib import Path

from ssm_study.refusal import require

TEMPLATE = Path(__file__).with_name("study_folder")


def write_study_template(folder: Path) -> list[Path]:
    """Write the folder of a new study from a template, and return the written files.

    The folder's name becomes the name of a Python package. Raises `BadRequest` for one that cannot,
    or is taken.
    """
    name = folder.name
    is_name = bool(re.fullmatch(r"[a-z]\w*", name))
    require(is_name, "new", name, "cannot name a package", "use letters, digits and _")
    require(not folder.exists(), "new", folder, "exists", "name a folder that does not")
    is_free = find_spec(name) is None
    require(is_free, "new", name, "is the name of an installed package", "choose another")
    templates = [path for path in TEMPLATE.rglob("*.txt") if path.is_file()]
    return [write_from_template(template, folder) for template in sorted(templates)]


def write_from_template(template: Path, folder: Path) -> Path:
    """Write one file of a new study from its template. `@NAME@` stands for the folder's name in
    path and text."""
    place = str(template.relative_to(TEMPLATE)).removesuffix(".txt")
    path = folder / place.replace("@NAME@", folder.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = template.read_text(encoding="utf-8").replace("@NAME@", folder.name)
    path.write_text(text, encoding="utf-8")
    return path
