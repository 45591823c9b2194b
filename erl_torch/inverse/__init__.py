"""From behaviour to reward: the solution as a differentiable function, and the reward behind demonstrations."""
