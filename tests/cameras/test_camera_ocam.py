"""OCamCalib's files against the toolbox's own two functions, written here as its paper and its C code have them."""

import numpy as np
import pytest
from camera_samples import INLINE, pixel_grid, require_shared
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.calibration import load_camera
from spherloc.cameras.ocam import Ocam
from spherloc.errors import CalibrationError
from spherloc.mapping.images.lens import for_colmap
from spherloc.testing import check_camera

pytestmark = pytest.mark.filterwarnings("error")

DIRECT = "5 -4.167604e+02 0.000000e+00 1.190213e-03 -1.534627e-06 3.137860e-09"
INVERSE = (
    "12 562.102870 266.095519 -26.584752 56.736554 9.341520 6.790452 14.809291 -21.675851 -10.308973 24.528996 "
    "20.092843 4.259172"
)
CENTRE, AFFINE, SIZE = "497.570118 508.063716", "0.997772 -0.011575 0.011638", "1000 1024"
"""Of a fisheye of 185 degrees, as the toolbox wrote it; the height is changed so that it is not the width."""


def file_of(direct=DIRECT, inverse=INVERSE, centre=CENTRE, affine=AFFINE, size=SIZE):
    return (
        "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These are used by "
        f"cam2world\n\n{direct} \n\n#polynomial coefficients for the inverse mapping function (ocam_model.invpol in "
        f'MATLAB). These are used by world2cam\n\n{inverse} \n\n#center: "row" and "column", starting from 0 (C '
        f'convention)\n\n{centre}\n\n#affine parameters "c", "d", "e"\n\n{affine}\n\n#image size: "height" and '
        f'"width"\n\n{size}\n\n'
    )


@pytest.fixture
def written(tmp_path):
    def write(text):
        path = tmp_path / "calib_results.txt"
        path.write_text(text)
        return path

    return write


def numbers(text):
    return [float(word) for word in text.split()]


def cam2world(row, column):
    """The toolbox's: x down, y to the right, z backwards."""
    (xc, yc), (c, d, e) = numbers(CENTRE), numbers(AFFINE)
    xp = (row - xc - d * (column - yc)) / (c - d * e)
    yp = (-e * (row - xc) + c * (column - yc)) / (c - d * e)
    radius = np.sqrt(xp**2 + yp**2)
    zp = sum(a * radius**power for power, a in enumerate(numbers(DIRECT)[1:]))
    return np.column_stack([xp, yp, zp]) / np.sqrt(xp**2 + yp**2 + zp**2)[:, None]


def world2cam(ray):
    (xc, yc), (c, d, e) = numbers(CENTRE), numbers(AFFINE)
    norm = np.hypot(ray[:, 0], ray[:, 1])
    theta = np.arctan(ray[:, 2] / norm)
    rho = sum(a * theta**power for power, a in enumerate(numbers(INVERSE)[1:]))
    x, y = ray[:, 0] / norm * rho, ray[:, 1] / norm * rho
    return x * c + y * d + xc, x * e + y + yc


def test_rays_are_the_toolboxs(written):
    camera = load_camera(written(file_of()))
    assert isinstance(camera, Ocam) and (camera.width, camera.height) == (1024, 1000)
    check_camera(camera)
    pixels = pixel_grid(camera)
    found, seen = camera.unproject(pixels)
    assert seen.all()
    theirs = cam2world(pixels[:, 1] - 0.5, pixels[:, 0] - 0.5)
    np.testing.assert_allclose(found, np.column_stack([theirs[:, 1], theirs[:, 0], -theirs[:, 2]]), atol=1e-12)


def test_pixels_are_the_toolboxs_as_far_as_its_fit_goes(written):
    """Its inverse polynomial is a fit: within 0.1 px in the lit circle, and its own error, not ours."""
    camera = load_camera(written(file_of()))
    pixels = pixel_grid(camera)
    pixels = pixels[np.hypot(*(pixels - [508.6, 498.1]).T) < 480.0]
    rays, _ = camera.unproject(pixels)
    row, column = world2cam(np.column_stack([rays[:, 1], rays[:, 0], -rays[:, 2]]))
    assert np.hypot(column + 0.5 - pixels[:, 0], row + 0.5 - pixels[:, 1]).max() < 0.1
    np.testing.assert_allclose(camera.project(rays)[0], pixels, atol=1e-9)


def test_the_adapters_file_has_the_axes_of_the_image():
    """Its polynomials agree with each other, by its own convention."""
    camera = load_camera(require_shared("formats_real/adapter_euroc_OcamCalib.yml"))
    assert isinstance(camera, Ocam) and camera.affine == (0.99887, -0.000169, 0.00011, 1.0)
    projection = (287.968301, 140.087942, -12.679484, 29.016357, 3.937199, 0.391479, 12.889536)
    projection += (-0.943428, -7.307169, 1.284518, 3.303587, 0.812912)
    ray = np.array([[0.4, -0.3, 0.5]])
    # Angles there are counted from the image plane backwards, as in the toolbox.
    rho = sum(a * (-np.arctan2(0.5, 0.5)) ** power for power, a in enumerate(projection))
    assert np.hypot(*(camera.project(ray)[0][0] - [360.33, 244.11])) == pytest.approx(rho, abs=1.0)


@given(
    a0=st.floats(100.0, 800.0),
    a2=st.floats(-3e-3, 1e-3),
    a3=st.floats(-3e-6, 3e-6),
    a4=st.floats(-1e-8, 1e-8),
    affine=st.tuples(st.floats(0.9, 1.1), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(0.9, 1.1)),
)
@settings(max_examples=60, deadline=None)
def test_whatever_the_polynomial_pixels_come_back(a0, a2, a3, a4, affine):
    camera = Ocam(640, 480, 325.0, 236.0, affine, (a0, 0.0, a2, a3, a4))
    pixels = pixel_grid(camera, step=16.0)
    bearings, seen = camera.unproject(pixels)
    back, valid = camera.project(bearings)
    x, y = np.linalg.solve(np.reshape(affine, (2, 2)), (pixels - [325.0, 236.0]).T)
    well_inside = np.hypot(x, y) < 0.99 * camera.max_radius
    np.testing.assert_array_equal(seen[well_inside], True)
    assert valid[well_inside].all()
    np.testing.assert_allclose(back[well_inside], pixels[well_inside], atol=1e-6)
    # Beyond the fold two pixels would have one ray: angles grow up to it.
    radius = np.linspace(0.0, camera.max_radius, 400)
    depth = a0 + a2 * radius**2 + a3 * radius**3 + a4 * radius**4
    assert (np.diff(np.arctan2(radius, depth)) > 0.0).all()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (file_of(direct="5 -4.1e+02 0.0 1e-03 nan 3e-09"), "line 3: 'nan' is not a finite number"),
        (file_of(direct="6 -4.1e+02 0.0 1e-03 1e-6 3e-09"), "line 3 begins with 6, and 5 numbers follow"),
        (file_of(direct="5 4.1e+02 0.0 1e-03 1e-6 3e-09"), "'polynomial' begins with -410"),
        (file_of(centre="497.5"), "line 11 has 1 numbers: give the centre"),
        (file_of(affine="0.0 1.0 1.0"), "'affine' is .* mirrors the image"),
        (file_of(size="1000 1024.5"), "'width' is 1024.5"),
        (file_of().rsplit("#", 1)[0], "the image size, height and width is missing"),
        (file_of() + "1 2 3\n", "there are more lines of numbers"),
        (file_of(direct="3 -300.0 0.0 -1e-3", centre="5000 9000"), "from where the lens reaches no pixel"),
    ],
)
def test_damaged_files_are_one_sentence(written, text, said):
    path = written(text)
    with pytest.raises(CalibrationError, match=said) as caught:
        load_camera(path)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message and message.endswith(".")


@given(st.integers(0, 700), st.binary(min_size=0, max_size=8))
@settings(max_examples=150, deadline=None)
def test_no_damage_raises_anything_else(tmp_path_factory, at, junk):
    text = file_of().encode()
    path = tmp_path_factory.getbasetemp() / "ocam_damaged.txt"
    path.write_bytes(text[:at] + junk + text[at + len(junk) :])
    try:
        assert load_camera(path).width >= 1
    except CalibrationError as error:
        assert "\n" not in str(error)


def test_tables_that_are_no_lens():
    table = INLINE["ocam-beyond-180"].to_dict()
    for key, value in (("polynomial", []), ("polynomial", "x"), ("polynomial", [300.0] * 17), ("affine", [1, 0, 0])):
        with pytest.raises(CalibrationError, match=f"camera key '{key}' is "):
            Ocam.from_dict({**table, key: value}, "scene.toml")


def test_colmap_gets_a_lens_within_half_a_pixel():
    fitted, remark = for_colmap(INLINE["ocam-beyond-180"])
    assert fitted.model == "kannala_brandt" and "px off at most" in remark
