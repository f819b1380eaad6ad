"""The Ray Serve application: ``cable_rpc.cloud.cluster.application:build_app`` in a Serve config file."""

from __future__ import annotations

from typing import Any

from ray import serve

from cable_rpc.cloud.cluster.ingress import PerceptionIngress
from cable_rpc.cloud.cluster.remote_models import DetectorDeployment, SegmenterDeployment
from cable_rpc.cloud.cluster.settings import ClusterSettings, ReplicaSettings

SERVICER = "cable_rpc.wire.v1.perception_pb2_grpc.add_PerceptionServiceServicer_to_server"
"""For ``grpc_options.grpc_servicer_functions``."""
MODEL_CALLS = 64
"""Frames under way to one replica of a model; its own batches bound what runs."""


def build_app(args: dict[str, Any]) -> serve.Application:
    """The application from a configuration's ``args``.

    Raises:
        ConfigurationError: an unknown key or a wrong value.
    """
    return application(ClusterSettings.of(args))


def application(settings: ClusterSettings) -> serve.Application:
    """The application of these settings."""
    models: dict[str, Any] = {}
    if settings.detector is not None:
        detector = deployment(DetectorDeployment, settings.detector, MODEL_CALLS)
        models["detector"] = detector.bind(settings.models)
    if settings.segmenter is not None:
        segmenter = deployment(SegmenterDeployment, settings.segmenter, MODEL_CALLS)
        models["segmenter"] = segmenter.bind(settings.models)
    ingress = deployment(PerceptionIngress, settings.ingress, settings.streams)
    app: serve.Application = ingress.options(graceful_shutdown_timeout_s=settings.drain_s).bind(settings, **models)
    return app


def deployment(hosted: type, replicas: ReplicaSettings, calls: int) -> Any:
    """A class as a deployment whose replicas take so many calls at a time."""
    options: dict[str, Any] = {
        "max_ongoing_requests": calls,
        "ray_actor_options": {"num_cpus": replicas.cpus, "num_gpus": replicas.gpus},
    }
    if replicas.max_replicas is None:
        options["num_replicas"] = replicas.replicas
    else:
        options["autoscaling_config"] = {
            "min_replicas": replicas.replicas,
            "max_replicas": replicas.max_replicas,
            "target_ongoing_requests": max(1, calls // 2),
        }
    deploy: Any = serve.deployment
    return deploy(hosted).options(**options)
