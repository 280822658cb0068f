"""The installed command: as a process, and within this one."""

import io
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from spherloc_viz.commands.cli import main
from tests.waiting import LIMIT_S

ROOT = Path(__file__).resolve().parents[1]
SCENE = ROOT / "scenes" / "mei_outliers_80.toml"


def spherloc(*words: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the installed console command."""
    program = Path(sys.executable).with_name("spherloc")
    environment = os.environ | {"COLUMNS": "100"}
    return subprocess.run(
        [program, *map(str, words)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        env=environment,
        check=False,
    )


def spherloc_here(*words: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The same within this process, for what it says and its exit code; a start would take seconds."""
    output, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(errors):
        patch.chdir(cwd)
        patch.setenv("COLUMNS", "100")
        patch.setattr(sys, "argv", ["spherloc", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
    code = ended.value.code or 0
    assert isinstance(code, int)
    return subprocess.CompletedProcess(sys.argv, code, output.getvalue(), errors.getvalue())


def one_sentence(result: subprocess.CompletedProcess[str]) -> str:
    """The error of a run that failed as a user's mistake should: exit code 2, one line, nothing on stdout."""
    assert result.returncode == 2, result
    assert result.stdout == ""
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("spherloc: ") and "Traceback" not in lines[0]
    return lines[0]
