"""Learners of action values, as baselines."""
