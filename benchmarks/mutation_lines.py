"""Tests that execute a planted line, for `mutation.py --table`: asks the server to run them.

The table (`mutation_table.py`) says which tests execute which line. A line that is executed at
import alone (a constant, a field, a default) or compiled by numba stands for the lines that mention
its name. The cheapest tests come first, up to `BUDGET_S` of recorded time. Where the run that
tests share executes the line, it is made again with the fault in it; for a first pass,
`$MUTATION_QUICK` leaves out the tests that look at it, and takes a smaller budget.
"""

import ast
import json
import os
import re
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from functools import cache, cached_property
from pathlib import Path

from mutation_server import ask

QUICK = "MUTATION_QUICK" in os.environ
BUDGET_S = 45.0 if QUICK else 150.0  # of recorded time: traced, on a busy machine
DEPTH = 2  # of names that stand for names
ENOUGH = 100  # contexts: no further lines that mention a name are looked up
SETUP = "setup:"
Line = tuple[str, int]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


class Table:
    """Recorded tests of each line, their times, and the source that was executed."""

    def __init__(self, folder: Path) -> None:
        self.source = folder / "ssm_study"
        self.base = sqlite3.connect(folder / ".coverage")
        lines = (folder / "times.jsonl").read_text().splitlines()
        records = [json.loads(line) for line in lines]
        self.seconds = {record["test"]: record["s"] for record in records}
        self.sharing = {record["test"] for record in records if record["shares_run"]}

    @cached_property
    def modules(self) -> dict[str, list[str]]:
        """Lines of each module."""
        paths = sorted(self.source.rglob("*.py"))
        return {str(path.relative_to(self.source)): path.read_text().splitlines() for path in paths}

    @cache  # noqa: B019  one table a process
    def recorded(self, module: str) -> list[tuple[str, bytes]]:
        """Contexts that execute the module, each with a bit for every line."""
        query = (
            "select context.context, numbits from line_bits join file on file.id = file_id"
            " join context on context.id = context_id where file.path like ?"
        )
        return list(self.base.execute(query, [f"%/ssm_study/{module}"]))

    def contexts(self, module: str, lines: range) -> set[str]:
        """Contexts that execute one of the lines."""
        return {
            context
            for context, bits in self.recorded(module)
            if context and any(_has_bit(bits, line) for line in lines)
        }


def _has_bit(bits: bytes, line: int) -> bool:
    return line // 8 < len(bits) and bool(bits[line // 8] >> line % 8 & 1)


def planted_line(table: Table, tree: Path) -> Line | None:
    """Module and line in which the tree differs from what was recorded."""
    for module, lines in table.modules.items():
        now = (tree / "ssm_study" / module).read_text().splitlines()
        if now != lines:
            pairs = enumerate(zip(lines, now, strict=False), 1)
            return module, next(i for i, (before, after) in pairs if before != after)
    return None


def contexts_of_line(table: Table, line: Line, depth: int = DEPTH) -> set[str]:
    """Contexts that execute the statement of the line, or one that mentions its name."""
    module, row = line
    tree = _parsed("\n".join(table.modules[module]))
    function, statement, names = _place(tree, row)
    found: set[str] = set()
    if function is not None:
        names = {function.name}
        body = range(function.body[0].lineno, (function.end_lineno or row) + 1)
        traced = table.contexts(module, body)
        if traced:
            return table.contexts(module, _own_lines(statement)) if row in body else traced
    if not depth:
        return found
    for mention in _mentions(table, names, module, _own_lines(statement)):
        found |= contexts_of_line(table, mention, depth - 1)
        if len(found) > ENOUGH:
            break
    return found


@cache
def _parsed(text: str) -> ast.Module:
    return ast.parse(text)


def _place(
    tree: ast.Module, row: int
) -> tuple[ast.FunctionDef | ast.AsyncFunctionDef | None, ast.stmt, set[str]]:
    """Innermost function and statement of the line, and the names that the statement assigns."""
    function = None
    statement: ast.stmt = tree.body[0]
    for node in ast.walk(tree):  # outer ones first
        if isinstance(node, ast.stmt) and _first_line(node) <= row <= (node.end_lineno or row):
            statement = node
            if isinstance(node, FUNCTIONS):
                function = node
    assigned = [node for node in ast.walk(statement) if isinstance(node, ast.Name)]
    names = {node.id for node in assigned if isinstance(node.ctx, ast.Store)}
    if isinstance(statement, ast.ClassDef):
        names = {statement.name}
    return function, statement, names


def _first_line(node: ast.stmt) -> int:
    decorators = getattr(node, "decorator_list", [])
    return min([node.lineno, *(decorator.lineno for decorator in decorators)])


def _own_lines(statement: ast.stmt) -> range:
    """Lines of a statement without those of its body."""
    body = getattr(statement, "body", None)
    last = body[0].lineno - 1 if body else statement.end_lineno or statement.lineno
    return range(statement.lineno, max(last, statement.lineno) + 1)


def _mentions(table: Table, names: set[str], own: str, without: range) -> Iterator[Line]:
    """Lines that mention one of the names, but for the statement that defines it."""
    if not names:
        return
    word = re.compile(rf"\b({'|'.join(map(re.escape, sorted(names)))})\b")
    own_first = sorted(table.modules.items(), key=lambda module: module[0] != own)
    for module, lines in own_first:
        for row, text in enumerate(lines, 1):
            is_own = module == own and row in without
            if word.search(text) and not is_own and not re.match(r"\s*(from|import|def)\b", text):
                yield module, row


def chosen_tests(table: Table, contexts: set[str]) -> tuple[list[str], bool]:
    """Tests in the order in which they run, and whether the shared run is made anew.

    What a fixture executes, all tests of its file may look at.
    """
    tests = {context.removeprefix(SETUP) for context in contexts}
    prepared = {context.removeprefix(SETUP) for context in contexts if context.startswith(SETUP)}
    prepared &= table.seconds.keys()
    shared = bool(prepared & table.sharing)
    files = {test.split("::")[0] for test in prepared}
    known = {test for test in table.seconds if test.split("::")[0] in files}
    known |= table.sharing if shared else set()

    def cost(test: str) -> tuple[bool, float]:
        return shared and test in table.sharing, table.seconds[test]

    if shared and QUICK:
        tests -= table.sharing
        known -= table.sharing
        shared = False
    first = sorted(tests & table.seconds.keys(), key=cost)
    rest = sorted(known - tests, key=cost)
    chosen: list[str] = []
    spent_s = 0.0
    for test in first + rest:
        spent_s += table.seconds[test]
        if chosen and spent_s > BUDGET_S:
            break
        chosen.append(test)
    return chosen, shared


def main(server: str, table_folder: str, tree: str, temporary: str) -> int:
    """Status zero if all tests that execute the planted line pass.

    Without a fault (Cosmic Ray's baseline) the run that tests share is made, if it is not there.
    """
    table = Table(Path(table_folder))
    shared_folder = Path(temporary) / "shared"
    line = planted_line(table, Path(tree))
    if line is None:
        if (shared_folder / "results").exists():
            return 0
        tests = [min(table.sharing, key=table.seconds.__getitem__)]
        return run_tests(table, server, Path(tree), shared_folder, tests)
    tests, shared = chosen_tests(table, contexts_of_line(table, line))
    print(line, len(tests), "tests", "the shared run is made anew" if shared else "", flush=True)
    if shared:
        shared_folder = Path(temporary) / Path(tree).name
        shutil.rmtree(shared_folder, ignore_errors=True)
    return run_tests(table, server, Path(tree), shared_folder, tests) if tests else 0


def run_tests(table: Table, server: str, tree: Path, shared_folder: Path, tests: list[str]) -> int:
    """Status of the tests, which find what they share in `shared_folder`."""
    shared_folder.mkdir(exist_ok=True, parents=True)
    limit_s = 120 + int(3 * sum(table.seconds[test] for test in tests))
    options = "-p no:xdist -p no:randomly -o addopts= --timeout=300 -q -x"
    files = list(dict.fromkeys(test.split("::")[0] for test in tests))
    arguments = [*options.split(), f"--basetemp={shared_folder / tree.name}.base", *files]
    status = ask(server, limit_s, str(tree), arguments, tests)
    said = Path(f"{tree}.log").read_text(errors="replace").splitlines()
    print(*[line for line in said if line.startswith(("FAILED", "ERROR"))], flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:5]) != 0)
