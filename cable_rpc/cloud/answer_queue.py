"""A session's messages to its client in their order: places for answers that are still to come, and all others."""

from __future__ import annotations

import asyncio
from collections import deque

from cable_rpc.wire.v1 import perception_pb2 as pb

Response = pb.StreamPerceptionResponse
Answer = asyncio.Future[Response]


class AnswerQueue:
    """Hands out messages in the order in which their places were taken; belongs to one event loop."""

    def __init__(self) -> None:
        self._places: deque[Response | Answer | None] = deque()
        self._ready = asyncio.Event()
        self.unanswered = 0
        """Frames whose answer has not been handed out; one that is ready counts until the client can take it."""

    def send(self, response: Response) -> None:
        """A message that is ready."""
        self._places.append(response)
        self._wake()

    def open_answer(self) -> Answer:
        """Takes the place of a frame's answer, which the caller sets; later messages wait for it."""
        answer: Answer = asyncio.get_running_loop().create_future()
        answer.add_done_callback(self._wake)
        self._places.append(answer)
        self.unanswered += 1
        return answer

    def end(self) -> None:
        """Nothing comes after what has a place now."""
        self._places.append(None)
        self._wake()

    def abandon(self) -> None:
        """Nothing comes any more, not even what has a place."""
        self._places.clear()
        self.end()

    async def next(self, timeout_s: float) -> Response | None:
        """The next message, None at the end.

        Raises:
            TimeoutError: none was ready in time.
        """
        while not self._has_next():
            self._ready.clear()
            async with asyncio.timeout(timeout_s):
                await self._ready.wait()
        place = self._places.popleft()
        if not isinstance(place, asyncio.Future):
            return place
        self.unanswered -= 1
        return place.result()

    def _has_next(self) -> bool:
        if not self._places:
            return False
        first = self._places[0]
        return not isinstance(first, asyncio.Future) or first.done()

    def _wake(self, _: Answer | None = None) -> None:
        if self._has_next():
            self._ready.set()
