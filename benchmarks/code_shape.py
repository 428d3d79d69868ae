"""Sizes and types of Python packages, ours and others': `python benchmarks/code_shape.py ssm_study
[FOLDER ...]`.

One row per folder: files and lines; lines of code per function body (docstring left out); share of
functions over 30
lines; share of public functions whose every argument and result has a type; share of public
functions and classes with
a docstring; share of comment lines. Of tests: how many functions, how many of them demand that
something is refused,
and how often (`pytest.raises`, `assertRaises`; a parametrised test counts once).
"""

import argparse
import ast
import io
import tokenize
from pathlib import Path

import numpy as np
import pandas as pd

Function = ast.FunctionDef | ast.AsyncFunctionDef


def body_lines(function: Function) -> int:
    """Lines from the first statement after the docstring to the last."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0  # type: ignore[operator]


def typed(function: Function) -> bool:
    given = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    named = [a for a in given if a.arg not in ("self", "cls")]
    returns = function.returns is not None or function.name == "__init__"
    return returns and all(a.annotation is not None for a in named)


def comments(text: str) -> int:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return len({token.start[0] for token in tokens if token.type == tokenize.COMMENT})


def refusals(function: Function) -> int:
    called = [node.func for node in ast.walk(function) if isinstance(node, ast.Call)]
    return sum(
        isinstance(f, ast.Attribute) and f.attr in ("raises", "assertRaises", "assertRaisesRegex")
        for f in called
    )


def shape(folder: Path) -> dict[str, object]:
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.py"))}
    nodes = [node for text in texts.values() for node in ast.walk(ast.parse(text))]
    functions = [node for node in nodes if isinstance(node, Function)]
    public = [node for node in functions if not node.name.startswith("_")]
    told = [
        node
        for node in nodes
        if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_")
    ]
    sizes, lengths = (
        np.array([len(t.splitlines()) for t in texts.values()]),
        np.array([*map(body_lines, functions)]),
    )
    lines = int(sizes.sum())
    refused = [refusals(node) for node in functions if node.name.startswith("test")]
    return {
        "package": folder.name,
        "files": len(texts),
        "lines": lines,
        "file_median": float(np.median(sizes)),
        "file_90_percent": float(np.quantile(sizes, 0.9)),
        "file_largest": int(sizes.max()),
        "functions": len(functions),
        "body_median": float(np.median(lengths)),
        "body_90_percent": float(np.quantile(lengths, 0.9)),
        "body_over_30": int((lengths > 30).sum()),
        "typed_percent": 100 * float(np.mean([typed(node) for node in public])),
        "docstring_percent": 100
        * float(np.mean([ast.get_docstring(node) is not None for node in told])),
        "comment_percent": 100 * sum(map(comments, texts.values())) / lines,
        "tests": len(refused),
        "tests_of_a_refusal": sum(n > 0 for n in refused),
        "refusals": sum(refused),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path)
    table = (
        pd.DataFrame([shape(folder) for folder in parser.parse_args().folders])
        .set_index("package")
        .T
    )
    print(table.to_string(float_format=lambda value: f"{value:.4g}"))


if __name__ == "__main__":
    main()
