"""Finite MDPs: tables, and what makes them of Gymnasium's environments."""
