"""Where a model tells the truth about an environment with continuous observations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from erl_torch.envs.windy_strip import MOVES, strip_mdp
from erl_torch.networks.policy import Acting, NetworkPolicy
from erl_torch.networks.strip_pictures import OnGrid, paths_picture
from erl_torch.solvers.chains import long_run, policy_chain
from erl_torch.solvers.policy import objective
from erl_torch.solvers.soft_bellman import solve_soft_bellman


class StripTruth:
    """Judges policies of the windy strip exactly, on the grid of ``strip_mdp``: a policy acts as at the cell's centre.

    Args:
        beta, optimism: of the problem.
        nx, ny: cells.
    """

    def __init__(self, beta: float, optimism: float = 0.0, nx: int = 20, ny: int = 30) -> None:
        self.strip, self.beta, self.optimism = strip_mdp(nx, ny), beta, optimism
        self.prior = np.full(self.strip.falls.shape, 1.0 / len(MOVES))
        self.solution = solve_soft_bellman(self.strip.mdp, beta, optimism=optimism)
        best = self.solution.policy.numpy()
        self._met = self._long_run(best)
        self.optimum = self.figures(lambda _: best)

    def _long_run(self, policy: np.ndarray) -> np.ndarray:
        return long_run(policy_chain(self.strip.mdp.transition, policy), self.strip.mdp.start).of_state

    def figures(self, probabilities: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
        """Of the policy: objective (at optimism 0 the real one), reward_per_step, loss_of_policy (how far the objective
        of its optimism is below the optimum), kl_to_optimal, falls and arrivals per 1,000 steps."""
        policy = np.asarray(probabilities(self.strip.centres), np.float64)
        policy = policy / policy.sum(1, keepdims=True)
        share = self._long_run(policy)[:, None] * policy
        best = self.solution.policy.numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            apart = np.where(best > 0, best * np.log(best / policy), 0.0).sum(1)
        worth = objective(self.strip.mdp, policy, self.prior, self.beta, optimism=self.optimism)
        assert self.solution.theta is not None
        found = {
            "objective": worth,
            "reward_per_step": float((share * self.strip.mdp.reward).sum()),
            "loss_of_policy": -self.solution.theta - worth,
            "kl_to_optimal": float(self._met @ apart),
            "falls": 1000 * float((share * self.strip.falls).sum()),
            "arrivals": 1000 * float((share * self.strip.arrivals).sum()),
        }
        if self.optimism:
            found["objective_real"] = objective(self.strip.mdp, policy, self.prior, self.beta)
        return found

    def picture(self, policy: NetworkPolicy) -> np.ndarray:
        """Paths of the policy and of the optimum in the same wind, [H, W, 3] uint8."""
        shown: dict[str, Acting] = {"learnt": policy, "optimal": OnGrid(self.solution.policy.numpy())}
        return paths_picture(shown, {"learnt": self.figures(policy), "optimal": self.optimum})


TRUTHS = {"erl_torch/WindyStrip-v0": StripTruth}
"""By the id of the environment: beta and optimism -> what judges policies."""
