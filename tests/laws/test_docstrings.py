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

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ssm_study"
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
    modules = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        if not path.name.startswith("test_"):
            relative_path = path.relative_to(PACKAGE)
            text = path.read_text()
            modules[str(relative_path)] = ast.parse(text)
    return modules


def public(module: ast.Module) -> list[Public]:
    definitions = [node for node in module.body if isinstance(node, Public)]
    return [node for node in definitions if not node.name.startswith("_")]


def named(kind: type[ast.AST]) -> list[tuple[str, Public]]:
    """Public names of this kind, each with the path of its module."""
    definitions = []
    for path, module in parse_modules().items():
        for node in public(module):
            if isinstance(node, kind):
                definitions.append((path, node))
    return definitions


def docstring_of(node: ast.Module | Public) -> str:
    return ast.get_docstring(node) or ""


ENDS_OF_A_SENTENCE = (".", ":", "?", ";", "`")


def test_a_module_says_what_it_answers() -> None:
    """In sentences: a first paragraph that ends as one."""
    modules = parse_modules().items()
    unfinished = []
    for path, module in modules:
        first, *_ = docstring_of(module).split("\n\n")
        if not first.rstrip().endswith(ENDS_OF_A_SENTENCE):
            unfinished.append(path)
    assert not unfinished


def is_part_of_a_figure(path: str, node: Public) -> bool:
    is_figure = path.startswith("report/figures/")
    return is_figure and node.name in ("figure", "draw")


def test_every_public_name_is_told() -> None:
    """Every public name has a docstring, except `figure` and `draw` of a figure, the interface of
    its room: the module's docstring tells them."""
    silent = []
    for path, node in named(Public):  # type: ignore[arg-type]
        if ast.get_docstring(node) is None and not is_part_of_a_figure(path, node):
            silent.append(f"{path}: {node.name}")
    assert not silent


def test_every_theorem_and_bound_names_its_source() -> None:
    modules = parse_modules().items()
    without = []
    for path, module in modules:
        needs_source = path.startswith(ROOMS_OF_THEOREMS) and public(module)
        if needs_source and not SOURCE.search(join_docstrings(module)):
            without.append(path)
    assert not without


def join_docstrings(module: ast.Module) -> str:
    """All docstrings of a module."""
    nodes = list(ast.walk(module))
    definitions = [node for node in nodes if isinstance(node, Public)]
    docstrings = [docstring_of(node) for node in (module, *definitions)]
    return "\n".join(docstrings)


def is_refusing(function: Public) -> bool:
    """Whether a function raises a refusal."""
    nodes = list(ast.walk(function))
    raises = [node for node in nodes if isinstance(node, ast.Raise)]
    return any("BadRequest(" in ast.unparse(node) for node in raises)


def test_who_refuses_says_so() -> None:
    silent = []
    for path, node in named(ast.FunctionDef):
        if is_refusing(node) and not REFUSAL.search(docstring_of(node)):
            silent.append(f"{path}: {node.name}")
    assert not silent


def test_arrays_of_public_functions_have_shapes() -> None:
    shapeless = []
    for path, node in named(ast.FunctionDef):
        assert isinstance(node, ast.FunctionDef)
        if any(ARRAY.search(text) for text in signature(node)):
            shapeless.append(f"{path}: {node.name}")
    assert not shapeless


def signature(function: ast.FunctionDef) -> list[str]:
    parameters = function.args
    arguments = [*parameters.posonlyargs, *parameters.args, *parameters.kwonlyargs]
    annotations = [argument.annotation for argument in arguments]
    annotations.append(function.returns)
    return [ast.unparse(annotation) for annotation in annotations if annotation is not None]


def has_unit(field: str, node: ast.ClassDef) -> bool:
    """Whether the name of a field ends in its unit, or the class speaks of the field."""
    if UNIT.search(field):
        return True
    return re.search(rf"\b{field}\b", docstring_of(node)) is not None


def test_numbers_of_a_plant_name_their_unit() -> None:
    """In the name of the field, or else in the docstring of the class."""
    unnamed = []
    for path, node in named(ast.ClassDef):
        assert isinstance(node, ast.ClassDef)
        if path.startswith("plants/") and yaml_sets(node):
            without_unit = [field for field in numbers(node) if not has_unit(field, node)]
            unnamed += [f"{path}: {node.name}.{field}" for field in without_unit]
    assert not unnamed


def yaml_sets(node: ast.ClassDef) -> bool:
    decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
    return any("kw_only=True" in text for text in decorators)


def numbers(node: ast.ClassDef) -> list[str]:
    """The names of the fields of a class that are floating-point numbers."""
    fields = [field for field in node.body if isinstance(field, ast.AnnAssign)]
    names = []
    for field in fields:
        is_number = ast.unparse(field.annotation).startswith("float")
        if is_number and isinstance(field.target, ast.Name):
            names.append(field.target.id)
    return names


def test_the_rules_can_refuse() -> None:
    code = "def f(x: np.ndarray) -> None:\n    raise BadRequest('x', x, 'bad', 'mend it')"
    wrong = ast.parse(code)
    (function,) = [node for node in wrong.body if isinstance(node, ast.FunctionDef)]
    assert ast.get_docstring(wrong) is None
    assert not SOURCE.search(join_docstrings(wrong))
    annotation = signature(function)[0]
    assert ARRAY.search(annotation)
    assert not ARRAY.search('Float[np.ndarray, "n n"]')
    assert not UNIT.search("clock")
    assert UNIT.search("clock_s")


@pytest.mark.parametrize("length", [2, 4])
def test_shapes_are_checked_anew_in_every_test(length: int) -> None:
    """The shapes are checked in each function's first calls: the second test would find none of
    them left."""
    measured = np.zeros((3, 1))
    simulated = np.zeros((length, 1))
    with pytest.raises(TypeCheckError, match="fit_percent"):
        fit_percent(measured, simulated)
    for _ in range(100):
        ramp = np.arange(3.0)[:, None]
        fit_percent(ramp, measured)
