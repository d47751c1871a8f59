"""Short formulas in presets and command lines, such as the level that an engine reads for a roughness.

numpy evaluates the same text that is translated to GLSL, HLSL and WGSL, so the bake and the shader agree.
"""

from __future__ import annotations

import ast
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from whitefurnace.errors import UsageError, nearest

LONGEST = 1000
"""Largest number of characters of a formula. Formulas of engines are far shorter."""

MOST_NODES = 200
"""Largest number of nodes in the syntax tree of a formula."""

FUNCTIONS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "sqrt": (1, np.sqrt),
    "log2": (1, np.log2),
    "exp2": (1, np.exp2),
    "abs": (1, np.abs),
    "min": (2, np.minimum),
    "max": (2, np.maximum),
    "pow": (2, np.power),
    "clamp": (3, lambda x, low, high: np.minimum(np.maximum(x, low), high)),
    "mix": (3, lambda a, b, t: a + (b - a) * t),
}
"""Number of arguments and numpy function of each function in formulas."""

_BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_COMPARE = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}

LANGUAGES = ("glsl", "hlsl", "wgsl")


class Expression:
    """A formula of the variables `names`: numbers, + - * / **, parentheses, FUNCTIONS, and `a if r < b else c`.

    `where` names the place of the formula in error messages. Raises UsageError where `text` is not such a formula.
    """

    def __init__(self, text: str, names: Sequence[str], where: str = "formula") -> None:
        self.text, self.names, self.where = text, tuple(names), where
        if not isinstance(text, str) or not text.strip() or len(text) > LONGEST:
            raise UsageError(f"{where}: a formula of 1 to {LONGEST} characters was expected")
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            raise UsageError(f"{where}: {text!r} is not a formula of {', '.join(names)}") from None
        if sum(1 for _ in ast.walk(self._tree)) > MOST_NODES:
            raise UsageError(
                f"{where}: {text[:40]!r}… is too long: a formula has at most {MOST_NODES} numbers, names and operators"
            )
        self._check(self._tree)

    def __repr__(self) -> str:
        return f"Expression({self.text!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Expression) and (self.text, self.names) == (other.text, other.names)

    def __hash__(self) -> int:
        return hash((self.text, self.names))

    @cached_property
    def used(self) -> frozenset[str]:
        """The variables that occur in the formula."""
        called = {id(n.func) for n in ast.walk(self._tree) if isinstance(n, ast.Call)}
        return frozenset(n.id for n in ast.walk(self._tree) if isinstance(n, ast.Name) and id(n) not in called)

    def __call__(self, **values: Any) -> Any:
        """Evaluate the formula, in float64 of the shape that `values` broadcast to.

        The value is NaN or ±inf outside the domain of a function.
        """
        with np.errstate(all="ignore"):
            return self._value(self._tree, {name: np.asarray(values[name], np.float64) for name in self.used})

    def shader(self, language: str, **names: str) -> str:
        """Translate the formula to a shading language of LANGUAGES.

        names: replacements of variables. Raises UsageError for an unknown language.
        """
        if language not in LANGUAGES:
            raise UsageError(f"unknown shading language {language!r}{nearest(language, LANGUAGES)}")
        return self._written(self._tree, language, names)

    # ------------------------------------------------------------------------------------------- the tree

    def _check(self, node: ast.AST) -> None:
        match node:
            case ast.Constant(value=bool()):
                pass
            case ast.Constant(value=int() | float() as value) if abs(value) <= sys.float_info.max:
                return
            case ast.Name(id=name):
                if name in self.names:
                    return
                raise UsageError(f"{self.where}: {self.text!r} has an unknown name {name!r}{nearest(name, self.names)}")
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
                return self._check(operand)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY or isinstance(op, ast.Pow):
                self._check(left)
                return self._check(right)
            case ast.IfExp(test=ast.Compare(left=left, ops=[op], comparators=[right]), body=body, orelse=other) if (
                type(op) in _COMPARE
            ):
                for part in (left, right, body, other):
                    self._check(part)
                return
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                if name not in FUNCTIONS:
                    raise UsageError(
                        f"{self.where}: {self.text!r} has an unknown function {name!r}{nearest(name, FUNCTIONS)}"
                    )
                if len(args) != FUNCTIONS[name][0]:
                    count = FUNCTIONS[name][0]
                    many = "1 argument" if count == 1 else f"{count} arguments"
                    raise UsageError(f"{self.where}: {name} takes {many}, and {self.text!r} gives it {len(args)}")
                for part in args:
                    self._check(part)
                return
        raise UsageError(
            f"{self.where}: {self.text!r} is not a formula; it may use numbers, {', '.join(self.names)}, + - * / **, "
            f"`a if x < y else b` and {', '.join(FUNCTIONS)}"
        )

    def _value(self, node: ast.AST, names: Mapping[str, Any]) -> Any:
        match node:
            case ast.Constant(value=int() | float() as value):
                return np.float64(value)
            case ast.Name(id=name):
                return names[name]
            case ast.UnaryOp(op=op, operand=operand):
                return -self._value(operand, names) if isinstance(op, ast.USub) else self._value(operand, names)
            case ast.BinOp(left=left, op=op, right=right):
                a, b = self._value(left, names), self._value(right, names)
                return (
                    a + b
                    if isinstance(op, ast.Add)
                    else a - b
                    if isinstance(op, ast.Sub)
                    else a * b
                    if isinstance(op, ast.Mult)
                    else np.divide(a, b)
                    if isinstance(op, ast.Div)
                    else np.power(a, b)
                )
            case ast.IfExp(test=ast.Compare(left=left, ops=[op], comparators=[right]), body=body, orelse=other):
                a, b = self._value(left, names), self._value(right, names)
                test = (
                    a < b
                    if isinstance(op, ast.Lt)
                    else a <= b
                    if isinstance(op, ast.LtE)
                    else a > b
                    if isinstance(op, ast.Gt)
                    else a >= b
                )
                return np.where(test, self._value(body, names), self._value(other, names))
            case ast.Call(func=ast.Name(id=name), args=args):
                return FUNCTIONS[name][1](*(self._value(part, names) for part in args))
        raise AssertionError(ast.dump(node))

    def _written(self, node: ast.AST, language: str, names: Mapping[str, str]) -> str:
        def write(part: ast.AST) -> str:
            return self._written(part, language, names)

        match node:
            case ast.Constant(value=int() | float() as value):
                text = repr(float(value))
                return text if "e" not in text else f"{float(value):.9e}"
            case ast.Name(id=name):
                return names.get(name, name)
            case ast.UnaryOp(op=op, operand=operand):
                return f"(-{write(operand)})" if isinstance(op, ast.USub) else write(operand)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                # pow is undefined for x < 0 in all three languages, so squares and cubes are products.
                power = right.value if isinstance(right, ast.Constant) else None
                if power == 2 or power == 3:
                    return "(" + " * ".join([write(left)] * (2 if power == 2 else 3)) + ")"
                return f"pow({write(left)}, {write(right)})"
            case ast.BinOp(left=left, op=op, right=right):
                return f"({write(left)} {_BINARY[type(op)]} {write(right)})"
            case ast.IfExp(test=ast.Compare(left=left, ops=[op], comparators=[right]), body=body, orelse=other):
                test = f"{write(left)} {_COMPARE[type(op)]} {write(right)}"
                if language == "wgsl":
                    return f"select({write(other)}, {write(body)}, {test})"
                return f"({test} ? {write(body)} : {write(other)})"
            case ast.Call(func=ast.Name(id=name), args=args):
                called = "lerp" if (name, language) == ("mix", "hlsl") else name
                return f"{called}({', '.join(map(write, args))})"
        raise AssertionError(ast.dump(node))


def table_text(points: Sequence[Sequence[float]], name: str, where: str) -> str:
    """Return the formula of a piecewise linear curve through (x, y) points, constant beyond its ends.

    points: two or more pairs of finite numbers with increasing x. name: the variable of the formula. Raises UsageError
    for other points, with `where` as their place.
    """
    rows = [tuple(float(x) for x in point) for point in points]
    if len(rows) < 2 or any(len(row) != 2 or not all(map(math.isfinite, row)) for row in rows):
        raise UsageError(f"{where}: two or more pairs of finite numbers were expected, such as [[0, 0], [1, 4]]")
    text = repr(rows[0][1])
    for (x0, y0), (x1, y1) in pairwise(rows):
        if x1 <= x0:
            raise UsageError(f"{where}: {name} = {x1:g} follows {name} = {x0:g}; the values must grow")
        text += f" + ({y1 - y0!r}) * clamp(({name} - ({x0!r})) / ({x1 - x0!r}), 0, 1)"
    return text
