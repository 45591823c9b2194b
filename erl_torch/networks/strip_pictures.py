"""Paths on the windy strip, of several policies in the same wind."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from erl_torch.envs.windy_strip import LENGTH, WIDTH, WindyStripEnv
from erl_torch.networks.policy import Acting
from erl_torch.pictures import COLOURS, DPI, pixels

LONGEST = 120  # steps of a path that is drawn


class OnGrid:
    """A policy [S, A] of the cells of ``strip_mdp(nx, ny)``, for any place on the strip."""

    def __init__(self, policy: np.ndarray, nx: int = 20, ny: int = 30) -> None:
        self._policy, self._nx, self._ny = policy, nx, ny

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Probabilities [N, A] at observations [N, 2]."""
        ix = np.clip((observation[:, 0] / WIDTH * self._nx).astype(int), 0, self._nx - 1)
        iy = np.clip((observation[:, 1] / LENGTH * self._ny).astype(int), 0, self._ny - 1)
        return np.asarray(self._policy[ix * self._ny + iy])

    def draw(self, observation: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of ``Acting``, but for the KL, which is not asked for."""
        p = self(observation)
        return np.minimum((np.cumsum(p, 1) <= uniform[:, :1]).sum(1), p.shape[1] - 1), np.zeros(len(p))

    def best(self, observation: np.ndarray) -> np.ndarray:
        """As of ``Acting``."""
        return np.asarray(self(observation).argmax(1))


def paths(policy: Acting, n: int, seed: int) -> list[tuple[np.ndarray, str]]:
    """``n`` episodes: places [T, 2], and how each ended: "fall", "goal" or ""; the wind is that of ``seed``."""
    found = []
    env = WindyStripEnv()
    for i in range(n):
        rng = np.random.default_rng([seed, i])
        observation, _ = env.reset(seed=int(rng.integers(2**31)))
        places, end = [observation], ""
        for _ in range(LONGEST):
            action = policy.draw(observation[None], rng.random((1, 1)))[0][0]
            observation, _, over, _, info = env.step(int(action))
            places.append(observation)
            if over:
                end = "fall" if info["failure"] else "goal"
                break
        found.append((np.array(places), end))
    return found


def paths_picture(
    shown: Mapping[str, Acting], figures: Mapping[str, Mapping[str, float]], n: int = 30, seed: int = 0
) -> np.ndarray:
    """A panel for each policy: ``n`` paths in the same wind, falls marked, and its rates beneath the title."""
    figure = Figure(figsize=(2.3 * len(shown) + 0.5, 4.6), dpi=DPI)
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for (name, policy), axes, colour in zip(shown.items(), panels, COLOURS, strict=False):
        for places, end in paths(policy, n, seed):
            axes.plot(places[:, 0], places[:, 1], color=colour, linewidth=0.7, alpha=0.5)
            if end == "fall":
                axes.plot(-0.03, places[-1, 1], marker="x", color="black", markersize=5, clip_on=False)
        axes.axvspan(-0.09, 0, color="#bbbbbb")
        axes.axhspan(LENGTH, LENGTH + 0.08, color="#cfe8cf")
        axes.set_xlim(-0.09, WIDTH)
        axes.set_ylim(0, LENGTH + 0.08)
        axes.set_aspect("equal")
        axes.set_xticks([0, 0.5, 1])
        told = figures.get(name, {})
        rates = f"\n{told['falls']:.2g} falls, {told['arrivals']:.2g} goals\nper 1,000 steps" if told else ""
        axes.set_title(f"{name}{rates}", fontsize=9)
        axes.set_xlabel("x; cliff left of 0", fontsize=8)
    panels[0].set_ylabel("y; the goal is at 2", fontsize=8)
    figure.tight_layout()
    return pixels(figure)
