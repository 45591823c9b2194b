"""Draw docs/images/windy-strip.png: python benchmarks/strip_picture.py

The optimum of the grid, the optimist of control as inference, and the prior, in the same wind.
"""

from pathlib import Path

from erl_torch import solve_soft_bellman
from erl_torch.files import write_png
from erl_torch.networks.strip_pictures import OnGrid, paths_picture
from erl_torch.networks.truth import StripTruth

BETA = 5.0

if __name__ == "__main__":
    truth = StripTruth(BETA)
    shown = {
        "optimal": OnGrid(truth.solution.policy.numpy()),
        "optimistic": OnGrid(solve_soft_bellman(truth.strip.mdp, BETA, optimism=1.0).policy.numpy()),
        "uniform": OnGrid(truth.prior),
    }
    drawn = paths_picture(shown, {name: truth.figures(policy) for name, policy in shown.items()})
    write_png(Path(__file__).parents[1] / "docs" / "images" / "windy-strip.png", drawn)
