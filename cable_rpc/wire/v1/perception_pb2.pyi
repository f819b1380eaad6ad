from google.rpc import status_pb2 as _status_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Codec(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CODEC_UNSPECIFIED: _ClassVar[Codec]
    CODEC_H264: _ClassVar[Codec]
    CODEC_H265: _ClassVar[Codec]
    CODEC_JPEG: _ClassVar[Codec]
    CODEC_WEBP: _ClassVar[Codec]
    CODEC_AV1: _ClassVar[Codec]
    CODEC_VP9: _ClassVar[Codec]
    CODEC_WEBP_LOSSLESS: _ClassVar[Codec]

class ResultKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    RESULT_KIND_UNSPECIFIED: _ClassVar[ResultKind]
    RESULT_KIND_DETECTION: _ClassVar[ResultKind]
    RESULT_KIND_SEGMENTATION: _ClassVar[ResultKind]

class BackgroundFill(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    BACKGROUND_FILL_UNSPECIFIED: _ClassVar[BackgroundFill]
    BACKGROUND_FILL_ZERO: _ClassVar[BackgroundFill]
    BACKGROUND_FILL_GREY: _ClassVar[BackgroundFill]
    BACKGROUND_FILL_MEAN: _ClassVar[BackgroundFill]
    BACKGROUND_FILL_BLUR: _ClassVar[BackgroundFill]
    BACKGROUND_FILL_FREEZE: _ClassVar[BackgroundFill]
    BACKGROUND_FILL_KEEP: _ClassVar[BackgroundFill]

class BackgroundRefill(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    BACKGROUND_REFILL_UNSPECIFIED: _ClassVar[BackgroundRefill]
    BACKGROUND_REFILL_DIFFUSE: _ClassVar[BackgroundRefill]

class CropMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CROP_MODE_UNSPECIFIED: _ClassVar[CropMode]
    CROP_MODE_ROWS: _ClassVar[CropMode]
    CROP_MODE_BOX: _ClassVar[CropMode]

class Interpolation(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    INTERPOLATION_UNSPECIFIED: _ClassVar[Interpolation]
    INTERPOLATION_CUBIC: _ClassVar[Interpolation]
    INTERPOLATION_LINEAR: _ClassVar[Interpolation]
    INTERPOLATION_NEAREST: _ClassVar[Interpolation]
    INTERPOLATION_LANCZOS: _ClassVar[Interpolation]

class RejectReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REJECT_REASON_UNSPECIFIED: _ClassVar[RejectReason]
    REJECT_REASON_SUPERSEDED: _ClassVar[RejectReason]
    REJECT_REASON_DEADLINE: _ClassVar[RejectReason]
    REJECT_REASON_UNDECODABLE: _ClassVar[RejectReason]
    REJECT_REASON_TOO_LARGE: _ClassVar[RejectReason]
    REJECT_REASON_INVALID_REGION: _ClassVar[RejectReason]
    REJECT_REASON_MODEL_FAILED: _ClassVar[RejectReason]
    REJECT_REASON_OVERLOADED: _ClassVar[RejectReason]

class CloseAction(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CLOSE_ACTION_UNSPECIFIED: _ClassVar[CloseAction]
    CLOSE_ACTION_RESUME: _ClassVar[CloseAction]
    CLOSE_ACTION_MOVE: _ClassVar[CloseAction]
    CLOSE_ACTION_STOP: _ClassVar[CloseAction]
CODEC_UNSPECIFIED: Codec
CODEC_H264: Codec
CODEC_H265: Codec
CODEC_JPEG: Codec
CODEC_WEBP: Codec
CODEC_AV1: Codec
CODEC_VP9: Codec
CODEC_WEBP_LOSSLESS: Codec
RESULT_KIND_UNSPECIFIED: ResultKind
RESULT_KIND_DETECTION: ResultKind
RESULT_KIND_SEGMENTATION: ResultKind
BACKGROUND_FILL_UNSPECIFIED: BackgroundFill
BACKGROUND_FILL_ZERO: BackgroundFill
BACKGROUND_FILL_GREY: BackgroundFill
BACKGROUND_FILL_MEAN: BackgroundFill
BACKGROUND_FILL_BLUR: BackgroundFill
BACKGROUND_FILL_FREEZE: BackgroundFill
BACKGROUND_FILL_KEEP: BackgroundFill
BACKGROUND_REFILL_UNSPECIFIED: BackgroundRefill
BACKGROUND_REFILL_DIFFUSE: BackgroundRefill
CROP_MODE_UNSPECIFIED: CropMode
CROP_MODE_ROWS: CropMode
CROP_MODE_BOX: CropMode
INTERPOLATION_UNSPECIFIED: Interpolation
INTERPOLATION_CUBIC: Interpolation
INTERPOLATION_LINEAR: Interpolation
INTERPOLATION_NEAREST: Interpolation
INTERPOLATION_LANCZOS: Interpolation
REJECT_REASON_UNSPECIFIED: RejectReason
REJECT_REASON_SUPERSEDED: RejectReason
REJECT_REASON_DEADLINE: RejectReason
REJECT_REASON_UNDECODABLE: RejectReason
REJECT_REASON_TOO_LARGE: RejectReason
REJECT_REASON_INVALID_REGION: RejectReason
REJECT_REASON_MODEL_FAILED: RejectReason
REJECT_REASON_OVERLOADED: RejectReason
CLOSE_ACTION_UNSPECIFIED: CloseAction
CLOSE_ACTION_RESUME: CloseAction
CLOSE_ACTION_MOVE: CloseAction
CLOSE_ACTION_STOP: CloseAction

class StreamPerceptionRequest(_message.Message):
    __slots__ = ("hello", "frame", "codec_config", "task_config", "goodbye")
    HELLO_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    CODEC_CONFIG_FIELD_NUMBER: _ClassVar[int]
    TASK_CONFIG_FIELD_NUMBER: _ClassVar[int]
    GOODBYE_FIELD_NUMBER: _ClassVar[int]
    hello: Hello
    frame: VideoFrame
    codec_config: CodecConfig
    task_config: TaskConfig
    goodbye: Goodbye
    def __init__(self, hello: _Optional[_Union[Hello, _Mapping]] = ..., frame: _Optional[_Union[VideoFrame, _Mapping]] = ..., codec_config: _Optional[_Union[CodecConfig, _Mapping]] = ..., task_config: _Optional[_Union[TaskConfig, _Mapping]] = ..., goodbye: _Optional[_Union[Goodbye, _Mapping]] = ...) -> None: ...

class StreamPerceptionResponse(_message.Message):
    __slots__ = ("welcome", "result", "frame_rejected", "keyframe_request", "flow_update", "closing")
    WELCOME_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    FRAME_REJECTED_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_REQUEST_FIELD_NUMBER: _ClassVar[int]
    FLOW_UPDATE_FIELD_NUMBER: _ClassVar[int]
    CLOSING_FIELD_NUMBER: _ClassVar[int]
    welcome: Welcome
    result: Result
    frame_rejected: FrameRejected
    keyframe_request: KeyframeRequest
    flow_update: FlowUpdate
    closing: Closing
    def __init__(self, welcome: _Optional[_Union[Welcome, _Mapping]] = ..., result: _Optional[_Union[Result, _Mapping]] = ..., frame_rejected: _Optional[_Union[FrameRejected, _Mapping]] = ..., keyframe_request: _Optional[_Union[KeyframeRequest, _Mapping]] = ..., flow_update: _Optional[_Union[FlowUpdate, _Mapping]] = ..., closing: _Optional[_Union[Closing, _Mapping]] = ...) -> None: ...

class Hello(_message.Message):
    __slots__ = ("protocol_revision", "client_id", "user_agent", "codec_config", "task_config", "intrinsics", "result_kinds", "wall_time_ns", "resume_token", "last_result_sequence", "features")
    PROTOCOL_REVISION_FIELD_NUMBER: _ClassVar[int]
    CLIENT_ID_FIELD_NUMBER: _ClassVar[int]
    USER_AGENT_FIELD_NUMBER: _ClassVar[int]
    CODEC_CONFIG_FIELD_NUMBER: _ClassVar[int]
    TASK_CONFIG_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    RESULT_KINDS_FIELD_NUMBER: _ClassVar[int]
    WALL_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    LAST_RESULT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    protocol_revision: int
    client_id: str
    user_agent: str
    codec_config: CodecConfig
    task_config: TaskConfig
    intrinsics: CameraIntrinsics
    result_kinds: _containers.RepeatedScalarFieldContainer[ResultKind]
    wall_time_ns: int
    resume_token: bytes
    last_result_sequence: int
    features: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, protocol_revision: _Optional[int] = ..., client_id: _Optional[str] = ..., user_agent: _Optional[str] = ..., codec_config: _Optional[_Union[CodecConfig, _Mapping]] = ..., task_config: _Optional[_Union[TaskConfig, _Mapping]] = ..., intrinsics: _Optional[_Union[CameraIntrinsics, _Mapping]] = ..., result_kinds: _Optional[_Iterable[_Union[ResultKind, str]]] = ..., wall_time_ns: _Optional[int] = ..., resume_token: _Optional[bytes] = ..., last_result_sequence: _Optional[int] = ..., features: _Optional[_Iterable[str]] = ...) -> None: ...

class CameraIntrinsics(_message.Message):
    __slots__ = ("focal_x", "focal_y", "center_x", "center_y")
    FOCAL_X_FIELD_NUMBER: _ClassVar[int]
    FOCAL_Y_FIELD_NUMBER: _ClassVar[int]
    CENTER_X_FIELD_NUMBER: _ClassVar[int]
    CENTER_Y_FIELD_NUMBER: _ClassVar[int]
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    def __init__(self, focal_x: _Optional[float] = ..., focal_y: _Optional[float] = ..., center_x: _Optional[float] = ..., center_y: _Optional[float] = ...) -> None: ...

class Welcome(_message.Message):
    __slots__ = ("protocol_revision", "session_id", "flow", "models", "resume_token", "resume_window_s", "resumed", "features", "decoded_sequence")
    PROTOCOL_REVISION_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    FLOW_FIELD_NUMBER: _ClassVar[int]
    MODELS_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    RESUME_WINDOW_S_FIELD_NUMBER: _ClassVar[int]
    RESUMED_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    DECODED_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    protocol_revision: int
    session_id: str
    flow: FlowUpdate
    models: _containers.RepeatedCompositeFieldContainer[ModelInfo]
    resume_token: bytes
    resume_window_s: float
    resumed: bool
    features: _containers.RepeatedScalarFieldContainer[str]
    decoded_sequence: int
    def __init__(self, protocol_revision: _Optional[int] = ..., session_id: _Optional[str] = ..., flow: _Optional[_Union[FlowUpdate, _Mapping]] = ..., models: _Optional[_Iterable[_Union[ModelInfo, _Mapping]]] = ..., resume_token: _Optional[bytes] = ..., resume_window_s: _Optional[float] = ..., resumed: bool = ..., features: _Optional[_Iterable[str]] = ..., decoded_sequence: _Optional[int] = ...) -> None: ...

class ModelInfo(_message.Message):
    __slots__ = ("name", "revision", "result_kind", "device")
    NAME_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    RESULT_KIND_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    name: str
    revision: str
    result_kind: ResultKind
    device: str
    def __init__(self, name: _Optional[str] = ..., revision: _Optional[str] = ..., result_kind: _Optional[_Union[ResultKind, str]] = ..., device: _Optional[str] = ...) -> None: ...

class CodecConfig(_message.Message):
    __slots__ = ("codec", "width", "height", "frame_rate", "quality", "treatment")
    CODEC_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FRAME_RATE_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    TREATMENT_FIELD_NUMBER: _ClassVar[int]
    codec: Codec
    width: int
    height: int
    frame_rate: float
    quality: int
    treatment: RegionTreatment
    def __init__(self, codec: _Optional[_Union[Codec, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., frame_rate: _Optional[float] = ..., quality: _Optional[int] = ..., treatment: _Optional[_Union[RegionTreatment, _Mapping]] = ...) -> None: ...

class RegionTreatment(_message.Message):
    __slots__ = ("fill", "grid", "crop", "scale", "interpolation", "feather_px", "compose", "refill")
    FILL_FIELD_NUMBER: _ClassVar[int]
    GRID_FIELD_NUMBER: _ClassVar[int]
    CROP_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    INTERPOLATION_FIELD_NUMBER: _ClassVar[int]
    FEATHER_PX_FIELD_NUMBER: _ClassVar[int]
    COMPOSE_FIELD_NUMBER: _ClassVar[int]
    REFILL_FIELD_NUMBER: _ClassVar[int]
    fill: BackgroundFill
    grid: int
    crop: CropMode
    scale: float
    interpolation: Interpolation
    feather_px: int
    compose: bool
    refill: BackgroundRefill
    def __init__(self, fill: _Optional[_Union[BackgroundFill, str]] = ..., grid: _Optional[int] = ..., crop: _Optional[_Union[CropMode, str]] = ..., scale: _Optional[float] = ..., interpolation: _Optional[_Union[Interpolation, str]] = ..., feather_px: _Optional[int] = ..., compose: bool = ..., refill: _Optional[_Union[BackgroundRefill, str]] = ...) -> None: ...

class TaskConfig(_message.Message):
    __slots__ = ("prompt", "min_score")
    PROMPT_FIELD_NUMBER: _ClassVar[int]
    MIN_SCORE_FIELD_NUMBER: _ClassVar[int]
    prompt: str
    min_score: float
    def __init__(self, prompt: _Optional[str] = ..., min_score: _Optional[float] = ...) -> None: ...

class VideoFrame(_message.Message):
    __slots__ = ("sequence", "capture_time_ns", "send_time_ns", "data", "keyframe", "reference_sequence", "region", "whole_frame", "prior_sequence", "ego_motion", "timing", "deadline_ns", "traceparent")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SEND_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    WHOLE_FRAME_FIELD_NUMBER: _ClassVar[int]
    PRIOR_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    EGO_MOTION_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_NS_FIELD_NUMBER: _ClassVar[int]
    TRACEPARENT_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    capture_time_ns: int
    send_time_ns: int
    data: bytes
    keyframe: bool
    reference_sequence: int
    region: Region
    whole_frame: bool
    prior_sequence: int
    ego_motion: EgoMotion
    timing: EdgeTiming
    deadline_ns: int
    traceparent: str
    def __init__(self, sequence: _Optional[int] = ..., capture_time_ns: _Optional[int] = ..., send_time_ns: _Optional[int] = ..., data: _Optional[bytes] = ..., keyframe: bool = ..., reference_sequence: _Optional[int] = ..., region: _Optional[_Union[Region, _Mapping]] = ..., whole_frame: bool = ..., prior_sequence: _Optional[int] = ..., ego_motion: _Optional[_Union[EgoMotion, _Mapping]] = ..., timing: _Optional[_Union[EdgeTiming, _Mapping]] = ..., deadline_ns: _Optional[int] = ..., traceparent: _Optional[str] = ...) -> None: ...

class Region(_message.Message):
    __slots__ = ("block_size", "columns", "rows", "data")
    BLOCK_SIZE_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    block_size: int
    columns: int
    rows: int
    data: bytes
    def __init__(self, block_size: _Optional[int] = ..., columns: _Optional[int] = ..., rows: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class EgoMotion(_message.Message):
    __slots__ = ("speed_mps", "lateral_mps", "yaw_rate_radps")
    SPEED_MPS_FIELD_NUMBER: _ClassVar[int]
    LATERAL_MPS_FIELD_NUMBER: _ClassVar[int]
    YAW_RATE_RADPS_FIELD_NUMBER: _ClassVar[int]
    speed_mps: float
    lateral_mps: float
    yaw_rate_radps: float
    def __init__(self, speed_mps: _Optional[float] = ..., lateral_mps: _Optional[float] = ..., yaw_rate_radps: _Optional[float] = ...) -> None: ...

class EdgeTiming(_message.Message):
    __slots__ = ("capture_ns", "roi_ns", "fill_ns", "encode_ns")
    CAPTURE_NS_FIELD_NUMBER: _ClassVar[int]
    ROI_NS_FIELD_NUMBER: _ClassVar[int]
    FILL_NS_FIELD_NUMBER: _ClassVar[int]
    ENCODE_NS_FIELD_NUMBER: _ClassVar[int]
    capture_ns: int
    roi_ns: int
    fill_ns: int
    encode_ns: int
    def __init__(self, capture_ns: _Optional[int] = ..., roi_ns: _Optional[int] = ..., fill_ns: _Optional[int] = ..., encode_ns: _Optional[int] = ...) -> None: ...

class Result(_message.Message):
    __slots__ = ("sequence", "timing", "detections", "mask", "partial_error")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    PARTIAL_ERROR_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    timing: ServerTiming
    detections: _containers.RepeatedCompositeFieldContainer[Detection]
    mask: Mask
    partial_error: _status_pb2.Status
    def __init__(self, sequence: _Optional[int] = ..., timing: _Optional[_Union[ServerTiming, _Mapping]] = ..., detections: _Optional[_Iterable[_Union[Detection, _Mapping]]] = ..., mask: _Optional[_Union[Mask, _Mapping]] = ..., partial_error: _Optional[_Union[_status_pb2.Status, _Mapping]] = ...) -> None: ...

class ServerTiming(_message.Message):
    __slots__ = ("receive_time_ns", "send_time_ns", "decode_wait_ns", "decode_ns", "stages")
    RECEIVE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SEND_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    DECODE_WAIT_NS_FIELD_NUMBER: _ClassVar[int]
    DECODE_NS_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    receive_time_ns: int
    send_time_ns: int
    decode_wait_ns: int
    decode_ns: int
    stages: _containers.RepeatedCompositeFieldContainer[StageTiming]
    def __init__(self, receive_time_ns: _Optional[int] = ..., send_time_ns: _Optional[int] = ..., decode_wait_ns: _Optional[int] = ..., decode_ns: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[StageTiming, _Mapping]]] = ...) -> None: ...

class StageTiming(_message.Message):
    __slots__ = ("stage", "wait_ns", "run_ns", "batch_size", "start_time_ns")
    STAGE_FIELD_NUMBER: _ClassVar[int]
    WAIT_NS_FIELD_NUMBER: _ClassVar[int]
    RUN_NS_FIELD_NUMBER: _ClassVar[int]
    BATCH_SIZE_FIELD_NUMBER: _ClassVar[int]
    START_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    stage: str
    wait_ns: int
    run_ns: int
    batch_size: int
    start_time_ns: int
    def __init__(self, stage: _Optional[str] = ..., wait_ns: _Optional[int] = ..., run_ns: _Optional[int] = ..., batch_size: _Optional[int] = ..., start_time_ns: _Optional[int] = ...) -> None: ...

class Detection(_message.Message):
    __slots__ = ("x_min", "y_min", "x_max", "y_max", "class_id", "score")
    X_MIN_FIELD_NUMBER: _ClassVar[int]
    Y_MIN_FIELD_NUMBER: _ClassVar[int]
    X_MAX_FIELD_NUMBER: _ClassVar[int]
    Y_MAX_FIELD_NUMBER: _ClassVar[int]
    CLASS_ID_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    x_min: float
    y_min: float
    x_max: float
    y_max: float
    class_id: int
    score: float
    def __init__(self, x_min: _Optional[float] = ..., y_min: _Optional[float] = ..., x_max: _Optional[float] = ..., y_max: _Optional[float] = ..., class_id: _Optional[int] = ..., score: _Optional[float] = ...) -> None: ...

class Mask(_message.Message):
    __slots__ = ("width", "height", "data", "confidence", "tokens_in", "tokens_full", "uncertainty", "prefill", "answer", "decoding")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    TOKENS_IN_FIELD_NUMBER: _ClassVar[int]
    TOKENS_FULL_FIELD_NUMBER: _ClassVar[int]
    UNCERTAINTY_FIELD_NUMBER: _ClassVar[int]
    PREFILL_FIELD_NUMBER: _ClassVar[int]
    ANSWER_FIELD_NUMBER: _ClassVar[int]
    DECODING_FIELD_NUMBER: _ClassVar[int]
    width: int
    height: int
    data: bytes
    confidence: float
    tokens_in: int
    tokens_full: int
    uncertainty: bytes
    prefill: PrefillCost
    answer: str
    decoding: str
    def __init__(self, width: _Optional[int] = ..., height: _Optional[int] = ..., data: _Optional[bytes] = ..., confidence: _Optional[float] = ..., tokens_in: _Optional[int] = ..., tokens_full: _Optional[int] = ..., uncertainty: _Optional[bytes] = ..., prefill: _Optional[_Union[PrefillCost, _Mapping]] = ..., answer: _Optional[str] = ..., decoding: _Optional[str] = ...) -> None: ...

class PrefillCost(_message.Message):
    __slots__ = ("prompt_tokens", "speedup_quadratic", "speedup_flops", "measured_ns", "whole_ns")
    PROMPT_TOKENS_FIELD_NUMBER: _ClassVar[int]
    SPEEDUP_QUADRATIC_FIELD_NUMBER: _ClassVar[int]
    SPEEDUP_FLOPS_FIELD_NUMBER: _ClassVar[int]
    MEASURED_NS_FIELD_NUMBER: _ClassVar[int]
    WHOLE_NS_FIELD_NUMBER: _ClassVar[int]
    prompt_tokens: int
    speedup_quadratic: float
    speedup_flops: float
    measured_ns: int
    whole_ns: int
    def __init__(self, prompt_tokens: _Optional[int] = ..., speedup_quadratic: _Optional[float] = ..., speedup_flops: _Optional[float] = ..., measured_ns: _Optional[int] = ..., whole_ns: _Optional[int] = ...) -> None: ...

class FrameRejected(_message.Message):
    __slots__ = ("sequence", "reason", "message", "timing")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    reason: RejectReason
    message: str
    timing: ServerTiming
    def __init__(self, sequence: _Optional[int] = ..., reason: _Optional[_Union[RejectReason, str]] = ..., message: _Optional[str] = ..., timing: _Optional[_Union[ServerTiming, _Mapping]] = ...) -> None: ...

class KeyframeRequest(_message.Message):
    __slots__ = ("last_good_sequence",)
    LAST_GOOD_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    last_good_sequence: int
    def __init__(self, last_good_sequence: _Optional[int] = ...) -> None: ...

class FlowUpdate(_message.Message):
    __slots__ = ("max_in_flight", "max_frame_bytes", "max_frame_rate")
    MAX_IN_FLIGHT_FIELD_NUMBER: _ClassVar[int]
    MAX_FRAME_BYTES_FIELD_NUMBER: _ClassVar[int]
    MAX_FRAME_RATE_FIELD_NUMBER: _ClassVar[int]
    max_in_flight: int
    max_frame_bytes: int
    max_frame_rate: float
    def __init__(self, max_in_flight: _Optional[int] = ..., max_frame_bytes: _Optional[int] = ..., max_frame_rate: _Optional[float] = ...) -> None: ...

class Closing(_message.Message):
    __slots__ = ("status", "action", "alternative_target")
    STATUS_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    ALTERNATIVE_TARGET_FIELD_NUMBER: _ClassVar[int]
    status: _status_pb2.Status
    action: CloseAction
    alternative_target: str
    def __init__(self, status: _Optional[_Union[_status_pb2.Status, _Mapping]] = ..., action: _Optional[_Union[CloseAction, str]] = ..., alternative_target: _Optional[str] = ...) -> None: ...

class Goodbye(_message.Message):
    __slots__ = ("keep_session",)
    KEEP_SESSION_FIELD_NUMBER: _ClassVar[int]
    keep_session: bool
    def __init__(self, keep_session: bool = ...) -> None: ...

class GetServerInfoRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GetServerInfoResponse(_message.Message):
    __slots__ = ("protocol_revision", "server_version", "codecs", "models", "flow", "max_pixels")
    PROTOCOL_REVISION_FIELD_NUMBER: _ClassVar[int]
    SERVER_VERSION_FIELD_NUMBER: _ClassVar[int]
    CODECS_FIELD_NUMBER: _ClassVar[int]
    MODELS_FIELD_NUMBER: _ClassVar[int]
    FLOW_FIELD_NUMBER: _ClassVar[int]
    MAX_PIXELS_FIELD_NUMBER: _ClassVar[int]
    protocol_revision: int
    server_version: str
    codecs: _containers.RepeatedScalarFieldContainer[Codec]
    models: _containers.RepeatedCompositeFieldContainer[ModelInfo]
    flow: FlowUpdate
    max_pixels: int
    def __init__(self, protocol_revision: _Optional[int] = ..., server_version: _Optional[str] = ..., codecs: _Optional[_Iterable[_Union[Codec, str]]] = ..., models: _Optional[_Iterable[_Union[ModelInfo, _Mapping]]] = ..., flow: _Optional[_Union[FlowUpdate, _Mapping]] = ..., max_pixels: _Optional[int] = ...) -> None: ...

class SyncClockRequest(_message.Message):
    __slots__ = ("client_send_time_ns",)
    CLIENT_SEND_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    client_send_time_ns: int
    def __init__(self, client_send_time_ns: _Optional[int] = ...) -> None: ...

class SyncClockResponse(_message.Message):
    __slots__ = ("client_send_time_ns", "server_receive_time_ns", "server_send_time_ns")
    CLIENT_SEND_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SERVER_RECEIVE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SERVER_SEND_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    client_send_time_ns: int
    server_receive_time_ns: int
    server_send_time_ns: int
    def __init__(self, client_send_time_ns: _Optional[int] = ..., server_receive_time_ns: _Optional[int] = ..., server_send_time_ns: _Optional[int] = ...) -> None: ...
