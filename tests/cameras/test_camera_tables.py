"""``from_dict`` and the constructors: an unusable camera cannot exist, and one sentence says why."""

import math

import numpy as np
import pytest
from camera_samples import INLINE, KITTI360_IMAGE_02
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.calibration import camera_from_table
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError

pytestmark = pytest.mark.filterwarnings("error")

MEI = KITTI360_IMAGE_02.to_dict()
KB = INLINE["kb-beyond-180"].to_dict()
PANORAMA = Equirectangular(2048, 1024).to_dict()
DOUBLE_SPHERE = INLINE["ds-tum-vi"].to_dict()
EUCM = INLINE["eucm-tum-vi"].to_dict()


def refused(table: object) -> str:
    with pytest.raises(CalibrationError) as caught:
        camera_from_table(table, "scene.toml [camera]")
    message = str(caught.value)
    assert message.startswith("scene.toml [camera]: ")
    assert message.endswith(".") and ". " not in message and "\n" not in message and len(message) < 300
    return message


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        *[(table, key, value) for table in (MEI, KB, PANORAMA) for key in ("width", "height") for value in (0, -3)],
        *[(MEI, "width", value) for value in (1400.0, True, "1400", None, math.nan, 10**9)],
        *[(table, key, value) for table in (MEI, KB) for key in ("fx", "fy") for value in (0, -1.0, math.inf)],
        *[(KB, "fx", value) for value in (math.nan, "300", True, None, [300.0])],
        *[(table, key, value) for table in (MEI, KB) for key in ("cx", "cy") for value in (math.nan, -math.inf, "x")],
        *[(MEI, "xi", value) for value in (math.nan, -1.0, -2.5, 1e9, "2")],
        *[(MEI, "distortion", value) for value in ([], [0.0] * 3, [0.0] * 5, 0.0, None, "0000", [0, 0, 0, math.nan])],
        *[(KB, "distortion", value) for value in ([0, 0, 0, "0"], [0, 0, 0, True], {"k1": 0}, [[0, 0, 0, 0]])],
    ],
)
def test_a_bad_value_is_named(table, key, value):
    assert f"camera key '{key}' is " in refused({**table, key: value})


@pytest.mark.parametrize("table", [MEI, KB, PANORAMA, DOUBLE_SPHERE, EUCM])
def test_every_key_is_needed(table):
    for key in table:
        message = refused({name: value for name, value in table.items() if name != key})
        assert f"key '{key}' is missing: add it" in message


@pytest.mark.parametrize("key", ["k1", "Width", "xi", "", 7, ("a", "b")])
def test_unknown_keys_are_named_with_the_known_ones(key):
    message = refused({**KB, key: 1.0})
    assert repr(key) in message and "unknown" in message and "model, width, height, fx, fy, cx, cy" in message


@pytest.mark.parametrize("model", ["pinhole", "", "Mei", 3, None, ["mei"], "a\nb", "x" * 10_000])
def test_unknown_models_list_the_known_ones(model):
    message = refused({**MEI, "model": model})
    assert "unknown camera" in message
    assert all(name in message for name in ("equirectangular", "kannala_brandt", "mei"))


@pytest.mark.parametrize("table", [None, 3, "mei", [], [("model", "mei")]])
def test_what_is_no_table_is_said_so(table):
    assert "give a table" in refused(table)


def test_a_table_of_another_model_is_refused_by_the_class():
    with pytest.raises(CalibrationError, match=r"^here: camera key 'model' is 'mei': give 'equirectangular' here\.$"):
        Equirectangular.from_dict({**PANORAMA, "model": "mei"}, "here")
    with pytest.raises(CalibrationError, match=r"^here: the camera is 3: give a table"):
        Mei.from_dict(3, "here")  # pyright: ignore[reportArgumentType]


def test_the_constructor_refuses_what_a_table_may_not_hold():
    with pytest.raises(CalibrationError, match=r"^camera key 'fx' is nan"):
        KannalaBrandt(10, 10, math.nan, 1.0, 5.0, 5.0, (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match=r"^camera key 'height' is 0"):
        Equirectangular(10, 0)


@pytest.mark.parametrize("key", ["width", "fx", "xi"])
@pytest.mark.parametrize("digits", [400, 10_000])
def test_integers_beyond_all_floats_are_named_and_not_printed_in_full(key, digits):
    assert f"camera key '{key}' is " in refused({**MEI, key: 1 << (4 * digits)})


@pytest.mark.parametrize("lens", [[-1e9, 0.0, 0.0, 0.0], [1e308, -1e308, 1e308, -1e308], [0.0, -1e15, 0.0, 0.0]])
def test_a_lens_that_folds_at_once_is_refused(lens):
    for table in (MEI, KB):
        assert "one pixel away from the principal point" in refused({**table, "distortion": lens})


def test_a_lens_that_reaches_no_pixel_of_its_image_is_refused():
    assert "camera keys 'cx', 'cy' are 5000, 706" in refused({**MEI, "cx": 5000.0, "cy": 706.0})
    outside = camera_from_table({**MEI, "cx": -300.0}, "x")
    assert outside.unproject(np.array([[0.0, outside.to_dict()["cy"]]]))[1].all()


def test_numbers_and_lists_of_other_kinds_are_normalised():
    camera = Mei(
        np.int64(1400),  # pyright: ignore[reportArgumentType]
        1400,
        np.float32(1300.0),  # pyright: ignore[reportArgumentType]
        1300,
        700,
        700,
        2,
        np.zeros(4),  # pyright: ignore[reportArgumentType]
    )
    same = Mei.from_dict(camera.to_dict(), "x")
    assert same == camera and hash(same) == hash(camera)
    assert all(type(value) in (int, float, list, str) for value in camera.to_dict().values())
    assert camera.distortion == (0.0, 0.0, 0.0, 0.0)


anything = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(-(10**400), 10**400),
    st.booleans(),
    st.none(),
    st.text(max_size=5),
    st.lists(st.floats(), max_size=5),
)


@settings(max_examples=150, derandomize=True, deadline=None)
@given(st.sampled_from([MEI, KB, PANORAMA, DOUBLE_SPHERE, EUCM]), st.data())
def test_any_table_is_a_working_camera_or_a_calibration_error(table, data):
    table = dict(table)
    for key in data.draw(st.lists(st.sampled_from(sorted(table)), max_size=3)):
        if key == "distortion":
            table[key] = data.draw(st.lists(st.floats() | st.floats(-2, 2), min_size=4, max_size=4) | anything)
        elif key in ("xi", "alpha", "beta"):
            table[key] = data.draw(st.floats(-1, 2) | st.sampled_from([0.0, 0.5, 1.0, 5e-324, 1e300]) | anything)
        else:
            table[key] = data.draw(anything)
    try:
        camera = camera_from_table(table, "fuzz")
    except CalibrationError as error:
        assert str(error).startswith("fuzz: ") and "\n" not in str(error)
        return
    pixels = np.random.default_rng(0).uniform(0, 1, size=(50, 2)) * [camera.width, camera.height]
    bearings, seen = camera.unproject(pixels)
    again, valid = camera.project(bearings)
    np.testing.assert_array_equal(valid, seen)
    assert np.isfinite(again[valid]).all()
    np.testing.assert_allclose(np.linalg.norm(bearings[valid], axis=1), 1.0, atol=1e-9)
