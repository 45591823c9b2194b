"""The smallest charge at which failures are as rare as asked for, where tuples are all that there is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from erl_torch.checks import InputError
from erl_torch.empirical.counts import empirical_mdp
from erl_torch.experience.experience import Experience
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solvers.charge import Charge, smallest_charge


def charge_of_tuples(
    free: Experience, charged: Experience, beta: float, target: float, prior_policy: ArrayLike
) -> Charge:
    """``smallest_charge`` of the model that the tuples count.

    A slow multiplier that learns from these tuples, pass after pass, has this charge as its limit: none is needed, nor
    a step size for it. Exact for the counts; how far it is from the charge of the real process is not bounded.

    Args:
        free: the tuples, with the rewards as they are.
        charged: the same tuples, the rewards of those that fail less by 1.
        beta: inverse temperature, 1/reward, > 0.
        target: failures a step, in (0, 1).
        prior_policy: [S, A].

    Raises:
        InputError: a stream without an empirical problem, that has no failure in it, or whose counts no policy meets
            the target in.
    """
    prior = np.asarray(prior_policy, np.float64)
    model, lower = (empirical_mdp(data, *prior.shape) for data in (free, charged))
    n = np.maximum(model.visits, 1)
    failing = np.rint((model.reward - lower.reward) * n) / n
    if not failing.any():
        raise InputError("end_reward", "auto", "a number: no tuple fails by this rule (env.failures)")
    posed = model.problem(beta, prior)
    one = posed.problem
    action = np.where(posed.used, np.arange(prior.shape[1]), posed.used.argmax(1)[:, None])[one.states]
    fails = np.take_along_axis(failing[one.states], action, axis=1)
    has = one.prior > 0
    mdp = TabularMDP(one.transition, np.where(has, one.reward, 0.0), one.start, allowed=has)
    return smallest_charge(mdp, np.where(has, fails, 0.0), beta, target, one.prior)
