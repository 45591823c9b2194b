"""Tuples (s, a, r, s', a'): collected, simulated, recorded, read."""
