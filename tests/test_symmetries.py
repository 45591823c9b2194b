"""What a learner must do whatever its numbers: follow a shift of the rewards, new names of states and actions, and
its own certificate. The oracles count the stream themselves."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import random_mdp, random_policy
from scipy.special import logsumexp

from erl_torch import CertaintyEquivalence, EfficientS1, Transitions, collect

BETA = 3.0


def counted(data, n_states, n_actions):
    """(P [S, A, S], r [S, A]) of the tuples; every pair visited."""
    n = np.zeros((n_states, n_actions, n_states))
    total = np.zeros((n_states, n_actions))
    np.add.at(n, (data.s, data.a, data.s_next), 1.0)
    np.add.at(total, (data.s, data.a), data.r)
    visits = n.sum(-1)
    return n / visits[..., None], total / visits


@pytest.mark.parametrize("seed", range(3))
def test_online_rho_is_the_streamed_one_as_far_as_the_certificate_allows(seed):
    """At a phase's end theta is in minus [min, max] of TV - V, in a yielded state of [min(T_pi V - V), max(TV - V)]:
    log rho of line 11 goes to the nearest point there, and stays where it is inside. Visits begin anew with a phase."""
    rng = np.random.default_rng(seed)
    mdp, prior = random_mdp(rng, 4, 2), random_policy(rng, 4, 2)
    data = collect(mdp, 1, 8 * 2**7, seed, prior_policy=prior)
    learner = EfficientS1(beta=BETA, prior_policy=prior)
    state, checked = learner.init_online(4, 2), 0
    while state.phase_end <= len(data):
        begin, end = state.n_tuples, state.phase_end
        before = learner._observe(state, data.where(slice(begin, end)))
        pair = 2 * data.s[begin:end] + data.a[begin:end]
        assert np.array_equal(before.fresh, np.bincount(pair, minlength=8))
        state = learner._end_phase(before)
        if before.visits.min() == 0:
            continue
        p, r = counted(data.first(end), 4, 2)

        def soft_gain(value, p=p, r=r):
            return logsumexp(BETA * (r + p @ value), b=prior, axis=1) / BETA - value

        gain = soft_gain(state.value)
        ends = BETA * np.array([gain.min(), gain.max()])
        for log_rho in (before.log_rho_in_use, ends.mean(), 0.9 * ends[0] + 0.1 * ends[1], ends[0] - 1, ends[1] + 1):
            after = learner._end_phase(replace(before, log_rho_in_use=log_rho))
            assert after.log_rho_in_use == pytest.approx(np.clip(log_rho, *ends), rel=1e-9)
            shown = learner._judged(after)
            policy, value = shown.policy.numpy(), -shown.log_psi.numpy() / BETA
            kl = (policy * np.log(policy / prior)).sum(1)
            low = ((policy * (r + p @ value)).sum(1) - kl / BETA - value).min()
            found = np.clip(after.log_rho_in_use, BETA * low, BETA * soft_gain(value).max())
            assert shown.log_rho == pytest.approx(found, rel=1e-9)
        checked += ends[1] - ends[0] > 1e-3
    assert checked >= 3


def online(data, n_states, n_actions, prior):
    learner = EfficientS1(BETA, prior_policy=prior)
    *_, state = learner.online([data], n_states, n_actions)
    return state.theta, state.policy.numpy(), state.empirical_width


def from_all_passes(learner_class):
    def learnt(data, n_states, n_actions, prior):
        *_, state = learner_class(BETA, prior_policy=prior).iterate(data, n_states, n_actions)
        return state.theta, state.policy.numpy(), state.empirical_width

    return learnt


@pytest.mark.parametrize("learn", [from_all_passes(CertaintyEquivalence), from_all_passes(EfficientS1), online])
def test_shifted_rewards_and_new_names(learn):
    """r - c: theta + c and the same policy. States and actions renamed: the policy renamed, theta as before.

    Up to what the certificates leave open: both thetas are within them of the empirical optimum, and so are both
    policies' losses, which bound their distance.
    """
    rng = np.random.default_rng(5)
    mdp, prior = random_mdp(rng, 5, 3), random_policy(rng, 5, 3)
    data = collect(mdp, 1, 20_000, 5, prior_policy=prior)
    theta, policy, width = learn(data, 5, 3, prior)
    shifted = Transitions(data.s, data.a, data.r - 0.7, data.s_next, data.a_next)
    state_name, action_name = rng.permutation(5), rng.permutation(3)
    states, actions = [state_name[x] for x in (data.s, data.s_next)], [action_name[x] for x in (data.a, data.a_next)]
    renamed = Transitions(states[0], actions[0], data.r, states[1], actions[1])
    renamed_prior = np.empty_like(prior)
    renamed_prior[np.ix_(state_name, action_name)] = prior
    for other, its_prior, shift, names in (
        (shifted, prior, 0.7, None),
        (renamed, renamed_prior, 0.0, np.ix_(state_name, action_name)),
    ):
        found, its_policy, its_width = learn(other, 5, 3, its_prior)
        open_to = width + its_width + 1e-12
        assert open_to < 0.01
        assert found - shift == pytest.approx(theta, abs=open_to)
        its_policy = its_policy if names is None else its_policy[names]
        # A loss is E_d KL(pi || pi*)/beta: Pinsker, d(s) above 1/20, both policies.
        assert np.abs(its_policy - policy).sum(1).max() < 2 * np.sqrt(2 * BETA * 20 * max(width, its_width)) + 1e-9
