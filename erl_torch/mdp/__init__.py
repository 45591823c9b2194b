"""Finite MDPs: their tables, and how to read them from Gymnasium's environments."""
