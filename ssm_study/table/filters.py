"""`--where "order == 8 and fit_test_percent > 85"`: comparisons of columns with constants, and
nothing else.

The expression is parsed, never evaluated as Python: names are columns, the rest is numbers, texts,
true, false, null.
"""

import ast
import operator
from functools import reduce
from typing import Never

import pandas as pd

from ssm_study.refusal import BadRequest
from ssm_study.table.columns import nearest

REMEDY = "write comparisons of columns with constants, e.g. order == 8 and fit_test_percent > 85"
COMPARE = {ast.Eq: "eq", ast.NotEq: "ne", ast.Lt: "lt", ast.LtE: "le", ast.Gt: "gt", ast.GtE: "ge"}
MIRRORED = {
    ast.Lt: ast.Gt,
    ast.LtE: ast.GtE,
    ast.Gt: ast.Lt,
    ast.GtE: ast.LtE,
    ast.Eq: ast.Eq,
    ast.NotEq: ast.NotEq,
}
WORDS = {"true": True, "false": False, "null": None, "nan": None, "inf": float("inf")}


def where(table: pd.DataFrame, expression: str) -> pd.DataFrame:
    """The rows of `table` for which `expression` holds; a comparison with a missing value does not
    hold.

    Grammar: `and`, `or`, `not`, parentheses, `== != < <= > >=` (chains too), `in [..]`, `not in
    [..]`, `== null`.
    Raises `BadRequest` for anything else and for unknown columns.
    """
    try:
        tree = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise BadRequest("where", expression, "not an expression", REMEDY) from None
    return table[_mask(tree, table)]


def _refuse(node: ast.expr, problem: str) -> Never:
    raise BadRequest("where", ast.unparse(node), problem, REMEDY)


def _mask(node: ast.expr, table: pd.DataFrame) -> pd.Series:
    match node:
        case ast.BoolOp(op=op, values=values):
            both = operator.and_ if isinstance(op, ast.And) else operator.or_
            return reduce(both, [_mask(value, table) for value in values])
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return ~_mask(operand, table)
        case ast.Name() if (
            column := _column(node, table)
        ) is not None and column.dtype == "boolean":
            return column.fillna(False).astype(bool)
        case ast.Compare(left=left, ops=ops, comparators=comparators):
            pairs = zip([left, *comparators], ops, comparators, strict=False)  # a < b < c
            return reduce(
                operator.and_, [_compare(one, op, other, table) for one, op, other in pairs]
            )
    _refuse(node, "not a comparison")


def _compare(left: ast.expr, op: ast.cmpop, right: ast.expr, table: pd.DataFrame) -> pd.Series:
    column, other = _column(left, table), _column(right, table)
    if column is None and other is not None and type(op) in MIRRORED:
        right, column, op, other = left, other, MIRRORED[type(op)](), None  # 8 == order
    if column is None:
        _refuse(left, "not a column")
    if isinstance(op, (ast.In, ast.NotIn)):
        if not isinstance(right, (ast.List, ast.Tuple, ast.Set)):
            raise BadRequest(
                "where", ast.unparse(right), "'in' needs a list", "write e.g. order in [4, 8]"
            )
        among = column.isin([_constant(item) for item in right.elts])
        return (
            among if isinstance(op, ast.In) else ~among & column.notna()
        )  # missing is in no list and outside none
    value = _constant(right) if other is None else other
    if value is None and isinstance(op, (ast.Eq, ast.Is, ast.NotEq, ast.IsNot)):
        return column.isna() if isinstance(op, (ast.Eq, ast.Is)) else column.notna()
    if type(op) not in COMPARE or value is None:
        raise BadRequest("where", type(op).__name__, "this comparison does not apply here", REMEDY)
    try:
        if other is not None or isinstance(value, str) == (column.dtype == "string"):
            return getattr(column, COMPARE[type(op)])(value).fillna(False).astype(bool)
    except TypeError:  # two columns of different types
        pass
    said = value if other is None else other.name
    raise BadRequest(
        "where", said, f"does not compare with column {column.name} ({column.dtype})", REMEDY
    )


def _column(node: ast.expr, table: pd.DataFrame) -> pd.Series | None:
    if not isinstance(node, ast.Name) or node.id.lower() in WORDS:
        return None
    if node.id not in table.columns:
        raise BadRequest("where", node.id, "no such column", nearest(node.id, table.columns))
    return table[node.id]


def _constant(node: ast.expr) -> bool | int | float | str | None:
    match node:
        case ast.Constant(value=None | bool() | int() | float() | str() as value):
            return value
        case ast.Name(id=name) if name.lower() in WORDS:
            return WORDS[name.lower()]
        case ast.UnaryOp(op=ast.USub(), operand=operand) if isinstance(
            value := _constant(operand), (int, float)
        ):
            return -value
    _refuse(node, "not a constant")
