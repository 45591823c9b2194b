"""Pictures: sizes that fit TensorBoard's cards, and contents that follow the data."""

import numpy as np
import pytest

from erl_torch import pictures
from erl_torch.envs import grid_pictures
from erl_torch.envs.grid_world import GridWorld, uniform_wind
from erl_torch.envs.windy_cliff import WindyCliffEnv

GRID = WindyCliffEnv().grid
LARGE = GridWorld(("S" + "F" * 29,) + ("F" * 30,) * 29, uniform_wind(1.0, 0.5))


@pytest.mark.parametrize("grid", [GRID, LARGE, None], ids=["cliff", "30x30", "table"])
@pytest.mark.parametrize("draw", [grid_pictures.policy_picture, grid_pictures.bias_picture])
def test_size_and_type(draw, grid):
    n_states = 15 if grid is None else grid.tiles.size
    picture = draw(np.full((n_states, 4), 0.25), grid, "title")
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3
    assert max(picture.shape[:2]) <= pictures.MAX_PX + 1
    assert picture.std() > 5  # not blank


@pytest.mark.parametrize(
    "labels",
    [
        [str({"season": i, "stock": j}) for i in (0, 1) for j in range(5)],
        ["a" * 30 + str(i) + "b" * 30 for i in range(3)],
        [a + "m" * 40 + b + "n" * 40 + c for a in "ab" for b in "cd" for c in "ef"],
        ["x" * 40, "x" * 41, "x" * 42, ""],
        ["a$b" * 9, "short"],
    ],
)
def test_labels_are_cut_where_they_are_alike(labels):
    """None longer than 24 letters, as many different ones as there were; a short one is left as it is."""
    found = pictures.brief(labels)
    assert len(found) == len(set(found)) == len(labels)
    assert max(len(text.replace("\\$", "$")) for text in found) <= 24
    assert pictures.brief(["go", "stay $"]) == ["go", r"stay \$"]


def blue(picture):
    r, g, b = np.moveaxis(picture.astype(int), -1, 0)
    return (b - r > 60) & (g < 120)


def test_arrows_point_where_the_policy_goes():
    """All on one action in the middle tile: the arrow's pixels lie on that side of the tile's centre."""
    grid = GridWorld(("RRR", "RRR", "SRR"))
    for action, (axis, sign) in enumerate([(1, -1), (0, 1), (1, 1), (0, -1)]):
        policy = np.zeros((9, 4))
        policy[4, action] = 1
        pixels = np.argwhere(blue(grid_pictures.policy_picture(policy, grid)))
        height, width = grid_pictures.policy_picture(policy, grid).shape[:2]
        px = (height - 30) / 3
        centre = np.array([24 + 1.5 * px, width / 2])
        assert width >= height - 24
        offset = pixels.mean(0) - centre
        assert sign * offset[axis] > 0.1 * px
        assert abs(offset[1 - axis]) < 0.05 * px


def test_traps_and_goal_have_no_arrows():
    grid = GridWorld(("HG", "SR"))
    assert not blue(grid_pictures.policy_picture(np.vstack([np.full((2, 4), 0.25), np.zeros((2, 4))]), grid)).any()


def test_bias_colours_follow_the_values():
    flat, peaked = np.zeros((15, 4)), np.zeros((15, 4))
    peaked[7, 2] = 1.0
    change = np.argwhere((grid_pictures.bias_picture(flat, GRID) != grid_pictures.bias_picture(peaked, GRID)).any(-1))
    width = grid_pictures.bias_picture(flat, GRID).shape[1] - 80  # without the colour bar
    grid_part = change[change[:, 1] < 200]
    px = (400 - 30) / 5
    centre = 24 + 2.5 * px, (6 + width) / 2  # state 7: row 2, col 1
    assert (np.abs(grid_part - centre) < px / 2 + 2).all()
    assert grid_part[:, 1].mean() > centre[1]  # action 2 points right


def test_agent_is_drawn_where_it_stands():
    board = grid_pictures.board(GRID)
    for cell in [(0, 0), (4, 1)]:
        change = np.argwhere((grid_pictures.with_agent(board, GRID.shape, cell) != board).any(-1))
        np.testing.assert_allclose(change.mean(0), (np.array(cell) + 0.5) * 64 - 0.5, atol=1)


def test_exact_values_of_settings_are_not_joined():
    """They are known at the settings alone: between two of them nothing is drawn."""
    one = {"mean": 1.0, "q25": 0.9, "q75": 1.1, "min": 0.0, "max": 2.0}
    for markers in (True, False):
        with_exact, without = (
            pictures.bands({"y": [pictures.BandLine("a", [1, 2], [one] * 2, exact)]}, "x", "title", markers)
            for exact in ([0.5, 0.5], [None, None])
        )
        below = slice(len(without) // 6, len(without) - len(without) // 8)  # neither the heading nor the caption
        changed = (with_exact != without)[below].any((0, 2)).sum()  # columns of the picture, 450 between the two
        assert 8 < changed < 40 if markers else changed > 200
