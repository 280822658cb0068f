"""The drawn sequence as a kind of scene files that is found inside the test's own process."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from sequence_samples import plug_in

from spherloc import registry


def forget_registered() -> None:
    """All that the registry has found is sought anew."""
    for found in vars(registry).values():
        if hasattr(found, "cache_clear"):
            found.cache_clear()


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Installs ``kind = "drawn"``; gives the environment in which other processes find it too."""
    environment = plug_in(tmp_path / "plug-in")
    monkeypatch.syspath_prepend(tmp_path / "plug-in")
    monkeypatch.delitem(sys.modules, "drawn_matches", raising=False)
    forget_registered()
    yield environment
    forget_registered()
