"""Robust pose estimators behind one function."""

from spherloc.estimators.base import default_options, estimate, options_type

__all__ = ["default_options", "estimate", "options_type"]
