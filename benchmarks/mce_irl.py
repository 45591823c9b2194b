"""The tabular MCE IRL of the package `imitation` on demonstrations from a file; `benchmarks/inverse.py` starts it.

    pip install imitation           in an environment of its own: it asks for older releases than this package does
    PYTHON benchmarks/mce_irl.py INPUT.npz OUTPUT.npz

INPUT: transition [S, A, S], start [S], states [episodes, horizon + 1], max_iter, lr, eps. OUTPUT: reward [S] and the
first step's policy [S, A], seconds, iterations; its rewards are those of beta 1, and the state's alone.
"""

from __future__ import annotations

import importlib.metadata
import sys
import time

import numpy as np
import torch
from imitation.algorithms import mce_irl  # type: ignore[import-not-found]
from imitation.rewards import reward_nets  # type: ignore[import-not-found]
from seals.base_envs import TabularModelPOMDP  # type: ignore[import-not-found]


def main() -> None:
    given = np.load(sys.argv[1])
    episodes = given["states"]
    n_states, horizon = len(given["start"]), episodes.shape[1] - 1
    env = TabularModelPOMDP(
        transition_matrix=given["transition"],
        observation_matrix=np.eye(n_states),
        reward_matrix=np.zeros(n_states),
        horizon=horizon,
        initial_state_dist=given["start"],
    )
    shares = np.bincount(episodes.ravel(), minlength=n_states) / len(episodes)  # as it counts states
    torch.manual_seed(0)
    net = reward_nets.BasicRewardNet(
        env.observation_space,
        env.action_space,
        use_action=False,
        use_next_state=False,
        use_done=False,
        hid_sizes=[],
    ).double()
    irl = mce_irl.MCEIRL(
        shares,
        env,
        net,
        rng=np.random.default_rng(0),
        optimizer_kwargs={"lr": float(given["lr"])},
        linf_eps=float(given["eps"]),
        grad_l2_eps=0.0,
        log_interval=None,
    )
    steps = []
    train_step = irl._train_step
    irl._train_step = lambda observations: steps.append(0) or train_step(observations)  # counted, not changed
    begin = time.process_time()
    irl.train(max_iter=int(given["max_iter"]))
    seconds = time.process_time() - begin
    with torch.no_grad():
        observations = torch.as_tensor(env.observation_matrix, dtype=net.dtype)
        reward = mce_irl.squeeze_r(net(observations, None, None, None)).numpy()
    version = importlib.metadata.version("imitation")
    np.savez(sys.argv[2], reward=reward, policy=irl.policy.pi[0], seconds=seconds, n=len(steps), version=version)


if __name__ == "__main__":
    main()
