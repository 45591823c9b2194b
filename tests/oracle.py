"""Dense oracle for tiny MDPs, written from the paper's equations with numpy.linalg.eig; shares no code."""

from typing import NamedTuple

import numpy as np


class Iterate(NamedTuple):
    """One exact biasing iteration: biases from psi, then the dominant eigenpair under them."""

    psi: np.ndarray  # [S], behind the biases
    mean_psi: np.ndarray  # [S, A]
    mean_log_psi: np.ndarray  # [S, A]
    delta: np.ndarray  # [S, A]
    rho: float
    u: np.ndarray  # [S, A]
    policy: np.ndarray  # [S, A]
    theta: float


def biasing_iterations(p, r, prior, beta, n):
    """The first ``n`` exact biasing iterations. p [S, A, S], r and prior [S, A]."""
    n_states, n_actions, _ = p.shape
    psi = np.ones(n_states)
    iterates = []
    for _ in range(n):
        mean_psi, mean_log_psi = p @ psi, p @ np.log(psi)
        delta = (np.log(mean_psi) - mean_log_psi) / beta  # eq. (9)
        b = psi / mean_psi[..., None]  # eq. (8), [S, A, S]
        weight = np.exp(beta * (r + delta - delta.max()))
        # eq. (4): sum over (s', a') of exp(beta r_b) p b pi0(a'|s') u(s', a') = rho u(s, a)
        tilted = np.einsum("sa,sat,sat,tb->satb", weight, p, b, prior)
        values, vectors = np.linalg.eig(tilted.reshape(n_states * n_actions, -1))
        top = np.argmax(values.real)
        u = np.abs(vectors[:, top].real).reshape(n_states, n_actions)
        rho = float(values[top].real)
        policy = prior * u / (prior * u).sum(1, keepdims=True)
        theta = -np.log(rho) / beta - delta.max()
        iterates.append(Iterate(psi, mean_psi, mean_log_psi, delta, rho, u, policy, theta))
        psi = 1 / (prior * u).sum(1)  # eq. (7)
    return iterates


def backup(p, r, prior, beta, v):
    """(TV [S], pi_V [S, A]) of the soft Bellman backup. p [S, A, S], r and prior [S, A]."""
    q = r + p @ v
    weight = np.log(prior) + beta * q
    top = weight.max(1, keepdims=True)
    total = np.exp(weight - top).sum(1, keepdims=True)
    return (top + np.log(total))[:, 0] / beta, np.exp(weight - top) / total


def stationary(chain):
    """Stationary distribution of a chain [S, S] with one closed class, by least squares."""
    n = len(chain)
    return np.linalg.lstsq(np.vstack([chain.T - np.eye(n), np.ones(n)]), np.eye(n + 1)[n], rcond=None)[0]


def worth(p, r, prior, beta, policy):
    """J(policy): reward rate less KL to the prior over beta, where the policy's chain has one closed class."""
    return soft_rate(p, r, prior, beta, policy)[0]


class Lines9To11(NamedTuple):
    """What lines 9-11 make of a stream in iteration 0, where psi = 1 and there is no bias."""

    u: np.ndarray  # [S, A], not rescaled
    rho: float
    largest: float  # rho of all tuples, before it was clipped


def lines_9_to_11(data, shape, beta, lr_u, lr_rho, rho_max=np.inf):
    """One pass, tuple by tuple, line 11 with the u that line 10 has just written."""
    u, rho, largest = np.ones(shape), np.exp(-beta), -np.inf
    for s, a, r, s_next, a_next in zip(data.s, data.a, data.r, data.s_next, data.a_next, strict=True):
        u[s, a] += lr_u * (np.exp(beta * r) * u[s_next, a_next] / rho - u[s, a])
        rho += lr_rho * (np.exp(beta * r) * u[s_next, a_next] / u[s, a] - rho)
        largest = max(largest, rho)
        rho = min(rho, rho_max)
    return Lines9To11(u, rho, largest)


def soft_optimum(p, r, prior, beta):
    """(g* = -theta*, its policy [S, A]) by damped value iteration, to about 1e-12. p [S, A, S], r and prior [S, A]."""
    value = np.zeros(len(r))
    for _ in range(200_000):
        q = beta * (r + p @ value)
        top = q.max(1, keepdims=True)
        weight = prior * np.exp(q - top)
        gain = (top[:, 0] + np.log(weight.sum(1))) / beta - value
        if np.ptp(gain) < 1e-12:
            break
        value = value + 0.9 * (gain - gain[0])
    return float((gain.min() + gain.max()) / 2), weight / weight.sum(1, keepdims=True)


def soft_rate(p, r, prior, beta, policy):
    """(J, V) of ``policy``: reward rate less KL(policy || prior)/beta, by one dense linear system; V(0) = 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        kl = np.where(policy > 0, policy * np.log(policy / prior), 0.0).sum(1)
    system = np.eye(len(r)) - np.einsum("sa,sat->st", policy, p)
    system[:, 0] = 1.0  # V(0) = 0 leaves its column to J
    found = np.linalg.solve(system, (policy * r).sum(1) - kl / beta)
    return float(found[0]), np.append(0.0, found[1:])


def counted(data, n_states, n_actions):
    """(p [S, A, S], mean r [S, A], n(s,a) [S, A]) of a stream; rows never visited are 0."""
    counts, rewards = np.zeros((n_states, n_actions, n_states)), np.zeros((n_states, n_actions))
    np.add.at(counts, (data.s, data.a, data.s_next), 1.0)
    np.add.at(rewards, (data.s, data.a), data.r)
    visits = counts.sum(2)
    seen = np.maximum(visits, 1)
    return counts / seen[..., None], rewards / seen, visits
