"""Scene files: what is read from good ones, and the one sentence that bad ones get."""

import numpy as np
import pytest
from scene_texts import CSV, MEASURED, SYNTHETIC, write, write_measured

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.scene_file import read_table
from spherloc.errors import InputError

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def check_refused(path, names, *mentions):
    """One sentence on one line that names the file ``names`` and what is wrong."""
    with pytest.raises(InputError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith(str(path.parent / names)), message
    assert message.isprintable(), f"not one line of text: {message!r}"
    assert message.endswith(".") and len(message) < 600, message
    for mention in mentions:
        assert mention in message, message


def test_measured_scene_is_read(tmp_path):
    scene = load_scene(write_measured(tmp_path))
    problem = scene.problem()
    assert scene.name == problem.name == "measured"
    assert scene.camera == problem.camera == Equirectangular(200, 100)
    np.testing.assert_array_equal(problem.pixels, [[10.5, 20.5], [110.5, 60.25], [150.0, 30.0]])
    np.testing.assert_array_equal(problem.points, [[1.0, 2.0, 3.0], [-1.0, 0.5, 4.0], [2.0, -1.5, 0.25]])
    assert problem.truth_inliers is not None and problem.truth_inliers.tolist() == [True, False, True]
    np.testing.assert_array_equal(problem.gravity_camera, [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(problem.gravity_map, [0.0, 0.0, -1.0])
    np.testing.assert_array_equal(problem.truth_cam_from_map[:, 3], [0.5, 0.0, 2.0])
    assert problem.bound_px == 2.5 and problem.image is None
    assert str(tmp_path / "scene.toml") == problem.scene
    assert scene.problem(seed=3) is problem, "measurements have nothing random"


def test_what_is_optional(tmp_path):
    """No truth, no labels, no options; columns in any order with spaces, others ignored; Windows line ends and BOM."""
    scene = MEASURED[: MEASURED.index("[truth]")].replace("[camera]", 'about = "where it is from"\n[camera]', 1)
    matches = "\ufeffZ, quality ,Y,X,v, u\r\n3,9,2,1,20.5,10.5\r\n\r\n6,bad,5,4,30,40\r\n"
    problem = load_scene(write_measured(tmp_path, scene, matches)).problem()
    np.testing.assert_array_equal(problem.pixels, [[10.5, 20.5], [40.0, 30.0]])
    np.testing.assert_array_equal(problem.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    assert problem.truth_inliers is None and problem.truth_cam_from_map is None and problem.bound_px is None


def test_gravity_error_of_a_simulation(tmp_path):
    scene = load_scene(write(tmp_path, SYNTHETIC + "gravity_error_deg = 0.5\n"))
    problem = scene.problem()
    assert problem.gravity_bound_rad == pytest.approx(np.radians(1.5)) and "0.5 deg" in problem.scene
    assert load_scene(write(tmp_path, SYNTHETIC)).problem().gravity_bound_rad == 0.0


@pytest.mark.parametrize(
    "lines, bound_deg, sd_deg",
    [
        ("", 0.0, 0.0),
        ("bound_deg = 1.5", 1.5, 0.5),
        ("sd_deg = 2", 6.0, 2.0),
        ("bound_deg = 3\nsd_deg = 0.25", 3, 0.25),
    ],
)
def test_gravity_error_of_a_measured_scene(tmp_path, lines, bound_deg, sd_deg):
    """One of both gives the other."""
    problem = load_scene(write_measured(tmp_path, added(MEASURED, f"[gravity]{lines}"))).problem()
    assert np.degrees(problem.gravity_bound_rad) == pytest.approx(bound_deg)
    assert np.degrees(problem.aligned.gravity_sd_rad) == pytest.approx(sd_deg)


def test_image_is_found_beside_the_scene(tmp_path):
    (tmp_path / "photo.png").write_bytes(b"x")
    path = write_measured(tmp_path, MEASURED.replace("[camera]", 'image = "photo.png"\n[camera]', 1))
    assert load_scene(path).problem().image == tmp_path / "photo.png"


def test_bundled_scenes_load():
    scenes = bundled_scenes()
    assert {"mei_outliers_80", "fisheye_outliers_90", "panorama_outliers_80"} <= scenes.keys()
    for path in scenes.values():
        scene = load_scene(path)
        if isinstance(scene, MapScene):  # its images take a while to draw; tests of rendered scenes do that
            assert len(scene.queries) >= 4 and len(scene.references) >= 4 and not scene.remarks
        else:
            assert len(scene.problem()) >= 2


def test_real_scenes_load(aria):
    for path in sorted(aria.glob("*.toml")):
        problem = load_scene(path).problem()
        assert len(problem) > 700 and problem.image is not None and problem.truth_cam_from_map is not None


def replaced(text, old, new):
    assert old in text
    return text.replace(old, new, 1)


def added(text, line):
    """A line at the top level, or in the section that it names."""
    section, _, line = line.rpartition("]")
    return replaced(text, f"{section}]", f"{section}]\n{line}") if section else f"{line}\n{text}"


EITHER = {
    "unknown key": ("colour = 1", "unknown key 'colour'"),
    "unknown camera key": ("[camera]fov = 90", "'fov'", "unknown"),
}


def test_exchanged_coordinates_of_a_principal_point_are_told(tmp_path):
    lens = 'model = "eucm"\nwidth = 200\nheight = 100\nfx = 60\nfy = 60\ncx = {}\ncy = {}\nalpha = 0.5\nbeta = 1\n'
    panorama = 'model = "equirectangular"\nwidth = 200\nheight = 100\n'
    for place, told in (((50, 100), 1), ((100, 50), 0)):
        problem = load_scene(write_measured(tmp_path, MEASURED.replace(panorama, lens.format(*place)))).problem()
        assert len(problem.remarks) == told
    assert load_scene(write_measured(tmp_path)).problem().remarks == ()


SCENES = {"synthetic": SYNTHETIC, "measured": MEASURED}


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("case", EITHER)
def test_unknown_keys_of_both_kinds(tmp_path, kind, case):
    line, *mentions = EITHER[case]
    write_measured(tmp_path)
    check_refused(write(tmp_path, added(SCENES[kind], line)), "scene.toml", *mentions)


@pytest.mark.parametrize("section", ["gravity", "truth", "options"])
def test_unknown_keys_of_measured_sections(tmp_path, section):
    write_measured(tmp_path, added(MEASURED, f"[{section}]extra = 1"))
    check_refused(tmp_path / "scene.toml", "scene.toml", f"[{section}]", "unknown key 'extra'")


def test_unknown_keys_of_synthetic_sections(tmp_path):
    check_refused(write(tmp_path, added(SYNTHETIC, "[simulation]extra = 1")), "scene.toml", "[simulation]", "'extra'")
    with_options = SYNTHETIC + "\n[options]\nextra = 1\n"
    check_refused(write(tmp_path, with_options), "scene.toml", "[options]", "unknown key 'extra'")


BAD_TOML = {
    "empty": ("", "'kind'"),
    "no TOML": ("kind = ", "TOML"),
    "binary": (bytes(range(256)), "UTF-8"),
    "NUL bytes": (b"\0\0\0\0", "TOML"),
    "no kind": (SYNTHETIC.replace('kind = "synthetic"', ""), "'kind'"),
    "unknown kind": (replaced(SYNTHETIC, '"synthetic"', '"nothing"'), "unknown dataset 'nothing'", "synthetic"),
    "kind no text": (replaced(SYNTHETIC, '"synthetic"', "3"), "'kind'"),
    "kind of two lines": (replaced(SYNTHETIC, '"synthetic"', r'"a\nb"'), "kind"),
    "key of two lines": ('"a\\nb" = 1\n' + SYNTHETIC, "unknown key"),
    "too large": ("#" * 1_000_001, "larger than"),
    "deeply nested": ("a = " + "[" * 100_000, ""),
    "number of 5000 digits": (replaced(SYNTHETIC, "seed = 4", "seed = " + "9" * 5000), ""),
    "hexadecimal number of 5000 digits": (replaced(SYNTHETIC, "seed = 4", "seed = 0x" + "f" * 5000), "seed"),
    "huge noise": (replaced(SYNTHETIC, "noise_px = 0.5", "noise_px = 0x" + "f" * 5000), "noise_px"),
    "no name": (SYNTHETIC.replace('name = "little"', ""), "'name'"),
    "empty name": (replaced(SYNTHETIC, '"little"', '""'), "'name'"),
    "no camera": (SYNTHETIC[: SYNTHETIC.index("[camera]")] + SYNTHETIC[SYNTHETIC.index("[simulation]") :], "'camera'"),
    "camera no section": ("camera = 1\n" + SYNTHETIC.replace("[camera]", "[lens]"), "camera"),
    "unknown model": (replaced(SYNTHETIC, '"equirectangular"', '"fishbowl"'), "'fishbowl'", "mei"),
    "zero width": (replaced(SYNTHETIC, "width = 200", "width = 0"), "'width'"),
    "no seed": (replaced(SYNTHETIC, "seed = 4", ""), "'seed'", "missing"),
    "negative seed": (replaced(SYNTHETIC, "seed = 4", "seed = -4"), "seed is -4"),
    "fractional seed": (replaced(SYNTHETIC, "seed = 4", "seed = 4.5"), "seed is 4.5"),
    "one correspondence": (replaced(SYNTHETIC, "correspondences = 10", "correspondences = 1"), "correspondences is 1"),
    "too many": (replaced(SYNTHETIC, "correspondences = 10", "correspondences = 10001"), "correspondences is 10001"),
    "true": (replaced(SYNTHETIC, "correspondences = 10", "correspondences = true"), "correspondences is True"),
    "rate above one": (replaced(SYNTHETIC, "outlier_rate = 0.3", "outlier_rate = 1.5"), "outlier_rate is 1.5"),
    "rate NaN": (replaced(SYNTHETIC, "outlier_rate = 0.3", "outlier_rate = nan"), "outlier_rate is nan"),
    "noise text": (replaced(SYNTHETIC, "noise_px = 0.5", 'noise_px = "0.5"'), "noise_px is '0.5'"),
    "gravity error below zero": (SYNTHETIC + "gravity_error_deg = -1", "gravity_error_deg is -1"),
    "gravity error text": (SYNTHETIC + "gravity_error_deg = 'small'", "gravity_error_deg is 'small'"),
    "bound zero": (SYNTHETIC + "[options]\nbound_px = 0", "bound_px is 0"),
    "bound infinite": (SYNTHETIC + "[options]\nbound_px = inf", "bound_px is inf"),
    "options no section": ("options = 3\n" + SYNTHETIC, "'options'"),
    "bound list": (SYNTHETIC + f"[options]\nbound_px = {[1] * 2000}", "bound_px"),
}


@pytest.mark.parametrize("case", BAD_TOML)
def test_bad_scene_is_refused(tmp_path, case):
    text, *mentions = BAD_TOML[case]
    check_refused(write(tmp_path, text), "scene.toml", *mentions)


BAD_MEASURED = {
    "no gravity": (MEASURED[: MEASURED.index("[gravity]")], "'gravity'"),
    "gravity half": (replaced(MEASURED, "map = [0.0, 0.0, -1.0]", ""), "[gravity]", "'map'"),
    "gravity of two numbers": (replaced(MEASURED, "[0.0, 1.0, 0.0]", "[0.0, 1.0]"), "[gravity]", "camera", "3"),
    "gravity of four numbers": (replaced(MEASURED, "[0.0, 0.0, -1.0]", "[0.0, 0.0, 1.0, 0.0]"), "[gravity]", "map"),
    "gravity ragged": (replaced(MEASURED, "[0.0, 1.0, 0.0]", "[0.0, [1.0], 0.0]"), "[gravity]", "camera"),
    "gravity NaN": (replaced(MEASURED, "[0.0, 1.0, 0.0]", "[0.0, nan, 0.0]"), "[gravity]", "camera"),
    "gravity texts": (replaced(MEASURED, "[0.0, 1.0, 0.0]", '["0", "1", "0"]'), "[gravity]", "camera"),
    "gravity true": (replaced(MEASURED, "[0.0, 1.0, 0.0]", "[false, true, false]"), "[gravity]", "camera"),
    "gravity huge": (replaced(MEASURED, "[0.0, 1.0, 0.0]", f"[0, {10**400}, 0]"), "[gravity]", "camera"),
    "gravity in m/s2": (replaced(MEASURED, "[0.0, 1.0, 0.0]", "[0.0, 9.81, 0.0]"), "length 9.81"),
    "gravity bound text": (replaced(MEASURED, "[gravity]", "[gravity]\nbound_deg = '1'"), "bound_deg is '1'"),
    "gravity bound below zero": (replaced(MEASURED, "[gravity]", "[gravity]\nbound_deg = -1"), "bound_deg is -1"),
    "gravity bound too large": (replaced(MEASURED, "[gravity]", "[gravity]\nbound_deg = 91"), "bound_deg is 91"),
    "gravity bound of 90": (replaced(MEASURED, "[gravity]", "[gravity]\nbound_deg = 90"), "gravity_bound_rad is"),
    "gravity sd NaN": (replaced(MEASURED, "[gravity]", "[gravity]\nsd_deg = nan"), "sd_deg is nan"),
    "gravity sd too large": (replaced(MEASURED, "[gravity]", "[gravity]\nsd_deg = 40"), "gravity_bound_rad is"),
    "gravity no section": ("gravity = 1\n" + MEASURED.replace("[gravity]", "[other]"), "gravity"),
    "truth of two rows": (replaced(MEASURED, ", [0.0, 0.0, 1.0, 2.0]]", "]"), "[truth]", "3 x 4"),
    "truth no rotation": (replaced(MEASURED, "[[1.0,", "[[2.0,"), "rotation"),
    "truth mirrored": (replaced(MEASURED, "[[1.0,", "[[-1.0,"), "rotation"),
    "no CSV key": (replaced(MEASURED, 'correspondences = "matches.csv"', ""), "'correspondences'"),
    "CSV key no text": (replaced(MEASURED, '"matches.csv"', "7"), "'correspondences'"),
    "missing image": (replaced(MEASURED, "[camera]", 'image = "none.png"\n[camera]'), "none.png", "does not exist"),
    "image with NUL": (replaced(MEASURED, "[camera]", 'image = "a\\u0000b"\n[camera]'), "image"),
    "image of two lines": (replaced(MEASURED, "[camera]", 'image = "a\\nb"\n[camera]'), "image"),
    "image no text": (replaced(MEASURED, "[camera]", "image = 1\n[camera]"), "'image'"),
    "name of two lines": (
        replaced(MEASURED, "[0.0, 1.0, 0.0]", "[0.0, 2.0, 0.0]").replace("measured", "a\\nb"),
        "length 2",
    ),
    "bound_px text": (replaced(MEASURED, "bound_px = 2.5", 'bound_px = "2.5"'), "bound_px"),
}


@pytest.mark.parametrize("case", BAD_MEASURED)
def test_bad_measured_scene_is_refused(tmp_path, case):
    text, *mentions = BAD_MEASURED[case]
    check_refused(write_measured(tmp_path, text), "scene.toml", *mentions)


BAD_CSV = {
    "empty": ("", "column 'u'"),
    "no header": (CSV[CSV.index("\n") + 1 :], "column 'u'"),
    "missing column": (CSV.replace("Y", "y"), "column 'Y' is missing"),
    "column twice": (CSV.replace("note", "u"), "column 'u' is given twice"),
    "labels twice": (CSV.replace("note", "inlier"), "column 'inlier' is given twice"),
    "NaN": (CSV.replace("-1.5", "nan"), "line 4", "Y is", "nan"),
    "infinity": (CSV.replace("60.25", "-inf"), "line 3", "v is", "-inf"),
    "text": (CSV.replace("60.25", "sixty"), "line 3", "v is 'sixty'"),
    "empty value": (CSV.replace("60.25", ""), "line 3", "v is ''"),
    "short row": (CSV.replace(",0.25,1,", ",1,"), "line 4", "6 values under 7 columns"),
    "long row": (CSV.replace("first", "first,second"), "line 2", "8 values under 7 columns"),
    "label 2": (CSV.replace("4.0,0,", "4.0,2,"), "line 3", "inlier is '2'"),
    "label true": (CSV.replace("4.0,0,", "4.0,true,"), "line 3", "inlier is 'true'"),
    "label empty": (CSV.replace("4.0,0,", "4.0,,"), "line 3", "inlier is ''"),
    "binary": (bytes(range(256)), "UTF-8"),
    "Latin-1": (CSV.replace("first", "première").encode("latin-1"), "UTF-8"),
    "cell of two lines": (CSV.replace("60.25", '"6\n0"'), "v is"),
    "label of two lines": (CSV.replace("4.0,0,", '4.0,"0\n1",'), "inlier is"),
    "control characters": (CSV.replace("60.25", "6\x1b[31m0"), "line 3", "v is"),
    "NUL": (CSV.replace("60.25", "6\x000"), ""),
    "huge field": (CSV.replace("first", "x" * 200_000), ""),
    "open quote": (CSV.replace("first", '"first'), ""),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_bad_csv_is_refused(tmp_path, case):
    text, *mentions = BAD_CSV[case]
    check_refused(write_measured(tmp_path, matches=text), "matches.csv", *mentions)


@pytest.mark.parametrize("rows", [0, 1])
def test_too_few_rows(tmp_path, rows):
    path = write_measured(tmp_path, matches="".join(CSV.splitlines(True)[: rows + 1]))
    check_refused(path, "scene.toml", f"{rows} usable of {rows}")


def test_pixels_outside_the_image(tmp_path):
    path = write_measured(tmp_path, matches="u,v,X,Y,Z\n500,20,1,2,3\n600,20,1,2,3\n50,20,1,2,3\n")
    check_refused(path, "scene.toml", "1 usable of 3")


def test_missing_scene(tmp_path):
    check_refused(tmp_path / "none.toml", "none.toml", "no such file")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (r'images = "C:\photos\a.jpg"', "line 3 has a backslash in double quotes"),
        (r'images = "C:\Users\a"', "line 3 has a backslash in double quotes"),
        (r'images = "D:\temp\new"', "'images' has a backslash in double quotes"),
        ('[[references]]\nimage = "old\\new.jpg"', "'image' has a backslash in double quotes"),
    ],
)
def test_a_windows_path_in_double_quotes(tmp_path, line, said):
    path = tmp_path / "scene.toml"
    path.write_text(f'kind = "image-folder"\nname = "a"\n{line}\n')
    with pytest.raises(InputError) as raised:
        load_scene(path)
    assert said in str(raised.value) and "forward slashes, or in single quotes" in str(raised.value)


def test_texts_and_names_that_are_there_may_have_escapes(tmp_path):
    path = tmp_path / "scene.toml"
    (tmp_path / "a\tb").mkdir()
    path.write_text('kind = "x"\nname = "a\\tb"\nabout = "a\\nb"\nimages = "a\\tb"\nfile = \'C:\\temp\'\n')
    story = tmp_path / "story.toml"
    story.write_text('story = """\nOne.\nTwo."""\n')
    assert read_table(story) == {"story": "One.\nTwo."}
    assert read_table(path)["images"] == "a\tb" and read_table(path)["file"] == r"C:\temp"


def test_scene_is_a_folder(tmp_path):
    (tmp_path / "scene.toml").mkdir()
    check_refused(tmp_path / "scene.toml", "scene.toml", "is an empty folder")


def test_path_with_nul(tmp_path):
    """From the command line or a page: an odd path is still only a wrong path."""
    with pytest.raises(InputError):
        load_scene(tmp_path / "a\0b.toml")


def test_missing_csv(tmp_path):
    check_refused(write_measured(tmp_path, matches=None), "matches.csv", "no such file")


def test_csv_is_a_folder(tmp_path):
    (tmp_path / "matches.csv").mkdir()
    check_refused(write_measured(tmp_path, matches=None), "matches.csv", "cannot be read")


@pytest.mark.parametrize("name", [r"a\u0000b", r"a\nb", "x" * 5000])
def test_odd_csv_names(tmp_path, name):
    path = write_measured(tmp_path, replaced(MEASURED, "matches.csv", name))
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert str(caught.value).isprintable()
