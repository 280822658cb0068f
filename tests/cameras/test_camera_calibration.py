"""``load_camera``: KITTI-360, Kalibr and the project's TOML; a damaged file is one sentence, never a crash."""

import random
import re
from pathlib import Path

import pytest
from camera_samples import KITTI360_IMAGE_02, require_shared, sample

from spherloc.cameras._files import MAX_FILE_BYTES
from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError, legible

pytestmark = pytest.mark.filterwarnings("error")

KITTI360 = """%YAML:1.0
---
model_type: MEI
camera_name: image_02
image_width: 1400
image_height: 1400
mirror_parameters:
   xi: 2.2134047507854890e+00
distortion_parameters:
   k1: 1.6798235660113681e-02
   k2: 1.6548773243373522e+00
   p1: 4.2223943394772046e-04
   p2: 4.2462134260997584e-04
projection_parameters:
   gamma1: 1.3363220825849971e+03
   gamma2: 1.3357883350012958e+03
   u0: 7.1694323510126321e+02
   v0: 7.0576498308221585e+02
"""

KALIBR = """cam0:
  cam_overlaps: &id001 [1]
  camera_model: pinhole
  distortion_coeffs: [-0.04217, -0.00413, 0.00179, -0.00063]
  distortion_model: equidistant
  intrinsics: [352.779, 354.609, 359.035, 260.546]
  resolution: [720, 540]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: *id001
  camera_model: omni
  distortion_coeffs: [-0.05, 1e-2, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [0.9, 520.0, 518.0, 370.0, 245.0]
  resolution: [752, 480]
cam10:
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.2, 0.5, 300.0, 300.0, 370.0, 245.0]
  resolution: [752, 480]
"""

TOML = """# a scene
name = "room"
[camera]
model = "kannala_brandt"
width = 1200
height = 1200
fx = 300.0
fy = 301
cx = 600.5
cy = 598.0
distortion = [-0.02, 0.003, -0.0008, 1e-5]
"""


@pytest.fixture
def load(tmp_path):
    def from_text(text: str | bytes, name: str | None = None) -> Camera:
        path = tmp_path / "calibration"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load_camera(path, name)

    return from_text


@pytest.fixture
def refused(load, tmp_path):
    def message(text: str | bytes, name: str | None = None) -> str:
        with pytest.raises(CalibrationError) as caught:
            load(text, name)
        return one_sentence(caught.value, str(tmp_path / "calibration"))

    return message


def one_sentence(error: CalibrationError, path: str) -> str:
    message = str(error)
    assert message.startswith(f"{path}: ")
    message = message.removeprefix(f"{path}: ")
    assert message.endswith(".") and "\n" not in message and len(message) < 400
    return message


def test_kitti360_is_mei_with_half_a_pixel_added(load):
    camera = load(KITTI360)
    assert camera == KITTI360_IMAGE_02
    assert camera.cx == 716.94323510126321 + 0.5
    assert load(KITTI360, "image_02") == camera
    assert load(KITTI360.replace("\n", "\r\n").replace("%YAML:1.0", "\ufeff%YAML:1.0")) == camera


def test_kalibr_equidistant_is_kannala_brandt_with_half_a_pixel_added(load):
    expected = KannalaBrandt(
        720, 540, 352.779, 354.609, 359.035 + 0.5, 260.546 + 0.5, (-0.04217, -0.00413, 0.00179, -0.00063)
    )
    assert load(KALIBR) == expected
    assert load(KALIBR, "cam0") == expected
    assert load(f"%YAML:1.0 # as OpenVINS writes it\n\n{KALIBR}") == expected


def test_kalibr_omni_is_mei_and_numbers_without_a_point_are_numbers(load):
    assert load(KALIBR, "cam1") == Mei(752, 480, 520.0, 518.0, 370.5, 245.5, 0.9, (-0.05, 0.01, 0.001, -0.002))


def test_toml_is_taken_as_it_is(load):
    expected = KannalaBrandt(1200, 1200, 300.0, 301.0, 600.5, 598.0, (-0.02, 0.003, -0.0008, 1e-5))
    assert load(TOML) == expected
    assert load(TOML.split("[camera]")[1]) == expected
    assert load("[camera]\nmodel = 'equirectangular'\nwidth = 20\nheight = 10\n") == Equirectangular(20, 10)


@pytest.mark.parametrize("name", ["rgb", "slam_left", "slam_right"])
def test_real_scene_files(name):
    path = require_shared(f"aria_adt_fisheye/{name}.toml")
    assert load_camera(path) == sample(f"aria_adt_fisheye/{name}.toml")


def test_real_kalibr_chain_is_the_lens_of_the_same_calibration_elsewhere():
    path = require_shared("formats_real/tumvi_kalibr_imucam_chain.yaml")
    assert load_camera(path) == sample("formats_real/stella_tum_vi_mono.yaml")
    second = load_camera(path, "cam1")
    assert isinstance(second, KannalaBrandt)
    assert (second.width, second.cx) == (512, 252.59949716835982 + 0.5)


@pytest.mark.parametrize(
    ("text", "name", "parts"),
    [
        ("", None, ["neither a [camera] table nor a key 'model'"]),
        ("x = 1", None, ["neither a [camera] table nor a key 'model'"]),
        ("camera = 3", None, ["[camera]: the camera is 3: give a table"]),
        ("[camera]\nmodel = 'foo'", None, ["[camera]: unknown camera 'foo': choose one of"]),
        ("model = 'mei'", None, ["camera key 'width' is missing"]),
        (TOML.replace("300.0", "nan"), None, ["[camera]: camera key 'fx' is nan"]),
        (TOML.replace("width", "wide"), None, ["'wide' is unknown"]),
        (TOML.replace("fx = 300.0", "fx = "), None, ["valid TOML", "line 7"]),
        (TOML, "cam0", ["leave out the name 'cam0'"]),
        ("[" * 5000, None, ["valid TOML"]),
        ("a = " + "[" * 5000, None, ["valid TOML"]),
        ("x: 1", None, ["this YAML has no known key at its top"]),
        ("---\n- 1\n- 2", None, ["this YAML has no known key at its top"]),
        ("camera: [1, 2", None, ["line 1", "valid YAML"]),
        ("a: " + "[" * 5000, None, ["valid YAML"]),
        ("a: !!timestamp x", None, ["valid YAML"]),
        ("a: !!bool x", None, ["valid YAML"]),
        ("a: !!int ''", None, ["valid YAML"]),
        ("a: 2001-99-99", None, ["valid YAML"]),
        ("a: " + "9" * 5000, None, ["valid YAML"]),
        ("a: !!python/object/apply:os.getcwd []", None, ["line 1", "valid YAML"]),
        ("a: &a {b: 1}\nc: {<<: *a}", None, ["line 2", "merge"]),
        ("a: \x01", None, ["valid YAML"]),
        ("a: 1\n\tb: 2", None, ["line 2", "valid YAML"]),
        (KITTI360, "image_03", ["the camera 'image_02' only", "'image_03'"]),
        (KITTI360.replace("MEI", "PINHOLE"), None, ["model_type 'PINHOLE' is not supported"]),
        (KITTI360.replace("image_width", "width"), None, ["key 'image_width' is missing"]),
        (KITTI360.replace("1400", "0"), None, ["camera key 'width' is 0"]),
        (KITTI360.replace("   xi", "   yi"), None, ["mirror_parameters: key 'xi' is missing"]),
        (KITTI360.replace("2.2134047507854890e+00", ".nan"), None, ["mirror_parameters: camera key 'xi' is nan"]),
        (KITTI360.replace("4.2223943394772046e-04", "[1]"), None, ["distortion_parameters: camera key 'p1' is [1]"]),
        (KITTI360.replace("1.3363220825849971e+03", "-5.0"), None, ["camera key 'fx' is -5.0"]),
        (KITTI360.split("projection")[0], None, ["key 'projection_parameters' is missing"]),
        (KITTI360.split("projection")[0] + "projection_parameters: 3", None, ["projection_parameters: ", " is 3"]),
        (KALIBR, "cam7", ["no camera 'cam7'", "cam0, cam1, cam10"]),
        (
            KALIBR.replace("none", "fov"),
            "cam10",
            ["cam10: the camera_model 'ds' with", "'fov' is not supported"],
        ),
        (KALIBR.replace("equidistant", "fov"), None, ["cam0: the camera_model 'pinhole'", "'fov' is not supported"]),
        (
            KALIBR.replace("[352.779, ", "["),
            None,
            ["cam0: camera key 'intrinsics'", "4 finite numbers, fu, fv, pu, pv"],
        ),
        (KALIBR.replace("352.779", ".inf"), None, ["cam0: camera key 'intrinsics'", "inf"]),
        (KALIBR.replace("[720, 540]", "[720]"), None, ["cam0: key 'resolution' is [720]"]),
        (KALIBR.replace("[720, 540]", "[720, tall]"), None, ["cam0: camera key 'height' is 'tall'"]),
        (KALIBR.replace("-0.00063]", "]"), None, ["cam0: camera key 'distortion_coeffs'"]),
        (KALIBR.replace("resolution", "size"), None, ["cam0: key 'resolution' is missing"]),
        ("cam0: 3", None, ["cam0: the camera is 3"]),
    ],
)
def test_each_mistake_has_its_sentence(refused, text, name, parts):
    message = refused(text, name)
    for part in parts:
        assert part in message


def test_a_number_of_too_many_digits_is_refused_without_printing_it(refused):
    assert "too large to print" in refused(TOML.replace("301", "0x" + "f" * 10_000))


def test_binary_and_large_files_are_refused(refused):
    assert "byte 2 is not UTF-8" in refused(b"ab\xff\xfe")
    assert "is larger than 256 KiB, which no calibration is: give a YAML" in refused(b"#" * (MAX_FILE_BYTES + 1))


def test_missing_files_directories_and_impossible_paths(tmp_path):
    for path in (tmp_path / "absent", tmp_path, tmp_path / "a\0b", tmp_path / ("n" * 5000)):
        with pytest.raises(CalibrationError) as caught:
            load_camera(path)
        one_sentence(caught.value, legible(f"{path}:")[:-1])


def test_an_unreadable_file(tmp_path, monkeypatch):
    path = tmp_path / "secret"
    path.write_text(TOML)

    def deny(*_args):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("spherloc.files.open_file", deny)
    with pytest.raises(CalibrationError, match=r"cannot be read \(Permission denied\): check the path"):
        load_camera(path)


FORMATS = {"kitti360": KITTI360, "kalibr": KALIBR, "toml": TOML}


def damaged(text: str, rng: random.Random) -> bytes:
    """``text`` cut off, with bits flipped, or with bytes and lines replaced, dropped or repeated."""
    data = bytearray(text.encode())
    kind = rng.randrange(4)
    if kind == 0:
        return bytes(data[: rng.randrange(len(data))])
    if kind == 1:
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return bytes(data)
    if kind == 2:
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] = rng.choice(b" \n:[]{}-\"'#&*!|>%@,.0e+\x00\xff")
        return bytes(data)
    lines = bytes(data).splitlines(keepends=True)
    return b"".join(line * rng.choice([1, 1, 1, 0, 2]) for line in lines)


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_a_camera_or_one_sentence(load, tmp_path, name):
    rng = random.Random(f"damaged {name}")
    outcomes = {"camera": 0, "error": 0}
    for _ in range(600):
        data = damaged(FORMATS[name], rng)
        try:
            camera = load(data)
        except CalibrationError as error:
            one_sentence(error, str(tmp_path / "calibration"))
            outcomes["error"] += 1
        else:
            assert isinstance(camera, Camera), data
            outcomes["camera"] += 1
    assert min(outcomes.values()) > 5  # some damage is harmless, some is not


def test_random_bytes_are_one_sentence(refused):
    rng = random.Random("random bytes")
    for length in range(200):
        refused(rng.randbytes(length + 1))
        refused(f"%YAML:1.0\n{''.join(rng.choices(': -[]{}&*!|>abc01.', k=length))}")


def test_a_folder_is_no_calibration_and_the_sentence_names_one_in_it(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"is a folder: give the calibration file itself\.$"):
        load_camera(tmp_path)
    for name in ("map.txt", "lens.toml"):
        (tmp_path / name).touch()
    with pytest.raises(CalibrationError, match=rf"itself, such as {re.escape(str(tmp_path / 'lens.toml'))}\.$"):
        load_camera(tmp_path)
