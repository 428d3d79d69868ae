"""Fingerprints of the code that a result depends on, computed from the sources themselves.

A symbol (function, class, constant) depends on the statements that bind it and on every name these
use, followed through imports anywhere in a file. Sources are compared as syntax trees, without
comments, docstrings and layout; libraries by the version of their distribution; a package used as a
whole (`from room import readers`) file by file. What is named by strings at run time
(`getattr(module, name)`, entry points) is not seen: a class that a configuration names by
`_target_` is therefore a root of its own.

Parsed files are cached by their content: reading 300 syntax trees takes four seconds.
"""

import ast
import hashlib
import importlib.util
import json
import os
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from ssm_study.durable import add_digest, read_json_with_digest, write_json_atomically
from ssm_study.refusal import require
from ssm_study.renamed import current_module, current_symbol

# A dotted module and a name in it; `*` is all of it, and a library has no name in it.
Symbol = tuple[str, str]
WHOLE = "*"
LIBRARY = ""
LOOSE = ""
OURS = __name__.split(".")[0]
NOT_AT_IMPORT = ("TYPE_CHECKING", "__name__ == '__main__'")
INSTALLED = frozenset({"site-packages", "dist-packages"})
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "ssm-study" / "code"
FORM = f"1 {sys.version}"  # syntax trees differ from one Python to the next


class Definition(NamedTuple):
    """Definition of one name in a source file: digest of its statements, and the names that they
    use."""

    digest: str
    names: list[str]
    imports: list[Symbol]


NOTHING = Definition("", [], [])


@dataclass
class Module:
    """Content of one scanned source file: the statements that define each name, and the imported
    names."""

    parts: dict[str, Definition] = field(default_factory=dict)
    imported: dict[str, list[Symbol]] = field(default_factory=dict)

    @property
    def defined_names(self) -> set[str]:
        """Names that the statements of a source file define."""
        return set(self.parts) - {LOOSE}


@dataclass(frozen=True)
class CodeReader:
    """Reader of source code that finds all code on which given functions and classes depend.
    Sources are read where they are imported from, or in `folders` (name: folder)."""

    folders: Mapping[str, Path] = field(default_factory=dict)
    modules: dict[str, Module | None] = field(default_factory=dict)
    followed: dict[str, bool] = field(default_factory=dict)
    steps: dict[Symbol, frozenset[Symbol]] = field(default_factory=dict)

    def code_digest(self, *roots: Symbol) -> str:
        """SHA-256 of all source code on which given functions and classes depend."""
        for module, name in roots:
            symbol = f"{module}.{name}"
            is_defined = self._is_defined(module, name)
            require(is_defined, "code", symbol, "is not defined in this module", "correct the name")
        lines = []
        for module, name in self.dependency_closure(roots):
            lines.append(f"{module}:{name} {self._symbol_digest(module, name)}")
        return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()

    def _is_defined(self, module: str, name: str) -> bool:
        """Whether a module defines a name; for a module of a library, every name is accepted."""
        if not self._is_source_read(module.split(".")[0]):
            return True
        read = self._read_module(module)
        if read is None:
            return False
        return (
            read == Module() or name == WHOLE or name in read.defined_names or name in read.imported
        )

    def dependency_closure(self, roots: Iterable[Symbol]) -> set[Symbol]:
        """All functions, classes and constants outside libraries on which given ones depend."""
        visited = set[Symbol]()
        waiting = {self._source_symbol(symbol) for symbol in roots}
        while waiting:
            symbol = waiting.pop()
            visited.add(symbol)
            if symbol not in self.steps:
                self.steps[symbol] = frozenset(
                    map(self._source_symbol, self._symbols_used(*symbol))
                )
            waiting |= self.steps[symbol] - visited
        return visited

    def read_loaded_modules(self) -> None:
        """Read the source of every loaded module of this package, so that later edits of the files
        have no effect."""
        for module in sorted(sys.modules):
            if module.split(".")[0] == OURS:
                self._read_module(module)

    def _source_symbol(self, symbol: Symbol) -> Symbol:
        """Symbol that stands for a given one in fingerprints: the whole library, or the current
        name of a renamed symbol."""
        top = symbol[0].split(".")[0]
        if not self._is_source_read(top):
            return (top, LIBRARY)
        return self._current_symbol(symbol) if top == OURS else symbol

    def _current_symbol(self, symbol: Symbol) -> Symbol:
        """Current module and name of a function or class that may be imported by an old name."""
        module, name = symbol
        if name in (WHOLE, LIBRARY):
            return (
                module if self._read_module(module) is not None else current_module(module)
            ), name
        read = self._read_module(module)
        if read is not None and (name in read.parts or name in read.imported):
            return symbol
        return current_symbol(module, name)

    def _is_source_read(self, top: str) -> bool:
        """Whether the code fingerprints depend on a package's source, not only on its version."""
        if top not in self.followed:
            path = None if top in sys.stdlib_module_names else self._source_path(top)
            is_ours = top in (*self.folders, OURS, "__main__")
            self.followed[top] = is_ours or not (path is None or _is_installed(path))
        return self.followed[top]

    def _symbols_used(self, module: str, name: str) -> Iterator[Symbol]:
        """Functions, classes and constants that a given function or class uses directly."""
        read = None if name == LIBRARY else self._read_module(module)
        if read is None:
            return
        for part in (read.parts.get(LOOSE, NOTHING), read.parts.get(name, NOTHING)):
            for used in part.names:
                if used in read.parts:
                    yield module, used
                yield from read.imported.get(used, ())
            yield from part.imports
        if name not in read.parts:  # imported from elsewhere, or itself a module of this package
            yield from read.imported.get(name, ())
            if self._read_module(f"{module}.{name}") is not None:
                yield f"{module}.{name}", WHOLE
        if name == WHOLE:
            yield from self._symbols_in_module(module, read)

    def _symbols_in_module(self, module: str, read: Module) -> Iterator[Symbol]:
        """All functions, classes and constants of a module, including files of a package."""
        for bound in read.defined_names:
            yield module, bound
        for symbols in read.imported.values():
            yield from symbols
        path = self._source_path(module)
        if path is None or path.name != "__init__.py":
            return
        for file in path.parent.glob("*.py"):
            if file != path:
                yield f"{module}.{file.stem}", WHOLE

    def _symbol_digest(self, module: str, name: str) -> str:
        """Digest of the statements that define a symbol; for a library, its version."""
        if name == LIBRARY:
            return library_version(module)
        parts = (self._read_module(module) or Module()).parts
        return f"{parts.get(LOOSE, NOTHING).digest} {parts.get(name, NOTHING).digest}"

    def _read_module(self, module: str) -> Module | None:
        """Scanned source of a module, read once; None if it has no Python source."""
        if module not in self.modules:
            path = self._source_path(module)
            is_cached = module.split(".")[0] == OURS and not self.folders
            scan = _scan_module if is_cached else _scan_source
            self.modules[module] = None if path is None else scan(path, module)
        return self.modules[module]

    def _source_path(self, module: str) -> Path | None:
        """Path of a module's source, found without any import; None if it has no Python source."""
        top, *inner = module.split(".")
        if top == "__main__":
            return None if inner else Path(sys.modules[top].__file__ or "")
        folder = self.folders.get(top) or _package_folder(top)
        if folder is None or (folder.suffix == ".py" and inner):
            return None
        if folder.suffix == ".py":
            return folder
        file = folder.joinpath(*inner).with_suffix(".py")
        room = folder.joinpath(*inner, "__init__.py")
        for path in (file, room):
            if path.is_file() and path.name != ".py":
                return path
        # A package whose path was made longer. A compiled module has no source to read.
        loaded = None if top in self.folders else sys.modules.get(module)
        origin = getattr(loaded, "__file__", None) or ""
        return Path(origin) if origin.endswith(".py") else None


CODE = CodeReader()


def _is_installed(path: Path) -> bool:
    """Whether a source file belongs to an installed library. A package in a folder of its own (`pip
    install --target`) has its `.dist-info` beside it."""
    if not INSTALLED.isdisjoint(path.parts):
        return True
    package = path.parent if path.name == "__init__.py" else path
    return any(package.parent.glob("*.dist-info"))


@cache
def _package_folder(top: str) -> Path | None:
    """Folder of a top-level package, or the file of a top-level module."""
    spec = importlib.util.find_spec(top)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        return None
    return Path(spec.origin).parent if spec.submodule_search_locations else Path(spec.origin)


@cache
def code_version(*roots: Callable[..., Any] | type | str) -> str:
    """SHA-256 of all source code on which the given functions, classes or dotted names depend."""
    return CODE.code_digest(*sorted({find_symbol(root) for root in roots}))


def find_symbol(root: Callable[..., Any] | type | str) -> Symbol:
    """Module in which a function or class is defined, and its name there. A lambda stands for its
    whole module."""
    if isinstance(root, str):
        module, _, name = root.rpartition(".")
        return module, name
    if isinstance(root, partial):
        return find_symbol(root.func)
    name = root.__qualname__
    return root.__module__, name if name.isidentifier() else WHOLE


@cache
def library_version(library: str) -> str:
    """Installed version of a library with a given import name; empty for the standard library."""
    if library in sys.stdlib_module_names:
        return ""
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(library)
    pattern = re.compile(rf"^{re.escape(library)}[/.]", re.MULTILINE)
    owners = [owner for owner, files in _distributions_with_files() if pattern.search(files)]
    return " ".join(sorted(f"{owner.metadata['Name']} {owner.version}" for owner in owners))


@cache
def _distributions_with_files() -> list[tuple[metadata.Distribution, str]]:
    """All installed distributions, each with the text that lists its files."""
    listed = []
    for owner in metadata.distributions():
        files = owner.read_text("RECORD") or owner.read_text("top_level.txt") or ""
        listed.append((owner, files))
    return listed


def _scan_module(path: Path, module: str) -> Module:
    """Scan a source file for names and dependencies, or read the result of an earlier scan."""
    content = path.read_bytes()
    digest = hashlib.sha256(FORM.encode() + content).hexdigest()
    file = CACHE / f"{hashlib.sha256(str(path).encode()).hexdigest()[:32]}.json"
    with suppress(OSError):
        cached = read_json_with_digest(file.read_bytes())
        if cached is not None and cached["content"] == digest:
            return _module_from_json(cached)
    read = _scan_source(path, module)
    with suppress(OSError):  # a home that cannot be written to
        CACHE.mkdir(parents=True, exist_ok=True)
        body = {"content": digest, "parts": read.parts, "imported": read.imported}
        as_read_back = json.loads(json.dumps(body))
        write_json_atomically(file, add_digest(as_read_back), durable=False)
    return read


def _module_from_json(cached: Mapping[str, Any]) -> Module:
    """Rebuild a scanned module from the cached result of an earlier scan."""
    parts = {}
    for name, (digest, names, imports) in cached["parts"].items():
        parts[name] = Definition(digest, names, _symbols_from_pairs(imports))
    imported = {name: _symbols_from_pairs(symbols) for name, symbols in cached["imported"].items()}
    return Module(parts, imported)


def _symbols_from_pairs(pairs: Iterable[Iterable[str]]) -> list[Symbol]:
    """Convert pairs of module and name from a JSON list to tuples."""
    return [(module, name) for module, name in pairs]


def _scan_source(path: Path, module: str) -> Module:
    """Scan a source file for the statements that define each name and for the imported symbols."""
    tree = ast.parse(path.read_bytes())
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    bound = defaultdict[str, list[ast.stmt]](list)
    imported = defaultdict[str, list[Symbol]](list)
    _drop_docstrings(tree)
    for statement in _top_level_statements(tree.body):
        if isinstance(statement, ast.Import | ast.ImportFrom):
            for name, symbol in _import_bindings(statement, package):
                imported[name].append(symbol)
            continue
        for name in _defined_names(statement) or {LOOSE}:
            bound[name].append(statement)
    parts = {name: _scan_statements(statements, package) for name, statements in bound.items()}
    return Module(parts, dict(imported))


def _drop_docstrings(tree: ast.Module) -> None:
    """Remove all docstrings from a syntax tree, in place."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            has_docstring = ast.get_docstring(node, clean=False) is not None
            node.body = node.body[has_docstring:]


def _scan_statements(statements: list[ast.stmt], package: str) -> Definition:
    """Digest the statements that define one name, and find the names on which they depend."""
    text = "\n".join(map(ast.dump, statements))
    names: set[str] = set()
    imports: set[Symbol] = set()
    for statement in statements:
        names.update(_names_read(statement))
        for node in ast.walk(statement):
            if isinstance(node, ast.Import | ast.ImportFrom):
                imports.update(symbol for _, symbol in _import_bindings(node, package))
    return Definition(hashlib.sha256(text.encode()).hexdigest(), sorted(names), sorted(imports))


def _top_level_statements(body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    """Iterate over the top-level statements of a module, including those inside `if`, `try` and
    `with` blocks. Statements that only type checkers see are left out."""
    for statement in body:
        if isinstance(statement, ast.If) and ast.unparse(statement.test) in NOT_AT_IMPORT:
            continue
        if not isinstance(statement, ast.If | ast.Try | ast.With):
            yield statement
            continue
        for block in ("body", "orelse", "handlers", "finalbody"):
            for part in getattr(statement, block, []):
                yield from _top_level_statements(
                    part.body if isinstance(part, ast.ExceptHandler) else [part]
                )


def _defined_names(statement: ast.stmt) -> set[str]:
    """Names that a statement defines or assigns."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    names = [node for node in ast.walk(statement) if isinstance(node, ast.Name)]
    return {node.id for node in names if isinstance(node.ctx, ast.Store)}


def _names_read(node: ast.AST) -> Iterator[str]:
    """Names that a statement reads when it runs, or when a function that it defines is called."""
    if isinstance(node, ast.Name):
        yield node.id
    for label, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and label not in ("annotation", "returns"):
                yield from _names_read(child)


def _import_bindings(
    node: ast.Import | ast.ImportFrom, package: str
) -> Iterator[tuple[str, Symbol]]:
    """Names that an import statement binds, each with the module and name for which it stands."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.asname or alias.name.split(".")[0], (alias.name, WHOLE)
        return
    base: list[str] = []
    if node.level:
        rooms = package.split(".")
        base = rooms[: len(rooms) - node.level + 1]
    source = ".".join(part for part in (*base, node.module) if part)
    for alias in node.names:
        yield alias.asname or alias.name, (source, alias.name)
