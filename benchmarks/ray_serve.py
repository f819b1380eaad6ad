"""What Ray Serve adds to a session: ``python benchmarks/ray_serve.py``. Needs the extra ``ray``.

64 KB frames go up one stream, one at a time, through our own server and through a replica of the same session on a
local Ray cluster, once behind its Python proxy and once behind HAProxy. The models cost nothing, the pictures are small
and padded (`overhead.py`). Each way is a process of its own; the lines come from one run.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys

import numpy as np
from overhead import loaded, running
from overhead_runs import Load, NullDetector, NullSegmenter, serve_null_models
from rich.console import Console
from rich.table import Table

from cable_rpc.cloud.model_settings import ModelSettings
from cable_rpc.cloud.perception import PerceptionModels

FRAME_BYTES = 64_000


class NullModels(ModelSettings):
    """In place of the models that a configuration names."""

    def load(self) -> PerceptionModels:
        return PerceptionModels.in_process(NullDetector(), NullSegmenter())


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def host(proxy: str, port: int) -> None:
    """The child: a cluster with one replica, until its standard input ends."""
    from cable_rpc.cloud.cluster.host import ClusterHost

    os.environ.update(ClusterHost(proxy=proxy).environment())  # type: ignore[arg-type]
    import overhead_runs
    import ray
    from ray import cloudpickle, serve
    from ray.serve.config import gRPCOptions

    from cable_rpc.cloud.cluster.application import SERVICER, application
    from cable_rpc.cloud.cluster.settings import ClusterSettings

    for module in (overhead_runs, sys.modules[__name__]):
        cloudpickle.register_pickle_by_value(module)  # the replicas' processes do not see this folder
    ray.init(num_cpus=2, object_store_memory=100 << 20, include_dashboard=False, log_to_driver=False)
    serve.start(
        grpc_options=gRPCOptions(port=port, grpc_servicer_functions=[SERVICER]),
        http_options={"host": "127.0.0.1", "port": free_port()},
    )
    serve.run(application(ClusterSettings(NullModels())), name="benchmark", route_prefix="/benchmark")
    print("ready", flush=True)
    sys.stdin.read()
    serve.shutdown()
    ray.shutdown()


def through_ray(proxy: str, seconds: float) -> np.ndarray:
    port = free_port()
    command = [sys.executable, __file__, "--host", proxy, str(port)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    child = subprocess.Popen(command, text=True, **pipes)
    try:
        while (line := child.stdout.readline() if child.stdout else "").strip() != "ready":
            if not line:
                raise SystemExit(f"the cluster with the {proxy} proxy did not come up")
        return loaded(Load("client", f"127.0.0.1:{port}", 1, seconds, FRAME_BYTES)).latencies_ms
    finally:
        child.communicate("")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--host", nargs=2, metavar=("PROXY", "PORT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.host:
        host(options.host[0], int(options.host[1]))
        return
    with running(serve_null_models, False, None) as port:
        own = loaded(Load("client", f"127.0.0.1:{port}", 1, options.seconds, FRAME_BYTES)).latencies_ms
    lines = {"our own server": own}
    for proxy in ("python", "haproxy"):
        lines[f"Ray Serve, {proxy}"] = through_ray(proxy, options.seconds)
    table = Table(title=f"{FRAME_BYTES / 1000:.0f} KB frames, one at a time, ms")
    for heading in ("way", "p50", "p95", "added p50"):
        table.add_column(heading, justify="left" if heading == "way" else "right")
    for name, latencies in lines.items():
        p50, p95 = np.percentile(latencies, [50, 95])
        table.add_row(name, f"{p50:.2f}", f"{p95:.2f}", f"{p50 - np.median(own):.2f}")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
