"""Packages of others as pip would have installed them: modules and a dist-info folder, in a folder on the path."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.waiting import LIMIT_S

COMMAND = "from spherloc_viz.start import main\nmain()"
SEVERAL = """
import io, json, sys
from contextlib import redirect_stderr, redirect_stdout
from spherloc_viz.commands.cli import main

found = []
for words in json.loads(sys.argv[1]):
    sys.argv, output, errors = ["spherloc", *words], io.StringIO(), io.StringIO()
    with redirect_stdout(output), redirect_stderr(errors):
        try:
            main()
        except SystemExit as ended:
            found.append([ended.code or 0, output.getvalue(), errors.getvalue()])
print(json.dumps(found))
"""


def install(folder: Path, name: str, entry_points: Mapping[str, Mapping[str, str]], modules: Mapping[str, str]) -> None:
    """Put version 1.0 of a package into a folder: ``entry_points`` by group and name, texts of ``modules`` by file."""
    for file, text in modules.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text)
    information = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    groups = ("\n".join([f"[{group}]", *(f"{key} = {target}" for key, target in points.items())])
              for group, points in entry_points.items())  # fmt: skip
    (information / "entry_points.txt").write_text("\n\n".join(groups) + "\n")


def with_packages(folder: Path) -> dict[str, str]:
    """The environment of a process that finds what is installed in a folder, besides what this one finds."""
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    return os.environ | {"PYTHONPATH": path, "COLUMNS": "100"}


def python(folder: Path, script: str, *words: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a script where the packages of a folder are installed; by default in that folder. No traceback is allowed."""
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, words)],
        cwd=cwd or folder,
        env=with_packages(folder),
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done


def spherloc(folder: Path, *words: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The same for the command ``spherloc``."""
    return python(folder, COMMAND, *words, cwd=cwd)


def spherloc_each(folder: Path, commands: Sequence[Sequence[str]]) -> list[subprocess.CompletedProcess[str]]:
    """The same for several commands in one process, since each start takes seconds."""
    done = python(folder, SEVERAL, json.dumps(commands))
    assert done.returncode == 0, done.stderr
    return [
        subprocess.CompletedProcess(words, code, output, errors)
        for words, (code, output, errors) in zip(commands, json.loads(done.stdout), strict=True)
    ]
