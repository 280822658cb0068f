"""Small valid scene files that the tests of this folder break in every way."""

CAMERA = """
[camera]
model = "equirectangular"
width = 200
height = 100
"""

SYNTHETIC = f"""
kind = "synthetic"
name = "little"
{CAMERA}
[simulation]
correspondences = 10
outlier_rate = 0.3
noise_px = 0.5
seed = 4
"""

MEASURED = f"""
kind = "correspondences"
name = "measured"
correspondences = "matches.csv"
{CAMERA}
[gravity]
camera = [0.0, 1.0, 0.0]
map = [0.0, 0.0, -1.0]

[truth]
cam_from_map = [[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]]

[options]
bound_px = 2.5
"""

CSV = """u,v,X,Y,Z,inlier,note
10.5,20.5,1.0,2.0,3.0,1,first
110.5,60.25,-1.0,0.5,4.0,0,
150.0,30.0,2e0,-1.5,0.25,1,"a, quoted"
"""


def write_measured(folder, scene=MEASURED, matches=CSV):
    """A scene and its CSV; texts or bytes. Returns the scene's path."""
    for name, content in (("scene.toml", scene), ("matches.csv", matches)):
        if content is not None:
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder / "scene.toml"


def write(folder, text):
    """One scene file of this text or these bytes."""
    path = folder / "scene.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path
