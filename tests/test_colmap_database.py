"""COLMAP's database says what its localizer had to go by, also for images that it could not register."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from cli_process import spherloc_here
from recording_samples import scene_problem

from spherloc.errors import InputError
from spherloc.formats.colmap_database import DatabaseQuery, read_queries_of_database
from spherloc.formats.colmap_files import read_model
from spherloc.trajectory import wxyz_from_rotation
from spherloc.types import FloatArray
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.replay import repeat

pycolmap = pytest.importorskip("pycolmap")
PROBLEM = scene_problem("panorama_outliers_80")
SIZE = (PROBLEM.camera.width, PROBLEM.camera.height)


def line(name: str, number: int, pose: FloatArray) -> str:
    numbers = (*wxyz_from_rotation(pose[:, :3]), *pose[:, 3])
    return f"{number} {' '.join(repr(float(x)) for x in numbers)} 1 {name}\n"


def write_model(folder: Path, images: list[str], observations: str) -> Path:
    """A model in COLMAP's text form of these images, of which the first has the observations."""
    folder.mkdir()
    (folder / "cameras.txt").write_text(f"1 EQUIRECTANGULAR {SIZE[0]} {SIZE[1]} {SIZE[0]} {SIZE[1]}\n")
    (folder / "images.txt").write_text("".join([images[0], observations + "\n", *(f"{one}\n" for one in images[1:])]))
    points = [f"{k} {x!r} {y!r} {z!r} 0 0 0 1 2 {k}\n" for k, (x, y, z) in enumerate(PROBLEM.points.tolist())]
    (folder / "points3D.txt").write_text("".join(points))
    return folder


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A map of m.jpg, a model that has q.jpg too, and a database that also has lost.jpg, which is not registered."""
    count, pose = len(PROBLEM), PROBLEM.truth_cam_from_map
    assert pose is not None
    observations = " ".join(f"{k}.5 7.5 {k}" for k in range(count)) + " 3 4 -1"
    reference = line("m.jpg", 2, np.eye(3, 4))
    write_model(tmp_path / "map", [reference], observations)
    write_model(tmp_path / "both", [reference, line("q.jpg", 1, pose)], observations)
    database = pycolmap.Database.open(str(tmp_path / "database.db"))
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=SIZE[0], height=SIZE[1], params=[*map(float, SIZE)])
    camera.camera_id = database.write_camera(camera)
    # The reference stands between the two queries, so that one pair has it second and the other one first.
    ids = {
        name: database.write_image(pycolmap.Image(name=name, camera_id=camera.camera_id))
        for name in ("q.jpg", "m.jpg", "lost.jpg")
    }
    reference_pixels = np.array([[k + 0.5, 7.5] for k in range(count)] + [[3.0, 4.0]])
    for name, pixels in (("q.jpg", PROBLEM.pixels), ("m.jpg", reference_pixels), ("lost.jpg", PROBLEM.pixels[::-1])):
        database.write_keypoints(ids[name], np.ascontiguousarray(pixels, dtype=np.float32))
    same = np.arange(count, dtype=np.uint32)
    pairs = {
        ("q.jpg", "m.jpg"): np.column_stack([same, same]),
        # The last keypoint of the reference has no point.
        ("m.jpg", "lost.jpg"): np.vstack([np.column_stack([same, same[::-1]]), [[count, 0]]]).astype(np.uint32),
    }
    for (one, other), matched in pairs.items():
        geometry = pycolmap.TwoViewGeometry(config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
        geometry.inlier_matches = np.ascontiguousarray(matched)
        database.write_two_view_geometry(ids[one], ids[other], geometry)
    database.close()
    return tmp_path


def test_queries_have_the_matches_that_colmap_verified(project: Path) -> None:
    found = read_queries_of_database(project / "database.db", read_model(project / "map"))
    assert list(found) == ["lost.jpg", "q.jpg"]
    for query in found.values():
        assert isinstance(query, DatabaseQuery) and (query.camera.width, query.camera.height) == SIZE
        order = np.lexsort(query.points.T), np.lexsort(PROBLEM.points.T)
        np.testing.assert_allclose(query.points[order[0]], PROBLEM.points[order[1]], atol=1e-12)
        np.testing.assert_allclose(query.pixels[order[0]], PROBLEM.pixels[order[1]], rtol=1e-6)


def test_what_colmap_could_not_register_is_solved_and_diagnosed(project: Path) -> None:
    files = ["both", "--model", "map", "--database", "database.db", "--recordings", "runs"]
    files += ["--map-down", *(repr(float(x)) for x in PROBLEM.gravity_map)]
    done = spherloc_here("diagnose", *files, cwd=project)
    assert "1 queries have no pose, such as 'lost.jpg'; give --gravity" in done.stderr, done.stderr
    assert "q.jpg: " in done.stdout and "lost.jpg: " not in done.stdout
    down = " ".join(repr(float(x)) for x in PROBLEM.gravity_camera)
    (project / "gravity.txt").write_text(f"q.jpg {down} 0.1\nlost.jpg {down} 0.1\n")
    done = spherloc_here("diagnose", *files, "--gravity", "gravity.txt", "--label", "colmap", cwd=project)
    assert done.returncode == 0 and "lost.jpg: no pose was given, auto finds one" in done.stdout, done.stderr
    runs = [path for path in (project / "runs").glob("*.rrd") if ".review." not in path.name]
    assert {read_recording(path).row.name for path in runs} == {"q.jpg", "lost.jpg"}
    assert all(repeat(path).same for path in runs)
    done = spherloc_here("diagnose", "both", "--database", "database.db", cwd=project)
    assert done.returncode == 2 and "goes with --database" in done.stderr


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("DROP TABLE images", "no such table"),
        ("DELETE FROM images WHERE name = 'm.jpg'", "has no image 'm.jpg' of the map"),
        ("DELETE FROM keypoints WHERE image_id = 1", "'q.jpg': has no keypoints"),
        ("UPDATE keypoints SET rows = rows + 1", "not as long as it says"),
        ("UPDATE keypoints SET rows = -1", "of an impossible size"),
        ("UPDATE two_view_geometries SET cols = 3", "of an impossible size"),
        ("UPDATE two_view_geometries SET data = zeroblob(length(data) - 1) || x'ff'", "of an impossible size"),
        ("UPDATE two_view_geometries SET data = CAST(zeroblob(length(data) - 1) || x'ff' AS BLOB)", "keypoints that"),
        ("UPDATE cameras SET model = 99", "its model is unknown"),
        ("UPDATE cameras SET params = x'00'", "does not have the 2 parameters of EQUIRECTANGULAR"),
    ],
)
def test_damaged_databases_are_a_sentence(project: Path, statement: str, said: str) -> None:
    with sqlite3.connect(project / "database.db") as database:
        database.execute(statement)
    database.close()
    told: list[str]
    try:
        found = read_queries_of_database(project / "database.db", read_model(project / "map"))
        told = [str(error) for error in found.values() if isinstance(error, InputError)]
    except InputError as error:
        told = [str(error)]
    assert any(said in one for one in told), told
    assert all(one.startswith(str(project / "database.db")) and one.isprintable() for one in told)


def test_another_file_is_no_database(tmp_path: Path, project: Path) -> None:
    (tmp_path / "text.db").write_text("no database" * 100)
    model = read_model(project / "map")
    for name, said in (("text.db", "is not a COLMAP database"), ("gone.db", "no such file"), ("map", "a folder")):
        with pytest.raises(InputError, match=said):
            read_queries_of_database(tmp_path / name, model)
