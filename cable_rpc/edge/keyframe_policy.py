"""When a frame is sent whole: the paper's refresh flag and its remedies, a period, a byte budget, or doubt."""

from __future__ import annotations

from dataclasses import dataclass

from cable_rpc.edge.refresh import prior_lost, region_lost
from cable_rpc.edge.roi_config import RoiConfig

NS_PER_S = 1_000_000_000
BYTES_PER_KBIT = 125

REVEALING_SHARE = 0.02
"""Share of a keyframe's mask outside the region from which on the keyframe was worth it; less is a ragged edge."""

DOUBT_WEIGHT = 0.2
"""Uncertainty for each answer of confidence 0; at confidence 0.5 an answer a frame makes 1 in ten frames."""
LATENESS_WEIGHT = 0.02
"""Uncertainty for each frame and each frame that its prior is older than one."""
LATENESS_LIMIT = 5
"""Frames of lateness from which on more of it counts no further: that is silence, which ``stale_after_s`` ends."""
MOTION_WEIGHT = 10.0
"""Uncertainty for each frame whose motion outside the region would fill the whole frame."""
MOTION_LIMIT = 0.01
"""Share of the frame from which on more motion outside the region counts no further: that is the background."""


@dataclass(frozen=True, slots=True)
class NewAnswer:
    """The newest answer of the cloud since the last decision.

    Where several have come and one of them was a keyframe's, the keyframe's is the one to tell.
    """

    mask_empty: bool
    of_keyframe: bool
    """Its frame had been sent whole."""
    revealed: float = 0.0
    """Share of its mask outside the region that would have been sent (``revealed_share``)."""
    confidence: float = 1.0
    """0..1; anything else counts as 0."""


@dataclass(frozen=True, slots=True)
class KeyframeSignals:
    """All that is known when the upload of a frame is decided."""

    time_ns: int
    """Capture time of the frame."""
    first: bool
    """No mask has ever come."""
    requested: bool
    """The stream was reconnected, or the server asked."""
    coverage: float | None = None
    """Share of the frame in R of the frame before; None where it had none."""
    prior_iou: float | None = None
    """Agreement of warped prior and mask at the newest answer's own frame; None without new answer or prior there."""
    answer: NewAnswer | None = None
    """None where none has come since the last decision."""
    staleness: int | None = None
    """Frames from the prior's frame to this one, 1 in lock-step; None before the first mask."""
    residual_outside: float = 0.0
    """Share of the frame that moves outside R of this frame."""
    heard_time_ns: int = 0
    """Capture time of the newest frame when the last answer came."""


class ByteBudget:
    """Token bucket in bytes that keyframes are paid from.

    A purchase needs the last keyframe's size in the bucket, or a full bucket where that is less; the real size is
    charged when it is known, and until then nothing more is bought. Keyframes that must be sent are charged too and
    may leave a debt. The bucket is never in debt at a purchase, hence: over any span of T seconds that ends with a
    bought keyframe, all keyframes before that one have cost at most ``capacity + rate * T`` bytes.
    """

    def __init__(self, rate_kbps: float, burst_s: float) -> None:
        self.bytes_per_s = rate_kbps * BYTES_PER_KBIT
        self.capacity = self.bytes_per_s * burst_s
        self._level = self.capacity
        self._price = 0.0
        self._filled_time_ns: int | None = None
        self._unpaid_time_ns: int | None = None

    def fill(self, time_ns: int) -> None:
        """Add what has come in up to a capture time."""
        if self._filled_time_ns is not None:
            income = self.bytes_per_s * (time_ns - self._filled_time_ns) / NS_PER_S
            self._level = min(self._level + income, self.capacity)
        self._filled_time_ns = time_ns

    @property
    def affordable(self) -> bool:
        """A keyframe like the last one can be paid."""
        return self._unpaid_time_ns is None and self._level >= min(self._price, self.capacity)

    @property
    def full(self) -> bool:
        """Waiting longer would waste income."""
        return self._unpaid_time_ns is None and self._level >= self.capacity

    def order(self, time_ns: int) -> None:
        """A keyframe captured then will have to be paid."""
        self._unpaid_time_ns = time_ns

    def charge(self, keyframe: bool, byte_count: int, time_ns: int) -> None:
        """A frame captured then was sent; a later one than the ordered keyframe says that it was dropped."""
        if keyframe:
            self._level -= byte_count
            self._price = byte_count
        if self._unpaid_time_ns is not None and time_ns >= self._unpaid_time_ns:
            self._unpaid_time_ns = None


class KeyframeScheduler:
    """Decides for one stream, frame by frame, which frames are sent whole.

    A stream's first frames (until a mask has come) and requested keyframes are always sent whole. Silence of the
    cloud asks for one keyframe per ``stale_after_s``, whatever the budget, but not within the minimum interval.
    Beyond these ``config.keyframe_policy`` decides:

    * ``paper``: c_{k+1} (``refresh_flag``), at most every minimum and at least every maximum interval. A lost prior
      that falls into the minimum interval is made up for at its end. With ``settle_after_keyframe`` nothing that
      goes back to a prior older than the last keyframe's mask counts, unless that mask is empty; with
      ``keyframe_backoff`` the wait for the coverage to be judged again doubles with each keyframe that reveals
      nothing, until one does, the prior is lost, or the region has grown back.
    * ``periodic``: a keyframe every ``keyframe_period`` frames, without regard to the intervals.
    * ``budget``: as ``paper``, as far as a ``ByteBudget`` pays, and whenever it is full; no maximum interval.
    * ``uncertainty``: when ``uncertainty`` reaches its limit, between minimum and maximum interval.

    Intervals are counted in decisions, from the last keyframe of whatever reason.

    Args:
        config: the keyframe settings of the method.
    """

    def __init__(self, config: RoiConfig) -> None:
        self.config = config
        self._shortest_wait = max(config.min_keyframe_interval, 1)
        self._wait = self._shortest_wait
        self._wait_number = 0
        self._number = -1
        self._keyframe_number = -1
        self._keyframe_time_ns: int | None = None
        self._settled_number: int | None = 0
        self._prior_lost = False
        self._doubt = self._lateness = self._motion = 0.0
        self._budget = ByteBudget(config.keyframe_budget_kbps, config.keyframe_budget_burst_s)

    def decide(self, signals: KeyframeSignals) -> str | None:
        """Whether the next frame is sent whole: the reason, or None.

        Call once for each frame, in order; a keyframe counts as sent from here on.

        Returns:
            ``first``, ``requested``, ``stale``, ``coverage``, ``prior``, ``interval``, ``periodic``, ``budget``
            or ``uncertainty``.
        """
        self._number += 1
        self._budget.fill(signals.time_ns)
        self._judge(signals)
        self._gather_uncertainty(signals)
        reason = self._forced_reason(signals) or self._policy_reason(signals)
        if reason is not None:
            self._keyframe_number = self._number
            self._keyframe_time_ns = signals.time_ns
            self._settled_number = None
            self._prior_lost = False
            self._doubt = self._lateness = self._motion = 0.0
            self._budget.order(signals.time_ns)
        return reason

    def sent(self, keyframe: bool, byte_count: int, time_ns: int) -> None:
        """Tell the coded size of a frame that was really sent, in the order of capture.

        Args:
            keyframe: it was sent whole.
            byte_count: its coded size.
            time_ns: its capture time.
        """
        self._budget.charge(keyframe, byte_count, time_ns)

    @property
    def uncertainty(self) -> float:
        """What the edge can't know, gathered since the last keyframe; 1 is the default limit.

        The sum of (1 - confidence) of the answers, of the frames by which each prior was older than one, and of
        the shares of the frames that moved outside the region, each by its weight above.
        """
        return DOUBT_WEIGHT * self._doubt + LATENESS_WEIGHT * self._lateness + MOTION_WEIGHT * self._motion

    def _judge(self, signals: KeyframeSignals) -> None:
        """Note what the newest answer and the last region say of the prior and of the keyframes so far."""
        answered = None if signals.staleness is None else self._number - signals.staleness
        if self._settled_number is None and answered is not None and answered >= self._keyframe_number:
            self._settled_number = self._number
        if signals.coverage is not None and not region_lost(signals.coverage, self.config):
            self._set_wait(self._shortest_wait)
        if signals.answer is not None and signals.answer.of_keyframe:
            if signals.answer.revealed >= REVEALING_SHARE and not signals.answer.mask_empty:
                self._set_wait(self._shortest_wait)
            elif answered is not None and answered >= self._wait_number:
                # Keyframes from before the last change of the wait were not sent for want of a longer one.
                self._set_wait(min(2 * self._wait, self.config.max_keyframe_interval))
        if self._counts(answered, signals.answer) and prior_lost(signals.prior_iou, self.config):
            self._prior_lost = True
            self._set_wait(self._shortest_wait)

    def _set_wait(self, frames: int) -> None:
        if frames != self._wait:
            self._wait, self._wait_number = frames, self._number

    def _counts(self, number: int | None, answer: NewAnswer | None) -> bool:
        """Whether the region or the prior of a frame, by its number, may ask for a keyframe."""
        if not self.config.settle_after_keyframe or (answer is not None and answer.of_keyframe and answer.mask_empty):
            return True
        return self._settled_number is not None and (number is None or number >= self._settled_number)

    def _gather_uncertainty(self, signals: KeyframeSignals) -> None:
        if signals.answer is not None:
            confidence = signals.answer.confidence
            self._doubt += 1 - confidence if 0 <= confidence <= 1 else 1
        if signals.staleness is not None:
            self._lateness += min(signals.staleness - 1, LATENESS_LIMIT)
        self._motion += min(signals.residual_outside, MOTION_LIMIT)

    def _forced_reason(self, signals: KeyframeSignals) -> str | None:
        if signals.first:
            return "first"
        if signals.requested:
            return "requested"
        return "stale" if self._rested and self._is_stale(signals) else None

    def _policy_reason(self, signals: KeyframeSignals) -> str | None:
        config = self.config
        if config.keyframe_policy == "periodic":
            return "periodic" if self._frames_since_keyframe >= config.keyframe_period else None
        if not self._rested:
            return None
        if config.keyframe_policy == "budget":
            cause = self._paper_cause(signals) if self._budget.affordable else None
            return cause or ("budget" if self._budget.full else None)
        if config.keyframe_policy == "paper":
            cause = self._paper_cause(signals)
        else:
            cause = "uncertainty" if self.uncertainty >= config.uncertainty_limit else None
        return cause or ("interval" if self._frames_since_keyframe >= config.max_keyframe_interval else None)

    def _paper_cause(self, signals: KeyframeSignals) -> str | None:
        waited = not self.config.keyframe_backoff or self._frames_since_keyframe >= self._wait
        if waited and region_lost(signals.coverage, self.config) and self._counts(self._number - 1, signals.answer):
            return "coverage"
        return "prior" if self._prior_lost else None

    @property
    def _frames_since_keyframe(self) -> int:
        return self._number - self._keyframe_number

    @property
    def _rested(self) -> bool:
        return self._frames_since_keyframe >= self.config.min_keyframe_interval

    def _is_stale(self, signals: KeyframeSignals) -> bool:
        limit_s = self.config.stale_after_s
        if limit_s is None or signals.staleness is None or signals.staleness <= 1:
            return False
        quiet_since_ns = signals.heard_time_ns
        if self._keyframe_time_ns is not None:
            quiet_since_ns = max(quiet_since_ns, self._keyframe_time_ns)
        return (signals.time_ns - quiet_since_ns) / NS_PER_S > limit_s
