"""Why an episode ended as it did: one code, first match wins (D-success). Pure."""

from dataclasses import dataclass

OUTCOMES = (
    "SUCCESS",
    "SIZE_CONFUSION",
    "ORDER_ERROR",
    "RECEPTACLE_ERROR",
    "MOTOR_FAIL",
    "NO_INTERACTION",
)
"""Codes in the order in which they are tried."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was asked for and what was done, in size words."""

    success: bool
    """The task's predicate, and no unnamed candidate handled or displaced."""

    success_lenient: bool
    """The task's predicate alone."""

    asked: tuple[str, ...]
    """Labels named in the instruction, in order."""

    handled: tuple[str, ...]
    """Labels acquired or pressed, in order."""

    placed: tuple[str, ...] = ()
    """Labels that lie in a place where the task wants something."""

    handled_indices: tuple[int, ...]
    """The same as candidate indices."""

    touched: tuple[str, ...]
    """Labels touched by a finger, in order of first contact."""

    displaced: tuple[str, ...]
    """Labels pushed away without being acquired."""

    wrong_receptacle: bool = False
    """A place that was not named was opened or filled."""

    robot_contact_n: float = 0.0
    """Largest force of a contact that nobody intended, for example an arm brushing a handle."""

    @property
    def first_choice(self) -> int | None:
        """Index of the candidate handled first, if any was."""
        return self.handled_indices[0] if self.handled_indices else None

    @property
    def size_confused(self) -> bool:
        """The first choice is of a size that was not named at all."""
        return bool(self.handled) and self.handled[0] not in self.asked

    @property
    def clean(self) -> bool:
        """Strict success without an unintended contact."""
        return self.success and not self.robot_contact_n

    @property
    def code(self) -> str:
        """The first code of `OUTCOMES` that fits."""
        if self.success:
            return "SUCCESS"
        if set(self.handled + self.placed) - set(self.asked):
            return "SIZE_CONFUSION"
        if self.handled != self.asked[: len(self.handled)]:
            return "ORDER_ERROR"
        if self.wrong_receptacle:
            return "RECEPTACLE_ERROR"
        return "MOTOR_FAIL" if self.handled or self.touched else "NO_INTERACTION"
