"""What learners with networks log beside ``erl_torch.log.quantities``."""

from __future__ import annotations

from erl_torch.log.quantities import RATE, RETURNS, Quantity

NETWORKS = "Networks"

NETWORK_QUANTITIES = (
    Quantity(
        "return_greedy",
        "reward",
        "networks: return of the episodes behind `eval/return`, from the same starts, of the most probable actions",
        ("eval", "prior"),
        board=RETURNS,
        chart="return of an episode, greedy",
        replicas=True,
    ),
    Quantity(
        "loss_of_policy",
        RATE,
        "networks, where a model tells the truth: theta\\* of it less the objective of the policy",
        ("eval", "prior"),
        board=RETURNS,
        chart="loss: optimum less objective",
        replicas=True,
    ),
    Quantity(
        "kl_to_optimal",
        "nats",
        "networks, where a model tells the truth: KL(optimal \\|\\| policy), mean over the optimum's long run",
        ("eval", "prior"),
        board=RETURNS,
        chart="KL from the optimal policy, nats",
        replicas=True,
    ),
    Quantity(
        "falls",
        "1/1000 steps",
        "windy strip: falls",
        ("eval", "prior"),
        board=RETURNS,
        chart="falls, per 1,000 steps",
        replicas=True,
    ),
    Quantity(
        "arrivals",
        "1/1000 steps",
        "windy strip: arrivals at the goal",
        ("eval", "prior"),
        board=RETURNS,
        chart="arrivals, per 1,000 steps",
        replicas=True,
    ),
    Quantity(
        "kl",
        "nats",
        "networks: KL(policy \\|\\| prior) a step, mean over the last epoch's observations",
        board=NETWORKS,
        chart="KL to the prior, nats",
        replicas=True,
    ),
    Quantity(
        "g",
        RATE,
        "networks: the rate that targets are less by; a device of the update, and no estimate of -theta",
        board=NETWORKS,
        chart="g of the update",
    ),
    Quantity(
        "loss",
        "reward^2",
        "networks: squared errors of a minibatch, halved, mean over the last epoch",
        board=NETWORKS,
        chart="loss, reward^2",
    ),
    Quantity(
        "exploration",
        "1",
        "networks: share of the steps that are drawn from the prior",
        board=NETWORKS,
        chart="exploration",
    ),
    Quantity(
        "episode_return",
        "reward",
        "networks: return of the episodes that ended in the last epoch, exploring",
        board=RETURNS,
        chart="return of a training episode",
        replicas=True,
    ),
    Quantity(
        "residual_lower",
        RATE,
        "deep_s1: 5% quantile of (1/beta) log sum pi0 exp(beta Q) - V at the last epoch's "
        "observations; a diagnostic, no bound",
        board=NETWORKS,
        chart="soft Q - V, 5% and 95% (a diagnostic)",
    ),
    Quantity(
        "residual_upper",
        RATE,
        "deep_s1: its 95% quantile",
        board=NETWORKS,
        chart="soft Q - V, 5% and 95% (a diagnostic)",
    ),
)
