"""A session that outlives its connections: it comes back, goes on where the server can, and says what was lost."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import replace

from cable_rpc.edge.backoff import Backoff
from cable_rpc.edge.channel import PLAIN, ClientSecurity, SecureTarget
from cable_rpc.edge.client import SILENCE_TIMEOUT_S, PerceptionClient, SessionRequest
from cable_rpc.edge.credit import Credit
from cable_rpc.errors import ConfigurationError, ConnectionLost, RemoteError
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.clock import ClockOffset
from cable_rpc.wire.v1 import perception_pb2 as pb

log = logging.getLogger(__name__)

DEFAULT_RECONNECT_S = 60.0

Report = Callable[[str], None]


class ResumingClient:
    """A `PerceptionClient` that reconnects; use as an async context manager, and in its place.

    When the connection breaks, falls silent, or the server asks to be called again (Closing with RESUME or MOVE), each
    frame that is unanswered gets a `FrameAnswer` with ``is_lost``; then the client knocks again, with a growing
    jittered wait, and gives the token of its last Welcome. Meanwhile `acquire_credit` does not return. Nothing is sent
    twice. An error that coming back would not mend (Closing with STOP, a refused token or certificate) is raised at
    once, and so is the failure of the very first connection.

    With MOVE it goes to the server that was named, under the same security: never from TLS to plain text, never with a
    token in plain text except to this machine, and the certificate must be made out to the new name. Where that one
    can't be reached it tries its first target in turn; where it refuses, or is not trusted, it goes back there.

    Args:
        target: ``grpcs://host:port``, ``grpc://host:port`` or ``host:port``.
        request: what is asked for.
        security: TLS and token.
        window: unanswered frames at most, where that is less than the server grants.
        connect_timeout_s: for everything up to the Welcome, each time.
        silence_timeout_s: after which a connection counts as lost.
        reconnect_s: how long to try in a row; 0 = raise the error of the first connection.
        report: is told, in a sentence, when the server is lost and found again.

    Raises:
        ConfigurationError: target, certificates or token can't be used.
        RemoteError: the server can't be reached for too long, or refused the session.
    """

    def __init__(
        self,
        target: str,
        request: SessionRequest,
        *,
        security: ClientSecurity = PLAIN,
        window: int | None = None,
        connect_timeout_s: float = 10.0,
        silence_timeout_s: float = SILENCE_TIMEOUT_S,
        reconnect_s: float = DEFAULT_RECONNECT_S,
        report: Report = log.warning,
    ) -> None:
        self.connection = 0
        """Changes with every loss and every Welcome: what was prepared under another number is out of date."""
        self.lost_frames = 0
        self.reconnects = 0
        self._first_target = target
        self._security = replace(security, tls=SecureTarget(target, security).tls)
        self._window = window
        self._connect_timeout_s = connect_timeout_s
        self._silence_timeout_s = silence_timeout_s
        self._reconnect_s = reconnect_s
        self._report = report
        self._credit = Credit()
        self._backoff = Backoff()
        self._request = request
        self._unanswered: list[int] = []
        self._last_sent: int | None = None
        self._finished = False
        self._is_open = False
        self._opened_s = 0.0
        self._client = self._client_for(target)

    # -- as PerceptionClient --------------------------------------------------------------------------------------

    @property
    def target(self) -> str:
        """The server in use."""
        return self._client.target

    @property
    def server_info(self) -> pb.GetServerInfoResponse:
        """What the server is."""
        return self._client.server_info

    @property
    def session_id(self) -> str:
        """Name of the session in the server's logs."""
        return self._client.session_id

    @property
    def clock_offset(self) -> ClockOffset | None:
        """Server clock against ours; of the server in use."""
        return self._client.clock_offset

    @property
    def max_frame_rate(self) -> float:
        """Frames per second that the server advises; 0 = any."""
        return self._client.max_frame_rate

    @property
    def resumed(self) -> bool:
        """True when the server in use still had the session."""
        return self._client.resumed

    @property
    def decoded_sequence(self) -> int | None:
        """Frame that the first one of this connection may refer to; None = begin with a keyframe."""
        return self._client.decoded_sequence

    @property
    def keyframe_requested(self) -> bool:
        """The server asks for a keyframe."""
        return self._client.keyframe_requested

    @keyframe_requested.setter
    def keyframe_requested(self, value: bool) -> None:
        self._client.keyframe_requested = value

    async def __aenter__(self) -> ResumingClient:
        await self._client.__aenter__()
        self._opened()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._leave()

    async def acquire_credit(self) -> None:
        """Waits until there is a connection and another frame may be sent."""
        await self._credit.acquire()

    def release_credit(self) -> None:
        """Gives the place of an answered frame back; not that of a lost one."""
        self._credit.release()

    async def send(self, frame: pb.VideoFrame) -> None:
        """Stamps a frame and hands it to the transport; where that fails, the frame is reported lost in its turn.

        Raises:
            ConnectionLost: there is no connection now.
            RemoteError: the frame is too large.
        """
        if not self._is_open:
            raise ConnectionLost(f"there is no connection to {self.target}")
        connection = self.connection
        self._unanswered.append(frame.sequence)
        self._last_sent = frame.sequence
        try:
            await self._client.send(frame)
        except ConnectionLost:
            # Whoever reads the answers is about to see it too; until then no frame is thrown after it.
            if self.connection == connection:
                self._credit.resize(0)

    async def finish(self, *, keep_session: bool = False) -> None:
        """No more frames; the server answers what is pending and ends the stream. See `PerceptionClient.finish`."""
        self._finished = True
        if self._is_open:
            try:
                await self._client.finish(keep_session=keep_session)
            except ConnectionLost as error:
                log.info("the end was not told: %s", error)

    async def answers(self) -> AsyncGenerator[FrameAnswer, None]:
        """One answer for each frame sent, in order, be it that it was lost; ends with the last stream.

        Raises:
            RemoteError: the server closed the session for good, or was away for too long.
            ProtocolError: the server sent something that does not fit.
        """
        while True:
            error = ConnectionLost(f"{self.target} ended the stream before the source did")
            try:
                async with aclosing(self._client.answers()) as answers:
                    async for answer in answers:
                        self._answered(answer.sequence)
                        yield answer
                if self._finished and not self._unanswered:
                    return
            except ConnectionLost as lost:
                error = lost
            if self._reconnect_s <= 0:
                raise error
            for answer in await self._lose(error):
                yield answer
            if not await self._reconnect(error):
                return

    # -- coming back ----------------------------------------------------------------------------------------------

    def _answered(self, sequence: int) -> None:
        if sequence in self._unanswered:
            self._unanswered.remove(sequence)
            # A server that says Welcome and breaks off before it has answered a frame is one more failed attempt.
            self._backoff = Backoff()
            self._request = replace(self._request, last_result_sequence=sequence)

    async def _lose(self, error: ConnectionLost) -> list[FrameAnswer]:
        """Leaves a broken connection; what stands for the answers that it owes."""
        then = "it was all sent" if self._finished else "reconnecting"
        self._report(f"lost the server after {time.monotonic() - self._opened_s:.1f} s: {error}; {then}")
        self.connection += 1
        self._credit.reset(0)
        await self._leave()
        lost, self._unanswered = self._unanswered, []
        self.lost_frames += len(lost)
        return [FrameAnswer.lost(sequence, str(error)) for sequence in lost]

    async def _reconnect(self, error: ConnectionLost) -> bool:
        """Knocks until a server says Welcome; False when the source has ended meanwhile.

        Raises:
            RemoteError: there was none for too long, or one that refuses us.
        """
        lost_s = time.monotonic()
        targets = self._targets(error)
        while not self._finished:
            wait_s = self._backoff.next_s(error.retry_after_s)
            away_s = time.monotonic() - lost_s
            if away_s + wait_s > self._reconnect_s:
                raise RemoteError(f"no server for {away_s:.0f} s, gave up: {error}") from error
            await asyncio.sleep(wait_s)
            target = targets[0]
            info = self._client.server_info
            self._client = self._client_for(target)
            self._client.server_info = info
            try:
                await self._client.__aenter__()
            except ConnectionLost as failure:
                error = failure
                targets = self._targets(error) if error.alternative_target else [*targets[1:], target]
                continue
            except RemoteError as refusal:
                if target == self._first_target:
                    raise
                # Only our own server's word is final; the one we were sent to may not be its equal.
                self._report(f"not going to {target}: {refusal}")
                error, targets = ConnectionLost(str(refusal)), [self._first_target]
                continue
            if self._client.welcome.models:
                del info.models[:]
                info.models.extend(self._client.welcome.models)
            self.reconnects += 1
            self._opened()
            self._report(f"resumed after {time.monotonic() - lost_s:.1f} s{self._place()} ({self._kept()})")
            return True
        return False

    def _targets(self, error: ConnectionLost) -> list[str]:
        """Where to knock, in turn."""
        targets = [self.target, self._first_target]
        if error.alternative_target:
            try:
                SecureTarget(error.alternative_target, self._security)
                targets.insert(0, error.alternative_target)
            except ConfigurationError as refusal:
                self._report(f"not going to {error.alternative_target}: {refusal}")
        return list(dict.fromkeys(targets))

    def _client_for(self, target: str) -> PerceptionClient:
        return PerceptionClient(
            target,
            self._request,
            security=self._security,
            window=self._window,
            connect_timeout_s=self._connect_timeout_s,
            silence_timeout_s=self._silence_timeout_s,
            credit=self._credit,
        )

    def _opened(self) -> None:
        self._is_open = True
        self._opened_s = time.monotonic()
        self.connection += 1
        self._request = replace(self._request, resume_token=self._client.welcome.resume_token)

    async def _leave(self) -> None:
        if self._is_open:
            self._is_open = False
            await self._client.__aexit__()

    def _place(self) -> str:
        return "" if self.target == self._first_target else f" at {self.target}"

    def _kept(self) -> str:
        if not self.resumed:
            return "new session"
        if self.decoded_sequence is not None and self.decoded_sequence == self._last_sent:
            return "session kept, no keyframe needed"
        return "session kept, next frame is a keyframe"
