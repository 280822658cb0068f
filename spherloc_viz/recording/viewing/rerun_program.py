"""rerun's own program: where it is, and how it runs without sending usage data home."""

import os
import sys
from pathlib import Path

import rerun_cli


def rerun_command() -> list[str]:
    """The rerun program of this environment."""
    folder = Path(rerun_cli.__file__).parent
    program = folder / ("rerun.exe" if os.name == "nt" else "rerun")
    return [str(program)] if program.exists() else [sys.executable, "-m", "rerun_cli"]


def rerun_environment() -> dict[str, str]:
    """Our environment for rerun's program, in which it sends no usage data.

    It knows no switch for that but its user's own settings, which are not ours to change, and ``CI``.
    """
    environment = {name: value for name, value in os.environ.items() if name != "FORCE_RERUN_ANALYTICS"}
    return environment | {"CI": "true", "TELEMETRY_ENABLED": "false"}
