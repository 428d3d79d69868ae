"""Functions and first sentences drawn for a reader who has not written them.

`python benchmarks/code_draw.py [COMMIT]` prints thirty functions of the package (name, signature,
first sentence) and sixty first sentences of docstrings. The seed is the first eight hexadecimal
digits of the commit, HEAD by default, so that nobody chooses what is read. The reader says of each
function whether its purpose is clear and its name right, and of each sentence whether it is
understood at once, without the signature.
"""

import argparse
import ast
import subprocess
from pathlib import Path

import numpy as np
from code_shape import Function, Source, read_sources

PACKAGE = Path(__file__).resolve().parents[1] / "ssm_study"
FUNCTIONS = 30
SENTENCES = 60


def resolve_commit(name: str) -> str:
    """Full hash of a commit."""
    done = subprocess.run(
        ["git", "rev-parse", name], cwd=PACKAGE, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def first_sentence(node: ast.AST) -> str:
    """First paragraph of a docstring up to its first full stop; empty without a docstring."""
    text = ast.get_docstring(node) or ""  # type: ignore[arg-type]
    paragraph = " ".join(text.split("\n\n")[0].split())
    head, stop, _ = paragraph.partition(". ")
    return head + stop.strip()


def describe_function(function: Function, source: Source) -> str:
    """Place, signature and first sentence of a function."""
    place = source.path.relative_to(PACKAGE).as_posix()
    result = "" if function.returns is None else f" -> {ast.unparse(function.returns)}"
    signature = f"{function.name}({ast.unparse(function.args)}){result}"
    return f"{place}: {signature}\n    {first_sentence(function) or '(no docstring)'}"


def main() -> None:
    """Print what is drawn."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commit", nargs="?", default="HEAD")
    digits = resolve_commit(parser.parse_args().commit)[:8]
    rng = np.random.default_rng(int(digits, 16))
    sources = read_sources(PACKAGE)
    functions = [(function, source) for source in sources for function in source.functions]
    own = [pair for pair in functions if not pair[0].name.startswith("__")]
    sentences = [first_sentence(node) for source in sources for node in source.documented]
    print(f"seed {digits}: {FUNCTIONS} of {len(own)} functions")
    for number in rng.choice(len(own), FUNCTIONS, replace=False):
        print(describe_function(*own[number]))
    print(f"{SENTENCES} of {len(sentences)} first sentences")
    for number in rng.choice(len(sentences), SENTENCES, replace=False):
        print(sentences[number])


if __name__ == "__main__":
    main()
