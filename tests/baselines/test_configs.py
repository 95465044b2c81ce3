from dataclasses import dataclass, replace
from typing import Annotated

import pytest

from baselines.agent import Recipe, agent_modules, find_agent
from baselines.configs import Fraction, Natural, Positive, Range, check_numbers
from sacil_tasks.errors import UsageError


@dataclass(frozen=True)
class Config:
    layers: int = 2
    memory: Natural = 0
    kernel: Annotated[int, Range(1, odd=True)] = 3
    weight: float = 0.0
    rate: Positive = 1e-3
    dropout: Fraction | None = None
    shift: float | tuple[float, float] = (0.5, 0.0)
    channels: tuple[Natural, ...] = (4, 0)
    on: bool = False

    def __post_init__(self):
        check_numbers(self)


@pytest.mark.parametrize(
    "change",
    [
        {"layers": 1, "memory": 7, "kernel": 5},
        {"dropout": 0.0, "shift": 0.2},
        {"channels": (0,), "on": True},
    ],
)
def test_numbers_in_their_range_pass(change):
    replace(Config(), **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layers": 0}, "layers must be a finite number from 1, not 0"),
        ({"memory": -1}, "memory must be a finite number from 0"),
        ({"kernel": 4}, "kernel must be an odd number from 1, not 4"),
        ({"weight": -0.1}, "weight must be"),
        ({"weight": float("nan")}, "weight must be a finite number"),
        ({"rate": 0.0}, "rate must be a finite number above 0"),
        ({"dropout": 1.0}, "dropout must be a finite number from 0 below 1"),
        ({"shift": (0.1, -0.1)}, "shift must be"),
        ({"shift": float("inf")}, "shift must be"),
        ({"channels": (4, -2)}, "channels must be"),
        ({"channels": ()}, "channels must not be empty"),
    ],
)
def test_others_end_in_one_sentence(change, message):
    with pytest.raises(UsageError, match=message):
        replace(Config(), **change)


@pytest.mark.parametrize("name", sorted(agent_modules()))
def test_every_agent_checks_its_numbers(name):
    """Any count of a config at -1, and any float at NaN, is refused."""
    config = find_agent(name)[0].config("cpu")
    for field, value in vars(config).items():
        bad = {int: -1, float: float("nan")}.get(type(value))
        if bad is not None:
            with pytest.raises(UsageError, match=field):
                replace(config, **{field: bad})


def test_the_recipe_checks_its_numbers():
    for change in ({"lr": -1.0}, {"ema_decay": 2.0}, {"choice_share": 2.0}, {"warmup_steps": -5}):
        with pytest.raises(UsageError, match="must be"):
            replace(Recipe(), **change)
