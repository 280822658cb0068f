"""Statements of a lesson that are recomputed: ``[CHANGES: ]EXPRESSION``.

CHANGES are those to the moment's state, as in its links; ``seed=0..19`` solves it for each of these seeds. EXPRESSION
is a comparison of numbers of the run (``numbers.py``), with arithmetic and a few functions: ``share``, ``median``,
``least`` and ``most`` of all runs, ``log``, ``sqrt``, ``ceil``, ``comb``. Nothing else is understood or executed.
"""

import ast
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from math import ceil, comb, cos, log, radians, sin, sqrt, tan
from statistics import fmean, median
from typing import Any

from spherloc.errors import InputError, show
from spherloc_viz.lessons.numbers import Number

SEEDS = re.compile(r"\bseed=(\d+)\.\.(\d+)")
OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    **{"log": log, "sqrt": sqrt, "ceil": ceil, "comb": lambda n, k: comb(int(n), int(k)), "abs": abs, "round": round},
    **{
        "sin": lambda deg: sin(radians(deg)),
        "tan": lambda deg: tan(radians(deg)),
        "cos": lambda deg: cos(radians(deg)),
    },
}
OVER_RUNS: Mapping[str, Callable[[Sequence[Any]], Any]] = {"share": fmean, "median": median, "least": min, "most": max}


def split_claim(claim: str) -> tuple[tuple[str, ...], str]:
    """Changes of the state, one for each run that it needs, and the expression."""
    changes, colon, expression = claim.partition(": ")
    if not colon:
        return ("",), claim
    seeds = SEEDS.search(changes)
    if seeds is None:
        return (changes,), expression
    return tuple(SEEDS.sub(f"seed={seed}", changes) for seed in range(int(seeds[1]), int(seeds[2]) + 1)), expression


def holds(expression: str, runs: Sequence[Mapping[str, Number]]) -> bool:
    """Whether a claim is true of its runs; raises ``InputError`` if it cannot be understood."""
    try:
        tree = ast.parse(expression.strip(), mode="eval").body
    except SyntaxError:
        raise InputError(f"the claim {show(expression)} is no expression.") from None
    if not isinstance(tree, ast.Compare):
        raise InputError(f"the claim {show(expression)} compares nothing.")
    return bool(_value(tree, runs))


def _value(node: ast.AST, runs: Sequence[Mapping[str, Number]]) -> Any:
    match node:
        case ast.Constant(value=value) if isinstance(value, int | float | str):
            return value
        case ast.Name(id=name):
            if name not in runs[0]:
                raise InputError(f"the run has no number {show(name)}; it has {', '.join(sorted(runs[0]))}.")
            return runs[0][name]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
            return OPERATORS[type(op)](_value(operand, runs))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            return OPERATORS[type(op)](_value(left, runs), _value(right, runs))
        case ast.Compare(left=left, ops=ops, comparators=others) if all(type(op) in OPERATORS for op in ops):
            values = [_value(one, runs) for one in (left, *others)]
            return all(OPERATORS[type(op)](*pair) for op, pair in zip(ops, pairwise(values), strict=True))
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in OVER_RUNS:
            return OVER_RUNS[name]([_value(argument, [run]) for run in runs])
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS:
            return FUNCTIONS[name](*(_value(argument, runs) for argument in arguments))
        case _:
            raise InputError(f"a claim does not know {show(ast.unparse(node))}.")
