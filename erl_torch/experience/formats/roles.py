"""Which columns of a table are which: found by their usual names, in upper or lower case, or as the user says."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from erl_torch.checks import InputError
from erl_torch.experience.formats.table import Table

NAMES = {
    "s": "s state states obs observation observations",
    "a": "a action actions",
    "r": "r reward rewards",
    "s_next": "s_next s' next_s next_state next_states next_obs next_observation next_observations",
    "a_next": "a_next a' next_a next_action next_actions",
    "terminated": "terminated terminal terminals terminations done dones",
    "truncated": "truncated truncations timeout timeouts",
    "episode": "episode episodes episode_id",
    "step": "step steps t",
    "weight": "importance_weight importance_weights",
}
NEEDED = ("s", "a", "r")
OUR_OWN = {"s", "a", "r", "s_next", "a_next", "weight"}  # beside these alone a "weight" is not of something else
AS_TUPLES = ("s", "a", "s_next", "a_next")  # several columns may be one
SHOWN = 30  # names of columns in a message

Roles = dict[str, tuple[str, ...]]
"""The columns of each role that there is: several columns make a tuple."""


def roles_of(source: Table, columns: Mapping[str, Any] | None) -> Roles:
    """Which columns of ``source`` are which.

    Args:
        source: has the names.
        columns: names by role, as the user says; None for a role is none of it. A list of names is a tuple of columns.

    Raises:
        InputError: a role that is none, a column that is not there, is there twice, or cannot be told.
    """
    there = ", ".join(source.names[:SHOWN]) + ", ..." * (len(source.names) > SHOWN)
    roles = {role: names for role, given in (columns or {}).items() if (names := _named(source, role, given, there))}
    taken = {name for names in roles.values() for name in names}
    for role, usual in NAMES.items():
        if role in (columns or {}):
            continue
        found = [name for name in source.names if plain(name) in usual.split() and name not in taken]
        if len(found) > 1:
            allowed = f"one column: say which, columns.{role}=NAME; the columns are {there}"
            raise InputError(f"path={source.path}: {role}", " and ".join(found), allowed)
        if found:
            roles[role] = (found[0],)
    if "weight" not in {*roles, *(columns or {})}:
        by_name = {plain(name): name for name in source.names}
        weight = by_name.get("weight")
        if weight is not None and by_name.keys() >= OUR_OWN and weight not in taken:
            roles["weight"] = (weight,)
    _check(source, roles, there)
    return roles


def _named(source: Table, role: str, given: Any, there: str) -> tuple[str, ...]:
    """The columns that the user says have a role; none for None."""
    if role not in NAMES:
        raise InputError(f"columns.{role}", given, f"left out: no such column; there are {', '.join(NAMES)}")
    if given is None:
        return ()
    several = isinstance(given, Sequence) and not isinstance(given, str)
    names = tuple(map(str, given)) if several else (str(given),)
    if not names or (len(names) > 1 and role not in AS_TUPLES):
        raise InputError(f"columns.{role}", given, "the name of one column")
    for name in names:
        if name not in source.names:
            raise InputError(f"columns.{role}", name, f"a column of {source.path}; the columns are {there}")
    return names


def _check(source: Table, roles: Roles, there: str) -> None:
    """Raise InputError unless there is what is needed."""
    path = f"path={source.path}"
    for role in NEEDED:
        if role not in roles:
            usual = ", ".join(NAMES[role].split())
            allowed = f"a column named {usual}, or any other: columns.{role}=NAME; the columns are {there}"
            raise InputError(f"{path}: {role}", "missing", allowed)
    for name in {name for names in roles.values() for name in names}:
        if list(source.names).count(name) > 1:
            raise InputError(f"{path}: {name}", "two columns", "the name of one column")
    for role, other in (("s_next", "s"), ("a_next", "a")):
        if role in roles and len(roles[role]) != len(roles[other]):
            allowed = f"{len(roles[other])} columns, as columns.{other} has"
            raise InputError(f"columns.{role}", ", ".join(roles[role]), allowed)
    if "s_next" not in roles and not {"episode", "terminated", "truncated"} & roles.keys():
        ways = ", ".join(f"columns.{role}=NAME" for role in ("s_next", "episode", "terminated", "truncated"))
        allowed = (
            "a column, or else one that tells the episodes or their ends, so that it is the state of the next row: "
            f"{ways}; the columns are {there}"
        )
        raise InputError(f"{path}: s_next", "missing", allowed)


def plain(name: str) -> str:
    return re.sub(r"[\s-]+", "_", name.strip().lower())
