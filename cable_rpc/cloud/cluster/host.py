"""Starts or joins a Ray cluster and keeps the application on it until a signal comes."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from cable_rpc.cloud.cluster.settings import ClusterSettings
from cable_rpc.errors import ConfigurationError
from cable_rpc.wire.channel import MAX_MESSAGE_BYTES

APPLICATION = "cable-rpc"
OBJECT_STORE_BYTES = 200 << 20
"""Of a cluster started here; frames travel by value and never enter it."""

Proxy = Literal["haproxy", "python"]


@dataclass(frozen=True, slots=True)
class ClusterHost:
    """Where the application runs."""

    port: int = 50051
    """Of the gRPC ingress, on every interface of every node."""
    http_port: int = 8000
    """Of Serve's HTTP ingress, which the application doesn't use; loopback."""
    ray_address: str = ""
    """Of a cluster to join, e.g. "auto"; empty = one is started on this machine and ends with this process."""
    proxy: Proxy = "python"

    def environment(self) -> Mapping[str, str]:
        """Variables that Ray reads when it is imported or its processes start."""
        return {
            "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE": str(MAX_MESSAGE_BYTES),
            "RAY_SERVE_ENABLE_HA_PROXY": "1" if self.proxy == "haproxy" else "0",
            "RAY_USAGE_STATS_ENABLED": "0",
        }


def serve_on_cluster(settings: ClusterSettings, host: ClusterHost, announce: Callable[[str], None]) -> None:
    """Deploys the application and waits for SIGINT or SIGTERM; a cluster that was joined is left as it was found.

    Raises:
        ConfigurationError: Ray is not installed, the cluster can't be reached, or a deployment does not come up.
    """
    os.environ.update(host.environment())
    try:
        import ray
        from ray import serve
        from ray.serve.config import gRPCOptions
    except ModuleNotFoundError as error:
        raise ConfigurationError("a cluster needs the ray extra: pip install 'cable-rpc[cloud,ray]'") from error
    from cable_rpc.cloud.cluster.application import SERVICER, application

    local = {"object_store_memory": OBJECT_STORE_BYTES, "include_dashboard": False} if not host.ray_address else {}
    try:
        ray.init(address=host.ray_address or None, logging_level="warning", log_to_driver=False, **local)
    except ConnectionError as error:
        raise ConfigurationError(f"no Ray cluster at --ray-address {host.ray_address}: {error}") from error
    try:
        serve.start(
            grpc_options=gRPCOptions(port=host.port, grpc_servicer_functions=[SERVICER]),
            http_options={"host": "127.0.0.1", "port": host.http_port},
        )
        try:
            # Without a route the gRPC ingress does not know the application either.
            serve.run(application(settings), name=APPLICATION, route_prefix=f"/{APPLICATION}")
        except RuntimeError as error:
            raise ConfigurationError(f"the application does not come up on the cluster: {error}") from error
        # Only now: starting Ray puts handlers of its own in their place.
        stopped = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stopped.set())
        announce(f"listening on every interface, port {host.port}, behind Ray Serve's {host.proxy} proxy")
        for part, replicas in (("ingress", settings.ingress), ("detector", settings.detector)):
            if replicas is not None:
                announce(f"  {part}: {replicas.replicas} replicas of {replicas.cpus:g} CPUs and {replicas.gpus:g} GPUs")
        stopped.wait()
        announce("stopping: replicas finish their sessions")
        serve.delete(APPLICATION)
    finally:
        if not host.ray_address:
            serve.shutdown()
        ray.shutdown()
