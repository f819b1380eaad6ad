"""``nuscenes:`` specs to sources."""

from __future__ import annotations

from pathlib import Path

from cable_rpc.data.nuscenes.can_bus import read_can_motion
from cable_rpc.data.nuscenes.scene import read_scene, scene_names
from cable_rpc.data.nuscenes.source import FRONT_CAMERA, NuScenesSource, NuScenesView
from cable_rpc.data.nuscenes.tables import tables_folder
from cable_rpc.data.sequence_spec import SequenceSpec, choose_sequence, parse_sequence_spec
from cable_rpc.data.source import SourceOptions
from cable_rpc.errors import ConfigurationError

CHOICES = {"boxes": ("keyframes", "interpolate"), "ego": ("pose", "can"), "frames": ("all", "keyframes")}
"""Option to its values, the default first."""
OPTION_KEYS = ("version", "camera", *CHOICES)


def open_nuscenes(rest: str, options: SourceOptions) -> NuScenesSource:
    """``nuscenes:ROOT#scene-0061?version=v1.0-mini&camera=CAM_FRONT&boxes=keyframes&ego=pose``.

    The version may be left out where ROOT holds one, or is a version's own folder of tables; the scene where there is
    one. ``boxes=interpolate`` gives truth between keyframes, ``frames=keyframes`` leaves out what lies between them,
    ``ego=can`` takes the ego-motion from the CAN bus expansion. Lyft Level 5 in nuScenes' format (``v1.01-train``)
    opens the same way.

    Raises:
        ConfigurationError: an option can't be used, or the scene isn't told and there are several.
        SourceError: a table can't be read.
    """
    spec = parse_sequence_spec("nuscenes", rest, OPTION_KEYS)
    values = chosen_values(spec)
    if options.ego_csv is not None or options.intrinsics is not None or options.mount is not None:
        raise ConfigurationError(
            f"'{spec.spec}': nuScenes has its own ego-motion and camera; leave ego_csv, intrinsics and mount out"
        )
    tables = tables_folder(spec.root, values.get("version"))
    name = choose_sequence(spec, scene_names(tables))
    scene = read_scene(tables, name, values["camera"], options.bad_frames)
    root = tables.parent
    can = read_can_motion(root, name, options.bad_frames) if values["ego"] == "can" else None
    view = NuScenesView(
        values["camera"],
        values["boxes"] == "interpolate",
        values["frames"] == "keyframes",
        can,
        options.size,
        options.fps,
        options.max_frames,
        options.bad_frames,
    )
    return NuScenesSource(root, scene, view)


def sequences(root: Path) -> list[str]:
    """What can follow ``#``: the scenes of a root with one version, or of a version's own folder.

    Raises:
        ConfigurationError: there are several versions, some of which may hold the same scenes.
        SourceError: there is no such folder, or a table in it can't be read.
    """
    return scene_names(tables_folder(root, None))


def chosen_values(spec: SequenceSpec) -> dict[str, str]:
    """The options of a spec and the defaults of those it leaves out.

    Raises:
        ConfigurationError: one can't be used.
    """
    values = {"camera": FRONT_CAMERA, **{key: choices[0] for key, choices in CHOICES.items()}, **spec.values}
    for key, choices in CHOICES.items():
        if values[key] not in choices:
            raise ConfigurationError(f"'{spec.spec}': {key} is '{values[key]}'; use {' or '.join(choices)}")
    return values
