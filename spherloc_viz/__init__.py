"""The screens of spherloc: viser app, rerun recorder, command line.

``show`` opens the playground on a run.
"""

import importlib
from typing import Any

EXPORTS = ("show", "Playground")
"""What is to be had from the package itself: imported when it is first asked for, since the layers need no server."""


def __getattr__(name: str) -> Any:
    if name not in EXPORTS:
        raise AttributeError(f"module 'spherloc_viz' has no attribute {name!r}")
    return getattr(importlib.import_module("spherloc_viz.showing"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *EXPORTS})
