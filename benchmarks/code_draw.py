"""Functions and first sentences drawn for a reader who has not written them.

`python benchmarks/code_draw.py [COMMIT]` prints thirty functions of the package (name, signature,
first sentence) and sixty first sentences of docstrings. The seed is the first eight hexadecimal
digits of the commit, HEAD by default, so that nobody chooses what is read. The reader says of each
function whether its purpose is clear and its name right, and of each sentence whether it is
understood at once, without the signature. An override without a docstring shows that of the method
which it overrides, where a base class of the package has one.
"""

import argparse
import ast
import re
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from code_shape import Function, Source, read_sources

PACKAGE = Path(__file__).resolve().parents[1] / "ssm_study"
FUNCTIONS = 30
SENTENCES = 60
STOP = re.compile(r"(?<!e\.g)(?<!i\.e)(?<!\.\.)\. ")  # no full stop: that of e.g., i.e. and "..."


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
    stop = STOP.search(paragraph)
    return paragraph if stop is None else paragraph[: stop.start() + 1]


def overridden_by(function: Function, sources: Sequence[Source]) -> Iterator[Function]:
    """Methods of base classes in the package that a method overrides, the nearest base first.

    Classes are found by their names alone.
    """
    nodes = [node for source in sources for node in source.nodes]
    classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
    queue = [owner for owner in classes if function in owner.body]
    for owner in queue:  # grows by the bases of each
        names = [ast.unparse(base).partition("[")[0].split(".")[-1] for base in owner.bases]
        bases = [found for found in classes if found.name in names and found not in queue]
        queue += bases
        methods = [node for base in bases for node in base.body if isinstance(node, Function)]
        yield from (method for method in methods if method.name == function.name)


def sentence_of(function: Function, sources: Sequence[Source]) -> str:
    """First sentence of a function, or of the first method with a docstring that it overrides."""
    found = [function, *overridden_by(function, sources)]
    sentences = [sentence for node in found if (sentence := first_sentence(node))]
    return sentences[0] if sentences else "(no docstring)"


def describe_function(function: Function, source: Source, sentence: str) -> str:
    """Place, signature and first sentence of a function."""
    place = source.path.relative_to(PACKAGE).as_posix()
    result = "" if function.returns is None else f" -> {ast.unparse(function.returns)}"
    signature = f"{function.name}({ast.unparse(function.args)}){result}"
    return f"{place}: {signature}\n    {sentence}"


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
        function, source = own[number]
        print(describe_function(function, source, sentence_of(function, sources)))
    print(f"{SENTENCES} of {len(sentences)} first sentences")
    for number in rng.choice(len(sentences), SENTENCES, replace=False):
        print(sentences[number])


if __name__ == "__main__":
    main()
