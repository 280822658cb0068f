"""Calibrations of Kalibr, Basalt, stella_vslam, 360Loc and fisheye-calib-adapter: real files, mistakes, damage."""

import json
import random
from pathlib import Path

import numpy as np
import pytest
from camera_samples import angle_rad, pixel_grid, require_shared, sample
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.cameras.tool_files import read_kalibr_chain
from spherloc.errors import CalibrationError

pytestmark = pytest.mark.filterwarnings("error")

ADAPTER = "image:\n  width: 752\n  height: 480\nparameter:\n  fx: 460.5\n  fy: 459\n  cx: 365.8\n  cy: 248.9\n"
LOC360 = "imgw: 1280\nimgh: 1120\nfx: 301.5\nfy: 301\ncx: 640\ncy: 560.5\nxi: -0.2\nalpha: 6e-1\n"
STELLA = """Camera:
  name: "a"
  model: "perspective"
  fx: 500
  fy: 501
  cx: 320
  cy: 240
  k1: -0.1
  k2: 0.01
  p1: 1e-3
  p2: -2e-3
  k3: 0.0
  fps: 30.0
  cols: 640
  rows: 480
"""
CHAIN = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.01, 1e-3, -2e-3]
  distortion_model: radtan
  intrinsics: [500.0, 501.0, 320.0, 240.0]
  resolution: [640, 480]
  T_cam_imu: [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
cam1:
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.2, 0.6, 300.0, 301.0, 370.0, 245.0]
  resolution: [752, 480]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
cam2:
  camera_model: eucm
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [0.6, 1.1, 300.0, 301.0, 370.0, 245.0]
  resolution: [752, 480]
cam3:
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [500.0, 501.0, 320.0, 240.0]
  resolution: [640, 480]
cam4:
  camera_model: omni
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [0.9, 500.0, 501.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def basalt(kind: str = "ds", **intrinsics: float) -> str:
    lens = {"fx": 158.3, "fy": 158.2, "cx": 254.9, "cy": 256.8} | intrinsics
    first = {"camera_type": "pinhole", "intrinsics": {"fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 239.5}}
    cameras = [first, {"camera_type": kind, "intrinsics": lens}]
    return json.dumps({"value0": {"intrinsics": cameras, "resolution": [[640, 480], [512, 512]]}}, indent=1)


@pytest.fixture
def written(tmp_path):
    def write(text: str | bytes) -> Path:
        path = tmp_path / "calibration"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def largest_difference_rad(a: Camera, b: Camera, radius_px: float) -> float:
    """Between the bearings of pixels within a radius of the image centre."""
    pixels = pixel_grid(a, step=8.0)
    pixels = pixels[np.hypot(*(pixels - [a.width / 2, a.height / 2]).T) < radius_px]
    return float(angle_rad(a.unproject(pixels)[0], b.unproject(pixels)[0]).max())


@pytest.mark.parametrize("camera", [None, "cam1"])
@pytest.mark.parametrize("model", ["ds", "eucm"])
def test_basalt_and_kalibr_saw_the_same_lens(model, camera):
    """Two calibrations of TUM VI by different tools: 0.4 px (0.12 degrees) over the lit image, half of it a shift."""
    theirs = load_camera(require_shared(f"formats_real/basalt_tumvi_512_{model}_calib.json"), camera)
    ours = load_camera(require_shared("formats_real/tumvi_kalibr_imucam_chain.yaml"), camera)
    assert isinstance(theirs, DoubleSphere | Eucm) and isinstance(ours, KannalaBrandt)
    assert largest_difference_rad(ours, theirs, 200.0) < np.radians(0.15)


def test_basalts_two_models_are_one_lens():
    ds = load_camera(require_shared("formats_real/basalt_tumvi_512_ds_calib.json"))
    eucm = load_camera(require_shared("formats_real/basalt_tumvi_512_eucm_calib.json"))
    assert largest_difference_rad(ds, eucm, 200.0) < np.radians(0.01)


@pytest.mark.parametrize("model", ["DS", "EUCM", "RadTan"])
def test_the_adapters_models_are_one_lens(model):
    """Fits of each other: 1.2 px apart, which is 0.15 degrees, and far less than a swapped or shifted parameter."""
    reference = load_camera(require_shared("formats_real/adapter_euroc_KB.yml"))
    other = load_camera(require_shared(f"formats_real/adapter_euroc_{model}.yml"))
    assert largest_difference_rad(reference, other, 200.0) < np.radians(0.16)


@pytest.mark.parametrize("name", ["adapter_euroc_KB.yml", "stella_fisheye.yaml", "stella_tum_vi_mono.yaml"])
def test_real_kannala_brandt_files(name):
    assert load_camera(require_shared(f"formats_real/{name}")) == sample(f"formats_real/{name}")


def test_real_files_without_a_usable_camera_are_refused():
    path = require_shared("formats_real/tumvi_kalibr_imu_chain.yaml")
    with pytest.raises(CalibrationError, match="this YAML has no known key at its top"):
        load_camera(path)
    with pytest.raises(CalibrationError, match=r"has no 'cam0' at its top: give a camchain YAML of Kalibr\.$"):
        read_kalibr_chain(path)


def test_real_chain_has_its_cameras_at_the_imu():
    chain = read_kalibr_chain(require_shared("formats_real/tumvi_kalibr_imucam_chain.yaml"))
    assert list(chain) == ["cam0", "cam1"]
    left, right = (chain[name].cam_from_imu for name in chain)
    assert left is not None and right is not None and left.shape == (4, 4)
    baseline = right @ np.linalg.inv(left)
    assert np.linalg.norm(baseline[:3, 3]) == pytest.approx(0.101, abs=1e-3)  # TUM VI: 10 cm
    assert baseline[0, 3] < -0.1  # the second camera is to the right of the first
    assert chain["cam0"].cam_from_previous is None


def test_real_panorama():
    assert load_camera(require_shared("formats_real/stella_equirectangular.yaml")) == Equirectangular(1920, 960)


def test_every_lens_of_a_chain(written):
    chain = read_kalibr_chain(written(CHAIN))
    lens = (-0.1, 0.01, 1e-3, -2e-3)
    assert [entry.camera for entry in chain.values()] == [
        Mei(640, 480, 500.0, 501.0, 320.5, 240.5, 0.0, lens),
        DoubleSphere(752, 480, 300.0, 301.0, 370.5, 245.5, -0.2, 0.6),
        Eucm(752, 480, 300.0, 301.0, 370.5, 245.5, 0.6, 1.1),
        Mei(640, 480, 500.0, 501.0, 320.5, 240.5, 0.0, (0.0, 0.0, 0.0, 0.0)),
        Mei(640, 480, 500.0, 501.0, 320.5, 240.5, 0.9, (0.0, 0.0, 0.0, 0.0)),
    ]
    for name, entry in chain.items():
        assert load_camera(written(CHAIN), name) == entry.camera
    first, second = chain["cam0"].cam_from_imu, chain["cam1"].cam_from_previous
    assert first is not None and second is not None
    np.testing.assert_array_equal(first[:2], [[0, -1, 0, 0.1], [1, 0, 0, 0.2]])
    assert second[0, 3] == -0.1 and chain["cam0"].cam_from_previous is None and chain["cam1"].cam_from_imu is None


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("0.1], [1", "0.1], [2", "cam0: key 'T_cam_imu' is not a rotation with a translation"),
        ("[0, -1, 0, 0.1]", "[0, 1, 0, 0.1]", "cam0: key 'T_cam_imu' is not a rotation"),  # a mirror
        ("[0, 0, 0, 1]]", "[0, 0, 0, 2]]", "cam0: key 'T_cam_imu' is not a rotation"),
        ("[0, 0, 0, 1]]", "[0, 0, 0]]", "cam0: camera key 'T_cam_imu' is [0, 0, 0]: give a list of 4"),
        (", [0, 0, 0, 1]]", "]", "cam0: key 'T_cam_imu' is [[0, -1, 0, 0.1]"),
        ("[0, -1, 0, 0.1]", "[.nan, -1, 0, 0.1]", "cam0: camera key 'T_cam_imu'"),
        ("[0, -1, 0, 0.1]", "[1.0e300, -1, 0, 0.1]", "cam0: key 'T_cam_imu' is not a rotation"),
        ("- [1.0, 0.0, 0.0, -0.1]", "- 3", "cam1: camera key 'T_cn_cnm1' is 3"),
        ("camera_model: ds", "camera_model: [ds]", "cam1: the camera_model ['ds'] with the distortion_model 'none'"),
        ("[0.6, 1.1,", "[0.6, -1.1,", "cam2: camera key 'beta' is -1.1"),
    ],
)
def test_mistakes_in_a_chain(written, old, new, part):
    assert old in CHAIN
    path = written(CHAIN.replace(old, new))
    with pytest.raises(CalibrationError) as caught:
        read_kalibr_chain(path)
    assert part in one_sentence(caught.value, path)


def one_sentence(error: CalibrationError, path: Path) -> str:
    message = str(error)
    assert message.startswith(f"{path}: ")
    message = message.removeprefix(f"{path}: ")
    assert message.endswith(".") and "\n" not in message and len(message) < 400
    return message


LENS = (-0.1, 0.01, 1e-3, -2e-3)


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        (LOC360, None, DoubleSphere(1280, 1120, 301.5, 301.0, 640.0, 560.5, -0.2, 0.6)),
        (LOC360.split("xi")[0], None, Mei(1280, 1120, 301.5, 301.0, 640.0, 560.5, 0.0, (0.0, 0.0, 0.0, 0.0))),
        (STELLA, None, Mei(640, 480, 500.0, 501.0, 320.5, 240.5, 0.0, LENS)),
        (STELLA.replace("Camera:\n", "").replace("  ", "Camera."), None, load_camera),
        (ADAPTER + "  xi: -0.2\n  alpha: 0.5\n", None, DoubleSphere(752, 480, 460.5, 459.0, 366.3, 249.4, -0.2, 0.5)),
        (ADAPTER + "  beta: 1.2\n  alpha: 0.5\n", None, Eucm(752, 480, 460.5, 459.0, 366.3, 249.4, 0.5, 1.2)),
        (basalt(), None, Mei(640, 480, 500.0, 500.0, 320.0, 240.0, 0.0, (0.0, 0.0, 0.0, 0.0))),
        (basalt(xi=-0.2, alpha=0.6), "cam1", DoubleSphere(512, 512, 158.3, 158.2, 255.4, 257.3, -0.2, 0.6)),
        (basalt("eucm", beta=1.1, alpha=0.6), "cam1", Eucm(512, 512, 158.3, 158.2, 255.4, 257.3, 0.6, 1.1)),
        (basalt("ucm", alpha=0.6), "cam1", Eucm(512, 512, 158.3, 158.2, 255.4, 257.3, 0.6, 1.0)),
        (
            basalt("kb4", k1=0.1, k2=0.2, k3=0.3, k4=0.4),
            "cam1",
            KannalaBrandt(512, 512, 158.3, 158.2, 255.4, 257.3, (0.1, 0.2, 0.3, 0.4)),
        ),
    ],
)
def test_each_format_and_its_pixel_centre(written, text, name, expected):
    camera = load_camera(written(text), name)
    if expected is load_camera:  # OpenVSLAM wrote the same keys with dots
        expected = load_camera(written(STELLA))
    np.testing.assert_allclose([camera.to_dict()[key] for key in ("cx", "cy")], [expected.cx, expected.cy], rtol=1e-15)
    assert camera.to_dict() | {"cx": 0, "cy": 0} == expected.to_dict() | {"cx": 0, "cy": 0}


@pytest.mark.parametrize(
    ("text", "name", "part"),
    [
        (LOC360.replace("imgh: 1120\n", ""), None, "key 'imgh' is missing: add it"),
        (LOC360.replace("xi: -0.2\n", ""), None, "key 'xi' is missing"),
        (LOC360.replace("301.5", ".nan"), None, "camera key 'fx' is nan"),
        (LOC360, "cam0", "leave out the name 'cam0'"),
        (
            STELLA.replace("perspective", "radial_division"),
            None,
            "Camera: the model 'radial_division' is not",
        ),
        (STELLA.replace("k3: 0.0", "k3: 0.1"), None, "Camera: key 'k3' is 0.1: calibrate with k1, k2, p1, p2 alone"),
        (STELLA.replace("  p1: 1e-3\n", ""), None, "Camera: key 'p1' is missing"),
        (STELLA.replace("cols: 640", "cols: wide"), None, "Camera: camera key 'width' is 'wide'"),
        ("Camera: 3", None, "Camera: the camera is 3"),
        ("Camera.model: fisheye", None, "Camera: key 'cols' is missing"),
        (ADAPTER, None, "parameter: the keys ['cx', 'cy', 'fx', 'fy'] are not those of a supported model"),
        (ADAPTER + "  k1: 0\n  k2: 0\n  k3: 0\n  p1: 0\n  p2: x\n", None, "parameter: camera key 'p2' is 'x'"),
        ("parameter: 3", None, "key 'image' is missing"),
        ("image: 3\nparameter: 3", None, "image: the camera is 3"),
        ("image: {width: 3, height: 3}\nparameter: 3", None, "parameter: the camera is 3"),
        ("{}", None, "this JSON has no known key at its top"),
        ("{]", None, "line 1 is not valid JSON (Expecting property name"),
        ('{"value0": ' + "[" * 100_000, None, "a value is not valid JSON (maximum recursion depth exceeded"),
        ('{"value0": ' + "9" * 10_000 + "}", None, "a value is not valid JSON (Exceeds the limit"),
        ('{"value0": 3}', None, "value0: the camera is 3"),
        (
            '{"value0": {"intrinsics": [], "resolution": []}}',
            None,
            "value0: keys 'intrinsics' and 'resolution' must be lists",
        ),
        ('{"value0": {"intrinsics": [3], "resolution": [3]}}', None, "value0: cam0: the camera is 3"),
        (basalt(), "cam2", "value0: has no camera 'cam2': choose one of cam0, cam1"),
        (
            basalt("pinhole-radtan8"),
            "cam1",
            "cam1: the camera_type 'pinhole-radtan8' is not supported: give ds,",
        ),
        (basalt("ds"), "cam1", "value0: cam1: key 'xi' is missing"),
        (basalt(xi=float("nan"), alpha=0.5), "cam1", "value0: cam1: camera key 'xi' is nan"),
        (basalt().replace("640", "-640"), None, "value0: cam0: camera key 'width' is -640"),
    ],
)
def test_each_mistake_has_its_sentence(written, text, name, part):
    path = written(text)
    with pytest.raises(CalibrationError) as caught:
        load_camera(path, name)
    assert part in one_sentence(caught.value, path)


FORMATS = {"loc360": LOC360, "stella": STELLA, "adapter": ADAPTER + "  xi: 0.1\n  alpha: 0.5\n", "basalt": basalt()}


@pytest.mark.parametrize("name", [*FORMATS, "chain"])
def test_damaged_files_are_a_camera_or_one_sentence(written, name):
    rng = random.Random(f"damaged {name}")
    outcomes = {"read": 0, "refused": 0}
    text = FORMATS.get(name, CHAIN)
    for _ in range(150 if name == "chain" else 300):
        data = bytearray(text.encode())
        for _ in range(rng.randint(0, 3)):
            at = rng.randrange(len(data))
            data[at] = rng.choice(
                [data[at] ^ (1 << rng.randrange(8)), rng.choice(b" \n:[]{}-\"'#&*!|>%@,.0e+\x00\xff")]
            )
        data = data[: rng.choice([len(data), len(data), rng.randrange(len(data))])]
        path = written(bytes(data))
        try:
            cameras = [e.camera for e in read_kalibr_chain(path).values()] if name == "chain" else [load_camera(path)]
        except CalibrationError as error:
            one_sentence(error, path)
            outcomes["refused"] += 1
        else:
            assert all(isinstance(camera, Camera) for camera in cameras)
            outcomes["read"] += 1
    assert min(outcomes.values()) > 5


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


def entries(document):
    """(container, key) of every value inside a document."""
    for key in list(document) if isinstance(document, dict) else range(len(document)):
        yield document, key
        if isinstance(document[key], dict | list):
            yield from entries(document[key])


@settings(max_examples=200)
@given(st.data())
def test_any_value_anywhere_in_a_basalt_file(tmp_path_factory, data):
    document = json.loads(basalt(xi=-0.2, alpha=0.6))
    container, key = data.draw(st.sampled_from(list(entries(document))))
    container[key] = data.draw(json_values)
    path = tmp_path_factory.getbasetemp() / "any.json"
    path.write_text(json.dumps(document))
    for name in (None, "cam1"):
        try:
            assert isinstance(load_camera(path, name), Camera)
        except CalibrationError as error:
            one_sentence(error, path)
