"""Public docstrings of the core say what a caller must know: that they are there, shapes of arrays, errors raised."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

CORE = Path(__file__).resolve().parents[1] / "spherloc"
TREES = {
    path: ast.parse(path.read_text("utf-8"))
    for room in ("spherloc", "spherloc_viz", "benchmarks", "scripts")
    for path in sorted((CORE.parent / room).rglob("*.py"))
}
MODULES = [path for path in TREES if CORE in path.parents and (path.stem == "__init__" or path.stem[0] != "_")]
ARRAYS = re.compile(r"\b(FloatArray|IntArray|BoolArray|IndexArray)\b")
SHAPE = re.compile(r"\((?:\.\.\.|[A-Z]'?|\d+|[a-z]+(?=, \d))(?: [+*] \d)?,(?: ?[\w'+* -]+,?)*\)|\dx\d")
"""Such as (N, 3), (I + 1, 6), (M,), (..., 4) or 6x6."""
PROTOCOLS = {"solve": "spherloc/solvers/base.py", "run": "spherloc/estimators/base.py"}
"""Methods of which one docstring, at their protocol, is enough."""
CAUGHT_BY_CALLERS = {"NotImplementedError", "AssertionError", "StopIteration"}
"""Of whoever does not fulfil a contract, not of whoever calls."""


@dataclass(frozen=True)
class Public:
    """A public class, function or method."""

    place: str
    node: ast.ClassDef | ast.FunctionDef
    around: str
    """The docstrings in which it stands, of its class or module, to which it may leave what is true for all."""

    @property
    def told_by_protocol(self) -> bool:
        """Whether it implements a method that is documented elsewhere."""
        file = self.place.partition(":")[0]
        return PROTOCOLS.get(self.node.name, file) != file

    @property
    def text(self) -> str:
        return ast.get_docstring(self.node) or ""


def public(module: Path) -> Iterator[Public]:
    """Those of a module; properties are methods."""
    tree = TREES[module]
    yield from _inside(tree, f"{module.relative_to(CORE.parent)}", ast.get_docstring(tree) or "")


def _inside(tree: ast.AST, place: str, around: str) -> Iterator[Public]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            found = Public(f"{place}:{node.lineno} {node.name}", node, around)
            yield found
            if isinstance(node, ast.ClassDef):
                yield from _inside(node, place, f"{around} {found.text} {_fields(node)}")


def _fields(node: ast.ClassDef) -> str:
    """The docstrings below the fields of a class."""
    return " ".join(
        item.value.value
        for item in node.body
        if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and isinstance(item.value.value, str)
    )


ALL = [found for module in MODULES for found in public(module)]


def raised(node: ast.FunctionDef) -> set[str]:
    """Names of the errors that the function itself makes and raises."""
    names = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Raise) and isinstance(part.exc, ast.Call) and isinstance(part.exc.func, ast.Name):
            names.add(part.exc.func.id)
    return {name for name in names if name[0].isupper()} - CAUGHT_BY_CALLERS


def arrays(node: ast.FunctionDef) -> list[str]:
    """Parameters that are arrays."""
    given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return [one.arg for one in given if one.annotation is not None and ARRAYS.search(ast.unparse(one.annotation))]


def test_all_have_a_docstring() -> None:
    assert [found.place for found in ALL if not found.text] == []


def test_arrays_have_a_shape() -> None:
    functions = [found for found in ALL if isinstance(found.node, ast.FunctionDef)]
    with_arrays = [found for found in functions if arrays(found.node)]
    assert len(with_arrays) > 100
    bare = [found for found in with_arrays if not SHAPE.search(f"{found.text} {found.around}")]
    assert [found.place for found in bare if not found.told_by_protocol] == []


def test_errors_are_told() -> None:
    functions = [found for found in ALL if isinstance(found.node, ast.FunctionDef)]
    silent = [
        f"{found.place}: {name}"
        for found in functions
        if not found.told_by_protocol
        for name in sorted(raised(found.node))
        if not re.search(rf"[Rr]aise[sd]?\b[^.]*{name}|{name}[:`]", f"{found.text}")
    ]
    assert silent == []


def test_kernels_say_their_types() -> None:
    """Numba's functions have no annotations: private ones too name each parameter in their docstring."""
    kernels = [
        (f"{module.relative_to(CORE.parent)}:{node.lineno} {node.name}", node)
        for module in MODULES
        for node in ast.walk(TREES[module])
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(one).startswith("kernel(") for one in node.decorator_list)
    ]
    assert len(kernels) > 150
    unnamed = {
        place: missing
        for place, node in kernels
        if (missing := [one.arg for one in node.args.args if not re.search(rf"\b{one.arg}\b", _text(node))])
    }
    assert unnamed == {}


def _text(node: ast.FunctionDef) -> str:
    return ast.get_docstring(node) or ""


def test_no_call_counts_more_than_eight_places() -> None:
    """Beyond eight, parameters have names where they are given."""
    found = {
        f"{path.relative_to(CORE.parent)}:{node.lineno} {node.name}": len(given)
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for given in ([one for one in (*node.args.posonlyargs, *node.args.args) if one.arg not in ("self", "cls")],)
    }
    assert len(found) > 4000
    assert {place: count for place, count in found.items() if count > 8} == {}


def test_what_lacks_would_be_noticed(tmp_path: Path) -> None:
    source = (
        "def f(a: FloatArray) -> None:\n    '''Of a (the mask).'''\n    raise InputError('no')\nclass C:\n    x = 1\n"
    )
    place = CORE / "module.py"
    tree = ast.parse(source)
    function, kind = _inside(tree, str(place), "")
    assert arrays(function.node) == ["a"] and not SHAPE.search(function.text)
    assert raised(function.node) == {"InputError"} and not kind.text
    assert not SHAPE.search("Of both (pixels, points).")
    assert all(map(SHAPE.search, ("(N, 3)", "(3,)", "(I + 1, 3, 4)", "(..., 4)", "6x6")))
