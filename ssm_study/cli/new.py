"""`ssm-study new FOLDER`: a study of one's own that runs as it stands."""

import re
from importlib.util import find_spec
from pathlib import Path

from ssm_study.refusal import require

TEMPLATE = Path(__file__).with_name("study_folder")


def new(folder: Path) -> list[Path]:
    """Write configuration, plant, theorem, figure, test and README into a new folder; returns the files.

    The folder's name becomes the name of a Python package. Raises `BadRequest` for one that cannot, or is taken.
    """
    name = folder.name
    require(bool(re.fullmatch(r"[a-z]\w*", name)), "new", name, "cannot name a package", "use letters, digits and _")
    require(not folder.exists(), "new", folder, "exists", "name a folder that does not")
    require(find_spec(name) is None, "new", name, "is the name of an installed package", "choose another")
    written = []
    for source in sorted(path for path in TEMPLATE.rglob("*.txt") if path.is_file()):
        to = folder / str(source.relative_to(TEMPLATE)).removesuffix(".txt").replace("@NAME@", name)
        to.parent.mkdir(parents=True, exist_ok=True)
        to.write_text(source.read_text(encoding="utf-8").replace("@NAME@", name), encoding="utf-8")
        written.append(to)
    return written
