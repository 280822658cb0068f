"""The kinds of scene files that are registered, and what their loaders say of themselves."""

import importlib
import inspect
from dataclasses import dataclass

from spherloc import registry
from spherloc.errors import InputError


@dataclass(frozen=True)
class SceneKind:
    """One kind of scene file."""

    name: str
    """Value of the scene file's ``kind``."""
    documentation: str
    """Docstring of the loader's module; its first line says what it reads."""
    extras: tuple[str, ...] = ()
    """Extras of spherloc that bring the packages it needs: the module's ``EXTRAS``, if it has one."""
    example: str = ""
    """A scene file of this kind (TOML): the module's ``EXAMPLE``, if it has one."""
    problem: str = ""
    """Why the loader cannot be imported; empty if it can."""


def scene_kinds() -> tuple[SceneKind, ...]:
    """All registered kinds, in alphabetical order."""
    return tuple(scene_kind(name) for name in registry.names("datasets"))


def scene_kind(name: str) -> SceneKind:
    """The kind of that name. Raises ``InputError`` naming the known ones if there is none."""
    try:
        loader = registry.lookup("datasets", name)
        with registry.guarded("datasets", name):
            module = importlib.import_module(loader.__module__)
            return SceneKind(
                name=name,
                documentation=inspect.getdoc(module) or "",
                extras=tuple(map(str, getattr(module, "EXTRAS", ()))),
                example=str(getattr(module, "EXAMPLE", "")),
            )
    except InputError as error:
        if name not in registry.names("datasets"):
            raise
        return SceneKind(name, "", problem=str(error))  # an extension that cannot be imported hides no other
