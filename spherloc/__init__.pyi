from spherloc.cameras.calibration import load_camera as load_camera
from spherloc.cameras.double_sphere import DoubleSphere as DoubleSphere
from spherloc.cameras.equirectangular import Equirectangular as Equirectangular
from spherloc.cameras.eucm import Eucm as Eucm
from spherloc.cameras.fisheye624 import Fisheye624 as Fisheye624
from spherloc.cameras.kannala_brandt import KannalaBrandt as KannalaBrandt
from spherloc.cameras.mei import Mei as Mei
from spherloc.cameras.ocam import Ocam as Ocam
from spherloc.cameras.radial_poly import RadialPoly as RadialPoly
from spherloc.datasets import bundled_scenes as bundled_scenes
from spherloc.datasets import load_scene as load_scene
from spherloc.diagnosis import diagnose as diagnose
from spherloc.errors import CalibrationError as CalibrationError
from spherloc.errors import InputError as InputError
from spherloc.errors import ProblemError as ProblemError
from spherloc.errors import RecordingError as RecordingError
from spherloc.errors import SpherlocError as SpherlocError
from spherloc.estimators import estimate as estimate
from spherloc.estimators import options_type as options_type
from spherloc.localization import Localization as Localization
from spherloc.localization import estimate_absolute_pose as estimate_absolute_pose
from spherloc.localization import gravity_from_image as gravity_from_image
from spherloc.localization import localize as localize
from spherloc.localization import localize_bearings as localize_bearings
from spherloc.metrics import evaluate as evaluate
from spherloc.problem import Problem as Problem
from spherloc.trace import Trace as Trace

EXPORTS: dict[str, str]
__version__: str
