"""Proof of identity before any handler runs: a bearer token, or the certificate of mutual TLS."""

from __future__ import annotations

import inspect
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextvars import ContextVar
from typing import Any, TypeAlias

import grpc

from cable_rpc.cloud.limits import ANYBODY, Identity
from cable_rpc.cloud.telemetry import NOBODY, Telemetry
from cable_rpc.cloud.throttled_log import ThrottledWarning
from cable_rpc.cloud.tls import certificate_subject
from cable_rpc.cloud.tokens import AccessFile
from cable_rpc.errors import AuthenticationError

log = logging.getLogger(__name__)
warn_of_refusal = ThrottledWarning(log)

OPEN_SERVICES = ("/grpc.health.v1.Health/",)
"""Probes of load balancers and orchestrators bring no token, and learn nothing but up or down."""
SCHEME = "bearer "

current_identity: ContextVar[Identity] = ContextVar("current_identity", default=ANYBODY)
"""Who makes the call that the running handler answers."""

Handler: TypeAlias = "grpc.RpcMethodHandler[Any, Any]"
Context: TypeAlias = "grpc.aio.ServicerContext[Any, Any]"


class Authenticator:
    """Finds out who a client is.

    Args:
        access: who may come; None = everybody, but a certificate still gives its subject as the name.
    """

    def __init__(self, access: AccessFile | None) -> None:
        self._access = access

    def identify(self, tokens: Sequence[str], subject: str | None) -> Identity:
        """Who brings these tokens and shows a certificate of this subject; a token goes before a certificate.

        Raises:
            AuthenticationError: nobody who is known.
        """
        if self._access is None:
            return ANYBODY if subject is None else Identity(subject)
        if len(tokens) > 1:
            raise AuthenticationError("the call has several authorization entries; send one")
        if tokens:
            identity = self._access.list.of_token(tokens[0])
            if identity is None:
                raise AuthenticationError("the token is not known here")
            return identity
        identity = None if subject is None else self._access.list.of_subject(subject)
        if identity is None:
            raise AuthenticationError("a token is needed: send 'authorization: Bearer TOKEN' with each call")
        return identity

    def still_known(self, identity: Identity) -> bool:
        """False when the identity has been taken off the list."""
        return self._access is None or identity.name in self._access.list.identities


def tokens_of(metadata: Sequence[tuple[str, str | bytes]] | None) -> list[str]:
    """The bearer tokens among a call's metadata."""
    entries = [value for key, value in metadata or () if key == "authorization" and isinstance(value, str)]
    return [entry[len(SCHEME) :].strip() for entry in entries if entry[: len(SCHEME)].lower() == SCHEME]


class AuthenticationInterceptor(grpc.aio.ServerInterceptor):
    """Ends calls of unknown clients with UNAUTHENTICATED before their handler runs, and tells handlers who calls."""

    def __init__(self, authenticator: Authenticator, telemetry: Telemetry = NOBODY) -> None:
        self._authenticator = authenticator
        self._telemetry = telemetry

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler | None]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler | None:
        """See `grpc.aio.ServerInterceptor`."""
        handler = await continuation(handler_call_details)
        # None stands for a method that does not exist; gRPC answers that.
        if handler is None or handler_call_details.method.startswith(OPEN_SERVICES):
            return handler
        return self._guarded(handler)

    def _guarded(self, handler: Handler) -> Handler:
        for kind in ("unary_unary", "unary_stream", "stream_unary", "stream_stream"):
            behaviour = getattr(handler, kind)
            if behaviour is None:
                continue
            wrap = self._guarded_generator if inspect.isasyncgenfunction(behaviour) else self._guarded_coroutine
            make = getattr(grpc, f"{kind}_rpc_method_handler")
            guarded: Handler = make(
                wrap(behaviour),
                request_deserializer=handler.request_deserializer,
                response_serializer=handler.response_serializer,
            )
            return guarded
        return handler

    def _guarded_coroutine(self, behaviour: Callable[..., Awaitable[Any]]) -> Callable[..., Awaitable[Any]]:
        async def run(request: Any, context: Context) -> Any:
            await self._admit(context)
            return await behaviour(request, context)

        return run

    def _guarded_generator(self, behaviour: Callable[..., AsyncIterator[Any]]) -> Callable[..., AsyncIterator[Any]]:
        async def run(request: Any, context: Context) -> AsyncIterator[Any]:
            await self._admit(context)
            async for response in behaviour(request, context):
                yield response

        return run

    async def _admit(self, context: Context) -> None:
        subject = certificate_subject(context.auth_context())
        try:
            identity = self._authenticator.identify(tokens_of(tuple(context.invocation_metadata() or ())), subject)
        except AuthenticationError as error:
            self._telemetry.authentication_failed()
            warn_of_refusal("refused a call from %s: %s", context.peer(), error)
            await context.abort(error.code, str(error))
        current_identity.set(identity)
