"""``EndReward``: a charge or a bonus at the ends of episodes, for learning from the steps of an environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs.encoded import encoded
from erl_torch.mdp.ends import EndRule, Rule, with_end_reward
from erl_torch.mdp.from_gymnasium import end_pays, model_ends, rule_of_ends


class EndReward(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Adds ``end_reward`` to the reward of a step that terminates an episode (``erl_torch.mdp.ends``).

    A charge, < 0, is added where the end is a failure, a bonus, > 0, where it is none. ``info["failure"]`` of an ending
    step says which it was. Truncated episodes have not ended. ``n_paid`` counts the ends that got it.

    Args:
        env: with finite spaces; they are Discrete then.
        end_reward: reward, finite.
        failures: the rule; "default" needs an environment that tells how its ends pay (a table ``P``, or this
            package's).

    Raises:
        InputError: an end_reward that is not finite, or that no end gets, or a rule that cannot be used.
    """

    def __init__(self, env: gym.Env[Any, Any], end_reward: float, failures: Rule = "default") -> None:
        gym.utils.RecordConstructorArgs.__init__(self, end_reward=end_reward, failures=failures)
        super().__init__(env := encoded(env))
        rule = rule_of_ends(failures, env)
        self.rule = EndRule(rule, checks.finite("end_reward", end_reward))
        self.n_paid = 0
        if end_pays(env) is not None:  # then the environment tells of all its ends
            ends = model_ends(env, failures)
            with_end_reward(0.0 * ends.ended, ends.ended, ends.failed, end_reward)
        if end_reward < 0 and rule.limit == -float("inf") and not rule.states:
            raise InputError("end_reward", end_reward, "0, or a bonus > 0: no end is a failure by this rule")
        if end_reward > 0 and rule.every:
            raise InputError("end_reward", end_reward, "0, or a charge < 0: every end is a failure by this rule")

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated:
            failed, more = self.rule.of(float(reward), int(observation))
            self.n_paid += more != 0
            info = {**info, "failure": failed}
            reward = float(reward) + more
        return observation, float(reward), terminated, truncated, info
