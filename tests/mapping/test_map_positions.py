"""The scale of a map by positions of another source, some of them wrong; their files, and GPS in photographs."""

import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.geometry import so3_exp
from spherloc.mapping.alignment.positions import Positions, gps_of_images, local_metres, overlaid, read_positions
from spherloc.mapping.alignment.upright import Level, MapScale, scale_by_positions
from spherloc.mapping.kept_scale import keep_scale, kept_scale
from spherloc.mapping.request import ScaleMeasurement
from spherloc_viz.commands.map_report import other_units

CLOCK_S = 1_700_000_000
NAMES = [f"frame_{CLOCK_S + index}_{500_000_000 * (index % 2):09d}.jpg" for index in range(8)]
VIEWS = [View(name, Equirectangular(400, 200), Path(name)) for name in NAMES]


@pytest.mark.parametrize("size", [2, 3])
def test_scale_is_found_among_wrong_positions(rng, size):
    points = rng.normal(size=(40, size)) * [10.0, 8.0, 1.0][:size]
    turn = so3_exp(np.array([0.0, 0.0, 2.1] if size == 2 else [0.4, -1.0, 2.1]))[:size, :size]
    positions = 2.5 * points @ turn.T + np.array([7.0, -3.0, 100.0])[:size] + 0.05 * rng.normal(size=(40, size))
    wrong = rng.permutation(40) < 15
    positions[wrong] += rng.normal(size=(15, size)) * 20.0
    found = overlaid(points, positions)
    assert (
        found.scale == pytest.approx(2.5, rel=0.01) and not found.near[wrong].any() and found.near[~wrong].mean() > 0.8
    )
    assert found.off_m[~wrong].max() < 0.3 and found.off_m[wrong].min() > 0.3


def test_its_standard_deviation_is_that_of_repetitions(rng):
    """Of 100 draws of noise, without a wrong position."""
    points = rng.normal(size=(12, 3)) * 5.0
    fits = [overlaid(points, 3.0 * points + 0.2 * rng.normal(size=points.shape)) for _ in range(100)]
    scales = np.array([fit.scale for fit in fits])
    assert np.median([fit.scale_sd for fit in fits]) == pytest.approx(scales.std() / 3.0, rel=0.3)
    assert scales.mean() == pytest.approx(3.0, rel=0.01)


def test_positions_on_a_line_fix_the_scale_and_a_mirrored_plane_does_not(rng):
    line = np.outer(np.linspace(0.0, 9.0, 10), [1.0, 2.0, 0.5])
    assert overlaid(line, 0.7 * line @ so3_exp(np.array([0.2, 0.1, 1.0])).T).scale == pytest.approx(0.7)
    plane = rng.normal(size=(10, 2))
    assert overlaid(plane, plane * [1.0, -1.0]).scale_sd > 0.1
    for points, positions in ((plane, np.ones((10, 2))), (np.ones((10, 2)), plane)):
        with pytest.raises(InputError, match="all in one place"):
            overlaid(points, positions)
    with pytest.raises(InputError, match="only 3 images of the map have a position, but 4 are needed"):
        overlaid(plane[:3], plane[:3])


def test_a_map_takes_it_and_says_how_good_it_is(rng):
    """Heights of GPS say nothing, whichever way the model lies."""
    level = Level(so3_exp(np.array([0.5, -0.4, 0.3])) @ [0.0, 0.0, -1.0], "a test", 0.0, {})
    upright = rng.normal(size=(8, 3)) * [20.0, 15.0, 2.0]
    centres = upright @ so3_exp(np.array([0.5, -0.4, 0.3])).T
    poses = {name: np.column_stack([np.eye(3), -centre]) for name, centre in zip(NAMES, centres, strict=True)}
    flat = upright * [2.0, 2.0, 0.0] + rng.normal(size=(8, 3)) * [0.5, 0.5, 0.0]
    flat[3] += 30.0
    scale = scale_by_positions(poses, Positions(dict(zip(NAMES, flat, strict=True)), "GPS", horizontal=True), level)
    assert scale.metres_per_unit == pytest.approx(2.0, rel=0.05) and scale.off_m[NAMES[3]] > 10.0
    assert scale.source.startswith("GPS: 7 of 8 images fit it, 0.")
    noise = {name: 60.0 * row for name, row in zip(NAMES, rng.normal(size=(8, 3)), strict=True)}
    with pytest.raises(InputError, match=r"GPS gave no scale: .* uncertain by .*; give --distance"):
        scale_by_positions(poses, Positions(noise, "GPS"), level)
    with pytest.raises(InputError, match="GPS gave no scale: no image of the map has a position, but 4 are needed"):
        scale_by_positions(poses, Positions({}, "GPS"), level)


def test_a_group_says_its_units_where_the_map_has_others():
    metres, unknown = (SimpleNamespace(scale=MapScale(1.0, source)) for source in ("a and b are 2 m apart", ""))
    assert other_units(metres, unknown) == ", in metres (a and b are 2 m apart)"
    assert other_units(unknown, metres) == ", units unknown"
    assert other_units(metres, metres) == "" == other_units(unknown, unknown)


@pytest.mark.parametrize("titles", ["lat,lon", "lon,lat"])
def test_latitudes_and_longitudes_that_are_exchanged(tmp_path, rng, titles):
    centres = rng.normal(size=(8, 3)) * [20.0, 15.0, 0.5]
    poses = {name: np.column_stack([np.eye(3), -centre]) for name, centre in zip(NAMES, centres, strict=True)}
    degrees = [50.0, 8.0] + (2.0 * centres[:, 1::-1] + rng.normal(size=(8, 2))) / [111_229.0, 71_696.0]
    path = tmp_path / "gps.csv"
    rows = [f"{name},{at[0]:.7f},{at[1]:.7f}" for name, at in zip(NAMES, degrees, strict=True)]
    path.write_text("\n".join([f"image,{titles}", *rows]))
    level, positions = Level(np.array([0.0, 0.0, -1.0]), "a test", 0.0, {}), read_positions(path, VIEWS)
    if titles == "lat,lon":
        assert scale_by_positions(poses, positions, level).metres_per_unit == pytest.approx(2.0, rel=0.05)
        return
    with pytest.raises(InputError, match=r"seem to be exchanged, since .* fit to \S+ m instead of"):
        scale_by_positions(poses, positions, level)


def test_metres_far_from_the_origin_are_no_degrees(tmp_path):
    path = tmp_path / "positions.txt"
    path.write_text("".join(f"{name} 50.{index} 8.{index} 120\n" for index, name in enumerate(NAMES)))
    assert len(read_positions(path, VIEWS).by_name) == len(NAMES)


@pytest.mark.parametrize("unit", [1, 10**9])
def test_a_trajectory_is_asked_at_the_times_of_the_images(tmp_path, unit):
    """TUM's rows in seconds and in nanoseconds: NAMES[3] lies at 3.5 s, between poses at 3.4 and 3.8 s."""
    path = tmp_path / "poses.txt"
    tenths = range(2, 60, 4)
    times = [(CLOCK_S * 10 + at) * unit // 10 if unit > 1 else f"{CLOCK_S + at // 10}.{at % 10}" for at in tenths]
    rows = (f"{time} {0.2 * at} 0 1 0 0 0 1\n" for time, at in zip(times, tenths, strict=True))
    path.write_text("# TUM\n" + "".join(rows))
    found = read_positions(path, VIEWS)
    assert set(found.by_name) == set(NAMES[1:6]) and found.source == "the trajectory poses.txt"
    np.testing.assert_allclose(found.by_name[NAMES[3]], [7.0, 0.0, 1.0])


@pytest.mark.parametrize("name", ["cam_000000002500000000.png", "rgb_002500000000.png", "a/2.5.png"])
def test_times_of_other_clocks(tmp_path, name):
    """Those of a device since it was switched on, and seconds with a point."""
    path = tmp_path / "poses.tum"
    path.write_text("2.3 1 2 3 0 0 0 1\n2.7 3 2 3 0 0 0 1\n")
    found = read_positions(path, [View(name, VIEWS[0].camera, Path(name)), VIEWS[0]])
    np.testing.assert_allclose(found.by_name[name], [2.0, 2.0, 3.0])
    np.savetxt(path, np.loadtxt(path))
    np.testing.assert_allclose(read_positions(path, [View(name, VIEWS[0].camera, Path(name))]).by_name[name], [2, 2, 3])


def test_rows_of_positions_and_of_gps(tmp_path):
    path = tmp_path / "positions.csv"
    path.write_text(f"{NAMES[0]}, 1, 2, 3\n{NAMES[1]} 4 5 6 # a remark\nother.jpg 0 0 0\n")
    found = read_positions(path, VIEWS)
    assert {name: place.tolist() for name, place in found.by_name.items()} == {NAMES[0]: [1, 2, 3], NAMES[1]: [4, 5, 6]}
    path.write_text(f"image,lat,lon,alt\n{NAMES[0]},47.0,8.0,400\n{NAMES[1]},47.001,8.0,410\n{NAMES[2]},47.0,8.001,9\n")
    found = read_positions(path, VIEWS)
    first, north, east = (found.by_name[name] for name in NAMES[:3])
    assert found.horizontal
    # A minute of latitude is 1,852.2 m there, one of longitude 1,267.9 m (by the tables of the geodesists).
    np.testing.assert_allclose(north - first, [0.0, 111.18, 0.0], atol=0.02)
    np.testing.assert_allclose(east - first, [76.06, 0.0, 0.0], atol=0.02)


@pytest.mark.parametrize(
    "row",
    [
        "Foto 00 #1 ä.JPG 1 2.5 -3e0",
        "'Foto 00 #1 ä.JPG'  1 2.5 -3  # seen from the door",
        '"Foto 00 #1 ä.JPG", 1, 2.5, -3',
        "image;x;y;z\nFoto 00 #1 ä.JPG;1;2.5;-3",
        "image,x,y,z\nFoto 00 #1 ä.JPG,1,2.5,-3",
        "Foto 00 #1 ä.JPG\t1\t2.5\t-3",
        "image,time,Northing,Easting,height_m\nFoto 00 #1 ä.JPG,9,2.5,1,-3",
    ],
)
def test_names_may_have_spaces_and_columns_titles(tmp_path, row):
    name, path = "Foto 00 #1 ä.JPG", tmp_path / "positions.csv"
    path.write_text(f"{row}\n", encoding="utf-8")
    found = read_positions(path, [View(name, VIEWS[0].camera, Path(name))]).by_name
    np.testing.assert_array_equal(found[name], [1.0, 2.5, -3.0])


def test_positions_without_heights_are_horizontal(tmp_path):
    path = tmp_path / "positions.csv"
    path.write_text(
        "".join(["image,easting,northing\n", *(f"{name},691000.5,5335{k}\n" for k, name in enumerate(NAMES))])
    )
    found = read_positions(path, VIEWS)
    assert found.horizontal and found.by_name[NAMES[1]].tolist() == [691000.5, 53351.0, 0.0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        (f"{NAMES[0]} 1 2\n", "line 1: has 3 words; give image x y z"),
        (f"{NAMES[0]} 1 2 x\n", "line 1: 'x' is not a finite number"),
        (f"{NAMES[0]},1,2,3\r{NAMES[1]},1,2,3\r", "line 1: has . words; give image x y z"),
        (f"{NAMES[0]} 1 2 3\n{NAMES[0]} 1 2 3\n", "line 2: .* a second time"),
        ("in/a.jpg 1 2 3\n", "none of its 1 rows, such as 'in/a.jpg', names one of the 8 images, such as 'frame_"),
        (f"image lat lon\n{NAMES[0]} 97 98\n", "is not a latitude and longitude; give degrees"),
        (f"image lat lon\n{NAMES[0]} -122.3 37\n", "is not a latitude and longitude; exchange the titles"),
        (
            "".join(f"{name} 50.00{index} 8.{index:03d} 120\n" for index, name in enumerate(NAMES)),
            "seem to be latitudes and longitudes in degrees, .*: image,lat,lon",
        ),
        ("".join(f"{name} 50.1 8.2 120\n" for name in NAMES), "the same position for all of its 8 images"),
        (
            "100.5 0 0 0 0 0 0 1\n101.5 0 0 0 0 0 0 1\n",
            rf"any of the 8 images: its first one is of 100\.5, frame_.* of {CLOCK_S}\.000 s; give times on the same",
        ),
        ("5000.03 0 0 0 0 0 0 1\n5000.23 0 0 0 0 0 0 1\n", "no pose at the time of any of the 8 images"),
        ("100.5 0 0 0 0 0 0 1\n101.5 0 0 0 0 0 0 1\n101.5 0 0 0 0 0 0 1\n", "line 3: its time is not after"),
    ],
)
def test_files_that_are_refused(tmp_path, text, sentence):
    (tmp_path / "positions.txt").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_positions(tmp_path / "positions.txt", VIEWS)


def photographed(path, latitude, longitude):
    image, exif = Image.new("RGB", (40, 20)), Image.Exif()
    tags = exif.get_ifd(0x8825)
    for tag, letter, angle in ((1, "NS", latitude), (3, "EW", longitude)):
        degrees = abs(angle)
        minutes = 60.0 * (degrees % 1.0)
        tags[tag], tags[tag + 1] = (
            letter[int(angle < 0)],
            (float(int(degrees)), float(int(minutes)), 60.0 * (minutes % 1.0)),
        )
    image.save(path, exif=exif)


def test_gps_in_photographs(tmp_path, monkeypatch):
    """South and west have negative degrees; an image without tags, and one with senseless ones, have no position."""
    degrees = {f"{index}.jpg": np.array([-33.45 - 1e-4 * index, -70.66 + 2e-4 * index, 0.0]) for index in range(5)}
    for name, (latitude, longitude, _) in degrees.items():
        photographed(tmp_path / name, latitude, longitude)
    Image.new("RGB", (40, 20)).save(tmp_path / "none.jpg")
    photographed(tmp_path / "pole.jpg", 100.0, 0.0)
    views = [View(name, Equirectangular(40, 20), tmp_path / name) for name in [*degrees, "none.jpg", "pole.jpg"]]
    found = gps_of_images(views)
    assert found is not None and found.horizontal and set(found.by_name) == set(degrees)
    for name, place in local_metres(degrees).items():
        np.testing.assert_allclose(found.by_name[name], place, atol=0.01)
    assert gps_of_images(views[:3]) is None
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 500)  # as an image beside which Pillow's own limit is small
    with warnings.catch_warnings(action="error"):
        large = gps_of_images(views)
    assert large is not None and set(large.by_name) == set(degrees)


@pytest.mark.parametrize(
    "measured",
    [
        ScaleMeasurement(),
        ScaleMeasurement(camera_height_m=1.6),
        ScaleMeasurement(distance=("a.jpg", "b c.jpg", 18.0)),
        ScaleMeasurement(positions=Positions({"a.jpg": np.array([1.0, 2.5, -3.0])}, "the file p.txt", True)),
    ],
)
def test_what_gave_a_map_its_scale_gives_it_again(tmp_path, measured):
    keep_scale(tmp_path, ScaleMeasurement())
    assert kept_scale(tmp_path) == ScaleMeasurement() and not list(tmp_path.iterdir())
    keep_scale(tmp_path, measured)
    found = kept_scale(tmp_path)
    if measured.positions is None:
        assert found == measured
        return
    assert found.positions is not None and found.positions.source == "the file p.txt" and found.positions.horizontal
    np.testing.assert_array_equal(found.positions.by_name["a.jpg"], [1.0, 2.5, -3.0])


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"distance": ["a", "b"]}', '{"positions": {"a": [1, 2]}}'])
def test_a_damaged_scale_is_a_sentence(tmp_path, text):
    (tmp_path / "scale.json").write_text(text)
    with pytest.raises(InputError, match=r"scale\.json: cannot be read \(.*\); remove it, and give the scale again\.$"):
        kept_scale(tmp_path)


def test_a_trajectory_for_images_whose_names_hold_no_time(tmp_path):
    (tmp_path / "poses.txt").write_text("100.5 0 0 0 0 0 0 1\n101.5 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"any of the 1 images; their names must hold it \(names like 1625133000_"):
        read_positions(tmp_path / "poses.txt", [View("a.jpg", Equirectangular(400, 200), Path("a.jpg"))])
