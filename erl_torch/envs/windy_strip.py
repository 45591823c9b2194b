"""The windy strip: a windy cliff with continuous states, and a model of it on a grid."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import scipy.sparse as sp
from scipy.stats import norm

from erl_torch import checks
from erl_torch.mdp.tabular import TabularMDP

WIDTH, LENGTH = 1.0, 2.0
STRIDE = 0.1
MOVES = np.array([[STRIDE, 0.0], [-STRIDE, 0.0], [0.0, STRIDE], [0.0, -STRIDE]])  # right, left, on, back
WIND_MEAN, WIND_SD = np.array([-0.03, 0.0]), np.array([0.06, 0.04])
FALL, GOAL = -10.0, 5.0
START_LOW, START_HIGH = np.array([0.2, 0.0]), np.array([0.4, 0.1])
LEAST = 1e-14  # probabilities of cells below this are left out


class WindyStripEnv(gym.Env[Any, Any]):
    """Walk along a cliff in gusts of wind.

    ## Description
    A strip of land, 1 wide and 2 long, with a cliff along its left side and the goal at its far end. Wind blows towards
    the cliff, and varies. The shortest way is straight on; who counts on luck takes it.

    ## Action Space
    `Discrete(4)`: 0 right, 1 left, 2 on, 3 back, each .1 far.

    ## Observation Space
    `Box([0, 0], [1, 2])`: x, the distance from the cliff, and y, along the strip.

    ## Starting State
    Uniform in x from .2 to .4, y from 0 to .1.

    ## Dynamics
    x grows by the move and N(-.03, .06^2), y by the move and N(0, .04^2); at x = 1 and y = 0 there are walls.

    ## Rewards
    -10 for a fall, 5 at the goal, 0 elsewhere.

    ## Episode End
    x below 0, a fall, or else y of 2 or more, the goal. The registered environment truncates after 1000 steps.

    ## Arguments
    `render_mode` (None).

    ## Version History
    v0: first version.
    """

    def __init__(self, render_mode: str | None = None) -> None:
        checks.one_of("render_mode", str(render_mode), ("None",))
        self.render_mode = None
        self.action_space = gym.spaces.Discrete(4)
        self.observation_space = gym.spaces.Box(np.zeros(2, np.float32), np.array([WIDTH, LENGTH], np.float32))
        self._at = np.zeros(2)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._at = self.np_random.uniform(START_LOW, START_HIGH)
        return self._at.astype(np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        x, y = self._at + MOVES[action] + WIND_MEAN + WIND_SD * self.np_random.standard_normal(2)
        fallen, arrived = bool(x < 0), bool(x >= 0 and y >= LENGTH)
        self._at = np.array([min(max(x, 0.0), WIDTH), min(max(y, 0.0), LENGTH)])
        reward = FALL if fallen else GOAL if arrived else 0.0
        return self._at.astype(np.float32), reward, fallen or arrived, False, {"failure": fallen}


class Strip(NamedTuple):
    """The strip on a grid of nx by ny cells; state ix * ny + iy."""

    mdp: TabularMDP  # an end leads to the start
    centres: np.ndarray  # [S, 2], of the cells
    falls: np.ndarray  # [S, A], the probability of a fall
    arrivals: np.ndarray  # [S, A], of the goal


def strip_mdp(nx: int = 20, ny: int = 30) -> Strip:
    """The model of ``WindyStripEnv`` in which a state is uniform in its cell after every step.

    Raises InputError for fewer than 2 cells a side.
    """
    checks.at_least("nx", nx, 2)
    checks.at_least("ny", ny, 2)
    x, y = np.linspace(0, WIDTH, nx + 1), np.linspace(0, LENGTH, ny + 1)
    start = np.outer(_share(x, START_LOW[0], START_HIGH[0]), _share(y, START_LOW[1], START_HIGH[1])).ravel()
    rows, falls, arrivals = [], [], []
    for move in MOVES:
        to_x, below_x, above_x = _moves(x, move[0] + WIND_MEAN[0], WIND_SD[0])
        to_y, below_y, above_y = _moves(y, move[1] + WIND_MEAN[1], WIND_SD[1])
        to_x[:, -1] += above_x
        to_y[:, 0] += below_y
        fall = np.repeat(below_x, ny)
        arrive = np.outer(1 - below_x, above_y).ravel()
        stays = sp.kron(sp.csr_array(to_x), sp.csr_array(to_y))
        ends = sp.csr_array((fall + arrive)[:, None]) @ sp.csr_array(start[None])
        rows.append(sp.csr_array(stays + ends))
        falls.append(fall)
        arrivals.append(arrive)
    n = nx * ny
    by_state = sp.vstack(rows).tocsr()[np.arange(4 * n).reshape(4, n).T.ravel()]
    by_state = sp.csr_array(by_state)
    by_state.data[by_state.data < LEAST] = 0.0
    by_state.eliminate_zeros()
    by_state = sp.csr_array(sp.diags_array(1 / by_state.sum(1)) @ by_state)
    f, g = np.stack(falls, 1), np.stack(arrivals, 1)
    mid_x, mid_y = (x[:-1] + x[1:]) / 2, (y[:-1] + y[1:]) / 2
    centres = np.stack([np.repeat(mid_x, ny), np.tile(mid_y, nx)], 1)
    return Strip(TabularMDP(by_state, FALL * f + GOAL * g, start), centres, f, g)


def _share(edges: np.ndarray, low: float, high: float) -> np.ndarray:
    """The share of the cells in an interval, [n], sums to 1."""
    inside = np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0.0, None)
    return np.asarray(inside / inside.sum())


def _moves(edges: np.ndarray, shift: float, sd: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From uniform in a cell by ``shift`` and a normal error: the chances [n, n] of cells, [n] of below, of above.

    With I(z) = z Phi(z) + phi(z), whose derivative is Phi, the chance to end below t is
    (sd/w) (I((t - shift - low)/sd) - I((t - shift - high)/sd)), w = high - low.
    """

    def integral(z: np.ndarray) -> np.ndarray:
        return np.asarray(z * norm.cdf(z) + norm.pdf(z))

    low, high = edges[:-1, None], edges[1:, None]
    end = (edges[None] - shift - low) / sd
    below = sd / (high - low) * (integral(end) - integral(end - (high - low) / sd))
    return np.clip(np.diff(below, axis=1), 0.0, None), below[:, 0], 1.0 - below[:, -1]
