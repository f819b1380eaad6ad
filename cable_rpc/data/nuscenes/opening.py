"""``nuscenes:`` specs to sources."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from cable_rpc.data.coco.opening import listed
from cable_rpc.data.nuscenes.can_bus import read_can_motion
from cable_rpc.data.nuscenes.scene import read_scene, scene_names
from cable_rpc.data.nuscenes.source import FRONT_CAMERA, NuScenesSource, NuScenesView
from cable_rpc.data.nuscenes.tables import find_versions, tables_folder
from cable_rpc.data.source import SourceOptions
from cable_rpc.errors import ConfigurationError, SourceError

CHOICES = {"boxes": ("keyframes", "interpolate"), "ego": ("pose", "can"), "frames": ("all", "keyframes")}
"""Option to its values, the default first."""
OPTION_KEYS = ("version", "camera", *CHOICES)


@dataclass(frozen=True, slots=True)
class NuScenesSpec:
    """A spec taken apart: ``ROOT#SCENE?version=...&camera=...&boxes=...&ego=...``."""

    spec: str
    """As written, for error texts."""
    root: Path
    scene: str | None
    version: str | None
    camera: str
    boxes: str
    ego: str
    frames: str


def open_nuscenes(rest: str, options: SourceOptions) -> NuScenesSource:
    """``nuscenes:ROOT#scene-0061?version=v1.0-mini&camera=CAM_FRONT&boxes=keyframes&ego=pose``.

    The version may be left out where ROOT holds one, the scene where that has one. ``boxes=interpolate`` gives truth
    between keyframes, ``frames=keyframes`` leaves out what lies between them, ``ego=can`` takes the ego-motion from the
    CAN bus expansion. Lyft Level 5 in nuScenes' format
    (``v1.01-train``) opens the same way.

    Raises:
        ConfigurationError: an option can't be used, or the scene isn't told and there are several.
        SourceError: a table can't be read.
    """
    spec = parse_spec(rest)
    if options.ego_csv is not None or options.intrinsics is not None or options.mount is not None:
        raise ConfigurationError(
            f"'{spec.spec}': nuScenes has its own ego-motion and camera; leave ego_csv, intrinsics and mount out"
        )
    tables = tables_folder(spec.root, spec.version)
    names = scene_names(tables)
    if not names:
        raise SourceError(f"{tables / 'scene.json'} lists no scene")
    if spec.scene is None and len(names) > 1:
        raise ConfigurationError(f"'{spec.spec}' has {len(names)} scenes; add #SCENE, {listed(names)}")
    if spec.scene is not None and spec.scene not in names:
        raise ConfigurationError(f"'{spec.spec}': {tables.name} has no scene '{spec.scene}'; use {listed(names)}")
    scene = read_scene(tables, spec.scene or names[0], spec.camera, options.bad_frames)
    can = read_can_motion(spec.root, scene.name, options.bad_frames) if spec.ego == "can" else None
    view = NuScenesView(
        spec.camera,
        spec.boxes == "interpolate",
        spec.frames == "keyframes",
        can,
        options.size,
        options.fps,
        options.max_frames,
        options.bad_frames,
    )
    return NuScenesSource(spec.root, scene, view)


def sequences(root: Path) -> list[str]:
    """What can follow ``#``: the scenes of all versions.

    Raises:
        SourceError: there is no such folder, or a table in it can't be read.
    """
    return sorted({name for version in find_versions(root) for name in scene_names(root / version)})


def parse_spec(rest: str) -> NuScenesSpec:
    """Take a spec apart.

    Raises:
        ConfigurationError: an option is unknown, comes twice or can't be used.
    """
    spec = f"nuscenes:{rest}"
    head, _, query = rest.partition("?")
    root, _, scene = head.partition("#")
    if not root:
        raise ConfigurationError(f"'{spec}' names no folder")
    values: dict[str, str] = {}
    for pair in query.split("&") if query else []:
        key, separator, value = pair.partition("=")
        if key not in OPTION_KEYS or not separator or not value:
            raise ConfigurationError(
                f"'{spec}': write options as key=value, joined by &; known are {', '.join(OPTION_KEYS)}"
            )
        if key in values:
            raise ConfigurationError(f"'{spec}': give {key} once")
        values[key] = unquote(value)
    for key, choices in CHOICES.items():
        if values.setdefault(key, choices[0]) not in choices:
            raise ConfigurationError(f"'{spec}': {key} is '{values[key]}'; use {' or '.join(choices)}")
    camera = values.get("camera", FRONT_CAMERA)
    return NuScenesSpec(
        spec, Path(root), scene or None, values.get("version"), camera, values["boxes"], values["ego"], values["frames"]
    )
