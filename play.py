"""Play a learnt policy in its environment.

``python play.py --help`` tells more.
"""

from erl_torch.cli.commands import play

if __name__ == "__main__":
    play()
