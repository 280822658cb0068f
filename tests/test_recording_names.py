"""Names of recordings that a page, an index or an archive tells lead to files of the folder only."""

import os
from pathlib import Path

import pytest

from spherloc.errors import RecordingError
from spherloc_viz.recording.reviews import review_path, reviewed_name
from spherloc_viz.recording.sandbox.examiner import check_name, resolve_inside


def test_names_of_recordings(tmp_path: Path) -> None:
    for name in ("run.rrd", "20260101T120000Z_a-b.c_mc_0_1a2b3c4d.rrd", "gallery/seam.rrd", "A.RRD"):
        assert check_name(name) == name


NO_NAMES = r"""
../run.rrd /etc/run.rrd gallery/../run.rrd other/run.rrd gallery//run.rrd gallery/gallery/run.rrd run.rd run .rrd
run.rrd/ ./run.rrd C:\run.rrd gallery\run.rrd run.rrd;ls $(ls).rrd %2e%2e%2frun.rrd ünicode.rrd run.rrd?x ~/run.rrd
<b>.rrd runs.sqlite run.rrd.part
"""


@pytest.mark.parametrize("name", [*NO_NAMES.split(), "", "a b.rrd", "run.rrd\n", "run\0.rrd", "x" * 300 + ".rrd"])
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(RecordingError) as error:
        resolve_inside(tmp_path, name)
    assert str(error.value).isprintable() and len(str(error.value)) < 300


def test_names_are_found_in_their_folder_only(tmp_path: Path) -> None:
    folder, outside = tmp_path / "recordings", tmp_path / "secret.rrd"
    (folder / "gallery").mkdir(parents=True)
    outside.touch()
    inside = [folder / "run.rrd", folder / "gallery" / "seam.rrd"]
    for path in inside:
        path.touch()
        assert resolve_inside(folder, str(path.relative_to(folder))) == path
    (folder / "link.rrd").symlink_to("run.rrd")
    assert resolve_inside(folder, "link.rrd").samefile(inside[0])
    (folder / "out.rrd").symlink_to(outside)
    (folder / "loop.rrd").symlink_to("loop.rrd")
    (folder / "folder.rrd").mkdir()
    os.mkfifo(folder / "pipe.rrd")
    for name in ("out.rrd", "loop.rrd", "folder.rrd", "pipe.rrd", "missing.rrd"):
        with pytest.raises(RecordingError, match="no such recording"):
            resolve_inside(folder, name)


def test_the_name_of_a_review_tells_its_recording() -> None:
    for name in ("run.rrd", "RUN.RRD", "run.Rrd", "a.b.rrd", "gallery/seam.rrd"):
        assert reviewed_name(review_path(Path(name)).as_posix()) == name


def test_a_gallery_elsewhere_is_not_followed(tmp_path: Path) -> None:
    folder, outside = tmp_path / "recordings", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (outside / "run.rrd").touch()
    (folder / "gallery").symlink_to(outside)
    with pytest.raises(RecordingError, match="no such recording"):
        resolve_inside(folder, "gallery/run.rrd")
