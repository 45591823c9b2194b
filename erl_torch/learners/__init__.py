"""Learners: ``fit(transitions, n_states, n_actions) -> Solution``, ``iterate(...)`` yields every epoch."""

from erl_torch.learners.algorithm_s1 import AlgorithmS1, NonFiniteError, S1State

LEARNERS = {"s1": AlgorithmS1}

__all__ = ["LEARNERS", "AlgorithmS1", "NonFiniteError", "S1State"]
