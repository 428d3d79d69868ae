"""Construction of objects from plain settings. `_target_` names a class, and its constructor is the
schema.

A setting is refused in one sentence where a constructor has no such field, where its value has
another type, or where a number is so large that memory would run out before anything is said.
"""

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from inspect import signature
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from beartype import BeartypeConf
from beartype.door import is_bearable

from ssm_study.refusal import BadRequest, require

LARGEST_NUMBER = 10_000_000  # samples of one kind, and any whole number of a part
WIDEST = {"model.order": 512, "model": 4096}  # what matrices and networks are as wide as
PART = "a part of the configuration"
TYPE_WORDS = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a text",
    type(None): "null",
}
# Runs of a sweep share the parts in which they do not differ.
_PARTS: dict[tuple[str, str], Any] = {}
INTEGERS_ARE_NUMBERS = BeartypeConf(is_pep484_tower=True)


def construct_part(name: str, settings: Mapping[str, Any]) -> Any:
    """Construct the object that one group of the configuration describes; equal settings give the
    same object.

    Raises `BadRequest` for fields that its constructor does not take or refuses.
    """
    key = (name, repr(settings))  # unlike `==`, it tells 1 from 1.0 and from True
    if key not in _PARTS:
        try:
            _PARTS[key] = construct_object(name, settings)
        except BadRequest:
            raise
        except Exception as error:  # a constructor may raise anything for values of right types
            cause = " ".join(str(error).split()).rstrip(".")
            remedy = f"see conf/{name}/ for its fields"
            raise BadRequest(name, settings.get("_target_"), cause, remedy) from error
    return _PARTS[key]


def construct_object(path: str, node: Any) -> Any:
    """Construct Python objects from nested settings, the inner ones first. Each class that is named
    by `_target_` is called with its fields.

    `path` names the tree in errors. Raises `BadRequest` for unknown or mistyped fields. A whole
    number given where any number is wanted becomes a float.
    """
    if isinstance(node, list):
        return [construct_object(f"{path}[{i}]", item) for i, item in enumerate(node)]
    if not isinstance(node, dict):
        return node
    if "_target_" not in node:
        return {key: construct_object(f"{path}.{key}", value) for key, value in node.items()}
    kind = import_target(node["_target_"])
    fields = {key: value for key, value in node.items() if key != "_target_"}
    arguments = {key: _check_argument(path, kind, key, value) for key, value in fields.items()}
    return kind(**arguments)


def import_target(target: str) -> Any:
    """Import the class or function that a dotted name such as `package.module.Class` stands for.
    Raises `ImportError` if there is none."""
    module, _, name = target.rpartition(".")
    try:
        return getattr(import_module(module), name)
    except (AttributeError, ValueError) as error:
        raise ImportError(f"there is no {target}") from error


@cache
def constructor_parameters(kind: type) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Types of the parameters of a class's constructor by name, and the parameter names in
    order."""
    hints = get_type_hints(kind.__init__)  # type: ignore[misc] # of a class
    return hints, tuple(signature(kind).parameters)


def _check_argument(path: str, kind: type, key: str, value: Any) -> Any:
    """Check a setting against the type of the constructor parameter that it is for, and return the
    value to pass."""
    hints, names = constructor_parameters(kind)
    field = f"{path}.{key}"
    remedy = f"its fields are {', '.join(names)}"
    require(key in names, field, value, f"{kind.__name__} has no such field", remedy)
    if isinstance(value, dict | list):
        problem = f"is not {_type_description(hints[key])}" if key in hints else ""
        require(not _allows_only_scalars(hints.get(key)), field, value, problem, "give one value")
        return construct_object(field, value)
    if key not in hints:
        return value
    hint = hints[key]
    words = _type_description(hint)
    remedy = _remedy_for_type(kind, key)
    if PART in words:
        remedy = "choose it by its group, as in training/optimiser=lbfgs"
    fits = is_bearable(value, hint, conf=INTEGERS_ARE_NUMBERS)
    require(fits, field, value, f"is not {words}", remedy)
    argument = value if is_bearable(value, hint) else float(value)
    if type(argument) is int and key != "seed":
        largest = WIDEST.get(field) or WIDEST.get(path.split(".")[0], LARGEST_NUMBER)
        require(value <= largest, field, value, f"more than {largest}", "use a smaller number")
    return argument


def _remedy_for_type(kind: type, key: str) -> str:
    """Remedy for a setting of a wrong type: an example of the right type, the default of the
    constructor's parameter if there is one."""
    default = signature(kind).parameters[key].default
    if isinstance(default, bool):
        return f"write {str(default).lower()}, for example"
    if isinstance(default, int | float | str) and default != "":
        return f"write {default}, for example"
    return "write a value of this kind"


def _allows_only_scalars(hint: Any) -> bool:
    """Whether a type hint allows only numbers, texts and truth values."""
    is_union = get_origin(hint) in (Union, UnionType)
    types = get_args(hint) if is_union else (hint,)
    return hint is not None and all(kind in TYPE_WORDS for kind in types)


def _type_description(hint: Any) -> str:
    """Plain-English description of a type hint for error messages."""
    is_union = get_origin(hint) in (Union, UnionType)
    types = get_args(hint) if is_union else (hint,)
    return " or ".join(_single_type_description(kind) for kind in types)


def _single_type_description(kind: Any) -> str:
    """Plain-English description of a type hint that names a single type."""
    if kind in TYPE_WORDS:
        return TYPE_WORDS[kind]
    return PART if isinstance(kind, type) else str(kind).replace("typing.", "")
