"""Compare learners on the same experience, against the exact optimum of a known model.

``python compare.py --help`` tells more.
"""

from erl_torch.cli.commands import compare

if __name__ == "__main__":
    compare()
