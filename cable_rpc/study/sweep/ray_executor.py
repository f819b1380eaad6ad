"""Calls as tasks of a Ray cluster, or of a Ray that is started on this machine for them alone."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any, Self

import cv2

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep.executors import Call, Outcome, answer
from cable_rpc.study.worker_pool import THREAD_LIMITS

ADDRESS_VARIABLE = "RAY_ADDRESS"
CALLS_PER_SLOT = 2
"""On the way at most: one that runs, and one that waits, which also tells an autoscaler that there is more to do."""
REPEATS = 1
"""Of a task whose process or node died."""


class RayExecutor:
    """An `Executor` over Ray tasks.

    The nodes need this package and the sources' files under the same paths; a folder for decoded clips that they do not
    share is filled on each node for itself.

    Args:
        address: of a cluster (``auto``, ``HOST:6379``, ``ray://HOST:10001``); None takes ``RAY_ADDRESS``, and without
            it starts a Ray of its own, which ends with the executor.
        workers: tasks beside each other of a Ray of its own; None = as many as the machine's CPUs allow.
        cpus: that a task asks for; also the threads of its numeric libraries.
        gpus: that a task asks for; parts of one are possible.

    Raises:
        ConfigurationError: a number is out of range.
    """

    def __init__(
        self, address: str | None = None, *, workers: int | None = None, cpus: float = 1.0, gpus: float = 0.0
    ) -> None:
        if (workers is not None and workers < 1) or cpus <= 0 or gpus < 0:
            raise ConfigurationError(
                f"a Ray of {workers} workers with {cpus:g} CPUs and {gpus:g} GPUs each can't be had; give at least 1 "
                "worker, more than 0 CPUs and at least 0 GPUs"
            )
        self.address = address or os.environ.get(ADDRESS_VARIABLE) or None
        self.workers = workers
        self.cpus = cpus
        self.gpus = gpus
        self._waiting: deque[Call] = deque()
        self._running: dict[Any, Call] = {}
        self._ray: Any = None
        self._task: Any = None
        self._started_here = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._ray is None:
            return
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._running.clear()
        if self._started_here:
            self._ray.shutdown()
        self._ray = None

    def submit(self, function: Callable[[Any], Any], argument: Any) -> None:
        """Hand in a call."""
        self._waiting.append(Call(function, argument))

    def completed(self) -> Iterator[Outcome]:
        """Runs what was handed in; each outcome as it becomes ready.

        Raises:
            ConfigurationError: Ray is missing or can't be reached, or has no GPU where one is asked for.
        """
        if self._ray is None and self._waiting:
            self.start()
        while self._waiting or self._running:
            most = CALLS_PER_SLOT * self.slots()
            while self._waiting and len(self._running) < most:
                call = self._waiting.popleft()
                self._running[self._task.remote(call)] = call
            ready, _ = self._ray.wait(list(self._running), num_returns=1)
            for reference in ready:
                yield self.outcome(reference, self._running.pop(reference))

    def outcome(self, reference: Any, call: Call) -> Outcome:
        """Of a task that has ended."""
        try:
            result, error = self._ray.get(reference)
        except self._ray.exceptions.RayError as failure:
            # A task's own trace ends with what happened; Ray's other errors begin with it, and go on about log files.
            last = isinstance(failure, self._ray.exceptions.RayTaskError)
            text = str(failure).strip().splitlines()[-1 if last else 0]
            return Outcome(call.argument, None, f"Ray gave it up: {text}")
        return Outcome(call.argument, result, error)

    def slots(self) -> int:
        """Tasks that the cluster has room for as it is now, at least 1."""
        resources = self._ray.cluster_resources()
        room = resources.get("CPU", 0.0) / self.cpus
        if self.gpus:
            room = min(room, resources.get("GPU", 0.0) / self.gpus)
        return max(1, int(room))

    def start(self) -> None:
        """Connect to the cluster, or start a Ray.

        Raises:
            ConfigurationError: it is missing, can't be reached, or has no GPU where one is asked for.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            ray = import_module("ray")
        except ModuleNotFoundError:
            raise ConfigurationError("--engine ray needs Ray: pip install 'cable-rpc[ray]'") from None
        if not ray.is_initialized():
            self.connect(ray)
            self._started_here = True
        self._ray = ray
        if self.gpus and self.address is None and ray.cluster_resources().get("GPU", 0.0) < self.gpus:
            raise ConfigurationError(
                f"each cell asks for {self.gpus:g} GPUs, and Ray finds fewer on this machine; ask for none, or name a "
                "cluster's address"
            )
        options = {"num_cpus": self.cpus, "num_gpus": self.gpus, "max_retries": REPEATS}
        self._task = ray.remote(answer_alone).options(**options)

    def connect(self, ray: Any) -> None:
        """`ray.init`, as quiet as it can be.

        Raises:
            ConfigurationError: it fails.
        """
        threads = str(max(1, int(self.cpus)))
        settings: dict[str, Any] = {
            "log_to_driver": False,
            "logging_level": "ERROR",
            "runtime_env": {"env_vars": dict.fromkeys(THREAD_LIMITS, threads)},
        }
        if self.address is None:
            # A Ray of our own takes no address from the environment.
            settings |= {"address": "local", "include_dashboard": False}
            if self.workers is not None:
                settings["num_cpus"] = max(1, round(self.workers * self.cpus))
        else:
            settings["address"] = self.address
        try:
            ray.init(**settings)
        except (OSError, RuntimeError, ValueError) as error:
            where = "a local Ray" if self.address is None else f"Ray at '{self.address}'"
            raise ConfigurationError(f"can't use {where}: {error}; see that it runs, or take --engine local") from error


def answer_alone(call: Call) -> tuple[Any, str]:
    """As `answer`, with one thread for OpenCV, which takes no limit from the environment."""
    cv2.setNumThreads(1)
    return answer(call)
