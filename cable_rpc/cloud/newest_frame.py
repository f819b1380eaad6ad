"""The frame of a session that the models take next: always the newest, and never one that has waited too long."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from dataclasses import dataclass

from cable_rpc.cloud.answer_queue import Answer
from cable_rpc.cloud.frame_answers import rejection_of, resolve
from cable_rpc.cloud.stream_decoder import DecodedFrame
from cable_rpc.wire.v1 import perception_pb2 as pb


@dataclass(frozen=True, slots=True)
class WaitingFrame:
    """A decoded frame that waits for the models."""

    sequence: int
    decoded: DecodedFrame
    timing: pb.ServerTiming
    answer: Answer
    deadline_ns: int = 0
    """The client's own limit after receiving, 0 = none."""


@dataclass(frozen=True, slots=True)
class _OvertakenFrame:
    """What is left of a frame when a newer one is there: no picture."""

    sequence: int
    timing: pb.ServerTiming
    answer: Answer


class NewestFrame:
    """A mailbox of one.

    A frame that is overtaken here keeps its place in the client's credit until the models turn to the stream: an
    answer at once would only bring the next frame, to be overtaken in its turn, and fill the uplink for nothing.

    Args:
        latency_bound_s: what waited longer is shed when its turn comes; 0 = nothing is.
    """

    def __init__(self, latency_bound_s: float = 0.0) -> None:
        self._bound_ns = round(latency_bound_s * 1e9)
        self._newest: WaitingFrame | None = None
        self._overtaken: deque[_OvertakenFrame] = deque()
        self._arrived = asyncio.Event()
        self.overtaken = 0
        """By the frame that was taken last."""

    def offer(self, frame: WaitingFrame) -> None:
        """Puts a frame in, in place of the one that is there."""
        old = self._newest
        if old is not None:
            self._overtaken.append(_OvertakenFrame(old.sequence, old.timing, old.answer))
        self._newest = frame
        self._arrived.set()

    async def wait(self) -> None:
        """Returns as soon as there is a frame."""
        await self._arrived.wait()

    def take(self) -> WaitingFrame | None:
        """The newest frame; answers those it has overtaken. None where it has waited too long, or is not there."""
        frame, self._newest = self._newest, None
        self._arrived.clear()
        if frame is None:
            return None
        self.overtaken = len(self._overtaken)
        while self._overtaken:
            old = self._overtaken.popleft()
            text = f"frame {old.sequence} was overtaken by {frame.sequence}"
            resolve(old.answer, rejection_of(old.sequence, old.timing, pb.REJECT_REASON_SUPERSEDED, text))
        return None if self._is_late(frame) else frame

    def _is_late(self, frame: WaitingFrame) -> bool:
        waited_ns = time.monotonic_ns() - frame.timing.receive_time_ns
        waited = f"frame {frame.sequence} waited {waited_ns / 1e6:.0f} ms"
        if 0 < frame.deadline_ns < waited_ns:
            reason, text = pb.REJECT_REASON_DEADLINE, f"{waited}, its deadline is {frame.deadline_ns / 1e6:.0f} ms"
        elif 0 < self._bound_ns < waited_ns:
            reason = pb.REJECT_REASON_OVERLOADED
            text = f"{waited}, this server's bound is {self._bound_ns / 1e6:.0f} ms; send fewer frames per second"
        else:
            return False
        resolve(frame.answer, rejection_of(frame.sequence, frame.timing, reason, text))
        return True
