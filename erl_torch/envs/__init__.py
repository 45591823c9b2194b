"""Environments: one file each, registered here by name.

Importing this module registers them; the environments' own modules load when one is made.
"""

from gymnasium.envs.registration import register, registry

EPISODE_LENGTH = 1000

ENTRY_POINTS = {
    "erl_torch/WindyCliff-v0": "erl_torch.envs.windy_cliff:WindyCliffEnv",
}

for _id, _entry_point in ENTRY_POINTS.items():
    if _id not in registry:
        register(_id, entry_point=_entry_point, max_episode_steps=EPISODE_LENGTH)
