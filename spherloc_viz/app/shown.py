"""The process that serves one run for ``spherloc_viz.show``.

Its first line on standard output is the page's address, or why there is none. It ends when standard input ends, which
is when the program that started it does.
"""

import os
import shutil
import signal
import sys
import threading
from pathlib import Path

from spherloc.errors import SpherlocError
from spherloc_viz.app.server import serve

HOST = "127.0.0.1"


def main(file: Path) -> None:
    """Serve the recording ``file`` until standard input ends, then delete its folder."""
    threading.Thread(target=_end_with_input, args=(file,), daemon=True).start()
    try:
        serve(file, HOST, 0, file.parent / "recordings", record=False, framed=True, on_address=_tell)
    except SpherlocError as error:
        _tell(str(error))
        sys.exit(2)


def _tell(line: str) -> None:
    print(line, flush=True)


def _end_with_input(file: Path) -> None:
    sys.stdin.read()
    shutil.rmtree(file.parent, ignore_errors=True)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
