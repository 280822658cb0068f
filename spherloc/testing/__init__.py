"""The contracts of what packages may register, as checks that spherloc's own kinds pass (docs/extending.md).

Each check raises ``AssertionError`` with one sentence that says what is wrong and where; none needs a test framework.
"""

from spherloc.testing.cameras import check_calibration_reader, check_camera
from spherloc.testing.datasets import check_dataset
from spherloc.testing.estimators import check_estimator, check_solver

__all__ = ["check_calibration_reader", "check_camera", "check_dataset", "check_estimator", "check_solver"]
