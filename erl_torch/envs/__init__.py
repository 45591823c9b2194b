"""Environments: one file each, registered here by name.

Importing this module registers them; the environments' own modules load when one is made, its functions on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gymnasium.envs.registration import register, registry

from erl_torch.lazy import loader

if TYPE_CHECKING:
    from erl_torch.envs.discretise import Discretise, UniformBins
    from erl_torch.envs.ends import EndReward
    from erl_torch.envs.frozen_lake import windy_frozen_lake
    from erl_torch.envs.grid_world import GridWorld
    from erl_torch.envs.mazes import random_maze, random_mazes
    from erl_torch.envs.shift import dynamics_shift
    from erl_torch.envs.tabular import GridWorldEnv, TabularEnv

EPISODE_LENGTH = 1000
CONTROL_EPISODE_LENGTH = 500

# Classic control with binned states: the task's module, and its environment's name there and here.
CONTROL_TASKS = {
    "pendulum": "DiscretePendulum",
    "mountain_car": "DiscreteMountainCar",
    "cart_pole": "DiscreteCartPole",
    "acrobot": "DiscreteAcrobot",
}
CONTROL_ENTRY_POINTS = {f"erl_torch/{name}-v0": f"{module}:{name}Env" for module, name in CONTROL_TASKS.items()}

ENTRY_POINTS = {
    "erl_torch/WindyCliff-v0": "windy_cliff:WindyCliffEnv",
    "erl_torch/WindyFrozenLake-v0": "frozen_lake:WindyFrozenLakeEnv",
    "erl_torch/WindyMaze-v0": "windy_maze:WindyMazeEnv",
    "erl_torch/DynamicsShift-v0": "shift:DynamicsShiftEnv",
    "erl_torch/TabularMDP-v0": "tabular:TabularFileEnv",
    "erl_torch/AccessControl-v0": "access_control:AccessControlEnv",
    "erl_torch/Admission-v0": "admission:AdmissionEnv",
    "erl_torch/CarRental-v0": "car_rental:CarRentalEnv",
    "erl_torch/Forest-v0": "forest:ForestEnv",
    "erl_torch/Inventory-v0": "inventory:InventoryEnv",
    "erl_torch/MachineReplacement-v0": "machine_replacement:MachineReplacementEnv",
    "erl_torch/RiverSwim-v0": "river_swim:RiverSwimEnv",
    "erl_torch/TwoChoice-v0": "two_choice:TwoChoiceEnv",
    "erl_torch/WindyStrip-v0": "windy_strip:WindyStripEnv",
    **CONTROL_ENTRY_POINTS,
}

for _id, _entry_point in ENTRY_POINTS.items():
    if _id not in registry:
        _length = CONTROL_EPISODE_LENGTH if _id in CONTROL_ENTRY_POINTS else EPISODE_LENGTH
        register(_id, entry_point=f"erl_torch.envs.{_entry_point}", max_episode_steps=_length)

_HOME = {
    "Discretise": "discretise",
    "EndReward": "ends",
    "GridWorld": "grid_world",
    "GridWorldEnv": "tabular",
    "TabularEnv": "tabular",
    "UniformBins": "discretise",
    "dynamics_shift": "shift",
    "random_maze": "mazes",
    "random_mazes": "mazes",
    "windy_frozen_lake": "frozen_lake",
}

__all__ = [
    "Discretise",
    "EndReward",
    "GridWorld",
    "GridWorldEnv",
    "TabularEnv",
    "UniformBins",
    "dynamics_shift",
    "random_maze",
    "random_mazes",
    "windy_frozen_lake",
]


__getattr__ = loader(__name__, _HOME)
