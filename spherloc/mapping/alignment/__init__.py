"""Gravity, scale and positions: from stated measurements, lines, sequences and calibrated rigs."""
