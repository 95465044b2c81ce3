"""Outcome codes: each scripted course of events has one."""

import pytest

from sacil_tasks.outcomes import OUTCOMES, Outcome

INDEX = {"small": 2, "medium": 0, "large": 1}


def _outcome(
    asked: str, handled: str = "", touched: str = "", *, placed: str = "", **flags: bool
) -> Outcome:
    done = tuple(handled.split())
    return Outcome(
        success=flags.get("success", False),
        success_lenient=flags.get("success_lenient", False),
        asked=tuple(asked.split()),
        handled=done,
        placed=tuple(placed.split()),
        handled_indices=tuple(INDEX[label] for label in done),
        touched=tuple(touched.split()),
        displaced=(),
        wrong_receptacle=flags.get("wrong_receptacle", False),
    )


@pytest.mark.parametrize(
    ("outcome", "code"),
    [
        (_outcome("small", "small", success=True), "SUCCESS"),
        (_outcome("small", "large small", success_lenient=True), "SIZE_CONFUSION"),
        (_outcome("small", "medium"), "SIZE_CONFUSION"),
        (_outcome("small large", "small medium"), "SIZE_CONFUSION"),
        (_outcome("small large", "large"), "ORDER_ERROR"),
        (_outcome("small large", "large small"), "ORDER_ERROR"),
        (_outcome("small", "small", wrong_receptacle=True), "RECEPTACLE_ERROR"),
        (_outcome("small", "small", "small"), "MOTOR_FAIL"),
        (_outcome("small", "small", placed="large"), "SIZE_CONFUSION"),
        (_outcome("small large", "small"), "MOTOR_FAIL"),
        (_outcome("small", touched="large"), "MOTOR_FAIL"),
        (_outcome("small"), "NO_INTERACTION"),
    ],
)
def test_first_matching_code_wins(outcome: Outcome, code: str) -> None:
    assert outcome.code == code
    assert outcome.code in OUTCOMES


def test_confusion_is_about_the_first_choice() -> None:
    assert _outcome("small", "medium").size_confused
    assert not _outcome("small large", "large").size_confused  # an order error
    assert not _outcome("small", touched="medium").size_confused  # nothing decisive happened
    assert _outcome("small", "medium small").first_choice == INDEX["medium"]
    assert _outcome("small").first_choice is None
