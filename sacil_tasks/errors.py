"""What cannot work, said in one sentence to the user, and look-ups that name the nearest match."""

import difflib
import sys
from collections.abc import Callable, Iterable


class UsageError(Exception):
    """Expected, came, what to do: the message is all a user sees (no traceback)."""


def find_name(name: str, known: Iterable[str], kind: str) -> str:
    """Return `name` if it is known.

    Raises:
        UsageError: names the nearest known names and all of them.
    """
    names = sorted(known)
    if name in names:
        return name
    near = difflib.get_close_matches(str(name), names, n=2)
    hint = f" Did you mean {' or '.join(near)}?" if near else ""
    raise UsageError(f"no {kind} called '{name}'.{hint} Known: {', '.join(names) or 'none'}.")


def run_command(main: Callable[[], None], *, after_stop: str = "") -> None:
    """Run a command line: a `UsageError` is one sentence and exit code 2, Ctrl-C is 130.

    `after_stop` tells a user who pressed Ctrl-C how to go on, if there is anything to go on with.
    """
    try:
        main()
    except UsageError as error:
        sys.exit(_say(error, code=2))
    except KeyboardInterrupt:
        sys.exit(_say(f"stopped by Ctrl-C. {after_stop}".rstrip(), code=130))


def _say(message: object, *, code: int) -> int:
    print(f"error: {message}", file=sys.stderr)
    return code
