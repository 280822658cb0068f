"""Small cameras of three models that worlds are looked at with."""

from spherloc.cameras.calibration import camera_from_table

MEI = {"model": "mei", "width": 180, "height": 176, "fx": 167.0, "fy": 167.0, "cx": 90.0, "cy": 88.0, "xi": 2.2}
KANNALA = {"model": "kannala_brandt", "width": 160, "height": 160, "fx": 60.0, "fy": 60.0, "cx": 80.3, "cy": 79.6}
TABLES = {
    "mei": MEI | {"distortion": [0.0168, 1.65, 0.0004, 0.0004]},
    "kannala_brandt": KANNALA | {"distortion": [0.003, 0.0007, -0.002, 0.0002]},
    "equirectangular": {"model": "equirectangular", "width": 192, "height": 96},
}


def camera(model, **changes):
    return camera_from_table(TABLES[model] | changes, "test")
