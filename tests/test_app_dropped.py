"""Photographs that are dropped onto a page: names and limits, and that nothing half is left."""

import asyncio
import errno
import io
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from spherloc.datasets import bundled_scenes
from spherloc.errors import InputError
from spherloc_viz.app.panels import dropped as dropped_module
from spherloc_viz.app.panels.dropped import MAX_ALL_BYTES, MAX_DEEP, MAX_FILES, DroppedFiles, most_bytes, safe_parts
from spherloc_viz.app.server import kept_folder
from spherloc_viz.app.web.access import Role
from spherloc_viz.app.web.drops import DROPS, DropRoom, NotTakenError
from tests.test_app_front_door import door_to
from tests.waiting import LIMIT_S


class Drop(DroppedFiles):
    """One page's, with the folders that are done."""

    def __init__(self, *homes: Path) -> None:
        self.kept: list[Path] = []
        super().__init__(lambda: tuple(lambda home=home: home for home in homes), self.kept.append)

    def send(self, name: str, content: bytes = b"bytes") -> None:
        file = self.open(name)
        file.write(content)
        file.close()


@pytest.fixture
def home(tmp_path: Path) -> Path:
    folder = tmp_path / "home"
    folder.mkdir()
    return folder


@pytest.fixture
def drop(home: Path) -> Iterator[Drop]:
    made = Drop(home)
    yield made
    made.close()


@pytest.mark.parametrize("by", ["the next drop", "the next start"])
def test_what_a_killed_playground_left_goes(by: str, home: Path, tmp_path: Path) -> None:
    """Folders of others, of living processes and behind links stay."""
    kill_in_a_drop = (
        "import os, signal, sys; from pathlib import Path; from spherloc_viz.app.panels.dropped import DroppedFiles;"
        "drop = DroppedFiles(lambda: (lambda: Path(sys.argv[1]),), print); drop.begin('rooms', 2, 10);"
        "drop.open('a.jpg').write(b'half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", kill_in_a_drop, home], check=False).returncode == -signal.SIGKILL
    (left,) = home.iterdir()
    assert (left / "a.jpg").read_bytes() == b"half"
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept.jpg").touch()
    (left / "link").symlink_to(outside)
    link = home / f"{left.name[:-1]}{'1' if left.name[-1] == '0' else '0'}"
    link.symlink_to(outside)
    others = {link, home / ".dropped-notes", home / f".dropped-{'0' * 16}"}
    for other in others - {link}:
        other.mkdir()
    drop = Drop(home)
    if by == "the next drop":
        drop.begin("street", 1, 10)
    else:
        DropRoom(home)
    assert not left.exists() and (outside / "kept.jpg").exists() and others <= set(home.iterdir())
    alive = set(home.iterdir())
    DropRoom(home)
    assert set(home.iterdir()) == alive, "that of a living process stays"
    drop.close()


@pytest.mark.parametrize(
    "name", ["a.jpg", "A b (1).JPEG", "cam0/data/1.png", "küche.tif", "sensor.yaml", "gravity.csv"]
)
def test_usual_names_are_kept_as_they_are(name: str) -> None:
    assert "/".join(safe_parts(name)) == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        "/a.jpg",
        "../a.jpg",
        "a/../../a.jpg",
        "a//a.jpg",
        "./a.jpg",
        ".a.jpg",
        ".git/a.jpg",
        "a\\..\\a.jpg",
        "C:a.jpg",
        "a.jpg:stream.png",
        "a.jpg\0",
        "a\n.jpg",
        "\u202egpj.jpg",
        "\udc80.jpg",
        "a.jpg.",
        "a /b.jpg",
        "con.jpg",
        "NUL/a.jpg",
        "a.py",
        "a",
        "jpg",
        "scene.rrd",
        f"{'a' * 300}.jpg",
        "/".join("a" * MAX_DEEP) + "/a.jpg",
    ],
)
def test_other_names_are_not_taken(drop: Drop, home: Path, name: str) -> None:
    drop.begin("rooms", 1, 5)
    with pytest.raises(NotTakenError) as refused:
        drop.open(name)
    assert str(refused.value).endswith(".") and "\n" not in str(refused.value)
    drop.send("b.jpg")
    drop.end()
    assert [path.name for path in (home / "dropped_rooms").rglob("*")] == ["b.jpg"]
    assert [path.name for path in home.parent.iterdir()] == ["home"]


def test_a_folder_gets_a_free_name_once_it_is_whole(drop: Drop, home: Path) -> None:
    (home / "dropped_my_rooms_2_map").mkdir()
    for number in range(2):
        drop.begin("my rooms/../", 2, 10)
        drop.send("a.jpg", b"12345")
        assert len(list(home.glob("dropped*/a.jpg"))) == number, "hidden until all is there"
        drop.send("right/b.png", b"")
        drop.end()
    assert [path.name for path in drop.kept] == ["dropped_my_rooms", "dropped_my_rooms_3"]
    assert (drop.kept[1] / "a.jpg").read_bytes() == b"12345" and (drop.kept[1] / "right" / "b.png").is_file()
    drop.begin("..", 1, 5)
    drop.send("a.jpg")
    drop.end()
    assert drop.kept[2].name == "dropped_photographs" and drop.kept[2].parent == home


def test_no_file_takes_the_place_of_another(drop: Drop) -> None:
    drop.begin("", 2, 10)
    drop.send("a.jpg", b"first")
    for name in ("a.jpg", "a.jpg/b.jpg"):
        with pytest.raises(NotTakenError, match=r"called as another"):
            drop.open(name)
    drop.end()
    assert (drop.kept[0] / "a.jpg").read_bytes() == b"first"


@pytest.mark.parametrize("count, size", [(0, 0), (1, -1), (MAX_FILES + 1, 5), (1, MAX_ALL_BYTES + 1), (-1, 5)])
def test_too_many_are_refused_before_any_is_sent(drop: Drop, home: Path, count: int, size: int) -> None:
    with pytest.raises(InputError, match=r"cannot be dropped at once; drop 2,000 files of 20 GB at most"):
        drop.begin("rooms", count, size)
    assert not list(home.iterdir())


def test_limits_hold_whatever_was_said(drop: Drop, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert most_bytes("a.yaml") < most_bytes("a.jpg")
    for limit, sentence in (("MAX_BYTES", "a.jpg: larger than 0 MB"), ("MAX_ALL_BYTES", "more than 0 GB")):
        drop.begin("rooms", 1, 5)
        with monkeypatch.context() as patch:
            patch.setattr(dropped_module, limit, 9)
            drop.send("b.jpg")
            file = drop.open("a.jpg")
            file.write(b"1234" if limit == "MAX_ALL_BYTES" else b"123456789")
            with pytest.raises(InputError, match=sentence):
                file.write(b"5")
        assert not list(home.iterdir())
    drop.begin("rooms", 1, 5)
    monkeypatch.setattr(dropped_module, "MAX_FILES", 1)
    drop.send("a.jpg")
    with pytest.raises(NotTakenError, match="more than 1 files"):
        drop.open("b.jpg")


def test_one_drop_and_one_file_at_a_time(drop: Drop, home: Path) -> None:
    with pytest.raises(InputError, match="no longer awaited"):
        drop.open("a.jpg")
    drop.begin("rooms", 2, 10)
    with pytest.raises(InputError, match="not all there"):
        drop.end()
    file = drop.open("a.jpg")
    with pytest.raises(InputError, match="another file is on its way"):
        drop.open("b.jpg")
    with pytest.raises(InputError, match="not all there"):
        drop.end()
    drop.cancel()
    with pytest.raises(InputError, match="no longer awaited"):
        file.write(b"more")
    file.close()
    assert not list(home.iterdir()) and not drop.kept
    drop.begin("rooms", 1, 5)
    drop.begin("others", 1, 5)
    assert len(list(home.iterdir())) == 1, "what is on its way still is given up"
    drop.close()
    assert not list(home.iterdir())
    with pytest.raises(InputError, match="has been closed"):
        drop.begin("rooms", 1, 5)


def test_what_breaks_off_late_takes_nothing_of_the_next_drop(drop: Drop, home: Path) -> None:
    """The server may hear only then that the page gave up a file."""
    drop.begin("rooms", 1, 5)
    late = drop.open("a.jpg")
    drop.begin("street", 1, 5)
    late.break_off()
    drop.send("b.jpg")
    drop.open("c.jpg").break_off()
    assert not list(home.iterdir()), "one of its own does"


def test_a_full_disk_leaves_nothing(drop: Drop, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(dropped_module.shutil, "disk_usage", lambda path: SimpleNamespace(free=2_000_000))
        with pytest.raises(InputError, match=r"have 5 MB, and the disk of the playground has 2 MB free; make room\."):
            drop.begin("rooms", 1, 5_000_000)
    assert not list(home.iterdir())
    drop.begin("rooms", 1, 5)
    file: Any = drop.open("a.jpg")

    class Full(io.BytesIO):
        def write(self, piece: Any) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    file.file.close()
    file.file = Full()
    with pytest.raises(InputError, match=r"a\.jpg: cannot be written \(No space left on device\), so none"):
        file.write(b"12345")
    assert not list(home.iterdir())


def test_where_nothing_can_be_written_the_next_folder_is_taken(tmp_path: Path, home: Path) -> None:
    drop = Drop(tmp_path / "gone", home)
    drop.begin("rooms", 1, 5)
    drop.send("a.jpg")
    drop.end()
    assert drop.kept == [home / "dropped_rooms"]
    with pytest.raises(InputError, match=r"no place for the photographs \(No such file or directory\); make room"):
        Drop(tmp_path / "gone").begin("rooms", 1, 5)


def test_the_folder_that_is_kept(tmp_path: Path) -> None:
    scene = tmp_path / "map" / "scene.toml"
    assert kept_folder(scene, [tmp_path, tmp_path / "other"]) == tmp_path
    assert kept_folder(scene, []) == scene.parent
    for without in (None, next(iter(bundled_scenes().values())), tmp_path / "run.rrd"):
        assert kept_folder(without, []) is None


def test_files_come_through_the_door_of_their_page_alone(drop: Drop, home: Path) -> None:
    room = DropRoom()
    address = room.take_for(drop)
    assert address.startswith(DROPS) and len(address) > 40

    async def visit() -> None:
        async with door_to(1, token=True, drops=room) as door:
            cookies = {role: f"{door.access._cookie}={token}" for role, token in door.access._tokens.items()}
            own = {"Cookie": cookies[Role.PRESENTER], "Origin": door.url.rstrip("/")}
            at = address.removeprefix("/")

            async def said(path: str, body: bytes = b"", sent: dict[str, str] = own) -> tuple[int, str]:
                answer = await door.post(path, body, **sent)
                return answer.status, await answer.text()

            begin = f"{at}begin?name=rooms&count=1&bytes=5"
            for wrong in (
                {"Origin": own["Origin"]},
                {"Cookie": own["Cookie"]},
                own | {"Origin": "http://evil.example"},
                own | {"Cookie": cookies[Role.AUDIENCE]},
            ):
                assert (await said(begin, sent=wrong))[0] == 403
            assert (await door.get(begin, **own)).status == 302, "only a POST changes anything"
            assert (await said(f"drop/{'x' * 43}/begin?count=1&bytes=5"))[0] == 404
            assert (await said(f"{at}nothing"))[0] == 404
            for digits in ("x", "-1", "1" * 20, "²"):
                assert (await said(f"{at}begin?name=rooms&count=1&bytes={digits}"))[0] == 409
            assert not list(home.iterdir())

            assert await said(begin) == (200, "")
            status, sentence = await said(f"{at}file?name=../a.jpg", b"12345")
            assert status == 422 and sentence.startswith("a.jpg: ")
            content = bytes(3_000_000) + b"end"
            assert await said(f"{at}file?name=sub/a.jpg", content) == (200, "")
            assert await said(f"{at}end") == (200, "")
            assert (drop.kept[0] / "sub" / "a.jpg").read_bytes() == content
            assert (await said(f"{at}end"))[0] == 409
            assert await said(begin) == (200, "") and await said(f"{at}cancel") == (200, "")
            assert await said(begin) == (200, "")
            status, sentence = await said(
                f"{at}file?name=a.jpg", b"none", own | {"Content-Encoding": "gzip", "Connection": "close"}
            )
            assert status == 409 and sentence.startswith("a file broke off") and len(list(home.iterdir())) == 1
            room.leave(address)
            assert (await said(begin))[0] == 404

    asyncio.run(asyncio.wait_for(visit(), LIMIT_S))
    assert [path.name for path in home.iterdir()] == ["dropped_rooms"]


def test_a_file_that_breaks_off_leaves_nothing(drop: Drop, home: Path) -> None:
    room = DropRoom()
    path = room.take_for(drop)

    async def visit() -> None:
        async with door_to(1, drops=room) as door:
            drop.begin("rooms", 1, 9_000)
            host = door.url.split("/")[2]
            _, writer = await asyncio.open_connection(*host.split(":"))
            head = (f"POST {path}file?name=a.jpg HTTP/1.1", f"Host: {host}", f"Origin: http://{host}")
            writer.write("\r\n".join((*head, "Content-Length: 9000", "", "half")).encode())
            await writer.drain()
            while not list(home.rglob("a.jpg")):
                await asyncio.sleep(0.01)
            writer.close()
            while list(home.iterdir()):
                await asyncio.sleep(0.01)

    asyncio.run(asyncio.wait_for(visit(), LIMIT_S))
    with pytest.raises(InputError, match="no longer awaited"):
        drop.open("b.jpg")
