"""The command where a system lacks something: one sentence or nothing, never a traceback."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from spherloc import disk_cache, kernel_cache
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.proof import write_proof
from spherloc_viz.commands.cli import play
from spherloc_viz.commands.flags import refuse_repeated, refuse_second_folder
from spherloc_viz.commands.image_commands import localize
from spherloc_viz.commands.scene_commands import run, sweep
from tests.waiting import LIMIT_S

PROGRAM = [sys.executable, "-c", "from spherloc_viz.start import main\nmain()"]


def begin(*words: str | bytes, **given) -> subprocess.Popen[bytes]:
    """The command; ``environment`` among what is given adds to the usual one, and None takes away."""
    environment = {**os.environ, **given.pop("environment", {})}
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(
        [*PROGRAM, *words], env={k: v for k, v in environment.items() if v is not None}, **(streams | given)
    )


def in_shell(line: str, *words: str | Path) -> subprocess.Popen[bytes]:
    """The command with its first words within a line of a shell, called "$@"."""
    return subprocess.Popen(["sh", "-c", line, "sh", *PROGRAM, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_outputs_that_cannot_be_written(tmp_path: Path, scene_of: Callable[..., SyntheticScene]) -> None:
    """Side by side, since each takes a second or two: closed, full, gone, in ASCII, and for names that are no UTF-8."""
    name = b"caf\xe9.toml"
    (tmp_path / "long").mkdir()
    ascii_only = {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0"}
    few = scene_of("fisheye", correspondences=8, outlier_rate=0.25, noise_px=0.5)
    write_proof(estimate(few.problem(4), "mc-exact"), tmp_path / "proof.npz")
    brief = ("check-proof", tmp_path / "proof.npz")  # prints, and imports little
    started = {
        "closed output": in_shell('"$@" >&-', *brief),
        "all closed": in_shell('"$@" <&- >&- 2>&-', *brief),
        "full disk": in_shell('"$@" >/dev/full', *brief),
        "full disk for help": in_shell('"$@" scenes --help >/dev/full'),
        "a reader that goes": in_shell('"$@" | true', *brief),
        "all goes to a reader that goes": in_shell('"$@" 2>&1 | true', "check-proof", "/nowhere"),
        "ASCII, no home": begin("scenes", environment=ascii_only | {"HOME": None, "XDG_CACHE_HOME": None}),
        "no UTF-8": begin("check-proof", name, cwd=tmp_path),
        "no UTF-8, ASCII": begin("run", name, "--no-record", cwd=tmp_path, environment=ascii_only),
        "nothing to write into": begin(
            "scenes", environment={"TMPDIR": "/nowhere", "NUMBA_CACHE_DIR": "/proc/nowhere"}
        ),
    }
    ended = {what: (*process.communicate(timeout=LIMIT_S), process.returncode) for what, process in started.items()}
    for what, (out, error, _) in ended.items():
        assert b"Traceback" not in out + error and b"Exception ignored" not in out + error, f"{what}: {error.decode()}"
        assert error.count(b"\n") <= 1, f"{what}: {error.decode()}"
    codes = {what: code for what, (_, _, code) in ended.items()}
    assert codes["closed output"] == codes["all closed"] == codes["ASCII, no home"] == 0
    assert codes["full disk"] == codes["full disk for help"] == codes["no UTF-8, ASCII"] == 2
    assert b"No space left on device" in ended["full disk"][1]
    assert rb"caf\udce9.toml: no such file" in ended["no UTF-8, ASCII"][1]
    assert rb"caf\udce9.toml" in ended["no UTF-8"][1] and codes["no UTF-8"] == 1
    assert ended["ASCII, no home"][0].isascii() and b"panorama" in ended["ASCII, no home"][0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_importing_ends_it_without_a_word(number: signal.Signals) -> None:
    """The import takes a second, in which Ctrl-C was a traceback of a library's."""
    started = []
    for delay_s in (0.2, 0.6):
        process = begin("scenes")
        until_python_runs(process)
        time.sleep(delay_s)  # what it is at by then is up to the machine; it must be quiet whatever it is
        process.send_signal(number)
        started.append(process)
    for process in started:
        out, error = process.communicate(timeout=LIMIT_S)
        assert error == b"", error.decode()
        assert process.returncode in (-number, 128 + number) or (process.returncode == 0 and out)


def until_python_runs(process: subprocess.Popen[bytes]) -> None:
    """Wait until the process has loaded numpy: earlier Python itself, not the program, answers Ctrl-C."""
    maps = Path(f"/proc/{process.pid}/maps")
    while process.poll() is None and b"numpy" not in maps.read_bytes():
        time.sleep(0.01)


def test_kernels_where_nothing_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """numba refused every kernel: "no locator available". A folder below a file cannot be made, whoever asks."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "kernels"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    kernel_cache._temporary.cache_clear()
    assert not kernel_cache.is_temporary()
    folder = kernel_cache._first_writable(tmp_path / "file", "kernels-1")
    assert folder.parent.is_dir() and folder.parent.parent == tmp_path and kernel_cache.is_temporary()
    assert folder.parent.stat().st_mode & 0o077 == 0, "others could put their code there"
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder.parent), "a child would compile again"
    kernel_cache._temporary.cache_clear()
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert kernel_cache._first_writable(tmp_path / "file", "kernels-1").is_relative_to(tmp_path / "cache")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "own"))
    assert kernel_cache._first_writable(tmp_path / "file", "kernels-1") == tmp_path / "own" / "kernels-1"


def test_a_user_without_a_home_has_a_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("SPHERLOC_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    folder = disk_cache.cache_folder("renders")
    assert disk_cache.store(folder / "a", b"x") and (folder / "a").read_bytes() == b"x"


@pytest.mark.parametrize(
    "words",
    [
        "run a.toml --estimator mc --estimator auto",
        "run a.toml --seed 1 --seed=2",
        "run a.toml --record --no-record",
        "run a.toml --keep-gigabytes 1 --keep_gigabytes 2",
        "localize a.toml --queries 1 --queries 2",
        "play --port 1 a.toml --port 2",
    ],
)
def test_a_flag_whose_first_value_would_be_lost_is_refused(words: str) -> None:
    with pytest.raises(InputError, match="is given 2 times; give it once"):
        refuse_repeated(words.split(), (run, localize, sweep, play))


def test_a_map_of_two_folders_is_refused_with_the_flags_for_the_second() -> None:
    with pytest.raises(InputError, match="'new' is a second one; give --localize new to localize its images"):
        refuse_second_folder(["map", "photos", "new", "--panorama"])
    for words in ("map", "map photos", "map photos --localize new", "map --output new photos", "run a.toml b.toml"):
        refuse_second_folder(words.split())


def test_flags_that_gather_and_words_that_are_no_flags_are_left_alone() -> None:
    for words in (
        "run a.toml --option x=1 --option y=2 --set a=1 --set b=2 --estimator mc",
        "sweep a.toml --estimator mc --estimator auto",
        "play --allow a --allow b",
        "run -- --seed --seed",
        "unknown --x --x",
    ):
        refuse_repeated(words.split(), (run, localize, sweep, play))
