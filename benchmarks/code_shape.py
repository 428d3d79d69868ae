"""Sizes, density and types of Python packages: `python benchmarks/code_shape.py ssm_study tests
[FOLDER ...]`.

One row per folder: files and lines; lines of code per function body (docstring left out); tokens of
code (names, numbers, operators, strings) in all, per line of code and per statement; the share of
statements with 30 tokens or more; assignments that bind several names to several values; lines over
100 characters; docstrings whose first word is one that needs the signature to be understood; share
of public functions whose every argument and result has a type; share of public functions and
classes with a docstring; share of comment lines. For tests also: how many functions, how many of
them demand that something is refused, and how often (`pytest.raises`, `assertRaises`).

A statement is what stands between two NEWLINE tokens, so line breaks do not change its size.
`tests/laws/test_code_shape.py` keeps the limits.
"""

import argparse
import ast
import io
import re
import tokenize
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

Function = ast.FunctionDef | ast.AsyncFunctionDef
Documented = Function | ast.ClassDef
CODE = (tokenize.NAME, tokenize.NUMBER, tokenize.OP, tokenize.STRING)
LAYOUT = (tokenize.INDENT, tokenize.DEDENT, tokenize.NL, tokenize.COMMENT, tokenize.ENCODING)
LONG_STATEMENT = 30  # tokens
WIDEST_LINE = 100  # characters
PRAGMA = re.compile(r"\s*#\s*(?:type: ignore|noqa).*$")
RIDDLES = ("Of", "Those", "What", "As", "By", "None", "Likewise")


@dataclass(frozen=True, kw_only=True)
class Density:
    """Tokens of one file, counted by line and by statement, docstrings left out."""

    tokens: int
    code_lines: int
    statement_sizes: list[int]
    comment_lines: int

    @classmethod
    def of(cls, text: str) -> "Density":
        """Count the tokens of a source; a statement that is a string alone is a docstring."""
        statement: list[tokenize.TokenInfo] = []
        sizes: list[int] = []
        lines: set[int] = set()
        comments: set[int] = set()
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                comments.add(token.start[0])
            elif token.type in CODE:
                statement.append(token)
            elif token.type not in LAYOUT and statement:
                if any(part.type != tokenize.STRING for part in statement):
                    sizes.append(len(statement))
                    lines.update(part.start[0] for part in statement)
                statement = []
        return cls(
            tokens=sum(sizes),
            code_lines=len(lines),
            statement_sizes=sizes,
            comment_lines=len(comments),
        )


@dataclass(frozen=True, kw_only=True)
class Source:
    """One Python file: its path, its text and its syntax tree."""

    path: Path
    text: str
    nodes: list[ast.AST]

    @classmethod
    def read(cls, path: Path) -> "Source":
        """Read and parse a file."""
        text = path.read_text(encoding="utf-8")
        return cls(path=path, text=text, nodes=list(ast.walk(ast.parse(text))))

    @property
    def functions(self) -> list[Function]:
        """All functions and methods."""
        return [node for node in self.nodes if isinstance(node, Function)]

    @property
    def documented(self) -> list[ast.Module | Documented]:
        """Module, classes and functions that have a docstring."""
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        return [n for n in self.nodes if isinstance(n, kinds) and ast.get_docstring(n)]


def read_sources(folder: Path) -> list[Source]:
    """All Python files below a folder, in order of their paths."""
    return [Source.read(path) for path in sorted(folder.rglob("*.py"))]


def count_body_lines(function: Function) -> int:
    """Lines from the first statement after the docstring to the last."""
    has_docstring = ast.get_docstring(function) is not None
    body = function.body[1:] if has_docstring else function.body
    if not body:
        return 0
    return body[-1].end_lineno - body[0].lineno + 1  # type: ignore[operator]


def is_fully_typed(function: Function) -> bool:
    """Whether every argument but self and cls, and the result, has a type."""
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    named = [argument for argument in arguments if argument.arg not in ("self", "cls")]
    has_result = function.returns is not None or function.name == "__init__"
    return has_result and all(argument.annotation is not None for argument in named)


def count_refusals(function: Function) -> int:
    """How often a test demands an exception."""
    called = [node.func for node in ast.walk(function) if isinstance(node, ast.Call)]
    attributes = [func.attr for func in called if isinstance(func, ast.Attribute)]
    return sum(name in ("raises", "assertRaises", "assertRaisesRegex") for name in attributes)


def is_packed(node: ast.AST) -> bool:
    """Whether a node is an assignment of several values to several names, `a, b = x, y`."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    return any(isinstance(target, ast.Tuple) for target in node.targets)


def opens_with_a_riddle(node: ast.Module | Documented) -> bool:
    """Whether the first word of a docstring is one of those that need the signature."""
    words = (ast.get_docstring(node) or "").split()
    return bool(words) and words[0].strip("`,:;.") in RIDDLES


def count_wide_lines(source: Source) -> int:
    """Lines with more characters than `WIDEST_LINE`, remarks for checkers at their end left out."""
    lines = [PRAGMA.sub("", line) for line in source.text.splitlines()]
    return sum(len(line) > WIDEST_LINE for line in lines)


def density_facts(sources: list[Source]) -> dict[str, float]:
    """Tokens, their number a line and a statement, and what is packed."""
    densities = [Density.of(source.text) for source in sources]
    sizes = np.concatenate([density.statement_sizes for density in densities])
    tokens = sum(density.tokens for density in densities)
    code_lines = sum(density.code_lines for density in densities)
    comment_lines = sum(density.comment_lines for density in densities)
    all_lines = sum(len(source.text.splitlines()) for source in sources)
    return {
        "tokens": tokens,
        "tokens_a_line": tokens / code_lines,
        "tokens_a_statement": float(sizes.mean()),
        "long_statements_percent": 100 * float((sizes >= LONG_STATEMENT).mean()),
        "packed_assignments": sum(is_packed(node) for s in sources for node in s.nodes),
        "wide_lines": sum(map(count_wide_lines, sources)),
        "riddles": sum(opens_with_a_riddle(node) for s in sources for node in s.documented),
        "comment_percent": 100 * comment_lines / all_lines,
    }


def size_facts(sources: list[Source]) -> dict[str, float]:
    """Lines of files and of functions' bodies."""
    files = np.array([len(source.text.splitlines()) for source in sources])
    functions = [function for source in sources for function in source.functions]
    bodies = np.array([count_body_lines(function) for function in functions])
    return {
        "files": len(sources),
        "lines": int(files.sum()),
        "file_median": float(np.median(files)),
        "file_90_percent": float(np.quantile(files, 0.9)),
        "file_largest": int(files.max()),
        "functions": len(functions),
        "body_median": float(np.median(bodies)),
        "body_90_percent": float(np.quantile(bodies, 0.9)),
        "body_largest": int(bodies.max()),
        "body_over_40": int((bodies > 40).sum()),
    }


def documentation_facts(sources: list[Source]) -> dict[str, float]:
    """Shares of public functions that are typed, and of public names that are documented."""
    nodes = [node for source in sources for node in source.nodes]
    named = [node for node in nodes if isinstance(node, Documented)]
    public = [node for node in named if not node.name.startswith("_")]
    typed = [is_fully_typed(node) for node in public if isinstance(node, Function)]
    documented = [ast.get_docstring(node) is not None for node in public]
    return {
        "typed_percent": 100 * float(np.mean(typed)),
        "docstring_percent": 100 * float(np.mean(documented)),
    }


def test_facts(sources: list[Source]) -> dict[str, float]:
    """Numbers of tests, of tests that demand a refusal, and of refusals demanded."""
    functions = [function for source in sources for function in source.functions]
    tests = [function for function in functions if function.name.startswith("test")]
    refusals = [count_refusals(function) for function in tests]
    return {
        "tests": len(tests),
        "tests_of_a_refusal": sum(count > 0 for count in refusals),
        "refusals": sum(refusals),
    }


def shape_facts(folder: Path) -> dict[str, object]:
    """All facts about the Python files below a folder."""
    sources = read_sources(folder)
    facts = size_facts(sources) | density_facts(sources)
    return {"package": folder.name, **facts, **documentation_facts(sources), **test_facts(sources)}


def main() -> None:
    """Print one column per folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", type=Path, default=[Path("ssm_study"), Path("tests")])
    folders = parser.parse_args().folders
    table = pd.DataFrame([shape_facts(folder) for folder in folders]).set_index("package").T
    print(table.to_string(float_format=lambda value: f"{value:.4g}"))


if __name__ == "__main__":
    main()
