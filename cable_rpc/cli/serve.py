"""`cable-rpc serve`: the cloud."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Annotated

import typer

from cable_rpc.cli.logging_options import LogFormatOption, LogLevelOption, set_up_logging
from cable_rpc.cli.serve_cluster import (
    Engine,
    EngineChoice,
    ProxyChoice,
    RayAddress,
    RayProxy,
    ReplicaCpus,
    ReplicaGpus,
    Replicas,
    cluster_port,
    refuse_in_process_options,
)
from cable_rpc.cli.serve_operations import MetricsListen, Reflection
from cable_rpc.cli.serve_scheduling import (
    BatchWait,
    DetectorBatch,
    DetectorWorkers,
    LatencyBound,
    SegmenterBatch,
)
from cable_rpc.cli.serve_security import (
    DrainTo,
    IdentityByteRate,
    IdentityFrameRate,
    IdentityPixelRate,
    IdentityStreams,
    MaxPixelRate,
    MaxStreams,
    TlsCert,
    TlsClientCa,
    TlsKey,
    Tokens,
    check_exposure,
)
from cable_rpc.cli.tracing_options import Otlp, server_spans
from cable_rpc.errors import ConfigurationError
from cable_rpc.structured_log import LogFormat
from cable_rpc.wire.address import is_loopback


def serve(
    listen: Annotated[
        str, typer.Option(help="HOST:PORT to listen on; port 0 picks a free one.", metavar="HOST:PORT")
    ] = "127.0.0.1:50051",
    detector: Annotated[
        str,
        typer.Option(
            help="embedded (compact, rendered world) | rtdetr:FOLDER_OR_HUB_ID (e.g. PekingU/rtdetr_r50vd) | onnx:FILE "
            "(RT-DETR export with labels/boxes/scores or logits/pred_boxes)."
        ),
    ] = "embedded",
    segmenter: Annotated[
        str,
        typer.Option(
            help="embedded (compact LISA, rendered world) | lisa:FOLDER_OR_HUB_ID (LISA++, e.g. Senqiao/LISA_Plus_7b; "
            "options follow as ?key=value&key=value, in quotes, and lisa alone lists them) | boxes (the detector's "
            "boxes, filled) | crop:SEGMENTER (any other one, shown only the box around the region) | oracle:SOURCE "
            "(ground truth, evaluation only)."
        ),
    ] = "embedded",
    device: Annotated[str, typer.Option(help="auto | cpu | cuda.")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads of each model.", min=1)] = 1,
    min_score: Annotated[float, typer.Option(help="Detections below are dropped.", min=0.0, max=1.0)] = 0.4,
    max_in_flight: Annotated[int, typer.Option(help="Unanswered frames granted to a client.", min=1)] = 2,
    max_frame_bytes: Annotated[int, typer.Option(help="Largest coded frame accepted.", min=1024)] = 2 << 20,
    detector_batch: DetectorBatch = None,
    segmenter_batch: SegmenterBatch = None,
    detector_workers: DetectorWorkers = 1,
    batch_wait: BatchWait = 0.0,
    latency_bound: LatencyBound = 0.0,
    max_streams: MaxStreams = 64,
    max_pixels_per_s: MaxPixelRate = None,
    identity_streams: IdentityStreams = None,
    identity_frames_per_s: IdentityFrameRate = None,
    identity_pixels_per_s: IdentityPixelRate = None,
    identity_bytes_per_s: IdentityByteRate = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    tls_client_ca: TlsClientCa = None,
    tokens: Tokens = None,
    drain_to: DrainTo = "",
    resume_window: Annotated[
        float,
        typer.Option(
            help="Seconds for which a session waits for a client that has lost its connection; 0 = none does.", min=0.0
        ),
    ] = 30.0,
    metrics_listen: MetricsListen = "",
    reflection: Reflection = None,
    log_format: LogFormatOption = LogFormat.TEXT,
    log_level: LogLevelOption = None,
    otlp: Otlp = "",
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure", help="Allow a non-loopback address without TLS. Only on a network you trust end to end."
        ),
    ] = False,
    engine: EngineChoice = Engine.IN_PROCESS,
    ray_address: RayAddress = "",
    replicas: Replicas = 1,
    cpus_per_replica: ReplicaCpus = 1.0,
    gpus_per_replica: ReplicaGpus = 0.0,
    ray_proxy: ProxyChoice = RayProxy.PYTHON,
) -> None:
    """Host the models and answer cameras over gRPC.

    Example: [bold]cable-rpc serve --device cuda --segmenter lisa:Senqiao/LISA_Plus_7b
    --detector rtdetr:PekingU/rtdetr_r50vd[/bold]

    From other machines: add [bold]--listen 0.0.0.0:50051 --tls-cert server.pem --tls-key server.key
    --tokens tokens.txt[/bold]; docs/security.md shows how to make them. Without pruning of tokens:
    [bold]--segmenter 'lisa:FOLDER?image_tokens=all&sam_windows=all'[/bold]
    """
    voice = set_up_logging(log_format, log_level)
    proof = tokens is not None or tls_client_ca is not None
    exposure = check_exposure(listen, tls=tls_cert is not None, proof=proof, insecure=insecure)
    if exposure is not None:
        voice.warn(exposure)
    try:
        import onnxruntime  # noqa: F401 - asked for here so that its absence gets a sentence
    except ModuleNotFoundError as error:
        raise ConfigurationError("serving needs the cloud extra: pip install 'cable-rpc[cloud]'") from error
    from cable_rpc.cloud.limits import UNLIMITED, IdentityLimits, ServerLimits
    from cable_rpc.cloud.model_settings import ModelSettings
    from cable_rpc.cloud.service import ServerConfig, serve_until_signal
    from cable_rpc.cloud.session_limits import SessionLimits
    from cable_rpc.cloud.session_store import StoreLimits
    from cable_rpc.cloud.tls import TlsFiles
    from cable_rpc.cloud.tokens import AccessFile

    settings = ModelSettings(
        detector=detector,
        segmenter=segmenter,
        device=device,
        threads=threads,
        min_score=min_score,
        detector_batch=detector_batch,
        segmenter_batch=segmenter_batch,
        detector_workers=detector_workers,
        batch_wait_s=batch_wait,
        latency_bound_s=latency_bound,
    )
    if engine is Engine.RAY:
        refuse_in_process_options(
            {
                "--otlp": otlp,
                "--metrics-listen": metrics_listen,
                "--drain-to": drain_to,
                "--identity-streams": identity_streams,
                "--identity-frames-per-s": identity_frames_per_s,
                "--identity-pixels-per-s": identity_pixels_per_s,
                "--identity-bytes-per-s": identity_bytes_per_s,
            }
        )
        from cable_rpc.cloud.cluster.host import ClusterHost, serve_on_cluster
        from cable_rpc.cloud.cluster.settings import ClusterSettings, ReplicaSettings

        port = cluster_port(listen, tls=tls_cert is not None or tls_client_ca is not None, insecure=insecure)
        cluster = ClusterSettings(
            models=settings,
            ingress=ReplicaSettings(replicas, cpus=cpus_per_replica, gpus=gpus_per_replica),
            streams=max_streams,
            pixels_per_s=max_pixels_per_s or 0.0,
            max_in_flight=max_in_flight,
            max_frame_bytes=max_frame_bytes,
            resume_window_s=resume_window,
            tokens=str(tokens.resolve()) if tokens is not None else "",
        )
        host = ClusterHost(port, ray_address=ray_address, proxy=ray_proxy.value)
        serve_on_cluster(cluster, host, voice.announce)
        return
    tls = TlsFiles.from_flags(tls_cert, tls_key, tls_client_ca)
    # Loading models takes long; what is wrong with the files is said before.
    if tls is not None:
        tls.load()
    if tokens is not None:
        AccessFile(tokens)
    shares = ServerLimits(
        streams=max_streams,
        pixels_per_s=max_pixels_per_s or UNLIMITED,
        identity=IdentityLimits(
            identity_streams or UNLIMITED,
            identity_frames_per_s or UNLIMITED,
            identity_pixels_per_s or UNLIMITED,
            identity_bytes_per_s or UNLIMITED,
        ),
    )
    limits = SessionLimits(
        max_in_flight=max_in_flight,
        max_frame_bytes=max_frame_bytes,
        default_min_score=min_score,
        latency_bound_s=latency_bound,
    )
    config = ServerConfig(
        address=listen,
        limits=limits,
        shares=shares,
        resume=StoreLimits(resume_window),
        tls=tls,
        tokens=tokens,
        alternative_target=drain_to,
        metrics_address=metrics_listen,
        reflection=(proof or is_loopback(listen)) if reflection is None else reflection,
    )
    with server_spans(otlp) as spans:
        asyncio.run(serve_until_signal(settings.load(), replace(config, spans=spans), voice.announce))
