"""Every registered kind of scene says what it reads and shows a scene file that its own loader understands."""

import tomllib
from pathlib import Path

import pytest

from spherloc import registry
from spherloc.datasets import load_scene
from spherloc.datasets.scene_file import scene_kind
from spherloc.errors import InputError

ALL = registry.names("datasets")


@pytest.mark.parametrize("name", ALL)
def test_a_kind_describes_itself(name: str) -> None:
    kind = scene_kind(name)
    assert kind.problem == "" and kind.documentation.splitlines()[0].endswith(".")
    assert tomllib.loads(kind.example)["kind"] == name


@pytest.mark.parametrize("name", ALL)
def test_the_example_lacks_nothing_but_its_files(name: str, tmp_path: Path) -> None:
    """Its keys and values are checked before its files are looked for, so that only these may be missed."""
    path = tmp_path / "scene.toml"
    path.write_text(scene_kind(name).example)
    if name in ("synthetic", "rendered"):
        assert load_scene(path).name == tomllib.loads(path.read_text())["name"]
        return
    with pytest.raises(InputError) as caught:
        load_scene(path)
    sentence = str(caught.value)
    assert any(words in sentence for words in ("does not exist", "no such file", "there is no", "is missing"))
    assert "key" not in sentence.replace("correct the key", "")
