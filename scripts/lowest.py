"""Prints the lowest version of every dependency that pyproject.toml admits, as constraints for pip.

python3.11 -m venv build/lowest
python3.11 scripts/lowest.py > build/lowest.txt
build/lowest/bin/python -m pip install -e '.[test]' -c build/lowest.txt
build/lowest/bin/python -m pytest -n 2 --dist loadfile -m 'not browser'
"""

import re
import tomllib
from pathlib import Path


def lowest(requirements: list[str]) -> set[str]:
    """``{"numpy==2.0"}`` of ``["numpy>=2.0,<3"]``.  Raises ValueError for a requirement without a lower bound."""
    pins = set()
    for requirement in requirements:
        parts = re.match(r"(?P<name>[\w.-]+)(\[.*\])?>=(?P<version>[\w.]+)", requirement)
        if parts is None:
            raise ValueError(f"pyproject.toml: {requirement!r} says no lowest version; write NAME>=VERSION.")
        pins.add(f"{parts['name']}=={parts['version']}")
    return pins


if __name__ == "__main__":
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    print("\n".join(sorted(lowest(project["dependencies"] + extras["test"]))))
