"""Agent names -> where to load them from. Finding an agent imports nothing of it.

Names come from four places: the probes of this package; the files in `baselines.agents` and
`sacil_agent.agents`; the entry-point group `sacil.agents` of installed packages; and
`my_package.policy:load` for a file of today. `name:variant` picks an ablation of ours.
"""

import importlib
import importlib.util
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.machinery import PathFinder
from importlib.metadata import entry_points
from operator import attrgetter
from pathlib import Path
from typing import Protocol

from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.interface import Policy

PROBES = ("oracle", "hold", "random", "blind")
"""Built-in agents that test the harness and mark ceiling and floors."""

AGENT_PACKAGES = ("baselines.agents", "sacil_agent.agents")
"""One agent a file; the file's attribute `load` makes its policy."""

ENTRY_POINTS = "sacil.agents"
"""Entry-point group through which installed packages add agents."""


class Loader(Protocol):
    """What a name leads to: a function that makes a policy."""

    def __call__(
        self, *, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None
    ) -> Policy:
        """Make the policy for `tasks`; without `checkpoint` it chooses its released one.

        A policy with weights carries their hash as `checkpoint_sha256`, which every record stores.

        Raises:
            UsageError: the checkpoint does not fit, or nothing released covers the tasks.
        """


@dataclass(frozen=True)
class AgentRef:
    """An agent that is known to exist and has not been imported."""

    name: str
    """As typed by the user; it names the agent in every record and table."""

    target: str
    """`module:attribute` of its `Loader`."""

    variant: str | None = None
    """Ablation asked for."""

    def load(self, *, checkpoint: Path | None, tasks: tuple[str, ...]) -> Policy:
        """Import the agent and make its policy.

        Raises:
            UsageError: the module or its attribute cannot be had, or the loader refuses.
        """
        module, _, attribute = self.target.partition(":")
        try:
            loader: Loader = attrgetter(attribute)(importlib.import_module(module))
        except (ImportError, AttributeError) as error:
            raise UsageError(
                f"agent '{self.name}' cannot be loaded from {self.target}: {error}. "
                "Expected an importable module and a function "
                "load(*, checkpoint, tasks, variant) in it."
            ) from error
        return loader(checkpoint=checkpoint, tasks=tasks, variant=self.variant)


def find_agent(name: str) -> AgentRef:
    """Look up `oracle`, `sacil`, `sacil:no_queries`, an entry point or `my_package.policy:load`.

    Raises:
        UsageError: nothing has that name; says the nearest.
    """
    base, colon, rest = name.partition(":")
    if base in PROBES and not colon:
        return AgentRef(name, "leaderboard.probes:load", variant=name)
    known = known_agents()
    if base in known:
        return AgentRef(name, known[base], variant=rest or None)
    if colon and module_exists(base):
        return AgentRef(name, f"{base}:{rest or 'load'}")
    if colon and "." in base:
        raise UsageError(
            f"no module {base} for --agent {name}. Run from the folder that holds it, "
            "or install it; the form is my_package.policy:load."
        )
    find_name(base, [*PROBES, *known], "agent")
    raise UsageError(f"{base} is a probe and has no variants, but '{name}' names one.")


def known_agents() -> Mapping[str, str]:
    """Names and `module:attribute` of all agents that are not probes."""
    foreign = {entry.name: entry.value for entry in entry_points(group=ENTRY_POINTS)}
    ours = {
        module.name: f"{package}.{module.name}:load"
        for package in AGENT_PACKAGES
        for module in pkgutil.iter_modules(_folders(package))
    }
    return foreign | ours


def module_exists(name: str) -> bool:
    """Whether `name` can be found, without running it or its parent packages."""
    if not all(part.isidentifier() for part in name.split(".")):
        return False
    parent, _, leaf = name.rpartition(".")
    if not parent:
        return leaf in sys.modules or importlib.util.find_spec(leaf) is not None
    return PathFinder.find_spec(name, list(_folders(parent))) is not None


def _folders(package: str) -> Iterator[str]:
    """Folders of a package, found through its top level so that no `__init__` runs."""
    top, *inner = package.split(".")
    spec = importlib.util.find_spec(top)
    for folder in (spec and spec.submodule_search_locations) or []:
        yield str(Path(folder, *inner))
