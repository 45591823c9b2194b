"""Rebuild a figure or table of the paper: numbers as CSV and JSON, picture as PNG and SVG.

``python reproduce.py --help`` tells more.
"""

from erl_torch.cli.commands import reproduce

if __name__ == "__main__":
    reproduce()
