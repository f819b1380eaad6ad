"""Who may open a stream, and how fast each may go: shares of identities, and of the server as a whole."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from cable_rpc.cloud.limits import ANYBODY, UNLIMITED, Identity, IdentityLimits, ServerLimits
from cable_rpc.errors import CapacityError, ProtocolError, Refusal

BURST_S = 2.0
"""A share may be used this far ahead: a keyframe is many times as large as the frames after it."""
LONGEST_WAIT_S = 5.0
"""A frame that would have to wait longer for its share ends the stream."""
RETRY_S = 5.0
"""When somebody is told to ask again for a place that others have."""
OWN_RATE_SLACK = 1.25
"""How far a stream may exceed the rate that it announced, where the server's pixel rate is shared out."""
DEFAULT_FRAME_RATE = 10.0
"""Of a CodecConfig that tells none."""
HIGHEST_FRAME_RATE = 1000

Clock = Callable[[], float]


class TokenBucket:
    """A rate with a reserve; what is taken beyond the reserve is a debt that time pays off."""

    def __init__(self, rate: float, clock: Clock) -> None:
        self.rate = rate
        self._clock = clock
        self._level = rate * BURST_S
        self._seen_s = clock()

    def take(self, amount: float) -> float:
        """Takes an amount; returns the seconds until it is paid for, 0 where there was enough."""
        if math.isinf(self.rate):
            return 0.0
        self._refill()
        self._level -= amount
        return max(0.0, -self._level / self.rate)

    @property
    def is_full(self) -> bool:
        """True when nothing has been taken for a while."""
        if math.isinf(self.rate):
            return True
        self._refill()
        return self._level >= self.rate * BURST_S

    def _refill(self) -> None:
        now_s = self._clock()
        self._level = min(self.rate * BURST_S, self._level + (now_s - self._seen_s) * self.rate)
        self._seen_s = now_s


class Account:
    """What one identity uses, all of its streams together."""

    def __init__(self, limits: IdentityLimits, clock: Clock) -> None:
        self.streams = 0
        self.announced_pixels_per_s = 0.0
        self.set_limits(limits, clock)

    def set_limits(self, limits: IdentityLimits, clock: Clock) -> None:
        """Changes the share, for open streams too; the reserves begin full."""
        self.limits = limits
        self.frames = TokenBucket(limits.frames_per_s, clock)
        self.pixels = TokenBucket(limits.pixels_per_s, clock)
        self.bytes = TokenBucket(limits.bytes_per_s, clock)

    @property
    def is_idle(self) -> bool:
        """True when forgetting it would give its owner nothing."""
        return self.streams == 0 and self.frames.is_full and self.pixels.is_full and self.bytes.is_full


class AdmissionControl:
    """Keeps count over all streams of a server; belongs to its event loop."""

    def __init__(self, limits: ServerLimits | None = None, clock: Clock = time.monotonic) -> None:
        self.limits = limits or ServerLimits()
        self.clock = clock
        self.streams = 0
        self.announced_pixels_per_s = 0.0
        self._accounts: dict[str, Account] = {}
        self._closed: Refusal | None = None

    def close(self, reason: Refusal) -> None:
        """Refuses every stream from now on."""
        self._closed = reason

    def open_stream(self, identity: Identity = ANYBODY) -> StreamShare:
        """A place for one more stream; give it back with `StreamShare.release`.

        Raises:
            CapacityError: the server, or the identity, has as many as it may.
            Refusal: the server takes no more streams.
        """
        if self._closed is not None:
            raise self._closed
        if self.streams >= self.limits.streams:
            raise CapacityError(f"the server has all of its {self.limits.streams} streams in use", RETRY_S)
        account = self._account_of(identity)
        if account.streams >= account.limits.streams:
            raise CapacityError(f"{identity.name} has all of its {account.limits.streams:g} streams in use", RETRY_S)
        account.streams += 1
        self.streams += 1
        return StreamShare(self, account, identity.name)

    def _account_of(self, identity: Identity) -> Account:
        for name in [name for name, account in self._accounts.items() if account.is_idle]:
            del self._accounts[name]
        limits = identity.limits or self.limits.identity
        account = self._accounts.get(identity.name)
        if account is None:
            account = self._accounts[identity.name] = Account(limits, self.clock)
        elif account.limits != limits:
            account.set_limits(limits, self.clock)
        return account


@dataclass(slots=True)
class StreamShare:
    """One stream's place."""

    control: AdmissionControl
    account: Account
    identity: str
    announced_pixels_per_s: float = 0.0
    pixels_per_frame: int = 0
    own: TokenBucket | None = field(default=None)
    released: bool = False

    @property
    def frame_rate_advice(self) -> float:
        """Frames per second that the share allows, for FlowUpdate.max_frame_rate; 0 = no advice."""
        rate = self.account.limits.frames_per_s
        return 0.0 if math.isinf(rate) else rate

    def announce(self, width: int, height: int, frame_rate: float) -> None:
        """Asks for what a CodecConfig announces; takes the place of what the stream announced before.

        Raises:
            CapacityError: it does not fit into what is left.
            ProtocolError: the rate is no usable number.
        """
        if not 0 <= frame_rate <= HIGHEST_FRAME_RATE:
            raise ProtocolError(f"CodecConfig.frame_rate is {frame_rate:g}; it must lie in 0..{HIGHEST_FRAME_RATE}")
        wanted = width * height * (frame_rate or DEFAULT_FRAME_RATE)
        asked = f"{width}x{height} at {frame_rate or DEFAULT_FRAME_RATE:g} frames/s"
        added = wanted - self.announced_pixels_per_s
        for holder, limit, used in (
            (self.identity, self.account.limits.pixels_per_s, self.account.announced_pixels_per_s),
            ("the server", self.control.limits.pixels_per_s, self.control.announced_pixels_per_s),
        ):
            if used + added > limit:
                raise CapacityError(
                    f"{asked} are {wanted / 1e6:.1f} Mpixel/s, and {holder} has "
                    f"{max(0.0, limit - used + self.announced_pixels_per_s) / 1e6:.1f} of {limit / 1e6:.1f} left; "
                    "stream smaller or slower, or try again later",
                    RETRY_S,
                )
        self._book(added)
        self.pixels_per_frame = width * height
        if self.control.limits.pixels_per_s < UNLIMITED:
            self.own = TokenBucket(wanted * OWN_RATE_SLACK, self.control.clock)

    def take_frame(self, size_bytes: int) -> float:
        """Takes what a frame costs; returns the seconds that it must wait for its share.

        Raises:
            CapacityError: it would have to wait too long: the client sends much more than it may.
        """
        account = self.account
        waits = {
            "frames": account.frames.take(1),
            "pixels": account.pixels.take(self.pixels_per_frame),
            "bytes": account.bytes.take(size_bytes),
            "announced pixels": self.own.take(self.pixels_per_frame) if self.own else 0.0,
        }
        scarce = max(waits, key=lambda name: waits[name])
        wait_s = waits[scarce]
        if wait_s > LONGEST_WAIT_S:
            raise CapacityError(
                f"{self.identity} is {wait_s:.0f} s ahead of its {scarce} per second; send fewer or smaller frames",
                wait_s,
            )
        return wait_s

    def release(self) -> None:
        """Gives the place back; again is no harm."""
        if not self.released:
            self.released = True
            self._book(-self.announced_pixels_per_s)
            self.account.streams -= 1
            self.control.streams -= 1

    def _book(self, added: float) -> None:
        self.announced_pixels_per_s += added
        self.account.announced_pixels_per_s += added
        self.control.announced_pixels_per_s += added
