"""The exceptions of the package: one root, each child with the gRPC status code it travels as."""

from __future__ import annotations

import grpc


class CableError(Exception):
    """Root of all errors raised on purpose; the text says what was wrong, where, and what to do."""

    code: grpc.StatusCode = grpc.StatusCode.UNKNOWN


class ConfigurationError(CableError):
    """A setting, flag or file given by the user can't be used."""

    code = grpc.StatusCode.INVALID_ARGUMENT


class SourceError(CableError):
    """A camera, video or data set can't be read."""

    code = grpc.StatusCode.NOT_FOUND


class FrameError(CableError):
    """One frame can't be processed; the stream goes on."""

    code = grpc.StatusCode.DATA_LOSS


class ProtocolError(CableError):
    """The peer broke a rule of the session; the stream ends."""

    code = grpc.StatusCode.FAILED_PRECONDITION


class ModelError(CableError):
    """A model can't be loaded or failed."""

    code = grpc.StatusCode.FAILED_PRECONDITION


class RemoteError(CableError):
    """The other end refused, vanished or closed the session."""

    code = grpc.StatusCode.UNAVAILABLE


class ConnectionLost(RemoteError):
    """The way to the other end is broken, or it asks to be called again; carries how."""

    def __init__(self, message: str, *, retry_after_s: float | None = None, alternative_target: str = "") -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s
        self.alternative_target = alternative_target


class AuthenticationError(CableError):
    """The peer did not prove who it is, or is not known here."""

    code = grpc.StatusCode.UNAUTHENTICATED


class Refusal(CableError):
    """What was asked for is fine, but not now; carries when to try again."""

    code = grpc.StatusCode.UNAVAILABLE

    def __init__(self, message: str, retry_after_s: float) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class CapacityError(Refusal):
    """A limit of the server or of the peer's share is used up."""

    code = grpc.StatusCode.RESOURCE_EXHAUSTED
