"""Makes a map in a process of its own and tells of it in lines of JSON: what a page that started it reads.

``python -m spherloc_viz.map_job FOLDER OUTPUT``. Lines are {"kind", "done", "count"} as it goes on, and at the end
{"scene", "summary"} or {"error"}. A termination signal ends it; what was done is kept and not done again.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

from spherloc.errors import SpherlocError
from spherloc.mapping.make import Measured, make_map
from spherloc.mapping.photographs import photographs
from spherloc_viz.map_command import REPORT, summary
from spherloc_viz.map_report import map_report


def main(folder: Path, output: Path) -> int:
    """Make the map of a folder's photographs."""
    try:
        found = photographs(folder, None)
        made = make_map(found.views, folder, output, Measured(), None, _progress)
        (output / REPORT).write_text(map_report(made, found), encoding="utf-8")
    except SpherlocError as error:
        _tell({"error": str(error)})
        return 1
    except OSError as error:
        _tell({"error": f"{output}: cannot be written ({error.strerror})."})
        return 1
    _tell({"scene": str(made.written.scene), "summary": [*found.remarks, *summary(made, found)]})
    return 0


def _progress(kind: str, done: int, count: int) -> None:
    _tell({"kind": kind, "done": done, "count": count})


def _tell(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    if hasattr(os, "nice"):
        os.nice(5)  # the page that started it goes before
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
