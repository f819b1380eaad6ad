"""`cable-rpc stream`: the edge."""

from __future__ import annotations

import asyncio
import importlib.util
import math
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from cable_rpc.cli.connection_options import (
    Tls,
    TlsCa,
    TlsCert,
    TlsKey,
    TlsServerName,
    TokenFile,
    client_security,
)
from cable_rpc.cli.progress import RunProgress
from cable_rpc.cli.roi_options import region_treatment, roi_config
from cable_rpc.cli.skip_bad import SkipBad, bad_frames_listed
from cable_rpc.cli.tracing_options import Otlp, TraceEvery, edge_tracing
from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.source import SOURCE_FORMS, FrameSource, open_source
from cable_rpc.edge.channel import SecureTarget
from cable_rpc.edge.resuming_client import DEFAULT_RECONNECT_S
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.strategies import STRATEGIES
from cable_rpc.study.stream_run import StreamRun, StreamRunConfig
from cable_rpc.study.summary_table import render_summary
from cable_rpc.types import CameraIntrinsics, CameraMount
from cable_rpc.wire.convert import CODECS_BY_NAME

console = Console(width=None if sys.stdout.isatty() else 100)


def stream(
    source: Annotated[
        str,
        typer.Option(
            help=f"{SOURCE_FORMS}.",
            metavar="SCHEME:...",
        ),
    ],
    target: Annotated[
        str, typer.Option(help="HOST:PORT of the server, or grpcs://HOST:PORT with TLS.", metavar="HOST:PORT")
    ] = "127.0.0.1:50051",
    codec: Annotated[str, typer.Option(help=" | ".join(CODECS_BY_NAME) + "; `doctor` says which run here.")] = "h264",
    quality: Annotated[
        int | None,
        typer.Option(help="JPEG/WebP quality 1..100 (75), video CRF (H.264: 0..51, 28; lower is better)."),
    ] = None,
    bitrate: Annotated[
        float | None, typer.Option(help="Constant rate in kbit/s instead of constant quality.", min=1)
    ] = None,
    encoder: Annotated[
        str | None, typer.Option(help="Video encoder by FFmpeg's name, or auto-hardware; falls back to software aloud.")
    ] = None,
    preset: Annotated[str | None, typer.Option(help="The encoder's effort in its own words, e.g. superfast.")] = None,
    treatment: Annotated[
        list[str] | None,
        typer.Option(
            help="Change how regions are treated before coding, e.g. fill=grey, grid=16, hold_frames=5, crop=box, "
            "scale=0.5, compose=true, or fill=keep with quantiser_offset=0.4 (soft); may be repeated.",
            metavar="KEY=VALUE",
        ),
    ] = None,
    strategy: Annotated[
        str,
        typer.Option(
            help="What chooses the region: " + " | ".join(f"{name} ({text})" for name, text in STRATEGIES.items()) + "."
        ),
    ] = "cable",
    mode: Annotated[
        str, typer.Option(help="robust: made for the road | paper: the published method to the letter.")
    ] = "robust",
    roi: Annotated[
        list[str] | None,
        typer.Option(help="Change one switch of the mode, e.g. ego_model=flow; may be repeated.", metavar="KEY=VALUE"),
    ] = None,
    keyframes: Annotated[
        str | None, typer.Option(help="What asks for whole frames: paper | periodic | budget | uncertainty.")
    ] = None,
    pace: Annotated[
        str,
        typer.Option(
            help="lockstep: every frame, one at a time, reproducible | realtime: as a camera delivers them, the newest "
            "frame wins and late ones are dropped and counted."
        ),
    ] = "lockstep",
    out: Annotated[Path, typer.Option(help="Folder for frames.csv, summary.json, annotated.mp4, report.html.")] = Path(
        "out/stream"
    ),
    frames: Annotated[int | None, typer.Option(help="Stop after so many frames.", min=1)] = None,
    fps: Annotated[float | None, typer.Option(help="Thin a video to this rate; rate of an image folder.")] = None,
    size: Annotated[str | None, typer.Option(help="Resize to WIDTHxHEIGHT before anything else.")] = None,
    ego_csv: Annotated[
        Path | None, typer.Option(help="Ego-motion of a video: CSV with speed_mps and yaw_rate_radps (left positive).")
    ] = None,
    focal: Annotated[
        float | None, typer.Option(help="Focal length of the video's camera in pixels, for the ego-motion warp.")
    ] = None,
    camera_height: Annotated[
        float | None, typer.Option(help="Metres from the road to the video's camera, for the ground-plane warp.")
    ] = None,
    camera_pitch: Annotated[float, typer.Option(help="Degrees by which that camera looks below the horizontal.")] = 0.0,
    block_size: Annotated[int, typer.Option(help="Grid that the region is grown to; 1 = exact.", min=1)] = 8,
    prompt: Annotated[str, typer.Option(help="Sentence for an open-vocabulary segmenter.")] = "",
    min_score: Annotated[
        float, typer.Option(help="Detections below are not sent; can only raise the server's.", min=0.0, max=1.0)
    ] = 0.0,
    connect_timeout: Annotated[float, typer.Option(help="Seconds to wait for the server.", min=0.1)] = 10.0,
    reconnect_for: Annotated[
        float | None,
        typer.Option(
            help="Seconds to look for a server that was lost, before giving up; 0 = never. [default: 60 in realtime, 0 "
            "in lockstep]",
            min=0.0,
            show_default=False,
        ),
    ] = None,
    tls: Tls = False,
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    tls_server_name: TlsServerName = "",
    token_file: TokenFile = None,
    client_id: Annotated[str, typer.Option(help="Name of this camera in the server's logs.")] = "",
    evaluate: Annotated[
        bool,
        typer.Option(
            help="Stream the same frames whole afterwards: byte saving, detection retention, annotated video."
        ),
    ] = True,
    skip_bad: SkipBad = False,
    trace_every: TraceEvery = None,
    otlp: Otlp = "",
) -> None:
    """Stream a camera through the loop and measure what it costs.

    Example: [bold]cable-rpc stream --source video:drive.mp4 --target gpu-box:50051 --codec h264[/bold]

    With TLS and a token: [bold]--target grpcs://gpu-box:50051 --tls-ca ca.pem --token-file token[/bold]
    """
    if pace not in {"lockstep", "realtime"}:
        raise ConfigurationError(f"--pace is '{pace}'; use lockstep or realtime")
    if codec not in CODECS_BY_NAME:
        raise ConfigurationError(f"--codec is '{codec}'; use one of {', '.join(CODECS_BY_NAME)}")
    frame_size = parse_size(size)
    security = client_security(
        tls=tls, ca=tls_ca, certificate=tls_cert, key=tls_key, server_name=tls_server_name, token_file=token_file
    )
    for warning in SecureTarget(target, security).warnings:
        print(f"cable-rpc: {warning}", file=sys.stderr)
    config = StreamRunConfig(
        target=target,
        out=out,
        codec=codec,
        quality=quality,
        bitrate_kbps=bitrate,
        encoder=encoder,
        preset=preset,
        treatment=region_treatment(codec, treatment or ()),
        strategy=strategy,
        roi=roi_config(mode, roi or (), keyframes),
        realtime=pace == "realtime",
        block_size=block_size,
        prompt=prompt,
        min_score=min_score,
        client_id=client_id,
        connect_timeout_s=connect_timeout,
        reconnect_s=reconnect_for if reconnect_for is not None else DEFAULT_RECONNECT_S if pace == "realtime" else 0.0,
        evaluate=evaluate,
        security=security,
        command_line=shlex.join(["cable-rpc", *sys.argv[1:]]),
    )
    with bad_frames_listed(skip_bad) as bad_frames, edge_tracing(otlp, trace_every) as tracing:
        opened = open_source(
            source,
            max_frames=frames,
            ego_csv=ego_csv,
            size=frame_size,
            intrinsics=centred_intrinsics(focal, source, bad_frames),
            fps=fps,
            mount=camera_mount(camera_height, camera_pitch),
            bad_frames=bad_frames,
        )
        run_and_report(opened, replace(config, tracing=tracing))


def run_and_report(source: FrameSource, config: StreamRunConfig) -> None:
    """Runs with live progress, prints the closing table, writes the report where its extra is installed."""
    try:
        with RunProgress(console, source.frame_count, source.fps) as progress:
            summary = asyncio.run(StreamRun(source, config, progress.update, say).run())
    except KeyboardInterrupt:
        print(
            f"cable-rpc: interrupted; frames.csv and summary.json in {config.out} hold what came so far",
            file=sys.stderr,
        )
        raise
    console.print(render_summary(summary))
    if importlib.util.find_spec("plotly") is None or importlib.util.find_spec("jinja2") is None:
        console.print(f"wrote {config.out}; install 'cable-rpc\\[study]' for the HTML report")
        return
    from cable_rpc.study.report import write_report

    console.print(f"report: {write_report(config.out)}")


def say(sentence: str) -> None:
    """What happens to the connection, beside the progress bar."""
    print(f"cable-rpc: {sentence}", file=sys.stderr)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """ "960x540" as (960, 540).

    Raises:
        ConfigurationError: if it is anything else.
    """
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise ConfigurationError(f"--size is '{text}'; write WIDTHxHEIGHT, e.g. 960x540")
    return int(width), int(height)


def camera_mount(height_m: float | None, pitch_down_deg: float) -> CameraMount | None:
    """Where the camera sits, if its height is known."""
    return None if height_m is None else CameraMount(height_m, math.radians(pitch_down_deg))


def centred_intrinsics(focal: float | None, source: str, bad_frames: BadFrames) -> CameraIntrinsics | None:
    """A camera with its axis through the middle of the source's own picture."""
    if focal is None:
        return None
    width, height = open_source(source, bad_frames=bad_frames).size_wh
    return CameraIntrinsics(focal, focal, width / 2, height / 2)
