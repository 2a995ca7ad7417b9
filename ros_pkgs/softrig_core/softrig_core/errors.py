"""The two ways in which a run can fail; the command line turns each into one line and an exit status."""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path


class ScenarioError(ValueError):
    """Bad input: the text states what was wrong, where, and what was expected (exit status 2)."""


class RunError(RuntimeError):
    """A run failed while it ran; the text names the node and topic (exit status 3)."""

    node = ""  # node of the block, if a block raised the error


class Impure(RunError):
    """The answers of a block depend on more than x, t and inputs, so a run may depend on earlier runs."""


# What a user's code raises ends a run with a message; `sys.exit` would end it in silence, with a status of its own.
FAILURES = (Exception, SystemExit, GeneratorExit)
_LIBRARIES = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
_OURS = str(Path(__file__).parent)


def describe(error: BaseException) -> str:
    """Describe an exception in one line, with the place in its author's code where it was raised.

    The place is the last one outside Python's libraries and softrig_core; of a syntax error, the line itself.
    """
    try:
        text = str(error)
    except Exception as inner:  # in the code of a class of the user's
        text = f"(no text: {type(inner).__name__})"
    line = f"{type(error).__name__}: {text}" if text else type(error).__name__
    if isinstance(error, SyntaxError) and error.filename:
        return f"{type(error).__name__}: {error.msg} ({error.filename}, line {error.lineno})"
    skipped = (*_LIBRARIES, _OURS, "<")
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(skipped)]
    return f"{line} ({frames[-1].filename}, line {frames[-1].lineno})" if frames else line


@contextmanager
def blaming(source: str) -> Iterator[None]:
    """Report an error of a user's code within the ``with`` block as bad input at a named place.

    Raises
    ------
    ScenarioError
        A ScenarioError raised by the code itself is passed on. The text of a ValueError is for people; for all other
        errors the message names the type and the line.
    """
    try:
        yield
    except ScenarioError:
        raise
    except ValueError as error:
        raise ScenarioError(f"{source}: {error}") from None
    except FAILURES as error:
        raise ScenarioError(f"{source}: {describe(error)}") from error


def closest(name: str, known: Iterable[str]) -> str:
    """Suggest the nearest of some names, as the end of a message."""
    from difflib import get_close_matches

    folded = {n.casefold(): n for n in known}  # wrong capital letters are the most frequent mistake
    word = name.casefold()
    near = get_close_matches(word, list(folded), 1)
    if not near and len(word) > 2:  # the word may be a part of a name, as `velocity` of motor/state/shaft/velocity
        near = sorted((n for n in folded if word in n), key=len)[:1]
    return f" (did you mean {folded[near[0]]!r}?)" if near else ""


def nearby(path: Path) -> str:
    """Suggest existing results for a path that does not exist, as the end of a message."""
    from difflib import get_close_matches

    if (results := Path("runs", path.name)).exists():  # folder of results without --out
        return f" (did you mean {str(results)!r}?)"
    folder = path.parent
    near = get_close_matches(path.name, [p.name for p in folder.iterdir()], 1) if folder.is_dir() else []
    return f" (did you mean {str(folder / near[0])!r}?)" if near else ""
