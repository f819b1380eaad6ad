"""What goes wrong with a call, as our errors: whether it is worth to come back is in their type."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

import grpc

from cable_rpc.edge.channel import TOKEN_VARIABLE
from cable_rpc.errors import ConnectionLost, RemoteError
from cable_rpc.wire.convert import retry_after_s, status_code_name
from cable_rpc.wire.v1 import perception_pb2 as pb

WORTH_A_RETRY = frozenset(
    {
        grpc.StatusCode.UNAVAILABLE,
        grpc.StatusCode.INTERNAL,
        grpc.StatusCode.UNKNOWN,
        grpc.StatusCode.CANCELLED,
        grpc.StatusCode.ABORTED,
        grpc.StatusCode.DEADLINE_EXCEEDED,
        grpc.StatusCode.RESOURCE_EXHAUSTED,
    }
)
"""After Hello the contract knows no status but OK: these say that the way broke, or that the server is full."""


def connection_error(target: str, error: grpc.aio.AioRpcError) -> RemoteError:
    """A call's status as our error."""
    if error.code() is grpc.StatusCode.UNAUTHENTICATED:
        return RemoteError(f"{target} does not let us in: {error.details()}; check --token-file or {TOKEN_VARIABLE}")
    text = f"the connection to {target} broke: {error.code().name} {error.details() or ''}".rstrip()
    return ConnectionLost(text) if error.code() in WORTH_A_RETRY else RemoteError(text)


@contextmanager
def transport_errors(target: str) -> Iterator[None]:
    """Turns what a call raises into `ConnectionLost` and `RemoteError`."""
    try:
        yield
    except asyncio.InvalidStateError as error:
        raise ConnectionLost(f"{target} has ended the stream") from error
    except grpc.aio.AioRpcError as error:
        raise connection_error(target, error) from error
    except asyncio.CancelledError:
        # A call that the other end, or our own closing of the call, has cancelled says so in the waiting task too.
        task = asyncio.current_task()
        if task is None or task.cancelling():
            raise
        raise ConnectionLost(f"the connection to {target} broke: CANCELLED") from None


def closing_error(target: str, closing: pb.Closing) -> RemoteError:
    """A Closing as our error; one that is worth to come back is a `ConnectionLost`."""
    text = f"{target} closed the session: {status_code_name(closing.status)}: {closing.status.message}"
    wait_s = retry_after_s(closing.status)
    if wait_s is not None:
        text += f"; try again in {wait_s:.0f} s"
    if closing.alternative_target:
        text += f", at {closing.alternative_target}"
    if closing.action == pb.CLOSE_ACTION_MOVE and closing.alternative_target:
        # How soon this server can be asked again is of no interest to who goes to another.
        return ConnectionLost(text, alternative_target=closing.alternative_target)
    if closing.action in (pb.CLOSE_ACTION_RESUME, pb.CLOSE_ACTION_MOVE):
        return ConnectionLost(text, retry_after_s=wait_s)
    return RemoteError(text)
