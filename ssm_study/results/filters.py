"""`--where "order == 8 and fit_test_percent > 85"`: comparisons of columns with constants, and nothing else.

The expression is parsed, never evaluated as Python: names are columns, the rest is numbers, texts, true, false, null.
"""

import ast
import operator
from collections.abc import Callable
from typing import Any

import pandas as pd

from ssm_study.refusal import BadRequest

REMEDY = "write comparisons of columns with constants, e.g. order == 8 and fit_test_percent > 85"
COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
MIRRORED = {ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE, ast.Eq: ast.Eq, ast.NotEq: ast.NotEq}
WORDS = {"true": True, "false": False, "null": None, "nan": None, "inf": float("inf")}


def where(table: pd.DataFrame, expression: str) -> pd.DataFrame:
    """The rows of `table` for which `expression` holds; a comparison with a missing value does not hold.

    Grammar: `and`, `or`, `not`, parentheses, `== != < <= > >=` (chains too), `in [..]`, `not in [..]`, `== null`.
    Raises `BadRequest` for anything else and for unknown columns.
    """
    try:
        tree = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise BadRequest("where", expression, "not an expression", REMEDY) from None
    return table[_mask(tree, table)]


def _mask(node: ast.expr, table: pd.DataFrame) -> pd.Series:
    if isinstance(node, ast.BoolOp):
        masks = [_mask(value, table) for value in node.values]
        both: Callable[[Any, Any], Any] = operator.and_ if isinstance(node.op, ast.And) else operator.or_
        result = masks[0]
        for mask in masks[1:]:
            result = both(result, mask)
        return result
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return ~_mask(node.operand, table)
    if isinstance(node, ast.Name):
        column = _column(node, table)
        if column.dtype == "boolean":
            return column.fillna(False).astype(bool)
    if isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        masks = [_compare(sides[i], op, sides[i + 1], table) for i, op in enumerate(node.ops)]
        return pd.concat(masks, axis=1).all(axis=1)
    raise BadRequest("where", ast.unparse(node), "not a comparison", REMEDY)


def _compare(left: ast.expr, op: ast.cmpop, right: ast.expr, table: pd.DataFrame) -> pd.Series:
    if not _is_column(left) and _is_column(right) and type(op) in MIRRORED:
        left, op, right = right, MIRRORED[type(op)](), left
    if not _is_column(left):
        raise BadRequest("where", ast.unparse(left), "not a column", REMEDY)
    assert isinstance(left, ast.Name)
    column = _column(left, table)
    if isinstance(op, (ast.In, ast.NotIn)):
        among = column.isin(_constants(right))
        return among if isinstance(op, ast.In) else ~among & column.notna()
    return _against(column, op, _column(right, table) if _is_column(right) else _constant(right))


def _against(column: pd.Series, op: ast.cmpop, value: Any) -> pd.Series:
    if value is None and isinstance(op, (ast.Eq, ast.Is)):
        return column.isna()
    if value is None and isinstance(op, (ast.NotEq, ast.IsNot)):
        return column.notna()
    if type(op) not in COMPARE or value is None:
        raise BadRequest("where", type(op).__name__, "this comparison does not apply here", REMEDY)
    if not isinstance(value, pd.Series) and isinstance(value, str) != (column.dtype == "string"):
        raise BadRequest("where", value, f"does not compare with column {column.name} ({column.dtype})", REMEDY)
    try:
        return COMPARE[type(op)](column, value).fillna(False).astype(bool)
    except TypeError:
        raise BadRequest(
            "where", value, f"does not compare with column {column.name} ({column.dtype})", REMEDY
        ) from None


def _is_column(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id.lower() not in WORDS


def _column(node: ast.expr, table: pd.DataFrame) -> pd.Series:
    assert isinstance(node, ast.Name)
    if node.id not in table.columns:
        raise BadRequest("where", node.id, "no such column", f"choose among {', '.join(table.columns[:12])}, ...")
    return table[node.id]


def _constants(node: ast.expr) -> list[Any]:
    if isinstance(node, (ast.List, ast.Tuple, ast.Set)):
        return [_constant(item) for item in node.elts]
    raise BadRequest("where", ast.unparse(node), "'in' needs a list", "write e.g. order in [4, 8]")


def _constant(node: ast.expr) -> bool | int | float | str | None:
    if isinstance(node, ast.Constant) and (node.value is None or isinstance(node.value, (bool, int, float, str))):
        return node.value
    if isinstance(node, ast.Name) and node.id.lower() in WORDS:
        return WORDS[node.id.lower()]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        value = _constant(node.operand)
        if isinstance(value, (int, float)):
            return -value if isinstance(node.op, ast.USub) else value
    raise BadRequest("where", ast.unparse(node), "not a constant", REMEDY)
