"""Where the command line begins: what must be right before anything large is imported."""

import os
import signal
import sys

from spherloc_viz.overview import answer


def main() -> None:
    """Entry point of ``spherloc``.

    Ctrl-C ends it without a word as long as it has nothing to keep, while it is importing and after its work is done.
    """
    _fill_standard_streams()
    told = answer(sys.argv[1:])
    if told is not None:
        _print(told[0])
        sys.exit(told[1])
    heard = signal.getsignal(signal.SIGINT)
    if heard is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        from spherloc_viz import cli
    except OSError as error:  # no folder for temporary files
        why = f"cannot start ({error.strerror}); make room on the disk, or set TMPDIR to another folder."
        print(f"spherloc: {why}", file=sys.stderr)
        sys.exit(2)
    signal.signal(signal.SIGINT, heard)
    try:
        cli.main()
    finally:
        if heard is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _print(text: str) -> None:
    """Print without a buffer, so that nothing is left to be written when Python ends; exits if that fails."""
    try:
        os.write(sys.stdout.fileno(), f"{text}\n".encode())
    except BrokenPipeError:
        sys.exit(141)
    except OSError as error:
        print(f"spherloc: the output cannot be written ({error.strerror}); check the disk.", file=sys.stderr)
        sys.exit(2)


def _fill_standard_streams() -> None:
    """Put the null device where a standard stream is closed: else the next file that is opened would get its number,
    and what is printed would be written into it."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            if opened != number:
                os.dup2(opened, number)
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", errors="backslashreplace"))
