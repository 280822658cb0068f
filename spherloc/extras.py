"""Optional packages: imported when they are needed, and named in one sentence when they are missing."""

import importlib
from typing import Any

from spherloc.errors import InputError


def require(module: str, extra: str, purpose: str) -> Any:
    """The optional module; ``purpose`` says what needs it ("reading COLMAP models").

    Raises ``InputError`` that names the extra which brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(f"{purpose} needs {module}; install it with: pip install 'spherloc[{extra}]'.") from None
