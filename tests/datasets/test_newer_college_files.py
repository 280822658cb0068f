"""Names, IMU files, point clouds and alignments: what they hold, and one sentence for whatever bytes are in them."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import mutations
from newer_college_tree import NS, QUERY_WALK, between
from scipy.spatial.transform import Rotation

from spherloc.datasets.imu import ImuSamples, down_at, read_imu
from spherloc.datasets.newer_college import Similarity, align, images_in, read_cloud, similarity_of, timestamp_of
from spherloc.errors import InputError
from spherloc.geometry import camera_centre, pose, transform

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


@pytest.mark.parametrize(
    "name, time",
    [
        ("1583836591_182590976.png", 1583836591182590976),
        ("infra1_1583836591_182590976.png", 1583836591182590976),
        ("cam0/1583836591_5.jpg", 1583836591000000005),
        ("1583836591182590976.png", 1583836591182590976),
        ("left-1583836591182590976.png", 1583836591182590976),
        ("0000000012.png", None),
        ("1583836591.png", None),
        ("1583836591_1825909760.png", None),
        ("image_12.png", None),
        ("1583836591182590976_left.png", None),
        ("٣٥٨٣٨٣٦٥٩١_1.png", None),
        ("", None),
    ],
)
def test_time_in_a_name(name, time):
    assert timestamp_of(name) == time


@given(st.integers(10**17, 10**19 - 1), st.sampled_from(["", "cam0_", "a/b/left-"]))
def test_any_time_is_read_back(time, before):
    assert timestamp_of(f"{before}{time}.png") == time
    assert timestamp_of(f"{before}{time // NS}_{time % NS:09d}.png") == time


def test_images_are_in_the_order_of_time(folder):
    place = folder / "images"
    place.mkdir()
    for name in ("1000000009_5.png", "1000000010_3.png", "1000000009_40.png", "cover.png", "1000000011_0.csv"):
        (place / name).touch()
    images, untimed = images_in(place)
    assert [image.name for image in images] == ["1000000009_5.png", "1000000009_40.png", "1000000010_3.png"]
    assert untimed == 1
    (place / "1000000009000000005.png").touch()
    with pytest.raises(InputError, match="the same time"):
        images_in(place)


def test_no_image_with_a_time(folder):
    place = folder / "none"
    place.mkdir()
    (place / "a.png").touch()
    with pytest.raises(InputError, match="none of its 1 images has a time"):
        images_in(place)


IMU = "#counter,sec,nsec,wx,wy,wz,ax,ay,az\n" + "".join(
    f"{n},1583836591,{5_000_000 * n},0.01,-0.02,0.5,0.1,{0.2 * n},9.7\n" for n in range(4)
)


def write(folder, content, name):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_imu_file(folder):
    samples = read_imu(write(folder, IMU, "imu.csv"))
    assert samples.timestamps_ns.tolist() == [1583836591 * NS + 5_000_000 * n for n in range(4)]
    np.testing.assert_array_equal(samples.rates_rad_s[2], [0.01, -0.02, 0.5])
    np.testing.assert_array_equal(samples.forces_m_s2[3], [0.1, 0.2 * 3, 9.7])


def test_an_imu_file_as_euroc_has_it(folder):
    rows = "".join(f"{10**18 + 5 * n},0.1,0.2,0.3,9.7,0,{n}\n" for n in range(3))
    samples = read_imu(write(folder, f"#timestamp [ns],w_RS_S_x [rad s^-1]\n{rows}", "imu.csv"))
    assert samples.timestamps_ns.tolist() == [10**18, 10**18 + 5, 10**18 + 10]
    np.testing.assert_array_equal(samples.forces_m_s2[2], [9.7, 0, 2])
    with pytest.raises(InputError, match=r"line 1: '1.5' is not a time in whole nanoseconds"):
        read_imu(write(folder, "1.5,0,0,0,9.8,0,0\n", "wrong.csv"))


@pytest.mark.parametrize(
    "text, says",
    [
        ("", "no measurement"),
        (IMU.splitlines()[0], "no measurement"),
        (IMU.replace("9.7", "0.99"), "m/s^2 of gravity"),
        (IMU.replace("5000000,", "0,", 1), "line 3"),
        (IMU.replace("1,1583836591,5000000", "1,1583836590,5000000"), "line 3"),
        (IMU.replace(",5000000,", ",1000000000,"), "line 3"),
        (IMU.replace("1,1583836591,5", "1,1583836591.5,5"), "line 3"),
        (IMU.replace("0.5", "nan", 1), "line 2"),
        (IMU.replace("0.5", "0.5,1", 1), "line 2"),
        (IMU.replace("0.5", "5e4", 1), "line 2"),
        (IMU.replace(",", " "), "has 1 column, separated by commas"),
        (IMU.rstrip().rpartition(",")[0], "line 5: is the last line and cut off; remove it"),
        (f"{10**18},0.1,0,0,0,0,0\n{10**18 + 5},0.1,0,0,0,0,0\n", "a gyroscope alone cannot tell where down is"),
        (IMU.replace(",9.7", ""), "line 2: has 8 columns, separated by commas"),
    ],
)
def test_wrong_imu_file_is_one_sentence(folder, text, says):
    path = write(folder, text, "wrong.csv")
    with pytest.raises(InputError) as caught:
        read_imu(path)
    assert str(caught.value).startswith(str(path)) and says in str(caught.value)


def degrees_between(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


def walk_samples(rng, first_s=0.0, last_s=40.0, bias_rad_s=0.005):
    times = np.array(between(QUERY_WALK, first_s, last_s, 200))
    rates, forces = QUERY_WALK.imu((times - QUERY_WALK.start_ns) / NS, rng, bias_rad_s)
    return ImuSamples(times, rates, forces)


def true_down(times_ns):
    rotations, _ = QUERY_WALK.map_from_imu((np.asarray(times_ns) - QUERY_WALK.start_ns) / NS)
    return rotations.inv().apply([0.0, 0.0, -1.0])


def test_down_at_rest_is_against_the_measured_force():
    times = np.arange(0, 3 * NS, NS // 100)
    force = 9.81 * np.array([0.6, 0.0, -0.8])
    samples = ImuSamples(times, np.zeros((len(times), 3)), np.tile(force, (len(times), 1)))
    down = down_at(samples, times[[0, 100, -1]])
    np.testing.assert_allclose(down, np.tile([-0.6, 0.0, 0.8], (3, 1)), atol=1e-12)


def test_down_follows_a_turn_between_two_samples():
    """A turn of a radian a second about x: down turns with it, to the nanosecond of the image."""
    times = np.arange(0, 20 * NS, NS // 200)
    rotations = Rotation.from_rotvec(np.column_stack([times / NS, 0 * times, 0 * times]))
    samples = ImuSamples(times, np.tile([1.0, 0, 0], (len(times), 1)), rotations.inv().apply([0, 0, 9.81]))
    asked = np.array([10 * NS, 10 * NS + 1_000_000, 10 * NS + 4_999_999])
    expected = Rotation.from_rotvec(np.column_stack([asked / NS, 0 * asked, 0 * asked])).inv().apply([0, 0, -1.0])
    assert degrees_between(down_at(samples, asked), expected).max() < 1e-3


def test_down_of_a_walking_person(rng):
    """Within the loader's bound while the device sways, turns and accelerates, where the accelerometer alone is not."""
    samples = walk_samples(rng)
    off = degrees_between(down_at(samples, samples.timestamps_ns), true_down(samples.timestamps_ns))
    alone = degrees_between(-samples.forces_m_s2, true_down(samples.timestamps_ns))
    assert off.max() < 2.0 and np.median(off) < 0.7
    assert np.quantile(alone, 0.9) > 2.0 * np.quantile(off, 0.9)


def test_bias_of_the_gyroscope_cancels_but_at_the_ends(rng):
    samples = walk_samples(rng, bias_rad_s=0.02)
    off = degrees_between(down_at(samples, samples.timestamps_ns), true_down(samples.timestamps_ns))
    assert off[1600:-1600].max() < 2.0
    assert off.max() < 5.0


def test_gaps_have_no_direction(rng):
    """Nothing is guessed before, after and between the measurements, nor from a fraction of a second."""
    one, two, three = (walk_samples(rng, *span) for span in ((0, 5), (6, 6.5), (8, 12)))
    joined = ImuSamples(
        np.concatenate([part.timestamps_ns for part in (one, two, three)]),
        np.concatenate([part.rates_rad_s for part in (one, two, three)]),
        np.concatenate([part.forces_m_s2 for part in (one, two, three)]),
    )
    asked = np.array([QUERY_WALK.start_ns + round(t * NS) for t in (-0.001, 0, 4.9, 5.0, 5.5, 6.2, 7, 9, 12, 12.001)])
    down = down_at(joined, asked)
    known = np.isfinite(down).all(axis=1)
    assert known.tolist() == [False, True, True, True, False, False, False, True, True, False]
    assert degrees_between(down[known], true_down(asked[known])).max() < 3.0
    assert len(down_at(joined, np.empty(0, dtype=np.int64))) == 0


POINTS = np.array([[1.5, -2.0, 0.25], [7.0, 8.0, -1.0], [0.0, 3.0, 0.0], [1.0, 1.0, 1.0]])
PLY = trimesh.PointCloud(POINTS).export(file_type="ply")
ASCII_PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
)
ASCII_PLY += b"1 2 3\n4 5 6\n"


def test_cloud(folder):
    np.testing.assert_allclose(read_cloud(write(folder, PLY, "a.ply")), POINTS)
    np.testing.assert_allclose(read_cloud(write(folder, ASCII_PLY, "b.ply")), [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    "content, says",
    [
        (b"", "no PLY"),
        (b"ply\n", "no PLY"),
        (PLY.replace(b"vertex 4", b"vertex 400000000000"), "more points than fit"),
        (PLY.replace(b"vertex 4", b"vertex -4"), "more points than fit"),
        (ASCII_PLY.replace(b"vertex 2", b"vertex 0").replace(b"1 2 3\n4 5 6\n", b""), "point"),
        (ASCII_PLY.replace(b"1 2 3", b"nan 2 3").replace(b"4 5 6", b"inf 5 6"), "no finite point"),
    ],
)
def test_wrong_cloud_is_one_sentence(folder, content, says):
    path = write(folder, content, "wrong.ply")
    read_cloud.cache_clear()
    with pytest.raises(InputError) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(str(path)) and says in str(caught.value)


READERS = {"imu": (read_imu, IMU), "ply": (read_cloud, PLY), "ascii": (read_cloud, ASCII_PLY)}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of trimesh
@pytest.mark.parametrize("kind", READERS)
@given(data=st.data())
@settings(max_examples=60)
def test_any_bytes_are_read_or_refused(folder, kind, data):
    read, sample = READERS[kind]
    path = write(folder, data.draw(st.one_of(mutations(sample), st.binary(max_size=80))), f"fuzz-{kind}")
    read_cloud.cache_clear()
    try:
        found = read(path)
    except InputError as error:
        message = str(error)
        assert message.startswith(str(path)) and message.isprintable() and len(message) < 600
    else:
        values = found.forces_m_s2 if kind == "imu" else found
        assert len(values) and np.isfinite(values).all()


def test_alignment_ignores_a_few_wrong_positions(rng):
    true = Similarity(2.7, Rotation.random(None, rng).as_matrix(), rng.normal(0, 50, 3))
    old = rng.normal(0, 8, (60, 3)) * [1.0, 0.5, 0.05]
    new = true.points(old) + rng.normal(0, 0.01, old.shape)
    new[::6] += rng.normal(0, 15, (10, 3))
    found = align(old, new, "here")
    assert found.similarity.scale == pytest.approx(true.scale, rel=2e-3)
    np.testing.assert_allclose(found.similarity.points(old), true.points(old), atol=0.03)
    assert 45 <= found.used <= 50 and 0.005 < found.rms_m < 0.03


def test_alignment_of_exact_positions_is_exact(rng):
    true = Similarity(0.01, Rotation.random(None, rng).as_matrix(), np.array([4e5, -5e6, 100.0]))
    old = rng.normal(0, 8, (4, 3)) * [1.0, 1.0, 0.0]  # in a plane, which leaves a mirror image open
    found = align(old, true.points(old), "here").similarity
    np.testing.assert_allclose(found.rotation, true.rotation, atol=1e-7)


def test_positions_that_have_nothing_in_common_do_not_fit(rng):
    """Also few of them, most of which any similarity would bring to each other."""
    for count in (4, 5, 40):
        with pytest.raises(InputError, match="do not fit"):
            align(rng.normal(0, 5, (count, 3)), rng.normal(0, 5, (count, 3)), "here")


@pytest.mark.parametrize(
    "old, says",
    [
        (np.zeros((2, 3)), "it takes three"),
        (np.zeros((5, 3)), "on a line"),
        (np.outer(np.arange(6), [1.0, 2.0, 3.0]), "on a line"),
        (np.array([[1e300, 0, 0], [0, 1, 0], [0, 0, 1]]), "beyond"),
    ],
)
def test_positions_that_fix_nothing(old, says):
    with pytest.raises(InputError, match=says):
        align(old, np.eye(len(old), 3) * 10, "here")


def test_similarity_moves_points_and_cameras_alike(rng):
    """A point is seen in the same direction from both frames, and as many times farther as the scale says."""
    given = 3.5 * Rotation.random(None, rng).as_matrix()
    similarity = similarity_of(np.column_stack([given, [1.0, -2.0, 30.0]]).tolist(), "key", "here")
    cam_from_old = pose(Rotation.random(None, rng).as_matrix(), rng.normal(0, 3, 3))
    points = rng.normal(0, 5, (20, 3))
    np.testing.assert_allclose(similarity.points(points), points @ given.T + [1.0, -2.0, 30.0])
    seen_old = transform(cam_from_old, points)
    seen_new = transform(similarity.pose(cam_from_old), similarity.points(points))
    np.testing.assert_allclose(seen_new, 3.5 * seen_old, atol=1e-9)
    centre = camera_centre(similarity.pose(cam_from_old))
    np.testing.assert_allclose(centre, similarity.points(camera_centre(cam_from_old)[None])[0], atol=1e-9)
