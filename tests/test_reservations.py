"""Reservations: true streams give none, and each fault its own."""

import numpy as np

from erl_torch.reservations import of_model, of_next_actions, of_outcome
from erl_torch.solution import Status


def test_next_actions_of_the_prior_and_of_another_policy():
    prior = np.array([[0.5, 0.5], [0.9, 0.1]])
    rng = np.random.default_rng(0)
    for _ in range(200):
        assert of_next_actions(np.stack([rng.multinomial(1000, row) for row in prior]), prior) == []
    assert len(of_next_actions(np.array([[700, 300], [900, 100]]), prior)) == 1
    assert of_next_actions(np.array([[4, 0], [0, 0]]), prior) == []  # too few to tell


def test_model_and_outcome():
    assert of_model(1.0, 0.01, (1.04, 1.05)) == []
    assert len(of_model(1.0, 0.01, (1.06, 1.07))) == len(of_model(1.0, 0.01, (0.9, 0.94))) == 1
    assert of_outcome(Status.COMPLETED, -1.0, -1.6) == []
    assert len(of_outcome(Status.PSI_LIMIT, -2.0, -1.6)) == 2
