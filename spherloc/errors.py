"""One exception tree. Every message is one sentence that says what, where, and what to do."""


class SpherlocError(Exception):
    """Base of every error that a user can cause; the command line shows it as one line and exits with code 2."""


class InputError(SpherlocError):
    """A file, key or value that the user gave cannot be used."""


class CalibrationError(InputError):
    """A camera calibration is unreadable or describes no usable camera."""


class ProblemError(InputError):
    """Correspondences do not form a localization problem (NaN, wrong shape, too few)."""


class RecordingError(SpherlocError):
    """A recording cannot be written or read."""
