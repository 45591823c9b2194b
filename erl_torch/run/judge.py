"""What a run is held against."""

from __future__ import annotations

import numpy as np

from erl_torch.checks import InputError
from erl_torch.empirical.counts import EmpiricalMDP
from erl_torch.empirical.uncertainty import Estimate, theta_uncertainty
from erl_torch.solvers.chains import SingularChainError

SMALL = 2000  # states of a model, or that a stream meets, up to which it is solved beside every run


def of_data(model: EmpiricalMDP | None, beta: float, prior: np.ndarray) -> Estimate:
    """theta* with its error, as a stream alone has it; withheld, with a value of NaN, where that cannot be had."""
    if model is None:
        reason = "the squares of the rewards overflow"
    elif (met := int(model.visits.any(1).sum())) > SMALL:
        reason = f"the stream meets {met:,} states, and more than {SMALL:,} are not solved beside a run"
    else:
        try:
            return theta_uncertainty(model, beta, prior)
        except InputError as error:  # streams that return nowhere
            reason = str(error)
        except (SingularChainError, np.linalg.LinAlgError):
            reason = "the chain of the data falls apart in double precision"
    return Estimate("theta", np.nan, np.inf, withheld=reason)
