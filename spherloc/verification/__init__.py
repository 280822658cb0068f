"""The paper's claims, each measured: its simulations as sweeps, and a verdict on each claim from their rows."""
