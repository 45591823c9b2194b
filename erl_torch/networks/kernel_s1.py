"""A finite MDP on representative observations, from recorded tuples: without a network, for few dimensions.

Representatives stand on a grid over the observations. The reward of (representative, action) is the mean of the nearest
tuples of that action, weighted by a Gaussian of their distance; each of their next observations is spread over the
nearest representatives in the same way. What comes out is a ``TabularMDP``: exact solver, certificate and bounds are
those of that model, and say nothing of how far it is from the environment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.networks.replay import Steps
from erl_torch.solution import Solution
from erl_torch.solvers.soft_bellman import solve_soft_bellman

MOST_DIMENSIONS = 4
MOST_REPRESENTATIVES = 100_000


@dataclass(frozen=True, eq=False)
class KernelModel:
    """What ``KernelS1.fit`` has found.

    Args:
        representatives: [m, d].
        mdp: the model on them.
        solution: of that model, with its own certificate.
        beta: inverse temperature, 1/reward.
        spacing: [d], of the grid: the unit of distances.
        neighbours, width: as of ``KernelS1``.
    """

    representatives: np.ndarray
    mdp: TabularMDP
    solution: Solution
    beta: float
    spacing: np.ndarray
    neighbours: int
    width: float

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Probabilities [N, A] at observations [N, d]: of the mean of the action values nearby."""
        tree = cKDTree(self.representatives / self.spacing)
        near, weight = _near(tree, np.asarray(observation, np.float64) / self.spacing, self.neighbours, self.width)
        assert self.solution.action_value is not None
        allowed = self.mdp.allowed
        q = np.where(allowed, self.solution.action_value.numpy(), 0.0)
        share = weight[:, :, None] * allowed[near]
        total = share.sum(1)
        mean = np.divide((share * q[near]).sum(1), total, out=np.full(total.shape, -np.inf), where=total > 0)
        tilted = np.exp(self.beta * (mean - mean.max(1, keepdims=True)))
        return np.asarray(tilted / tilted.sum(1, keepdims=True))


@dataclass(frozen=True)
class KernelS1:
    """S1 on representatives (S1-K).

    Args:
        beta: inverse temperature, 1/reward, > 0.
        cells: of the grid, a number for each dimension of an observation, at most four; whole numbers >= 2.
        optimism: 1 optimistic (control as inference), 0 right, negative robust.
        neighbours: tuples, and representatives, that count at most, >= 1.
        width: standard deviation of the Gaussian, in spacings of the grid, > 0.
        reach: spacings beyond which a tuple tells nothing of a representative, > 0.

    Raises:
        InputError: an argument out of its range.
    """

    beta: float
    cells: tuple[int, ...]
    optimism: float = 0.0
    neighbours: int = 12
    width: float = 0.7
    reach: float = 1.5

    def __post_init__(self) -> None:
        checks.temperature("beta", self.beta)
        checks.optimism("optimism", self.optimism, self.beta)
        checks.at_least("neighbours", self.neighbours, 1)
        for key in ("width", "reach"):
            checks.positive(key, getattr(self, key))
        cells = checks.sequence("cells", self.cells)
        for n in cells:
            checks.at_least("cells", n, 2)
        if not 1 <= len(cells) <= MOST_DIMENSIONS:
            raise InputError("cells", list(cells), f"one to {MOST_DIMENSIONS} numbers, one for each dimension")
        if np.prod(np.array(cells, float)) > MOST_REPRESENTATIVES:
            raise InputError("cells", list(cells), f"at most {MOST_REPRESENTATIVES:,} in all")

    def fit(self, steps: Steps, n_actions: int) -> KernelModel:
        """The model of ``steps``, solved; an action without a tuple nearby is one that the representative lacks.

        Raises:
            InputError: observations of other dimensions, or actions that are no whole numbers below ``n_actions``.
        """
        d = steps.observation.shape[1]
        if d != len(self.cells):
            raise InputError("cells", list(self.cells), f"{d} numbers, one for each dimension of an observation")
        if steps.action.ndim > 1 or (steps.action < 0).any() or (steps.action >= n_actions).any():
            raise InputError("action", "others", f"whole numbers in [0, {n_actions})")
        x = steps.observation.astype(np.float64)
        low, high = x.min(0), x.max(0)
        spacing = np.maximum((high - low) / np.array(self.cells), 1e-12)
        axes = [at + (np.arange(n) + 0.5) * h for at, n, h in zip(low, self.cells, spacing, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, d)
        trees: list[tuple[np.ndarray, cKDTree] | None] = []
        has = np.zeros((len(grid), n_actions), bool)
        for a in range(n_actions):
            rows = np.flatnonzero(steps.action == a)
            if not rows.size:
                trees.append(None)
                continue
            tree = cKDTree(x[rows] / spacing)
            has[:, a] = tree.query(grid / spacing)[0] <= self.reach
            trees.append((rows, tree))
        kept = has.any(1)
        representatives, has = grid[kept], has[kept]
        m = len(representatives)
        following = steps.following.astype(np.float64) / spacing
        near_next, share_next = _near(cKDTree(representatives / spacing), following, self.neighbours, self.width)
        reward = np.zeros((m, n_actions))
        blocks = []
        for a, found in enumerate(trees):
            members = np.flatnonzero(has[:, a])
            block = sp.csr_array((m, m))
            if found is not None and members.size:
                rows, tree = found
                near, weight = _near(tree, representatives[members] / spacing, self.neighbours, self.width)
                reward[members, a] = (weight * steps.reward[rows[near]]).sum(1)
                n = near.shape[1]
                pick = sp.csr_array(
                    (weight.ravel(), (np.repeat(members, n), rows[near].ravel())), shape=(m, len(steps))
                )
                width = near_next.shape[1]
                spread = sp.csr_array(
                    (share_next.ravel(), (np.repeat(np.arange(len(steps)), width), near_next.ravel())),
                    shape=(len(steps), m),
                )
                block = sp.csr_array(pick @ spread)
            blocks.append(block)
        whole = sp.csr_array(sp.vstack(blocks))[np.arange(n_actions * m).reshape(n_actions, m).T.ravel()]
        mdp = TabularMDP(sp.csr_array(whole), reward, allowed=has, normalise=True)
        solution = solve_soft_bellman(mdp, self.beta, _uniform(has), optimism=self.optimism)
        return KernelModel(representatives, mdp, solution, float(self.beta), spacing, self.neighbours, self.width)


def _uniform(has: np.ndarray) -> np.ndarray:
    return np.asarray(has / has.sum(1, keepdims=True))


def _near(tree: cKDTree, x: np.ndarray, n: int, width: float) -> tuple[np.ndarray, np.ndarray]:
    """([N, n'] the nearest to x [N, d], n' <= n; their weights, which sum to 1)."""
    n = min(n, tree.n)
    distance, near = tree.query(x, k=n)
    distance, near = distance.reshape(len(x), n), near.reshape(len(x), n)
    exponent = -0.5 * (distance / width) ** 2
    weight = np.exp(exponent - exponent.max(1, keepdims=True))
    return near, weight / weight.sum(1, keepdims=True)
