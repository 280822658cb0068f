"""Robust pose estimators behind one function."""

from spherloc.estimators.base import default_options, estimate, options_type
from spherloc.estimators.warm_up import warm_up

__all__ = ["default_options", "estimate", "options_type", "warm_up"]
