"""Reads the data in a Python pickle without running anything: objects of classes are noted and not made.

A pickle is a program for a small machine with a stack. Python's own unpickler imports what the program names and calls
it. This reader takes the program apart with ``pickletools``, which runs nothing, and goes through it with plain data
only: numbers, texts, bytes, lists, tuples, dicts, and ``Noted`` in place of everything that would have to be imported
or called. No name in the file is looked up. Numbers and arrays of numpy are made of their bytes by ``value_of``.
"""

import io
import math
import pickletools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_STEPS = 200_000_000
"""Largest number of instructions of a pickle; a log of thousands of queries has tens of millions."""
KEYS = (str, int, float, bytes, type(None))
"""Types of a dict's keys: those that are cheap to hash."""
PLAIN = {"collections.defaultdict", "collections.OrderedDict", "builtins.dict"}
"""Classes whose objects are read as dicts."""


class PickleDataError(Exception):
    """The pickle cannot be read; the message ends a sentence about the file."""


@dataclass(eq=False)
class Noted:
    """An object that Python's unpickler would import (``args`` is None) or make by a call with ``args``."""

    name: str
    """Module and name, such as "numpy.dtype"."""
    args: tuple[Any, ...] | None = None
    state: Any = None
    """Its state, which the unpickler would set after the call, such as a dict of fields or the bytes of an array."""
    items: dict[Any, Any] = field(default_factory=dict)
    """Items that the unpickler would put into it by keys."""


def read_pickle_data(content: bytes) -> Any:
    """The data of a pickle. Raises ``PickleDataError`` for another file, and for instructions that no data needs."""
    machine = _Machine()
    try:
        for number, (opcode, argument, _) in enumerate(pickletools.genops(io.BytesIO(content))):
            if number > MAX_STEPS:
                raise PickleDataError(f"has more than {MAX_STEPS:,} instructions")
            if opcode.name == "STOP":
                return machine.stack.pop()
            machine.do(opcode.name, argument)
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, UnicodeError) as error:
        raise PickleDataError("is not a complete pickle of data") from error
    raise PickleDataError("ends in the middle")


class _Machine:
    """The stack and the memory of a pickle's program."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._marks: list[int] = []
        self._memory: dict[int, Any] = {}

    def do(self, name: str, argument: Any) -> None:
        """Do one instruction. Raises ``PickleDataError`` for one that no data needs, others for a wrong pickle."""
        stack = self.stack
        if name in _PUSH:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name]())
        elif name in ("MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT"):
            self._memory[len(self._memory) if name == "MEMOIZE" else argument] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self._memory[argument])
        elif name == "GLOBAL":
            stack.append(Noted(argument.replace(" ", ".", 1)))
        elif name == "MARK":
            self._marks.append(len(stack))
        elif name in _SMALL_TUPLES:
            count = _SMALL_TUPLES[name]
            stack[len(stack) - count :] = [tuple(stack[len(stack) - count :])]
        elif name not in ("PROTO", "FRAME"):
            make = _MAKE.get(name)
            if make is None:
                raise PickleDataError(f"has the instruction {name}, which no data needs")
            make(self)

    def marked(self) -> list[Any]:
        """Take everything that was pushed since the last mark from the stack."""
        start = self._marks.pop()
        taken = self.stack[start:]
        del self.stack[start:]
        return taken


def _tuple(machine: _Machine) -> None:
    machine.stack.append(tuple(machine.marked()))


def _list(machine: _Machine) -> None:
    machine.stack.append(machine.marked())


def _dict(machine: _Machine) -> None:
    items = machine.marked()
    machine.stack.append({})
    _put(machine.stack[-1], items)


def _append(machine: _Machine) -> None:
    item = machine.stack.pop()
    _extend(machine.stack[-1], [item])


def _appends(machine: _Machine) -> None:
    items = machine.marked()
    _extend(machine.stack[-1], items)


def _extend(target: Any, items: list[Any]) -> None:
    if not isinstance(target, list):
        raise PickleDataError("appends to something that is not a list")
    target.extend(items)


def _set_item(machine: _Machine) -> None:
    value, key = machine.stack.pop(), machine.stack.pop()
    _put(machine.stack[-1], [key, value])


def _set_items(machine: _Machine) -> None:
    items = machine.marked()
    _put(machine.stack[-1], items)


def _put(target: Any, items: list[Any]) -> None:
    keys = [_key(key) for key in items[::2]]
    table = target.items if isinstance(target, Noted) else target
    if not isinstance(table, dict):
        raise PickleDataError("puts items into something that is not a dict")
    table.update(zip(keys, items[1::2], strict=True))


def _key(key: Any) -> Any:
    key = value_of(key)
    if not isinstance(key, KEYS):
        raise PickleDataError("has a key that is neither a text nor a number")
    return key


def _stack_global(machine: _Machine) -> None:
    name, module = machine.stack.pop(), machine.stack.pop()
    if not isinstance(name, str) or not isinstance(module, str):
        raise PickleDataError("has a name that is not a text")
    machine.stack.append(Noted(f"{module}.{name}"))


def _call(machine: _Machine) -> None:
    args, called = machine.stack.pop(), machine.stack.pop()
    if not isinstance(called, Noted) or not isinstance(args, tuple):
        raise PickleDataError("calls something that is not a name")
    name = called.name if called.args is None else f"{called.name}()"
    machine.stack.append({} if name in PLAIN else Noted(name, args))


def _build(machine: _Machine) -> None:
    state = machine.stack.pop()
    made = machine.stack[-1]
    if not isinstance(made, Noted):
        raise PickleDataError("gives a state to something that cannot have one")
    made.state = state


def _pop(machine: _Machine) -> None:
    machine.stack.pop()


def _pop_mark(machine: _Machine) -> None:
    machine.marked()


def _duplicate(machine: _Machine) -> None:
    machine.stack.append(machine.stack[-1])


_PUSH = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "STRING", "BINSTRING", "SHORT_BINSTRING"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}
_CONSTANTS: Mapping[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
    "EMPTY_TUPLE": tuple,
}
_SMALL_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_MAKE: Mapping[str, Callable[[_Machine], None]] = {
    "TUPLE": _tuple,
    "LIST": _list,
    "DICT": _dict,
    "APPEND": _append,
    "APPENDS": _appends,
    "SETITEM": _set_item,
    "SETITEMS": _set_items,
    "STACK_GLOBAL": _stack_global,
    "REDUCE": _call,
    "NEWOBJ": _call,
    "BUILD": _build,
    "POP": _pop,
    "POP_MARK": _pop_mark,
    "DUP": _duplicate,
}

_ARRAYS = {"numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct"}
_BUFFERS = {"numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer"}
_SCALARS = {"numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar"}


def value_of(found: Any) -> Any:
    """A number or an array of numpy, made from its bytes; anything else as it is.

    Raises ``PickleDataError`` for an array of objects, and for one whose bytes do not fit its shape.
    """
    if not isinstance(found, Noted) or found.args is None:
        return found
    try:
        if found.name in _SCALARS:
            return _array(found.args[1], found.args[0], (), False).item()
        if found.name in _ARRAYS and found.state is not None:
            _, shape, kind, fortran, content = found.state
            return _array(content, kind, shape, fortran)
        if found.name in _BUFFERS:
            content, kind, shape, order = found.args
            return _array(content, kind, shape, order == "F")
    except (ValueError, TypeError, IndexError) as error:
        raise PickleDataError("has an array that does not hold numbers") from error
    return found


def _array(content: Any, kind: Any, shape: Any, fortran: bool) -> NDArray[Any]:
    """An array made from its bytes, or from a text with one byte per letter, as Python 2 wrote them."""
    dtype = _dtype(kind)
    if isinstance(content, str):
        content = content.encode("latin-1")
    if not isinstance(shape, tuple) or not all(isinstance(size, int) and size >= 0 for size in shape):
        raise ValueError("no shape")
    if not isinstance(content, bytes | bytearray) or len(content) != dtype.itemsize * math.prod(shape):
        raise ValueError("not as many bytes as its shape says")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


def _dtype(kind: Any) -> np.dtype[Any]:
    if not isinstance(kind, Noted) or kind.name != "numpy.dtype" or not kind.args:
        raise TypeError("no dtype")
    text = kind.args[0]
    order = kind.state[1] if isinstance(kind.state, tuple) and len(kind.state) > 1 else "="
    if (
        not isinstance(text, str)
        or not text[1:].isdigit()
        or text[0] not in "biuf"
        or order not in ("<", ">", "=", "|")
    ):
        raise TypeError("no dtype of numbers")
    return np.dtype(text).newbyteorder(order)
