"""Why a run failed or is doubtful."""

from spherloc.diagnosis.causes import Cause, Diagnosis, Measures
from spherloc.diagnosis.decide import diagnose

__all__ = ["Cause", "Diagnosis", "Measures", "diagnose"]
