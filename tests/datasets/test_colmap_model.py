"""COLMAP models: what is read is what was written, by pycolmap or by hand, in all of the format's forms."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from colmap_samples import (
    EQUIRECTANGULAR,
    NO_POINT,
    binary_files,
    sample_model,
    text_files,
    with_rigs,
    write,
)
from scipy.spatial.transform import Rotation

from spherloc.errors import CalibrationError, InputError
from spherloc.formats.colmap_files import read_model
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[2]

FORMS = pytest.mark.parametrize("files_of", [binary_files, text_files], ids=["binary", "text"])


def check_against(model, sample):
    """Everything that the sample has is in the model, and nothing else."""
    assert list(model.images) == sorted(image[3] for image in sample.images)
    for _, cam_from_map, camera, name, seen in sample.images:
        image = model.images[name]
        np.testing.assert_allclose(image.cam_from_map, cam_from_map, atol=1e-12)
        assert image.camera_id == camera
        np.testing.assert_array_equal(image.pixels, [item[:2] for item in seen])
        assert image.point_ids.tolist() == [-1 if item[2] == NO_POINT else item[2] for item in seen]
    assert model.points.ids.tolist() == [point[0] for point in sample.points]
    np.testing.assert_array_equal(model.points.xyz, [point[1] for point in sample.points])
    np.testing.assert_array_equal(model.points.errors_px, [point[2] for point in sample.points])
    assert model.points.track_lengths.tolist() == [len(point[3]) for point in sample.points]


@FORMS
@pytest.mark.parametrize("layout", ["old", "rigs"])
def test_what_was_written_is_read(layout, files_of, rng, tmp_path):
    sample = sample_model(rng)
    if layout == "rigs":
        sample = with_rigs(sample, rng)
    model = read_model(write(tmp_path / "model", files_of(sample)))
    check_against(model, sample)
    assert model.remarks == ()
    for number, _, width, height, params in sample.cameras:
        assert model.raw_cameras[number][1:] == (width, height, params)
        assert (model.camera(number).width, model.camera(number).height) == (width, height)


@FORMS
def test_poses_of_a_rig_are_those_of_its_frames(files_of, rng, tmp_path):
    """The poses beside the images are a copy, which other tools may have left as it was: frames and rigs decide."""
    sample = with_rigs(sample_model(rng), rng)
    stale = [(image[0], np.eye(3, 4), *image[2:]) for image in sample.images]
    model = read_model(write(tmp_path / "model", files_of(replace(sample, images=stale))))
    check_against(model, sample)


@FORMS
def test_an_image_whose_rig_leaves_its_pose_open_is_left_out_and_counted(files_of, rng, tmp_path):
    sample = with_rigs(sample_model(rng), rng, frames=3)
    (number, sensors) = sample.rigs[0]
    open_rig = [(number, [sensors[0], (sensors[1][0], None)])]
    model = read_model(write(tmp_path / "model", files_of(replace(sample, rigs=open_rig))))
    assert [image.camera_id for image in model.images.values()] == [sensors[0][0]] * 3
    assert len(model.remarks) == 1 and "3 images have no pose" in model.remarks[0]


def pycolmap_model(rng):
    """Every camera model of pycolmap in one rig, two frames, a few points, by pycolmap's own functions."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    kinds = [kind for name, kind in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
    for number, kind in enumerate(kinds, start=1):
        camera = pycolmap.Camera.create_from_model_id(number, kind, 300.0, 640, 480)
        model.add_camera(camera)
        offset = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(None, rng).as_quat()), rng.normal(size=3))
        if number == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, offset)
    model.add_rig(rig)
    for frame_id in (1, 2):
        turn = pycolmap.Rotation3d(Rotation.random(None, rng).as_quat())
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1, rig_from_world=pycolmap.Rigid3d(turn, rng.normal(size=3)))
        images = []
        for camera_id in model.cameras:
            image = pycolmap.Image(
                name=f"{frame_id}/{camera_id:02}.png",
                camera_id=camera_id,
                image_id=100 * frame_id + camera_id,
                points2D=pycolmap.Point2DList([pycolmap.Point2D(rng.uniform(0, 400, 2)) for _ in range(3)]),
            )
            image.frame_id = frame_id
            frame.add_data_id(image.data_id)
            images.append(image)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(frame_id)
    for place in range(3):
        track = pycolmap.Track([pycolmap.TrackElement(100 + camera, place) for camera in model.cameras])
        model.add_point3D(rng.normal(size=3), track)
    return model


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_models_of_every_camera_kind_with_rigs_by_pycolmap(form, rng, tmp_path):
    written = pycolmap_model(rng)
    (written.write_binary if form == "bin" else written.write_text)(str(tmp_path))
    model = read_model(tmp_path)
    assert len(model.images) == len(written.images) == 36
    for image in written.images.values():
        read = model.images[image.name]
        np.testing.assert_allclose(read.cam_from_map, image.cam_from_world().matrix(), atol=1e-12)
        np.testing.assert_allclose(read.pixels, [point.xy for point in image.points2D], atol=1e-9)
        pixels, points = read.observed(model)
        expected = [written.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
        np.testing.assert_allclose(points, np.reshape(expected, (-1, 3)), atol=1e-12)
        assert len(pixels) == len(expected)
    outcomes = {}
    for number, camera in written.cameras.items():
        name, width, height, params = model.raw_cameras[number]
        assert (name, width, height) == (camera.model.name, 640, 480)
        np.testing.assert_allclose(params, camera.params, rtol=1e-14)
        try:
            outcomes[name] = model.camera(number)
        except CalibrationError as error:
            assert name in str(error) or "EQUIRECTANGULAR" in name
    assert {"OPENCV_FISHEYE", "EUCM", "PINHOLE"} <= outcomes.keys()
    assert "FOV" not in outcomes  # not supported, and no harm to the others


def test_points_by_id(rng, tmp_path):
    sample = sample_model(rng)
    shuffled = replace(sample, points=sample.points[::-1])
    model = read_model(write(tmp_path / "model", binary_files(shuffled)))
    xyz = model.point_xyz(np.array([105, -1, 99, 100, 10**12, 129]))
    np.testing.assert_array_equal(xyz[[0, 3, 5]], [sample.points[k][1] for k in (5, 0, 29)])
    assert np.isnan(xyz[[1, 2, 4]]).all()
    empty = replace(sample, points=[])
    model = read_model(write(tmp_path / "empty", binary_files(empty)))
    assert np.isnan(model.point_xyz(np.array([100, -1]))).all()


def test_observations_are_read_from_a_file_that_is_still_the_same(rng, tmp_path):
    folder = write(tmp_path / "model", binary_files(sample_model(rng)))
    model = read_model(folder)
    images = folder / "images.bin"
    images.write_bytes(images.read_bytes()[:-100])
    with pytest.raises(InputError, match="has changed since it was loaded"):
        _ = list(model.images.values())[-1].pixels
    images.unlink()
    with pytest.raises(InputError, match="no such file; load the scene again"):
        _ = list(model.images.values())[-1].pixels


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_a_missing_file_is_named(name, rng, tmp_path):
    folder = write(tmp_path / "model", binary_files(with_rigs(sample_model(rng), rng)))
    (folder / name).unlink()
    with pytest.raises(InputError, match=f"{name} is missing"):
        read_model(folder)


def test_a_folder_without_model_hints_at_the_one_inside(rng, tmp_path):
    with pytest.raises(InputError, match=r"no COLMAP model .* give the folder that holds one"):
        read_model(tmp_path)
    write(tmp_path / "0", binary_files(sample_model(rng)))
    with pytest.raises(InputError, match=r"no COLMAP model .* give one of its folders 0"):
        read_model(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        read_model(tmp_path / "sparse")


@FORMS
def test_spheres_of_the_fork_are_refused_in_one_sentence(files_of, rng, tmp_path):
    sample = sample_model(rng, models=(EQUIRECTANGULAR,))
    model = 11 if files_of is binary_files else "SPHERE"
    sample = replace(sample, cameras=[(7, model, 640, 320, (1.0, 320.0, 160.0))])
    with pytest.raises(InputError, match=r"SPHERE, which only the fork SphereSfM knows .* EQUIRECTANGULAR"):
        read_model(write(tmp_path / "model", files_of(sample)))


def test_two_images_of_one_name_are_refused(rng, tmp_path):
    sample = sample_model(rng)
    doubled = replace(sample, images=[(*image[:3], "same.jpg", image[4]) for image in sample.images])
    with pytest.raises(InputError, match=r"two images have the name 'same.jpg'"):
        read_model(write(tmp_path / "model", binary_files(doubled)))


def test_names_with_spaces_and_letters_of_all_kinds(rng, tmp_path):
    sample = sample_model(rng)

    def named(form):
        return replace(sample, images=[(*image[:3], form.format(image[0]), image[4]) for image in sample.images])

    spaced, unspaced = named("stra\u00dfe {}/\u7532 b.jpg"), named("stra\u00dfe/\u7532{}.jpg")
    check_against(read_model(write(tmp_path / "0", binary_files(spaced))), spaced)
    check_against(read_model(write(tmp_path / "1", text_files(unspaced))), unspaced)
    with pytest.raises(InputError, match=r"images.txt, line 2: the image's name has a space"):
        read_model(write(tmp_path / "2", text_files(spaced)))


def test_the_commas_of_an_old_kapture_export_are_named():
    folder = real_data("kapture_t265") / "samples" / "t265" / "colmap"
    with pytest.raises(InputError, match=r"images.txt, line 5: has commas between its values"):
        read_model(folder)


def test_the_real_panorama_pair():
    folder = real_data("stella_equirect_pair") / "colmap_equirect" / "0"
    model = read_model(folder)
    assert len(model.points.ids) == 854 and model.points.track_lengths.tolist() == [2] * 854
    for image in model.images.values():
        camera = model.camera(image.camera_id)
        pixels, points = image.observed(model)
        assert len(pixels) == 854
        projected, seen = camera.project(points @ image.cam_from_map[:, :3].T + image.cam_from_map[:, 3])
        assert seen.all()
        assert np.sqrt(((projected - pixels) ** 2).sum(axis=1)).mean() < 0.2  # the model's own 0.185 px
