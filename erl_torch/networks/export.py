"""A learnt policy as a program of torch's own, ``policy.pt2``, which needs nothing of this package."""

from __future__ import annotations

import io
import os
from pathlib import Path

import torch

from erl_torch.files import write_bytes
from erl_torch.networks.policy import ActorPolicy, NetworkPolicy


class _Module(torch.nn.Module):
    """Observations [N, d] float32 -> probabilities [N, A]; of an actor the middle of the policy, [N, k]."""

    def __init__(self, policy: NetworkPolicy | ActorPolicy) -> None:
        super().__init__()
        layers = policy.layout.layers(policy.weights)
        self.n = len(layers)
        for i, (weight, bias) in enumerate(layers):
            self.register_buffer(f"weight{i}", weight.clone())
            self.register_buffer(f"bias{i}", bias.clone())
        self.beta = policy.beta if isinstance(policy, NetworkPolicy) else None
        if isinstance(policy, ActorPolicy):
            low, high = torch.tensor(policy.low), torch.tensor(policy.high)
            self.register_buffer("middle", (low + high) / 2)
            self.register_buffer("reach", (high - low) / 2)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        x = observation
        for i in range(self.n):
            x = x @ getattr(self, f"weight{i}") + getattr(self, f"bias{i}")
            if i < self.n - 1:
                x = torch.relu(x)
        if self.beta is not None:
            return torch.softmax(self.beta * x, 1)
        middle: torch.Tensor = self.get_buffer("middle")
        return middle + self.get_buffer("reach") * torch.tanh(x[:, : len(middle)])


def export_policy(policy: NetworkPolicy | ActorPolicy, path: str | os.PathLike[str]) -> Path:
    """Write ``policy`` for ``torch.export.load(path).module()``: observations [N, d] float32 to probabilities [N, A],
    or of an actor to the actions in the middle of the policy, [N, k]; N is any.
    """
    example = torch.zeros(2, policy.layout.widths[0])
    rows = {"observation": {0: torch.export.Dim("n", min=1)}}
    program = torch.export.export(_Module(policy).eval(), (example,), dynamic_shapes=rows)
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    return write_bytes(path, buffer.getvalue())
