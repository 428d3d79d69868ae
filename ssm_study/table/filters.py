"""Selection of rows of a table by an expression, such as `--where "order == 8 and fit_test_percent
> 85"`.

`pandas.DataFrame.eval` evaluates the expression, as `DataFrame.query` does. It evaluates Python, so
calls, attributes, subscripts and names that are no columns are refused before it sees them.
"""

import ast
from typing import Any

import numpy as np
import pandas as pd

from ssm_study.refusal import BadRequest
from ssm_study.table.columns import suggest_column

REMEDY = "write comparisons of columns with constants, e.g. order == 8 and fit_test_percent > 85"
WORDS = {"true": True, "false": False, "inf": float("inf")}
NULL = ("null", "none", "nan")
REFUSED = (ast.Call, ast.Attribute, ast.Subscript, ast.Lambda, ast.JoinedStr, ast.NamedExpr)
LISTS = (ast.List, ast.Tuple, ast.Set)
IS_MISSING = "__is_missing"  # ends the name that stands for `column == null`
TEXT = pd.StringDtype("python", na_value=np.nan)  # a comparison with what is missing is false


def filter_rows(table: pd.DataFrame, expression: str) -> pd.DataFrame:
    """Rows of a results table for which an expression such as `order == 8` is true. A comparison
    with a missing value is false.

    `null`, `true`, `false` and `inf` are constants; `x == null` selects what is missing. Raises
    `BadRequest` for what is no comparison of columns and for unknown columns.
    """
    try:
        trimmed = expression.strip()
        tree = ast.parse(trimmed, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise BadRequest("where", expression, "not an expression", REMEDY) from None
    preparation = _FilterChecker(table)
    prepared = ast.unparse(preparation.visit(tree))
    missing = {f"{name}{IS_MISSING}": values.isna() for name, values in table.items()}
    try:
        comparable = _with_comparable_values(table)
        selected = comparable.eval(prepared, engine="python", resolvers=[missing])
    except Exception as error:  # whatever pandas meets in an expression that it does not take
        problem = str(error)
        raise BadRequest("where", expression, problem, REMEDY) from None
    if not isinstance(selected, pd.Series) or selected.dtype != bool:
        raise BadRequest("where", expression, "not a comparison", REMEDY)
    return table[selected]


def _with_comparable_values(table: pd.DataFrame) -> pd.DataFrame:
    """Copy of a table with NaN for missing numbers and texts, and false for missing truth
    values."""
    columns: dict[Any, Any] = {}
    for name, values in table.items():
        if values.dtype == "boolean":
            known_values = values.fillna(False)
            columns[name] = known_values.astype(bool)
        elif pd.api.types.is_numeric_dtype(values.dtype):
            numbers = values.astype("Float64")
            columns[name] = numbers.to_numpy(float, na_value=np.nan)
        else:
            columns[name] = values.astype(TEXT)
    return pd.DataFrame(columns, index=table.index)


class _FilterChecker(ast.NodeTransformer):
    """Checker of filter expressions such as `order == 8`, which also rewrites syntax that pandas
    reads differently."""

    def __init__(self, table: pd.DataFrame) -> None:
        self.table = table

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Raise `BadRequest` for every kind of syntax that is not allowed in a filter
        expression."""
        if isinstance(node, REFUSED):
            syntax = ast.unparse(node)
            raise BadRequest("where", syntax, "not a comparison", REMEDY)
        return super().generic_visit(node)

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Replace words such as `null` by constants, and raise `BadRequest` for names that are no
        columns."""
        if node.id.lower() in WORDS:
            word = node.id.lower()
            return ast.Constant(WORDS[word])
        if node.id not in self.table.columns:
            names = self.table.columns
            remedy = suggest_column(node.id, names)
            raise BadRequest("where", node.id, "no such column", remedy)
        return node

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        """Rewrite a chain of comparisons as single comparisons that treat missing values as
        false."""
        comparisons: list[ast.expr] = []
        left = node.left
        for operator, right in zip(node.ops, node.comparators, strict=True):
            comparison = self._comparison_expression(left, operator, right)
            comparisons.append(comparison)
            left = right
        return comparisons[0] if len(comparisons) == 1 else ast.BoolOp(ast.And(), comparisons)

    def _comparison_expression(
        self, left: ast.expr, operator: ast.cmpop, right: ast.expr
    ) -> ast.expr:
        """Filter expression that compares two operands and is false where one of them is
        missing."""
        if _is_null(left):
            left, right = right, left  # so that null stands on the right
        if _is_null(right):
            return self._null_comparison(left, operator)
        if isinstance(operator, ast.In | ast.NotIn) and not isinstance(right, LISTS):
            remedy = "write e.g. order in [4, 8]"
            operand = ast.unparse(right)
            raise BadRequest("where", operand, "'in' needs a list", remedy)
        self._refuse_mixed_types(left, right)
        left = self.visit(left)
        right = self.visit(right)
        comparison = ast.Compare(left, [operator], [right])
        if not isinstance(operator, ast.NotEq | ast.NotIn):
            return comparison
        # NaN differs from everything and is in no list: here it has to be equal to itself as well.
        sides = (left, right)
        names = [side for side in sides if isinstance(side, ast.Name)]
        present: list[ast.expr] = [ast.Compare(name, [ast.Eq()], [name]) for name in names]
        conjunction = ast.And()
        operands = [comparison, *present]
        return ast.BoolOp(conjunction, operands)

    def _null_comparison(self, side: ast.expr, operator: ast.cmpop) -> ast.expr:
        """Rewrite a comparison with null, such as `x == null`, as a test for a missing value."""
        equalities = ast.Eq | ast.Is
        is_equality = isinstance(operator, equalities)
        is_comparison = is_equality or isinstance(operator, ast.NotEq | ast.IsNot)
        if not isinstance(side, ast.Name) or not is_comparison:
            raise BadRequest(
                "where", "null", "only a column can be compared with null, by == or !=", REMEDY
            )
        self.visit(side)
        missing = ast.Name(f"{side.id}{IS_MISSING}")
        return missing if is_equality else ast.UnaryOp(ast.Not(), missing)

    def _refuse_mixed_types(self, left: ast.expr, right: ast.expr) -> None:
        """Raise `BadRequest` for a comparison of a number with a text, which no row could
        satisfy."""
        left_kind = self._operand_type(left)
        right_kind = self._operand_type(right)
        if left_kind and right_kind and left_kind != right_kind:
            problem = f"{ast.unparse(left)} is a {left_kind}"
            operand = ast.unparse(right)
            raise BadRequest("where", operand, problem, REMEDY)

    def _operand_type(self, side: ast.expr) -> str:
        """Type of an operand of a comparison: text or number, and empty if the operand is
        compound."""
        if isinstance(side, ast.Constant):
            return "text" if isinstance(side.value, str) else "number"
        if isinstance(side, ast.Name) and side.id in self.table.columns:
            dtype = self.table[side.id].dtype
            numeric = pd.api.types.is_numeric_dtype(dtype)
            return "number" if numeric else "text"
        return ""


def _is_null(node: ast.expr) -> bool:
    """Whether an operand of a comparison is `null`, under any of its names."""
    constant = isinstance(node, ast.Constant) and node.value is None
    return constant or (isinstance(node, ast.Name) and node.id.lower() in NULL)
