"""Attacks of more than one request, and what each may cost. A module adds one with a function and `@attack(...)`."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from benchmarks.abuse.server import Cost, ObservedServer

Run = Callable[[ObservedServer, bool], str]


class AttackSucceeded(Exception):
    """An attack achieved what it must not, besides its cost: a key was accepted, others were locked out."""


@dataclass(frozen=True, slots=True)
class Attack:
    """An attack and its limits."""

    name: str
    # attacks a server; the second argument asks for a smaller attack. Returns what happened, for the table, or raises
    # `AttackSucceeded`.
    run: Run
    cpu_s: float  # [s] processor time of the server until it is idle again
    memory_mb: float  # [MB] growth of memory at its peak
    health_ms: float  # [ms] longest answer of /healthz to another address meanwhile


ATTACKS: dict[str, Attack] = {}
"""All attacks by name, in the order in which their modules are imported."""


def attack(
    name: str, *, cpu_s: float = 5.0, memory_mb: float = 200.0, health_ms: float = 250.0
) -> Callable[[Run], Run]:
    """Add a function to the attacks, with its limits; the defaults are those of a request."""

    def add(run: Run) -> Run:
        ATTACKS[name] = Attack(name, run, cpu_s, memory_mb, health_ms)
        return run

    return add


class AttackOutcome(NamedTuple):
    """An attack, its cost, what happened, and whether it succeeded in what it must not."""

    attack: Attack
    cost: Cost
    result: str
    succeeded: bool

    def broken(self, slack: float) -> list[str]:
        """The limits that it broke."""
        limits = (
            (self.cost.cpu_s, self.attack.cpu_s * slack, "processor time"),
            (self.cost.memory_mb, self.attack.memory_mb, "memory"),
            (self.cost.health_ms, self.attack.health_ms * slack, "delay of /healthz"),
            (self.cost.failed, 0, "/healthz failed"),
        )
        return [name for value, limit, name in limits if value > limit] + ["succeeded"] * self.succeeded


def _run_attack(server: ObservedServer, attack: Attack, *, short: bool) -> AttackOutcome:
    """Attack a server, and wait until it is idle again: what goes on after the clients have left counts."""
    succeeded = False
    with server.observed() as costs:
        try:
            result = attack.run(server, short)
        except AttackSucceeded as error:
            result, succeeded = str(error), True
        except Exception as error:  # noqa: BLE001 - an attack that broke is reported, and the others run
            traceback.print_exc()
            result, succeeded = f"{type(error).__name__}: {error}", True
        server.wait_until_idle()
    return AttackOutcome(attack, costs[0], result, succeeded)


def run_attacks(server: ObservedServer, attacks: Sequence[Attack], slack: float, *, short: bool) -> int:
    """Attack a server, and print a row for each attack; returns how many broke a limit or succeeded."""
    if not attacks:
        return 0
    print("| attack | result | processor time | memory | /healthz | within the limits |")
    print("|---|---|---|---|---|---|", flush=True)
    faults = 0
    for each in attacks:
        outcome = _run_attack(server, each, short=short)
        cost, broken = outcome.cost, outcome.broken(slack)
        cells = (
            f"{cost.cpu_s:.2f} of {each.cpu_s:g} s",
            f"{cost.memory_mb:.0f} of {each.memory_mb:g} MB",
            f"{cost.health_ms:.0f} of {each.health_ms:g} ms" + (f", {cost.failed} failed" if cost.failed else ""),
            f"no: {', '.join(broken)}" if broken else "yes",
        )
        print(f"| {each.name} | {outcome.result} | {' | '.join(cells)} |", flush=True)
        faults += bool(broken)
    print()
    return faults
