"""The form of public docstrings: what is said, its source, its refusals, shapes in types, units in
names."""

import ast
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from ssm_study.signals import fit_percent

PACKAGE = Path(__file__).resolve().parents[2] / "ssm_study"
ROOMS_OF_THEOREMS = ("bounds", "synthesis")
SOURCE = re.compile(r"\[Z26\]|docs/(?:theory|trust)\.md|\b(?:19|20)\d\d\b")
REFUSAL = re.compile(r"BadRequest|[Rr]efus|[Rr]aises|NoSolution")
ARRAY = re.compile(r"(?<!\[)\b(?:np\.ndarray|torch\.Tensor|Tensor)\b")
UNIT = re.compile(
    r"_(?:s|v|a|h|hz|ohm|nm|cm2|rad_per_s|kgm2|variance|v_per_cm|cm3_per_vs|nm_per_a"
    r"|nms_per_rad|nm_per_rad)$"
)

Public = ast.FunctionDef | ast.ClassDef


@cache
def parse_modules() -> dict[str, ast.Module]:
    """Syntax tree of each module by its path, parsed once by the worker that runs these tests."""
    paths = [path for path in sorted(PACKAGE.rglob("*.py")) if not path.name.startswith("test_")]
    return {str(path.relative_to(PACKAGE)): ast.parse(path.read_text()) for path in paths}


def public(module: ast.Module) -> list[Public]:
    return [
        node for node in module.body if isinstance(node, Public) and not node.name.startswith("_")
    ]


def named(kind: type[ast.AST]) -> list[tuple[str, Public]]:
    modules = parse_modules().items()
    return [
        (path, node)
        for path, module in modules
        for node in public(module)
        if isinstance(node, kind)
    ]


def test_a_module_says_what_it_answers() -> None:
    """In sentences: a first paragraph that ends as one."""
    modules = parse_modules().items()
    first = {
        path: (ast.get_docstring(module) or "").split("\n\n")[0].rstrip()
        for path, module in modules
    }
    assert not [
        path for path, said in first.items() if not said.endswith((".", ":", "?", ";", "`"))
    ]


def test_every_public_name_is_told() -> None:
    """Every public name has a docstring, except `figure` and `draw` of a figure, the interface of
    its room: the module's docstring tells them."""
    silent = [
        f"{path}: {node.name}"
        for path, node in named(Public)  # type: ignore[arg-type]
        if ast.get_docstring(node) is None
        and not (path.startswith("report/figures/") and node.name in ("figure", "draw"))
    ]
    assert not silent


def test_every_theorem_and_bound_names_its_source() -> None:
    modules = parse_modules().items()
    without = [
        path
        for path, module in modules
        if path.startswith(ROOMS_OF_THEOREMS) and public(module) and not SOURCE.search(told(module))
    ]
    assert not without


def told(module: ast.Module) -> str:
    """All docstrings of a module."""
    definitions = [n for n in ast.walk(module) if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    tellers = [module, *definitions]
    docstrings = [ast.get_docstring(node) or "" for node in tellers]
    return "\n".join(docstrings)


def test_who_refuses_says_so() -> None:
    silent = [
        f"{path}: {node.name}"
        for path, node in named(ast.FunctionDef)
        if any(isinstance(n, ast.Raise) and "BadRequest(" in ast.unparse(n) for n in ast.walk(node))
        and not REFUSAL.search(ast.get_docstring(node) or "")
    ]
    assert not silent


def test_arrays_of_public_functions_have_shapes() -> None:
    shapeless = [
        f"{path}: {node.name}"
        for path, node in named(ast.FunctionDef)
        if isinstance(node, ast.FunctionDef) and any(ARRAY.search(text) for text in signature(node))
    ]
    assert not shapeless


def signature(function: ast.FunctionDef) -> list[str]:
    posonlyargs = function.args.posonlyargs
    kwonlyargs = function.args.kwonlyargs
    arguments = [*posonlyargs, *function.args.args, *kwonlyargs]
    given = [a.annotation for a in arguments]
    annotations = [*given, function.returns]
    return [ast.unparse(annotation) for annotation in annotations if annotation is not None]


def test_numbers_of_a_plant_name_their_unit() -> None:
    """In the name of the field, or else in the docstring of the class."""
    unnamed = [
        f"{path}: {node.name}.{field}"
        for path, node in named(ast.ClassDef)
        if path.startswith("plants/") and isinstance(node, ast.ClassDef) and yaml_sets(node)
        for field in numbers(node)
        if not UNIT.search(field) and not re.search(rf"\b{field}\b", ast.get_docstring(node) or "")
    ]
    assert not unnamed


def yaml_sets(node: ast.ClassDef) -> bool:
    return any("kw_only=True" in ast.unparse(decorator) for decorator in node.decorator_list)


def numbers(node: ast.ClassDef) -> list[str]:
    fields = [
        n
        for n in node.body
        if isinstance(n, ast.AnnAssign) and ast.unparse(n.annotation).startswith("float")
    ]
    return [n.target.id for n in fields if isinstance(n.target, ast.Name)]


def test_the_rules_can_refuse() -> None:
    wrong = ast.parse(
        "def f(x: np.ndarray) -> None:\n    raise BadRequest('x', x, 'bad', 'mend it')"
    )
    (function,) = (node for node in wrong.body if isinstance(node, ast.FunctionDef))
    assert ast.get_docstring(wrong) is None
    assert not SOURCE.search(told(wrong))
    assert ARRAY.search(signature(function)[0])
    assert not ARRAY.search('Float[np.ndarray, "n n"]')
    assert not UNIT.search("clock")
    assert UNIT.search("clock_s")


@pytest.mark.parametrize("length", [2, 4])
def test_shapes_are_checked_anew_in_every_test(length: int) -> None:
    """The shapes are checked in each function's first calls: the second test would find none of
    them left."""
    with pytest.raises(TypeCheckError, match="fit_percent"):
        fit_percent(np.zeros((3, 1)), np.zeros((length, 1)))
    for _ in range(100):
        ramp = np.arange(3.0)[:, None]
        fit_percent(ramp, np.zeros((3, 1)))
