"""Environments: one file each, registered here by name.

Importing this module registers them; the environments' own modules load when one is made.
"""

from gymnasium.envs.registration import register, registry

EPISODE_LENGTH = 1000
CONTROL_EPISODE_LENGTH = 500

# Classic control with binned states: the task's module, and its environment's name there and here.
CONTROL_TASKS = {
    "pendulum": "DiscretePendulum",
    "mountain_car": "DiscreteMountainCar",
    "cart_pole": "DiscreteCartPole",
    "acrobot": "DiscreteAcrobot",
}
CONTROL_ENTRY_POINTS = {
    f"erl_torch/{name}-v0": f"erl_torch.envs.{module}:{name}Env" for module, name in CONTROL_TASKS.items()
}

ENTRY_POINTS = {
    "erl_torch/WindyCliff-v0": "erl_torch.envs.windy_cliff:WindyCliffEnv",
    **CONTROL_ENTRY_POINTS,
}

for _id, _entry_point in ENTRY_POINTS.items():
    if _id not in registry:
        _length = CONTROL_EPISODE_LENGTH if _id in CONTROL_ENTRY_POINTS else EPISODE_LENGTH
        register(_id, entry_point=_entry_point, max_episode_steps=_length)
