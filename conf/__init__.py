"""The configurations, installed as ``erl_torch.conf``."""
