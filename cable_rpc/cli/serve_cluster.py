"""Options of `serve` for a Ray cluster."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

import typer

from cable_rpc.errors import ConfigurationError

PANEL = "Cluster (--engine ray)"


class Engine(StrEnum):
    """What hosts the sessions."""

    IN_PROCESS = "in-process"
    RAY = "ray"


class RayProxy(StrEnum):
    """What stands before the replicas."""

    PYTHON = "python"
    HAPROXY = "haproxy"


EngineChoice = Annotated[
    Engine,
    typer.Option(help="in-process: one server on this machine | ray: replicas on a Ray cluster (extra 'ray')."),
]
RayAddress = Annotated[
    str,
    typer.Option(
        "--ray-address",
        help="Cluster to join, e.g. auto; by default one is started here and ends with this process.",
        rich_help_panel=PANEL,
    ),
]
Replicas = Annotated[
    int,
    typer.Option("--replicas", help="Servers with both models; --max-streams each.", min=1, rich_help_panel=PANEL),
]
ReplicaCpus = Annotated[
    float, typer.Option("--cpus-per-replica", help="CPUs that Ray sets aside.", min=0.01, rich_help_panel=PANEL)
]
ReplicaGpus = Annotated[
    float,
    typer.Option(
        "--gpus-per-replica",
        help="GPUs that Ray sets aside; 0.5 puts two replicas on one.",
        min=0.0,
        rich_help_panel=PANEL,
    ),
]
ProxyChoice = Annotated[
    RayProxy,
    typer.Option("--ray-proxy", help="haproxy is faster; docs/cluster.md tells its traps.", rich_help_panel=PANEL),
]


def cluster_port(listen: str, *, tls: bool, insecure: bool) -> int:
    """The port of a cluster's ingress.

    Raises:
        ConfigurationError: Ray can't do what is asked, or would do more without being told to.
    """
    if tls:
        raise ConfigurationError(
            "Ray Serve's gRPC ingress speaks no TLS: leave the --tls options out and let a proxy in front of the "
            "cluster do it (docs/cluster.md)"
        )
    if not insecure:
        raise ConfigurationError(
            "Ray Serve's gRPC ingress listens on every interface in plain text, whatever --listen says; give "
            "--insecure if the network is trusted or a firewall and a TLS proxy stand before it"
        )
    port = listen.rpartition(":")[2]
    if not port.isdigit() or not 0 < int(port) < 65536:
        raise ConfigurationError(f"--listen {listen}: a cluster needs a port of 1 to 65535")
    return int(port)


def refuse_in_process_options(given: Mapping[str, object]) -> None:
    """Options that replicas don't heed are not passed over in silence.

    Args:
        given: names of such options and what was given; what is empty was not given.

    Raises:
        ConfigurationError: one was given.
    """
    names = [name for name, value in given.items() if value]
    if names:
        raise ConfigurationError(
            f"{', '.join(names)}: only for the in-process engine; docs/cluster.md tells what --engine ray has instead"
        )
