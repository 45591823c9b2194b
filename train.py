"""Learn the optimal entropy-regularised policy of a stochastic MDP from a stream of tuples.

``python train.py --help`` tells more.
"""

from erl_torch.cli.commands import train

if __name__ == "__main__":
    train()
