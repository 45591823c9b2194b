"""Every quantity that is logged, defined once.

Tags, boards, bands, axes of pictures, ``result.json``, summaries and the tables of docs/logging.md
(``docs/tools/quantities.py``) are made from ``QUANTITIES``. A tag is ``PREFIX/NAME``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from erl_torch.checks import InputError

CONVERGENCE, BIAS, RETURNS = "Did theta converge?", "Reward bias", "Returns"
RATE = "reward a step"
STEP = ("epoch", "n_tuples")  # of metrics(), and no tags: the step of a record says it

# What stands before the name in a tag: whose quantity it is.
PREFIXES = {
    "learner": (
        "What the learner logs of its own estimates (`metrics()`). `_lower` and `_upper`, of `learner=exact`, are "
        "proven: theta\\* is neither below the one nor above the other (the best bounds so far)"
    ),
    "eval": "Figures of the policy, measured at each record",
    "optimal": (
        "Exact figures of the optimal policy of the known model; constant (models of up to `evaluation.exact_up_to` "
        "transitions, `evaluation.certify=true`). `_lower` and `_upper` are proven bounds on theta\\*: minus the "
        "largest and the smallest TV(s) - V(s) of `solve_soft_bellman`. There is no return where episodes have to be "
        "played. The optimal policy maximises the objective, so a policy may well have a better return or reward a "
        "step. Of `learner=exact` itself: two points, at step 0 and the last, once it has converged"
    ),
    "prior": "Figures of the prior policy, those of step 0; constant",
    "data": (
        "theta\\* of the empirical model, less its bias, from the visit counts alone; `_lower` and `_upper` are the "
        "ends of its 95% interval; constant (up to 2,000 states; no interval where the counts are too few: "
        "`erl_torch/empirical/uncertainty.py`)"
    ),
    "Final": (
        "What the run ended with, once, at the end, for tab *HParams*. Of replicas: means over those of the group with "
        "the best mean objective, and its gap to the optimum"
    ),
    "time": "Speed, once, at the end; without evaluation and pictures",
    "GROUP": "Of runs of many learners: statistics over replicas, see below",
}
# Runs once logged s1/NAME and exact/NAME instead of learner/NAME: charts of new runs show the old ones too.
LEARNER = "(learner|s1|exact)"


@dataclass(frozen=True)
class Quantity:
    """One quantity that is logged.

    Args:
        name: letters, digits and ``_``: its key in ``metrics()``, and the end of its tags.
        unit: as tables and pictures write it; "1" for a pure number.
        meaning: its definition, in Markdown.
        prefixes: of its tags, keys of ``PREFIXES``.
        ends: those prefixes under which ``NAME_lower`` and ``NAME_upper`` may stand too.
        board: title of the board with its chart; "" for none.
        chart: title of the chart, which quantities may share; "" is ``axis``.
        label: name in pictures; "" is the name, with spaces.
        replicas: whether runs of replicas log statistics of it.
        result: key of ``result.json`` that holds it at the end of a run; "" for none.
        digits: format of the numbers in the summary of a run; "" leaves it out.
        row: name in the summary; "" is the name, with spaces.

    Raises:
        InputError: a name or prefix that is not as above.
    """

    name: str
    unit: str
    meaning: str
    prefixes: tuple[str, ...] = ("learner",)
    ends: tuple[str, ...] = ()
    board: str = ""
    chart: str = ""
    label: str = ""
    replicas: bool = False
    result: str = ""
    digits: str = ""
    row: str = ""

    def __post_init__(self) -> None:
        plain = self.name.replace("_", " ")
        object.__setattr__(self, "label", self.label or plain)
        object.__setattr__(self, "row", self.row or plain)
        if not re.fullmatch(r"\w+", self.name):
            raise InputError("quantities", self.name, "a name of letters, digits and _")
        for prefix in (*self.prefixes, *self.ends):
            if prefix not in PREFIXES:
                raise InputError(f"quantities.{self.name}", prefix, f"a prefix among {', '.join(PREFIXES)}")

    @property
    def axis(self) -> str:
        """Label and unit, as pictures write them."""
        return self.label if self.unit in ("1", self.label) else f"{self.label}, {self.unit}"

    @property
    def tags(self) -> list[str]:
        """All tags that it may have in a run of one learner."""
        ends = {prefix: ("", "_lower", "_upper") if prefix in self.ends else ("",) for prefix in self.prefixes}
        return [f"{prefix}/{self.name}{end}" for prefix, found in ends.items() for end in found]

    @property
    def lines(self) -> list[str]:
        """Patterns of the tags that are lines of its chart: each value, and of the data's interval the ends."""
        patterns = {
            "learner": f"{LEARNER}/{self.name}$",
            "eval": f"eval/{self.name}$",
            "optimal": f"optimal/{self.name}$",
            "prior": f"prior/{self.name}$",
            "data": f"data/{self.name}_(lower|upper)$",
        }
        return [patterns[prefix] for prefix in self.prefixes if prefix in patterns]


_ESTIMATE = ("learner", "optimal")
_FIGURE = ("eval", "optimal", "prior", "Final")

# In the order of rows in tables, of keys in result.json, and of charts on a board.
QUANTITIES = (
    Quantity(
        "theta",
        RATE,
        "`-log(rho)/beta - delta_max`: minus the regularised reward rate of the unbiased problem. Of an action-value "
        "learner: minus its reward rate. Of `learner=exact`: -G(V) of the biasing iteration, at most theta\\* "
        "(optimistic); of a Newton step, the middle of the bounds",
        (*_ESTIMATE, "data", "Final"),
        ends=("learner", "optimal", "data"),
        board=CONVERGENCE,
        chart="theta; theta* of the model, ends of the data's 95%",
        replicas=True,
        result="theta",
        digits=".5f",
    ),
    Quantity(
        "rho",
        "1",
        "estimate of the Perron root of the tilted, biased matrix; a step of rewards multiplies by it, so it lies in "
        "(0, exp(beta max r)]. Of the optimum: exp(-beta (theta\\* + Delta))",
        _ESTIMATE,
        board=CONVERGENCE,
        chart="rho; of the optimum",
        replicas=True,
        result="rho",
        digits=".4e",
    ),
    Quantity(
        "delta_max",
        "reward",
        "Delta, the largest reward bias `(log<psi> - <log psi>)/beta` over the pairs that occur (eq. 9, line 6)",
        _ESTIMATE,
        board=BIAS,
        chart="delta, largest; of the optimum",
        label="largest reward bias",
        replicas=True,
        result="reward_bias_max",
    ),
    Quantity(
        "delta_mean",
        "reward",
        "mean reward bias over all pairs (s,a), 0 for pairs that never occur",
        _ESTIMATE,
        board=BIAS,
        chart="delta, mean; of the optimum",
    ),
    Quantity(
        "psi_error",
        "1",
        "relative error at which lines 2-3 stopped: the largest change of `<psi>` and `<log psi>` from one epoch to "
        "the next",
        board=CONVERGENCE,
        chart="error of psi, relative",
    ),
    Quantity("psi_epochs", "epochs", "how many epochs lines 2-3 took"),
    Quantity(
        "bias_iteration",
        "count",
        "0 is the iteration without a bias (psi = 1): the optimistic policy",
        board=CONVERGENCE,
        chart="biasing iteration",
    ),
    Quantity(
        "empirical_width",
        RATE,
        "`s1_efficient`, `certainty_equivalence`: proven bound on the policy's loss in the empirical model",
        board=CONVERGENCE,
        chart="loss in the empirical model, at most",
        label="bound on the loss in the empirical model",
        replicas=True,
    ),
    Quantity("n_replaced", "count", "states of the online mode: phases at whose end V was taken from the counts"),
    Quantity(
        "kl_max",
        "nats",
        "largest KL(optimal dynamics of the biased problem \\|\\| p) over (s,a); below 1e-6 the paper counts the "
        "problem as solved; 0 for Newton steps",
        board=CONVERGENCE,
        chart="KL to the dynamics, nats",
    ),
    Quantity("q_min", "reward", "smallest action value", board=CONVERGENCE, chart="action values, extremes"),
    Quantity("q_max", "reward", "largest action value", board=CONVERGENCE, chart="action values, extremes"),
    Quantity(
        "reward_per_step",
        RATE,
        "expected return of `evaluation.horizon` steps from the start, divided by their number: exact where the model "
        "is known (grid worlds, tables `P`, estimated models up to `evaluation.exact_up_to` transitions); otherwise "
        "total reward over total steps of the sampled episodes",
        _FIGURE,
        board=RETURNS,
        chart="reward a step; optimal, prior",
        label=RATE,
        replicas=True,
        result="reward_per_step",
        digits=".5f",
    ),
    Quantity(
        "objective",
        RATE,
        "J: reward rate minus KL(policy \\|\\| prior)/beta a step. Stationary and exact where the model is known (only"
        " somewhere between its bounds where products of probabilities underflow); otherwise over the sampled "
        "episodes; of a log alone, in the model of its counts. Its maximum is -theta, so compare it with minus "
        "`learner/theta`. Of a learner with `optimism`: the nested J at that optimism",
        _FIGURE,
        board=RETURNS,
        chart="objective; optimal, prior",
        label="objective J",
        replicas=True,
        result="objective",
        digits=".5f",
    ),
    Quantity(
        "objective_real",
        RATE,
        "J at optimism 0, where the learner's is another: what the policy is worth in the real world, less KL/beta. Of "
        "the optimum: what the optimal policy of that optimism is worth there",
        _FIGURE,
        board=RETURNS,
        chart="objective in the real world; optimal, prior",
        label="objective J in the real world",
        replicas=True,
        result="objective_real",
        digits=".5f",
        row="objective, real",
    ),
    Quantity(
        "return",
        "reward",
        "undiscounted return of an episode of at most `evaluation.horizon` steps (and the environment's own limit), "
        "mean over `evaluation.n_episodes` episodes played in the environment; its exact expectation where Gymnasium's"
        " table `P` tells how episodes end. Control tasks: in the original, with its own rewards",
        _FIGURE,
        board=RETURNS,
        chart="return of an episode; optimal, prior",
        label="return of an episode",
        replicas=True,
        result="return",
        digits=".2f",
        row="episode return",
    ),
    Quantity(
        "success_rate",
        "1",
        "share of episodes that end, within `evaluation.horizon` steps and the environment's own limit, in an end that "
        "is no failure (`env.failures`); where every end is one, that do not end: exact where `return` is, else of the "
        "episodes played",
        _FIGURE,
        board=RETURNS,
        chart="success rate; optimal, prior",
        replicas=True,
        result="success_rate",
        digits=".4f",
    ),
    Quantity("gap", RATE, "how far the policy's objective can be below its maximum, at most", ("Final",), result="gap"),
    Quantity("tuples_per_second", "1/s", "u updates a second of learning time", ("time",)),
    Quantity("iterations_per_second", "1/s", "`learner=exact`: iterations a second of solving time", ("time",)),
)
BY_NAME = {quantity.name: quantity for quantity in QUANTITIES}
# What pictures and lines of replicas show, in their order.
BANDS = ("theta", "delta_max", "reward_per_step", "objective", "objective_real", "return", "success_rate")
SWEEP = ("theta", "objective", "objective_real", "delta_max")
PROGRESS = ("theta", "delta_max", "reward_per_step", "objective")


def with_own(own: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
    """``QUANTITIES``, and behind them those of a learner's own.

    Raises:
        InputError: a name that stands twice.
    """
    names = {*BY_NAME, *STEP}
    for quantity in own:
        if quantity.name in names:
            raise InputError("quantities", quantity.name, "a name that no other quantity has (docs/logging.md)")
        names.add(quantity.name)
    return (*QUANTITIES, *own)


def tagged(prefix: str, values: Mapping[str, float]) -> dict[str, float]:
    """``values`` by tag instead of name; what is told by the step of a record is left out."""
    return {f"{prefix}/{name}": value for name, value in values.items() if name not in STEP}


def results(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """Those of ``values`` (by name) that belong in ``result.json``, by their keys there."""
    return {q.result: values[q.name] for q in QUANTITIES if q.result and q.name in values}
