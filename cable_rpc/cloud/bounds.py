"""What a client may say, checked before anything is made of it."""

from __future__ import annotations

from cable_rpc.errors import ProtocolError
from cable_rpc.wire.v1 import perception_pb2 as pb

MOST_PROMPT_CHARACTERS = 2000
MOST_CLIENT_ID_CHARACTERS = 128
MOST_FEATURES = 64
MOST_RESULT_KINDS = 16
MOST_RESUME_TOKEN_BYTES = 1024


def check_hello(hello: pb.Hello) -> None:
    """Checks the texts and lists of a Hello.

    Raises:
        ProtocolError: one is too long.
    """
    check_length("Hello.client_id", len(hello.client_id), MOST_CLIENT_ID_CHARACTERS)
    check_length("Hello.features", len(hello.features), MOST_FEATURES)
    check_length("Hello.result_kinds", len(hello.result_kinds), MOST_RESULT_KINDS)
    check_length("Hello.resume_token", len(hello.resume_token), MOST_RESUME_TOKEN_BYTES)
    check_task(hello.task_config)


def check_task(task: pb.TaskConfig) -> None:
    """Checks what the models are asked for.

    Raises:
        ProtocolError: the prompt is too long, or the score is none.
    """
    check_length("TaskConfig.prompt", len(task.prompt), MOST_PROMPT_CHARACTERS)
    if not 0 <= task.min_score <= 1:
        raise ProtocolError(f"TaskConfig.min_score is {task.min_score:g}; it must lie in 0..1")


def check_codec_config(config: pb.CodecConfig, max_pixels: int) -> None:
    """Checks the size of frames, before a decoder makes room for them.

    Raises:
        ProtocolError: a side is zero, or the frame too large.
    """
    if config.width == 0 or config.height == 0:
        raise ProtocolError(f"CodecConfig asks for {config.width}x{config.height}; both sides must be positive")
    if config.width * config.height > max_pixels:
        raise ProtocolError(
            f"CodecConfig asks for {config.width}x{config.height} = {config.width * config.height} pixels, "
            f"this server accepts {max_pixels}; stream at a lower resolution"
        )


def check_length(field: str, length: int, most: int) -> None:
    """Compares a length with its limit.

    Raises:
        ProtocolError: it is above.
    """
    if length > most:
        raise ProtocolError(f"{field} has a length of {length}, at most {most} are taken")
