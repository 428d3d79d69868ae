"""Names and sentences of this package beside those of public packages, for a reader who knows none.

`python benchmarks/names_beside.py draw SEED FOLDER` writes `mix.txt`: thirty functions of this
package and ten each of scikit-learn, python-control and Lightning, shuffled, each with its
signature and first sentence. `key.json` has the package of each. The reader sees `mix.txt` alone
and writes a file `verdict_NAME.txt` beside it with a line `NUMBER PURPOSE NAME SENTENCE` for each
entry, every verdict 1 or 0. `python benchmarks/names_beside.py count FOLDER...` prints how many of
thirty functions each reader accepted, by package. Only functions with a docstring are drawn.
"""

import argparse
import ast
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from code_draw import first_sentence
from code_shape import Function

OURS = "ssm_study"
PUBLIC = ("sklearn", "control", "lightning.pytorch")
FUNCTIONS = {OURS: 30, **dict.fromkeys(PUBLIC, 10)}
LEFT_OUT = {"tests", "test", "externals", "_build_utils", "demos"}
LONGEST = 300  # characters of a signature and of a sentence
VERDICTS = ("purpose", "name", "sentence")


class Entry(NamedTuple):
    """One function as the reader sees it, and its package."""

    package: str
    text: str


class DocumentedFunction(NamedTuple):
    """One function of a package and its file."""

    node: ast.FunctionDef | ast.AsyncFunctionDef
    place: Path


def functions_in(file: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Functions of a file that have a docstring, without those named by two underscores."""
    for node in ast.walk(ast.parse(file.read_text())):
        named = isinstance(node, Function) and not node.name.startswith("__")
        if named and ast.get_docstring(node):
            yield node


def find_functions(package: str) -> list[DocumentedFunction]:
    """Documented functions of an installed package, without those of its tests."""
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise SystemExit(f"{package} is not installed: pip install -e '.[dev]'")
    folder = Path(spec.origin).parent
    found = []
    for file in sorted(folder.rglob("*.py")):
        place = file.relative_to(folder)
        if LEFT_OUT.isdisjoint(place.parts):
            found += [DocumentedFunction(node, place) for node in functions_in(file)]
    return found


def describe(found: DocumentedFunction) -> str:
    """Place, signature and first sentence, each line cut to the longest that is shown."""
    node = found.node
    result = "" if node.returns is None else f" -> {ast.unparse(node.returns)}"
    signature = f"{found.place}: {node.name}({ast.unparse(node.args)}){result}"
    sentence = first_sentence(node).replace(OURS, "package")
    return f"{signature[:LONGEST]}\n    {sentence[:LONGEST]}"


def draw_functions(seed: int, folder: Path) -> None:
    """Write the shuffled entries and, apart, the package of each."""
    rng = np.random.default_rng(seed)
    drawn = []
    for package, number in FUNCTIONS.items():
        functions = find_functions(package)
        chosen = rng.choice(len(functions), number, replace=False)
        drawn += [Entry(package, describe(functions[place])) for place in chosen]
    shuffled = [drawn[place] for place in rng.permutation(len(drawn))]
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{number}. {entry.text}\n" for number, entry in enumerate(shuffled, 1)]
    (folder / "mix.txt").write_text("".join(lines))
    key = {number: entry.package for number, entry in enumerate(shuffled, 1)}
    (folder / "key.json").write_text(json.dumps(key, indent=1) + "\n")


def print_verdict_shares(folders: Sequence[Path]) -> None:
    """Print, by reader and package, how many of thirty functions were accepted."""
    verdicts: dict[tuple[str, str], list[list[int]]] = defaultdict(list)
    for folder in folders:
        key = json.loads((folder / "key.json").read_text())
        for file in sorted(folder.glob("verdict_*.txt")):
            reader = file.stem.removeprefix("verdict_")
            for line in file.read_text().splitlines():
                number, *judged = line.split()
                package = key[number]
                numbers = [int(verdict) for verdict in judged[: len(VERDICTS)]]
                verdicts[reader, package].append(numbers)
                if package != OURS:
                    verdicts[reader, "the three public ones"].append(numbers)
    print("| reader | package | functions |", " | ".join(f"{word} of 30" for word in VERDICTS), "|")
    print("|---|---|---|---|---|---|")
    for (reader, package), rows in sorted(verdicts.items()):
        shares = 30 * np.mean(rows, axis=0)
        cells = " | ".join(f"{share:.1f}" for share in shares)
        print(f"| {reader} | {package} | {len(rows)} | {cells} |")


def main() -> None:
    """Draw or count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    drawing = commands.add_parser("draw", help="write mix.txt and key.json")
    drawing.add_argument("seed", type=int)
    drawing.add_argument("folder", type=Path)
    counting = commands.add_parser("count", help="count the readers' verdicts")
    counting.add_argument("folders", type=Path, nargs="+")
    options = parser.parse_args()
    if options.command == "draw":
        draw_functions(options.seed, options.folder)
    else:
        print_verdict_shares(options.folders)


if __name__ == "__main__":
    main()
