"""Pictures of sweeps and of localized sequences as PNG."""
