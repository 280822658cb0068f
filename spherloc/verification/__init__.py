"""The paper's claims, each measured: its simulations as sweeps, and what their rows say of its sentences."""
