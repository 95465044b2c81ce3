"""Task names -> what they stand for. A task is one file in `sacil_tasks/tasks/`, nothing else.

The file `pick_and_lift.py` holds the literal `SPEC = TaskSpec(...)` and `class PickAndLiftEnv`.
The spec is read from the source text, so that asking for a task's words or splits starts neither
torch nor the simulator.
"""

import ast
import importlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sacil_tasks.errors import find_name
from sacil_tasks.spec import Fixture, TaskSpec

if TYPE_CHECKING:
    from sacil_tasks.table import SizedTableEnv

_FOLDER = Path(__file__).with_name("tasks")

MAX_EPISODE_STEPS = 2000
"""Control steps before truncation: above the longest expert episode, the same for all tasks."""


@cache
def task_names() -> tuple[str, ...]:
    """Every task, in the order tables show them."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("[a-z]*.py")))


def env_id(task: str) -> str:
    """Gymnasium id, e.g. `SizedPickAndLift-v1`."""
    return f"Sized{_camel(task)}-v1"


def entry_point(task: str) -> str:
    """Where gymnasium finds the class, as `module:name`."""
    return f"sacil_tasks.tasks.{task}:{_camel(task)}Env"


def load_task(task: str) -> type["SizedTableEnv"]:
    """Import a task's environment class (and with it torch and ManiSkill).

    Raises:
        UsageError: there is no such task.
    """
    module, name = entry_point(find_name(task, task_names(), "task")).split(":")
    return getattr(importlib.import_module(module), name)


@cache
def task_spec(task: str) -> TaskSpec:
    """Read a task's spec without importing its file.

    Raises:
        UsageError: there is no such task.
    """
    for node in _source(task).body:
        match node:
            case ast.Assign(targets=[ast.Name(id="SPEC")], value=ast.Call(keywords=keywords)):
                return TaskSpec(**{str(key.arg): _literal(key.value) for key in keywords})
    raise LookupError(f"{task}.py has no `SPEC = TaskSpec(...)` with literal arguments")


def task_docstrings(task: str) -> tuple[str, str]:
    """Docstrings of a task's file and of its environment class, read without importing them.

    Raises:
        UsageError: there is no such task.
    """
    module, name = _source(task), f"{_camel(task)}Env"
    for node in module.body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return ast.get_docstring(module) or "", ast.get_docstring(node) or ""
    raise LookupError(f"{task}.py has no class {name}")


def _source(task: str) -> ast.Module:
    path = _FOLDER / f"{find_name(task, task_names(), 'task')}.py"
    return ast.parse(path.read_text())


def _literal(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="Fixture"), keywords=keywords):
            return Fixture(**{str(key.arg): ast.literal_eval(key.value) for key in keywords})
    return ast.literal_eval(node)


def suite_names() -> tuple[str, ...]:
    """Groups of tasks that can be asked for by one word."""
    return (*sorted({suite for task in task_names() for suite in task_spec(task).suites}), "all")


def suite_tasks(suite: str) -> tuple[str, ...]:
    """Tasks of a suite, in the order of `task_names`.

    Raises:
        UsageError: there is no such suite.
    """
    find_name(suite, suite_names(), "suite")
    return tuple(task for task in task_names() if suite in (*task_spec(task).suites, "all"))


def _camel(task: str) -> str:
    return "".join(word.capitalize() for word in task.split("_"))
