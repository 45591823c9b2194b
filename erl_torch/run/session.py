"""``train``: a logged run from Python, of objects that the caller has made."""

from __future__ import annotations

import os
import time
import warnings
from dataclasses import asdict, is_dataclass, replace
from pathlib import Path
from typing import Any, overload

import gymnasium as gym
import numpy as np
import yaml

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs.encoded import encoded, labels_of
from erl_torch.envs.tabular import TabularEnv
from erl_torch.experience.experience import EXPERIENCE, Experience, permitted
from erl_torch.experience.log import Log
from erl_torch.experience.simulation import ReplicaExperience, Simulation, digest, longest
from erl_torch.experience.sources import Source
from erl_torch.experience.transitions import Transitions
from erl_torch.files import alone
from erl_torch.learners.learner import CONTRACT, Table, TabularLearner, as_told, with_prior
from erl_torch.learners.replicas import Replicas, ReplicaSolution
from erl_torch.log.tensorboard import hyperparameters
from erl_torch.mdp.from_gymnasium import known_mdp, sizes
from erl_torch.mdp.masks import ActionMasks
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.notes import Note, collected, note
from erl_torch.problem import Problem
from erl_torch.rng import streams
from erl_torch.run.build import accepted, steps_of
from erl_torch.run.checkpoint import Checkpoints, failure_of
from erl_torch.run.groups import groups_among
from erl_torch.run.identity import environment, plain
from erl_torch.run.judge import EvaluationSettings
from erl_torch.run.loop import Run
from erl_torch.run.replicas import ReplicaRecorder
from erl_torch.run.report import Title
from erl_torch.run.single import SingleRecorder
from erl_torch.solution import Solution

KINDS = (Simulation, list, tuple)  # of experience that replicas take besides
Known = Problem | TabularMDP | gym.Env[Any, Any]
Given = Known | Log


@overload
def train(
    learner: TabularLearner[Any],
    problem: Given,
    experience: Experience | Source | None = None,
    *,
    directory: str | os.PathLike[str],
    seed: int = 0,
    evaluation: EvaluationSettings | None = None,
    checkpoint_every: float | None = 60.0,
    talks: bool = False,
) -> Solution: ...


@overload
def train(
    learner: Replicas,
    problem: Given,
    experience: ReplicaExperience | Source | None = None,
    *,
    directory: str | os.PathLike[str],
    seed: int = 0,
    evaluation: EvaluationSettings | None = None,
    checkpoint_every: float | None = 60.0,
    talks: bool = False,
) -> ReplicaSolution: ...


def train(
    learner: Any,
    problem: Given,
    experience: Any = None,
    *,
    directory: str | os.PathLike[str],
    seed: int = 0,
    evaluation: EvaluationSettings | None = None,
    checkpoint_every: float | None = 60.0,
    talks: bool = False,
) -> Any:
    """Learn in ``directory``: with TensorBoard's boards, checkpoints, ``result.json`` and the solution's file.

    The run of the command line, without its configuration. Called again after a stop or a crash, it goes on from the
    last checkpoint, bit for bit; a run that is complete is read. Nothing is printed, but for a warning where a file of
    the run is damaged, and no global setting is changed, unless ``talks``. Notes are warnings of class ``Note``, once
    the run is written.

    What a run is of, is the learner and its settings, the tuples (of a ``Source`` its settings), the model where it is
    known, and what Gymnasium knows of the environment; a directory of another run is refused. Of an environment that
    was not made by ``gymnasium.make`` and has no model only the class is known. Two runs at once in one process need
    processes, not threads.

    Args:
        learner: one learner, an exact solver, or ``Replicas``.
        problem: an environment of Gymnasium's with finite spaces, a model, or a ``Problem`` of both. Where the model is
            known, policies are evaluated on it and the solution is certified; of an environment with a table ``P`` give
            ``tabular_mdp(env)``. Of a ``Problem`` its own horizon counts. Or a ``Log``, as of ``read_log``: only what
            the data say is then written.
        experience: tuples to learn from, or a ``Source`` of them; of ``Replicas`` also one stream per replica, or a
            ``Simulation``. None of an exact solver, and of a ``Log``.
        directory: of the run; made if it is missing.
        seed: of the source, and of episodes that are played; replicas have ``seed``, ``seed + 1``, ...
        evaluation: what is measured of the policy while it learns; None is ``EvaluationSettings()``.
        checkpoint_every: seconds between checkpoints; 0 is after every epoch, None is none but on a stop.
        talks: show progress bar, milestones and summary.

    Raises:
        InputError: an argument that cannot be used, or a directory that holds another run.
        NonFiniteError: the learner (or a replica) left the finite numbers; everything is written, up to the last good
            epoch.
    """
    directory = Path(directory)
    made = not directory.exists()
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with alone(directory, "directory"):
            notes: list[str] = []
            try:
                with collected(print_them=talks) as notes:
                    given = (learner, problem, experience)
                    return _trained(*given, directory, seed, evaluation, checkpoint_every, talks, notes)
            finally:
                for text in () if talks else notes:
                    warnings.warn(text, Note, stacklevel=2)
    except NotADirectoryError as error:
        raise InputError("directory", directory, f"a directory, new or that of a run ({error.strerror})") from error
    except FileExistsError as error:
        raise InputError("directory", directory, "a directory, new or that of a run: it is a file") from error
    finally:
        if made and directory.is_dir() and not any(directory.iterdir()):
            directory.rmdir()


def _trained(
    learner: Any,
    problem: Given,
    experience: Any,
    directory: Path,
    seed: int,
    evaluation: EvaluationSettings | None,
    checkpoint_every: float | None,
    talks: bool,
    notes: list[str],
) -> Any:
    """``train``, in a directory that no other run is writing to."""
    began = time.perf_counter()
    seed = checks.at_least("seed", seed, 0)
    settings = EvaluationSettings() if evaluation is None else evaluation
    log, known, experience = _of_log(learner, problem, experience)
    one = _checked(learner, experience, settings, checkpoint_every)
    many = isinstance(learner, Replicas)
    given = _problem(known, one.prior_policy, settings.horizon)
    learner = with_prior(learner, given.allowed)
    learner.start(given)  # raises where the learner cannot learn this problem
    checksum = None if isinstance(experience, Source) else digest(experience)
    described = _described(learner, given, experience, seed, settings) | {"digest": checksum}
    saved = Checkpoints(directory, described, checkpoint_every, getattr(one, "device", "cpu"), "directory")
    if (found := saved.result()) is not None:
        saved.clear()
        if (failure := failure_of(found)) is not None:
            raise failure
        kind, name = (ReplicaSolution, "replicas.npz") if many else (Solution, "solution.npz")
        return kind.load(saved.directory / name)
    title = Title(given.name, described["learner"]["name"], seed)
    recorder: Any
    vary: dict[str, list[Any]] = {}
    if many:
        experience, seeds = _of_replicas(learner, given, experience, seed)
        learner, given = as_told(learner, given)
        experience = learner.permitted(experience, given.n_states, given.n_actions, note)
        learner.check(experience, given.n_states, given.n_actions)
        groups, vary = groups_among(learner.learners)
        recorder = ReplicaRecorder(learner, given, experience, groups, seeds, vary, settings, title, lambda: None, log)
        n_experience = longest(experience)
    else:
        if isinstance(experience, Source):
            experience = experience(given, seed, lambda _: None)
            checks.instance("experience", experience, Experience, EXPERIENCE)
        n_skipped = 0
        if experience is not None:
            experience, n_skipped = accepted(experience)
            learner, given = as_told(learner, given)
            experience = permitted(experience, given.prior, learner.drawn_from_prior == "a_next", note)
        rng = streams(seed).evaluation
        recorder = SingleRecorder(learner, given, experience, settings, rng, title, n_skipped, log)
        n_experience = 0 if experience is None else len(experience)
    # Columns of tab HParams: what varies among replicas by its name, not replica by replica.
    own = {key: value for key, value in described["learner"].items() if key not in ("module", "replicas")}
    shown = described | {"learner": own | {f"vary.{key}": plain(key, values, 1) for key, values in vary.items()}}
    run: Run[Any, Any, Any] = Run(
        learner=learner,
        problem=given,
        experience=experience,
        digest=digest(experience) if checksum is None else checksum,
        recorder=recorder,
        saved=saved,
        hyperparameters=hyperparameters(shown, n_experience=n_experience),
        configuration=yaml.safe_dump(described, sort_keys=False),
        every=settings.every,
        talks=talks,
        safe_point=lambda: None,
        began=began,
    )
    return run.perform(notes)[0]


def _of_log(learner: Any, problem: Given, experience: Any) -> tuple[Log | None, Known, Any]:
    """The log, if ``problem`` is one; what there is to learn; what from: its own experience, if no other is given."""
    if not isinstance(problem, Log):
        return None, problem, experience
    own = problem.experience if isinstance(learner, Replicas) else problem.recording
    return problem, problem.problem, own if experience is None else experience


def _checked(
    learner: Any, experience: object, settings: EvaluationSettings, checkpoint_every: float | None
) -> TabularLearner[Any]:
    """The learner, or the first of replicas. Raises InputError for arguments of ``train`` that cannot be used."""
    if checkpoint_every is not None and not (checks.is_number(checkpoint_every) and checkpoint_every >= 0):
        raise InputError("checkpoint_every", checkpoint_every, "seconds >= 0, or None")
    checks.instance("evaluation", settings, EvaluationSettings, "EvaluationSettings, or None")
    many = isinstance(learner, Replicas)
    one: Any = learner.learners[0] if many else learner
    if not is_dataclass(one) or isinstance(one, type):
        raise InputError("learner", learner, "a learner, as AlgorithmS1(): a dataclass derived from StreamLearner")
    absent = [name for name in CONTRACT if not hasattr(one, name)]
    if absent:
        raise InputError("learner", type(one).__name__, f"a learner: it has no {', '.join(absent)}")
    if learner.needs_model != (experience is None):
        allowed = "None: the learner solves the model" if learner.needs_model else "given: tuples, or a source of them"
        raise InputError("experience", type(experience).__name__, allowed)
    if isinstance(experience, Source):
        if not is_dataclass(experience):
            raise InputError("experience", experience, "a source that is a dataclass")
    elif many and isinstance(experience, KINDS):
        streams_given = () if isinstance(experience, Simulation) else experience
        for data in streams_given:
            checks.instance("experience", data, Transitions, "Transitions, one per replica")
    elif many and isinstance(experience, Experience):
        checks.instance("experience", experience, Transitions, "Transitions: replicas hold their tuples in memory")
    elif experience is not None:
        checks.instance("experience", experience, Experience, EXPERIENCE)
    found: TabularLearner[Any] = learner.learners[0] if many else learner
    return found


def _problem(given: Known, prior_policy: Table, horizon: int) -> Problem:
    """As a ``Problem``, with the prior of the learner. Raises InputError."""
    if isinstance(given, Problem):
        shape = given.n_states, given.n_actions
        prior = check_policy("learner.prior_policy", prior_policy, *shape, given.allowed)
        if given.env is None:
            return replace(given, prior=prior)
        env, source = encoded(given.env), encoded(given.source)
        states, actions = (known or own for known, own in zip(given.names, labels_of(env), strict=True))
        return replace(
            given,
            env=env,
            source=source,
            prior=prior,
            masks=ActionMasks(*shape),
            state_labels=states,
            action_labels=actions,
        )
    if isinstance(given, TabularMDP):
        prior = check_policy("learner.prior_policy", prior_policy, given.n_states, given.n_actions, given.allowed)
        return Problem(TabularEnv(given), given, prior, given, horizon=horizon, name="mdp")
    checks.instance("problem", given, gym.Env, "an environment of Gymnasium's, a TabularMDP or a Problem")
    given = encoded(given)
    mdp, shape = known_mdp(given), sizes(given)
    prior = check_policy("learner.prior_policy", prior_policy, *shape, None if mdp is None else mdp.allowed)
    name = given.spec.id if given.spec is not None else type(given.unwrapped).__name__
    horizon = steps_of(given, horizon)
    return Problem(given, given, prior, mdp, None, horizon, name, ActionMasks(*shape), *labels_of(given))


def _of_replicas(
    replicas: Replicas, problem: Problem, experience: ReplicaExperience | Source, seed: int
) -> tuple[ReplicaExperience, list[int]]:
    """The experience of all replicas, and their seeds."""
    if isinstance(experience, Simulation):
        return experience, [int(one) for one in experience.seeds]
    seeds = [seed + r for r in range(len(replicas))]
    if not isinstance(experience, Source):
        return experience, seeds
    if (simulation := experience.simulation(problem, seeds, None)) is not None:
        return simulation, seeds
    if experience.one_stream and len(replicas) > len(groups_among(replicas.learners)[0]):
        raise InputError(
            "experience", type(experience).__name__, "a source of many streams: equal replicas of one are equal"
        )
    recorded = [accepted(experience(problem, one, lambda _: None))[0] for one in seeds]
    held = [data for data in recorded if isinstance(data, Transitions)]
    if len(held) < len(recorded):
        raise InputError("experience", type(experience).__name__, "a source of tuples in memory, for replicas")
    return held, seeds


# -- what the run computes with, as text ----------------------------------------------------------------


def _described(
    learner: TabularLearner[Any] | Replicas,
    problem: Problem,
    experience: object,
    seed: int,
    settings: EvaluationSettings,
) -> dict[str, Any]:
    """Settings by name: a directory of other settings is refused."""
    one = learner.learners[0] if isinstance(learner, Replicas) else learner
    kind = type(one)
    values = plain("learner", one)
    if isinstance(learner, Replicas):
        own = [plain("learner", other) for other in learner.learners]
        values |= {"n_replicas": len(learner)}
        if any(other != own[0] for other in own):
            values |= {"replicas": own}
    source = {"name": type(experience).__name__, "module": type(experience).__module__}
    if isinstance(experience, (Source, Simulation)):
        source |= plain("experience", experience)
    models = {key: plain(f"problem.{key}", getattr(problem, key)) for key in ("mdp", "episode", "horizon", "prior")}
    if isinstance(problem.source, TabularMDP):
        models["source"] = plain("problem.source", problem.source)
    elif problem.source is not None and problem.source is not problem.env:
        models["source"] = environment(problem.source)
    if problem.env is None:  # of a log, the names are its own
        for key, labels in (("state_labels", problem.state_labels), ("action_labels", problem.action_labels)):
            models[key] = None if labels is None else plain(f"problem.{key}", np.asarray(labels.texts))
    models["ends"] = plain("problem.ends", problem.ends)
    return {
        "env": {"name": problem.name, **models, **environment(problem.env)},
        "learner": {"name": kind.__name__, "module": kind.__module__, **values},
        "experience": source,
        "evaluation": asdict(settings),
        "seed": seed,
    }
