"""Small kapture trees in the exact layout."""

SENSORS = """# kapture format: 1.1
# sensor_id, name, sensor_type, [sensor_params]+
left, left fisheye, camera, OPENCV_FISHEYE, 848, 800, 284.5, 285.5, 424.25, 393.75, 0.001, 0.03, -0.03, 0.005
right, , camera, SIMPLE_PINHOLE, 640, 480, 500, 320, 240
blind, , camera, UNKNOWN_CAMERA, 640, 480
imu0, , accelerometer
"""

RIGS = """# kapture format: 1.1
# rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz
head, left,  1.0, -0.0, -0.0, -0.0, 0.032,  0.0,  0.0
head, right, 0.8, 0, 0.6, 0, -0.032,  0.0,  0.1
car, head, 0.6, 0, 0, 0.8, 1, 2, 3
loose, left,  ,  ,  ,  ,  ,  ,
"""

TRAJECTORIES = """# kapture format: 1.1
# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz
1553180224000000000, car, 0.8, 0.6, 0, 0, 5, 6, 7
1553180224100000000, head, 1, 0, 0, 0, 0, 0, 1
1553180224200000000, right, 1, 0, 0, 0, 0, 0, 2
1553180224200000000, left, 1, 0, 0, 0, , ,
"""

RECORDS = """# kapture format: 1.1
# timestamp, device_id, image_path
1553180224000000000, left, left/0.jpg
1553180224000000000, right, right/0.jpg
1553180224100000000, left, left/1.jpg
1553180224100000000, right, right/1.jpg
1553180224200000000, right, right/2.jpg
1553180224200000000, left, left/2.jpg
1553180224300000000, left, left/3.jpg
1553180224300000000, blind, blind/3.jpg
"""

FILES = {"sensors": SENSORS, "rigs": RIGS, "trajectories": TRAJECTORIES, "records_camera": RECORDS}


def write_kapture(root, images=(), **files):
    """The files of ``FILES``, some of them changed (text or bytes) or left out (None), and empty images."""
    (root / "sensors").mkdir(parents=True, exist_ok=True)
    for name, content in (FILES | files).items():
        path = root / "sensors" / f"{name}.txt"
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for name in images:
        path = root / "sensors" / "records_data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    return root
