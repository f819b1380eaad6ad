"""A cluster's configuration, without a cluster: what files say is what replicas get."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from cable_rpc.cli.serve_cluster import cluster_port, refuse_in_process_options
from cable_rpc.cloud.cluster.settings import ClusterSettings, ReplicaSettings
from cable_rpc.errors import ConfigurationError
from cable_rpc.wire.channel import MAX_MESSAGE_BYTES

DEPLOY = Path(__file__).resolve().parents[2] / "deploy" / "ray"


def loaded(name: str) -> Any:
    return yaml.safe_load((DEPLOY / name).read_text())


def test_the_shipped_configuration_is_understood() -> None:
    settings = ClusterSettings.of(loaded("serve.yaml")["applications"][0]["args"])
    assert settings.ingress == ReplicaSettings(2, cpus=2.0)
    assert settings.models.detector == "embedded"
    assert settings.limits.max_in_flight == 2
    assert settings.detector is settings.segmenter is settings.tokens_path is None


def test_kubernetes_gets_the_same_configuration() -> None:
    service = loaded("rayservice.yaml")
    assert yaml.safe_load(service["spec"]["serveConfigV2"]) == loaded("serve.yaml")
    groups = service["spec"]["rayClusterConfig"]
    for group in (groups["headGroupSpec"], *groups["workerGroupSpecs"]):
        (container,) = group["template"]["spec"]["containers"]
        assert {"name": "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE", "value": str(MAX_MESSAGE_BYTES)} in container["env"]


def test_everything_can_be_set() -> None:
    settings = ClusterSettings.of(
        {
            "models": {"segmenter": "boxes", "detector_batch": 4, "latency_bound_s": 1, "threads": 2},
            "ingress": {"replicas": 2, "max_replicas": 5, "gpus": 0.5},
            "detector": {"cpus": 2},
            "segmenter": None,
            "pixels_per_s": 1e6,
            "tokens": "/etc/tokens",
        }
    )
    assert settings.models.detector_policy("cpu").max_batch == 4
    assert settings.limits.latency_bound_s == 1.0
    assert settings.ingress.max_replicas == 5
    assert settings.detector == ReplicaSettings(cpus=2.0)
    assert settings.shares.pixels_per_s == 1e6
    assert settings.tokens_path == Path("/etc/tokens")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"model": {}}, "args: unknown model; known are detector"),
        ({"models": {"detectr": "x"}}, "args.models: unknown detectr"),
        ({"models": "embedded"}, "args.models: expected keys and values, got 'embedded'"),
        ({"streams": "many"}, "args.streams: expected int, got 'many'"),
        ({"streams": True}, "args.streams: expected int, got True"),
        ({"streams": None}, "args.streams: expected int, got None"),
        ({"ingress": {"replicas": 0}}, "replicas must be 1 or more"),
        ({"ingress": {"replicas": 3, "max_replicas": 2}}, "max_replicas not fewer"),
        ({"ingress": {"cpus": -1}}, "needs some cpus"),
    ],
)
def test_mistakes_are_told_with_their_place(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        ClusterSettings.of(values)


def test_a_cluster_listens_openly_only_when_told_to() -> None:
    assert cluster_port("127.0.0.1:50051", tls=False, insecure=True) == 50051
    with pytest.raises(ConfigurationError, match="every interface in plain text"):
        cluster_port("127.0.0.1:50051", tls=False, insecure=False)
    with pytest.raises(ConfigurationError, match="speaks no TLS"):
        cluster_port("0.0.0.0:50051", tls=True, insecure=True)
    with pytest.raises(ConfigurationError, match="port of 1 to 65535"):
        cluster_port("0.0.0.0:0", tls=False, insecure=True)


def test_options_that_replicas_would_ignore_are_refused() -> None:
    refuse_in_process_options({"--otlp": "", "--identity-streams": None})
    with pytest.raises(ConfigurationError, match=r"--otlp, --drain-to: only for the in-process engine"):
        refuse_in_process_options({"--otlp": "localhost:4317", "--metrics-listen": "", "--drain-to": "b:1"})
