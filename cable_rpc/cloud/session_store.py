"""Sessions without a stream, kept for a while so that their clients can go on where they were."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from cable_rpc.cloud.limits import Identity
from cable_rpc.cloud.stream_decoder import StreamDecoder
from cable_rpc.wire.v1 import perception_pb2 as pb

log = logging.getLogger(__name__)

TOKEN_BYTES = 24


@dataclass(frozen=True, slots=True)
class StoreLimits:
    """How long sessions without a stream are kept, and how many; where there are too many, the oldest goes first."""

    window_s: float = 30.0
    """0 = none is kept."""
    sessions: int = 64
    identity_sessions: int = 16
    """Of one identity."""
    pixels: int = 1 << 27
    """Sum of the frame sizes: a decoder holds pictures."""


@dataclass(slots=True)
class SessionState:
    """What of a session outlives its stream."""

    session_id: str
    """Also the name under which the segmenter keeps what it remembers."""
    config: pb.CodecConfig = field(default_factory=pb.CodecConfig)
    task: pb.TaskConfig = field(default_factory=pb.TaskConfig)
    decoder: StreamDecoder | None = None
    last_sequence: int | None = None

    @property
    def pixels(self) -> int:
        """Size of a frame."""
        return self.config.width * self.config.height

    @property
    def decoded_sequence(self) -> int | None:
        """Frame that the next one may refer to; None = only a keyframe can be decoded."""
        if self.decoder is None or self.decoder.needs_keyframe:
            return None
        return self.decoder.last_good_sequence

    async def settle(self) -> None:
        """Waits for a decode under way, off the loop: cancelling who waits for it does not stop it."""
        if self.decoder is not None:
            await asyncio.to_thread(self.decoder.wait_idle)

    async def close(self) -> None:
        """Frees the decoder, after a decode under way, off the loop."""
        decoder, self.decoder = self.decoder, None
        if decoder is not None:
            await asyncio.to_thread(decoder.close)


class OpenSession(Protocol):
    """A session that has a stream."""

    identity: Identity

    async def give_way(self) -> None:
        """Ends the stream; when this returns, its state is in the store."""
        ...


@dataclass(frozen=True, slots=True)
class _Kept:
    identity: Identity
    state: SessionState
    expiry: asyncio.TimerHandle


class SessionStore:
    """Sessions by their tokens; belongs to one event loop. A token is good only for the identity it was given to.

    Args:
        limits: how long and how many.
        forget: is told the name of a session whose state is gone.
    """

    def __init__(self, limits: StoreLimits, forget: Callable[[str], None]) -> None:
        self.limits = limits
        self._forget = forget
        self._open: dict[bytes, OpenSession] = {}
        self._kept: dict[bytes, _Kept] = {}
        self._endings: set[asyncio.Task[None]] = set()
        self._closed = False

    def __len__(self) -> int:
        """Sessions without a stream."""
        return len(self._kept)

    @property
    def pixels(self) -> int:
        """Sum of their frame sizes."""
        return sum(kept.state.pixels for kept in self._kept.values())

    def enter(self, session: OpenSession, token: bytes = b"") -> bytes:
        """A session has a stream now; returns its token, a new one where it has none."""
        token = token or secrets.token_bytes(TOKEN_BYTES)
        self._open[token] = session
        return token

    async def end_stream(self, token: bytes, identity: Identity) -> None:
        """Ends the stream that a session still has, where the token is good: its client would not call otherwise."""
        session = self._open.get(token)
        if session is not None and session.identity.name == identity.name:
            await session.give_way()

    def take(self, token: bytes, identity: Identity) -> SessionState | None:
        """The session of a token; None where it is not kept here, or belongs to another identity."""
        kept = self._kept.get(token)
        if kept is None or kept.identity.name != identity.name:
            return None
        del self._kept[token]
        kept.expiry.cancel()
        return kept.state

    async def leave(self, token: bytes, identity: Identity, state: SessionState, *, keep: bool) -> None:
        """A session's stream has ended.

        Args:
            token: of the session.
            identity: whose it is.
            state: what is left of it.
            keep: False frees it.
        """
        self._open.pop(token, None)
        limits = self.limits
        if not keep or self._closed or limits.window_s <= 0 or state.pixels > limits.pixels:
            self._forget(state.session_id)
            await state.close()
            return
        own = [key for key, kept in self._kept.items() if kept.identity.name == identity.name]
        if len(own) >= limits.identity_sessions:
            self._drop(own[0])
        while self._kept and (len(self._kept) >= limits.sessions or self.pixels + state.pixels > limits.pixels):
            self._drop(next(iter(self._kept)))
        expiry = asyncio.get_running_loop().call_later(limits.window_s, self._drop, token)
        self._kept[token] = _Kept(identity, state, expiry)

    def keep_only(self, is_known: Callable[[Identity], bool]) -> None:
        """Drops the sessions of identities that are not known any more."""
        for token in [token for token, kept in self._kept.items() if not is_known(kept.identity)]:
            self._drop(token)

    async def close(self) -> None:
        """Frees everything; what comes later is not kept."""
        self._closed = True
        for token in list(self._kept):
            self._drop(token)
        await asyncio.gather(*self._endings)

    def _drop(self, token: bytes) -> None:
        kept = self._kept.pop(token)
        kept.expiry.cancel()
        log.info("session %s: not kept any longer", kept.state.session_id)
        self._forget(kept.state.session_id)
        ending = asyncio.create_task(kept.state.close())
        self._endings.add(ending)
        ending.add_done_callback(self._endings.discard)
