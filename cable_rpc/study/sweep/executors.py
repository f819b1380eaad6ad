"""What runs calls beside each other, whatever that is: handed in one by one, come back in any order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, Self

from cable_rpc.study.closed_loop.failure import told

WORKER_DIED = "its worker process died twice, probably for want of memory; give fewer workers, frames or pixels"


@dataclass(frozen=True, slots=True)
class Call:
    """A function and its one argument; both travel to another process, so the function is a module's own."""

    function: Callable[[Any], Any]
    argument: Any


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a call."""

    argument: Any
    """The very object that was handed in."""
    result: Any
    """None where it failed."""
    error: str = ""
    """Why it failed, one line; empty where it didn't."""


class Executor(Protocol):
    """Context manager: leaving it by an exception ends the calls that run, and starts no other.

    Nothing is started before the first call is waited for.
    """

    def submit(self, function: Callable[[Any], Any], argument: Any) -> None:
        """Hand in a call; thousands may be waiting, of which a bounded number is on the way."""
        ...

    def completed(self) -> Iterator[Outcome]:
        """Runs what was handed in; each outcome as it becomes ready, until nothing is left."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc_info: object) -> None: ...


def answer(call: Call) -> tuple[Any, str]:
    """What a call gives, and why it failed; runs where the work is done."""
    try:
        return call.function(call.argument), ""
    except Exception as failure:
        return None, told(failure) or type(failure).__name__
