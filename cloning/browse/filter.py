"""Find the rows of a recording for which a condition on its columns is true, such as `abs(steering) > 0.8`."""

import ast
import operator
from collections.abc import Callable

import numpy as np

from cloning.base.errors import UserError

MAX_LENGTH = 300  # characters of a condition
FUNCTIONS: dict[str, Callable] = {"abs": np.abs, "min": np.minimum, "max": np.maximum}
OPERATORS: dict[type, Callable] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: np.divide},
    **{ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge},
    **{ast.Eq: operator.eq, ast.NotEq: operator.ne},
    **{ast.USub: operator.neg, ast.UAdd: operator.pos},
}


def matching(condition: str, column: Callable[[str], np.ndarray], names: list[str]) -> np.ndarray:
    """Return the rows for which a condition is true: bool (n,).

    It has numbers, columns, + - * /, comparisons, abs, min, max, and, or, not and parentheses, as in Python. A row in
    which a value that it names is unknown does not match. column: returns the column of one of `names`, float (n,).
    Raises UserError, and the errors of `column`.
    """
    unknown: np.ndarray | bool = False

    def value(node: ast.AST) -> np.ndarray | float:
        found = value_of(node)
        return found.item() if isinstance(found, np.generic) else found  # 1/10, as 0.1, in a column's precision

    def value_of(node: ast.AST) -> np.ndarray | float:
        nonlocal unknown
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return float(number)
            case ast.Name(id=name) if name in names:
                unknown |= np.isnan(column(name))
                return column(name)
            case ast.Name(id=name):
                raise UserError(f"condition: there is no {name[:40]} here; there are {', '.join(names)}")
            case ast.BinOp(left, op, right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(left), value(right))
            case ast.UnaryOp(ast.Not(), operand):
                return ~truth(value(operand))
            case ast.UnaryOp(op, operand) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(operand))
            case ast.BoolOp(op, values):
                all_or_any = np.logical_and if isinstance(op, ast.And) else np.logical_or
                return all_or_any.reduce([truth(value(each)) for each in values])
            case ast.Compare(left, ops, comparators) if all(type(op) in OPERATORS for op in ops):
                sides = [value(left), *map(value, comparators)]
                pairs = zip(ops, sides, sides[1:], strict=False)
                return np.logical_and.reduce([OPERATORS[type(op)](one, two) for op, one, two in pairs])
            case ast.Call(ast.Name(id=name), args, []) if name in FUNCTIONS and len(args) == 1 + (name != "abs"):
                return FUNCTIONS[name](*map(value, args))
        raise UserError(f"condition: {ast.unparse(node)[:40]} has no meaning; for example abs(steering) > 0.8")

    if len(condition) > MAX_LENGTH:
        raise UserError(f"condition: longer than {MAX_LENGTH} characters; use fewer")
    try:
        with np.errstate(all="ignore"):
            found = truth(value(ast.parse(condition.strip(), mode="eval").body))
    except (SyntaxError, TypeError, ValueError, RecursionError, MemoryError, OverflowError):
        raise UserError("condition: not complete; for example abs(steering) > 0.8 and speed < 5") from None
    return found & ~unknown


def truth(found: np.ndarray | float) -> np.ndarray:
    """Return the outcome of comparisons: bool (n,). Raises UserError if it is none."""
    found = np.asarray(found)
    if found.dtype != bool or not found.ndim:
        raise UserError("condition: compares no column with a number; for example speed < 5")
    return found


def stretches_of(rows: np.ndarray) -> list[list[int]]:
    """Return the stretches of rows that are true: [first row, row after the last]; rows: bool (n,)."""
    return np.flatnonzero(np.diff(rows, prepend=False, append=False)).reshape(-1, 2).tolist()
