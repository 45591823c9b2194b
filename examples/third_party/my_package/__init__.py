"""A package of its own: a learner, an environment and a source of experience for erl_torch."""

from my_package.environment import Ring
from my_package.learner import Sweeps
from my_package.source import Biased

__all__ = ["Biased", "Ring", "Sweeps"]
