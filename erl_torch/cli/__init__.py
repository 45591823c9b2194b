"""The command line: Hydra, signals, sweeps."""
